"""Levenberg-Marquardt damping for any solver: the same least-squares problem with a further term that holds the step small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgrasp.least_squares import LeastSquares, Term
from factorgrasp.typing import FloatArray

SMALLEST_SHARE = 1e-12
"""Information that a direction counts with at least, relative to the best informed one, so that an empty one is damped as well."""


class Damped:
    """A copy of a problem's structure with the rows ``sqrt(lambda diag(A'A)) d ~ 0`` below its own.

    Parameters
    ----------
    original : LeastSquares

    Attributes
    ----------
    problem : LeastSquares
        Given its values by `fill`; its first rows are those of the original, in the same order.
    """

    def __init__(self, original: LeastSquares) -> None:
        terms = [
            replace(term, pattern=original.jacobian.patterns_of(term.name))
            for term in original.terms.values()
        ]
        terms += [
            Term(_name(v.name), v.size, (v.name,), pattern={v.name: np.eye(v.size, dtype=bool)})
            for v in original.variables
        ]
        constraints = []
        for constraint in original.constraints.values():
            rows = original.equalities if constraint.kind == "equality" else original.inequalities
            constraints.append(replace(constraint, pattern=rows.patterns_of(constraint.name)))
        self.problem = LeastSquares(original.variables, terms, constraints)

    def fill(
        self, original: LeastSquares, damping: float, row_weights: FloatArray | None = None
    ) -> FloatArray | None:
        """Copy the values of `original` with `damping` added; returns the row weights for `problem`."""
        copy = self.problem
        for name, term in original.terms.items():
            if copy.terms[name].covariance is not term.covariance:
                copy.set_covariance(name, term.covariance)
        for target, source in (
            (copy.jacobian, original.jacobian),
            (copy.equalities, original.equalities),
            (copy.inequalities, original.inequalities),
        ):
            target.matrix.data[: source.matrix.nnz] = source.matrix.data
            target.rhs[: source.height] = source.rhs
        copy.lower[:], copy.upper[:] = original.lower, original.upper
        entries, _ = original.whitened_values(row_weights)
        columns = original.jacobian.matrix.indices
        information = np.bincount(columns, weights=entries**2, minlength=original.size)
        information = np.maximum(information, SMALLEST_SHARE * information.max(initial=1e-300))
        root = np.sqrt(damping * information)
        for variable in original.variables:
            copy.set_term(_name(variable.name), {variable.name: root[original.columns[variable.name]]}, 0.0)
        return None if row_weights is None else np.concatenate([row_weights, np.ones(original.size)])


def _name(variable: str) -> str:
    return f"damping of {variable}"

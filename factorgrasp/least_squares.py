"""Covariance-weighted least squares over named variables: the one form that every problem takes.

``x_hat = argmin sum_k rho_k(|| W_k (A_k x - b_k) ||)  subject to  E x = e,  G x <= h,  lb <= x <= ub``   (mathematics, section 1)

with ``W_k' W_k = covariance_k^-1`` and ``rho(s) = s^2 / 2`` where a term has no robust loss.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Literal, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from factorgrasp.block_rows import BlockRows, RowBlock
from factorgrasp.errors import InputError
from factorgrasp.losses import Loss
from factorgrasp.typing import BoolArray, FloatArray, IntArray
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable, slices


@dataclass(frozen=True)
class Term:
    """Measured rows: ``A x - b`` with a covariance and, if wanted, a robust loss.

    Attributes
    ----------
    name : str
    rows : int
    variables : tuple of str
        The variables that its rows touch.
    covariance : Covariance
        Of the rows, in their own units squared.
    loss : Loss or None
        Applied to the whitened norm of every group of `group` consecutive rows.
    group : int
        Rows that form one residual for the loss and for the summary; 0 stands for all rows of the term.
    pattern : mapping
        Boolean (rows, size) per variable; variables left out are dense.
    unit : str
        Unit of a row, for reports.
    """

    name: str
    rows: int
    variables: tuple[str, ...]
    covariance: Covariance = field(default_factory=lambda: Covariance.scalar(1.0))
    loss: Loss | None = None
    group: int = 0
    pattern: Mapping[str, BoolArray] = field(default_factory=dict)
    unit: str = ""


@dataclass(frozen=True)
class Constraint:
    """Exact linear rows: ``A x = b`` (equality) or ``A x <= b`` (inequality)."""

    name: str
    rows: int
    variables: tuple[str, ...]
    kind: Literal["equality", "inequality"] = "equality"
    pattern: Mapping[str, BoolArray] = field(default_factory=dict)
    unit: str = ""


class QuadraticProgram(NamedTuple):
    """``min 1/2 x'Px + q'x + constant  s.t.  G x <= h, A x = b, lb <= x <= ub``; absent parts are None."""

    P: sp.csc_array
    q: FloatArray
    G: sp.csc_array | None
    h: FloatArray | None
    A: sp.csc_array | None
    b: FloatArray | None
    lb: FloatArray | None
    ub: FloatArray | None
    constant: float


class LeastSquares:
    """Named terms and constraints over named variables, in one sparse matrix each with a fixed pattern.

    Building is slow and done once; `set_term` and `set_constraint` then fill in new values, so that the same object (and whatever a
    solver cached for its pattern) serves a batch, a sweep and a stream.

    Parameters
    ----------
    variables : sequence of Variable
    terms : sequence of Term
    constraints : sequence of Constraint

    Attributes
    ----------
    jacobian : BlockRows
        ``A`` and ``b`` of all terms, not whitened.
    equalities, inequalities : BlockRows
        ``E, e`` and ``G, h``.
    lower, upper : ndarray
        Bounds (n,), infinite where there is none.
    """

    def __init__(
        self, variables: Sequence[Variable], terms: Sequence[Term], constraints: Sequence[Constraint] = ()
    ) -> None:
        self.variables = tuple(variables)
        self.terms = {term.name: term for term in terms}
        self.constraints = {constraint.name: constraint for constraint in constraints}
        self.columns = slices(self.variables)
        self.size = sum(variable.size for variable in self.variables)
        sizes = {variable.name: variable.size for variable in self.variables}
        self.jacobian = BlockRows(
            [_row_block(term, sizes, term.covariance.block_size) for term in terms], self.columns, self.size
        )
        self.equalities = BlockRows(
            [_row_block(c, sizes) for c in constraints if c.kind == "equality"], self.columns, self.size
        )
        self.inequalities = BlockRows(
            [_row_block(c, sizes) for c in constraints if c.kind == "inequality"], self.columns, self.size
        )
        self.lower: FloatArray = np.full(self.size, -np.inf)
        self.upper: FloatArray = np.full(self.size, np.inf)
        self._scale: FloatArray = np.ones(self.jacobian.height)
        self._block_roots: dict[str, FloatArray] = {}
        for term in terms:
            self.set_covariance(term.name, term.covariance)

    # ---- values -----------------------------------------------------------------------------------------------

    def set_term(self, name: str, blocks: Mapping[str, ArrayLike], rhs: ArrayLike) -> None:
        """Fill the rows ``A x - b`` of a term: blocks (rows, size) per variable and the right-hand side (rows,)."""
        for variable, value in blocks.items():
            self.jacobian.set_block(name, variable, value)
        self.jacobian.set_rhs(name, rhs)

    def set_constraint(self, name: str, blocks: Mapping[str, ArrayLike], rhs: ArrayLike) -> None:
        """Fill the rows of a constraint: blocks (rows, size) per variable and the right-hand side (rows,)."""
        if name not in self.constraints:
            raise InputError("constraint", "one of " + ", ".join(self.constraints), repr(name))
        rows = self.equalities if self.constraints[name].kind == "equality" else self.inequalities
        for variable, value in blocks.items():
            rows.set_block(name, variable, value)
        rows.set_rhs(name, rhs)

    def set_bounds(self, variable: str, lower: ArrayLike = -np.inf, upper: ArrayLike = np.inf) -> None:
        """Bounds on the (tangent) components of a variable, scalars or (size,)."""
        where = self._column(variable)
        low, high = (
            np.broadcast_to(lower, self.lower[where].shape),
            np.broadcast_to(upper, self.upper[where].shape),
        )
        if np.any(np.isnan(low)) or np.any(np.isnan(high)) or np.any(low > high):
            raise InputError(f"bounds of {variable}", "lower <= upper", f"{low} and {high}")
        self.lower[where], self.upper[where] = low, high

    def set_covariance(self, name: str, covariance: Covariance) -> None:
        """Give a term another covariance; of blocks only when it was built with blocks of that size."""
        term = self._term(name)
        if covariance.block_size > 1 and covariance.block_size != term.covariance.block_size:
            raise InputError(
                f"covariance of {name}", f"blocks of {term.covariance.block_size}", f"{covariance.block_size}"
            )
        covariance.check_rows(term.rows, f"covariance of {name}")
        where = self.jacobian.slices[name]
        self.terms[name] = replace(term, covariance=covariance)
        if covariance.kind == "blocks":
            self._scale[where] = 1.0
            self._block_roots[name] = covariance.rows_root(term.rows)
        else:
            self._scale[where] = covariance.rows_root(term.rows)
            self._block_roots.pop(name, None)

    # ---- views ------------------------------------------------------------------------------------------------

    def whitened_values(self, row_weights: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Non-zeros of ``W A`` in the order of `jacobian.matrix.data`, and ``W b`` (rows,): fresh arrays, without a matrix object.

        Raises
        ------
        InputError
            When a term holds NaN or infinity; a gap is a row that is left out or zero, never a NaN row.
        """
        raw = self.jacobian
        data = raw.matrix.data * self._scale[raw.row_of_entry]
        rhs = raw.rhs * self._scale
        for name, roots in self._block_roots.items():
            self._whiten_blocks(name, roots, data, rhs)
        if row_weights is not None:
            data *= row_weights[raw.row_of_entry]
            rhs *= row_weights
        # One sum finds a NaN or an infinity several times faster than isfinite; only then is it worth while to look where.
        if not isfinite(data.sum() + rhs.sum()):
            self._raise_not_finite(data, rhs)
        return data, rhs

    def whitened(self, row_weights: FloatArray | None = None) -> tuple[sp.csr_array, FloatArray]:
        """``(W A, W b)`` with the pattern of ``A``; `row_weights` (rows,) multiply the rows (square roots of robust weights)."""
        raw = self.jacobian
        data, rhs = self.whitened_values(row_weights)
        matrix = sp.csr_array((data, raw.matrix.indices, raw.matrix.indptr), shape=raw.matrix.shape)
        return matrix, rhs

    def normal_equations(self, row_weights: FloatArray | None = None) -> tuple[sp.csc_array, FloatArray]:
        """``(A'W'WA, A'W'Wb)``: information matrix (n, n) and information vector (n,)."""
        matrix, rhs = self.whitened(row_weights)
        return sp.csc_array(matrix.T @ matrix), np.asarray(matrix.T @ rhs)

    def quadratic_program(self, row_weights: FloatArray | None = None) -> QuadraticProgram:
        """The same problem as a QP; its optimum plus `constant` equals ``1/2 || W (A x - b) ||^2``."""
        matrix, rhs = self.whitened(row_weights)
        hard, soft = self.equalities, self.inequalities
        bounded_low, bounded_high = np.any(np.isfinite(self.lower)), np.any(np.isfinite(self.upper))
        return QuadraticProgram(
            P=sp.csc_array(matrix.T @ matrix),
            q=-np.asarray(matrix.T @ rhs),
            G=sp.csc_array(soft.matrix) if soft.height else None,
            h=soft.rhs.copy() if soft.height else None,
            A=sp.csc_array(hard.matrix) if hard.height else None,
            b=hard.rhs.copy() if hard.height else None,
            lb=self.lower.copy() if bounded_low or bounded_high else None,
            ub=self.upper.copy() if bounded_low or bounded_high else None,
            constant=0.5 * float(rhs @ rhs),
        )

    @property
    def constrained(self) -> bool:
        """Whether there is any equality, inequality or finite bound."""
        return bool(self.equalities.height or self.has_inequalities)

    @property
    def has_inequalities(self) -> bool:
        """Whether there is any inequality or finite bound."""
        return bool(
            self.inequalities.height or np.any(np.isfinite(self.lower)) or np.any(np.isfinite(self.upper))
        )

    @property
    def robust(self) -> bool:
        """Whether any term has a robust loss."""
        return any(term.loss is not None for term in self.terms.values())

    # ---- residuals --------------------------------------------------------------------------------------------

    def residuals(self, x: FloatArray) -> FloatArray:
        """Whitened residuals ``W (A x - b)`` (rows,), without robust weights."""
        matrix, rhs = self.whitened()
        return np.asarray(matrix @ x - rhs)

    def group_norms(self, name: str, whitened_residuals: FloatArray) -> FloatArray:
        """Whitened norm of every residual (group of rows) of a term, shape (rows / group,)."""
        term = self._term(name)
        part = whitened_residuals[self.jacobian.slices[name]]
        return np.asarray(np.linalg.norm(part.reshape(-1, term.group or term.rows), axis=1))

    def robust_weights(self, whitened_residuals: FloatArray) -> FloatArray | None:
        """Square roots of the robust weights, one a row (rows,); None when no term has a loss."""
        if not self.robust:
            return None
        out = np.ones(self.jacobian.height)
        for name, term in self.terms.items():
            if term.loss is not None:
                weights = term.loss.weight(self.group_norms(name, whitened_residuals))
                out[self.jacobian.slices[name]] = np.repeat(np.sqrt(weights), term.group or term.rows)
        return out

    def objective(self, x: FloatArray) -> float:
        """``sum_k rho_k`` at `x`, robust losses included."""
        residuals = self.residuals(x)
        total = 0.0
        for name, term in self.terms.items():
            if term.loss is None:
                part = residuals[self.jacobian.slices[name]]
                total += 0.5 * float(part @ part)
            else:
                total += float(np.sum(term.loss.rho(self.group_norms(name, residuals))))
        return total

    def select(self, names: Iterable[str]) -> FloatArray:
        """Selection matrix (sum of sizes, n) of the named variables, to read covariances with."""
        columns = np.concatenate([np.arange(self.size)[self._column(name)] for name in names])
        out = np.zeros((columns.size, self.size))
        out[np.arange(columns.size), columns] = 1.0
        return out

    # ---- internals --------------------------------------------------------------------------------------------

    def _term(self, name: str) -> Term:
        if name not in self.terms:
            raise InputError("term", "one of " + ", ".join(self.terms), repr(name))
        return self.terms[name]

    def _column(self, name: str) -> slice:
        if name not in self.columns:
            raise InputError("variable", "one of " + ", ".join(self.columns), repr(name))
        return self.columns[name]

    def _raise_not_finite(self, data: FloatArray, rhs: FloatArray) -> None:
        bad = ~np.isfinite(rhs)
        bad[self.jacobian.row_of_entry[~np.isfinite(data)]] = True
        for name, where in self.jacobian.slices.items():
            if bad[where].any():
                row = int(np.flatnonzero(bad[where])[0])
                raise InputError(
                    f"term {name}",
                    "finite numbers",
                    f"NaN or infinity in {int(bad[where].sum())} of its {where.stop - where.start} rows, first in row {row}",
                    "Leave rows of gaps out, or set them and their right-hand side to zero",
                )

    def _whiten_blocks(self, name: str, roots: FloatArray, data: FloatArray, rhs: FloatArray) -> None:
        """Multiply every block of k rows by its root, in place; the rows of a block share one pattern by construction."""
        where, size = self.jacobian.slices[name], roots.shape[1]
        indptr = self.jacobian.matrix.indptr
        starts = indptr[where.start : where.stop : size].astype(np.intp)
        widths = (indptr[where.start + 1 : where.stop + 1 : size] - starts).astype(np.intp)
        # A NaN or an infinity is named by the caller; numpy's warning would say less.
        with np.errstate(invalid="ignore"):
            self._multiply_blocks(roots, data, starts, widths)
            rhs[where] = (roots @ rhs[where].reshape(-1, size, 1)).ravel()

    @staticmethod
    def _multiply_blocks(roots: FloatArray, data: FloatArray, starts: IntArray, widths: IntArray) -> None:
        size = roots.shape[1]
        for width in np.unique(widths):
            chosen = np.flatnonzero(widths == width)
            entries = starts[chosen, None] + np.arange(size * width)
            values = data[entries].reshape(chosen.size, size, width)
            data[entries] = (roots[chosen] @ values).reshape(chosen.size, -1)


def _row_block(item: Term | Constraint, sizes: Mapping[str, int], block: int = 1) -> RowBlock:
    """Patterns of a term or constraint, made equal within every block of rows that one covariance couples."""
    patterns: dict[str, BoolArray] = {}
    if item.rows < 1:
        raise InputError(f"rows of {item.name}", "at least one", str(item.rows))
    for variable in item.variables:
        if variable not in sizes:
            raise InputError(f"variables of {item.name}", "among " + ", ".join(sizes), repr(variable))
        shape = (item.rows, sizes[variable])
        pattern = np.asarray(item.pattern.get(variable, np.ones(shape, dtype=bool)), dtype=bool)
        if pattern.shape != shape:
            raise InputError(f"pattern of {item.name}/{variable}", f"shape {shape}", str(pattern.shape))
        if block > 1:
            union = pattern.reshape(-1, block, shape[1]).any(axis=1, keepdims=True)
            pattern = np.broadcast_to(union, (item.rows // block, block, shape[1])).reshape(shape)
        patterns[variable] = pattern
    return RowBlock(item.name, item.rows, patterns)

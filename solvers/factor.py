"""Posterior covariance of a solved problem, from a sparse factor and never as a dense inverse.

``P = Z (Z'HZ)^-1 Z'`` with the information matrix ``H = A'W'W A`` and a basis Z of what the equalities and the active inequalities and
bounds leave free; without constraints ``P = H^-1``. A constraint that is active removes the variance along its normal: the covariance is
that of the estimate while the active set stays what it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from factorgrasp.errors import UnobservableError
from factorgrasp.least_squares import LeastSquares
from factorgrasp.solvers.base import Solution
from factorgrasp.solvers.linear_system import LinearSystem, LinearValues, System
from factorgrasp.solvers.null_directions import NullSpace
from factorgrasp.status import Status
from factorgrasp.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class ActiveSet:
    """Which inequalities and bounds hold with equality.

    Attributes
    ----------
    inequalities : ndarray of bool
        One a row of ``G x <= h``.
    lower, upper : ndarray of bool
        One an unknown.
    """

    inequalities: BoolArray
    lower: BoolArray
    upper: BoolArray

    @property
    def empty(self) -> bool:
        """Whether nothing is active."""
        return not (self.inequalities.any() or self.lower.any() or self.upper.any())


def active_set(problem: LeastSquares, solution: Solution, row_weights: FloatArray | None = None) -> ActiveSet:
    """Active inequalities and bounds of a solution.

    Slack and multiplier are both put in conditional standard deviations of their row, so that the larger of the two decides
    without units; a row without any multiplier (a solver that reports none) counts as active when its slack is nil.
    """
    rows, size = problem.inequalities, problem.size
    if not problem.has_inequalities:
        none = np.zeros(size, dtype=bool)
        return ActiveSet(np.zeros(0, dtype=bool), none, none)
    entries, _ = problem.whitened_values(row_weights)
    information = np.bincount(problem.jacobian.matrix.indices, weights=entries**2, minlength=size)
    sd = 1.0 / np.sqrt(np.where(information > 0.0, information, 1.0))
    x = solution.x
    spread = np.sqrt(np.asarray(rows.matrix.power(2) @ sd**2)) if rows.height else np.zeros(0)
    spread = np.where(spread > 0.0, spread, 1.0)
    z = solution.z if solution.z.size == rows.height else np.zeros(rows.height)
    box = solution.z_box if solution.z_box.size == size else np.zeros(size)
    slack = rows.rhs - rows.matrix @ x if rows.height else np.zeros(0)
    return ActiveSet(
        _active(slack, z, spread),
        _active(x - problem.lower, -box, sd),
        _active(problem.upper - x, box, sd),
    )


def _active(slack: FloatArray, multiplier: FloatArray, spread: FloatArray) -> BoolArray:
    distance, pull = slack / spread, multiplier * spread
    return np.asarray(((pull > distance) & (pull > 1e-6) & (distance < 1e-2)) | (distance <= 1e-9))


class Factor:
    """Covariance of the unknowns, held as a factorisation.

    Attributes
    ----------
    null : NullSpace
        Directions that nothing informs; variances along them are infinite.
    size : int
    """

    def __init__(self, system: LinearSystem, values: LinearValues) -> None:
        self._values = values
        self._linear = system
        self._stamp = system.stamp
        self.size = system.size
        self.null: NullSpace = system.system.null

    def solve(self, columns: FloatArray) -> FloatArray:
        """``P B`` (n, k) for B (n, k) or (n,); NaN in a column that reaches into a null direction."""
        columns = np.asarray(columns, dtype=float)
        out = self._system().apply(columns)
        reached = self.null.reaches(columns if columns.ndim == 2 else columns[:, None])
        return np.where(reached if columns.ndim == 2 else reached[0], np.nan, out) if reached.any() else out

    def informed_solve(self, columns: FloatArray) -> FloatArray:
        """``P B`` without a look at null directions: right for read-outs that none of them reaches, meaningless for others."""
        return self._system().apply(np.asarray(columns, dtype=float))

    def marginal(self, indices: IntArray) -> FloatArray:
        """Covariance (k, k) of the unknowns at `indices`; infinite variances and NaN covariances where nothing informs them."""
        indices = np.asarray(indices, dtype=np.intp)
        out = self.informed_marginal(indices)
        lost = self.null.reaches_unknowns()[indices]
        if lost.any():
            out[lost] = out[:, lost] = np.nan
            out[lost, lost] = np.inf
        return out

    def informed_marginal(self, indices: IntArray) -> FloatArray:
        """The same, but finite: right for every combination of the unknowns that no null direction reaches, meaningless for others."""
        indices = np.asarray(indices, dtype=np.intp)
        system = self._system()
        block = system.block(indices)
        if block is None:
            block = system.apply(_unit_columns(self.size, indices))[indices]
        return np.asarray(0.5 * (block + block.T))

    def prepare_marginals(self) -> None:
        """Make many calls of `marginal` cheap: one selected inverse holds the covariances of all unknowns that share a row."""
        self._system().prepare_blocks()

    def variances(self) -> FloatArray:
        """Variances of all unknowns (n,) at once, by the selected inverse; infinite where nothing informs them."""
        out = np.array(self._system().variances())
        out[self.null.reaches_unknowns()] = np.inf
        return out

    def _system(self) -> System:
        """The factored system; made anew when the solver that lent it has gone on to other values."""
        if self._linear.stamp != self._stamp:
            self._linear = self._linear.fresh()
            self._linear.update(self._values)
            self._stamp = self._linear.stamp
        return self._linear.for_covariance(self._values)


def posterior_factor(
    problem: LeastSquares,
    x: FloatArray,
    row_weights: FloatArray | None = None,
    active: ActiveSet | None = None,
) -> Factor:
    """Factor of the posterior at `x`.

    Parameters
    ----------
    problem : LeastSquares
    x : ndarray
        (n,) solution, used to find the active set when it is not given.
    row_weights : ndarray, optional
        (rows,) square roots of the robust weights at `x`.
    active : ActiveSet, optional
        What is active; by default every inequality and bound without slack at `x`. A solver's multipliers say it better:
        :func:`active_set`.

    Raises
    ------
    UnobservableError
        When the constraints that are active contradict each other, so that there is no covariance.
    """
    if active is None:
        active = active_set(problem, Solution(np.asarray(x, dtype=float), Status.SOLVED), row_weights)
    hard, hard_rhs = _hard_rows(problem, active)
    entries, rhs = problem.whitened_values(row_weights)
    system = LinearSystem.of(problem, hard)
    values = LinearValues(entries, rhs, hard, hard_rhs)
    system.update(values)
    if system.system.violated.size:
        raise UnobservableError("the active constraints contradict each other: there is no covariance")
    return Factor(system, values)


def _hard_rows(problem: LeastSquares, active: ActiveSet) -> tuple[sp.csr_array, FloatArray]:
    equalities = problem.equalities
    if active.empty:
        return equalities.matrix.copy(), equalities.rhs.copy()
    bound = np.flatnonzero(active.lower | active.upper)
    unit = sp.csr_array(
        (np.ones(bound.size), (np.arange(bound.size), bound)), shape=(bound.size, problem.size)
    )
    parts = [equalities.matrix, problem.inequalities.matrix[np.flatnonzero(active.inequalities)], unit]
    level = np.where(active.lower, problem.lower, problem.upper)[bound]
    rhs = [equalities.rhs, problem.inequalities.rhs[active.inequalities], level]
    matrix = sp.csr_array(sp.vstack([part for part in parts if part.shape[0]]))
    matrix.sort_indices()
    return matrix, np.concatenate(rhs)


def _unit_columns(size: int, indices: IntArray) -> FloatArray:
    out = np.zeros((size, indices.size))
    out[indices, np.arange(indices.size)] = 1.0
    return out

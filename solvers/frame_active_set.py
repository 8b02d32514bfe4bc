"""Inequalities in many frames of one pattern: the active set is found by solving with it, on the fast path without constraints.

A row of ``G x <= h`` that is active enters as one more measurement ``G x = h``, so exact that what it leaves (1e-4 of the row's
*conditional* variance) does not matter; its multiplier is what holds it there, ``z = w^2 (G x - h)``. A row leaves the set when its
multiplier turns negative and enters when it is violated (the primal-dual active-set method; Hintermueller, Ito and Kunisch 2003). It
settles in a few solves where few rows are active; a frame in which it does not settle goes to a QP solver. The covariance is that of the
estimate while the active set stays what it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from factorgrasp.least_squares import LeastSquares, Term
from factorgrasp.solvers.base import Solution
from factorgrasp.solvers.frames import FrameResult, FrameSolver
from factorgrasp.typing import BoolArray, FloatArray, IntArray

MOST_SOLVES = 15
EXACT = 1e4
"""Information of an active row over its conditional information."""
TOLERANCE = 1e-9
"""Violation, relative to the row's numbers, below which an inactive row counts as kept."""


class InequalityFrames(Protocol):
    """What a problem of frames offers beyond :class:`factorgrasp.solvers.frames.FrameProblem` to come here."""

    @property
    def pattern(self) -> LeastSquares:
        """With the inequalities' pattern."""
        ...

    @property
    def marginals(self) -> tuple[IntArray, ...]:
        """Groups of unknowns whose joint covariance is wanted."""
        ...

    def whitened_frames(self, frames: slice) -> tuple[FloatArray, FloatArray]:
        """Whitened non-zeros and right-hand sides."""
        ...

    def inequality_frames(self, frames: slice) -> tuple[FloatArray, FloatArray]:
        """Non-zeros (n, nnz) in the order of ``pattern.inequalities.matrix.data`` and limits (n, rows)."""
        ...


@dataclass(frozen=True)
class ActiveSetResult:
    """Outcome of some frames.

    Attributes
    ----------
    result : FrameResult
        With one solution a frame, which holds the multipliers.
    settled : ndarray of bool
        (n,) frames for which the active set was found.
    """

    result: FrameResult
    settled: BoolArray


class ActiveSetSolver:
    """Solver of one pattern with inequalities.

    Parameters
    ----------
    problem : InequalityFrames
        Without equalities or bounds.
    """

    def __init__(self, problem: InequalityFrames) -> None:
        pattern = problem.pattern
        rows = pattern.inequalities
        limits = [
            Term(
                f"limit: {name}",
                where.stop - where.start,
                rows.variables_of(name),
                pattern=rows.patterns_of(name),
            )
            for name, where in rows.slices.items()
        ]
        self._problem, self._rows = problem, rows
        self._solver = FrameSolver(
            LeastSquares(pattern.variables, [*pattern.terms.values(), *limits]), problem.marginals
        )
        self._columns = pattern.jacobian.matrix.indices
        self._of_entry, self._column_of_entry = rows.row_of_entry, rows.matrix.indices
        self._size = pattern.size

    def solve(self, frames: slice, covariance: bool = True) -> ActiveSetResult:
        """Solve some frames of the problem."""
        entries, rhs = self._problem.whitened_frames(frames)
        G, h = self._problem.inequality_frames(frames)
        count, height = h.shape
        weight = np.sqrt(EXACT) / self._conditional_sd(entries, G, height)
        size = np.maximum(np.abs(h), 1.0)
        active = np.zeros((count, height), dtype=bool)
        settled = np.zeros(count, dtype=bool)
        x = np.empty((count, self._size))
        pending = np.arange(count)
        for _ in range(MOST_SOLVES):
            w = np.where(active, weight, 0.0)[pending]
            x[pending] = self._solver.solve(
                *self._stacked(entries, rhs, G, h, w, pending), covariance=False
            ).x
            excess = self._excess(G, h, x, pending)
            wanted = np.where(active[pending], excess > 0.0, excess > TOLERANCE * size[pending])
            same = np.all(wanted == active[pending], axis=1) | ~np.isfinite(x[pending]).all(axis=1)
            settled[pending[same]] = True
            active[pending] = wanted
            pending = pending[~same]
            if not pending.size:
                break
        every = np.arange(count)
        w = np.where(active, weight, 0.0)
        result = self._solver.solve(*self._stacked(entries, rhs, G, h, w, every), covariance)
        z = np.maximum(w**2 * self._excess(G, h, result.x, every), 0.0)
        solutions = tuple(Solution(result.x[f], result.status[f], z=z[f]) for f in range(count))
        return ActiveSetResult(replace(result, solver="active-set", solutions=solutions), settled)

    def _stacked(
        self,
        entries: FloatArray,
        rhs: FloatArray,
        G: FloatArray,
        h: FloatArray,
        w: FloatArray,
        frames: IntArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Rows of the problem and, weighted, of the limits."""
        below = G[frames] * w[:, self._of_entry]
        return np.concatenate([entries[frames], below], axis=1), np.concatenate(
            [rhs[frames], w * h[frames]], axis=1
        )

    def _excess(self, G: FloatArray, h: FloatArray, x: FloatArray, frames: IntArray) -> FloatArray:
        """``G x - h`` (n, rows)."""
        products = G[frames] * x[frames][:, self._column_of_entry]
        starts = self._rows.matrix.indptr[:-1]
        return np.asarray(np.add.reduceat(products, starts, axis=1) - h[frames])

    def _conditional_sd(self, entries: FloatArray, G: FloatArray, height: int) -> FloatArray:
        """(n, rows) sd that a row would have if every unknown had its conditional variance."""
        information = np.zeros((entries.shape[0], self._size))
        for frame in range(entries.shape[0]):
            information[frame] = np.bincount(self._columns, weights=entries[frame] ** 2, minlength=self._size)
        variance = 1.0 / np.where(information > 0.0, information, 1.0)
        spread = np.add.reduceat(
            G**2 * variance[:, self._column_of_entry], self._rows.matrix.indptr[:-1], axis=1
        )
        return np.asarray(np.sqrt(np.where(spread > 0.0, spread, 1.0)))

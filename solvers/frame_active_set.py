"""Inequalities in many frames of one pattern: the active set is found by solving with it, on the fast path without constraints.

A row of ``G x <= h`` that is active enters as one more measurement ``G x = h`` with 1e-8 of the variance that
the row has when it is free, and, once the
set is known, a step of multipliers takes out what even that gives way; the multiplier is what holds it there, ``z =
w^2 (G x - h)``. A row leaves the set when its
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
from factorgrasp.status import Status
from factorgrasp.typing import BoolArray, FloatArray, IntArray

MOST_SOLVES = 15
EXACT = 1e8
"""Information of an active row over that which it has when it is free."""
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
        self._groups, self._asked = list(problem.marginals), len(problem.marginals)
        self._places: list[tuple[slice, int, IntArray]] = []
        for where in rows.slices.values():
            first, last = int(rows.matrix.indptr[where.start]), int(rows.matrix.indptr[where.stop])
            columns = rows.matrix.indices[first:last]
            group = np.unique(columns).astype(np.intp)
            known = [i for i, one in enumerate(self._groups) if np.array_equal(one, group)]
            if not known:
                self._groups.append(group)
            at = known[0] if known else len(self._groups) - 1
            self._places.append((where, at, np.searchsorted(group, columns)))
        self._solver = FrameSolver(
            LeastSquares(pattern.variables, [*pattern.terms.values(), *limits]), self._groups
        )
        self._of_entry, self._column_of_entry = rows.row_of_entry, rows.matrix.indices
        self._size = pattern.size

    def solve(
        self, frames: slice, covariance: bool = True, start: BoolArray | None = None
    ) -> ActiveSetResult:
        """Solve some frames of the problem, from no active row or from those (n, rows) in `start`."""
        return self.solve_values(
            *self._problem.whitened_frames(frames),
            *self._problem.inequality_frames(frames),
            covariance,
            start,
        )

    def solve_values(
        self,
        entries: FloatArray,
        rhs: FloatArray,
        G: FloatArray,
        h: FloatArray,
        covariance: bool = True,
        start: BoolArray | None = None,
    ) -> ActiveSetResult:
        """The same from whitened non-zeros and right-hand sides, and the non-zeros and limits of the inequalities."""
        count, height = h.shape
        size = np.maximum(np.abs(h), 1.0)
        active = np.zeros((count, height), dtype=bool) if start is None else start.copy()
        weight = np.zeros((count, height))
        self._weigh(weight, np.flatnonzero(active.any(axis=1)), entries, rhs, G, h)
        settled = np.zeros(count, dtype=bool)
        x = np.empty((count, self._size))
        status = [Status.SOLVED] * count
        messages: dict[int, str] = {}
        pending, spent = np.arange(count), 0.0
        for _ in range(MOST_SOLVES):
            w = np.where(active, weight, 0.0)[pending]
            found = self._solver.solve(*self._stacked(entries, rhs, G, h, w, pending), covariance=False)
            x[pending] = found.x
            spent += found.time
            for i, f in enumerate(map(int, pending)):
                status[f] = found.status[i]
                messages.pop(f, None)
                if i in found.messages:
                    messages[f] = found.messages[i]
            excess = self._excess(G, h, x, pending)
            wanted = np.where(active[pending], excess > 0.0, excess > TOLERANCE * size[pending])
            same = np.all(wanted == active[pending], axis=1) | ~np.isfinite(x[pending]).all(axis=1)
            settled[pending[same]] = True
            active[pending] = wanted
            pending = pending[~same]
            self._weigh(weight, pending[~weight[pending].any(axis=1)], entries, rhs, G, h)
            if not pending.size:
                break
        every = np.arange(count)
        w = np.where(active, weight, 0.0)
        # A step of multipliers: aimed short by what the row gave way, it ends where it should.
        short = np.where(active, self._excess(G, h, x, every), 0.0)
        again = every if covariance else np.flatnonzero(active.any(axis=1))
        aim = h - short
        result = FrameResult(x, np.empty((count, 0)), (), tuple(status), messages, "cholesky", spent)
        if again.size:
            last = self._solver.solve(*self._stacked(entries, rhs, G, aim, w[again], again), covariance)
            if covariance:
                result = replace(last, marginals=last.marginals[: self._asked])
            else:
                x[again] = last.x
        z = np.maximum(w**2 * self._excess(G, aim, result.x, every), 0.0)
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

    def _weigh(
        self,
        weight: FloatArray,
        frames: IntArray,
        entries: FloatArray,
        rhs: FloatArray,
        G: FloatArray,
        h: FloatArray,
    ) -> None:
        """Fill in what holds rows of some frames: 1e-8 of the variance that a row has when it is free."""
        if not frames.size:
            return
        none = np.zeros((frames.size, h.shape[1]))
        free = self._solver.solve(*self._stacked(entries, rhs, G, h, none, frames))
        for rows, group, column in self._places:
            first, last = int(self._rows.matrix.indptr[rows.start]), int(self._rows.matrix.indptr[rows.stop])
            dense = np.zeros((frames.size, rows.stop - rows.start, self._groups[group].size))
            dense[:, self._of_entry[first:last] - rows.start, column] = G[frames, first:last]
            variance = np.einsum("nri,nij,nrj->nr", dense, free.marginals[group], dense)
            weight[frames, rows] = np.sqrt(EXACT / np.where(variance > 0.0, variance, 1.0))

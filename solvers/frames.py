"""Many least-squares problems of one pattern (the frames of a recording or a stream): the symbolic work is done once for all of them.

The factorisation is ``L D L'`` of the normal equations in an order that qdldl's AMD chose, with refinement through A, as
:mod:`factorgrasp.solvers.sparse_system` does it for one problem; frames whose numbers leave it too few digits go there instead.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import scipy.sparse as sp

from factorgrasp.errors import InputError, NotSolvedError, SolverError
from factorgrasp.least_squares import LeastSquares
from factorgrasp.solvers import frame_kernels
from factorgrasp.solvers.base import Solution, Solver, SolverOptions
from factorgrasp.solvers.factor import active_set, posterior_factor
from factorgrasp.solvers.linear_system import LinearSystem, LinearValues
from factorgrasp.solvers.registry import get_solver
from factorgrasp.status import Status
from factorgrasp.typing import BoolArray, FloatArray, IntArray

LANES = 8
"""Frames side by side in the compiled loop; a single frame has a loop of its own."""
MOST_REFINEMENTS = 6
TOO_WEAK = 3e12
"""Trace of the scaled inverse above which the selected inverse may have fewer than four digits (measured: 2e-6 at
1.2e11); refined solves come in then."""
MOST_ENTRIES = 400_000
"""Numbers of A that are held at a time, so that they stay in the cache; longer recordings are worked through in pieces."""


@runtime_checkable
class FrameProblem(Protocol):
    """A problem of many frames that share one pattern and are solved one by one."""

    kind: str

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        ...

    @property
    def pattern(self) -> LeastSquares:
        """A least-squares problem with the pattern of every frame; its values are of no interest."""
        ...

    @property
    def marginals(self) -> tuple[IntArray, ...]:
        """Groups of unknowns whose joint covariance is wanted."""
        ...

    def whitened_frames(self, frames: slice) -> tuple[FloatArray, FloatArray]:
        """Whitened non-zeros (n, nnz) in the order of ``pattern.jacobian.matrix.data`` and right-hand sides (n, rows)."""
        ...

    def frame(self, index: int) -> LeastSquares:
        """One frame with its values and constraints filled in; the same object may be refilled by later calls."""
        ...

    def view_frames(self, result: FrameResult) -> Any:
        """The typed view of all frames."""
        ...


@dataclass(frozen=True)
class FrameResult:
    """Estimates of n frames.

    Attributes
    ----------
    x : ndarray
        (n, size) unknowns; NaN in a frame that was not solved.
    variances : ndarray
        (n, size); empty (n, 0) when no covariance was asked for.
    marginals : tuple of ndarray
        (n, k, k) for every group that the problem names.
    status : tuple of Status
    messages : mapping of int to str
        Frame and reason, where there is something to say.
    solver : str
    time : float
        Seconds for all frames.
    careful : int
        Frames that needed the slower, more careful linear algebra.
    solutions : tuple of Solution
        With constraints only: one a frame, with its multipliers.
    """

    x: FloatArray
    variances: FloatArray
    marginals: tuple[FloatArray, ...]
    status: tuple[Status, ...]
    messages: dict[int, str]
    solver: str
    time: float = float("nan")
    careful: int = 0
    solutions: tuple[Solution, ...] = ()

    @property
    def solved(self) -> BoolArray:
        """(n,) which frames are solved."""
        return np.array([status.ok for status in self.status], dtype=bool)


class FrameSolver:
    """Solver of one pattern for any number of frames, without constraints.

    Parameters
    ----------
    pattern : LeastSquares
        Only its pattern is used.
    marginals : sequence of ndarray
        Groups of unknowns whose joint covariances are wanted.
    compiled : bool, optional
        Insist on the compiled loop or on the one without; by default compiled where numba is installed.
    """

    def __init__(
        self, pattern: LeastSquares, marginals: Sequence[IntArray] = (), compiled: bool | None = None
    ) -> None:
        if pattern.equalities.height:
            raise SolverError("FrameSolver takes no equality constraints: use solve_frames with a QP solver")
        matrix = pattern.jacobian.matrix
        self._pattern, self.size, self.rows = pattern, pattern.size, matrix.shape[0]
        self.marginals = tuple(np.asarray(group, dtype=np.int64) for group in marginals)
        self._plan: _Plan | None = None
        if compiled is not False and frame_kernels.load(1) is not None:
            self._plan = _Plan(matrix.indptr, matrix.indices, pattern.size, self.marginals)
        elif compiled:
            raise SolverError("the compiled loop needs numba: pip install factorgrasp[fast]")
        self._careful: LinearSystem | None = None

    def solve(self, entries: FloatArray, rhs: FloatArray, covariance: bool = True) -> FrameResult:
        """Solve n frames.

        Parameters
        ----------
        entries : ndarray
            (n, nnz) whitened non-zeros in the order of the pattern's ``jacobian.matrix.data``.
        rhs : ndarray
            (n, rows) whitened right-hand sides.
        covariance : bool
            Also compute all variances and the marginal covariances.
        """
        started = time.perf_counter()
        count, size = rhs.shape[0], self.size
        if entries.shape[0] != count or rhs.shape[1] != self.rows:
            raise InputError(
                "frames",
                f"entries (n, nnz) and right-hand sides (n, {self.rows})",
                f"{entries.shape}, {rhs.shape}",
            )
        x = np.empty((count, size))
        variances = np.empty((count, size if covariance else 0))
        widths = [group.size**2 for group in self.marginals]
        pairs = np.empty((count, sum(widths) if covariance else 0))
        info = np.zeros((count, 2))
        if self._plan is None:
            doubtful = np.arange(count)
        else:
            self._plan.run(entries, rhs, covariance, x, variances, pairs, info)
            bad = (info[:, 0] > 0.0) | ~np.isfinite(x.sum(axis=1)) | ~(info[:, 1] <= TOO_WEAK)
            doubtful = np.flatnonzero(bad)
        ends = np.cumsum(widths)
        blocks = tuple(
            pairs[:, end - width : end].reshape(count, group.size, group.size)
            for end, width, group in zip(ends, widths, self.marginals, strict=True)
        ) if covariance else ()  # fmt: skip
        status, messages = [Status.SOLVED] * count, {}
        for f in map(int, doubtful):
            try:
                x[f] = self._solve_carefully(entries[f], rhs[f])
                if covariance:
                    self._covariance_carefully(f, variances, blocks)
            except NotSolvedError as error:
                x[f] = np.nan
                variances[f] = np.nan
                for block in blocks:
                    block[f] = np.nan
                status[f], messages[int(f)] = Status.NUMERICAL_ERROR, str(error)
        elapsed = time.perf_counter() - started
        return FrameResult(
            x, variances, blocks, tuple(status), messages, "cholesky", elapsed, int(doubtful.size)
        )

    def _solve_carefully(self, entries: FloatArray, rhs: FloatArray) -> FloatArray:
        if not np.isfinite(entries.sum() + rhs.sum()):
            raise NotSolvedError(
                "a row holds NaN or infinity where its value is no gap: the motion of this frame is incomplete"
            )
        if self._careful is None:
            self._careful = LinearSystem.of(self._pattern)
        self._values = LinearValues(
            entries, rhs, self._pattern.equalities.matrix, self._pattern.equalities.rhs
        )
        self._careful.update(self._values)
        return self._careful.system.x

    def _covariance_carefully(self, f: int, variances: FloatArray, blocks: Sequence[FloatArray]) -> None:
        from factorgrasp.solvers.factor import Factor

        assert self._careful is not None
        factor = Factor(self._careful, self._values)
        variances[f] = factor.variances()
        for group, block in zip(self.marginals, blocks, strict=True):
            block[f] = factor.marginal(group)


class _Plan:
    """Where every product of the compiled loop goes, for one pattern."""

    def __init__(self, indptr: IntArray, indices: IntArray, size: int, groups: Sequence[IntArray]) -> None:
        import qdldl

        self.size = size
        self._indptr, self._indices = indptr.astype(np.int64), indices.astype(np.int64)
        counts = np.diff(self._indptr)
        number = int(self._indptr[-1])
        partners = np.repeat(self._indptr[1:], counts) - np.arange(number)
        left = np.repeat(np.arange(number), partners)
        right = left + np.arange(left.size) - np.repeat(np.cumsum(partners) - partners, partners)
        one, other = self._indices[left], self._indices[right]
        cliques = [np.array(np.meshgrid(group, group)).reshape(2, -1) for group in groups]
        first = np.concatenate([one, np.arange(size), *(c[0] for c in cliques)])
        second = np.concatenate([other, np.arange(size), *(c[1] for c in cliques)])
        # A matrix that has the pattern and is safely positive definite, to learn order and fill from.
        ones = sp.coo_array(
            (np.ones(first.size), (np.minimum(first, second), np.maximum(first, second))), shape=(size, size)
        )
        upper = sp.csc_matrix(ones)
        upper.data[:] = 1.0
        upper.setdiag(
            4.0 * np.bincount(np.concatenate([upper.indices, upper.nonzero()[1]]), minlength=size) + 1.0
        )
        upper.sort_indices()
        lower, _, order = qdldl.Solver(upper, upper=True).factors()
        pattern = sp.csc_array(lower)
        pattern.sort_indices()
        self._place = np.empty(size, dtype=np.int64)
        self._place[np.asarray(order)] = np.arange(size)
        self._factor_indptr, self._factor_rows = (
            pattern.indptr.astype(np.int64),
            pattern.indices.astype(np.int64),
        )
        self._keys = np.repeat(np.arange(size), np.diff(self._factor_indptr)) * size + self._factor_rows
        self._gram_target = self._positions(self._place[one], self._place[other])
        a, b, starts = _column_pairs(self._factor_indptr)
        self._update_target = self._positions(self._factor_rows[a], self._factor_rows[b])
        self._update_start = starts
        asked = [self._positions(self._place[c[0]], self._place[c[1]]) for c in cliques]
        self._pairs = np.concatenate(asked) if asked else np.empty(0, dtype=np.int64)

    def _positions(self, one: IntArray, other: IntArray) -> IntArray:
        """Where the entries (one, other), in factor order, are kept: strictly lower ones first, then the diagonal."""
        low, high = np.minimum(one, other), np.maximum(one, other)
        at = np.searchsorted(self._keys, low * self.size + high)
        return np.asarray(np.where(low == high, self._keys.size + low, at), dtype=np.uint32)

    def run(
        self, entries: FloatArray, rhs: FloatArray, covariance: bool,
        x: FloatArray, variances: FloatArray, pairs: FloatArray, info: FloatArray,
    ) -> None:  # fmt: skip
        """Fill the last four arrays."""
        kernel: Callable[..., None] | None = frame_kernels.load(1 if rhs.shape[0] == 1 else LANES)
        assert kernel is not None
        kernel(
            np.ascontiguousarray(entries), np.ascontiguousarray(rhs), self._indptr, self._indices, self._gram_target,
            self._factor_indptr, self._factor_rows, self._update_target, self._update_start, self._place, self._pairs,
            MOST_REFINEMENTS, covariance, x, variances, pairs, info,
        )  # fmt: skip


def _column_pairs(indptr: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Positions (p, q <= p) of all pairs of entries of one column, column by column, and where the pairs of every column start."""
    counts = np.diff(indptr)
    number = int(indptr[-1])
    own = np.arange(number) - np.repeat(indptr[:-1], counts)
    p = np.repeat(np.arange(number), own + 1)
    before = np.concatenate([[0], np.cumsum(own + 1)])
    q = (
        np.repeat(np.repeat(indptr[:-1], counts), own + 1)
        + np.arange(p.size)
        - np.repeat(before[:-1], own + 1)
    )
    return p, q, before[indptr[:-1]]


def solve_frames(
    problem: FrameProblem,
    solver: str | None = None,
    options: SolverOptions | None = None,
    *,
    covariance: bool = True,
) -> Any:
    """Solve all frames of a problem.

    Parameters
    ----------
    problem : FrameProblem
        Such as :class:`factorgrasp.problems.human_dynamics.HumanDynamics`.
    solver : str, optional
        By default "cholesky" by one plan for all frames; with inequalities "active-set", which hands frames that it cannot settle to the
        best QP solver installed; "piqp" then finds the active rows by an interior point and polishes what follows
        from them; with equality constraints "kkt" or that QP solver, frame by frame. Any other solver's name also works so.
    options : SolverOptions, optional
        For a solver that goes frame by frame.
    covariance : bool
        Also compute all variances and the marginal covariances that the problem names.

    Returns
    -------
    object
        The typed view that the problem makes of the :class:`FrameResult`.
    """
    if problem.frame_count == 0:
        raise InputError("frames", "at least one frame", "none")
    result = _solve_frames(problem, solver, options, covariance)
    again = getattr(problem, "relinearised", None)
    nearer = None if again is None else again(result.x)
    if nearer is not None:
        spent = result.time
        problem, result = nearer, _solve_frames(nearer, solver, options, covariance)
        result = replace(result, time=result.time + spent)
    return problem.view_frames(result)


def _solve_frames(
    problem: FrameProblem, solver: str | None, options: SolverOptions | None, covariance: bool
) -> FrameResult:
    first = problem.frame(0)
    only_rows = (
        first.inequalities.height
        and not first.equalities.height
        and not np.isfinite([first.lower, first.upper]).any()
    )
    if solver in (None, "cholesky") and not first.constrained:
        return _all_at_once(problem, covariance)
    if solver in (None, "active-set", "piqp") and only_rows and hasattr(problem, "inequality_frames"):
        return _with_inequalities(problem, solver or "active-set", options, covariance)
    return _one_by_one(problem, first, solver, options, covariance)


def _with_inequalities(
    problem: Any, name: str, options: SolverOptions | None, covariance: bool
) -> FrameResult:
    from factorgrasp.solvers.frame_active_set import ActiveSetSolver

    started = time.perf_counter()
    if name == "piqp":
        from factorgrasp.solvers.frame_piqp import PiqpFrames

        get_solver(name, options)  # whose error says how to install it
        chosen = options or SolverOptions()
        limits = {} if chosen.max_iterations is None else {"max_iter": chosen.max_iterations}
        machine: Any = PiqpFrames(problem, {"eps_abs": chosen.tolerance, **limits, **chosen.extra})
    else:
        machine = ActiveSetSolver(problem)
    count = problem.frame_count
    step = max(LANES, MOST_ENTRIES // max(problem.pattern.jacobian.matrix.nnz, 1))
    parts, left = [], []
    for first in range(0, count, step):
        found = machine.solve(slice(first, min(first + step, count)), covariance)
        parts.append(found.result)
        left += [first + int(f) for f in np.flatnonzero(~found.settled)]
    whole = _joined(parts, step, started, name)
    if not left:
        return whole
    backend = None if name == "active-set" else name
    rest = _one_by_one(problem, problem.frame(left[0]), backend, options, covariance, left)
    status, solutions = list(whole.status), list(whole.solutions)
    for i, f in enumerate(left):
        whole.x[f], status[f], solutions[f] = rest.x[i], rest.status[i], rest.solutions[i]
        if covariance:
            whole.variances[f] = rest.variances[i]
            for mine, theirs in zip(whole.marginals, rest.marginals, strict=True):
                mine[f] = theirs[i]
    messages = {**whole.messages, **{left[i]: words for i, words in rest.messages.items()}}
    return FrameResult(
        whole.x, whole.variances, whole.marginals, tuple(status), messages, f"{name}, {rest.solver} in {len(left)} frames",
        time.perf_counter() - started, whole.careful, tuple(solutions),
    )  # fmt: skip


def _all_at_once(problem: FrameProblem, covariance: bool) -> FrameResult:
    started = time.perf_counter()
    machine = FrameSolver(problem.pattern, problem.marginals)
    count = problem.frame_count
    step = max(LANES, MOST_ENTRIES // max(problem.pattern.jacobian.matrix.nnz, 1))
    parts = [
        machine.solve(*problem.whitened_frames(slice(first, min(first + step, count))), covariance)
        for first in range(0, count, step)
    ]
    return _joined(parts, step, started, "cholesky")


def _joined(parts: Sequence[FrameResult], step: int, started: float, solver: str) -> FrameResult:
    """Pieces of `step` frames as one result."""
    messages = {k * step + f: words for k, part in enumerate(parts) for f, words in part.messages.items()}
    blocks = zip(*(part.marginals for part in parts), strict=True)
    return FrameResult(
        np.concatenate([part.x for part in parts]),
        np.concatenate([part.variances for part in parts]),
        tuple(np.concatenate(block) for block in blocks),
        tuple(status for part in parts for status in part.status),
        messages,
        solver,
        time.perf_counter() - started,
        sum(part.careful for part in parts),
        tuple(solution for part in parts for solution in part.solutions),
    )


def _one_by_one(
    problem: FrameProblem,
    first: LeastSquares,
    name: str | None,
    options: SolverOptions | None,
    covariance: bool,
    chosen_frames: Sequence[int] | None = None,
) -> FrameResult:
    from factorgrasp.solvers.solve import default_solver

    started = time.perf_counter()
    frames = range(problem.frame_count) if chosen_frames is None else chosen_frames
    count, size = len(frames), first.size
    chosen: Solver = get_solver(name or default_solver(first), options)
    x, variances = np.full((count, size), np.nan), np.full((count, size if covariance else 0), np.nan)
    blocks = tuple(np.full((count, g.size, g.size), np.nan) for g in problem.marginals) if covariance else ()
    status: list[Status] = []
    solutions: list[Solution] = []
    messages: dict[int, str] = {}
    for f, frame in enumerate(frames):
        system = problem.frame(frame)
        try:
            chosen.setup(system)
            found = chosen.solve()
            x[f] = found.x
            if covariance and found.status.ok:
                factor = posterior_factor(system, found.x, None, active_set(system, found))
                variances[f] = factor.variances()
                for block, group in zip(blocks, problem.marginals, strict=True):
                    block[f] = factor.marginal(group)
        except NotSolvedError as error:
            found = Solution(np.full(size, np.nan), Status.NUMERICAL_ERROR, message=str(error))
        status.append(found.status)
        solutions.append(found)
        if found.message and not found.status.ok:
            messages[f] = found.message
    elapsed = time.perf_counter() - started
    return FrameResult(
        x, variances, blocks, tuple(status), messages, chosen.name, elapsed, 0, tuple(solutions)
    )

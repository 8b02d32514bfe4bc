"""Constraint exchange: limits are imposed where a fine grid shows that they matter, until they hold everywhere on it.

A limit that has to hold at every instant is infinitely many rows. Imposing it at a few nodes lets the motion exceed it between them;
imposing it at a thousand a second makes the program slow. So the program is solved with few rows, the answer is checked on the grid, the
worst instant of every stretch that violates a limit becomes a row, and the program is solved again from there.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from factorgrasp.nonlinear_program import NlpSolution, NonlinearProgram
from factorgrasp.solvers.nlp import NlpSolver
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray

MOST_ROUNDS = 12
MOST_EASINGS = 6
"""Shares of a demand that cannot be met that are tried."""
CLOSE = 1.4
"""Ratio of a share that is too large to one that is not at which the search ends."""
QUICK = 40
"""Iterations after which a share counts as too large."""
LOADED = 1e-4
"""Multiplier, relative to the price of the excitation, above which a limit counts as one that binds."""

NOT_THE_BEST = "the solver stopped before its tolerance: a motion with less wrench may exist"


class ExchangeProblem(Protocol):
    """What is solved so; `space` and `points` are the problem's own."""

    def program(self, space: Any, points: Any, start: FloatArray) -> Any:
        """The :class:`NonlinearProgram` with limits at `points`, and ``coefficients(x)`` of its points."""
        ...

    def eased(self, points: Any, share: float) -> Any:
        """The same limits with a share of the demand."""
        ...

    def check(self, space: Any, C: FloatArray, points: Any, needed: float = ...) -> Any:
        """What the fine grid shows: ``violated``, ``share`` (of the demand that is met) and the ``points`` of the next round."""
        ...

    def first_points(self, space: Any) -> Any:
        """Where to begin."""
        ...


@dataclass(frozen=True, eq=False)
class ExchangeResult:
    """Where the exchange ended.

    Attributes
    ----------
    C : ndarray
        Coefficients.
    status : Status
    message : str
    check, points : object
        Of the fine grid, for `C`; and where limits are imposed.
    program : NonlinearProgram
        The last one.
    solution : NlpSolution
    share : float
        Of what was asked for that is met: one, or less when it is infeasible.
    binding : tuple of str
        Limits that bind at the end, the hardest first.
    rounds, iterations : int
    time : float
        s.
    """

    C: FloatArray
    status: Status
    message: str
    check: Any
    points: Any
    program: NonlinearProgram
    solution: NlpSolution
    share: float
    binding: tuple[str, ...]
    rounds: int
    iterations: int
    time: float


def solve_by_exchange(
    problem: ExchangeProblem, space: Any, solver: NlpSolver, start: FloatArray, points: Any = None
) -> ExchangeResult:
    """Solve a program whose limits hold at every instant of the problem's grid.

    When the demand cannot be met, the largest share of it that can is found in the same way, and the limits that bind there are named.

    Parameters
    ----------
    problem : ExchangeProblem
    space : object
        One of the problem's.
    solver : NlpSolver
    start : ndarray
        Coefficients.
    points : object, optional
        Where to begin; the problem's own first points by default.
    """
    began = time.perf_counter()
    points = problem.first_points(space) if points is None else points
    result = _rounds(problem, space, solver, start, points, began, 1.0)
    if result.status.ok or result.status is Status.NUMERICAL_ERROR:
        return result
    return _most(problem, space, solver, start, result, began)


def _most(
    problem: ExchangeProblem,
    space: Any,
    solver: NlpSolver,
    start: FloatArray,
    failed: ExchangeResult,
    began: float,
) -> ExchangeResult:
    """The largest share of the demand that can be met, by bisection from below; the whole demand if it can be met from there."""
    C, share = _within_limits(problem, space, start, failed.points)
    best: ExchangeResult | None = None
    low, high = 0.5 * share, 1.0
    quick = type(solver)(replace(solver.options, max_iterations=QUICK))
    for number in range(MOST_EASINGS):
        if low <= 0.0 or high < CLOSE * low:
            break
        trial = low if number == 0 else min(4.0 * low, 1.0) if high >= 1.0 else float(np.sqrt(low * high))
        # Even the first is only a guess at what is easy; it decides whether there is anything to go on from.
        able, most = (solver, 8) if best is None else (quick, 4)
        found = _rounds(problem, space, able, C, failed.points, began, trial, most)
        if found.status.ok:
            best, C, low = found, found.C, trial
            if trial >= 1.0:
                return found
        else:
            high = trial
    if best is None:
        return replace(failed, C=C, check=problem.check(space, C, failed.points, 0.0), share=share)
    words = f"{low:.3g} of it can be had" + (f", less than {high:.3g}" if high < 1.0 else "")
    return replace(best, status=Status.INFEASIBLE, share=low, message=words)


def _rounds(
    problem: ExchangeProblem,
    space: Any,
    solver: NlpSolver,
    start: FloatArray,
    points: Any,
    began: float,
    share: float,
    most: int = MOST_ROUNDS,
) -> ExchangeResult:
    C, iterations = start, 0
    number = 0
    while number < most:
        number += 1
        program = problem.program(space, problem.eased(points, share), C)
        near = NlpSolution(program.start, Status.NOT_CONVERGED) if number > 1 else None
        found = solver.solve_program(program, near)
        iterations += found.iterations
        if np.all(np.isfinite(found.x)):
            C = program.coefficients(found.x)
        check = problem.check(space, C, points, share)
        points = check.points
        settled = not check.violated and check.share >= share
        if settled or not found.status.ok:
            break
    status, message = found.status, "" if found.status.ok else found.message
    if settled and status is Status.NOT_CONVERGED:
        # Whatever a solver claims, the grid has shown that the motion does what was asked for.
        status, message = Status.SOLVED, NOT_THE_BEST
    if found.status.ok and not settled:
        status, message = (
            Status.NOT_CONVERGED,
            f"limits still violated between the instants imposed after {number} rounds",
        )
    return ExchangeResult(
        C, status, message, check, points, program, found, share, _binding(program, found), number, iterations,
        time.perf_counter() - began,
    )  # fmt: skip


def _within_limits(
    problem: ExchangeProblem, space: Any, C: FloatArray, points: Any
) -> tuple[FloatArray, float]:
    """The same motion made so small that no limit is violated, and the share of the demand that it meets."""
    for _ in range(40):
        check = problem.check(space, C, points)
        if not check.violated:
            break
        C = 0.8 * C
    return C, float(np.clip(check.share, 0.0, 1.0))


def _binding(program: NonlinearProgram, found: NlpSolution) -> tuple[str, ...]:
    """Words of the rows that carry a load, each once, the heaviest first."""
    loads = np.abs(found.multipliers)
    if not loads.size or not np.any(np.isfinite(loads)):
        return ()
    rows = [
        k for k in np.argsort(-loads) if np.isfinite(loads[k]) and program.row_lower[k] < program.row_upper[k]
    ]
    total: dict[str, float] = {}
    for k in rows:
        total[program.row_words(int(k))] = total.get(program.row_words(int(k)), 0.0) + float(loads[k])
    heaviest = max(total.values(), default=0.0)
    floor = max(LOADED, 1e-3 * heaviest)
    return tuple(
        sorted((word for word, load in total.items() if load > floor), key=lambda word: -total[word])
    )

"""Constraint exchange: limits are imposed where a fine grid shows that they matter, until they hold everywhere on it.

A limit that has to hold at every instant is infinitely many rows. Imposing it at a few nodes lets the motion exceed it between them; imposing
it at a thousand a second makes the program slow. So the program is solved with few rows, the answer is checked on the grid, the worst instant
of every stretch that violates a limit becomes a row, and the program is solved again from there.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from factorgrasp.nonlinear_program import NlpSolution, NonlinearProgram
from factorgrasp.solvers.nlp import NlpSolver
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray

MOST_ROUNDS = 15
SHARE_WEIGHT = 1e3
"""Price of excitation that falls short, in units of the objective: far above what any sensible motion costs."""
LOADED = 1e-4
"""Multiplier, relative to the price of the excitation, above which a limit counts as one that binds."""


class ExchangeProblem(Protocol):
    """What is solved so; `space` and `points` are the problem's own."""

    def program(
        self, space: Any, points: Any, start: FloatArray, share: tuple[float, float] = ..., share_weight: float = ...
    ) -> Any:
        """The :class:`NonlinearProgram` with limits at `points`; its last unknown is the share of the demand that is met."""
        ...

    def check(self, space: Any, C: FloatArray, points: Any) -> Any:
        """What the fine grid shows: ``violated``, ``share`` (at least one when the demand is met) and the ``points`` of the next round."""
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
    check : object
        Of the fine grid, for `C`.
    program : NonlinearProgram
        The last one.
    solution : NlpSolution
    share : float
        Of what was asked for that is reached: one, or the most there is when it is infeasible.
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
    result = _rounds(problem, space, solver, start, points, began, demand=True)
    if result.status.ok:
        return result
    # Whether that is the solver's fault or the demand's: how much of it can be had within the limits?
    most = _rounds(problem, space, solver, start, result.check.points, began, demand=False)
    if most.status.ok and most.share >= 1.0 - 1e-6:
        again = _rounds(problem, space, solver, most.C, most.check.points, began, demand=True)
        return again if again.status.ok else result
    return most


def _rounds(
    problem: ExchangeProblem, space: Any, solver: NlpSolver, start: FloatArray, points: Any, began: float, demand: bool
) -> ExchangeResult:
    points = problem.first_points(space) if points is None else points
    share, price, C, iterations = (1.0, 1.0), 0.0, start, 0
    if not demand:
        # From inside, and never back to rest: where nothing moves, no direction promises any excitation.
        C, inside = _within_limits(problem, space, start, points)
        share, price = (0.5 * inside, 1.0), SHARE_WEIGHT
    reached = 0.0
    for number in range(1, MOST_ROUNDS + 1):
        program = problem.program(space, points, C, share, price)
        if not demand:
            program.start = program.point(C, 0.9 * inside if number == 1 else reached)
        found = solver.solve_program(program)
        iterations += found.iterations
        if np.all(np.isfinite(found.x)):
            C = program.coefficients(found.x)
        check = problem.check(space, C, points)
        reached = float(found.x[-1])
        needed = 1.0 if demand else reached
        good = not check.violated and check.share >= needed * (1.0 - 1e-4 if not demand else 1.0)
        points = check.points
        if good or not found.status.ok:
            break
    status, message = found.status, found.message
    if found.status.ok and not good:
        status, message = Status.NOT_CONVERGED, f"limits still violated between the instants imposed after {number} rounds"
    return ExchangeResult(
        C, status, message, check, program, found, reached if not demand else 1.0, _binding(program, found), number, iterations,
        time.perf_counter() - began,
    )  # fmt: skip


def _within_limits(problem: ExchangeProblem, space: Any, C: FloatArray, points: Any) -> tuple[FloatArray, float]:
    """The same motion made so small that no limit is violated, and the share that it reaches."""
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
    rows = [k for k in np.argsort(-loads) if np.isfinite(loads[k]) and program.row_lower[k] < program.row_upper[k]]
    total: dict[str, float] = {}
    for k in rows:
        total[program.row_words(int(k))] = total.get(program.row_words(int(k)), 0.0) + float(loads[k])
    heaviest = max(total.values(), default=0.0)
    floor = max(LOADED, 1e-3 * heaviest)
    return tuple(sorted((word for word, load in total.items() if load > floor), key=lambda word: -total[word]))

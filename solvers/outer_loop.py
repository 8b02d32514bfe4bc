"""The loops around a solver: re-weighting for robust losses, other starts and fresh poses for nonlinear problems.

One descent of a nonlinear problem is :class:`factorgrasp.solvers.gauss_newton.GaussNewton` or a native nonlinear solver. Lengths of steps
are measured in posterior standard deviations, ``sqrt(d'Hd)``, which need no units.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorgrasp.least_squares import LeastSquares
from factorgrasp.problem import NonlinearProblem
from factorgrasp.solvers.base import Solution, Solver
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, State

ROUNDING = 1e-15
"""Share of the objective below which its changes are noise."""
GOOD_ENOUGH = 1e-4
"""Step in standard deviations below which an iteration that cannot improve any more counts as converged."""
NO_DAMPING = 1e-8
"""Damping below which the length of a step says how far the optimum is; a strongly damped step is always short."""


@dataclass(frozen=True)
class LoopOptions:
    """Options of the outer loops.

    Attributes
    ----------
    max_iterations : int
        Linearisations (or re-weightings of a linear problem) in one descent.
    step_tolerance : float
        A step below this many posterior standard deviations ends a descent.
    damping : float
        Levenberg-Marquardt damping to begin with, relative to the diagonal of the information matrix; 0 begins as Gauss-Newton,
        which turns to damping by itself where the line search fails.
    max_refinements : int
        How often a problem may be posed afresh through its `refine`.
    max_escapes : int
        How often a problem may offer another start through its `escape`.
    """

    max_iterations: int = 100
    step_tolerance: float = 1e-8
    damping: float = 0.0
    max_refinements: int = 20
    max_escapes: int = 3


@dataclass(frozen=True)
class Iteration:
    """One line of the log.

    Attributes
    ----------
    objective : float
        Before the step, robust losses included.
    violation : float
        Sum of constraint violations before the step.
    step : float
        Length of the full step in posterior standard deviations.
    length : float
        Part of it that was taken; 0 when none was accepted.
    damping : float
    """

    objective: float
    violation: float
    step: float
    length: float
    damping: float


@dataclass(frozen=True)
class LoopResult:
    """Where an outer loop ended.

    Attributes
    ----------
    problem : NonlinearProblem or None
        As refined last; None for a linear problem.
    state : mapping or None
    least_squares : LeastSquares
        Linearised at `state`, or the linear problem itself.
    solution : Solution
        For a nonlinear problem with ``x = 0``: the multipliers belong to the point itself.
    row_weights : ndarray or None
        Square roots of the robust weights at the end (rows,).
    status : Status
    message : str
    log : tuple of Iteration
    iterations : int
    setup_time, solve_time : float
        Seconds; `solve_time` includes linearising.
    """

    problem: NonlinearProblem | None
    state: State | None
    least_squares: LeastSquares
    solution: Solution
    row_weights: FloatArray | None
    status: Status
    message: str = ""
    log: tuple[Iteration, ...] = ()
    iterations: int = 0
    setup_time: float = 0.0
    solve_time: float = 0.0

    @property
    def objective(self) -> float:
        """Objective at the end, robust losses included."""
        return self.least_squares.objective(self.solution.x)


Descent = Callable[[Any, State], LoopResult]
"""From a problem and a start to where a solver's iterations end."""


def solve_linear(problem: LeastSquares, solver: Solver, options: LoopOptions | None = None) -> LoopResult:
    """Solve a linear problem; with robust losses by iterative re-weighting until the solution settles."""
    options = options or LoopOptions()
    started = time.perf_counter()
    solver.setup(problem)
    setup = time.perf_counter() - started
    log: list[Iteration] = []
    weights: FloatArray | None = None
    solution = solver.solve()
    status, message = solution.status, solution.message
    if problem.robust and np.all(np.isfinite(solution.x)):
        settled = False
        for _ in range(options.max_iterations):
            residuals = problem.residuals(solution.x)
            weights = problem.robust_weights(residuals)
            before = solution
            solution = solver.solve(weights, before)
            status, message = solution.status, solution.message
            if not np.all(np.isfinite(solution.x)):
                solution = before
                break
            step = sd_length(problem, solution.x - before.x, weights)
            objective = problem.objective(before.x)
            log.append(Iteration(objective, 0.0, step, 1.0, 0.0))
            if step <= smallest_step(options, objective) or cannot_improve(log):
                settled = True
                break
        if not settled and status in (Status.SOLVED, Status.UNOBSERVABLE):
            status = Status.NOT_CONVERGED
            message = unsettled_words("robust weights", log)
    elapsed = time.perf_counter() - started - setup
    count = len(log) + 1 if problem.robust else solution.iterations
    return LoopResult(
        None, None, problem, solution, weights, status, message, tuple(log), count, setup, elapsed
    )


def solve_nonlinear(
    problem: NonlinearProblem,
    descend: Descent,
    initial_state: State | None = None,
    options: LoopOptions | None = None,
) -> LoopResult:
    """Solve a nonlinear problem with everything it asks for: other starts (`escape`) and fresh poses (`refine`).

    Parameters
    ----------
    problem : NonlinearProblem
    descend : callable
        What does one descent: :class:`GaussNewton`, or a native nonlinear solver.
    initial_state : mapping, optional
        Start in place of the problem's own.
    options : LoopOptions, optional
    """
    options = options or LoopOptions()
    state = problem.initial_state() if initial_state is None else initial_state
    result = _with_escapes(problem, state, descend, options)
    refine = getattr(problem, "refine", None)
    for attempt in range(options.max_refinements + 1):
        if refine is None or not _usable(result):
            break
        fresh = refine(result.state)
        if fresh is None:
            break
        if attempt == options.max_refinements:
            words = (
                f"still changing after {attempt} refinements of the problem (weights or clocks do not settle)"
            )
            return replace(result, status=Status.NOT_CONVERGED, message=words)
        assert result.state is not None
        start = fresh.initial_state() if hasattr(fresh, "initial_state") else result.state
        result = _after(result, _with_escapes(fresh, start, descend, options))
        refine = getattr(fresh, "refine", None)
    return result


def _with_escapes(
    problem: NonlinearProblem, state: State, descend: Descent, options: LoopOptions
) -> LoopResult:
    result = descend(problem, state)
    escape = getattr(problem, "escape", None)
    for _ in range(options.max_escapes if escape is not None else 0):
        if not _usable(result):
            break
        other = escape(result.state)  # type: ignore[misc]
        if other is None:
            break
        objective = result.objective
        found = descend(problem, other)
        if not (_usable(found) and found.objective < objective - 1e-9 * abs(objective)):
            # Linearising at the other state has overwritten the shared least-squares object: fill it again.
            problem.linearize(result.state)  # type: ignore[arg-type]
            result = replace(
                result, log=result.log + found.log, iterations=result.iterations + found.iterations
            )
            break
        result = _after(result, found)
    return result


def _usable(result: LoopResult) -> bool:
    return result.status in (Status.SOLVED, Status.UNOBSERVABLE) and result.state is not None


def _after(first: LoopResult, second: LoopResult) -> LoopResult:
    """The second result with the costs of both."""
    return replace(
        second,
        log=first.log + second.log,
        iterations=first.iterations + second.iterations,
        setup_time=first.setup_time + second.setup_time,
        solve_time=first.solve_time + second.solve_time,
    )


def sd_length(system: LeastSquares, step: FloatArray, weights: FloatArray | None) -> float:
    """Length of a step in posterior standard deviations, ``|| W A d ||``."""
    matrix, _ = system.whitened(weights)
    return float(np.linalg.norm(matrix @ step))


def smallest_step(options: LoopOptions, objective: float) -> float:
    """Length below which a step changes nothing, or less than the objective's rounding shows."""
    return max(options.step_tolerance, float(np.sqrt(2.0 * ROUNDING * abs(objective))))


def cannot_improve(log: list[Iteration]) -> bool:
    """Whether the last steps are tiny and no longer shrink: what is left is the noise of the linear solver."""
    recent = [line.step for line in log[-4:] if line.damping <= NO_DAMPING]
    return len(recent) == 4 and max(recent) <= GOOD_ENOUGH and min(recent[1:]) > 0.9 * recent[0]


def unsettled_words(what: str, log: list[Iteration]) -> str:
    """Why an iteration limit ended a loop."""
    last = log[-1].step if log else float("nan")
    return f"{what} have not settled after {len(log)} iterations (last step {last:.2g} standard deviations)"

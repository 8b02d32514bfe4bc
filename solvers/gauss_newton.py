"""Gauss-Newton on a manifold with any linear or QP solver.

Each linearisation is one :class:`LeastSquares`; with inequalities this is sequential quadratic programming with the Gauss-Newton Hessian.
Steps are judged by the objective (robust losses included) plus, with constraints, an l1 penalty on their violation.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from factorgrasp.least_squares import LeastSquares
from factorgrasp.problem import NonlinearProblem
from factorgrasp.solvers.base import Solution, Solver
from factorgrasp.solvers.damping import Damped
from factorgrasp.solvers.outer_loop import (
    GOOD_ENOUGH,
    NO_DAMPING,
    ROUNDING,
    Iteration,
    LoopOptions,
    LoopResult,
    cannot_improve,
    smallest_step,
    unsettled_words,
)
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, State

FEASIBLE = 1e-7
"""Violation of a constraint, in its own unit, that counts as none."""


class GaussNewton:
    """One descent of a nonlinear problem with a given linear or QP solver.

    Full Gauss-Newton steps, shortened by a line search; where that finds nothing, Levenberg-Marquardt damping comes in and leaves again.

    Parameters
    ----------
    solver : Solver
    options : LoopOptions, optional
    """

    def __init__(self, solver: Solver, options: LoopOptions | None = None) -> None:
        self.solver = solver
        self.options = options or LoopOptions()
        self._set_up_for: LeastSquares | None = None
        self._damped: Damped | None = None

    def __call__(self, problem: NonlinearProblem, state: State) -> LoopResult:
        """Descend from `state`."""
        self._setup_time = 0.0
        self._damped = None
        started = time.perf_counter()
        result = self._descend(problem, state)
        elapsed = time.perf_counter() - started - self._setup_time
        return replace(result, setup_time=self._setup_time, solve_time=elapsed)

    def _descend(self, problem: NonlinearProblem, state: State) -> LoopResult:
        options = self.options
        damping, penalty = options.damping, 0.0
        log: list[Iteration] = []
        merits: list[float] = []
        system = problem.linearize(state)
        solution: Solution | None = None
        singular = False

        def end(status: Status, message: str) -> LoopResult:
            held = solution or Solution(np.zeros(system.size), status)
            weights = system.robust_weights(system.residuals(np.zeros(system.size)))
            final = replace(held, x=np.zeros(system.size), status=status, message=message)
            return LoopResult(problem, state, system, final, weights, status, message, tuple(log), len(log))

        while len(log) < options.max_iterations:
            point = _Point(system)
            if not np.isfinite(point.objective):
                return end(Status.NUMERICAL_ERROR, "the objective is not finite at the current state")
            found = self._step(system, damping, point.weights, solution)
            if not np.all(np.isfinite(found.x)):
                if found.status in (Status.INFEASIBLE, Status.UNBOUNDED) or damping > 1e3:
                    return end(found.status, found.message)
                # A solver that gives up on a singular system gets a regular one.
                singular, damping = True, max(1e-10, 10.0 * damping)
                log.append(Iteration(point.objective, point.violation, np.inf, 0.0, damping))
                last_words = found
                continue
            if found.status in (Status.INFEASIBLE, Status.UNBOUNDED):
                return end(found.status, found.message)
            solution = found
            penalty = max(penalty, 1.5 * _largest_multiplier(found))
            step = float(np.linalg.norm(point.weighted @ found.x))
            slope = -float(point.weighted_rhs @ (point.weighted @ found.x)) - penalty * point.violation
            small = step <= smallest_step(options, point.objective) and damping <= NO_DAMPING
            if small and point.worst_violation <= FEASIBLE:
                state, system, taken = self._last_step(problem, state, found.x, point, penalty)
                log.append(Iteration(point.objective, point.violation, step, taken, damping))
                if singular:
                    return end(Status.UNOBSERVABLE, last_words.message)
                return end(*_verdict(found, len(log)))
            merits.append(point.objective + penalty * point.violation)
            # With curved constraints a full step may raise the penalty at first (Maratos): allow the worst of the last few.
            reference = max(merits[-3:]) if system.constrained else merits[-1]
            length, moved, landed = self._search(problem, state, found.x, reference, slope, penalty)
            log.append(Iteration(point.objective, point.violation, step, length, damping))
            if landed is None:
                system = problem.linearize(state)
                if step <= GOOD_ENOUGH and damping <= NO_DAMPING and point.worst_violation <= 1e-5:
                    return end(*_verdict(found, len(log)))
                if damping > 1e8:
                    words = "stalled: no step decreases the objective although its gradient is not zero"
                    return end(Status.NOT_CONVERGED, words)
                damping = max(1e-4, 10.0 * damping)
                continue
            state, system = moved, landed
            if length == 1.0:
                damping = damping / 10.0 if damping > 1e-9 else (1e-10 if singular else 0.0)
            if cannot_improve(log):
                point = _Point(system)
                if point.worst_violation <= 1e-5:
                    return end(*_verdict(found, len(log)))
        return end(Status.NOT_CONVERGED, unsettled_words("steps", log))

    def _step(
        self, system: LeastSquares, damping: float, weights: FloatArray | None, warm: Solution | None
    ) -> Solution:
        target = system
        if damping > 0.0:
            if self._damped is None:
                self._damped = Damped(system)
            weights = self._damped.fill(system, damping, weights)
            target = self._damped.problem
        if self._set_up_for is not target:
            started = time.perf_counter()
            self.solver.setup(target)
            self._setup_time += time.perf_counter() - started
            self._set_up_for = target
            warm = None
        # The unknown is a step that shrinks to nothing: zero is a better start than the last step.
        return self.solver.solve(weights, None if warm is None else replace(warm, x=np.zeros(system.size)))

    def _last_step(
        self, problem: NonlinearProblem, state: State, step: FloatArray, point: _Point, penalty: float
    ) -> tuple[State, LeastSquares, float]:
        """Take a step that is known to be tiny, for the digits it still gains, unless it does not go down."""
        moved = problem.retract(state, step)
        landed = problem.linearize(moved)
        before = point.objective + penalty * point.violation
        if _merit(landed, penalty) <= before + 10.0 * ROUNDING * abs(before) + penalty * FEASIBLE:
            return moved, landed, 1.0
        return state, problem.linearize(state), 0.0

    def _search(
        self,
        problem: NonlinearProblem,
        state: State,
        step: FloatArray,
        reference: float,
        slope: float,
        penalty: float,
    ) -> tuple[float, State, LeastSquares | None]:
        """Shorten a step until the merit falls; None in place of the linearisation when it never does."""
        length = 1.0
        noise = 10.0 * ROUNDING * abs(reference)
        while length > 1e-3:
            moved = problem.retract(state, length * step)
            landed = problem.linearize(moved)
            merit = _merit(landed, penalty)
            if merit <= reference + 1e-4 * length * min(slope, 0.0) + noise:
                return length, moved, landed
            # Minimum of the parabola through what is known, held within a tenth and a half.
            curve = merit - reference - length * slope
            best = -0.5 * slope * length**2 / curve if np.isfinite(curve) and curve > 0.0 else 0.0
            length = float(np.clip(best, 0.1 * length, 0.5 * length))
        return 0.0, state, None


class _Point:
    """Objective, weights and violations of a linearisation at its own state (zero step)."""

    def __init__(self, system: LeastSquares) -> None:
        zero = np.zeros(system.size)
        self.weights = system.robust_weights(system.residuals(zero)) if system.robust else None
        self.weighted, self.weighted_rhs = system.whitened(self.weights)
        plain = 0.5 * float(self.weighted_rhs @ self.weighted_rhs)
        self.objective = system.objective(zero) if system.robust else plain
        violations = _violations(system)
        self.violation = float(violations.sum())
        self.worst_violation = float(violations.max(initial=0.0))


def _violations(system: LeastSquares) -> FloatArray:
    if not system.constrained:
        return np.empty(0)
    parts = [np.abs(system.equalities.rhs), -system.inequalities.rhs, system.lower, -system.upper]
    return np.asarray(np.maximum(np.concatenate(parts), 0.0))


def _merit(system: LeastSquares, penalty: float) -> float:
    try:
        value = system.objective(np.zeros(system.size)) + penalty * float(_violations(system).sum())
    except ValueError:  # a state so far out that the rows are not finite
        return np.inf
    return value if np.isfinite(value) else np.inf


def _largest_multiplier(solution: Solution) -> float:
    parts = np.concatenate([solution.y, solution.z, solution.z_box])
    return float(np.abs(parts[np.isfinite(parts)]).max(initial=0.0))


def _verdict(solution: Solution, iterations: int) -> tuple[Status, str]:
    """Status of a descent that has converged: that of its last linear solve."""
    if solution.status is Status.SOLVED:
        return Status.SOLVED, f"converged in {iterations} iterations"
    return solution.status, solution.message

"""Solvers that take a nonlinear problem whole, seen as one descent of the outer loop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from factorgrasp.least_squares import LeastSquares
from factorgrasp.problem import NonlinearProblem
from factorgrasp.solvers.base import NonlinearSolution, Solution, Solver
from factorgrasp.solvers.outer_loop import LoopResult
from factorgrasp.typing import FloatArray, State


def native_descent(solver: Solver) -> Callable[[NonlinearProblem, State], LoopResult] | None:
    """A solver that takes nonlinear problems whole, as a descent of the outer loop; None for the others."""
    whole: Callable[[NonlinearProblem, State], NonlinearSolution] | None = getattr(
        solver, "solve_problem", None
    )
    if whole is None or not solver.capabilities.nonlinear:
        return None

    def descend(problem: NonlinearProblem, state: State) -> LoopResult:
        found = whole(problem, state)
        system = problem.linearize(found.state)
        weights = system.robust_weights(system.residuals(np.zeros(system.size)))
        solution = Solution(
            np.zeros(system.size), found.status, y=_multipliers(system, weights), message=found.message
        )
        return LoopResult(
            problem,
            found.state,
            system,
            solution,
            weights,
            found.status,
            found.message,
            iterations=found.iterations,
            setup_time=found.setup_time,
            solve_time=found.solve_time,
        )

    return descend


def _multipliers(system: LeastSquares, weights: FloatArray | None) -> FloatArray:
    """Multipliers of the equalities at the point of linearisation, from stationarity: gtsam reports none."""
    if not system.equalities.height:
        return np.empty(0)
    matrix, rhs = system.whitened(weights)
    dense = system.equalities.matrix.toarray()
    return np.asarray(np.linalg.lstsq(dense.T, matrix.T @ rhs, rcond=None)[0])

"""The front door: a problem in, an estimate (or the problem's typed view of it) out."""

from __future__ import annotations

import time
from typing import Any

from factorgrasp.errors import InputError, SolverError
from factorgrasp.least_squares import LeastSquares
from factorgrasp.problem import LinearProblem, NonlinearProblem
from factorgrasp.provenance import problem_hash
from factorgrasp.solvers.base import Solver, SolverOptions
from factorgrasp.solvers.gauss_newton import GaussNewton
from factorgrasp.solvers.make_estimate import make_estimate
from factorgrasp.solvers.native import native_descent
from factorgrasp.solvers.outer_loop import LoopOptions, LoopResult, solve_linear, solve_nonlinear
from factorgrasp.solvers.registry import QP_PREFERENCE, get_solver, solver_class
from factorgrasp.threads import one_blas_thread
from factorgrasp.typing import State


@one_blas_thread()
def solve(
    problem: LinearProblem | NonlinearProblem | LeastSquares,
    solver: str | Solver | None = None,
    options: SolverOptions | None = None,
    *,
    initial_state: State | None = None,
    loop: LoopOptions | None = None,
) -> Any:
    """Solve an estimation problem.

    Parameters
    ----------
    problem : LinearProblem, NonlinearProblem or LeastSquares
    solver : str or Solver, optional
        A name of :func:`factorgrasp.solvers.registry.solver_names`, or a solver object to use again (it keeps what it worked out for a
        pattern). By default "cholesky"; "kkt" with equality constraints; the best QP solver installed with inequalities or bounds.
    options : SolverOptions, optional
        For a solver given by name.
    initial_state : mapping, optional
        Start of a nonlinear problem, in place of its own.
    loop : LoopOptions, optional
        Options of the outer loops.

    Returns
    -------
    Estimate
        Or the typed view that the problem makes of it. A failed solve returns its last iterate with the status and the reason.

    Raises
    ------
    SolverError
        When the solver is unknown, not installed or cannot take the problem.
    InputError
        When the problem holds numbers that are not finite.
    """
    started = time.perf_counter()
    loop = loop or LoopOptions()
    if isinstance(problem, LeastSquares):
        result, chosen, asked = _linear(problem, "least_squares", solver, options, loop)
    elif isinstance(problem, NonlinearProblem):
        result, chosen, asked = _nonlinear(problem, solver, options, loop, initial_state)
    elif isinstance(problem, LinearProblem):
        result, chosen, asked = _linear(problem.least_squares(), problem.kind, solver, options, loop)
    else:
        raise InputError(
            "problem",
            "a LeastSquares, or an object with kind, view and least_squares (or initial_state, linearize, retract)",
            type(problem).__name__,
        )
    final = problem if result.problem is None else result.problem
    kind = getattr(problem, "kind", "least_squares")
    estimate = make_estimate(result, kind, chosen, final, asked, started)
    view = getattr(final, "view", None)
    return estimate if view is None else view(estimate)


def default_solver(problem: LeastSquares) -> str:
    """Name of the solver that a problem gets when none is asked for."""
    if not problem.has_inequalities:
        return "kkt" if problem.equalities.height else "cholesky"
    for name in QP_PREFERENCE:
        if solver_class(name).installed():
            return name
    raise SolverError(
        "the problem has inequalities and no QP solver is installed: pip install qpsolvers piqp"
    )


def _choose(solver: str | Solver | None, options: SolverOptions | None, problem: LeastSquares) -> Solver:
    if isinstance(solver, Solver):
        return solver
    chosen = get_solver(solver or default_solver(problem), options)
    can = chosen.capabilities
    if problem.has_inequalities and not can.inequalities:
        raise SolverError(f"{chosen.name} takes no inequalities or bounds; {default_solver(problem)!r} does")
    if problem.equalities.height and not can.equalities:
        raise SolverError(f"{chosen.name} takes no equality constraints; {default_solver(problem)!r} does")
    return chosen


def _linear(
    problem: LeastSquares,
    kind: str,
    solver: str | Solver | None,
    options: SolverOptions | None,
    loop: LoopOptions,
) -> tuple[LoopResult, Solver, str]:
    asked = problem_hash(kind, problem)
    chosen = _choose(solver, options, problem)
    return solve_linear(problem, chosen, loop), chosen, asked


def _nonlinear(
    problem: NonlinearProblem,
    solver: str | Solver | None,
    options: SolverOptions | None,
    loop: LoopOptions,
    initial_state: State | None,
) -> tuple[LoopResult, Solver, str]:
    start = problem.initial_state() if initial_state is None else initial_state
    system = problem.linearize(start)
    asked = problem_hash(problem.kind, system, start)
    chosen = _choose(solver, options, system)
    descend = native_descent(chosen) or GaussNewton(chosen, loop)
    return solve_nonlinear(problem, descend, start, loop), chosen, asked

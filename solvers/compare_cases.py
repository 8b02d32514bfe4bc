"""The kinds of problems that can be compared, each with its way to run a solver and to judge what came back.

A bare quadratic program is right when primal residual, dual residual and gap are within the tolerance, in its own units and beyond what
rounding leaves. In an estimation problem these units say little (an information of 1e8 makes a dual residual of 1e-4 a matter of 1e-8
standard deviations; the gap holds the same times the unknown). There the dual residual of every unknown is taken in conditional standard
deviations, in place of the gap stands complementarity (slack times multiplier, without a unit), and both have to be within the tolerance or
a millionth, whichever is larger: a millionth of a standard deviation changes nobody's decision.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np

from factorgrasp.errors import NotSolvedError
from factorgrasp.estimate import Certificate
from factorgrasp.least_squares import LeastSquares, QuadraticProgram
from factorgrasp.problem import NonlinearProblem
from factorgrasp.solvers.base import Solution, Solver, SolverOptions
from factorgrasp.solvers.certificate import OptimalityCheck, certify, check_least_squares
from factorgrasp.solvers.factor import active_set, posterior_factor
from factorgrasp.solvers.gauss_newton import GaussNewton
from factorgrasp.solvers.measure import Solve, Timing, measure
from factorgrasp.solvers.native import native_descent
from factorgrasp.solvers.outer_loop import LoopOptions, LoopResult, solve_linear, solve_nonlinear
from factorgrasp.solvers.qp import QpSession
from factorgrasp.solvers.registry import get_solver
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, State

MILLIONTH = 1e-6
"""Of a standard deviation: what an answer to an estimation problem may be off without being wrong."""
ROUNDING = 1e-11
"""Residual, relative to the numbers that cancel in it, which double precision may leave (the backends are asked for a tenth of it)."""
FIXED = 1e-6
"""Posterior over conditional standard deviation below which an unknown counts as fixed by a constraint."""


@dataclass(frozen=True)
class Outcome:
    """What one solver made of one problem.

    Attributes
    ----------
    status : Status
        Its claim.
    objective : float
    certificate : Certificate or None
        In the problem's own units; None when there is no finite answer.
    scaled : Certificate or None
        As it is judged.
    timing : Timing
    iterations : int
    message : str
    solution : Solution
    problem : NonlinearProblem or None
        As refined last: it may have other unknowns than at first.
    state : mapping or None
        Of a nonlinear problem.
    weights : ndarray or None
        Square roots of the robust weights at the end.
    estimation : bool
        Whether it is judged as an estimation problem.
    """

    status: Status
    objective: float
    certificate: Certificate | None
    scaled: Certificate | None
    timing: Timing
    iterations: int
    message: str
    solution: Solution
    problem: NonlinearProblem | None = None
    state: State | None = None
    weights: FloatArray | None = None
    estimation: bool = True

    @property
    def error(self) -> tuple[float, float]:
        """Largest of the judged residuals, and largest of the raw ones to tell apart those that are at rounding."""
        if self.scaled is None or self.certificate is None:
            return np.inf, np.inf
        judged, raw = self.scaled, self.certificate
        return max(judged.primal, judged.dual, judged.gap), max(raw.primal, raw.dual, raw.gap)

    def right(self, tolerance: float) -> bool:
        """Whether its answer solves the problem, whatever it claims."""
        limit = max(tolerance, MILLIONTH) if self.estimation else tolerance
        return bool(self.scaled is not None and self.scaled.within(limit))


class Case(ABC):
    """One problem to compare solvers on."""

    equalities = False
    inequalities = False
    nonlinear = False
    quadratic = False
    takes_program = False

    @abstractmethod
    def run(self, name: str, options: SolverOptions, repeat: int) -> Outcome:
        """Solve with one solver, cold and warm."""

    def spread(self, reference: Outcome) -> FloatArray | None:
        """Standard deviation (n,) of every tangent component at the reference; None where there is none."""
        return None

    def difference(self, reference: Outcome, other: Outcome, spread: FloatArray | None) -> float | None:
        """Largest difference of a mean to the reference, in standard deviations."""
        if spread is None:
            return None
        step = np.abs(self._step(reference, other))
        known = np.isfinite(spread) & (spread > 0.0)
        return float(np.max(step[known] / spread[known], initial=0.0)) if np.all(np.isfinite(step)) else None

    def _step(self, reference: Outcome, other: Outcome) -> FloatArray:
        return np.asarray(other.solution.x - reference.solution.x)


class QuadraticCase(Case):
    """A bare quadratic program; only the QP solvers take it."""

    quadratic = True

    def __init__(self, program: QuadraticProgram) -> None:
        self.program = program
        self.equalities = program.A is not None
        self.inequalities = any(part is not None for part in (program.G, program.lb, program.ub))

    def run(self, name: str, options: SolverOptions, repeat: int) -> Outcome:
        """Through :class:`QpSession`."""

        def fresh() -> Solve:
            session = QpSession(name, options)
            return lambda start: session.solve(self.program, start)

        found, timing, _ = measure(fresh, repeat)
        program, x = self.program, found.x
        objective = float(0.5 * x @ (program.P @ x) + program.q @ x) + program.constant
        finite = bool(np.all(np.isfinite(x)))
        certificate = certify(program, found) if finite else None
        scaled = None if certificate is None else _unrounded(program, x, certificate)
        return Outcome(
            found.status,
            objective,
            certificate,
            scaled,
            timing,
            found.iterations,
            found.message,
            found,
            estimation=False,
        )


class LinearCase(Case):
    """One linear least-squares problem, robust losses by re-weighting."""

    def __init__(self, problem: LeastSquares) -> None:
        self.problem = problem
        self.equalities = bool(problem.equalities.height)
        self.inequalities = problem.has_inequalities

    def run(self, name: str, options: SolverOptions, repeat: int) -> Outcome:
        """Through the solver itself, in the re-weighting loop where there is a loss."""
        problem = self.problem
        last: list[LoopResult] = []

        def fresh() -> Solve:
            solver = get_solver(name, options)

            def run(start: Solution | None) -> Solution:
                if not problem.robust:
                    return _timed(solver, problem, start)
                began = time.perf_counter()
                result = solve_linear(problem, solver)
                last[:] = [result]
                elapsed = time.perf_counter() - began
                return replace(
                    result.solution,
                    status=result.status,
                    message=result.message,
                    iterations=result.iterations,
                    setup_time=result.setup_time,
                    solve_time=elapsed - result.setup_time,
                )

            return run

        found, timing, _ = measure(fresh, repeat)
        weights = last[0].row_weights if last else None
        return _outcome(problem, found, timing, weights)

    def spread(self, reference: Outcome) -> FloatArray | None:
        """From the posterior at the reference."""
        return _spread(self.problem, reference)


class NonlinearCase(Case):
    """A nonlinear problem: with a native solver, or by our Gauss-Newton over a linear or QP solver."""

    nonlinear = True

    def __init__(self, problem: NonlinearProblem) -> None:
        self.problem = problem
        self.start = problem.initial_state()
        system = problem.linearize(self.start)
        self.equalities = bool(system.equalities.height)
        self.inequalities = system.has_inequalities

    def run(self, name: str, options: SolverOptions, repeat: int) -> Outcome:
        """Cold from the problem's start, warm from the solution of the problem as it was refined."""
        last: list[LoopResult] = []

        def fresh() -> Solve:
            solver = get_solver(name, options)
            loop = LoopOptions()
            descend = native_descent(solver) or GaussNewton(solver, loop)

            def run(start: Solution | None) -> Solution:
                began = time.perf_counter()
                problem, state = self.problem, self.start
                if start is not None and last and last[0].problem is not None and last[0].state is not None:
                    problem, state = last[0].problem, last[0].state
                result = solve_nonlinear(problem, descend, state, loop)
                elapsed = time.perf_counter() - began
                if start is None:
                    last[:] = [result]
                return replace(
                    result.solution,
                    status=result.status,
                    message=result.message,
                    iterations=result.iterations,
                    setup_time=result.setup_time,
                    solve_time=elapsed - result.setup_time,
                )

            return run

        found, timing, _ = measure(fresh, repeat)
        result = last[0]
        system = _at(result)
        weights = system.robust_weights(system.residuals(np.zeros(system.size)))
        return replace(_outcome(system, found, timing, weights), problem=result.problem, state=result.state)

    def spread(self, reference: Outcome) -> FloatArray | None:
        """From the posterior at the reference."""
        assert reference.problem is not None
        assert reference.state is not None
        return _spread(reference.problem.linearize(reference.state), reference)

    def _step(self, reference: Outcome, other: Outcome) -> FloatArray:
        assert reference.problem is not None
        assert reference.state is not None
        assert other.state is not None
        variables = reference.problem.linearize(reference.state).variables
        steps = [
            v.local(reference.state[v.name], other.state[v.name])
            if v.name in other.state
            else np.full(v.size, np.nan)
            for v in variables
        ]
        return np.concatenate(steps)


def _timed(solver: Solver, problem: LeastSquares, start: Solution | None) -> Solution:
    """One solve, with all that is not the solver's own iterations counted as set-up."""
    began = time.perf_counter()
    solver.setup(problem)
    found = solver.solve(warm_start=start)
    elapsed = time.perf_counter() - began
    return replace(found, setup_time=max(elapsed - found.solve_time, 0.0))


def _at(result: LoopResult) -> LeastSquares:
    """The problem (as refined last) linearised at the end; later runs may have refilled the object."""
    assert result.problem is not None
    assert result.state is not None
    return result.problem.linearize(result.state)


def _outcome(problem: LeastSquares, found: Solution, timing: Timing, weights: FloatArray | None) -> Outcome:
    """Judge an answer to an estimation problem."""
    finite = bool(np.all(np.isfinite(found.x)))
    check = check_least_squares(problem, found, weights) if finite else None
    return Outcome(
        found.status,
        problem.objective(found.x) if finite else np.nan,
        None if check is None else check.certificate(),
        None if check is None else _scaled(problem, found, weights, check),
        timing,
        found.iterations,
        found.message,
        found,
        weights=weights,
    )


def _scaled(
    problem: LeastSquares, found: Solution, weights: FloatArray | None, check: OptimalityCheck
) -> Certificate:
    """The residuals of an estimation problem without its units, less what rounding leaves."""
    matrix, rhs = problem.whitened(weights)
    sd = _conditional_sd(problem, weights)
    gradient = matrix.T @ (matrix @ found.x - rhs)
    for rows, multiplier in ((problem.equalities, found.y), (problem.inequalities, found.z)):
        if rows.height and multiplier.size == rows.height:
            gradient = gradient + rows.matrix.T @ multiplier
    if found.z_box.size == problem.size:
        gradient = gradient + found.z_box
    sizes = abs(matrix).T @ (abs(matrix) @ np.abs(found.x) + np.abs(rhs))
    dual = np.maximum(np.abs(gradient) - ROUNDING * sizes, 0.0) * sd
    chi2 = float(rhs @ rhs)
    primal_size = 0.0
    for rows in (problem.equalities, problem.inequalities):
        if rows.height:
            terms = abs(rows.matrix) @ np.abs(found.x) + np.where(
                np.isfinite(rows.rhs), np.abs(rows.rhs), 0.0
            )
            primal_size = max(primal_size, float(terms.max()))
    # Multipliers have units of their own: one of the wrong sign is compared with the largest.
    loads = max(1.0, float(np.abs(found.z).max(initial=0.0)), float(np.abs(found.z_box).max(initial=0.0)))
    return Certificate(
        primal=max(check.primal - ROUNDING * primal_size, 0.0),
        dual=max(float(dual.max(initial=0.0)), check.sign / loads),
        gap=max(check.complementarity - ROUNDING * chi2, 0.0),
    )


def _spread(problem: LeastSquares, reference: Outcome) -> FloatArray | None:
    active = active_set(problem, reference.solution, reference.weights)
    try:
        factor = posterior_factor(problem, reference.solution.x, reference.weights, active)
    except NotSolvedError:
        return None
    spread = np.sqrt(np.maximum(factor.variances(), 0.0))
    # What a constraint fixes is left with the rounding of a variance: a difference there shows as a primal residual instead.
    return np.where(spread > FIXED * _conditional_sd(problem, reference.weights), spread, 0.0)


def _conditional_sd(problem: LeastSquares, weights: FloatArray | None) -> FloatArray:
    """Standard deviation (n,) of every unknown, all others given; 1 where nothing is said of it."""
    entries, _ = problem.whitened_values(weights)
    indices = problem.jacobian.matrix.indices
    information = np.bincount(indices, weights=entries**2, minlength=problem.size)
    return np.asarray(1.0 / np.sqrt(np.where(information > 0.0, information, 1.0)))


def _unrounded(program: QuadraticProgram, x: FloatArray, certificate: Certificate) -> Certificate:
    """The residuals of a quadratic program, less what rounding leaves."""
    hessian = abs(program.P) @ np.abs(x) + np.abs(program.q)
    primal = 0.0
    for rows, side in ((program.G, program.h), (program.A, program.b)):
        if rows is not None and side is not None:
            sizes = abs(rows) @ np.abs(x) + np.where(np.isfinite(side), np.abs(side), 0.0)
            primal = max(primal, float(sizes.max(initial=0.0)))
    return Certificate(
        primal=max(certificate.primal - ROUNDING * primal, 0.0),
        dual=max(certificate.dual - ROUNDING * float(hessian.max(initial=0.0)), 0.0),
        gap=max(certificate.gap - ROUNDING * float(np.abs(x) @ hessian), 0.0),
    )

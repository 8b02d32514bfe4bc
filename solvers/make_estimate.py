"""From the end of a solve to everything that an estimate owes its user."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from factorgrasp.errors import NotSolvedError
from factorgrasp.estimate import CovarianceSource, Estimate, TermSummary
from factorgrasp.least_squares import LeastSquares
from factorgrasp.observability import Describe, Direction, Observability, default_words, observe
from factorgrasp.provenance import versions
from factorgrasp.solvers.base import Solution, Solver
from factorgrasp.solvers.certificate import certify
from factorgrasp.solvers.cholesky import Cholesky
from factorgrasp.solvers.factor import ActiveSet, Factor, active_set, posterior_factor
from factorgrasp.solvers.outer_loop import LoopResult
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, State


def make_estimate(
    result: LoopResult, kind: str, solver: Solver, problem: object, asked: str, started: float
) -> Estimate:
    """Status, values, covariance, agreement, observability and provenance, from the end of a loop.

    Parameters
    ----------
    result : LoopResult
    kind : str
    solver : Solver
    problem : object
        Read for ``describe_direction``, ``advice`` and ``score_covariance`` where it offers them.
    asked : str
        Hash of the problem.
    started : float
        ``time.perf_counter()`` when the solve began.
    """
    system, solution = result.least_squares, result.solution
    finite = bool(np.all(np.isfinite(solution.x)))
    posterior = time.perf_counter()
    status, message = result.status, result.message
    factor: Factor | None = None
    observability: Observability | None = None
    source: CovarianceSource | None = None
    # Without inequalities the covariance does not depend on the iterate: a solver that gave none up can still be told what was missing.
    judgeable = finite or (status is Status.UNOBSERVABLE and not system.has_inequalities)
    if judgeable and status not in (Status.INFEASIBLE, Status.UNBOUNDED):
        active = active_set(system, solution, result.row_weights)
        try:
            factor = _factor(result, solver, active)
            score = _score(problem, result.state)
            observability = _observe(system, factor, score, problem)
            source = _source(factor, score)
        except NotSolvedError as error:
            message = f"{message}; no covariance: {error}" if message else f"no covariance: {error}"
    if factor is not None and observability is not None and status in (Status.SOLVED, Status.UNOBSERVABLE):
        status, message = _judge(status, message, observability, factor, system, problem)
    elif status is Status.INFEASIBLE:
        message = _infeasible_words(system, solution, message)
    ended = time.perf_counter()
    residuals = system.residuals(solution.x) if finite else np.empty(0)
    return Estimate(
        status=status,
        kind=kind,
        solver=solver.name,
        variables=system.variables,
        values=_values(system, solution, result.state),
        message=message,
        residuals=term_summaries(system, residuals) if finite else (),
        observability=observability,
        objective=system.objective(solution.x) if finite else float("nan"),
        iterations=result.iterations,
        certificate=certify(system, solution, result.row_weights) if finite else None,
        timing={
            "setup": result.setup_time,
            "solve": result.solve_time,
            "posterior": ended - posterior,
            "total": time.perf_counter() - started,
        },
        versions=versions(solver.modules),
        problem_hash=asked,
        multipliers=_multipliers(system, solution),
        covariance_source=source,
    )


def term_summaries(problem: LeastSquares, residuals: FloatArray) -> tuple[TermSummary, ...]:
    """Agreement of every term with an estimate, from the whitened residuals (rows,).

    Rows without any entry and with a zero right-hand side are gaps: they count neither as rows nor as agreement.
    """
    matrix = problem.jacobian.matrix
    used = (
        np.bincount(problem.jacobian.row_of_entry, weights=np.abs(matrix.data), minlength=matrix.shape[0])
        > 0.0
    )
    used |= problem.jacobian.rhs != 0.0
    out = []
    for name, term in problem.terms.items():
        where = problem.jacobian.slices[name]
        rows = int(np.count_nonzero(used[where]))
        chi2 = float(residuals[where] @ residuals[where])
        norms = problem.group_norms(name, residuals)
        groups = used[where].reshape(norms.size, -1).any(axis=1)
        lost = 0.0
        if term.loss is not None and groups.any():
            lost = float(np.mean(term.loss.weight(norms[groups]) < 0.5))
        rms = float(np.sqrt(chi2 / rows)) if rows else float("nan")
        out.append(TermSummary(name, rows, chi2, rms, float(norms.max(initial=0.0)), lost))
    return tuple(out)


def _factor(result: LoopResult, solver: Solver, active: ActiveSet) -> Factor:
    """The solver's own factor where it solved exactly this system last, else a new one."""
    lend = solver.factor if isinstance(solver, Cholesky) else None
    # A linear problem without re-weighting: the weights of the last solve are those of the result.
    if lend is not None and active.empty and result.state is None and result.row_weights is None:
        return lend()
    return posterior_factor(result.least_squares, result.solution.x, result.row_weights, active)


def _score(problem: object, state: State | None) -> FloatArray | None:
    offer = getattr(problem, "score_covariance", None)
    if offer is None or state is None:
        return None
    score = offer(state)
    return None if score is None else np.asarray(score, dtype=float)


def _source(factor: Factor, score: FloatArray | None) -> CovarianceSource:
    if score is None:
        return factor.solve

    def sandwich(columns: FloatArray) -> FloatArray:
        inner = factor.solve(columns)
        lost = ~np.isfinite(inner).all(axis=0)
        out = factor.informed_solve(score @ np.where(lost, 0.0, inner))
        return np.where(lost, np.nan, out)

    return sandwich


def _observe(
    system: LeastSquares, factor: Factor, score: FloatArray | None, problem: object
) -> Observability:
    judged = [variable for variable in system.variables if variable.resolution is not None]
    if len(judged) > 20:
        factor.prepare_marginals()

    def marginal(name: str) -> FloatArray:
        where = np.arange(system.size)[system.columns[name]]
        if score is None:
            return factor.informed_marginal(where)
        columns = np.zeros((system.size, where.size))
        columns[where, np.arange(where.size)] = 1.0
        spread = factor.informed_solve(columns)
        return np.asarray(spread.T @ score @ spread)

    null = factor.null.parts(system.variables) if factor.null.count else {}
    found = observe(system.variables, marginal, _describe(problem), null=null)
    if found.complete:
        return found
    # Advice may cost a look at the data: it is asked for only when something is missing.
    advice = getattr(problem, "advice", "")
    return replace(found, advice=str(advice() if callable(advice) else advice))


def _describe(problem: object) -> Describe:
    return getattr(problem, "describe_direction", None) or default_words


def _judge(
    status: Status,
    message: str,
    observability: Observability,
    factor: Factor,
    system: LeastSquares,
    problem: object,
) -> tuple[Status, str]:
    if observability.complete and not factor.null.count:
        # A solver may stop at a system that is singular for it although the data do inform everything.
        return status, message
    if factor.null.count:
        words = factor.null.message(system.variables, _describe(problem))
        weak = [d for d in observability.missing if np.isfinite(d.sd)]
    else:
        words, weak = "", list(observability.missing)
    parts = [words] if words else []
    if weak:
        parts.append("the data hardly inform " + "; ".join(_weak_words(d) for d in weak))
    if observability.advice:
        parts.append(observability.advice)
    return Status.UNOBSERVABLE, ". ".join(parts)


def _weak_words(direction: Direction) -> str:
    unit = f" {direction.unit}" if direction.unit else ""
    return f"{direction.words} (sd {direction.sd:.3g}{unit}, needed {direction.resolution:.3g}{unit})"


def _infeasible_words(system: LeastSquares, solution: Solution, message: str) -> str:
    """The solver's words, and the constraints that its last iterate violates most."""
    if not np.all(np.isfinite(solution.x)):
        return message or "no value of the unknowns satisfies all constraints"
    worst = []
    for name, constraint in system.constraints.items():
        rows = system.equalities if constraint.kind == "equality" else system.inequalities
        where = rows.slices[name]
        error = (rows.matrix @ solution.x - rows.rhs)[where]
        size = float(np.max(np.abs(error) if constraint.kind == "equality" else np.maximum(error, 0.0)))
        if size > 1e-6:
            worst.append((size, f"{name} (by {size:.3g}{' ' + constraint.unit if constraint.unit else ''})"))
    for variable in system.variables:
        where = system.columns[variable.name]
        x = solution.x[where]
        size = float(np.max(np.maximum(system.lower[where] - x, x - system.upper[where])))
        if size > 1e-6:
            worst.append(
                (
                    size,
                    f"bounds of {variable.name} (by {size:.3g}{' ' + variable.unit if variable.unit else ''})",
                )
            )
    named = ", ".join(words for _, words in sorted(worst, reverse=True)[:4])
    said = message or "no value of the unknowns satisfies all constraints"
    return f"{said}; violated at the last iterate: {named}" if named else said


def _values(system: LeastSquares, solution: Solution, state: State | None) -> dict[str, FloatArray]:
    if state is None:
        return {v.name: solution.x[system.columns[v.name]].copy() for v in system.variables}
    return {v.name: np.array(state[v.name], dtype=float) for v in system.variables}


def _multipliers(system: LeastSquares, solution: Solution) -> dict[str, FloatArray]:
    """Multipliers by the name of their constraint; those of bounds as ``"bounds of <variable>"``."""
    out: dict[str, FloatArray] = {}
    for rows, multiplier in ((system.equalities, solution.y), (system.inequalities, solution.z)):
        if multiplier.size == rows.height:
            out.update({name: multiplier[where].copy() for name, where in rows.slices.items()})
    if solution.z_box.size == system.size:
        for variable in system.variables:
            where = system.columns[variable.name]
            if np.any(np.isfinite(system.lower[where]) | np.isfinite(system.upper[where])):
                out[f"bounds of {variable.name}"] = solution.z_box[where].copy()
    return out

"""What each QP backend says at the end of a solve, in words of ours."""

from __future__ import annotations

from collections.abc import Mapping

from factorgrasp.status import Status

STATUS_MAP: Mapping[str, Mapping[str, Status]] = {
    "clarabel": {
        "Solved": Status.SOLVED,
        "AlmostSolved": Status.NOT_CONVERGED,
        "PrimalInfeasible": Status.INFEASIBLE,
        "AlmostPrimalInfeasible": Status.INFEASIBLE,
        "DualInfeasible": Status.UNBOUNDED,
        "AlmostDualInfeasible": Status.UNBOUNDED,
        "MaxIterations": Status.NOT_CONVERGED,
        "MaxTime": Status.NOT_CONVERGED,
        "InsufficientProgress": Status.NOT_CONVERGED,
        "CallbackTerminated": Status.NOT_CONVERGED,
        "NumericalError": Status.NUMERICAL_ERROR,
        "Unsolved": Status.NUMERICAL_ERROR,
    },
    # CVXOPT's QP solver knows no certificate of infeasibility: it ends as "unknown" or with an exception.
    "cvxopt": {"optimal": Status.SOLVED, "unknown": Status.NOT_CONVERGED},
    "kvxopt": {"optimal": Status.SOLVED, "unknown": Status.NOT_CONVERGED},
    "daqp": {
        "1": Status.SOLVED,
        "2": Status.NOT_CONVERGED,
        "-1": Status.INFEASIBLE,
        "-2": Status.NUMERICAL_ERROR,
        "-3": Status.UNBOUNDED,
        "-4": Status.NOT_CONVERGED,
        "-5": Status.NUMERICAL_ERROR,
        "-6": Status.INFEASIBLE,
        "-7": Status.NOT_CONVERGED,
    },
    "ecos": {
        "0": Status.SOLVED,
        "1": Status.INFEASIBLE,
        "2": Status.UNBOUNDED,
        "10": Status.NOT_CONVERGED,
        "11": Status.INFEASIBLE,
        "12": Status.UNBOUNDED,
        "-1": Status.NOT_CONVERGED,
        "-2": Status.NUMERICAL_ERROR,
        "-3": Status.NUMERICAL_ERROR,
        "-4": Status.NOT_CONVERGED,
        "-7": Status.NUMERICAL_ERROR,
    },
    "highs": {
        "Optimal": Status.SOLVED,
        "Infeasible": Status.INFEASIBLE,
        "Unbounded": Status.UNBOUNDED,
        "UnboundedOrInfeasible": Status.INFEASIBLE,
        "TimeLimit": Status.NOT_CONVERGED,
        "IterationLimit": Status.NOT_CONVERGED,
        "ObjectiveBound": Status.NOT_CONVERGED,
        "ObjectiveTarget": Status.NOT_CONVERGED,
        "Interrupt": Status.NOT_CONVERGED,
        "HighsInterrupt": Status.NOT_CONVERGED,
        "SolutionLimit": Status.NOT_CONVERGED,
        "Unknown": Status.NOT_CONVERGED,
        "ModelEmpty": Status.NUMERICAL_ERROR,
        "SolveError": Status.NUMERICAL_ERROR,
        "ModelError": Status.NUMERICAL_ERROR,
        "LoadError": Status.NUMERICAL_ERROR,
        "PresolveError": Status.NUMERICAL_ERROR,
        "PostsolveError": Status.NUMERICAL_ERROR,
        "MemoryLimit": Status.NUMERICAL_ERROR,
        "Notset": Status.NUMERICAL_ERROR,
    },
    "osqp": {
        "OSQP_SOLVED": Status.SOLVED,
        "OSQP_SOLVED_INACCURATE": Status.NOT_CONVERGED,
        "OSQP_PRIMAL_INFEASIBLE": Status.INFEASIBLE,
        "OSQP_PRIMAL_INFEASIBLE_INACCURATE": Status.INFEASIBLE,
        "OSQP_DUAL_INFEASIBLE": Status.UNBOUNDED,
        "OSQP_DUAL_INFEASIBLE_INACCURATE": Status.UNBOUNDED,
        "OSQP_MAX_ITER_REACHED": Status.NOT_CONVERGED,
        "OSQP_TIME_LIMIT_REACHED": Status.NOT_CONVERGED,
        "OSQP_NON_CVX": Status.NUMERICAL_ERROR,
        "OSQP_SIGINT": Status.NOT_CONVERGED,
        "OSQP_UNSOLVED": Status.NUMERICAL_ERROR,
    },
    "piqp": {
        "PIQP_SOLVED": Status.SOLVED,
        "PIQP_MAX_ITER_REACHED": Status.NOT_CONVERGED,
        "PIQP_PRIMAL_INFEASIBLE": Status.INFEASIBLE,
        "PIQP_DUAL_INFEASIBLE": Status.UNBOUNDED,
        "PIQP_NUMERICS": Status.NUMERICAL_ERROR,
        "PIQP_UNSOLVED": Status.NUMERICAL_ERROR,
        "PIQP_INVALID_SETTINGS": Status.NUMERICAL_ERROR,
    },
    "proxqp": {
        "PROXQP_SOLVED": Status.SOLVED,
        "PROXQP_SOLVED_CLOSEST_PRIMAL_FEASIBLE": Status.INFEASIBLE,
        "PROXQP_MAX_ITER_REACHED": Status.NOT_CONVERGED,
        "PROXQP_PRIMAL_INFEASIBLE": Status.INFEASIBLE,
        "PROXQP_DUAL_INFEASIBLE": Status.UNBOUNDED,
        "PROXQP_NOT_RUN": Status.NUMERICAL_ERROR,
    },
    "qpalm": {
        "solved": Status.SOLVED,
        "dual terminated": Status.NOT_CONVERGED,
        "maximum iterations reached": Status.NOT_CONVERGED,
        "primal infeasible": Status.INFEASIBLE,
        "dual infeasible": Status.UNBOUNDED,
        "time limit exceeded": Status.NOT_CONVERGED,
        "user cancellation": Status.NOT_CONVERGED,
        "unsolved": Status.NUMERICAL_ERROR,
        "error": Status.NUMERICAL_ERROR,
    },
    "quadprog": {"found": Status.SOLVED, "no solution": Status.INFEASIBLE},
    "scs": {
        "1": Status.SOLVED,
        "2": Status.NOT_CONVERGED,
        "0": Status.NOT_CONVERGED,
        "-1": Status.UNBOUNDED,
        "-2": Status.INFEASIBLE,
        "-3": Status.NUMERICAL_ERROR,
        "-4": Status.NUMERICAL_ERROR,
        "-5": Status.NOT_CONVERGED,
        "-6": Status.UNBOUNDED,
        "-7": Status.INFEASIBLE,
    },
}
"""Per backend, its own word or number (as a string) for the end of a solve, and our status."""

WORDS: Mapping[str, Mapping[str, str]] = {
    "daqp": {
        "1": "optimal",
        "2": "soft optimal",
        "-1": "infeasible",
        "-2": "cycling",
        "-3": "unbounded",
        "-4": "iteration limit",
        "-5": "not convex",
        "-6": "contradictory equalities",
        "-7": "time limit",
    },
    "ecos": {
        "0": "optimal",
        "1": "primal infeasible",
        "2": "dual infeasible",
        "10": "reduced accuracy",
        "11": "primal infeasible (reduced accuracy)",
        "12": "dual infeasible (reduced accuracy)",
        "-1": "iteration limit",
        "-2": "unreliable search direction",
        "-3": "iterate outside the cone",
        "-7": "unknown problem",
    },
    "scs": {
        "1": "solved",
        "2": "solved inaccurately (iteration or time limit)",
        "-1": "unbounded",
        "-2": "infeasible",
        "-3": "indeterminate",
        "-4": "failed",
        "-6": "unbounded (inaccurate)",
        "-7": "infeasible (inaccurate)",
    },
}
"""Words for backends that end with a number."""


def read_status(backend: str, raw: str, found: bool | None = None) -> Status:
    """Our status for what a backend said.

    Parameters
    ----------
    backend : str
    raw : str
        Its own word or number.
    found : bool or None
        What qpsolvers makes of it; used for backends and words that are not in :data:`STATUS_MAP`.
    """
    known = STATUS_MAP.get(backend, {})
    if raw in known:
        return known[raw]
    if found:
        return Status.SOLVED
    lower = raw.lower()
    if ("dual" in lower and "infeasible" in lower) or "unbounded" in lower:
        return Status.UNBOUNDED
    if "infeasible" in lower:
        return Status.INFEASIBLE
    return Status.NOT_CONVERGED


def status_words(backend: str, raw: str) -> str:
    """The backend's own words for its status."""
    return f"{backend}: {WORDS.get(backend, {}).get(raw, raw)}"

"""One tolerance for all: our options in every backend's own keywords."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from factorgrasp.solvers.base import SolverOptions


@dataclass(frozen=True)
class Keywords:
    """A backend's names for what :class:`SolverOptions` says.

    Attributes
    ----------
    absolute, relative : tuple of str
        Keywords that take the absolute and the relative tolerance.
    iterations, seconds : str
        Keywords of the limits; empty where the backend has none.
    smallest : float
        Smallest tolerance that it accepts.
    fixed : mapping
        Switches that make its test of convergence the same as everyone's.
    """

    absolute: tuple[str, ...] = ()
    relative: tuple[str, ...] = ()
    iterations: str = ""
    seconds: str = ""
    smallest: float = 0.0
    fixed: Mapping[str, Any] | None = None


_EPS = ("eps_abs",), ("eps_rel",)

KEYWORDS: Mapping[str, Keywords] = {
    "clarabel": Keywords(("tol_feas", "tol_gap_abs"), ("tol_gap_rel",), "max_iter", "time_limit"),
    "cvxopt": Keywords(("feastol", "abstol"), ("reltol",), "maxiters"),
    "daqp": Keywords(("primal_tol", "dual_tol"), (), "iter_limit", "time_limit"),
    "ecos": Keywords(("feastol", "abstol"), ("reltol",), "max_iters"),
    # HiGHS adds 1e-7 to the diagonal of P unless told not to: another problem than the one that was asked.
    "highs": Keywords(
        ("primal_feasibility_tolerance", "dual_feasibility_tolerance"),
        (),
        "qp_iteration_limit",
        "time_limit",
        1e-10,
        {"qp_regularization_value": 0.0},
    ),
    "osqp": Keywords(*_EPS, "max_iter", "time_limit", fixed={"check_dualgap": True}),
    "piqp": Keywords(
        ("eps_abs", "eps_duality_gap_abs"),
        ("eps_rel", "eps_duality_gap_rel"),
        "max_iter",
        fixed={"check_duality_gap": True},
    ),
    "proxqp": Keywords(
        ("eps_abs", "eps_duality_gap_abs"),
        ("eps_rel", "eps_duality_gap_rel"),
        "max_iter",
        fixed={"check_duality_gap": True},
    ),
    "qpalm": Keywords(*_EPS, "max_iter", "time_limit"),
    "quadprog": Keywords(),
    "scs": Keywords(*_EPS, "max_iters", "time_limit_secs"),
    # From the documentation of qpsolvers 4.13; not run by us.
    "copt": Keywords(("FeasTol", "DualTol"), (), "", "TimeLimit", 1e-9),
    "gurobi": Keywords(("FeasibilityTol", "OptimalityTol"), (), "BarIterLimit", "TimeLimit", 1e-9),
    "hpipm": Keywords(("tol_stat", "tol_eq", "tol_ineq", "tol_comp", "tol_dual_gap"), (), "iter_max"),
    "jaxopt_osqp": Keywords(("tol",), (), "maxiter"),
    "kvxopt": Keywords(("feastol", "abstol"), ("reltol",), "maxiters"),
    "pdhcg": Keywords(("FeasibilityTol", "OptimalityTol"), (), "IterationLimit", "TimeLimit"),
    "pyqpmad": Keywords(("tolerance",), (), "max_iter"),
    "qpax": Keywords(("solver_tol",), (), "max_iter"),
    "qpoases": Keywords((), ("termination_tolerance",), "max_wsr", "time_limit"),
    "qpswift": Keywords(("ABSTOL",), ("RELTOL",), "MAXITER"),
    "qtqp": Keywords(("atol",), ("rtol",), "max_iter"),
    "sip": Keywords(*_EPS, "max_iterations"),
}

ROUNDING = 1e-12
"""Relative tolerance of every backend that has one: what rounding leaves at best where the rows are large (a term with a variance of
1e-12 has normal equations of 1e12), so that an absolute tolerance which nobody can reach does not make every solve fail."""


def backend_settings(backend: str, options: SolverOptions) -> dict[str, Any]:
    """Keyword arguments of a backend for our options; `options.extra` has the last word."""
    words = KEYWORDS.get(backend, Keywords())
    settings: dict[str, Any] = dict(words.fixed or {})
    tolerance = max(options.tolerance, words.smallest)
    settings.update(dict.fromkeys(words.absolute, tolerance))
    settings.update(dict.fromkeys(words.relative, min(tolerance, ROUNDING)))
    if options.max_iterations is not None and words.iterations:
        settings[words.iterations] = options.max_iterations
    if options.time_limit is not None and words.seconds:
        settings[words.seconds] = options.time_limit
    settings.update(options.extra)
    return settings


def ignored_options(backend: str, options: SolverOptions) -> str:
    """Words for the limits that were asked for and that the backend does not have; empty when it has them all."""
    words = KEYWORDS.get(backend, Keywords())
    missing = []
    if options.max_iterations is not None and not words.iterations:
        missing.append("iteration limit")
    if options.time_limit is not None and not words.seconds:
        missing.append("time limit")
    if options.tolerance < words.smallest:
        missing.append(f"tolerance below {words.smallest:g}")
    return f"{backend} has no " + " and no ".join(missing) if missing else ""

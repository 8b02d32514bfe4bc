"""Estimation in physical human-robot interaction as covariance-weighted least squares.

``from factorgrasp import solve, compare``; the problems are in :mod:`factorgrasp.problems`. Everything here loads on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from factorgrasp.errors import (
        FactorgraspError,
        InfeasibleError,
        InputError,
        NotSolvedError,
        SolverError,
        UnobservableError,
    )
    from factorgrasp.estimate import Estimate
    from factorgrasp.least_squares import Constraint, LeastSquares, Term
    from factorgrasp.losses import Cauchy, GemanMcClure, Huber
    from factorgrasp.solvers.base import SolverOptions
    from factorgrasp.solvers.compare import compare
    from factorgrasp.solvers.outer_loop import LoopOptions
    from factorgrasp.solvers.registry import solver_names, solver_table
    from factorgrasp.solvers.solve import solve
    from factorgrasp.status import Status
    from factorgrasp.uncertainty import Covariance
    from factorgrasp.variables import Variable

__version__ = "0.1.0"

_HOME = {
    "Cauchy": "losses",
    "Constraint": "least_squares",
    "Covariance": "uncertainty",
    "Estimate": "estimate",
    "FactorgraspError": "errors",
    "GemanMcClure": "losses",
    "Huber": "losses",
    "InfeasibleError": "errors",
    "InputError": "errors",
    "LeastSquares": "least_squares",
    "LoopOptions": "solvers.outer_loop",
    "NotSolvedError": "errors",
    "SolverError": "errors",
    "SolverOptions": "solvers.base",
    "Status": "status",
    "Term": "least_squares",
    "UnobservableError": "errors",
    "Variable": "variables",
    "compare": "solvers.compare",
    "solve": "solvers.solve",
    "solver_names": "solvers.registry",
    "solver_table": "solvers.registry",
}

__all__ = [
    "Cauchy",
    "Constraint",
    "Covariance",
    "Estimate",
    "FactorgraspError",
    "GemanMcClure",
    "Huber",
    "InfeasibleError",
    "InputError",
    "LeastSquares",
    "LoopOptions",
    "NotSolvedError",
    "SolverError",
    "SolverOptions",
    "Status",
    "Term",
    "UnobservableError",
    "Variable",
    "__version__",
    "compare",
    "solve",
    "solver_names",
    "solver_table",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

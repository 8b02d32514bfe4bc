"""The solvers by name. Adding a backend takes one file and one line here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import cast

from factorgrasp.errors import SolverError
from factorgrasp.solvers.base import Capabilities, Solver, SolverOptions

SOLVERS: dict[str, str] = {
    "cholesky": "factorgrasp.solvers.cholesky:Cholesky",
    "kkt": "factorgrasp.solvers.kkt:Kkt",
    "gtsam": "factorgrasp.solvers.gtsam_linear:GtsamElimination",
    "gtsam-gauss-newton": "factorgrasp.solvers.gtsam_nonlinear:GtsamGaussNewton",
    "gtsam-levenberg-marquardt": "factorgrasp.solvers.gtsam_nonlinear:GtsamLevenbergMarquardt",
    "gtsam-isam2": "factorgrasp.solvers.gtsam_nonlinear:GtsamIsam2",
    "ipopt": "factorgrasp.solvers.nlp_casadi:Ipopt",
    "fatrop": "factorgrasp.solvers.nlp_casadi:Fatrop",
    "sqpmethod": "factorgrasp.solvers.nlp_casadi:SqpMethod",
}
"""``"module:Class"`` of every solver by its name, imported when it is asked for. What follows the colon may also be a function that makes
the class for a name (how one file serves all backends of qpsolvers)."""

QPSOLVERS_BACKENDS: tuple[str, ...] = (
    "clarabel",
    "copt",
    "cvxopt",
    "daqp",
    "ecos",
    "gurobi",
    "highs",
    "hpipm",
    "jaxopt_osqp",
    "kvxopt",
    "mosek",
    "nppro",
    "osqp",
    "pdhcg",
    "piqp",
    "proxqp",
    "pyqpmad",
    "qpalm",
    "qpax",
    "qpoases",
    "qpswift",
    "qtqp",
    "quadprog",
    "scs",
    "sip",
)
SOLVERS.update({name: "factorgrasp.solvers.qp:solver_class" for name in QPSOLVERS_BACKENDS})

QP_PREFERENCE: tuple[str, ...] = (
    "piqp",
    "clarabel",
    "daqp",
    "highs",
    "proxqp",
    "quadprog",
    "cvxopt",
    "qpalm",
    "osqp",
)
"""Which installed backend solves a problem with inequalities by default: the most accurate on our badly scaled problems first."""


@dataclass(frozen=True)
class SolverRow:
    """One line of the table of solvers.

    Attributes
    ----------
    name : str
    installed : bool
    capabilities : Capabilities
    pip : str
        The command that installs what it needs; empty when it comes with factorgrasp.
    """

    name: str
    installed: bool
    capabilities: Capabilities
    pip: str


def solver_names(installed_only: bool = False) -> list[str]:
    """Names of all known solvers, ours first; of those that can run here when `installed_only`."""
    return [name for name in SOLVERS if not installed_only or solver_class(name).installed()]


def solver_table() -> list[SolverRow]:
    """One row a known solver: whether it can run here, what it takes, how to install it."""
    rows = []
    for name in SOLVERS:
        kind = solver_class(name)
        pip = f"pip install {kind.pip}" if kind.pip else ""
        rows.append(SolverRow(name, kind.installed(), kind.capabilities, pip))
    return rows


def get_solver(name: str, options: SolverOptions | None = None) -> Solver:
    """A new solver by its name.

    Raises
    ------
    SolverError
        When the name is unknown or what it needs is not installed; the message lists what is installed and the command to install it.
    """
    kind = solver_class(name)
    if not kind.installed():
        raise SolverError(
            f"solver {name!r} is not installed: pip install {kind.pip}. "
            f"Installed: {', '.join(solver_names(installed_only=True))}"
        )
    return kind(options)


def solver_class(name: str) -> type[Solver]:
    """Class of a solver by its name, whether or not what it needs is installed."""
    if name not in SOLVERS:
        rows = solver_table()
        installed = ", ".join(row.name for row in rows if row.installed)
        missing = "; ".join(f"{row.name} ({row.pip})" for row in rows if not row.installed)
        raise SolverError(
            f"unknown solver {name!r}. Installed: {installed}."
            + (f" Can be installed: {missing}." if missing else "")
        )
    return _load(name, SOLVERS[name])


@cache
def _load(name: str, address: str) -> type[Solver]:
    module, _, attribute = address.partition(":")
    found = getattr(import_module(module), attribute)
    if isinstance(found, type):
        return cast("type[Solver]", found)
    return cast("Callable[[str], type[Solver]]", found)(name)

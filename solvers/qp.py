"""Quadratic programs: every backend that qpsolvers knows, behind one class each, with one tolerance and one set of statuses.

Objective, residuals and gap are not taken from the backends: see :mod:`factorgrasp.solvers.certificate`.
"""

from __future__ import annotations

import time
from typing import ClassVar

import numpy as np
import scipy.sparse as sp

from factorgrasp.errors import FactorgraspError, SolverError
from factorgrasp.least_squares import LeastSquares, QuadraticProgram
from factorgrasp.solvers.base import Capabilities, Solution, Solver, SolverOptions
from factorgrasp.solvers.qp_cached import CACHED
from factorgrasp.solvers.qp_form import QpForm, make_form
from factorgrasp.solvers.qp_oneshot import (
    DENSE,
    FOLD_BOUNDS,
    NEEDS_ROWS,
    ONE_SHOT,
    RawResult,
    solve_with_qpsolvers,
)
from factorgrasp.solvers.qp_options import backend_settings, ignored_options
from factorgrasp.solvers.qp_status import read_status, status_words
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray

MODULES: dict[str, tuple[str, str]] = {
    "clarabel": ("clarabel", "clarabel"),
    "copt": ("coptpy", "coptpy"),
    "cvxopt": ("cvxopt", "cvxopt"),
    "daqp": ("daqp", "daqp"),
    "ecos": ("ecos", "ecos"),
    "gurobi": ("gurobipy", "gurobipy"),
    "highs": ("highspy", "highspy"),
    "hpipm": (
        "hpipm_python",
        "git+https://github.com/giaf/hpipm#subdirectory=interfaces/python/hpipm_python",
    ),
    "jaxopt_osqp": ("jaxopt", "jaxopt"),
    "kvxopt": ("kvxopt", "kvxopt"),
    "mosek": ("mosek", "cvxopt mosek"),
    "nppro": ("nppro", "nppro"),
    "osqp": ("osqp", "osqp"),
    "pdhcg": ("pdhcg", "pdhcg"),
    "piqp": ("piqp", "piqp"),
    "proxqp": ("proxsuite", "proxsuite"),
    "pyqpmad": ("pyqpmad", "pyqpmad"),
    "qpalm": ("qpalm", "qpalm"),
    "qpax": ("qpax", "qpax"),
    "qpoases": ("qpoases", "qpoases"),
    "qpswift": ("qpSWIFT", "qpSWIFT"),
    "qtqp": ("qtqp", "qtqp"),
    "quadprog": ("quadprog", "quadprog"),
    "scs": ("scs", "scs"),
    "sip": ("sip_qp_python", "sip-qp-python"),
}
"""Per backend the module that must be there and what to `pip install` for it."""

WARM_STARTED = frozenset({"daqp", "osqp", "proxqp"})
"""Backends that gain from a start as they are reached here. Interior-point methods do not; the starts of qpalm and scs do not get through
qpsolvers 4.13 (no iteration saved: measured)."""


_GROSS = 1e-3
"""Violation of a constraint, relative to the numbers in its row, from which a claim to have solved is not believed. Whether it is within
the tolerance is the certificate's business; this is for answers that have nothing to do with the question."""


class QpSession:
    """One backend with its options, and what it keeps between solves of one pattern.

    Parameters
    ----------
    backend : str
        Name of a backend of qpsolvers.
    options : SolverOptions, optional
    """

    def __init__(self, backend: str, options: SolverOptions | None = None) -> None:
        if backend not in MODULES:
            raise SolverError(f"unknown QP backend {backend!r}; known: {', '.join(MODULES)}")
        self.backend = backend
        self.options = options or SolverOptions()
        self._settings = backend_settings(backend, self.options)
        self._cached = CACHED[backend](self._settings) if backend in CACHED else None

    def expect(self, hessian: sp.sparray) -> None:
        """Say which entries of P may become non-zero in later solves."""
        if self._cached is not None:
            self._cached.expect(hessian)

    def solve(self, qp: QuadraticProgram, warm_start: Solution | None = None) -> Solution:
        """Solve one quadratic program; never raises for what a backend does, only for options that it does not have."""
        start_time = time.perf_counter()
        try:
            form = make_form(qp, self.backend in FOLD_BOUNDS, self.backend in NEEDS_ROWS)
            if self.backend not in WARM_STARTED or not _usable(warm_start, qp.q.size):
                warm_start = None
            if self._cached is None:
                raw = ONE_SHOT.get(self.backend, solve_with_qpsolvers)(
                    self.backend, form, self._settings, warm_start
                )
            else:
                self._cached.load(form)
                raw = self._cached.run(form, warm_start)
        except (FactorgraspError, KeyboardInterrupt, SystemExit, GeneratorExit):
            raise  # bad input of the caller, or someone who wants to stop
        except BaseException as error:  # panics of Rust backends are no Exception
            if self._cached is not None:
                self._cached = CACHED[self.backend](self._settings)
            return self._failed(qp, error, time.perf_counter() - start_time)
        status = read_status(self.backend, raw.raw, raw.found)
        x = _vector(raw.x, qp.q.size, np.nan)
        message = "; ".join(
            part for part in (status_words(self.backend, raw.raw), raw.message, self._ignored()) if part
        )
        if status is Status.SOLVED:
            if not np.all(np.isfinite(x)):
                status, message = Status.NUMERICAL_ERROR, message + "; but its answer is not finite"
            elif (violation := _violation(form, x)) > max(_GROSS, 100.0 * self.options.tolerance):
                status = Status.NOT_CONVERGED
                message += f"; but its answer violates a constraint by {violation:.2g} of the numbers in it"
        z, z_box = _multipliers(raw, form)
        elapsed = time.perf_counter() - start_time
        return Solution(
            x=x,
            status=status,
            y=_vector(raw.y, 0 if qp.b is None else qp.b.size, 0.0),
            z=z,
            z_box=z_box if qp.lb is not None or qp.ub is not None else np.empty(0),
            iterations=raw.iterations,
            setup_time=max(elapsed - raw.solve_time, 0.0),
            solve_time=raw.solve_time,
            message=message,
        )

    def _ignored(self) -> str:
        words = ignored_options(self.backend, self.options)
        return words and f"note: {words}"

    def _failed(self, qp: QuadraticProgram, error: BaseException, elapsed: float) -> Solution:
        message = f"{self.backend}: {type(error).__name__}: {error}"
        if "not positive definite" in str(error):
            message += (
                f". {self.backend} takes positive definite problems only, and nothing was added to make it so: "
                "give every unknown a prior, or use a solver that takes semidefinite ones (piqp, clarabel, osqp)"
            )
        return Solution(
            x=np.full(qp.q.size, np.nan),
            status=Status.NUMERICAL_ERROR,
            y=np.zeros(0 if qp.b is None else qp.b.size),
            z=np.zeros(0 if qp.h is None else qp.h.size),
            z_box=np.zeros(qp.q.size) if qp.lb is not None or qp.ub is not None else np.empty(0),
            setup_time=elapsed,
            message=message,
        )


class QpSolver(Solver):
    """A least-squares problem as a quadratic program for one backend; see :func:`solver_class`."""

    name: ClassVar[str] = "qp"

    def setup(self, problem: LeastSquares) -> None:
        """Remember the problem and the entries that its Hessian can have; what the backend keeps survives for the same pattern."""
        pattern = problem.jacobian.matrix
        known: LeastSquares | None = getattr(self, "_problem", None)
        self._problem = problem
        if known is not None:
            old = known.jacobian.matrix
            if old.shape == pattern.shape and all(
                np.array_equal(a, b)
                for a, b in ((old.indptr, pattern.indptr), (old.indices, pattern.indices))
            ):
                return
        self._session = QpSession(self.name, self.options)
        ones = sp.csr_array((np.ones(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape)
        self._session.expect(ones.T @ ones)

    def solve(self, row_weights: FloatArray | None = None, warm_start: Solution | None = None) -> Solution:
        """Solve for the current values; `setup_time` holds the forming of the QP and the backend's set-up or update."""
        start_time = time.perf_counter()
        qp = self._problem.quadratic_program(row_weights)
        formed = time.perf_counter() - start_time
        found = self._session.solve(qp, warm_start)
        return Solution(**{**vars(found), "setup_time": found.setup_time + formed})


def solver_class(name: str) -> type[Solver]:
    """The solver class of a backend of qpsolvers, whether or not it is installed."""
    if name not in MODULES:
        raise SolverError(f"unknown QP backend {name!r}; known: {', '.join(MODULES)}")
    module, pip = MODULES[name]
    attributes = {
        "name": name,
        "modules": ("qpsolvers", module),
        "pip": f"qpsolvers {pip}",
        "capabilities": Capabilities(
            equalities=True, inequalities=True, warm_start=name in WARM_STARTED, sparse=name not in DENSE
        ),
        "__module__": __name__,
        "__doc__": f"Quadratic programs with {name}.",
    }
    return type(f"{name.title().replace('_', '')}Solver", (QpSolver,), attributes)


def solve_qp(
    qp: QuadraticProgram,
    backend: str,
    options: SolverOptions | None = None,
    warm_start: Solution | None = None,
) -> Solution:
    """Solve one quadratic program with one backend, from scratch.

    Parameters
    ----------
    qp : QuadraticProgram
        ``min 1/2 x'Px + q'x + constant  s.t.  G x <= h, A x = b, lb <= x <= ub``, P symmetric with both triangles.
    backend : str
        Name of a backend of qpsolvers.
    options : SolverOptions, optional
    warm_start : Solution, optional
        Ignored by backends that cannot use one.

    Returns
    -------
    Solution
        The last iterate also when it failed; an exception of the backend becomes `Status.NUMERICAL_ERROR` with its words.

    Raises
    ------
    SolverError
        When the backend is unknown or not installed.
    """
    if backend in MODULES and not solver_class(backend).installed():
        raise SolverError(
            f"QP backend {backend!r} is not installed: pip install qpsolvers {MODULES[backend][1]}"
        )
    return QpSession(backend, options).solve(qp, warm_start)


def _usable(start: Solution | None, size: int) -> bool:
    """Whether a start is finite throughout; a single infinite multiplier keeps ProxQP busy for minutes."""
    return (
        start is not None
        and start.x.size == size
        and all(bool(np.all(np.isfinite(part))) for part in (start.x, start.y, start.z, start.z_box))
    )


def _violation(form: QpForm, x: FloatArray) -> float:
    """Largest violation of a constraint, relative to the sizes of the numbers in its row and at least one."""
    worst = 0.0
    for rows, side, two_sided in ((form.G, form.h, False), (form.A, form.b, True)):
        if rows is not None and side is not None:
            error = rows @ x - side
            size = 1.0 + np.abs(side) + abs(rows) @ np.abs(x)
            worst = max(worst, float(np.max((np.abs(error) if two_sided else error) / size)))
    for bound, sign in ((form.lb, -1.0), (form.ub, 1.0)):
        if bound is not None and bound.size:
            worst = max(worst, float(np.max(sign * (x - bound) / (1.0 + np.abs(x)))))
    return worst


def _vector(value: FloatArray | None, size: int, missing: float) -> FloatArray:
    """A backend's vector, or `missing` where it gave none."""
    if value is None:
        return np.full(size, missing)
    out = np.asarray(value, dtype=float).ravel()
    return out.copy() if out.size == size else np.full(size, missing)


def _multipliers(raw: RawResult, form: QpForm) -> tuple[FloatArray, FloatArray]:
    z = _vector(raw.z, 0 if form.h is None else form.h.size, 0.0)
    box = _vector(raw.z_box, form.size, 0.0)
    return form.back(z, box)

"""Backends that are built afresh for every solve: qpsolvers' interfaces, and our own where those hide the status or the last iterate."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from factorgrasp.solvers.base import Solution
from factorgrasp.solvers.qp_form import QpForm
from factorgrasp.typing import FloatArray

DENSE = frozenset({"daqp", "ecos", "hpipm", "jaxopt_osqp", "nppro", "pyqpmad", "qpax", "qpoases", "quadprog"})
"""Backends that take dense matrices only."""

FOLD_BOUNDS = frozenset(
    {"clarabel", "cvxopt", "ecos", "jaxopt_osqp", "kvxopt", "qpax", "qpswift", "qtqp", "quadprog", "scs"}
)
"""Backends without bounds of their own, or that fail on one-sided ones."""

NEEDS_ROWS = frozenset({"clarabel", "highs", "scs"})
"""Backends that need a constraint, be it vacuous: without any, SCS refuses and HiGHS stops short of the optimum (residual of 0.08 seen)."""


class RawResult(NamedTuple):
    """What came out of a backend, in the form's order of constraints; `x` is None when it returned nothing."""

    raw: str
    found: bool | None
    x: FloatArray | None
    y: FloatArray | None
    z: FloatArray | None
    z_box: FloatArray | None
    iterations: int
    solve_time: float
    message: str = ""


def solve_with_qpsolvers(
    backend: str, form: QpForm, settings: Mapping[str, Any], start: Solution | None
) -> RawResult:
    """Through ``qpsolvers.solve_problem``, with the backend's own status dug out of the extras."""
    qpsolvers: Any = import_module("qpsolvers")

    parts: list[Any] = [form.P, form.q, form.G, form.h, form.A, form.b, form.lb, form.ub]
    if backend in DENSE or settings.get("backend") == "dense":
        parts = [part.toarray() if sp.issparse(part) else part for part in parts]
    keywords = dict(settings)
    initial = None
    if start is not None:
        initial = start.x
        if backend == "proxqp":
            y, z, box = form.forward(start)
            keywords |= {"y": y, "z": np.concatenate([z, box]) if form.lb is not None else z}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        start_time = time.perf_counter()
        found = qpsolvers.solve_problem(qpsolvers.Problem(*parts), backend, initvals=initial, **keywords)
        elapsed = time.perf_counter() - start_time
    said = "; ".join(str(w.message) for w in caught if issubclass(w.category, UserWarning))
    raw, iterations = _read_extras(backend, found.extras, bool(found.found))
    return RawResult(
        raw,
        found.found,
        found.x,
        found.y,
        found.z,
        found.z_box,
        iterations,
        elapsed if found.solve_time is None else found.solve_time,
        said,
    )


def _read_extras(backend: str, extras: Mapping[str, Any], found: bool) -> tuple[str, int]:
    """The backend's own status and its iterations."""
    if backend == "quadprog":
        return ("found" if found else "no solution"), int(extras["iterations"][0]) if found else 0
    if backend == "ecos":
        return str(extras["exitFlag"]), int(extras["iter"])
    if backend == "scs":
        return str(extras["status_val"]), int(extras["iter"])
    if backend in ("cvxopt", "kvxopt"):
        return str(extras["status"]), int(extras["iterations"])
    if backend in ("proxqp", "qpalm"):
        info = extras["info"]
        return getattr(info.status, "name", str(info.status)), int(info.iter)
    raw = str(extras.get("status", "found" if found else "not found"))
    return raw, int(extras.get("iter", extras.get("num_iterations", 0)) or 0)


def solve_with_daqp(
    backend: str, form: QpForm, settings: Mapping[str, Any], start: Solution | None
) -> RawResult:
    """DAQP itself: qpsolvers drops its exit flag and the iterate of a failed solve."""
    daqp: Any = import_module("daqp")

    n = form.size
    boxed = form.lb is not None or form.ub is not None
    lower_box = np.full(n, -np.inf) if form.lb is None else form.lb
    upper_box = np.full(n, np.inf) if form.ub is None else form.ub
    none = np.empty(0)
    h = none if form.h is None else form.h
    b = none if form.b is None else form.b
    blocks = [m.toarray() for m in (form.G, form.A) if m is not None]
    rows = np.ascontiguousarray(np.vstack(blocks)) if blocks else np.zeros((0, n))
    upper = np.concatenate([upper_box if boxed else none, h, b])
    lower = np.concatenate([lower_box if boxed else none, np.full(h.size, -np.inf), b])
    sense = np.zeros(upper.size, dtype=np.intc)
    sense[upper.size - b.size :] = 5  # DAQP: active and immutable, which is an equality
    keywords = dict(settings)
    if start is not None:
        keywords["primal_start"] = start.x.copy()
    start_time = time.perf_counter()
    x, _, flag, info = daqp.solve(form.P.toarray(), form.q.copy(), rows, upper, lower, sense, **keywords)
    elapsed = time.perf_counter() - start_time
    # The multipliers of a failed solve are uninitialised memory.
    lam = info["lam"] if flag > 0 else np.zeros(upper.size)
    box, z, y = np.split(lam, [n if boxed else 0, (n if boxed else 0) + h.size])
    return RawResult(str(flag), flag > 0, np.asarray(x), y, z, box, int(info["iterations"]), elapsed)


def solve_with_highs(
    backend: str, form: QpForm, settings: Mapping[str, Any], start: Solution | None
) -> RawResult:
    """HiGHS itself: qpsolvers drops its model status and the iterations."""
    highspy: Any = import_module("highspy")

    n, infinity = form.size, highspy.kHighsInf
    model = highspy.HighsModel()
    lower_triangle = sp.tril(form.P, format="csc")
    model.hessian_.dim_ = n
    model.hessian_.start_ = lower_triangle.indptr
    model.hessian_.index_ = lower_triangle.indices
    model.hessian_.value_ = lower_triangle.data
    lp = model.lp_
    lp.num_col_, lp.col_cost_ = n, form.q
    lp.col_lower_ = np.full(n, -infinity) if form.lb is None else form.lb
    lp.col_upper_ = np.full(n, infinity) if form.ub is None else form.ub
    none = np.empty(0)
    h = none if form.h is None else form.h
    b = none if form.b is None else form.b
    lp.num_row_ = h.size + b.size
    blocks = [m for m in (form.G, form.A) if m is not None]
    if blocks:
        rows = sp.vstack(blocks, format="csc")
        lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
        lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = rows.indptr, rows.indices, rows.data
        lp.a_matrix_.num_row_, lp.a_matrix_.num_col_ = rows.shape
        lp.row_lower_ = np.concatenate([np.full(h.size, -infinity), b])
        lp.row_upper_ = np.concatenate([h, b])
    # Its base class: the one for users prints a banner, whatever the options say.
    solver = getattr(highspy, "_Highs", highspy.Highs)()
    solver.setOptionValue("output_flag", False)
    for option, value in settings.items():
        if solver.setOptionValue(option, value) == highspy.HighsStatus.kError:
            raise ValueError(f"HiGHS refuses the option {option} = {value!r}")
    solver.passModel(model)
    start_time = time.perf_counter()
    solver.run()
    elapsed = time.perf_counter() - start_time
    found = solver.getSolution()
    status = solver.getModelStatus().name.removeprefix("k")
    duals = -np.asarray(found.row_dual, dtype=float) if found.row_dual else np.zeros(h.size + b.size)
    x = np.asarray(found.col_value, dtype=float) if found.value_valid else None
    box = -np.asarray(found.col_dual, dtype=float) if found.col_dual else np.zeros(n)
    info = solver.getInfo()
    iterations = max(int(info.qp_iteration_count), 0) + max(int(info.simplex_iteration_count), 0)
    return RawResult(
        status, status == "Optimal", x, duals[h.size :], duals[: h.size], box, iterations, elapsed
    )


def solve_with_cvxopt(
    backend: str, form: QpForm, settings: Mapping[str, Any], start: Solution | None
) -> RawResult:
    """CVXOPT itself: with P singular and equalities alone, its default factorisation calls a wrong answer optimal."""
    cvxopt: Any = import_module("cvxopt")
    solvers: Any = import_module("cvxopt.solvers")

    def convert(part: sp.csc_matrix | FloatArray | None) -> Any:
        if part is None:
            return None
        if isinstance(part, np.ndarray):
            return cvxopt.matrix(part)
        entries = part.tocoo()
        return cvxopt.spmatrix(
            entries.data.tolist(), entries.row.tolist(), entries.col.tolist(), size=entries.shape
        )

    parts = [convert(part) for part in (form.P, form.q, form.G, form.h, form.A, form.b)]
    options = {"show_progress": False, **settings}
    start_time = time.perf_counter()
    found = solvers.qp(*parts, kktsolver="ldl" if form.G is None else None, options=options)
    elapsed = time.perf_counter() - start_time
    x, y, z = (None if found[key] is None else np.array(found[key]).ravel() for key in "xyz")
    raw = str(found["status"])
    return RawResult(raw, raw == "optimal", x, y, z, None, int(found.get("iterations", 0)), elapsed)


OneShot = Callable[[str, QpForm, Mapping[str, Any], Solution | None], RawResult]

ONE_SHOT: Mapping[str, OneShot] = {
    "cvxopt": solve_with_cvxopt,
    "daqp": solve_with_daqp,
    "highs": solve_with_highs,
}
"""Backends that we call ourselves; every other one goes through :func:`solve_with_qpsolvers`."""

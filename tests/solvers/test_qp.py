"""Every QP backend against an enumeration of active sets, on what can go right and on what can go wrong."""

from __future__ import annotations

from itertools import combinations
from operator import attrgetter

import numpy as np
import pytest
import scipy.sparse as sp

from factorgrasp.errors import InputError, SolverError
from factorgrasp.least_squares import Constraint, LeastSquares, QuadraticProgram, Term
from factorgrasp.solvers.base import Solution, SolverOptions
from factorgrasp.solvers.qp import MODULES, WARM_STARTED, QpSession, solve_qp, solver_class
from factorgrasp.solvers.qp_cached import CACHED
from factorgrasp.solvers.qp_form import make_form
from factorgrasp.solvers.qp_options import ROUNDING, backend_settings, ignored_options
from factorgrasp.solvers.qp_status import STATUS_MAP, read_status
from factorgrasp.solvers.registry import QPSOLVERS_BACKENDS, get_solver, solver_table
from factorgrasp.status import Status
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable

TESTED = ("clarabel", "cvxopt", "daqp", "ecos", "highs", "osqp", "piqp", "proxqp", "qpalm", "quadprog", "scs")
DEFINITE_ONLY = ("ecos", "quadprog")
# An SOCP solver sees the objective through a cone: half of the digits of its tolerance arrive at x.
ACCURACY = {"ecos": 1e-4}
INFINITY = np.inf


@pytest.fixture(params=TESTED)
def backend(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    if not solver_class(name).installed():
        pytest.skip(f"{name} is not installed: pip install {solver_class(name).pip}")
    return name


def program(
    P: np.ndarray,
    q: np.ndarray,
    G: np.ndarray | None = None,
    h: np.ndarray | None = None,
    A: np.ndarray | None = None,
    b: np.ndarray | None = None,
    lb: np.ndarray | None = None,
    ub: np.ndarray | None = None,
) -> QuadraticProgram:
    return QuadraticProgram(
        sp.csc_array(P),
        q,
        None if G is None else sp.csc_array(G),
        h,
        None if A is None else sp.csc_array(A),
        b,
        lb,
        ub,
        0.0,
    )


def random_program(
    seed: int, *, equalities: int = 0, inequalities: int = 0, bounds: bool = False
) -> QuadraticProgram:
    rng = np.random.default_rng(seed)
    n = 4
    root = rng.normal(size=(6, n))
    G = rng.normal(size=(inequalities, n)) if inequalities else None
    A = rng.normal(size=(equalities, n)) if equalities else None
    inside = 0.1 * rng.normal(size=n)
    return program(
        root.T @ root,
        3.0 * rng.normal(size=n),
        G,
        None if G is None else G @ inside + 0.1,
        A,
        None if A is None else A @ inside,
        np.array([-INFINITY, inside[1] - 0.1, inside[2] - 0.2, -INFINITY]) if bounds else None,
        np.array([inside[0] + 0.1, INFINITY, inside[2] + 0.1, INFINITY]) if bounds else None,
    )


def enumerate_active_sets(qp: QuadraticProgram) -> tuple[np.ndarray, float]:
    """Optimum of a strictly convex QP: the KKT point among all sets of active constraints."""
    n = qp.q.size
    P = qp.P.toarray()
    rows, sides = [np.zeros((0, n))], [np.zeros(0)]
    if qp.G is not None and qp.h is not None:
        finite = np.isfinite(qp.h)
        rows.append(qp.G.toarray()[finite])
        sides.append(qp.h[finite])
    for bound, sign in ((qp.ub, 1.0), (qp.lb, -1.0)):
        if bound is not None:
            finite = np.isfinite(bound)
            rows.append(sign * np.eye(n)[finite])
            sides.append(sign * bound[finite])
    C, d = np.vstack(rows), np.concatenate(sides)
    E = np.zeros((0, n)) if qp.A is None else qp.A.toarray()
    e = np.zeros(0) if qp.b is None else qp.b
    for count in range(n - E.shape[0] + 1):
        for chosen in combinations(range(d.size), count):
            active = list(chosen)
            K = np.vstack([E, C[active]])
            m = K.shape[0]
            if np.linalg.matrix_rank(K) < m:
                continue
            kkt = np.block([[P, K.T], [K, np.zeros((m, m))]])
            solution = np.linalg.solve(kkt, np.concatenate([-qp.q, e, d[active]]))
            x, multipliers = solution[:n], solution[n + E.shape[0] :]
            if np.all(C @ x <= d + 1e-10) and np.all(multipliers >= -1e-10):
                return x, 0.5 * float(x @ P @ x) + float(qp.q @ x)
    raise AssertionError("no KKT point: the test problem is infeasible")


def check_optimal(qp: QuadraticProgram, found: Solution, accuracy: float) -> None:
    """The KKT conditions with our signs of the multipliers."""
    gradient = qp.P @ found.x + qp.q
    if qp.G is not None and qp.h is not None:
        slack = np.where(np.isfinite(qp.h), qp.h - qp.G @ found.x, 1.0)
        assert found.z.shape == qp.h.shape
        assert np.all(slack >= -accuracy)
        assert np.all(found.z >= -accuracy)
        assert np.abs(found.z * np.minimum(slack, 1.0)).max() < accuracy
        gradient = gradient + qp.G.T @ found.z
    if qp.A is not None and qp.b is not None:
        assert np.abs(qp.A @ found.x - qp.b).max() < accuracy
        gradient = gradient + qp.A.T @ found.y
    if qp.lb is not None and qp.ub is not None:
        assert found.z_box.shape == found.x.shape
        to_upper, to_lower = np.minimum(qp.ub - found.x, 1.0), np.minimum(found.x - qp.lb, 1.0)
        assert min(to_upper.min(), to_lower.min()) > -accuracy
        assert np.abs(np.maximum(found.z_box, 0.0) * to_upper).max() < accuracy
        assert np.abs(np.maximum(-found.z_box, 0.0) * to_lower).max() < accuracy
        gradient = gradient + found.z_box
    assert np.abs(gradient).max() < accuracy


@pytest.mark.parametrize(
    "parts",
    [
        {},
        {"equalities": 1},
        {"inequalities": 3},
        {"bounds": True},
        {"equalities": 1, "inequalities": 3, "bounds": True},
    ],
    ids=["free", "equality", "inequality", "bounds", "all"],
)
def test_optimum_and_multipliers(backend: str, parts: dict[str, int]) -> None:
    accuracy = ACCURACY.get(backend, 1e-7)
    bound_once = False
    for seed in range(3):
        qp = random_program(seed, **parts)
        found = solve_qp(qp, backend, SolverOptions(tolerance=1e-9))
        x, objective = enumerate_active_sets(qp)
        # ECOS may call 1e-9 reached with reduced accuracy only: an honest word, not a failure.
        assert found.status is Status.SOLVED or (backend == "ecos" and found.status is Status.NOT_CONVERGED)
        np.testing.assert_allclose(found.x, x, atol=accuracy)
        assert 0.5 * found.x @ (qp.P @ found.x) + qp.q @ found.x == pytest.approx(
            objective, abs=10.0 * accuracy
        )
        check_optimal(qp, found, 10.0 * accuracy)
        assert found.setup_time > 0.0
        assert found.solve_time > 0.0
        bound_once |= bool(np.any(np.abs(found.z) > 1e-3) or np.any(np.abs(found.z_box) > 1e-3))
    # The problems are such that some constraint is active: else its multiplier would go unseen.
    assert bound_once == bool(set(parts) - {"equalities"})


def test_rows_and_bounds_at_infinity_are_no_constraints(backend: str) -> None:
    qp = random_program(1, equalities=1, inequalities=3, bounds=True)
    assert qp.h is not None
    open_row = qp._replace(h=np.array([qp.h[0], INFINITY, qp.h[2]]))
    found = solve_qp(open_row, backend, SolverOptions(tolerance=1e-9))
    np.testing.assert_allclose(found.x, enumerate_active_sets(open_row)[0], atol=ACCURACY.get(backend, 1e-7))
    assert found.z.shape == (3,)
    assert found.z[1] == 0.0


def test_infeasible_is_said(backend: str) -> None:
    first = np.eye(4)[:1]
    inconsistent = random_program(0)._replace(
        G=sp.csc_array(np.vstack([first, -first])), h=np.array([-1.0, -1.0])
    )
    status = solve_qp(inconsistent, backend).status
    if (
        backend == "cvxopt"
    ):  # has no certificate of infeasibility: it breaks down, and may not call the problem solved
        assert status in (Status.NUMERICAL_ERROR, Status.NOT_CONVERGED)
    else:
        assert status is Status.INFEASIBLE


def test_unbounded_is_never_solved(backend: str) -> None:
    # x_3 is free to grow: no curvature, no constraint, negative slope.
    qp = program(np.diag([1.0, 1.0, 0.0]), np.array([1.0, 0.0, -1.0]), np.eye(3)[:1], np.ones(1))
    found = solve_qp(qp, backend)
    if backend in ("clarabel", "daqp", "osqp", "piqp", "proxqp", "qpalm", "scs"):
        assert found.status is Status.UNBOUNDED
    else:  # refuses a singular P before it can see more
        assert found.status is Status.NUMERICAL_ERROR


def test_semidefinite_cost(backend: str) -> None:
    qp = program(np.diag([1.0, 1.0, 0.0]), np.array([1.0, 0.0, -1.0]), np.eye(3)[2:], np.ones(1))
    found = solve_qp(qp, backend, SolverOptions(tolerance=1e-9))
    if backend in DEFINITE_ONLY:
        assert found.status is Status.NUMERICAL_ERROR
        assert "positive definite" in found.message
        assert "nothing was added" in found.message
        assert np.all(np.isnan(found.x))
    else:
        assert found.status is Status.SOLVED
        np.testing.assert_allclose(found.x, [-1.0, 0.0, 1.0], atol=1e-6)


@pytest.mark.parametrize("name", ["clarabel", "cvxopt", "ecos", "osqp", "piqp", "proxqp", "qpalm", "scs"])
def test_iteration_limit_keeps_the_iterate(name: str) -> None:
    if not solver_class(name).installed():
        pytest.skip(f"{name} is not installed")
    qp = random_program(2, equalities=1, inequalities=3, bounds=True)
    found = solve_qp(qp, name, SolverOptions(tolerance=1e-9, max_iterations=2))
    assert found.status is Status.NOT_CONVERGED
    assert found.iterations <= 2
    assert np.all(np.isfinite(found.x))


def test_backend_exception_becomes_a_status(monkeypatch: pytest.MonkeyPatch) -> None:
    import osqp

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("the solver fell over")

    monkeypatch.setattr(osqp.OSQP, "solve", broken)
    found = solve_qp(random_program(0), "osqp")
    assert found.status is Status.NUMERICAL_ERROR
    assert "fell over" in found.message
    assert found.x.shape == (4,)
    assert np.all(np.isnan(found.x))


def test_not_finite_answer_is_not_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    import osqp

    original = osqp.OSQP.solve

    def poisoned(self: object, **keywords: object) -> object:
        found = original(self, **keywords)
        found.x = np.full(4, np.nan)
        return found

    monkeypatch.setattr(osqp.OSQP, "solve", poisoned)
    assert solve_qp(random_program(0), "osqp").status is Status.NUMERICAL_ERROR


@pytest.mark.parametrize("name", sorted(WARM_STARTED))
def test_warm_start_saves_iterations(name: str) -> None:
    if not solver_class(name).installed():
        pytest.skip(f"{name} is not installed")
    qp = random_program(1, equalities=1, inequalities=3, bounds=True)
    options = SolverOptions(tolerance=1e-9)
    cold = solve_qp(qp, name, options)
    warm = solve_qp(qp, name, options, warm_start=cold)
    assert warm.status is Status.SOLVED
    assert warm.iterations < cold.iterations
    np.testing.assert_allclose(warm.x, cold.x, atol=1e-8)


def chain(count: int = 6, size: int = 3) -> LeastSquares:
    variables = [Variable(f"x{i}", size) for i in range(count)]
    terms = [Term(f"prior{i}", size, (f"x{i}",), Covariance.scalar(4.0)) for i in range(count)]
    terms += [
        Term(f"link{i}", size, (f"x{i}", f"x{i + 1}"), Covariance.diagonal(np.full(size, 0.01)))
        for i in range(count - 1)
    ]
    constraints = [Constraint("tie", 1, ("x0", "x1")), Constraint("limit", 2, ("x2", "x4"), "inequality")]
    return LeastSquares(variables, terms, constraints)


def fill(problem: LeastSquares, seed: int, zeros: bool = False) -> None:
    rng = np.random.default_rng(seed)
    size = problem.variables[0].size
    for name, term in problem.terms.items():
        blocks = {
            v: np.eye(size) if name.startswith("prior") else rng.normal(size=(size, size))
            for v in term.variables
        }
        if zeros and name == "link2":  # entries of the Hessian vanish
            blocks = {v: np.diag(np.diag(block)) for v, block in blocks.items()}
        problem.set_term(name, blocks, rng.normal(size=term.rows))
    for name, constraint in problem.constraints.items():
        blocks = {v: rng.normal(size=(constraint.rows, size)) for v in constraint.variables}
        problem.set_constraint(name, blocks, rng.normal(size=constraint.rows) - (name == "limit"))
    problem.set_bounds("x3", -0.1, 0.2 if seed % 2 else INFINITY)


@pytest.mark.parametrize("name", sorted(CACHED))
def test_cached_setup_gives_the_same_as_a_fresh_one(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if not solver_class(name).installed():
        pytest.skip(f"{name} is not installed")
    builds = []
    original = CACHED[name].build
    monkeypatch.setattr(CACHED[name], "build", lambda self, form: (builds.append(1), original(self, form))[1])
    options = SolverOptions(tolerance=1e-10)
    problem = chain()
    kept = get_solver(name, options)
    kept.setup(problem)
    last: Solution | None = None
    # Same pattern of bounds in 0, 2, 4; another in 1.
    for seed, zeros in ((0, False), (2, False), (4, True), (2, False), (1, False)):
        fill(problem, seed, zeros)
        again = kept.solve(warm_start=last)
        made = len(builds)
        fresh = solve_qp(problem.quadratic_program(), name, options)
        del builds[made:]
        assert again.status is fresh.status is Status.SOLVED
        np.testing.assert_allclose(again.x, fresh.x, atol=1e-7)
        np.testing.assert_allclose(again.y, fresh.y, atol=1e-4)
        np.testing.assert_allclose(again.z, fresh.z, atol=1e-4)
        np.testing.assert_allclose(again.z_box, fresh.z_box, atol=1e-4)
        last = again
    # One set-up for the first four fillings, although an entry of P vanished in one; a new bound needs a second
    # where bounds are part of the pattern.
    assert len(builds) == 2


def test_row_weights_scale_the_rows(backend: str) -> None:
    problem = chain()
    fill(problem, 0)
    weights = np.linspace(0.5, 1.5, problem.jacobian.height)
    solver = get_solver(backend, SolverOptions(tolerance=1e-9))
    solver.setup(problem)
    plain, weighted = solver.solve(), solver.solve(row_weights=weights)
    reference = solve_qp(problem.quadratic_program(weights), "osqp", SolverOptions(tolerance=1e-10))
    np.testing.assert_allclose(weighted.x, reference.x, atol=ACCURACY.get(backend, 1e-6))
    assert np.abs(weighted.x - plain.x).max() > 1e-3


def test_hessian_is_widened_to_the_expected_pattern() -> None:
    qp = random_program(0)
    sparse = qp._replace(P=sp.csc_array(np.diag(np.diag(qp.P.toarray()))))
    session = QpSession("osqp", SolverOptions(tolerance=1e-10))
    session.expect(sp.csc_array(np.ones((4, 4))))
    first, second = session.solve(sparse), session.solve(qp)
    np.testing.assert_allclose(first.x, -sparse.q / sparse.P.diagonal(), atol=1e-8)
    np.testing.assert_allclose(second.x, np.linalg.solve(qp.P.toarray(), -qp.q), atol=1e-8)


def test_unexpected_entries_start_anew() -> None:
    qp = random_program(0)
    session = QpSession("osqp", SolverOptions(tolerance=1e-10))
    session.expect(sp.csc_array(np.eye(4)))
    np.testing.assert_allclose(session.solve(qp).x, np.linalg.solve(qp.P.toarray(), -qp.q), atol=1e-8)


def test_multipliers_go_there_and_back() -> None:
    qp = random_program(1, inequalities=3, bounds=True)
    assert qp.h is not None
    form = make_form(qp._replace(h=np.array([qp.h[0], INFINITY, qp.h[2]])), fold_bounds=True)
    assert form.G is not None
    assert form.G.shape == (2 + 2 + 2, 4)
    start = Solution(
        np.zeros(4), Status.SOLVED, z=np.array([1.0, 0.0, 3.0]), z_box=np.array([2.0, -4.0, 5.0, 0.0])
    )
    _, z, box = form.forward(start)
    np.testing.assert_array_equal(z, [1.0, 3.0, 2.0, 5.0, 4.0, 0.0])
    back, back_box = form.back(z, np.zeros(4))
    np.testing.assert_array_equal(back, start.z)
    np.testing.assert_array_equal(back_box, start.z_box)
    np.testing.assert_array_equal(box, start.z_box)


@pytest.mark.parametrize("name", sorted(STATUS_MAP))
def test_status_map_knows_solved_and_maps_to_ours(name: str) -> None:
    statuses = STATUS_MAP[name]
    assert sum(status is Status.SOLVED for status in statuses.values()) == 1
    for word, status in statuses.items():
        assert read_status(name, word) is status
        lower = word.lower()
        if "almost" in lower or "inaccurate" in lower or "max" in lower or "limit" in lower:
            assert status is not Status.SOLVED


@pytest.mark.parametrize(
    ("module", "enumeration", "name", "strip"),
    [
        ("osqp", "SolverStatus", "osqp", ""),
        ("piqp", "Status", "piqp", ""),
        ("proxsuite", "proxqp.QPSolverOutput", "proxqp", ""),
        ("highspy", "HighsModelStatus", "highs", "k"),
    ],
)
def test_status_map_covers_all_that_the_backend_can_say(
    module: str, enumeration: str, name: str, strip: str
) -> None:
    package = pytest.importorskip(module)
    kind = attrgetter(enumeration)(package)
    words = {word.removeprefix(strip) for word in getattr(kind, "__members__", {})}
    assert words
    assert words <= set(STATUS_MAP[name])


@pytest.mark.parametrize(
    ("word", "found", "status"),
    [
        ("OPTIMAL", True, Status.SOLVED),
        ("PRIMAL_INFEASIBLE", False, Status.INFEASIBLE),
        ("dual infeasible", False, Status.UNBOUNDED),
        ("unbounded", None, Status.UNBOUNDED),
        ("what?", False, Status.NOT_CONVERGED),
    ],
)
def test_status_of_an_unknown_backend(word: str, found: bool | None, status: Status) -> None:
    assert read_status("somebody", word, found) is status


def test_one_tolerance_reaches_every_backend() -> None:
    for name in TESTED:
        settings = backend_settings(name, SolverOptions(tolerance=1e-6))
        absolute = [value for key, value in settings.items() if value == 1e-6]
        assert absolute or name == "quadprog"
        relative = [value for key, value in settings.items() if "rel" in key]
        assert all(value == ROUNDING for value in relative)
    assert backend_settings("osqp", SolverOptions(extra={"eps_abs": 0.5}))["eps_abs"] == 0.5
    assert backend_settings("osqp", SolverOptions(max_iterations=7, time_limit=2.0))["max_iter"] == 7
    assert backend_settings("highs", SolverOptions(tolerance=1e-12))["primal_feasibility_tolerance"] == 1e-10


def test_limits_that_a_backend_has_not_are_said() -> None:
    assert "time limit" in ignored_options("piqp", SolverOptions(time_limit=1.0))
    assert ignored_options("osqp", SolverOptions(time_limit=1.0, max_iterations=5)) == ""
    found = solve_qp(random_program(0), "osqp", SolverOptions(tolerance=1e-6, time_limit=5.0))
    assert "note" not in found.message


@pytest.mark.parametrize("name", ["piqp", "clarabel"])
def test_unknown_option_is_bad_input(name: str) -> None:
    if not solver_class(name).installed():
        pytest.skip(f"{name} is not installed")
    with pytest.raises(InputError, match="no_such_option"):
        solve_qp(random_program(0), name, SolverOptions(extra={"no_such_option": 1}))


def test_unknown_and_missing_backends() -> None:
    with pytest.raises(SolverError, match="unknown QP backend 'nonsense'"):
        solve_qp(random_program(0), "nonsense")
    missing = [name for name in MODULES if not solver_class(name).installed()]
    for name in missing:
        with pytest.raises(SolverError, match="pip install"):
            solve_qp(random_program(0), name)
        with pytest.raises(SolverError, match="pip install"):
            get_solver(name)


def test_registry_lists_every_backend_of_qpsolvers() -> None:
    import qpsolvers

    assert set(qpsolvers.available_solvers) <= set(MODULES)
    assert set(MODULES) == set(QPSOLVERS_BACKENDS)
    rows = {row.name: row for row in solver_table()}
    for name in MODULES:
        assert rows[name].capabilities.inequalities
        assert rows[name].pip.startswith("pip install qpsolvers")
    assert rows["osqp"].installed


def test_solution_of_a_failed_setup_does_not_poison_the_next() -> None:
    session = QpSession("osqp")
    bad = random_program(0)
    broken = bad._replace(P=sp.csc_array(-np.eye(4)))
    assert session.solve(broken).status is not Status.SOLVED
    found = session.solve(bad)
    assert found.status is Status.SOLVED
    np.testing.assert_allclose(found.x, np.linalg.solve(bad.P.toarray(), -bad.q), atol=1e-6)

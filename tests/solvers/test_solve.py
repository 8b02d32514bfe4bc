"""The front door: the choice of a solver, what it refuses, and what every estimate carries; and the registry behind it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from factorgrasp.errors import InputError, SolverError
from factorgrasp.estimate import Estimate
from factorgrasp.least_squares import Constraint, LeastSquares, Term
from factorgrasp.losses import Huber
from factorgrasp.observability import default_words
from factorgrasp.solvers import registry
from factorgrasp.solvers.base import Solver
from factorgrasp.solvers.cholesky import Cholesky
from factorgrasp.solvers.solve import default_solver, solve
from factorgrasp.status import Status
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable


def make(rng: np.random.Generator, equality: bool = False, inequality: bool = False) -> LeastSquares:
    constraints = [Constraint("sum", 1, ("x",))] if equality else []
    constraints += [Constraint("cap", 2, ("x",), "inequality", unit="N")] if inequality else []
    problem = LeastSquares(
        [Variable("x", 3, unit="m", resolution=10.0)], [Term("rows", 6, ("x",))], constraints
    )
    problem.set_term("rows", {"x": rng.normal(size=(6, 3))}, rng.normal(size=6))
    if equality:
        problem.set_constraint("sum", {"x": np.ones((1, 3))}, 1.0)
    if inequality:
        problem.set_constraint("cap", {"x": np.eye(3)[:2]}, -0.2)
    return problem


class Simple:
    """A linear problem with a typed view."""

    kind = "simple"

    def __init__(self, system: LeastSquares) -> None:
        self.system = system

    def least_squares(self) -> LeastSquares:
        return self.system

    def view(self, estimate: Estimate) -> Any:
        return {"estimate": estimate, "first": float(estimate.values["x"][0])}


# ---- the registry -----------------------------------------------------------------------------------------------


def test_every_registered_solver_loads_and_declares_itself() -> None:
    table = registry.solver_table()
    assert [row.name for row in table] == registry.solver_names()
    for row in table:
        kind = registry.solver_class(row.name)
        assert issubclass(kind, Solver)
        assert kind.name == row.name
        assert kind.modules
        assert row.pip.startswith("pip install ")
    assert {"cholesky", "kkt", "gtsam", "osqp"} <= set(registry.solver_names(installed_only=True))


def test_an_unknown_solver_lists_the_known_ones() -> None:
    with pytest.raises(
        SolverError, match=r"unknown solver 'chol'. Installed: cholesky, kkt.*pip install"
    ) as caught:
        registry.get_solver("chol")
    assert "osqp" in str(caught.value)


def test_a_missing_solver_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Cholesky, "modules", ("no_such_module",))
    with pytest.raises(
        SolverError, match=r"'cholesky' is not installed: pip install qdldl\. Installed: .*gtsam"
    ):
        registry.get_solver("cholesky")


def test_a_backend_is_added_with_one_line(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    monkeypatch.setitem(registry.SOLVERS, "again", "factorgrasp.solvers.kkt:Kkt")
    assert solve(make(rng), "again").status is Status.SOLVED


# ---- the choice -------------------------------------------------------------------------------------------------


def test_default_solvers(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    assert solve(make(rng)).solver == "cholesky"
    assert solve(make(rng, equality=True)).solver == "kkt"
    limited = make(rng, inequality=True)
    assert solve(limited).solver in registry.QP_PREFERENCE
    first = default_solver(limited)
    kind = registry.solver_class(first)
    monkeypatch.setattr(kind, "modules", ("no_such_module",))
    assert default_solver(limited) != first
    for name in registry.QP_PREFERENCE:
        monkeypatch.setattr(registry.solver_class(name), "modules", ("no_such_module",))
    with pytest.raises(SolverError, match="pip install qpsolvers piqp"):
        default_solver(limited)


def test_solvers_that_cannot_take_a_problem_are_refused(rng: np.random.Generator) -> None:
    with pytest.raises(SolverError, match="cholesky takes no equality constraints; 'kkt' does"):
        solve(make(rng, equality=True), "cholesky")
    with pytest.raises(SolverError, match="kkt takes no inequalities"):
        solve(make(rng, inequality=True), "kkt")


def test_what_is_not_a_problem_is_refused() -> None:
    with pytest.raises(InputError, match="problem: expected a LeastSquares"):
        solve(np.eye(3))  # type: ignore[arg-type]


def test_a_solver_object_serves_many_problems(rng: np.random.Generator) -> None:
    solver = Cholesky()
    problem = make(rng)
    first = solve(problem, solver)
    before = first.covariance()
    problem.set_term("rows", {"x": 2.0 * problem.jacobian.matrix.toarray()}, 0.0)
    second = solve(problem, solver)
    np.testing.assert_allclose(second.values["x"], 0.0, atol=1e-12)
    np.testing.assert_allclose(second.covariance(), 0.25 * before, rtol=1e-9)
    np.testing.assert_allclose(first.covariance(), before, rtol=1e-12)


def test_the_problem_makes_its_view(rng: np.random.Generator) -> None:
    system = make(rng)
    view = solve(Simple(system))
    assert view["first"] == solve(system).values["x"][0]
    assert view["estimate"].kind == "simple"


# ---- what an estimate carries -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cholesky", "kkt", "gtsam", "osqp", "piqp", "clarabel", "quadprog"])
def test_all_solvers_bring_the_same_estimate(name: str, rng: np.random.Generator) -> None:
    if not registry.solver_class(name).installed():
        pytest.skip(f"{name} is not installed")
    problem = make(rng)
    estimate, reference = solve(problem, name), solve(problem)
    assert estimate.status is Status.SOLVED
    np.testing.assert_allclose(estimate.values["x"], reference.values["x"], atol=1e-6)
    np.testing.assert_allclose(estimate.covariance(), reference.covariance(), rtol=1e-9)
    assert estimate.problem_hash == reference.problem_hash
    assert estimate.certificate is not None
    assert estimate.certificate.within(1e-6)
    assert {"setup", "solve", "total"} <= set(estimate.timing)
    assert estimate.timing["total"] >= estimate.timing["solve"] > 0.0
    assert {"factorgrasp", "python", "numpy"} <= set(estimate.versions)


def test_term_summaries_leave_gaps_out(rng: np.random.Generator) -> None:
    term = Term("rows", 6, ("x",), Covariance.scalar(0.25), Huber(1.0), group=2)
    problem = LeastSquares([Variable("x", 1)], [term, Term("prior", 1, ("x",), Covariance.scalar(1e12))])
    A, b = np.ones((6, 1)), np.array([1.0, 1.0, 0.0, 0.0, 9.0, 1.0])
    A[2:4] = 0.0
    problem.set_term("rows", {"x": A}, b)
    problem.set_term("prior", {"x": [[1.0]]}, [0.0])
    estimate = solve(problem)
    rows = estimate.residuals[0]
    residual = 2.0 * (estimate.values["x"][0] - b[[0, 1, 4, 5]])
    assert rows.rows == 4
    assert rows.chi2 == pytest.approx(residual @ residual)
    assert rows.rms == pytest.approx(np.sqrt(residual @ residual / 4.0))
    assert rows.worst == pytest.approx(np.linalg.norm(residual[2:]))
    assert rows.down_weighted == pytest.approx(0.5)


def test_weak_directions_make_it_unobservable_in_the_problems_own_words(rng: np.random.Generator) -> None:
    class Spoken(Simple):
        def view(self, estimate: Estimate) -> Estimate:
            return estimate

        def describe_direction(self, variable: Variable, vector: np.ndarray) -> str:
            return f"lever arm along {'xyz'[int(np.argmax(np.abs(vector)))]}"

        @property
        def advice(self) -> str:
            return "rotate about another axis"

    system = LeastSquares([Variable("arm", 3, unit="m", resolution=0.05)], [Term("rows", 3, ("arm",))])
    system.set_term("rows", {"arm": np.diag([100.0, 1.0, 100.0])}, [1.0, 2.0, 3.0])
    estimate = solve(Spoken(system))
    assert estimate.status is Status.UNOBSERVABLE
    assert "lever arm along y (sd 1 m, needed 0.05 m)" in estimate.message
    assert "along x" not in estimate.message
    assert estimate.message.endswith("rotate about another axis")
    np.testing.assert_allclose(estimate.values["arm"], [0.01, 2.0, 0.03])
    system.set_term("rows", {"arm": np.diag([100.0, 0.0, 100.0])}, [1.0, 2.0, 3.0])
    estimate = solve(Spoken(system))
    assert estimate.message.startswith("the data do not inform lever arm along y")
    np.testing.assert_allclose(estimate.sd("arm"), [0.01, np.nan, 0.01])
    assert default_words(system.variables[0], np.array([0.0, 1.0, 0.0])) == "arm along +1.00 arm[1]"


def test_infeasible_constraints_are_named_with_their_unit(rng: np.random.Generator) -> None:
    problem = make(rng, equality=True, inequality=True)
    problem.set_constraint("sum", {}, 5.0)
    problem.set_bounds("x", -1.0, 1.0)
    for name in ("piqp", "clarabel"):
        estimate = solve(problem, name)
        assert estimate.status is Status.INFEASIBLE, name
        assert estimate.covariance_source is None


def test_multipliers_are_named(rng: np.random.Generator) -> None:
    problem = make(rng, equality=True, inequality=True)
    problem.set_bounds("x", -5.0, 5.0)
    estimate = solve(problem)
    assert set(estimate.multipliers) == {"sum", "cap", "bounds of x"}
    x = estimate.values["x"]
    matrix, rhs = problem.whitened()
    gradient = matrix.T @ (matrix @ x - rhs)
    balance = gradient + estimate.multipliers["sum"][0] + np.eye(3)[:2].T @ estimate.multipliers["cap"]
    np.testing.assert_allclose(balance + estimate.multipliers["bounds of x"], 0.0, atol=1e-6)


def test_not_finite_input_is_an_error_before_any_solver_runs(rng: np.random.Generator) -> None:
    problem = make(rng)
    problem.set_term("rows", {}, np.full(6, np.nan))
    for name in ("cholesky", "osqp", "gtsam"):
        with pytest.raises(InputError, match="term rows"):
            solve(problem, name)

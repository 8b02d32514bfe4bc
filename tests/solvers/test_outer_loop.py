"""Re-weighting and Gauss-Newton against scipy's optimisers, closed forms and Monte Carlo; hooks, limits and failures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

from factorgrasp import lie
from factorgrasp.estimate import Estimate
from factorgrasp.least_squares import Constraint, LeastSquares, Term
from factorgrasp.losses import Cauchy, GemanMcClure, Huber, Loss
from factorgrasp.solvers.damping import Damped
from factorgrasp.solvers.gauss_newton import GaussNewton
from factorgrasp.solvers.outer_loop import LoopOptions, solve_linear, solve_nonlinear
from factorgrasp.solvers.registry import get_solver
from factorgrasp.solvers.solve import solve
from factorgrasp.status import Status
from factorgrasp.uncertainty import Covariance, nees, nees_band
from factorgrasp.variables import Variable

Function = Callable[[np.ndarray], np.ndarray]


class Curve:
    """``residual(x)`` with its Jacobian, and constraints ``equal(x) = 0``, ``below(x) <= 0``, for tests."""

    kind = "curve"

    def __init__(
        self,
        start: np.ndarray,
        residual: Function,
        jacobian: Function,
        loss: Loss | None = None,
        equal: tuple[Function, Function] | None = None,
        below: tuple[Function, Function] | None = None,
        bounds: tuple[float, float] | None = None,
        variance: float = 1.0,
    ) -> None:
        self.start, self.residual, self.jacobian = np.asarray(start, dtype=float), residual, jacobian
        self.equal, self.below, self.bounds = equal, below, bounds
        size, rows = self.start.size, residual(self.start).size
        constraints = [Constraint("equal", equal[0](self.start).size, ("x",))] if equal else []
        constraints += [Constraint("below", below[0](self.start).size, ("x",), "inequality")] if below else []
        term = Term("curve", rows, ("x",), Covariance.scalar(variance), loss, group=1)
        self.system = LeastSquares([Variable("x", size)], [term], constraints)

    def initial_state(self) -> dict[str, np.ndarray]:
        return {"x": self.start}

    def linearize(self, state: Any) -> LeastSquares:
        x = state["x"]
        self.system.set_term("curve", {"x": self.jacobian(x)}, -self.residual(x))
        for name, pair in (("equal", self.equal), ("below", self.below)):
            if pair:
                self.system.set_constraint(name, {"x": pair[1](x)}, -pair[0](x))
        if self.bounds:
            self.system.set_bounds("x", self.bounds[0] - x, self.bounds[1] - x)
        return self.system

    def retract(self, state: Any, step: np.ndarray) -> dict[str, np.ndarray]:
        return {"x": state["x"] + step}

    def view(self, estimate: Estimate) -> Estimate:
        return estimate


class MeanRotation:
    """Rotation that several measured ones scatter about."""

    kind = "mean_rotation"

    def __init__(self, measured: np.ndarray, covariance: np.ndarray, start: np.ndarray | None = None) -> None:
        self.measured, self.start = measured, np.eye(3) if start is None else start
        term = Term("rotations", 3 * len(measured), ("rotation",), Covariance.blocks(covariance), group=3)
        self.system = LeastSquares([Variable("rotation", 3, "rotation", unit="rad", resolution=0.1)], [term])

    def initial_state(self) -> dict[str, np.ndarray]:
        return {"rotation": self.start}

    def linearize(self, state: Any) -> LeastSquares:
        error = lie.so3_log(np.swapaxes(self.measured, 1, 2) @ state["rotation"])
        jacobian = np.linalg.inv(lie.so3_right_jacobian(error))
        self.system.set_term("rotations", {"rotation": jacobian.reshape(-1, 3)}, -error.ravel())
        return self.system

    def retract(self, state: Any, step: np.ndarray) -> dict[str, np.ndarray]:
        return {"rotation": state["rotation"] @ lie.so3_exp(step)}

    def view(self, estimate: Estimate) -> Estimate:
        return estimate


def rosenbrock(start: tuple[float, float] = (-1.2, 1.0), **more: Any) -> Curve:
    return Curve(
        np.array(start),
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
        **more,
    )


# ---- robust losses ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("loss", "name"), [(Huber(1.3), "huber"), (Cauchy(1.1), "cauchy")])
def test_robust_line_fit_matches_scipy(loss: Loss, name: str, rng: np.random.Generator) -> None:
    t = np.linspace(0.0, 1.0, 80)
    A = np.column_stack([t, np.ones_like(t)])
    b = A @ [2.0, -1.0] + 0.1 * rng.normal(size=80)
    b[::9] += rng.normal(2.0, 1.0, size=b[::9].size)
    problem = LeastSquares(
        [Variable("line", 2)], [Term("points", 80, ("line",), Covariance.scalar(0.01), loss, group=1)]
    )
    problem.set_term("points", {"line": A}, b)
    theirs = least_squares(
        lambda x: (A @ x - b) / 0.1,
        lstsq(A, b),
        loss=name,
        f_scale=loss.scale,
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-12,
    )
    estimate = solve(problem)
    assert estimate.status is Status.SOLVED
    np.testing.assert_allclose(estimate.values["line"], theirs.x, atol=1e-6)
    assert estimate.objective == pytest.approx(theirs.cost, rel=1e-9)
    assert estimate.residuals[0].down_weighted > 0.05


def lstsq(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(A, b, rcond=None)[0]


def test_a_bounded_loss_ignores_gross_outliers(rng: np.random.Generator) -> None:
    A = rng.normal(size=(60, 3))
    truth = np.array([1.0, -2.0, 0.5])
    b = A @ truth + 0.01 * rng.normal(size=60)
    b[:6] += 0.4
    term = Term("rows", 60, ("x",), Covariance.scalar(1e-4), GemanMcClure(), group=1)
    problem = LeastSquares([Variable("x", 3)], [term])
    problem.set_term("rows", {"x": A}, b)
    clean = lstsq(A[6:], b[6:])
    np.testing.assert_allclose(solve(problem).values["x"], clean, atol=1e-3)
    assert np.abs(lstsq(A, b) - clean).max() > 0.01


def test_robust_fit_under_inequalities_matches_scipy(rng: np.random.Generator) -> None:
    A, b = rng.normal(size=(40, 3)), 2.0 * rng.normal(size=40)
    problem = LeastSquares([Variable("x", 3)], [Term("rows", 40, ("x",), loss=Huber(1.0), group=1)])
    problem.set_term("rows", {"x": A}, b)
    problem.set_bounds("x", -0.1, 0.1)
    theirs = least_squares(
        lambda x: A @ x - b, np.zeros(3), bounds=(-0.1, 0.1), loss="huber", xtol=1e-15, ftol=1e-15
    )
    np.testing.assert_allclose(solve(problem).values["x"], theirs.x, atol=1e-6)


def test_unsettled_weights_are_said(rng: np.random.Generator) -> None:
    problem = LeastSquares([Variable("x", 1)], [Term("rows", 30, ("x",), loss=Huber(0.1), group=1)])
    problem.set_term("rows", {"x": np.ones((30, 1))}, rng.standard_cauchy(30))
    result = solve_linear(problem, get_solver("cholesky"), LoopOptions(max_iterations=2))
    assert result.status is Status.NOT_CONVERGED
    assert "robust weights" in result.message
    assert np.isfinite(result.solution.x).all()


# ---- nonlinear --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["cholesky", "kkt", "gtsam", "piqp"])
def test_rosenbrock(solver: str) -> None:
    estimate = solve(rosenbrock(), solver)
    assert estimate.status is Status.SOLVED
    np.testing.assert_allclose(estimate.values["x"], [1.0, 1.0], atol=1e-8)


def test_a_full_step_that_overshoots_is_shortened() -> None:
    """Gauss-Newton on ``atan`` diverges from beyond 1.39; the line search brings it home."""
    curve = Curve(np.array([4.0]), np.arctan, lambda x: np.diag(1.0 / (1.0 + x**2)))
    estimate = solve(curve)
    assert estimate.status is Status.SOLVED
    assert abs(estimate.values["x"][0]) < 1e-8


def test_exponential_fit_matches_scipy(rng: np.random.Generator) -> None:
    t = np.linspace(0.0, 3.0, 40)
    y = 2.0 * np.exp(-1.3 * t) + 0.3 + 0.02 * rng.normal(size=40)

    def residual(x: np.ndarray) -> np.ndarray:
        return x[0] * np.exp(-x[1] * t) + x[2] - y

    def jacobian(x: np.ndarray) -> np.ndarray:
        decay = np.exp(-x[1] * t)
        return np.column_stack([decay, -x[0] * t * decay, np.ones_like(t)])

    start = np.array([1.0, 0.2, 0.0])
    theirs = least_squares(residual, start, jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    estimate = solve(Curve(start, residual, jacobian, variance=4e-4))
    np.testing.assert_allclose(estimate.values["x"], theirs.x, atol=1e-8)
    expected = 4e-4 * np.linalg.inv(jacobian(theirs.x).T @ jacobian(theirs.x))
    np.testing.assert_allclose(estimate.covariance("x"), expected, rtol=1e-5)


def test_robust_nonlinear_fit_matches_scipy(rng: np.random.Generator) -> None:
    t = np.linspace(0.0, 3.0, 60)
    y = 2.0 * np.exp(-1.3 * t) + 0.05 * rng.normal(size=60)
    y[::7] += 1.0

    def residual(x: np.ndarray) -> np.ndarray:
        return x[0] * np.exp(-x[1] * t) - y

    def jacobian(x: np.ndarray) -> np.ndarray:
        return np.column_stack([np.exp(-x[1] * t), -x[0] * t * np.exp(-x[1] * t)])

    start = np.array([1.5, 1.0])
    theirs = least_squares(
        lambda x: residual(x) / 0.05, start, loss="cauchy", f_scale=1.5, xtol=1e-15, ftol=1e-15, gtol=1e-12
    )
    estimate = solve(Curve(start, residual, jacobian, loss=Cauchy(1.5), variance=0.0025))
    assert estimate.status is Status.SOLVED
    np.testing.assert_allclose(estimate.values["x"], theirs.x, atol=1e-6)


@pytest.mark.parametrize("solver", [None, "kkt", "gtsam-levenberg-marquardt"])
def test_mean_rotation_is_a_stationary_point(solver: str | None, rng: np.random.Generator) -> None:
    truth = lie.so3_exp(np.array([1.5, -0.8, 0.6]))
    measured = truth @ lie.so3_exp(0.2 * rng.normal(size=(50, 3)))
    estimate = solve(MeanRotation(measured, 0.04 * np.eye(3)), solver)
    assert estimate.status is Status.SOLVED
    # The Karcher mean: the mean of the logarithms at it is zero.
    logs = lie.so3_log(estimate.values["rotation"].T @ measured)
    np.testing.assert_allclose(logs.mean(axis=0), 0.0, atol=1e-7)


def test_mean_rotation_is_consistent(rng: np.random.Generator) -> None:
    truth = lie.so3_exp(np.array([0.4, -1.2, 2.0]))
    root = np.diag([0.02, 0.05, 0.1])
    errors = []
    for _ in range(80):
        measured = truth @ lie.so3_exp(rng.normal(size=(8, 3)) @ root)
        estimate = solve(MeanRotation(measured, root @ root))
        error = lie.so3_log(truth.T @ estimate.values["rotation"])
        errors.append(nees(error, estimate.covariance("rotation")) / 3.0)
    low, high = nees_band(3, 80)
    assert low < np.mean(errors) < high


# ---- constraints ------------------------------------------------------------------------------------------------


def test_nonlinear_equality_matches_scipy() -> None:
    """Closest point of an ellipse."""
    target = np.array([3.0, 2.0])

    def ring(x: np.ndarray) -> np.ndarray:
        return np.array([x[0] ** 2 / 4.0 + x[1] ** 2 - 1.0])

    theirs = minimize(
        lambda x: 0.5 * np.sum((x - target) ** 2),
        [1.0, 1.0],
        constraints={"type": "eq", "fun": ring},
        tol=1e-14,
    )
    curve = Curve(
        np.array([1.0, 1.0]), lambda x: x - target, lambda x: np.eye(2),
        equal=(ring, lambda x: np.array([[x[0] / 2.0, 2.0 * x[1]]])),
    )  # fmt: skip
    estimate = solve(curve)
    assert estimate.solver == "kkt"
    assert estimate.status is Status.SOLVED
    np.testing.assert_allclose(estimate.values["x"], theirs.x, atol=1e-5)
    assert abs(ring(estimate.values["x"])[0]) < 1e-7
    # What is left of the covariance lies along the tangent.
    tangent = np.array([-2.0 * estimate.values["x"][1], estimate.values["x"][0] / 2.0])
    tangent /= np.linalg.norm(tangent)
    np.testing.assert_allclose(estimate.covariance("x"), np.outer(tangent, tangent), atol=1e-6)


@pytest.mark.parametrize("solver", ["piqp", "quadprog", "clarabel"])
def test_nonlinear_inequalities_match_scipy(solver: str) -> None:
    """Rosenbrock inside a disc and a box: the optimum lies on the disc."""

    def disc(x: np.ndarray) -> np.ndarray:
        return np.array([x @ x - 0.5])

    theirs = minimize(
        lambda x: 0.5 * (100.0 * (x[1] - x[0] ** 2) ** 2 + (1.0 - x[0]) ** 2),
        [-0.3, 0.3],
        bounds=[(-0.6, 0.6)] * 2,
        constraints={"type": "ineq", "fun": lambda x: -disc(x)[0]},
        tol=1e-14,
        options={"maxiter": 500},
    )
    estimate = solve(
        rosenbrock((-0.3, 0.3), below=(disc, lambda x: 2.0 * x[None]), bounds=(-0.6, 0.6)), solver
    )
    assert estimate.status is Status.SOLVED
    np.testing.assert_allclose(estimate.values["x"], theirs.x, atol=1e-5)
    assert estimate.certificate is not None
    assert estimate.certificate.within(1e-4)


def test_infeasible_linearisation_names_the_constraint() -> None:
    curve = Curve(
        np.array([0.0]), lambda x: x, lambda x: np.eye(1),
        equal=(lambda x: x - 3.0, lambda x: np.eye(1)), bounds=(-1.0, 1.0),
    )  # fmt: skip
    estimate = solve(curve)
    assert estimate.status is Status.INFEASIBLE
    assert "equal" in estimate.message
    assert estimate.covariance_source is None


# ---- limits and failures ----------------------------------------------------------------------------------------


def test_an_iteration_limit_keeps_the_iterate() -> None:
    estimate = solve(rosenbrock(), loop=LoopOptions(max_iterations=1))
    assert estimate.status is Status.NOT_CONVERGED
    assert "standard deviations" in estimate.message
    assert np.isfinite(estimate.values["x"]).all()
    assert np.linalg.norm(estimate.values["x"] - [-1.2, 1.0]) > 1e-6


def test_a_wrong_jacobian_is_a_stall_not_a_solution() -> None:
    curve = Curve(np.array([2.0, 1.0]), lambda x: x, lambda x: -np.eye(2))
    estimate = solve(curve)
    assert estimate.status is Status.NOT_CONVERGED
    assert "stalled" in estimate.message


def test_a_direction_without_information_is_left_alone_and_named() -> None:
    curve = Curve(
        np.array([2.0, 5.0]), lambda x: np.array([x[0] ** 2 - 1.0]), lambda x: np.array([[2.0 * x[0], 0.0]])
    )
    for solver in ("cholesky", "gtsam", "piqp"):
        estimate = solve(curve, solver)
        assert estimate.status is Status.UNOBSERVABLE, solver
        assert "x[1]" in estimate.message
        assert estimate.values["x"][0] == pytest.approx(1.0, abs=1e-7)
        assert estimate.values["x"][1] == pytest.approx(5.0, abs=1e-3)


def test_a_start_that_is_singular_only_at_first() -> None:
    """``x^2 = 1`` from zero, where the slope vanishes, beside a well-informed unknown."""
    curve = Curve(
        np.array([0.0, 0.0]), lambda x: np.array([x[0] ** 2 - 1.0, x[1] - 2.0 - x[0], x[0] - 0.5 * x[1]]),
        lambda x: np.array([[2.0 * x[0], 0.0], [-1.0, 1.0], [1.0, -0.5]]),
    )  # fmt: skip
    estimate = solve(curve)
    x = estimate.values["x"]
    assert estimate.status is Status.SOLVED
    np.testing.assert_allclose(curve.jacobian(x).T @ curve.residual(x), 0.0, atol=1e-6)
    assert abs(x[0]) > 0.5


def test_damping_adds_its_rows_and_nothing_else(rng: np.random.Generator) -> None:
    problem = LeastSquares(
        [Variable("a", 2), Variable("b", 3)],
        [Term("t", 6, ("a", "b"), Covariance.blocks(np.diag([1.0, 2.0, 3.0]))), Term("p", 2, ("a",))],
        [Constraint("c", 1, ("b",))],
    )
    problem.set_term("t", {"a": rng.normal(size=(6, 2)), "b": rng.normal(size=(6, 3))}, rng.normal(size=6))
    problem.set_term("p", {"a": np.eye(2)}, 1.0)
    problem.set_constraint("c", {"b": np.ones((1, 3))}, 2.0)
    problem.set_bounds("a", -1.0, 1.0)
    damped = Damped(problem)
    weights = damped.fill(problem, 0.5, rng.uniform(0.5, 1.0, 8))
    assert weights is not None
    plain, vector = problem.normal_equations(weights[:8])
    information, damped_vector = damped.problem.normal_equations(weights)
    np.testing.assert_allclose(
        information.toarray(), plain.toarray() + 0.5 * np.diag(plain.diagonal()), atol=1e-12
    )
    np.testing.assert_allclose(damped_vector, vector, atol=1e-12)
    np.testing.assert_array_equal(damped.problem.lower, problem.lower)
    np.testing.assert_array_equal(
        damped.problem.equalities.matrix.toarray(), problem.equalities.matrix.toarray()
    )


def test_levenberg_marquardt_from_the_start_reaches_the_same_optimum() -> None:
    estimate = solve(rosenbrock(), loop=LoopOptions(damping=1e-2))
    assert estimate.status is Status.SOLVED
    np.testing.assert_allclose(estimate.values["x"], [1.0, 1.0], atol=1e-7)


# ---- what a problem may ask for ---------------------------------------------------------------------------------


class Refining(Curve):
    """Estimates the offset of a clock step by step: every refinement moves the target half of the way to 1."""

    def __init__(self, target: float, rest: int) -> None:
        super().__init__(np.array([0.0]), lambda x: x - target, lambda x: np.eye(1))
        self.target, self.rest = target, rest

    def refine(self, state: Any) -> Refining | None:
        if self.rest == 0:
            return None
        return Refining(0.5 * (self.target + 1.0), self.rest - 1)


def test_refinement_poses_the_problem_afresh_until_it_settles() -> None:
    estimate = solve(Refining(0.0, 3))
    assert estimate.status is Status.SOLVED
    assert estimate.values["x"][0] == pytest.approx(0.875)
    endless = solve(Refining(0.0, 100))
    assert endless.status is Status.NOT_CONVERGED
    assert f"{LoopOptions().max_refinements} refinements" in endless.message


class Escaping(Curve):
    """``(x^2 - 1)^2 + slope``: two valleys, of which the left one is deeper."""

    def __init__(self, offers: list[float]) -> None:
        super().__init__(
            np.array([1.5]),
            lambda x: np.array([x[0] ** 2 - 1.0, 0.2 * (x[0] + 1.0)]),
            lambda x: np.array([[2.0 * x[0]], [0.2]]),
        )
        self.offers = offers

    def escape(self, state: Any) -> dict[str, np.ndarray] | None:
        return {"x": np.array([self.offers.pop(0)])} if self.offers else None


def test_escape_is_taken_when_it_leads_lower() -> None:
    assert solve(Escaping([])).values["x"][0] > 0.9
    assert solve(Escaping([-2.0])).values["x"][0] == pytest.approx(-1.0, abs=1e-7)
    # An offer that leads nowhere better changes nothing, neither the values nor what is reported of them.
    plain, offered = solve(Escaping([])), solve(Escaping([3.0]))
    np.testing.assert_allclose(offered.values["x"], plain.values["x"], atol=1e-7)
    assert offered.objective == pytest.approx(plain.objective)
    assert offered.iterations > plain.iterations


def test_sandwich_covariance(rng: np.random.Generator) -> None:
    A = rng.normal(size=(10, 2))
    meat = np.array([[2.0, 0.3], [0.3, 1.0]])

    class Scored(Curve):
        def score_covariance(self, state: Any) -> np.ndarray:
            return meat

    estimate = solve(Scored(np.zeros(2), lambda x: A @ x - 1.0, lambda x: A))
    inverse = np.linalg.inv(A.T @ A)
    np.testing.assert_allclose(estimate.covariance("x"), inverse @ meat @ inverse, rtol=1e-9)


def test_a_given_start_is_used() -> None:
    result = solve_nonlinear(Escaping([]), GaussNewton(get_solver("cholesky")), {"x": np.array([-3.0])})
    assert result.state is not None
    assert result.state["x"][0] == pytest.approx(-1.0, abs=1e-7)
    steps = [line.step for line in result.log]
    assert steps[-1] < 1e-6 < steps[0]
    assert all(a.objective >= b.objective - 1e-12 for a, b in zip(result.log, result.log[1:], strict=False))

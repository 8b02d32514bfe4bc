"""gtsam against dense algebra and against a Gauss-Newton of a few lines, on linear and on nonlinear problems."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.errors import InputError, SolverError
from factorgrasp.gtsam_nonlinear_view import NonlinearView, robust_estimator
from factorgrasp.gtsam_view import GaussianView, Keys, gaussian_factor_graph, split_rows
from factorgrasp.least_squares import Constraint, LeastSquares, Term
from factorgrasp.losses import Cauchy, GemanMcClure, Huber, Loss
from factorgrasp.solvers.base import Solver, SolverOptions
from factorgrasp.solvers.gtsam_linear import GtsamElimination
from factorgrasp.solvers.gtsam_nonlinear import (
    GtsamGaussNewton,
    GtsamIsam2,
    GtsamLevenbergMarquardt,
    increments,
)
from factorgrasp.solvers.registry import get_solver
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, State
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable, retract

gtsam = pytest.importorskip("gtsam")

NONLINEAR = (GtsamGaussNewton, GtsamLevenbergMarquardt, GtsamIsam2)


def random_problem(seed: int, *, constrained: bool = False, count: int = 12) -> LeastSquares:
    """Terms on one to five variables, with partial patterns and covariances over eight decades."""
    rng = np.random.default_rng(seed)
    variables = [Variable(f"x{i}", int(rng.integers(1, 6))) for i in range(count)]
    sizes = {v.name: v.size for v in variables}
    terms = [
        Term(f"prior{i}", v.size, (v.name,), Covariance.scalar(10.0 ** rng.uniform(-4, 4)))
        for i, v in enumerate(variables)
    ]
    for k in range(2 * count):
        chosen = [variables[j] for j in rng.choice(count, int(rng.integers(1, 6)), replace=False)]
        rows = 2 * int(rng.integers(1, 4))
        pattern = {v.name: rng.random((rows, v.size)) < 0.6 for v in chosen}
        covariance = Covariance.blocks(np.array([[0.02, 0.01], [0.01, 0.03]]))
        terms.append(Term(f"t{k}", rows, tuple(v.name for v in chosen), covariance, pattern=pattern))
    constraints = [Constraint("tie", 2, ("x0", "x1", "x2", "x3"))] if constrained else []
    problem = LeastSquares(variables, terms, constraints)
    refill(problem, sizes, seed)
    return problem


def refill(problem: LeastSquares, sizes: dict[str, int], seed: int) -> None:
    rng = np.random.default_rng(1000 + seed)
    for term in problem.terms.values():
        blocks = {v: rng.normal(size=(term.rows, sizes[v])) for v in term.variables}
        problem.set_term(term.name, blocks, rng.normal(size=term.rows))
    for c in problem.constraints.values():
        problem.set_constraint(
            c.name, {v: rng.normal(size=(c.rows, sizes[v])) for v in c.variables}, rng.normal(size=c.rows)
        )


def dense_solution(problem: LeastSquares, weights: FloatArray | None = None) -> FloatArray:
    """Orthogonal decompositions of dense matrices: null space of the equalities, then lstsq."""
    matrix, rhs = problem.whitened(weights)
    A, E = matrix.toarray(), problem.equalities.matrix.toarray()
    x, Z = np.zeros(problem.size), np.eye(problem.size)
    if E.shape[0]:
        x = np.linalg.lstsq(E, problem.equalities.rhs, rcond=None)[0]
        Z = np.linalg.svd(E)[2][E.shape[0] :].T
    return np.asarray(x + Z @ np.linalg.lstsq(A @ Z, rhs - A @ x, rcond=None)[0])


def conditional_sd(problem: LeastSquares) -> FloatArray:
    matrix, _ = problem.whitened()
    return np.asarray(1.0 / np.sqrt(matrix.power(2).sum(axis=0)))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("elimination", ["qr", "cholesky"])
def test_linear_against_dense_and_cholesky(seed: int, elimination: str) -> None:
    problem = random_problem(seed)
    solver = GtsamElimination(SolverOptions(extra={"elimination": elimination}))
    solver.setup(problem)
    found = solver.solve()
    assert found.status is Status.SOLVED
    np.testing.assert_allclose(found.x, dense_solution(problem), atol=1e-9)
    ours = get_solver("cholesky")
    ours.setup(problem)
    np.testing.assert_allclose(found.x, ours.solve().x, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_linear_with_equalities(seed: int) -> None:
    problem = random_problem(seed, constrained=True)
    solver = GtsamElimination()
    solver.setup(problem)
    found = solver.solve()
    assert found.status is Status.SOLVED
    np.testing.assert_allclose(problem.equalities.matrix @ found.x, problem.equalities.rhs, atol=1e-10)
    # Constrained elimination in gtsam does not pivot between variables: a few digits may go.
    error = (found.x - dense_solution(problem)) / conditional_sd(problem)
    assert np.abs(error).max() < 1e-6
    matrix, rhs = problem.whitened()
    stationarity = matrix.T @ (matrix @ found.x - rhs) + problem.equalities.matrix.T @ found.y
    assert np.abs(stationarity * conditional_sd(problem)).max() < 1e-5


def test_new_values_and_weights_with_the_cached_cut() -> None:
    problem = random_problem(0)
    solver = GtsamElimination()
    solver.setup(problem)
    solver.solve()
    view = solver._view
    refill(problem, {v.name: v.size for v in problem.variables}, 5)
    weights = np.linspace(0.3, 1.0, problem.jacobian.height)
    solver.setup(problem)
    np.testing.assert_allclose(solver.solve(weights).x, dense_solution(problem, weights), atol=1e-9)
    assert solver._view is view
    other = random_problem(1)
    solver.setup(other)
    np.testing.assert_allclose(solver.solve().x, dense_solution(other), atol=1e-9)
    assert solver._view is not view


@pytest.mark.parametrize("elimination", ["qr", "cholesky"])
def test_what_is_not_informed_is_named(elimination: str) -> None:
    variables = [Variable("position", 3), Variable("gyro_bias", 2)]
    problem = LeastSquares(
        variables, [Term("fix", 3, ("position",)), Term("rate", 3, ("position", "gyro_bias"))]
    )
    problem.set_term("fix", {"position": np.eye(3)}, np.ones(3))
    # Both bias components act alike: their difference is seen by nothing.
    problem.set_term("rate", {"position": np.eye(3), "gyro_bias": np.ones((3, 2)) / 3.0}, np.zeros(3))
    solver = GtsamElimination(SolverOptions(extra={"elimination": elimination}))
    solver.setup(problem)
    found = solver.solve()
    assert found.status is Status.UNOBSERVABLE
    assert "gyro_bias" in found.message
    assert np.all(np.isnan(found.x))


def test_variable_without_any_row_is_named() -> None:
    problem = LeastSquares([Variable("a", 1), Variable("idle", 2)], [Term("fix", 1, ("a",))])
    problem.set_term("fix", {"a": [[1.0]]}, [2.0])
    solver = GtsamElimination()
    solver.setup(problem)
    found = solver.solve()
    assert found.status is Status.UNOBSERVABLE
    assert "idle" in found.message


def test_badly_scaled_is_solved_by_qr() -> None:
    problem = LeastSquares(
        [Variable("a", 2), Variable("b", 1)], [Term("exact", 3, ("a", "b")), Term("loose", 1, ("b",))]
    )
    problem.set_term(
        "exact", {"a": [[1e6, 0.0], [0.0, 1.0], [1e6, 1e6]], "b": [[0.0], [0.0], [1e6]]}, [1e6, 1.0, 3e6]
    )
    problem.set_term("loose", {"b": [[1e-3]]}, [1e-3])
    solver = GtsamElimination()
    solver.setup(problem)
    found = solver.solve()
    assert found.status is Status.SOLVED
    np.testing.assert_allclose(found.x, [1.0, 1.0, 1.0], atol=1e-9)


def test_contradictory_equalities_are_infeasible() -> None:
    problem = LeastSquares([Variable("a", 2)], [Term("prior", 2, ("a",))], [Constraint("twice", 2, ("a",))])
    problem.set_term("prior", {"a": np.eye(2)}, np.zeros(2))
    problem.set_constraint("twice", {"a": [[1.0, 0.0], [1.0, 0.0]]}, [1.0, 2.0])
    solver = GtsamElimination()
    solver.setup(problem)
    assert solver.solve().status is Status.INFEASIBLE


def test_inequalities_are_refused() -> None:
    problem = random_problem(0)
    problem.set_bounds("x1", -1.0, 1.0)
    with pytest.raises(SolverError, match="inequalities"):
        GtsamElimination().setup(problem)
    with pytest.raises(InputError, match="elimination"):
        GtsamElimination(SolverOptions(extra={"elimination": "magic"})).setup(random_problem(0))


def test_rows_are_cut_into_the_smallest_factors() -> None:
    problem = random_problem(2)
    parts = split_rows(problem.jacobian, problem.variables)
    rows = np.concatenate([part.rows for part in parts])
    matrix = problem.jacobian.matrix
    assert np.array_equal(np.sort(rows), np.flatnonzero(np.diff(matrix.indptr)))
    rebuilt = np.zeros(matrix.shape)
    for part in parts:
        for variable, block in zip(part.variables, part.blocks(matrix.data), strict=True):
            rebuilt[part.rows, problem.columns[variable.name]] = block
    np.testing.assert_array_equal(rebuilt, matrix.toarray())


def test_keys_are_readable_and_unique() -> None:
    keys = Keys.of(["gyro_bias", "R", "pose12", "pose_12", "position", "7", "gyro_bias2"])
    assert keys.key["pose12"] == gtsam.symbol("p", 12)
    assert keys.key["gyro_bias"] == gtsam.symbol("g", 0)
    assert len(keys.name) == 7
    assert all(keys.name[key] == name for name, key in keys.key.items())
    assert "g0  gyro_bias" in keys.table()


def test_graph_error_is_the_objective() -> None:
    problem = random_problem(3, constrained=True)
    graph, keys = gaussian_factor_graph(problem)
    x = dense_solution(problem)
    values = gtsam.VectorValues()
    for variable in problem.variables:
        values.insert(keys.key[variable.name], x[problem.columns[variable.name]])
    assert graph.error(values) == pytest.approx(problem.objective(x), rel=1e-9)
    np.testing.assert_array_equal(GaussianView(problem).vector(values), x)


@pytest.mark.parametrize("loss", [Huber(), Cauchy(), GemanMcClure(2.0)])
def test_gtsam_losses_are_ours(loss: Loss) -> None:
    estimator = robust_estimator(loss)
    for s in (0.1, 1.0, 2.5, 7.0):
        assert estimator.weight(s) == pytest.approx(float(loss.weight(np.array(s))), rel=1e-12)
        assert estimator.loss(s) == pytest.approx(float(loss.rho(np.array(s))), rel=1e-12)


class Chain:
    """Poses in a row with relative measurements, positions seen, directions seen through an unknown mounting and a bias."""

    kind = "chain"

    def __init__(
        self, count: int = 4, loss: Loss | None = None, tie: bool = False, absolute: bool = True
    ) -> None:
        rng = np.random.default_rng(7)
        self.count, self.tie, self.absolute = count, tie, absolute
        poses = [f"pose{i}" for i in range(count)]
        self.variables = [Variable(p, 6, "pose") for p in poses] + [
            Variable("mount", 3, "rotation"),
            Variable("bias", 3),
        ]
        truth = [np.eye(4)]
        for _ in range(count - 1):
            truth.append(truth[-1] @ lie.se3_exp(0.5 * rng.normal(size=6)))
        self.relative = [
            np.linalg.inv(a) @ b @ lie.se3_exp(0.01 * rng.normal(size=6)) for a, b in pairwise(truth)
        ]
        self.directions = rng.normal(size=(count, 3))
        mount, self.bias = lie.so3_exp([0.3, -0.2, 0.5]), np.array([0.1, 0.2, -0.1])
        self.seen = np.array([t[:3, :3] @ mount @ d for t, d in zip(truth, self.directions, strict=True)])
        self.seen += self.bias + 0.02 * rng.normal(size=(count, 3))
        self.positions = np.array([t[:3, 3] for t in truth]) + 0.02 * rng.normal(size=(count, 3))
        if loss is not None:
            self.positions[1] += 0.7
        blocks = np.broadcast_to(1e-4 * np.eye(6) + 2e-5, (count - 1, 6, 6))
        terms = [
            Term(
                "relative",
                6 * (count - 1),
                tuple(poses),
                Covariance.blocks(blocks),
                pattern=self._pattern(6, 2),
            )
        ]
        if absolute:
            noise, pattern = Covariance.scalar(4e-4), self._pattern(3, 1)
            terms.append(Term("position", 3 * count, tuple(poses), noise, loss, 3, pattern))
            terms.append(Term("direction", 3 * count, (*poses, "mount", "bias"), noise, loss, 3, pattern))
        constraints = [Constraint("known", 3, ("bias",))] if tie else []
        self.system = LeastSquares(self.variables, terms, constraints)

    def _pattern(self, height: int, reach: int) -> dict[str, np.ndarray]:
        out = {}
        for i in range(self.count):
            rows = np.zeros((self.count - reach + 1, height, 6), dtype=bool)
            rows[max(i - reach + 1, 0) : i + 1] = True
            out[f"pose{i}"] = rows.reshape(-1, 6)
        return out

    def initial_state(self) -> State:
        state = {"pose0": np.eye(4), "mount": np.eye(3), "bias": np.zeros(3)}
        for i, step in enumerate(self.relative):
            state[f"pose{i + 1}"] = state[f"pose{i}"] @ step
        return state

    def retract(self, state: State, step: FloatArray) -> State:
        return retract(self.variables, state, step)

    def linearize(self, state: State) -> LeastSquares:
        n, system = self.count, self.system
        J = {f"pose{i}": np.zeros((6 * (n - 1), 6)) for i in range(n)}
        r = np.zeros(6 * (n - 1))
        h = 1e-6 * np.vstack([np.eye(6), -np.eye(6)])
        for i, measured in enumerate(self.relative):
            a, b = state[f"pose{i}"], state[f"pose{i + 1}"]
            at, back = slice(6 * i, 6 * i + 6), np.linalg.inv(measured)
            r[at] = lie.se3_log(back @ np.linalg.inv(a) @ b)
            left = lie.se3_log(back @ lie.se3_exp(-h) @ np.linalg.inv(a) @ b)
            right = lie.se3_log(back @ np.linalg.inv(a) @ b @ lie.se3_exp(h))
            J[f"pose{i}"][at] = (left[:6] - left[6:]).T / 2e-6
            J[f"pose{i + 1}"][at] = (right[:6] - right[6:]).T / 2e-6
        system.set_term("relative", J, -r)
        if self.absolute:
            position = {f"pose{i}": np.zeros((3 * n, 6)) for i in range(n)}
            direction: dict[str, np.ndarray] = {f"pose{i}": np.zeros((3 * n, 6)) for i in range(n)}
            direction |= {"mount": np.zeros((3 * n, 3)), "bias": np.tile(np.eye(3), (n, 1))}
            r_position, r_direction = np.zeros(3 * n), np.zeros(3 * n)
            for i in range(n):
                at, R, t = slice(3 * i, 3 * i + 3), state[f"pose{i}"][:3, :3], state[f"pose{i}"][:3, 3]
                turned = state["mount"] @ self.directions[i]
                r_position[at], position[f"pose{i}"][at, :3] = t - self.positions[i], R
                r_direction[at] = R @ turned + state["bias"] - self.seen[i]
                direction[f"pose{i}"][at, 3:] = -R @ lie.skew(turned)
                direction["mount"][at] = -R @ state["mount"] @ lie.skew(self.directions[i])
            system.set_term("position", position, -r_position)
            system.set_term("direction", direction, -r_direction)
        if self.tie:
            system.set_constraint("known", {"bias": np.eye(3)}, self.bias - state["bias"])
        return system

    def view(self, estimate: Any) -> Any:
        return estimate


def reference(problem: Chain, iterations: int = 40) -> tuple[State, float]:
    """Dense re-weighted Gauss-Newton with a saddle-point system."""
    state = problem.initial_state()
    for _ in range(iterations):
        system = problem.linearize(state)
        matrix, rhs = system.whitened(system.robust_weights(system.residuals(np.zeros(system.size))))
        A, E = matrix.toarray(), system.equalities.matrix.toarray()
        kkt = np.block([[A.T @ A, E.T], [E, np.zeros((E.shape[0], E.shape[0]))]])
        step = np.linalg.solve(kkt, np.concatenate([A.T @ rhs, system.equalities.rhs]))
        state = problem.retract(state, step[: system.size])
    return state, problem.linearize(state).objective(np.zeros(system.size))


@pytest.mark.parametrize("kind", NONLINEAR)
@pytest.mark.parametrize(
    "settings",
    [{}, {"tie": True}, {"loss": Huber()}, {"loss": GemanMcClure()}],
    ids=["plain", "equality", "huber", "geman_mcclure"],
)
def test_nonlinear_against_dense_gauss_newton(kind: type[GtsamGaussNewton], settings: dict[str, Any]) -> None:
    problem = Chain(**settings)
    state, objective = reference(problem)
    found = kind(SolverOptions(tolerance=1e-8)).solve_problem(problem)
    assert found.status is Status.SOLVED, found.message
    for variable in problem.variables:
        difference = variable.local(state[variable.name], found.state[variable.name])
        np.testing.assert_allclose(difference, 0.0, atol=1e-7)
    # gtsam's own objective, robust noise models included, is ours.
    assert found.errors_log[-1] == pytest.approx(objective, rel=1e-9)
    assert found.iterations >= 2
    assert found.solve_time > 0.0


@pytest.mark.parametrize("kind", NONLINEAR)
def test_nonlinear_names_what_is_not_informed(kind: type[GtsamGaussNewton]) -> None:
    found = kind().solve_problem(Chain(absolute=False))
    assert found.status is Status.UNOBSERVABLE
    assert "pose" in found.message or "mount" in found.message or "bias" in found.message
    assert np.all(np.isfinite(found.state["pose1"]))


def test_iteration_limit_is_said_and_the_iterate_kept() -> None:
    problem = Chain()
    found = GtsamLevenbergMarquardt(SolverOptions(max_iterations=1)).solve_problem(problem)
    assert found.status is Status.NOT_CONVERGED
    assert found.iterations == 1
    assert len(found.errors_log) == 2
    assert found.errors_log[1] < found.errors_log[0]
    again = GtsamGaussNewton().solve_problem(problem, found.state)
    assert again.status is Status.SOLVED
    assert again.errors_log[0] == pytest.approx(found.errors_log[1], rel=1e-9)


def test_isam2_is_fed_in_increments_that_hold_the_whole_graph() -> None:
    view = NonlinearView(Chain(6), Chain(6).initial_state())
    parts = increments(view, 5)
    assert len(parts) > 1
    assert sum(graph.size() for graph, _ in parts) == view.graph.size()
    assert sum(values.size() for _, values in parts) == view.values.size()


def test_isam2_begins_again_with_the_whole_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    original, fed = GtsamIsam2._feed, []

    def feed(self: GtsamIsam2, view: NonlinearView, run: Any, parts: list[Any]) -> Any:
        fed.append(len(parts))
        values = original(self, view, run, parts)
        if len(parts) > 1:
            run.end(Status.NOT_CONVERGED, "led away")
        return values

    monkeypatch.setattr(GtsamIsam2, "_feed", feed)
    found = GtsamIsam2(SolverOptions(extra={"increments": 3})).solve_problem(Chain())
    assert found.status is Status.SOLVED
    assert "fed whole" in found.message
    assert fed[0] > 1
    assert fed[1:] == [1]


def test_custom_factor_jacobians_against_gtsam_differences() -> None:
    problem = Chain()
    view = NonlinearView(problem, problem.initial_state())
    assert view.keys is not None
    ordering = gtsam.Ordering()
    for variable in problem.variables:
        ordering.push_back(view.keys.key[variable.name])
    analytic, _ = view.graph.linearize(view.values).jacobian(ordering)
    h, column = 1e-6, 0
    for variable in problem.variables:
        for axis in range(variable.size):
            sides = []
            for sign in (1.0, -1.0):
                step = gtsam.VectorValues()
                for other in problem.variables:
                    part = np.zeros(other.size)
                    if other is variable:
                        part[axis] = sign * h
                    step.insert(view.keys.key[other.name], part)
                sides.append(-view.graph.linearize(view.values.retract(step)).jacobian(ordering)[1])
            numeric = (sides[0] - sides[1]) / (2.0 * h)
            np.testing.assert_allclose(
                analytic[:, column], numeric, atol=1e-5 * max(1.0, np.abs(numeric).max())
            )
            column += 1
    assert column == analytic.shape[1]


class Squeezed(Chain):
    """Moves its bias in another way than adding."""

    def retract(self, state: State, step: FloatArray) -> State:
        return {**super().retract(state, step), "bias": state["bias"] + 2.0 * step[-3:]}


def test_other_manifolds_are_refused() -> None:
    with pytest.raises(SolverError, match=r"bias.*factor_graph"):
        GtsamGaussNewton().solve_problem(Squeezed())


class Bounded(Chain):
    def linearize(self, state: State) -> LeastSquares:
        system = super().linearize(state)
        system.set_bounds("bias", -1.0, 1.0)
        return system


def test_nonlinear_inequalities_are_refused() -> None:
    with pytest.raises(SolverError, match="inequalities"):
        GtsamGaussNewton().solve_problem(Bounded())


class Native:
    """Two rotations by gtsam's own factors."""

    kind = "native"

    def initial_state(self) -> State:
        return {"a": np.eye(3), "b": np.eye(3)}

    def linearize(self, state: State) -> LeastSquares:
        raise AssertionError("a native graph needs no linearisation of ours")

    def retract(self, state: State, step: FloatArray) -> State:
        raise AssertionError("a native graph moves by itself")

    def view(self, estimate: Any) -> Any:
        return estimate

    def factor_graph(self, state: State) -> Any:
        graph = gtsam.NonlinearFactorGraph()
        noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
        graph.addPriorRot3(1, gtsam.Rot3.Expmap(np.array([0.1, 0.2, 0.3])), noise)
        graph.push_back(gtsam.BetweenFactorRot3(1, 2, gtsam.Rot3.Expmap(np.array([0.0, 0.5, 0.0])), noise))
        return graph

    def graph_values(self, state: State) -> Any:
        values = gtsam.Values()
        values.insert(1, gtsam.Rot3(state["a"]))
        values.insert(2, gtsam.Rot3(state["b"]))
        return values

    def graph_state(self, values: Any) -> State:
        return {"a": values.atRot3(1).matrix(), "b": values.atRot3(2).matrix()}


@pytest.mark.parametrize("kind", NONLINEAR)
def test_native_graph_is_taken_as_it_is(kind: type[GtsamGaussNewton]) -> None:
    found = kind().solve_problem(Native())
    assert found.status is Status.SOLVED
    first = lie.so3_exp([0.1, 0.2, 0.3])
    np.testing.assert_allclose(found.state["a"], first, atol=1e-8)
    np.testing.assert_allclose(found.state["b"], first @ lie.so3_exp([0.0, 0.5, 0.0]), atol=1e-8)


def test_error_of_the_problem_passes_through() -> None:
    class Broken(Chain):
        calls = 0

        def linearize(self, state: State) -> LeastSquares:
            Broken.calls += 1
            if Broken.calls > 2:
                raise InputError("sensor", "numbers", "none")
            return super().linearize(state)

    with pytest.raises(InputError, match="sensor"):
        GtsamGaussNewton().solve_problem(Broken())


@pytest.mark.parametrize("kind", NONLINEAR)
def test_nonlinear_solvers_take_linear_problems_too(kind: type[Solver]) -> None:
    problem = random_problem(0)
    solver = kind()
    solver.setup(problem)
    np.testing.assert_allclose(solver.solve().x, dense_solution(problem), atol=1e-9)
    assert solver.name.startswith("gtsam-")
    assert type(get_solver(solver.name)) is kind

"""The direct solvers against dense linear algebra, on well, badly and not at all determined problems, small (dense) and large (sparse)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.linalg import lstsq

from factorgrasp.errors import SolverError
from factorgrasp.least_squares import Constraint, LeastSquares, Term
from factorgrasp.solvers import kernels, linear_system, normal_equations
from factorgrasp.solvers.base import Solution
from factorgrasp.solvers.cholesky import Cholesky
from factorgrasp.solvers.dense_system import DenseSystem
from factorgrasp.solvers.kkt import Kkt
from factorgrasp.solvers.normal_equations import GramPattern
from factorgrasp.solvers.sparse_system import SparseSystem
from factorgrasp.status import Status
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable


@dataclass
class Rows:
    """``min sum (A x - b)^2 / variances  s.t.  E x = e`` with its own dense solution."""

    A: np.ndarray
    b: np.ndarray
    variances: np.ndarray
    E: np.ndarray
    e: np.ndarray

    def problem(self) -> LeastSquares:
        size = self.A.shape[1]
        constraints = (
            [Constraint("exact", len(self.e), ("x",), pattern={"x": self.E != 0.0})] if self.e.size else []
        )
        out = LeastSquares(
            [Variable("x", size)],
            [
                Term(
                    "rows",
                    len(self.b),
                    ("x",),
                    Covariance.diagonal(self.variances),
                    pattern={"x": self.A != 0.0},
                )
            ],
            constraints,
        )
        return self.fill(out)

    def fill(self, problem: LeastSquares) -> LeastSquares:
        problem.set_term("rows", {"x": self.A}, self.b)
        if self.e.size:
            problem.set_constraint("exact", {"x": self.E}, self.e)
        return problem

    def reference(self) -> tuple[np.ndarray, np.ndarray]:
        """Solution and covariance by singular values in the null space of E: no squaring, no elimination."""
        A, b = self.A / np.sqrt(self.variances)[:, None], self.b / np.sqrt(self.variances)
        Q, R = (
            np.linalg.qr(self.E.T, mode="complete") if self.e.size else (np.eye(A.shape[1]), np.empty((0, 0)))
        )
        count = self.e.size
        origin = Q[:, :count] @ np.linalg.solve(R[:count].T, self.e) if count else np.zeros(A.shape[1])
        Z = Q[:, count:]
        scale = 1.0 / np.linalg.norm(A @ Z, axis=0)
        U, values, Vt = np.linalg.svd(A @ Z * scale, full_matrices=False)
        root = (Z * scale) @ (Vt.T / values)
        return origin + root @ (U.T @ (b - A @ origin)), root @ root.T


def banded(rng: np.random.Generator, size: int, rows: int, hard: int = 0, decades: float = 0.0) -> Rows:
    """Random rows of 6 neighbouring unknowns each, variances over `decades` orders of magnitude, and a weak prior."""

    def block(count: int) -> np.ndarray:
        out = np.zeros((count, size))
        for i in range(count):
            out[i, rng.integers(0, size - 20) + rng.choice(20, 6, replace=False)] = rng.normal(size=6)
        return out

    variances = np.concatenate([10.0 ** rng.uniform(-decades / 2, decades / 2, rows), np.full(size, 1e6)])
    A = np.vstack([block(rows), np.eye(size)])
    b = A @ rng.normal(size=size) + np.sqrt(variances) * rng.normal(size=rows + size)
    return Rows(A, b, variances, block(hard), rng.normal(size=hard))


@pytest.fixture(params=["dense", "sparse"])
def method(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Force one of the two systems, whatever the size."""
    monkeypatch.setattr(linear_system, "DENSE_UP_TO", 10**6 if request.param == "dense" else 0)
    return str(request.param)


def solve(problem: LeastSquares, kind: type[Cholesky] = Kkt) -> tuple[Cholesky, Solution]:
    solver = kind()
    solver.setup(problem)
    return solver, solver.solve()


@pytest.mark.parametrize(("size", "rows"), [(30, 60), (150, 300)])
def test_random_problems_match_lstsq(method: str, size: int, rows: int, rng: np.random.Generator) -> None:
    case = banded(rng, size, rows)
    solver, solution = solve(case.problem(), Cholesky)
    root = 1.0 / np.sqrt(case.variances)
    expected = lstsq(case.A * root[:, None], case.b * root, rcond=None)[0]
    assert solution.status is Status.SOLVED
    np.testing.assert_allclose(solution.x, expected, rtol=1e-9, atol=1e-10)
    assert isinstance(solver._system.system, DenseSystem if method == "dense" else SparseSystem)


@pytest.mark.parametrize("hard", [0, 15])
def test_covariances_over_twelve_orders_of_magnitude(
    method: str, hard: int, rng: np.random.Generator
) -> None:
    for _ in range(3):
        case = banded(rng, 120, 240, hard, decades=12.0)
        _, solution = solve(case.problem())
        x, covariance = case.reference()
        sd = np.sqrt(np.diag(covariance))
        assert solution.status is Status.SOLVED
        # Every unknown to a millionth of its own standard deviation; those that the constraints fix almost exactly, to rounding.
        assert np.all(np.abs(solution.x - x) <= 1e-6 * sd + 1e-9 * np.abs(x))


def test_refinement_brings_back_what_squaring_costs(method: str, rng: np.random.Generator) -> None:
    """A long chain held by a weak anchor: the plain normal equations lose its position, refinement through A finds it again."""
    count = 100
    A = np.vstack([np.eye(count)[1:] - np.eye(count)[:-1], 1e-5 * np.eye(count)[:1]])
    truth = 1.0 + rng.normal(size=count)
    case = Rows(A, A @ truth, np.ones(count), np.empty((0, count)), np.empty(0))
    _, solution = solve(case.problem(), Cholesky)
    plain = np.linalg.solve(A.T @ A, A.T @ case.b)
    error = np.abs(solution.x - truth).max()
    assert error < 1e-8
    assert error < 1e-3 * np.abs(plain - truth).max()


def test_very_small_model_covariance_with_large_prior(rng: np.random.Generator) -> None:
    """The scales of human dynamics: model rows 1e-12, sensors 1e-8, prior 1e6."""
    size, model, sensors = 150, 110, 40
    A = np.zeros((model + sensors + size, size))
    for i in range(model):
        A[i, i : i + 8] = rng.normal(size=8)
    A[model : model + sensors] = np.eye(size)[rng.choice(size, sensors, replace=False)]
    A[model + sensors :] = np.eye(size)
    variances = np.concatenate([np.full(model, 1e-12), np.full(sensors, 1e-8), np.full(size, 1e6)])
    case = Rows(A, A @ rng.normal(size=size), variances, np.empty((0, size)), np.empty(0))
    _, solution = solve(case.problem(), Cholesky)
    x, covariance = case.reference()
    assert solution.status is Status.SOLVED
    assert np.all(np.abs(solution.x - x) <= 1e-4 * np.sqrt(np.diag(covariance)) + 1e-8 * np.abs(x).max())


def test_equalities_hold_and_multipliers_balance(method: str, rng: np.random.Generator) -> None:
    case = banded(rng, 80, 160, hard=12, decades=4.0)
    problem = case.problem()
    _, solution = solve(problem)
    np.testing.assert_allclose(case.E @ solution.x, case.e, rtol=0, atol=1e-9)
    matrix, rhs = problem.whitened()
    gradient = matrix.T @ (matrix @ solution.x - rhs)
    np.testing.assert_allclose(gradient, -case.E.T @ solution.y, atol=1e-8 * np.abs(gradient).max())


def test_repeated_constraints_are_harmless(method: str, rng: np.random.Generator) -> None:
    case = banded(rng, 50, 100, hard=5)
    twice = Rows(
        case.A,
        case.b,
        case.variances,
        np.vstack([case.E, 2.0 * case.E]),
        np.concatenate([case.e, 2.0 * case.e]),
    )
    _, solution = solve(twice.problem())
    assert solution.status is Status.SOLVED
    np.testing.assert_allclose(solution.x, case.reference()[0], atol=1e-8)


def test_contradicting_constraints_are_named(method: str, rng: np.random.Generator) -> None:
    case = banded(rng, 50, 100)
    problem = LeastSquares(
        [Variable("x", 50)],
        [Term("rows", 150, ("x",), Covariance.diagonal(case.variances), pattern={"x": case.A != 0.0})],
        [Constraint(name, 1, ("x",), pattern={"x": np.eye(50, dtype=bool)[:1]}) for name in ("here", "there")]
        + [Constraint("elsewhere", 1, ("x",), pattern={"x": np.eye(50, dtype=bool)[7:8]})],
    )
    problem.set_term("rows", {"x": case.A}, case.b)
    problem.set_constraint("here", {"x": np.eye(50)[:1]}, 1.0)
    problem.set_constraint("there", {"x": np.eye(50)[:1]}, 2.0)
    problem.set_constraint("elsewhere", {"x": np.eye(50)[7:8]}, 2.0)
    _, solution = solve(problem)
    assert solution.status is Status.INFEASIBLE
    assert "here" in solution.message or "there" in solution.message
    assert "elsewhere" not in solution.message


def test_missing_directions_are_named_and_the_rest_holds(method: str, rng: np.random.Generator) -> None:
    """Differences of a chain say nothing about its common offset, and nothing at all about an unknown that no row touches."""
    count = 40
    difference = np.zeros((count - 1, count))
    difference[np.arange(count - 1), np.arange(count - 1)] = -1.0
    difference[np.arange(count - 1), np.arange(1, count)] = 1.0
    problem = LeastSquares(
        [
            Variable("chain", count),
            Variable("bias", 2, components=("bias x", "bias y")),
            Variable("known", 1),
        ],
        [
            Term("steps", count - 1, ("chain",), pattern={"chain": difference != 0.0}),
            Term("bias", 1, ("bias",), pattern={"bias": np.array([[True, False]])}),
            Term("known", 1, ("known",), Covariance.scalar(1e-6)),
        ],
    )
    steps = rng.normal(size=count - 1)
    problem.set_term("steps", {"chain": difference}, steps)
    problem.set_term("bias", {"bias": [[2.0, 0.0]]}, [3.0])
    problem.set_term("known", {"known": [[1.0]]}, [5.0])
    solver, solution = solve(problem, Cholesky)
    assert solution.status is Status.UNOBSERVABLE
    assert "bias y" in solution.message
    assert "chain along" in solution.message
    assert "known" not in solution.message
    np.testing.assert_allclose(np.diff(solution.x[:count]), steps, atol=1e-9)
    assert abs(np.mean(solution.x[:count])) < 10.0
    assert solution.x[count] == pytest.approx(1.5)
    assert solution.x[count + 1] == pytest.approx(0.0, abs=1e-9)
    assert solution.x[-1] == pytest.approx(5.0)
    null = solver.factor().null
    assert null.count == 2
    np.testing.assert_allclose(problem.jacobian.matrix @ null.tangent, 0.0, atol=1e-9)


def test_a_weak_direction_is_not_a_missing_one(method: str, rng: np.random.Generator) -> None:
    count = 40
    A = np.vstack([np.eye(count)[1:] - np.eye(count)[:-1], 1e-6 * np.eye(count)[:1]])
    case = Rows(A, A @ np.ones(count), np.ones(count), np.empty((0, count)), np.empty(0))
    _, solution = solve(case.problem(), Cholesky)
    assert solution.status is Status.SOLVED
    np.testing.assert_allclose(solution.x, 1.0, atol=1e-6)


def test_constraints_can_inform_what_rows_do_not(method: str) -> None:
    count = 40
    A = np.eye(count)[1:] - np.eye(count)[:-1]
    case = Rows(A, np.ones(count - 1), np.ones(count - 1), np.eye(count)[3:4], np.array([3.0]))
    _, solution = solve(case.problem())
    assert solution.status is Status.SOLVED
    np.testing.assert_allclose(solution.x, np.arange(count), atol=1e-8)


def test_weak_priors_under_many_constraints(rng: np.random.Generator) -> None:
    """Exact dynamics with loose priors: the case in which a fixed regularisation of the constraints stalls refinement."""
    size, hard = 200, 140
    E = np.zeros((hard, size))
    for i in range(hard):
        E[i, i : i + 8] = rng.normal(size=8)
    measured = np.eye(size)[rng.choice(size, 60, replace=False)]
    variances = np.concatenate([np.full(60, 1e-4), np.full(size, 1e6)])
    case = Rows(
        np.vstack([measured, np.eye(size)]), rng.normal(size=260), variances, E, rng.normal(size=hard)
    )
    problem = case.problem()
    _, solution = solve(problem)
    assert solution.status is Status.SOLVED
    np.testing.assert_allclose(E @ solution.x, case.e, atol=1e-8 * max(1.0, np.abs(solution.x).max()))
    matrix, rhs = problem.whitened()
    gradient = matrix.T @ (matrix @ solution.x - rhs)
    assert np.abs(gradient + E.T @ solution.y).max() < 1e-8 * np.abs(gradient).max()


def test_new_values_reuse_the_symbolic_work(method: str, rng: np.random.Generator) -> None:
    case = banded(rng, 60, 120, hard=4)
    problem = case.problem()
    solver = Kkt()
    solver.setup(problem)
    system = solver._system
    for _ in range(3):
        case.b = rng.normal(size=case.b.size)
        case.A *= rng.uniform(0.5, 2.0, size=(case.A.shape[0], 1))
        case.fill(problem)
        solver.setup(problem)
        np.testing.assert_allclose(solver.solve().x, case.reference()[0], atol=1e-8)
    assert solver._system is system
    solver.setup(banded(rng, 60, 119, hard=4).problem())
    assert solver._system is not system


def test_row_weights(method: str, rng: np.random.Generator) -> None:
    case = banded(rng, 50, 100)
    problem = case.problem()
    weights = rng.uniform(0.1, 1.0, case.b.size)
    solver = Cholesky()
    solver.setup(problem)
    case.variances = case.variances / weights**2
    np.testing.assert_allclose(solver.solve(weights).x, case.reference()[0], atol=1e-8)


def test_what_a_solver_cannot_take_it_says(rng: np.random.Generator) -> None:
    case = banded(rng, 30, 60, hard=2)
    with pytest.raises(SolverError, match="kkt"):
        Cholesky().setup(case.problem())
    bounded = banded(rng, 30, 60).problem()
    solver = Cholesky()
    solver.setup(bounded)
    bounded.set_bounds("x", -1.0, 1.0)
    with pytest.raises(SolverError, match="inequalities"):
        solver.solve()


@pytest.mark.parametrize("most", [0, 10**9])
@pytest.mark.parametrize("compiled_from", [0, 10**9])
def test_gram_pattern(
    most: int, compiled_from: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(normal_equations, "MOST_PRODUCTS", most)
    monkeypatch.setattr(normal_equations, "COMPILED_FROM", compiled_from)
    monkeypatch.setattr(kernels, "WORTH_SECONDS", 0.0)
    problem = banded(rng, 40, 80).problem()
    matrix = problem.jacobian.matrix
    pattern = GramPattern(matrix.indptr, matrix.indices, 40)
    expected = np.triu((matrix.T @ matrix).toarray())
    out = np.zeros((40, 40))
    out[pattern.indices, np.repeat(np.arange(40), np.diff(pattern.indptr))] = pattern.values(matrix.data)
    np.testing.assert_allclose(out, expected, atol=1e-12)
    np.testing.assert_array_equal(pattern.indices[pattern.diagonal], np.arange(40))


def test_a_problem_too_ill_conditioned_for_normal_equations_is_rescued(rng: np.random.Generator) -> None:
    """Information of the weakest direction 1e-18 of the strongest: beyond normal equations, within reach of singular values."""
    count = 100
    A = np.vstack([np.eye(count)[1:] - np.eye(count)[:-1], 1e-9 * np.eye(count)])
    case = Rows(A, A @ np.full(count, 2.0), np.ones(2 * count - 1), np.empty((0, count)), np.empty(0))
    solver, solution = solve(case.problem(), Cholesky)
    assert solution.status is Status.SOLVED
    _, covariance = case.reference()
    np.testing.assert_allclose(solver.factor().variances(), np.diag(covariance), rtol=1e-6)

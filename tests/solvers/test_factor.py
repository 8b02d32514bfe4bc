"""Posterior covariances against dense inverses, closed forms and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from factorgrasp.errors import UnobservableError
from factorgrasp.least_squares import Constraint, LeastSquares, Term
from factorgrasp.solvers import linear_system
from factorgrasp.solvers.base import Solution
from factorgrasp.solvers.cholesky import Cholesky
from factorgrasp.solvers.factor import ActiveSet, active_set, posterior_factor
from factorgrasp.solvers.kkt import Kkt
from factorgrasp.solvers.ldl import SparseLdl
from factorgrasp.solvers.normal_equations import GramPattern
from factorgrasp.solvers.selected_inverse import selected_inverse
from factorgrasp.solvers.solve import solve
from factorgrasp.status import Status
from factorgrasp.uncertainty import Covariance, nees, nees_band
from factorgrasp.variables import Variable


@pytest.fixture(params=["dense", "sparse"])
def method(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(linear_system, "DENSE_UP_TO", 10**6 if request.param == "dense" else 0)
    return str(request.param)


def make(rng: np.random.Generator, size: int = 60, hard: int = 0, soft: int = 0) -> LeastSquares:
    pattern = rng.random((2 * size, size)) < 0.08
    pattern[:size] |= np.eye(size, dtype=bool)
    constraints = [Constraint("exact", hard, ("x",))] if hard else []
    constraints += [Constraint("limit", soft, ("x",), "inequality")] if soft else []
    problem = LeastSquares(
        [Variable("x", size)],
        [
            Term(
                "rows",
                2 * size,
                ("x",),
                Covariance.diagonal(rng.uniform(0.1, 10.0, 2 * size)),
                pattern={"x": pattern},
            )
        ],
        constraints,
    )
    problem.set_term(
        "rows", {"x": np.where(pattern, rng.normal(size=pattern.shape), 0.0)}, rng.normal(size=2 * size)
    )
    if hard:
        problem.set_constraint("exact", {"x": rng.normal(size=(hard, size))}, rng.normal(size=hard))
    if soft:
        problem.set_constraint("limit", {"x": rng.normal(size=(soft, size))}, rng.normal(size=soft))
    return problem


def dense_covariance(problem: LeastSquares, hard: np.ndarray) -> np.ndarray:
    """Upper left block of the inverse of the whole KKT matrix."""
    size = problem.size
    information = problem.normal_equations()[0].toarray()
    zero = np.zeros((hard.shape[0],) * 2)
    return np.linalg.inv(np.block([[information, hard.T], [hard, zero]]))[:size, :size]


@pytest.mark.parametrize("hard", [0, 7])
def test_solves_marginals_and_variances(method: str, hard: int, rng: np.random.Generator) -> None:
    problem = make(rng, hard=hard)
    expected = dense_covariance(problem, problem.equalities.matrix.toarray())
    factor = posterior_factor(problem, np.zeros(60))
    B = rng.normal(size=(60, 12))
    np.testing.assert_allclose(factor.solve(B), expected @ B, atol=1e-9)
    np.testing.assert_allclose(factor.solve(B[:, 0]), expected @ B[:, 0], atol=1e-9)
    where = np.array([3, 41, 17])
    np.testing.assert_allclose(factor.marginal(where), expected[np.ix_(where, where)], atol=1e-9)
    np.testing.assert_allclose(factor.variances(), np.diag(expected), atol=1e-9)
    # With the selected inverse at hand, marginals are read from it.
    np.testing.assert_allclose(factor.marginal(where), expected[np.ix_(where, where)], atol=1e-9)


def test_row_weights_count(method: str, rng: np.random.Generator) -> None:
    problem = make(rng)
    weights = rng.uniform(0.2, 1.0, 120)
    matrix, _ = problem.whitened(weights)
    expected = np.linalg.inv((matrix.T @ matrix).toarray())
    np.testing.assert_allclose(
        posterior_factor(problem, np.zeros(60), weights).variances(), np.diag(expected)
    )


def test_active_constraints_remove_variance(method: str, rng: np.random.Generator) -> None:
    problem = make(rng, hard=2, soft=4)
    problem.set_bounds(
        "x", np.where(np.arange(60) == 5, 0.1, -np.inf), np.where(np.arange(60) == 9, 0.2, np.inf)
    )
    active = ActiveSet(np.array([True, False, True, False]), np.arange(60) == 5, np.arange(60) == 9)
    hard = np.vstack(
        [
            problem.equalities.matrix.toarray(),
            problem.inequalities.matrix.toarray()[[0, 2]],
            np.eye(60)[[5, 9]],
        ]
    )
    factor = posterior_factor(problem, np.zeros(60), active=active)
    np.testing.assert_allclose(factor.solve(np.eye(60)), dense_covariance(problem, hard), atol=1e-9)
    assert factor.variances()[5] < 1e-12


def test_active_set_of_a_solved_problem(rng: np.random.Generator) -> None:
    problem = make(rng, size=20, soft=6)
    problem.set_bounds("x", -0.2, 0.2)
    estimate = solve(problem)
    assert estimate.status is Status.SOLVED
    x = estimate.values["x"]
    load = np.concatenate([estimate.multipliers["limit"], np.abs(estimate.multipliers["bounds of x"])])
    solution = Solution(
        x, Status.SOLVED, z=estimate.multipliers["limit"], z_box=estimate.multipliers["bounds of x"]
    )
    found = active_set(problem, solution)
    said = np.concatenate([found.inequalities, found.lower | found.upper])
    np.testing.assert_array_equal(said, load > 1e-5)
    assert 0 < said.sum() < 26
    # Slack alone finds the same set when a solver reports no multipliers, once the iterate sits on its bounds.
    exact = Solution(np.where(found.lower, -0.2, np.where(found.upper, 0.2, x)), Status.SOLVED)
    np.testing.assert_array_equal(active_set(problem, exact).lower, found.lower)
    hard = np.vstack(
        [problem.inequalities.matrix.toarray()[found.inequalities], np.eye(20)[found.lower | found.upper]]
    )
    np.testing.assert_allclose(estimate.covariance(), dense_covariance(problem, hard), atol=1e-7)


def test_contradicting_active_constraints_have_no_covariance(method: str) -> None:
    problem = LeastSquares([Variable("x", 2)], [Term("prior", 2, ("x",))], [Constraint("tie", 1, ("x",))])
    problem.set_term("prior", {"x": np.eye(2)}, 0.0)
    problem.set_constraint("tie", {"x": [[1.0, 0.0]]}, [2.0])
    problem.set_bounds("x", -np.inf, [1.0, np.inf])
    active = ActiveSet(np.zeros(0, dtype=bool), np.zeros(2, dtype=bool), np.array([True, False]))
    with pytest.raises(UnobservableError, match="contradict"):
        posterior_factor(problem, np.zeros(2), active=active)


def test_nothing_is_said_along_null_directions(method: str) -> None:
    """Two unknowns of which only the sum is measured, and one that is known."""
    problem = LeastSquares(
        [Variable("x", 3)], [Term("sum", 1, ("x",)), Term("known", 1, ("x",), Covariance.scalar(4.0))]
    )
    problem.set_term("sum", {"x": [[1.0, 1.0, 0.0]]}, [1.0])
    problem.set_term("known", {"x": [[0.0, 0.0, 1.0]]}, [1.0])
    factor = posterior_factor(problem, np.zeros(3))
    assert factor.null.count == 1
    np.testing.assert_array_equal(np.isinf(factor.variances()), [True, True, False])
    assert factor.variances()[2] == pytest.approx(4.0)
    marginal = factor.marginal(np.arange(3))
    assert np.isnan(marginal[0, 2])
    assert marginal[0, 0] == np.inf
    out = factor.solve(np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0]]).T)
    assert out[:, 0] @ [1.0, 1.0, 0.0] == pytest.approx(1.0)
    assert np.all(np.isnan(out[:, 1]))
    assert out[2, 2] == pytest.approx(4.0)


@pytest.mark.parametrize("solver", [Cholesky, Kkt])
def test_a_lent_factor_outlives_the_values_it_was_made_for(
    method: str, solver: type[Cholesky], rng: np.random.Generator
) -> None:
    problem = make(rng, hard=3 if solver is Kkt else 0)
    expected = dense_covariance(problem, problem.equalities.matrix.toarray())
    instance = solver()
    instance.setup(problem)
    instance.solve()
    factor = instance.factor()
    problem.set_term("rows", {"x": 5.0 * problem.jacobian.matrix.toarray()}, 0.0)
    if solver is Kkt:
        problem.set_constraint("exact", {"x": rng.normal(size=(3, 60))}, 0.0)
    # Neither new values in the problem nor a new solve may reach what was lent.
    np.testing.assert_allclose(factor.solve(np.eye(60)), expected, atol=1e-9)
    instance.solve()
    np.testing.assert_allclose(factor.solve(np.eye(60)), expected, atol=1e-9)
    changed = dense_covariance(problem, problem.equalities.matrix.toarray())
    np.testing.assert_allclose(instance.factor().solve(np.eye(60)), changed, atol=1e-9)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("indefinite", [False, True])
def test_selected_inverse(compiled: bool, indefinite: bool, rng: np.random.Generator) -> None:
    if compiled:
        pytest.importorskip("numba")
    A = sp.random_array((150, 80), density=0.03, rng=rng, format="csr") + sp.eye_array(150, 80)
    A = sp.csr_array(A)
    A.sort_indices()
    pattern = GramPattern(A.indptr, A.indices, 80)
    values = pattern.values(A.data)
    matrix = (A.T @ A).toarray()
    if indefinite:
        shift = np.where(np.arange(80) < 40, 0.0, -50.0)
        values[pattern.diagonal] += shift
        matrix += np.diag(shift)
    ldl = SparseLdl(pattern.indptr, pattern.indices)
    assert ldl.factorize(values)
    lower, pivots, order = ldl.factors()
    expected = np.linalg.inv(matrix)[np.ix_(order, order)]
    found = selected_inverse(lower, pivots, compiled)
    np.testing.assert_allclose(found.diagonal, np.diag(expected), rtol=1e-9)
    rows, columns = lower.nonzero()
    np.testing.assert_allclose(found.lower.toarray()[rows, columns], expected[rows, columns], atol=1e-10)
    pair = np.array([rows[0], columns[0]])
    np.testing.assert_allclose(found.block(pair), expected[np.ix_(pair, pair)], atol=1e-10)
    empty = np.argwhere(np.tril((lower + sp.eye_array(80)).toarray() == 0.0))[0]
    assert found.block(empty) is None


def test_without_numba_everything_still_works(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    from factorgrasp.solvers import kernels

    monkeypatch.setattr(kernels, "load", lambda seconds=0.0: None)
    monkeypatch.setattr(linear_system, "DENSE_UP_TO", 0)
    problem = make(rng)
    expected = dense_covariance(problem, np.empty((0, 60)))
    factor = posterior_factor(problem, np.zeros(60))
    np.testing.assert_allclose(factor.solve(np.eye(60)), expected, atol=1e-9)
    np.testing.assert_allclose(factor.variances(), np.diag(expected), atol=1e-9)


def test_estimates_scatter_as_their_covariance_says(method: str, rng: np.random.Generator) -> None:
    """Normalised error of a constrained linear problem over simulated measurements."""
    size, rows, runs = 30, 60, 60
    A, E = rng.normal(size=(rows, size)), rng.normal(size=(4, size))
    variances = 10.0 ** rng.uniform(-3.0, 3.0, rows)
    truth = rng.normal(size=size)
    problem = LeastSquares(
        [Variable("x", size)],
        [Term("rows", rows, ("x",), Covariance.diagonal(variances))],
        [Constraint("exact", 4, ("x",))],
    )
    solver = Kkt()
    free = np.linalg.qr(E.T, mode="complete")[0][:, 4:]
    errors = []
    for _ in range(runs):
        problem.set_term("rows", {"x": A}, A @ truth + np.sqrt(variances) * rng.normal(size=rows))
        problem.set_constraint("exact", {"x": E}, E @ truth)
        estimate = solve(problem, solver)
        covariance = free.T @ estimate.covariance("x") @ free
        errors.append(nees(free.T @ (estimate.values["x"] - truth), covariance) / (size - 4))
    low, high = nees_band(size - 4, runs)
    assert low < np.mean(errors) < high

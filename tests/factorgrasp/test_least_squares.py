"""The named least-squares problem against the same problem written out as dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from factorgrasp.errors import InputError
from factorgrasp.least_squares import Constraint, LeastSquares, Term
from factorgrasp.losses import Cauchy, GemanMcClure, Huber, make_loss
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable


class Dense:
    """A problem with scalar, diagonal and block covariances, a sparse block and constraints, beside its dense form."""

    def __init__(self, rng: np.random.Generator) -> None:
        root = rng.normal(size=(2, 3, 3))
        self.blocks = root @ np.swapaxes(root, 1, 2) + np.eye(3)
        self.pattern = rng.random((6, 4)) < 0.4
        self.variances = rng.uniform(0.1, 2.0, 4)
        self.problem = LeastSquares(
            [Variable("a", 4), Variable("b", 2)],
            [
                Term("block", 6, ("a", "b"), Covariance.blocks(self.blocks), pattern={"a": self.pattern}),
                Term("diagonal", 4, ("a",), Covariance.diagonal(self.variances)),
                Term("scalar", 2, ("b",), Covariance.scalar(0.25)),
            ],
            [Constraint("tie", 1, ("a", "b")), Constraint("cap", 2, ("b",), "inequality")],
        )
        # Rows of one block share a pattern: the union of the wished ones.
        union = self.pattern.reshape(2, 3, 4).any(axis=1).repeat(3, axis=0)
        self.A = np.zeros((12, 6))
        self.A[:6, :4] = np.where(union, rng.normal(size=(6, 4)), 0.0)
        self.A[:6, 4:] = rng.normal(size=(6, 2))
        self.A[6:10, :4] = rng.normal(size=(4, 4))
        self.A[10:, 4:] = rng.normal(size=(2, 2))
        self.b = rng.normal(size=12)
        self.E, self.e = rng.normal(size=(1, 6)), rng.normal(size=1)
        self.G, self.h = rng.normal(size=(2, 2)), rng.normal(size=2)
        self.fill()

    def fill(self) -> None:
        A, b = self.A, self.b
        self.problem.set_term("block", {"a": A[:6, :4], "b": A[:6, 4:]}, b[:6])
        self.problem.set_term("diagonal", {"a": A[6:10, :4]}, b[6:10])
        self.problem.set_term("scalar", {"b": A[10:, 4:]}, b[10:])
        self.problem.set_constraint("tie", {"a": self.E[:, :4], "b": self.E[:, 4:]}, self.e)
        self.problem.set_constraint("cap", {"b": self.G}, self.h)

    @property
    def information(self) -> np.ndarray:
        covariance = scipy.linalg.block_diag(*self.blocks, np.diag(self.variances), 0.25 * np.eye(2))
        return np.linalg.inv(covariance)


@pytest.fixture
def dense(rng: np.random.Generator) -> Dense:
    return Dense(rng)


def test_normal_equations(dense: Dense) -> None:
    information, vector = dense.problem.normal_equations()
    np.testing.assert_allclose(information.toarray(), dense.A.T @ dense.information @ dense.A, atol=1e-10)
    np.testing.assert_allclose(vector, dense.A.T @ dense.information @ dense.b, atol=1e-10)


def test_refilling_keeps_the_pattern_and_changes_the_values(dense: Dense, rng: np.random.Generator) -> None:
    indices = dense.problem.jacobian.matrix.indices.copy()
    dense.A *= 1.7
    dense.b = rng.normal(size=12)
    dense.fill()
    np.testing.assert_array_equal(dense.problem.jacobian.matrix.indices, indices)
    information, _ = dense.problem.normal_equations()
    np.testing.assert_allclose(information.toarray(), dense.A.T @ dense.information @ dense.A, atol=1e-10)


def test_pattern_entries_can_be_filled_alone(dense: Dense) -> None:
    problem = dense.problem
    union = dense.pattern.reshape(2, 3, 4).any(axis=1).repeat(3, axis=0)
    before = problem.jacobian.matrix.toarray()
    problem.set_term("block", {"a": 2.0 * dense.A[:6, :4][union]}, dense.b[:6])
    after = problem.jacobian.matrix.toarray()
    np.testing.assert_allclose(after[:6, :4], 2.0 * before[:6, :4])
    np.testing.assert_allclose(after[:, 4:], before[:, 4:])


def test_quadratic_program_has_the_same_objective(dense: Dense, rng: np.random.Generator) -> None:
    dense.problem.set_bounds("b", -1.0, [2.0, np.inf])
    qp = dense.problem.quadratic_program()
    for _ in range(5):
        x = rng.normal(size=6)
        residual = dense.A @ x - dense.b
        expected = 0.5 * residual @ dense.information @ residual
        assert 0.5 * x @ (qp.P @ x) + qp.q @ x + qp.constant == pytest.approx(expected, rel=1e-10)
        assert dense.problem.objective(x) == pytest.approx(expected, rel=1e-10)
    np.testing.assert_allclose(qp.A.toarray(), dense.E)
    np.testing.assert_allclose(qp.G.toarray(), np.hstack([np.zeros((2, 4)), dense.G]))
    np.testing.assert_array_equal(qp.lb, [-np.inf] * 4 + [-1.0, -1.0])
    np.testing.assert_array_equal(qp.ub, [np.inf] * 4 + [2.0, np.inf])


def test_row_weights_scale_the_rows(dense: Dense, rng: np.random.Generator) -> None:
    weights = rng.uniform(0.1, 1.0, 12)
    plain, rhs = dense.problem.whitened()
    scaled, scaled_rhs = dense.problem.whitened(weights)
    np.testing.assert_allclose(scaled.toarray(), weights[:, None] * plain.toarray())
    np.testing.assert_allclose(scaled_rhs, weights * rhs)


def test_a_new_covariance_takes_the_place_of_the_old(dense: Dense, rng: np.random.Generator) -> None:
    dense.blocks = dense.blocks[::-1] * 3.0
    dense.problem.set_covariance("block", Covariance.blocks(dense.blocks))
    np.testing.assert_allclose(
        dense.problem.normal_equations()[0].toarray(), dense.A.T @ dense.information @ dense.A, atol=1e-10
    )
    dense.problem.set_covariance("block", Covariance.scalar(2.0))
    dense.blocks = np.stack([2.0 * np.eye(3)] * 2)
    np.testing.assert_allclose(
        dense.problem.normal_equations()[0].toarray(), dense.A.T @ dense.information @ dense.A, atol=1e-10
    )
    with pytest.raises(InputError, match="covariance of diagonal"):
        dense.problem.set_covariance("diagonal", Covariance.blocks(np.eye(2)))


@pytest.mark.parametrize("loss", [Huber(1.2), Cauchy(0.8), GemanMcClure(2.0)])
def test_robust_weights_act_on_whole_groups(
    loss: Huber | Cauchy | GemanMcClure, rng: np.random.Generator
) -> None:
    problem = LeastSquares(
        [Variable("x", 2)],
        [Term("r", 6, ("x",), Covariance.scalar(0.25), loss, group=3), Term("p", 2, ("x",))],
    )
    A, b = rng.normal(size=(6, 2)), 3.0 * rng.normal(size=6)
    problem.set_term("r", {"x": A}, b)
    problem.set_term("p", {"x": np.eye(2)}, 0.0)
    x = rng.normal(size=2)
    norms = np.linalg.norm((2.0 * (A @ x - b)).reshape(2, 3), axis=1)
    weights = problem.robust_weights(problem.residuals(x))
    assert weights is not None
    np.testing.assert_allclose(weights[:6] ** 2, np.repeat(loss.weight(norms), 3))
    np.testing.assert_array_equal(weights[6:], 1.0)
    assert problem.objective(x) == pytest.approx(loss.rho(norms).sum() + 0.5 * x @ x)


@pytest.mark.parametrize("loss", [Huber(), Cauchy(), GemanMcClure()])
def test_weight_is_the_slope_of_the_loss(loss: Huber | Cauchy | GemanMcClure) -> None:
    s = np.linspace(0.05, 8.0, 60)
    slope = (loss.rho(s + 1e-6) - loss.rho(s - 1e-6)) / 2e-6
    np.testing.assert_allclose(loss.weight(s) * s, slope, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(loss.rho(np.array([1e-4])), 0.5e-8, rtol=1e-4)


def test_losses_by_name() -> None:
    assert make_loss("none") is None
    assert make_loss("huber", 2.0) == Huber(2.0)
    with pytest.raises(InputError, match="geman_mcclure"):
        make_loss("tukey")
    with pytest.raises(InputError, match="above zero"):
        Huber(0.0)


def test_not_finite_rows_are_named(dense: Dense) -> None:
    b = dense.b[6:10].copy()
    b[2] = np.nan
    dense.problem.set_term("diagonal", {}, b)
    with pytest.raises(InputError, match=r"term diagonal.*1 of its 4 rows, first in row 2"):
        dense.problem.whitened()
    dense.fill()
    A = dense.A[:6, :4].copy()
    A[A != 0.0] = np.inf
    dense.problem.set_term("block", {"a": A}, dense.b[:6])
    with pytest.raises(InputError, match="term block"):
        dense.problem.quadratic_program()


def test_wrong_shapes_and_names_say_what_was_expected(dense: Dense) -> None:
    problem = dense.problem
    with pytest.raises(InputError, match=r"shape \(4, 4\)"):
        problem.set_term("diagonal", {"a": np.ones((4, 3))}, np.zeros(4))
    with pytest.raises(InputError, match="right-hand side"):
        problem.set_term("diagonal", {}, np.zeros(3))
    with pytest.raises(InputError, match="a variable of these rows"):
        problem.set_term("scalar", {"a": np.ones((2, 4))}, 0.0)
    with pytest.raises(InputError, match="tie, cap"):
        problem.set_constraint("missing", {}, 0.0)
    with pytest.raises(InputError, match="lower <= upper"):
        problem.set_bounds("b", 1.0, 0.0)
    with pytest.raises(InputError, match="unique names"):
        LeastSquares([Variable("x", 1), Variable("x", 1)], [])
    with pytest.raises(InputError, match="variables of t"):
        LeastSquares([Variable("x", 1)], [Term("t", 1, ("y",))])


def test_selection_reads_the_named_variables(dense: Dense) -> None:
    x = np.arange(6.0)
    np.testing.assert_array_equal(dense.problem.select(["b", "a"]) @ x, [4, 5, 0, 1, 2, 3])

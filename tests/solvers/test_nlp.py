"""Solvers of nonlinear programs on programs whose answers are known, and the comparison of them."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from factorgrasp import compare
from factorgrasp.errors import SolverError
from factorgrasp.nonlinear_program import NlpSolution, check_program
from factorgrasp.solvers.nlp import get_nlp_solver
from factorgrasp.solvers.registry import get_solver
from factorgrasp.status import Status

SOLVERS = ("ipopt", "fatrop", "sqpmethod")


def full(matrix: np.ndarray) -> sp.csc_array:
    """Every entry kept, zero or not."""
    rows, columns = matrix.shape
    indices = np.tile(np.arange(rows), columns)
    return sp.csc_array((matrix.T.ravel(), indices, np.arange(columns + 1) * rows), shape=matrix.shape)


class Rosenbrock:
    """Rosenbrock's valley within the half-plane x + y <= 1: the answer is (0.61879562, 0.38120438)."""

    kind = "rosenbrock"
    start = np.array([0.0, 2.0])
    lower, upper = np.full(2, -np.inf), np.full(2, np.inf)
    row_lower, row_upper = np.array([-np.inf]), np.array([1.0])

    def objective(self, x):
        return float((1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2)

    def gradient(self, x):
        away = x[1] - x[0] ** 2
        return np.array([-2 * (1 - x[0]) - 400 * x[0] * away, 200 * away])

    def rows(self, x):
        return np.array([x[0] + x[1]])

    def jacobian(self, x):
        return full(np.ones((1, 2)))

    def hessian(self, x, factor, multipliers):
        cross = -400 * x[0]
        return full(factor * np.array([[2 - 400 * x[1] + 1200 * x[0] ** 2, cross], [cross, 200.0]]))

    def row_words(self, row):
        return "the half-plane"

    def nonlinear_program(self):
        return self


class Impossible(Rosenbrock):
    """x^2 + y^2 <= -1."""

    row_upper = np.array([-1.0])

    def rows(self, x):
        return np.array([x @ x])

    def jacobian(self, x):
        return full(2 * x[None])

    def hessian(self, x, factor, multipliers):
        base = super().hessian(x, factor, multipliers)
        base.data[[0, 3]] += 2 * multipliers[0]
        return base


class Broken(Rosenbrock):
    """Fails where it should answer."""

    def gradient(self, x):
        raise ZeroDivisionError("broken on purpose")


@pytest.mark.parametrize("name", SOLVERS)
def test_answer_multipliers_and_certificate(name: str) -> None:
    program = Rosenbrock()
    found = get_nlp_solver(name, tolerance=1e-9).solve_program(program)
    assert found.status is Status.SOLVED
    np.testing.assert_allclose(found.x, [0.61879562, 0.38120438], atol=1e-6)
    check = check_program(program, found)
    assert max(check.primal, check.dual, check.complementarity) < 1e-6
    # The half-plane pushes back: its multiplier is the slope along its normal.
    assert found.multipliers[0] == pytest.approx(-program.gradient(found.x)[0], rel=1e-5)
    wrong = NlpSolution(found.x + 0.01, Status.SOLVED, found.multipliers)
    assert check_program(program, wrong).primal == pytest.approx(0.02, rel=1e-3)
    assert check_program(program, wrong).dual > 0.1


@pytest.mark.parametrize("name", SOLVERS)
def test_what_is_impossible_is_not_claimed(name: str) -> None:
    assert get_nlp_solver(name, max_iterations=80).solve_program(Impossible()).status is not Status.SOLVED


def test_an_error_of_the_program_comes_through() -> None:
    with pytest.raises(ZeroDivisionError, match="on purpose"):
        get_nlp_solver("ipopt").solve_program(Broken())


def test_programs_are_compared_by_those_that_take_them() -> None:
    rows = {
        row.solver: row for row in compare([Rosenbrock()], ["ipopt", "sqpmethod", "cholesky"], repeat=1).rows
    }
    assert rows["ipopt"].correct is True
    assert rows["sqpmethod"].correct is True
    assert rows["sqpmethod"].objective == pytest.approx(rows["ipopt"].objective, rel=1e-6)
    assert "nonlinear program" in rows["cholesky"].skipped


def test_wrong_solvers_are_named() -> None:
    with pytest.raises(SolverError, match=r"cholesky.*ipopt"):
        get_nlp_solver("cholesky")
    with pytest.raises(SolverError, match="nonlinear programs only"):
        get_solver("ipopt").setup(None)

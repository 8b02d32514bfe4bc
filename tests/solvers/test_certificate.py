"""The optimality check against qpsolvers' own formulae, hand-made optima and deliberately wrong answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import qpsolvers

from factorgrasp.least_squares import Constraint, LeastSquares, Term
from factorgrasp.solvers.base import Solution
from factorgrasp.solvers.certificate import certify, check, check_least_squares
from factorgrasp.solvers.registry import get_solver
from factorgrasp.status import Status
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable


@pytest.fixture
def problem(rng: np.random.Generator) -> LeastSquares:
    out = LeastSquares(
        [Variable("x", 8)],
        [Term("rows", 12, ("x",), Covariance.scalar(0.5))],
        [Constraint("exact", 2, ("x",)), Constraint("limit", 5, ("x",), "inequality")],
    )
    out.set_term("rows", {"x": rng.normal(size=(12, 8))}, 3.0 * rng.normal(size=12))
    out.set_constraint("exact", {"x": rng.normal(size=(2, 8))}, 0.1 * rng.normal(size=2))
    out.set_constraint("limit", {"x": rng.normal(size=(5, 8))}, rng.uniform(0.0, 0.3, 5))
    out.set_bounds("x", np.where(np.arange(8) % 2, -0.5, -np.inf), np.where(np.arange(8) % 3, 0.4, np.inf))
    return out


def solved(problem: LeastSquares) -> Solution:
    solver = get_solver("clarabel")
    solver.setup(problem)
    return solver.solve()


def test_the_formulae_are_those_of_qpsolvers(problem: LeastSquares, rng: np.random.Generator) -> None:
    """At arbitrary points, where none of the residuals is small."""
    qp = problem.quadratic_program()
    theirs = qpsolvers.Problem(qp.P, qp.q, qp.G, qp.h, qp.A, qp.b, qp.lb, qp.ub)
    # qpsolvers multiplies a load by its bound, so that loads may stand only on bounds that exist.
    box = rng.normal(size=8)
    box = np.where(np.isfinite(qp.ub), np.maximum(box, 0.0), 0.0) - np.where(
        np.isfinite(qp.lb), np.maximum(-box, 0.0), 0.0
    )
    mine = Solution(rng.normal(size=8), Status.SOLVED, rng.normal(size=2), rng.uniform(0.0, 1.0, 5), box)
    other = qpsolvers.Solution(theirs, x=mine.x, y=mine.y, z=mine.z, z_box=mine.z_box, found=True)
    for found in (check(qp, mine), check_least_squares(problem, mine)):
        assert found.primal == pytest.approx(other.primal_residual())
        assert found.dual == pytest.approx(other.dual_residual())
        assert found.gap == pytest.approx(other.duality_gap())
        assert found.sign == 0.0


def test_an_optimum_passes(problem: LeastSquares) -> None:
    solution = solved(problem)
    assert certify(problem, solution).within(1e-6)
    assert certify(problem.quadratic_program(), solution).within(1e-6)
    assert check_least_squares(problem, solution).complementarity < 1e-6
    assert np.max(solution.z) > 1e-3, "the test wants active constraints"


@pytest.mark.parametrize("part", ["x", "y", "z", "z_box"])
def test_a_disturbed_optimum_fails(problem: LeastSquares, part: str) -> None:
    solution = solved(problem)
    value = getattr(solution, part).copy()
    value[int(np.argmax(np.abs(value)))] += 1e-3
    assert not certify(problem, replace(solution, **{part: value})).within(1e-5)


def test_wrong_signs_and_loads_on_missing_bounds_count_as_dual(problem: LeastSquares) -> None:
    solution = solved(problem)
    z = solution.z.copy()
    z[0] = -0.3
    assert check_least_squares(problem, replace(solution, z=z)).sign == pytest.approx(0.3)
    box = np.zeros(8)
    box[0] = -2.0  # the first unknown has no lower bound
    assert certify(problem, replace(solution, z_box=box)).dual >= 2.0


def test_a_feasible_point_that_is_no_optimum_has_a_gap() -> None:
    """``min (x - 2)^2 / 2  s.t.  x <= 1`` at x = 0 with the right multiplier for stationarity there."""
    problem = LeastSquares(
        [Variable("x", 1)], [Term("t", 1, ("x",))], [Constraint("c", 1, ("x",), "inequality")]
    )
    problem.set_term("t", {"x": [[1.0]]}, 2.0)
    problem.set_constraint("c", {"x": [[1.0]]}, 1.0)
    found = check_least_squares(problem, Solution(np.zeros(1), Status.SOLVED, z=np.array([2.0])))
    assert found.primal == 0.0
    assert found.dual == 0.0
    assert found.gap == pytest.approx(2.0)
    assert found.complementarity == pytest.approx(2.0)
    assert certify(problem, Solution(np.ones(1), Status.SOLVED, z=np.array([1.0]))).within(1e-15)


def test_robust_weights_belong_to_the_check(rng: np.random.Generator) -> None:
    problem = LeastSquares([Variable("x", 3)], [Term("t", 9, ("x",))])
    problem.set_term("t", {"x": rng.normal(size=(9, 3))}, rng.normal(size=9))
    weights = rng.uniform(0.1, 1.0, 9)
    solver = get_solver("cholesky")
    solver.setup(problem)
    solution = solver.solve(weights)
    assert certify(problem, solution, weights).within(1e-12)
    assert not certify(problem, solution).within(1e-6)


def test_nothing_returned_is_nothing_certified(problem: LeastSquares) -> None:
    assert not certify(problem, Solution(np.full(8, np.nan), Status.NUMERICAL_ERROR)).within(np.inf)

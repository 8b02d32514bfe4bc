"""Solver-independent check of optimality: residuals of the Karush-Kuhn-Tucker conditions and the duality gap.

For ``min 1/2 x'Px + q'x  s.t.  G x <= h, A x = b, lb <= x <= ub`` with multipliers y, z >= 0 and z_box (positive at an upper bound,
negative at a lower one), the formulae of qpsolvers' ``Solution``:

- primal residual: ``max(|A x - b|, (G x - h)+, (lb - x)+, (x - ub)+)``;
- dual residual: ``max |P x + q + G'z + A'y + z_box|``, here together with the violation of ``z >= 0`` and of the signs of z_box;
- gap: ``|x'Px + q'x + b'y + h'z + lb'z_box- + ub'z_box+|``.

At a feasible stationary point the gap is the sum of slack times multiplier; complementary slackness is checked term by term as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from factorgrasp.estimate import Certificate
from factorgrasp.least_squares import LeastSquares, QuadraticProgram
from factorgrasp.solvers.base import Solution
from factorgrasp.typing import FloatArray


@dataclass(frozen=True)
class OptimalityCheck:
    """All residuals, in the units of the quadratic program.

    Attributes
    ----------
    primal : float
        Largest violation of a constraint or bound.
    dual : float
        Largest component of the gradient of the Lagrangian.
    gap : float
        Duality gap.
    sign : float
        Largest multiplier of the wrong sign.
    complementarity : float
        Largest product of a slack and its multiplier.
    """

    primal: float
    dual: float
    gap: float
    sign: float
    complementarity: float

    def certificate(self) -> Certificate:
        """The three numbers of a report: a wrong sign counts as dual, a slack under load as gap."""
        return Certificate(self.primal, max(self.dual, self.sign), max(self.gap, self.complementarity))


def check(program: QuadraticProgram, solution: Solution) -> OptimalityCheck:
    """Residuals of a solution of a quadratic program; NaN throughout when its `x` is not finite."""
    gradient = program.P @ solution.x + program.q
    return _check(solution, gradient, program.A, program.b, program.G, program.h, program.lb, program.ub)


def check_least_squares(
    problem: LeastSquares, solution: Solution, row_weights: FloatArray | None = None
) -> OptimalityCheck:
    """The same for a least-squares problem; the gradient ``A'(A x - b)`` is formed through A and loses fewer digits than ``P x + q``."""
    matrix, rhs = problem.whitened(row_weights)
    gradient = matrix.T @ (matrix @ solution.x - rhs)
    hard, soft = problem.equalities, problem.inequalities
    return _check(
        solution, gradient,
        hard.matrix if hard.height else None, hard.rhs,
        soft.matrix if soft.height else None, soft.rhs,
        problem.lower, problem.upper,
    )  # fmt: skip


def certify(
    problem: LeastSquares | QuadraticProgram, solution: Solution, row_weights: FloatArray | None = None
) -> Certificate:
    """Certificate of a solution; `row_weights` (rows,) are the square roots of the robust weights it was found with."""
    if isinstance(problem, QuadraticProgram):
        return check(problem, solution).certificate()
    return check_least_squares(problem, solution, row_weights).certificate()


def _check(
    solution: Solution,
    gradient: FloatArray,
    hard: sp.sparray | None,
    hard_rhs: FloatArray | None,
    soft: sp.sparray | None,
    soft_rhs: FloatArray | None,
    lower: FloatArray | None,
    upper: FloatArray | None,
) -> OptimalityCheck:
    x = solution.x
    if not np.all(np.isfinite(x)):
        return OptimalityCheck(*(float("nan"),) * 5)
    violations, slacks, loads = [np.zeros(1)], [np.zeros(1)], [np.zeros(1)]
    wrong = [np.zeros(1)]
    # x'(gradient of the Lagrangian) minus what the constraints leave: the gap without the cancellation of its large terms.
    gap = 0.0
    lagrangian = np.array(gradient)
    if hard is not None and hard_rhs is not None:
        error = hard @ x - hard_rhs
        y = _or_zero(solution.y, error.size)
        lagrangian += hard.T @ y
        violations.append(np.abs(error))
        gap -= float(y @ error)
    if soft is not None and soft_rhs is not None:
        error = soft @ x - soft_rhs
        z = _or_zero(solution.z, error.size)
        lagrangian += soft.T @ z
        violations.append(error)
        wrong.append(-z)
        slacks.append(error)
        loads.append(z)
        gap -= float(z @ error)
    if lower is not None or upper is not None:
        box = _or_zero(solution.z_box, x.size)
        lagrangian += box
        for bound, sign in ((lower, -1.0), (upper, 1.0)):
            if bound is None:
                continue
            finite = np.isfinite(bound)
            load = np.maximum(sign * box, 0.0)
            error = sign * (x - bound)[finite]
            violations.append(error)
            slacks.append(error)
            loads.append(load[finite])
            # A multiplier on a bound that does not exist has the wrong sign by definition.
            wrong.append(load[~finite])
            gap -= float(load[finite] @ error)
    gap += float(x @ lagrangian)
    product = np.abs(np.concatenate(slacks) * np.concatenate(loads))
    return OptimalityCheck(
        primal=max(float(np.concatenate(violations).max()), 0.0),
        dual=float(np.abs(lagrangian).max(initial=0.0)),
        gap=abs(gap),
        sign=max(float(np.concatenate(wrong).max()), 0.0),
        complementarity=float(product.max()),
    )


def _or_zero(multiplier: FloatArray, size: int) -> FloatArray:
    return multiplier if multiplier.size == size else np.zeros(size)

"""Nonlinear programs: what problems with constraints that no linearisation settles state, and solvers of their own kind take.

    minimise f(x)   subject to   g_low <= g(x) <= g_high,   x_low <= x <= x_high

with exact first and second derivatives of fixed sparsity.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
import scipy.sparse as sp

from factorgrasp.status import Status
from factorgrasp.typing import FloatArray


@runtime_checkable
class NonlinearProgram(Protocol):
    """One program. Rows and unknowns are scaled by whoever states it, so that one is a large violation.

    Attributes
    ----------
    start : ndarray, shape (n,)
    lower, upper : ndarray, shape (n,)
        Bounds of the unknowns; infinite where there are none.
    row_lower, row_upper : ndarray, shape (m,)
        Bounds of the rows g(x).
    """

    start: FloatArray
    lower: FloatArray
    upper: FloatArray
    row_lower: FloatArray
    row_upper: FloatArray

    def objective(self, x: FloatArray) -> float:
        """``f(x)``."""
        ...

    def gradient(self, x: FloatArray) -> FloatArray:
        """(n,)."""
        ...

    def rows(self, x: FloatArray) -> FloatArray:
        """``g(x)`` (m,)."""
        ...

    def jacobian(self, x: FloatArray) -> sp.csc_array:
        """(m, n); the same pattern for every x, entries that happen to be zero kept."""
        ...

    def hessian(self, x: FloatArray, factor: float, multipliers: FloatArray) -> sp.csc_array:
        """(n, n) symmetric, of ``factor f(x) + multipliers' g(x)``; the same pattern always."""
        ...

    def row_words(self, row: int) -> str:
        """What a row limits, in physical words."""
        ...


@dataclass(frozen=True)
class NlpSolution:
    """Last iterate of a solver on a :class:`NonlinearProgram`, kept also when it failed.

    Attributes
    ----------
    x : ndarray, shape (n,)
    status : Status
    multipliers : ndarray, shape (m,)
        Of the rows: positive at an upper bound, negative at a lower one (``grad f + J'y + z = 0``).
    bound_multipliers : ndarray, shape (n,)
    iterations : int
    setup_time, solve_time : float
        Seconds.
    message : str
        The solver's own words.
    """

    x: FloatArray
    status: Status
    multipliers: FloatArray = field(default_factory=lambda: np.empty(0))
    bound_multipliers: FloatArray = field(default_factory=lambda: np.empty(0))
    iterations: int = 0
    setup_time: float = 0.0
    solve_time: float = 0.0
    message: str = ""


@dataclass(frozen=True)
class NlpCheck:
    """Solver-independent residuals of the conditions of first order, and the objective.

    Attributes
    ----------
    objective : float
    primal : float
        Largest violation of a row or a bound.
    dual : float
        Largest entry of the gradient of the Lagrangian, over the largest of the terms that cancel in it (at least one).
    complementarity : float
        Largest product of a multiplier and its slack, over the largest multiplier (at least one).
    """

    objective: float
    primal: float
    dual: float
    complementarity: float


def check_program(program: NonlinearProgram, solution: NlpSolution) -> NlpCheck:
    """Residuals of a solution; multipliers that a solver did not return count as zero."""
    x = solution.x
    y = solution.multipliers if solution.multipliers.size else np.zeros(program.row_lower.size)
    z = solution.bound_multipliers if solution.bound_multipliers.size else np.zeros(x.size)
    g, J, gradient = program.rows(x), program.jacobian(x), program.gradient(x)
    pushed = J.T @ y
    size = max(1.0, *(float(np.abs(part).max(initial=0.0)) for part in (gradient, pushed, z)))
    primal, products = 0.0, 0.0
    loads = max(1.0, float(np.abs(y).max(initial=0.0)), float(np.abs(z).max(initial=0.0)))
    for value, low, high, load in (
        (g, program.row_lower, program.row_upper, y),
        (x, program.lower, program.upper, z),
    ):
        below, above = low - value, value - high
        primal = max(primal, float(np.maximum(below, above).max(initial=0.0)))
        slack = np.where(load > 0.0, np.abs(above), np.abs(below))
        products = max(
            products,
            float(
                np.where(load == 0.0, 0.0, np.abs(load) * np.where(np.isfinite(slack), slack, 1.0)).max(
                    initial=0.0
                )
            ),
        )
    dual = float(np.abs(gradient + pushed + z).max(initial=0.0)) / size
    return NlpCheck(program.objective(x), primal, dual, products / loads)

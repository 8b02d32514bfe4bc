"""Least squares without inequalities, by one factorisation of the normal equations and refinement through A."""

from __future__ import annotations

import time
from typing import ClassVar

import numpy as np

from factorgrasp.errors import NotSolvedError, SolverError
from factorgrasp.least_squares import LeastSquares
from factorgrasp.solvers.base import Capabilities, Solution, Solver, SolverOptions
from factorgrasp.solvers.factor import Factor
from factorgrasp.solvers.linear_system import LinearSystem, LinearValues
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, IntArray


class Cholesky(Solver):
    """``A'A x = A'b`` by a cached symbolic factorisation; small problems by dense LAPACK.

    A direction without information ends as `Status.UNOBSERVABLE`, named in the message; `x` has no part along it and is right elsewhere.
    """

    name: ClassVar[str] = "cholesky"
    modules: ClassVar[tuple[str, ...]] = ("qdldl",)
    pip: ClassVar[str] = "qdldl"
    capabilities: ClassVar[Capabilities] = Capabilities()

    def __init__(self, options: SolverOptions | None = None) -> None:
        super().__init__(options)
        self._system: LinearSystem | None = None

    def setup(self, problem: LeastSquares) -> None:
        """Order and analyse the pattern, unless it is the one of the last problem."""
        started = time.perf_counter()
        if problem.equalities.height and not self.capabilities.equalities:
            raise SolverError(f"{self.name} takes no equality constraints: use solver 'kkt'")
        self._problem = problem
        if self._system is None or not self._system.fits(problem):
            self._system = LinearSystem.of(problem)
        self._setup_time = time.perf_counter() - started

    def solve(self, row_weights: FloatArray | None = None, warm_start: Solution | None = None) -> Solution:
        """Solve for the current values of the problem given to `setup`; a direct method needs no `warm_start`."""
        started = time.perf_counter()
        problem, linear = self._problem, self._system
        assert linear is not None, "setup comes before solve"
        if problem.has_inequalities:
            raise SolverError(f"{self.name} takes no inequalities or bounds: use a QP solver such as 'piqp'")
        values = linear_values(problem, row_weights)
        try:
            linear.update(values)
        except NotSolvedError as error:
            nothing, y = np.full(problem.size, np.nan), np.zeros(values.hard_rhs.size)
            return self._solution(nothing, y, Status.NUMERICAL_ERROR, str(error), started)
        self._values = values
        system = linear.system
        status, message = Status.SOLVED, ""
        if system.violated.size:
            status = Status.INFEASIBLE
            message = "the equality constraints contradict each other: " + ", ".join(
                rows_words(problem, system.violated)
            )
        elif system.null.count:
            status = Status.UNOBSERVABLE
            message = system.null.message(problem.variables)
        return self._solution(system.x, system.y, status, message, started)

    def factor(self) -> Factor:
        """Posterior factor of the last solve, without factoring again."""
        assert self._system is not None, "solve comes before factor"
        return Factor(self._system, self._values)

    def _solution(
        self, x: FloatArray, y: FloatArray, status: Status, message: str, started: float
    ) -> Solution:
        elapsed = time.perf_counter() - started
        return Solution(
            x, status, y=y, iterations=1, setup_time=self._setup_time, solve_time=elapsed, message=message
        )


def linear_values(problem: LeastSquares, row_weights: FloatArray | None = None) -> LinearValues:
    """Current values of a problem with its equalities, whitened."""
    entries, rhs = problem.whitened_values(row_weights)
    hard = problem.equalities
    if not hard.height:
        return LinearValues(entries, rhs, hard.matrix, hard.rhs)
    return LinearValues(entries, rhs, hard.matrix.copy(), hard.rhs.copy())


def rows_words(problem: LeastSquares, rows: IntArray) -> list[str]:
    """Names of the equality constraints that hold these rows."""
    return [
        name
        for name, where in problem.equalities.slices.items()
        if np.any((rows >= where.start) & (rows < where.stop))
    ]

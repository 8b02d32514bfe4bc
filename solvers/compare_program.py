"""Nonlinear programs among the cases of a comparison."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from factorgrasp.errors import SolverError
from factorgrasp.estimate import Certificate
from factorgrasp.nonlinear_program import NlpSolution, NonlinearProgram, check_program
from factorgrasp.solvers.base import Solution, SolverOptions
from factorgrasp.solvers.compare_cases import Case, Outcome
from factorgrasp.solvers.measure import Solve, measure
from factorgrasp.solvers.nlp import NlpSolver
from factorgrasp.solvers.registry import get_solver

RIGHT = 1e-5
"""Violation of a scaled row, or relative residual of stationarity or complementarity, up to which an answer counts as right."""
MOST_REPEATS = 3


class ProgramCase(Case):
    """One nonlinear program; only solvers of those take it. The certificate is the conditions of first order, by our own evaluation."""

    takes_program = True
    inequalities = equalities = True

    def __init__(self, program: NonlinearProgram) -> None:
        self.stated = program

    def run(self, name: str, options: SolverOptions, repeat: int) -> Outcome:
        """Cold from the program's start, warm from the solution."""
        last: list[NlpSolution] = []

        def fresh() -> Solve:
            solver = get_solver(name, replace(options, tolerance=max(options.tolerance, 1e-8)))
            if not isinstance(solver, NlpSolver):
                raise SolverError(f"{name} takes no nonlinear programs")

            def run(start: Solution | None) -> Solution:
                began = time.perf_counter()
                found = solver.solve_program(self.stated, last[0] if start is not None and last else None)
                if start is None:
                    last[:] = [found]
                elapsed = time.perf_counter() - began
                return Solution(
                    found.x, found.status, iterations=found.iterations, setup_time=found.setup_time,
                    solve_time=elapsed - found.setup_time, message=found.message,
                )  # fmt: skip

            return run

        found, timing, _ = measure(fresh, min(repeat, MOST_REPEATS))
        best = last[0]
        if not np.all(np.isfinite(best.x)):
            return Outcome(
                found.status,
                np.nan,
                None,
                None,
                timing,
                found.iterations,
                found.message,
                found,
                estimation=False,
            )
        check = check_program(self.stated, best)
        certificate = Certificate(check.primal, check.dual, check.complementarity)
        # Scaled so that the comparison's tolerance is where an answer counts as right.
        part = options.tolerance / RIGHT
        judged = Certificate(check.primal * part, check.dual * part, check.complementarity * part)
        return Outcome(
            found.status,
            check.objective,
            certificate,
            judged,
            timing,
            found.iterations,
            found.message,
            found,
            estimation=False,
        )

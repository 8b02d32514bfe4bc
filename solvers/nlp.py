"""Base of the solvers of nonlinear programs."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from factorgrasp.errors import SolverError
from factorgrasp.least_squares import LeastSquares
from factorgrasp.nonlinear_program import NlpSolution, NonlinearProgram
from factorgrasp.solvers.base import Capabilities, Solution, Solver
from factorgrasp.solvers.registry import get_solver, solver_class, solver_names
from factorgrasp.typing import FloatArray

NLP_PREFERENCE: tuple[str, ...] = ("ipopt", "fatrop", "sqpmethod")
"""Which solver a nonlinear program gets by default."""


class NlpSolver(Solver):
    """A solver that takes a :class:`NonlinearProgram` and nothing else."""

    capabilities: ClassVar[Capabilities] = Capabilities(equalities=True, inequalities=True, program=True)

    @abstractmethod
    def solve_program(self, program: NonlinearProgram, warm_start: NlpSolution | None = None) -> NlpSolution:
        """Solve from the program's start, or from another solution of it."""

    def setup(self, problem: LeastSquares) -> None:
        raise SolverError(f"{self.name} takes nonlinear programs only")

    def solve(self, row_weights: FloatArray | None = None, warm_start: Solution | None = None) -> Solution:
        raise SolverError(f"{self.name} takes nonlinear programs only")


def get_nlp_solver(name: str | None = None, **options: object) -> NlpSolver:
    """A solver of nonlinear programs by its name, the first of :data:`NLP_PREFERENCE` that is there without one.

    Parameters
    ----------
    name : str, optional
    **options
        Fields of :class:`factorgrasp.solvers.base.SolverOptions`.

    Raises
    ------
    SolverError
        When the name is unknown, or takes no nonlinear programs.
    """
    from factorgrasp.solvers.base import SolverOptions

    if name is None:
        name = next(one for one in NLP_PREFERENCE if solver_class(one).installed())
    solver = get_solver(name, SolverOptions(**({"tolerance": 1e-7} | options)))  # type: ignore[arg-type]
    if not isinstance(solver, NlpSolver):
        takers = ", ".join(one for one in solver_names(True) if solver_class(one).capabilities.program)
        raise SolverError(f"{name!r} takes no nonlinear programs; {takers} do")
    return solver

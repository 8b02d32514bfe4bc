"""What a solver is: declared capabilities, a set-up for a pattern and a solve for values."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np

from factorgrasp.least_squares import LeastSquares
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, State


@dataclass(frozen=True)
class Capabilities:
    """What a solver takes as it is; the outer loops add nonlinear problems and robust losses to all of them."""

    equalities: bool = False
    inequalities: bool = False
    nonlinear: bool = False
    warm_start: bool = False
    sparse: bool = True
    program: bool = False
    """Takes a :class:`factorgrasp.nonlinear_program.NonlinearProgram` (and no least squares)."""


@dataclass(frozen=True)
class Solution:
    """Last iterate of a solver on one :class:`LeastSquares`, kept also when it failed.

    Attributes
    ----------
    x : ndarray
        (n,); NaN only when the solver returned nothing at all.
    status : Status
    y, z, z_box : ndarray
        Multipliers of equalities, inequalities (>= 0) and bounds (positive at an upper one, negative at a lower one), in the convention
        ``P x + q + G'z + A'y + z_box = 0``.
    iterations : int
    setup_time, solve_time : float
        Seconds.
    message : str
        The solver's own words.
    """

    x: FloatArray
    status: Status
    y: FloatArray = field(default_factory=lambda: np.empty(0))
    z: FloatArray = field(default_factory=lambda: np.empty(0))
    z_box: FloatArray = field(default_factory=lambda: np.empty(0))
    iterations: int = 0
    setup_time: float = 0.0
    solve_time: float = 0.0
    message: str = ""


@dataclass(frozen=True)
class NonlinearSolution:
    """What a solver that takes a nonlinear problem whole brings back from its own iterations (no outer loop of ours).

    Attributes
    ----------
    state : mapping
        Last iterate, kept also when it failed.
    status : Status
    iterations : int
    setup_time, solve_time : float
        Seconds: building the solver's own model of the problem, and its iterations.
    message : str
        The solver's own words.
    errors_log : tuple of float
        Objective at the start and after every iteration, robust losses included.
    """

    state: State
    status: Status
    iterations: int = 0
    setup_time: float = 0.0
    solve_time: float = 0.0
    message: str = ""
    errors_log: tuple[float, ...] = ()


@dataclass(frozen=True)
class SolverOptions:
    """Options that mean the same for every solver; None leaves the solver's default.

    Attributes
    ----------
    tolerance : float
        Absolute primal and dual residual that is asked for.
    max_iterations : int or None
        Of the solver itself.
    time_limit : float or None
        Seconds a solve.
    extra : dict
        Passed on to the backend as it is.
    """

    tolerance: float = 1e-9
    max_iterations: int | None = None
    time_limit: float | None = None
    extra: dict[str, Any] = field(default_factory=dict)


class Solver(ABC):
    """Base of all backends. One object serves one pattern: `setup` once, `solve` for every new set of values."""

    name: ClassVar[str]
    modules: ClassVar[tuple[str, ...]] = ()
    """Top-level modules that must be installed; checked without importing them."""
    pip: ClassVar[str] = ""
    """What to `pip install` to get them."""
    capabilities: ClassVar[Capabilities] = Capabilities()

    def __init__(self, options: SolverOptions | None = None) -> None:
        self.options = options or SolverOptions()

    @classmethod
    def installed(cls) -> bool:
        """Whether every needed module can be found."""
        return all(find_spec(module) is not None for module in cls.modules)

    @abstractmethod
    def setup(self, problem: LeastSquares) -> None:
        """Do the work that depends on the pattern alone, and remember the problem."""

    @abstractmethod
    def solve(self, row_weights: FloatArray | None = None, warm_start: Solution | None = None) -> Solution:
        """Solve for the current values of the problem given to `setup`."""

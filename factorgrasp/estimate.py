"""What comes back from a solve: means, covariances, residuals, observability and an honest status."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgrasp.errors import InputError, UnobservableError
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, JsonDict
from factorgrasp.variables import Variable, slices

if TYPE_CHECKING:
    from factorgrasp.observability import Observability

CovarianceSource = Callable[[FloatArray], FloatArray]
"""Maps columns ``B`` (n, k) to ``P B`` (n, k) through the factor; P itself is never formed."""


@dataclass(frozen=True)
class TermSummary:
    """How well one term agrees with the estimate.

    Attributes
    ----------
    name : str
    rows : int
    chi2 : float
        Sum of squared whitened residuals.
    rms : float
        ``sqrt(chi2 / rows)``: about 1 where the covariance fits the data.
    worst : float
        Largest whitened norm of one residual.
    down_weighted : float
        Share of the residuals to which a robust loss gave less than half of their weight.
    """

    name: str
    rows: int
    chi2: float
    rms: float
    worst: float
    down_weighted: float = 0.0


@dataclass(frozen=True)
class Certificate:
    """Solver-independent check of optimality: largest violations in the units of the QP, and the duality gap."""

    primal: float
    dual: float
    gap: float

    def within(self, tolerance: float) -> bool:
        """Whether all three residuals are at most `tolerance`."""
        return max(self.primal, self.dual, self.gap) <= tolerance


@dataclass(frozen=True)
class Estimate:
    """The answer to a problem. Frozen; covariances are computed from the solver's factor when asked for.

    Attributes
    ----------
    status : Status
    message : str
        Why it ended so and, when it is not solved, what would help.
    kind, solver : str
    variables : tuple of Variable
        In the order of the tangent space.
    values : mapping
        Mean of every variable by name.
    residuals : tuple of TermSummary
    observability : Observability or None
        Which directions the data informed, in physical words.
    objective : float
    iterations : int
    certificate : Certificate or None
    timing : mapping
        Seconds: ``setup``, ``solve``, and others by name.
    versions : mapping
    problem_hash : str
    multipliers : mapping
        Multipliers of constraints and bounds by name (units: objective per unit of the constraint).
    """

    status: Status
    kind: str
    solver: str
    variables: tuple[Variable, ...]
    values: Mapping[str, FloatArray]
    message: str = ""
    residuals: tuple[TermSummary, ...] = ()
    observability: Observability | None = None
    objective: float = float("nan")
    iterations: int = 0
    certificate: Certificate | None = None
    timing: Mapping[str, float] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    problem_hash: str = ""
    multipliers: Mapping[str, FloatArray] = field(default_factory=dict)
    covariance_source: CovarianceSource | None = field(default=None, repr=False, compare=False)

    @property
    def solved(self) -> bool:
        """Whether the status is `Status.SOLVED`."""
        return self.status.ok

    @property
    def size(self) -> int:
        """Dimension of the tangent space."""
        return sum(variable.size for variable in self.variables)

    def covariance(self, *names: str) -> FloatArray:
        """Joint covariance of the named variables (all of them when none is named), shape (k, k), in tangent coordinates."""
        where = slices(self.variables)
        for name in names:
            if name not in where:
                raise InputError("variable", "one of " + ", ".join(where), repr(name))
        columns = np.concatenate([np.arange(self.size)[where[name]] for name in names or where])
        selection = np.zeros((columns.size, self.size))
        selection[np.arange(columns.size), columns] = 1.0
        return self.readout_covariance(selection)

    def readout_covariance(self, matrix: FloatArray) -> FloatArray:
        """Covariance (k, k) of the linear read-out ``matrix @ d`` of the tangent vector d, `matrix` of shape (k, n)."""
        if self.covariance_source is None:
            raise UnobservableError(f"no covariance is available: {self.message or self.status.value}")
        matrix = np.atleast_2d(matrix)
        if matrix.shape[1] != self.size:
            raise InputError("read-out matrix", f"{self.size} columns", f"{matrix.shape[1]}")
        out = matrix @ self.covariance_source(np.ascontiguousarray(matrix.T))
        return np.asarray(0.5 * (out + out.T))

    def sd(self, name: str) -> FloatArray:
        """Standard deviation of every tangent component of a variable, shape (size,)."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance(name)), 0.0)))

    def summary(self) -> str:
        """A few lines for a terminal."""
        from factorgrasp.estimate_text import summarize

        return summarize(self)

    def to_dict(self) -> JsonDict:
        """Plain numbers, strings and lists of everything but the arrays' full covariance."""
        from factorgrasp.estimate_io import to_dict

        return to_dict(self)

    def save(self, directory: str | Path) -> Path:
        """Write ``estimate.json`` and ``estimate.npz`` into `directory`, each atomically; returns the JSON's path."""
        from factorgrasp.estimate_io import save

        return save(self, Path(directory))

    @staticmethod
    def load(directory: str | Path) -> Estimate:
        """Read what :meth:`save` wrote."""
        from factorgrasp.estimate_io import load

        return load(Path(directory))

    def to_dataframe(self) -> Any:
        """One row a tangent component with its mean and standard deviation (needs pandas)."""
        from factorgrasp.estimate_io import to_dataframe

        return to_dataframe(self)

    def to_xarray(self) -> Any:
        """Means and covariances as an ``xarray.Dataset`` (needs xarray)."""
        from factorgrasp.estimate_io import to_xarray

        return to_xarray(self)

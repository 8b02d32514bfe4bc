"""Which directions of the unknowns the data informed, in numbers and in physical words."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgrasp.typing import FloatArray, JsonDict
from factorgrasp.variables import Variable

Describe = Callable[[Variable, FloatArray], str]
"""Words for a unit direction (size,) of a variable, e.g. "lever arm along the rotation axis"."""


@dataclass(frozen=True)
class Direction:
    """One principal direction of a variable's posterior.

    Attributes
    ----------
    variable : str
    vector : ndarray
        Unit vector (size,) in the variable's tangent coordinates.
    sd : float
        Posterior standard deviation along it, in the variable's unit; infinite when nothing informs it.
    resolution : float
        The sd above which it counts as not informed; NaN for a variable that is not judged and listed only because nothing informs it.
    words : str
    unit : str
    """

    variable: str
    vector: FloatArray
    sd: float
    resolution: float
    words: str
    unit: str = ""

    @property
    def observable(self) -> bool:
        """Whether the data informed this direction well enough to be used."""
        return self.sd <= self.resolution

    def to_dict(self) -> JsonDict:
        """Plain numbers and strings; an infinite sd becomes None."""
        return {
            "variable": self.variable,
            "direction": [float(v) for v in self.vector],
            "sd": float(self.sd) if np.isfinite(self.sd) else None,
            "resolution": float(self.resolution) if np.isfinite(self.resolution) else None,
            "unit": self.unit,
            "observable": self.observable,
            "words": self.words,
        }


@dataclass(frozen=True)
class Observability:
    """All judged directions, worst first, and advice on what would inform the missing ones."""

    directions: tuple[Direction, ...]
    advice: str = ""

    @property
    def complete(self) -> bool:
        """Whether every judged direction is informed."""
        return all(direction.observable for direction in self.directions)

    @property
    def missing(self) -> tuple[Direction, ...]:
        """The directions that are not informed, worst first."""
        return tuple(direction for direction in self.directions if not direction.observable)

    def to_dict(self) -> JsonDict:
        """Plain numbers and strings."""
        return {
            "complete": self.complete,
            "advice": self.advice,
            "directions": [direction.to_dict() for direction in self.directions],
        }


def default_words(variable: Variable, vector: FloatArray) -> str:
    """Words made of the components that dominate a direction: all above 0.2, but three at least and six at most."""
    order = np.argsort(-np.abs(vector), kind="stable")
    large = int(np.count_nonzero(np.abs(vector) > 0.2))
    shown = order[: min(max(large, 3), 6)]
    parts = [
        f"{vector[i]:+.2f} {variable.labels[i]}" for i in shown if abs(vector[i]) > (0.2 if large else 0.0)
    ]
    # Rounded to nothing they would say nothing: a direction spread over many components names its largest ones.
    rest = 1.0 - float(np.sum(vector[shown] ** 2)) > 0.2
    return f"{variable.name} along " + " ".join(parts) + (" ..." if rest else "")


def observe(
    variables: Sequence[Variable],
    covariance: Callable[[str], FloatArray],
    describe: Describe = default_words,
    advice: str = "",
    null: Mapping[str, FloatArray] | None = None,
) -> Observability:
    """Judge the principal directions of every variable that has a resolution, and name all that nothing informs.

    Parameters
    ----------
    variables : sequence of Variable
    covariance : callable
        Marginal covariance (size, size) of a variable by name, such as ``Estimate.covariance``; of a variable in `null` it must be
        right across the directions given there and may be anything along them.
    describe : callable
    advice : str
        Kept only when something is missing.
    null : mapping, optional
        Orthonormal directions (size, k), by variable, that nothing at all informs. They are listed for variables without a resolution, too.
    """
    directions: list[Direction] = []
    for variable in variables:
        lost = (null or {}).get(variable.name, np.empty((variable.size, 0)))
        if variable.resolution is None and not lost.shape[1]:
            continue
        resolution = float("nan") if variable.resolution is None else variable.resolution
        spread, axes = np.full(lost.shape[1], np.inf), lost
        if variable.resolution is not None:
            rest = _complement(lost)
            marginal = rest.T @ covariance(variable.name) @ rest
            if np.all(np.isfinite(marginal)):
                values, within = np.linalg.eigh(marginal)
                spread, axes = np.concatenate([spread, values]), np.hstack([axes, rest @ within])
            else:
                spread, axes = np.full(variable.size, np.inf), np.eye(variable.size)
        for value, axis in zip(spread, axes.T, strict=True):
            sign = 1.0 if axis[int(np.argmax(np.abs(axis)))] >= 0.0 else -1.0
            vector = sign * axis
            words = describe(variable, vector)
            sd = float(np.sqrt(max(value, 0.0)))
            directions.append(Direction(variable.name, vector, sd, resolution, words, variable.unit))
    directions.sort(key=lambda d: d.sd / d.resolution if np.isfinite(d.sd) else np.inf, reverse=True)
    missing = any(not direction.observable for direction in directions)
    return Observability(tuple(directions), advice if missing else "")


def _complement(axes: FloatArray) -> FloatArray:
    """Orthonormal basis of what is perpendicular to orthonormal `axes` (size, k)."""
    if not axes.shape[1]:
        return np.eye(axes.shape[0])
    return np.asarray(np.linalg.qr(axes, mode="complete")[0][:, axes.shape[1] :])

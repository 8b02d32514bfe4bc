"""Robust losses: how much a residual that is far outside its covariance may still pull.

Each loss acts on the whitened norm ``s`` of one residual (a group of rows) with ``rho(s) ~ s^2 / 2`` near zero. Solvers use it through
iteratively re-weighted least squares with the weight ``w(s) = rho'(s) / s``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray


class Loss(Protocol):
    """What a robust loss offers. `scale` is in standard deviations."""

    @property
    def scale(self) -> float: ...
    def rho(self, s: FloatArray) -> FloatArray: ...
    def weight(self, s: FloatArray) -> FloatArray: ...


@dataclass(frozen=True)
class Huber:
    """``s^2/2`` inside `scale`, linear outside; convex. 1.345 keeps 95 % efficiency on Gaussian noise."""

    scale: float = 1.345

    def __post_init__(self) -> None:
        _check(self.scale)

    def rho(self, s: FloatArray) -> FloatArray:
        return np.where(s <= self.scale, 0.5 * s**2, self.scale * (s - 0.5 * self.scale))

    def weight(self, s: FloatArray) -> FloatArray:
        return self.scale / np.maximum(s, self.scale)


@dataclass(frozen=True)
class Cauchy:
    """``c^2/2 log(1 + (s/c)^2)``; not convex, never quite forgets an outlier. 2.385 keeps 95 % efficiency."""

    scale: float = 2.385

    def __post_init__(self) -> None:
        _check(self.scale)

    def rho(self, s: FloatArray) -> FloatArray:
        return 0.5 * self.scale**2 * np.log1p((s / self.scale) ** 2)

    def weight(self, s: FloatArray) -> FloatArray:
        return 1.0 / (1.0 + (s / self.scale) ** 2)


@dataclass(frozen=True)
class GemanMcClure:
    """``(s^2/2) / (1 + (s/c)^2)``; bounded, so that a gross outlier stops pulling altogether."""

    scale: float = 3.0

    def __post_init__(self) -> None:
        _check(self.scale)

    def rho(self, s: FloatArray) -> FloatArray:
        return 0.5 * s**2 / (1.0 + (s / self.scale) ** 2)

    def weight(self, s: FloatArray) -> FloatArray:
        return 1.0 / (1.0 + (s / self.scale) ** 2) ** 2


def inlier_weight(scale: float) -> float:
    """Mean Geman-McClure weight of a residual of three rows that is as its covariance says.

    Information weighted so is too small by this factor; a covariance that is to be honest is divided by it.
    """
    s = np.linspace(0.0, 8.0, 4001)
    density = s**2 * np.exp(-0.5 * s**2)
    return float(np.sum(density * GemanMcClure(scale).weight(s)) / np.sum(density))


LOSSES: dict[str, type[Huber] | type[Cauchy] | type[GemanMcClure]] = {
    "huber": Huber,
    "cauchy": Cauchy,
    "geman_mcclure": GemanMcClure,
}


def make_loss(name: str | None, scale: float | None = None) -> Loss | None:
    """Loss by its name ("none", "huber", "cauchy", "geman_mcclure"), `scale` in standard deviations."""
    if name is None or name == "none":
        return None
    if name not in LOSSES:
        raise InputError("loss", "one of none, " + ", ".join(LOSSES), repr(name))
    return LOSSES[name]() if scale is None else LOSSES[name](scale)


def _check(scale: float) -> None:
    if not (np.isfinite(scale) and scale > 0.0):
        raise InputError("loss scale", "a number of standard deviations above zero", repr(scale))

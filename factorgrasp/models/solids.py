"""Masses with a centre and an inertia: put together, taken apart, cut out of a trunk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Solid:
    """A rigid mass.

    Attributes
    ----------
    mass : float
        kg.
    com : (3,) ndarray
        Centre of mass, m.
    inertia : (3, 3) ndarray
        About the centre of mass, kg m^2.
    """

    mass: float
    com: FloatArray
    inertia: FloatArray

    def about(self, point: FloatArray) -> FloatArray:
        """(3, 3) inertia about a point (Steiner), kg m^2."""
        d = self.com - point
        return np.asarray(self.inertia + self.mass * (d @ d * np.eye(3) - np.outer(d, d)))

    def moved(self, offset: FloatArray) -> Solid:
        """The same solid, moved by `offset` (3,), m."""
        return Solid(self.mass, self.com + offset, self.inertia)

    def mirrored(self) -> Solid:
        """The mirror image on the other side of the sagittal plane (y to -y)."""
        flip = np.diag([1.0, -1.0, 1.0])
        return Solid(self.mass, flip @ self.com, flip @ self.inertia @ flip)


def join(solids: Sequence[Solid]) -> Solid:
    """All of them as one rigid solid."""
    mass = sum(solid.mass for solid in solids)
    if mass <= 0.0:
        raise InputError("mass of the solids", "above 0 kg in all", f"{mass:.6g} kg")
    com = np.sum([solid.mass * solid.com for solid in solids], axis=0) / mass
    return Solid(mass, com, np.sum([solid.about(com) for solid in solids], axis=0))


def remove(whole: Solid, part: Solid) -> Solid:
    """What is left of `whole` without `part`: mass, centre of mass and inertia of both together are those of `whole`."""
    mass = whole.mass - part.mass
    com = (whole.mass * whole.com - part.mass * part.com) / mass
    d = com - whole.com
    steiner = mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Solid(mass, com, whole.inertia - part.about(whole.com) - steiner)


def rod(mass: float, start: FloatArray, end: FloatArray, density: float) -> Solid:
    """A circular cylinder from `start` to `end` with the radius that its density (kg/m^3) asks for."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    radius2 = mass / (density * np.pi * length)
    u = np.outer(axis, axis) / length**2
    across = mass * (radius2 / 4.0 + length**2 / 12.0)
    return Solid(mass, 0.5 * (start + end), across * (np.eye(3) - u) + 0.5 * mass * radius2 * u)


def box(mass: float, centre: FloatArray, size: FloatArray) -> Solid:
    """A homogeneous box with edges `size` (3,) along the axes."""
    s2 = np.asarray(size, dtype=float) ** 2
    return Solid(mass, np.asarray(centre, dtype=float), mass / 12.0 * np.diag(s2.sum() - s2))


def gyration(mass: float, com: FloatArray, radii: FloatArray) -> Solid:
    """From radii of gyration (3,) about the axes x, y, z through the centre of mass, m."""
    return Solid(mass, np.asarray(com, dtype=float), mass * np.diag(np.asarray(radii, dtype=float) ** 2))


@dataclass(frozen=True)
class Column:
    """A part of the trunk: an upright column whose density per height is linear, and whose cross-section is the same all the way.

    It has the mass, the centre of mass and the cross-section's second moments that a table gives for the whole part, and can be cut.

    Attributes
    ----------
    bottom, top : float
        Heights, m.
    mass : float
        kg.
    com : float
        Height of the centre of mass, m; within the middle third.
    spread_x, spread_y : float
        Second moments of the cross-section per mass, ``<x^2>`` and ``<y^2>``, m^2.
    """

    bottom: float
    top: float
    mass: float
    com: float
    spread_x: float
    spread_y: float

    def __post_init__(self) -> None:
        if not abs(self.slope) <= 2.0:
            raise InputError(
                "centre of mass of a part of the trunk",
                f"between {self.bottom:.3f} and {self.top:.3f} m, in the middle third",
                f"{self.com:.3f} m",
            )
        if min(self.spread_x, self.spread_y) < 0.0:
            raise InputError(
                "cross-section of a part of the trunk",
                "second moments above zero",
                f"{self.spread_x}, {self.spread_y}",
            )

    @property
    def slope(self) -> float:
        """Slope b of the density ``m / L (1 + b u)``, u from -1/2 (bottom) to 1/2 (top), that puts the centre of mass in its place."""
        return 12.0 * ((self.com - self.bottom) / (self.top - self.bottom) - 0.5)

    def slice(self, low: float, high: float) -> Solid | None:
        """What lies between two heights; None where there is nothing."""
        low, high = max(low, self.bottom), min(high, self.top)
        if high <= low:
            return None
        length, b = self.top - self.bottom, self.slope
        middle = 0.5 * (self.top + self.bottom)
        u = (np.array([low, high]) - middle) / length
        m0, m1, m2 = (float(np.diff(u**k / k + b * u ** (k + 1) / (k + 1))[0]) for k in (1, 2, 3))
        mass, centre = self.mass * m0, m1 / m0
        height = length**2 * (m2 / m0 - centre**2)
        second = np.array([self.spread_x, self.spread_y, height])
        return Solid(
            mass, np.array([0.0, 0.0, middle + length * centre]), mass * np.diag(second.sum() - second)
        )

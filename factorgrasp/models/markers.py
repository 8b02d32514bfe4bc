"""Markers on a rigid palm: where they are in the wrist frame, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray

PALM_NAMES = ("wrist", "thumb_mcp", "index_mcp", "middle_mcp", "ring_mcp", "little_mcp")
PALM_POINTS = (
    (0.000, 0.000, 0.000),
    (0.038, 0.046, -0.014),
    (0.092, 0.024, 0.001),
    (0.095, 0.000, 0.000),
    (0.087, -0.021, -0.002),
    (0.075, -0.040, -0.006),
)
"""An adult right hand seen from above (back of the hand), m: the palm is not flat, the thumb lies about 14 mm below."""
SMALLEST_SPREAD = 5e-3


@dataclass(frozen=True, eq=False)
class MarkerLayout:
    """Positions of n >= 3 markers in the wrist frame ``W`` with their joint covariance.

    ``W``: origin at the wrist marker, x towards the marker of the middle finger's joint, z normal to the palm (out of the back of the hand,
    towards a camera above it), y completes the right-handed frame.

    Attributes
    ----------
    names : tuple of str
    points : (n, 3) ndarray
        m.
    covariance : (3n, 3n) ndarray
        m^2, of ``points.ravel()``; zero where the layout is exact.

    Raises
    ------
    InputError
        For fewer than three markers, markers on one line (the pose about it could not be seen), or a covariance that is none.
    """

    names: tuple[str, ...]
    points: FloatArray
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        names, points = tuple(self.names), np.array(self.points, dtype=float)
        count = len(names)
        if points.shape != (count, 3) or not np.all(np.isfinite(points)):
            raise InputError(
                "markers: points", f"{count} finite points, shape ({count}, 3), m", str(points.shape)
            )
        if count < 3:
            raise InputError("markers", "at least three: fewer do not fix an orientation", str(count))
        if len(set(names)) != count:
            raise InputError("markers: names", "unique names", ", ".join(names))
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[0] > 2.0:
            raise InputError(
                "markers: points",
                "a palm, in metres",
                f"markers {spread[0]:.3g} m apart",
                "Are they in millimetres?",
            )
        if spread[1] < SMALLEST_SPREAD * 0.2:
            raise InputError("markers: points", "markers that are not on one line", "markers on one line")
        covariance = np.array(self.covariance, dtype=float)
        if covariance.size == 0:
            covariance = np.zeros((3 * count, 3 * count))
        if covariance.shape != (3 * count, 3 * count):
            raise InputError(
                "markers: covariance", f"shape ({3 * count}, {3 * count}), m^2", str(covariance.shape)
            )
        smallest = float(np.linalg.eigvalsh(0.5 * (covariance + covariance.T)).min())
        if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-18) or smallest < -1e-12:
            raise InputError(
                "markers: covariance", "a symmetric matrix without negative eigenvalues", f"{smallest:.3g}"
            )
        for array in (points, covariance):
            array.setflags(write=False)
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "covariance", covariance)

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def with_sd(cls, names: tuple[str, ...], points: ArrayLike, sd: ArrayLike = 0.0) -> MarkerLayout:
        """A layout whose coordinates are known to `sd` (a scalar, (n,) or (n, 3), m), independently of each other."""
        where = np.asarray(points, dtype=float)
        spread = np.asarray(sd, dtype=float)
        if spread.ndim == 1:
            spread = spread[:, None]
        return cls(names, where, np.diag(np.broadcast_to(spread, where.shape).ravel() ** 2))

    @classmethod
    def palm(cls, sd: float = 1e-3, scale: float = 1.0) -> MarkerLayout:
        """The six markers of Cordella 2014 on an average adult right hand, `scale` times as large, known to `sd` (m)."""
        return cls.with_sd(PALM_NAMES, scale * np.array(PALM_POINTS), sd)

    @property
    def sd(self) -> FloatArray:
        """(n, 3) m."""
        return np.asarray(np.sqrt(np.diag(self.covariance)).reshape(-1, 3))

    @property
    def blocks(self) -> FloatArray:
        """(n, 3, 3) covariance of every marker by itself, m^2."""
        count = len(self)
        return np.asarray(self.covariance.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)])

    @property
    def distances(self) -> FloatArray:
        """(n, n) m."""
        return np.asarray(np.linalg.norm(self.points[:, None] - self.points[None], axis=-1))

    @property
    def planar(self) -> bool:
        """Whether all markers lie within 1 mm of one plane."""
        return bool(np.linalg.svd(self.points - self.points.mean(axis=0), compute_uv=False)[2] < 1e-3)

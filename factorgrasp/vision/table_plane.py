"""The table under the hand, from depth alone: a plane has an inverse depth that is affine in the pixel.

Skin colour selects a wooden table as well; height above the table does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factorgrasp.typing import FloatArray
from factorgrasp.vision.images import metres

_STEP = 16
_TRIALS = 32
_LEAST_SHARE = 0.25
"""Of the image that must lie on one plane for it to be called a table; a hand alone covers less."""


@dataclass(frozen=True, eq=False)
class TablePlane:
    """``1 / z = coefficients . [u, v, 1]``.

    Attributes
    ----------
    coefficients : ndarray, shape (3,)
        1/(m px), 1/(m px), 1/m.
    share : float
        Of the image that lies on it.
    sd : float
        Of one depth pixel about the plane, in inverse depth, 1/m.
    """

    coefficients: FloatArray
    share: float
    sd: float

    def depth(self, uv: ArrayLike) -> FloatArray:
        """Depth (...,) of the plane at pixels (..., 2), m; infinite beyond its horizon."""
        q = np.asarray(uv, dtype=float)
        inverse = q @ self.coefficients[:2] + self.coefficients[2]
        return np.asarray(np.where(inverse > 1e-3, 1.0 / np.maximum(inverse, 1e-3), np.inf))


def fit_table(depth: NDArray[Any], step: int = _STEP) -> TablePlane | None:
    """The plane that most of the image lies on; None when no plane covers a quarter of it.

    Parameters
    ----------
    depth : ndarray, shape (h, w)
        m; zero or NaN where missing.
    step : int
        Every so many pixels is looked at, in rows and in columns.
    """
    step = max(min(step, min(depth.shape) // 12), 1)
    v, u = np.mgrid[step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step]
    z = metres(depth[v, u]).ravel()
    cells = z.size
    known = np.isfinite(z)
    if known.sum() < max(12, _LEAST_SHARE * cells):
        return None
    rows = np.column_stack([u.ravel(), v.ravel(), np.ones(cells)])[known]
    inverse = 1.0 / z[known]
    # Depth cameras measure disparity: their noise is about even in inverse depth.
    gate = 0.012 * max(float(np.median(inverse)), 0.3)
    rng = np.random.default_rng(5)
    picks = rng.integers(0, inverse.size, size=(_TRIALS, 3))
    systems = rows[picks]
    sound = np.abs(np.linalg.det(systems)) > 1e3
    if not sound.any():
        return None
    planes = np.linalg.solve(systems[sound], inverse[picks[sound]][..., None])[..., 0]
    inliers = np.abs(rows @ planes.T - inverse[:, None]) < gate
    best = inliers[:, int(np.argmax(inliers.sum(axis=0)))]
    for _ in range(3):
        plane, *_ = np.linalg.lstsq(rows[best], inverse[best], rcond=None)
        residual = rows @ plane - inverse
        sd = max(1.4826 * float(np.median(np.abs(residual[best]))), 1e-5)
        best = np.abs(residual) < min(max(4.0 * sd, 1e-4), gate)
        if best.sum() < 12:
            return None
    share = float(best.sum()) / cells
    return TablePlane(plane, share, sd) if share >= _LEAST_SHARE else None

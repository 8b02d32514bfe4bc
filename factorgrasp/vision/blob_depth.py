"""Depth of a marker from the depth pixels of its disc, outliers rejected."""

from __future__ import annotations

import numpy as np

from factorgrasp.typing import BoolArray, FloatArray
from factorgrasp.vision.images import middle as centre

_LEAST_GATE = 4e-3
"""m: what differs less from the median is never called an outlier."""
_QUANTISATION = 1e-3
"""m, of depth images."""


def disc_depth(depth: FloatArray, mask: BoolArray, at: FloatArray, correlated: float) -> tuple[float, float]:
    """Depth and its variance at the centroid of a blob.

    The disc is taken as a plane, whose depth at the centroid is what counts: a disc of which a part is missing would else be read where its
    rest is.

    Parameters
    ----------
    depth : ndarray, shape (h, w)
        Of a window, m, NaN where missing.
    mask : ndarray of bool, shape (h, w)
        The blob's pixels.
    at : ndarray, shape (2,)
        Centroid in the window, px.
    correlated : float
        Number of neighbouring pixels that share one error.

    Returns
    -------
    (float, float)
        m and m^2; NaN and NaN with fewer than three pixels that agree, or fewer than a fifth of the disc.
    """
    v, u = np.nonzero(mask & np.isfinite(depth))
    z = depth[v, u]
    if z.size < max(3, 0.2 * mask.sum()):
        return np.nan, np.nan
    kept = np.ones(z.size, dtype=bool)
    for _ in range(2):
        middle = float(centre(z[kept]))
        spread = 1.4826 * float(centre(np.abs(z[kept] - middle)))
        kept = np.abs(z - middle) <= max(3.5 * spread, _LEAST_GATE)
    z, u, v = z[kept], u[kept] - at[0], v[kept] - at[1]
    if z.size < max(3, 0.2 * mask.sum()):
        return np.nan, np.nan
    rows = np.ones((z.size, 1))
    if z.size >= 12:
        rows = np.column_stack([rows, u, v])
    normal = rows.T @ rows
    # Pixels on one line do not show a slope.
    if rows.shape[1] == 3 and np.linalg.det(normal[1:, 1:]) < 1e-3 * normal[1, 1] * normal[2, 2]:
        rows, normal = rows[:, :1], normal[:1, :1]
    solution = np.linalg.solve(normal, rows.T @ z)
    residual = z - rows @ solution
    degrees = max(z.size - rows.shape[1], 1)
    noise = float(residual @ residual) / degrees + _QUANTISATION**2 / 12.0
    share = float(np.linalg.inv(normal)[0, 0])
    variance = noise * min(share * correlated, 1.0) + _QUANTISATION**2 / 12.0
    return float(solution[0]), variance

"""Sub-pixel centroids: how much of each pixel is marker, from the colours beside and inside it.

A pixel on the edge is a mixture ``c = alpha m + (1 - alpha) b`` of the marker's and the surrounding colour in linear light, which is
how lens and sensor mix them. Its share alpha is read along the direction that separates both best against the scatter of the surroundings
(linear discriminant), whose inverse separation also is the standard deviation of alpha.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.typing import BoolArray, FloatArray
from factorgrasp.vision.images import LINEAR, ByteImage, middle, quantile

_SHADING = 0.2
"""Relative standard deviation of the brightness of the surroundings."""
_EDGE = 1.7
"""px beyond the outline that still count for the centroid: the reach of the lens' blur."""
_RAYS = 40
_TURN = np.linspace(0.0, 2.0 * np.pi, _RAYS, endpoint=False)
_DIRECTIONS = np.column_stack([np.cos(_TURN), np.sin(_TURN)])


@dataclass(frozen=True, eq=False)
class SoftBlob:
    """One blob in a window of the image.

    Attributes
    ----------
    corner : ndarray, shape (2,)
        Pixel (u, v) of the window's first pixel.
    alpha : ndarray, shape (h, w)
        Share of each pixel that is marker; noise may take it below 0 or above 1.
    window : ndarray of bool, shape (h, w)
        Pixels that belong to this blob or its edge, and to no other.
    alpha_variance : float
        Of alpha in one pixel.
    centroid : ndarray, shape (2,)
        In the window, px.
    covariance : ndarray, shape (2, 2)
        Of the centroid from the noise of alpha, px^2.
    outline : ndarray, shape (_RAYS, 2)
        Where alpha falls through one half, in the window.
    area : float
        Inside of the outline, px.
    moment : ndarray, shape (2, 2)
        Second moment of the area inside of the outline, px^2; a full ellipse has a quarter of its squared semi-axes.
    middle : ndarray, shape (2,)
        Centre of that area.
    """

    corner: FloatArray
    alpha: FloatArray
    window: BoolArray
    alpha_variance: float
    centroid: FloatArray
    covariance: FloatArray
    outline: FloatArray
    area: float
    moment: FloatArray
    middle: FloatArray

    @property
    def elongation(self) -> float:
        """Ratio of the axes of the outline."""
        values = np.linalg.eigvalsh(self.moment)
        return float(np.sqrt(values[1] / max(values[0], 1e-9)))


def soften(
    rgb: ByteImage, inside: BoolArray, ring: BoolArray, window: BoolArray, corner: FloatArray
) -> SoftBlob | None:
    """The blob with the pixels `inside` of a window of the image; None when its colour does not stand out of that of the `ring`.

    Parameters
    ----------
    rgb : ndarray of uint8, shape (h, w, 3)
        The window of the image.
    inside, ring, window : ndarray of bool, shape (h, w)
        The connected component, what surrounds it, and the component with its edge.
    corner : ndarray, shape (2,)
        Pixel of the window's first pixel.
    """
    light = LINEAR[rgb]
    around = light[ring]
    if around.shape[0] < 8:
        return None
    back = middle(around)
    away = around - back
    # A few pixels of something else beside the hand must not decide the scatter.
    size = np.einsum("ij,ij->i", away, away)
    kept = away[size <= quantile(size, 0.9)]
    scatter = kept.T @ kept / kept.shape[0] + np.diag(1e-6 + (0.01 * back) ** 2)
    # Shading makes the same skin brighter or darker under the marker than in the ring: that must not look like marker.
    scatter += _SHADING**2 * np.outer(back, back)
    direction = np.linalg.solve(scatter, light[inside].mean(axis=0) - back)
    value = (light - back) @ direction
    full = quantile(value[inside], 0.7)
    if full < 4.0:
        # Less than two standard deviations between marker and surroundings.
        return None
    alpha = value / full
    # Skin is shaded: its colour changes across the marker, and with it where alpha is zero.
    slope, spread = _background_slope(alpha, ring)
    alpha = (alpha - slope) / np.maximum(1.0 - slope, 0.5)
    only = np.where(window, alpha, 0.0)
    v, u = np.nonzero(window)
    weight = np.clip(alpha[v, u], 0.0, 1.0)
    if weight.sum() < 1.0:
        return None
    shape = find_outline(only, np.array([weight @ u, weight @ v]) / weight.sum())
    area, heart, moment = polygon_moments(shape)
    if area < 1.0:
        return None
    near = window & _within(moment, heart, _EDGE, alpha.shape)
    v, u = np.nonzero(near)
    weight = alpha[v, u]
    total = float(weight.sum())
    if total < 1.0:
        return None
    centroid = np.array([weight @ u, weight @ v]) / total
    arm = np.column_stack([u, v]) - centroid
    covariance = spread / total**2 * (arm.T @ arm)
    return SoftBlob(corner, alpha, window, spread, centroid, covariance, shape, area, moment, heart)


def _background_slope(alpha: FloatArray, ring: BoolArray) -> tuple[FloatArray, float]:
    """Plane (h, w) through alpha in the ring, without its farthest tenth, and the variance about it."""
    h, w = alpha.shape
    v, u = np.nonzero(ring)
    rows = np.column_stack([np.ones(u.size), u - 0.5 * w, v - 0.5 * h])
    values = alpha[v, u]
    kept = np.abs(values - middle(values))
    near = kept <= quantile(kept, 0.9)
    rows, values = rows[near], values[near]
    normal = rows.T @ rows + np.diag([1e-9, 1.0, 1.0])
    plane = np.linalg.solve(normal, rows.T @ values)
    spread = float(np.mean((values - rows @ plane) ** 2))
    level = plane[0] + plane[1] * (np.arange(w) - 0.5 * w) + plane[2] * (np.arange(h)[:, None] - 0.5 * h)
    return np.clip(level, -0.3, 0.3), spread


def _within(moment: FloatArray, heart: FloatArray, margin: float, shape: tuple[int, ...]) -> BoolArray:
    """Pixels (h, w) inside of the ellipse with a second moment, grown by a margin (px)."""
    values, vectors = np.linalg.eigh(moment)
    grown = np.sqrt(4.0 * np.maximum(values, 0.05)) + margin
    inverse = (vectors / grown) @ vectors.T
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    x, y = u - heart[0], v - heart[1]
    p, q = inverse[0, 0] * x + inverse[0, 1] * y, inverse[1, 0] * x + inverse[1, 1] * y
    return np.asarray(p * p + q * q <= 1.0)


def find_outline(alpha: FloatArray, centre: FloatArray, step: float = 0.5) -> FloatArray:
    """Where alpha first falls through one half on rays (_RAYS, 2) from a centre."""
    h, w = alpha.shape
    reach = np.arange(0.0, 0.75 * float(np.hypot(h, w)), step)
    u = centre[0] + reach[None] * _DIRECTIONS[:, :1]
    v = centre[1] + reach[None] * _DIRECTIONS[:, 1:]
    value = bilinear(alpha, u, v)
    below = value < 0.5
    # The centre may lie in a dent of a merged or hidden blob: start from the first pixel of the blob on the ray.
    started = np.maximum.accumulate(~below, axis=1)
    leaves = below & started
    k = np.where(leaves.any(axis=1), np.argmax(leaves, axis=1), 1)
    k = np.maximum(k, 1)
    row = np.arange(_RAYS)
    a, b = value[row, k - 1], value[row, k]
    part = np.clip((a - 0.5) / np.where(a - b > 1e-9, a - b, 1.0), 0.0, 1.0)
    distance = np.where(leaves.any(axis=1), (k - 1 + part) * step, 0.0)
    return np.asarray(centre + distance[:, None] * _DIRECTIONS)


def bilinear(image: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Values between pixels; 0 outside."""
    h, w = image.shape
    padded = np.zeros((h + 2, w + 2))
    padded[1:-1, 1:-1] = image
    x, y = np.clip(u + 1.0, 0.0, w + 0.999), np.clip(v + 1.0, 0.0, h + 0.999)
    i, j = y.astype(np.intp), x.astype(np.intp)
    a, b = y - i, x - j
    flat, width = padded.ravel(), w + 2
    at = i * width + j
    return np.asarray(
        (1.0 - a) * ((1.0 - b) * flat[at] + b * flat[at + 1])
        + a * ((1.0 - b) * flat[at + width] + b * flat[at + width + 1])
    )


def polygon_moments(points: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Area, centre (2,) and second central moment (2, 2) of the area inside of a polygon (k, 2)."""
    origin = points.mean(axis=0)
    p = points - origin
    q = np.roll(p, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]
    area = 0.5 * float(cross.sum())
    if abs(area) < 1e-9:
        return 0.0, origin, np.eye(2)
    heart = cross @ (p + q) / (6.0 * area)
    second = np.einsum("k,ki,kj->ij", cross, p, p) + np.einsum("k,ki,kj->ij", cross, q, q)
    second += 0.5 * (np.einsum("k,ki,kj->ij", cross, p, q) + np.einsum("k,ki,kj->ij", cross, q, p))
    moment = second / (12.0 * area) - np.outer(heart, heart)
    return abs(area), origin + heart, moment

"""Which blob is which marker of a palm, from where they are in space: no order, no track, no first frame by hand."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, permutations

import numpy as np

from factorgrasp.typing import FloatArray, IntArray

_MOST_UNLIKE = 0.04
"""m: a distance between two markers of a hand differs less from that of the template, scaled."""
MOST_POINTS = 9
"""Points that all labellings are tried of; 6 of 9 are 60480."""


@dataclass(frozen=True, eq=False)
class Labelling:
    """How points are given to markers.

    Attributes
    ----------
    order : ndarray of int, shape (n,)
        Point of each marker.
    rotation : ndarray, shape (3, 3)
        ``R_c_w``.
    position : ndarray, shape (3,)
        ``p_c_w``, m.
    scale : float
        Size of the hand relative to the template.
    rms : float
        Of the distances between points and template, m.
    second : float
        The same of the best labelling that differs, m: how clear the choice was.
    """

    order: IntArray
    rotation: FloatArray
    position: FloatArray
    scale: float
    rms: float
    second: float


def nearest_together(points: FloatArray, count: int, reach: float = 0.16) -> IntArray:
    """The `count` points (as sorted rows) with the most others within `reach` (m) of them: a hand among clutter."""
    away = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = (away < reach).sum(axis=1)
    return np.sort(np.argsort(-near, kind="stable")[:count])


@lru_cache(maxsize=8)
def _all_orders(count: int, markers: int) -> IntArray:
    """Every choice of points for the markers, in every order."""
    chosen = [order for some in combinations(range(count), markers) for order in permutations(some)]
    return np.array(chosen, dtype=np.intp)


def _alike(
    points: FloatArray, template: FloatArray, orders: IntArray, scales: tuple[float, float]
) -> IntArray:
    """Orders under which no distance between two points differs much from the template's: they alone are worth aligning."""
    first, second = np.triu_indices(template.shape[0], 1)
    wanted = np.linalg.norm(template[first] - template[second], axis=1)
    away = np.linalg.norm(points[:, None] - points[None], axis=2)
    found = away[orders[:, first], orders[:, second]]
    scale = np.clip(found @ wanted / (wanted @ wanted), *scales)
    worst = np.abs(found - scale[:, None] * wanted).max(axis=1)
    return np.asarray(orders[worst < _MOST_UNLIKE])


def label_points(
    points: FloatArray, template: FloatArray, scales: tuple[float, float] = (0.7, 1.35), facing: bool = True
) -> Labelling | None:
    """The labelling under which the points are most similar to a template.

    Every choice of points for the markers is aligned by rotation, translation and scale (Umeyama 1991); of those whose scale is that of a
    hand the one with the smallest residual is taken.

    Parameters
    ----------
    points : ndarray, shape (m, 3)
        In the camera frame, m; at most :data:`MOST_POINTS`.
    template : ndarray, shape (n, 3)
        Markers in W, n <= m.
    scales : (float, float)
        Allowed sizes relative to the template; (1, 1) for a layout that is known.
    facing : bool
        Whether z of W must point towards the camera; a nearly flat palm fits its own mirror image seen from behind.

    Returns
    -------
    Labelling or None
        None with too few or too many points, or when no labelling has an allowed scale.
    """
    count, markers = points.shape[0], template.shape[0]
    if not markers <= count <= MOST_POINTS:
        return None
    orders = _alike(points, template, _all_orders(count, markers), scales)
    if orders.shape[0] == 0:
        return None
    model = template - template.mean(axis=0)
    chosen = points[orders]
    middle = chosen.mean(axis=1)
    cloud = chosen - middle[:, None]
    # Kabsch for all labellings at once: H = sum_i q_i m_i'.
    H = np.einsum("kni,nj->kij", cloud, model)
    U, S, Vt = np.linalg.svd(H)
    sign = np.sign(np.linalg.det(U @ Vt))
    S = S.copy()
    S[:, 2] *= sign
    size = float(np.sum(model**2))
    free = S.sum(axis=1) / size
    scale = np.clip(free, *scales)
    squares = np.einsum("kni,kni->k", cloud, cloud)
    cost = squares - 2.0 * scale * S.sum(axis=1) + scale**2 * size
    D = np.zeros_like(U)
    D[:, 0, 0], D[:, 1, 1], D[:, 2, 2] = 1.0, 1.0, sign
    R = U @ D @ Vt
    position = middle - scale[:, None] * (R @ template.mean(axis=0))
    cost = np.where((free < 0.9 * scales[0]) | (free > 1.1 * scales[1]), np.inf, cost)
    if facing:
        cost = np.where(np.einsum("ki,ki->k", R[:, :, 2], middle) < 0.0, cost, np.inf)
    ranked = np.argsort(cost)
    best = int(ranked[0])
    if not np.isfinite(cost[best]):
        return None
    rms = np.sqrt(np.maximum(cost, 0.0) / markers)
    second = float(rms[ranked[1]]) if ranked.size > 1 else np.inf
    return Labelling(orders[best], R[best], position[best], float(scale[best]), float(rms[best]), second)

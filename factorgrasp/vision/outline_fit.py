"""Where the centre of a marker is of which a part is hidden, or that touches another one: its shape is known from the whole ones.

The centroid of what is seen of a half-hidden marker is off by a fifth of its diameter. Its true edge still lies on the outline of a
marker; the edge of what hides it lies inside of that outline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.typing import FloatArray
from factorgrasp.vision.soft_blob import SoftBlob

_INSIDE = 0.9
"""px: a point of the edge that far inside of the outline is no edge of the marker."""
_EDGE_SD = 0.12
"""px: least scatter of an edge point about the outline: noise, pixels, shape."""
_DOUBT = 0.6
"""px: fits whose cost differs by less than the square of this are both possible."""
_STEPS = 8
_STARTS = 7


@dataclass(frozen=True, eq=False)
class FittedCentre:
    """Centre of a marker's outline.

    Attributes
    ----------
    centre : ndarray, shape (2,)
        In the window of the blob, px.
    covariance : ndarray, shape (2, 2)
        px^2.
    share : float
        Of the edge points that lie on the outline.
    rms : float
        Distance of these from it, px.
    """

    centre: FloatArray
    covariance: FloatArray
    share: float
    rms: float


def fit_outline(points: FloatArray, moment: FloatArray, middle: FloatArray) -> FittedCentre:
    """The ellipse of given shape through the edge points that are the marker's.

    Points outside of the outline cost the square of their distance, since nothing makes a marker larger; points inside cost no more
    than :data:`_INSIDE` squared / 3, since something may hide a part of it (Tukey's loss on that side).

    Parameters
    ----------
    points : ndarray, shape (k, 2)
        Edge of what is seen, px.
    moment : ndarray, shape (2, 2)
        Second moment of a whole marker there, px^2.
    middle : ndarray, shape (2,)
        Centre of what is seen, px.
    """
    root = np.linalg.cholesky(4.0 * moment)
    inverse = np.linalg.inv(root)
    size = float(np.sqrt(np.linalg.det(root)))
    turn = np.linspace(0.0, 2.0 * np.pi, _STARTS - 1, endpoint=False)
    offsets = 0.55 * size * np.column_stack([np.cos(turn), np.sin(turn)])
    centre = middle + np.vstack([np.zeros((1, 2)), offsets])

    for step in range(_STEPS + 1):
        gap, normal = _gaps(points, centre, inverse)
        inner = np.clip(1.0 - (np.minimum(gap, 0.0) / _INSIDE) ** 2, 0.0, None)
        weight = np.where(gap > 0.0, 1.0, inner**2)
        if step == _STEPS:
            break
        information = np.einsum("sk,ski,skj->sij", weight, normal, normal) + 1e-3 * np.eye(2)
        pull = np.einsum("sk,sk,ski->si", weight, gap, normal)
        move = np.linalg.solve(information, pull[..., None])[..., 0]
        length = np.linalg.norm(move, axis=1, keepdims=True)
        centre = centre + move * np.minimum(1.0, 0.5 * size / np.maximum(length, 1e-9))
    cost = np.where(gap > 0.0, gap**2, _INSIDE**2 / 3.0 * (1.0 - inner**3)).sum(axis=1)
    best = int(np.argmin(cost))
    on = weight[best] > 0.5
    count = max(int(on.sum()), 1)
    rms = float(np.sqrt(np.mean(gap[best, on] ** 2))) if on.any() else _INSIDE
    information = np.einsum("k,ki,kj->ij", weight[best], normal[best], normal[best])
    values, vectors = np.linalg.eigh(information)
    # Neighbouring rays see the same pixel: about two of them are one measurement.
    noise = 2.0 * max(rms, _EDGE_SD) ** 2 * points.shape[0] / max(count, 8)
    spread = np.minimum(noise / np.maximum(values, 1e-6), (0.5 * size) ** 2)
    covariance = (vectors * spread) @ vectors.T
    # A small part of an outline may fit in more than one place: that doubt is the spread of the places.
    chance = np.exp(-0.5 * (cost - cost[best]) / _DOUBT**2)
    away = centre - centre[best]
    covariance = covariance + (away * chance[:, None]).T @ away / chance.sum()
    return FittedCentre(centre[best], covariance, float(on.mean()), rms)


def outline_rms(points: FloatArray, moment: FloatArray, centre: FloatArray) -> float:
    """Distance of edge points (k, 2) from the outline of a whole marker at a centre (2,), px."""
    gap, _ = _gaps(points, centre[None], np.linalg.inv(np.linalg.cholesky(4.0 * moment)))
    return float(np.sqrt(np.mean(gap**2)))


def _gaps(points: FloatArray, centre: FloatArray, inverse: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Signed distances (s, k), positive outside, and outward normals (s, k, 2) for centres (s, 2)."""
    arm = points[None] - centre[:, None]
    scaled = arm @ inverse.T
    radius = np.maximum(np.sqrt(np.einsum("ski,ski->sk", scaled, scaled)), 1e-6)
    gradient = scaled @ inverse / radius[..., None]
    slope = np.maximum(np.sqrt(np.einsum("ski,ski->sk", gradient, gradient)), 1e-9)
    return (radius - 1.0) / slope, gradient / slope[..., None]


def split_blob(blob: SoftBlob, moment: FloatArray, count: int, blur: float = 1.3) -> list[FittedCentre]:
    """Centres of `count` markers of given shape that merged into one blob, by least squares on alpha.

    Parameters
    ----------
    blob : SoftBlob
    moment : ndarray, shape (2, 2)
        Second moment of one whole marker there, px^2.
    count : int
    blur : float
        Width over which alpha falls from 1 to 0 across an edge, px.
    """
    inverse = np.linalg.inv(np.linalg.cholesky(4.0 * moment))
    v, u = np.nonzero(blob.window)
    at, alpha = np.column_stack([u, v]).astype(float), blob.alpha[blob.window]
    centre = _spread_out(at, np.clip(alpha, 0.0, 1.0), count)
    damping, previous = 1e-2, np.inf
    accepted = centre
    information = np.eye(2 * count)
    for _ in range(15):
        model, slope = _union(at, centre, inverse, blur)
        residual = alpha - model
        error = float(residual @ residual)
        if error < previous:
            accepted, previous, damping = centre, error, 0.3 * damping
            J = slope.reshape(at.shape[0], 2 * count)
            information, gradient = J.T @ J, J.T @ residual
        else:
            damping *= 10.0
        step = np.linalg.solve(information + damping * np.eye(2 * count), gradient).reshape(count, 2)
        if np.abs(step).max() < 1e-3:
            break
        centre = accepted + np.clip(step, -2.0, 2.0)
    noise = max(previous / max(alpha.size - 2 * count, 1), blob.alpha_variance)
    covariance = np.asarray(np.linalg.inv(information + 1e-2 * np.eye(2 * count)) * noise, dtype=float)
    rms = float(np.sqrt(previous / alpha.size))
    return [
        FittedCentre(accepted[i], covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2], 1.0, rms)
        for i in range(count)
    ]


def _spread_out(at: FloatArray, weight: FloatArray, count: int) -> FloatArray:
    """Starting centres along the long axis of the blob, improved by a few steps of weighted k-means."""
    total = weight.sum()
    middle = weight @ at / total
    arm = at - middle
    values, vectors = np.linalg.eigh((arm * weight[:, None]).T @ arm / total)
    along = np.linspace(-1.0, 1.0, count)[:, None] * np.sqrt(values[1]) * vectors[:, 1]
    centre = middle + along
    for _ in range(6):
        owner = np.argmin(((at[:, None] - centre[None]) ** 2).sum(axis=2), axis=1)
        for i in range(count):
            mine = weight * (owner == i)
            if mine.sum() > 0.5:
                centre[i] = mine @ at / mine.sum()
    return np.asarray(centre)


def _union(
    at: FloatArray, centre: FloatArray, inverse: FloatArray, blur: float
) -> tuple[FloatArray, FloatArray]:
    """Alpha (p,) of a union of soft ellipses, and its slope (p, count, 2) by their centres."""
    gap, normal = _gaps(at, centre, inverse)
    each = np.clip(0.5 - gap / blur, 0.0, 1.0)
    owner = np.argmax(each, axis=0)
    pixel = np.arange(at.shape[0])
    model = each[owner, pixel]
    slope = np.zeros((at.shape[0], centre.shape[0], 2))
    edge = (model > 0.0) & (model < 1.0)
    slope[pixel[edge], owner[edge]] = normal[owner[edge], pixel[edge]] / blur
    return model, slope

"""How large a whole marker is in an image: from what most blobs share, or from a known diameter."""

from __future__ import annotations

import numpy as np

from factorgrasp.models.camera import Camera
from factorgrasp.typing import FloatArray
from factorgrasp.vision.blobs import Candidate
from factorgrasp.vision.outline_fit import outline_rms
from factorgrasp.vision.soft_blob import SoftBlob

_ROUND = 1.15
"""Elongation of what certainly is no half of a disc (1.9)."""


def area_scales(candidates: list[Candidate]) -> FloatArray:
    """Factor (k,) by which an area is to be multiplied to compare it with the others: they shrink with distance squared."""
    depth = np.array([candidate.depth for candidate in candidates], dtype=float)
    if not np.isfinite(depth).any():
        return np.ones(depth.size)
    middle = float(np.nanmedian(depth))
    return np.asarray((np.where(np.isfinite(depth), depth, middle) / middle) ** 2)


def is_elliptic(soft: SoftBlob) -> bool:
    """Whether the outline of a blob is an ellipse, as that of a whole marker is."""
    rough = max(0.2, 0.045 * np.sqrt(soft.area))
    if soft.elongation < _ROUND:
        return True
    return soft.elongation < 2.5 and outline_rms(soft.outline, soft.moment, soft.middle) < rough


def palm_moment(candidates: list[Candidate], camera: Camera, diameter: float) -> FloatArray | None:
    """Second moment (2, 2) of a disc of known diameter that lies in the plane of the blobs, at their middle distance, px^2.

    None unless four blobs with depth span a plane that the camera sees from above.
    """
    known = [c for c in candidates if np.isfinite(c.depth)]
    if len(known) < 4:
        return None
    uv = np.array([c.soft.corner + c.soft.centroid for c in known])
    points = camera.back_project(uv, np.array([c.depth for c in known]))
    middle = np.median(points, axis=0)
    _, spread, axes = np.linalg.svd(points - points.mean(axis=0))
    if spread[1] < 0.01 or spread[2] > 0.4 * spread[1]:
        return None
    normal = axes[2]
    if abs(normal @ middle) < 0.35 * np.linalg.norm(middle):
        return None
    _, J = camera.project_with_jacobian(middle)
    within = np.eye(3) - np.outer(normal, normal)
    return np.asarray(diameter**2 / 16.0 * J @ within @ J.T)


def common_size(candidates: list[Candidate], scale: FloatArray) -> tuple[FloatArray | None, int]:
    """Second moment (2, 2) of a whole marker at the middle distance, from the size that most blobs share, and their number."""
    if len(candidates) < 2:
        return None, 0
    area = np.array([candidate.soft.area for candidate in candidates]) * scale
    round_ = np.array([is_elliptic(candidate.soft) for candidate in candidates])
    if round_.sum() < 2:
        return None, 0
    shape = np.array([c.soft.moment / np.sqrt(np.linalg.det(c.soft.moment)) for c in candidates])
    # Halves of discs are as large as each other, but cut in different directions.
    other = np.linalg.norm(shape[:, None] - shape[None], axis=(2, 3)) > 0.5
    alike = (np.abs(np.log(area[:, None] / area[None])) < 0.22) & ~other & round_[:, None] & round_[None]
    votes = alike.sum(axis=1) + 1e-6 * area / area.max()
    best = int(np.argmax(votes))
    members = np.flatnonzero(alike[best])
    if members.size < 2:
        return None, 0
    moments = np.array([candidates[i].soft.moment * scale[i] for i in members])
    return np.asarray(np.median(moments, axis=0)), int(members.size)


def largest_area(candidate: Candidate, camera: Camera | None, diameter: float) -> float:
    """Area of a marker seen face on at the blob's depth, px; infinite when that is not known."""
    if camera is None or not np.isfinite(candidate.depth) or diameter == 0.0:
        return np.inf
    radius = 0.5 * diameter / candidate.depth
    return float(np.pi * radius**2 * camera.fx * camera.fy)

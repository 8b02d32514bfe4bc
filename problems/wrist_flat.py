"""Pixels without depth: finding the hand, and the second pose that explains them as well (mathematics 5.1).

Six nearly coplanar markers seen from afar have two poses with almost the same image: the palm tilted towards the camera and the palm tilted
away. Which one it is, pixels alone hardly say.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from factorgrasp import lie
from factorgrasp.models.camera import Camera
from factorgrasp.problems.wrist_assign import Assignment, Rates
from factorgrasp.problems.wrist_model import predict, roots
from factorgrasp.problems.wrist_search import EVIDENCE, Found, fit, judge
from factorgrasp.typing import FloatArray, IntArray

DECIDED = 13.8
"""Difference of chi-square (odds of a thousand) from which on pixels do decide between two poses."""
DEEP_ENOUGH = 3
"""Markers with depth that leave no second pose."""
LOOSE = np.deg2rad(5.0)
"""rad: standard deviation of the orientation beyond which pixels have not decided it, whatever else they say."""
_NEAREST, _FARTHEST = 0.25, 2.0
_MOST_BLOBS = 16
_TOLERANCE = 0.22
"""Of the palm's size in the image: how far from a flat hand's a marker may be when the hand is looked for."""


def flat_search(
    camera: Camera,
    points: FloatArray,
    blocks: FloatArray,
    uvz: FloatArray,
    covariance: FloatArray,
    rates: Rates,
    gate: float,
) -> Found | None:
    """The hand lying flat before the camera with its back towards it (as the paper asks), from pixels alone.

    Pairs of blobs and markers fix a shift, a turn and a scale; the pose that explains most blobs is fitted to them.
    """
    blobs = uvz[:, :2][:_MOST_BLOBS]
    # The back of the hand faces the camera: y of the wrist frame is mirrored in the image.
    flat = points[:, 0] - 1j * points[:, 1]
    image = blobs[:, 0] + 1j * blobs[:, 1]
    best: list[tuple[float, FloatArray, FloatArray]] = []
    size = np.abs(flat - flat.mean()).max()
    i, j = (g.ravel() for g in np.meshgrid(np.arange(image.size), np.arange(image.size), indexing="ij"))
    i, j = i[i != j], j[i != j]
    for a, b in permutations(range(len(points)), 2):
        if abs(flat[b] - flat[a]) < 0.04:
            continue
        scale = (image[j] - image[i]) / (flat[b] - flat[a])
        z = camera.fx / np.abs(scale)
        good = (z > _NEAREST) & (z < _FARTHEST)
        if not good.any():
            continue
        s, shift = scale[good], image[i[good]] - scale[good] * flat[a]
        where = s[:, None] * flat + shift[:, None]
        away = np.abs(where[:, :, None] - image) / (np.abs(s)[:, None, None] * size * _TOLERANCE)
        support = np.sum(np.maximum(1.0 - away.min(axis=2) ** 2, 0.0), axis=1)
        k = int(np.argmax(support))
        turn = float(np.angle(s[k]))
        R = lie.so3_exp([0.0, 0.0, turn]) @ np.diag([1.0, -1.0, -1.0])
        p = camera.back_project([shift[k].real, shift[k].imag], camera.fx / abs(s[k]))
        best.append((float(support[k]), R, p))
    found: list[Found] = []
    for _, R, p in sorted(best, key=lambda item: -item[0])[:4]:
        result = judge(camera, points, blocks, R, p, uvz, covariance, rates, gate, None, _loose())
        if result is not None and result.assignment.count >= 4:
            found.append(result)
    found.sort(key=lambda f: -f.assignment.score)
    return found[0] if found and found[0].assignment.score > EVIDENCE else None


def _loose() -> FloatArray:
    return np.diag(np.array([0.25, 0.25, 0.15, 0.015, 0.015, 0.06]) ** 2)


def second_pose(
    camera: Camera,
    points: FloatArray,
    blocks: FloatArray,
    R: FloatArray,
    p: FloatArray,
    uvz: FloatArray,
    covariance: FloatArray,
    marker: IntArray,
) -> tuple[FloatArray, float] | None:
    """The other pose of a frame whose blobs hold (almost) no depth.

    Parameters
    ----------
    camera, points, blocks
        The camera and the layout with its covariances.
    R, p : ndarray
        The pose that is believed, in the camera frame.
    uvz, covariance : ndarray
        The frame's blobs.
    marker : (m,) ndarray of int
        Of every blob, -1 for none.

    Returns
    -------
    away : (6,) ndarray
        ``[Log(R' R_other); p_other - p]``.
    difference : float
        Chi-square of the other pose less that of the best one near the believed pose.
    None
        When there is no other pose: enough depth, or one and the same minimum.
    """
    used = np.flatnonzero(marker >= 0)
    if used.size < 3 or np.count_nonzero(np.isfinite(uvz[used, 2])) >= DEEP_ENOUGH:
        return None
    assignment = Assignment(marker, 0.0)
    try:
        near = fit(camera, points, blocks, R, p, uvz, covariance, assignment, None, 8)
        start = mirrored(points, near[0], near[1])
        other = fit(camera, points, blocks, *start, uvz, covariance, assignment, None, 12)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(other[1]).all() or other[1][2] <= 0.05:
        return None
    if float(lie.angle_between(near[0], other[0])) < np.deg2rad(1.0):
        return None
    best, rival = (
        _chi2(camera, points, blocks, pose[0], pose[1], uvz, covariance, marker) for pose in (near, other)
    )
    away = np.concatenate([lie.so3_log(R.T @ other[0]), other[1] - p])
    return away, rival - best


def mirrored(points: FloatArray, R: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The pose with the same weak-perspective image: the palm's plane mirrored at the plane across the ray to its centre."""
    centre = points.mean(axis=0)
    basis = np.linalg.svd(points - centre)[2]
    if np.linalg.det(basis) < 0.0:
        basis[2] *= -1.0
    middle = R @ centre + p
    ray = middle / np.linalg.norm(middle)
    F = np.eye(3) - 2.0 * np.outer(ray, ray)
    axes = F @ R @ basis.T
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    other = axes @ basis
    return other, middle - other @ centre


def _chi2(
    camera: Camera,
    points: FloatArray,
    blocks: FloatArray,
    R: FloatArray,
    p: FloatArray,
    uvz: FloatArray,
    covariance: FloatArray,
    marker: IntArray,
) -> float:
    used = np.flatnonzero(marker >= 0)
    count, chosen = used.size, marker[used]
    seen, _, J = predict(
        camera, np.broadcast_to(R, (count, 3, 3)), np.broadcast_to(p, (count, 3)), points[chosen]
    )
    root = roots(covariance[used] + J @ blocks[chosen] @ np.swapaxes(J, 1, 2))
    r = np.where(np.isfinite(uvz[used]), uvz[used], 0.0) - seen
    return float(np.sum((root @ r[:, :, None]) ** 2))

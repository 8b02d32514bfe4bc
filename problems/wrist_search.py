"""Finding the hand from nothing: which blobs with depth have the distances of the markers (mathematics 5.2).

Triples of blobs whose three distances are those of three markers give poses; each pose is judged by how probable all blobs of the frame
are under it. The best is believed only when it beats every other pose, and "all clutter", by a margin.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from factorgrasp import lie
from factorgrasp.models.camera import Camera
from factorgrasp.problems.wrist_assign import Assignment, Prediction, Rates, assign
from factorgrasp.problems.wrist_model import predict, roots
from factorgrasp.typing import FloatArray, IntArray

MARGIN = 5.0
"""Logarithm of the odds against the second best pose that is asked for."""
EVIDENCE = 10.0
"""Logarithm of the odds against clutter that is asked for."""
EVIDENCE_OF_THREE = 25.0
"""The same where only three blobs speak for a pose of which nothing was known: chance makes triangles that score up to 24, true ones 26 and
more."""
MOST_TRIPLES = 600
_REFINED = 6
_WIDE = np.array([0.5, 0.5, 0.5, 0.15, 0.15, 0.15])
"""Standard deviations (rad, m) within which a pose is as good as any other when nothing was known of it."""


@dataclass(frozen=True, eq=False)
class Found:
    """A pose found by its markers.

    Attributes
    ----------
    R : (3, 3) ndarray
        ``R_c_w``.
    p : (3,) ndarray
        ``p_c_w``, m.
    covariance : (6, 6) ndarray
        [theta, p], from this frame alone (and the prior, where there was one).
    assignment : Assignment
    margin : float
        Logarithm of the odds against the second best.
    """

    R: FloatArray
    p: FloatArray
    covariance: FloatArray
    assignment: Assignment
    margin: float


@dataclass(frozen=True, eq=False)
class Guess:
    """What is known of the pose before the search: mean and covariance (6, 6) in [theta, p]."""

    R: FloatArray
    p: FloatArray
    covariance: FloatArray


def search(
    camera: Camera,
    points: FloatArray,
    layout_blocks: FloatArray,
    uvz: FloatArray,
    covariance: FloatArray,
    rates: Rates,
    support: int,
    gate: float,
    guess: Guess | None = None,
) -> Found | None:
    """The pose that most markers agree on, or None when there is none that may be believed.

    Parameters
    ----------
    camera : Camera
    points : (n, 3) ndarray
        Markers in W, m.
    layout_blocks : (n, 3, 3) ndarray
        Their covariances, m^2.
    uvz, covariance : (m, 3), (m, 3, 3) ndarray
        Blobs; NaN where the depth is missing.
    rates : Rates
    support : int
        Markers that must agree.
    gate : float
    guess : Guess, optional
    """
    deep = np.flatnonzero(np.isfinite(uvz[:, 2]))
    if deep.size < 3:
        return None
    R, p = _candidates(camera, points, layout_blocks, uvz[deep], covariance[deep])
    if not len(R):
        return None
    order = _rank(camera, points, R, p, uvz, covariance)
    found: list[Found] = []
    for k in order[:40]:
        if len(found) >= _REFINED:
            break
        if any(_same(f, R[k], p[k], 0.15, 0.02) for f in found):
            continue
        better = judge(camera, points, layout_blocks, R[k], p[k], uvz, covariance, rates, gate, guess)
        if better is not None:
            found.append(better)
    found.sort(key=lambda f: -f.assignment.score)
    if not found or found[0].assignment.count < support:
        return None
    best = found[0]
    rivals = [f.assignment.score for f in found[1:] if not _same(best, f.R, f.p, 0.25, 0.03)]
    margin = best.assignment.score - max([0.0, *rivals])
    second = best.assignment.score - max(rivals, default=-np.inf)
    asked = EVIDENCE_OF_THREE if guess is None and best.assignment.count == 3 else EVIDENCE
    if best.assignment.score < asked or second < MARGIN:
        return None
    return Found(best.R, best.p, best.covariance, best.assignment, min(margin, second))


def _candidates(
    camera: Camera, points: FloatArray, layout_blocks: FloatArray, uvz: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Poses (k, 3, 3), (k, 3) of all triples of blobs whose distances are those of three markers."""
    q = camera.back_project(uvz[:, :2], uvz[:, 2])
    variance = np.maximum(covariance[:, 2, 2], (uvz[:, 2] / camera.fx) ** 2 * covariance[:, 0, 0])
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    seen = np.linalg.norm(q[:, None] - q[None], axis=-1)
    spread = np.einsum("nii->n", layout_blocks) / 3.0
    tolerance = 4.0 * np.sqrt(
        (variance[:, None] + variance[None])[None, None] + (spread[:, None] + spread[None])[:, :, None, None]
    )
    off = np.abs(apart[:, :, None, None] - seen[None, None])
    fits = off < tolerance
    off = (off / tolerance) ** 2
    count = len(q)
    grid = np.arange(count)
    a, b, c = (g.ravel() for g in np.meshgrid(grid, grid, grid, indexing="ij"))
    distinct = (a != b) & (a != c) & (b != c)
    a, b, c = a[distinct], b[distinct], c[distinct]
    markers, blobs, score = [], [], []
    for i, j, k in combinations(range(len(points)), 3):
        legs = np.linalg.svd(points[[j, k]] - points[i], compute_uv=False)
        if legs[1] < 8e-3:  # three markers almost on a line say nothing about the turn around it
            continue
        good = fits[i, j, a, b] & fits[i, k, a, c] & fits[j, k, b, c]
        if good.any():
            A, B, C = a[good], b[good], c[good]
            blobs.append(np.stack([A, B, C], axis=1))
            markers.append(np.broadcast_to([i, j, k], (A.size, 3)))
            # Small triangles fit anything: the larger one goes first.
            score.append(off[i, j, A, B] + off[i, k, A, C] + off[j, k, B, C] - 20.0 * legs[1])
    if not blobs:
        return np.empty((0, 3, 3)), np.empty((0, 3))
    chosen = np.argsort(np.concatenate(score), kind="stable")[:MOST_TRIPLES]
    source, target = points[np.concatenate(markers)[chosen]], q[np.concatenate(blobs)[chosen]]
    return _rigid(source, target)


def _rigid(source: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation and position (k, 3, 3), (k, 3) that carry points (k, j, 3) onto others (Kabsch)."""
    mean_s, mean_t = source.mean(axis=1), target.mean(axis=1)
    M = np.swapaxes(target - mean_t[:, None], 1, 2) @ (source - mean_s[:, None])
    R = lie.project_to_so3(M)
    return R, mean_t - (R @ mean_s[:, :, None])[:, :, 0]


def _rank(
    camera: Camera, points: FloatArray, R: FloatArray, p: FloatArray, uvz: FloatArray, covariance: FloatArray
) -> IntArray:
    """Poses in the order of how many markers have a blob nearby, and how near."""
    seen = np.einsum("kij,nj->kni", R, points) + p[:, None]
    uv = camera.project(seen)
    pixel = np.sqrt(covariance[:, 0, 0]) + 4.0
    away = np.sum((uv[:, :, None] - uvz[None, None, :, :2]) ** 2, axis=-1) / pixel**2
    depth = (seen[:, :, None, 2] - uvz[None, None, :, 2]) ** 2 / (np.sqrt(covariance[:, 2, 2]) + 4e-3) ** 2
    away = away + np.where(np.isfinite(depth), depth, 1.0)
    nearest = np.min(np.where(np.isfinite(away), away, np.inf), axis=2)
    return np.argsort(-np.sum(np.maximum(1.0 - nearest / 9.0, 0.0), axis=1), kind="stable")


def judge(
    camera: Camera,
    points: FloatArray,
    layout_blocks: FloatArray,
    R: FloatArray,
    p: FloatArray,
    uvz: FloatArray,
    covariance: FloatArray,
    rates: Rates,
    gate: float,
    guess: Guess | None,
    loose: FloatArray | None = None,
) -> Found | None:
    """Fit a pose to the blobs that are jointly compatible with it, and say how probable they are."""
    if loose is None:
        loose = np.diag(np.array([0.12, 0.12, 0.12, 0.01, 0.01, 0.01]) ** 2)
    assignment = None
    for _ in range(2):
        predicted = prediction(camera, points, layout_blocks, R, p, loose)
        assignment = assign("joint", predicted, uvz, covariance, rates, gate)
        if assignment.count < 3:
            return None
        R, p, fitted = fit(camera, points, layout_blocks, R, p, uvz, covariance, assignment, None)
        loose = fitted
    assert assignment is not None
    # Evidence: the prior's density at the fit, the misfit, and the volume that the data leave of the prior.
    if guess is None:
        prior, away = np.diag(_WIDE**2), np.zeros(6)
    else:
        prior = guess.covariance
        away = np.concatenate([lie.so3_log(guess.R.T @ R), p - guess.p])
    used = assignment.marker >= 0
    predicted = prediction(camera, points, layout_blocks, R, p, fitted)
    covered = covariance[used] + predicted.own[assignment.marker[used]]
    root = roots(covered)
    deep = root[:, 2, 2] > 0.0
    r = np.where(np.isfinite(uvz[used]), uvz[used], 0.0) - predicted.uvz[assignment.marker[used]]
    white = (root @ r[:, :, None])[:, :, 0]
    logdet = (
        -2.0 * np.log(np.where(root[:, [0, 1, 2], [0, 1, 2]] > 0.0, root[:, [0, 1, 2], [0, 1, 2]], 1.0)).sum()
    )
    gain = float(rates.reward(deep.astype(float)).sum()) - 0.5 * (
        float(np.sum(white**2)) + logdet + float(np.sum(np.where(deep, 3.0, 2.0))) * np.log(2.0 * np.pi)
    )
    misfit = float(away @ np.linalg.solve(prior + fitted, away))
    volume = np.linalg.slogdet(np.eye(6) + np.linalg.solve(fitted, prior))[1]
    score = gain - 0.5 * misfit - 0.5 * float(volume)
    return Found(R, p, fitted, Assignment(assignment.marker, score, assignment.margin), 0.0)


def prediction(
    camera: Camera,
    points: FloatArray,
    layout_blocks: FloatArray,
    R: FloatArray,
    p: FloatArray,
    pose: FloatArray,
) -> Prediction:
    """Markers as a pose with covariance (6, 6) and an independent layout foretell them."""
    count = len(points)
    uvz, J, J_point = predict(
        camera, np.broadcast_to(R, (count, 3, 3)), np.broadcast_to(p, (count, 3)), points
    )
    own = J_point @ layout_blocks @ np.swapaxes(J_point, 1, 2)
    bad = ~np.isfinite(uvz).all(axis=1)
    if bad.any():
        # Behind the camera: nowhere in the image.
        uvz, J, own = uvz.copy(), J.copy(), own.copy()
        uvz[bad], J[bad], own[bad] = -1e6, 0.0, np.eye(3)
    return Prediction(uvz, J, pose, own)


def fit(
    camera: Camera,
    points: FloatArray,
    layout_blocks: FloatArray,
    R: FloatArray,
    p: FloatArray,
    uvz: FloatArray,
    covariance: FloatArray,
    assignment: Assignment,
    guess: Guess | None,
    steps: int = 5,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pose of one frame by covariance-weighted least squares on its assigned blobs (with a prior, if any), and its covariance."""
    used = np.flatnonzero(assignment.marker >= 0)
    marker = assignment.marker[used]
    H = np.eye(6)
    for _ in range(steps):
        count = used.size
        predicted, J, J_point = predict(
            camera, np.broadcast_to(R, (count, 3, 3)), np.broadcast_to(p, (count, 3)), points[marker]
        )
        own = J_point @ layout_blocks[marker] @ np.swapaxes(J_point, 1, 2)
        root = roots(covariance[used] + own)
        r = (root @ (np.where(np.isfinite(uvz[used]), uvz[used], 0.0) - predicted)[:, :, None])[:, :, 0]
        A = (root @ J).reshape(-1, 6)
        H, g = A.T @ A, A.T @ r.ravel()
        if guess is not None:
            information = np.linalg.inv(guess.covariance)
            away = np.concatenate([lie.so3_log(guess.R.T @ R), p - guess.p])
            H, g = H + information, g - information @ away
        else:
            H = H + 1e-6 * np.eye(6)
        step = np.linalg.solve(H, g)
        R, p = R @ lie.so3_exp(step[:3]), p + step[3:]
        if float(step @ H @ step) < 1e-8:
            break
    return R, p, np.asarray(np.linalg.inv(H))


def _same(found: Found, R: FloatArray, p: FloatArray, angle: float, distance: float) -> bool:
    near = float(np.linalg.norm(found.p - p)) < distance
    return near and float(lie.angle_between(found.R, R)) < angle

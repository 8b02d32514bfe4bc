"""The state of a body, (q, qd, qdd) with covariances, from markers or from poses of its links (mathematics 4.3, equation 12c).

Inverse kinematics frame by frame, all frames of a stretch at once; then one nonlinear least-squares problem over time with a motion
prior on the manifold: third differences of the configuration are independent and small. How small is found from the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgrasp.body_state_prior import jerk_scale
from factorgrasp.body_state_smoother import CHUNK, normal, smooth_over_time
from factorgrasp.errors import InputError
from factorgrasp.problems.body_observations import BodyObservations
from factorgrasp.problems.observed_osim import Observed, observed
from factorgrasp.typing import BoolArray, FloatArray

POSTURE_SD = 1.0
"""Rad: how far joints are from the zero configuration, for what nothing else tells of."""
# Information that holds what cannot move.
_HELD = 1e12
_KEY = 10
_STEPS = 40
MAX_GAP = 0.1
"""s: what was hidden for longer is a gap, however well the motion around it is known."""
# A component that a single frame tells of this much worse than usual (standard deviations) is not seen in it.
_UNSEEN = 5.0


@dataclass(frozen=True, eq=False)
class BodyState:
    """Configurations over time.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s, uniform.
    q, qd, qdd : ndarray
        (n, nq), (n, nv), (n, nv), as pinocchio has them; NaN in frames that are not `good`.
    q_variance, qd_variance, qdd_variance : ndarray, shape (n, nv)
        Of every component; those of a free-flyer's translation along the world's axes.
    q_covariance : ndarray, shape (m, nv, nv)
        Of the first m frames: all of them up to :data:`factorgrasp.body_state_smoother.WHOLE`.
    qdd_covariance : ndarray, shape (n, nv, nv) or (nv, nv)
        The mean over all frames of a recording longer than :data:`factorgrasp.body_state_smoother.WHOLE`.
    root_covariance : ndarray, shape (n, 3, 3)
        Of the first three components: a free-flyer's place in the world.
    good : ndarray, shape (n,)
        False where too little was seen to tell the whole configuration, and at both ends.
    residual_sd : float
        Root mean square of the whitened residuals per degree of freedom left: 1 when the stated noise is right.
    worst_marker : tuple of (str, float)
        The marker (or pose) that fits worst, and its root mean square distance, m (rad for the orientation of a pose).
    jerk_sd : ndarray, shape (nv,)
        Third differences of the motion prior, rad or m.
    """

    t: FloatArray
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    q_variance: FloatArray
    qd_variance: FloatArray
    qdd_variance: FloatArray
    q_covariance: FloatArray
    qdd_covariance: FloatArray
    root_covariance: FloatArray
    good: BoolArray
    residual_sd: float
    worst_marker: tuple[str, float]
    jerk_sd: FloatArray


def estimate_state(
    model: Any,
    t: FloatArray,
    observations: BodyObservations,
    *,
    posture: FloatArray | None = None,
    posture_sd: float = POSTURE_SD,
    bandwidth: float | None = None,
    max_gap: float = MAX_GAP,
) -> BodyState:
    """Configurations with velocities, accelerations and covariances.

    Parameters
    ----------
    model : pinocchio.Model or OsimModel
        Hinges, sliders and ball joints, with or without a free-flyer as first joint; or an OpenSim model, whose coordinates are the
        configuration then. Limits of hinges are respected where they are narrower than a full turn.
    t : (n,) ndarray
        Uniform times, s.
    observations : BodyObservations
        NaN where something was not seen.
    posture : (nq,) ndarray, optional
        What joints are near to that nothing tells of; the model's zero by default.
    posture_sd : float
        rad.
    bandwidth : float, optional
        Hz, at which motion prior and data weigh the same; found from the data by default.
    max_gap : float
        s: a configuration of which a part was hidden for longer is a gap.

    Raises
    ------
    InputError
        For fewer than five frames, uneven times, or no frame in which three points are seen.
    """
    count = t.size
    if count < 5:
        raise InputError("frames", "at least five", str(count))
    dt = float(np.median(np.diff(t)))
    if np.abs(np.diff(t) - dt).max() > 0.02 * dt:
        raise InputError("t", "uniform times", f"steps from {np.diff(t).min():g} to {np.diff(t).max():g} s")
    body = observed(model, observations)
    rest = body.neutral() if posture is None else np.asarray(posture, dtype=float)
    pull = _posture(body, posture_sd)
    q = _frame_by_frame(body, observations, rest, pull)
    variance = _information_variance(body, q, pull)
    jerk, _ = jerk_scale(_unrolled(body, q), variance, dt, bandwidth)
    smooth = smooth_over_time(body, q, rest, pull, jerk, dt)
    q, Q = smooth.q, smooth.Q
    v, a = body.derivatives(q, dt)
    good = _told(body, q, pull, variance, round(max_gap / dt))
    good[[0, -1]] = False
    q, v, a = (np.where(good[:, None], x, np.nan) for x in (q, v, a))
    ratio, worst = _fit(body, observations, q, Q, good)
    return BodyState(
        t, q, v, a, smooth.q2, smooth.qd2, smooth.qdd2, Q, smooth.A, smooth.root, good, ratio, worst, jerk
    )  # fmt: skip


def configurations(
    model: Any,
    observations: BodyObservations,
    *,
    posture: FloatArray | None = None,
    posture_sd: float = POSTURE_SD,
) -> FloatArray:
    """Configurations (n, nq) frame by frame, without a motion prior: what inverse kinematics usually is."""
    body = observed(model, observations)
    rest = body.neutral() if posture is None else np.asarray(posture, dtype=float)
    return _frame_by_frame(body, observations, rest, _posture(body, posture_sd))


def solve_posture(
    model: Any, observations: BodyObservations, posture: FloatArray, posture_sd: float
) -> FloatArray:
    """The configuration (nq,) of one frame, with the joints near to a known posture."""
    body = observed(model, observations)
    found: FloatArray = _first(body, 0, posture, _posture(body, posture_sd))
    return found


def _posture(body: Observed, sd: float) -> FloatArray:
    """Information (nv,) of the posture about every component; none about where the body is."""
    out = np.full(body.nv, sd**-2)
    out[body.root] = 0.0
    out[body.still] = _HELD
    return out


# ---- frame by frame ---------------------------------------------------------------------------------------------


def _frame_by_frame(
    body: Observed, observations: BodyObservations, rest: FloatArray, pull: FloatArray
) -> FloatArray:
    count = len(observations)
    seen = np.isfinite(observations.markers).all(axis=2).sum(axis=1)
    if observations.posed:
        seen = seen + 3 * np.isfinite(observations.p).all(axis=2).sum(axis=1)
    if seen.max(initial=0) < 3:
        raise InputError("markers", "a frame in which at least three are seen", "none")
    start = int(np.argmax(seen))
    q = np.tile(rest, (count, 1))
    q[start] = _first(body, start, rest, pull)
    found = [start]
    for direction in (1, -1):
        last = start
        for k in range(start + direction * _KEY, count if direction > 0 else -1, direction * _KEY):
            q[k] = q[last]
            if seen[k] >= 3:
                q[k : k + 1] = _iterate(body, q[k : k + 1], slice(k, k + 1), rest, pull, 8)
            found.append(k)
            last = k
    keys = np.array(sorted(found))
    nearest = keys[np.abs(np.arange(count)[:, None] - keys).argmin(axis=1)]
    q = q[nearest]
    for low in range(0, count, CHUNK):
        part = slice(low, low + CHUNK)
        q[part] = _iterate(body, q[part], part, rest, pull, 6)
    return np.asarray(q)


def _first(body: Observed, frame: int, rest: FloatArray, pull: FloatArray) -> FloatArray:
    """One frame from nothing: the whole body laid onto what is seen, then all joints."""
    part = slice(frame, frame + 1)
    tried = []
    for start in body.starts(frame, rest):
        q = _iterate(body, start[None], part, rest, pull, _STEPS)
        tried.append((float(normal(body, q, part, rest, pull)[2][0]), q))
    q = min(tried, key=lambda one: one[0])[1]
    near = body.nearest(q, rest)
    return np.asarray(_iterate(body, near, part, rest, pull, _STEPS)[0])


def _iterate(
    body: Observed, q: FloatArray, part: slice, rest: FloatArray, pull: FloatArray, steps: int
) -> FloatArray:
    """Levenberg-Marquardt on every frame of a stretch, each with a damping of its own."""
    damping = np.full(len(q), 1e-6)
    H, g, cost = normal(body, q, part, rest, pull)
    for _ in range(steps):
        scale = np.einsum("nii->ni", H)
        d = -np.linalg.solve(
            H + damping[:, None, None] * (scale[:, :, None] * np.eye(H.shape[1]) + np.eye(H.shape[1])),
            g[..., None],
        )[..., 0]
        # No joint turns by more than a radian at once.
        d *= np.minimum(1.0, 1.0 / np.maximum(np.abs(d).max(axis=1), 1e-12))[:, None]
        tried = body.step(q, d)
        H2, g2, cost2 = normal(body, tried, part, rest, pull)
        better = cost2 <= cost * (1.0 + 1e-12)
        q = np.where(better[:, None], tried, q)
        H, g = np.where(better[:, None, None], H2, H), np.where(better[:, None], g2, g)
        damping = np.where(better, damping * 0.1, damping * 20.0)
        done = np.abs(d).max() < 1e-7 or bool(np.all(np.abs(cost - cost2) < 1e-9 * (1.0 + cost)))
        cost = np.where(better, cost2, cost)
        if done:
            break
    return np.asarray(q)


def _information_variance(body: Observed, q: FloatArray, pull: FloatArray) -> FloatArray:
    """Median variance (nv,) of the configurations found frame by frame."""
    every = slice(0, len(q), max(1, len(q) // 50))
    r, J = body.residuals(q[every], every)
    H = np.swapaxes(J, 1, 2) @ J
    H[:, np.arange(H.shape[1]), np.arange(H.shape[1])] += pull + 1e-12
    seen = (r != 0.0).any(axis=1)
    return np.asarray(np.median(np.diagonal(np.linalg.inv(H[seen]), axis1=1, axis2=2), axis=0))


def _told(body: Observed, q: FloatArray, pull: FloatArray, usual: FloatArray, most: int) -> BoolArray:
    """Frames of which every component is seen, or was hidden for no more than `most` frames."""
    unseen = np.empty((len(q), usual.size), dtype=bool)
    for low in range(0, len(q), CHUNK):
        part = slice(low, low + CHUNK)
        _, J = body.residuals(q[part], part)
        H = np.swapaxes(J, 1, 2) @ J
        H[:, np.arange(H.shape[1]), np.arange(H.shape[1])] += pull + 1e-6
        own = np.diagonal(np.linalg.inv(H), axis1=1, axis2=2)
        unseen[part] = own > _UNSEEN**2 * usual
    lost = unseen.copy()
    for shift in range(1, most + 1):
        # What stays after `most` frames of shrinking was hidden for longer.
        lost[:-1] &= unseen[1:] if shift == 1 else lost[1:]
    for _ in range(most):
        lost[1:] |= lost[:-1] & unseen[1:]
    return np.asarray(~lost.any(axis=1))


def _unrolled(body: Observed, q: FloatArray) -> FloatArray:
    """Coordinates (n, nv) whose differences are those on the manifold."""
    steps = body.difference(q[:-1], q[1:])
    return np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])


def _fit(
    body: Observed, observations: BodyObservations, q: FloatArray, Q: FloatArray, good: BoolArray
) -> tuple[float, tuple[str, float]]:
    """How well what was seen fits, in its own standard deviations, and what fits worst."""
    frames = np.flatnonzero(good[: len(Q)])
    if not frames.size:
        raise InputError("markers", "frames in which the whole configuration can be told", "none")
    frames = frames[:: max(1, frames.size // 200)]
    r, J = body.residuals(q[frames], frames)
    # Degrees of freedom that the configuration has used up: less than all of them, as neighbouring frames share theirs.
    used = float(np.einsum("nri,nij,nrj->", J, Q[frames], J, optimize=True))
    ratio = float(np.sqrt(np.sum(r**2) / max(float((r != 0.0).sum()) - used, 1.0)))
    names = [*observations.placement.names, *observations.posed]
    sd = [*observations.placement.sd, *([observations.position_sd] * len(observations.posed))]
    size = []
    for k in range(len(names)):
        three = r[:, 3 * k : 3 * k + 3]
        some = (three != 0.0).any(axis=1)
        size.append(float(np.sqrt(np.mean(np.sum(three[some] ** 2, axis=1)))) * sd[k] if some.any() else 0.0)
    worst = int(np.argmax(size))
    return ratio, (names[worst], size[worst])

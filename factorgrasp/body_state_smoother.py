"""Smoothing of configurations over time for :mod:`factorgrasp.body_state`: one block-tridiagonal problem a window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.body_state_prior import third_difference_band
from factorgrasp.problems.observed_osim import Observed
from factorgrasp.solvers.block_tridiagonal import BlockTridiagonal
from factorgrasp.typing import FloatArray

WINDOW = 300
"""Frames that are smoothed at once, as long as they are four times the overlap: that bounds the memory."""
OVERLAP = 0.5
"""s that a window reaches beyond what is kept of it: by then the motion prior has forgotten."""
WHOLE = 1500
"""Frames up to which every frame's covariances are kept whole; beyond, that would fill the memory."""
CHUNK = 128
"""Frames whose Jacobians are held at once."""


def normal(
    body: Observed, q: FloatArray, part: slice, rest: FloatArray, pull: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Information (n, nv, nv), gradient (n, nv) and cost (n,)."""
    r, J = body.residuals(q, part)
    JT = np.swapaxes(J, 1, 2)
    H, g = JT @ J, (JT @ r[..., None])[..., 0]
    off = body.difference(np.broadcast_to(rest, q.shape), q)
    beyond, tight = body.limits(q)
    H[:, np.arange(H.shape[1]), np.arange(H.shape[1])] += pull + tight
    g += pull * off + tight * beyond
    cost: FloatArray = 0.5 * (
        np.sum(r**2, axis=1) + np.sum(pull * off**2, axis=1) + np.sum(tight * beyond**2, axis=1)
    )
    return H, g, cost


@dataclass(frozen=True, eq=False)
class Smooth:
    """Configurations, their variances and those of both derivatives, and covariances as far as they are kept."""

    q: FloatArray
    q2: FloatArray
    qd2: FloatArray
    qdd2: FloatArray
    Q: FloatArray
    A: FloatArray
    root: FloatArray


def smooth_over_time(
    body: Observed, q: FloatArray, rest: FloatArray, pull: FloatArray, jerk: FloatArray, dt: float
) -> Smooth:
    """Gauss-Newton over time in windows, from configurations (n, nq) found frame by frame.

    Parameters
    ----------
    body : Observed
    q : (n, nq) ndarray
    rest, pull : ndarray
        The posture, and the information (nv,) about every component that it stands for.
    jerk : (nv,) ndarray
        Standard deviations of third differences.
    dt : float
        s.
    """
    count, nv = len(q), body.nv
    whole = count <= WHOLE
    overlap = int(np.clip(round(OVERLAP / dt), 30, 120))
    window = max(WINDOW, 4 * overlap)
    step = window - 2 * overlap
    out, root = q.copy(), np.empty((count, min(3, nv), min(3, nv)))
    q2, qd2, qdd2 = (np.empty((count, nv)) for _ in range(3))
    Q = np.empty((count if whole else step, nv, nv))
    A = np.zeros((count, nv, nv) if whole else (nv, nv))
    for begin in range(0, count, step) if count > window else (0,):
        low, high = max(0, begin - overlap), min(count, begin + step + overlap)
        if count <= window:
            low, high = 0, count
        part, C, v2, a2 = _smooth_window(body, q[low:high], slice(low, high), rest, pull, jerk, dt)
        keep = slice(begin, min(count, begin + step) if count > window else count)
        inside = slice(keep.start - low, keep.stop - low)
        out[keep], qd2[keep] = part[inside], v2[inside]
        q2[keep], qdd2[keep] = (np.diagonal(x[inside], axis1=1, axis2=2) for x in (C, a2))
        root[keep] = C[inside, :3, :3]
        if keep.stop <= len(Q):
            Q[keep] = C[inside]
        if whole:
            A[keep] = a2[inside]
        else:
            A += a2[inside].sum(axis=0) / count
    return Smooth(out, q2, qd2, qdd2, Q, A, root)


def _smooth_window(
    body: Observed,
    q: FloatArray,
    part: slice,
    rest: FloatArray,
    pull: FloatArray,
    jerk: FloatArray,
    dt: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Gauss-Newton over all frames of a window.

    Steps of rotations are taken to add up, which they do to first order in the turn of one frame.
    """
    count, nv = len(q), body.nv
    # The posture is known once, not anew in every frame.
    once = pull / count
    weight = jerk**-2.0
    blocks = -(-count // 3)
    band = third_difference_band(count)
    system = None
    for last in (False, False, True):
        H, g = np.empty((count, nv, nv)), np.empty((count, nv))
        for low in range(0, count, CHUNK):
            some = slice(low, min(low + CHUNK, count))
            where = slice(part.start + some.start, part.start + some.stop)
            H[some], g[some], _ = normal(body, q[some], where, rest, once)
        steps = body.difference(q[:-1], q[1:])
        third = np.diff(steps, n=2, axis=0)
        pullback = np.zeros((count, nv))
        for k, c in enumerate((-1.0, 3.0, -3.0, 1.0)):
            pullback[k : count - 3 + k] += c * weight * third
        g += pullback
        system = _assemble(H, band, weight, blocks)
        if last:
            break
        padded = np.zeros((3 * blocks, nv))
        padded[:count] = -g
        d = system.solve(padded.reshape(blocks, 3 * nv)).reshape(3 * blocks, nv)[:count]
        q = body.step(q, d)
    assert system is not None
    return (q, *_marginals(system, count, nv, dt))


def _assemble(H: FloatArray, band: FloatArray, weight: FloatArray, blocks: int) -> BlockTridiagonal:
    """Three frames make one block: third differences then reach no further than the next one."""
    count, nv = H.shape[:2]
    diagonal = np.zeros((blocks, 3, nv, 3, nv))
    below = np.zeros((max(blocks - 1, 0), 3, nv, 3, nv))
    axis = np.arange(nv)
    for i in range(3 * blocks):
        b, r = divmod(i, 3)
        if i >= count:
            diagonal[b, r, axis, r, axis] = 1.0
            continue
        diagonal[b, r, :, r, :] += H[i]
        for off in range(4):
            j = i - off
            if j < 0:
                continue
            value = band[off, j] * weight
            c, s = divmod(j, 3)
            if c == b:
                diagonal[b, r, axis, s, axis] += value
                if off:
                    diagonal[b, s, axis, r, axis] += value
            else:
                below[c, r, axis, s, axis] += value
    size = 3 * nv
    return BlockTridiagonal(diagonal.reshape(blocks, size, size), below.reshape(len(below), size, size))


def _marginals(
    system: BlockTridiagonal, count: int, nv: int, dt: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariances of configurations, variances of velocities and covariances of accelerations."""
    Z, up = system.inverse_band()
    Z, up = Z.reshape(-1, 3, nv, 3, nv), up.reshape(-1, 3, nv, 3, nv)

    def block(i: int, j: int) -> FloatArray:
        """Covariance (nv, nv) between frames i <= j."""
        (b, r), (c, s) = divmod(i, 3), divmod(j, 3)
        return np.asarray(Z[b, r, :, s, :] if b == c else up[b, r, :, s, :])

    Q = np.array([block(k, k) for k in range(count)])
    v2, A = np.empty((count, nv)), np.empty((count, nv, nv))
    for k in range(count):
        m = min(max(k, 1), count - 2)
        last, next_, apart = block(m - 1, m), block(m, m + 1), block(m - 1, m + 1)
        v2[k] = np.diagonal(Q[m - 1] + Q[m + 1] - 2.0 * apart) / (4.0 * dt**2)
        mixed = apart - 2.0 * (last + next_)
        A[k] = (Q[m - 1] + 4.0 * Q[m] + Q[m + 1] + mixed + mixed.T) / dt**4
    return Q, v2, A

"""The usual way with recorded signals: low-pass every signal first, differentiate, multiply, and fit all samples.

Kept beside the library's own way (products first, then one filter on all of them) to measure what the order costs. It gets every help: both
biases as unknowns, weights by its own residuals, the time offset that the library found, a zero-phase filter of one
cut-off for both sides, and no sample within half a second of a gap.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, filtfilt

from factorgrasp import lie, signals
from factorgrasp.recordings import ImuStream, PoseStream
from factorgrasp.typing import FloatArray

MARGIN = 0.5
_ROUNDS = 6


def estimate(
    robot: PoseStream, hand: ImuStream, cutoff: float, time_offset: float, gravity: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rotation ``R_r_h`` (3, 3) and lever arm ``p_r_h`` (3,) from signals that were filtered first.

    Parameters
    ----------
    robot : PoseStream
        Uniformly sampled; gaps as NaN rows.
    cutoff : float
        Hz, -3 dB of the Butterworth filter of order 2 that runs forwards and backwards (so -6 dB in all).
    time_offset : float
        s, hand minus robot.
    gravity : (3,) ndarray
    """
    step = robot.step
    b, a = butter(2, 2.0 * cutoff * step)
    limit = 1.6 * hand.step
    imu = np.hstack([hand.angular_velocity, hand.specific_force])
    both = signals.resample_uniform(hand.t, imu, robot.t + time_offset, max_gap=limit, kind="cubic")[1]
    parts = []
    good = robot.valid & np.isfinite(both).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]])))
    margin = round(MARGIN / step)
    for first, last in edges.reshape(-1, 2):
        if last - first < 4 * margin:
            continue
        rows = slice(first, last)
        p, q, readings = (
            filtfilt(b, a, x[rows], axis=0) for x in (robot.position, robot.rotation_wxyz, both)
        )
        q = q / np.linalg.norm(q, axis=1, keepdims=True)
        # The signals are smooth by now: the shortest window that gives second derivatives adds no smoothing worth mentioning.
        motion = signals.differentiate_rotations(q, step, 5, 4)
        acceleration = signals.savgol_derivatives(p, step, 5, 4, 2)
        force = np.matmul((acceleration - gravity)[:, None, :], lie.quaternion_wxyz_to_matrix(q))[:, 0]
        block = np.hstack([motion.angular_velocity, motion.angular_acceleration, force, readings])
        parts.append(block[margin:-margin])
    return _fit(np.vstack(parts))


def _fit(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton over rotation, lever arm and biases on every sample [w_r, al_r, f_r, w_h, f_h]."""
    w_r, al_r, f_r, w_h, f_h = np.split(rows, 5, axis=1)
    spin = lie.skew(w_r)
    phi = lie.skew(al_r) + spin @ spin
    R, r, biases = lie.project_to_so3(w_r.T @ w_h), np.zeros(3), np.zeros(6)
    n, weight = w_r.shape[0], np.ones(2)
    for _ in range(_ROUNDS):
        gyro = w_h - biases[:3] - w_r @ R
        force = f_h - biases[3:] - (f_r + phi @ r) @ R
        # Readings change by [x]x d for R Exp(d), by R' phi dr and by the biases.
        J = np.zeros((2, n, 3, 12))
        J[0, :, :, 0:3], J[1, :, :, 0:3] = lie.skew(w_r @ R), lie.skew((f_r + phi @ r) @ R)
        J[1, :, :, 3:6] = np.matmul(R.T, phi)
        J[0, :, :, 6:9] = J[1, :, :, 9:12] = np.eye(3)
        H = np.einsum("s,snij,snik->jk", weight, J, J, optimize=True)
        g = np.einsum("s,snij,sni->j", weight, J, np.stack([gyro, force]), optimize=True)
        d = np.linalg.solve(H, g)
        R, r, biases = R @ lie.so3_exp(d[:3]), r + d[3:6], biases + d[6:]
        weight = 1.0 / np.array([np.mean(gyro**2), np.mean(force**2)])
    return R, r

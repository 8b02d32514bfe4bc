"""The terms of the wrist-pose problem, linearised for many frames and markers at once.

A node holds ``R = R_c_w`` and a vector ``x = [p, w, v]`` (or ``[p, w, v, alpha, a]`` for white noise on the jerk): position ``p_c_w`` and
velocity in the camera frame, angular rate (and acceleration) in the wrist frame. Its tangent is ``[theta, p, w, v, ...]``, 12 or 18 long,
theta as right perturbation ``R Exp(theta)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp import lie
from factorgrasp.models.camera import Camera
from factorgrasp.problems.wrist_settings import Motion, WristNoise
from factorgrasp.typing import FloatArray, IntArray

NODE_SIZE = {"acceleration": 12, "jerk": 18}
_IDENTITY = np.eye(3)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Blobs that were given to markers.

    Attributes
    ----------
    node : (M,) ndarray of int
    marker : (M,) ndarray of int
        Index into the layout, from 0.
    uvz : (M, 3) ndarray
        px, px, m; anything where the depth is missing.
    root : (M, 3, 3) ndarray
        Square-root information of (u, v, z); the last row and column are zero where the depth is missing.
    covariance : (M, 3, 3) ndarray
        Of (u, v, z).
    """

    node: IntArray
    marker: IntArray
    uvz: FloatArray
    root: FloatArray
    covariance: FloatArray

    def __len__(self) -> int:
        return int(self.node.size)

    @property
    def deep(self) -> FloatArray:
        """(M,) 1 where there is depth, else 0."""
        return np.asarray(self.root[:, 2, 2] > 0.0, dtype=float)

    def select(self, rows: IntArray) -> Pairs:
        """Some of them."""
        return Pairs(
            self.node[rows], self.marker[rows], self.uvz[rows], self.root[rows], self.covariance[rows]
        )

    @staticmethod
    def join(parts: list[Pairs]) -> Pairs:
        """All of them, one after another."""
        return Pairs(
            np.concatenate([p.node for p in parts]),
            np.concatenate([p.marker for p in parts]),
            np.concatenate([p.uvz for p in parts]),
            np.concatenate([p.root for p in parts]),
            np.concatenate([p.covariance for p in parts]),
        )


def blob_covariances(
    camera: Camera,
    noise: WristNoise,
    depth: FloatArray,
    usual_depth: float,
    covariance_uv: FloatArray | None = None,
    covariance_depth: FloatArray | None = None,
) -> FloatArray:
    """Covariance (m, 3, 3) of (u, v, z) of blobs; NaN rows and columns of z where the depth is missing.

    The calibration error acts across the ray: ``s_eff^2 = s^2 + (f s_cal / z)^2`` (mathematics 5.3); `usual_depth` (m) stands in for a
    missing depth there.
    """
    out = np.zeros((depth.size, 3, 3))
    if covariance_uv is None:
        out[:, 0, 0] = out[:, 1, 1] = noise.pixel_sd**2
    else:
        out[:, :2, :2] = covariance_uv
    if noise.calibration_sd > 0.0:
        z = np.where(np.isfinite(depth), depth, usual_depth)
        out[:, 0, 0] += (camera.fx * noise.calibration_sd / z) ** 2
        out[:, 1, 1] += (camera.fy * noise.calibration_sd / z) ** 2
    out[:, 2, 2] = noise.depth_variance(depth) if covariance_depth is None else covariance_depth
    out[:, 2, 2] = np.where(np.isfinite(depth), out[:, 2, 2], np.nan)
    return out


def roots(covariance: FloatArray) -> FloatArray:
    """Upper square-root information (m, 3, 3) of covariances in (u, v, z); z is left out where it is NaN.

    Pixels and depth may be correlated (through an uncertain layout).
    """
    deep = np.isfinite(covariance[:, 2, 2])
    filled = covariance.copy()
    filled[~deep, 2, :] = filled[~deep, :, 2] = 0.0
    filled[~deep, 2, 2] = 1.0
    lower = np.linalg.cholesky(filled)
    out = np.linalg.inv(lower)
    out[~deep, 2, 2] = 0.0
    return np.asarray(out)


def predict(
    camera: Camera, R: FloatArray, p: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where markers are seen, with derivatives.

    Parameters
    ----------
    camera : Camera
    R : (M, 3, 3) ndarray
    p : (M, 3) ndarray
    points : (M, 3) ndarray
        Markers in W, m.

    Returns
    -------
    uvz : (M, 3) ndarray
        px, px, m.
    J_pose : (M, 3, 6) ndarray
        By ``[theta, p]``.
    J_point : (M, 3, 3) ndarray
        By the marker's position in W.
    """
    turned = (R @ points[:, :, None])[:, :, 0]
    seen = turned + p
    uv, J = camera.project_with_jacobian(seen)
    whole = np.empty((seen.shape[0], 3, 3))
    whole[:, :2] = J
    whole[:, 2] = (0.0, 0.0, 1.0)
    J_point = whole @ R
    J_pose = np.empty((seen.shape[0], 3, 6))
    # d(R Exp(d) m) = -R [m]x d: the columns of J_point crossed with m.
    m = points[:, :, None]
    J_pose[:, :, 0] = m[:, 1] * J_point[:, :, 2] - m[:, 2] * J_point[:, :, 1]
    J_pose[:, :, 1] = m[:, 2] * J_point[:, :, 0] - m[:, 0] * J_point[:, :, 2]
    J_pose[:, :, 2] = m[:, 0] * J_point[:, :, 1] - m[:, 1] * J_point[:, :, 0]
    J_pose[:, :, 3:] = whole
    return np.concatenate([uv, seen[:, 2:]], axis=1), J_pose, J_point


def motion_covariance(dt: float, motion: Motion) -> FloatArray:
    """Covariance (2, 2) or (3, 3) of one axis over a step of `dt` for unit spectral density: position, velocity(, acceleration)."""
    if motion == "acceleration":
        return np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    return np.array(
        [
            [dt**5 / 20.0, dt**4 / 8.0, dt**3 / 6.0],
            [dt**4 / 8.0, dt**3 / 3.0, dt**2 / 2.0],
            [dt**3 / 6.0, dt**2 / 2.0, dt],
        ]
    )


def motion_root(dt: FloatArray, densities: FloatArray, motion: Motion) -> FloatArray:
    """Square-root information (K, D, D) of steps (K,), rows in the order of the tangent; densities [rotation, translation]."""
    count, size = dt.size, NODE_SIZE[motion]
    out = np.zeros((count, size, size))
    orders = size // 6
    for k in range(count):
        inverse = np.linalg.inv(np.linalg.cholesky(motion_covariance(float(dt[k]), motion)))
        for i in range(orders):
            for j in range(i + 1):
                for part in range(2):
                    axes = np.arange(3)
                    scale = inverse[i, j] / np.sqrt(densities[part])
                    out[k, 6 * i + 3 * part + axes, 6 * j + 3 * part + axes] = scale
    return out


def motion_rows(
    R: FloatArray, x: FloatArray, dt: FloatArray, motion: Motion
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals of the motion between successive nodes, with derivatives; not whitened.

    ``[Log(R1' R2) - w1 dt (- alpha1 dt^2/2); p2 - p1 - v1 dt (- a1 dt^2/2); w2 - w1 (- alpha1 dt); v2 - v1 (- a1 dt)(; alpha2 - alpha1;
    a2 - a1)]`` (mathematics 5.1, the rate kept as a state).

    Parameters
    ----------
    R : (K + 1, 3, 3) ndarray
    x : (K + 1, D - 3) ndarray
    dt : (K,) ndarray

    Returns
    -------
    residual : (K, D) ndarray
    J_first, J_second : (K, D, D) ndarray
    """
    size = NODE_SIZE[motion]
    count = dt.size
    phi = lie.so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:])
    h = dt[:, None]
    residual = np.empty((count, size))
    before, after = x[:-1], x[1:]
    # Tangent order is [theta, p, w, v, alpha, a]; x begins with p.
    residual[:, :3] = phi - h * before[:, 3:6]
    residual[:, 3:] = after - before
    residual[:, 3:6] -= h * before[:, 6:9]
    first = np.zeros((count, size, size))
    second = np.zeros((count, size, size))
    axes = np.arange(size)
    first[:, axes, axes], second[:, axes, axes] = -1.0, 1.0
    right = lie.so3_right_jacobian_inverse(phi)
    # The inverse left Jacobian is the transpose of the right one.
    first[:, :3, :3], second[:, :3, :3] = -np.swapaxes(right, 1, 2), right
    low = np.arange(size - 6)
    first[:, low, low + 6] = -h
    if motion == "jerk":
        residual[:, :3] -= 0.5 * h**2 * before[:, 9:12]
        residual[:, 3:6] -= 0.5 * h**2 * before[:, 12:15]
        residual[:, 6:12] -= h * before[:, 9:15]
        first[:, np.arange(6), np.arange(6) + 12] = -0.5 * h**2
    return residual, first, second


def transition(
    R: FloatArray, x: FloatArray, dt: float, motion: Motion
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The node after `dt` without noise, and the derivative (D, D) of its tangent by that of the node before."""
    size = NODE_SIZE[motion]
    turn = dt * x[3:6]
    out = x.copy()
    out[:3] += dt * x[6:9]
    F = np.eye(size)
    low = np.arange(size - 6)
    F[low, low + 6] = dt
    if motion == "jerk":
        turn = turn + 0.5 * dt**2 * x[9:12]
        out[:3] += 0.5 * dt**2 * x[12:15]
        out[3:9] += dt * x[9:15]
        F[np.arange(6), np.arange(6) + 12] = 0.5 * dt**2
    step = lie.so3_exp(turn)
    right = lie.so3_right_jacobian(turn)
    F[:3, :3] = step.T
    F[:3, 6:9] = dt * right
    if motion == "jerk":
        F[:3, 12:15] = 0.5 * dt**2 * right
    return R @ step, out, F


def process_covariance(dt: float, densities: FloatArray, motion: Motion) -> FloatArray:
    """Covariance (D, D) of a step in tangent order."""
    unit = motion_covariance(dt, motion)
    return np.asarray(np.kron(unit, np.kron(np.diag(densities), _IDENTITY)))


def retract(R: FloatArray, x: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Move nodes by tangent steps (K, D)."""
    return np.asarray(R @ lie.so3_exp(step[:, :3])), x + step[:, 3:]

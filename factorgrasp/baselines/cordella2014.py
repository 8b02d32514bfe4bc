"""The estimator printed in Cordella et al. 2014: an augmented unscented Kalman filter with blob-by-blob association.

State ``T, v, R`` of the wrist in the start frame, driven by white acceleration and white angular rate (equation 5), predicted projections
by sigma points (9 to 11), every blob to its most probable marker or to clutter (12). Two readings of it:

- as printed: image points only and the rotation as ZYZ Euler angles. That sequence is singular at the neutral posture, where the filter
  starts, so it is kept for the record only;
- on the manifold, with or without the depth of each blob: what the method can do at its best, for comparison.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.wrist_settings import WristNoise
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.recordings.blobs import BlobFrame, BlobRecording
from factorgrasp.typing import FloatArray, IntArray

Attitude = Literal["manifold", "zyz"]
DEPTH_RANGE = 1.0
"""m over which clutter is spread in depth."""


@dataclass(frozen=True)
class UkfSettings:
    """Noise and association of the filter.

    Attributes
    ----------
    attitude : {"manifold", "zyz"}
    depth : bool
        Whether the blobs' depth is used.
    acceleration_sd : float
        Of ``n_v``, m/s^2.
    rate_sd : float
        Of ``n_w``, rad/s.
    detection, clutter : float
        Priors of the association: a marker is seen, blobs of clutter a frame.
    layout_noise : bool
        Whether the layout's covariance is added to that of each residual.
    alpha, beta, kappa : float
        Of the scaled unscented transform.
    """

    attitude: Attitude = "manifold"
    depth: bool = True
    acceleration_sd: float = 3.0
    rate_sd: float = 1.0
    detection: float = 0.9
    clutter: float = 2.0
    layout_noise: bool = True
    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0


@dataclass(frozen=True, eq=False)
class UkfTrack:
    """Filtered poses in ``W0``.

    Attributes
    ----------
    t : (n,) ndarray
    rotation : (n, 3, 3) ndarray
        ``R_w0_w``.
    position, velocity : (n, 3) ndarray
        m, m/s.
    covariance : (n, 6, 6) ndarray
        [rotation; translation], rotation as right perturbation (for ZYZ angles: mapped to first order).
    association : (m,) ndarray of int
        0 clutter, 1..n.
    """

    t: FloatArray
    rotation: FloatArray
    position: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    association: IntArray


def zyz_to_matrix(angles: FloatArray) -> FloatArray:
    """``R_z(a) R_y(b) R_z(c)`` of angles (..., 3), rad."""
    axis = np.eye(3)
    first = lie.so3_exp(angles[..., :1] * axis[2])
    second = lie.so3_exp(angles[..., 1:2] * axis[1])
    return np.asarray(first @ second @ lie.so3_exp(angles[..., 2:] * axis[2]))


def matrix_to_zyz(R: FloatArray) -> FloatArray:
    """ZYZ Euler angles (..., 3), rad; at the singularity the first and the last share the turn arbitrarily."""
    return np.stack(
        [
            np.arctan2(R[..., 1, 2], R[..., 0, 2]),
            np.arctan2(np.hypot(R[..., 0, 2], R[..., 1, 2]), R[..., 2, 2]),
            np.arctan2(R[..., 2, 1], -R[..., 2, 0]),
        ],
        axis=-1,
    )


class WristUkf:
    """The filter.

    Parameters
    ----------
    camera : Camera
    markers : MarkerLayout
    camera_pose : CameraPose
        Where ``W0`` is; the hand starts there, in its neutral posture (the paper's initialisation).
    noise : WristNoise, optional
        Of pixels and depth.
    settings : UkfSettings, optional
    """

    def __init__(
        self,
        camera: Camera,
        markers: MarkerLayout,
        camera_pose: CameraPose,
        noise: WristNoise | None = None,
        settings: UkfSettings | None = None,
    ) -> None:
        self.camera, self.markers, self.camera_pose = camera, markers, camera_pose
        self.noise, self.settings = noise or WristNoise(), settings or UkfSettings()
        if self.settings.attitude not in ("manifold", "zyz"):
            raise InputError("attitude", "'manifold' or 'zyz'", repr(self.settings.attitude))
        self.R: FloatArray = np.eye(3)
        self.angles: FloatArray = np.zeros(3)
        self.T: FloatArray = np.zeros(3)
        self.v: FloatArray = np.zeros(3)
        # [rotation (or angles), T, v]
        self.P: FloatArray = np.diag(np.repeat([np.deg2rad(3.0), 3e-3, 0.05], 3) ** 2)
        self.t: float | None = None

    def run(self, blobs: BlobRecording) -> UkfTrack:
        """Filter a whole recording."""
        count = len(blobs)
        R, T, v = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
        P = np.empty((count, 6, 6))
        association = np.zeros(blobs.frame.size, dtype=np.intp)
        for k in range(count):
            association[blobs.rows(k)] = self.step(blobs.at(k))
            R[k], T[k], v[k], P[k] = self.R, self.T, self.v, self._pose_covariance()
        return UkfTrack(blobs.t.copy(), R, T, v, P, association)

    def step(self, blobs: BlobFrame) -> IntArray:
        """Predict to the frame, associate, correct; returns the marker (1..n, 0 clutter) of every blob."""
        if self.t is not None:
            self._predict(blobs.t - self.t)
        self.t = blobs.t
        return self._correct(blobs)

    # ---- unscented transform

    def _weights(self, n: int) -> tuple[FloatArray, FloatArray, float]:
        s = self.settings
        scale = s.alpha**2 * (n + s.kappa)
        mean = np.full(2 * n + 1, 0.5 / scale)
        mean[0] = 1.0 - n / scale
        covariance = mean.copy()
        covariance[0] += 1.0 - s.alpha**2 + s.beta
        return mean, covariance, scale

    def _sigma(self, P: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Deviations (2n + 1, n) and weights."""
        n = P.shape[0]
        mean, covariance, scale = self._weights(n)
        values, axes = np.linalg.eigh(0.5 * (P + P.T))
        root = axes * np.sqrt(scale * np.maximum(values, 0.0))
        return np.concatenate([np.zeros((1, n)), root.T, -root.T]), mean, covariance

    def _turned(self, deviation: FloatArray) -> FloatArray:
        """Rotations of sigma points (k, 3, 3)."""
        if self.settings.attitude == "manifold":
            return np.asarray(self.R @ lie.so3_exp(deviation))
        return zyz_to_matrix(self.angles + deviation)

    def _predict(self, dt: float) -> None:
        s = self.settings
        noise = np.repeat([s.acceleration_sd, s.rate_sd], 3) ** 2
        augmented = np.zeros((15, 15))
        augmented[:9, :9] = self.P
        augmented[9:, 9:] = np.diag(noise)
        X, w_mean, w_cov = self._sigma(augmented)
        R = self._turned(X[:, :3]) @ lie.so3_exp(dt * X[:, 12:15])
        T = self.T + X[:, 3:6] + dt * (self.v + X[:, 6:9])
        v = self.v + X[:, 6:9] + dt * X[:, 9:12]
        D = np.empty((X.shape[0], 9))
        if s.attitude == "manifold":
            centre = R[0]
            for _ in range(3):
                d = lie.so3_log(centre.T @ R)
                centre = centre @ lie.so3_exp(w_mean @ d)
            D[:, :3] = lie.so3_log(centre.T @ R)
            self.R = centre
        else:
            angles = matrix_to_zyz(R)
            # Angles are averaged as they are, wrapped about the middle one: what a filter on Euler angles does.
            angles = angles[0] + (angles - angles[0] + np.pi) % (2.0 * np.pi) - np.pi
            self.angles = w_mean @ angles
            self.R = zyz_to_matrix(self.angles)
            D[:, :3] = angles - self.angles
        self.T, self.v = w_mean @ T, w_mean @ v
        D[:, 3:6], D[:, 6:] = T - self.T, v - self.v
        self.P = (D * w_cov[:, None]).T @ D

    def _correct(self, blobs: BlobFrame) -> IntArray:
        out = np.zeros(len(blobs), dtype=np.intp)
        X, w_mean, w_cov = self._sigma(self.P)
        R, T = self._turned(X[:, :3]), self.T + X[:, 3:6]
        local = np.einsum("kij,nj->kni", R, self.markers.points) + T[:, None]
        pose = self.camera_pose
        seen = local @ pose.rotation.T + pose.position
        uvz = np.concatenate([self.camera.project(seen), seen[..., 2:]], axis=-1)
        if not np.isfinite(uvz).all():
            return out
        mean = np.einsum("k,kni->ni", w_mean, uvz)
        D = uvz - mean
        own = self._own_noise(seen[0])
        marker, depth = self._associate(blobs, D, mean, w_cov, own)
        used = np.flatnonzero(marker >= 0)
        if not used.size:
            return out
        rows, innovation, R_rows = [], [], []
        for i in used:
            j, deep = marker[i], depth[i]
            size = 3 if deep else 2
            rows.append(D[:, j, :size])
            value = np.append(blobs.uv[i], blobs.depth[i])[:size]
            innovation.append(value - mean[j, :size])
            R_rows.append(self._noise(blobs, int(i), own[j])[:size, :size])
        Y = np.concatenate(rows, axis=1)
        S = (Y * w_cov[:, None]).T @ Y
        start = 0
        for block in R_rows:
            end = start + block.shape[0]
            S[start:end, start:end] += block
            start = end
        C = (X * w_cov[:, None]).T @ Y
        K = np.linalg.solve(S, C.T).T
        step = K @ np.concatenate(innovation)
        self.P = self.P - K @ S @ K.T
        self.P = 0.5 * (self.P + self.P.T)
        if self.settings.attitude == "manifold":
            self.R = self.R @ lie.so3_exp(step[:3])
        else:
            self.angles = self.angles + step[:3]
            self.R = zyz_to_matrix(self.angles)
        self.T, self.v = self.T + step[3:6], self.v + step[6:]
        out[used] = marker[used] + 1
        return out

    def _own_noise(self, seen: FloatArray) -> FloatArray:
        """(n, 3, 3) what the layout's covariance makes of (u, v, z)."""
        if not self.settings.layout_noise:
            return np.zeros((len(seen), 3, 3))
        J = np.empty((len(seen), 3, 3))
        J[:, :2] = self.camera.project_with_jacobian(seen)[1]
        J[:, 2] = (0.0, 0.0, 1.0)
        J = J @ (self.camera_pose.rotation @ self.R)
        return np.asarray(J @ self.markers.blocks @ np.swapaxes(J, 1, 2))

    def _noise(self, blobs: BlobFrame, i: int, own: FloatArray) -> FloatArray:
        out = own.copy()
        out[:2, :2] += (
            self.noise.pixel_sd**2 * np.eye(2) if blobs.covariance_uv is None else blobs.covariance_uv[i]
        )
        z = blobs.depth[i] if np.isfinite(blobs.depth[i]) else 0.8
        out[2, 2] += (
            float(self.noise.depth_variance(np.array([z]))[0])
            if blobs.covariance_depth is None
            else blobs.covariance_depth[i]
        )
        return out

    def _associate(
        self, blobs: BlobFrame, D: FloatArray, mean: FloatArray, w_cov: FloatArray, own: FloatArray
    ) -> tuple[IntArray, IntArray]:
        """Equation (12): every blob by itself; of two for one marker the more probable one stays."""
        s = self.settings
        deep = np.isfinite(blobs.depth) & s.depth
        marker = np.full(len(blobs), -1, dtype=np.intp)
        best = np.full(len(mean), -np.inf)
        P = np.einsum("k,kni,knj->nij", w_cov, D, D)
        for i in range(len(blobs)):
            size = 3 if deep[i] else 2
            value = np.append(blobs.uv[i], blobs.depth[i])[:size]
            S = (P + self._noise(blobs, i, np.zeros((3, 3))) + own)[:, :size, :size]
            r = value - mean[:, :size]
            d = np.einsum("ni,ni->n", r, np.linalg.solve(S, r[..., None])[..., 0])
            logp = -0.5 * (d + np.log(np.linalg.det(S)) + size * np.log(2.0 * np.pi)) + np.log(s.detection)
            spread = self.camera.pixels * (DEPTH_RANGE if deep[i] else 1.0)
            clutter = np.log(max(s.clutter, 0.02) * (1.0 - s.detection)) - np.log(spread)
            j = int(np.argmax(logp))
            if logp[j] > clutter and logp[j] > best[j]:
                marker[marker == j] = -1
                marker[i], best[j] = j, logp[j]
        return marker, np.asarray(deep, dtype=np.intp)

    def _pose_covariance(self) -> FloatArray:
        P = self.P[:6, :6].copy()
        if self.settings.attitude == "zyz":
            # Right Jacobian of the angles by differences: theta = J d(angles).
            h = 1e-6
            moved = zyz_to_matrix(self.angles + h * np.eye(3))
            J = np.zeros((6, 6))
            J[:3, :3] = lie.so3_log(self.R.T @ moved).T / h
            J[3:, 3:] = np.eye(3)
            P = J @ P @ J.T
        return P

"""From the camera's frame to the start frame ``W0``, and where ``W0`` is: the hand's pose in the first frames (Cordella 2014, III-D).

The paper's equation (15) adds pixels and metres; here every residual is weighted by its covariance (mathematics 5.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from factorgrasp import lie
from factorgrasp.models.camera import Camera
from factorgrasp.problems.wrist_model import Pairs, predict
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.typing import FloatArray

_DRIFT = float(chi2.ppf(0.99, 6))
_FEWEST = 4
_STEPS = 6


@dataclass(frozen=True, eq=False)
class WristPoseIn0:
    """One node in ``W0``: rotation, position, velocity (W0), angular velocity (W), and their covariances (6, 6)."""

    R: FloatArray
    p: FloatArray
    v: FloatArray
    w: FloatArray
    covariance: FloatArray
    velocity_covariance: FloatArray


def in_start_frame(
    start: CameraPose, R: FloatArray, x: FloatArray, covariance: FloatArray, with_layout: FloatArray
) -> WristPoseIn0:
    """A node ``[p, w, v, ...]`` with covariance in ``[theta, p, w, v, ...]`` seen from ``W0``, what is not known of ``W0`` included.

    Parameters
    ----------
    start : CameraPose
    R, x : (3, 3), (D - 3,) ndarray
        In the camera frame.
    covariance : (D, D) ndarray
    with_layout : (D, 3n or 0) ndarray
    """
    R_0 = start.rotation
    if not np.isfinite(covariance[:6, :6]).all():
        nothing = np.full(3, np.nan)
        unknown = np.diag(np.full(6, np.inf))
        return WristPoseIn0(np.full((3, 3), np.nan), nothing, nothing, nothing, unknown, unknown)
    rotation, position = R_0.T @ R, R_0.T @ (x[:3] - start.position)
    # theta = theta_k - R' theta_0, and p = R_0' (dp_k - dp_0) + [p]x theta_0.
    own, other = np.zeros((6, 6)), np.zeros((6, 6))
    own[:3, :3], own[3:, 3:] = np.eye(3), R_0.T
    other[:3, :3], other[3:, 3:] = -rotation.T, -R_0.T
    other[3:, :3] = lie.skew(position)
    P = own @ covariance[:6, :6] @ own.T + other @ start.covariance @ other.T
    if start.layout_gain.size and with_layout.size:
        both = own @ with_layout[:6] @ start.layout_gain.T @ other.T
        P = P + both + both.T
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = np.eye(3), R_0.T
    spread = turn @ covariance[6:12, 6:12] @ turn.T
    return WristPoseIn0(rotation, position, R_0.T @ x[6:9], x[3:6], _positive(P), spread)


def _positive(P: FloatArray) -> FloatArray:
    """The same without eigenvalues that the approximated correlation with ``W0`` made too small."""
    P = 0.5 * (P + P.T)
    if not np.isfinite(P).all():
        return P
    values, axes = np.linalg.eigh(P)
    return np.asarray((axes * np.maximum(values, 1e-12)) @ axes.T)


def start_pose(
    camera: Camera,
    points: FloatArray,
    layout_covariance: FloatArray,
    pairs: Pairs,
    R: FloatArray,
    p: FloatArray,
) -> CameraPose:
    """Pose of a hand at rest by least squares over all its blobs of some frames.

    Parameters
    ----------
    camera : Camera
    points : (n, 3) ndarray
        m.
    layout_covariance : (3n, 3n) ndarray
        m^2.
    pairs : Pairs
        Of the frames, one after another; `node` numbers the frames.
    R, p : ndarray
        Where to begin.
    """
    R, p, A, A_layout = _static(camera, points, pairs, R, p)
    H = np.linalg.inv(A.T @ A + 1e-9 * np.eye(6))
    gain = -H @ (A.T @ A_layout)
    C = H + gain @ layout_covariance @ gain.T
    frames = int(np.unique(pairs.node).size)
    return CameraPose(R, p, 0.5 * (C + C.T), frames, gain if np.any(layout_covariance) else np.zeros((6, 0)))


def moved(
    camera: Camera, points: FloatArray, pairs: Pairs, t: FloatArray, R: FloatArray, p: FloatArray
) -> bool:
    """Whether a hand that should be at rest drifted over the frames: a rate of the pose that its noise does not explain.

    `t` (frames,) are the times of the nodes of `pairs`.
    """
    R, p, A, _ = _static(camera, points, pairs, R, p)
    tau = np.repeat((t - t.mean())[pairs.node], 3)[:, None]
    uvz = _seen(camera, points, pairs, R, p)[0]
    r = (pairs.root @ (pairs.uvz - uvz)[:, :, None])[:, :, 0].ravel()
    B = A * tau
    H = B.T @ B - B.T @ A @ np.linalg.solve(A.T @ A + 1e-9 * np.eye(6), A.T @ B)
    g = B.T @ (r - A @ np.linalg.lstsq(A, r, rcond=None)[0])
    return bool(g @ np.linalg.solve(H + 1e-9 * np.eye(6), g) > _DRIFT)


def _static(
    camera: Camera, points: FloatArray, pairs: Pairs, R: FloatArray, p: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """One pose for all pairs, and the whitened derivatives by pose (3M, 6) and layout (3M, 3n)."""
    A = np.zeros((3 * len(pairs), 6))
    J_point = np.zeros((len(pairs), 3, 3))
    for _ in range(_STEPS):
        uvz, J, J_point = _seen(camera, points, pairs, R, p)
        r = (pairs.root @ (pairs.uvz - uvz)[:, :, None])[:, :, 0].ravel()
        A = (pairs.root @ J).reshape(-1, 6)
        step = np.linalg.solve(A.T @ A + 1e-9 * np.eye(6), A.T @ r)
        R, p = R @ lie.so3_exp(step[:3]), p + step[3:]
        if float(np.sum((A @ step) ** 2)) < 1e-12:
            break
    A_layout = np.zeros((len(pairs), 3, points.size))
    rows = np.arange(len(pairs))[:, None]
    columns = 3 * pairs.marker[:, None] + np.arange(3)
    A_layout[rows, :, columns] = np.swapaxes(pairs.root @ J_point, 1, 2)
    return R, p, A, A_layout.reshape(-1, points.size)


def _seen(
    camera: Camera, points: FloatArray, pairs: Pairs, R: FloatArray, p: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    count = len(pairs)
    return predict(
        camera, np.broadcast_to(R, (count, 3, 3)), np.broadcast_to(p, (count, 3)), points[pairs.marker]
    )


class StartFrame:
    """Averages the first frames as they come, as long as the hand is at rest.

    Parameters
    ----------
    camera : Camera
    points : (n, 3) ndarray
    layout_covariance : (3n, 3n) ndarray
    most : int
        Frames.
    given : CameraPose, optional
        Then nothing is averaged.
    """

    def __init__(
        self,
        camera: Camera,
        points: FloatArray,
        layout_covariance: FloatArray,
        most: int,
        given: CameraPose | None = None,
    ) -> None:
        self._camera, self._points, self._layout = camera, points, layout_covariance
        self._most = most
        self.pose = given
        self.closed = given is not None
        self._pairs: list[Pairs] = []
        self._t: list[float] = []

    def add(self, t: float, pairs: Pairs, R: FloatArray, p: FloatArray) -> None:
        """The pairs of one frame and a rough pose; frames with fewer than three markers say nothing."""
        if self.closed or len(pairs) < 3:
            return
        node = np.full(len(pairs), len(self._t), dtype=np.intp)
        joined = Pairs.join(
            [*self._pairs, Pairs(node, pairs.marker, pairs.uvz, pairs.root, pairs.covariance)]
        )
        times = np.array([*self._t, t])
        if self.pose is not None:
            R, p = self.pose.rotation, self.pose.position
            if times.size >= _FEWEST and moved(self._camera, self._points, joined, times, R, p):
                self.closed = True
                return
        self.pose = start_pose(self._camera, self._points, self._layout, joined, R, p)
        self._pairs, self._t = [joined], times.tolist()
        if len(self._t) >= self._most:
            self.closed, self._pairs = True, []

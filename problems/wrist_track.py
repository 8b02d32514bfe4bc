"""The wrist's pose over time, as every estimator of it returns it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from factorgrasp import lie
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Gap:
    """A stretch of frames in which no marker was used.

    Attributes
    ----------
    start, end : float
        Times of its first and last frame, s.
    frames : int
    lost : bool
        Whether the track was lost in it, so that a labelling search had to find the hand again.
    found : float or None
        Time of the first frame that was used after it; None when there was none.
    """

    start: float
    end: float
    frames: int
    lost: bool
    found: float | None


@dataclass(frozen=True, eq=False)
class CameraPose:
    """Where the start frame ``W0`` is seen from the camera.

    Attributes
    ----------
    rotation : (3, 3) ndarray
        ``R_c_w0``.
    position : (3,) ndarray
        ``p_c_w0``, m.
    covariance : (6, 6) ndarray
        [rotation; position]: rotation as right perturbation ``R_c_w0 Exp(d)``, position in the camera frame; zero when the pose was given
        as exact.
    frames : int
        Frames that it was averaged over; 0: given.
    layout_gain : (6, 3n) ndarray
        How an error of the layout moves this pose; empty when it does not. A rigid error of the layout then cancels between W0 and W.
    """

    rotation: FloatArray
    position: FloatArray
    covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    frames: int = 0
    layout_gain: FloatArray = field(default_factory=lambda: np.zeros((6, 0)))


@dataclass(frozen=True, eq=False)
class WristTrack:
    """Pose of the moving wrist frame ``W`` in the start frame ``W0``, one row a frame.

    A gap has the prediction, or the smoothed pose, with a covariance that grows; frames before the hand was found for the first time have
    NaN poses and infinite variances.

    Attributes
    ----------
    t : (n,) ndarray
        s.
    rotation_wxyz : (n, 4) ndarray
        Unit quaternion [w, x, y, z] of ``R_w0_w``.
    position : (n, 3) ndarray
        ``p_w0_w``, m.
    velocity : (n, 3) ndarray
        Of the wrist's origin, in W0, m/s.
    angular_velocity : (n, 3) ndarray
        Of W, in W, rad/s.
    covariance : (n, 6, 6) ndarray
        [rotation; translation]: rotation as right perturbation ``R_w0_w Exp(d)`` (rad, in W), translation in W0 (m). What is not known of
        W0 itself is included.
    velocity_covariance : (n, 6, 6) ndarray
        [angular velocity (in W); velocity (in W0)].
    association : (m,) ndarray of int
        For every blob of the recording: 0 clutter, 1..n_markers the marker (in the layout's order).
    lost : (n,) ndarray of bool
        No trusted pose in this frame.
    ambiguous : (n,) ndarray of bool
        Without depth two poses explain the frame's pixels; the covariance covers both.
    gaps : tuple of Gap
    markers : MarkerLayout
        The layout that was used, or estimated with its covariance.
    camera_pose : CameraPose
    delay : int
        Frames by which these poses lag behind the newest blobs: 0 filtered, n a fixed lag, -1 the whole recording.
    """

    t: FloatArray
    rotation_wxyz: FloatArray
    position: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    covariance: FloatArray
    velocity_covariance: FloatArray
    association: IntArray
    lost: BoolArray
    ambiguous: BoolArray
    gaps: tuple[Gap, ...]
    markers: MarkerLayout
    camera_pose: CameraPose
    delay: int = -1

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def rotation(self) -> FloatArray:
        """``R_w0_w`` (n, 3, 3)."""
        return lie.quaternion_wxyz_to_matrix(self.rotation_wxyz)

    @property
    def camera_rotation(self) -> FloatArray:
        """``R_c_w`` (n, 3, 3)."""
        return np.asarray(self.camera_pose.rotation @ self.rotation)

    @property
    def camera_position(self) -> FloatArray:
        """``p_c_w`` (n, 3), m."""
        return np.asarray(self.position @ self.camera_pose.rotation.T + self.camera_pose.position)

    def errors_to(self, rotation: FloatArray, position: FloatArray) -> FloatArray:
        """``[log(R_w0_w' R); p - p_w0_w]`` (n, 6) from this track to a true one, in the coordinates of `covariance`."""
        turn = lie.so3_log(np.swapaxes(self.rotation, -1, -2) @ np.asarray(rotation))
        return np.concatenate([turn, np.asarray(position) - self.position], axis=-1)

"""The wrist's pose while the camera runs."""

from __future__ import annotations

from dataclasses import dataclass

from factorgrasp import lie
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.wrist_settings import WristAssociation, WristNoise, WristSettings
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.typing import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class WristState:
    """Pose of ``W`` in ``W0`` at one time.

    Attributes
    ----------
    t : float
        s.
    rotation : (3, 3) ndarray
        ``R_w0_w``.
    position : (3,) ndarray
        ``p_w0_w``, m.
    velocity : (3,) ndarray
        In W0, m/s.
    angular_velocity : (3,) ndarray
        In W, rad/s.
    covariance : (6, 6) ndarray
        [rotation; translation], as in `WristTrack`.
    lost, ambiguous : bool
    """

    t: float
    rotation: FloatArray
    position: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    covariance: FloatArray
    lost: bool
    ambiguous: bool

    @property
    def rotation_wxyz(self) -> FloatArray:
        """Unit quaternion [w, x, y, z]."""
        return lie.matrix_to_quaternion_wxyz(self.rotation)


@dataclass(frozen=True, eq=False)
class OnlineWristEstimate:
    """What is known after one frame.

    Attributes
    ----------
    newest : WristState
        Of this frame, without delay.
    lagged : WristState or None
        Of the frame that has just left the lag: smoothed, final; None until the first one has.
    association : (m,) ndarray of int
        Of this frame's blobs: 0 clutter, 1..n the marker.
    gap : float
        s since the last frame in which a marker was used; 0 when this one was.
    message : str
        Empty, or what is wrong in words: not found yet, lost, ambiguous, late frame dropped, intrinsics suspected.
    latency : float
        Seconds that the step took.
    """

    newest: WristState
    lagged: WristState | None
    association: IntArray
    gap: float
    message: str
    latency: float


class OnlineWristPose:
    """Streaming form of :class:`factorgrasp.problems.wrist_pose.WristPose`: ``push(t, uv, depth)`` returns an `OnlineWristEstimate`.

    Parameters
    ----------
    camera, markers, association, noise, settings, camera_pose
        As for the problem.
    late : float
        s that a frame may come after a newer one and still be put in its place.
    """

    def __init__(
        self,
        camera: Camera,
        markers: MarkerLayout,
        association: WristAssociation | None = None,
        noise: WristNoise | None = None,
        settings: WristSettings | None = None,
        camera_pose: CameraPose | None = None,
        late: float = 0.1,
    ) -> None:
        self.camera, self.markers, self.late = camera, markers, late
        self.association = association or WristAssociation()
        self.noise = noise or WristNoise()
        self.settings = settings or WristSettings()
        self.camera_pose = camera_pose

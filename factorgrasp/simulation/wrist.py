"""The experiments of Cordella et al. 2014, section IV, as a scenario with ground truth.

An RGB-D camera looks down at a hand with six markers. The paper prints a camera (640 x 480, about 30 frames a second, at least 0.6 m
away), the movements and one number, 25 degrees of abduction; everything else here is stated at :class:`WristSensing` and below.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.lie import matrix_to_quaternion_wxyz, so3_exp
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import PALM_NAMES, PALM_POINTS, MarkerLayout
from factorgrasp.recordings.blobs import BlobRecording
from factorgrasp.simulation.wrist_motion import Motion, WristMotion, wrist_motion
from factorgrasp.simulation.wrist_sensing import SensedBlobs, WristSensing, arrivals, sense
from factorgrasp.toml_tables import close_matches
from factorgrasp.typing import BoolArray, FloatArray, IntArray

XTION = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
"""The class of camera that the paper used; its calibration is not printed."""

DISTANCE = 0.7
"""From the camera to the hand (m); the paper asks for at least 0.6."""

_LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
_CENTER = {"reach": (0.19, 0.03, 0.0)}


@dataclass(frozen=True, eq=False)
class WristTruth:
    """What an estimate is compared with; one row a frame of the recording.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s.
    pose : ndarray, shape (n, 4, 4)
        ``T_W0_W``; the identity at the start.
    velocity, angular_velocity : ndarray, shape (n, 3)
        Of the origin of ``W`` in ``W0`` (m/s); of ``W`` in ``W`` (rad/s).
    angles : ndarray, shape (n, 3) or None
        Flexion, deviation, pronation (rad): rotations about y, z, x.
    T_c_W0 : ndarray, shape (4, 4)
        Start frame of the wrist in the camera's frame.
    points : ndarray, shape (k, 3)
        The markers in ``W`` (m).
    camera : Camera
        The true one; the recording's may be wrong on purpose.
    hidden : ndarray, shape (n, k)
        Markers that the camera could not see.
    """

    t: FloatArray
    pose: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    angles: FloatArray | None
    T_c_W0: FloatArray
    points: FloatArray
    camera: Camera
    hidden: BoolArray

    @property
    def rotation(self) -> FloatArray:
        """``R_W0_W``, shape (n, 3, 3)."""
        return self.pose[:, :3, :3]

    @property
    def rotation_wxyz(self) -> FloatArray:
        """``R_W0_W`` as unit quaternions, w first, shape (n, 4)."""
        return matrix_to_quaternion_wxyz(self.rotation, continuous=True)

    @property
    def position(self) -> FloatArray:
        """``p_W0_W`` (m), shape (n, 3)."""
        return self.pose[:, :3, 3]

    @property
    def T_c_W(self) -> FloatArray:
        """The wrist in the camera's frame, shape (n, 4, 4)."""
        return self.T_c_W0 @ self.pose


@dataclass(frozen=True, eq=False)
class WristRecording:
    """A simulated recording: what an estimator may use, and the truth.

    Attributes
    ----------
    blobs : BlobRecording
        With the true labels.
    camera : Camera
        The intrinsics as they are believed.
    layout : MarkerLayout
        The markers as they were measured, with their covariance.
    arrival : ndarray, shape (n,)
        When each frame reaches an online estimator (s); it may be after that of a later frame.
    truth : WristTruth
    sensing : WristSensing
    hand : {"right", "left"}
    name : str
    """

    blobs: BlobRecording
    camera: Camera
    layout: MarkerLayout
    arrival: FloatArray
    truth: WristTruth
    sensing: WristSensing
    hand: Literal["right", "left"] = "right"
    name: str = "wrist"

    @property
    def label(self) -> IntArray:
        """True marker of every blob: 0 for clutter, 1 to k."""
        assert self.blobs.label is not None
        return self.blobs.label


def cordella2014(
    seed: int = 0,
    *,
    motion: Motion = "abduction",
    duration: float = 12.0,
    hand: Literal["right", "left"] = "right",
    speed: float = 1.0,
    distance: float = DISTANCE,
    layout_sd: float = 1e-3,
    anatomy_sd: float = 2e-3,
    camera: Camera = XTION,
    sensing: WristSensing | None = None,
    **options: Any,
) -> WristRecording:
    """Six markers on a moving hand, seen by an RGB-D camera.

    Parameters
    ----------
    seed : int
        Of everything random.
    motion : {"abduction", "flexion", "pronation", "three_axes", "reach"}
        25 deg of abduction and adduction as in Fig. 4; one of the other axes; all three at once; reach-and-grasp as in Figs. 5 and 6.
    duration : float
        s.
    hand : {"right", "left"}
        The left one is the mirror image.
    speed : float
        1: cycles of about 2.5 s, reaching in 1.4 s.
    distance : float
        From the camera to the hand (m).
    layout_sd : float
        With which the markers were measured, per coordinate (m).
    anatomy_sd : float
        By which this hand differs from the average one, per coordinate (m).
    camera : Camera
    sensing : WristSensing, optional
        How the markers are seen.
    **options
        Fields of :class:`WristSensing`, which go before those of `sensing`.

    Returns
    -------
    WristRecording
    """
    if hand not in ("right", "left"):
        raise InputError("hand", "'right' or 'left'", repr(hand))
    for name, value in (("duration", duration), ("distance", distance), ("speed", speed)):
        if not np.isfinite(value) or value <= 0.0:
            raise InputError(name, "a positive number", repr(value))
    seen = make_sensing(sensing or WristSensing(rate=camera.rate), options)
    rng = np.random.default_rng([seed, 5])
    t = np.arange(max(2, round(duration * seen.rate) + 1)) / seen.rate
    truth_motion = wrist_motion(motion, t, seed, speed)

    points = np.array(PALM_POINTS)
    points[1:] += anatomy_sd * rng.standard_normal((len(points) - 1, 3))
    points[3, 1:] = 0.0  # the x axis goes through the marker of the middle finger
    if hand == "left":
        points[:, 1] *= -1.0
    T = np.eye(4)
    roll, tilt = rng.uniform(-0.35, 0.35), np.deg2rad(4.0) * rng.standard_normal(2)
    T[:3, :3] = so3_exp([0.0, 0.0, roll]) @ so3_exp([*tilt, 0.0]) @ _LOOKING_DOWN
    T[:3, 3] = np.array([0.0, 0.0, distance]) - T[:3, :3] @ np.array(_CENTER.get(motion, (0.05, 0.0, 0.0)))
    name = f"cordella2014 ({motion})"
    return record(truth_motion, T, points, PALM_NAMES, camera, seen, rng, layout_sd, hand=hand, name=name)


def record(
    motion: WristMotion,
    T_c_W0: FloatArray,
    points: FloatArray,
    names: tuple[str, ...],
    camera: Camera,
    sensing: WristSensing,
    rng: np.random.Generator,
    layout_sd: float = 1e-3,
    layout_error: float | None = None,
    hand: Literal["right", "left"] = "right",
    name: str = "wrist",
    angles: bool = True,
    seen_points: FloatArray | None = None,
    covered: BoolArray | None = None,
) -> WristRecording:
    """The recording of a motion by a camera.

    Parameters
    ----------
    motion : WristMotion
    T_c_W0 : ndarray, shape (4, 4)
    points : ndarray, shape (k, 3)
        Markers in ``W`` (m).
    names : tuple of str
    camera : Camera
        The true one.
    sensing : WristSensing
    rng : Generator
    layout_sd : float
        Standard deviation that the given layout states, per coordinate (m).
    layout_error : float, optional
        Of the error that it has (m); by default as large as stated.
    hand, name
    angles : bool
        Whether the motion's angles are known.
    seen_points : ndarray, shape (n, k, 3), optional
        Where the markers really are, in ``W``, when they are not rigid.
    covered : ndarray, shape (n, k), optional
        Frames in which a marker cannot be seen.
    """
    arrive, arrival = arrivals(motion.t, sensing, rng)
    T = T_c_W0 @ motion.pose
    local = np.broadcast_to(points, (motion.t.size, *points.shape)) if seen_points is None else seen_points
    P = np.einsum("nij,nkj->nki", T[:, :3, :3], local) + T[:, None, :3, 3]
    facing = -np.einsum("nkj,nj->nk", P / np.linalg.norm(P, axis=2, keepdims=True), T[:, :3, 2])
    blobs = sense(camera, P, facing, sensing, rng, covered)
    error = layout_sd if layout_error is None else layout_error
    measured = points + error * rng.standard_normal(points.shape)
    believed = replace(
        camera,
        fx=camera.fx * (1.0 + sensing.focal_error),
        fy=camera.fy * (1.0 + sensing.focal_error),
        cx=camera.cx + sensing.principal_error,
        cy=camera.cy + sensing.principal_error,
        rate=sensing.rate,
    )
    truth = WristTruth(
        motion.t[arrive],
        motion.pose[arrive],
        motion.velocity[arrive],
        motion.angular_velocity[arrive],
        motion.angles[arrive] if angles else None,
        T_c_W0,
        points,
        camera,
        blobs.hidden[arrive],
    )
    return WristRecording(
        _arrived(motion.t, arrive, blobs, name),
        believed,
        MarkerLayout.with_sd(names, measured, layout_sd),
        arrival[arrive],
        truth,
        sensing,
        hand,
        name,
    )


def _arrived(t: FloatArray, arrive: BoolArray, blobs: SensedBlobs, name: str) -> BlobRecording:
    rows = arrive[blobs.frame]
    number = np.cumsum(arrive) - 1
    return BlobRecording(
        t=t[arrive],
        frame=number[blobs.frame[rows]],
        uv=blobs.uv[rows],
        depth=blobs.z[rows],
        label=blobs.label[rows],
        name=name,
    )


def make_sensing(base: WristSensing, options: dict[str, Any]) -> WristSensing:
    """`base` with some fields replaced; an unknown one is an InputError."""
    known = [field.name for field in fields(WristSensing)]
    for key in options:
        if key not in known:
            raise InputError(
                key, "an option of cordella2014 or of WristSensing", "none", close_matches(key, known)
            )
    return replace(base, **options)

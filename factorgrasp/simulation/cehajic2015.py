"""The experiment of Cehajic et al., IROS 2015, section V, as a scenario with ground truth, and two that the paper leaves open.

A robot and a human hold a rigid frame; the wrist rests while the robot turns the object. All numbers printed in the paper are
used as printed, with these readings:

- ``q = [0 0 0 1]`` is ``[eta, eps]`` as in eq. (1): 180 degrees about z (the x-axes of both frames point at each other, Fig. 3).
- ``w_ref = [10 40 20] deg/s * sin(t)`` keeps **one axis**: angular velocity and acceleration are parallel, the regressor has rank
  2, and the printed motion violates the paper's own condition (23). ``motion="exciting"`` does what the text asks for.
- ``v_ref = r_0 x w_ref``: the robot turns about the point ``r_0`` of its own frame, which is not yet the wrist.
- The accelerometer's noise "0.002 deg/s^2/sqrt(Hz)" is a misprint for m/s^2/sqrt(Hz).

The paper says nothing of the robot's own noise or of biases; the defaults here are stated at :data:`ENCODER_NOISE` and
:data:`XSENS`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from factorgrasp.baselines.cehajic2015 import CehajicInputs
from factorgrasp.errors import InputError
from factorgrasp.lie import quaternion_wxyz_to_matrix, so3_exp
from factorgrasp.recordings.streams import MotionStream
from factorgrasp.simulation.grasp import (
    STANDARD_GRAVITY,
    GraspChange,
    GraspRecording,
    HandImu,
    RobotSensing,
    simulate_grasp,
)
from factorgrasp.simulation.trajectory import RigidTrajectory, Sinusoids
from factorgrasp.typing import FloatArray

TRANSLATION = (1.11, 0.16, 0.08)
"""``r`` of the paper (m)."""
QUATERNION_WXYZ = (0.0, 0.0, 0.0, 1.0)
"""``q`` of the paper, read as [eta, eps] = [w, x, y, z]."""
PRINTED_RATE = np.deg2rad((10.0, 40.0, 20.0))
"""Amplitude of the printed reference ``w_ref`` (rad/s)."""
PRINTED_CENTER = (0.5, 0.0, 0.0)
"""``r_0``: the point about which the printed motion turns (m, frame ``r``)."""

XSENS = HandImu(
    rate=1000.0,
    gyro_noise_density=float(np.deg2rad(0.05)),
    accelerometer_noise_density=0.002,
    gyro_bias_sd=0.01,
    accelerometer_bias_sd=0.05,
)
"""The paper's noise densities and step; the biases are of the class of sensor, not printed."""

ENCODER_NOISE = RobotSensing(
    output="motion",
    rate=1000.0,
    angular_velocity_sd=0.001,
    angular_acceleration_sd=0.05,
    acceleration_sd=0.02,
)
"""White noise of rates and accelerations that come from good encoders by differentiation, per sample at 1 kHz (not printed)."""

ROUGH_ENCODER_NOISE = RobotSensing(
    output="motion",
    rate=1000.0,
    angular_velocity_sd=0.005,
    angular_acceleration_sd=0.5,
    acceleration_sd=0.2,
)
"""The same from coarse encoders: noise that spoils an estimator which takes the robot's signals as exact.

The angular acceleration stands in the regressor, and ordinary least squares on it shortens the lever arm (errors in variables) by about
``2 sd^2 (G / T + 2 sd^2 I)^-1 r`` with the excitation matrix ``G`` over ``T``: 200 mm on the exciting motion.
"""

ENCODER_POSES = RobotSensing(output="pose", rate=1000.0, position_sd=5e-5, rotation_sd=5e-5)
"""The same encoders read as poses by forward kinematics: 0.05 mm and 0.05 mrad of white noise at 1 kHz (not printed)."""

_WRIST = (1.0, 0.0, 1.0)


def _printed_motion() -> RigidTrajectory:
    # phi' = w_ref sin(t) along one axis: phi = w_ref (1 - cos t), exactly.
    return RigidTrajectory(
        rotation=Sinusoids(
            PRINTED_RATE, [-PRINTED_RATE], [1.0 / (2.0 * np.pi)], np.full((1, 3), 0.5 * np.pi)
        ),
        center=Sinusoids(_WRIST),
        lever=PRINTED_CENTER,
    )


def _exciting_motion() -> RigidTrajectory:
    # A small fast cone shows the lever arm (angular accelerations about changing axes); slow wide turns about all axes show the
    # rotation and tell gravity from the accelerometer's bias; the hand sways by a few millimetres.
    x, y, z = np.eye(3)
    quarter = 0.5 * np.pi
    amplitude = [0.10 * y, 0.10 * z, 0.05 * x + 0.03 * y, 0.70 * y, 0.56 * z, 0.42 * x]
    phase = np.outer([quarter, 0.0, 0.4, 0.0, 1.0, 2.0], np.ones(3))
    return RigidTrajectory(
        rotation=Sinusoids((0.0, 0.0, 0.0), amplitude, (0.6, 0.6, 0.95, 0.08, 0.11, 0.133), phase),
        center=Sinusoids(_WRIST, [(0.004, 0.003, 0.002)], [0.23], [(0.0, 1.0, 2.0)]),
        lever=TRANSLATION,
    )


def cehajic2015(
    seed: int = 0,
    *,
    motion: Literal["exciting", "printed"] = "exciting",
    duration: float = 60.0,
    robot: RobotSensing = ENCODER_NOISE,
    hand: HandImu = XSENS,
    time_offset: float = 0.0,
    base_tilt: npt.ArrayLike = (0.0, 0.0, 0.0),
    changes: tuple[GraspChange, ...] = (),
    name: str = "cehajic2015",
) -> GraspRecording:
    """The paper's grasp and sensors under the printed or under an exciting motion.

    Parameters
    ----------
    seed : int
        Of noise and biases.
    motion : {"exciting", "printed"}
        ``printed``: ``w_ref = [10 40 20] deg/s sin(t)`` about ``r_0`` (one axis: the lever arm along it cannot be seen).
        ``exciting``: about the wrist, slow wide turns about all axes with a small cone at 0.6 Hz, peak rate 67 deg/s (printed: 46).
    duration : float
        s (the paper: 60).
    robot, hand : RobotSensing, HandImu
        Noise and rates; ``RobotSensing(output="pose", ...)`` gives a PoseStream instead.
    time_offset, base_tilt, changes
        As for :func:`factorgrasp.simulation.grasp.simulate_grasp`.
    name : str
        Of the recording.

    Returns
    -------
    GraspRecording
    """
    if motion not in ("exciting", "printed"):
        raise InputError("motion", "'exciting' or 'printed'", repr(motion))
    return simulate_grasp(
        _exciting_motion() if motion == "exciting" else _printed_motion(),
        quaternion_wxyz_to_matrix(QUATERNION_WXYZ),
        TRANSLATION,
        duration=duration,
        robot=robot,
        hand=hand,
        time_offset=time_offset,
        base_tilt=base_tilt,
        changes=changes,
        gravity=STANDARD_GRAVITY,
        seed=seed,
        name=f"{name} ({motion} motion)",
    )


def grasp_regrasp(
    seed: int = 0,
    *,
    at: float = 30.0,
    angle: float = float(np.deg2rad(10.0)),
    distance: float = 0.07,
    duration: float = 60.0,
) -> GraspRecording:
    """The hand takes another grasp at time ``at`` (s): turned by ``angle`` (rad), moved by ``distance`` (m), random directions."""
    return cehajic2015(
        seed, duration=duration, changes=(_change(seed, at, 0.0, angle, distance),), name="grasp_regrasp"
    )


def grasp_slip(
    seed: int = 0,
    *,
    at: float = 20.0,
    time: float = 20.0,
    angle: float = float(np.deg2rad(3.0)),
    distance: float = 0.02,
    duration: float = 60.0,
) -> GraspRecording:
    """The hand slips from time ``at`` on, within ``time`` (s), by ``angle`` (rad) and ``distance`` (m), random directions."""
    return cehajic2015(
        seed, duration=duration, changes=(_change(seed, at, time, angle, distance),), name="grasp_slip"
    )


def _change(seed: int, start: float, duration: float, angle: float, distance: float) -> GraspChange:
    axis, way = np.random.default_rng([seed, 2015]).standard_normal((2, 3))
    R = quaternion_wxyz_to_matrix(QUATERNION_WXYZ) @ so3_exp(angle * axis / np.linalg.norm(axis))
    return GraspChange(start, duration, R, np.array(TRANSLATION) + distance * way / np.linalg.norm(way))


def gravity_compensated(
    specific_force: FloatArray, rotation: FloatArray, gravity: npt.ArrayLike = STANDARD_GRAVITY
) -> FloatArray:
    """The paper's hand acceleration: ``v_h = f_h + R_w_h' g`` with the hand's orientation as its own sensor believes it.

    Parameters
    ----------
    specific_force : ndarray, shape (n, 3)
        Accelerometer, frame ``h`` (m/s^2).
    rotation : ndarray, shape (n, 3, 3)
        Believed ``R_w_h``. An error of 1 degree leaves 0.17 m/s^2 (the paper's "0.1 degrees cause 1.71 m/s^2" is 100 times too much).
    gravity : array_like, shape (3,)
        Frame ``w`` (m/s^2).

    Returns
    -------
    ndarray, shape (n, 3)
        Acceleration of the hand in frame ``h`` (m/s^2).
    """
    out: FloatArray = specific_force + np.asarray(gravity, dtype=np.float64) @ rotation
    return out


def paper_inputs(
    recording: GraspRecording, *, orientation_error: float = float(np.deg2rad(1.0)), seed: int = 0
) -> CehajicInputs:
    """The signals of a recording as the paper's estimator takes them.

    The hand's signals are interpolated linearly to the robot's stamps (the paper has one clock, and so no time offset is undone);
    samples of the robot without hand samples on either side within three steps are left out.

    Parameters
    ----------
    recording : GraspRecording
        With a MotionStream on the robot's side.
    orientation_error : float
        Size (rad) of the constant error of the hand's orientation estimate by which gravity is compensated, about a random axis.
    seed : int
        Of that axis.

    Returns
    -------
    CehajicInputs

    Raises
    ------
    InputError
        When the robot side holds poses only: the paper has measured rates and accelerations.
    """
    robot, hand = recording.robot, recording.hand
    if not isinstance(robot, MotionStream) or robot.rotation_wxyz is None:
        raise InputError("recording.robot", "a MotionStream with orientation", repr(robot))
    axis = np.random.default_rng([seed, 1]).standard_normal(3)
    believed = so3_exp(orientation_error * axis / np.linalg.norm(axis)) @ recording.hand_truth.rotation
    acceleration = gravity_compensated(hand.specific_force, believed, recording.gravity)
    before = np.searchsorted(hand.t, robot.t, side="right") - 1
    after = np.searchsorted(hand.t, robot.t, side="left")
    inside = (before >= 0) & (after < hand.t.size)
    inside[inside] = hand.t[after[inside]] - hand.t[before[inside]] <= 3.0 * hand.step
    t = robot.t[inside]
    return CehajicInputs(
        t,
        robot.angular_velocity[inside],
        robot.angular_acceleration[inside],
        gravity_compensated(
            robot.specific_force, quaternion_wxyz_to_matrix(robot.rotation_wxyz), recording.gravity
        )[inside],
        _interpolated(t, hand.t, hand.angular_velocity),
        _interpolated(t, hand.t, acceleration),
    )


def _interpolated(t: FloatArray, stamps: FloatArray, values: FloatArray) -> FloatArray:
    return np.stack([np.interp(t, stamps, column) for column in values.T], axis=1)

"""Ground truth for the grasp-pose problem: a robot that moves, a hand that holds on, and the sensors of both.

Frames: world ``w``, robot end-effector ``r``, human hand with its IMU ``h``. The grasp is ``R_r_h`` and ``p_r_h``.
Everything is evaluated from closed forms at each sensor's own sampling times; nothing is interpolated or differentiated
numerically. The rigid coupling that results is ``w_r = R w_h`` and ``f_r + (S(al_r) + S(w_r)^2) p_r_h = R f_h``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.lie import quaternion_exp_wxyz, quaternion_multiply_wxyz
from factorgrasp.recordings.streams import ImuStream, MotionStream, PoseStream
from factorgrasp.simulation.grasp_truth import (
    STANDARD_GRAVITY,
    GraspChange,
    GraspTruth,
    gravity_error,
    hand_motion,
)
from factorgrasp.simulation.trajectory import RigidMotion, RigidTrajectory
from factorgrasp.typing import FloatArray

__all__ = [
    "STANDARD_GRAVITY",
    "GraspChange",
    "GraspRecording",
    "GraspTruth",
    "HandImu",
    "RobotSensing",
    "gravity_error",
    "simulate_grasp",
]


@dataclass(frozen=True)
class RobotSensing:
    """What the robot reports about its end-effector, with white noise on every sample.

    Parameters
    ----------
    output : {"motion", "pose"}
        A MotionStream (angular velocity and acceleration, specific force, orientation) or a PoseStream.
    rate : float
        Hz.
    position_sd : float
        Pose: standard deviation of each coordinate (m).
    rotation_sd : float
        Standard deviation of the orientation about each body axis (rad); of both outputs.
    angular_velocity_sd, angular_acceleration_sd, acceleration_sd : float
        Motion: standard deviations per sample (rad/s, rad/s^2, m/s^2).
    """

    output: Literal["motion", "pose"] = "motion"
    rate: float = 1000.0
    position_sd: float = 0.0
    rotation_sd: float = 0.0
    angular_velocity_sd: float = 0.0
    angular_acceleration_sd: float = 0.0
    acceleration_sd: float = 0.0


@dataclass(frozen=True)
class HandImu:
    """The inertial sensor on the hand.

    Parameters
    ----------
    rate : float
        Hz.
    gyro_noise_density : float
        rad/s/sqrt(Hz). A sample's standard deviation is density times sqrt(rate).
    accelerometer_noise_density : float
        m/s^2/sqrt(Hz), likewise.
    gyro_bias_sd, accelerometer_bias_sd : float
        Standard deviation of the constant bias that is drawn for each axis (rad/s, m/s^2).
    stamp_jitter_sd : float
        The stamp differs from the instant of sampling by this standard deviation (s), at most 0.45 of a step.
    dropout_fraction : float
        Share of the samples that is lost, in [0, 1); their rows are missing.
    dropout_length : float
        Mean number of consecutive samples lost at a time, at least 1.
    """

    rate: float = 1000.0
    gyro_noise_density: float = 0.0
    accelerometer_noise_density: float = 0.0
    gyro_bias_sd: float = 0.0
    accelerometer_bias_sd: float = 0.0
    stamp_jitter_sd: float = 0.0
    dropout_fraction: float = 0.0
    dropout_length: float = 20.0


@dataclass(frozen=True, eq=False)
class GraspRecording:
    """A simulated recording of both sides with its truth.

    Attributes
    ----------
    robot : MotionStream or PoseStream
        What the robot reports, on the robot's clock.
    hand : ImuStream
        What the hand's sensor reports, on its own clock.
    truth : GraspTruth
        What should be found.
    name : str
        Of the scenario.
    gravity : ndarray, shape (3,)
        The gravity assumed on the robot's side (m/s^2, frame ``w``); the true one is ``gravity + truth.base_tilt``.
    trajectory : RigidTrajectory
        The robot's exact motion.
    robot_sensing, hand_imu : RobotSensing, HandImu
        The noise that was added.
    hand_sample_time : ndarray, shape (n,)
        When each hand sample was really taken (s, robot clock).
    """

    robot: MotionStream | PoseStream
    hand: ImuStream
    truth: GraspTruth
    name: str
    gravity: FloatArray
    trajectory: RigidTrajectory
    robot_sensing: RobotSensing
    hand_imu: HandImu
    hand_sample_time: FloatArray

    @cached_property
    def robot_truth(self) -> RigidMotion:
        """The robot's exact motion at its own stamps."""
        return self.trajectory.at(self.robot.t)

    @cached_property
    def hand_truth(self) -> RigidMotion:
        """The hand's exact motion at the instants of its samples; ``t`` is on the robot's clock."""
        return hand_motion(self.trajectory, self.truth, self.hand_sample_time)


def _require(ok: bool, field_name: str, expected: str, found: object) -> None:
    if not ok:
        raise InputError(field_name, expected, repr(found))


def _lost(rng: np.random.Generator, n: int, imu: HandImu) -> npt.NDArray[np.bool_]:
    """Which samples are lost: a two-state chain with the given share and mean length of losses."""
    lost = np.zeros(n, dtype=np.bool_)
    if imu.dropout_fraction == 0.0:
        return lost
    mean_kept = imu.dropout_length * (1.0 / imu.dropout_fraction - 1.0)
    k = int(rng.geometric(1.0 / mean_kept))
    while k < n:
        length = int(rng.geometric(1.0 / imu.dropout_length))
        lost[k : k + length] = True
        k += length + int(rng.geometric(1.0 / mean_kept))
    return lost


def _robot_stream(
    motion: RigidMotion, sensing: RobotSensing, gravity: FloatArray, rng: np.random.Generator
) -> MotionStream | PoseStream:
    n = motion.t.size
    q = motion.rotation_wxyz
    if sensing.rotation_sd > 0.0:
        q = quaternion_multiply_wxyz(
            q, quaternion_exp_wxyz(sensing.rotation_sd * rng.standard_normal((n, 3)))
        )
    if sensing.output == "pose":
        return PoseStream(
            motion.t, motion.position + sensing.position_sd * rng.standard_normal((n, 3)), q, name="robot"
        )
    noise = rng.standard_normal((3, n, 3))
    return MotionStream(
        motion.t,
        motion.angular_velocity + sensing.angular_velocity_sd * noise[0],
        motion.angular_acceleration + sensing.angular_acceleration_sd * noise[1],
        motion.specific_force(gravity) + sensing.acceleration_sd * noise[2],
        q,
        name="robot",
    )


def simulate_grasp(
    trajectory: RigidTrajectory,
    rotation: npt.ArrayLike,
    translation: npt.ArrayLike,
    *,
    duration: float = 60.0,
    robot: RobotSensing = RobotSensing(),
    hand: HandImu = HandImu(),
    time_offset: float = 0.0,
    base_tilt: npt.ArrayLike = (0.0, 0.0, 0.0),
    changes: tuple[GraspChange, ...] = (),
    gravity: npt.ArrayLike = STANDARD_GRAVITY,
    seed: int = 0,
    name: str = "grasp",
) -> GraspRecording:
    """Simulate a robot and a hand that holds what it moves.

    Parameters
    ----------
    trajectory : RigidTrajectory
        Motion of the end-effector ``r`` in the world ``w``.
    rotation : array_like, shape (3, 3)
        ``R_r_h``.
    translation : array_like, shape (3,)
        ``p_r_h`` (m).
    duration : float
        s; both sensors sample from 0 to (not including) ``duration`` of the robot's clock.
    robot, hand : RobotSensing, HandImu
        Rates and noise.
    time_offset : float
        Hand stamp minus robot stamp of the same instant (s).
    base_tilt : array_like, shape (3,)
        True minus assumed gravity (m/s^2, frame ``w``); see :func:`gravity_error`.
    changes : tuple of GraspChange
        Regrasps and slips, in order and not overlapping.
    gravity : array_like, shape (3,)
        Assumed gravity (m/s^2, frame ``w``).
    seed : int
        Every source of randomness has its own stream derived from it, so that one option changes no other draw.
    name : str
        Of the recording.

    Returns
    -------
    GraspRecording

    Raises
    ------
    InputError
        Naming the argument.
    """
    R, r = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    dg, g = np.asarray(base_tilt, dtype=np.float64), np.asarray(gravity, dtype=np.float64)
    _require(R.shape == (3, 3) and np.allclose(R @ R.T, np.eye(3), atol=1e-9), "rotation", "R_r_h, 3 x 3", R)
    for key, vector in (("translation", r), ("base_tilt", dg), ("gravity", g)):
        _require(
            vector.shape == (3,) and bool(np.isfinite(vector).all()), key, "three finite numbers", vector
        )
    for key, rate in (("robot.rate", robot.rate), ("hand.rate", hand.rate)):
        _require(rate > 0.0 and duration * rate >= 2.0, key, f"Hz, two samples in {duration!r} s", rate)
    _require(robot.output in ("motion", "pose"), "robot.output", "'motion' or 'pose'", robot.output)
    _require(0.0 <= hand.dropout_fraction < 1.0, "hand.dropout_fraction", "in [0, 1)", hand.dropout_fraction)
    shortest = max(1.0, hand.dropout_fraction / (1.0 - hand.dropout_fraction))
    _require(
        hand.dropout_length >= shortest,
        "hand.dropout_length",
        f"at least {shortest:.3g} samples, or the share that is lost cannot be reached",
        hand.dropout_length,
    )
    end = -np.inf
    for change in changes:
        _require(
            change.start >= end and change.duration >= 0.0, "changes", "in order, not overlapping", change
        )
        end = change.start + change.duration

    biases, gyro, accelerometer, robot_noise, stamps, losses = (
        np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(6)
    )
    truth = GraspTruth(
        R,
        r,
        hand.gyro_bias_sd * biases.standard_normal(3),
        hand.accelerometer_bias_sd * biases.standard_normal(3),
        float(time_offset),
        dg,
        tuple(changes),
    )
    motion = trajectory.at(np.arange(round(duration * robot.rate)) / robot.rate)

    t = np.arange(round(duration * hand.rate)) / hand.rate
    held = hand_motion(trajectory, truth, t)
    sd = np.sqrt(hand.rate)
    w_h = held.angular_velocity + truth.gyro_bias
    w_h += hand.gyro_noise_density * sd * gyro.standard_normal((t.size, 3))
    f_h = held.specific_force(g + dg) + truth.accelerometer_bias
    f_h += hand.accelerometer_noise_density * sd * accelerometer.standard_normal((t.size, 3))
    # Clipped below half a step, so that stamps stay in order.
    late = np.clip(hand.stamp_jitter_sd * stamps.standard_normal(t.size), -0.45 / hand.rate, 0.45 / hand.rate)
    keep = ~_lost(losses, t.size, hand)
    return GraspRecording(
        robot=_robot_stream(motion, robot, g, robot_noise),
        hand=ImuStream((t + late + time_offset)[keep], w_h[keep], f_h[keep], name="hand"),
        truth=truth,
        name=name,
        gravity=g,
        trajectory=trajectory,
        robot_sensing=robot,
        hand_imu=hand,
        hand_sample_time=t[keep],
    )

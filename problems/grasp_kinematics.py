"""The robot side of the grasp problem: body rate, acceleration and specific force of the end-effector on a uniform grid.

Whatever the robot offers (poses, an IMU, motion, joint positions) becomes ``w_r, al_r, f_r = R_w_r'(a_w -
g)`` in the end-effector frame, with the noise that its differentiation leaves in them as a function of
frequency.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgrasp import lie, signals
from factorgrasp.errors import InputError
from factorgrasp.problems.grasp_averaging import average, averaged_samples
from factorgrasp.problems.grasp_settings import GraspNoise
from factorgrasp.recordings import ImuStream, JointStream, MotionStream, PoseStream
from factorgrasp.typing import FloatArray

RobotStream = PoseStream | MotionStream | ImuStream | JointStream

# Order 4: the second derivative then keeps a flat passband (its error grows with f^4), at the price of some
# more noise.
DERIVATIVE_ORDER = 4
# Steps of a stream that is called uniform differ by less than this part of the median step.
_UNIFORM = 0.02


@dataclass(frozen=True)
class RobotNoise:
    """Two-sided power spectral densities of the robot signals' noise at given frequencies, per axis.

    Attributes
    ----------
    angular_velocity, angular_acceleration, specific_force : (K,) ndarray
        (rad/s)^2/Hz, (rad/s^2)^2/Hz, (m/s^2)^2/Hz.
    force_by_acceleration : (K,) ndarray
        ``c`` in ``E[df_r dal_r'] = c S(f_r)``: an error of the orientation shows in both.
    """

    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    specific_force: FloatArray
    force_by_acceleration: FloatArray


@dataclass(frozen=True)
class RobotKinematics:
    """Motion of the end-effector on a uniform grid; rows with NaN are gaps.

    Attributes
    ----------
    t : (n,) ndarray
        s, uniform.
    angular_velocity, angular_acceleration, specific_force : (n, 3) ndarray
        rad/s, rad/s^2, m/s^2, all in the end-effector frame ``r``.
    rotation : (n, 3, 3) ndarray or None
        ``R_w_r``, where the robot offers it.
    noise : callable
        Frequencies (K,) in Hz to :class:`RobotNoise`.
    bandwidth : float
        -3 dB bandwidth of the differentiation, Hz; infinite where nothing was differentiated.
    averaged : int
        Samples of the recording that each row is a mean of, over one grid step; 1 where none were averaged.
    """

    t: FloatArray
    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    specific_force: FloatArray
    rotation: FloatArray | None
    noise: Callable[[FloatArray], RobotNoise]
    bandwidth: float
    averaged: int = 1

    @property
    def step(self) -> float:
        """Grid step, s."""
        return float((self.t[-1] - self.t[0]) / (self.t.size - 1))


def robot_kinematics(
    robot: RobotStream,
    noise: GraspNoise,
    gravity: FloatArray,
    bandwidth: float,
    max_gap: float | None = None,
    robot_model: Any = None,
    frame: str | None = None,
) -> RobotKinematics:
    """Motion of the end-effector from whatever the robot offers.

    Parameters
    ----------
    robot : PoseStream, MotionStream, ImuStream or JointStream
    noise : GraspNoise
    gravity : (3,) ndarray
        In the robot's world frame, m/s^2.
    bandwidth : float
        Wanted -3 dB bandwidth of a differentiation, Hz; lowered to what the rate allows.
    max_gap : float, optional
        s; see :func:`gap_limit`.
    robot_model : pinocchio.Model, optional
        For a joint stream, with the name of the end-effector's `frame`.

    Raises
    ------
    InputError
        When a stream is too short for its differentiation, or a joint stream comes without a model.
    """
    limit = gap_limit(robot.t, max_gap)
    if isinstance(robot, PoseStream):
        return _from_poses(robot, noise, gravity, bandwidth, limit)
    if isinstance(robot, MotionStream):
        return _from_motion(robot, noise, limit)
    if isinstance(robot, ImuStream):
        return _from_imu(robot, noise, bandwidth, limit)
    return _from_joints(robot, noise, gravity, bandwidth, limit, robot_model, frame)


def gap_limit(t: FloatArray, max_gap: float | None) -> float:
    """Longest step (s) between two good samples that is not a gap.

    1.6 median steps for a stream with a steady clock, so that one missing sample is a gap already; 3 for one
    with jittered stamps.
    """
    if max_gap is not None:
        return max_gap
    steps = np.diff(t)[:: max(1, t.size // 5000)]
    middle = float(np.median(steps))
    steady = float(np.percentile(np.abs(steps - middle), 90)) < 0.2 * middle
    return (1.6 if steady else 3.0) * middle


def uniform_grid(t: FloatArray) -> tuple[FloatArray, bool]:
    """Uniform grid over stamps at their median step, and whether the stamps are that grid already."""
    steps = np.diff(t)
    middle = float(np.median(steps))
    if np.all(np.abs(steps - middle) < _UNIFORM * middle):
        step = (t[-1] - t[0]) / (t.size - 1)
        grid = t[0] + step * np.arange(t.size)
        if np.max(np.abs(grid - t)) < _UNIFORM * middle:
            return grid, True
    return t[0] + middle * np.arange(int((t[-1] - t[0]) / middle * (1 + 1e-12)) + 1), False


def on_grid(t: FloatArray, x: FloatArray, grid: FloatArray, same: bool, limit: float) -> FloatArray:
    """Signals (n, c) on the grid, gaps as NaN."""
    if same:
        return x
    return signals.resample_uniform(t, x, grid, max_gap=limit, kind="cubic")[1]


def differentiator(bandwidth: float, step: float, samples: int, field: str) -> tuple[int, float]:
    """Savitzky-Golay window for a second derivative of about this bandwidth, and the bandwidth that it really has (Hz)."""
    window = signals.choose_savgol(min(bandwidth, 0.35 / step), step, DERIVATIVE_ORDER, deriv=2)
    window = max(window, DERIVATIVE_ORDER + 3)
    if samples < 2 * window:
        raise InputError(field, f"at least {2 * window} samples to differentiate", f"{samples}")
    return window, signals.savgol_bandwidth(window, DERIVATIVE_ORDER, step, deriv=2)


def _from_poses(
    robot: PoseStream, noise: GraspNoise, gravity: FloatArray, bandwidth: float, limit: float
) -> RobotKinematics:
    grid, same = uniform_grid(robot.t)
    quaternion = (
        np.array(robot.rotation_wxyz)
        if same
        else signals.resample_rotations(robot.t, robot.rotation_wxyz, grid, max_gap=limit, kind="cubic")[1]
    )
    position = on_grid(robot.t, robot.position, grid, same, limit)
    missing = ~(np.isfinite(position).all(axis=1) & np.isfinite(quaternion).all(axis=1))
    if missing.any():
        position, quaternion = position.copy(), quaternion.copy()
        position[missing], quaternion[missing] = np.nan, np.nan
    position_sd, rotation_sd = noise.robot_position_sd, noise.robot_rotation_sd
    if position_sd is None:
        position_sd = signals.white_noise_sd(position)
    if rotation_sd is None:
        rotation_sd = signals.rotation_noise_sd(quaternion)
    return _from_uniform_poses(
        grid, position, quaternion, gravity, bandwidth, float(position_sd), float(rotation_sd), robot.name
    )


def _from_uniform_poses(
    grid: FloatArray,
    position: FloatArray,
    quaternion: FloatArray,
    gravity: FloatArray,
    bandwidth: float,
    position_sd: float,
    rotation_sd: float,
    name: str,
) -> RobotKinematics:
    step = float((grid[-1] - grid[0]) / (grid.size - 1))
    # Poses of a fast stream are averaged first (in step with the hand's samples, later): differentiating all of
    # them would cost several times as much for nothing.
    averaged = averaged_samples(step, 0.5 * bandwidth)
    if averaged > 1 and grid.size > 20 * averaged:
        grid, position = average(grid[:, None], averaged)[:, 0], average(position, averaged)
        # Between neighbours the mean of quaternions is the mean of rotations up to third order of the turn.
        quaternion = average(quaternion, averaged)
        quaternion /= np.sqrt(np.einsum("ij,ij->i", quaternion, quaternion))[:, None]
        position_sd, rotation_sd = position_sd / np.sqrt(averaged), rotation_sd / np.sqrt(averaged)
        step *= averaged
    else:
        averaged = 1
    window, reached = differentiator(bandwidth, step, grid.size, f"{name} stream")
    motion = signals.differentiate_rotations(quaternion, step, window, DERIVATIVE_ORDER)
    acceleration = signals.savgol_derivatives(position, step, window, DERIVATIVE_ORDER, 2)
    rotation = lie.quaternion_wxyz_to_matrix(motion.rotation)
    force = to_body(rotation, acceleration - gravity)

    def densities(f: FloatArray) -> RobotNoise:
        gain = [signals.savgol_frequency_response(window, DERIVATIVE_ORDER, d, step, f) for d in (0, 1, 2)]
        position_psd, rotation_psd = position_sd**2 * step, rotation_sd**2 * step
        pull = float(np.nanmean(np.sum(force**2, axis=1)))
        return RobotNoise(
            angular_velocity=np.abs(gain[1]) ** 2 * rotation_psd,
            angular_acceleration=np.abs(gain[2]) ** 2 * rotation_psd,
            specific_force=np.abs(gain[2]) ** 2 * position_psd
            + np.abs(gain[0]) ** 2 * rotation_psd * pull / 1.5,
            force_by_acceleration=np.real(gain[0] * np.conj(gain[2])) * rotation_psd,
        )

    return RobotKinematics(
        grid,
        motion.angular_velocity,
        motion.angular_acceleration,
        force,
        rotation,
        densities,
        reached,
        averaged,
    )


def to_body(rotation: FloatArray, vectors: FloatArray) -> FloatArray:
    """``R' v`` for every row, (n, 3)."""
    return np.asarray(np.matmul(vectors[:, None, :], rotation)[:, 0, :])


def _white(
    angular_velocity: float, angular_acceleration: float, specific_force: float
) -> Callable[[FloatArray], RobotNoise]:
    def densities(f: FloatArray) -> RobotNoise:
        one = np.ones_like(f)
        return RobotNoise(
            angular_velocity**2 * one, angular_acceleration**2 * one, specific_force**2 * one, 0.0 * one
        )

    return densities


def _from_motion(robot: MotionStream, noise: GraspNoise, limit: float) -> RobotKinematics:
    grid, same = uniform_grid(robot.t)
    parts = [robot.angular_velocity, robot.angular_acceleration, robot.specific_force]
    rate, acceleration, force = (on_grid(robot.t, part, grid, same, limit) for part in parts)
    rotation = None
    if robot.rotation_wxyz is not None:
        quaternion = (
            robot.rotation_wxyz
            if same
            else signals.resample_rotations(robot.t, robot.rotation_wxyz, grid, max_gap=limit, kind="cubic")[
                1
            ]
        )
        rotation = lie.quaternion_wxyz_to_matrix(quaternion)
    declared = (
        noise.robot_angular_velocity_density,
        noise.robot_angular_acceleration_density,
        noise.robot_acceleration_density,
    )
    root = np.sqrt((grid[-1] - grid[0]) / (grid.size - 1))
    densities = _white(
        *(
            signals.white_noise_sd(signal) * root if density is None else density
            for density, signal in zip(declared, (rate, acceleration, force), strict=True)
        )
    )
    return RobotKinematics(grid, rate, acceleration, force, rotation, densities, np.inf)


def _from_imu(robot: ImuStream, noise: GraspNoise, bandwidth: float, limit: float) -> RobotKinematics:
    grid, same = uniform_grid(robot.t)
    step = float((grid[-1] - grid[0]) / (grid.size - 1))
    rate = on_grid(robot.t, robot.angular_velocity, grid, same, limit)
    force = on_grid(robot.t, robot.specific_force, grid, same, limit)
    window, reached = differentiator(bandwidth, step, grid.size, f"{robot.name} stream")
    smooth = signals.savgol_derivatives(rate, step, window, DERIVATIVE_ORDER, 0)
    acceleration = signals.savgol_derivatives(rate, step, window, DERIVATIVE_ORDER, 1)
    own = noise.robot_angular_velocity_density, noise.robot_acceleration_density
    rate_psd = (noise.gyro_density if own[0] is None else own[0]) ** 2
    force_psd = (noise.accelerometer_density if own[1] is None else own[1]) ** 2

    def densities(f: FloatArray) -> RobotNoise:
        gain = [
            np.abs(signals.savgol_frequency_response(window, DERIVATIVE_ORDER, d, step, f)) for d in (0, 1)
        ]
        return RobotNoise(gain[0] ** 2 * rate_psd, gain[1] ** 2 * rate_psd, force_psd + 0.0 * f, 0.0 * f)

    return RobotKinematics(grid, smooth, acceleration, force, None, densities, reached)


def _from_joints(
    robot: JointStream,
    noise: GraspNoise,
    gravity: FloatArray,
    bandwidth: float,
    limit: float,
    robot_model: Any,
    frame: str | None,
) -> RobotKinematics:
    from factorgrasp.models.robot import end_effector_poses, frame_error_sd

    if robot_model is None or frame is None:
        raise InputError(
            "robot",
            "a robot model (urdf) and the name of the end-effector's frame with joint positions",
            "none",
        )
    grid, same = uniform_grid(robot.t)
    q = on_grid(robot.t, robot.q, grid, same, limit)
    position, quaternion = end_effector_poses(robot_model, frame, q, robot.names)
    position_sd, rotation_sd = frame_error_sd(robot_model, frame, q, robot.names, noise.robot_joint_sd)
    return _from_uniform_poses(
        grid, position, quaternion, gravity, bandwidth, position_sd, rotation_sd, robot.name
    )

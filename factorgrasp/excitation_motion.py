"""A motion whose excitation is to be measured, from whatever says it: joints with a URDF, poses, or body motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from factorgrasp import lie, signals
from factorgrasp.errors import InputError
from factorgrasp.models.wrist import WristStiffness
from factorgrasp.problems.grasp_kinematics import (
    DERIVATIVE_ORDER,
    RobotKinematics,
    RobotNoise,
    differentiator,
    gap_limit,
    on_grid,
    robot_kinematics,
    uniform_grid,
)
from factorgrasp.problems.grasp_settings import GraspNoise, GraspSettings
from factorgrasp.recordings import ImuStream, JointStream, MotionStream, PoseStream
from factorgrasp.typing import FloatArray, JsonDict

# Hz; arms are moved below this, and noise of encoders and stamps above it would swamp the inertial torques.
_TORQUE_BANDWIDTH = 10.0

TrajectoryStream = PoseStream | MotionStream | JointStream


@dataclass(frozen=True, eq=False)
class JointMotion:
    """The joints of a trajectory on its grid, with the torques that the model predicts.

    Attributes
    ----------
    t : (n,) ndarray
        s.
    names : tuple of str
    q, qd, qdd : (n, k) ndarray
        rad, rad/s, rad/s^2.
    torque : (n, k) ndarray
        Of the rigid-body model (inverse dynamics), Nm.
    measured_torque : (n, k) ndarray or None
        Nm, where the file has them.
    position_limits : (k, 2) ndarray
        Lowest and highest position, rad.
    velocity_limits, torque_limits : (k,) ndarray
        rad/s and Nm; infinite where the URDF states none.
    """

    t: FloatArray
    names: tuple[str, ...]
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    torque: FloatArray
    measured_torque: FloatArray | None
    position_limits: FloatArray
    velocity_limits: FloatArray
    torque_limits: FloatArray

    @cached_property
    def correlation(self) -> FloatArray | None:
        """Correlation of predicted and measured torque of every joint, (k,); None without measured ones."""
        if self.measured_torque is None:
            return None
        good = np.isfinite(np.hstack([self.torque, self.measured_torque])).all(axis=1)
        pairs = zip(self.torque[good].T, self.measured_torque[good].T, strict=True)
        # A joint that holds still under a constant torque has none.
        return np.array(
            [np.corrcoef(a, b)[0, 1] if np.ptp(a) * np.ptp(b) > 0.0 else np.nan for a, b in pairs]
        )

    def margins(self) -> JsonDict:
        """Distance to every limit by joint: positive inside, negative where it is violated; peaks of what has no limit in a URDF."""
        out: JsonDict = {}
        low, high = self.position_limits.T
        for k, name in enumerate(self.names):
            q = self.q[:, k]
            position = min(float(np.nanmin(q)) - float(low[k]), float(high[k]) - float(np.nanmax(q)))
            speed, torque = _peak(self.qd[:, k]), _peak(self.torque[:, k])
            out[name] = {
                "position": position,
                "velocity": float(self.velocity_limits[k]) - speed,
                "torque": float(self.torque_limits[k]) - torque,
                "peak_velocity": speed,
                "peak_acceleration": _peak(self.qdd[:, k]),
                "peak_torque": torque,
            }
        return out


@dataclass(frozen=True, eq=False)
class ExcitationMotion:
    """A trajectory of the end-effector, ready to be measured.

    Attributes
    ----------
    kinematics : RobotKinematics
        Body rates, accelerations and specific force on a uniform grid, with the noise that the robot will report them with.
    contained : callable
        Densities of the noise that the trajectory itself contains; see :func:`factorgrasp.excitation_prediction.predict_grasp`.
    position : (n, 3) ndarray or None
        ``p_w_r`` on the same grid, m.
    joints : JointMotion or None
    """

    kinematics: RobotKinematics
    contained: Callable[[FloatArray], RobotNoise]
    position: FloatArray | None = None
    joints: JointMotion | None = None

    @property
    def t(self) -> FloatArray:
        """Time of the grid, s."""
        return self.kinematics.t

    @cached_property
    def noise_variances(self) -> tuple[float, float]:
        """Variances per axis of the noise contained in angular velocity and acceleration, (rad/s)^2 and (rad/s^2)^2 a sample."""
        edge = 0.5 / self.kinematics.step
        f = np.linspace(0.0, edge, 2001)
        noise = self.contained(f)
        rate, change = (
            2.0 * float(np.trapezoid(p, f)) for p in (noise.angular_velocity, noise.angular_acceleration)
        )
        return rate, change

    def wrist_wrench(
        self, translation: FloatArray, wrist: WristStiffness, reference: str = "start"
    ) -> FloatArray | None:
        """Wrench (n, 6) of a wrist at ``p_r_h = translation`` that would rather stay: N and Nm, world axes; None without poses.

        Parameters
        ----------
        translation : (3,) ndarray
            m, end-effector frame.
        wrist : WristStiffness
        reference : {"start", "mean"}
            Where it wants to stay: at its first pose, or at its mean pose (the least that a wrist can feel on this motion).
        """
        R = self.kinematics.rotation
        if R is None or self.position is None:
            return None
        at = self.position + R @ np.asarray(translation, dtype=float)
        good = np.flatnonzero(np.isfinite(at).all(axis=1) & np.isfinite(R).all(axis=(1, 2)))
        if not good.size:
            return None
        if reference == "start":
            place, turn = at[good[0]], R[good[0]]
        else:
            place, turn = at[good].mean(axis=0), lie.project_to_so3(R[good].mean(axis=0))
        out = np.full((self.t.size, 6), np.nan)
        out[good] = wrist.wrench(at[good], R[good], place, turn)
        return out


def read_motion_of(
    stream: TrajectoryStream,
    noise: GraspNoise,
    settings: GraspSettings,
    gravity: FloatArray,
    robot_model: Any = None,
    frame: str | None = None,
    measured_torque: FloatArray | None = None,
) -> ExcitationMotion:
    """Bring a trajectory onto a grid with its derivatives and its noise.

    Parameters
    ----------
    stream : PoseStream, MotionStream or JointStream
    noise : GraspNoise
        With which the robot will report the motion; what is None is estimated from the stream's own high frequencies.
    settings : GraspSettings
        Bandwidths.
    gravity : (3,) ndarray
        World frame, m/s^2.
    robot_model : pinocchio.Model, optional
        With `frame`, for a joint stream.
    frame : str, optional
    measured_torque : (n, k) ndarray, optional
        Torques (Nm) that a joint stream was recorded with.

    Raises
    ------
    InputError
    """
    if isinstance(stream, ImuStream):
        raise InputError(
            "trajectory",
            "poses, joints with a URDF, or body motion with angular acceleration",
            "an IMU, which does not say how it turned",
        )
    bandwidth = settings.kinematics_bandwidth or 2.0 * (settings.bandwidth or min(20.0, 0.2 * stream.rate))
    reading = (gravity, bandwidth, settings.max_gap, robot_model, frame)
    kinematics = robot_kinematics(stream, noise, *reading)
    # The noise in the file is its own, whatever the robot will add next time.
    own = replace(noise, robot_position_sd=None, robot_rotation_sd=None, robot_angular_velocity_density=None,
                  robot_angular_acceleration_density=None, robot_acceleration_density=None)  # fmt: skip
    if isinstance(stream, JointStream):
        q = on_grid(stream.t, stream.q, *uniform_grid(stream.t), gap_limit(stream.t, settings.max_gap))
        own = replace(own, robot_joint_sd=float(signals.white_noise_sd(q)))
    contained = kinematics.noise if own == noise else robot_kinematics(stream, own, *reading).noise
    position, joints = None, None
    if isinstance(stream, PoseStream):
        position = _onto(kinematics.t, stream.t, stream.position)
    elif isinstance(stream, JointStream):
        joints = _joint_motion(stream, robot_model, bandwidth, settings.max_gap, measured_torque)
        position = _joint_positions(stream, robot_model, frame, kinematics.t)
    return ExcitationMotion(kinematics, contained, position, joints)


def _onto(grid: FloatArray, t: FloatArray, values: FloatArray) -> FloatArray:
    return np.stack([np.interp(grid, t, column) for column in values.T], axis=1)


def _joint_positions(stream: JointStream, model: Any, frame: str | None, grid: FloatArray) -> FloatArray:
    from factorgrasp.models.robot import end_effector_poses

    assert frame is not None
    return end_effector_poses(model, frame, _onto(grid, stream.t, stream.q), stream.names)[0]


def _joint_motion(
    stream: JointStream,
    model: Any,
    bandwidth: float,
    max_gap: float | None,
    measured_torque: FloatArray | None,
) -> JointMotion:
    import pinocchio

    from factorgrasp.models.robot import joint_columns

    grid, same = uniform_grid(stream.t)
    limit, step = gap_limit(stream.t, max_gap), float((grid[-1] - grid[0]) / (grid.size - 1))
    q = on_grid(stream.t, stream.q, grid, same, limit)
    window, _ = differentiator(min(bandwidth, _TORQUE_BANDWIDTH), step, grid.size, f"{stream.name} stream")
    smooth, qd, qdd = (
        signals.savgol_derivatives(q, step, window, DERIVATIVE_ORDER, order) for order in (0, 1, 2)
    )
    if stream.qd is not None:
        qd = on_grid(stream.t, stream.qd, grid, same, limit)
    if stream.qdd is not None:
        qdd = on_grid(stream.t, stream.qdd, grid, same, limit)
    where = joint_columns(model, stream.names, q.shape[1])
    moving = np.array([model.joints[i].idx_v for i in _joints_of(model, where)])
    full = np.tile(pinocchio.neutral(model), (grid.size, 1))
    full[:, where] = q
    rate, change = np.zeros((grid.size, model.nv)), np.zeros((grid.size, model.nv))
    rate[:, moving], change[:, moving] = qd, qdd
    data, torque = model.createData(), np.full(q.shape, np.nan)
    for k in np.flatnonzero(np.isfinite(np.hstack([q, qd, qdd])).all(axis=1)):
        torque[k] = pinocchio.rnea(model, data, full[k], rate[k], change[k])[moving]
    measured = None if measured_torque is None else on_grid(stream.t, measured_torque, grid, same, limit)
    speed, effort = (np.array(x)[moving] for x in (model.velocityLimit, model.effortLimit))
    return JointMotion(
        grid,
        tuple(model.names[i] for i in _joints_of(model, where)),
        np.where(np.isfinite(q), q, smooth),
        qd,
        qdd,
        torque,
        measured,
        np.stack([np.array(x)[where] for x in (model.lowerPositionLimit, model.upperPositionLimit)], axis=1),
        np.where(speed > 0.0, speed, np.inf),
        np.where(effort > 0.0, effort, np.inf),
    )


def _joints_of(model: Any, where: Any) -> list[int]:
    """Index of the joint of every configuration column."""
    first = {int(model.joints[i].idx_q): i for i in range(1, model.njoints)}
    return [first[int(column)] for column in where]


def _peak(values: FloatArray) -> float:
    return float(np.nanmax(np.abs(values), initial=0.0))

"""The grasp and its truth: where the hand holds, how that changes, and the exact motion that the hand makes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from factorgrasp.lie import matrix_to_quaternion_wxyz, quaternion_multiply_wxyz, so3_exp, so3_log
from factorgrasp.simulation.trajectory import RigidMotion, RigidTrajectory, cross
from factorgrasp.typing import FloatArray

STANDARD_GRAVITY: tuple[float, float, float] = (0.0, 0.0, -9.80665)


@dataclass(frozen=True, eq=False)
class GraspChange:
    """The hand moves to another grasp: at once (a regrasp) or slowly (a slip).

    Parameters
    ----------
    start : float
        When it begins (s, robot clock).
    duration : float
        How long it takes (s). With 0 the grasp jumps and the hand's sensor feels nothing of it; otherwise the way is a
        quintic blend (no velocity or acceleration at its ends), which the sensor does feel.
    rotation : array_like, shape (3, 3)
        ``R_r_h`` afterwards.
    translation : array_like, shape (3,)
        ``p_r_h`` afterwards (m).
    """

    start: float
    duration: float
    rotation: npt.ArrayLike
    translation: npt.ArrayLike


@dataclass(frozen=True, eq=False)
class GraspTruth:
    """What an estimator of the grasp should find.

    Attributes
    ----------
    rotation : ndarray, shape (3, 3)
        ``R_r_h`` (at the start, when there are changes).
    translation : ndarray, shape (3,)
        ``p_r_h`` (m), as above.
    gyro_bias : ndarray, shape (3,)
        Added to the hand's angular velocity (rad/s), frame ``h``.
    accelerometer_bias : ndarray, shape (3,)
        Added to the hand's specific force (m/s^2), frame ``h``.
    time_offset : float
        Hand stamp minus robot stamp of the same instant (s): a hand sample stamped ``t`` shows the robot's ``t - time_offset``.
    base_tilt : ndarray, shape (3,)
        True gravity minus the gravity assumed on the robot's side, frame ``w`` (m/s^2); see :func:`gravity_error`.
    changes : tuple of GraspChange
        Regrasps and slips in order of time.
    """

    rotation: FloatArray
    translation: FloatArray
    gyro_bias: FloatArray
    accelerometer_bias: FloatArray
    time_offset: float
    base_tilt: FloatArray
    changes: tuple[GraspChange, ...] = ()

    @property
    def rotation_wxyz(self) -> FloatArray:
        """``R_r_h`` as a quaternion [w, x, y, z]."""
        return matrix_to_quaternion_wxyz(self.rotation)

    def grasp_at(self, t: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """``R_r_h`` (n, 3, 3) and ``p_r_h`` (n, 3) at times ``t`` (n,) of the robot's clock."""
        motion = _grasp_motion(self, np.asarray(t, dtype=np.float64))
        return motion.rotation, motion.position


def gravity_error(tilt: npt.ArrayLike, gravity: npt.ArrayLike = STANDARD_GRAVITY) -> FloatArray:
    """``base_tilt`` (m/s^2) of a robot base tilted by the rotation vector ``tilt`` (3,) in rad: ``exp(tilt) g - g``."""
    g = np.asarray(gravity, dtype=np.float64)
    out: FloatArray = so3_exp(tilt) @ g - g
    return out


@dataclass(frozen=True, eq=False)
class _GraspMotion:
    """The grasp over time: ``R_r_h``, ``p_r_h`` and their derivatives (rates in frames ``h`` and ``r``)."""

    rotation: FloatArray
    position: FloatArray
    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


def _grasp_motion(truth: GraspTruth, t: FloatArray) -> _GraspMotion:
    n = t.size
    R, p = (
        np.broadcast_to(truth.rotation, (n, 3, 3)).copy(),
        np.broadcast_to(truth.translation, (n, 3)).copy(),
    )
    w, al, v, a = (np.zeros((n, 3)) for _ in range(4))
    R_before, p_before = truth.rotation, truth.translation
    for change in truth.changes:
        R_after, p_after = np.asarray(change.rotation), np.asarray(change.translation)
        turn, way = so3_log(R_before.T @ R_after), p_after - p_before
        now = (t >= change.start) & (t < change.start + change.duration)
        if now.any():
            T = change.duration
            x = (t[now] - change.start) / T
            s = (x**3 * (10.0 - 15.0 * x + 6.0 * x * x))[:, None]
            ds = (30.0 * x * x * (1.0 - x) ** 2 / T)[:, None]
            dds = (60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / T**2)[:, None]
            R[now], p[now] = R_before @ so3_exp(s * turn), p_before + s * way
            w[now], al[now], v[now], a[now] = ds * turn, dds * turn, ds * way, dds * way
        later = t >= change.start + change.duration
        R[later], p[later] = R_after, p_after
        R_before, p_before = R_after, p_after
    return _GraspMotion(R, p, w, al, v, a)


def hand_motion(trajectory: RigidTrajectory, truth: GraspTruth, t: FloatArray) -> RigidMotion:
    """Exact motion of the hand ``h`` at times ``t`` (n,) of the robot's clock, by rigid-body kinematics on a moving frame."""
    robot, grasp = trajectory.at(t), _grasp_motion(truth, t)
    R, p = grasp.rotation, grasp.position
    w, al = robot.angular_velocity, robot.angular_acceleration
    acceleration = robot.acceleration + cross(al, p) + cross(w, cross(w, p))
    acceleration += 2.0 * cross(w, grasp.velocity) + grasp.acceleration
    carried = np.einsum("nji,nj->ni", R, w)
    return RigidMotion(
        t,
        robot.position + np.einsum("nij,nj->ni", robot.rotation, p),
        quaternion_multiply_wxyz(robot.rotation_wxyz, matrix_to_quaternion_wxyz(R)),
        carried + grasp.angular_velocity,
        np.einsum("nji,nj->ni", R, al) + cross(carried, grasp.angular_velocity) + grasp.angular_acceleration,
        np.einsum("nji,nj->ni", R, acceleration),
    )

"""Cramer-Rao bound of the grasp problem, worked out in the time domain from the true signals; it shares no code with the estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp import lie
from factorgrasp.simulation.grasp import GraspRecording
from factorgrasp.typing import FloatArray

_SLOPE_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class Bound:
    """What no unbiased estimator can beat, and one that meets it.

    Attributes
    ----------
    covariance : ndarray, shape (13, 13)
        Inverse Fisher information; rotation (right perturbation of ``R_r_h``), lever arm, gyroscope and accelerometer bias, time offset.
    error : ndarray, shape (13,) or None
        Of the efficient estimator, one Newton step from the truth, on this recording's noise; only for a robot without noise.
    """

    covariance: FloatArray
    error: FloatArray | None


def cramer_rao(recording: GraspRecording) -> Bound:
    """Bound for one recording whose robot side is a motion stream; noise densities count as known.

    With ``R_r_h Exp(d)`` the hand's exact readings change by ``[w_h]x d + db_g - dw_h/dt dtau`` and by
    ``[f_h]x d + R' phi dr + db_a - df_h/dt dtau``, at every sample. Noise of the robot's signals is white as simulated and adds to that
    of the residual: ``n_f + S(n_al) r`` to the specific force. (That of the rate in ``S(w)^2 r`` is some 1 % of it and left out.)
    """
    t, R, r = recording.hand_sample_time, recording.truth.rotation, recording.truth.translation
    robot, imu, sensing = recording.trajectory.at(t), recording.hand_imu, recording.robot_sensing
    if sensing.output != "motion":
        raise ValueError("the bound knows robots that report motion only")
    exact, before, after = (_readings(recording, t + shift) for shift in (0.0, -_SLOPE_STEP, _SLOPE_STEP))
    spin = lie.skew(robot.angular_velocity)
    J = np.zeros((t.size, 6, 13))
    J[:, :3, :3], J[:, 3:, :3] = lie.skew(exact[:, :3]), lie.skew(exact[:, 3:])
    J[:, 3:, 3:6] = np.matmul(R.T, lie.skew(robot.angular_acceleration) + spin @ spin)
    J[:, :3, 6:9] = J[:, 3:, 9:12] = np.eye(3)
    J[:, :, 12] = (before - after) / (2.0 * _SLOPE_STEP)

    arm = R.T @ lie.skew(r)
    noise = np.zeros((6, 6))
    noise[:3, :3] = (
        imu.gyro_noise_density**2 * imu.rate + _at_rate(sensing.angular_velocity_sd, recording)
    ) * np.eye(3)
    noise[3:, 3:] = (
        imu.accelerometer_noise_density**2 * imu.rate + _at_rate(sensing.acceleration_sd, recording)
    ) * np.eye(3)
    noise[3:, 3:] += _at_rate(sensing.angular_acceleration_sd, recording) * arm @ arm.T
    whiten = np.linalg.inv(np.linalg.cholesky(noise))
    J = np.matmul(whiten, J)
    covariance = np.linalg.inv(np.einsum("nij,nik->jk", J, J, optimize=True))
    if max(sensing.angular_velocity_sd, sensing.acceleration_sd, sensing.angular_acceleration_sd) > 0.0:
        return Bound(covariance, None)
    bias = np.concatenate([recording.truth.gyro_bias, recording.truth.accelerometer_bias])
    left = np.hstack([recording.hand.angular_velocity, recording.hand.specific_force]) - exact - bias
    return Bound(covariance, covariance @ np.einsum("nij,ni->j", J, left @ whiten.T, optimize=True))


def _at_rate(sd: float, recording: GraspRecording) -> float:
    """Variance a sample of the hand's rate that holds as much noise as the robot's sd at its own rate."""
    return sd**2 * recording.hand_imu.rate / recording.robot_sensing.rate


def _readings(recording: GraspRecording, t: FloatArray) -> FloatArray:
    """Exact gyroscope and accelerometer (n, 6) of the hand at times of the robot's clock, from the robot's exact motion."""
    robot, R, r = recording.trajectory.at(t), recording.truth.rotation, recording.truth.translation
    w, al = robot.angular_velocity, robot.angular_acceleration
    swing = np.cross(al, r) + np.cross(w, np.cross(w, r))
    return np.hstack([w @ R, (robot.specific_force(recording.gravity) + swing) @ R])

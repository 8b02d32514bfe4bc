"""Root-mean-square errors over the Cramer-Rao bound, on data for which the model holds: a robot without noise.

The bound is worked out in the time domain from the true signals at every sample of the hand's sensor: Fisher information of the rotation,
the lever arm, both biases and the time offset, for white noise of the simulated size. It shares no code with the estimator. Beside
the bound stands the efficient estimator, one Newton step from the truth with that information: it meets the bound, sees the same noise, and
so leaves a ratio free of most of the Monte-Carlo scatter.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from grasp_monte_carlo import pose_error, time_offset
from metrics import Metric

from factorgrasp import lie, solve
from factorgrasp.problems import GraspPose
from factorgrasp.simulation.cehajic2015 import cehajic2015
from factorgrasp.simulation.grasp import GraspRecording, RobotSensing
from factorgrasp.tables import Column, Table
from factorgrasp.typing import FloatArray

UNKNOWNS = ("rotation", "lever arm", "gyroscope bias", "accelerometer bias", "time offset")
_SLOPE_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class Bound:
    """Cramer-Rao bound and efficient estimate of one recording.

    Attributes
    ----------
    covariance : ndarray, shape (13, 13)
        Inverse Fisher information; rotation (right perturbation of ``R_r_h``), lever arm, biases, time offset.
    error : ndarray, shape (13,)
        Of the efficient estimator on this recording's noise.
    """

    covariance: FloatArray
    error: FloatArray


def cramer_rao(recording: GraspRecording) -> Bound:
    """Bound and efficient estimate from the recording's truth and noise.

    With ``R = R_r_h Exp(d)`` the exact readings change by ``[w_h]x d + db_g - dw_h/dt dtau`` and ``[f_h]x d + R' phi dr + db_a - df_h/dt dtau``.
    """
    t, R = recording.hand_sample_time, recording.truth.rotation
    robot = recording.trajectory.at(t)
    exact, before, after = (_reading(recording, t + shift) for shift in (0.0, -_SLOPE_STEP, _SLOPE_STEP))
    slope = (after - before) / (2.0 * _SLOPE_STEP)
    w = lie.skew(robot.angular_velocity)
    phi = lie.skew(robot.angular_acceleration) + w @ w
    J = np.zeros((t.size, 6, 13))
    J[:, :3, :3], J[:, 3:, :3] = lie.skew(exact[:, :3]), lie.skew(exact[:, 3:])
    J[:, 3:, 3:6] = np.matmul(R.T, phi)
    J[:, :3, 6:9], J[:, 3:, 9:12] = np.eye(3), np.eye(3)
    J[:, :, 12] = -slope
    imu = recording.hand_imu
    sd = np.sqrt(imu.rate) * np.repeat([imu.gyro_noise_density, imu.accelerometer_noise_density], 3)
    bias = np.concatenate([recording.truth.gyro_bias, recording.truth.accelerometer_bias])
    noise = np.hstack([recording.hand.angular_velocity, recording.hand.specific_force]) - exact - bias
    J /= sd[:, None]
    covariance = np.linalg.inv(np.einsum("nij,nik->jk", J, J, optimize=True))
    return Bound(covariance, covariance @ np.einsum("nij,ni->j", J, noise / sd, optimize=True))


def _reading(recording: GraspRecording, t: FloatArray) -> FloatArray:
    """Exact gyroscope and accelerometer (n, 6) of the hand at times of the robot's clock, from the robot's exact motion."""
    robot, R, r = recording.trajectory.at(t), recording.truth.rotation, recording.truth.translation
    w, al = robot.angular_velocity, robot.angular_acceleration
    swing = np.cross(al, r) + np.cross(w, np.cross(w, r))
    return np.hstack([w @ R, (robot.specific_force(recording.gravity) + swing) @ R])


def run(seed: int) -> tuple[FloatArray, Bound]:
    """Error (7,) of GraspPose (rotation, lever arm, time offset) and the bound, for one seed."""
    offset = time_offset(seed)
    recording = cehajic2015(seed, robot=RobotSensing(), time_offset=offset)
    found = solve(GraspPose(recording.robot, recording.hand))
    error = pose_error(recording, found.rotation, found.translation)
    return np.append(error, found.time_offset - offset), cramer_rao(recording)


def measure(seeds: Iterable[int], workers: int) -> tuple[Table, list[Metric]]:
    """RMSE over bound for the rotation, the lever arm and the time offset."""
    with ProcessPoolExecutor(workers) as pool:
        results = list(pool.map(run, seeds, chunksize=2))
    errors = np.array([error for error, _ in results])
    efficient = np.array([bound.error for _, bound in results])
    variances = np.array([np.diag(bound.covariance) for _, bound in results])
    rows, metrics = [], []
    for name, ours, columns, unit, scale in (
        ("rotation", slice(0, 3), slice(0, 3), "deg", 180.0 / np.pi),
        ("lever arm", slice(3, 6), slice(3, 6), "mm", 1e3),
        ("time offset", slice(6, 7), slice(12, 13), "us", 1e6),
    ):
        rmse, best = _rms(errors[:, ours]), _rms(efficient[:, columns])
        bound = float(np.sqrt(variances[:, columns].sum(axis=1).mean()))
        # Scatter of a ratio of root mean squares from this many seeds, by resampling them.
        sd = _bootstrap(errors[:, ours], bound)
        rows.append({
            "unknown": f"{name} [{unit}]",
            "rmse": scale * rmse,
            "bound": scale * bound,
            "ratio": rmse / bound,
            "sd": sd,
            "efficient": scale * best,
            "paired": rmse / best,
        })  # fmt: skip
        if name != "time offset":
            metrics.append(
                Metric(f"RMSE / Cramer-Rao bound, {name}", rmse / bound, "", "lower", 1.05, f"sampling sd {sd:.3f}, {len(results)} seeds")
            )
            metrics.append(
                Metric(f"RMSE / efficient estimator on the same noise, {name}", rmse / best, "", "lower", 1.05, f"{len(results)} seeds")
            )
    samples = np.random.default_rng(0).multivariate_normal(np.zeros(13), results[0][1].covariance, 20000)
    median = np.rad2deg(np.median(np.linalg.norm(samples[:, :3], axis=1)))
    metrics.append(Metric("median rotation error of an estimator at the bound", median, "deg", note="no estimator can do better on this motion"))
    return Table(COLUMNS, tuple(rows), "Against the Cramer-Rao bound, robot without noise"), metrics


def _rms(x: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(x**2, axis=1))))


def _bootstrap(x: FloatArray, bound: float) -> float:
    rng = np.random.default_rng(0)
    return float(np.std([_rms(x[rng.integers(0, len(x), len(x))]) / bound for _ in range(400)]))


COLUMNS = (
    Column("unknown"),
    Column("rmse", "RMSE"),
    Column("bound", "bound"),
    Column("ratio", "RMSE / bound", "", ".3f"),
    Column("sd", "sampling sd", "", ".3f"),
    Column("efficient", "RMSE, efficient estimator"),
    Column("paired", "RMSE / efficient", "", ".3f"),
)

"""The public recordings as streams (see their NOTE.md), and what is done with a recording to test an estimate without a truth."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.recordings import ImuStream, PoseStream
from factorgrasp.typing import FloatArray

Recording = tuple[PoseStream, ImuStream]
Grasp = tuple[FloatArray, FloatArray]
"""``R_r_h`` (3, 3) and ``p_r_h`` (3,)."""
SHIFT, TURN = 0.4, 1.5
"""Size of the transforms that move a body, m and rad."""


def read_broad(path: Path) -> Recording:
    """Optical body as robot, IMU as hand; poses outside the declared movement become gaps."""
    with np.load(path) as raw:
        n = raw["movement"].size
        t = np.arange(n) / float(raw["fs"])
        moving = raw["movement"].astype(bool)[:, None]
        position = np.where(moving, raw["opt_pos"].astype(float), np.nan)
        rotation = np.where(moving, raw["opt_quat"].astype(float), np.nan)
        rate, force = raw["imu_gyr"].astype(float), raw["imu_acc"].astype(float)
    return PoseStream(t, position, rotation), ImuStream(t, rate, force)


def read_euroc(folder: Path) -> tuple[PoseStream, ImuStream, FloatArray]:
    """Ground-truth poses, IMU, and the ground truth's biases (n, 6) of gyroscope and accelerometer."""
    truth = np.genfromtxt(folder / "V102_groundtruth_first40s.csv", delimiter=",", comments="#")
    imu = np.genfromtxt(folder / "imu0_data.csv", delimiter=",", comments="#")
    # Nanoseconds since 1970 lose digits as floating-point seconds: count from the first.
    robot = PoseStream((truth[:, 0] - truth[0, 0]) * 1e-9, truth[:, 1:4], truth[:, 4:8])
    return robot, ImuStream((imu[:, 0] - truth[0, 0]) * 1e-9, imu[:, 1:4], imu[:, 4:7]), truth[:, 11:17]


def read_abb(path: Path) -> Recording:
    """Tool poses of the robot and the IMU on it, one clock."""
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    t = table[:, 0]
    with warnings.catch_warnings():
        # The authors interpolated quaternions across changes of sign; the reader says so and takes these rows as gaps.
        warnings.simplefilter("ignore")
        robot = PoseStream(t, table[:, 5:8], table[:, 1:5])
    return robot, ImuStream(t, table[:, 8:11], table[:, 11:14])


def moved_body(robot: PoseStream, shift: FloatArray, turn: FloatArray) -> PoseStream:
    """The stream of another point and other axes of the same body: ``p + R shift``, ``R turn``."""
    R, good = robot.rotation, robot.valid
    q = np.full_like(robot.rotation_wxyz, np.nan)
    q[good] = lie.matrix_to_quaternion_wxyz(R[good] @ turn)
    return PoseStream(robot.t, robot.position + R @ shift, q, check_units=False)


def transforms(count: int) -> list[tuple[FloatArray, FloatArray]]:
    """Rigid transforms of 0.4 m and 1.5 rad in random directions, the same in every run."""
    rng = np.random.default_rng(2015)
    out = []
    for _ in range(count):
        way, axis = rng.standard_normal((2, 3))
        out.append((SHIFT * way / np.linalg.norm(way), lie.so3_exp(TURN * axis / np.linalg.norm(axis))))
    return out


def halves(robot: PoseStream, hand: ImuStream) -> tuple[Recording, Recording]:
    """Both halves of the time in which the robot side moves."""
    good = robot.t[robot.valid]
    middle = 0.5 * (good[0] + good[-1])
    return tuple(  # type: ignore[return-value]
        (robot.slice(a, b), hand.slice(max(a - 1.0, hand.t[0]), min(b + 1.0, hand.t[-1])))
        for a, b in ((good[0], middle), (middle, good[-1]))
    )


def carried(a: Grasp, shift: FloatArray, turn: FloatArray) -> Grasp:
    """Where a grasp (R_r_h, p_r_h) must lie after the body was moved."""
    return turn.T @ a[0], turn.T @ (a[1] - shift)


def apart(a: Grasp, b: Grasp) -> tuple[float, float]:
    """Angle (rad) and distance (m) between two grasps."""
    return float(lie.angle_between(a[0], b[0])), float(np.linalg.norm(a[1] - b[1]))


def sigmas(a: Any, b: Any) -> FloatArray:
    """Difference of two estimates (6,), rotation before lever arm, in claimed standard deviations."""
    difference = np.concatenate([lie.so3_log(a.rotation.T @ b.rotation), b.translation - a.translation])
    return np.asarray(np.abs(difference) / np.sqrt(np.diag(a.covariance) + np.diag(b.covariance)))

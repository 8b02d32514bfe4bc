"""The demonstration: a recording with known truth is written to disk, solved from there, and compared with the truth."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from factorgrasp import lie
from factorgrasp.problems.grasp_estimate import GraspPoseEstimate
from factorgrasp.report import quantity
from factorgrasp.simulation.cehajic2015 import ENCODER_POSES, XSENS, cehajic2015
from factorgrasp.simulation.grasp_files import write_recording
from factorgrasp.tables import Column, Table

TIME_OFFSET = 0.034
"""By how much the hand's clock is ahead (s)."""


def write_demo(directory: Path, duration: float = 60.0, seed: int = 7) -> Path:
    """Simulate the experiment of Cehajic et al. (2015) with everyday faults, and write it as files.

    The robot offers poses at 250 Hz; the hand's IMU runs at 200 Hz on a clock of its own that is 34 ms ahead, has biases,
    and loses 1 % of its samples in bursts.

    Parameters
    ----------
    directory : Path
        Where ``robot.csv``, ``imu.csv``, ``truth.json`` and ``grasp.toml`` go.
    duration : float
        s.
    seed : int

    Returns
    -------
    Path
        Of the problem file.
    """
    recording = cehajic2015(
        seed,
        duration=duration,
        robot=replace(ENCODER_POSES, rate=250.0),
        hand=replace(XSENS, rate=200.0, dropout_fraction=0.01, dropout_length=10.0),
        time_offset=TIME_OFFSET,
    )
    return write_recording(recording, directory)


def truth_table(estimate: GraspPoseEstimate, directory: Path) -> Table:
    """The truth of a simulated recording beside the estimate.

    Parameters
    ----------
    estimate : GraspPoseEstimate
    directory : Path
        With ``truth.json``.
    """
    truth = json.loads((directory / "truth.json").read_text(encoding="utf-8"))
    sd = np.sqrt(np.diag(estimate.covariance))
    rotation_error = lie.so3_log(estimate.rotation.T @ lie.quaternion_wxyz_to_matrix(truth["rotation_wxyz"]))
    rows = _rows("position", "m", truth["translation"], estimate.translation, sd[3:])
    rows += [
        {
            "what": f"rotation about {axis}",
            "error": quantity(float(e), "rad"),
            "sd": quantity(float(s), "rad"),
        }
        for axis, e, s in zip("xyz", rotation_error, sd[:3], strict=True)
    ]
    rows += _rows(
        "clock offset", "s", [truth["time_offset"]], [estimate.time_offset], [estimate.time_offset_sd]
    )
    rows += _rows("gyroscope bias", "rad/s", truth["gyro_bias"], estimate.gyro_bias, estimate.gyro_bias_sd)
    rows += _rows(
        "accelerometer bias",
        "m/s^2",
        truth["accelerometer_bias"],
        estimate.accelerometer_bias,
        estimate.accelerometer_bias_sd,
    )
    columns = (
        Column("what", "beside the truth"),
        Column("truth"),
        Column("estimate"),
        Column("error"),
        Column("sd", "claimed sd"),
    )
    return Table(columns, tuple(rows))


def _rows(
    what: str, unit: str, truth: Iterable[float], estimate: Iterable[float], sd: Iterable[float]
) -> list[dict[str, str]]:
    found = list(zip(truth, estimate, sd, strict=True))
    names = [f"{what} {axis}" for axis in "xyz"] if len(found) == 3 else [what]
    return [
        {
            "what": name,
            "truth": quantity(float(true), unit, 4),
            "estimate": quantity(float(value), unit, 4),
            "error": quantity(float(value - true), unit),
            "sd": quantity(float(spread), unit),
        }
        for name, (true, value, spread) in zip(names, found, strict=True)
    ]

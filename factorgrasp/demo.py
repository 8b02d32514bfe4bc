"""The demonstration: a recording with known truth is written to disk, solved from there, and compared with the truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from factorgrasp import lie
from factorgrasp.problems.grasp_estimate import GraspPoseEstimate
from factorgrasp.report import decimals
from factorgrasp.simulation.cehajic2015 import ENCODER_POSES, XSENS, cehajic2015
from factorgrasp.simulation.grasp_files import write_recording
from factorgrasp.tables import Column, Table
from factorgrasp.typing import FloatArray

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
    turn = np.degrees(
        lie.so3_log(estimate.rotation.T @ lie.quaternion_wxyz_to_matrix(truth["rotation_wxyz"]))
    )
    gyro_bias, force_bias = np.array(truth["gyro_bias"]), np.array(truth["accelerometer_bias"])
    offset = (
        np.array([truth["time_offset"]]),
        np.array([estimate.time_offset]),
        np.array([estimate.time_offset_sd]),
    )
    deg = 180.0 / np.pi
    rows = [
        *_rows("position", "mm", 1e3, np.array(truth["translation"]), estimate.translation, sd[3:]),
        *_rows("rotation about", "deg", 1.0, np.full(3, np.nan), turn, deg * sd[:3]),
        *_rows("clock offset", "ms", 1e3, *offset),
        *_rows("gyroscope bias", "deg/s", deg, gyro_bias, estimate.gyro_bias, estimate.gyro_bias_sd),
        *_rows(
            "accelerometer bias",
            "mm/s²",
            1e3,
            force_bias,
            estimate.accelerometer_bias,
            estimate.accelerometer_bias_sd,
        ),
    ]
    columns = tuple(
        Column(key, header)
        for key, header in (
            ("what", "beside the truth"),
            ("unit", "unit"),
            ("truth", "truth"),
            ("estimate", "estimate"),
            ("error", "error"),
            ("sd", "claimed sd"),
        )
    )
    return Table(columns, tuple(rows))


def _rows(
    what: str, unit: str, scale: float, truth: FloatArray, estimate: FloatArray, sd: FloatArray
) -> list[dict[str, str]]:
    """One row a component, all figures to the second digit of the standard deviation; a truth of NaN: `estimate` is the error itself."""
    names = [f"{what} {axis}" for axis in "xyz"] if truth.size == 3 else [what]
    out = []
    for name, true, value, spread in zip(names, scale * truth, scale * estimate, scale * sd, strict=True):
        digits = decimals(float(spread))
        # Adding zero turns -0.0 into 0.0.
        error = np.round(value if np.isnan(true) else value - true, digits) + 0.0
        row = {"what": name, "unit": unit, "error": f"{error:+.{digits}f}", "sd": f"{spread:.{digits}f}"}
        if not np.isnan(true):
            row |= {"truth": f"{true:.{digits}f}", "estimate": f"{value:.{digits}f}"}
        out.append(row)
    return out

"""A simulated grasp recording as files: two CSV tables, the truth, and a problem file that points at them."""

from __future__ import annotations

import json
from dataclasses import asdict
from os import PathLike
from pathlib import Path

import numpy as np

from factorgrasp.atomic import write_text
from factorgrasp.recordings.csv import write_csv
from factorgrasp.simulation.grasp import GraspRecording, GraspTruth
from factorgrasp.typing import JsonDict


def write_recording(recording: GraspRecording, directory: str | PathLike[str]) -> Path:
    """Write ``robot.csv``, ``imu.csv``, ``truth.json`` and ``grasp.toml``, each atomically.

    The tables have the columns of :mod:`factorgrasp.recordings.csv`, in SI units.

    Parameters
    ----------
    recording : GraspRecording
        What to write.
    directory : path
        Made if missing; files of these names in it are replaced.

    Returns
    -------
    Path
        Of ``grasp.toml``.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "robot.csv", recording.robot)
    write_csv(folder / "imu.csv", recording.hand)
    write_text(folder / "truth.json", json.dumps(_truth(recording), indent=2) + "\n")
    gravity = ", ".join(repr(float(g)) for g in recording.gravity)
    # Written last: whoever finds it finds the rest.
    target = folder / "grasp.toml"
    write_text(
        target,
        f"# Simulated: {recording.name}. The truth is in truth.json.\n"
        'kind = "grasp_pose"\n\n'
        f'[robot]\nfile = "robot.csv"\ngravity = [{gravity}]\n\n'
        '[hand]\nfile = "imu.csv"\n',
    )
    return target


def _truth(recording: GraspRecording) -> JsonDict:
    truth: GraspTruth = recording.truth
    return {
        "name": recording.name,
        "rotation_wxyz": truth.rotation_wxyz.tolist(),
        "translation": truth.translation.tolist(),
        "gyro_bias": truth.gyro_bias.tolist(),
        "accelerometer_bias": truth.accelerometer_bias.tolist(),
        "time_offset": truth.time_offset,
        "base_tilt": truth.base_tilt.tolist(),
        "changes": [
            {
                "start": change.start,
                "duration": change.duration,
                "rotation": np.asarray(change.rotation).tolist(),
                "translation": np.asarray(change.translation).tolist(),
            }
            for change in truth.changes
        ],
        "robot_sensing": asdict(recording.robot_sensing),
        "hand_imu": asdict(recording.hand_imu),
    }

"""A simulated human-dynamics recording as files: tables, a truth and a problem file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorgrasp.atomic import replacing, write_text
from factorgrasp.simulation.human_dynamics import FEET, HANDS, HumanRecording
from factorgrasp.typing import FloatArray

PROBLEM_NAME = "dynamics.toml"
_ROOT = ("px", "py", "pz", "qx", "qy", "qz", "qw")
_PLATE = ("t", "fx", "fy", "fz", "px", "py", "pz", "mx", "my", "mz")


def write_recording(recording: HumanRecording, directory: Path) -> Path:
    """Write what is recorded as files, and what is true.

    Parameters
    ----------
    recording : HumanRecording
    directory : Path
        Where ``motion.csv``, ``plate_<foot>.csv``, ``truth.npz`` and ``dynamics.toml`` go; made if missing.

    Returns
    -------
    Path
        Of the problem file.
    """
    truth = recording.truth
    names = ("t", *_ROOT, *truth.dof_names)
    _write_csv(directory / "motion.csv", names, np.column_stack([recording.t, recording.configurations]))
    for link in FEET:
        plate = recording.plates[link]
        columns = np.column_stack([plate.t, plate.force, plate.point, plate.moment])
        _write_csv(directory / f"plate_{link}.csv", _PLATE, columns)
    arrays = {f"external_wrench/{link}": wrench for link, wrench in truth.external_wrench.items()}
    with replacing(directory / "truth.npz") as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            t=recording.t,
            torque=truth.torque,
            dof_names=np.array(truth.dof_names),
            payload=np.array(truth.payload),
            **arrays,  # type: ignore[arg-type]  # its stubs take the options for names, too
        )
    return write_text(directory / PROBLEM_NAME, problem_text(recording))


def problem_text(recording: HumanRecording) -> str:
    """The problem file of a recording."""
    body, noise = recording.body, recording.noise
    held = [link for link in HANDS if link in recording.truth.external_wrench]
    variance = ", ".join(f"{v:.6g}" for v in [noise.force**2] * 3 + [noise.moment**2] * 3)
    lines = [
        'kind = "human_dynamics"',
        f'title = "{recording.name}, simulated"',
        "",
        "[model]",
        f"height = {body.height!r}",
        f"mass = {body.mass!r}",
        f'sex = "{body.sex}"',
        "",
        "[motion]",
        'file = "motion.csv"',
        f"bandwidth = {noise.bandwidth!r}",
        f"angle_sd = {noise.angle!r}",
        f"position_sd = {noise.position!r}",
        f"orientation_sd = {noise.orientation!r}",
    ]
    for link in FEET:
        lines += [
            "",
            "[[forces]]",
            f'file = "plate_{link}.csv"',
            f'link = "{link}"',
            f"covariance = [{variance}]",
        ]
    if held:
        names = ", ".join(f'"{link}"' for link in held)
        points = ", ".join(f"{link} = {[float(x) for x in body.segments[link].com]}" for link in held)
        lines += ["", "[contacts]", f"unmeasured = [{names}]"]
        lines += [f"payload = [{names}]"] if recording.truth.payload > 0.0 else []
        lines += [f"points = {{ {points} }}", "", "[covariance]", "contact_wrench = [1e4, 1e4, 1e4, 1, 1, 1]"]
    return "\n".join(lines) + "\n"


def _write_csv(path: Path, names: tuple[str, ...], values: FloatArray) -> None:
    with replacing(path) as temporary:
        np.savetxt(temporary, values, "%.9g", ",", header=",".join(names), comments="", encoding="utf-8")

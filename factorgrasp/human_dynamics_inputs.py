"""[[sensors]] of a human-dynamics file: what else was measured, brought onto the clock of the motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.human_dynamics_forces import mounting
from factorgrasp.human_dynamics_motion import BodyMotion
from factorgrasp.problems.human_dynamics_sensors import (
    Accelerometer,
    GyroscopeDerivative,
    JointAcceleration,
    JointTorque,
    Sensor,
)
from factorgrasp.recordings.plausibility import check_angular_velocity, check_specific_force
from factorgrasp.recordings.tables import column_names, read_table
from factorgrasp.signals import (
    choose_savgol,
    resample_uniform,
    savgol_derivatives,
    savgol_noise_gain,
    synchronise,
)
from factorgrasp.toml_tables import check_keys, close_matches, convert, get, place
from factorgrasp.typing import FloatArray

SENSORS = (
    "accelerometer",
    "gyroscope",
    "angular_acceleration",
    "joint_torque",
    "joint_acceleration",
    "wrench",
)
"""Types of [[sensors]]; a "wrench" is read as one of [[forces]]."""
_ORDER = 4
_AXES: Mapping[str, tuple[str, ...]] = {
    "accelerometer": ("ax", "ay", "az"), "gyroscope": ("wx", "wy", "wz"), "angular_acceleration": ("alx", "aly", "alz")
}  # fmt: skip


def read_sensors(
    entries: Sequence[Mapping[str, Any]], body: BodyMotion, base_dir: Path, bandwidth: float
) -> list[Sensor]:
    """Accelerometers and gyroscopes on links, torques and accelerations of joints; at the good frames.

    Parameters
    ----------
    entries : sequence of mappings
    body : BodyMotion
    base_dir : Path
    bandwidth : float
        Hz, of the filter that differentiates a gyroscope.
    """
    out: list[Sensor] = []
    for number, one in enumerate(entries, start=1):
        where = f"[[sensors]] {number}"
        kind = get(one, "type", str, where)
        if kind not in SENSORS:
            raise InputError(
                place(where, "type"), "one of " + ", ".join(SENSORS), repr(kind), close_matches(kind, SENSORS)
            )
        path = base_dir / get(one, "file", str, where)
        if kind in _AXES:
            out.append(_on_link(one, where, kind, path, body, bandwidth))
        else:
            out.append(_on_joint(one, where, kind, path, body))
    return out


def _on_link(
    one: Mapping[str, Any], where: str, kind: str, path: Path, body: BodyMotion, bandwidth: float
) -> Sensor:
    keys = [
        "type",
        "name",
        "file",
        "link",
        "columns",
        "covariance",
        "position",
        "rotation_wxyz",
        "time_offset",
    ]
    check_keys(one, [*keys, "bandwidth"] if kind == "gyroscope" else keys, where)
    link = get(one, "link", str, where)
    if link not in body.motion.links:
        raise InputError(
            f"{where}: link", "a link of the model", repr(link), close_matches(link, body.motion.links)
        )
    names = get(one, "columns", tuple[str, str, str], where, _AXES[kind])
    t, values = _columns(path, names, get(one, "time_offset", float, where, 0.0))
    variance = _variance(one, where, 3)
    field = f"{where}: {path}: {', '.join(names)}"
    R, p = mounting(one, where)
    name = f"{kind.replace('_', ' ')} on {link}"
    if kind == "accelerometer":
        check_specific_force(values, field)
        return Accelerometer(_at(body, path, t, values), variance, name, link=link, R_l_s=R, p_l_s=p)
    if "position" in one:
        raise InputError(place(where, "position"), "no such key: a link turns everywhere alike", "one")
    if kind == "gyroscope":
        check_angular_velocity(values, field)
        dt = float(np.median(np.diff(t)))
        t, values = resample_uniform(t, values, dt)
        window = choose_savgol(min(get(one, "bandwidth", float, where, bandwidth), 0.5 / dt), dt, _ORDER, 1)
        values = savgol_derivatives(values, dt, window, _ORDER, 1)
        variance = variance * savgol_noise_gain(window, _ORDER, 1, dt)
    return GyroscopeDerivative(_at(body, path, t, values), variance, name, link=link, R_l_s=R)


def _on_joint(one: Mapping[str, Any], where: str, kind: str, path: Path, body: BodyMotion) -> Sensor:
    check_keys(one, ("type", "name", "file", "joint", "columns", "covariance", "time_offset"), where)
    joint = get(one, "joint", str, where)
    known = [j.name for j in body.motion.joints]
    if joint not in known:
        raise InputError(
            place(where, "joint"), "a joint of the model", repr(joint), close_matches(joint, known)
        )
    dofs = body.motion.joints[known.index(joint)].dofs
    if not dofs:
        raise InputError(
            place(where, "joint"), "a joint with known axes", f"{joint}, of which only the centre is known"
        )
    names = get(one, "columns", tuple[str, ...], where, dofs)
    if len(names) != len(dofs):
        raise InputError(
            place(where, "columns"), f"{len(dofs)} names, for " + ", ".join(dofs), str(len(names))
        )
    t, values = _columns(path, names, get(one, "time_offset", float, where, 0.0))
    variance, values = _variance(one, where, len(dofs)), _at(body, path, t, values)
    if kind == "joint_torque":
        return JointTorque(values, variance, f"torque of {joint}", joint=joint)
    return JointAcceleration(values, variance, f"acceleration of {joint}", joint=joint)


def _variance(one: Mapping[str, Any], where: str, size: int) -> FloatArray:
    """Variances (size,) from one number or one a component."""
    if "covariance" not in one:
        raise InputError(place(where, "covariance"), "a variance (or sd, its root)", "no such key")
    value = np.asarray(convert(one["covariance"], float | tuple[float, ...], place(where, "covariance")))
    if value.size not in (1, size) or (value <= 0.0).any():
        raise InputError(
            place(where, "covariance"), f"one variance above zero, or {size} of them", f"{one['covariance']}"
        )
    return np.asarray(np.broadcast_to(value, (size,)).astype(float))


def _columns(path: Path, names: Sequence[str], offset: float) -> tuple[FloatArray, FloatArray]:
    there = column_names(path)
    clock = next((name for name in ("t", "time", "Time") if name in there), "t")
    columns = read_table(path, (clock, *names))
    return columns[clock] + offset, np.column_stack([columns[name] for name in names])


def _at(body: BodyMotion, path: Path, t: FloatArray, values: FloatArray) -> FloatArray:
    found = synchronise(body.clock, {path.name: (t, values)})[path.name][body.good]
    if not np.isfinite(found).any() and np.isfinite(values).any():
        clock = body.clock[body.good]
        raise InputError(
            f"{path}: t", f"times within those of the motion, {clock[0]:.6g} to {clock[-1]:.6g} s",
            f"{t[0]:.6g} to {t[-1]:.6g} s", "One clock? time_offset is added to the file's times",
        )  # fmt: skip
    return found

"""[[forces]] and [[sensors]] of a human-dynamics file: what was measured, brought onto the clock of the motion."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.human_dynamics_motion import BodyMotion, Vector
from factorgrasp.problems.human_dynamics_sensors import Accelerometer, ExternalWrench, JointTorque, Sensor
from factorgrasp.recordings.forces import (
    ForceRecording,
    read_force,
    read_force_table,
    read_opensim_forces,
    read_wrench_table,
)
from factorgrasp.recordings.links import read_link_forces
from factorgrasp.recordings.tables import read_table
from factorgrasp.signals import synchronise
from factorgrasp.toml_tables import check_keys, close_matches, convert, get, place
from factorgrasp.typing import FloatArray

Quaternion = tuple[float, float, float, float]
Six = tuple[float, float, float, float, float, float]

PLATE_COVARIANCE: Six = (59.0, 59.0, 36.0, 2.25, 2.25, 0.56)
"""N^2 and (Nm)^2 of a force plate, upright last: those of the bowing data set of Latella et al., Sensors 16(5), 2016."""

_SENSORS = ("accelerometer", "joint_torque")


def tables_of(table: Mapping[str, Any], key: str) -> Sequence[Mapping[str, Any]]:
    """``[[key]]``, or a single ``[key]``, or nothing."""
    value = table.get(key, [])
    tables = [value] if isinstance(value, Mapping) else value
    if not isinstance(tables, list) or not all(isinstance(one, Mapping) for one in tables):
        raise InputError(f"[[{key}]]", "tables", type(value).__name__)
    return tables


def read_wrenches(
    table: Mapping[str, Any], body: BodyMotion, base_dir: Path, default: Six
) -> list[ExternalWrench]:
    """One sensor a link and frame of measurement, at the good frames of the motion.

    Plates on one link add up: their wrenches and their covariances.
    """
    out: list[ExternalWrench] = []
    world: dict[str, list[tuple[ForceRecording, FloatArray, float | None]]] = {}
    for number, one in enumerate(tables_of(table, "forces"), start=1):
        where = f"[[forces]] {number}"
        covariance = np.array(get(one, "covariance", Six, where, default))
        if (covariance <= 0.0).any():
            raise InputError(
                place(where, "covariance"), "six variances above zero, N^2 and (Nm)^2", f"{covariance}"
            )
        if get(one, "frame", Literal["world", "sensor"], where, "world") == "sensor":
            out.append(_in_hand(one, where, body, base_dir, covariance))
            continue
        limit = get(one, "limit", float, where, None)
        for force in _world_forces(one, where, base_dir):
            _check_link(force.link, body, where)
            world.setdefault(force.link, []).append((force, covariance, limit))
    out += [_on_link(link, parts, body) for link, parts in world.items()]
    return out


def _world_forces(one: Mapping[str, Any], where: str, base_dir: Path) -> Iterable[ForceRecording]:
    path = base_dir / get(one, "file", str, where)
    suffix = path.suffix.lower()
    common = ("file", "frame", "covariance", "limit")
    if suffix == ".xml":
        check_keys(one, (*common, "data"), where)
        data = get(one, "data", str, where, None)
        return read_opensim_forces(path, None if data is None else base_dir / data)
    if suffix in (".mot", ".sto"):
        check_keys(one, (*common, "link", "force", "point", "moment"), where)
        words = [get(one, key, str, where) for key in ("link", "force", "point")]
        return (read_force(path, words[0], words[1], words[2], get(one, "moment", str, where, "")),)
    if suffix == ".npz" and "link" not in one:
        check_keys(one, common, where)
        return read_link_forces(path)
    check_keys(one, (*common, "link"), where)
    return (read_force_table(path, get(one, "link", str, where)),)


def _on_link(
    link: str, parts: Sequence[tuple[ForceRecording, FloatArray, float | None]], body: BodyMotion
) -> ExternalWrench:
    total = np.zeros((body.clock.size, 6))
    variance = np.zeros(6)
    for force, covariance, limit in parts:
        # About the ground's origin: there forces and moments may be interpolated each on its own, a centre of pressure may not.
        wrench = force.wrench_about(np.zeros(3))
        if limit is not None:
            wrench[np.linalg.norm(force.force, axis=1) >= limit] = np.nan
        total += synchronise(body.clock, {force.name: (force.t, wrench)})[force.name]
        variance = variance + covariance
    values = total[body.good]
    motion = body.motion
    origin = motion.p[:, motion.link(link)]
    values[:, 3:] -= np.cross(origin, values[:, :3])
    return ExternalWrench(values, variance, f"force on {link}", link=link, frame="world")


def _in_hand(
    one: Mapping[str, Any], where: str, body: BodyMotion, base_dir: Path, covariance: FloatArray
) -> ExternalWrench:
    """A force/torque sensor that moves with its link."""
    check_keys(one, ("file", "link", "frame", "covariance", "position", "rotation_wxyz"), where)
    link = get(one, "link", str, where)
    _check_link(link, body, where)
    t, wrench = read_wrench_table(base_dir / get(one, "file", str, where))
    values = synchronise(body.clock, {link: (t, wrench)})[link][body.good]
    R, p = mounting(one, where)
    return ExternalWrench(values, covariance, f"force sensor on {link}", link=link, R_l_s=R, p_l_s=p)


def read_sensors(table: Mapping[str, Any], body: BodyMotion, base_dir: Path) -> list[Sensor]:
    """Accelerometers on links and measured joint torques."""
    out: list[Sensor] = []
    for number, one in enumerate(tables_of(table, "sensors"), start=1):
        where = f"[[sensors]] {number}"
        kind = get(one, "type", str, where)
        if kind not in _SENSORS:
            raise InputError(
                place(where, "type"),
                "one of " + ", ".join(_SENSORS),
                repr(kind),
                close_matches(kind, _SENSORS),
            )
        path = base_dir / get(one, "file", str, where)
        variance = get(one, "covariance", float, where)
        if kind == "accelerometer":
            check_keys(one, ("type", "file", "link", "covariance", "position", "rotation_wxyz"), where)
            link = get(one, "link", str, where)
            _check_link(link, body, where)
            values = _read_columns(path, ("ax", "ay", "az"), body)
            R, p = mounting(one, where)
            out.append(
                Accelerometer(values, variance, f"accelerometer on {link}", link=link, R_l_s=R, p_l_s=p)
            )
        else:
            check_keys(one, ("type", "file", "joint", "covariance"), where)
            joint = get(one, "joint", str, where)
            known = [j.name for j in body.motion.joints]
            if joint not in known:
                raise InputError(
                    place(where, "joint"), "a joint of the model", repr(joint), close_matches(joint, known)
                )
            dofs = body.motion.joints[known.index(joint)].dofs
            if not dofs:
                raise InputError(
                    place(where, "joint"),
                    "a joint with known axes",
                    f"{joint}, of which only the centre is known",
                )
            out.append(
                JointTorque(_read_columns(path, dofs, body), variance, f"torque of {joint}", joint=joint)
            )
    return out


def mounting(one: Mapping[str, Any], where: str) -> tuple[FloatArray, FloatArray]:
    """``R_l_s`` and ``p_l_s`` of a sensor from ``rotation_wxyz`` and ``position``."""
    position = np.array(get(one, "position", Vector, where, (0.0, 0.0, 0.0)))
    quaternion = np.array(
        convert(one.get("rotation_wxyz", [1, 0, 0, 0]), Quaternion, place(where, "rotation_wxyz"))
    )
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 1e-2:
        raise InputError(place(where, "rotation_wxyz"), "a unit quaternion [w, x, y, z]", f"norm {norm:.6g}")
    return lie.quaternion_wxyz_to_matrix(quaternion / norm), position


def _read_columns(path: Path, names: Sequence[str], body: BodyMotion) -> FloatArray:
    columns = read_table(path, ("t", *names))
    values = np.column_stack([columns[name] for name in names])
    return synchronise(body.clock, {path.name: (columns["t"], values)})[path.name][body.good]


def _check_link(link: str, body: BodyMotion, where: str) -> None:
    if link not in body.motion.links:
        raise InputError(
            f"{where}: link", "a link of the model", repr(link), close_matches(link, body.motion.links)
        )

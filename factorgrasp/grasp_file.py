"""The tables of a problem file with ``kind = "grasp_pose"``: [robot], [hand], [noise], [estimate], [prior]."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.lie import quaternion_wxyz_to_matrix
from factorgrasp.models.robot import load_robot
from factorgrasp.problems.grasp_pose import GraspPose
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.recordings import (
    ImuStream,
    JointStream,
    MotionStream,
    PoseStream,
    column_names,
    read_imu,
    read_joints,
    read_motion,
    read_poses,
    read_stream,
)
from factorgrasp.toml_tables import check_keys, convert, from_table, get, place, sub_table

TABLES = ("robot", "hand", "noise", "estimate", "prior")

Columns = Literal["poses", "imu", "motion", "joints"]
_MARKS = {"poses": ("px", "qw"), "imu": ("wx", "ax")}

# What the tables call settings that belong together or go by another name elsewhere.
_ALIASES = {
    "biases": ("gyro_bias", "accelerometer_bias"),
    "robust_loss": ("loss",),
    "forgetting": ("forgetting_time",),
}


def build(table: Mapping[str, Any], base_dir: Path) -> GraspPose:
    """The grasp-pose problem of a problem file.

    Parameters
    ----------
    table : mapping
        The tables of the file.
    base_dir : Path
        Folder that its paths are relative to.

    Raises
    ------
    InputError
        Naming the table and the key, or the recording and the column.
    """
    check_keys(table, TABLES, "")
    robot, hand = sub_table(table, "robot", required=True), sub_table(table, "hand", required=True)
    check_keys(robot, ("file", "columns", "check_units", "gravity", "urdf", "frame", "bandwidth"), "[robot]")
    check_keys(hand, ("file", "columns", "check_units"), "[hand]")

    # Cheap mistakes first: a wrong switch is said before a long recording is read.
    noise = from_table(GraspNoise, sub_table(table, "noise"), "[noise]")
    settings = _settings(sub_table(table, "estimate"), robot)
    prior = _prior(table)
    gravity = get(robot, "gravity", tuple[float, float, float], "[robot]", (0.0, 0.0, -9.80665))

    robot_stream = _read(robot, "robot", base_dir, "poses")
    hand_stream = _read(hand, "hand", base_dir, "imu")
    if not isinstance(hand_stream, ImuStream):
        raise InputError("[hand] file", "an IMU (columns t,wx,wy,wz,ax,ay,az)", type(hand_stream).__name__)
    model = _robot_model(robot, robot_stream, base_dir)
    return GraspPose(
        robot=robot_stream,
        hand=hand_stream,
        noise=noise,
        settings=settings,
        gravity=gravity,
        prior=prior,
        **model,
    )


def _read(
    table: Mapping[str, Any], side: str, base_dir: Path, preferred: Columns
) -> PoseStream | ImuStream | MotionStream | JointStream:
    where = f"[{side}]"
    path = base_dir / get(table, "file", str, where)
    check_units = get(table, "check_units", bool, where, True)
    columns = get(table, "columns", Columns, where, None)
    if columns is None:
        names = set(column_names(path))
        # A log of everything is common; the two sides of a grasp say what they are read as by default.
        if all(names.issuperset(mark) for mark in _MARKS.values()):
            columns = preferred
    if columns is None:
        return read_stream(path, side, check_units)
    if columns == "poses":
        return read_poses(path, side, check_units)
    if columns == "imu":
        return read_imu(path, side, check_units)
    if columns == "motion":
        return read_motion(path, side, check_units)
    return read_joints(path, side, check_units)


def _settings(table: Mapping[str, Any], robot: Mapping[str, Any]) -> GraspSettings:
    where = "[estimate]"
    values = dict(table)
    for alias, targets in _ALIASES.items():
        if alias in values:
            value = values.pop(alias)
            for target in targets:
                if target in values:
                    raise InputError(place(where, alias), f"either {alias} or {target}", "both")
                values[target] = value
    if "bandwidth" in robot:
        if "kinematics_bandwidth" in values:
            raise InputError("[robot] bandwidth", "either this or [estimate] kinematics_bandwidth", "both")
        values["kinematics_bandwidth"] = get(robot, "bandwidth", float, "[robot]")
    return from_table(GraspSettings, values, where)


def _prior(table: Mapping[str, Any]) -> GraspPrior | None:
    if "prior" not in table:
        return None
    where = "[prior]"
    values = sub_table(table, "prior")
    check_keys(values, ("translation", "translation_sd", "rotation_wxyz", "rotation_sd"), where)
    known: dict[str, Any] = {}
    if "translation" in values:
        known["translation"] = np.array(get(values, "translation", tuple[float, float, float], where))
    if "rotation_wxyz" in values:
        known["rotation"] = _rotation(values["rotation_wxyz"], place(where, "rotation_wxyz"))
    for key in ("translation_sd", "rotation_sd"):
        if key in values:
            known[key] = get(values, key, float, where)
    return from_table(GraspPrior, {}, where, **known)


def _rotation(value: Any, field: str) -> Any:
    quaternion = np.array(convert(value, tuple[float, float, float, float], field))
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 1e-2:
        raise InputError(field, "a unit quaternion [w, x, y, z]", f"norm {norm:.6g}")
    return quaternion_wxyz_to_matrix(quaternion)


def _robot_model(robot: Mapping[str, Any], stream: object, base_dir: Path) -> dict[str, Any]:
    """The model and frame that joint positions need; nothing for any other recording."""
    if isinstance(stream, JointStream):
        urdf = base_dir / get(robot, "urdf", str, "[robot]")
        return {"robot_model": load_robot(urdf), "frame": get(robot, "frame", str, "[robot]")}
    for key in ("urdf", "frame"):
        if key in robot:
            raise InputError(
                place("[robot]", key), "joint positions (t,q1,...,qn) in file", type(stream).__name__
            )
    return {}

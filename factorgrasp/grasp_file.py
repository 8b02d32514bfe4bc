"""The tables of a problem file with ``kind = "grasp_pose"``: [robot], [hand], [noise], [estimate], [prior]."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.lie import quaternion_wxyz_to_matrix
from factorgrasp.models.robot import load_robot
from factorgrasp.problems.grasp_from_poses import (
    GraspFromPosesNoise,
    GraspFromPosesSettings,
    GraspPoseFromPoses,
)
from factorgrasp.problems.grasp_kinematics import RobotStream
from factorgrasp.problems.grasp_pose import GraspPose
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.recordings import (
    JointStream,
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
_READERS: dict[Columns, Callable[[Path, str, bool], RobotStream]] = {
    "poses": read_poses,
    "imu": read_imu,
    "motion": read_motion,
    "joints": read_joints,
}
# One column tells what is meant; the reader then says what is missing.
_MARKS: dict[str, Columns] = {"px": "poses", "alx": "motion", "wx": "imu", "q1": "joints"}

# What the tables call settings that belong together or go by another name elsewhere.
_ALIASES = {
    "biases": ("gyro_bias", "accelerometer_bias"),
    "robust_loss": ("loss",),
    "forgetting": ("forgetting_time",),
}


def build(table: Mapping[str, Any], base_dir: Path) -> GraspPose | GraspPoseFromPoses:
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
    robot_columns = _columns(robot, "robot", base_dir, "poses")
    hand_columns = _columns(hand, "hand", base_dir, "imu")
    prior = _prior(table)
    if hand_columns == "poses":
        return _from_poses(table, base_dir, robot_columns, prior)
    if hand_columns != "imu":
        raise InputError(
            "[hand] file", "an IMU (t,wx,wy,wz,ax,ay,az) or poses (t,px,py,pz,qw,qx,qy,qz)", hand_columns
        )
    noise = from_table(GraspNoise, sub_table(table, "noise"), "[noise]")
    settings = from_table(GraspSettings, _estimate_table(table), "[estimate]")
    gravity = get(robot, "gravity", tuple[float, float, float], "[robot]", (0.0, 0.0, -9.80665))
    robot_stream = _READERS[robot_columns](*_reading(robot, "robot", base_dir))
    return GraspPose(
        robot=robot_stream,
        hand=read_imu(*_reading(hand, "hand", base_dir)),
        noise=noise,
        settings=settings,
        gravity=gravity,
        prior=prior,
        **_robot_model(robot, robot_stream, base_dir),
    )


def _from_poses(
    table: Mapping[str, Any], base_dir: Path, robot_columns: Columns, prior: GraspPrior | None
) -> GraspPoseFromPoses:
    """The problem of a hand whose pose is measured, by a camera or by markers."""
    robot, hand = table["robot"], table["hand"]
    if robot_columns != "poses":
        raise InputError(
            "[robot] file", "poses (t,px,py,pz,qw,qx,qy,qz), as the hand has them", robot_columns
        )
    for key in ("gravity", "urdf", "frame", "bandwidth"):
        if key in robot:
            raise InputError(
                place("[robot]", key), "an IMU in [hand] file", "poses, for which it means nothing"
            )
    noise = from_table(GraspFromPosesNoise, sub_table(table, "noise"), "[noise]")
    settings = from_table(GraspFromPosesSettings, _estimate_table(table), "[estimate]")
    return GraspPoseFromPoses(
        robot=read_poses(*_reading(robot, "robot", base_dir)),
        hand=read_poses(*_reading(hand, "hand", base_dir)),
        noise=noise,
        settings=settings,
        prior=prior,
    )


def _columns(table: Mapping[str, Any], side: str, base_dir: Path, preferred: Columns) -> Columns:
    """What a table is read as: what the file says, else what its columns say."""
    where = f"[{side}]"
    path = base_dir / get(table, "file", str, where)
    stated = get(table, "columns", Columns, where, None)
    if stated is not None:
        return cast(Columns, stated)
    names = column_names(path)
    fits = [kind for mark, kind in _MARKS.items() if mark in names]
    if not fits:
        read_stream(path, side)  # raises, in the words of all recordings
    # A log of everything is common; the two sides of a grasp are read as what they usually are.
    return preferred if preferred in fits else fits[0]


def _reading(table: Mapping[str, Any], side: str, base_dir: Path) -> tuple[Path, str, bool]:
    """Arguments of a reader: path, name and whether units are checked."""
    where = f"[{side}]"
    return base_dir / get(table, "file", str, where), side, get(table, "check_units", bool, where, True)


def _estimate_table(table: Mapping[str, Any]) -> dict[str, Any]:
    """[estimate] with its aliases, and [robot] bandwidth, under the names of the settings."""
    where = "[estimate]"
    values = dict(sub_table(table, "estimate"))
    for alias, targets in _ALIASES.items():
        if alias in values:
            value = values.pop(alias)
            for target in targets:
                if target in values:
                    raise InputError(place(where, alias), f"either {alias} or {target}", "both")
                values[target] = value
    robot = table["robot"]
    if "bandwidth" in robot:
        if "kinematics_bandwidth" in values:
            raise InputError("[robot] bandwidth", "either this or [estimate] kinematics_bandwidth", "both")
        values["kinematics_bandwidth"] = get(robot, "bandwidth", float, "[robot]")
    return values


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

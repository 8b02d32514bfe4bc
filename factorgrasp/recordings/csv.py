"""Tables with named columns (CSV, NPZ, Parquet) as recordings, and back.

Columns (any order; further ones are ignored)::

    robot    t,px,py,pz,qw,qx,qy,qz           poses, R_w_b as a unit quaternion
             t,wx,wy,wz,ax,ay,az              rates and specific force, body frame
             t,wx,wy,wz,alx,aly,alz,ax,ay,az  the same with angular acceleration; qw,qx,qy,qz optional
             t,q1,...,qn                      joints; qd1,...,qdn and qdd1,...,qddn optional
    hand     t,wx,wy,wz,ax,ay,az              gyroscope and accelerometer

Without a unit in the header values are SI: s, m, rad/s, m/s^2, rad. With one (``px [mm]``, ``wx [deg/s]``,
``t [ns]``) they are converted here. An empty field or ``nan`` is a gap and stays one. Lines that begin with
``#`` are comments.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np

from factorgrasp.atomic import write_text
from factorgrasp.errors import InputError
from factorgrasp.recordings._validate import QUATERNION_NORM_TOLERANCE
from factorgrasp.recordings.streams import ImuStream, JointStream, MotionStream, PoseStream
from factorgrasp.recordings.tables import PathLike, column_names, read_table
from factorgrasp.typing import FloatArray

Stream: TypeAlias = PoseStream | ImuStream | MotionStream | JointStream
_S = TypeVar("_S", PoseStream, ImuStream, MotionStream, JointStream)

_POSITION = ("px", "py", "pz")
_QUATERNION = ("qw", "qx", "qy", "qz")
_RATE = ("wx", "wy", "wz")
_RATE_CHANGE = ("alx", "aly", "alz")
_FORCE = ("ax", "ay", "az")
_JOINT = re.compile(r"(q|qd|qdd)([1-9]\d*)")


def _joint_columns(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Columns of q, qd and qdd, each complete or absent."""
    found: dict[str, set[int]] = {"q": set(), "qd": set(), "qdd": set()}
    for name in names:
        match = _JOINT.fullmatch(name)
        if match is not None:
            found[match[1]].add(int(match[2]))
    return {key: tuple(f"{key}{i}" for i in range(1, max(ids) + 1)) for key, ids in found.items() if ids}


def _stack(table: dict[str, FloatArray], names: Sequence[str]) -> FloatArray:
    return np.column_stack([table[name] for name in names])


def _load(
    path: PathLike, required: tuple[str, ...], optional: tuple[str, ...] = (), *, repair: bool
) -> dict[str, FloatArray]:
    """The table; with ``repair``, less the rows that make it unusable. What was done is said."""
    table = read_table(path, required, optional)
    if not repair:
        return table
    done = []
    keep = np.concatenate([[True], np.diff(table["t"]) != 0.0])
    if not keep.all():
        table = {name: values[keep] for name, values in table.items()}
        done.append(f"dropped {int((~keep).sum())} row(s) with the stamp of the row before")
    if all(name in table for name in _QUATERNION):
        norm = np.sqrt(sum(table[name] ** 2 for name in _QUATERNION))
        wrong = np.abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE
        if wrong.any():
            for name in _QUATERNION:
                table[name] = np.where(wrong, np.nan, table[name])
            done.append(f"made gaps of {int(wrong.sum())} quaternion(s) whose norm is not 1")
    if done:
        # Level 3 is the caller of read_poses and its siblings.
        warnings.warn(f"{path}: " + " and ".join(done), stacklevel=3)
    return table


def _build(file: Path, build: Callable[[], _S]) -> _S:
    try:
        return build()
    except InputError as error:
        raise InputError(f"{file}: {error.field}", error.expected, error.found, error.hint) from error


def read_poses(
    path: PathLike, name: str = "robot", check_units: bool = True, repair: bool = False
) -> PoseStream:
    """Poses from columns ``t,px,py,pz,qw,qx,qy,qz``; see :class:`PoseStream` and :func:`read_stream`."""
    table = _load(path, ("t", *_POSITION, *_QUATERNION), repair=repair)
    position, rotation = _stack(table, _POSITION), _stack(table, _QUATERNION)
    return _build(
        Path(path), lambda: PoseStream(table["t"], position, rotation, name=name, check_units=check_units)
    )


def read_imu(path: PathLike, name: str = "hand", check_units: bool = True, repair: bool = False) -> ImuStream:
    """Gyroscope and accelerometer from columns ``t,wx,wy,wz,ax,ay,az``; see :func:`read_stream`."""
    table = _load(path, ("t", *_RATE, *_FORCE), repair=repair)
    rate, force = _stack(table, _RATE), _stack(table, _FORCE)
    return _build(Path(path), lambda: ImuStream(table["t"], rate, force, name=name, check_units=check_units))


def read_motion(
    path: PathLike, name: str = "robot", check_units: bool = True, repair: bool = False
) -> MotionStream:
    """Motion from columns ``t,wx,wy,wz,alx,aly,alz,ax,ay,az`` (``a`` is specific force) and ``qw,qx,qy,qz`` if any."""
    table = _load(path, ("t", *_RATE, *_RATE_CHANGE, *_FORCE), _QUATERNION, repair=repair)
    rotation = _stack(table, _QUATERNION) if all(key in table for key in _QUATERNION) else None
    rate, change, force = _stack(table, _RATE), _stack(table, _RATE_CHANGE), _stack(table, _FORCE)
    return _build(
        Path(path),
        lambda: MotionStream(table["t"], rate, change, force, rotation, name=name, check_units=check_units),
    )


def read_joints(
    path: PathLike, name: str = "robot", check_units: bool = True, repair: bool = False
) -> JointStream:
    """Joints from columns ``t,q1,...,qn``, and ``qd1...`` and ``qdd1...`` when they are there."""
    groups = _joint_columns(column_names(path))
    positions = groups.get("q", ("q1",))
    columns = ("t", *positions, *groups.get("qd", ()), *groups.get("qdd", ()))
    table = _load(path, columns, repair=repair)
    values = {key: _stack(table, names) for key, names in groups.items()}
    return _build(
        Path(path),
        lambda: JointStream(
            table["t"],
            values["q"],
            positions,
            values.get("qd"),
            values.get("qdd"),
            name=name,
            check_units=check_units,
        ),
    )


def read_stream(
    path: PathLike, name: str | None = None, check_units: bool = True, repair: bool = False
) -> Stream:
    """The recording that a file's columns describe.

    Parameters
    ----------
    path : path
        A .csv, .npz or .parquet file; the columns decide what it is.
    name : str, optional
        Who was recorded; "hand" for an IMU and "robot" for everything else by default.
    check_units : bool
        Refuse values that suggest the wrong unit.
    repair : bool
        Drop rows that repeat the stamp of the row before and make gaps of quaternions whose norm is not 1, with a
        warning that counts both. By default they are errors. Time that runs backwards always is.

    Raises
    ------
    InputError
        When the columns describe nothing known, or more than one thing.
    """
    names = set(column_names(path))
    fits = []
    if names.issuperset(_POSITION + _QUATERNION):
        fits.append("poses")
    if names.issuperset(_RATE + _FORCE):
        fits.append("motion" if names.issuperset(_RATE_CHANGE) else "imu")
    if "q1" in names:
        fits.append("joints")
    if len(fits) > 1:
        raise InputError(
            f"{path}: columns",
            "those of one recording",
            "those of " + " and ".join(fits),
            "Call " + " or ".join(f"read_{kind}" for kind in fits),
        )
    if not fits:
        raise InputError(
            f"{path}: columns",
            "t with px,py,pz,qw,qx,qy,qz (poses), wx,wy,wz,ax,ay,az (IMU) or q1,...,qn (joints)",
            ", ".join(sorted(names)) or "none",
        )
    if fits == ["imu"]:
        return read_imu(path, name or "hand", check_units, repair)
    if fits == ["poses"]:
        return read_poses(path, name or "robot", check_units, repair)
    if fits == ["motion"]:
        return read_motion(path, name or "robot", check_units, repair)
    return read_joints(path, name or "robot", check_units, repair)


def write_csv(path: PathLike, stream: Stream) -> None:
    """Write a recording such that reading it back gives the same numbers, bit for bit; gaps are ``nan``.

    The file appears under its name only when it is complete.
    """
    file = Path(path)
    columns: list[tuple[Sequence[str], FloatArray]] = []
    match stream:
        case PoseStream():
            columns += [(_POSITION, stream.position), (_QUATERNION, stream.rotation_wxyz)]
        case ImuStream():
            columns += [(_RATE, stream.angular_velocity), (_FORCE, stream.specific_force)]
        case MotionStream():
            columns += [
                (_RATE, stream.angular_velocity),
                (_RATE_CHANGE, stream.angular_acceleration),
                (_FORCE, stream.specific_force),
            ]
            if stream.rotation_wxyz is not None:
                columns.append((_QUATERNION, stream.rotation_wxyz))
        case JointStream():
            for key, values in (("q", stream.q), ("qd", stream.qd), ("qdd", stream.qdd)):
                if values is not None:
                    columns.append(([f"{key}{i + 1}" for i in range(values.shape[1])], values))
        case _:
            raise InputError("stream", "a recording of this package", type(stream).__name__)
    columns.insert(0, (("t",), stream.t[:, None]))
    header = ",".join(name for names, _ in columns for name in names)
    rows = np.hstack([values for _, values in columns]).tolist()
    content = "\n".join([header, *(",".join(map(repr, row)) for row in rows), ""])
    if not file.parent.is_dir():
        raise InputError(str(file), "a path in an existing folder", f"no folder {file.parent}")
    write_text(file, content)

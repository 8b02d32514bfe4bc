"""Joint angles (and the pose of the root) from a table or an OpenSim storage, checked for wrong units."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.recordings.opensim import read_coordinates
from factorgrasp.recordings.plausibility import check_position, check_rate
from factorgrasp.recordings.tables import column_names, read_table
from factorgrasp.toml_tables import close_matches, get, sub_table
from factorgrasp.typing import BoolArray, FloatArray

POSITION, QUATERNION = ("px", "py", "pz"), ("qw", "qx", "qy", "qz")
DERIVATIVES: Mapping[int, tuple[str, ...]] = {
    1: ("_qd", "_dq", "_vel", "_velocity"), 2: ("_qdd", "_ddq", "_acc", "_acceleration")
}  # fmt: skip
"""Endings of columns with a joint's velocity and acceleration."""
BEYOND = 1.0
"""rad: beyond a joint's limits by so much is no rounding and no loose model, but another unit or another joint."""
# Hinges without limits: people's joints turn less than one turn.
_WITHOUT_LIMITS = 2.0 * np.pi
_UNLIMITED = 100.0


@dataclass(frozen=True, eq=False)
class JointTable:
    """Columns of a motion.

    Attributes
    ----------
    path : Path
    t : ndarray, shape (n,)
        s.
    used : list of str
        Hinges that have a column.
    angles : ndarray, shape (n, len(used))
        rad or m.
    position, quaternion : ndarray
        (n, 3) m and (n, 4) ``[w, x, y, z]`` of the root; empty for a fixed one.
    derivatives : dict of int to ndarray (n, len(used))
        Velocities (1) and accelerations (2) of those hinges, where the file has them for all.
    """

    path: Path
    t: FloatArray
    used: list[str]
    angles: FloatArray
    position: FloatArray
    quaternion: FloatArray
    derivatives: Mapping[int, FloatArray]


def read_joint_table(
    model: Any,
    floating: bool,
    motion: Mapping[str, Any],
    base_dir: Path,
    span: Callable[[FloatArray, Mapping[str, Any]], BoolArray],
) -> JointTable:
    """The columns that [motion] names.

    Raises
    ------
    InputError
        For columns that are missing, and for values that a unit other than rad, m or s would explain.
    """
    where = "[motion]"
    joints = _hinges(model)
    renamed = {key: str(value) for key, value in sub_table(motion, "columns").items()}
    base = (*POSITION, *QUATERNION) if floating else ()
    known = [*joints, *base]
    for key in renamed:
        if key not in known:
            raise InputError(
                "[motion.columns] " + key, "a joint of the model", "none", close_matches(key, known)
            )
    others = get(motion, "others", Literal["required", "zero"], where, "required")
    path = base_dir / get(motion, "file", str, where)
    t, columns = read_columns(path, motion)
    numbered = {name: f"q{k}" for k, name in enumerate(joints, start=1)}
    if "q1" in columns and not set(joints) & set(columns):
        renamed = {**numbered, **renamed}
        if f"q{len(joints) + 1}" in columns:
            raise InputError(
                f"{path}: columns",
                f"q1 to q{len(joints)}, one a joint of the model",
                f"q{len(joints) + 1}, too",
            )
    wanted = {name: renamed.get(name, name) for name in known}
    missing = [name for name, column in wanted.items() if column not in columns]
    needed = [name for name in missing if others == "required" or name in base or name in renamed]
    if needed:
        listed = ", ".join(wanted[name] for name in needed[:8]) + (" ..." if len(needed) > 8 else "")
        hint = (
            'Joints that do not move need no column with others = "zero"' if set(needed) - set(base) else ""
        )
        there = ", ".join(list(columns)[:8]) + (" ..." if len(columns) > 8 else "")
        raise InputError(
            f"{path}: columns",
            "one for every joint of the model",
            f"{len(needed)} missing: {listed}; there are {there}",
            hint,
        )
    used = [name for name in joints if name not in missing]
    if not floating and not used:
        raise InputError(f"{path}: columns", "joints among " + ", ".join(joints), "none of them")
    if t.size < 2:
        raise InputError("[motion]", "at least two frames", str(t.size))
    if (np.diff(t) <= 0.0).any():
        row = int(np.argmax(np.diff(t) <= 0.0)) + 1
        raise InputError(
            f"{path}: column t",
            "increasing times",
            f"{t[row]:.6g} s after {t[row - 1]:.6g} s in row {row + 1}",
        )
    check_stamps(t, path)
    keep = span(t, motion)
    t = t[keep]
    if t.size < 2:
        raise InputError("[motion]", "at least two frames", str(t.size))

    def part(names: list[str]) -> FloatArray:
        return np.column_stack([columns[name][keep] for name in names]) if names else np.zeros((t.size, 0))

    angles = part([wanted[name] for name in used])
    for k, name in enumerate(used):
        if np.isfinite(angles[:, k]).sum() < 2:
            raise InputError(f"{path}: column {wanted[name]}", "at least two numbers", "gaps everywhere")
        _check_angles(model, name, angles[:, k], f"{path}: {wanted[name]}")
    position, quaternion = (
        part([wanted[name] for name in group if floating]) for group in (POSITION, QUATERNION)
    )
    if floating:
        if np.isfinite(position).all(axis=1).sum() < 2 or np.isfinite(quaternion).all(axis=1).sum() < 2:
            raise InputError(
                f"{path}: px, py, pz, qw, qx, qy, qz", "at least two poses of the root", "gaps everywhere"
            )
        _check_position(position, f"{path}: px, py, pz")
    derivatives = {}
    for order, endings in DERIVATIVES.items():
        names = [_derivative(wanted[name], order, endings, columns) for name in used]
        found = [name for name in names if name is not None]
        if found and len(found) < len(used):
            lost = wanted[used[names.index(None)]]
            raise InputError(f"{path}: columns", f"{lost}{endings[0]}, as other joints have one", "none")
        if found:
            derivatives[order] = part(found)
    if 2 in derivatives and 1 not in derivatives:
        raise InputError(f"{path}: columns", "velocities beside the accelerations", "none")
    return JointTable(path, t, used, angles, position, quaternion, derivatives)


def check_stamps(t: FloatArray, path: Path) -> None:
    """Refuse stamps that look like milliseconds; the hint is one for files."""
    try:
        check_rate(float(np.median(np.diff(t))), f"{path}: column t")
    except InputError as error:
        raise InputError(
            error.field, error.expected, error.found, "Declare the unit in the file's header (t [ms], t [ns])"
        ) from error


def _check_position(position: FloatArray, field: str) -> None:
    try:
        check_position(position, field)
    except InputError as error:
        raise InputError(
            error.field, error.expected, error.found, "Declare [mm] in the file's header"
        ) from error


def _derivative(
    column: str, order: int, endings: tuple[str, ...], columns: Mapping[str, FloatArray]
) -> str | None:
    names = [column + ending for ending in endings]
    if column.startswith("q") and column[1:].isdigit():
        names.append({1: "qd", 2: "qdd"}[order] + column[1:])
        names.append({1: "dq", 2: "ddq"}[order] + column[1:])
    return next((name for name in names if name in columns), None)


def _check_angles(model: Any, name: str, values: FloatArray, field: str) -> None:
    joint = model.joints[model.getJointId(name)]
    if "P" in joint.shortname().removeprefix("JointModel")[:1]:
        return
    k = int(joint.idx_q)
    low, high = float(model.lowerPositionLimit[k]), float(model.upperPositionLimit[k])
    if not -_UNLIMITED < low < high < _UNLIMITED:
        low, high = -_WITHOUT_LIMITS, _WITHOUT_LIMITS
    good = values[np.isfinite(values)]
    beyond = (good < low - BEYOND) | (good > high + BEYOND)
    if beyond.any():
        worst = float(good[np.argmax(np.abs(good))])
        raise InputError(
            field,
            f"rad, within {low:.4g} to {high:.4g} rad",
            f"{worst:.4g}"
            + (
                f": degrees suspected ({worst:.4g} deg = {np.deg2rad(worst):.4g} rad)"
                if abs(worst) > np.pi
                else ""
            ),
            "Convert with numpy.deg2rad, or declare [deg] in the file's header",
        )


def _hinges(model: Any) -> list[str]:
    out = []
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        if joint.nq == 1:
            out.append(str(name))
        elif joint.shortname() != "JointModelFreeFlyer":
            raise InputError(
                "[model] urdf",
                "joints of one coordinate each (revolute or prismatic)",
                f"{name}: {joint.shortname()}",
            )
    return out


def read_columns(
    path: Path, motion: Mapping[str, Any], lengths: Sequence[str] = ()
) -> tuple[FloatArray, Mapping[str, FloatArray]]:
    """Times and columns of a table, or of an OpenSim storage in which `lengths` and the `translations` of [motion] are no angles."""
    if path.suffix.lower() in (".mot", ".sto"):
        stated = get(motion, "translations", tuple[str, ...], "[motion]", ())
        # A unit quaternion has no unit: its columns are no angles.
        table = read_coordinates(path, (*stated, *lengths, *POSITION, *QUATERNION))
        return table.t, {name: table.values[:, k] for k, name in enumerate(table.names)}
    if "translations" in motion:
        raise InputError("[motion] translations", "a .mot or .sto file", path.name)
    names = column_names(path)
    clock = next((name for name in ("t", "time", "Time") if name in names), None)
    if clock is None:
        raise InputError(f"{path}: columns", "t and the joints of the model", ", ".join(names))
    columns = read_table(path)
    return columns[clock], columns

"""[model] and [motion] of a human-dynamics file: which body, and how it moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.anthropometry import Sex
from factorgrasp.models.human import human_body, load_body
from factorgrasp.models.joint_motion import differentiate_configurations
from factorgrasp.problems.human_dynamics_settings import PerName
from factorgrasp.problems.link_motion import GRAVITY, LinkMotion
from factorgrasp.problems.link_motion_files import load_links
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.recordings.opensim import read_coordinates
from factorgrasp.recordings.tables import column_names, read_table
from factorgrasp.signals import resample_rotations, resample_uniform
from factorgrasp.toml_tables import check_keys, close_matches, get, place, sub_table
from factorgrasp.typing import BoolArray, FloatArray

Vector = tuple[float, float, float]

_POSITION, _QUATERNION = ("px", "py", "pz"), ("qw", "qx", "qy", "qz")
# Ground of link archives (OpenSim): y up.
_GRAVITY_Y_UP: Vector = (0.0, -9.80665, 0.0)


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """A motion on its clock.

    Attributes
    ----------
    clock : ndarray, shape (n,)
        s, all frames.
    good : ndarray, shape (n,)
        Frames in which the whole motion is known; the others are gaps.
    motion : LinkMotion
        Of the good frames.
    variances : dict
        `joint_acceleration` and `link_acceleration` of :class:`HumanDynamicsNoise`, as far as they follow from the stated noise of angles
        and pose through the filter that differentiated them.
    """

    clock: FloatArray
    good: BoolArray
    motion: LinkMotion
    variances: Mapping[str, PerName] = field(default_factory=dict)


def read_body_motion(table: Mapping[str, Any], base_dir: Path) -> BodyMotion:
    """The motion that [model] and [motion] describe.

    Raises
    ------
    InputError
        Naming the table and key, or the file and column.
    """
    model = sub_table(table, "model", required=True)
    ways = [key for key in ("links", "urdf", "height") if key in model]
    if len(ways) != 1:
        raise InputError(
            "[model]",
            "one of: links (a motion file), urdf, or height with mass and sex",
            " and ".join(ways) or "none of them",
        )
    if ways[0] == "links":
        return _from_links(model, sub_table(table, "motion"), base_dir)
    motion = sub_table(table, "motion", required=True)
    if ways[0] == "urdf":
        check_keys(model, ("urdf", "base", "gravity"), "[model]")
        base = get(model, "base", Literal["floating", "fixed"], "[model]", "floating")
        pin_model = load_body(base_dir / get(model, "urdf", str, "[model]"), base == "floating")
    else:
        check_keys(model, ("height", "mass", "sex", "gravity"), "[model]")
        base = "floating"
        sex: Sex = get(model, "sex", Sex, "[model]")
        try:
            body = human_body(
                get(model, "height", float, "[model]"), get(model, "mass", float, "[model]"), sex
            )
        except InputError as error:
            raise InputError(
                place("[model]", error.field), error.expected, error.found, error.hint
            ) from error
        pin_model = body.model()
    gravity = get(model, "gravity", Vector, "[model]", GRAVITY)
    return _from_joints(pin_model, base == "floating", gravity, motion, base_dir)


def _from_links(model: Mapping[str, Any], motion: Mapping[str, Any], base_dir: Path) -> BodyMotion:
    check_keys(model, ("links", "gravity", "ball_joints"), "[model]")
    check_keys(motion, ("start", "end", "every"), "[motion]")
    path = base_dir / get(model, "links", str, "[model]")
    if not path.is_file():
        raise InputError("[model] links", "an archive of link-level arrays (.npz)", f"no file {path}")
    gravity = get(model, "gravity", Vector, "[model]", _GRAVITY_Y_UP)
    read = load_links(path, gravity, get(model, "ball_joints", tuple[str, ...], "[model]", ()))
    keep = _span(read.t, motion)
    every = get(motion, "every", int, "[motion]", 1)
    if every < 1:
        raise InputError("[motion] every", "a whole number above 0", str(every))
    read = read.select(np.flatnonzero(keep)[::every])
    finite = np.ones(len(read), dtype=bool)
    for name in (
        "R",
        "p",
        "velocity",
        "angular_velocity",
        "acceleration",
        "angular_acceleration",
        "joint_centre",
    ):
        finite &= np.isfinite(getattr(read, name)).all(axis=tuple(range(1, getattr(read, name).ndim)))
    return _known(read.t, finite, read)


def _known(
    clock: FloatArray, good: BoolArray, motion: LinkMotion, variances: Mapping[str, PerName] | None = None
) -> BodyMotion:
    if not good.any():
        raise InputError(
            "[motion]", "at least one frame in which all of the motion is known", "gaps everywhere"
        )
    return BodyMotion(
        clock, good, motion.select(good) if len(motion) == good.size else motion, variances or {}
    )


def _span(t: FloatArray, motion: Mapping[str, Any]) -> BoolArray:
    start = get(motion, "start", float, "[motion]", -np.inf)
    end = get(motion, "end", float, "[motion]", np.inf)
    keep: BoolArray = np.asarray((t >= start) & (t <= end))
    if not keep.any():
        raise InputError(
            "[motion] start, end", f"times within {t[0]:.6g} to {t[-1]:.6g} s", f"{start:g} to {end:g} s"
        )
    return keep


_JOINT_KEYS = (
    "file", "columns", "translations", "rate", "bandwidth", "others", "angle_sd", "position_sd", "orientation_sd",
    "start", "end", "max_gap",
)  # fmt: skip


def _from_joints(
    model: Any, floating: bool, gravity: Vector, motion: Mapping[str, Any], base_dir: Path
) -> BodyMotion:
    """Joint angles (and the pose of the root) over time, differentiated."""
    check_keys(motion, _JOINT_KEYS, "[motion]")
    where = "[motion]"
    joints = _hinges(model)
    renamed = {key: str(value) for key, value in sub_table(motion, "columns").items()}
    base = (*_POSITION, *_QUATERNION) if floating else ()
    known = [*joints, *base]
    for key in renamed:
        if key not in known:
            raise InputError(
                "[motion.columns] " + key, "a joint of the model", "none", close_matches(key, known)
            )
    others = get(motion, "others", Literal["required", "zero"], where, "required")
    path = base_dir / get(motion, "file", str, where)
    t, columns = _columns(path, motion)
    wanted = {name: renamed.get(name, name) for name in known}
    missing = [name for name, column in wanted.items() if column not in columns]
    needed = [name for name in missing if others == "required" or name in base or name in renamed]
    if needed:
        listed = ", ".join(wanted[name] for name in needed[:8]) + (" ..." if len(needed) > 8 else "")
        hint = (
            'Joints that do not move need no column with others = "zero"' if set(needed) - set(base) else ""
        )
        raise InputError(
            f"{path}: columns", "one for every joint of the model", f"{len(needed)} missing: {listed}", hint
        )
    if not floating and len(missing) == len(joints):
        raise InputError(f"{path}: columns", "joints among " + ", ".join(joints), "none of them")
    used = [name for name in joints if name not in missing]
    keep = _span(t, motion)
    t = t[keep]
    if t.size < 2:
        raise InputError("[motion]", "at least two frames", str(t.size))
    angles = (
        np.column_stack([columns[wanted[name]][keep] for name in used]) if used else np.zeros((t.size, 0))
    )
    rate = get(motion, "rate", float, where, float(1.0 / np.median(np.diff(t))))
    if rate <= 0.0:
        raise InputError("[motion] rate", "a rate above 0 Hz", f"{rate:g}")
    dt = 1.0 / rate
    max_gap = get(motion, "max_gap", float, where, None)
    clock, uniform = resample_uniform(t, angles, dt, max_gap=max_gap, kind="cubic")
    q = np.zeros((clock.size, model.nq))
    q[:, [int(model.joints[model.getJointId(name)].idx_q) for name in used]] = uniform
    if floating:
        position = np.column_stack([columns[wanted[name]][keep] for name in _POSITION])
        quaternion = np.column_stack([columns[wanted[name]][keep] for name in _QUATERNION])
        unit = _unit(quaternion, path)
        q[:, :3] = resample_uniform(t, position, clock, max_gap=max_gap, kind="cubic")[1]
        q[:, 3:7] = np.roll(resample_rotations(t, unit, clock, max_gap=max_gap, kind="cubic")[1], -1, axis=1)
    try:
        moved = differentiate_configurations(model, q, dt, get(motion, "bandwidth", float, where, 6.0))
    except InputError as error:
        raise InputError(f"[motion] {error.field}", error.expected, error.found, error.hint) from error
    good = moved.good
    if not good.any():
        raise InputError(
            "[motion]", "a stretch without gaps that is longer than the filter of the derivatives", "none"
        )
    tree = PinocchioTree(model, gravity=gravity)
    variances: dict[str, PerName] = {}
    if (angle := get(motion, "angle_sd", float, where, None)) is not None:
        variances["joint_acceleration"] = _variance(angle, "angle_sd") * moved.acceleration_gain
    position, turn = (get(motion, key, float, where, None) for key in ("position_sd", "orientation_sd"))
    if (position is None) != (turn is None):
        raise InputError("[motion] position_sd, orientation_sd", "both or none", "one of them")
    if position is not None:
        parts = _variance(position, "position_sd"), _variance(turn, "orientation_sd")
        variances["link_acceleration"] = tuple(moved.acceleration_gain * v for v in parts for _ in range(3))
    return _known(
        clock, good, tree.motion(clock[good], moved.q[good], moved.qd[good], moved.qdd[good]), variances
    )


def _variance(sd: float, key: str) -> float:
    if sd <= 0.0:
        raise InputError(f"[motion] {key}", "a standard deviation above 0", f"{sd:g}")
    return sd**2


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


def _columns(path: Path, motion: Mapping[str, Any]) -> tuple[FloatArray, Mapping[str, FloatArray]]:
    suffix = path.suffix.lower()
    if suffix == ".trc":
        raise InputError(
            f"[motion] file {path.name}",
            "joint angles over time",
            "markers",
            "Inverse kinematics has to come first",
        )
    if suffix in (".mot", ".sto"):
        lengths = get(motion, "translations", tuple[str, ...], "[motion]", ())
        # A unit quaternion has no unit: its columns are no angles.
        table = read_coordinates(path, (*lengths, *_POSITION, *_QUATERNION))
        return table.t, {name: table.values[:, k] for k, name in enumerate(table.names)}
    if "translations" in motion:
        raise InputError("[motion] translations", "a .mot or .sto file", path.name)
    if "t" not in column_names(path):
        raise InputError(f"{path}: columns", "t and the joints of the model", ", ".join(column_names(path)))
    columns = read_table(path)
    return columns["t"], columns


def _unit(q: FloatArray, path: Path) -> FloatArray:
    norm = np.linalg.norm(q, axis=1)
    off = np.abs(norm - 1.0) > 1e-2
    if off.any():
        raise InputError(
            f"{path}: qw, qx, qy, qz",
            "unit quaternions",
            f"norm {norm[off][0]:.4g} in {int(off.sum())} row(s)",
        )
    return lie.continuous_quaternions(q / norm[:, None])

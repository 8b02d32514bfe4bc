"""[model] and [motion] of a human-dynamics file: which body, and how it moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.human_dynamics_joint_table import read_joint_table
from factorgrasp.human_dynamics_osim import read_osim_motion
from factorgrasp.models.anthropometry import Sex
from factorgrasp.models.human import HumanBody, human_body, load_body
from factorgrasp.models.joint_motion import differentiate_configurations
from factorgrasp.models.osim import OsimModel, read_osim
from factorgrasp.problems.human_dynamics_settings import PerName
from factorgrasp.problems.link_motion import GRAVITY, LinkMotion
from factorgrasp.problems.link_motion_files import is_link_archive, load_links, with_masses_of
from factorgrasp.problems.link_motion_osim import from_osim
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.recordings.links import read_link_coordinates
from factorgrasp.signals import resample_rotations, resample_uniform
from factorgrasp.toml_tables import check_keys, get, place, sub_table
from factorgrasp.typing import BoolArray, FloatArray

Vector = tuple[float, float, float]

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
    forces : Path or None
        The archive that the motion is from, which may hold forces, too.
    extras : dict of str to ndarray
        Over all frames of the clock, for ``estimate.npz``: the configuration, where it was estimated.
    """

    clock: FloatArray
    good: BoolArray
    motion: LinkMotion
    variances: Mapping[str, PerName] = field(default_factory=dict)
    forces: Path | None = None
    extras: Mapping[str, Any] = field(default_factory=dict)


def read_body_motion(table: Mapping[str, Any], base_dir: Path) -> BodyMotion:
    """The motion that [model] and [motion] describe.

    Raises
    ------
    InputError
        Naming the table and key, or the file and column.
    """
    motion = sub_table(table, "motion")
    file = base_dir / get(motion, "file", str, "[motion]") if "file" in motion else None
    archive = file is not None and is_link_archive(file)
    model = sub_table(table, "model", required=not archive)
    ways = [key for key in ("links", "urdf", "osim", "height") if key in model]
    if len(ways) > 1 or (not ways and not archive):
        raise InputError(
            "[model]",
            "one of: links (a motion file), urdf, osim, or height with mass and sex",
            " and ".join(ways) or "none of them",
        )
    if not ways or ways[0] == "links":
        return _from_links(model, motion, base_dir)
    motion = sub_table(table, "motion", required=True)
    if ways[0] == "osim":
        return _from_osim(model, motion, base_dir)
    pin_model, base, body = read_model(model, base_dir)
    gravity = get(model, "gravity", Vector, "[model]", _GRAVITY_Y_UP if archive else GRAVITY)
    assert file is not None or "file" not in motion
    if file is not None and (archive or file.suffix.lower() == ".trc"):
        if base == "fixed":
            raise InputError(
                "[model] base", '"floating", as the body is seen to move in the world', '"fixed"'
            )
        from factorgrasp.human_dynamics_markers import from_observations
        from factorgrasp.human_dynamics_state_noise import state_noise

        state, variances = from_observations(pin_model, body, motion, file, base_dir, gravity)
        tree = PinocchioTree(pin_model, gravity=gravity)
        good = state.good
        found = tree.motion(state.t[good], state.q[good], state.qd[good], state.qdd[good])
        found = found.with_state_noise(state_noise(state, tree))
        names = np.array([str(name) for name in list(pin_model.names)[2:]])
        extras = {"q": state.q, "q_sd": np.sqrt(state.q_variance), "q_names": names}
        return _known(state.t, good, found, variances, file if archive else None, extras)
    return _from_joints(pin_model, base == "floating", gravity, motion, base_dir)


def read_model(model: Mapping[str, Any], base_dir: Path) -> tuple[Any, str, HumanBody | None]:
    """The ``pinocchio.Model`` of [model], "floating" or "fixed", and the body where it is the one from a person's size."""
    if "urdf" in model:
        check_keys(model, ("urdf", "base", "gravity"), "[model]")
        base = get(model, "base", Literal["floating", "fixed"], "[model]", "floating")
        return load_body(base_dir / get(model, "urdf", str, "[model]"), base == "floating"), base, None
    check_keys(model, ("height", "mass", "sex", "gravity"), "[model]")
    sex: Sex = get(model, "sex", Sex, "[model]")
    try:
        body = human_body(get(model, "height", float, "[model]"), get(model, "mass", float, "[model]"), sex)
    except InputError as error:
        raise InputError(place("[model]", error.field), error.expected, error.found, error.hint) from error
    return body.model(), "floating", body


def _from_osim(model: Mapping[str, Any], motion: Mapping[str, Any], base_dir: Path) -> BodyMotion:
    check_keys(model, ("osim", "gravity"), "[model]")
    osim = read_osim(base_dir / get(model, "osim", str, "[model]"))
    file = base_dir / get(motion, "file", str, "[motion]")
    gravity = np.array(get(model, "gravity", Vector, "[model]", tuple(float(x) for x in osim.gravity)))
    if file.suffix.lower() == ".trc":
        from factorgrasp.human_dynamics_markers import from_observations

        x, y, z = (float(v) for v in gravity)
        state, variances = from_observations(osim, None, motion, file, base_dir, (x, y, z))
        good = state.good
        found = from_osim(osim, state.t[good], state.q[good], state.qd[good], state.qdd[good], gravity)
        extras = {"q": state.q, "q_sd": np.sqrt(state.q_variance), "q_names": np.array(osim.names)}
        return _known(state.t, good, found, variances, None, extras)
    if is_link_archive(file):
        return _osim_archive(osim, motion, file, gravity)
    read = read_osim_motion(osim, motion, file, gravity)
    return _known(read.clock, read.good, read.motion, read.variances)


def _osim_archive(osim: OsimModel, motion: Mapping[str, Any], file: Path, gravity: FloatArray) -> BodyMotion:
    """Coordinates with their derivatives from an archive of link-level arrays: nothing is filtered."""
    check_keys(motion, ("file", "start", "end", "every", "grf"), "[motion]")
    table, qd, qdd = read_link_coordinates(file)
    missing = [
        c.name
        for c in osim.coordinates
        if c.name not in table.names and not c.locked and c.name not in osim.coupled
    ]
    if missing:
        raise InputError(
            f"{file.name}: names", "the coordinates of the model", ", ".join(missing) + " missing"
        )
    every = get(motion, "every", int, "[motion]", 1)
    if every < 1:
        raise InputError("[motion] every", "a whole number above 0", str(every))
    rows = np.flatnonzero(_span(table.t, motion))[::every]
    parts = []
    for order, values in enumerate((table.values, qd, qdd)):
        columns = [
            values[rows, table.names.index(c.name)]
            if c.name in table.names
            else np.full(rows.size, 0.0 if order else c.default)
            for c in osim.coordinates
        ]
        parts.append(np.column_stack(columns))
    good: BoolArray = np.asarray(np.isfinite(np.concatenate(parts, axis=1)).all(axis=1))
    if not good.any():
        raise InputError("[motion]", "at least one frame without gaps", "none")
    q, v, a = (part[good] for part in parts)
    clock = table.t[rows]
    forces = file if get(motion, "grf", bool, "[motion]", True) else None
    return _known(clock, good, from_osim(osim, clock[good], q, v, a, gravity), forces=forces)


def _from_links(model: Mapping[str, Any], motion: Mapping[str, Any], base_dir: Path) -> BodyMotion:
    check_keys(model, ("links", "gravity", "ball_joints"), "[model]")
    check_keys(motion, ("file", "start", "end", "every", "grf"), "[motion]")
    own = base_dir / get(model, "links", str, "[model]") if "links" in model else None
    path = base_dir / get(motion, "file", str, "[motion]") if "file" in motion else own
    assert path is not None
    for key, file in (("[model] links", own), ("[motion] file", path)):
        if file is not None and not file.is_file():
            raise InputError(key, "an archive of link-level arrays (.npz)", f"no file {file}")
    if not is_link_archive(path):
        raise InputError(
            "[motion] file", "an archive of link-level arrays (.npz), as [model] is one", path.name,
            "Joint angles and markers need a model with joints: urdf, osim, or height with mass and sex",
        )  # fmt: skip
    gravity = get(model, "gravity", Vector, "[model]", _GRAVITY_Y_UP)
    read = load_links(path, gravity, get(model, "ball_joints", tuple[str, ...], "[model]", ()))
    if own is not None and own != path:
        read = with_masses_of(read, own)
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
    return _known(read.t, finite, read, forces=path if get(motion, "grf", bool, "[motion]", True) else None)


def _known(
    clock: FloatArray,
    good: BoolArray,
    motion: LinkMotion,
    variances: Mapping[str, PerName] | None = None,
    forces: Path | None = None,
    extras: Mapping[str, Any] | None = None,
) -> BodyMotion:
    if not good.any():
        raise InputError(
            "[motion]", "at least one frame in which all of the motion is known", "gaps everywhere"
        )
    known = motion.select(good) if len(motion) == good.size and not good.all() else motion
    return BodyMotion(clock, good, known, variances or {}, forces, extras or {})


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
    read = read_joint_table(model, floating, motion, base_dir, _span)
    t, used, path = read.t, read.used, read.path
    rate = get(motion, "rate", float, where, float(1.0 / np.median(np.diff(t))))
    if rate <= 0.0:
        raise InputError("[motion] rate", "a rate above 0 Hz", f"{rate:g}")
    dt = 1.0 / rate
    max_gap = get(motion, "max_gap", float, where, None)
    clock, uniform = resample_uniform(t, read.angles, dt, max_gap=max_gap, kind="cubic")
    q = np.zeros((clock.size, model.nq))
    q[:, [int(model.joints[model.getJointId(name)].idx_q) for name in used]] = uniform
    if floating:
        unit = _unit(read.quaternion, path)
        q[:, :3] = resample_uniform(t, read.position, clock, max_gap=max_gap, kind="cubic")[1]
        q[:, 3:7] = np.roll(resample_rotations(t, unit, clock, max_gap=max_gap, kind="cubic")[1], -1, axis=1)
    given = {
        order: resample_uniform(t, values, clock, max_gap=max_gap, kind="linear")[1]
        for order, values in read.derivatives.items()
    }
    if len(given) == 2 and not floating:
        return _as_given(model, gravity, clock, q, given, used, motion)
    try:
        moved = differentiate_configurations(model, q, dt, get(motion, "bandwidth", float, where, 6.0))
    except InputError as error:
        raise InputError(f"[motion] {error.field}", error.expected, error.found, error.hint) from error
    at = [int(model.joints[model.getJointId(name)].idx_v) for name in used]
    for order, into in ((1, moved.qd), (2, moved.qdd)):
        if order in given:
            into[:, at] = np.where(np.isfinite(into[:, at]), given[order], np.nan)
    whole = np.isfinite(moved.qd).all(axis=1) & np.isfinite(moved.qdd).all(axis=1)
    good: BoolArray = np.asarray(moved.good & whole)
    if not good.any():
        raise InputError(
            "[motion]", "a stretch without gaps that is longer than the filter of the derivatives", "none"
        )
    tree = PinocchioTree(model, gravity=gravity)
    # Noise of a slower source has the same density in the filter's band, which white noise of the faster clock must have.
    denser = max(1.0, float(np.median(np.diff(t))) / dt)
    gain = denser * moved.acceleration_gain
    variances: dict[str, PerName] = {}
    if (angle := get(motion, "angle_sd", float, where, None)) is not None:
        variances["joint_acceleration"] = _variance(angle, "angle_sd") * gain
    position, turn = (get(motion, key, float, where, None) for key in ("position_sd", "orientation_sd"))
    if (position is None) != (turn is None):
        raise InputError("[motion] position_sd, orientation_sd", "both or none", "one of them")
    if position is not None:
        parts = _variance(position, "position_sd"), _variance(turn, "orientation_sd")
        variances["link_acceleration"] = tuple(gain * v for v in parts for _ in range(3))
    found = tree.motion(clock[good], moved.q[good], moved.qd[good], moved.qdd[good])
    if angle is not None and not given and (position is not None or not floating):
        # Poses are as noisy as they are stated to be: lever arms and directions with them.
        sd = np.full(model.nv, angle)
        if floating:
            sd[:3], sd[3:6] = position, turn
        found = found.with_state_noise(moved.state_noise(denser * sd[tree.tangent_columns] ** 2))
    return _known(clock, good, found, variances)


def _as_given(
    model: Any,
    gravity: Vector,
    clock: FloatArray,
    q: FloatArray,
    given: Mapping[int, FloatArray],
    used: list[str],
    motion: Mapping[str, Any],
) -> BodyMotion:
    """Velocities and accelerations as the recording has them: nothing is filtered."""
    for key in ("bandwidth", "angle_sd"):
        if key in motion:
            raise InputError(
                f"[motion] {key}",
                "positions that are to be differentiated",
                "velocities and accelerations are given",
            )
    at = [int(model.joints[model.getJointId(name)].idx_v) for name in used]
    qd, qdd = np.zeros((clock.size, model.nv)), np.zeros((clock.size, model.nv))
    qd[:, at], qdd[:, at] = given[1], given[2]
    good: BoolArray = np.asarray(
        np.isfinite(q).all(axis=1) & np.isfinite(qd).all(axis=1) & np.isfinite(qdd).all(axis=1)
    )
    if not good.any():
        raise InputError("[motion]", "at least one frame without gaps", "none")
    tree = PinocchioTree(model, gravity=gravity)
    return _known(clock, good, tree.motion(clock[good], q[good], qd[good], qdd[good]))


def _variance(sd: float, key: str) -> float:
    if sd <= 0.0:
        raise InputError(f"[motion] {key}", "a standard deviation above 0", f"{sd:g}")
    return sd**2


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

"""[motion] from markers (.trc) or from the poses of segments: the state of the body is estimated first (mathematics 4.3)."""

from __future__ import annotations

import tomllib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.body_state import MAX_GAP, POSTURE_SD, BodyState, estimate_state, solve_posture
from factorgrasp.errors import InputError
from factorgrasp.human_dynamics_joint_table import check_stamps
from factorgrasp.human_dynamics_state_noise import acceleration_variances
from factorgrasp.models.human import HumanBody, configuration
from factorgrasp.models.osim import OsimModel
from factorgrasp.problems.body_observations import BodyObservations, Placement, poses_only
from factorgrasp.problems.human_dynamics_settings import PerName
from factorgrasp.problems.link_motion_files import link_poses
from factorgrasp.problems.observed_osim import observed
from factorgrasp.recordings.opensim import MarkerRecording, read_osim_markers, read_trc
from factorgrasp.signals import resample_rotations, resample_uniform
from factorgrasp.toml_tables import check_keys, close_matches, convert, get, place, sub_table
from factorgrasp.typing import BoolArray, FloatArray

MARKER_SD = 0.003
"""m, of one coordinate of a marker, where the file does not say: camera, skin and placement together."""
_COMMON = ("file", "start", "end", "rate", "bandwidth", "posture", "posture_sd", "max_gap")
_MARKERS = (*_COMMON, "markers", "marker_sd", "static", "static_posture", "static_posture_sd")
_POSES = (*_COMMON, "bodies", "position_sd", "orientation_sd", "grf")
_FITS = 3.0
Vector = tuple[float, float, float]
Stated = dict[str, tuple[str, Vector | None, float | None]]
"""Marker to its link, its position there (m) and its sd (m), as far as they are said."""


def from_observations(
    model: Any, body: HumanBody | None, motion: Mapping[str, Any], file: Path, base_dir: Path, gravity: Vector
) -> tuple[BodyState, dict[str, PerName]]:
    """The state of the body and the variances of its accelerations.

    Parameters
    ----------
    model : pinocchio.Model or OsimModel
    body : HumanBody or None
        Its own markers are known by name, as those of an OpenSim model are.
    motion : mapping
        The table [motion].
    file : Path
        A .trc file or an archive of link-level arrays.
    base_dir : Path
    gravity : tuple
        In the world of the recording.

    Raises
    ------
    InputError
        Naming the key, or the file and what it lacks.
    """
    if file.suffix.lower() == ".trc":
        check_keys(motion, _MARKERS, "[motion]")
        own: Stated = {}
        if isinstance(model, OsimModel):
            own = {name: (link, _vector(point), None) for name, (link, point) in model.markers.items()}
        elif body is not None:
            own = {name: (link, _vector(point), None) for name, (link, point) in body.markers.items()}
        observations, t = _markers(model, own, motion, file, base_dir)
    else:
        check_keys(motion, _POSES, "[motion]")
        observations, t = _poses(model, motion, file)
    posture = _posture(model, motion, "posture")
    bandwidth = get(motion, "bandwidth", float, "[motion]", None)
    if bandwidth is not None and bandwidth <= 0.0:
        raise InputError("[motion] bandwidth", "above 0 Hz", f"{bandwidth:g}")
    state = estimate_state(
        model, t, observations, posture=posture, bandwidth=bandwidth,
        posture_sd=_positive(motion, "posture_sd", POSTURE_SD), max_gap=_positive(motion, "max_gap", MAX_GAP),
    )  # fmt: skip
    _say_how_it_fits(state, file)
    _check_upright(model, state, gravity)
    return state, acceleration_variances(model, state)


# ---- what was seen ------------------------------------------------------------------------------------------------


def _markers(
    model: Any, own: Stated, motion: Mapping[str, Any], file: Path, base_dir: Path
) -> tuple[BodyObservations, FloatArray]:
    seen = read_trc(file)
    check_stamps(seen.t, file)
    stated = _placements(motion, own, base_dir)
    at = _matched(stated, seen, file)
    sd = _positive(motion, "marker_sd", MARKER_SD)
    names = list(at)
    loose = [name for name in names if stated[name][1] is None]
    placement = Placement(
        tuple(names),
        tuple(stated[name][0] for name in names),
        np.array([stated[name][1] or (0.0, 0.0, 0.0) for name in names], dtype=float).reshape(-1, 3),
        np.array([stated[name][2] or sd for name in names]),
    )
    if "static" in motion:
        placement = _calibrated(model, placement, loose, motion, seen, at, file, base_dir)
    elif loose:
        raise InputError(
            f"[motion.markers] {loose[0]}", "a position in the frame of its link (m)", "none",
            "Or say static = a .trc file (or [start, end] in this one) in which the posture is known",
        )  # fmt: skip
    t, position = _uniform(seen.t, seen.position[:, list(at.values())], motion)
    return BodyObservations(placement, position), t


def _matched(stated: Mapping[str, Any], seen: MarkerRecording, file: Path) -> dict[str, int]:
    """Marker to its index in the recording; names may differ in case and by a subject's prefix (``Subject:RASI``)."""
    plain = {name.rpartition(":")[2].lower(): k for k, name in reversed(list(enumerate(seen.names)))}
    at = {name: plain[name.lower()] for name in stated if name.lower() in plain}
    if len(at) < 3:
        raise InputError(
            f"{file}: markers",
            "at least three of " + ", ".join(list(stated)[:12]),
            ", ".join(seen.names[:12]) + " ...",
        )
    missing = [name for name in stated if name not in at]
    if missing:
        warnings.warn(
            f"{file.name} has no marker {', '.join(missing[:8])}{' ...' if len(missing) > 8 else ''}: without it",
            UserWarning,
            stacklevel=2,
        )
    return at


def _placements(motion: Mapping[str, Any], own: Stated, base_dir: Path) -> Stated:
    """Marker to its link, its position there, and its sd, from [motion.markers] or from a file."""
    value = motion.get("markers")
    where = "[motion.markers]"
    if value is None:
        if not own:
            raise InputError(
                "[motion] markers", "where markers sit: a table, or a .toml or .osim file", "no such key"
            )
        return own
    if isinstance(value, str):
        path = base_dir / value
        where = path.name
        if path.suffix.lower() == ".osim":
            return {m.name: (m.link, m.position, None) for m in read_osim_markers(path)}
        if not path.is_file():
            raise InputError("[motion] markers", "a .toml or .osim file", f"no file {path}")
        try:
            value = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(f"[motion] markers: {path}", "a TOML file", str(error)) from error
        value = value.get("markers", value)
    if not isinstance(value, Mapping) or not value:
        raise InputError("[motion] markers", "a table, or a .toml or .osim file", repr(value))
    out: Stated = {}
    for name, one in value.items():
        if isinstance(one, str):
            out[name] = (one, None, None)
            continue
        field = f"{where} {name}"
        if not isinstance(one, Mapping):
            raise InputError(field, "{ link = ..., position = [x, y, z] }", repr(one))
        check_keys(one, ("link", "body", "position", "sd"), field)
        link = get(one, "link" if "link" in one else "body", str, field)
        out[name] = (link, get(one, "position", Vector, field, None), get(one, "sd", float, field, None))
        if (out[name][2] or 1.0) <= 0.0:
            raise InputError(place(field, "sd"), "above 0 m", f"{out[name][2]}")
    return out


def _calibrated(
    model: Any, placement: Placement, loose: list[str], motion: Mapping[str, Any], seen: MarkerRecording,
    at: Mapping[str, int], file: Path, base_dir: Path,
) -> Placement:  # fmt: skip
    """Positions of the markers that have none, from frames in which the posture is known."""
    static = motion["static"]
    if isinstance(static, str):
        standing = read_trc(base_dir / static)
        index = _matched(dict.fromkeys(placement.names), standing, base_dir / static)
        lost = [name for name in loose if name not in index]
        if lost:
            raise InputError(f"{static}: markers", ", ".join(loose), ", ".join(lost) + " missing")
        rows = standing.position
        here = [index.get(name, -1) for name in placement.names]
    else:
        start, end = convert(static, tuple[float, float], "[motion] static")
        inside = np.asarray((seen.t >= start) & (seen.t <= end))
        if not inside.any():
            raise InputError(
                "[motion] static",
                f"times within {seen.t[0]:g} to {seen.t[-1]:g} s",
                f"{start:g} to {end:g} s",
            )
        rows, here = seen.position[inside], list(at.values())
    some: BoolArray = np.asarray(np.isfinite(rows).all(axis=2).any(axis=0))
    mean = np.array(
        [np.nanmean(rows[:, k], axis=0) if k >= 0 and some[k] else np.full(3, np.nan) for k in here]
    )
    unseen = [
        name
        for name, point in zip(placement.names, mean, strict=True)
        if name in loose and np.isnan(point).any()
    ]
    if unseen:
        raise InputError(
            f"{file}: static frames",
            "every marker without a position seen at least once",
            ", ".join(unseen) + " hidden",
        )
    known = np.array([name not in loose for name in placement.names])
    if known.sum() < 3:
        raise InputError(
            "[motion.markers]", "a position for at least three markers that do not lie on a line, which say where the body stands",
            f"{int(known.sum())} with a position",
        )  # fmt: skip
    posture = _posture(model, motion, "static_posture")
    anchor = mean.copy()
    anchor[~known] = np.nan
    sd = _positive(motion, "static_posture_sd", 0.05)
    q = solve_posture(model, BodyObservations(placement, anchor[None]), posture, sd)
    R, p = observed(model, BodyObservations(placement, mean[None])).link_axes(q[None])
    own = np.einsum("mji,mj->mi", R[0], mean - p[0])
    position = np.where(known[:, None], placement.position, own)
    return Placement(placement.names, placement.links, position, placement.sd)


def _poses(model: Any, motion: Mapping[str, Any], file: Path) -> tuple[BodyObservations, FloatArray]:
    """Poses of the bodies of an archive that the model has, too."""
    t, bodies, R, p = link_poses(file)
    renamed = {str(k): str(v) for k, v in sub_table(motion, "bodies").items()}
    unknown = [name for name in renamed if name not in bodies]
    if unknown:
        raise InputError(
            f"[motion.bodies] {unknown[0]}",
            f"a body of {file.name}",
            "none",
            close_matches(unknown[0], bodies),
        )
    frames = {str(frame.name) for frame in model.frames}
    names = {k: renamed.get(body, body) for k, body in enumerate(bodies)}
    at = [k for k, name in names.items() if name in frames]
    if not at:
        raise InputError(
            f"{file.name}: bodies",
            "links of the model",
            ", ".join(bodies[:10]),
            "Say which is which in [motion.bodies], by name in the archive",
        )
    clock, rotations = t, [R[:, k] for k in at]
    clock, position = _uniform(t, p[:, at], motion)
    if clock.size != t.size or np.abs(clock - t).max() > 0.0:
        rotations = [resample_rotations(t, one, clock)[1] for one in rotations]
    sd = _positive(motion, "orientation_sd", 0.01), _positive(motion, "position_sd", 0.005)
    return poses_only([names[k] for k in at], np.stack(rotations, axis=1), position, *sd), clock


def _uniform(t: FloatArray, position: FloatArray, motion: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Positions (n, m, 3) on a uniform clock, every marker with its own gaps."""
    start, end = (
        get(motion, key, float, "[motion]", default) for key, default in (("start", -np.inf), ("end", np.inf))
    )
    keep = (t >= start) & (t <= end)
    if keep.sum() < 5:
        raise InputError(
            "[motion] start, end", f"five frames within {t[0]:.6g} to {t[-1]:.6g} s", f"{int(keep.sum())}"
        )
    t, position = t[keep], position[keep]
    rate = get(motion, "rate", float, "[motion]", None)
    if rate is not None and rate <= 0.0:
        raise InputError("[motion] rate", "a rate above 0 Hz", f"{rate:g}")
    dt = float(np.median(np.diff(t))) if rate is None else 1.0 / rate
    if rate is None and np.abs(np.diff(t) - dt).max() < 1e-2 * dt:
        return t[0] + (t[-1] - t[0]) / (t.size - 1) * np.arange(t.size), position
    gap = get(motion, "max_gap", float, "[motion]", None)
    clock = t[0] + dt * np.arange(int((t[-1] - t[0]) / dt + 1e-6) + 1)
    out = np.full((clock.size, *position.shape[1:]), np.nan)
    for k in range(position.shape[1]):
        if np.isfinite(position[:, k]).all(axis=1).sum() >= 2:
            out[:, k] = resample_uniform(t, position[:, k], clock, max_gap=gap, kind="cubic")[1]
    return clock, out


# ---- what follows -------------------------------------------------------------------------------------------------


def _vector(point: FloatArray) -> Vector:
    x, y, z = (float(value) for value in point)
    return x, y, z


def _posture(model: Any, motion: Mapping[str, Any], key: str) -> FloatArray:
    angles = {
        name: convert(value, float, f"[motion.{key}] {name}")
        for name, value in sub_table(motion, key).items()
    }
    if isinstance(model, OsimModel):
        unknown = [name for name in angles if name not in model.names]
        if unknown:
            raise InputError(
                f"[motion.{key}] {unknown[0]}",
                "a coordinate of the model",
                "none",
                close_matches(unknown[0], model.names),
            )
        return np.array([angles.get(one.name, one.default) for one in model.coordinates])
    try:
        return configuration(model, angles)
    except InputError as error:
        raise InputError(f"[motion.{key}]", error.expected, error.found, error.hint) from error


def _positive(motion: Mapping[str, Any], key: str, default: float) -> float:
    value: float = get(motion, key, float, "[motion]", default)
    if value <= 0.0:
        raise InputError(f"[motion] {key}", "a number above 0", f"{value:g}")
    return value


def _say_how_it_fits(state: BodyState, file: Path) -> None:
    name, size = state.worst_marker
    if state.residual_sd > _FITS:
        warnings.warn(
            f"{file.name}: what was seen fits the body {state.residual_sd:.1f} times worse than its stated sd; worst is {name}, "
            f"{1000.0 * size:.0f} mm: is it placed well, and has the body the right size?",
            UserWarning,
            stacklevel=2,
        )


def _check_upright(model: Any, state: BodyState, gravity: Vector) -> None:
    """Refuse a person of our own body model who lies on the floor all along: the ground's upright axis is another one."""
    if isinstance(model, OsimModel) or str(model.name) != "human" or not model.existFrame("Pelvis"):
        return
    q = state.q[state.good][:, 3:7]
    up = np.array(
        [
            2.0 * (q[:, 0] * q[:, 2] + q[:, 3] * q[:, 1]),
            2.0 * (q[:, 1] * q[:, 2] - q[:, 3] * q[:, 0]),
            1.0 - 2.0 * (q[:, 0] ** 2 + q[:, 1] ** 2),
        ]
    )
    mean = up.mean(axis=1)
    g = np.asarray(gravity)
    if float(mean @ -g) < 0.3 * float(np.linalg.norm(g) * np.linalg.norm(mean)):
        axis = "xyz"[int(np.argmax(np.abs(mean)))]
        turned = [0.0, 0.0, 0.0]
        turned["xyz".index(axis)] = -9.80665 * float(np.sign(mean["xyz".index(axis)]))
        raise InputError(
            "[model] gravity", "gravity along the body of who stands", f"{list(gravity)}, where the body is upright along {axis}",
            f"For a laboratory with {axis} up say gravity = {turned} in [model]",
        )  # fmt: skip

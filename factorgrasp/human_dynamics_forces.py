"""[[forces]] of a human-dynamics file: plates, shoes and force/torque sensors, brought onto the clock of the motion."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.human_dynamics_motion import BodyMotion, Vector
from factorgrasp.problems.human_dynamics_sensors import ExternalWrench
from factorgrasp.recordings.forces import FORCE, MOMENT, POINT, ForceRecording, force_of, read_opensim_forces
from factorgrasp.recordings.links import has_link_forces, read_link_forces
from factorgrasp.recordings.opensim import read_storage
from factorgrasp.recordings.tables import column_names, read_table
from factorgrasp.signals import synchronise
from factorgrasp.toml_tables import check_keys, close_matches, convert, get, place
from factorgrasp.typing import FloatArray

Quaternion = tuple[float, float, float, float]
Six = tuple[float, float, float, float, float, float]

PLATE_COVARIANCE: Six = (59.0, 59.0, 36.0, 2.25, 2.25, 0.56)
"""N^2 and (Nm)^2 of a force plate, upright last: those of the bowing data set of Latella et al., Sensors 16(5), 2016."""

# A person's foot or hand does not push two metres beside itself.
_FARTHEST = 2.0
_COMMON = ("file", "name", "frame", "covariance", "limit", "time_offset")
_COLUMNS = (*FORCE, *POINT, *MOMENT)


@dataclass(frozen=True, eq=False)
class _Part:
    """One force in world axes, with its variances and limit (N), and the file that it is from."""

    force: ForceRecording
    covariance: FloatArray
    limit: float | None
    file: str


def read_wrenches(
    entries: Sequence[Mapping[str, Any]] | None, body: BodyMotion, base_dir: Path, default: Six
) -> list[ExternalWrench]:
    """One sensor a link and frame of measurement, at the good frames of the motion.

    Plates on one link add up: their wrenches and their covariances.

    Parameters
    ----------
    entries : sequence of mappings or None
        The tables; None where the file has none: then the forces in the archive of the motion count, if it holds some.
    body : BodyMotion
    base_dir : Path
    default : tuple
        Variances of those that state none.
    """
    out: list[ExternalWrench] = []
    world: dict[str, list[_Part]] = {}
    if entries is None:
        entries = []
        if body.forces is not None and has_link_forces(body.forces):
            for force in read_link_forces(body.forces):
                if force.link in body.motion.links:
                    part = _Part(force, np.array(default), None, body.forces.name)
                    world.setdefault(force.link, []).append(part)
    for number, one in enumerate(entries, start=1):
        where = f"[[forces]] {number}"
        covariance = np.array(get(one, "covariance", Six, where, default))
        if (covariance <= 0.0).any():
            raise InputError(
                place(where, "covariance"), "six variances above zero, N^2 and (Nm)^2", f"{covariance}"
            )
        limit = get(one, "limit", float, where, None)
        if limit is not None and limit <= 0.0:
            raise InputError(place(where, "limit"), "a force above 0 N", f"{limit:g}")
        frame = get(one, "frame", str, where, "world")
        if frame not in ("world", "plate", "sensor", "link") and frame != one.get("link"):
            known = ("world", "plate", "sensor", "link")
            raise InputError(
                place(where, "frame"),
                "one of world, plate, sensor, link",
                repr(frame),
                close_matches(frame, known),
            )
        if frame not in ("world", "plate"):
            out.append(_in_hand(one, where, body, base_dir, covariance, limit))
            continue
        for force in _world_forces(one, where, base_dir, frame):
            _check_link(force.link, body, where)
            world.setdefault(force.link, []).append(_Part(force, covariance, limit, str(one.get("file", ""))))
    out += [_on_link(link, parts, body) for link, parts in world.items()]
    _check_direction(world, body)
    return out


def _world_forces(one: Mapping[str, Any], where: str, base_dir: Path, frame: str) -> Iterable[ForceRecording]:
    path = base_dir / get(one, "file", str, where)
    suffix, offset = path.suffix.lower(), get(one, "time_offset", float, where, 0.0)
    if suffix == ".xml":
        check_keys(one, (*_COMMON, "data"), where)
        data = get(one, "data", str, where, None)
        found = read_opensim_forces(path, None if data is None else base_dir / data)
    elif suffix == ".npz" and has_link_forces(path):
        check_keys(one, (*_COMMON, "link"), where)
        found = read_link_forces(path)
        if "link" in one:
            link = get(one, "link", str, where)
            found = tuple(force for force in found if force.link == link)
            if not found:
                raise InputError(place(where, "link"), f"a link with a force in {path.name}", repr(link))
    else:
        check_keys(
            one, (*_COMMON, "link", "columns", "force", "point", "moment", "position", "rotation_wxyz"), where
        )
        found = (_from_columns(path, one, where),)
    if frame == "plate":
        R, p = mounting(one, where)
        found = tuple(
            replace(f, force=f.force @ R.T, point=p + f.point @ R.T, moment=f.moment @ R.T) for f in found
        )
    else:
        for key in ("position", "rotation_wxyz"):
            if key in one:
                raise InputError(place(where, key), 'frame = "plate", "link" or "sensor"', '"world"')
    return [replace(force, t=force.t + offset) for force in found] if offset else found


def _from_columns(path: Path, one: Mapping[str, Any], where: str) -> ForceRecording:
    """A force from a table or a storage, by the names of its columns."""
    link = get(one, "link", str, where)
    t, columns = _table(path, _names(one, where, path), where)
    return force_of(path, t, columns, link, get(one, "name", str, where, ""))


def _table(path: Path, names: Mapping[str, str], where: str) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Times and the columns ``fx`` to ``mz`` of a file that calls them `names`."""
    if path.suffix.lower() in (".mot", ".sto"):
        table = read_storage(path)
        there: Sequence[str] = table.names
        t, values = table.t, {name: table.column(name) for name in set(names.values()) if name in there}
    else:
        there = column_names(path)
        clock = next((name for name in ("t", "time", "Time") if name in there), "t")
        wanted = [name for name in dict.fromkeys(names.values()) if name in there]
        values = read_table(path, (clock, *wanted))
        t = values[clock]
    for group, needed in ((FORCE, True), (POINT, False), (MOMENT, False)):
        lost = [names[key] for key in group if key in names and names[key] not in values]
        given = [key for key in group if key in names]
        # Without names of their own, points and moments may be missing altogether.
        if lost and (needed or len(lost) < len(given) or any(names[key] != key for key in group)):
            raise InputError(
                f"{where}: {path}: columns", ", ".join(names[key] for key in given),
                f"{', '.join(lost)} missing; there are {', '.join(there)}",
                "Say columns = [...], or force, point and moment",
            )  # fmt: skip
    return t, {key: values[name] for key, name in names.items() if name in values}


def _names(one: Mapping[str, Any], where: str, path: Path) -> dict[str, str]:
    """What the file calls ``fx`` to ``mz``."""
    columns = one.get("columns")
    prefixes = [key for key in ("force", "point", "moment") if key in one]
    if columns is not None and prefixes:
        raise InputError(place(where, prefixes[0]), "either columns or " + prefixes[0], "both")
    if isinstance(columns, list):
        names = convert(columns, tuple[str, ...], place(where, "columns"))
        keys = {3: FORCE, 6: (*FORCE, *MOMENT), 9: _COLUMNS}.get(len(names))
        if keys is None:
            raise InputError(
                place(where, "columns"),
                "3 names (force), 6 (force, moment) or 9 (force, point, moment)",
                str(len(names)),
            )
        return dict(zip(keys, names, strict=True))
    if columns is not None:
        if not isinstance(columns, Mapping):
            raise InputError(place(where, "columns"), "names of columns, or a table of them", repr(columns))
        check_keys(columns, _COLUMNS, place(where, "columns"))
        return {key: get(columns, key, str, place(where, "columns"), key) for key in _COLUMNS}
    if prefixes:
        if "force" not in one:
            raise InputError(place(where, "force"), "what the columns of the force begin with", "no such key")
        out: dict[str, str] = {}
        for key, group in (("force", FORCE), ("point", POINT), ("moment", MOMENT)):
            if key in one:
                out |= {
                    name: get(one, key, str, where) + axis for name, axis in zip(group, "xyz", strict=True)
                }
        return out
    return {key: key for key in _COLUMNS}


def _on_link(link: str, parts: Sequence[_Part], body: BodyMotion) -> ExternalWrench:
    total = np.zeros((body.clock.size, 6))
    variance = np.zeros(6)
    # A plate that nobody steps on has no noise to add to the others' on the same link.
    for part in [part for part in parts if part.force.force.any()] or parts[:1]:
        force = part.force
        # About the ground's origin: there forces and moments may be interpolated each on its own, a centre of pressure may not.
        wrench = _below(force.wrench_about(np.zeros(3)), force.force, part.limit)
        total += _on_clock(body, force.t, wrench, f"{part.file or force.name} on {link}")
        variance = variance + part.covariance
    values = total[body.good]
    motion = body.motion
    origin = motion.p[:, motion.link(link)]
    _check_nearness(link, parts, values, origin)
    values[:, 3:] -= np.cross(origin, values[:, :3])
    return ExternalWrench(values, variance, f"force on {link}", link=link, frame="world")


def _in_hand(
    one: Mapping[str, Any],
    where: str,
    body: BodyMotion,
    base_dir: Path,
    covariance: FloatArray,
    limit: float | None,
) -> ExternalWrench:
    """A force/torque sensor that moves with its link."""
    check_keys(one, (*_COMMON, "link", "columns", "force", "moment", "position", "rotation_wxyz"), where)
    link = get(one, "link", str, where)
    _check_link(link, body, where)
    path = base_dir / get(one, "file", str, where)
    names = {key: name for key, name in _names(one, where, path).items() if key not in POINT}
    t, columns = _table(path, names, where)
    force = np.column_stack([columns[key] for key in FORCE])
    # A sensor of forces alone says nothing of moments: that is no zero.
    moment = (
        np.column_stack([columns[key] for key in MOMENT]) if "mx" in columns else np.full_like(force, np.nan)
    )
    t = t + get(one, "time_offset", float, where, 0.0)
    label = f"{path.name} on {link}"
    values = _on_clock(body, t, _below(force, force, limit), label)
    rest = (
        _on_clock(body, t, _below(moment, force, limit), label)
        if "mx" in columns
        else np.full_like(values, np.nan)
    )
    R, p = mounting(one, where)
    both = np.concatenate([values, rest], axis=1)[body.good]
    return ExternalWrench(both, covariance, f"force sensor on {link}", link=link, R_l_s=R, p_l_s=p)


def _below(values: FloatArray, force: FloatArray, limit: float | None) -> FloatArray:
    """Gaps where a sensor is at its limit (N)."""
    if limit is None:
        return values
    return np.where((np.linalg.norm(force, axis=1) >= limit)[:, None], np.nan, values)


def _on_clock(body: BodyMotion, t: FloatArray, values: FloatArray, label: str) -> FloatArray:
    if np.isfinite(values).all(axis=1).sum() < 2:
        raise InputError(
            label, "a sensor that measured something", "gaps everywhere", "Is it at its limit all the time?"
        )
    found = synchronise(body.clock, {label: (t, values)})[label]
    if not np.isfinite(found[body.good]).any() and np.isfinite(values).any():
        clock = body.clock[body.good]
        raise InputError(
            f"{label}: t",
            f"times within those of the motion, {clock[0]:.6g} to {clock[-1]:.6g} s",
            f"{t[0]:.6g} to {t[-1]:.6g} s",
            "One clock? time_offset is added to the file's times",
        )
    return found


def _check_nearness(link: str, parts: Sequence[_Part], values: FloatArray, origin: FloatArray) -> None:
    """Refuse forces that act metres away from the link: millimetres, or another origin of the ground."""
    size = np.linalg.norm(values[:, :3], axis=1)
    loaded = size > max(10.0, 0.5 * float(np.nanmax(size, initial=0.0)))
    points = [part for part in parts if part.force.point.any()]
    if not loaded.any() or not points:
        return
    f, m = values[loaded, :3], values[loaded, 3:] - np.cross(origin[loaded], values[loaded, :3])
    # The line of action's distance from the link's origin.
    away = float(np.median(np.linalg.norm(np.cross(f, m), axis=1) / np.sum(f**2, axis=1)))
    if away > _FARTHEST:
        raise InputError(
            f"force on {link}", f"a line of action within {_FARTHEST:g} m of the link's origin", f"{away:.4g} m away",
            "Millimetres? Declare [mm] in the header. Or have motion and plates different origins?",
        )  # fmt: skip


def _check_direction(world: Mapping[str, Sequence[_Part]], body: BodyMotion) -> None:
    """Refuse forces of the body on the ground, and a ground whose upright axis is another one."""
    parts = [part for several in world.values() for part in several]
    if not parts:
        return
    total = sum(
        (np.nanmean(np.where(np.isnan(p.force.force), 0.0, p.force.force), axis=0) for p in parts),
        np.zeros(3),
    )
    g = body.motion.gravity
    weight = body.motion.total_mass * float(np.linalg.norm(g))
    size = float(np.linalg.norm(total))
    if weight == 0.0 or size < 0.2 * weight:
        if 2e-4 * weight < size < 3e-3 * weight:
            raise InputError(
                "[[forces]]", f"N: the body weighs {weight:.0f} N", f"a mean of {size:.3g} in all: kN suspected",
                "Declare the unit in the file's header, such as fz [kN]",
            )  # fmt: skip
        largest = max(float(np.nanmax(np.linalg.norm(p.force.force, axis=1), initial=0.0)) for p in parts)
        if largest < 0.02 * weight:
            warnings.warn(
                f"the forces reach {largest:.3g} N, where the body weighs {weight:.0f} N: are they in N?",
                UserWarning,
                stacklevel=2,
            )
        return
    upright = float(total @ -g) / (size * float(np.linalg.norm(g)))
    if upright < -0.8:
        raise InputError(
            "[[forces]]", "forces of the ground on the body, against gravity", f"a mean of {np.round(total, 1)} N along gravity {g}",
            "Are they those of the body on the ground? Turn their sign",
        )  # fmt: skip
    if upright < 0.5:
        raise InputError(
            "[[forces]]", f"forces against gravity {g}", f"a mean of {np.round(total, 1)} N",
            "Which axis is upright? Say gravity = [...] in [model]",
        )  # fmt: skip


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


def _check_link(link: str, body: BodyMotion, where: str) -> None:
    if link not in body.motion.links:
        raise InputError(
            f"{where}: link", "a link of the model", repr(link), close_matches(link, body.motion.links)
        )

"""Forces from outside on links of a body: force plates, instrumented shoes, a robot's force/torque sensor."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.recordings import _validate
from factorgrasp.recordings.opensim import read_storage
from factorgrasp.recordings.tables import PathLike, read_table
from factorgrasp.typing import FloatArray

GROUND = "ground"
FORCE, POINT, MOMENT = ("fx", "fy", "fz"), ("px", "py", "pz"), ("mx", "my", "mz")


@dataclass(frozen=True, eq=False)
class ForceRecording:
    """A force with its point of application, on one link.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s.
    force : ndarray, shape (n, 3)
        On the link, in the axes of the ground, N; NaN for gaps.
    point : ndarray, shape (n, 3)
        Where it acts, in the ground's frame, m. Where nothing pushes it has no meaning.
    moment : ndarray, shape (n, 3)
        About that point, in the axes of the ground, Nm.
    link : str
        What it acts on.
    name : str
    """

    t: FloatArray
    force: FloatArray
    point: FloatArray
    moment: FloatArray
    link: str
    name: str = ""

    def __post_init__(self) -> None:
        label = self.name or f"force on {self.link}"
        object.__setattr__(self, "name", label)
        t = _validate.times(self.t, f"{label}: t")
        object.__setattr__(self, "t", t)
        for key, unit in (("force", "N"), ("point", "m"), ("moment", "Nm")):
            value = np.array(getattr(self, key), dtype=float)
            if value.shape != (t.size, 3):
                raise InputError(f"{label}: {key}", f"shape ({t.size}, 3) in {unit}", str(value.shape))
            if np.isinf(value).any():
                raise InputError(f"{label}: {key}", f"finite values in {unit}, or NaN for gaps", "infinity")
            object.__setattr__(self, key, _validate.read_only(value))

    def __len__(self) -> int:
        return int(self.t.size)

    def wrench_about(self, origin: npt.ArrayLike) -> FloatArray:
        """``[force; moment]`` (n, 6) in the ground's axes, the moment about `origin` (3,) or (n, 3), m."""
        idle = (self.force == 0.0).all(axis=1)
        arm = np.where(idle[:, None], 0.0, self.point - np.asarray(origin, dtype=float))
        return np.concatenate([self.force, self.moment + np.cross(arm, self.force)], axis=1)


@dataclass(frozen=True)
class ExternalForceEntry:
    """One entry of an OpenSim external-loads file.

    Attributes
    ----------
    name, link : str
    force, point, moment : str
        Identifiers: what the names of the three columns have in common before x, y and z; `moment` may be empty.
    """

    name: str
    link: str
    force: str
    point: str
    moment: str


def read_external_loads(path: PathLike) -> tuple[tuple[ExternalForceEntry, ...], str]:
    """Entries of an OpenSim external-loads file (.xml) and the name of the data file that it refers to.

    Raises
    ------
    InputError
        For a file that is none, and for forces or points that are expressed in a body instead of the ground.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(
            str(file), "an OpenSim external-loads file", "a folder" if file.is_dir() else "no such file"
        )
    try:
        root = ElementTree.parse(file).getroot()
    except ElementTree.ParseError as error:
        raise InputError(str(file), "an XML file", str(error)) from error
    loads = root.find("ExternalLoads") if root.tag != "ExternalLoads" else root
    if loads is None:
        raise InputError(str(file), "an element ExternalLoads", root.tag)
    out: list[ExternalForceEntry] = []
    for element in loads.iter("ExternalForce"):
        name = element.get("name", f"force {len(out) + 1}")
        if _text(element, "isDisabled").lower() == "true":
            continue
        for key in ("force_expressed_in_body", "point_expressed_in_body"):
            if _text(element, key) not in ("", GROUND):
                raise InputError(f"{file}: {name}, {key}", "ground", _text(element, key))
        for key in ("applied_to_body", "force_identifier", "point_identifier"):
            if not _text(element, key):
                raise InputError(f"{file}: {name}", f"an element {key}", "none, or an empty one")
        out.append(
            ExternalForceEntry(
                name,
                _text(element, "applied_to_body"),
                _text(element, "force_identifier"),
                _text(element, "point_identifier"),
                _text(element, "torque_identifier"),
            )
        )
    if not out:
        raise InputError(str(file), "at least one enabled ExternalForce", "none")
    return tuple(out), _text(loads, "datafile")


def read_opensim_forces(loads: PathLike, data: PathLike | None = None) -> tuple[ForceRecording, ...]:
    """The forces of an OpenSim external-loads file with its data.

    Parameters
    ----------
    loads : path
        The .xml file.
    data : path, optional
        The .mot or .sto file; by default the one that the .xml names, in its folder.
    """
    entries, named = read_external_loads(loads)
    if data is None:
        if not named:
            raise InputError(
                f"{loads}: datafile", "the name of a .mot or .sto file", "none", "Give the data file yourself"
            )
        data = Path(loads).parent / Path(named.replace("\\", "/")).name
    return tuple(read_force(data, e.link, e.force, e.point, e.moment, e.name) for e in entries)


def read_force(
    path: PathLike, link: str, force: str, point: str, moment: str = "", name: str = ""
) -> ForceRecording:
    """One force from a .mot or .sto file, by what its columns begin with.

    Parameters
    ----------
    path : path
    link : str
        What it acts on.
    force, point, moment : str
        Such as ``ground_force_v``, ``ground_force_p`` and ``ground_torque_``: the columns are these with x, y and z behind. Without
        `moment` there is no free moment.
    name : str
    """
    table = read_storage(path)

    def part(prefix: str) -> FloatArray:
        try:
            return table.columns([prefix + axis for axis in "xyz"])
        except InputError as error:
            raise InputError(f"{path}: {error.field}", error.expected, error.found, error.hint) from error

    f = part(force)
    m = part(moment) if moment else np.where(np.isnan(f), np.nan, 0.0)
    return ForceRecording(table.t, f, part(point), m, link, name)


def read_force_table(path: PathLike, link: str, name: str = "") -> ForceRecording:
    """One force from a CSV, NPZ or Parquet table with columns ``t,fx,fy,fz,px,py,pz,mx,my,mz``.

    Units may be declared (``px [mm]``, ``mz [N mm]``). Without ``px,py,pz`` moments are about the ground's origin; without
    ``mx,my,mz`` there is no free moment.
    """
    optional = (*POINT, *MOMENT)
    table = read_table(path, ("t", *FORCE), optional)
    return force_of(path, table["t"], table, link, name)


def force_of(
    path: PathLike, t: FloatArray, columns: Mapping[str, FloatArray], link: str, name: str = ""
) -> ForceRecording:
    """A force from columns ``fx`` to ``mz``; without a point it acts at the ground's origin, without a moment there is none."""
    for group in (POINT, MOMENT):
        missing = [key for key in group if key not in columns]
        if missing and len(missing) < 3:
            raise InputError(f"{path}: columns", ", ".join(group), ", ".join(missing) + " missing")

    def part(names: tuple[str, ...]) -> FloatArray:
        if names[0] not in columns:
            return np.zeros((t.size, 3))
        return np.column_stack([columns[key] for key in names])

    return ForceRecording(t, part(FORCE), part(POINT), part(MOMENT), link, name)


def read_wrench_table(path: PathLike) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and wrenches (n, 6) ``[fx fy fz mx my mz]`` of a force/torque sensor, in the sensor's frame, from a table."""
    table = read_table(path, ("t", *FORCE, *MOMENT))
    return table["t"], np.column_stack([table[key] for key in (*FORCE, *MOMENT)])


def _text(element: ElementTree.Element, key: str) -> str:
    return (element.findtext(key) or "").strip()

"""Link motion from an archive of link-level arrays (``links_*.npz``), such as a musculoskeletal model's analysis writes."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.problems.link_motion import LinkJoint, LinkMotion, spherical_subspace
from factorgrasp.typing import FloatArray

NEEDED = (
    "t", "bodies", "mass", "com", "inertia", "R", "p", "w", "al", "vcom", "acom", "joints", "jparent", "jchild", "jpos",
)  # fmt: skip
GROUND = "ground"


def is_link_archive(path: str | Path) -> bool:
    """Whether a file is an archive of link-level arrays (and not a table of columns)."""
    file = Path(path)
    if file.suffix.lower() != ".npz" or not file.is_file():
        return False
    try:
        with np.load(file, allow_pickle=False) as archive:
            return "bodies" in archive and "R" in archive
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return False


def with_masses_of(motion: LinkMotion, path: str | Path) -> LinkMotion:
    """A motion with the masses, centres of mass and inertias of another archive; its bodies are matched by name."""
    data = _read(path, ("bodies", "mass", "com", "inertia"))
    names = [str(name) for name in data["bodies"]]
    missing = [link for link in motion.links if link not in names]
    if missing:
        raise InputError(f"{Path(path).name}: bodies", "those of the motion", ", ".join(missing) + " missing")
    at = [names.index(link) for link in motion.links]
    return replace(motion, mass=data["mass"][at], com=data["com"][at], inertia=data["inertia"][at])


def link_poses(path: str | Path) -> tuple[FloatArray, tuple[str, ...], FloatArray, FloatArray]:
    """Times (n,), bodies, orientations (n, L, 3, 3) and origins (n, L, 3) alone."""
    data = _read(path, ("t", "bodies", "R", "p"))
    bodies = tuple(str(name) for name in data["bodies"])
    R, p = np.asarray(data["R"], dtype=float), np.asarray(data["p"], dtype=float)
    shape = (data["t"].size, len(bodies), 3)
    if p.shape != shape or R.shape != (*shape, 3):
        raise InputError(
            f"{Path(path).name}: R, p", f"shapes {(*shape, 3)} and {shape}", f"{R.shape} and {p.shape}"
        )
    return np.asarray(data["t"], dtype=float), bodies, R, p


def _read(path: str | Path, needed: tuple[str, ...]) -> dict[str, Any]:
    file = Path(path)
    try:
        with np.load(file, allow_pickle=False) as archive:
            missing = [name for name in needed if name not in archive]
            if missing:
                raise InputError(file.name, "the fields " + ", ".join(needed), "no " + ", ".join(missing))
            return {name: archive[name] for name in needed}
    except InputError:
        raise
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(str(file), "an archive of link-level arrays (.npz)", str(error)) from error


def load_coordinates(path: str | Path) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Coordinates of an archive of links: name to value (n,) and rate (n,), rad or m and per second.

    Raises
    ------
    InputError
        When the archive has none.
    """
    data = _read(path, ("names", "Q", "dQ"))
    names, Q, dQ = data["names"], data["Q"], data["dQ"]
    return {
        str(name): (np.asarray(Q[:, i], dtype=float), np.asarray(dQ[:, i], dtype=float))
        for i, name in enumerate(names)
    }


def load_links(
    path: str | Path,
    gravity: tuple[float, float, float] = (0.0, -9.80665, 0.0),
    ball_joints: tuple[str, ...] = (),
) -> LinkMotion:
    """Read a motion from an archive.

    Parameters
    ----------
    path : path
        Archive with ``t`` (n,), ``bodies``, ``mass`` kg, ``com`` m and ``inertia`` kg m^2 (body axes, about the centre of
        mass), ``R`` (n, L, 3, 3)
        body to ground, ``p`` body origin, ``w``, ``al`` angular velocity and acceleration, ``vcom``, ``acom`` of the centres
        of mass (all in ground axes),
        ``joints``, ``jparent``, ``jchild`` and ``jpos`` (n, J, 3), the joint centres in ground axes.
    gravity : tuple
        In ground axes, m/s^2; the default is that of a ground with y up.
    ball_joints : tuple of str
        Joints that are ball joints about their centre; of the others only the moment vector is estimated.

    Raises
    ------
    InputError
        Naming the field that is missing or has the wrong shape.
    """
    data = _read(path, NEEDED)
    links = [str(name) for name in data["bodies"]]
    names = ("bodies", "joints", "jparent", "jchild")
    real: dict[str, FloatArray] = {}
    count, bodies, joints_in = data["t"].shape[:1], (len(links),), data["joints"].shape[:1]
    shapes: dict[str, tuple[int, ...]] = {
        "t": count, "mass": bodies, "com": (*bodies, 3), "inertia": (*bodies, 3, 3), "R": (*count, *bodies, 3, 3),
        **{name: (*count, *bodies, 3) for name in ("p", "w", "al", "vcom", "acom")}, "jpos": (*count, *joints_in, 3),
        "jparent": joints_in, "jchild": joints_in,
    }  # fmt: skip
    for name in NEEDED:
        if name in shapes and data[name].shape != shapes[name]:
            raise InputError(f"{Path(path).name}: {name}", f"shape {shapes[name]}", str(data[name].shape))
        if name not in names:
            try:
                real[name] = np.asarray(data[name], dtype=float)
            except ValueError as error:
                raise InputError(f"{Path(path).name}: {name}", "numbers", str(error)) from error
    kept = [j for j, parent in enumerate(data["jparent"]) if str(parent) != GROUND]
    joints = []
    for j in kept:
        name, parent, child = str(data["joints"][j]), str(data["jparent"][j]), str(data["jchild"][j])
        for end in (parent, child):
            if end not in links:
                raise InputError(f"joint {name}", "links among " + ", ".join(links), repr(end))
        parent_at, child_at = links.index(parent), links.index(child)
        if name in ball_joints:
            S = spherical_subspace(real["R"], real["p"], real["jpos"][:, j], child_at)
            joints.append(LinkJoint(name, parent_at, child_at, tuple(f"{name}_{axis}" for axis in "xyz"), S))
        else:
            joints.append(LinkJoint(name, parent_at, child_at))
    unknown = sorted(set(ball_joints) - {joint.name for joint in joints})
    if unknown:
        raise InputError(
            "ball_joints", "among " + ", ".join(joint.name for joint in joints), ", ".join(unknown)
        )
    return LinkMotion.from_com_motion(
        t=real["t"], links=tuple(links), mass=real["mass"], com=real["com"], inertia=real["inertia"], R=real["R"], p=real["p"],
        angular_velocity=real["w"], angular_acceleration=real["al"], com_velocity=real["vcom"], com_acceleration=real["acom"],
        joints=tuple(joints), joint_centre=real["jpos"][:, kept], gravity=np.asarray(gravity, dtype=float),
    )  # fmt: skip

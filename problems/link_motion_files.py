"""Link motion from an archive of link-level arrays (``links_*.npz``), such as a musculoskeletal model's analysis writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.problems.link_motion import LinkJoint, LinkMotion, spherical_subspace
from factorgrasp.typing import FloatArray

NEEDED = (
    "t", "bodies", "mass", "com", "inertia", "R", "p", "w", "al", "vcom", "acom", "joints", "jparent", "jchild", "jpos",
)  # fmt: skip
GROUND = "ground"


def load_coordinates(path: str | Path) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Coordinates of an archive of links: name to value (n,) and rate (n,), rad or m and per second.

    Raises
    ------
    InputError
        When the archive has none.
    """
    with np.load(path, allow_pickle=False) as archive:
        missing = [name for name in ("names", "Q", "dQ") if name not in archive]
        if missing:
            raise InputError(
                str(Path(path).name), "coordinates: the fields names, Q, dQ", "no " + ", ".join(missing)
            )
        names, Q, dQ = (archive[name] for name in ("names", "Q", "dQ"))
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
    with np.load(path, allow_pickle=False) as archive:
        missing = [name for name in NEEDED if name not in archive]
        if missing:
            raise InputError(
                str(Path(path).name), "the fields " + ", ".join(NEEDED), "no " + ", ".join(missing)
            )
        data = {name: archive[name] for name in NEEDED}
    links = [str(name) for name in data["bodies"]]
    real: dict[str, FloatArray] = {
        name: np.asarray(data[name], dtype=float)
        for name in NEEDED
        if name not in ("bodies", "joints", "jparent", "jchild")
    }
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

"""Is a URDF one of a physical body with names? What its parser passes over in silence is said here."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from factorgrasp.errors import InputError


def check_urdf(path: Path) -> None:
    """Raise InputError for names that are missing or double, and for masses and inertias that are no numbers or no body's.

    A link that a joint moves and that has no mass at the end of its chain is warned of.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise InputError("[model] urdf", "a URDF file that pinocchio reads", f"{path}: {error}") from error
    if root.tag != "robot":
        raise InputError("[model] urdf", "a URDF file, with an element robot", f"{path}: {root.tag}")
    links, joints = root.findall("link"), root.findall("joint")
    for what, elements in (("link", links), ("joint", joints)):
        names = [element.get("name", "").strip() for element in elements]
        if "" in names:
            raise InputError(f"{path}: {what} {names.index('') + 1}", "a name", "none")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"{path}: {what}s", "unique names", ", ".join(twice) + " more than once")
    known = {link.get("name", "") for link in links}
    parents: dict[str, tuple[str, str]] = {}
    for joint in joints:
        name = joint.get("name", "")
        ends = [(joint.find(key), key) for key in ("parent", "child")]
        for end, key in ends:
            link = "" if end is None else end.get("link", "")
            if link not in known:
                raise InputError(f"{path}: {key} of joint {name}", "a link of the file", repr(link))
            if key == "child":
                parents[link] = (name, joint.get("type", ""))
    total, massless = 0.0, []
    for element in links:
        mass = _mass(path, element)
        total += mass
        if mass == 0.0:
            massless.append(element.get("name", ""))
    if links and total == 0.0:
        raise InputError(f"{path}: masses", "links with masses", "none: every link is without inertial")
    has_child = {joint.find("parent").get("link") for joint in joints}  # type: ignore[union-attr]  # checked above
    ends_without = [
        name for name in massless if name not in has_child and parents.get(name, ("", "fixed"))[1] != "fixed"
    ]
    if ends_without:
        warnings.warn(
            f"{path.name}: {', '.join(ends_without[:5])} has no mass, though a joint moves it",
            UserWarning,
            stacklevel=2,
        )


def _mass(path: Path, link: ElementTree.Element) -> float:
    name, inertial = link.get("name", ""), link.find("inertial")
    if inertial is None:
        return 0.0
    mass = _number(path, inertial.find("mass"), "value", f"mass of {name}")
    if mass < 0.0:
        raise InputError(f"{path}: mass of {name}", "a finite mass of at least 0 kg", f"{mass:.6g} kg")
    element = inertial.find("inertia")
    if element is None:
        return mass
    xx, xy, xz, yy, yz, zz = (
        _number(path, element, "i" + key, f"inertia of {name}")
        for key in ("xx", "xy", "xz", "yy", "yz", "zz")
    )
    moments = np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    if moments[0] < -1e-9 * max(abs(moments)):
        raise InputError(
            f"{path}: inertia of {name}",
            "a positive semidefinite matrix in kg m^2",
            f"principal moments {moments}",
        )
    return mass


def _number(path: Path, element: ElementTree.Element | None, key: str, field: str) -> float:
    text = None if element is None else element.get(key)
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{path}: {field}", "a finite number", repr(text))
    return value

"""OpenSim models (.osim): bodies, joints with any spatial transform, coordinates and markers, and their kinematics for many frames.

Muscles, contact and everything else that is not rigid-body kinematics is left aside.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.osim_functions import Function, inner_function, read_function
from factorgrasp.typing import FloatArray

GROUND = "ground"
_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class OsimAxis:
    """One of the six motions of a joint: along or about an axis (3,), by a function of a coordinate (None: a constant)."""

    axis: FloatArray
    function: Function
    coordinate: str | None


@dataclass(frozen=True, eq=False)
class OsimJoint:
    """A joint: three turns about axes that turn along, after a translation, between frames on the parent and on the child.

    Attributes
    ----------
    name, parent, child : str
    R_p, p_p, R_c, p_c : ndarray
        The joint's frame on the parent and that on the child, (3, 3) and (3,) m.
    turns, slides : tuple of OsimAxis
        Up to three each.
    coordinates : tuple of str
    """

    name: str
    parent: str
    child: str
    R_p: FloatArray
    p_p: FloatArray
    R_c: FloatArray
    p_c: FloatArray
    turns: tuple[OsimAxis, ...]
    slides: tuple[OsimAxis, ...]
    coordinates: tuple[str, ...]

    def transform(self, values: dict[str, FloatArray], count: int) -> tuple[FloatArray, FloatArray]:
        """``R_p_c`` (n, 3, 3) and ``p_p_c`` (n, 3) of the child's body in the parent's body."""
        R = np.broadcast_to(self.R_p, (count, 3, 3))
        p = np.broadcast_to(self.p_p, (count, 3)).copy()
        for one in self.slides:
            p += _amount(one, values, count)[:, None] * (self.R_p @ one.axis)
        for one in self.turns:
            R = R @ lie.so3_exp(_amount(one, values, count)[:, None] * one.axis)
        R = R @ self.R_c.T
        return R, p - R @ self.p_c

    def subspace(self, values: dict[str, FloatArray], count: int) -> FloatArray:
        """(n, 6, k): twist ``[linear; angular]`` of the child against the parent by the rate of every coordinate, in the child's frame."""
        R, _ = self.transform(values, count)
        columns = []
        for name in self.coordinates:
            (R0, p0), (R1, p1) = (
                self.transform({**values, name: values[name] + step}, count) for step in (-_STEP, _STEP)
            )
            angular = lie.so3_log(np.swapaxes(R0, 1, 2) @ R1) / (2.0 * _STEP)
            linear = np.einsum("nji,nj->ni", R, p1 - p0) / (2.0 * _STEP)
            columns.append(np.concatenate([linear, angular], axis=1))
        return np.stack(columns, axis=2) if columns else np.zeros((count, 6, 0))


@dataclass(frozen=True, eq=False)
class OsimCoordinate:
    """A coordinate: its default, its range (rad or m) and whether it does not move."""

    name: str
    default: float
    low: float
    high: float
    locked: bool
    slides: bool


@dataclass(frozen=True, eq=False)
class OsimModel:
    """Bodies, joints and coordinates of an OpenSim model.

    Attributes
    ----------
    name : str
    bodies : tuple of str
    mass : ndarray, shape (L,)
        kg.
    com : ndarray, shape (L, 3)
        In the body's frame, m.
    inertia : ndarray, shape (L, 3, 3)
        About the centre of mass, in the body's axes, kg m^2.
    joints : tuple of OsimJoint
        From the ground outwards.
    coordinates : tuple of OsimCoordinate
    coupled : dict of str to (str, function)
        Coordinate that follows another one.
    markers : dict of str to (str, ndarray)
        Name to body and place in its frame.
    gravity : ndarray, shape (3,)
    """

    name: str
    bodies: tuple[str, ...]
    mass: FloatArray
    com: FloatArray
    inertia: FloatArray
    joints: tuple[OsimJoint, ...]
    coordinates: tuple[OsimCoordinate, ...]
    coupled: dict[str, tuple[str, Function]] = field(default_factory=dict)
    markers: dict[str, tuple[str, FloatArray]] = field(default_factory=dict)
    gravity: FloatArray = field(default_factory=lambda: np.array([0.0, -9.80665, 0.0]))

    @property
    def names(self) -> tuple[str, ...]:
        """Of all coordinates."""
        return tuple(one.name for one in self.coordinates)

    def values(self, q: FloatArray) -> dict[str, FloatArray]:
        """Coordinates (n, c) by name, those that follow others put right."""
        out = {name: q[:, k] for k, name in enumerate(self.names)}
        for name, (leader, function) in self.coupled.items():
            out[name] = function(out[leader])
        return out

    def poses(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``R_w_b`` (n, L, 3, 3) and origins (n, L, 3) of all bodies."""
        count, values = q.shape[0], self.values(q)
        R = np.full((count, len(self.bodies), 3, 3), np.nan)
        p = np.full((count, len(self.bodies), 3), np.nan)
        for joint in self.joints:
            R_j, p_j = joint.transform(values, count)
            k = self.bodies.index(joint.child)
            if joint.parent == GROUND:
                R[:, k], p[:, k] = R_j, p_j
            else:
                up = self.bodies.index(joint.parent)
                R[:, k] = R[:, up] @ R_j
                p[:, k] = p[:, up] + np.einsum("nij,nj->ni", R[:, up], p_j)
        return R, p


def _amount(one: OsimAxis, values: dict[str, FloatArray], count: int) -> FloatArray:
    x = np.zeros(count) if one.coordinate is None else values[one.coordinate]
    return one.function(x)


def read_osim(path: str | Path) -> OsimModel:
    """Read a model of version 3 or 4.

    Raises
    ------
    InputError
        For a file that is no model, and for joints, functions or constraints that are not known.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(str(file), "an OpenSim model (.osim)", "no such file")
    try:
        root = ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise InputError(str(file), "an OpenSim model (.osim)", str(error)) from error
    model = root.find("Model")
    if model is None:
        raise InputError(str(file), "an element Model", root.tag)
    reader = _Reader(file, model)
    return reader.model()


class _Reader:
    def __init__(self, file: Path, model: ElementTree.Element) -> None:
        self._file, self._model = file, model
        self._coordinates: list[OsimCoordinate] = []

    def model(self) -> OsimModel:
        elements = [e for e in self._model.findall("./BodySet/objects/Body") if e.get("name", "") != GROUND]
        names = tuple(e.get("name", "") for e in elements)
        if not names or "" in names or len(set(names)) != len(names):
            raise InputError(
                f"{self._file}: BodySet", "bodies with names of their own", ", ".join(names) or "none"
            )
        mass, com, inertia = [], [], []
        for e, name in zip(elements, names, strict=True):
            mass.append(self._numbers(e, "mass", 1, name)[0])
            com.append(self._numbers(e, "mass_center", 3, name))
            inertia.append(self._inertia(e, name))
        found = [(e, None) for e in self._model.findall("./JointSet/objects/*")]
        found += [(j, body) for e, body in zip(elements, names, strict=True) for j in e.findall("./Joint/*")]  # type: ignore[misc]
        joints = self._sorted([self._joint(e, body) for e, body in found], names)
        gravity = self._model.findtext("gravity")
        return OsimModel(
            self._model.get("name", ""), names, np.array(mass), np.array(com), np.array(inertia), joints, tuple(self._coordinates),
            self._couplers(), self._markers(),
            np.array([float(x) for x in gravity.split()]) if gravity else np.array([0.0, -9.80665, 0.0]),
        )  # fmt: skip

    def _inertia(self, e: ElementTree.Element, name: str) -> FloatArray:
        if e.find("inertia") is not None:
            xx, yy, zz, xy, xz, yz = self._numbers(e, "inertia", 6, name)
        else:
            xx, yy, zz, xy, xz, yz = (
                self._numbers(e, f"inertia_{key}", 1, name)[0] for key in ("xx", "yy", "zz", "xy", "xz", "yz")
            )
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def _joint(self, e: ElementTree.Element, owner: str | None) -> OsimJoint:
        name = e.get("name", "")
        if owner is None:
            parent, R_p, p_p = self._frame(e, "socket_parent_frame", name)
            child, R_c, p_c = self._frame(e, "socket_child_frame", name)
            coordinates = e.findall("./coordinates/Coordinate")
        else:
            parent, child = (e.findtext("parent_body") or "").strip(), owner
            R_p = _euler(self._numbers(e, "orientation_in_parent", 3, name, 0.0))
            p_p = np.array(self._numbers(e, "location_in_parent", 3, name, 0.0))
            R_c = _euler(self._numbers(e, "orientation", 3, name, 0.0))
            p_c = np.array(self._numbers(e, "location", 3, name, 0.0))
            coordinates = e.findall("./CoordinateSet/objects/Coordinate")
        names = tuple(c.get("name", "") for c in coordinates)
        turns, slides = self._axes(e, name, names)
        sliding = {one.coordinate for one in slides} - {one.coordinate for one in turns}
        self._coordinates += [self._coordinate(c, c.get("name", "") in sliding) for c in coordinates]
        return OsimJoint(name, parent, child, R_p, p_p, R_c, p_c, turns, slides, names)

    def _axes(
        self, e: ElementTree.Element, name: str, coordinates: tuple[str, ...]
    ) -> tuple[tuple[OsimAxis, ...], tuple[OsimAxis, ...]]:
        one = np.eye(3)
        simple: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
            "WeldJoint": ((), ()), "PinJoint": ((2,), ()), "SliderJoint": ((), (0,)), "UniversalJoint": ((0, 1), ()),
            "BallJoint": ((0, 1, 2), ()), "GimbalJoint": ((0, 1, 2), ()), "PlanarJoint": ((2,), (0, 1)),
            "FreeJoint": ((0, 1, 2), (0, 1, 2)),
        }  # fmt: skip
        if e.tag in simple:
            turns, slides = simple[e.tag]
            if len(turns) + len(slides) != len(coordinates):
                raise InputError(
                    f"{self._file}: {name}", f"{len(turns) + len(slides)} coordinates", str(len(coordinates))
                )
            of = iter(coordinates)
            made = [tuple(OsimAxis(one[k], lambda x: x, next(of)) for k in part) for part in (turns, slides)]
            return made[0], made[1]
        if e.tag != "CustomJoint":
            raise InputError(
                f"{self._file}: {name}", "a joint among " + ", ".join((*simple, "CustomJoint")), e.tag
            )
        parts: dict[str, list[OsimAxis]] = {"rotation": [], "translation": []}
        for axis in e.findall("./SpatialTransform/TransformAxis"):
            kind = axis.get("name", "")
            label = f"{self._file}: {name}, {kind}"
            direction = np.array(self._numbers(axis, "axis", 3, name))
            words = (axis.findtext("coordinates") or "").split()
            if len(words) > 1:
                raise InputError(label, "a function of one coordinate", ", ".join(words))
            function = read_function(inner_function(axis, label), label)
            parts[kind.rstrip("123")].append(OsimAxis(direction, function, words[0] if words else None))
        return tuple(parts["rotation"]), tuple(parts["translation"])

    def _coordinate(self, e: ElementTree.Element, slides: bool) -> OsimCoordinate:
        name = e.get("name", "")
        low, high = self._numbers(e, "range", 2, name, -np.inf)
        locked = (e.findtext("locked") or "").strip().lower() == "true"
        return OsimCoordinate(
            name, self._numbers(e, "default_value", 1, name, 0.0)[0], low, max(low, high), locked, slides
        )

    def _frame(self, e: ElementTree.Element, socket: str, name: str) -> tuple[str, FloatArray, FloatArray]:
        word = (e.findtext(socket) or "").strip().rpartition("/")[2]
        for frame in e.findall("./frames/PhysicalOffsetFrame"):
            if frame.get("name") == word:
                body = (frame.findtext("socket_parent") or "").strip().rpartition("/")[2]
                turn = self._numbers(frame, "orientation", 3, name, 0.0)
                return body, _euler(turn), np.array(self._numbers(frame, "translation", 3, name, 0.0))
        if not word:
            raise InputError(f"{self._file}: {name}", f"an element {socket}", "none")
        return word, np.eye(3), np.zeros(3)

    def _sorted(self, joints: list[OsimJoint], bodies: tuple[str, ...]) -> tuple[OsimJoint, ...]:
        """From the ground outwards."""
        out: list[OsimJoint] = []
        have, left = {GROUND}, list(joints)
        while left:
            ready = [joint for joint in left if joint.parent in have]
            if not ready:
                raise InputError(
                    f"{self._file}: JointSet",
                    "a tree that begins at the ground",
                    ", ".join(j.name for j in left),
                )
            out += ready
            have |= {joint.child for joint in ready}
            left = [joint for joint in left if joint not in ready]
        children = [joint.child for joint in out]
        wrong = [name for name in bodies if children.count(name) != 1]
        if wrong:
            raise InputError(
                f"{self._file}: JointSet", "one joint to a parent for every body", ", ".join(wrong)
            )
        return tuple(out)

    def _couplers(self) -> dict[str, tuple[str, Function]]:
        out = {}
        for e in self._model.findall("./ConstraintSet/objects/CoordinateCouplerConstraint"):
            if (
                e.findtext("isEnforced") or e.findtext("isDisabled") or "true"
            ).strip().lower() == "false" and e.find("isDisabled") is None:
                continue
            label = f"{self._file}: {e.get('name', '')}"
            leaders = (e.findtext("independent_coordinate_names") or "").split()
            follower = (e.findtext("dependent_coordinate_name") or "").strip()
            if len(leaders) != 1:
                raise InputError(label, "one leading coordinate", ", ".join(leaders) or "none")
            holder = e.find("coupled_coordinates_function")
            if holder is None or not len(holder):
                raise InputError(label, "a function", "none")
            out[follower] = (leaders[0], read_function(holder[0], label))
        return out

    def _markers(self) -> dict[str, tuple[str, FloatArray]]:
        if not self._model.findall("./MarkerSet/objects/Marker"):
            return {}
        from factorgrasp.recordings.opensim import read_osim_markers

        return {m.name: (m.link, np.array(m.position)) for m in read_osim_markers(self._file)}

    def _numbers(
        self, e: ElementTree.Element, key: str, count: int, name: str, default: float | None = None
    ) -> list[float]:
        text = e.findtext(key)
        if text is None or not text.strip():
            if default is None:
                raise InputError(f"{self._file}: {name}, {key}", f"{count} number(s)", "none")
            return [default] * count if np.isfinite(default) else [default, -default][:count]
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        if len(values) != count:
            raise InputError(f"{self._file}: {name}, {key}", f"{count} number(s)", repr(text.strip()[:40]))
        return values


def _euler(angles: list[float]) -> FloatArray:
    """Turns about x, y and z that turn along."""
    R = np.eye(3)
    for k, angle in enumerate(angles):
        R = R @ lie.so3_exp(angle * np.eye(3)[k])
    return R

"""How every kind of sensor reads the unknowns: constant and varying blocks of its rows, and the known part of its value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.problems import human_dynamics_sensors as kinds
from factorgrasp.problems.human_dynamics_names import (
    acceleration_of,
    joint_acceleration_of,
    wrench_of,
    wrench_on,
)
from factorgrasp.problems.human_dynamics_sensors import Sensor
from factorgrasp.problems.human_dynamics_state import (
    MotionAcceleration,
    StateError,
    motion_acceleration,
    on_world_wrench,
    state_error,
)
from factorgrasp.problems.link_motion import BodyTree, LinkKinematics
from factorgrasp.problems.link_motion_spatial import cross, rotate, skew
from factorgrasp.typing import BoolArray, FloatArray

Make = Callable[[LinkKinematics], FloatArray]


@dataclass(frozen=True)
class SensorRows:
    """Rows ``Y d = y - b_Y`` of one sensor.

    Attributes
    ----------
    name : str
    size : int
    unit : str
    full : bool
        Whether its covariance couples its rows.
    patterns : dict
        Boolean (rows, size) per variable.
    constant : dict
        (rows, size) per variable that does not change.
    varying : dict
        Functions that give (n, rows, size) per variable that does.
    offset : callable or None
        ``b_Y`` (n, rows).
    placement : tuple or None
        Of an accelerometer: index of its link, ``R_s_l`` and ``p_l_s``, from which the offsets of all of them are computed at once.
    """

    name: str
    size: int
    unit: str
    full: bool
    patterns: dict[str, BoolArray]
    constant: dict[str, FloatArray] = field(default_factory=dict)
    varying: dict[str, Make] = field(default_factory=dict)
    offset: Make | None = None
    placement: tuple[int, FloatArray, FloatArray] | None = None

    def jacobian(self, k: LinkKinematics) -> FloatArray:
        """(1 or n, rows, touched unknowns), the variables side by side in the order of `patterns`."""
        parts = [self.constant[v][None] if v in self.constant else self.varying[v](k) for v in self.patterns]
        count = max(part.shape[0] for part in parts)
        return np.concatenate([np.broadcast_to(part, (count, *part.shape[1:])) for part in parts], axis=2)


def sensor_rows(tree: BodyTree, sensor: Sensor, state_errors: bool = False) -> SensorRows:
    """Rows of a sensor on a body; with `state_errors` also how errors of the configuration enter them.

    Raises
    ------
    InputError
        When its link or joint is not there, or has no such unknown.
    """
    C = sensor.variances()
    full = C.ndim == 3 or (C.ndim == 2 and C.shape == (sensor.size, sensor.size) and sensor.size > 1)
    for link in getattr(sensor, "links", None) or ((sensor.where,) if hasattr(sensor, "link") else ()):
        if link not in tree.links:
            raise InputError(f"link of {sensor.name}", "one of " + ", ".join(tree.links), repr(link))
        on_base = tree.fixed_base and link == tree.links[tree.root]
        if on_base and isinstance(
            sensor, kinds.Accelerometer | kinds.GyroscopeDerivative | kinds.LinkAcceleration
        ):
            raise InputError(f"link of {sensor.name}", "a link that moves", f"{link!r}, the fixed base")
    make = _MAKERS.get(type(sensor))
    if make is None:
        raise InputError("sensor", "one of " + ", ".join(t.__name__ for t in _MAKERS), type(sensor).__name__)
    blocks, varying, offset = make(tree, sensor)
    if state_errors and isinstance(sensor, kinds.ExternalWrench) and sensor.frame == "world":
        for name, (size, error) in on_world_wrench(tree, tree.links.index(sensor.link)).items():
            blocks[name], varying[name] = np.ones((6, size)), error
    patterns = {name: block != 0.0 for name, block in blocks.items()}
    constant = {name: block for name, block in blocks.items() if name not in varying}
    placement = None
    if isinstance(sensor, kinds.Accelerometer):
        placement = (
            tree.links.index(sensor.link),
            np.asarray(sensor.R_l_s, dtype=float).T,
            np.asarray(sensor.p_l_s, dtype=float),
        )
    return SensorRows(
        sensor.name, sensor.size, sensor.unit, full, patterns, constant, varying, offset, placement
    )


Made = tuple[dict[str, FloatArray], dict[str, Make], Make | None]
"""Blocks per variable (for varying ones any that has the pattern), the varying ones, and the offset."""


def _accelerometer(tree: BodyTree, sensor: Sensor) -> Made:
    assert isinstance(sensor, kinds.Accelerometer)
    at, back, r = (
        tree.links.index(sensor.link),
        np.asarray(sensor.R_l_s, dtype=float).T,
        np.asarray(sensor.p_l_s, dtype=float),
    )
    _check_placement(sensor, back, r)
    block = np.concatenate([back, -back @ skew(r)], axis=1)

    def offset(k: LinkKinematics) -> FloatArray:
        v, w = k.velocity[:, at, :3], k.velocity[:, at, 3:]
        return np.asarray(cross(w, v + cross(w, r)) @ back.T)

    return {acceleration_of(sensor.link): block}, {}, offset


def _gyroscope(tree: BodyTree, sensor: Sensor) -> Made:
    assert isinstance(sensor, kinds.GyroscopeDerivative)
    back = np.asarray(sensor.R_l_s, dtype=float).T
    _check_placement(sensor, back, np.zeros(3))
    return {acceleration_of(sensor.link): np.concatenate([np.zeros((3, 3)), back], axis=1)}, {}, None


def _link_acceleration(tree: BodyTree, sensor: Sensor) -> Made:
    assert isinstance(sensor, kinds.LinkAcceleration)
    return {acceleration_of(sensor.link): np.eye(6)}, {}, None


def _external_wrench(tree: BodyTree, sensor: Sensor) -> Made:
    assert isinstance(sensor, kinds.ExternalWrench)
    name, at = wrench_on(sensor.link), tree.links.index(sensor.link)
    if sensor.frame == "world":
        pattern: FloatArray = np.zeros((6, 6))
        pattern[:3, :3] = pattern[3:, 3:] = 1.0

        def make(k: LinkKinematics) -> FloatArray:
            out = np.zeros((k.count, 6, 6))
            out[:, :3, :3] = out[:, 3:, 3:] = k.R[:, at]
            return out

        return {name: pattern}, {name: make}, None
    back, p = np.asarray(sensor.R_l_s, dtype=float).T, np.asarray(sensor.p_l_s, dtype=float)
    _check_placement(sensor, back, p)
    block = np.zeros((6, 6))
    block[:3, :3] = block[3:, 3:] = back
    block[3:, :3] = -back @ skew(p)
    return {name: block}, {}, None


def _joint_wrench(tree: BodyTree, sensor: Sensor) -> Made:
    assert isinstance(sensor, kinds.JointWrench)
    _joint(tree, sensor)
    return {wrench_of(sensor.joint): np.eye(6)}, {}, None


def _joint_torque(tree: BodyTree, sensor: Sensor) -> Made:
    j = _joint_with_axes(tree, sensor)
    name, S = wrench_of(tree.joints[j]), tree.subspaces[j]
    if S is not None:
        return {name: S.T.copy()}, {}, None

    def make(k: LinkKinematics) -> FloatArray:
        moving = k.subspaces[j]
        assert moving is not None
        return np.swapaxes(moving, 1, 2)

    return {name: np.ones((sensor.size, 6))}, {name: make}, None


def _joint_acceleration(tree: BodyTree, sensor: Sensor) -> Made:
    j = _joint_with_axes(tree, sensor)
    return {joint_acceleration_of(tree.joints[j]): np.eye(sensor.size)}, {}, None


def _wrench_set(tree: BodyTree, sensor: Sensor) -> Made:
    assert isinstance(sensor, kinds.WrenchSet)
    if sensor.size != 6 * len(sensor.links) or not sensor.links:
        raise InputError(
            sensor.name, f"six columns for each of {len(sensor.links)} links", str(sensor.values.shape)
        )
    blocks = {}
    for i, link in enumerate(sensor.links):
        block = np.zeros((sensor.size, 6))
        block[6 * i : 6 * i + 6] = np.eye(6)
        blocks[wrench_on(link)] = block
    return blocks, {}, None


def _momentum_rate(tree: BodyTree, sensor: Sensor) -> Made:
    pattern = np.ones((6, 6))
    pattern[:3, 3:] = 0.0
    com = np.where(tree.mass[:, None] > 0.0, _lever(tree), 0.0)

    def of(i: int) -> Make:
        def make(k: LinkKinematics) -> FloatArray:
            centre = np.einsum("l,nlk->nk", tree.mass, k.p + rotate(k.R, com)) / tree.mass.sum()
            out = np.zeros((k.count, 6, 6))
            out[:, :3, :3] = out[:, 3:, 3:] = k.R[:, i]
            out[:, 3:, :3] = skew(k.p[:, i] - centre) @ k.R[:, i]
            return out

        return make

    names = {wrench_on(link): pattern for link in tree.links}
    return names, {wrench_on(link): of(i) for i, link in enumerate(tree.links)}, None


def _lever(tree: BodyTree) -> FloatArray:
    """Centres of mass (L, 3) read from the spatial inertias."""
    S = tree.spatial_inertia[:, 3:, :3] / np.where(tree.mass > 0.0, tree.mass, 1.0)[:, None, None]
    return np.stack([S[:, 2, 1], S[:, 0, 2], S[:, 1, 0]], axis=1)


_MAKERS: dict[type[Sensor], Callable[[BodyTree, Sensor], Made]] = {
    kinds.Accelerometer: _accelerometer,
    kinds.GyroscopeDerivative: _gyroscope,
    kinds.LinkAcceleration: _link_acceleration,
    kinds.ExternalWrench: _external_wrench,
    kinds.JointWrench: _joint_wrench,
    kinds.JointTorque: _joint_torque,
    kinds.JointAcceleration: _joint_acceleration,
    kinds.WrenchSet: _wrench_set,
    kinds.MomentumRate: _momentum_rate,
    StateError: state_error,
    MotionAcceleration: motion_acceleration,
}


def _joint(tree: BodyTree, sensor: Sensor) -> int:
    if sensor.where not in tree.joints:
        raise InputError(f"joint of {sensor.name}", "one of " + ", ".join(tree.joints), repr(sensor.where))
    return tree.joints.index(sensor.where)


def _joint_with_axes(tree: BodyTree, sensor: Sensor) -> int:
    j = _joint(tree, sensor)
    if not tree.dofs[j]:
        raise InputError(
            f"joint of {sensor.name}", "a joint with known axes", f"{sensor.where!r}, whose axes are unknown"
        )
    if sensor.size != len(tree.dofs[j]):
        raise InputError(
            sensor.name, f"{len(tree.dofs[j])} columns ({', '.join(tree.dofs[j])})", f"{sensor.size}"
        )
    return j


def _check_placement(sensor: Sensor, R: FloatArray, p: FloatArray) -> None:
    if R.shape != (3, 3) or p.shape != (3,):
        raise InputError(
            f"placement of {sensor.name}", "R_l_s (3, 3) and p_l_s (3,) m", f"{R.shape} and {p.shape}"
        )
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0.0:
        raise InputError(f"R_l_s of {sensor.name}", "a rotation matrix", f"{R.T.tolist()}")

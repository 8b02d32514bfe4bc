"""Errors of the configuration as unknowns of the human-dynamics problem: how noise of (q, qdd) reaches its rows (mathematics 4.3).

Lever arms, directions and gravity's share of the accelerations come from a measured configuration. With ``delta`` the true less the
measured one (the root's displacement in its own frame, then all joints), every row is taken at the true configuration to first order:

- a child's frame moves by the twist ``xi = S_j delta_j``, and ``X(q + delta) m = X m + (X m) x xi``, ``X' f -> X' (f + xi x* f)``;
- a wrench given in world axes about the measured origin of its link is ``w + xi x* w`` there, ``xi`` summed over the joints above;
- the root's measured proper acceleration turns with the root;
- the columns of a chain of hinges turn with the hinges behind them.

``delta`` has the prior ``N(0, g_q Sigma)``, and what it says of the accelerations' noise is taken into their rows. So the estimate's
covariance, and the innovations of the sensors, hold it without a second pass of error propagation, and the pattern stays sparse.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from factorgrasp.problems.human_dynamics_names import acceleration_of, joint_acceleration_of, pose_error_of
from factorgrasp.problems.human_dynamics_sensors import Sensor
from factorgrasp.problems.link_motion import BodyTree, LinkKinematics, StateNoise
from factorgrasp.problems.link_motion_spatial import cross_motion, motion_transform, rotate_back, skew
from factorgrasp.typing import FloatArray, IntArray

Make = Callable[[LinkKinematics], FloatArray]
Made = tuple[dict[str, FloatArray], dict[str, Make], Make | None]


@dataclass(frozen=True)
class StateError(Sensor):
    """The prior of the configuration's error: zeros (n, k)."""

    kind: ClassVar[str] = "configuration"
    unit: ClassVar[str] = "rad, m"

    @property
    def where(self) -> str:
        """The whole motion."""
        return "the motion"


@dataclass(frozen=True)
class MotionAcceleration(Sensor):
    """The motion's own accelerations given the configuration's error: the root's proper one, then those of joints.

    Attributes
    ----------
    root : bool
        Whether the root's six come first.
    joints : tuple of str
    ratio : float
        :attr:`StateNoise.ratio`.
    """

    root: bool = False
    joints: tuple[str, ...] = ()
    ratio: float = 0.0

    kind: ClassVar[str] = "acceleration"
    unit: ClassVar[str] = "m/s^2, rad/s^2"

    @property
    def where(self) -> str:
        """The whole motion."""
        return "the motion"

    def read(self, tree: BodyTree, k: LinkKinematics) -> FloatArray:
        """Values (n, size) of some frames."""
        ends = np.cumsum([0, *k.sizes])
        at = [np.arange(ends[j], ends[j + 1]) for j in map(tree.joints.index, self.joints)]
        joints = k.joint_acceleration[:, np.concatenate([*at, np.empty(0, dtype=np.intp)]).astype(np.intp)]
        return np.concatenate([k.acceleration[:, tree.root], joints], axis=1) if self.root else joints


def state_sensors(
    tree: BodyTree, noise: StateNoise, k: LinkKinematics, sensors: Sequence[Sensor], use_motion: bool
) -> tuple[Sensor, ...]:
    """The rows that the noise of the configuration adds at the frames of `k`; accelerations only where no sensor gives them."""
    prior = StateError(np.zeros((k.count, noise.size)), noise.position_gain * noise.covariance)
    if not use_motion or not noise.gives_accelerations:
        return (prior,)
    have = {(sensor.kind, sensor.where) for sensor in sensors}
    root = not tree.fixed_base and ("link acceleration", tree.links[tree.root]) not in have
    chosen = tuple(j for j, name in enumerate(tree.joints) if ("joint acceleration", name) not in have)
    index = [np.arange(6)] * root + [places(tree)[j] for j in chosen]
    if not index:
        return (prior,)
    own = MotionAcceleration(
        np.zeros((k.count, sum(map(len, index)))), noise.left.part(np.concatenate(index)),
        root=root, joints=tuple(tree.joints[j] for j in chosen), ratio=noise.ratio,
    )  # fmt: skip
    return prior, replace(own, values=own.read(tree, k))


def places(tree: BodyTree) -> list[IntArray]:
    """Components of the configuration's error by joint."""
    ends = np.cumsum([0 if tree.fixed_base else 6, *(len(dofs) for dofs in tree.dofs)])
    return [np.arange(ends[j], ends[j + 1]) for j in range(len(tree.joints))]


def holders(tree: BodyTree) -> list[tuple[str, IntArray]]:
    """Names of the unknown errors with their components: the root's, then the joints'."""
    root = [] if tree.fixed_base else [(pose_error_of(tree.links[tree.root]), np.arange(6))]
    return root + [(pose_error_of(name), at) for name, at in zip(tree.joints, places(tree), strict=True)]


# ---- rows of the two sensors ----------------------------------------------------------------------------------


def state_error(tree: BodyTree, sensor: Sensor) -> Made:
    """Identity."""
    return {name: np.eye(sensor.size)[:, at] for name, at in holders(tree)}, {}, None


def motion_acceleration(tree: BodyTree, sensor: Sensor) -> Made:
    """``qdd - ratio delta``, and for the root the turn of its proper acceleration."""
    assert isinstance(sensor, MotionAcceleration)
    blocks: dict[str, FloatArray] = {}
    varying: dict[str, Make] = {}
    first = 0
    if sensor.root:
        link = tree.links[tree.root]
        block = np.zeros((sensor.size, 6))
        block[:6] = np.eye(6)
        blocks[acceleration_of(link)] = block
        turn = np.zeros((sensor.size, 6))
        turn[:6] = np.eye(6)
        turn[:3, 3:] = 1.0
        blocks[pose_error_of(link)] = turn

        def root(k: LinkKinematics) -> FloatArray:
            v, alpha = k.velocity[:, tree.root], k.acceleration[:, tree.root]
            out = np.zeros((k.count, sensor.size, 6))
            out[:, :6] = -sensor.ratio * np.eye(6)
            out[:, :3, 3:] -= skew(alpha[:, :3] + np.cross(v[:, 3:], v[:, :3]))
            return out

        varying[pose_error_of(link)] = root
        first = 6
    for name in sensor.joints:
        size = len(tree.dofs[tree.joints.index(name)])
        block = np.zeros((sensor.size, size))
        block[first : first + size] = np.eye(size)
        blocks[joint_acceleration_of(name)] = block
        if sensor.ratio:
            blocks[pose_error_of(name)] = -sensor.ratio * block
        first += size
    return blocks, varying, None


# ---- what errors do to the other rows -------------------------------------------------------------------------


def on_propagation(tree: BodyTree, j: int) -> Make:
    """``-(X alpha_p) x S_j`` and the turn of ``S_j qdd_j``: (n, 6, n_j)."""
    ends = np.cumsum([0, *(len(dofs) for dofs in tree.dofs)])
    own, up, moves = slice(ends[j], ends[j + 1]), int(tree.parents[j]), tree.subspaces[j] is None

    def make(k: LinkKinematics) -> FloatArray:
        S = k.axes[:, own]
        carried = (k.transform[:, j] @ k.acceleration[:, up, :, None])[..., 0]
        out = -cross_motion(carried[:, None], S)
        if moves:
            term = S * k.joint_acceleration[:, own, None]
            before = np.cumsum(term, axis=1) - term
            out += cross_motion(S, before)
        return np.swapaxes(out, 1, 2)

    return make


def on_balance(tree: BodyTree, j: int) -> Make:
    """``X' (S_j x* f_j)`` in the balance of the parent: (n, 6, n_j)."""
    ends = np.cumsum([0, *(len(dofs) for dofs in tree.dofs)])
    own = slice(ends[j], ends[j + 1])

    def make(k: LinkKinematics) -> FloatArray:
        if k.joint_wrench is None:
            return np.zeros((k.count, 6, own.stop - own.start))
        turned = wrench_turn(k.joint_wrench[:, j]) @ np.swapaxes(k.axes[:, own], 1, 2)
        return np.asarray(np.swapaxes(k.transform[:, j], 1, 2) @ turned)

    return make


def on_world_wrench(tree: BodyTree, link: int) -> dict[str, tuple[int, Make]]:
    """``R (S x* w)`` for every error that moves a link, in rows that give its wrench in world axes: width and (n, 6, n_j) by name."""

    def turned(k: LinkKinematics) -> FloatArray:
        assert k.external_wrench is not None
        B = wrench_turn(k.external_wrench[:, link]).reshape(k.count, 2, 3, 6)
        return np.asarray((k.R[:, None, link] @ B).reshape(k.count, 6, 6))

    def of(columns: Make, size: int) -> Make:
        return lambda k: np.zeros((k.count, 6, size)) if k.external_wrench is None else turned(k) @ columns(k)

    return {name: (size, of(columns, size)) for name, size, columns in link_jacobian(tree, link)}


def link_jacobian(tree: BodyTree, link: int) -> list[tuple[str, int, Make]]:
    """Twist of a link in its frame by the errors above it: name, width and (n, 6, width), the root's last."""
    ends = np.cumsum([0, *(len(dofs) for dofs in tree.dofs)])
    out: list[tuple[str, int, Make]] = []

    def through(j: int) -> Make:
        at = int(tree.children[j])
        return lambda k: seen_from(k, at, link) @ np.swapaxes(k.axes[:, ends[j] : ends[j + 1]], 1, 2)

    for j in tree.paths[link]:
        out.append((pose_error_of(tree.joints[j]), len(tree.dofs[j]), through(j)))
    if not tree.fixed_base:
        out.append((pose_error_of(tree.links[tree.root]), 6, lambda k: seen_from(k, tree.root, link)))
    return out


def seen_from(k: LinkKinematics, one: int, other: int) -> FloatArray:
    """Motion transform (n, 6, 6) from a link's frame to another's."""
    R = np.swapaxes(k.R[:, other], 1, 2) @ k.R[:, one]
    return motion_transform(R, rotate_back(k.R[:, one], k.p[:, other] - k.p[:, one]))


def wrench_turn(w: FloatArray) -> FloatArray:
    """``B(w)`` (..., 6, 6) with ``xi x* w = B(w) xi``."""
    out = np.zeros((*w.shape, 6))
    force = skew(w[..., :3])
    out[..., :3, 3:], out[..., 3:, :3], out[..., 3:, 3:] = -force, -force, -skew(w[..., 3:])
    return out


def torque_turn(S: FloatArray, f: FloatArray) -> FloatArray:
    """``T`` (n, n_j, n_j) with ``S(q + delta)' f = S' f + T delta``: hinges turn those in front of them.

    Parameters
    ----------
    S : (n, 6, n_j) ndarray
    f : (n, 6) ndarray
    """
    columns = np.swapaxes(S, 1, 2)
    size = columns.shape[1]
    # T[m, k] = -(S_k x S_m)' f for k behind m.
    turned = cross_motion(columns[:, None, :], columns[:, :, None])
    return np.asarray(-np.einsum("nmki,ni->nmk", turned, f) * np.triu(np.ones((size, size)), 1))

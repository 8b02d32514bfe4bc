"""How the links of an articulated body move: the one form of motion that the human-dynamics problems stand on.

A URDF with ``(q, qd, qdd)``, the segments of a motion suit and the links of a musculoskeletal model all reduce to it: poses, velocities and
accelerations of links, joint centres, and axes where they are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.models.state_noise import StateNoise
from factorgrasp.problems.link_motion_check import check_masses, check_names, check_rotations, check_tree
from factorgrasp.problems.link_motion_parts import BodyTree, LinkJoint, LinkKinematics
from factorgrasp.problems.link_motion_spatial import (
    cross_motion,
    motion_transform,
    rotate,
    rotate_back,
    skew,
    spatial_inertia,
)
from factorgrasp.typing import BoolArray, FloatArray, IntArray

__all__ = [
    "GRAVITY",
    "BodyTree",
    "LinkJoint",
    "LinkKinematics",
    "LinkMotion",
    "StateNoise",
    "spherical_subspace",
]

GRAVITY = (0.0, 0.0, -9.80665)


@dataclass(frozen=True)
class LinkMotion:
    """Motion of the links of one articulated body over n frames, in world axes.

    Attributes
    ----------
    t : ndarray
        (n,) s.
    links : tuple of str
    mass : ndarray
        (L,) kg.
    com : ndarray
        (L, 3) centre of mass in the link's frame, m.
    inertia : ndarray
        (L, 3, 3) about the centre of mass, in the link's axes, kg m^2.
    R : ndarray
        (n, L, 3, 3) ``R_w_l``, link to world.
    p : ndarray
        (n, L, 3) origin of the link in the world, m.
    velocity, angular_velocity : ndarray
        (n, L, 3) of the link's origin, m/s and rad/s, in the world.
    acceleration, angular_acceleration : ndarray
        (n, L, 3) of the link's origin (the classical one, without gravity), m/s^2 and rad/s^2, in the world.
    joints : tuple of LinkJoint
        One less than links.
    joint_centre : ndarray
        (n, J, 3) in the world, m.
    joint_acceleration : ndarray or None
        (n, dofs) ``qdd`` of all joints with known axes, in the order of `joints`; None: derived from the links.
    base : {"floating", "fixed"}
        Whether the root link moves freely or has a given acceleration.
    gravity : ndarray
        (3,) in the world, m/s^2.
    state_noise : StateNoise or None
        Covariance of the configurations that the motion was computed from; the axes of all joints must be known then. None: the poses are
        taken to be exact. :meth:`with_state_noise` adds it.
    """

    t: FloatArray
    links: tuple[str, ...]
    mass: FloatArray
    com: FloatArray
    inertia: FloatArray
    R: FloatArray
    p: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    acceleration: FloatArray
    angular_acceleration: FloatArray
    joints: tuple[LinkJoint, ...]
    joint_centre: FloatArray
    joint_acceleration: FloatArray | None = None
    base: Literal["floating", "fixed"] = "floating"
    gravity: FloatArray = field(default_factory=lambda: np.array(GRAVITY))
    state_noise: StateNoise | None = None

    def __post_init__(self) -> None:
        count, links, joints = np.size(self.t), len(self.links), len(self.joints)
        shapes: dict[str, tuple[int, ...]] = {
            "t": (count,), "mass": (links,), "com": (links, 3), "inertia": (links, 3, 3), "R": (count, links, 3, 3),
            "p": (count, links, 3), "velocity": (count, links, 3), "angular_velocity": (count, links, 3),
            "acceleration": (count, links, 3), "angular_acceleration": (count, links, 3),
            "joint_centre": (count, joints, 3), "gravity": (3,),
        }  # fmt: skip
        if self.joint_acceleration is not None:
            shapes["joint_acceleration"] = (count, sum(joint.size for joint in self.joints))
        for name, shape in shapes.items():
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != shape:
                raise InputError(f"{name} of the link motion", f"shape {shape}", str(value.shape))
            object.__setattr__(self, name, value)
        if not np.all(np.isfinite(self.t)) or (count > 1 and np.any(np.diff(self.t) <= 0.0)):
            raise InputError("t of the link motion", "increasing seconds", "NaN, infinity or a step back")
        if self.base not in ("floating", "fixed"):
            raise InputError("base of the link motion", "'floating' or 'fixed'", repr(self.base))
        check_names(self.links, "links")
        check_names([joint.name for joint in self.joints], "joints")
        check_names([dof for joint in self.joints for dof in joint.dofs], "degrees of freedom")
        check_masses(self.links, self.mass, self.com, self.inertia)
        check_rotations(self.R, self.links)
        object.__setattr__(
            self, "_root", check_tree(self.links, [j.name for j in self.joints], self.parents, self.children)
        )
        for joint in self.joints:
            if joint.subspace is not None and joint.subspace.ndim == 3 and joint.subspace.shape[0] != count:
                raise InputError(
                    f"subspace of joint {joint.name}", f"{count} frames", str(joint.subspace.shape[0])
                )
        if self.state_noise is not None:
            self._check_state_noise(self.state_noise)

    def _check_state_noise(self, noise: StateNoise) -> None:
        blind = [joint.name for joint in self.joints if not joint.dofs]
        if blind:
            raise InputError(
                "state noise of the motion", "joints with known axes", ", ".join(blind[:5]) + ", of which only the centre is known",
                "Declare them as ball joints",
            )  # fmt: skip
        noise.check(6 * (self.base == "floating") + len(self.dof_names), len(self))

    def with_state_noise(self, noise: StateNoise | None) -> LinkMotion:
        """The same motion with the noise of its configurations; all that is computed already stays so."""
        if noise is not None:
            self._check_state_noise(noise)
        out = copy(self)
        object.__setattr__(out, "state_noise", noise)
        return out

    # ---- structure --------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def root(self) -> int:
        """Index of the root link."""
        return int(self.__dict__["_root"])

    @property
    def parents(self) -> IntArray:
        """(J,) link above every joint."""
        return np.array([joint.parent for joint in self.joints], dtype=np.intp)

    @property
    def children(self) -> IntArray:
        """(J,) link below every joint."""
        return np.array([joint.child for joint in self.joints], dtype=np.intp)

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names of all degrees of freedom with known axes."""
        return tuple(dof for joint in self.joints for dof in joint.dofs)

    @property
    def total_mass(self) -> float:
        """Kg."""
        return float(self.mass.sum())

    def link(self, name: str) -> int:
        """Index of a link by its name."""
        if name not in self.links:
            raise InputError("link", "one of " + ", ".join(self.links), repr(name))
        return self.links.index(name)

    def joint(self, name: str) -> int:
        """Index of a joint by its name."""
        names = [joint.name for joint in self.joints]
        if name not in names:
            raise InputError("joint", "one of " + ", ".join(names), repr(name))
        return names.index(name)

    def select(self, frames: slice | Sequence[int] | BoolArray | IntArray) -> LinkMotion:
        """The same body at some of the frames."""
        index = np.arange(len(self))[frames]
        joints = tuple(
            joint
            if joint.subspace is None or joint.subspace.ndim == 2
            else replace(joint, subspace=joint.subspace[index])
            for joint in self.joints
        )
        names = (
            "t",
            "R",
            "p",
            "velocity",
            "angular_velocity",
            "acceleration",
            "angular_acceleration",
            "joint_centre",
        )
        parts = {name: getattr(self, name)[index] for name in names}
        qdd = None if self.joint_acceleration is None else self.joint_acceleration[index]
        noise = None if self.state_noise is None else self.state_noise.select(index)
        return replace(self, joints=joints, joint_acceleration=qdd, state_noise=noise, **parts)

    @property
    def tree(self) -> BodyTree:
        """What of the body does not move."""
        return BodyTree(
            self.links, tuple(joint.name for joint in self.joints), self.spatial_inertia, self.mass, self.parents, self.children,
            tuple(joint.dofs for joint in self.joints),
            tuple(None if joint.subspace is None or joint.subspace.ndim == 3 else joint.subspace for joint in self.joints),
            self.root, self.base == "fixed",
        )  # fmt: skip

    # ---- body-frame quantities --------------------------------------------------------------------------------

    @cached_property
    def spatial_inertia(self) -> FloatArray:
        """(L, 6, 6) about the links' origins."""
        return spatial_inertia(self.mass, self.com, self.inertia)

    @cached_property
    def spatial_velocity(self) -> FloatArray:
        """(n, L, 6) ``v_i``, in the link's frame."""
        return np.concatenate(
            [rotate_back(self.R, self.velocity), rotate_back(self.R, self.angular_velocity)], axis=-1
        )

    @cached_property
    def proper_acceleration(self) -> FloatArray:
        """(n, L, 6) ``alpha_i = R' [a - w x v - g; dw/dt]``: spatial acceleration minus gravity, in the link's frame."""
        linear = self.acceleration - np.cross(self.angular_velocity, self.velocity) - self.gravity
        return np.concatenate(
            [rotate_back(self.R, linear), rotate_back(self.R, self.angular_acceleration)], axis=-1
        )

    @cached_property
    def joint_transform(self) -> FloatArray:
        """(n, J, 6, 6) ``X_cp``: motion vectors of the parent's frame in the child's frame."""
        R_p, R_c = self.R[:, self.parents], self.R[:, self.children]
        R_c_p = np.swapaxes(R_c, -1, -2) @ R_p
        return motion_transform(R_c_p, rotate_back(R_p, self.p[:, self.children] - self.p[:, self.parents]))

    @cached_property
    def subspaces(self) -> tuple[FloatArray | None, ...]:
        """``S_j`` of every joint, (1 or n, 6, n_j)."""
        return tuple(
            None if joint.subspace is None else joint.subspace.reshape(-1, 6, joint.size)
            for joint in self.joints
        )

    @cached_property
    def qdd(self) -> FloatArray:
        """(n, dofs) joint accelerations: those given, else the ones that fit the accelerations of the links best.

        The fit takes the bias to be ``v x S qd``: exact for axes that are fixed in the child. Whatever it is,
        :attr:`joint_bias` belongs to it,
        so that the links' accelerations are met all the same.
        """
        if self.joint_acceleration is not None:
            return self.joint_acceleration
        relative = self._relative_acceleration - self._constant_axes_bias
        parts = [
            (np.linalg.pinv(S) @ relative[:, j, :, None])[..., 0]
            for j, S in enumerate(self.subspaces)
            if S is not None
        ]
        return np.concatenate(parts, axis=1) if parts else np.zeros((len(self), 0))

    @cached_property
    def joint_bias(self) -> FloatArray:
        """(n, J, 6) ``c_j = alpha_i - X alpha_p - S_j qdd_j``, exactly ``Sdot qd + v_i x S_j qd_j`` of this motion; NaN without axes."""
        out = self._relative_acceleration.copy()
        first = 0
        for j, S in enumerate(self.subspaces):
            if S is None:
                out[:, j] = np.nan
                continue
            out[:, j] -= (S @ self.qdd[:, first : first + S.shape[2], None])[..., 0]
            first += S.shape[2]
        return out

    @cached_property
    def _relative_acceleration(self) -> FloatArray:
        alpha = self.proper_acceleration
        return np.asarray(
            alpha[:, self.children] - (self.joint_transform @ alpha[:, self.parents, :, None])[..., 0]
        )

    @cached_property
    def _constant_axes_bias(self) -> FloatArray:
        v = self.spatial_velocity
        v_child = v[:, self.children]
        v_joint = v_child - (self.joint_transform @ v[:, self.parents, :, None])[..., 0]
        return cross_motion(v_child, v_joint)

    def kinematics(self, frames: slice = slice(None)) -> LinkKinematics:
        """All of it for some of the frames."""
        return self._kinematics.select(frames)

    @cached_property
    def _kinematics(self) -> LinkKinematics:
        count = len(self)
        columns = [
            np.broadcast_to(np.swapaxes(S, 1, 2), (count, S.shape[2], 6))
            for S in self.subspaces
            if S is not None
        ]
        axes = np.concatenate(columns, axis=1) if columns else np.zeros((count, 0, 6))
        return LinkKinematics(
            self.R, self.p, self.spatial_velocity, self.proper_acceleration, self.joint_transform, self.joint_bias,
            axes, tuple(joint.size for joint in self.joints), self.qdd, self.joint_centre,
        )  # fmt: skip

    # ---- the whole body ---------------------------------------------------------------------------------------

    @cached_property
    def com_positions(self) -> FloatArray:
        """(n, L, 3) centres of mass in the world, m."""
        return self.p + rotate(self.R, self.com)

    @cached_property
    def body_com(self) -> FloatArray:
        """(n, 3) centre of mass of the whole body in the world, m."""
        return np.asarray(np.einsum("l,nlk->nk", self.mass, self.com_positions) / self.total_mass)

    @cached_property
    def momentum_rate(self) -> FloatArray:
        """(n, 6) ``hdot_G - w``: full rate of the centroidal momentum minus weight, about the body's centre of mass, world axes.

        ``sum_i [m a_ci - m g; (c_i - c_G) x m (a_ci - g) + I_i dw_i + w_i x I_i w_i]`` (mathematics 4.2); it equals the sum of
        the external wrenches.
        """
        arm = rotate(self.R, self.com)
        w, dw = self.angular_velocity, self.angular_acceleration
        a = self.acceleration + np.cross(dw, arm) + np.cross(w, np.cross(w, arm)) - self.gravity
        force = self.mass[:, None] * a
        I_w = self.R @ self.inertia @ np.swapaxes(self.R, -1, -2)
        spin = rotate(I_w, dw) + np.cross(w, rotate(I_w, w))
        moment = np.cross(self.com_positions - self.body_com[:, None], force) + spin
        return np.concatenate([force.sum(axis=1), moment.sum(axis=1)], axis=-1)

    # ---- other makers -----------------------------------------------------------------------------------------

    @classmethod
    def from_com_motion(
        cls,
        *,
        com_velocity: ArrayLike,
        com_acceleration: ArrayLike,
        angular_velocity: ArrayLike,
        angular_acceleration: ArrayLike,
        R: ArrayLike,
        com: ArrayLike,
        **others: object,
    ) -> LinkMotion:
        """The motion when velocities and accelerations are those of the centres of mass (n, L, 3), in the world."""
        R_w, w = np.asarray(R, dtype=float), np.asarray(angular_velocity, dtype=float)
        dw = np.asarray(angular_acceleration, dtype=float)
        arm = rotate(R_w, np.broadcast_to(np.asarray(com, dtype=float), w.shape))
        v = np.asarray(com_velocity, dtype=float) - np.cross(w, arm)
        a = np.asarray(com_acceleration, dtype=float) - np.cross(dw, arm) - np.cross(w, np.cross(w, arm))
        return cls(
            R=R_w, com=np.asarray(com, dtype=float), velocity=v, acceleration=a, angular_velocity=w, angular_acceleration=dw,
            **others,  # type: ignore[arg-type]
        )  # fmt: skip


def spherical_subspace(motion_R: FloatArray, p: FloatArray, centre: FloatArray, child: int) -> FloatArray:
    """``S`` (n, 6, 3) of a ball joint at `centre` (n, 3) with the child's own axes: ``[S(r); 1]``, r the centre in the child's frame."""
    r = rotate_back(motion_R[:, child], centre - p[:, child])
    return np.concatenate([skew(r), np.broadcast_to(np.eye(3), (*r.shape, 3))], axis=-2)

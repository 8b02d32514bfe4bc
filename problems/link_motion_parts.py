"""Parts of a link motion: joints, the tree they make, and body-frame kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray, IntArray


@dataclass(frozen=True)
class LinkJoint:
    """A joint between two links, with 1 to 6 degrees of freedom.

    Attributes
    ----------
    name : str
    parent, child : int
        Indices of the links.
    dofs : tuple of str
        A name for every degree of freedom; empty when its axes are unknown, and then only the joint moment vector is estimated.
    subspace : ndarray or None
        ``S_j``, (6, n_j) or, where the axes move in the child, (n, 6, n_j): ``v_child - X v_parent = S_j qd_j``, in the child's frame.
    """

    name: str
    parent: int
    child: int
    dofs: tuple[str, ...] = ()
    subspace: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.subspace is None:
            if self.dofs:
                raise InputError(
                    f"subspace of joint {self.name}",
                    f"(6, {len(self.dofs)}) for its degrees of freedom",
                    "none",
                )
            return
        S = np.asarray(self.subspace, dtype=float)
        object.__setattr__(self, "subspace", S)
        if S.ndim not in (2, 3) or S.shape[-2:] != (6, len(self.dofs)) or not 1 <= len(self.dofs) <= 6:
            raise InputError(
                f"subspace of joint {self.name}",
                f"shape (6, n) or (frames, 6, n) with n = {len(self.dofs)} from 1 to 6",
                str(S.shape),
            )

    @property
    def size(self) -> int:
        """Number of degrees of freedom whose axes are known."""
        return len(self.dofs)


@dataclass(frozen=True)
class LinkKinematics:
    """What the equations of motion need of n frames, in the links' own frames; spatial vectors are ``[linear; angular]``.

    Attributes
    ----------
    R, p : ndarray
        (n, L, 3, 3) ``R_w_l`` and (n, L, 3) origin in the world.
    velocity : ndarray
        (n, L, 6) ``v_i``.
    acceleration : ndarray
        (n, L, 6) ``alpha_i``, proper (minus gravity).
    transform : ndarray
        (n, J, 6, 6) ``X`` from the parent's to the child's frame.
    bias : ndarray
        (n, J, 6) ``c_j``.
    axes : ndarray
        (n, dofs, 6) columns of all ``S_j``, joint after joint, each in its child's frame.
    sizes : tuple of int
        Degrees of freedom of every joint; 0 where the axes are unknown.
    joint_acceleration : ndarray
        (n, dofs).
    joint_centre : ndarray
        (n, J, 3) in the world.
    external_wrench, joint_wrench : ndarray or None
        (n, L, 6) and (n, J, 6): wrenches at which errors of poses are linearised, where the motion's poses have errors.
    """

    R: FloatArray
    p: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    transform: FloatArray
    bias: FloatArray
    axes: FloatArray
    sizes: tuple[int, ...]
    joint_acceleration: FloatArray
    joint_centre: FloatArray
    external_wrench: FloatArray | None = None
    joint_wrench: FloatArray | None = None

    @property
    def count(self) -> int:
        """Number of frames."""
        return int(self.R.shape[0])

    @cached_property
    def subspaces(self) -> tuple[FloatArray | None, ...]:
        """``S_j``, (n, 6, n_j) by joint; None where the axes are unknown."""
        ends = np.cumsum(self.sizes)
        return tuple(
            np.swapaxes(self.axes[:, end - size : end], 1, 2) if size else None
            for end, size in zip(ends, self.sizes, strict=True)
        )

    def select(self, frames: slice) -> LinkKinematics:
        """Some of the frames."""
        return LinkKinematics(
            self.R[frames], self.p[frames], self.velocity[frames], self.acceleration[frames], self.transform[frames], self.bias[frames],
            self.axes[frames], self.sizes, self.joint_acceleration[frames], self.joint_centre[frames],
            None if self.external_wrench is None else self.external_wrench[frames],
            None if self.joint_wrench is None else self.joint_wrench[frames],
        )  # fmt: skip


@dataclass(frozen=True)
class BodyTree:
    """What of an articulated body does not move: links, joints and how they hang together.

    Attributes
    ----------
    links, joints : tuple of str
    spatial_inertia : ndarray
        (L, 6, 6) about the links' origins.
    mass : ndarray
        (L,) kg.
    parents, children : ndarray
        (J,) links of every joint.
    dofs : tuple of tuple of str
        By joint; empty where the axes are unknown.
    subspaces : tuple of ndarray or None
        (6, n_j) by joint where it does not change over time, else None.
    root : int
    fixed_base : bool
    """

    links: tuple[str, ...]
    joints: tuple[str, ...]
    spatial_inertia: FloatArray
    mass: FloatArray
    parents: IntArray
    children: IntArray
    dofs: tuple[tuple[str, ...], ...]
    subspaces: tuple[FloatArray | None, ...]
    root: int
    fixed_base: bool

    @cached_property
    def from_leaves(self) -> tuple[int, ...]:
        """Joints in an order in which every joint comes before the one above it."""
        order: list[int] = []
        left = set(range(len(self.joints)))
        while left:
            ready = [
                j for j in sorted(left) if not any(self.parents[other] == self.children[j] for other in left)
            ]
            order += ready
            left -= set(ready)
        return tuple(order)

    @cached_property
    def paths(self) -> tuple[tuple[int, ...], ...]:
        """By link, the joints between it and the root, nearest first."""
        above = {int(child): j for j, child in enumerate(self.children)}
        out = []
        for link in range(len(self.links)):
            path, at = [], link
            while at in above:
                path.append(above[at])
                at = int(self.parents[above[at]])
            out.append(tuple(path))
        return tuple(out)

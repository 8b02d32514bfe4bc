"""Link motion from a pinocchio model (a URDF) with joint positions, velocities and accelerations.

Chains of joints through links without mass, which is how URDFs write joints of several degrees of freedom, become one joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.problems import link_motion_kernels
from factorgrasp.problems.link_motion import GRAVITY, BodyTree, LinkJoint, LinkKinematics, LinkMotion
from factorgrasp.problems.link_motion_spatial import (
    cross_motion,
    motion_transform,
    rotate,
    rotate_back,
    skew,
    spatial_inertia,
)
from factorgrasp.typing import FloatArray, IntArray

FEW_FRAMES = 4
"""Up to so many frames pinocchio computes the kinematics frame by frame; above, numpy does it for all frames at once."""


@dataclass(frozen=True)
class _Chain:
    """One of our joints: the pinocchio joints that it is made of, from the parent's side to the child."""

    members: tuple[int, ...]
    parent: int
    child: int


class PinocchioTree:
    """The links and joints of a pinocchio model, and their kinematics.

    Parameters
    ----------
    model : pinocchio.Model
        With or without a free-flyer as first joint; URDF links that a fixed joint attaches are part of the link they hang on.
    merge_massless : bool
        Join chains of joints through links without mass and inertia into one joint of up to six degrees of freedom.
    gravity : (3,) array_like
        In the world, m/s^2.
    compiled : bool, optional
        False: do without the compiled loop even where numba is installed.

    Raises
    ------
    InputError
        For a model without joints, with unnamed joints or links, or with masses and inertias that no body has.
    """

    def __init__(
        self,
        model: Any,
        merge_massless: bool = True,
        gravity: ArrayLike = GRAVITY,
        compiled: bool | None = None,
    ) -> None:
        self.model, self.gravity = model, np.asarray(gravity, dtype=float)
        self._data = model.createData()
        if model.njoints < 2:
            raise InputError("model", "at least one joint", "none")
        self.floating = "FreeFlyer" in model.joints[1].shortname() and int(model.parents[1]) == 0
        massless = [
            merge_massless
            and i > int(self.floating)
            and model.inertias[i].mass == 0.0
            and not np.any(model.inertias[i].inertia)
            for i in range(model.njoints)
        ]
        below: list[list[int]] = [[] for _ in range(model.njoints)]
        for i in range(1, model.njoints):
            below[int(model.parents[i])].append(i)
        self._kept = [
            i
            for i in range(model.njoints)
            if not (massless[i] and len(below[i]) == 1) and (i or not self.floating)
        ]
        place = {i: k for k, i in enumerate(self._kept)}
        self._chains: list[_Chain] = []
        for i in self._kept:
            if i == self._kept[0]:
                continue
            members, parent = [i], int(model.parents[i])
            while parent not in place:
                members.append(parent)
                parent = int(model.parents[parent])
            self._chains.append(_Chain(tuple(reversed(members)), place[parent], place[i]))
        self.links = tuple(_link_name(model, i) for i in self._kept)
        self.joint_names = tuple(
            str(model.names[c.members[-1]]) if len(c.members) == 1 else _chain_name(model, c)
            for c in self._chains
        )
        self.mass = np.array([model.inertias[i].mass for i in self._kept])
        self.com = np.array([model.inertias[i].lever for i in self._kept])
        self.inertia = np.array([model.inertias[i].inertia for i in self._kept])
        for i, link in zip(self._kept, self.links, strict=True):
            if not np.isfinite(model.inertias[i].mass) or model.inertias[i].mass < 0.0:
                raise InputError(
                    f"mass of {link}", "a finite mass of at least 0 kg", f"{model.inertias[i].mass:.6g} kg"
                )
        self._joint_kinds = [None, *(_JointKind(model, i) for i in range(1, model.njoints))]
        self._columns = [
            np.concatenate([np.arange(model.idx_vs[m], model.idx_vs[m] + model.nvs[m]) for m in c.members])
            for c in self._chains
        ]
        self._fixed_subspaces = [
            self._kind(c.members[0]).subspace if len(c.members) == 1 else None for c in self._chains
        ]
        self._dofs = tuple(
            tuple(name for m in c.members for name in _dof_names(model, m)) for c in self._chains
        )
        self._child_of_column = np.concatenate(
            [np.full(c.size, chain.child) for c, chain in zip(self._columns, self._chains, strict=True)]
        )
        self._all_columns: IntArray = np.concatenate(self._columns)
        self._sizes = tuple(int(c.size) for c in self._columns)
        self._starts = np.cumsum([0, *self._sizes[:-1]])
        self.parents: IntArray = np.array([c.parent for c in self._chains], dtype=np.int64)
        self.children: IntArray = np.array([c.child for c in self._chains], dtype=np.int64)
        self._compiled = compiled is not False and all(
            kind.kind in link_motion_kernels.KINDS for kind in self._joint_kinds[1:] if kind
        )
        self._constants = self._kernel_constants()
        self._quaternions = [
            int(model.idx_qs[i]) + (3 if self._kind(i).kind == "freeflyer" else 0)
            for i in range(1, model.njoints)
            if self._kind(i).kind in ("spherical", "freeflyer")
        ]

    @property
    def tree(self) -> BodyTree:
        """What of the body does not move."""
        return BodyTree(
            self.links, self.joint_names, spatial_inertia(self.mass, self.com, self.inertia), self.mass, self.parents, self.children,
            self._dofs, tuple(self._fixed_subspaces), 0, not self.floating,
        )  # fmt: skip

    @property
    def columns(self) -> tuple[IntArray, ...]:
        """Of every joint: the components of pinocchio's velocities that belong to it."""
        return tuple(self._columns)

    @property
    def tangent_columns(self) -> IntArray:
        """(k,) where the components of a :class:`~factorgrasp.problems.link_motion.StateNoise` stand in pinocchio's tangent vector."""
        return np.concatenate([np.arange(6 if self.floating else 0), self._all_columns]).astype(np.intp)

    def motion(self, t: ArrayLike, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> LinkMotion:
        """Link motion of n frames.

        Parameters
        ----------
        t : (n,) array_like
            s.
        q : (n, nq) array_like
            In pinocchio's order and units (quaternions ``[x, y, z, w]``).
        qd, qdd : (n, nv) array_like
            Tangent velocities and accelerations; those of a free-flyer are in its own frame.
        """
        k = self.kinematics(q, qd, qdd)
        linear, angular = k.velocity[..., :3], k.velocity[..., 3:]
        a = rotate(k.R, k.acceleration[..., :3] + np.cross(angular, linear)) + self.gravity
        joints = tuple(
            LinkJoint(name, c.parent, c.child, dofs, S if fixed is None or S is None else fixed)
            for name, c, dofs, S, fixed in zip(
                self.joint_names, self._chains, self._dofs, k.subspaces, self._fixed_subspaces, strict=True
            )
        )
        motion = LinkMotion(
            t=np.atleast_1d(np.asarray(t, dtype=float)), links=self.links, mass=self.mass, com=self.com, inertia=self.inertia,
            R=k.R, p=k.p, velocity=rotate(k.R, linear), angular_velocity=rotate(k.R, angular), acceleration=a,
            angular_acceleration=rotate(k.R, k.acceleration[..., 3:]), joints=joints, joint_centre=k.joint_centre,
            joint_acceleration=k.joint_acceleration, base="floating" if self.floating else "fixed", gravity=self.gravity,
        )  # fmt: skip
        # Known already: no need to derive it from the world's quantities again.
        motion.__dict__["_kinematics"] = k
        return motion

    def kinematics(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> LinkKinematics:
        """The same as body-frame quantities, which is all that the equations of motion need."""
        positions, v, a = (np.atleast_2d(np.asarray(x, dtype=float)) for x in (q, qd, qdd))
        for name, value, width in (
            ("q", positions, self.model.nq),
            ("qd", v, self.model.nv),
            ("qdd", a, self.model.nv),
        ):
            if value.ndim != 2 or value.shape[1] != width or value.shape[0] != positions.shape[0]:
                raise InputError(name, f"shape ({positions.shape[0]}, {width})", str(value.shape))
        kernel = link_motion_kernels.load() if self._compiled else None
        if kernel is not None:
            return self._by_kernel(kernel.kinematics, positions, v, a)
        by_frame = positions.shape[0] <= FEW_FRAMES and np.all(np.isfinite(positions))
        R, p, vel, acc, axes = (self._by_frame if by_frame else self._vectorised)(positions, v, a)
        acc[..., :3] -= rotate_back(R, np.broadcast_to(self.gravity, p.shape))
        up, down = self.parents, self.children
        R_c_p = np.swapaxes(R[:, down], -1, -2) @ R[:, up]
        X = motion_transform(R_c_p, rotate_back(R[:, up], p[:, down] - p[:, up]))
        qdd_ours = a[:, self._all_columns]
        bias = acc[:, down] - (X @ acc[:, up, :, None])[..., 0]
        bias -= np.add.reduceat(axes * qdd_ours[:, :, None], self._starts, axis=1)
        return LinkKinematics(R, p, vel, acc, X, bias, axes, self._sizes, qdd_ours, p[:, down])

    def _by_kernel(self, kernel: Any, q: FloatArray, v: FloatArray, a: FloatArray) -> LinkKinematics:
        count, links, joints, dofs = q.shape[0], len(self._kept), len(self._chains), self._all_columns.size
        for at in self._quaternions:
            _check_quaternions(q[:, at : at + 4])
        R, p, vel, acc = (
            np.empty((count, links, 3, 3)),
            np.empty((count, links, 3)),
            np.empty((count, links, 6)),
            np.empty((count, links, 6)),
        )
        X, bias, axes = (
            np.empty((count, joints, 6, 6)),
            np.empty((count, joints, 6)),
            np.empty((count, dofs, 6)),
        )
        kernel(*self._constants[:7], q, v, a, *self._constants[7:], R, p, vel, acc, X, bias, axes)
        return LinkKinematics(
            R, p, vel, acc, X, bias, axes, self._sizes, a[:, self._all_columns], p[:, self._constants[10]]
        )

    # ---- internals --------------------------------------------------------------------------------------------

    def _kernel_constants(self) -> tuple[Any, ...]:
        model, kinds = self.model, link_motion_kernels.KINDS
        number = model.njoints
        codes, axes = np.zeros(number, dtype=np.int64), np.zeros((number, 3))
        for i in range(1, number):
            one = self._kind(i)
            codes[i] = kinds.get(one.kind, 0)
            axes[i] = 0.0 if one.axis is None else one.axis
        R = np.array([np.asarray(model.jointPlacements[i].rotation) for i in range(number)])
        p = np.array([np.asarray(model.jointPlacements[i].translation) for i in range(number)])
        columns = [
            (m, part, c)
            for c, chain in enumerate(self._chains)
            for m in chain.members
            for part in range(int(model.nvs[m]))
        ]
        joint, part, owner = (np.array(column, dtype=np.int64) for column in zip(*columns, strict=True))

        def whole(values: Any) -> IntArray:
            return np.array([int(values[i]) for i in range(number)], dtype=np.int64)

        return (
            codes, axes, R, p, whole(model.parents), whole(model.idx_qs), whole(model.idx_vs), self.gravity,
            np.array(self._kept, dtype=np.int64), self.parents, self.children, joint, part, owner, self._all_columns.astype(np.int64),
        )  # fmt: skip

    def _kind(self, joint: int) -> _JointKind:
        kind = self._joint_kinds[joint]
        assert kind is not None
        return kind

    def _by_frame(self, q: FloatArray, v: FloatArray, a: FloatArray) -> tuple[FloatArray, ...]:
        import pinocchio as pin

        model, data, kept = self.model, self._data, self._kept
        count, links = q.shape[0], len(kept)
        H = np.empty((count, links, 4, 4))
        vel, acc = np.zeros((count, links, 6)), np.zeros((count, links, 6))
        J = np.empty((count, 6, model.nv))
        start = 0 if self.floating else 1
        for f in range(count):
            pin.forwardKinematics(model, data, q[f], v[f], a[f])
            pin.computeJointJacobians(model, data)
            J[f] = data.J
            oMi, speeds, accelerations = data.oMi, data.v, data.a
            for k, i in enumerate(kept):
                H[f, k] = oMi[i].homogeneous
            for k in range(start, links):
                vel[f, k] = speeds[kept[k]].vector
                acc[f, k] = accelerations[kept[k]].vector
        R, p = H[..., :3, :3].copy(), H[..., :3, 3].copy()
        # Columns of the world-frame Jacobian, moved into the frames of the children.
        R_c, p_c = R[:, self._child_of_column], p[:, self._child_of_column]
        columns = np.swapaxes(J[:, :, self._all_columns], 1, 2)
        w = columns[..., 3:]
        S = np.concatenate(
            [rotate_back(R_c, columns[..., :3] + np.cross(w, p_c)), rotate_back(R_c, w)], axis=-1
        )
        return R, p, vel, acc, S

    def _vectorised(self, q: FloatArray, v: FloatArray, a: FloatArray) -> tuple[FloatArray, ...]:
        model, count = self.model, q.shape[0]
        R: list[FloatArray] = [np.broadcast_to(np.eye(3), (count, 3, 3))]
        p: list[FloatArray] = [np.zeros((count, 3))]
        vel: list[FloatArray] = [np.zeros((count, 6))]
        acc: list[FloatArray] = [np.zeros((count, 6))]
        own: list[FloatArray] = [np.zeros((1, 6, 0))]
        for i in range(1, model.njoints):
            up, kind = int(model.parents[i]), self._kind(i)
            iq, iv = model.idx_qs[i], model.idx_vs[i]
            rate, second = v[:, iv : iv + kind.nv], a[:, iv : iv + kind.nv]
            R_j, p_j, S, c = kind.motion(q[:, iq : iq + kind.nq], rate, q, v)
            placement = model.jointPlacements[i]
            R_up = placement.rotation @ R_j
            p_up = placement.translation + p_j @ placement.rotation.T
            R.append(R[up] @ R_up)
            p.append(p[up] + rotate(R[up], p_up))
            v_joint = (S @ rate[:, :, None])[..., 0]
            vel.append(_into(R_up, p_up, vel[up]) + v_joint)
            acc.append(
                _into(R_up, p_up, acc[up])
                + (S @ second[:, :, None])[..., 0]
                + c
                + cross_motion(vel[i], v_joint)
            )
            own.append(S)
        S_all: list[FloatArray] = []
        for chain in self._chains:
            end = chain.members[-1]
            for m in chain.members:
                if m == end:
                    S_all.append(np.swapaxes(np.broadcast_to(own[m], (count, *own[m].shape[1:])), 1, 2))
                else:
                    R_e_m = np.swapaxes(R[end], 1, 2) @ R[m]
                    X = motion_transform(R_e_m, rotate_back(R[m], p[end] - p[m]))
                    S_all.append(np.swapaxes(X @ own[m], 1, 2))
        kept = self._kept
        return (
            np.stack([R[i] for i in kept], axis=1), np.stack([p[i] for i in kept], axis=1),
            np.stack([vel[i] for i in kept], axis=1), np.stack([acc[i] for i in kept], axis=1),
            np.concatenate(S_all, axis=1),
        )  # fmt: skip


def from_pinocchio(
    model: Any, t: ArrayLike, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, merge_massless: bool = True
) -> LinkMotion:
    """Link motion of a pinocchio model, fixed or floating base; see :class:`PinocchioTree`."""
    return PinocchioTree(model, merge_massless).motion(t, q, qd, qdd)


class _JointKind:
    """Placement, motion subspace and bias of one joint, for many frames at once."""

    def __init__(self, model: Any, index: int) -> None:
        joint = model.joints[index]
        self._joint, self._name = joint, joint.shortname()
        self.nq, self.nv = int(joint.nq), int(joint.nv)
        self.axis: FloatArray | None = None
        self.kind = "other"
        name = self._name.removeprefix("JointModel")
        if name in ("RX", "RY", "RZ", "PX", "PY", "PZ", "RUBX", "RUBY", "RUBZ"):
            self.axis = np.eye(3)["XYZ".index(name[-1])]
            self.kind = {"RU": "unbounded", "PX": "prismatic", "PY": "prismatic", "PZ": "prismatic"}.get(
                name[:2], "revolute"
            )
        elif name in ("RevoluteUnaligned", "RevoluteUnboundedUnaligned", "PrismaticUnaligned"):
            # Through the data: the bindings offer the axis of the generic joint under no name.
            data = joint.createData()
            joint.calc(data, neutral(model), np.zeros(model.nv))
            column = np.asarray(data.S).ravel()
            prismatic = name == "PrismaticUnaligned"
            self.axis = column[:3] if prismatic else column[3:]
            self.kind = "prismatic" if prismatic else ("unbounded" if "Unbounded" in name else "revolute")
        elif name in ("Spherical", "FreeFlyer", "Translation"):
            self.kind = name.lower()
        self.subspace = self._constant_subspace()

    def _constant_subspace(self) -> FloatArray | None:
        zero, one = np.zeros((3, 3)), np.eye(3)
        if self.axis is not None:
            parts = (self.axis, np.zeros(3)) if self.kind == "prismatic" else (np.zeros(3), self.axis)
            return np.concatenate(parts)[:, None]
        return {
            "spherical": np.vstack([zero, one]), "translation": np.vstack([one, zero]), "freeflyer": np.eye(6)
        }.get(self.kind)  # fmt: skip

    def motion(
        self, q: FloatArray, v: FloatArray, whole_q: FloatArray, whole_v: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """R (n, 3, 3), p (n, 3), S (1 or n, 6, nv) and bias (n, 6) of the joint's child frame in its parent frame."""
        count = q.shape[0]
        R, p = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3))
        S = None if self.subspace is None else self.subspace[None]
        if S is None:
            return self._frame_by_frame(whole_q, whole_v)
        if self.axis is not None:
            if self.kind == "prismatic":
                p = q * self.axis
            else:
                cosine, sine = (np.cos(q), np.sin(q)) if self.kind == "revolute" else (q[:, :1], q[:, 1:])
                K = skew(self.axis)
                R = np.eye(3) + sine[:, :, None] * K + (1.0 - cosine)[:, :, None] * (K @ K)
        elif self.kind == "spherical":
            R = _from_xyzw(q)
        elif self.kind == "freeflyer":
            R, p = _from_xyzw(q[:, 3:]), q[:, :3]
        else:
            p = q
        return R, p, S, np.zeros((count, 6))

    def _frame_by_frame(
        self, q: FloatArray, v: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        data = self._joint.createData()
        count = q.shape[0]
        R, p = np.empty((count, 3, 3)), np.empty((count, 3))
        S, c = np.empty((count, 6, self.nv)), np.zeros((count, 6))
        for f in range(count):
            self._joint.calc(data, q[f], v[f])
            R[f], p[f] = data.M.rotation, data.M.translation
            S[f], c[f] = np.asarray(data.S).reshape(6, self.nv), data.c.vector
        return R, p, S, c


def _into(R: FloatArray, p: FloatArray, m: FloatArray) -> FloatArray:
    """``X m`` for the child frame at (R, p) in the frame of m."""
    linear = m[..., :3] + np.cross(m[..., 3:], p)
    return np.concatenate([rotate_back(R, linear), rotate_back(R, m[..., 3:])], axis=-1)


def _from_xyzw(q: FloatArray) -> FloatArray:
    """Rotations of unit quaternions ``[x, y, z, w]`` (n, 4)."""
    norm = _check_quaternions(q)
    e = q[:, :3] / norm[:, None]
    w = (q[:, 3] / norm)[:, None, None]
    K = skew(e)
    return np.asarray(np.eye(3) + 2.0 * w * K + 2.0 * (K @ K))


def _check_quaternions(q: FloatArray) -> FloatArray:
    norm = np.sqrt(np.einsum("ni,ni->n", q, q))
    bad = np.isfinite(norm) & (np.abs(norm - 1.0) > 1e-3)
    if bad.any():
        frame = int(np.flatnonzero(bad)[0])
        raise InputError(
            "quaternion in q", "unit length, [x, y, z, w]", f"length {norm[frame]:.4g} in frame {frame}"
        )
    return np.asarray(norm)


def neutral(model: Any) -> FloatArray:
    """The configuration (nq,) with all joints at zero."""
    import pinocchio as pin

    return np.asarray(pin.neutral(model))


def _link_name(model: Any, joint: int) -> str:
    import pinocchio as pin

    for frame in model.frames:
        if frame.parentJoint == joint and frame.type == pin.FrameType.BODY:
            return str(frame.name)
    return str(model.names[joint])


def _chain_name(model: Any, chain: _Chain) -> str:
    """The part that the names of the members share, or all of them."""
    names = [str(model.names[m]) for m in chain.members]
    common = names[0]
    for name in names[1:]:
        while not name.startswith(common):
            common = common[:-1]
    common = common.rstrip("_-. ")
    return common if len(common) >= 3 else "+".join(names)


def _dof_names(model: Any, joint: int) -> tuple[str, ...]:
    name, size = str(model.names[joint]), int(model.nvs[joint])
    if size == 1:
        return (name,)
    letters = {2: "xy", 3: "xyz", 6: ("tx", "ty", "tz", "rx", "ry", "rz")}.get(size)
    return tuple(f"{name}_{part}" for part in (letters or range(size)))

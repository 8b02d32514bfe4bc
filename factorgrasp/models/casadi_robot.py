"""A robot as CasADi expressions: kinematics and dynamics of any tree that a ``pinocchio.Model`` describes.

The recursions of Featherstone (Rigid Body Dynamics Algorithms, 2008), written out symbolically. Everything is in the units and in the order
of the pinocchio model: configuration q (nq,), velocity v and acceleration a (nv,), frames by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.models.casadi_joints import ElementaryJoint, elementary_joints
from factorgrasp.models.robot import frame_id
from factorgrasp.typing import FloatArray

Expression = Any
"""A ``casadi.SX``, ``MX`` or ``DM``."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Where every elementary joint is and how it moves, as expressions.

    Attributes
    ----------
    rotation, position : list
        ``R_w_j`` (3, 3) and ``p_w_j`` (3,).
    linear, angular : list
        Velocity of the joint's origin and angular velocity, in the joint's frame.
    linear_rate, angular_rate : list
        Spatial acceleration in the joint's frame (its linear part is the classical acceleration less w x v).
    to_parent : list
        ``R_p_j`` and ``p_p_j`` as they are now.
    """

    rotation: list[Expression]
    position: list[Expression]
    linear: list[Expression]
    angular: list[Expression]
    linear_rate: list[Expression]
    angular_rate: list[Expression]
    to_parent: list[tuple[Expression, Expression]]


class CasadiRobot:
    """Kinematics and dynamics of a robot in CasADi.

    Parameters
    ----------
    model : pinocchio.Model
        Of any tree: revolute (any axis, bounded or not), prismatic, helical, universal, spherical, planar, free-flyer, translation,
        composite and mimic joints.

    Raises
    ------
    InputError
        For a joint of another kind.
    """

    def __init__(self, model: Any) -> None:
        self.model = model
        self.nq, self.nv = int(model.nq), int(model.nv)
        self.joints, self._carrier = elementary_joints(model)
        self.gravity = np.array(model.gravity.linear)
        self.armature = np.array(getattr(model, "armature", np.zeros(self.nv)))

    def motion(self, q: Expression, v: Expression | None = None, a: Expression | None = None) -> Motion:
        """Walk the tree; without `v` or `a` those are zero."""
        ca = _casadi()
        out = Motion([], [], [], [], [], [], [])
        zero = type(q)(3, 1) if hasattr(q, "shape") else ca.DM(3, 1)
        for joint in self.joints:
            R_j, p_j = _displacement(joint, q)
            R0, p0 = _constant(joint.rotation), _constant(joint.position)
            R_p, p_p = R0 @ R_j, p0 + R0 @ p_j
            out.to_parent.append((R_p, p_p))
            S, rates = _constant(joint.subspace), slice(joint.idx_v, joint.idx_v + joint.nv)
            own = None if v is None else S @ (joint.ratio * v[rates])
            gain = None if a is None else S @ (joint.ratio * a[rates])
            if joint.parent < 0:
                R, p, lin, ang, dlin, dang = R_p, p_p, zero, zero, zero, zero
            else:
                k = joint.parent
                R, p = out.rotation[k] @ R_p, out.position[k] + out.rotation[k] @ p_p
                lin, ang = _to_child(R_p, p_p, out.linear[k], out.angular[k])
                dlin, dang = _to_child(R_p, p_p, out.linear_rate[k], out.angular_rate[k])
            if own is not None:
                own_lin, own_ang = own[:3], own[3:]
                lin, ang = lin + own_lin, ang + own_ang
                dlin = dlin + ca.cross(ang, own_lin) + ca.cross(lin, own_ang)
                dang = dang + ca.cross(ang, own_ang)
            if gain is not None:
                dlin, dang = dlin + gain[:3], dang + gain[3:]
            for target, value in zip(
                (out.rotation, out.position, out.linear, out.angular, out.linear_rate, out.angular_rate),
                (R, p, lin, ang, dlin, dang),
                strict=True,
            ):
                target.append(value)
        return out

    def placement(self, motion: Motion, frame: str) -> tuple[Expression, Expression]:
        """``R_w_f`` (3, 3) and ``p_w_f`` (3,) of a frame of the model."""
        carrier, R, p = self._frame(frame)
        if carrier < 0:
            return R, p
        return motion.rotation[carrier] @ R, motion.position[carrier] + motion.rotation[carrier] @ p

    def twist(self, motion: Motion, frame: str) -> tuple[Expression, Expression]:
        """Linear and angular velocity of a frame, in that frame."""
        carrier, R, p = self._frame(frame)
        if carrier < 0:
            return _constant(np.zeros(3)), _constant(np.zeros(3))
        return _to_child(R, p, motion.linear[carrier], motion.angular[carrier])

    def acceleration(self, motion: Motion, frame: str) -> tuple[Expression, Expression]:
        """Classical acceleration of a frame's origin and angular acceleration, in that frame (no gravity in them)."""
        ca = _casadi()
        carrier, R, p = self._frame(frame)
        if carrier < 0:
            return _constant(np.zeros(3)), _constant(np.zeros(3))
        lin, ang = _to_child(R, p, motion.linear[carrier], motion.angular[carrier])
        dlin, dang = _to_child(R, p, motion.linear_rate[carrier], motion.angular_rate[carrier])
        return dlin + ca.cross(ang, lin), dang

    def _frame(self, frame: str) -> tuple[int, Expression, Expression]:
        one = self.model.frames[frame_id(self.model, frame)]
        carrier = self._carrier[int(one.parentJoint)]
        return carrier, _constant(np.array(one.placement.rotation)), _constant(np.array(one.placement.translation))  # fmt: skip

    def joint_of_frame(self, frame: str) -> int:
        """Index of the elementary joint that carries a frame; -1 for the base."""
        return self._frame(frame)[0]

    # ---- as functions of numbers ----------------------------------------------------------------------------------

    @cached_property
    def symbols(self) -> tuple[Expression, Expression, Expression]:
        """q, v and a as SX symbols."""
        ca = _casadi()
        return ca.SX.sym("q", self.nq), ca.SX.sym("v", self.nv), ca.SX.sym("a", self.nv)

    def kinematics_function(self, frame: str) -> Any:
        """``casadi.Function`` (q, v, a) -> (rotation, position, linear, angular, acceleration, angular_acceleration) of a frame."""
        q, v, a = self.symbols
        motion = self.motion(q, v, a)
        out = [*self.placement(motion, frame), *self.twist(motion, frame), *self.acceleration(motion, frame)]
        names = ["rotation", "position", "linear", "angular", "acceleration", "angular_acceleration"]
        return _casadi().Function("kinematics", [q, v, a], out, ["q", "v", "a"], names)

    def rnea_function(self) -> Any:
        """``casadi.Function`` (q, v, a) -> joint torques (nv,), gravity included."""
        from factorgrasp.models.casadi_dynamics import rnea

        q, v, a = self.symbols
        return _casadi().Function("rnea", [q, v, a], [rnea(self, q, v, a)], ["q", "v", "a"], ["tau"])

    def regressor_function(self) -> Any:
        """``casadi.Function`` (q, v, a) -> (nv, 10 links) of :func:`factorgrasp.models.casadi_dynamics.joint_torque_regressor`."""
        from factorgrasp.models.casadi_dynamics import joint_torque_regressor

        q, v, a = self.symbols
        out = joint_torque_regressor(self, q, v, a)
        return _casadi().Function("regressor", [q, v, a], [out], ["q", "v", "a"], ["regressor"])


def load_casadi_robot(urdf: Any, mimic: bool = False) -> CasadiRobot:
    """The robot of a URDF file; with `mimic`, joints that the file ties to another follow it instead of being free."""
    import pinocchio

    from factorgrasp.models.robot import load_robot

    if not mimic:
        return CasadiRobot(load_robot(urdf))
    load_robot(urdf)  # its errors are the ones that users read
    try:
        return CasadiRobot(pinocchio.buildModelFromUrdf(str(urdf), mimic=True))
    except ValueError as error:
        raise InputError("robot.urdf", "mimic joints that follow a joint of the tree", str(error)) from error


def _displacement(joint: ElementaryJoint, q: Expression) -> tuple[Expression, Expression]:
    """Rotation and translation of the joint's frame by its own coordinates."""
    ca = _casadi()
    own = q[joint.idx_q : joint.idx_q + joint.nq]
    if joint.kind == "translation":
        return _constant(np.eye(3)), own
    if joint.kind == "spherical":
        return _quaternion(own), _constant(np.zeros(3))
    if joint.kind == "free_flyer":
        return _quaternion(own[3:]), own[:3]
    if joint.kind == "planar":
        axis = np.array([0.0, 0.0, 1.0])
        return _axis_turn(axis, own[2], own[3]), ca.vertcat(own[0], own[1], 0.0)
    linear, axis = joint.subspace[:3, 0], joint.subspace[3:, 0]
    if joint.kind == "unbounded":
        return _axis_turn(axis, own[0], own[1]), _constant(np.zeros(3))
    coordinate = joint.ratio * own[0] + joint.offset
    if not axis.any():
        return _constant(np.eye(3)), _constant(linear) * coordinate
    # Revolute and helical: the linear part is along the axis, which stays where it is.
    return _axis_turn(axis, ca.cos(coordinate), ca.sin(coordinate)), _constant(linear) * coordinate


def _axis_turn(axis: FloatArray, cosine: Expression, sine: Expression) -> Expression:
    """Rodrigues' formula for a unit axis."""
    k, K = np.outer(axis, axis), _skew(axis)
    return _constant(k) + _constant(np.eye(3) - k) * cosine + _constant(K) * sine


def _quaternion(xyzw: Expression) -> Expression:
    """Rotation of a unit quaternion [x, y, z, w] (pinocchio's order)."""
    ca = _casadi()
    x, y, z, w = (xyzw[k] for k in range(4))
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def _to_child(R: Expression, p: Expression, linear: Expression, angular: Expression) -> tuple[Expression, Expression]:  # fmt: skip
    """A twist of the parent's frame in a frame at ``(R_p_c, p_p_c)``."""
    return R.T @ (linear + _casadi().cross(angular, p)), R.T @ angular


def _constant(values: FloatArray) -> Expression:
    """Numbers whose zeros CasADi knows to be zeros."""
    ca = _casadi()
    return ca.sparsify(ca.DM(np.where(np.abs(values) < 1e-300, 0.0, values)))


def _skew(w: FloatArray) -> FloatArray:
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def _casadi() -> Any:
    import casadi

    return casadi

"""Inverse dynamics and the joint-torque regressor of a :class:`CasadiRobot`, as expressions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from factorgrasp.models.casadi_robot import CasadiRobot, Motion

    Expression = Any


def rnea(robot: CasadiRobot, q: Any, v: Any, a: Any, wrenches: dict[int, Any] | None = None) -> Any:
    """Joint torques (nv,) of a motion by the recursive Newton-Euler algorithm, gravity and armature included.

    Parameters
    ----------
    robot : CasadiRobot
    q, v, a : expressions
    wrenches : dict, optional
        Elementary joint to the wrench ``[force; moment]`` (6,) that the world exerts on its link, in the joint's frame about its origin.
    """
    ca = _casadi()
    motion = robot.motion(q, v, a)
    forces, moments = [], []
    for i, joint in enumerate(robot.joints):
        lin, ang, dlin, dang = motion.linear[i], motion.angular[i], *_proper(robot, motion, i)
        c, inertia = ca.DM(joint.center), ca.DM(joint.inertia)
        # Classical acceleration of the centre of mass in a frame that moves with the link.
        origin = dlin + ca.cross(ang, lin)
        force = joint.mass * (origin + ca.cross(dang, c) + ca.cross(ang, ca.cross(ang, c)))
        moment = inertia @ dang + ca.cross(ang, inertia @ ang) + ca.cross(c, force)
        if wrenches and i in wrenches:
            force, moment = force - wrenches[i][:3], moment - wrenches[i][3:]
        forces.append(force)
        moments.append(moment)
    tau = _zeros(q, robot.nv)
    for i in reversed(range(len(robot.joints))):
        joint = robot.joints[i]
        rows = slice(joint.idx_v, joint.idx_v + joint.nv)
        tau[rows] += joint.ratio * (ca.sparsify(ca.DM(joint.subspace)).T @ ca.vertcat(forces[i], moments[i]))
        if joint.parent >= 0:
            R, p = motion.to_parent[i]
            force, moment = R @ forces[i], R @ moments[i]
            forces[joint.parent] += force
            moments[joint.parent] += moment + ca.cross(p, force)
    return tau + ca.DM(robot.armature) * a


def joint_torque_regressor(robot: CasadiRobot, q: Any, v: Any, a: Any) -> Any:
    """(nv, 10 (njoints - 1)): torques per inertial parameter.

    Those of a link are [m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz] about its joint. The order is that of
    ``pinocchio.computeJointTorqueRegressor``; armature is not among the parameters.
    """
    ca = _casadi()
    motion = robot.motion(q, v, a)
    out = _zeros(q, robot.nv, 10 * (robot.model.njoints - 1))
    for i, joint in enumerate(robot.joints):
        if not joint.body:
            continue
        lin, ang, dlin, dang = motion.linear[i], motion.angular[i], *_proper(robot, motion, i)
        origin = dlin + ca.cross(ang, lin)
        phi = ca.skew(dang) + ca.skew(ang) @ ca.skew(ang)
        of_inertia = _inertia_columns(dang) + ca.skew(ang) @ _inertia_columns(ang)
        zeros = type(origin)(3, 1)
        block = ca.vertcat(
            ca.horzcat(origin, phi, type(origin)(3, 6)), ca.horzcat(zeros, -ca.skew(origin), of_inertia)
        )
        columns = slice(10 * (joint.body - 1), 10 * joint.body)
        k = i
        while k >= 0:
            one = robot.joints[k]
            rows = slice(one.idx_v, one.idx_v + one.nv)
            out[rows, columns] += one.ratio * (ca.sparsify(ca.DM(one.subspace)).T @ block)
            R, p = motion.to_parent[k]
            block = ca.vertcat(R @ block[:3, :], R @ block[3:, :] + ca.skew(p) @ (R @ block[:3, :]))
            k = one.parent
    return out


def _proper(robot: CasadiRobot, motion: Motion, i: int) -> tuple[Any, Any]:
    """Spatial acceleration of a joint's frame less gravity, in that frame."""
    gravity = _casadi().sparsify(_casadi().DM(robot.gravity))
    return motion.linear_rate[i] - motion.rotation[i].T @ gravity, motion.angular_rate[i]


def _inertia_columns(w: Any) -> Any:
    """(3, 6) with ``I w = columns @ [Ixx, Ixy, Iyy, Ixz, Iyz, Izz]``."""
    ca = _casadi()
    x, y, z = w[0], w[1], w[2]
    return ca.vertcat(ca.horzcat(x, y, 0, z, 0, 0), ca.horzcat(0, x, y, 0, z, 0), ca.horzcat(0, 0, 0, x, y, z))  # fmt: skip


def _zeros(like: Any, rows: int, columns: int = 1) -> Any:
    return type(like)(np.zeros((rows, columns)))


def _casadi() -> Any:
    import casadi

    return casadi

"""Deterministic inverse dynamics, and the original estimator without unmeasured contacts: what human dynamics is compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_point import newton_euler
from factorgrasp.problems.human_dynamics_sensors import Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_spatial import rotate_back, skew
from factorgrasp.typing import FloatArray


@dataclass(frozen=True)
class InverseDynamics:
    """Result of the recursion of Newton and Euler from the leaves to the root.

    Attributes
    ----------
    joint_wrench : ndarray
        (n, J, 6) parent on child, in the child's frame, N and Nm.
    torque : ndarray
        (n, dofs) of the joints with known axes, Nm.
    joint_moment, joint_force : ndarray
        (n, J, 3) world axes, the moment about the joint centre, Nm and N.
    root_residual : ndarray
        (n, 6) external wrench on the root, in its frame, that motion and forces leave unexplained: zero in a perfect world.
    """

    joint_wrench: FloatArray
    torque: FloatArray
    joint_moment: FloatArray
    joint_force: FloatArray
    root_residual: FloatArray


def inverse_dynamics(
    motion: LinkMotion, external_wrench: Mapping[str, ArrayLike] | None = None
) -> InverseDynamics:
    """Joint wrenches from accelerations and measured external wrenches, bottom-up, all frames at once.

    Parameters
    ----------
    motion : LinkMotion
    external_wrench : mapping of str to (n, 6) array_like
        ``[force; moment]`` on a link in its frame, N and Nm; links that are not named carry none.
    """
    tree, k, count = motion.tree, motion.kinematics(), len(motion)
    external = np.zeros((count, len(tree.links), 6))
    for link, wrench in (external_wrench or {}).items():
        value = np.asarray(wrench, dtype=float)
        if value.shape != (count, 6):
            raise InputError(f"external wrench on {link}", f"shape ({count}, 6)", str(value.shape))
        external[:, motion.link(link)] = value
    f, residual = newton_euler(tree, k, external)
    torque = [
        (np.swapaxes(S, 1, 2) @ f[:, j, :, None])[..., 0] for j, S in enumerate(k.subspaces) if S is not None
    ]
    R = k.R[:, tree.children]
    centre = rotate_back(R, k.joint_centre - k.p[:, tree.children])
    moment = f[..., 3:] - (skew(centre) @ f[..., :3, None])[..., 0]
    return InverseDynamics(
        f,
        np.concatenate(torque, axis=1) if torque else np.zeros((count, 0)),
        (R @ moment[..., None])[..., 0],
        (R @ f[..., :3, None])[..., 0],
        residual,
    )


def rnea(
    model: Any,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    external_wrench: Mapping[str, ArrayLike] | None = None,
) -> FloatArray:
    """Generalised forces (n, nv) by pinocchio's recursive Newton-Euler algorithm, with the model's own gravity.

    Parameters
    ----------
    model : pinocchio.Model
    q, qd, qdd : array_like
        (n, nq), (n, nv), (n, nv).
    external_wrench : mapping of str to (n, 6) array_like
        By the name of a body frame, ``[force; moment]`` in that frame, N and Nm.
    """
    import pinocchio as pin

    positions, v, a = (np.atleast_2d(np.asarray(x, dtype=float)) for x in (q, qd, qdd))
    data = model.createData()
    out = np.empty((positions.shape[0], model.nv))
    placed = []
    for name, wrench in (external_wrench or {}).items():
        if not model.existFrame(name):
            raise InputError("external wrench", "the name of a frame of the model", repr(name))
        frame = model.frames[model.getFrameId(name)]
        placed.append((frame, np.asarray(wrench, dtype=float)))
    for i in range(positions.shape[0]):
        forces = pin.StdVec_Force()
        for _ in range(model.njoints):
            forces.append(pin.Force.Zero())
        for frame, wrench in placed:
            forces[frame.parentJoint] += frame.placement.act(pin.Force(wrench[i]))
        out[i] = pin.rnea(model, data, positions[i], v[i], a[i], forces)
    return out


def original_map(
    motion: LinkMotion, sensors: Sequence[Sensor], noise: HumanDynamicsNoise | None = None
) -> HumanDynamics:
    """Latella 2018: every link without a wrench sensor touches nothing, whatever the hands may carry."""
    return HumanDynamics(motion, sensors, noise or HumanDynamicsNoise.latella2018())

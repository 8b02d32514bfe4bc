"""Forces of simulated motions: inverse dynamics, what is held, and how two feet share the ground's reaction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from factorgrasp.models.human import HumanBody
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.problems.link_motion_spatial import rotate_back
from factorgrasp.simulation.human_motion import (
    JointTrajectory,
)
from factorgrasp.simulation.human_recording import FEET
from factorgrasp.typing import FloatArray


def inverse_dynamics(body: HumanBody, trajectory: JointTrajectory) -> FloatArray:
    """Torques (n, 66) of a body by its equations of motion alone: the feet carry what they ask for, the hands nothing."""
    model = body.model()
    motion = PinocchioTree(model).motion(trajectory.t, trajectory.q, trajectory.v, trajectory.a)
    return inverse_dynamics_on_feet(model, trajectory, motion, {}, None)[0]


def weight_of(motion: LinkMotion, link: str, mass: float, at: FloatArray) -> FloatArray:
    """Wrench (n, 6) on a link, in its frame, of a point mass that it holds: ``m (g - a)`` at the point `at`."""
    i = motion.link(link)
    R = motion.R[:, i]
    w, dw = (rotate_back(R, x[:, i]) for x in (motion.angular_velocity, motion.angular_acceleration))
    felt = rotate_back(R, motion.gravity - motion.acceleration[:, i])
    arm = np.broadcast_to(at, w.shape)
    force = mass * (felt - np.cross(dw, arm) - np.cross(w, np.cross(w, arm)))
    return np.concatenate([force, np.cross(arm, force)], axis=1)


def inverse_dynamics_on_feet(
    model: Any,
    trajectory: JointTrajectory,
    motion: LinkMotion,
    external: Mapping[str, FloatArray],
    right_load: FloatArray | None,
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Joint torques (n, 66), and the wrenches on the feet in their frames that the equations of motion ask for.

    On two feet they share the force as its centre of pressure lies between them (or as `right_load` says), and the rest of the
    moment in the same proportion: one of the many ways in which people stand, and as good as any.
    """
    import pinocchio as pin

    data = model.createData()
    joint = {link: int(model.frames[model.getFrameId(link)].parentJoint) for link in (*external, *FEET)}
    index = {link: motion.link(link) for link in FEET}
    pelvis = motion.link("Pelvis")
    torque = np.zeros((trajectory.t.size, model.nv - 6))
    feet = {link: np.zeros((trajectory.t.size, 6)) for link in FEET}
    forces = pin.StdVec_Force()
    for _ in range(model.njoints):
        forces.append(pin.Force.Zero())
    for k in range(trajectory.t.size):
        for link, wrench in external.items():
            forces[joint[link]] = pin.Force(wrench[k])
        for link in FEET:
            forces[joint[link]] = pin.Force.Zero()
        state = (trajectory.q[k], trajectory.v[k], trajectory.a[k])
        tau = pin.rnea(model, data, *state, forces)
        # What a free-flyer cannot give has to come from the ground; in the world, about its origin.
        total = pin.SE3(motion.R[k, pelvis], motion.p[k, pelvis]).act(pin.Force(tau[:6])).vector
        ankle = {link: motion.p[k, i] for link, i in index.items()}
        share = _share(total, ankle) if right_load is None else float(right_load[k])
        weights = dict(zip(FEET, (share, 1.0 - share), strict=True))
        middle = sum(weights[link] * ankle[link] for link in FEET)
        rest = total[3:] - np.cross(middle, total[:3])
        for link, i in index.items():
            R = motion.R[k, i]
            feet[link][k] = weights[link] * np.concatenate([R.T @ total[:3], R.T @ rest])
            forces[joint[link]] = pin.Force(feet[link][k])
        torque[k] = pin.rnea(model, data, *state, forces)[6:]
    return torque, feet


def _share(total: FloatArray, ankle: Mapping[str, FloatArray]) -> float:
    """The right foot's share: where the centre of pressure lies on the line from the left ankle to the right."""
    cop = np.array([-total[4], total[3]]) / total[2]
    right, left = (ankle[link][:2] for link in FEET)
    line = right - left
    return float(np.clip((cop - left) @ line / (line @ line), 0.0, 1.0))

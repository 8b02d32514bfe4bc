"""What a planned excitation leaves for a robot and for the eye: a ROS 2 trajectory, an animation and a strip of pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp.joint_trajectory import joint_trajectory
from factorgrasp.motion_scene import MotionScene, animate, strip

if TYPE_CHECKING:
    from factorgrasp.excitation_plan import ExcitationPlan

ROS_NAMES = ("joint_trajectory.yaml", "joint_trajectory.json")
PICTURE_NAMES = ("motion.gif", "motion.png")
_ROS_RATE = 100.0
"""Hz; controllers interpolate the points of a trajectory themselves."""
_PICTURE_STEP = 0.02


def export_names(plan: ExcitationPlan) -> tuple[str, ...]:
    """Names of the files that :func:`write_exports` writes for a plan."""
    return (*ROS_NAMES, *PICTURE_NAMES) if plan.q.shape[1] else PICTURE_NAMES


def write_exports(plan: ExcitationPlan, folder: Path) -> None:
    """Write them into a folder, each atomically."""
    scene = scene_of(plan)
    arm = plan.problem.arm
    if plan.q.shape[1] and arm is not None:
        names = tuple(map(str, arm.robot.model.names))[1:]
        message = joint_trajectory(plan.t, names, plan.q, plan.qd, plan.qdd, plan.tau, _ROS_RATE)
        for name in ROS_NAMES:
            message.save(folder / name)
    animate(scene, folder / PICTURE_NAMES[0], rate=5.0, width=3.4)
    strip(scene, folder / PICTURE_NAMES[1])


def scene_of(plan: ExcitationPlan) -> MotionScene:
    """The plan as a scene: with the arm where there is one."""
    every = slice(None, None, max(1, round(_PICTURE_STEP / float(plan.t[1] - plan.t[0]))))
    t, lever, arm = plan.t[every], plan.problem.grasp.translation, plan.problem.arm
    force = plan.wrench[every, :3]
    if plan.q.shape[1] and arm is not None:
        return MotionScene.of_joints(t, plan.q[every], arm.robot.model, arm.frame, lever, force)
    R, p = plan.rotation[every], plan.position[every]
    return MotionScene(t, np.empty((t.size, 0, 3)), p, R, p + R @ lever, force)

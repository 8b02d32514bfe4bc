"""Recordings fed to the online estimator as they would come from a robot and a sensor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from factorgrasp.online import OnlineGraspPose
from factorgrasp.recordings import ImuStream, MotionStream, PoseStream

Stream = MotionStream | PoseStream | ImuStream


def add_robot(estimator: OnlineGraspPose, robot: Stream, rows: slice) -> None:
    """Feed some rows of the robot's side, whatever it is."""
    if isinstance(robot, PoseStream):
        estimator.add_robot(robot.t[rows], robot.position[rows], robot.rotation_wxyz[rows])
    elif isinstance(robot, MotionStream):
        estimator.add_robot(
            robot.t[rows],
            angular_velocity=robot.angular_velocity[rows],
            angular_acceleration=robot.angular_acceleration[rows],
            specific_force=robot.specific_force[rows],
        )
    else:
        estimator.add_robot(
            robot.t[rows],
            angular_velocity=robot.angular_velocity[rows],
            specific_force=robot.specific_force[rows],
        )


def stream(
    estimator: OnlineGraspPose,
    robot: Stream,
    hand: ImuStream,
    chunk: int = 20,
    after: Callable[[OnlineGraspPose], None] | None = None,
    offset: float = 0.0,
) -> OnlineGraspPose:
    """Feed both sides in chunks of `chunk` robot samples, in step.

    Parameters
    ----------
    after : callable, optional
        Called with the estimator after every chunk.
    offset : float
        s; hand clock minus robot clock.
    """
    done = 0
    for first in range(0, len(robot), chunk):
        rows = slice(first, min(first + chunk, len(robot)))
        add_robot(estimator, robot, rows)
        come = int(np.searchsorted(hand.t, robot.t[rows][-1] + offset, side="right"))
        if come > done:
            part = slice(done, come)
            estimator.add_hand(hand.t[part], hand.angular_velocity[part], hand.specific_force[part])
            done = come
        if after is not None:
            after(estimator)
    if done < len(hand):
        part = slice(done, len(hand))
        estimator.add_hand(hand.t[part], hand.angular_velocity[part], hand.specific_force[part])
    return estimator

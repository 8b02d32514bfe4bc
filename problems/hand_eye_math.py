"""Two pose streams of one rigid body: residuals of their coupling and the derivatives.

Robot poses ``(R_w_r, p_w_r)`` and hand poses ``(R_t_h, p_t_h)`` in another world ``t``. Rigid coupling with the grasp
``(R_r_h, p_r_h)`` and the other world ``(R_w_t, p_w_t)``: ``R_w_r R_r_h = R_w_t R_t_h`` and
``R_w_r p_r_h + p_w_r = R_w_t p_t_h + p_w_t``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgrasp import lie
from factorgrasp.problems.hand_eye_curve import PoseCurve, apply, transposed
from factorgrasp.recordings import PoseStream
from factorgrasp.typing import BoolArray, FloatArray, IntArray, State

COLUMNS = {
    "rotation": slice(0, 3),
    "translation": slice(3, 6),
    "world_rotation": slice(6, 9),
    "world_translation": slice(9, 12),
    "time_offset": slice(12, 13),
}
"""Columns of the Jacobian of :func:`coupling_rows`."""


@dataclass(frozen=True)
class CoupledPoses:
    """Both bodies at the same instants; one side is interpolated, and moves when the time offset does.

    Attributes
    ----------
    robot_rotation, robot_position : ndarray
        ``R_w_r`` (n, 3, 3), ``p_w_r`` (n, 3).
    hand_rotation, hand_position : ndarray
        ``R_t_h`` (n, 3, 3), ``p_t_h`` (n, 3).
    robot_slide, hand_slide : (n, 6) ndarray or None
        Derivative of the pose by the time offset, [angular in the body frame; linear in its world]; None for the side that is sampled.
    inside : (n,) ndarray
    """

    robot_rotation: FloatArray
    robot_position: FloatArray
    hand_rotation: FloatArray
    hand_position: FloatArray
    robot_slide: FloatArray | None
    hand_slide: FloatArray | None
    inside: BoolArray


@dataclass(frozen=True)
class PoseCoupling:
    """Robot and hand on their own clocks; ``t_hand = t_robot + time offset``.

    The slower stream is taken at its samples, the faster one is interpolated: that bridges the shorter steps.
    """

    robot: PoseCurve
    hand: PoseCurve

    @classmethod
    def from_streams(cls, robot: PoseStream, hand: PoseStream, max_gap: float | None) -> PoseCoupling:
        """Only the interpolated side is smoothed: its samples in between are there to be used, too."""
        at_hand = hand.step >= robot.step
        return cls(
            PoseCurve.from_stream(robot, max_gap, smooth=at_hand),
            PoseCurve.from_stream(hand, max_gap, smooth=not at_hand),
        )

    @property
    def at_hand(self) -> bool:
        """Whether the samples are those of the hand."""
        return self.hand.step >= self.robot.step

    @property
    def sampled(self) -> PoseCurve:
        """The slower side."""
        return self.hand if self.at_hand else self.robot

    @property
    def interpolated(self) -> PoseCurve:
        """The faster side."""
        return self.robot if self.at_hand else self.hand

    def other_times(self, t: FloatArray, time_offset: float) -> FloatArray:
        """Times on the clock of the interpolated side."""
        return t - time_offset if self.at_hand else t + time_offset

    def usable(self, time_offset: float, margin: float) -> IntArray:
        """Samples whose interpolation stays clear of gaps for all offsets within `margin` (s) of this one."""
        return np.flatnonzero(self.interpolated.covers(self.other_times(self.sampled.t, time_offset), margin))

    def at(self, samples: IntArray, time_offset: float) -> CoupledPoses:
        """Both sides at some of the samples."""
        own = self.sampled
        R, p = own.rotation[samples], own.position[samples]
        points = self.interpolated.at(self.other_times(own.t[samples], time_offset))
        slide = np.hstack([points.angular_velocity, points.velocity])
        if self.at_hand:
            return CoupledPoses(points.rotation, points.position, R, p, -slide, None, points.inside)
        return CoupledPoses(R, p, points.rotation, points.position, None, slide, points.inside)


def coupling_rows(state: State, poses: CoupledPoses) -> tuple[FloatArray, FloatArray]:
    """Residuals of the rigid coupling and their derivatives.

    Both are what the robot predicts against what the other sensor measured, in the hand frame:
    ``log((R_w_r R_r_h)' R_w_t R_t_h)`` (rad) and ``(R_w_t R_t_h)' (R_w_r p_r_h + p_w_r - R_w_t p_t_h - p_w_t)`` (m).

    Returns
    -------
    residual : (n, 6) ndarray
        [rotation; position]; zero where the interpolated side has a gap.
    jacobian : (n, 6, 13) ndarray
        Columns as in `COLUMNS`, rotations by right perturbations.
    """
    X, lever, Y, origin = (
        state[k] for k in ("rotation", "translation", "world_rotation", "world_translation")
    )
    A, B = poses.robot_rotation, poses.hand_rotation
    BT = transposed(B)
    error = lie.so3_log(transposed(A @ X) @ Y @ B)
    left = lie.so3_left_jacobian_inverse(error)
    right = lie.so3_right_jacobian_inverse(error)
    seen = (A @ lever + poses.robot_position - origin) @ Y  # hand origin as the robot has it, in t
    back = BT @ Y.T
    residual = np.concatenate([error, apply(BT, seen - poses.hand_position)], axis=1)

    jacobian = np.zeros((len(A), 6, 13))
    jacobian[:, :3, 0:3] = -left
    jacobian[:, :3, 6:9] = right @ BT
    jacobian[:, 3:, 3:6] = back @ A
    jacobian[:, 3:, 6:9] = BT @ lie.skew(seen)
    jacobian[:, 3:, 9:12] = -back
    if poses.robot_slide is not None:
        w, v = poses.robot_slide[:, :3], poses.robot_slide[:, 3:]
        jacobian[:, :3, 12] = -apply(left, w @ X)
        jacobian[:, 3:, 12] = apply(back, apply(A, np.cross(w, lever)) + v)
    if poses.hand_slide is not None:
        w, v = poses.hand_slide[:, :3], poses.hand_slide[:, 3:]
        jacobian[:, :3, 12] = apply(right, w)
        jacobian[:, 3:, 12] = -np.cross(w, residual[:, 3:]) - apply(BT, v)
    outside = ~poses.inside
    residual[outside] = 0.0
    jacobian[outside] = 0.0
    return residual, jacobian


def noise_information(
    state: State, poses: CoupledPoses, robot_noise: FloatArray, hand_noise: FloatArray, whitener: FloatArray
) -> FloatArray:
    """Information (13, 13) that noise of the poses adds by shaking the Jacobian: ``sum dJ' W' W dJ`` for one draw of such noise.

    Parameters
    ----------
    robot_noise, hand_noise : (2, 2) ndarray
        As :attr:`PoseCurve.noise`.
    whitener : (n, 6, 6) ndarray
        ``W`` of every sample, robust weights included.
    """
    rng = np.random.default_rng(0)

    def draw(sd: FloatArray) -> FloatArray:
        return np.asarray(np.repeat(sd, 3) * rng.standard_normal((len(poses.robot_position), 6)))

    robot, hand = draw(robot_noise[0]), draw(hand_noise[0])
    shaken = replace(
        poses,
        robot_rotation=poses.robot_rotation @ lie.so3_exp(robot[:, :3]),
        robot_position=poses.robot_position + robot[:, 3:],
        hand_rotation=poses.hand_rotation @ lie.so3_exp(hand[:, :3]),
        hand_position=poses.hand_position + hand[:, 3:],
        robot_slide=None if poses.robot_slide is None else poses.robot_slide + draw(robot_noise[1]),
        hand_slide=None if poses.hand_slide is None else poses.hand_slide + draw(hand_noise[1]),
    )
    change = (whitener @ (coupling_rows(state, shaken)[1] - coupling_rows(state, poses)[1])).reshape(-1, 13)
    return np.asarray(change.T @ change)

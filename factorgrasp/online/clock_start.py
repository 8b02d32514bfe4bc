"""The first seconds of both streams: rates, gaps, noise and the offset between the clocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from factorgrasp.online.robot_feed import RobotKind
from factorgrasp.problems.grasp_averaging import averaged_samples
from factorgrasp.problems.grasp_kinematics import RobotNoise, differentiator, gap_limit, robot_kinematics
from factorgrasp.problems.grasp_recording import (
    ClockSearch,
    HandSignals,
    find_clock,
)
from factorgrasp.problems.grasp_settings import GraspNoise, GraspSettings
from factorgrasp.recordings import ImuStream, MotionStream, PoseStream
from factorgrasp.typing import FloatArray

# A stream is called regular when so many of its steps are within 2 % of their median.
_REGULAR, _REGULAR_SHARE = 0.02, 0.9


@dataclass(frozen=True)
class Timing:
    """Steps of one stream.

    Attributes
    ----------
    step : float
        s, nominal.
    limit : float
        s; a longer step is a gap.
    regular : bool
        Stamps are evenly spaced.
    """

    step: float
    limit: float
    regular: bool

    @classmethod
    def of(cls, t: FloatArray, max_gap: float | None) -> Timing:
        """Timing of stamps t (n,), n >= 3."""
        steps, limit = np.diff(t), gap_limit(t, max_gap)
        middle = float(np.median(steps))
        near = np.abs(steps - middle) < _REGULAR * middle
        regular = bool(np.mean(near) > _REGULAR_SHARE)
        step = float(np.mean(steps[near] if regular else steps[steps <= max(limit, middle)]))
        return cls(step, limit, regular)


@dataclass(frozen=True)
class Setup:
    """All that the first seconds settle.

    Attributes
    ----------
    robot, hand : Timing
    clock : ClockSearch
    bandwidth : float
        Hz.
    window : int
        Samples of the robot's differentiation.
    finer_step : float or None
        s; see :class:`factorgrasp.online.robot_feed.RobotFeed`.
    averaged_poses : int
        Poses whose mean is differentiated.
    master_step : float
        s, between the robot's rows when the hand joins them.
    averaged : int
        Such rows that one row of z averages.
    averaged_hand : int
        Readings of the hand within one such row.
    step : float
        s, between rows of z.
    noise : callable
        Frequencies (K,) in Hz to densities of the robot's noise.
    """

    robot: Timing
    hand: Timing
    clock: ClockSearch
    bandwidth: float
    window: int
    finer_step: float | None
    averaged_poses: int
    master_step: float
    averaged: int
    averaged_hand: int
    step: float
    noise: Callable[[FloatArray], RobotNoise]


def analyse(
    kind: RobotKind,
    robot: tuple[FloatArray, FloatArray],
    hand: tuple[FloatArray, FloatArray],
    noise: GraspNoise,
    settings: GraspSettings,
    gravity: FloatArray,
) -> Setup:
    """Look at the first samples (stamps (n,), rows (n, c)) of both sides.

    Raises
    ------
    InputError
        As the streams of :mod:`factorgrasp.recordings` and the batch problem do: units, shapes, no overlap.
    """
    timings = [Timing.of(t, settings.max_gap) for t, _ in (robot, hand)]
    rates = [1.0 / timing.step for timing in timings]
    bandwidth = settings.bandwidth or min(20.0, 0.2 * min(rates))
    kinematics_bandwidth = settings.kinematics_bandwidth or 2.0 * bandwidth
    stream = _stream(kind, *robot)
    motion = robot_kinematics(stream, noise, gravity, kinematics_bandwidth, settings.max_gap)
    t, x = hand
    signals = HandSignals.from_stream(ImuStream(t, x[:, :3], x[:, 3:]), settings.max_gap)
    clock = find_clock(motion, signals, settings, bandwidth)
    robot_step, hand_step = timings[0].step, timings[1].step
    averaged_poses = motion.averaged
    window = 1
    if kind != "motion":
        window = differentiator(
            kinematics_bandwidth, robot_step * averaged_poses, motion.t.size, "robot stream"
        )[0]
    finer, averaged, averaged_hand = None, 1, 1
    master = robot_step * averaged_poses
    if averaged_poses > 1:
        # The robot's rows are means over their step already; the hand's are averaged over the same.
        averaged_hand = max(averaged_poses, round(master / hand_step))
    else:
        finer = hand_step if robot_step > 1.05 * hand_step else None
        master = finer or robot_step
        averaged = averaged_samples(master, bandwidth)
    return Setup(
        robot=timings[0],
        hand=timings[1],
        clock=clock,
        bandwidth=bandwidth,
        window=window,
        finer_step=finer,
        averaged_poses=averaged_poses,
        master_step=master,
        averaged=averaged,
        averaged_hand=averaged_hand,
        step=averaged * master,
        noise=motion.noise,
    )


def _stream(kind: RobotKind, t: FloatArray, x: FloatArray) -> PoseStream | MotionStream | ImuStream:
    if kind == "poses":
        return PoseStream(t, x[:, :3], x[:, 3:7])
    if kind == "imu":
        return ImuStream(t, x[:, :3], x[:, 3:6], name="robot")
    rotation = x[:, 9:13] if x.shape[1] > 9 else None
    return MotionStream(t, x[:, :3], x[:, 3:6], x[:, 6:9], rotation)


def enough(t: FloatArray, x: FloatArray, seconds: float) -> bool:
    """Whether samples (stamps (n,), rows (n, c)) span this time and half of them are complete."""
    if t.size < 32 or t[-1] - t[0] < seconds:
        return False
    return bool(np.mean(np.isfinite(x).all(axis=1)) > 0.5)

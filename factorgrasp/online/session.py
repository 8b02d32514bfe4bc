"""Two streams whose rates and clocks are known: the robot's feed, the coupling with the hand and the tracker, in one place."""

from __future__ import annotations

import numpy as np

from factorgrasp.online.change import DetectorSettings
from factorgrasp.online.clock_start import Setup
from factorgrasp.online.coupled_rows import Coupler, HandReader
from factorgrasp.online.robot_feed import (
    Differentiator,
    ImuRows,
    MotionRows,
    PoseAverager,
    PoseRows,
    RobotFeed,
    RobotKind,
)
from factorgrasp.online.sample_buffer import SampleBuffer
from factorgrasp.online.stream_pieces import GapCutter
from factorgrasp.online.tracker import GraspTracker
from factorgrasp.problems.grasp_recording import tilt_axes
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.typing import FloatArray

# Chunks that are a block long but for rounding.
_ALMOST = 0.9


class GraspSession:
    """Everything behind the two buffers.

    Parameters
    ----------
    setup : Setup
    offset : float
        s, hand clock minus robot clock, at which to begin.
    kind : RobotKind
    robot, hand : SampleBuffer
    noise, settings, prior : GraspNoise, GraspSettings, GraspPrior
    gravity : (3,) ndarray
    detector : DetectorSettings or None
    block : float
        s.
    """

    def __init__(
        self,
        setup: Setup,
        offset: float,
        kind: RobotKind,
        robot: SampleBuffer,
        hand: SampleBuffer,
        noise: GraspNoise,
        settings: GraspSettings,
        prior: GraspPrior,
        gravity: FloatArray,
        detector: DetectorSettings | None,
        block: float,
    ) -> None:
        self.offset = offset
        """s, hand clock minus robot clock, at which the hand is read now."""
        self._setup, self._settings = setup, settings
        self._robot = robot
        self._least = _ALMOST * block
        self._feed = _feed(setup, kind, gravity, settings.base_tilt)
        self.coupler = Coupler(
            HandReader(hand), setup.averaged, setup.averaged_hand, setup.step, settings.base_tilt, hand.keep
        )
        self.tracker = GraspTracker(
            setup.step, setup.bandwidth, setup.noise, noise, settings, prior, detector, block
        )

    def read_start(self) -> tuple[float, float]:
        """Read all settled samples and keep them; returns how wrong the offset turned out, and its standard deviation (s)."""
        self.coupler.push(self._feed.push(*self._robot.settled()))
        for piece in self.coupler.pull(self.offset):
            self.tracker.take(piece)
        fit = self.tracker.solve()
        error = self.tracker.taken_clock_shift()
        if not self._settings.time_offset:
            return 0.0, 0.0
        if fit is None:
            return 0.0, np.inf
        where = fit.model.columns["time_offset"].start
        variance = self.tracker.fitter.covariance()[where, where]
        return error + float(fit.state["time_offset"][0]), float(np.sqrt(variance))

    def keep_start(self) -> None:
        """Let the samples go that were read."""
        self._robot.release(self._robot.settled()[0].size)
        self.coupler.release(self.offset)

    def advance(self) -> None:
        """Read what has been settled since, once it is about a block."""
        t, x = self._robot.settled()
        if t.size * self._setup.robot.step >= self._least:
            self.coupler.push(self._feed.push(t, x, t[0] > self._robot.plain_since))
            self._robot.release(t.size)
        if self.coupler.available(self.offset) + self._setup.master_step >= self._least:
            for piece in self.coupler.pull(self.offset):
                self.tracker.take(piece)
            self.offset += self.tracker.taken_clock_shift()
            self.coupler.release(self.offset)


def _feed(setup: Setup, kind: RobotKind, gravity: FloatArray, tilted: bool) -> RobotFeed:
    tilt = tilt_axes(gravity) if tilted else None
    step = setup.robot.step * setup.averaged_poses
    rows: Differentiator
    if kind == "poses":
        rows = PoseRows(setup.window, step, gravity, tilt)
    elif kind == "imu":
        rows = ImuRows(setup.window, step)
    else:
        rows = MotionRows(tilt)
    cutter = GapCutter(setup.robot.limit)
    averager = PoseAverager(setup.averaged_poses) if setup.averaged_poses > 1 else None
    return RobotFeed(
        cutter, averager, rows, setup.robot.step, setup.robot.regular, setup.finer_step, kind == "poses"
    )

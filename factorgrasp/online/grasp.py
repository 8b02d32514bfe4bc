"""Grasp pose from two live streams: the batch problem's terms in constant memory, with regrasps and slips detected."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.online.change import DetectorSettings
from factorgrasp.online.clock_start import analyse, enough
from factorgrasp.online.estimate import OnlineGraspEstimate, StreamCounts
from factorgrasp.online.events import GraspEvent
from factorgrasp.online.robot_feed import COLUMNS, RobotKind
from factorgrasp.online.sample_buffer import SampleBuffer
from factorgrasp.online.session import GraspSession
from factorgrasp.online.tracker import GraspTracker
from factorgrasp.problems import grasp_words
from factorgrasp.problems.grasp_pose import checked_gravity
from factorgrasp.problems.grasp_recording import SMALLEST_CORRELATION
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray

# s; while the first seconds do not show the clocks' offset they are looked at again, less and less often.
_RETRY, _LONGEST_RETRY = 0.5, 2.0
# s; the offset found in the first seconds is applied and they are read again until it moves by less than this.
_SETTLED_START = 2e-4
_MOST_PASSES = 4
# s; the offset must be known this well from the first seconds, or more of them are awaited.
_STARTING_OFFSET_SD = 3e-3
# A quaternion shorter than 1 by more than this was interpolated across a change of sign: a gap. A longer one is something else.
_QUATERNION_TOLERANCE = 1e-2
_DEFAULT_DETECTOR = DetectorSettings()


class OnlineGraspPose:
    """Estimates the grasp pose while robot and hand move, from samples as they come.

    Feed both sides with :meth:`add_robot` and :meth:`add_hand`, sample by sample or in chunks, each on its own clock; ask
    :meth:`estimate` whenever it is wanted. Rates up to some kHz; memory does not grow.

    Parameters
    ----------
    noise : GraspNoise
    settings : GraspSettings
        As for the batch problem. ``forgetting_time`` follows slow drifts (of the clocks, too).
    gravity : (3,) array_like
        In the robot's world frame, m/s^2.
    prior : GraspPrior
    lateness : float
        s; samples may come late, and out of order, by this much against the newest of their own stream. Where a stamp is missing the
        rows behind it wait this long; what comes later still is dropped and counted.
    detector : DetectorSettings or None
        When a regrasp or a slip is reported; None: never looked for.
    start_seconds : float
        s; first data from which rates, noise and the clocks' offset are taken. Longer where the motion begins later.
    buffer_seconds : float
        s; one stream may be ahead of the other by so much, clock offset included.
    block : float
        s; new data enter the estimate in blocks of about this length.

    Raises
    ------
    InputError
        On bad arguments; and from :meth:`add_robot` or :meth:`add_hand` on samples of the wrong shape, or with units that cannot be
        right.

    Notes
    -----
    Lag of the newest data: two hand samples, one block, two rows of z (10 ms), and for poses half the differentiation window (about
    20 ms at 40 Hz). Newest data count fully only after half an analysis window (0.5 s); the change detector sees them within 0.1 s.
    """

    def __init__(
        self,
        noise: GraspNoise | None = None,
        settings: GraspSettings | None = None,
        gravity: Sequence[float] | FloatArray = (0.0, 0.0, -9.80665),
        prior: GraspPrior | None = None,
        *,
        lateness: float = 0.2,
        detector: DetectorSettings | None = _DEFAULT_DETECTOR,
        start_seconds: float = 3.0,
        buffer_seconds: float = 10.0,
        block: float = 0.02,
    ) -> None:
        self.noise, self.settings = noise or GraspNoise(), settings or GraspSettings()
        self.prior, self.gravity = prior or GraspPrior(), checked_gravity(gravity)
        for name, value in (("start_seconds", start_seconds), ("block", block)):
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(name, "a finite number of seconds above zero", repr(value))
        if not (np.isfinite(lateness) and lateness >= 0.0):
            raise InputError("lateness", "a finite number of seconds, zero or more", repr(lateness))
        least = (
            start_seconds + self.settings.max_time_offset + abs(self.settings.time_offset_guess) + lateness
        )
        if not (np.isfinite(buffer_seconds) and buffer_seconds >= least):
            raise InputError(
                "buffer_seconds",
                f"at least {least:g} s: start_seconds + max_time_offset + |time_offset_guess| + lateness",
                repr(buffer_seconds),
            )
        self._lateness, self._keep, self._start_seconds, self._block = (
            lateness,
            buffer_seconds,
            start_seconds,
            block,
        )
        self._detector = detector
        self._kind: RobotKind | None = None
        self._robot: SampleBuffer | None = None
        self._hand = SampleBuffer(6, lateness, buffer_seconds)
        self._session: GraspSession | None = None
        self._next_try, self._retry = -np.inf, _RETRY
        self._correlation = 0.0

    # ---- samples in --------------------------------------------------------------------------------------

    def add_robot(
        self,
        t: npt.ArrayLike,
        position: npt.ArrayLike | None = None,
        rotation_wxyz: npt.ArrayLike | None = None,
        *,
        angular_velocity: npt.ArrayLike | None = None,
        angular_acceleration: npt.ArrayLike | None = None,
        specific_force: npt.ArrayLike | None = None,
    ) -> None:
        """Take one sample of the robot's end-effector or a chunk of them, always of the same kind.

        Parameters
        ----------
        t : float or (m,) array_like
            s, robot clock.
        position, rotation_wxyz : (3,) or (m, 3); (4,) or (m, 4) array_like
            Poses: ``p_w_r`` (m) and ``R_w_r`` as unit quaternion [w, x, y, z].
        angular_velocity, angular_acceleration, specific_force : (3,) or (m, 3) array_like
            Motion in the end-effector frame (rad/s, rad/s^2, m/s^2); without the acceleration, an IMU that defines that frame.
            `rotation_wxyz` with motion is used for the base tilt only.
        """
        if angular_velocity is None:
            kind: RobotKind = "poses"
            parts = [("position", position, 3), ("rotation_wxyz", rotation_wxyz, 4)]
        else:
            kind = "imu" if angular_acceleration is None else "motion"
            parts = [("angular_velocity", angular_velocity, 3)]
            if kind == "motion":
                parts.append(("angular_acceleration", angular_acceleration, 3))
            parts.append(("specific_force", specific_force, 3))
            if self.settings.base_tilt:
                parts.append(("rotation_wxyz", rotation_wxyz, 4))
        if self._kind is None:
            if kind == "imu" and self.settings.base_tilt:
                raise InputError(
                    "settings.base_tilt", "a robot stream with orientations", "an IMU on the robot"
                )
            self._kind = kind
            extra = 4 if kind == "motion" and self.settings.base_tilt else 0
            self._robot = SampleBuffer(COLUMNS[kind] + extra, self._lateness, self._keep)
        if kind != self._kind:
            raise InputError("robot", f"{self._kind} as in the first sample", kind)
        assert self._robot is not None
        stamps = _stamps(t, "robot.t")
        rows = [_rows(value, f"robot.{name}", stamps.size, width) for name, value, width in parts]
        if rows[-1].shape[1] == 4:
            rows[-1] = _quaternions(rows[-1], "robot.rotation_wxyz")
        self._robot.add(stamps, _without_infinity(np.hstack(rows), "robot"))
        self._advance()

    def add_hand(
        self, t: npt.ArrayLike, angular_velocity: npt.ArrayLike, specific_force: npt.ArrayLike
    ) -> None:
        """Take one sample of the IMU on the hand or a chunk of them.

        Parameters
        ----------
        t : float or (m,) array_like
            s, hand clock.
        angular_velocity, specific_force : (3,) or (m, 3) array_like
            rad/s and m/s^2, in the sensor's frame.
        """
        stamps = _stamps(t, "hand.t")
        rate = _rows(angular_velocity, "hand.angular_velocity", stamps.size, 3)
        force = _rows(specific_force, "hand.specific_force", stamps.size, 3)
        self._hand.add(stamps, _without_infinity(np.hstack([rate, force]), "hand"))
        self._advance()

    # ---- answers out -------------------------------------------------------------------------------------

    @property
    def events(self) -> tuple[GraspEvent, ...]:
        """Regrasps and slips so far, oldest first."""
        return () if self._session is None else self._session.tracker.events

    @property
    def started(self) -> bool:
        """Whether the first seconds have shown rates and clocks, so that estimates come."""
        return self._session is not None

    def estimate(self) -> OnlineGraspEstimate:
        """What is known of the grasp with all data so far."""
        session, counts = self._session, self._counts()
        fit = None if session is None else session.tracker.solve()
        if session is None or fit is None:
            return self._nothing(counts)
        tracker, model, state, settings = session.tracker, fit.model, fit.state, self.settings
        full = tracker.fitter.covariance()
        resolved = _resolved(full[:3, :3], settings.rotation_resolution) and _resolved(
            full[3:6, 3:6], settings.translation_resolution
        )
        offset, offset_sd = session.offset, 0.0
        if "time_offset" in state:
            where = model.columns["time_offset"].start
            offset, offset_sd = offset + float(state["time_offset"][0]), float(np.sqrt(full[where, where]))
        return OnlineGraspEstimate(
            t=tracker.time,
            status=Status.SOLVED if resolved else Status.UNOBSERVABLE,
            message="" if resolved else self._missing(tracker),
            rotation=state["rotation"],
            translation=state["translation"],
            covariance=full[:6, :6],
            time_offset=offset,
            time_offset_sd=offset_sd,
            seconds=tracker.seconds,
            events=tracker.events,
            robot=counts[0],
            hand=counts[1],
            variables=model.variables,
            values=state,
            full_covariance=full,
            rate_moment=tracker.rate_moment,
        )

    def _nothing(self, counts: tuple[StreamCounts, StreamCounts]) -> OnlineGraspEstimate:
        session = self._session
        return OnlineGraspEstimate(
            t=np.nan if session is None else session.tracker.time,
            status=Status.UNOBSERVABLE,
            message=self._waiting(),
            rotation=np.full((3, 3), np.nan),
            translation=np.full(3, np.nan),
            covariance=np.diag(np.full(6, np.inf)),
            time_offset=np.nan if session is None else session.offset,
            time_offset_sd=self.noise.time_offset_sd if self.settings.time_offset else 0.0,
            seconds=0.0 if session is None else session.tracker.seconds,
            events=self.events,
            robot=counts[0],
            hand=counts[1],
            variables=(),
            values={},
            full_covariance=np.zeros((0, 0)),
            rate_moment=np.zeros((3, 3)),
        )

    def _missing(self, tracker: GraspTracker) -> str:
        return "The motion has not shown all of the grasp yet. " + grasp_words.advice(
            tracker.rate_moment, None
        )

    def _waiting(self) -> str:
        if self._robot is None or self._robot.received == 0:
            return "No sample of the robot yet."
        if self._hand.received == 0:
            return "No sample of the hand yet."
        if self._session is not None:
            return "Too little data of this grasp yet."
        if self._correlation == 0.0:
            return f"Waiting for {self._start_seconds:g} s of both streams."
        if self._correlation < SMALLEST_CORRELATION:
            return (
                f"Robot and hand are not seen to turn together yet (correlation of their angular rates {self._correlation:.2f} "
                "at the best offset): move the object about changing axes."
            )
        return "The motion has not shown the offset between the clocks yet: move the object faster, about changing axes."

    def _counts(self) -> tuple[StreamCounts, StreamCounts]:
        lost = 0 if self._session is None else self._session.coupler.overflown
        robot = StreamCounts() if self._robot is None else _counted(self._robot, lost)
        return robot, _counted(self._hand, 0)

    # ---- internals ---------------------------------------------------------------------------------------

    def _advance(self) -> None:
        if self._session is not None:
            self._session.advance()
        elif self._robot is not None and self._kind is not None and self._hand.received:
            self._try_start(self._robot, self._kind)

    def _try_start(self, robot: SampleBuffer, kind: RobotKind) -> None:
        """Start when the first seconds suffice."""
        if robot.newest < self._next_try:
            return
        first, second = robot.everything(), self._hand.everything()
        if not (enough(*first, self._start_seconds) and enough(*second, self._start_seconds)):
            return
        self._next_try = robot.newest + self._retry
        self._retry = min(2.0 * self._retry, _LONGEST_RETRY)
        setup = analyse(kind, first, second, self.noise, self.settings, self.gravity)
        self._correlation = setup.clock.correlation
        if setup.clock.correlation < SMALLEST_CORRELATION:
            return
        robot.start(setup.robot.step, setup.robot.limit)
        self._hand.start(setup.hand.step, setup.hand.limit)
        offset = setup.clock.offset
        for _ in range(_MOST_PASSES):
            session = GraspSession(
                setup, offset, kind, robot, self._hand, self.noise, self.settings, self.prior, self.gravity,
                self._detector, self._block,
            )  # fmt: skip
            error, sd = session.read_start()
            if abs(error) < max(_SETTLED_START, 0.1 * sd):
                break
            offset += error
        if sd <= _STARTING_OFFSET_SD:
            session.keep_start()
            self._session = session


def _resolved(covariance: FloatArray, resolution: float) -> bool:
    """Whether the largest standard deviation in a covariance (3, 3) is within the resolution."""
    limit = resolution**2
    return bool(np.trace(covariance) <= limit or np.linalg.eigvalsh(covariance)[-1] <= limit)


def _counted(buffer: SampleBuffer, lost: int) -> StreamCounts:
    return StreamCounts(
        buffer.received,
        buffer.late,
        buffer.duplicates,
        buffer.incomplete,
        buffer.gaps,
        buffer.overflown + lost,
    )


def _stamps(t: npt.ArrayLike, name: str) -> FloatArray:
    out = np.atleast_1d(np.asarray(t, dtype=np.float64))
    if out.ndim != 1 or not math.isfinite(out.sum()):
        raise InputError(
            name, "a finite time stamp or an array of them, shape (m,) [s]", f"shape {out.shape}: {out}"
        )
    return out


def _rows(values: npt.ArrayLike | None, name: str, count: int, width: int) -> FloatArray:
    if values is None:
        raise InputError(name, f"shape ({count}, {width})", "nothing")
    out = np.asarray(values, dtype=np.float64)
    if out.ndim == 1 and count == 1:
        out = out[None]
    if out.shape != (count, width):
        raise InputError(name, f"shape ({count}, {width}), one row a time stamp", f"shape {out.shape}")
    return out


def _without_infinity(rows: FloatArray, name: str) -> FloatArray:
    if not math.isfinite(rows.sum()) and np.isinf(rows).any():
        raise InputError(name, "finite values, or NaN for a gap", "an infinite value")
    return rows


def _quaternions(q: FloatArray, name: str) -> FloatArray:
    norm = np.sqrt(np.einsum("ij,ij->i", q, q))
    if np.any(norm > 1.0 + _QUATERNION_TOLERANCE):
        worst = float(np.nanmax(norm))
        raise InputError(name, "unit quaternions [w, x, y, z]", f"norm {worst:.6g}")
    return np.asarray(q / np.where(norm < 1.0 - _QUATERNION_TOLERANCE, np.nan, norm)[:, None])

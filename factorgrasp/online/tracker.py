"""From rows of z to the grasp: windows, solves and reviews in their rhythm, and a fresh start after a change."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from factorgrasp import lie
from factorgrasp.losses import make_loss
from factorgrasp.online.change import Change, DetectorSettings
from factorgrasp.online.change_watch import ChangeWatch
from factorgrasp.online.coupled_rows import ACCELEROMETER, GYRO, row_width, shift_hand
from factorgrasp.online.events import GraspEvent
from factorgrasp.online.fitter import GraspFitter
from factorgrasp.online.jump_detector import GRASP, REACH
from factorgrasp.online.level import Level, bin_averages
from factorgrasp.online.moment_solver import Fit, retract
from factorgrasp.online.row_history import RowHistory
from factorgrasp.online.stream_pieces import Piece
from factorgrasp.online.window_bank import WindowBank
from factorgrasp.problems.grasp_kinematics import RobotNoise
from factorgrasp.problems.grasp_model import ACCELEROMETER_WIDTH, TILTED_WIDTH
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.problems.grasp_windows import Windowing
from factorgrasp.typing import FloatArray, State

# s; the change detector looks at windows of twice this length, one every such time.
SEGMENT = 0.04
# Reviews of the weights: after so many seconds of data, and after every further tenth of all data, within these limits (s).
_OFTEN, _SELDOM, _SHARE = 0.5, 5.0, 0.1
# Other local optima are looked for within the first seconds only.
_SURE = 20.0
# A remaining clock offset above this (s) is applied to the data; the model is linear in what remains.
_SETTLED_OFFSET = 1e-4
# s; a change that is found this soon after another one is the same one going on, as is a small one (and a drift) a little later. What
# goes on again and again for longer than the latter is a slip.
_SAME_CHANGE, _AFTERMATH = 1.0, 4.0
# s; before so much data of the grasp after, the detector knows better how far a change went.
_SETTLING = 0.5
# s; an estimate from fewer data is nothing to see a change against.
_BLIND = 1.0
_MOST_EVENTS = 256


class GraspTracker:
    """Estimates the grasp from rows of z as they come.

    Parameters
    ----------
    step : float
        s, between rows.
    bandwidth : float
        Hz.
    robot : callable
        Frequencies (K,) in Hz to the densities of the robot's noise.
    noise, settings, prior : GraspNoise, GraspSettings, GraspPrior
    detector : DetectorSettings or None
        None: changes are not looked for.
    block : float
        s; new data enter the estimate in blocks of about this length.
    """

    def __init__(
        self,
        step: float,
        bandwidth: float,
        robot: Callable[[FloatArray], RobotNoise],
        noise: GraspNoise,
        settings: GraspSettings,
        prior: GraspPrior,
        detector: DetectorSettings | None,
        block: float,
    ) -> None:
        self.step = step
        self.hop = max(1, round(block / step))
        self.segment = self.hop * max(1, round(SEGMENT / (self.hop * step)))
        self._loss = make_loss(settings.loss, settings.loss_scale)
        width = TILTED_WIDTH if settings.base_tilt else ACCELEROMETER_WIDTH
        half = max(2, round(0.5 * settings.window / step))
        lever_arm = np.full(3, np.linalg.norm(prior.translation) or 0.5) / np.sqrt(3.0)

        def level(length: int, hop: int) -> Level:
            windowing = Windowing(step, length, max(2, int(bandwidth * length * step + 1e-9) + 1))
            bank = WindowBank(windowing, hop, width, settings.forgetting_time, self._loss is not None)
            return Level(bank, bin_averages(robot, windowing), noise, settings, lever_arm)

        self.fitter = GraspFitter(
            level(2 * self.segment, self.segment), level(2 * half, self.hop), noise, settings, prior
        )
        self.history = RowHistory((REACH + 4) * self.segment + 2 * half, row_width(settings.base_tilt))
        self._watch = None
        if detector is not None:
            self._watch = ChangeWatch(self.fitter, self.segment, row_width(settings.base_tilt), detector)
        self._since_hop = self._since_segment = 0
        self._events: deque[GraspEvent] = deque(maxlen=_MOST_EVENTS)
        self._before: tuple[State, FloatArray] | None = None
        self._repeats = 0
        self.event_count = 0
        self._clock_shift = 0.0
        self._begin()

    def _begin(self) -> None:
        self._rows = 0
        self._force, self._rates = np.zeros(3), np.zeros((3, 3))
        self._next_review = _OFTEN
        self._pending = False

    # ---- rows in -----------------------------------------------------------------------------------------

    def take(self, piece: Piece) -> None:
        """Take rows of z (m, c)."""
        t, z, starts = piece
        if starts:
            self._since_hop = self._since_segment = 0
        first = 0
        while first < t.size:
            count = min(t.size - first, self.segment - self._since_segment)
            rows = z[first : first + count]
            if self._clock_shift != 0.0:
                # Read before the last review moved the clock.
                rows = rows.copy()
                shift_hand(rows, self._clock_shift)
            self.history.append(t[first : first + count], rows, starts and first == 0)
            self._count(rows)
            self._since_segment += count
            hops, self._since_hop = divmod(self._since_hop + count, self.hop)
            if hops:
                self._slide(hops)
            if self._since_segment == self.segment:
                self._since_segment = 0
                self._finish_segment()
            first += count

    def _count(self, z: FloatArray) -> None:
        self._rows += z.shape[0]
        self._force += z[:, 10:13].sum(axis=0)
        self._rates += z[:, 0:3].T @ z[:, 0:3]

    def _slide(self, hops: int) -> None:
        """Long windows that end with each of the last `hops` hops."""
        self._pending = True
        level, skip = self.fitter.long, self._since_hop
        length = level.bank.windowing.length
        usable = min(self.history.kept - skip, (hops - 1) * self.hop + length)
        if usable >= length:
            rows = self.history.last(usable + skip)[:usable]
            coefficients = level.bank.coefficients(rows)
            level.bank.add(coefficients, self._trust(level, coefficients))

    def _trust(self, level: Level, coefficients: FloatArray) -> FloatArray | None:
        """Robust weights (N,) of windows at insertion, by their whitened residuals."""
        if self._loss is None:
            return None
        fit = self.fitter.fit
        if fit is None:
            return np.ones(coefficients.shape[0])
        norm = np.zeros(coefficients.shape[0])
        for k, (L, part) in enumerate(zip(fit.model.matrices(fit.state), (GYRO, ACCELEROMETER), strict=True)):
            norm += 0.5 * level.relative_power(k, np.sum((coefficients[..., part] @ L.T) ** 2, axis=(2, 3)))
        return np.asarray(self._loss.weight(np.sqrt(norm)))

    # ---- the estimate ------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time of the newest row, s, robot clock."""
        return float(self.history.last_times(1)[0]) if self.history.run else np.nan

    @property
    def seconds(self) -> float:
        """Data of this grasp, s."""
        return self._rows * self.step

    @property
    def rate_moment(self) -> FloatArray:
        """Mean of ``w_r w_r'`` (3, 3) over this grasp."""
        return self._rates / max(self._rows, 1)

    def solve(self) -> Fit | None:
        """The estimate with all windows so far."""
        if self._pending:
            self._pending = False
            self.fitter.solve(self._force / max(self._rows, 1), self.rate_moment)
        return self.fitter.fit

    def taken_clock_shift(self) -> float:
        """By how much (s) the hand is to be read later than before the last call."""
        shift, self._clock_shift = self._clock_shift, 0.0
        return shift

    @property
    def events(self) -> tuple[GraspEvent, ...]:
        """Changes of the grasp so far, the last one with the best present knowledge of how far."""
        if not self._events:
            return ()
        return (*list(self._events)[:-1], self._refined(self._events[-1]))

    # ---- what is done now and then -----------------------------------------------------------------------

    def _finish_segment(self) -> None:
        if self.history.kept < 2 * self.segment:
            return
        short = self.fitter.short
        coefficients = short.bank.coefficients(self.history.last(2 * self.segment))
        short.bank.add(coefficients, self._trust(short, coefficients))
        if self._watch is not None:
            self._watch.add(self.time, coefficients)
            alert = bool(self._events) and self.time - self._events[-1].until < _AFTERMATH
            change = self._watch.find(self.history, alert)
            if change is not None:
                self._start_afresh(change)
                return
        if self.solve() is None:
            return
        if self.seconds >= self._next_review:
            self._review()
        if self._watch is not None and self.seconds >= _BLIND:
            self._watch.remember(self.time)

    def _review(self) -> None:
        self._next_review = self.seconds + min(max(_OFTEN, _SHARE * self.seconds), _SELDOM)
        self.fitter.review(self.seconds < _SURE, self._force / self._rows, self.rate_moment)
        fit = self.fitter.fit
        assert fit is not None
        shift = float(fit.state["time_offset"][0]) if "time_offset" in fit.state else 0.0
        if abs(shift) > _SETTLED_OFFSET:
            self.fitter.shift_clock(shift)
            shift_hand(self.history.last(self.history.kept), shift)
            if self._watch is not None:
                self._watch.shift_clock(shift)
            self._clock_shift += shift
        if self._watch is not None:
            self._watch.refer()

    def _start_afresh(self, change: Change) -> None:
        self._note(change)
        step = _padded(change.jump.step, self.fitter.model.size)
        self.fitter.restart(
            change.before, change.before_covariance, retract(self.fitter.model, change.before, step)
        )
        self._begin()
        kept = min(change.rows, self.history.kept)
        self.history.run = kept
        self._count(self.history.last(kept) if kept else self.history.last(1)[:0])
        assert self._watch is not None
        self._watch.restart(kept // self.segment - 1)
        short = self.fitter.short.bank
        if kept >= 2 * self.segment:
            short.add(short.coefficients(self.history.last(kept)))
        self._slide(max(kept // self.hop, 1))

    def _note(self, change: Change) -> None:
        """Put a change on record; one that follows another at once is that one, going on."""
        now, last, jump = self.time, self._events[-1] if self._events else None, change.jump
        if last is not None and self._before is not None and self._goes_on(last, change):
            self._repeats += 1
            lasts = self._repeats > 1 and now - last.time > _AFTERMATH
            drifts = lasts or "slip" in (change.kind, last.kind)
            after = retract(self.fitter.model, change.before, _padded(jump.step, self.fitter.model.size))
            self._events[-1] = replace(
                last,
                kind="slip" if drifts else "regrasp",
                until=now,
                step=_between(self._before[0], after),
                covariance=jump.covariance + self._before[1],
                log_bayes_factor=max(last.log_bayes_factor, jump.log_bayes_factor),
            )
            return
        if last is not None:
            self._events[-1] = self._refined(last)
        self._before = (change.before, change.before_covariance[:GRASP, :GRASP])
        self._repeats = 0
        self.event_count += 1
        self._events.append(
            GraspEvent(change.kind, change.time, now, now, jump.step, jump.covariance, jump.log_bayes_factor)
        )

    def _goes_on(self, last: GraspEvent, change: Change) -> bool:
        since = change.time - last.until
        if change.large and change.kind == "regrasp" and last.kind == "regrasp":
            return since < _SAME_CHANGE
        return since < _AFTERMATH

    def _refined(self, event: GraspEvent) -> GraspEvent:
        """The event with the difference between the estimates after and before, where that is known better."""
        fit = self.fitter.fit
        if fit is None or self._before is None or self.seconds < _SETTLING:
            return event
        before, P = self._before
        turn = np.eye(GRASP)
        turn[:3, :3] = fit.state["rotation"].T @ before["rotation"]
        covariance = turn @ P @ turn.T + self.fitter.covariance()[:GRASP, :GRASP]
        if event.kind == "regrasp" and np.sum(np.diag(covariance) / np.diag(event.covariance)) > GRASP:
            return event
        return replace(event, step=_between(before, fit.state), covariance=covariance)


def _between(before: State, after: State) -> FloatArray:
    """[rotation vector; translation] (6,) from one grasp to another."""
    turn = lie.so3_log(before["rotation"].T @ after["rotation"])
    return np.concatenate([turn, after["translation"] - before["translation"]])


def _padded(step: FloatArray, size: int) -> FloatArray:
    return np.concatenate([step, np.zeros(size - step.size)])

"""Watches the estimate for a change of the grasp: keeps what the jump detector needs, and says when, how far and how a change went."""

from __future__ import annotations

import numpy as np

from factorgrasp.online.change import Change, DetectorSettings
from factorgrasp.online.coupled_rows import ACCELEROMETER, GYRO, shift_hand
from factorgrasp.online.fitter import GraspFitter, columns_of
from factorgrasp.online.jump_detector import (
    GRASP,
    GUARD,
    REACH,
    STARTS,
    Jump,
    JumpDetector,
    Segments,
    explain,
)
from factorgrasp.online.moment_solver import Linearised, Moment, local, retract
from factorgrasp.online.row_history import RowHistory
from factorgrasp.online.slow_watch import SlowWatch
from factorgrasp.problems.grasp_model import GYRO_WIDTH, GraspModel
from factorgrasp.typing import FloatArray, State

# A drift is told from a jump by this much evidence, and lasts at least so many segments.
_SLIP_EVIDENCE = 3.0
_SLIP_SHARE = 0.05
_SHORTEST_SLIP = 20
# Starts are all tried at every sixth segment, the newest ones whenever a segment fits badly.
_FULL_TEST, _QUICK_STARTS = 6, 4
# Moments for a second, closer look are kept at every third segment.
_MOMENTS_EVERY = 3
# Segments of a second, roughly.
_SECOND = 25
# A reference this far (tangent step) from the estimate before makes its snapshots worthless.
_FAR = 0.2


class ChangeWatch:
    """Segments since a few seconds, and the test on them.

    Parameters
    ----------
    fitter : GraspFitter
    segment : int
        Rows between segments.
    columns : int
        Of one row.
    settings : DetectorSettings
    """

    def __init__(self, fitter: GraspFitter, segment: int, columns: int, settings: DetectorSettings) -> None:
        self._fitter, self._segment, self._settings = fitter, segment, settings
        self._coefficients = RowHistory(REACH, fitter.short.bank.windowing.bins * 2 * columns)
        width = fitter.long.bank.width
        self._moments = RowHistory(REACH // _MOMENTS_EVERY + 2, 2 * (GYRO_WIDTH**2 + width**2))
        self._reference: State | None = None
        self._lines: Linearised | None = None
        self._model: GraspModel = fitter.model
        self._detector = JumpDetector(fitter.model.size)
        self._slow = SlowWatch(fitter, settings, segment * _SECOND)
        self._turn = self._in_second = 0

    def add(self, time: float, coefficients: FloatArray) -> None:
        """A segment is complete at `time`: coefficients of the newest short window."""
        self._in_second += 1
        self._coefficients.append(np.array([time]), coefficients.reshape(1, -1), False)
        if self._reference is not None:
            self._give_segments(1)

    def remember(self, time: float) -> None:
        """Keep the estimate as what was known at `time`."""
        fit = self._fitter.fit
        if fit is None:
            return
        if self._reference is None:
            self.refer()
        assert self._reference is not None
        mean, covariance = local(self._model, self._reference, fit.state), self._fitter.covariance()
        self._detector.add_snapshot(time, mean, covariance)
        level = self._fitter.level
        assert level is not None
        if self._turn % _MOMENTS_EVERY == 0:
            self._moments.append(np.array([time]), level.moment().to_row()[None], False)
        if self._in_second == _SECOND:
            self._in_second = 0
            self._slow.remember(time)

    def refer(self) -> None:
        """Linearise at the present estimate, with its model and its weights."""
        fit = self._fitter.fit
        assert fit is not None
        if fit.model is not self._model:
            self._change_model(fit.model)
        if self._reference is not None:
            shift = local(self._model, {**fit.state, **self._reference}, fit.state)
            self._detector.move(shift)
            if np.linalg.norm(shift[:GRASP]) > _FAR:
                self._detector.forget()
                self._moments.run = 0
        self._reference, self._lines = fit.state, Linearised(self._model, fit.state)
        self._detector.forget_segments()
        self._give_segments(self._coefficients.kept)

    def _change_model(self, model: GraspModel) -> None:
        """Other errors of the hand's sensors have become unknowns."""
        names = tuple(v.name for v in self._model.variables)
        if {v.name for v in model.variables}.issuperset(names):
            precision = np.diag(self._fitter.prior.information)
            self._detector = self._detector.widened(columns_of(model, names), model.size, 1.0 / precision)
        else:
            # What was known with more unknowns is of no use for fewer.
            self._detector, self._reference = JumpDetector(model.size), None
            self._moments.run = 0
        self._model = model

    def shift_clock(self, shift: float) -> None:
        """The hand is read later by `shift` (s) from now on."""
        count = self._coefficients.kept
        short = self._fitter.short.bank
        shift_hand(self._coefficients.last(count).reshape(count, short.windowing.bins, 2, -1), shift)
        self._moment_shift(shift)
        self._slow.shift_clock(shift)
        if self._reference is not None and "time_offset" in self._reference:
            self._reference = {**self._reference, "time_offset": self._reference["time_offset"] - shift}
            self._lines = Linearised(self._model, self._reference)

    def _moment_shift(self, shift: float) -> None:
        """As for the coefficients: moments Z of z become T Z T'."""
        rows = self._moments.last(self._moments.kept)
        width = self._fitter.long.bank.width
        T = np.eye(GYRO_WIDTH + width)
        shift_hand(T.T, shift)
        first = 0
        for part, size in ((GYRO, GYRO_WIDTH), (ACCELEROMETER, width)) * 2:
            block = rows[:, first : first + size**2]
            change = T[part, part]
            block[...] = (change @ block.reshape(-1, size, size) @ change.T).reshape(block.shape)
            first += size**2

    def restart(self, segments: int) -> None:
        """Another grasp, of which the newest `segments` are."""
        self._coefficients.run = max(min(self._coefficients.kept, segments), 0)
        self._detector.forget()
        self._moments.run = 0
        self._reference = None
        self._slow.restart()
        self._in_second = 0

    def find(self, rows: RowHistory, alert: bool) -> Change | None:
        """A change of the grasp in the newest segments.

        Parameters
        ----------
        rows : RowHistory
        alert : bool
            The grasp has just changed: smaller changes count, too, since they may be the rest of that one.
        """
        found = self._find_fast(rows, self._settings.alerted() if alert else self._settings)
        if found is None and self._in_second == _SECOND:
            return self._slow.add(float(rows.last_times(1)[0]), self._segment_moments(_SECOND))
        return found

    def _find_fast(self, rows: RowHistory, settings: DetectorSettings) -> Change | None:
        self._turn = (self._turn + 1) % _FULL_TEST
        if self._turn and not self._detector.loud():
            return None
        starts = self._detector.starts(STARTS if self._turn == 0 else STARTS[:_QUICK_STARTS])
        if not starts:
            return None
        jumps = self._detector.jumps(starts, settings.give)
        if max(jump.log_bayes_factor for jump in jumps) < settings.log_bayes_factor:
            return None
        best, drift = self._detector.shapes(settings.give)
        margin = max(_SLIP_EVIDENCE, _SLIP_SHARE * best.evidence)
        slips = drift.segments >= _SHORTEST_SLIP and drift.evidence > best.evidence + margin
        if not settings.reports(drift.step if slips else best.step):
            return None
        sure = self._confirmed(best, settings)
        if sure is None:
            return None
        if slips:
            time, state, covariance = self._before(drift)
            kept = max(best.segments // 2, 1) * self._segment
            return Change("slip", time, kept, state, covariance, drift, self._settings.reports(drift.step))
        _, state, covariance = self._before(best)
        kept, large = self._since(rows, sure, state), self._settings.reports(sure.step)
        return Change("regrasp", float(rows.last_times(kept + 1)[0]), kept, state, covariance, sure, large)

    def _confirmed(self, jump: Jump, settings: DetectorSettings) -> Jump | None:
        """The jump, if it convinces even where errors of the hand's sensors could explain the residuals instead."""
        time, state, _ = self._before(jump)
        older = int(np.searchsorted(self._moments.last_times(self._moments.kept), time, side="right"))
        if older == 0:
            return None
        row = self._moments.last(self._moments.kept)[older - 1]
        known = Moment.from_row(row, self._fitter.long.bank.width)
        fit = self._fitter.with_sensor_errors(state, known)
        count = jump.segments
        normals = Linearised(fit.model, fit.state).normals(
            self._segment_moments(count), self._fitter.short.window_noise
        )
        cost, gradient, information = (part.sum(axis=0) for part in normals)
        covariance = fit.covariance()
        covariance[range(GRASP), range(GRASP)] += settings.give
        data = Segments(
            [count],
            np.array([cost]),
            np.array([count * self._fitter.short.residuals]),
            np.zeros((1, fit.model.size)),
            covariance[None],
            gradient[None],
            information[None],
            gradient[None, :GRASP],
            information[None, :, :GRASP],
            information[None, :GRASP, :GRASP],
        )
        surer = explain(data, np.zeros(1), np.zeros(1))[0]
        return surer if surer.log_bayes_factor >= settings.log_bayes_factor else None

    def _segment_moments(self, count: int) -> tuple[FloatArray, FloatArray]:
        short = self._fitter.short
        c = self._coefficients.last(count).reshape(count, short.bank.windowing.bins, 2, -1)
        return short.segment_moments(c[..., GYRO], c[..., ACCELEROMETER])

    def _give_segments(self, count: int) -> None:
        assert self._reference is not None
        if count == 0:
            return
        assert self._lines is not None
        normals = self._lines.normals(self._segment_moments(count), self._fitter.short.window_noise)
        self._detector.add_segments(
            self._coefficients.last_times(count), *normals, self._fitter.short.residuals
        )

    def _before(self, jump: Jump) -> tuple[float, State, FloatArray]:
        assert self._reference is not None
        time, mean, covariance = self._detector.snapshot(jump.segments)
        return time, retract(self._model, self._reference, mean), covariance

    def _since(self, rows: RowHistory, jump: Jump, before: State) -> int:
        """How many of the newest rows fit the grasp after better than the one before."""
        after = retract(self._model, before, np.concatenate([jump.step, np.zeros(self._model.size - GRASP)]))
        first = (jump.segments + GUARD + 2) * self._segment
        z = rows.last(min(first, rows.kept))
        gain = np.zeros(z.shape[0])
        for part, L_before, L_after in zip(
            (GYRO, ACCELEROMETER), self._model.matrices(before), self._model.matrices(after), strict=True
        ):
            e_before = np.sum((z[:, part] @ L_before.T) ** 2, axis=1)
            e_after = np.sum((z[:, part] @ L_after.T) ** 2, axis=1)
            gain += (e_before - e_after) / max(float(np.mean(e_before[: self._segment])), 1e-300)
        # The best split: rows after it speak for the new grasp, rows before it for the old one.
        total = np.cumsum(gain[::-1])
        return int(
            np.clip(
                np.argmax(total) + 1, jump.segments * self._segment, (jump.segments + GUARD) * self._segment
            )
        )

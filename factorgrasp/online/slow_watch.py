"""Watches the estimate for slow changes of the grasp, over half a minute, a second at a time."""

from __future__ import annotations

import numpy as np

from factorgrasp.online.change import Change, DetectorSettings
from factorgrasp.online.fitter import GraspFitter, columns_of
from factorgrasp.online.jump_detector import JumpDetector
from factorgrasp.online.moment_solver import Linearised, local, retract
from factorgrasp.problems.grasp_model import GraspModel
from factorgrasp.typing import FloatArray, State

# Seconds since a change at which it is looked for.
_STARTS = (1, 2, 3, 4, 6, 8, 11, 15, 20, 26)
# Seconds; what began later is for the fast detector, which sees its shape.
_YOUNGEST = 4
# Rows that are kept of a grasp that slips, as part of the time since the best jump.
_KEPT = 0.25


class SlowWatch:
    """The change detector on segments of a second, with every error of the hand's sensors as unknown.

    Parameters
    ----------
    fitter : GraspFitter
    settings : DetectorSettings
    rows : int
        Of one second.
    """

    def __init__(self, fitter: GraspFitter, settings: DetectorSettings, rows: int) -> None:
        self._fitter, self._settings, self._rows = fitter, settings, rows
        self._model: GraspModel | None = None
        self._reference: State | None = None
        self._detector: JumpDetector | None = None

    def add(self, time: float, moments: tuple[FloatArray, FloatArray]) -> Change | None:
        """A second is complete: moments (N, 10, 10) and (N, m, m) of its short windows; a change of the grasp, if they show one."""
        if self._detector is None or self._reference is None or self._model is None:
            return None
        short = self._fitter.short
        normals = Linearised(self._model, self._reference).normals(moments, short.window_noise)
        count = moments[0].shape[0]
        sums = [part.sum(axis=0, keepdims=True) for part in normals]
        self._detector.add_segments(np.array([time]), sums[0], sums[1], sums[2], count * short.residuals)
        starts = self._detector.starts(_STARTS)
        if not starts:
            return None
        jumps = self._detector.jumps(starts, self._settings.give)
        if max(jump.log_bayes_factor for jump in jumps) < self._settings.log_bayes_factor:
            return None
        best, drift = self._detector.shapes(self._settings.give)
        slips = drift.evidence > best.evidence
        found = drift if slips else best
        if (
            found.segments < _YOUNGEST
            or found.evidence < self._settings.log_bayes_factor
            or not self._settings.reports(found.step)
        ):
            return None
        start, mean, covariance = self._detector.snapshot(found.segments)
        where = columns_of(self._model, tuple(v.name for v in self._fitter.model.variables))
        before = retract(self._model, self._reference, mean)
        kept = int(best.segments * self._rows * (_KEPT if slips else 1.0))
        return Change(
            "slip" if slips else "regrasp",
            start,
            max(kept, self._rows),
            {variable.name: before[variable.name] for variable in self._fitter.model.variables},
            covariance[np.ix_(where, where)],
            found,
            True,
        )

    def remember(self, time: float) -> None:
        """Keep the estimate as what was known at `time`."""
        fit, level = self._fitter.fit, self._fitter.level
        if fit is None or level is None:
            return
        wide = self._fitter.with_sensor_errors(fit.state, level.moment())
        covariance = wide.covariance()
        # Where the model check found the noise model too narrow, it is so here, too.
        where = columns_of(wide.model, tuple(v.name for v in fit.model.variables))
        wider = np.ones(wide.model.size)
        wider[where] = np.sqrt(
            np.maximum(np.diag(self._fitter.covariance()) / np.diag(fit.covariance()), 1.0)
        )
        covariance = wider[:, None] * covariance * wider
        if self._detector is None or self._reference is None:
            self._model, self._detector = wide.model, JumpDetector(wide.model.size)
        else:
            self._detector.move(local(wide.model, self._reference, wide.state))
        self._reference = wide.state
        self._detector.add_snapshot(time, np.zeros(wide.model.size), covariance)

    def shift_clock(self, shift: float) -> None:
        """The hand is read later by `shift` (s) from now on."""
        if self._reference is not None and "time_offset" in self._reference:
            self._reference = {**self._reference, "time_offset": self._reference["time_offset"] - shift}

    def restart(self) -> None:
        """Another grasp."""
        self._model = self._reference = self._detector = None

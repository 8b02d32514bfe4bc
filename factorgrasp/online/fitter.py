"""The estimate of one grasp: which unknowns, which windows, which weights, and how wide the covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgrasp.online.level import Level
from factorgrasp.online.moment_solver import Fit, GaussianPrior, Moment, definite, descend, evaluate
from factorgrasp.problems.grasp_model import GraspModel
from factorgrasp.problems.grasp_model_check import ModelCheck, check_model
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.problems.grasp_system import (
    SENSOR_ERRORS,
    grasp_variables,
    insignificant,
    prior_precision,
    wahba_start,
)
from factorgrasp.typing import FloatArray, IntArray, State

GRASP_NAMES = ("rotation", "translation")
# Half-overlapping windows after which a level is used: the short windows at once, the long ones when their slow start no longer costs much.
_ENOUGH_SHORT, _ENOUGH_LONG = 2.0, 6.0
# Where gaps leave the long windows less than this part of the data, the short ones know more.
_COVERED = 0.5
# A warm start whose step is below this many standard deviations is there.
_TOLERANCE = 0.5
# Moments that are definite by so much at a review are taken to stay so until the next.
_MARGIN = 1e-9
# Half a turn from the present rotation lie the other local optima, if any. They are tried while data are few.
_HALF_TURNS = np.array(
    [np.diag(signs) for signs in ((1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))]
)
# Chances at which errors of the hand's sensors become unknowns, and stop to be.
_APPEARS, _VANISHES = 1e-4, 1e-2
# A start that ends lower by this much of the cost (a log likelihood) is better.
_BETTER = 1.0


def columns_of(model: GraspModel, names: tuple[str, ...]) -> IntArray:
    """Columns of some unknowns, in the order of `names`."""
    where = model.columns
    return np.concatenate([np.arange(where[name].start, where[name].stop) for name in names])


class GraspFitter:
    """Solves and reviews the estimate of the present grasp.

    Parameters
    ----------
    short, long : Level
        Windows for the first seconds, and for good.
    noise, settings, prior : GraspNoise, GraspSettings, GraspPrior
    """

    def __init__(
        self, short: Level, long: Level, noise: GraspNoise, settings: GraspSettings, prior: GraspPrior
    ) -> None:
        self.short, self.long = short, long
        self._noise, self._settings, self._grasp_prior = noise, settings, prior
        absent = frozenset() if settings.sensor_errors == "always" else frozenset(SENSOR_ERRORS)
        self.model = GraspModel(*grasp_variables(noise, settings, absent))
        self.prior = GaussianPrior(
            self._prior_mean(self.model), np.diag(prior_precision(self.model, noise, prior))
        )
        self.fit: Fit | None = None
        self._check: ModelCheck | None = None
        self._covariance: tuple[Fit, FloatArray] | None = None
        self._definite = False
        self._guess: State | None = None

    @property
    def level(self) -> Level | None:
        """The windows in use; None while there are too few."""
        short, long = self.short.bank, self.long.bank
        if long.count >= _ENOUGH_LONG and long.seconds > _COVERED * short.seconds:
            return self.long
        return self.short if short.count >= _ENOUGH_SHORT else None

    def solve(self, mean_force: FloatArray, rate_moment: FloatArray) -> Fit | None:
        """The estimate with all windows so far; None while there are too few."""
        level = self.level
        if level is None:
            return None
        if self.fit is None:
            return self._first(level, mean_force, rate_moment)
        self.fit = descend(
            self.model, self.fit.state, level.moment(), self.prior, 3, _TOLERANCE, not self._definite
        )
        return self.fit

    def covariance(self) -> FloatArray:
        """Covariance (n, n) of the estimate, widened where the model check found the noise model alone too narrow."""
        assert self.fit is not None
        if self._covariance is None or self._covariance[0] is not self.fit:
            fit = self.fit
            if self._check is not None and not self._check.passed:
                fit = replace(fit, meat=self._check.widened(fit.information, fit.meat))
            self._covariance = (self.fit, fit.covariance())
        return self._covariance[1]

    def review(self, young: bool, mean_force: FloatArray, rate_moment: FloatArray) -> None:
        """Weigh the bands anew, look for sensor errors and for a better optimum, and check the model."""
        level = self.level
        if level is None or self.fit is None:
            return
        for each in {id(level): level, id(self.short): self.short}.values():
            each.refresh(self.fit, mean_force, rate_moment)
        self.fit = descend(self.model, self.fit.state, level.moment(), self.prior, 3, _TOLERANCE)
        moment = level.moment()
        self._definite = all(definite(Z, _MARGIN) for Z in (moment.gyro, moment.accelerometer))
        if young:
            self._try_other_starts(level)
        if self._settings.sensor_errors == "auto" and level is self.long:
            self._choose_sensor_errors(level)
        self._covariance = None
        self._check = self._checked(level) if self._settings.check_model and level is self.long else None

    def with_sensor_errors(self, start: State, moment: Moment) -> Fit:
        """Fit of moments with every error of the hand's sensors that the settings allow as unknown."""
        absent = frozenset(SENSOR_ERRORS) if self._settings.sensor_errors == "never" else frozenset()
        wide = GraspModel(*grasp_variables(self._noise, self._settings, absent))
        prior = self._prior_for(wide)
        return descend(wide, {**prior.mean, **start}, moment, prior, 4, _TOLERANCE)

    def shift_clock(self, shift: float) -> None:
        """The hand is read later by `shift` (s) from now on, and in all moments."""
        for level in (self.short, self.long):
            level.bank.shift_clock(shift)
        self.prior = replace(self.prior, mean=_earlier(self.prior.mean, shift))
        if self.fit is not None:
            self.fit = replace(self.fit, state=_earlier(self.fit.state, shift))

    def restart(self, state: State, covariance: FloatArray, guess: State) -> None:
        """Another grasp: what is known of everything else, from an estimate and its covariance (n, n), becomes the prior."""
        names = tuple(v.name for v in self.model.variables if v.name not in GRASP_NAMES)
        information = np.diag(prior_precision(self.model, self._noise, self._grasp_prior))
        mean = self._prior_mean(self.model)
        if names:
            where = columns_of(self.model, names)
            information[np.ix_(where, where)] = np.linalg.inv(covariance[np.ix_(where, where)])
            mean |= {name: state[name] for name in names}
        self.prior = GaussianPrior(mean, information)
        self.short.restart()
        self.long.restart()
        self.fit, self._check, self._guess, self._definite = None, None, guess, False

    def _prior_mean(self, model: GraspModel) -> dict[str, FloatArray]:
        mean = {variable.name: np.zeros(variable.size) for variable in model.variables}
        mean["translation"] = self._grasp_prior.translation.copy()
        mean["rotation"] = np.eye(3) if self._grasp_prior.rotation is None else self._grasp_prior.rotation
        return mean

    def _first(self, level: Level, mean_force: FloatArray, rate_moment: FloatArray) -> Fit:
        start = self._guess
        if start is None:
            start = {
                **self.prior.mean,
                "rotation": wahba_start(level.moment().gyro[:3, 3:6], self._grasp_prior),
            }
        for _ in range(5):
            self.fit = descend(self.model, start, level.moment(), self.prior, 20)
            start = self.fit.state
            if level.refresh(self.fit, mean_force, rate_moment) < 0.05:
                break
        self._guess = None
        self.fit = descend(self.model, start, level.moment(), self.prior, 5)
        return self.fit

    def _try_other_starts(self, level: Level) -> None:
        assert self.fit is not None
        moment = level.moment()
        wahba = wahba_start(moment.gyro[:3, 3:6], self._grasp_prior)
        for rotation in (wahba, *(self.fit.state["rotation"] @ _HALF_TURNS)):
            other = descend(self.model, {**self.prior.mean, "rotation": rotation}, moment, self.prior, 8)
            if other.cost < self.fit.cost - _BETTER:
                self.fit = descend(self.model, other.state, moment, self.prior, 10)

    def _choose_sensor_errors(self, level: Level) -> None:
        """Errors of the hand's sensors that the data show become unknowns, and those that turn out to be nothing are none any more."""
        assert self.fit is not None
        moment = level.moment()
        fit = self.with_sensor_errors(self.fit.state, moment)
        covariance = fit.covariance()
        present = {variable.name for variable in self.model.variables}
        # Looked at again and again, chance alone would pass the batch problem's threshold now and then.
        unproven = insignificant(fit.model.variables, fit.state, covariance, _APPEARS) - present
        nothing = insignificant(fit.model.variables, fit.state, covariance, _VANISHES) & present
        model = GraspModel(*grasp_variables(self._noise, self._settings, unproven | nothing))
        if model.size == self.model.size:
            return
        self.prior = self._prior_for(model)
        self.model = model
        start = {variable.name: fit.state[variable.name] for variable in model.variables}
        self.fit = descend(model, start, moment, self.prior, 10)

    def _prior_for(self, model: GraspModel) -> GaussianPrior:
        """The present prior for a model with other sensor errors: new ones at their own prior, dropped ones known to be zero."""
        information = np.diag(prior_precision(model, self._noise, self._grasp_prior))
        mean = self._prior_mean(model)
        names = tuple(v.name for v in self.model.variables if v.name in mean)
        to, source = columns_of(model, names), columns_of(self.model, names)
        information[np.ix_(to, to)] = self.prior.information[np.ix_(source, source)]
        return GaussianPrior(mean | {name: self.prior.mean[name] for name in names}, information)

    def _checked(self, level: Level) -> ModelCheck:
        assert self.fit is not None
        # The check takes differences of large matrices, which must belong to the very same state.
        fit = evaluate(self.model, self.fit.state, level.moment(), self.prior)
        return check_model(
            self.model,
            fit.state,
            level.bank.moments(),
            level.expected,
            level.variances,
            np.diag(self.prior.information),
            fit.information,
            fit.meat,
            level.bank.windowing.frequencies,
            self._settings.errors_in_variables,
        )


def _earlier(state: State, shift: float) -> State:
    if "time_offset" not in state:
        return state
    return {**state, "time_offset": state["time_offset"] - shift}

"""One kind of window with everything that weighs its bands: expected noise, residual power, trust."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np

from factorgrasp.online.moment_solver import Fit, Moment
from factorgrasp.online.window_bank import WindowBank
from factorgrasp.problems.grasp_kinematics import RobotNoise
from factorgrasp.problems.grasp_model import phi_matrix
from factorgrasp.problems.grasp_noise import (
    BandVariances,
    NoiseMoments,
    declared_variances,
    estimated_variances,
    noise_moments,
)
from factorgrasp.problems.grasp_settings import GraspNoise, GraspSettings
from factorgrasp.problems.grasp_system import floored_inverse
from factorgrasp.problems.grasp_windows import Windowing
from factorgrasp.typing import FloatArray

# Points a bin over which a density is averaged, and half their range in bins: the spectrum of the sine taper.
_POINTS, _RANGE = 25, 1.5


def bin_averages(robot: Callable[[FloatArray], RobotNoise], windowing: Windowing) -> RobotNoise:
    """Densities of the robot's noise (K,) as the windows see them: averages over each bin, which matter where bins are wide."""
    offset = np.linspace(-_RANGE, _RANGE, _POINTS)
    n = np.arange(windowing.length)
    taper = np.sin(np.pi * (n + 0.5) / windowing.length)
    weight = np.abs(np.exp(-2j * np.pi * np.outer(offset, n) / windowing.length) @ taper) ** 2
    weight /= weight.sum()
    spacing = 1.0 / (windowing.length * windowing.step)
    fine = np.abs(windowing.frequencies[:, None] + spacing * offset)
    density = robot(fine.ravel())
    return RobotNoise(*(getattr(density, f.name).reshape(fine.shape) @ weight for f in fields(RobotNoise)))


class Level:
    """A bank of windows, its noise model and its band weights.

    Parameters
    ----------
    bank : WindowBank
    robot : RobotNoise
        Densities at the bins' frequencies.
    noise, settings : GraspNoise, GraspSettings
    lever_arm : (3,) ndarray
        m; a guess through which the robot's noise acts before anything is known.
    """

    def __init__(
        self,
        bank: WindowBank,
        robot: RobotNoise,
        noise: GraspNoise,
        settings: GraspSettings,
        lever_arm: FloatArray,
    ) -> None:
        self.bank = bank
        self._robot, self._noise, self._settings = robot, noise, settings
        self.expected = self._expect(np.zeros(3), np.zeros((3, 3)))
        self.declared = declared_variances(self.expected, lever_arm)
        self._lever_arm = self._guess = lever_arm
        self.variances = self.declared
        self._fresh = True
        self._median = [0.0, 0.0]
        self._correct()

    def _expect(self, mean_force: FloatArray, rate_moment: FloatArray) -> NoiseMoments:
        bank = self.bank
        return noise_moments(self._robot, self._noise, bank.windowing, mean_force, rate_moment, bank.width)

    def _correct(self) -> None:
        """Expected noise in the weighted sums, for one half-overlapping window."""
        self._weights, dof = self.variances.weights, self.bank.windowing.dof
        w_g, w_a = self._weights
        self.residuals = float(3.0 * (dof.sum() + dof[self.variances.trusted].sum()))
        """Independent numbers of one half-overlapping window in the bins that are used."""
        size = float(self._settings.errors_in_variables)
        # The robot's noise acts on the residual through the lever arm: there cannot be more of it than residual power.
        phi = phi_matrix(self._lever_arm)
        through = np.einsum("ij,kjl,il->k", phi, self.expected.accelerometer[:, :12, :12], phi) / 3.0
        share = np.minimum(1.0, self.variances.accelerometer / np.maximum(through, 1e-300))
        self._noise_g = size * np.tensordot(w_g * dof, self.expected.gyro, 1)
        self._noise_a = size * np.tensordot(w_a * dof * share, self.expected.accelerometer, 1)

    def moment(self) -> Moment:
        """Weighted sums of all windows."""
        bank, weights = self.bank, self._weights
        gyro, accelerometer = bank.weighted(weights)
        squared = bank.weighted(weights, squared=True) if bank.squares else (gyro, accelerometer)
        count = bank.weight
        return Moment(gyro - count * self._noise_g, accelerometer - count * self._noise_a, *squared)

    def segment_moments(self, c_g: FloatArray, c_a: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Weighted sums (N, 10, 10) and (N, m, m) of single windows with coefficients (N, K, 2, c), noise not taken out."""
        out = []
        for c, weight in zip((c_g, c_a), self._weights, strict=True):
            flat = c.reshape(c.shape[0], -1, c.shape[3])
            out.append(np.matmul(flat.transpose(0, 2, 1) * np.repeat(weight, 2), flat))
        return out[0], out[1]

    @property
    def window_noise(self) -> tuple[FloatArray, FloatArray]:
        """Expected noise (10, 10) and (m, m) in the weighted sums of one half-overlapping window."""
        return self._noise_g, self._noise_a

    def relative_power(self, sensor: int, power: FloatArray) -> FloatArray:
        """Whitened residual power (N,) of single windows, from their power per bin (N, K), relative to its running median."""
        total = power @ self._weights[sensor]
        for value in total:
            # Stochastic approximation of the median: a step up or down of a few per cent.
            if self._median[sensor] == 0.0:
                self._median[sensor] = value
            self._median[sensor] *= 1.03 if value > self._median[sensor] else 1.0 / 1.03
        return np.asarray(total / max(self._median[sensor], 1e-300))

    def refresh(self, fit: Fit, mean_force: FloatArray, rate_moment: FloatArray) -> float:
        """Estimate the residual power of every band anew; returns the largest relative change of a variance."""
        self.expected = self._expect(mean_force, rate_moment)
        self._lever_arm = fit.state["translation"]
        if self._fresh:
            self.declared = declared_variances(self.expected, self._guess)
        before = self.variances
        self.variances = estimated_variances(
            fit.model,
            fit.state,
            self.bank.moments(),
            self.declared,
            floored_inverse(fit.information),
            before,
            self._settings.adapt_noise,
        )
        self._correct()
        return self.variances.change_from(before)

    def restart(self) -> None:
        """A new grasp: moments go, noise levels stay as what is known beforehand."""
        self.bank.clear()
        self.declared = BandVariances(
            self.variances.gyro, self.variances.accelerometer, np.ones_like(self.variances.trusted)
        )
        self._fresh = False

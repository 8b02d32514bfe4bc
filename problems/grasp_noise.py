"""Weights per frequency band, and the noise that the robot's own signals add to the moments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp import lie
from factorgrasp.problems.grasp_kinematics import RobotNoise
from factorgrasp.problems.grasp_model import VECH, GraspModel, phi_matrix
from factorgrasp.problems.grasp_settings import GraspNoise
from factorgrasp.problems.grasp_windows import Moments, Windowing
from factorgrasp.typing import BoolArray, FloatArray, State

# Declared densities count as much as this many observed numbers when the residual power of a band is
# estimated: enough to keep a recording of a second sane, too few to be noticed after ten.
PRIOR_DOF = 6.0

# Robot and hand turn as one body. Where their angular rates differ by more than this part of their power, the
# robot's rate is no measurement of the motion, and its derivatives (angular and linear acceleration) even
# less; such a band holds nothing about the lever arm but false excitation.
LARGEST_DISAGREEMENT = 0.05


@dataclass(frozen=True)
class NoiseMoments:
    """Expected noise per degree of freedom in the moments, per frequency bin.

    Attributes
    ----------
    gyro : (K, 10, 10) ndarray
    accelerometer : (K, m, m) ndarray
    gyro_variance, accelerometer_variance : (K,) ndarray
        Of the residuals' own measurement noise (hand and robot), per axis, (rad/s)^2 and (m/s^2)^2 a sample.
    """

    gyro: FloatArray
    accelerometer: FloatArray
    gyro_variance: FloatArray
    accelerometer_variance: FloatArray


def noise_moments(
    robot: RobotNoise,
    hand: GraspNoise,
    windowing: Windowing,
    mean_force: FloatArray,
    rate_moment: FloatArray,
    width: int,
) -> NoiseMoments:
    """Second moments of the noise in those entries of z that multiply unknowns (errors in variables, mathematics 2.3).

    Parameters
    ----------
    robot : RobotNoise
        At the bins' frequencies.
    mean_force : (3,) ndarray
        Mean of f_r, m/s^2.
    rate_moment : (3, 3) ndarray
        Mean of ``w_r w_r'``, (rad/s)^2.
    width : int
        Entries of z_a.
    """
    f, step = windowing.frequencies, windowing.step
    slope_gain = (np.sin(2.0 * np.pi * f * step) / step) ** 2
    eye = np.eye(3)
    gyro = np.zeros((f.size, 10, 10))
    gyro[:, 6:9, 6:9] = (hand.gyro_density**2 / step * slope_gain)[:, None, None] * eye
    out = np.zeros((f.size, width, width))
    out[:, 3:6, 3:6] = (robot.angular_acceleration / step)[:, None, None] * eye
    cross = (robot.force_by_acceleration / step)[:, None, None] * lie.skew(mean_force)
    out[:, 0:3, 3:6] = cross
    out[:, 3:6, 0:3] = cross.transpose(0, 2, 1)
    out[:, 6:12, 6:12] = (robot.angular_velocity / step)[:, None, None] * product_noise(rate_moment)
    out[:, 15:18, 15:18] = (hand.accelerometer_density**2 / step * slope_gain)[:, None, None] * eye
    return NoiseMoments(
        gyro=gyro,
        accelerometer=out,
        gyro_variance=(hand.gyro_density**2 + robot.angular_velocity) / step,
        accelerometer_variance=(hand.accelerometer_density**2 + robot.specific_force) / step,
    )


def product_noise(W: FloatArray) -> FloatArray:
    """Covariance (6, 6) of ``vech(w n' + n w')`` for white unit noise n (3,) and ``E[w w'] = W`` (3, 3)."""
    out = np.zeros((6, 6))
    eye = np.eye(3)
    for a, (i, j) in enumerate(VECH):
        for b, (k, m) in enumerate(VECH):
            out[a, b] = W[i, k] * eye[j, m] + W[i, m] * eye[j, k] + W[j, k] * eye[i, m] + W[j, m] * eye[i, k]
    return out


@dataclass(frozen=True)
class BandVariances:
    """Residual variance per axis, sample and bin of both sensors, (K,) each; their inverses are the weights.

    `trusted` (K,) tells in which bins the accelerations are used at all; see `LARGEST_DISAGREEMENT`.
    """

    gyro: FloatArray
    accelerometer: FloatArray
    trusted: BoolArray

    @property
    def weights(self) -> tuple[FloatArray, FloatArray]:
        """Weights of the gyroscope's and the accelerometer's bins."""
        return 1.0 / self.gyro, np.where(self.trusted, 1.0 / self.accelerometer, 0.0)

    def change_from(self, other: BandVariances) -> float:
        """Largest relative change of a variance; infinite when another set of bins is used."""
        if np.any(self.trusted != other.trusted):
            return float("inf")
        gyro = np.max(np.abs(self.gyro / other.gyro - 1.0))
        accelerometer = np.max(
            np.abs(self.accelerometer / other.accelerometer - 1.0), where=self.trusted, initial=0.0
        )
        return float(max(gyro, accelerometer))


def declared_variances(noise: NoiseMoments, lever_arm: FloatArray) -> BandVariances:
    """What the declared densities predict; the robot's noise in phi acts through a lever arm of this size (3,), m."""
    phi = phi_matrix(lever_arm)
    through = np.einsum("ij,kjl,il->k", phi, noise.accelerometer[:, :12, :12], phi) / 3.0
    accelerometer = noise.accelerometer_variance + np.maximum(through, 0.0)
    return BandVariances(noise.gyro_variance, accelerometer, np.ones(accelerometer.size, dtype=bool))


def estimated_variances(
    model: GraspModel,
    state: State,
    moments: Moments,
    declared: BandVariances,
    covariance: FloatArray,
    current: BandVariances,
    adapt: bool,
) -> BandVariances:
    """Residual power of every band at `state`, and the bands in which both sides agree on the motion.

    Restricted maximum likelihood with an inverse-gamma prior at the declared power; the numbers that the fit
    itself took from a band are counted by its leverage ``tr(C J Z J') / variance``. Without `adapt` the
    declared powers stay.
    """
    L_g, L_a = model.matrices(state)
    J_g, J_a = model.jacobians(state)
    dof = moments.dof.sum(axis=0)
    Z_g, Z_a = moments.gyro.sum(axis=0), moments.accelerometer.sum(axis=0)
    values, vectors = np.linalg.eigh(covariance)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    out, powers = [], []
    w_g, w_a = current.weights
    for L, J, Z, prior, weight in (
        (L_g, J_g, Z_g, declared.gyro, w_g),
        (L_a, J_a, Z_a, declared.accelerometer, w_a),
    ):
        power = np.sum((L @ Z) * L, axis=(1, 2))
        spread = np.tensordot(half, J, axes=(0, 0)).reshape(-1, J.shape[2])
        leverage = np.sum((spread @ Z) * spread, axis=(1, 2)) * weight
        free = np.maximum(3.0 * dof - leverage, 0.25 * 3.0 * dof)
        out.append((power + PRIOR_DOF * prior) / (free + PRIOR_DOF))
        powers.append(power)
    moving = np.einsum("kii->k", Z_g[:, 0:3, 0:3])
    trusted = powers[0] <= LARGEST_DISAGREEMENT * moving
    if not adapt:
        return BandVariances(declared.gyro, declared.accelerometer, trusted)
    return BandVariances(out[0], out[1], trusted)

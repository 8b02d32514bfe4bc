"""Whether the rigid-coupling model holds on a recording, and how much wider the truth is where it does not.

Real grasps give way a little, clocks drift, and poses that were interpolated from few samples carry no
acceleration. Such errors do not average out like noise, so a covariance from noise alone would be too small.
Three tests look for them; the first two do nothing to a sound recording 99 times out of 100:

- *stretches*: the scores of separate stretches of time scatter more than their covariance (a slow drift of
  the grasp);
- *bands*: the lever arms that separate frequency bands ask for differ more than their covariances (wrong
  accelerations);
- *phantom motion*: at frequencies without hand motion the robot's stream shows rates far above its declared
  noise (poses interpolated from few
  samples, or with jittered stamps). Its error is then no noise at all frequencies, and what it may do to the
  lever arm is bounded, not averaged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.problems.grasp_model import GraspModel, quadratic_forms
from factorgrasp.problems.grasp_noise import BandVariances, NoiseMoments
from factorgrasp.problems.grasp_system import floored_inverse
from factorgrasp.problems.grasp_windows import Moments
from factorgrasp.typing import FloatArray, IntArray, State

_PROBABILITY = 0.99
_FEWEST_STRETCHES = 6
# Phantom motion: residual rate this many times the hand's own power and the declared noise, in at least half
# of the bins that are not trusted.
_PHANTOM_OVER_HAND = 5.0
_PHANTOM_OVER_NOISE = 3.0


@dataclass(frozen=True)
class ModelCheck:
    """Outcome of the tests.

    Attributes
    ----------
    scale : (n,) ndarray
        Factor on the variance of every unknown from the stretches' scatter; 1 where nothing was found.
    lever_arm_excess : (3, 3) ndarray
        Covariance (m^2) to add to the lever arm for the disagreement of frequency bands; zero where nothing
        was found.
    band_spread : float
        m; scatter of the lever arm between bands beyond noise.
    phantom : float
        m; bound on the lever arm's error where the robot's stream shows phantom motion, else 0.
    confirmed : float
        Hz; highest frequency at which both sides agree on the motion.
    translation : slice
        Columns of the lever arm.
    """

    scale: FloatArray
    lever_arm_excess: FloatArray
    band_spread: float
    phantom: float
    confirmed: float
    translation: slice

    @property
    def passed(self) -> bool:
        """Whether no test found anything."""
        return bool(np.all(self.scale == 1.0) and self.band_spread == 0.0 and self.phantom == 0.0)

    def widened(self, information: FloatArray, meat: FloatArray) -> FloatArray:
        """Meat of the sandwich that gives the widened covariance with this information matrix."""
        if self.passed:
            return meat
        bread = floored_inverse(information)
        root = np.sqrt(self.scale)
        covariance = root[:, None] * (bread @ meat @ bread) * root
        where = self.translation
        covariance[where, where] += self.lever_arm_excess + self.phantom**2 * np.eye(3)
        return np.asarray(information @ covariance @ information)


def octaves(bins: int) -> IntArray:
    """Octave of every frequency bin, (bins,): 0-1, 2, 3-4, 5-8, 9-16, ..."""
    k = np.maximum(np.arange(bins), 1)
    return np.asarray(np.ceil(np.log2(k) - 1e-9), dtype=np.intp)


def check_model(
    model: GraspModel,
    state: State,
    moments: Moments,
    expected: NoiseMoments,
    variances: BandVariances,
    precision: FloatArray,
    information: FloatArray,
    meat: FloatArray,
    frequencies: FloatArray,
    corrected: bool,
) -> ModelCheck:
    """Run the tests at a converged state.

    Parameters
    ----------
    expected : NoiseMoments
        Expected noise.
    frequencies : (K,) ndarray
        Hz, of the bins.
    corrected : bool
        Whether the fit takes the expected noise out of the moments.
    precision : (n,) ndarray
        Of the priors.
    information, meat : (n, n) ndarray
        Of the whole problem.
    """
    scale = _stretch_scale(model, state, moments, variances, information, meat)
    excess, spread = _band_excess(
        model, state, moments, expected if corrected else None, variances, precision, information
    )
    trusted = np.flatnonzero(variances.trusted)
    return ModelCheck(
        scale=scale,
        lever_arm_excess=excess,
        band_spread=spread,
        phantom=_phantom_bound(model, state, moments, expected, variances),
        confirmed=float(frequencies[trusted[-1]]) if trusted.size else 0.0,
        translation=model.columns["translation"],
    )


def _phantom_bound(
    model: GraspModel, state: State, moments: Moments, expected: NoiseMoments, variances: BandVariances
) -> float:
    """Bound (m) on the lever arm's error: a relative error of the rates, taken for that of the accelerations and as coherent."""
    untrusted = ~variances.trusted
    if not untrusted.any():
        return 0.0
    L_g, _ = model.matrices(state)
    Z_g, Z_a = moments.gyro.sum(axis=0), moments.accelerometer.sum(axis=0)
    dof = 3.0 * moments.dof.sum(axis=0)
    residual = np.einsum("ij,kjl,il->k", L_g, Z_g, L_g)
    hand = np.einsum("kii->k", Z_g[:, 3:6, 3:6])
    phantom = (residual > _PHANTOM_OVER_HAND * hand) & (
        residual > _PHANTOM_OVER_NOISE * dof * expected.gyro_variance
    )
    if np.mean(phantom[untrusted]) < 0.5:
        return 0.0
    moving = variances.trusted.copy()
    moving[0] = False
    if not moving.any():
        moving = np.arange(moving.size) == 1
    error = float(residual[moving].sum() / np.einsum("kii->", Z_g[moving][:, 0:3, 0:3]))
    force = float(np.einsum("kii->", Z_a[moving][:, 0:3, 0:3]))
    turning = float(np.einsum("kii->", Z_a[moving][:, 3:6, 3:6]))
    return float(np.sqrt(error * force / turning))


def _stretch_scale(
    model: GraspModel,
    state: State,
    moments: Moments,
    variances: BandVariances,
    information: FloatArray,
    meat: FloatArray,
) -> FloatArray:
    """Ratio of the variance from scattering scores ``[H^-1 S H^-1]_ii`` to the modelled one where it is significant, else 1.

    Stretches are also merged by two and three, since slow drifts show only over long stretches. Axes of a
    rotation or a lever arm are a matter of convention, so the worst of the three counts for all.
    """
    from scipy.special import chdtri

    scale = np.ones(model.size)
    count = moments.dof.shape[0]
    if count < _FEWEST_STRETCHES:
        return scale
    w_g, w_a = variances.weights
    (L_g, L_a), (J_g, J_a) = model.matrices(state), model.jacobians(state)
    Z_g = np.tensordot(moments.gyro, w_g, axes=(1, 0))
    Z_a = np.tensordot(moments.accelerometer, w_a, axes=(1, 0))
    scores = np.array(
        [
            quadratic_forms(L_g, J_g, g)[1] + quadratic_forms(L_a, J_a, a)[1]
            for g, a in zip(Z_g, Z_a, strict=True)
        ]
    )
    bread = floored_inverse(information)
    modelled = np.diag(bread @ meat @ bread)
    for group in (1, 2, 3):
        merged = np.add.reduceat(scores, np.arange(0, count, group), axis=0)
        if merged.shape[0] < 4:
            break
        merged = merged - merged.mean(axis=0)
        dof = merged.shape[0] - 1
        ratio = np.sum((merged @ bread) ** 2, axis=0) * (dof + 1) / dof / modelled
        scale = np.maximum(scale, np.where(ratio > chdtri(dof, 1.0 - _PROBABILITY) / dof, ratio, 1.0))
    for name in ("rotation", "translation"):
        scale[model.columns[name]] = scale[model.columns[name]].max()
    return scale


def _band_excess(
    model: GraspModel,
    state: State,
    moments: Moments,
    expected: NoiseMoments | None,
    variances: BandVariances,
    precision: FloatArray,
    information: FloatArray,
) -> tuple[FloatArray, float]:
    """Excess covariance of the lever arm and its spread between bands.

    Every band is solved with the gyroscope and the priors, but without the other bands.
    """
    where = model.columns["translation"]
    L_a, J_a = model.matrices(state)[1], model.jacobians(state)[1]
    w_a = variances.weights[1]
    Z = moments.accelerometer.sum(axis=0)
    if expected is not None:
        Z = Z - moments.dof.sum(axis=0)[:, None, None] * expected.accelerometer
    octave = octaves(Z.shape[0])
    forms = []
    for band in range(int(octave[-1]) + 1):
        chosen = octave == band
        forms.append(quadratic_forms(L_a, J_a, np.tensordot(w_a[chosen], Z[chosen], 1))[1:])
    # What every band shares: gyroscope and priors. At the optimum all gradients sum to zero.
    shared_gradient = -np.sum([gradient for gradient, _ in forms], axis=0)
    shared = information - np.sum([matrix for _, matrix in forms], axis=0)
    shared = shared + np.diag(precision) * 1e-9
    arms, covariances = [], []
    for gradient, matrix in forms:
        full = shared + matrix
        values = np.linalg.eigvalsh(matrix[where, where])
        if values[0] <= 0.0:
            continue
        inverse = floored_inverse(full)
        arms.append(-(inverse @ (shared_gradient + gradient))[where])
        covariances.append(inverse[where, where])
    if len(arms) < 2:
        return np.zeros((3, 3)), 0.0
    return _disagreement(np.array(arms), np.array(covariances))


def _disagreement(arms: FloatArray, covariances: FloatArray) -> tuple[FloatArray, float]:
    """Excess covariance (3, 3) and largest spread (m) of lever arms (k, 3) that scatter more than they should.

    Along each principal axis of the scatter where it is significant, every band moves the estimate by its own
    error times its share of the information; the squares of these moves add up (the cluster-robust variance
    with bands for clusters).
    """
    from scipy.special import chdtri

    axes = np.linalg.eigh(arms.T @ arms)[1]
    count = arms.shape[0]
    limit = float(chdtri(count - 1, (1.0 - _PROBABILITY) / 3.0))
    excess, largest = np.zeros((3, 3)), 0.0
    for axis in axes.T:
        x = arms @ axis
        variances = np.einsum("i,kij,j->k", axis, covariances, axis)
        scatter, mean = _weighted_scatter(x, variances)
        if scatter <= limit:
            continue
        shares = 1.0 / variances / np.sum(1.0 / variances)
        moves = shares * (x - mean)
        excess += float(np.sum(moves**2)) * count / (count - 1) * np.outer(axis, axis)
        largest = max(largest, float(np.sqrt(np.sum(shares * (x - mean) ** 2))))
    return excess, largest


def _weighted_scatter(x: FloatArray, variances: FloatArray) -> tuple[float, float]:
    """``sum (x - mean)^2 / variance`` and the weighted mean."""
    weights = 1.0 / variances
    mean = float(np.sum(weights * x) / np.sum(weights))
    return float(np.sum(weights * (x - mean) ** 2)), mean

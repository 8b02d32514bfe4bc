"""How well a motion will show the grasp: the grasp estimator's own covariance, before there is any measurement of a hand.

:class:`factorgrasp.problems.GraspPose` compresses a recording into noise-corrected moments Z of robot and hand signals and states the
sandwich covariance ``H^-1 M H^-1`` with ``H = J W Z J'`` and ``M = J W (Z + N) J'`` (N the expected noise of the robot's own signals in the
regressor). On a rigid grasp the hand's entries of Z follow from the robot's: ``w_h = R' w_r``, ``f_h = R' (f_r + phi r)``. So the robot's
motion, a guess of the grasp and the sensors' noise say what the covariance is going to be: same windows, same bands, same unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.observability import Observability, default_words, observe
from factorgrasp.problems import grasp_words
from factorgrasp.problems.grasp_averaging import average, averaged_samples
from factorgrasp.problems.grasp_kinematics import RobotKinematics, RobotNoise
from factorgrasp.problems.grasp_model import GYRO_WIDTH, GraspModel, phi_matrix
from factorgrasp.problems.grasp_noise import declared_variances, noise_moments
from factorgrasp.problems.grasp_recording import tilt_axes, vech_products
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.problems.grasp_system import SENSOR_ERRORS, floored_inverse, grasp_variables, prior_precision
from factorgrasp.problems.grasp_windows import Windowing, finite_windows
from factorgrasp.typing import FloatArray
from factorgrasp.variables import Variable, slices

# Entries of the robot's own z: [w_r, f_r, al_r, vech(w w')], then their slopes; the tilt's columns last.
_RATE, _FORCE = slice(0, 3), slice(3, 15)
_ROBOT = 15


@dataclass(frozen=True, eq=False)
class GraspPrediction:
    """What the estimator will know of the grasp after a motion.

    Attributes
    ----------
    variables : tuple of Variable
        Unknowns of the estimator, ``rotation`` and ``translation`` first.
    covariance : (n, n) ndarray
        Of all of them after the whole motion.
    t : (k,) ndarray
        Ends of the analysis windows, s.
    covariance_over_time : (k, 6, 6) ndarray
        Of [rotation; translation] with the data up to `t`; rotation as right perturbation of ``R_r_h``, rad and m.
    rate_moment : (3, 3) ndarray
        Mean of ``w_r w_r'``, (rad/s)^2.
    settings : GraspSettings
        With the resolutions that directions are judged by.
    """

    variables: tuple[Variable, ...]
    covariance: FloatArray
    t: FloatArray
    covariance_over_time: FloatArray
    rate_moment: FloatArray
    settings: GraspSettings

    @property
    def grasp_covariance(self) -> FloatArray:
        """Covariance (6, 6) of [rotation; translation], rad and m."""
        return np.asarray(self.covariance[:6, :6])

    @property
    def sd(self) -> FloatArray:
        """Standard deviations (6,) of the components of [rotation; translation], rad and m."""
        return np.asarray(np.sqrt(np.diag(self.grasp_covariance)))

    @property
    def worst_sd(self) -> tuple[float, float]:
        """Standard deviation of the worst direction of rotation (rad) and of lever arm (m)."""
        P = self.grasp_covariance
        return _largest_sd(P[:3, :3]), _largest_sd(P[3:, 3:])

    @cached_property
    def worst_sd_over_time(self) -> FloatArray:
        """The same after every window, (k, 2), rad and m."""
        P = self.covariance_over_time
        turn, way = np.linalg.eigvalsh(P[:, :3, :3]), np.linalg.eigvalsh(P[:, 3:, 3:])
        return np.asarray(np.sqrt(np.maximum(np.stack([turn[:, -1], way[:, -1]], axis=1), 0.0)))

    def seconds_to(self, rotation_sd: float, translation_sd: float) -> float:
        """When (s, on the clock of the motion) both worst directions are below these sd (rad, m) for good; NaN when never."""
        below = np.all(self.worst_sd_over_time <= (rotation_sd, translation_sd), axis=1)
        if not below.size or not below[-1]:
            return float("nan")
        above = np.flatnonzero(~below)
        return float(self.t[above[-1] + 1 if above.size else 0])

    @cached_property
    def observability(self) -> Observability:
        """Directions of the grasp that the motion shows or does not show, worst first, in physical words."""
        where = slices(self.variables)

        def words(variable: Variable, vector: FloatArray) -> str:
            if variable.name in ("rotation", "translation"):
                return grasp_words.direction(variable.name, vector, self.rate_moment)
            return default_words(variable, vector)

        return observe(
            self.variables,
            lambda name: self.covariance[where[name], where[name]],
            words,
            grasp_words.advice(self.rate_moment, None),
        )


def predict_grasp(
    motion: RobotKinematics,
    rotation: FloatArray,
    translation: FloatArray,
    noise: GraspNoise | None = None,
    settings: GraspSettings | None = None,
    prior: GraspPrior | None = None,
    gravity: FloatArray | tuple[float, float, float] = (0.0, 0.0, -9.80665),
    contained: Callable[[FloatArray], RobotNoise] | None = None,
    known: FloatArray | None = None,
) -> GraspPrediction:
    """Covariance that :class:`~factorgrasp.problems.GraspPose` is going to state after a motion.

    Parameters
    ----------
    motion : RobotKinematics
        The end-effector's motion, from :func:`factorgrasp.problems.grasp_kinematics.robot_kinematics`; its `noise` is that with which the
        robot will report the motion.
    rotation : (3, 3) ndarray
        ``R_r_h``, the grasp at which to predict.
    translation : (3,) ndarray
        ``p_r_h``, m.
    noise : GraspNoise
    settings : GraspSettings
        With ``sensor_errors="auto"`` the hand's sensor counts as calibrated, as it is for the estimator once it has dropped what does not
        show; ``"always"`` keeps its scale errors unknown.
    prior : GraspPrior
    gravity : (3,) array_like
        World frame, m/s^2; for the base tilt.
    contained : callable, optional
        Spectral densities of the noise that the signals of `motion` themselves contain (a recorded motion), frequency (K,) in Hz to
        :class:`RobotNoise`; taken out of the moments. None: the motion is exact (a planned one).
    known : (6, 6) ndarray, optional
        Covariance of [rotation; translation] that is known before the motion, besides the prior, rad and m.

    Raises
    ------
    InputError
        When the motion is shorter than two analysis windows.
    """
    noise, settings, prior = noise or GraspNoise(), settings or GraspSettings(), prior or GraspPrior()
    dropped = frozenset(SENSOR_ERRORS) if settings.sensor_errors == "auto" else frozenset()
    model = GraspModel(*grasp_variables(noise, settings, dropped))
    bandwidth = settings.bandwidth or min(20.0, 0.2 / motion.step)
    tilt = tilt_axes(np.asarray(gravity, dtype=float)) if settings.base_tilt else None
    windowing, coefficients = _coefficients(motion, bandwidth, settings.window, tilt)
    good = finite_windows(coefficients)
    if np.count_nonzero(good) < 2:
        raise InputError(
            "motion",
            f"at least two windows of {windowing.length * windowing.step:.3g} s without gaps",
            f"{np.count_nonzero(good)}",
            "Take a longer motion",
        )
    rates = motion.angular_velocity[np.isfinite(motion.angular_velocity).all(axis=1)]
    forces = motion.specific_force[np.isfinite(motion.specific_force).all(axis=1)]
    moment = rates.T @ rates / rates.shape[0]
    expected = noise_moments(
        motion.noise(windowing.frequencies),
        noise,
        windowing,
        forces.mean(axis=0),
        moment,
        model.accelerometer_width,
    )
    variances = declared_variances(expected, np.asarray(translation))
    w_g, w_a = variances.weights

    T_g, T_a = _hand_from_robot(rotation, translation, tilt is not None)
    c = coefficients[good]
    moments_g = np.einsum("k,nkja,nkjb->nab", w_g, c, c, optimize=True)
    moments_a = np.einsum("k,nkja,nkjb->nab", w_a, c, c, optimize=True)
    if contained is not None:
        robot = _robot_noise(contained(windowing.frequencies), windowing, forces.mean(axis=0), moment, c)
        moments_g -= np.tensordot(w_g * windowing.dof, robot, 1)
        moments_a -= np.tensordot(w_a * windowing.dof, robot, 1)
    Z_g, Z_a = T_g @ np.cumsum(moments_g, axis=0) @ T_g.T, T_a @ np.cumsum(moments_a, axis=0) @ T_a.T

    state = {v.name: np.zeros(v.size) for v in model.variables}
    state |= {"rotation": np.asarray(rotation), "translation": np.asarray(translation)}
    J_g, J_a = model.jacobians(state)
    own = np.diag(prior_precision(model, noise, prior))
    if known is not None:
        own[:6, :6] += np.linalg.inv(known)
    noise_g = _form(J_g, np.tensordot(w_g * windowing.dof, expected.gyro, 1)[None])[0]
    noise_a = _form(J_a, np.tensordot(w_a * windowing.dof, expected.accelerometer, 1)[None])[0]
    H = _form(J_g, Z_g) + _form(J_a, Z_a) + own
    count = np.arange(1, H.shape[0] + 1)[:, None, None]
    M = H + count * (noise_g + noise_a)
    covariances = np.stack([_sandwich(h, m, own) for h, m in zip(H, M, strict=True)])
    ends = motion.t[0] + windowing.centres(coefficients.shape[0])[good]
    return GraspPrediction(
        variables=model.variables,
        covariance=covariances[-1],
        t=ends + 0.5 * windowing.length * windowing.step,
        covariance_over_time=covariances[:, :6, :6],
        rate_moment=moment,
        settings=settings,
    )


def _coefficients(
    motion: RobotKinematics, bandwidth: float, window: float, tilt: FloatArray | None
) -> tuple[Windowing, FloatArray]:
    """Windowed spectra (windows, bins, 2, 31 or 37) of [z, slope of z, 1, tilt] with the robot's z."""
    z = np.hstack(
        [
            motion.angular_velocity,
            motion.specific_force,
            motion.angular_acceleration,
            vech_products(motion.angular_velocity),
        ]
    )
    extra = np.empty((z.shape[0], 0))
    if tilt is not None:
        if motion.rotation is None:
            raise InputError("settings.base_tilt", "a motion with orientations", "one without")
        extra = np.hstack([np.matmul(motion.rotation.transpose(0, 2, 1), tilt[:, i]) for i in (0, 1)])
    averaged = 1 if motion.averaged > 1 else averaged_samples(motion.step, bandwidth)
    z, extra, step = average(z, averaged), average(extra, averaged), motion.step * averaged
    slope = np.full_like(z, np.nan)
    slope[1:-1] = (z[2:] - z[:-2]) / (2.0 * step)
    windowing = Windowing.for_grid(step, window, bandwidth, z.shape[0])
    both = windowing.transform(np.hstack([z, slope, extra]))
    one = np.broadcast_to(windowing.constant()[None, :, :, None], (*both.shape[:3], 1))
    out = np.concatenate([both[..., : 2 * _ROBOT], one, both[..., 2 * _ROBOT :]], axis=3)
    return windowing, out


def _hand_from_robot(
    rotation: FloatArray, translation: FloatArray, tilted: bool
) -> tuple[FloatArray, FloatArray]:
    """Matrices (10, c) and (19 or 25, c) that give z_g and z_a of the grasp model from the robot's own coefficients."""
    width = 2 * _ROBOT + 1 + (6 if tilted else 0)
    back = np.asarray(rotation).T
    force = back @ (np.hstack([np.eye(3), np.zeros((3, 9))]) + phi_matrix(np.asarray(translation)))
    T_g = np.zeros((GYRO_WIDTH, width))
    T_g[0:3, _RATE] = np.eye(3)
    T_g[3:6, _RATE] = back
    T_g[6:9, _ROBOT : _ROBOT + 3] = back
    T_g[9, 2 * _ROBOT] = 1.0
    T_a = np.zeros((25 if tilted else 19, width))
    T_a[0:12, _FORCE] = np.eye(12)
    T_a[12:15, _FORCE] = force
    T_a[15:18, _ROBOT + 3 : 2 * _ROBOT] = force
    T_a[18, 2 * _ROBOT] = 1.0
    if tilted:
        T_a[19:25, 2 * _ROBOT + 1 :] = np.eye(6)
    return T_g, T_a


def _robot_noise(
    noise: RobotNoise, windowing: Windowing, mean_force: FloatArray, rate_moment: FloatArray, c: FloatArray
) -> FloatArray:
    """Moments (K, c, c), per degree of freedom, of the noise within the robot's own coefficients."""
    quiet = GraspNoise(gyro_density=1e-30, accelerometer_density=1e-30)
    part = noise_moments(noise, quiet, windowing, mean_force, rate_moment, 19).accelerometer[:, :12, :12]
    N = np.zeros((windowing.bins, _ROBOT, _ROBOT))
    N[:, _RATE, _RATE] = (noise.angular_velocity / windowing.step)[:, None, None] * np.eye(3)
    N[:, _FORCE, _FORCE] = part
    N[:, 3:6, 3:6] += (noise.specific_force / windowing.step)[:, None, None] * np.eye(3)
    slope = (np.sin(2.0 * np.pi * windowing.frequencies * windowing.step) / windowing.step) ** 2
    out = np.zeros((windowing.bins, c.shape[3], c.shape[3]))
    out[:, :_ROBOT, :_ROBOT] = N
    out[:, _ROBOT : 2 * _ROBOT, _ROBOT : 2 * _ROBOT] = slope[:, None, None] * N
    return out


def _form(J: FloatArray, Z: FloatArray) -> FloatArray:
    """``tr(J_i Z J_j')`` (k, n, n) for derivatives J (n, 3, m) of the residual's matrix and moments Z (k, m, m)."""
    return np.asarray(np.einsum("iam,kml,jal->kij", J, Z, J, optimize=True))


def _sandwich(H: FloatArray, M: FloatArray, own: FloatArray) -> FloatArray:
    """``H^-1 M H^-1``, but nowhere wider than what is known beforehand, the information `own`.

    Where nothing excites, H is the prior's and noise in the regressor would make the sandwich wider than that.
    """
    bread = floored_inverse(H)
    root = np.linalg.cholesky(own)
    values, vectors = np.linalg.eigh(root.T @ (bread @ M @ bread) @ root)
    half = np.linalg.solve(root.T, vectors * np.sqrt(np.clip(values, 0.0, 1.0)))
    return np.asarray(half @ half.T)


def _largest_sd(P: FloatArray) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(P)[-1], 0.0)))


__all__ = ["GraspPrediction", "predict_grasp"]

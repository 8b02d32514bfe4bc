"""Unknowns, priors and the compressed linear system of the grasp problem."""

from __future__ import annotations

import numpy as np

from factorgrasp import lie
from factorgrasp.least_squares import LeastSquares, Term
from factorgrasp.problems.grasp_model import GraspModel
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.typing import FloatArray, State
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable, slices

# rad; a prior this wide says nothing of a rotation, but keeps the system regular where no motion does either.
_NO_KNOWLEDGE = np.pi
SENSOR_ERRORS = ("accelerometer_delay", "gyro_calibration", "accelerometer_calibration")


def grasp_variables(
    noise: GraspNoise, settings: GraspSettings, without: frozenset[str] = frozenset()
) -> tuple[tuple[Variable, ...], dict[str, FloatArray]]:
    """Unknowns in tangent order, less those named in `without`, and zeros for everything that is not estimated."""
    axes = ("x", "y", "z")
    every = {
        "rotation": Variable(
            "rotation",
            3,
            "rotation",
            "rad",
            tuple(f"rotation about hand {a}" for a in axes),
            settings.rotation_resolution,
        ),
        "translation": Variable(
            "translation",
            3,
            "vector",
            "m",
            tuple(f"lever arm {a}" for a in axes),
            settings.translation_resolution,
        ),
        "gyro_bias": Variable(
            "gyro_bias", 3, unit="rad/s", components=tuple(f"gyroscope bias {a}" for a in axes)
        ),
        "accelerometer_bias": Variable(
            "accelerometer_bias", 3, unit="m/s^2", components=tuple(f"accelerometer bias {a}" for a in axes)
        ),
        "time_offset": Variable("time_offset", 1, unit="s", components=("time offset",)),
        "accelerometer_delay": Variable(
            "accelerometer_delay", 1, unit="s", components=("accelerometer delay",)
        ),
        "base_tilt": Variable("base_tilt", 2, unit="rad", components=("base tilt 1", "base tilt 2")),
        "gyro_calibration": Variable("gyro_calibration", 6, unit=""),
        "accelerometer_calibration": Variable("accelerometer_calibration", 9, unit=""),
    }
    sensors = settings.sensor_errors != "never"
    wanted = {
        "rotation": True,
        "translation": True,
        "gyro_bias": settings.gyro_bias,
        "accelerometer_bias": settings.accelerometer_bias,
        "time_offset": settings.time_offset,
        "accelerometer_delay": sensors and noise.accelerometer_delay_sd > 0.0,
        "base_tilt": settings.base_tilt,
        "gyro_calibration": sensors and noise.gyro_scale_sd > 0.0,
        "accelerometer_calibration": sensors and noise.accelerometer_scale_sd > 0.0,
    }
    wanted = {name: want and name not in without for name, want in wanted.items()}
    chosen = tuple(variable for name, variable in every.items() if wanted[name])
    fixed = {name: np.zeros(variable.size) for name, variable in every.items() if not wanted[name]}
    return chosen, fixed


def prior_sd(noise: GraspNoise, prior: GraspPrior, name: str) -> float:
    """Prior standard deviation of every component of an unknown."""
    return {
        "rotation": _NO_KNOWLEDGE if prior.rotation_sd is None else prior.rotation_sd,
        "translation": prior.translation_sd,
        "gyro_bias": noise.gyro_bias_sd,
        "accelerometer_bias": noise.accelerometer_bias_sd,
        "time_offset": noise.time_offset_sd,
        "accelerometer_delay": noise.accelerometer_delay_sd,
        "base_tilt": noise.base_tilt_sd,
        "gyro_calibration": noise.gyro_scale_sd,
        "accelerometer_calibration": noise.accelerometer_scale_sd,
    }[name]


def prior_precision(model: GraspModel, noise: GraspNoise, prior: GraspPrior) -> FloatArray:
    """Diagonal of the prior information (n,)."""
    out = np.zeros(model.size)
    for variable in model.variables:
        out[model.columns[variable.name]] = 1.0 / prior_sd(noise, prior, variable.name) ** 2
    return out


def prior_residual(variable: Variable, state: State, prior: GraspPrior) -> tuple[FloatArray, FloatArray]:
    """Jacobian (size, size) and residual (size,) of a variable against its prior mean (zero but for the grasp itself)."""
    if variable.name == "rotation":
        error = lie.so3_log(
            state["rotation"] if prior.rotation is None else prior.rotation.T @ state["rotation"]
        )
        return lie.so3_right_jacobian_inverse(error), error
    mean = prior.translation if variable.name == "translation" else 0.0
    return np.eye(variable.size), state[variable.name] - mean


def least_squares_pattern(model: GraspModel, precision: FloatArray) -> LeastSquares:
    """Terms of the problem with empty values: one a sensor, one a prior."""
    gyro = ("rotation", "gyro_bias", "time_offset", "gyro_calibration")
    accelerometer = (
        "rotation",
        "translation",
        "accelerometer_bias",
        "time_offset",
        "accelerometer_delay",
        "base_tilt",
        "accelerometer_calibration",
    )
    names = [variable.name for variable in model.variables]
    terms = [
        Term("gyroscope", 30, tuple(n for n in gyro if n in names), unit="rad/s"),
        Term(
            "accelerometer",
            3 * model.accelerometer_width,
            tuple(n for n in accelerometer if n in names),
            unit="m/s^2",
        ),
    ]
    for variable in model.variables:
        covariance = Covariance.diagonal(1.0 / precision[model.columns[variable.name]])
        terms.append(
            Term(f"prior of {variable.name}", variable.size, (variable.name,), covariance, unit=variable.unit)
        )
    return LeastSquares(model.variables, terms)


def positive_part(Z: FloatArray) -> FloatArray:
    """Root S (m, m) with ``S S'`` the nearest positive semidefinite matrix to Z.

    Taking the expected noise out can leave small negative eigenvalues where nothing excites; they carry no
    information.
    """
    diagonal = np.diag(Z)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(Z / np.outer(scale, scale))
    return np.asarray((scale[:, None] * vectors) * np.sqrt(np.maximum(values, 0.0)))


def wahba_start(cross: FloatArray, prior: GraspPrior) -> FloatArray:
    """Rotation (3, 3) that best maps the hand's rates to the robot's: ``cross = sum w_r w_h'`` (Wahba's problem by SVD)."""
    if prior.rotation is not None and prior.rotation_sd is not None:
        cross = cross + prior.rotation * (1e-6 * np.trace(np.abs(cross)) + 1e-12)
    U, _, Vt = np.linalg.svd(cross)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def insignificant(
    variables: tuple[Variable, ...], state: State, covariance: FloatArray, false_alarm: float = 1e-3
) -> frozenset[str]:
    """Groups of sensor errors that the data do not show to differ from zero (chi-square of the whole group)."""
    # scipy.stats would take a second to import, in the middle of a live stream.
    from scipy.special import chdtri

    where = slices(variables)
    out = set()
    for variable in variables:
        if variable.name in SENSOR_ERRORS:
            part = covariance[where[variable.name], where[variable.name]]
            value = state[variable.name]
            if value @ np.linalg.solve(part, value) < chdtri(variable.size, false_alarm):
                out.add(variable.name)
    return frozenset(out)


def floored_inverse(H: FloatArray) -> FloatArray:
    """Inverse (n, n) of an information matrix; what holds no information gets a huge variance instead of an error."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-12))
    values, vectors = np.linalg.eigh(scale[:, None] * H * scale)
    root = (scale[:, None] * vectors) / np.sqrt(np.maximum(values, 1e-13 * values[-1]))
    return np.asarray(root @ root.T)

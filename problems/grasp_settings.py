"""What a user may say about a grasp recording: noise, switches and prior knowledge. Every entry has a default."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.losses import make_loss
from factorgrasp.typing import FloatArray


@dataclass(frozen=True)
class GraspNoise:
    """Noise of both sides; the defaults fit a consumer IMU on the hand and an industrial robot or a motion-capture system.

    A *density* ``d`` stands for white noise whose variance a sample is ``d^2 * rate``. An *sd* of a pose is
    that of one sample. The densities are starting values: with ``GraspSettings.adapt_noise`` the residual
    power of every frequency band is estimated from the data.

    Attributes
    ----------
    gyro_density : float
        rad/s/sqrt(Hz), hand gyroscope.
    accelerometer_density : float
        m/s^2/sqrt(Hz), hand accelerometer.
    gyro_bias_sd, accelerometer_bias_sd : float
        Prior of the constant biases, rad/s and m/s^2.
    gyro_scale_sd, accelerometer_scale_sd : float
        Prior of scale and misalignment errors of the hand IMU's axes, as a fraction; see
        ``GraspSettings.sensor_errors``.
    accelerometer_delay_sd : float
        Prior of the delay between the accelerometer's and the gyroscope's channels (their built-in filters
        differ), s.
    robot_position_sd, robot_rotation_sd : float or None
        Of one robot pose, m and rad; None estimates them from the pose stream's own high frequencies.
    robot_joint_sd : float
        Of one joint position, rad, when the robot side is a joint stream.
    robot_angular_velocity_density, robot_angular_acceleration_density, robot_acceleration_density : float or None
        rad/s, rad/s^2 and m/s^2 per sqrt(Hz), when the robot side is a motion stream; None estimates them
        from the stream's own high frequencies. For an IMU on the robot the first and the last; None takes the
        hand's densities.
    base_tilt_sd : float
        Prior of the tilt of the robot's base against gravity, rad, when it is estimated.
    time_offset_sd : float
        Prior of the time offset that remains after the coarse search, s.
    """

    gyro_density: float = 5e-4
    accelerometer_density: float = 2e-3
    gyro_bias_sd: float = 0.05
    accelerometer_bias_sd: float = 0.3
    gyro_scale_sd: float = 0.005
    accelerometer_scale_sd: float = 0.005
    accelerometer_delay_sd: float = 0.002
    robot_position_sd: float | None = None
    robot_rotation_sd: float | None = None
    robot_joint_sd: float = 1e-5
    robot_angular_velocity_density: float | None = None
    robot_angular_acceleration_density: float | None = None
    robot_acceleration_density: float | None = None
    base_tilt_sd: float = 0.02
    time_offset_sd: float = 0.1

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if value is None and item.default is None:
                continue
            if (
                isinstance(value, bool)
                or not isinstance(value, (int, float))
                or not np.isfinite(value)
                or value < 0.0
            ):
                raise InputError(f"noise.{item.name}", "a finite number, zero or more", repr(value))
        for name in (
            "gyro_density",
            "accelerometer_density",
            "gyro_bias_sd",
            "accelerometer_bias_sd",
            "time_offset_sd",
            "base_tilt_sd",
        ):
            if getattr(self, name) == 0.0:
                raise InputError(
                    f"noise.{name}",
                    "a number above zero (a singular covariance has no least squares)",
                    "0",
                    _ZERO_HINTS.get(name, ""),
                )


_ZERO_HINTS = {
    "gyro_bias_sd": "Switch gyro_bias off in [estimate] to trust the gyroscope's zero",
    "accelerometer_bias_sd": "Switch accelerometer_bias off in [estimate] to trust the accelerometer's zero",
    "time_offset_sd": "Switch time_offset off in [estimate] to trust the clocks",
    "base_tilt_sd": "Switch base_tilt off in [estimate] to trust the robot's gravity",
}


@dataclass(frozen=True)
class GraspSettings:
    """What is estimated, and how the recording is read.

    Attributes
    ----------
    time_offset : bool
        Estimate the offset between the two clocks (hand minus robot).
    time_offset_guess : float
        s; where the search starts, or the known offset when `time_offset` is off.
    max_time_offset : float
        s; half width of the coarse search.
    gyro_bias, accelerometer_bias : bool
        Estimate the constant biases of the hand IMU.
    base_tilt : bool
        Estimate the tilt of the robot base against gravity; needs robot orientations.
    errors_in_variables : bool
        Take the expected noise of the robot's own signals out of the moments (mathematics 2.3).
    adapt_noise : bool
        Estimate the residual power per frequency band, instead of trusting the declared densities alone.
    loss : {"none", "huber", "cauchy", "geman_mcclure"}
        Robust loss on the whitened residual of every window.
    loss_scale : float or None
        In standard deviations of one window's residual; None takes the loss's default.
    forgetting_time : float or None
        s; weights decay as ``exp(-age / forgetting_time)``; None keeps everything.
    bandwidth : float or None
        Hz; the relations are used up to this frequency. None: 20 Hz, or a fifth of the slower rate.
    kinematics_bandwidth : float or None
        Hz; of the differentiation of robot poses or joints. None: twice `bandwidth`, as far as the rate
        allows.
    window : float
        s; length of the analysis windows.
    max_gap : float or None
        s; samples further apart than this are a gap, which is never bridged. None: 2.5 times the median step.
    rotation_resolution, translation_resolution : float
        rad and m; a direction whose posterior sd is larger counts as not identified.
    sensor_errors : {"auto", "always", "never"}
        Estimate scale and misalignment errors of the hand IMU and the delay between its two channels. "auto"
        does so first and drops those groups that the data do not show to differ from zero, so that a
        well-calibrated sensor costs no accuracy.
    check_model : bool
        Widen the covariance where the scores of separate stretches of the recording scatter more than the
        noise allows.
    """

    time_offset: bool = True
    time_offset_guess: float = 0.0
    max_time_offset: float = 1.0
    gyro_bias: bool = True
    accelerometer_bias: bool = True
    base_tilt: bool = False
    errors_in_variables: bool = True
    adapt_noise: bool = True
    loss: Literal["none", "huber", "cauchy", "geman_mcclure"] = "none"
    loss_scale: float | None = None
    forgetting_time: float | None = None
    bandwidth: float | None = None
    kinematics_bandwidth: float | None = None
    window: float = 1.0
    max_gap: float | None = None
    rotation_resolution: float = 0.05
    translation_resolution: float = 0.03
    sensor_errors: Literal["auto", "always", "never"] = "auto"
    check_model: bool = True

    def __post_init__(self) -> None:
        make_loss(self.loss, self.loss_scale)
        if self.sensor_errors not in ("auto", "always", "never"):
            raise InputError("estimate.sensor_errors", "one of auto, always, never", repr(self.sensor_errors))
        for name in ("forgetting_time", "bandwidth", "kinematics_bandwidth", "max_gap"):
            value = getattr(self, name)
            if value is not None:
                _above_zero(f"estimate.{name}", value)
        for name in ("window", "rotation_resolution", "translation_resolution", "max_time_offset"):
            _above_zero(f"estimate.{name}", getattr(self, name))
        if not np.isfinite(self.time_offset_guess):
            raise InputError(
                "estimate.time_offset_guess", "a finite number of seconds", repr(self.time_offset_guess)
            )


@dataclass(frozen=True)
class GraspPrior:
    """What is known of the grasp beforehand.

    Attributes
    ----------
    translation : (3,) ndarray
        ``p_r_h``, m.
    translation_sd : float
        m, of every component. The default says only that a hand is within a few metres of the robot's
        end-effector.
    rotation : (3, 3) ndarray or None
        ``R_r_h``.
    rotation_sd : float or None
        rad; None: nothing is known of the rotation.
    """

    translation: FloatArray = None  # type: ignore[assignment]
    translation_sd: float = 3.0
    rotation: FloatArray | None = None
    rotation_sd: float | None = None

    def __post_init__(self) -> None:
        translation = np.zeros(3) if self.translation is None else np.asarray(self.translation, dtype=float)
        if translation.shape != (3,) or not np.all(np.isfinite(translation)):
            raise InputError("prior.translation", "3 finite numbers in m", str(translation))
        object.__setattr__(self, "translation", translation)
        _above_zero("prior.translation_sd", self.translation_sd)
        if (self.rotation is None) != (self.rotation_sd is None):
            raise InputError("prior.rotation", "rotation and rotation_sd together", "only one of them")
        if self.rotation is not None:
            rotation = np.asarray(self.rotation, dtype=float)
            if (
                rotation.shape != (3, 3)
                or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
                or np.linalg.det(rotation) < 0
            ):
                raise InputError("prior.rotation", "a rotation matrix (3, 3)", str(rotation.tolist()))
            object.__setattr__(self, "rotation", rotation)
            _above_zero("prior.rotation_sd", self.rotation_sd)


def _above_zero(field: str, value: object) -> None:
    if (
        isinstance(value, bool)
        or not isinstance(value, (int, float))
        or not np.isfinite(value)
        or value <= 0.0
    ):
        raise InputError(field, "a finite number above zero", repr(value))

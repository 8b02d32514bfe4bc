"""Physical words for what a motion did and did not show of a grasp."""

from __future__ import annotations

import numpy as np

from factorgrasp.problems.grasp_model_check import ModelCheck
from factorgrasp.problems.grasp_settings import GraspNoise
from factorgrasp.typing import FloatArray, State

# Rates whose second principal axis carries less than this part of the power turn about one axis only.
_ONE_AXIS = 0.02
_ALIGNED = 0.9
# m/s^2; a fifth of gravity: more than any tilt, bias or bad differentiation of a slow motion.
_LARGEST_SLOW_FORCE = 2.0
# Fraction; cheap sensors are off by 3 %.
_LARGEST_CALIBRATION = 0.15
_CALIBRATIONS = ("gyro_calibration", "accelerometer_calibration")


def rotation_axis(rate_moment: FloatArray) -> tuple[FloatArray, float]:
    """Principal axis (3,) of the end-effector's rotation, and the power of the second axis relative to the first."""
    values, vectors = np.linalg.eigh(rate_moment)
    return np.asarray(vectors[:, 2]), float(values[1] / values[2]) if values[2] > 0.0 else 1.0


def axis_words(vector: FloatArray) -> str:
    """A direction in its frame, e.g. "(0.22, 0.87, 0.44)" or "z"."""
    largest = int(np.argmax(np.abs(vector)))
    if abs(vector[largest]) > 0.97:
        return "xyz"[largest]
    return "(" + ", ".join(f"{v:.2f}" for v in vector) + ")"


def direction(variable: str, vector: FloatArray, rate_moment: FloatArray) -> str:
    """Words for a unit direction of the rotation (hand frame) or the lever arm (end-effector frame)."""
    if variable == "rotation":
        return f"rotation about hand axis {axis_words(vector)}"
    axis, second = rotation_axis(rate_moment)
    along = abs(float(axis @ vector))
    words = f"lever arm along end-effector axis {axis_words(vector)}"
    if second < _ONE_AXIS and along > _ALIGNED:
        return words + ", which is the rotation axis"
    return words


def advice(rate_moment: FloatArray, check: ModelCheck | None) -> str:
    """What would inform the missing directions.

    Parameters
    ----------
    rate_moment : (3, 3) ndarray
        Mean of ``w_r w_r'``, (rad/s)^2.
    check : ModelCheck or None
        Outcome of the model check, where it ran.
    """
    _, second = rotation_axis(rate_moment)
    speed = float(np.sqrt(max(np.trace(rate_moment), 0.0)))
    if speed < 0.05:
        return (
            f"The end-effector hardly rotates ({np.degrees(speed):.2g} deg/s rms): only a rotation shows the lever arm. "
            "Rotate the object about at least two axes, some tens of deg/s."
        )
    if second < _ONE_AXIS:
        return (
            "The end-effector rotates about one axis only, and a lever arm along that axis moves nothing. "
            "Add rotation about a second axis (a conical motion, or two rotations one after the other)."
        )
    if check is not None and check.phantom > 0.0:
        return (
            f"The robot's stream agrees with the hand only up to {check.confirmed:.1f} Hz; above that it shows motion which "
            "the hand does not make, as poses do that were interpolated from few samples or have jittered stamps. "
            f"Its accelerations may then move the lever arm by {1e3 * check.phantom:.0f} mm. Record the robot side faster, "
            "with its own time stamps."
        )
    if check is not None and check.band_spread > 0.0:
        return (
            f"Frequency bands disagree about the lever arm by {1e3 * check.band_spread:.1f} mm: the accelerations of the two "
            "sides are not those of one rigid body. Check the mounting, the robot's noise in [noise], and the sensor's range."
        )
    return (
        f"The rotation ({np.degrees(speed):.2g} deg/s rms) is too weak or too slow for the noise in the acceleration: "
        "rotate faster or longer, about changing axes."
    )


def unrelated(correlation: float, rate_moment: FloatArray) -> str:
    """What it may mean that the two angular rates do not correlate."""
    speed = float(np.sqrt(max(np.trace(rate_moment), 0.0)))
    if speed < 0.05:
        return f"The end-effector hardly rotates ({np.degrees(speed):.2g} deg/s rms), so nothing ties the hand's motion to it."
    return (
        f"Robot and hand do not turn together (correlation of their angular rates {correlation:.2f} at the "
        "best offset): the recordings may not belong to the same motion, the clocks may differ by more than "
        "max_time_offset, or the quaternions may be in another order or direction than w, x, y, z body-to-world."
    )


def contradiction(values: State, noise: GraspNoise, residual: float) -> str:
    """What it may mean that only an impossible sensor reconciles the two sides; empty when the sensor is plausible.

    Parameters
    ----------
    values : mapping
        Unknowns as estimated.
    noise : GraspNoise
        With the priors of the sensor's errors.
    residual : float
        Disagreement of the slow specific forces that remains, m/s^2 per axis.
    """
    bias = float(np.linalg.norm(values.get("accelerometer_bias", np.zeros(3))))
    size = max(bias, float(np.sqrt(3.0)) * residual)
    if size > max(6.0 * noise.accelerometer_bias_sd, _LARGEST_SLOW_FORCE):
        found = (
            f"The specific forces of the two sides differ by {size:.1f} m/s^2, which no sensor bias explains"
        )
    else:
        scale = max(
            (float(np.max(np.abs(values[name]))) for name in _CALIBRATIONS if name in values), default=0.0
        )
        if scale < _LARGEST_CALIBRATION:
            return ""
        found = f"The two sides agree only if the sensor's axes are off by {100.0 * scale:.0f} %"
    return (
        f"{found}: check the sign and frame of gravity, that the quaternions are w, x, y, z body-to-world, and that the "
        "accelerometer reads m/s^2 with gravity in it."
    )

"""Values that no hand and no robot arm produces, but a wrong unit does: refused, with the likely unit named.

Every check can be switched off (``check_units=False``). Slow motion in degrees can pass as fast motion in radians; the
surer test compares both sides of a grasp and belongs to the problem that has both.
"""

from __future__ import annotations

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.recordings.units import STANDARD_GRAVITY
from factorgrasp.typing import FloatArray

# 2000 deg/s is the full range of common gyroscopes and more than a hand or an arm reaches (fast tennis
# serves: 30 rad/s at the wrist). A hand moving at a leisurely 0.7 rad/s (99th percentile), recorded in
# degrees, exceeds it.
FASTEST_ANGULAR_VELOCITY = 35.0
# An accelerometer on a hand reads about 9.8 m/s^2 in the median, whatever the hand does; 0.5 to 2 is the same
# in g.
G_UNITS_SPECIFIC_FORCE = (0.5, 2.0)
# Above it neither a hand nor an arm lives in the median (5 g): milli-g, or counts of the converter.
LARGEST_MEDIAN_SPECIFIC_FORCE = 50.0
# Nobody records motion below 2 Hz; a median step of half a second and more is milliseconds (or finer) taken
# for seconds.
SLOWEST_RATE = 2.0
# No arm and no capture volume is larger; the same motion in millimetres always is.
LARGEST_TRAVEL = 30.0
# Two full turns: beyond every revolute joint's stops, while 12.6 degrees is a small joint angle.
LARGEST_JOINT_ANGLE = 4.0 * np.pi

_UNITS_HINT = "If the values are right, pass check_units=False"


def _norms(values: FloatArray) -> FloatArray:
    norms = np.sqrt(np.einsum("ij,ij->i", values, values))
    out: FloatArray = norms[np.isfinite(norms)]
    return out


def check_angular_velocity(values: FloatArray, field: str) -> None:
    """Refuse an angular velocity (rad/s, shape (n, 3)) that looks like degrees per second."""
    norms = _norms(values)
    if norms.size == 0:
        return
    fast = float(np.percentile(norms, 99.0))
    if fast > FASTEST_ANGULAR_VELOCITY:
        raise InputError(
            field,
            f"rad/s, 99th percentile of the norm below {FASTEST_ANGULAR_VELOCITY:g} (2000 deg/s)",
            f"{fast:.4g}: degrees per second suspected ({fast:.4g} deg/s = {np.deg2rad(fast):.4g} rad/s)",
            f"Convert with numpy.deg2rad, or declare [deg/s] in the file's header. {_UNITS_HINT}",
        )


def check_specific_force(values: FloatArray, field: str) -> None:
    """Refuse a specific force (m/s^2, shape (n, 3)) in g, without gravity, or in counts."""
    norms = _norms(values)
    if norms.size == 0:
        return
    middle = float(np.median(norms))
    low, high = G_UNITS_SPECIFIC_FORCE
    expected = "specific force in m/s^2 (what an accelerometer reads: 9.8 at rest)"
    if low <= middle <= high:
        raise InputError(
            field,
            expected,
            f"median norm {middle:.4g}: g units suspected ({middle:.4g} g = {middle * STANDARD_GRAVITY:.4g} m/s^2)",
            f"Multiply by 9.80665, or declare [g] in the file's header. {_UNITS_HINT}",
        )
    if middle < low:
        raise InputError(
            field,
            expected,
            f"median norm {middle:.4g}: gravity seems to be removed",
            f"Export the raw accelerometer signal instead of the linear (user) acceleration. {_UNITS_HINT}",
        )
    if middle > LARGEST_MEDIAN_SPECIFIC_FORCE:
        raise InputError(
            field,
            expected,
            f"median norm {middle:.4g}: milli-g or raw counts suspected",
            f"Declare [mg] in the file's header, or convert to m/s^2. {_UNITS_HINT}",
        )


def check_rate(step: float, field: str) -> None:
    """Refuse a median step (s) that looks like milliseconds or finer."""
    if 1.0 / step < SLOWEST_RATE:
        raise InputError(
            field,
            f"seconds, at least {SLOWEST_RATE:g} samples each",
            f"a median step of {step:.6g}: milliseconds or finer suspected",
            f"Declare the unit in the file's header (t [ms], t [ns]). {_UNITS_HINT}",
        )


def check_position(values: FloatArray, field: str) -> None:
    """Refuse positions (m, shape (n, 3)) that look like millimetres."""
    travel = float(np.max(np.nanmax(values, axis=0) - np.nanmin(values, axis=0)))
    if travel > LARGEST_TRAVEL:
        raise InputError(
            field,
            f"m, travel below {LARGEST_TRAVEL:g} along every axis",
            f"{travel:.4g}: millimetres suspected ({travel:.4g} mm = {travel / 1000.0:.4g} m)",
            f"Divide by 1000, or declare [mm] in the file's header. {_UNITS_HINT}",
        )


def check_joint_angle(values: FloatArray, field: str) -> None:
    """Refuse joint positions (rad, shape (n, k)) that look like degrees."""
    widest = float(np.nanmax(np.abs(values)))
    if widest > LARGEST_JOINT_ANGLE:
        raise InputError(
            field,
            "rad, within two turns",
            f"{widest:.4g}: degrees suspected ({widest:.4g} deg = {np.deg2rad(widest):.4g} rad)",
            f"Convert with numpy.deg2rad, or declare [deg] in the file's header. {_UNITS_HINT}",
        )

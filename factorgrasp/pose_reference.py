"""A reference of the end-effector over time, and smooth transitions from one value to another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.lie import so3_exp
from factorgrasp.simulation.trajectory import body_rates, cross
from factorgrasp.typing import FloatArray

Curve = tuple[FloatArray, FloatArray, FloatArray]
"""Values (n, ...) with their first and second derivatives."""


@dataclass(frozen=True, eq=False)
class PoseReference:
    """A reference of the end-effector at n instants, world axes.

    Attributes
    ----------
    position, velocity, acceleration : (n, 3) ndarray
        Of the frame's origin: m, m/s, m/s^2.
    rotation : (n, 3, 3) ndarray
        ``R_w_r``.
    angular_velocity, angular_acceleration : (n, 3) ndarray
        rad/s, rad/s^2.
    """

    position: FloatArray
    rotation: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    acceleration: FloatArray
    angular_acceleration: FloatArray


def turned(start: FloatArray, phi: Curve) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``R = exp(phi) R_0`` (n, 3, 3) with angular velocity and acceleration (n, 3), all in world axes.

    Parameters
    ----------
    start : (3, 3) ndarray
        ``R_0``.
    phi : Curve
        Rotation vector (n, 3), world axes, rad.
    """
    own = tuple(part @ start for part in phi)
    w, al = body_rates(*own)
    R = so3_exp(phi[0]) @ start
    return R, np.einsum("nij,nj->ni", R, w), np.einsum("nij,nj->ni", R, al)


def about_point(
    start_position: FloatArray, start_rotation: FloatArray, phi: Curve, lever: Curve, travel: Curve
) -> PoseReference:
    """Turn about a point of the object at pose level: ``p = p_0 + travel + (R_0 - R) r``.

    Parameters
    ----------
    start_position, start_rotation : (3,), (3, 3) ndarray
        ``p_0`` and ``R_0``.
    phi : Curve
        Rotation vector (n, 3) from the start, world axes, rad.
    lever : Curve
        ``r`` (n, 3), the point in the end-effector's frame, m; it may move.
    travel : Curve
        Way of the point (n, 3), world axes, m.
    """
    R, w, al = turned(start_rotation, phi)
    r, dr, ddr = lever
    arm, slip, pull = (np.einsum("nij,nj->ni", R, part) for part in (r, dr, ddr))
    swing = cross(w, arm)
    position = start_position + travel[0] + r @ start_rotation.T - arm
    velocity = travel[1] + dr @ start_rotation.T - swing - slip
    acceleration = (
        travel[2] + ddr @ start_rotation.T - cross(al, arm) - cross(w, swing) - 2.0 * cross(w, slip) - pull
    )
    return PoseReference(position, R, velocity, w, acceleration, al)


class Blend:
    """A value that goes from one level to the next without a jump of velocity or acceleration.

    Parameters
    ----------
    value : (k,) ndarray
        At the start.
    """

    def __init__(self, value: FloatArray) -> None:
        self._before = self._after = np.array(value, dtype=float)
        self._start, self._seconds = 0.0, 0.0

    @property
    def target(self) -> FloatArray:
        """Where it goes or has arrived (k,)."""
        return self._after

    def busy(self, t: float) -> bool:
        """Whether it is still on its way at time `t` (s)."""
        return t < self._start + self._seconds

    def go(self, t: float, value: FloatArray, seconds: float) -> None:
        """Leave at time `t` (s) for another value (k,), to be there after `seconds`; only when not busy."""
        self._before, self._after = self._after, np.array(value, dtype=float)
        self._start, self._seconds = t, seconds

    def at(self, t: FloatArray) -> Curve:
        """Value with two derivatives at times `t` (n,), each (n, k); a quintic polynomial in between."""
        way = self._after - self._before
        if self._seconds == 0.0 or not way.any():
            value = np.tile(self._after, (t.size, 1))
            return value, np.zeros_like(value), np.zeros_like(value)
        T = self._seconds
        x = np.clip((t - self._start) / T, 0.0, 1.0)[:, None]
        s = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
        ds = 30.0 * x * x * (1.0 - x) ** 2 / T
        dds = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / T**2
        return self._before + s * way, ds * way, dds * way


def times(scale: Curve, curve: Curve) -> Curve:
    """Product of a scalar (n, 1) and a vector (n, 3) with their derivatives."""
    a, da, dda = scale
    x, dx, ddx = curve
    return a * x, da * x + a * dx, dda * x + 2.0 * da * dx + a * ddx


def plus(a: Curve, b: Curve) -> Curve:
    """Sum of two vectors with their derivatives."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]

"""Velocities and accelerations of a model from its configurations over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.state_noise import StateNoise
from factorgrasp.signals import (
    choose_savgol,
    differentiate_rotations,
    savgol_derivatives,
)
from factorgrasp.typing import BoolArray, FloatArray

ORDER = 4
"""Of the polynomial: even, so that the second derivative gains from it."""


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Smoothed configurations and their derivatives.

    Attributes
    ----------
    q, qd, qdd : ndarray
        (n, nq), (n, nv), (n, nv), as pinocchio has them; NaN where the filter touches a gap or an end.
    good : ndarray, shape (n,)
        Frames without NaN.
    angle_gain, acceleration_gain : float
        Variance of a smoothed angle and of its second derivative (1/s^4) per variance of one angle: white noise through the filter.
    cross_gain : float
        Their covariance (1/s^2), likewise.
    window : int
        Samples of the filter: frames so far apart have independent errors.
    """

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    good: BoolArray
    angle_gain: float
    acceleration_gain: float
    cross_gain: float
    window: int

    def state_noise(self, covariance: FloatArray) -> StateNoise:
        """Noise of a motion made of these, from the covariance of one sample of the configuration."""
        return StateNoise(covariance, self.angle_gain, self.acceleration_gain, self.cross_gain)


def differentiate_configurations(model: Any, q: FloatArray, dt: float, bandwidth: float) -> JointMotion:
    """Savitzky-Golay derivatives of uniformly sampled configurations.

    Parameters
    ----------
    model : pinocchio.Model
        Hinges and sliders, with or without a free-flyer as first joint.
    q : (n, nq) ndarray
        As pinocchio has them: a free-flyer's are ``[position, quaternion x y z w]``; NaN marks gaps.
    dt : float
        s.
    bandwidth : float
        Hz, up to which motion passes.

    Raises
    ------
    InputError
        For a bandwidth beyond half the rate, or fewer frames than the filter is long.
    """
    window = choose_savgol(bandwidth, dt, ORDER)
    if q.shape[0] < window:
        raise InputError(
            "configurations",
            f"at least {window} frames ({window * dt:.3g} s) for the derivatives",
            f"{q.shape[0]}",
        )
    free = model.nv != model.nq
    if free and (model.nq - model.nv != 1 or model.joints[1].shortname() != "JointModelFreeFlyer"):
        raise InputError(
            "model",
            "joints of one coordinate, and a free-flyer at most",
            f"{model.nq} coordinates, {model.nv} velocities",
        )
    first_q, first_v = (7, 6) if free else (0, 0)
    parts = [savgol_derivatives(q[:, first_q:], dt, window, ORDER, k) for k in (0, 1, 2)]
    smooth = np.concatenate([np.full((q.shape[0], first_q), np.nan), parts[0]], axis=1)
    v, a = (np.concatenate([np.full((q.shape[0], first_v), np.nan), part], axis=1) for part in parts[1:])
    if free:
        turned = differentiate_rotations(np.roll(q[:, 3:7], 1, axis=1), dt, window, ORDER)
        p, pd, pdd = (savgol_derivatives(q[:, :3], dt, window, ORDER, k) for k in (0, 1, 2))
        root = free_flyer(p, turned.rotation, pd, turned.angular_velocity, pdd, turned.angular_acceleration)
        smooth[:, :7], v[:, :6], a[:, :6] = root
    good: BoolArray = np.asarray(
        np.isfinite(smooth).all(axis=1) & np.isfinite(v).all(axis=1) & np.isfinite(a).all(axis=1)
    )
    passed = StateNoise.through_savgol(np.ones(1), window, ORDER, dt)
    gains = passed.position_gain, passed.acceleration_gain, passed.cross_gain
    return JointMotion(smooth, v, a, good, *gains, window)


def free_flyer(
    p: FloatArray, rotation_wxyz: FloatArray, pd: FloatArray, w: FloatArray, pdd: FloatArray, dw: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Configuration (n, 7), velocity and acceleration (n, 6) of a free-flyer, as pinocchio has them.

    Parameters
    ----------
    p, pd, pdd : (n, 3) ndarray
        Position and its derivatives in the world, m, m/s, m/s^2.
    rotation_wxyz : (n, 4) ndarray
        Body to world.
    w, dw : (n, 3) ndarray
        Angular velocity and acceleration in the body's frame, rad/s and rad/s^2.
    """
    back = np.swapaxes(lie.quaternion_wxyz_to_matrix(rotation_wxyz), 1, 2)
    linear = (back @ pd[:, :, None])[..., 0]
    # Spatial acceleration: that of the origin less w x v.
    spatial = (back @ pdd[:, :, None])[..., 0] - np.cross(w, linear)
    q = np.concatenate([p, np.roll(rotation_wxyz, -1, axis=1)], axis=1)
    return q, np.concatenate([linear, w], axis=1), np.concatenate([spatial, dw], axis=1)

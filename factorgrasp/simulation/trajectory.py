"""Analytic rigid-body motion: sums of sinusoids with exact derivatives, nothing differentiated numerically."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.lie import quaternion_exp_wxyz, quaternion_multiply_wxyz, quaternion_wxyz_to_matrix
from factorgrasp.typing import FloatArray

# Below this squared angle the closed forms of the derivatives cancel; five terms of the series are exact to 1e-13.
_SERIES_BELOW = 0.25


@dataclass(frozen=True, eq=False)
class Sinusoids:
    """A vector signal ``x(t) = offset + sum_k amplitude_k * sin(2 pi frequency_k t + phase_k)``.

    Parameters
    ----------
    offset : array_like, shape (3,)
        In the signal's unit.
    amplitude : array_like, shape (m, 3)
        In the signal's unit, one row for each frequency.
    frequency : array_like, shape (m,)
        Hz.
    phase : array_like, shape (m, 3)
        rad, one for each component.
    """

    offset: npt.ArrayLike = (0.0, 0.0, 0.0)
    amplitude: npt.ArrayLike = field(default_factory=lambda: np.zeros((0, 3)))
    frequency: npt.ArrayLike = ()
    phase: npt.ArrayLike = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        m = np.size(self.frequency)
        for key, shape in (("offset", (3,)), ("amplitude", (m, 3)), ("frequency", (m,)), ("phase", (m, 3))):
            value = np.asarray(getattr(self, key), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(f"Sinusoids.{key}", f"finite numbers, shape {shape}", f"{value!r}")
            object.__setattr__(self, key, value)

    def derivatives(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Value, first and second time derivative at times ``t`` (n,), each (n, 3)."""
        amplitude, phase = np.asarray(self.amplitude), np.asarray(self.phase)
        rate = 2.0 * np.pi * np.asarray(self.frequency)
        sine, cosine = np.sin(np.multiply.outer(t, rate)), np.cos(np.multiply.outer(t, rate))
        # A sin(w t + p) = (A cos p) sin(w t) + (A sin p) cos(w t): one sine for all three components.
        in_phase, quadrature = amplitude * np.cos(phase), amplitude * np.sin(phase)
        w = rate[:, None]
        value = np.asarray(self.offset) + sine @ in_phase + cosine @ quadrature
        first = cosine @ (w * in_phase) - sine @ (w * quadrature)
        second = -(sine @ (w * w * in_phase) + cosine @ (w * w * quadrature))
        return value, first, second


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a x b`` along the last axis; several times faster than :func:`numpy.cross`."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def _series(x: FloatArray, coefficients: Sequence[float]) -> FloatArray:
    out = np.zeros_like(x)
    for c in reversed(coefficients):
        out = out * x + c
    return out


def _jacobian_coefficients(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """``a = (1 - cos s)/s^2``, ``b = (s - sin s)/s^3`` and their ``d/ds`` over ``s``, at the squared angle ``x = s^2``."""
    small = x < _SERIES_BELOW
    safe = np.where(small, 1.0, x)
    s = np.sqrt(safe)
    sine, cosine = np.sin(s), np.cos(s)
    u = np.where(small, x, 0.0)
    # The coefficients are (-1)^k / (2k + 2)! and (-1)^k / (2k + 3)!; the last two rows are twice their derivatives in x.
    a = np.where(
        small,
        _series(u, (1 / 2, -1 / 24, 1 / 720, -1 / 40320, 1 / 3628800, -1 / 479001600)),
        (1.0 - cosine) / safe,
    )
    b = np.where(
        small,
        _series(u, (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800)),
        (s - sine) / (safe * s),
    )
    da = np.where(
        small,
        _series(u, (-1 / 12, 1 / 180, -1 / 6720, 1 / 453600, -1 / 47900160, 1 / 7264857600)),
        (s * sine - 2.0 * (1.0 - cosine)) / (safe * safe),
    )
    db = np.where(
        small,
        _series(u, (-1 / 60, 1 / 1260, -1 / 60480, 1 / 4989600, -1 / 622702080, 1 / 108972864000)),
        (s * (1.0 - cosine) - 3.0 * (s - sine)) / (safe * safe * s),
    )
    return a, b, da, db


def body_rates(phi: FloatArray, dphi: FloatArray, ddphi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angular velocity and acceleration in the body frame of ``R = exp(phi(t))``.

    ``w = J_r(phi) dphi = dphi - a phi x dphi + b phi x (phi x dphi)``, and its derivative term by term.

    Parameters
    ----------
    phi, dphi, ddphi : ndarray, shape (n, 3)
        Rotation vector (rad) and its first two time derivatives.

    Returns
    -------
    w, al : ndarray, shape (n, 3)
        rad/s and rad/s^2.
    """
    a, b, da, db = (c[:, None] for c in _jacobian_coefficients(np.einsum("ij,ij->i", phi, phi)))
    along = np.einsum("ij,ij->i", phi, dphi)[:, None]
    once, once_dd = cross(phi, dphi), cross(phi, ddphi)
    twice = cross(phi, once)
    w = dphi - a * once + b * twice
    al = (
        ddphi
        - (da * along) * once
        - a * once_dd
        + (db * along) * twice
        + b * (cross(dphi, once) + cross(phi, once_dd))
    )
    return w, al


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """The exact motion of a body ``b`` against the world ``w`` at given times.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s.
    position : ndarray, shape (n, 3)
        ``p_w_b`` (m).
    rotation_wxyz : ndarray, shape (n, 4)
        Quaternions [w, x, y, z] of ``R_w_b``.
    angular_velocity, angular_acceleration : ndarray, shape (n, 3)
        rad/s and rad/s^2, in the body frame.
    acceleration : ndarray, shape (n, 3)
        Acceleration of the body's origin (m/s^2), gravity not included, in the **body** frame.
    """

    t: FloatArray
    position: FloatArray
    rotation_wxyz: FloatArray
    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    acceleration: FloatArray

    @property
    def rotation(self) -> FloatArray:
        """``R_w_b``, shape (n, 3, 3)."""
        return quaternion_wxyz_to_matrix(self.rotation_wxyz)

    def specific_force(self, gravity: npt.ArrayLike) -> FloatArray:
        """``f = a - R_w_b' g`` in the body frame (m/s^2), shape (n, 3); ``gravity`` in the world frame."""
        out: FloatArray = self.acceleration - np.asarray(gravity, dtype=np.float64) @ self.rotation
        return out


@dataclass(frozen=True, eq=False)
class RigidTrajectory:
    """A body that turns about a point fixed in it while that point travels.

    ``R_w_b(t) = R_w_b(mean) exp(rotation(t))`` and ``p_w_b(t) = center(t) - R_w_b(t) lever``: with ``lever = p_b_c`` the
    origin of the body swings about the point ``c`` (the paper's motion about the wrist, eq. 26).

    Parameters
    ----------
    rotation : Sinusoids
        Rotation vector about the mean orientation (rad).
    center : Sinusoids
        ``p_w_c`` (m).
    lever : array_like, shape (3,)
        ``p_b_c`` (m).
    mean_rotation_wxyz : array_like, shape (4,)
        Quaternion [w, x, y, z] of the orientation where the rotation vector is zero.
    """

    rotation: Sinusoids
    center: Sinusoids = field(default_factory=Sinusoids)
    lever: npt.ArrayLike = (0.0, 0.0, 0.0)
    mean_rotation_wxyz: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0)

    def at(self, t: npt.ArrayLike) -> RigidMotion:
        """The motion at times ``t`` (n,) in s."""
        times = np.asarray(t, dtype=np.float64)
        lever = np.asarray(self.lever, dtype=np.float64)
        phi, dphi, ddphi = self.rotation.derivatives(times)
        q = quaternion_multiply_wxyz(self.mean_rotation_wxyz, quaternion_exp_wxyz(phi))
        R = quaternion_wxyz_to_matrix(q)
        w, al = body_rates(phi, dphi, ddphi)
        center, _, center_acceleration = self.center.derivatives(times)
        swing = cross(al, lever) + cross(w, cross(w, lever))
        acceleration = np.einsum("nji,nj->ni", R, center_acceleration) - swing
        return RigidMotion(times, center - R @ lever, q, w, al, acceleration)

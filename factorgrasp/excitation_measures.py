"""How much a motion excites the grasp: the excitation matrix over every window, and the pointwise index (mathematics 3).

With ``phi = S(al) + S(w)^2`` (end-effector frame, Cehajic 2015 (21)) the condition (23) asks for

    G(t) = integral_t^(t+T) phi' phi ds >= alpha I

over every window. Three things make it honest here:

- *noise-corrected*: noise in ``w`` and ``al`` adds to G what no motion made; its expectation is taken out;
- *centred*: a constant accelerometer bias (in the hand's frame, which the grasp holds still in the end-effector's) explains the mean of
  ``phi r``, so where it is estimated only ``phi - mean(phi)`` shows the lever arm;
- *every* window of the grid is looked at, not every T-th.

``det phi = -|w x al|^2`` exactly: the motion excites at an instant where angular velocity and acceleration are not parallel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.problems.grasp_model import phi_information
from factorgrasp.problems.grasp_noise import product_noise
from factorgrasp.signals.rotations import cross
from factorgrasp.typing import BoolArray, FloatArray

# Eigenvalues below this part of the largest one are rounding.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class WindowMeasures:
    """The excitation of every window of a motion.

    Attributes
    ----------
    start : (n,) ndarray
        When each window begins, s.
    window : float
        Its length T, s.
    matrix : (n, 3, 3) ndarray
        G, s^-3, end-effector frame.
    eigenvalues : (n, 3) ndarray
        Ascending, s^-3; below zero where the expected noise is all there is.
    weakest : (n, 3) ndarray
        Unit vector (end-effector frame) of the smallest one: the lever arm along it shows least.
    centred : bool
        The mean of phi is taken out.
    noise : float
        What noise alone would have put into every eigenvalue (s^-3), already taken out.
    """

    start: FloatArray
    window: float
    matrix: FloatArray
    eigenvalues: FloatArray
    weakest: FloatArray
    centred: bool
    noise: float

    @property
    def lambda_min(self) -> FloatArray:
        """Smallest eigenvalue of every window, s^-3, (n,)."""
        return np.asarray(self.eigenvalues[:, 0])

    @property
    def condition(self) -> FloatArray:
        """Condition number of every window; infinite where a direction is not excited, (n,)."""
        low, high = self.eigenvalues[:, 0], self.eigenvalues[:, 2]
        excited = low > _ROUNDING * np.maximum(high, 0.0)
        return np.where(excited, high / np.where(excited, low, 1.0), np.inf)

    @property
    def log_det(self) -> FloatArray:
        """``log det G`` of every window (G in s^-3); minus infinity where a direction is not excited, (n,)."""
        excited = np.isfinite(self.condition) & (self.eigenvalues[:, 2] > 0.0)
        safe = np.where(excited[:, None], self.eigenvalues, 1.0)
        return np.where(excited, np.log(safe).sum(axis=1), -np.inf)

    @property
    def worst(self) -> int:
        """Index of the window with the smallest eigenvalue."""
        return int(np.argmin(self.lambda_min))

    def meets(self, alpha: float) -> bool:
        """Whether ``G >= alpha I`` over every window."""
        return bool(self.lambda_min.min() >= alpha)


def phi_parts(angular_velocity: npt.ArrayLike, angular_acceleration: npt.ArrayLike) -> FloatArray:
    """``phi = S(al) + S(w)^2`` of every row, (n, 3, 3), s^-2.

    Parameters
    ----------
    angular_velocity, angular_acceleration : (n, 3) array_like
        rad/s and rad/s^2, in the end-effector frame.
    """
    w, al = np.asarray(angular_velocity, dtype=float), np.asarray(angular_acceleration, dtype=float)
    phi: FloatArray = w[:, :, None] * w[:, None, :]
    square = np.sum(w * w, axis=1)
    for i in range(3):
        phi[:, i, i] -= square
    x, y, z = al.T
    phi[:, 0, 1] -= z
    phi[:, 0, 2] += y
    phi[:, 1, 0] += z
    phi[:, 1, 2] -= x
    phi[:, 2, 0] -= y
    phi[:, 2, 1] += x
    return phi


def excitation_index(angular_velocity: npt.ArrayLike, angular_acceleration: npt.ArrayLike) -> FloatArray:
    """``det phi = -|w x al|^2`` (s^-6) of every row, (n,): zero where angular velocity and acceleration are parallel."""
    turned = cross(np.asarray(angular_velocity, dtype=float), np.asarray(angular_acceleration, dtype=float))
    return np.asarray(-np.sum(turned * turned, axis=1))


def noise_matrix(
    angular_velocity: npt.ArrayLike, angular_velocity_variance: float, angular_acceleration_variance: float
) -> FloatArray:
    """Expectation (3, 3), s^-4, of what white noise adds to ``phi' phi`` of one sample.

    ``E[S(n)' S(n)] = 2 s^2 I`` for noise of the angular acceleration with variance s^2 per axis, (rad/s^2)^2, and the noise of the products
    ``w w'`` for one of the angular velocity, (rad/s)^2. To first order in the variances.
    """
    w = np.asarray(angular_velocity, dtype=float)
    good = w[np.isfinite(w).all(axis=1)]
    out = np.zeros((12, 12))
    out[3:6, 3:6] = angular_acceleration_variance * np.eye(3)
    out[6:12, 6:12] = angular_velocity_variance * product_noise(good.T @ good / max(good.shape[0], 1))
    return phi_information(out)


def window_measures(
    t: npt.ArrayLike,
    angular_velocity: npt.ArrayLike,
    angular_acceleration: npt.ArrayLike,
    window: float,
    *,
    centred: bool = True,
    noise: FloatArray | None = None,
) -> WindowMeasures:
    """Excitation matrices over every window of a motion.

    Parameters
    ----------
    t : (n,) array_like
        s, uniform.
    angular_velocity, angular_acceleration : (n, 3) array_like
        rad/s and rad/s^2, end-effector frame. A row with NaN is a gap: it counts as no excitation.
    window : float
        T, s. Longer than the motion: the whole of it is the only window.
    centred : bool
        Take out the mean of phi, which an unknown accelerometer bias hides.
    noise : (3, 3) ndarray, optional
        From :func:`noise_matrix`; taken out of every sample.

    Returns
    -------
    WindowMeasures

    Raises
    ------
    InputError
        For a window of less than two samples, or when nothing but gaps is there.
    """
    stamps = np.asarray(t, dtype=float)
    step = float((stamps[-1] - stamps[0]) / (stamps.size - 1))
    length = min(round(window / step), stamps.size - 1)
    if not np.isfinite(window) or length < 2:
        raise InputError("window", f"at least two samples of {step:.3g} s", repr(window))
    phi = phi_parts(angular_velocity, angular_acceleration)
    bad: BoolArray = np.asarray(~np.isfinite(phi).all(axis=(1, 2)))
    phi[bad] = 0.0
    if bad.all():
        raise InputError("motion", "rows of numbers", "gaps only")
    # Trapezoidal sums: a window of n samples has n - 1 steps, and its two ends count half.
    square = np.matmul(phi.transpose(0, 2, 1), phi)
    G, mean = _windowed(square, length) * step, _windowed(phi, length) * step
    seconds = np.maximum(_windowed((~bad)[:, None, None].astype(float), length) * step, 1e-12)
    if centred:
        G -= np.matmul(mean.transpose(0, 2, 1), mean) / seconds
    expected = np.zeros((3, 3)) if noise is None else np.asarray(noise)
    G -= seconds * expected
    values, vectors = np.linalg.eigh(0.5 * (G + G.transpose(0, 2, 1)))
    weakest = vectors[:, :, 0]
    largest = np.take_along_axis(weakest, np.argmax(np.abs(weakest), axis=1)[:, None], axis=1)
    return WindowMeasures(
        start=stamps[: G.shape[0]],
        window=length * step,
        matrix=G,
        eigenvalues=values,
        weakest=weakest * np.where(largest < 0.0, -1.0, 1.0),
        centred=centred,
        noise=float(np.trace(expected) / 3.0 * length * step),
    )


def _windowed(x: FloatArray, length: int) -> FloatArray:
    """Sums of x (n, ...) by the trapezoidal rule over every stretch of `length` steps, (n - length, ...)."""
    total = np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])
    inner = total[length + 1 :] - total[: -length - 1]
    return np.asarray(inner - 0.5 * (x[: x.shape[0] - length] + x[length:]))

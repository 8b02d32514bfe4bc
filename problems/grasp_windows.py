"""Short-time spectra of the moments' inputs, and the second moments that they compress to.

The relations of :mod:`factorgrasp.problems.grasp_model` are linear in z, so the same linear functional on
every entry of z keeps them exact (mathematics 2.3). Here the functionals are sine-windowed cosines and sines
on half-overlapping windows. They form a tight frame: their squares sum to the signal's energy. That buys
three things over one low-pass filter: the residual's noise is nearly white inside a narrow band, so every
band gets the weight that its own residual power deserves; coefficients of a band count as independent, so the
covariance is honest for coloured noise (differentiated poses) as for white; and a window that touches a gap
is left out whole, so nothing is bridged.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from factorgrasp.typing import BoolArray, FloatArray, IntArray


@lru_cache(maxsize=16)
def _basis(length: int, bins: int) -> tuple[FloatArray, FloatArray]:
    """First and second half of the windowed basis, each (2 bins, length / 2); row 2k is the cosine of bin k, 2k + 1 its sine."""
    n = np.arange(length)
    k = np.arange(bins)
    angle = 2.0 * np.pi * np.outer(k, n) / length
    taper = np.sin(np.pi * (n + 0.5) / length)
    scale = np.where(k == 0, 1.0, np.sqrt(2.0))[:, None] * np.sqrt(1.0 / length) * taper
    out = np.stack([np.cos(angle) * scale, np.sin(angle) * scale], axis=1).reshape(2 * bins, length)
    return np.ascontiguousarray(out[:, : length // 2]), np.ascontiguousarray(out[:, length // 2 :])


@dataclass(frozen=True)
class Windowing:
    """Where the analysis windows lie on a uniform grid.

    Attributes
    ----------
    step : float
        Of the grid, s.
    length : int
        Samples of a window, even; windows start every half length.
    bins : int
        Frequencies 0, 1/T, ..., (bins - 1)/T with T = length * step.
    """

    step: float
    length: int
    bins: int

    @classmethod
    def for_grid(cls, step: float, seconds: float, bandwidth: float, samples: int) -> Windowing:
        """Windows of about `seconds`, shorter on a recording that holds fewer than eight of them."""
        half = max(2, min(round(0.5 * seconds / step), samples // 16))
        length = 2 * half
        return cls(step, length, max(2, int(bandwidth * length * step + 1e-9) + 1))

    @property
    def frequencies(self) -> FloatArray:
        """Centre frequency of every bin, Hz, (bins,)."""
        return np.asarray(np.arange(self.bins) / (self.length * self.step))

    @property
    def dof(self) -> FloatArray:
        """Independent real numbers per axis that one window adds to every bin, (bins,)."""
        out = np.ones(self.bins)
        out[0] = 0.5
        return out

    def basis(self) -> FloatArray:
        """Windowed cosines and sines (2 bins, length): a window's coefficients are ``basis @ z``."""
        return np.hstack(_basis(self.length, self.bins))

    def transform(self, z: FloatArray) -> FloatArray:
        """Coefficients (windows, bins, 2, c) of signals z (n, c); NaN in every window that touches a NaN."""
        half = self.length // 2
        blocks = z.shape[0] // half
        first, second = _basis(self.length, self.bins)
        cut = z[: blocks * half].reshape(blocks, half, z.shape[1])
        with np.errstate(invalid="ignore"):
            out = np.matmul(first, cut[:-1]) + np.matmul(second, cut[1:])
        return np.asarray(out.reshape(blocks - 1, self.bins, 2, z.shape[1]))

    def constant(self) -> FloatArray:
        """Coefficients (bins, 2) of the constant 1."""
        first, second = _basis(self.length, self.bins)
        return np.asarray((first.sum(axis=1) + second.sum(axis=1)).reshape(self.bins, 2))

    def centres(self, count: int) -> FloatArray:
        """Times of the windows' centres after the grid's first sample, s, (count,)."""
        return np.asarray((np.arange(count) + 1) * (self.length // 2) * self.step)


@dataclass(frozen=True)
class Moments:
    """Second moments of z per stretch of time and frequency bin; all that the estimator keeps of a recording.

    Attributes
    ----------
    gyro : (B, K, 10, 10) ndarray
        ``sum z_g z_g'`` over the coefficients of stretch b and bin k.
    accelerometer : (B, K, m, m) ndarray
    gyro_squared, accelerometer_squared : ndarray or None
        The same sums with squared window weights; None where every weight is one.
    dof : (B, K) ndarray
        Independent numbers per axis, weights included.
    """

    gyro: FloatArray
    accelerometer: FloatArray
    dof: FloatArray
    gyro_squared: FloatArray | None = None
    accelerometer_squared: FloatArray | None = None

    @property
    def weighted(self) -> bool:
        """Whether windows have weights other than one."""
        return self.gyro_squared is not None

    def scaled(self, factor: float) -> Moments:
        """All window weights multiplied by `factor`."""
        gyro = self.gyro if self.gyro_squared is None else self.gyro_squared
        force = self.accelerometer if self.accelerometer_squared is None else self.accelerometer_squared
        return Moments(
            gyro=factor * self.gyro,
            accelerometer=factor * self.accelerometer,
            dof=factor * self.dof,
            gyro_squared=factor**2 * gyro,
            accelerometer_squared=factor**2 * force,
        )


def stretches(windows: int, most: int) -> IntArray:
    """Stretch of every window when `windows` are cut into at most `most` stretches of two windows and more."""
    count = max(1, min(most, windows // 2))
    return np.asarray(np.arange(windows) * count // max(windows, 1), dtype=np.intp)


def compress(
    windowing: Windowing,
    gyro: FloatArray,
    accelerometer: FloatArray,
    stretch: IntArray,
    weights: FloatArray | None = None,
) -> Moments:
    """Second moments of coefficients (windows, bins, 2, c) of both sensors.

    Parameters
    ----------
    stretch : (windows,) int ndarray
        Ascending; see :func:`stretches`.
    weights : (windows,) ndarray, optional
        Weight of every window (forgetting, robust loss).
    """
    count = int(stretch[-1]) + 1 if stretch.size else 1
    edges = np.searchsorted(stretch, np.arange(count + 1))
    unit = weights is None or bool(np.all(weights == 1.0))
    weight = np.ones(stretch.size) if weights is None else weights
    dof = np.stack([weight[a:b].sum() * windowing.dof for a, b in pairwise(edges)])
    return Moments(
        gyro=_second_moments(gyro, edges, None if unit else weight),
        accelerometer=_second_moments(accelerometer, edges, None if unit else weight),
        dof=dof,
        gyro_squared=None if unit else _second_moments(gyro, edges, weight**2),
        accelerometer_squared=None if unit else _second_moments(accelerometer, edges, weight**2),
    )


def _second_moments(coefficients: FloatArray, edges: IntArray, weights: FloatArray | None) -> FloatArray:
    bins, width = coefficients.shape[1], coefficients.shape[3]
    out = np.zeros((edges.size - 1, bins, width, width))
    for b, (start, stop) in enumerate(pairwise(edges)):
        part = coefficients[start:stop].transpose(1, 0, 2, 3)
        flat = part.reshape(bins, -1, width)
        other = flat if weights is None else flat * np.repeat(weights[start:stop], 2)[None, :, None]
        out[b] = np.matmul(flat.transpose(0, 2, 1), other)
    return out


def finite_windows(*coefficients: FloatArray) -> BoolArray:
    """Which windows hold no NaN in any of the arrays (windows, ...)."""
    good = np.ones(coefficients[0].shape[0], dtype=bool)
    for part in coefficients:
        # One entry a channel is enough: a NaN sample reaches every coefficient of its window.
        good &= np.isfinite(part[:, 0, 0, :]).all(axis=1)
    return good

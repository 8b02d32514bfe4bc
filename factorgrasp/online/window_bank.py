"""Sliding spectral windows and their second moments, in constant memory.

The batch problem's windows (:mod:`factorgrasp.problems.grasp_windows`) start every half window. Here one starts every few rows, so that
new data enter at once, and counts ``2 hop / length`` of a window: the squared tapers of all of them still sum to one.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from factorgrasp.online.coupled_rows import ACCELEROMETER, GYRO, shift_hand
from factorgrasp.problems.grasp_model import GYRO_WIDTH
from factorgrasp.problems.grasp_windows import Moments, Windowing
from factorgrasp.typing import FloatArray

# Stretches of time whose moments are kept apart for the model check. When there are this many, neighbours are merged two by two.
_MOST_STRETCHES = 16
# Forgetting multiplies new weights by a growing factor instead of fading old moments; beyond this exponent everything is scaled back.
_LARGEST_EXPONENT = 20.0


class WindowBank:
    """Moments of one kind of window since the grasp began.

    Parameters
    ----------
    windowing : Windowing
    hop : int
        Rows between windows.
    width : int
        Entries of z_a.
    forgetting_time : float or None
        s.
    robust : bool
        Windows come with weights from a robust loss.
    """

    def __init__(
        self,
        windowing: Windowing,
        hop: int,
        width: int,
        forgetting_time: float | None = None,
        robust: bool = False,
    ) -> None:
        self.windowing, self.hop, self.width = windowing, hop, width
        self.basis = windowing.basis()
        self.share = 2.0 * hop / windowing.length
        self._rate = 0.0 if forgetting_time is None else hop * windowing.step / forgetting_time
        self._weighted = robust or forgetting_time is not None
        self.clear()

    def clear(self) -> None:
        """Forget all moments."""
        K, m = self.windowing.bins, self.width
        self._exponent = 0.0
        self._windows = 0
        self.count = 0.0
        """Half-overlapping windows taken, not faded."""
        self._stretch = max(2, round(2.0 / self.share))
        shape = (_MOST_STRETCHES, 2 if self._weighted else 1)
        self._gyro = np.zeros((*shape, K, GYRO_WIDTH, GYRO_WIDTH))
        self._accelerometer = np.zeros((*shape, K, m, m))
        self._weight = np.zeros(shape)
        self._used = 0  # stretches closed; the next one is being filled
        self._total_gyro = np.zeros((shape[1], K, GYRO_WIDTH, GYRO_WIDTH))
        self._total_accelerometer = np.zeros((shape[1], K, m, m))
        self._total_weight = np.zeros(shape[1])

    @property
    def squares(self) -> bool:
        """Whether windows have weights other than one, so that squared ones are kept too."""
        return self._weighted

    @property
    def weight(self) -> float:
        """Half-overlapping windows that all moments stand for."""
        return float(self._total_weight[0]) * self._scale

    @property
    def seconds(self) -> float:
        """Data that the windows taken stand for, s."""
        return 0.5 * self.count * self.windowing.length * self.windowing.step

    @property
    def _scale(self) -> float:
        return float(np.exp(-self._exponent))

    def coefficients(self, rows: FloatArray) -> FloatArray:
        """Coefficients (N, K, 2, c) of windows that start every `hop` rows; the last one ends with `rows` (n, c)."""
        length = self.windowing.length
        count = (rows.shape[0] - length) // self.hop + 1
        if count == 1:
            out = self.basis @ rows[-length:]
        else:
            rows = rows[rows.shape[0] - length - (count - 1) * self.hop :]
            windows = sliding_window_view(rows, length, axis=0)[:: self.hop]
            out = np.matmul(self.basis, windows.transpose(0, 2, 1))
        return np.asarray(out.reshape(count, self.windowing.bins, 2, rows.shape[1]))

    def add(self, coefficients: FloatArray, trust: FloatArray | None = None) -> None:
        """Take windows in order of time, each with a weight `trust` (N,) from a robust loss."""
        for first in range(0, coefficients.shape[0], self._stretch):
            part = coefficients[first : first + self._stretch]
            self._add(part, None if trust is None else trust[first : first + self._stretch])

    def _add(self, c: FloatArray, trust: FloatArray | None) -> None:
        n = c.shape[0]
        self.count += self.share * n
        gyro, accelerometer = c[..., GYRO], c[..., ACCELEROMETER]
        factors = [np.full(n, self.share)]
        if self._weighted:
            weight = np.exp(self._exponent + self._rate * np.arange(1, n + 1))
            if trust is not None:
                weight *= trust
            factors = [self.share * weight, self.share * weight**2]
            self._exponent += self._rate * n
        for power, factor in enumerate(factors):
            self._total_weight[power] += factor.sum()
            self._weight[self._used, power] += factor.sum()
            for z, total, stretch in (
                (gyro, self._total_gyro, self._gyro),
                (accelerometer, self._total_accelerometer, self._accelerometer),
            ):
                new = _gram(z, factor)
                total[power] += new
                stretch[self._used, power] += new
        self._windows += n
        if self._windows >= self._stretch:
            self._close()
        if self._exponent > _LARGEST_EXPONENT:
            self._rescale()

    def _close(self) -> None:
        self._windows = 0
        self._used += 1
        if self._used < _MOST_STRETCHES:
            return
        half = _MOST_STRETCHES // 2
        for values in (self._gyro, self._accelerometer, self._weight):
            values[:half] = values[0::2] + values[1::2]
            values[half:] = 0.0
        self._used = half
        self._stretch *= 2

    def _rescale(self) -> None:
        for values, totals in (
            (self._gyro, self._total_gyro),
            (self._accelerometer, self._total_accelerometer),
            (self._weight, self._total_weight),
        ):
            for power in range(totals.shape[0]):
                factor = self._scale ** (power + 1)
                values[:, power] *= factor
                totals[power] *= factor
        self._exponent = 0.0

    def shift_clock(self, shift: float) -> None:
        """Read the hand later by `shift` (s), to first order, in all moments."""
        T = np.eye(GYRO_WIDTH + self.width)
        shift_hand(T.T, shift)
        T_g, T_a = T[GYRO, GYRO], T[ACCELEROMETER, ACCELEROMETER]
        for values, change in (
            (self._gyro, T_g),
            (self._total_gyro, T_g),
            (self._accelerometer, T_a),
            (self._total_accelerometer, T_a),
        ):
            values[...] = change @ values @ change.T

    def weighted(
        self, weights: tuple[FloatArray, FloatArray], squared: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Sums over bins (10, 10) and (m, m) of the moments times `weights` (K,) of both sensors."""
        power = int(squared and self._weighted)
        scale = self._scale ** (power + 1)
        K = self.windowing.bins
        gyro = (scale * weights[0]) @ self._total_gyro[power].reshape(K, -1)
        accelerometer = (scale * weights[1]) @ self._total_accelerometer[power].reshape(K, -1)
        return gyro.reshape(GYRO_WIDTH, -1), accelerometer.reshape(self.width, -1)

    def moments(self) -> Moments:
        """The moments by stretch and bin, as the batch problem has them."""
        count = max(self._used + int(self._windows > 0), 1)
        scale = self._scale
        dof = scale * self._weight[:count, 0, None] * self.windowing.dof
        return Moments(
            gyro=scale * self._gyro[:count, 0],
            accelerometer=scale * self._accelerometer[:count, 0],
            dof=dof,
            gyro_squared=scale**2 * self._gyro[:count, 1] if self._weighted else None,
            accelerometer_squared=scale**2 * self._accelerometer[:count, 1] if self._weighted else None,
        )


def _gram(z: FloatArray, weights: FloatArray) -> FloatArray:
    """``sum_n w_n z_n' z_n`` (K, c, c) of coefficients z (N, K, 2, c)."""
    if z.shape[0] == 1:
        return np.asarray(weights[0] * np.matmul(z[0].transpose(0, 2, 1), z[0]))
    flat = z.transpose(1, 0, 2, 3).reshape(z.shape[1], -1, z.shape[3])
    return np.asarray(np.matmul(flat.transpose(0, 2, 1) * np.repeat(weights, 2), flat))

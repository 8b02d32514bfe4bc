"""The motion prior of :mod:`factorgrasp.body_state`: third differences are white, and how large they are follows from the data."""

from __future__ import annotations

import numpy as np

from factorgrasp.typing import FloatArray

BANDWIDTHS = (1.5, 15.0)
"""Hz, between which motion of people ends: below the first nothing is gained, and a sudden move would not be believed."""
STRETCH = 1.2
"""s: motion is not stationary, so that the liveliest stretch of so long decides."""
_GRID = 25
_SHORTEST = 24


def third_difference_band(count: int) -> FloatArray:
    """``D' D`` of the third-difference matrix D (count - 3, count), as its diagonals (4, count): [off, j] stands at (j + off, j)."""
    out = np.zeros((4, count))
    c = np.array([-1.0, 3.0, -3.0, 1.0])
    for off in range(4):
        for k in range(4 - off):
            out[off, k : count - 3 + k] += c[k] * c[k + off]
    return out


def jerk_scale(
    x: FloatArray, variance: FloatArray, dt: float, bandwidth: float | None = None
) -> tuple[FloatArray, FloatArray]:
    """Standard deviation (c,) of third differences of signals (n, c), and the factor (c,) by which their noise exceeds `variance` (c,).

    A prior with white third differences of variance s^2 and white noise of variance r have the same power at the frequency f where
    ``s = sqrt(r) (2 sin(pi f dt))^3``. Without `bandwidth` f is found by Whittle's likelihood of the periodogram of the third
    differences, ``S = s^2 + r (2 sin(w / 2))^6``, together with r, in stretches of :data:`STRETCH`, of which the liveliest decides.
    """
    noise = np.sqrt(np.maximum(variance, 1e-18))

    def of(f: FloatArray | float) -> FloatArray:
        return np.asarray((2.0 * np.sin(np.pi * np.minimum(np.asarray(f) * dt, 0.45))) ** 3)

    if bandwidth is not None:
        return noise * of(bandwidth), np.ones_like(noise)
    third = np.diff(x, n=3, axis=0)
    count = len(third)
    if count < _SHORTEST:
        return noise * of(6.0), np.ones_like(noise)
    size = min(count, max(_SHORTEST, round(STRETCH / dt)))
    starts = np.unique(np.linspace(0, count - size, max(1, 2 * count // size - 1)).astype(int))
    found = [_whittle(third[k : k + size], noise, of(_candidates(dt)) ** 2) for k in starts]
    return np.max([jerk for jerk, _ in found], axis=0), np.median([gain for _, gain in found], axis=0)


def _candidates(dt: float) -> FloatArray:
    f = np.geomspace(*BANDWIDTHS, _GRID)
    return np.asarray(f[f * dt < 0.45])


def _whittle(third: FloatArray, noise: FloatArray, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    count = len(third)
    # A taper: the noise at high frequencies is a million times the motion, and must not leak into it.
    taper = np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 4
    taper /= np.sqrt(np.sum(taper**2))
    inside = np.arange(1, count // 2)
    wave = taper[:, None] * np.exp(-2j * np.pi * np.arange(count)[:, None] * inside / count)
    spectrum = np.abs(wave.T @ third) ** 2
    # What white noise of the signal makes of it, the taper's leakage included.
    padded = np.pad(wave, ((3, 3), (0, 0)))
    shape = np.sum(np.abs(np.diff(padded, n=3, axis=0)) ** 2, axis=0)
    best = np.full(noise.size, np.inf)
    jerk, factor = np.empty_like(noise), np.ones_like(noise)
    for gain in np.geomspace(0.04, 25.0, 29):
        for s2 in scale:
            S = gain * (noise**2)[None] * (s2 + shape[:, None])
            cost = np.sum(np.log(S) + spectrum / S, axis=0)
            better = cost < best
            best = np.where(better, cost, best)
            jerk = np.where(better, noise * np.sqrt(gain * s2), jerk)
            factor = np.where(better, gain, factor)
    return jerk, np.asarray(factor)

"""How smooth a movement is: spectral arc length and log dimensionless jerk of profiles on a uniform clock."""

from __future__ import annotations

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.signals.savgol import choose_savgol, savgol_weights
from factorgrasp.typing import FloatArray

CUTOFF = 10.0
"""Hz; highest frequency that the spectral arc length regards (Balasubramanian et al. 2015)."""
AMPLITUDE = 0.05
"""Share of the largest amplitude below which the spectrum counts as ended (the same)."""

_PADDING = 4
_ORDER = 4


def spectral_arc_length(
    speed: FloatArray, rate: float, cutoff: float = CUTOFF, amplitude: float = AMPLITUDE
) -> float:
    """SPARC of Balasubramanian et al. 2015: minus the arc length of the normalised amplitude spectrum; nearer to 0 is smoother.

    Parameters
    ----------
    speed : ndarray, shape (n,)
        Of one movement, from its onset to its end, uniformly sampled.
    rate : float
        Hz.
    cutoff : float
        Hz; half of the rate when that is lower.
    amplitude : float
        Share of the largest amplitude; the spectrum counts up to the last frequency that reaches it.

    Returns
    -------
    float
        Dimensionless. A whole minimum-jerk movement has -1.41.

    Raises
    ------
    InputError
        For fewer than four samples.
    """
    s = np.asarray(speed, dtype=np.float64)
    if s.ndim != 1 or s.size < 4:
        raise InputError("speed", "at least 4 samples, shape (n,)", f"shape {s.shape}")
    size = int(2 ** (np.ceil(np.log2(s.size)) + _PADDING))
    spectrum = np.abs(np.fft.rfft(s, size))
    f = np.arange(spectrum.size) * rate / size
    spectrum = (spectrum / spectrum.max())[f <= min(cutoff, 0.5 * rate)]
    above = np.flatnonzero(spectrum >= amplitude)
    kept = spectrum[above[0] : above[-1] + 1]
    if kept.size < 2:
        return 0.0
    return float(-np.sum(np.hypot(1.0 / (kept.size - 1), np.diff(kept))))


def low_pass(values: FloatArray, rate: float, bandwidth: float) -> FloatArray:
    """Uniform samples (..., n, c) up to a frequency (Hz, where the gain is -3 dB), by local polynomials of order 4.

    NaN where a window touches an end or a NaN.
    """
    dt = 1.0 / rate
    window = choose_savgol(min(bandwidth, 0.45 * rate), dt, _ORDER)
    return _correlated(values, savgol_weights(window, _ORDER, 0, dt))


def second_derivative(values: FloatArray, rate: float, bandwidth: float) -> FloatArray:
    """Second derivative of uniform samples (..., n, c) up to a frequency (Hz, where the gain is -3 dB).

    By the second derivative of a Gaussian: a local polynomial would let through a good part of the noise above the bandwidth. NaN where
    the window touches an end or a NaN.
    """
    dt = 1.0 / rate
    width = np.sqrt(np.log(2.0)) / (2.0 * np.pi * min(bandwidth, 0.25 * rate))
    half = max(2, int(np.ceil(4.0 * width * rate)))
    x = np.arange(-half, half + 1) * dt
    weights = ((x / width) ** 2 - 1.0) * np.exp(-0.5 * (x / width) ** 2)
    # Exact for parabolas, however coarse the samples are.
    weights -= weights.mean()
    return _correlated(values, weights / (0.5 * weights @ x**2))


def _correlated(values: FloatArray, weights: FloatArray) -> FloatArray:
    v = np.asarray(values, dtype=np.float64)
    out = np.full_like(v, np.nan)
    half = weights.size // 2
    if v.shape[-2] >= weights.size:
        windows = np.lib.stride_tricks.sliding_window_view(v, weights.size, axis=-2)
        out[..., half : v.shape[-2] - half, :] = windows @ weights
    return out


def log_dimensionless_jerk(jerk: FloatArray, rate: float, peak_speed: float) -> float:
    """``-ln(T^3 / v^2 * integral of |jerk|^2)``; larger is smoother.

    Parameters
    ----------
    jerk : ndarray, shape (n, 3)
        m/s^3, of one movement from its onset to its end.
    rate : float
        Hz.
    peak_speed : float
        v, m/s.

    Returns
    -------
    float
        Dimensionless. A whole minimum-jerk movement of any size has ``-ln(204.8) = -5.32``.
    """
    j = np.asarray(jerk, dtype=np.float64)
    duration = (len(j) - 1) / rate
    energy = float(np.trapezoid(np.sum(j**2, axis=1), dx=1.0 / rate))
    return float(-np.log(duration**3 * energy / peak_speed**2))

"""Savitzky-Golay filters: derivatives of uniformly sampled signals, with their response and noise gain."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray


def check_settings(window: int, order: int, deriv: int, dt: float) -> None:
    """Raise when no Savitzky-Golay filter has these settings."""
    if window < 1 or window % 2 == 0:
        raise InputError("window", "an odd number of samples", repr(window))
    if not 0 <= order < window:
        raise InputError("order", f"a polynomial order from 0 to window - 1 = {window - 1}", repr(order))
    if not 0 <= deriv <= order:
        raise InputError("deriv", f"a derivative from 0 to the polynomial order {order}", repr(deriv))
    if not (np.isfinite(dt) and dt > 0.0):
        raise InputError("dt", "a positive time step [s]", repr(dt))


@lru_cache(maxsize=256)
def savgol_weights(window: int, order: int, deriv: int, dt: float) -> FloatArray:
    """Weights ``c_j`` in ``y_k = sum_j c_j x_{k+j}``, ``j = -(window // 2) ... window // 2``."""
    check_settings(window, order, deriv, dt)
    # Here and not above: scipy.signal takes longer to import than the rest of the library.
    from scipy.signal import savgol_coeffs

    weights = np.asarray(savgol_coeffs(window, order, deriv=deriv, delta=dt, use="dot"), dtype=np.float64)
    weights.setflags(write=False)
    return weights


def correlate_centred(x: FloatArray, weights: FloatArray, n: int) -> FloatArray:
    """Correlate each column of ``x`` with ``weights``, centred in ``n`` rows; NaN where data are missing."""
    out = np.full((n, x.shape[1]), np.nan)
    rows = x.shape[0] - weights.size + 1
    first = (n - rows) // 2
    kernel = weights[::-1]
    # Direct sums on purpose: an FFT would spread one NaN over everything and the signal's offset over its
    # derivative.
    for column in range(x.shape[1]):
        out[first : first + rows, column] = np.convolve(
            np.ascontiguousarray(x[:, column]), kernel, mode="valid"
        )
    return out


def savgol_derivatives(x: npt.ArrayLike, dt: float, window: int, order: int, deriv: int) -> FloatArray:
    """Derivative of uniformly sampled signals by a local polynomial fit (Savitzky and Golay 1964).

    Parameters
    ----------
    x : array_like, shape (n,) or (n, c)
        Uniform samples; NaN marks a gap.
    dt : float
        Sampling step (s).
    window : int
        Odd number of samples in a fit.
    order : int
        Order of the polynomial.
    deriv : int
        0 smooths, 1 gives the first derivative (unit of x per s), and so on.

    Returns
    -------
    ndarray, shape of ``x``
        NaN wherever the window touches a gap or an end of the recording: nothing is extrapolated.

    Raises
    ------
    InputError
        On an even window, an order or a derivative that do not fit, or fewer samples than one window.
    """
    values = np.asarray(x, dtype=np.float64)
    if values.ndim not in (1, 2):
        raise InputError("x", "shape (n,) or (n, channels)", f"shape {values.shape}")
    c = savgol_weights(int(window), int(order), int(deriv), float(dt))
    if values.shape[0] < window:
        raise InputError("x", f"at least one window of {window} samples", f"{values.shape[0]} samples")
    if values.ndim == 1:
        return correlate_centred(values[:, None], c, values.shape[0])[:, 0]
    return correlate_centred(values, c, values.shape[0])


def savgol_frequency_response(
    window: int, order: int, deriv: int, dt: float, f: npt.ArrayLike
) -> npt.NDArray[np.complex128]:
    """Complex gain ``H(f) = sum_j c_j exp(i 2 pi f j dt)`` of :func:`savgol_derivatives`; ``f`` in Hz.

    An input with (two-sided) power spectral density ``S(f)`` comes out with ``|H(f)|^2 S(f)``.
    """
    c = savgol_weights(int(window), int(order), int(deriv), float(dt))
    half = window // 2
    angle = 2.0 * np.pi * dt * np.asarray(f, dtype=np.float64)[..., None] * np.arange(-half, half + 1)
    # Even and odd weights apart: the gain of a smoother is exactly real, of a first derivative exactly
    # imaginary.
    even, odd = 0.5 * (c + c[::-1]), 0.5 * (c - c[::-1])
    out: npt.NDArray[np.complex128] = np.cos(angle) @ even + 1j * (np.sin(angle) @ odd)
    return out


def savgol_noise_gain(window: int, order: int, deriv: int, dt: float) -> float:
    """Output variance for white input noise of variance 1: ``sum_j c_j^2`` (1/s^2 to the power ``deriv``)."""
    c = savgol_weights(int(window), int(order), int(deriv), float(dt))
    return float(c @ c)


def savgol_bandwidth(window: int, order: int, dt: float, deriv: int = 0) -> float:
    """Frequency (Hz), up to ``0.5 / dt``, where the gain relative to an ideal derivative falls to -3 dB."""
    return _savgol_bandwidth(int(window), int(order), float(dt), int(deriv))


@lru_cache(maxsize=1024)
def _savgol_bandwidth(window: int, order: int, dt: float, deriv: int) -> float:
    def relative(f: npt.ArrayLike) -> FloatArray:
        f = np.asarray(f, dtype=np.float64)
        gain = np.abs(savgol_frequency_response(window, order, deriv, dt, f))
        return np.asarray(gain / np.abs(2.0 * np.pi * f) ** deriv)

    nyquist = 0.5 / dt
    # Lobes are at least a full period of the window wide; 16 points in each cannot miss the first crossing.
    grid = np.linspace(0.0, nyquist, 8 * window + 2)[1:]
    below = relative(grid) < np.sqrt(0.5)
    if not below.any():
        return nyquist
    k = int(np.argmax(below))
    low, high = (0.0 if k == 0 else float(grid[k - 1])), float(grid[k])
    for _ in range(60):
        middle = 0.5 * (low + high)
        if relative(middle) < np.sqrt(0.5):
            high = middle
        else:
            low = middle
    return high


def choose_savgol(bandwidth_hz: float, dt: float, order: int, deriv: int = 0) -> int:
    """The longest odd window whose -3 dB bandwidth is at least ``bandwidth_hz``.

    Raises
    ------
    InputError
        If the bandwidth is not between 0 and half the sampling rate.
    """
    nyquist = 0.5 / dt
    if not 0.0 < bandwidth_hz <= nyquist:
        raise InputError("bandwidth_hz", f"a bandwidth above 0 and up to {nyquist:g} Hz", repr(bandwidth_hz))
    shortest = order + 1 + order % 2
    # Bandwidth falls with length like (order + 1) / window, so doubling and then halving finds the end.
    low = shortest
    step = 2
    while savgol_bandwidth(low + step, order, dt, deriv) >= bandwidth_hz:
        low += step
        step *= 2
    while step > 2:
        step //= 2
        if savgol_bandwidth(low + step, order, dt, deriv) >= bandwidth_hz:
            low += step
    return low

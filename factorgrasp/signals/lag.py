"""Time offset between two signals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray

# Two signals must share this part of the shorter one's samples for a lag to be considered.
SMALLEST_OVERLAP = 0.25


@dataclass(frozen=True)
class LagEstimate:
    """What :func:`estimate_lag` found.

    Attributes
    ----------
    lag : float
        Time (s) by which the second signal is late: ``y(t + lag)`` looks like ``x(t)``.
    correlation : float
        Pearson correlation at the peak, from -1 to 1.
    ambiguity : float
        The second highest peak over the highest, 0 to 1: near 1 the motion is periodic and the lag one of
        several.
    at_limit : bool
        The correlation is highest at the end of the search: the true lag lies beyond ``max_lag``, or there is
        none.
    """

    lag: float
    correlation: float
    ambiguity: float
    at_limit: bool


def estimate_lag(x: npt.ArrayLike, y: npt.ArrayLike, dt: float, max_lag: float) -> LagEstimate:
    """Time offset between two scalar signals by normalised cross-correlation.

    Parameters
    ----------
    x, y : array_like, shape (n,)
        Signals on the same uniform grid, for instance the norms of two angular velocities; NaN marks a gap.
    dt : float
        Sampling step (s).
    max_lag : float
        Largest offset (s) to consider, either way.

    Returns
    -------
    LagEstimate
        ``y(t + lag)`` is like ``x(t)``: a positive lag means that ``y`` is late, and ``y.shifted(-lag)``
        mends it.

    Raises
    ------
    InputError
        When the signals hardly overlap or do not vary.

    Notes ----- For every lag the Pearson correlation of the pairs that exist on both sides, so neither gaps
    nor offsets nor the triangular overlap bias it; a parabola through the peak gives the fraction of a step.
    """
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if a.ndim != 1 or a.shape != b.shape:
        raise InputError("x, y", "two signals of the same shape (n,)", f"shapes {a.shape} and {b.shape}")
    if not (np.isfinite(dt) and dt > 0.0):
        raise InputError("dt", "a positive time step [s]", repr(dt))
    if not max_lag >= dt:
        raise InputError("max_lag", f"at least one step, {dt:g} s", repr(max_lag))
    reach = min(int(max_lag / dt + 1e-6), a.size - 1)
    r = _correlation_by_lag(a, b, reach)
    if np.isnan(r).all():
        raise InputError("x, y", "signals that vary and overlap", "constant, or hardly any common samples")
    peak = int(np.nanargmax(r))
    before = r[peak - 1] if peak > 0 else np.nan
    after = r[peak + 1] if peak + 1 < r.size else np.nan
    at_limit = bool(np.isnan(before) or np.isnan(after))
    shift, top = 0.0, float(r[peak])
    if not at_limit:
        bend = before - 2.0 * r[peak] + after
        if bend < 0.0:
            shift = float(0.5 * (before - after) / bend)
            top = float(r[peak] - 0.25 * (before - after) * shift)
    inner = r[1:-1]
    peaks = np.flatnonzero((inner > r[:-2]) & (inner >= r[2:])) + 1
    others = r[peaks[np.abs(peaks - peak) > 1]]
    second = float(others.max()) if others.size else 0.0
    ambiguity = min(max(second, 0.0) / top, 1.0) if top > 0.0 else 1.0
    return LagEstimate((peak - reach + shift) * dt, min(top, 1.0), ambiguity, at_limit)


def _correlation_by_lag(a: FloatArray, b: FloatArray, reach: int) -> FloatArray:
    """Pearson correlation of ``a_k`` with ``b_{k+lag}``, lag = -reach ... reach; NaN where pairs are too few."""
    from scipy import fft

    ma, mb = np.isfinite(a), np.isfinite(b)
    na, nb = int(ma.sum()), int(mb.sum())
    if min(na, nb) < 2:
        return np.full(2 * reach + 1, np.nan)
    # Centred and scaled first: the moments below are differences of large sums otherwise.
    a = np.where(ma, a - a[ma].mean(), 0.0)
    b = np.where(mb, b - b[mb].mean(), 0.0)
    scale_a, scale_b = np.sqrt(a @ a / na), np.sqrt(b @ b / nb)
    if not (scale_a > 0.0 and scale_b > 0.0):
        return np.full(2 * reach + 1, np.nan)
    a, b = a / scale_a, b / scale_b
    size = fft.next_fast_len(a.size + reach + 1, real=True)
    left = np.conj(fft.rfft(np.stack([ma.astype(np.float64), a, a * a]), size, axis=1))
    right = fft.rfft(np.stack([mb.astype(np.float64), b, b * b]), size, axis=1)
    products = np.stack(
        [
            left[0] * right[0],
            left[1] * right[0],
            left[0] * right[1],
            left[2] * right[0],
            left[0] * right[2],
            left[1] * right[1],
        ]
    )
    sums = np.roll(fft.irfft(products, size, axis=1), reach, axis=1)[:, : 2 * reach + 1]
    count = np.rint(sums[0])
    enough = count >= max(2.0, SMALLEST_OVERLAP * min(na, nb))
    pairs = np.where(enough, count, 1.0)
    mean_a, mean_b = sums[1] / pairs, sums[2] / pairs
    var_a, var_b = sums[3] / pairs - mean_a**2, sums[4] / pairs - mean_b**2
    # Where one side hardly varies over the overlap its correlation is noise over noise.
    enough &= (var_a > 1e-6) & (var_b > 1e-6)
    safe = np.sqrt(np.where(enough, var_a * var_b, 1.0))
    out: FloatArray = np.where(enough, (sums[5] / pairs - mean_a * mean_b) / safe, np.nan)
    return out

"""Several sources with rates and gaps of their own, brought onto one clock."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.signals.resampling import GAP_IN_STEPS, resample_uniform
from factorgrasp.typing import BoolArray, FloatArray

# A source this much faster than the clock is averaged over the clock's step, not sampled: sampling would throw its other samples away and
# fold what is above half the clock's rate into the result.
_FASTER = 1.5
# Share of a step's samples that must be there for an average to count.
_ENOUGH = 0.5


def common_clock(times: Mapping[str, npt.ArrayLike], rate: float) -> FloatArray:
    """A uniform clock over the time that all sources cover.

    Parameters
    ----------
    times : mapping of str to array_like, shape (n,)
        Stamps (s) by source.
    rate : float
        Hz.

    Raises
    ------
    InputError
        When the sources do not overlap; it names the two that lie apart.
    """
    if not (np.isfinite(rate) and rate > 0.0):
        raise InputError("rate", "a positive rate [Hz]", repr(rate))
    spans = {name: (float(np.min(t)), float(np.max(t))) for name, t in times.items()}
    if not spans:
        raise InputError("sources", "at least one", "none")
    late = max(spans, key=lambda name: spans[name][0])
    early = min(spans, key=lambda name: spans[name][1])
    start, end = spans[late][0], spans[early][1]
    if end - start < 1.0 / rate:
        raise InputError(
            "sources",
            "recordings that overlap",
            f"{early} ends at {end:.6g} s, {late} begins at {start:.6g} s",
            "One clock?",
        )
    return np.asarray(start + np.arange(int((end - start) * rate + 1e-6) + 1) / rate)


def synchronise(
    clock: npt.ArrayLike,
    sources: Mapping[str, tuple[npt.ArrayLike, npt.ArrayLike]],
    *,
    max_gap: float | None = None,
) -> dict[str, FloatArray]:
    """Values of several sources at the times of one clock; a gap stays a gap.

    Parameters
    ----------
    clock : array_like, shape (m,)
        Increasing times (s), uniform or not.
    sources : mapping of str to (t, x)
        Stamps (n,) in s, and samples (n,) or (n, c); a row with a NaN is missing as a whole.
    max_gap : float, optional
        Longest time (s) between two good samples that is bridged; by default three median steps of the source.

    Returns
    -------
    dict of str to ndarray, shape (m,) or (m, c)
        NaN inside gaps and outside the source's recording. A source up to one and a half times as fast as the clock is interpolated
        linearly. A faster one is averaged: a straight line through its samples within half a step of the clock on either side,
        where at least half of them are there.
    """
    points = np.asarray(clock, dtype=np.float64)
    if points.ndim != 1 or points.size < 1 or not np.isfinite(points).all() or (np.diff(points) <= 0.0).any():
        raise InputError("clock", "finite, increasing times of shape (m,) [s]", f"shape {points.shape}")
    out = {}
    for name, (t, x) in sources.items():
        stamps, values = np.asarray(t, dtype=np.float64), np.asarray(x, dtype=np.float64)
        step = float(np.median(np.diff(points))) if points.size > 1 else 0.0
        try:
            if stamps.size > 1 and step > _FASTER * float(np.median(np.diff(stamps))):
                out[name] = _averaged(points, step, stamps, values, max_gap)
            else:
                out[name] = resample_uniform(stamps, values, points, max_gap=max_gap)[1]
        except InputError as error:
            raise InputError(f"{name}: {error.field}", error.expected, error.found, error.hint) from error
    return out


def _averaged(
    points: FloatArray, step: float, t: FloatArray, x: FloatArray, max_gap: float | None
) -> FloatArray:
    """A line through the samples within half a step, at every point."""
    if x.ndim not in (1, 2) or t.shape != x.shape[:1]:
        raise InputError("samples", f"shape ({t.size},) or ({t.size}, channels)", f"shape {x.shape}")
    if not (np.diff(t) > 0.0).all():
        raise InputError("t", "strictly increasing times [s]", "something else")
    rows = x[:, None] if x.ndim == 1 else x
    own = float(np.median(np.diff(t)))
    low = np.searchsorted(t, points - 0.5 * step, side="left")
    # The most samples that any step has; stamps may jitter.
    high = np.searchsorted(t, points + 0.5 * step, side="right")
    width = max(int(np.max(high - low)), 1)
    index = low[:, None] + np.arange(width)
    inside = index < t.size
    index = np.minimum(index, t.size - 1)
    inside &= np.abs(t[index] - points[:, None]) <= 0.5 * step * (1.0 + 1e-9)
    complete: BoolArray = np.asarray(np.isfinite(rows).all(axis=1))
    inside &= complete[index]
    count = inside.sum(axis=1)
    weight = inside / np.maximum(count, 1)[:, None]
    away = t[index] - points[:, None]
    mean_t = (weight * away).sum(axis=1)
    samples = np.where(inside[:, :, None], rows[index], 0.0)
    mean_x = np.einsum("mk,mkc->mc", weight, samples)
    centred = np.where(inside, away - mean_t[:, None], 0.0)
    power = (centred**2).sum(axis=1)
    slope = np.einsum("mk,mkc->mc", centred, samples) / np.where(power > 0.0, power, 1.0)[:, None]
    out = mean_x - slope * mean_t[:, None]
    longest = GAP_IN_STEPS * own if max_gap is None else max_gap
    # Half of the samples may all lie on one side of a gap: then the line would be drawn beyond them.
    nearest = np.where(inside, np.abs(away), np.inf).min(axis=1)
    lost = (count < max(_ENOUGH * step / own, 1.0)) | (nearest > 0.5 * longest)
    out[lost] = np.nan
    return np.asarray(out[:, 0] if x.ndim == 1 else out)

"""Averages over consecutive samples: one linear filter for every entry of z, which keeps the relations exact."""

from __future__ import annotations

import numpy as np

from factorgrasp.typing import FloatArray

# Samples a second that z keeps for every Hz of bandwidth; enough that vibration does not fold into the band.
_RATE_OVER_BANDWIDTH = 10.0


def averaged_samples(step: float, bandwidth: float) -> int:
    """How many samples of a grid with this step (s) one entry of z averages, for relations used up to `bandwidth` (Hz)."""
    return max(1, int(1.0 / (step * _RATE_OVER_BANDWIDTH * bandwidth) + 1e-6))


def average(x: FloatArray, samples: int) -> FloatArray:
    """Means (n // samples, c) of consecutive samples of x (n, c); a NaN spoils its mean."""
    if samples == 1:
        return x
    count = x.shape[0] // samples
    return np.asarray(x[: count * samples].reshape(count, samples, -1).mean(axis=1))

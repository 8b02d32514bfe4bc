"""White noise on smooth signals, from what is too fast to be motion."""

from __future__ import annotations

from math import comb

import numpy as np

from factorgrasp import lie
from factorgrasp.typing import FloatArray

# Sixth differences: motion sampled at ten times its bandwidth leaves 1e-4 of itself in them.
_ORDER = 6
# A few thousand differences from all over a recording tell as much as all of them.
_BLOCK, _BLOCKS = 512, 16
# Median of |x| of a normal variable, in standard deviations.
_MEDIAN = 0.6745


def white_noise_sd(x: FloatArray) -> float:
    """Standard deviation of the white noise on uniformly sampled smooth signals.

    Parameters
    ----------
    x : (n, c) ndarray
        The channels share one noise level; rows with NaN are gaps.

    Returns
    -------
    float
        In the unit of x; 0 when there are too few samples to tell.
    """
    return _spread(_fast(x, _ORDER))


def rotation_noise_sd(rotation_wxyz: FloatArray) -> float:
    """Standard deviation (rad, per axis) of the white noise on uniformly sampled rotations.

    Parameters
    ----------
    rotation_wxyz : (n, 4) ndarray
        Unit quaternions [w, x, y, z]; rows with NaN are gaps.
    """
    steps = lie.quaternion_log_wxyz(
        lie.quaternion_multiply_wxyz(lie.quaternion_conjugate(rotation_wxyz[:-1]), rotation_wxyz[1:])
    )
    # The step is one difference of the noise already.
    return _spread(_fast(steps, _ORDER - 1))


def _fast(x: FloatArray, order: int) -> FloatArray:
    starts = np.unique(np.linspace(0, max(x.shape[0] - _BLOCK, 0), _BLOCKS).astype(int))
    differences = np.concatenate([np.diff(x[start : start + _BLOCK], n=order, axis=0) for start in starts])
    return np.asarray(differences[np.isfinite(differences).all(axis=1)])


def _spread(differences: FloatArray) -> float:
    if differences.shape[0] < 10:
        return 0.0
    return float(np.median(np.abs(differences)) / _MEDIAN / np.sqrt(comb(2 * _ORDER, _ORDER)))

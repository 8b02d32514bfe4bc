"""How another lamp shifts colours: along the curve of black bodies, whatever the scene is made of."""

from __future__ import annotations

import numpy as np

from factorgrasp.typing import FloatArray
from factorgrasp.vision.images import LOG_LIGHT, LOG_STEPS, ByteImage

_WAVELENGTHS = np.array([610e-9, 550e-9, 465e-9])
"""Of red, green and blue, m."""
_PLANCK = 1.438777e-2
"""Second radiation constant, m K."""
_MIRED = np.arange(-110.0, 300.0, 10.0)
"""Changes of the lamp, in millionths of 1/K, from 6500 K."""
_FAR = 0.35
"""A difference that far from the curve (log chroma) is one of the scene, not of the lamp."""
NOTICEABLE = 0.3
"""Shifts that a reference colour does not bear by itself, log chroma."""


def _curve() -> FloatArray:
    """Shift (k, 2) of log(red / green) and log(blue / green) for each change of the lamp."""
    inverse = 1.0 / 6500.0 + 1e-6 * _MIRED
    power = -np.log(np.expm1(_PLANCK / _WAVELENGTHS * inverse[:, None]))
    power = power + np.log(np.expm1(_PLANCK / (_WAVELENGTHS * 6500.0)))
    return np.column_stack([power[:, 0] - power[:, 1], power[:, 2] - power[:, 1]])


_CURVE = _curve()


def mean_chroma(rgb: ByteImage) -> FloatArray:
    """Mean (2,) log chroma of an image, every 64th pixel looked at."""
    logs = LOG_LIGHT[rgb[::8, ::8].reshape(-1, 3)].astype(float).mean(axis=0) / LOG_STEPS
    return np.array([logs[0] - logs[1], logs[2] - logs[1]])


def light_shift(change: FloatArray) -> FloatArray:
    """The shift (2,) of a lamp that explains a change of the mean colour best; zero when none does."""
    away = np.linalg.norm(_CURVE - change, axis=1)
    best = int(np.argmin(away))
    return _CURVE[best].copy() if away[best] < _FAR else np.zeros(2)

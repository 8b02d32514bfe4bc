"""Resampling, differentiation and time offset of recorded signals.

Two rules hold throughout. A gap stays a gap: whatever would need a missing sample is NaN. And every filter is a
plain linear one with a known response, so that noise can be propagated through it
(:func:`savgol_frequency_response`, :func:`savgol_noise_gain`) and the same filter can be applied to every entry of a
linear relation.
"""

from factorgrasp.signals.lag import LagEstimate, estimate_lag
from factorgrasp.signals.resampling import resample_rotations, resample_uniform
from factorgrasp.signals.rotations import RotationDerivatives, differentiate_rotations
from factorgrasp.signals.savgol import (
    choose_savgol,
    savgol_bandwidth,
    savgol_derivatives,
    savgol_frequency_response,
    savgol_noise_gain,
)

__all__ = [
    "LagEstimate",
    "RotationDerivatives",
    "choose_savgol",
    "differentiate_rotations",
    "estimate_lag",
    "resample_rotations",
    "resample_uniform",
    "savgol_bandwidth",
    "savgol_derivatives",
    "savgol_frequency_response",
    "savgol_noise_gain",
]

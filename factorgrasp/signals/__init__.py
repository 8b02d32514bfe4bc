"""Resampling, differentiation and time offset of recorded signals.

Two rules hold throughout. A gap stays a gap: whatever would need a missing sample is NaN. And every filter is a
plain linear one with a known response, so that noise can be propagated through it
(:func:`savgol_frequency_response`, :func:`savgol_noise_gain`) and the same filter can be applied to every entry of a
linear relation.
"""

from factorgrasp.signals.clock import common_clock, synchronise
from factorgrasp.signals.lag import LagEstimate, estimate_lag
from factorgrasp.signals.noise import rotation_noise_sd, white_noise_sd
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
    "common_clock",
    "differentiate_rotations",
    "estimate_lag",
    "resample_rotations",
    "resample_uniform",
    "rotation_noise_sd",
    "savgol_bandwidth",
    "savgol_derivatives",
    "savgol_frequency_response",
    "savgol_noise_gain",
    "synchronise",
    "white_noise_sd",
]

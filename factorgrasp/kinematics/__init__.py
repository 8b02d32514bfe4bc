"""Kinematic measures: anatomical angles, ranges of motion, movements and their smoothness, with uncertainties."""

from factorgrasp.kinematics.angles import (
    angle_covariance,
    angle_jacobian,
    euler_zyz,
    isb_angles,
    isb_signs,
    wrist_angles,
    wrist_rotation,
)
from factorgrasp.kinematics.measure import Measure
from factorgrasp.kinematics.range_of_motion import RangeOfMotion, range_of_motion
from factorgrasp.kinematics.reaching import Movement, movements
from factorgrasp.kinematics.smoothness import log_dimensionless_jerk, spectral_arc_length
from factorgrasp.kinematics.track_errors import TrackSamples, sample_tracks
from factorgrasp.kinematics.wrist_measures import WristMeasures, wrist_measures

__all__ = [
    "Measure",
    "Movement",
    "RangeOfMotion",
    "TrackSamples",
    "WristMeasures",
    "angle_covariance",
    "angle_jacobian",
    "euler_zyz",
    "isb_angles",
    "isb_signs",
    "log_dimensionless_jerk",
    "movements",
    "range_of_motion",
    "sample_tracks",
    "spectral_arc_length",
    "wrist_angles",
    "wrist_measures",
    "wrist_rotation",
]

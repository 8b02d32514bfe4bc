"""Anatomical angles of the wrist from its rotation, with covariance.

Frame ``W``: x along the hand to the middle finger, z out of its back, y to the left of someone who looks along the fingers with the back
of the hand up. The rotation out of the neutral posture is read as ``R_W0_W = R_y(flexion) R_z(deviation) R_x(pronation)``: flexion about
the proximal segment's axis, pronation about the hand's own, deviation about the floating one, which is the order of the joint coordinate
system of Wu et al. 2005 (ISB, part II, 4.4.1). It is singular only at a deviation of 90 degrees, which no wrist reaches.

The three rotations have the signs of their axes. :func:`isb_angles` gives them anatomical signs, which differ between hands: flexion,
ulnar deviation and pronation are positive.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.lie import so3_exp
from factorgrasp.typing import FloatArray

Hand: TypeAlias = Literal["right", "left"]
Facing: TypeAlias = Literal["back", "palm"]
"""The side of the hand out of which z of ``W`` points: that which bears the markers."""

ISB_NAMES = ("flexion", "ulnar_deviation", "pronation")
"""What is positive in :func:`isb_angles`."""
OPPOSITES = ("extension", "radial_deviation", "supination")
"""What is negative there."""
AXES = ("flexion_extension", "radial_ulnar_deviation", "pronation_supination")

_SIGNS: dict[str, tuple[float, float, float]] = {
    # With the back of the right hand up, the thumb is on the left: turning left about z is radial, turning the left side up is supination.
    "right": (1.0, -1.0, -1.0),
    "left": (1.0, 1.0, 1.0),
}
_SINGULAR = 1e-6


def wrist_angles(rotation: npt.ArrayLike) -> FloatArray:
    """Rotations about y, z and x: ``[flexion, deviation, pronation]`` (rad).

    ``deviation = asin(R10)``, ``flexion = atan2(-R20, R00)``, ``pronation = atan2(-R12, R11)``.

    Parameters
    ----------
    rotation : array_like, shape (..., 3, 3)
        ``R_W0_W``.

    Returns
    -------
    ndarray, shape (..., 3)
        Flexion and pronation in (-pi, pi], deviation in [-pi/2, pi/2]; NaN where the rotation is NaN.
    """
    R = _rotations(rotation)
    out = np.empty(R.shape[:-1])
    out[..., 0] = np.arctan2(-R[..., 2, 0], R[..., 0, 0])
    # asin loses half of the digits near 90 degrees; the hypotenuse does not.
    out[..., 1] = np.arctan2(R[..., 1, 0], np.hypot(R[..., 0, 0], R[..., 2, 0]))
    out[..., 2] = np.arctan2(-R[..., 1, 2], R[..., 1, 1])
    return out


def wrist_rotation(angles: npt.ArrayLike) -> FloatArray:
    """``R_y(flexion) R_z(deviation) R_x(pronation)`` of angles (..., 3) in rad: shape (..., 3, 3)."""
    a = np.asarray(angles, dtype=np.float64)
    y, z, x = np.eye(3)[[1, 2, 0]]
    out: FloatArray = so3_exp(a[..., :1] * y) @ so3_exp(a[..., 1:2] * z) @ so3_exp(a[..., 2:] * x)
    return out


def isb_signs(hand: Hand, facing: Facing = "back") -> FloatArray:
    """Factors (3,) from :func:`wrist_angles` to flexion, ulnar deviation and pronation of this hand.

    Raises
    ------
    InputError
        For a hand that is neither "right" nor "left", or a side of it that is neither "back" nor "palm".
    """
    if hand not in _SIGNS:
        raise InputError("hand", "'right' or 'left'", repr(hand))
    if facing not in ("back", "palm"):
        raise InputError("facing", "'back' or 'palm'", repr(facing))
    # With z out of the palm, y and z are turned round, and x is not.
    return np.array(_SIGNS[hand]) * ((1.0, 1.0, 1.0) if facing == "back" else (-1.0, -1.0, 1.0))


def isb_angles(rotation: npt.ArrayLike, hand: Hand = "right", facing: Facing = "back") -> FloatArray:
    """Flexion, ulnar deviation, pronation (rad), positive in the direction of their names: shape (..., 3).

    Parameters
    ----------
    rotation : array_like, shape (..., 3, 3)
        ``R_W0_W``.
    hand : {"right", "left"}
    facing : {"back", "palm"}
        The side of the hand out of which z of ``W`` points.
    """
    return isb_signs(hand, facing) * wrist_angles(rotation)


def angle_jacobian(rotation: npt.ArrayLike) -> FloatArray:
    """Derivative of :func:`wrist_angles` by the right perturbation ``R Exp(d)``: (..., 3, 3); NaN at the singular deviation.

    The same matrix turns the angular velocity in ``W`` into the rates of the angles.
    """
    R = _rotations(rotation)
    angles = wrist_angles(R)
    pronation, deviation = angles[..., 2], angles[..., 1]
    c, s, cd = np.cos(pronation), np.sin(pronation), np.cos(deviation)
    safe = np.where(np.abs(cd) > _SINGULAR, cd, np.nan)
    # w = R_x' (R_z' e_y flexion' + e_z deviation') + e_x pronation', solved for the rates.
    J = np.zeros_like(R)
    J[..., 0, 1], J[..., 0, 2] = c / safe, -s / safe
    J[..., 1, 1], J[..., 1, 2] = s, c
    J[..., 2, 0] = 1.0
    J[..., 2, 1], J[..., 2, 2] = -np.sin(deviation) * c / safe, np.sin(deviation) * s / safe
    return J


def angle_covariance(rotation: npt.ArrayLike, covariance: npt.ArrayLike) -> FloatArray:
    """Covariance (..., 3, 3) of :func:`wrist_angles` (rad^2), to first order.

    Parameters
    ----------
    rotation : array_like, shape (..., 3, 3)
    covariance : array_like, shape (..., 3, 3)
        Of the right perturbation ``R Exp(d)`` (rad^2), in ``W``.
    """
    J = angle_jacobian(rotation)
    out: FloatArray = J @ np.asarray(covariance, dtype=np.float64) @ np.swapaxes(J, -1, -2)
    return out


def euler_zyz(rotation: npt.ArrayLike) -> FloatArray:
    """Angles (..., 3), rad, of ``R = R_z(a) R_y(b) R_z(c)``, b in [0, pi], as Cordella 2014 parametrises the wrist.

    Singular at b = 0, which is the neutral posture: only a + c is determined there, and c is 0 by convention. For reading, not for
    estimation.
    """
    R = _rotations(rotation)
    sine = np.hypot(R[..., 0, 2], R[..., 1, 2])
    regular = sine > _SINGULAR
    out = np.empty(R.shape[:-1])
    out[..., 0] = np.where(
        regular, np.arctan2(R[..., 1, 2], R[..., 0, 2]), np.arctan2(R[..., 1, 0], R[..., 1, 1])
    )
    out[..., 1] = np.arctan2(sine, R[..., 2, 2])
    out[..., 2] = np.where(regular, np.arctan2(R[..., 2, 1], -R[..., 2, 0]), 0.0)
    return out


def _rotations(rotation: npt.ArrayLike) -> FloatArray:
    R = np.asarray(rotation, dtype=np.float64)
    if R.shape[-2:] != (3, 3):
        raise InputError("rotation", "shape (..., 3, 3)", str(R.shape))
    return R

"""Differentiation of rotations on the manifold."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.signals.savgol import check_settings, correlate_centred, savgol_weights
from factorgrasp.typing import FloatArray

# Beyond a quarter turn per sample neither the direction of the rotation nor its rate can be trusted.
LARGEST_ROTATION_PER_SAMPLE = 0.5 * np.pi


class RotationDerivatives(NamedTuple):
    """What :func:`differentiate_rotations` returns."""

    rotation: FloatArray
    """Smoothed rotations, in the representation that came in."""
    angular_velocity: FloatArray
    """``w``, body frame (rad/s), shape (n, 3)."""
    angular_acceleration: FloatArray
    """``dw/dt``, body frame (rad/s^2), shape (n, 3)."""


def differentiate_rotations(
    rotation: npt.ArrayLike, dt: float, window: int, order: int
) -> RotationDerivatives:
    """Smoothed rotation, body rate and body acceleration of a uniformly sampled rotation.

    Parameters
    ----------
    rotation : array_like, shape (n, 3, 3) or (n, 4)
        ``R_w_b`` as matrices, or as unit quaternions [w, x, y, z]; NaN marks a gap.
    dt : float
        Sampling step (s).
    window : int
        Odd number of samples in a fit.
    order : int
        Order of the polynomial, at least 2.

    Returns
    -------
    RotationDerivatives
        NaN wherever the window touches a gap or an end of the recording.

    Raises
    ------
    InputError
        As :func:`savgol_derivatives`; and when the body turns more than a quarter turn between two samples.

    Notes ----- The rotation between two samples, ``log(R_k' R_{k+1})``, less its coning term ``h^3 / 12 w x
    dw/dt``, is the time integral of the body rate over that step (Magnus expansion, error of order ``h^5``).
    The Savitzky-Golay weights act on these integrals, so the returned rate and acceleration are *exactly* the
    Savitzky-Golay derivative filters of the true body rate's integral: gain and noise are those of
    :func:`savgol_frequency_response` with ``deriv`` 1 and 2, at any amplitude. Fitting ``log(R_k' R_{k+j})``
    instead costs a logarithm for each pair and bends large rotations.
    """
    values = np.asarray(rotation, dtype=np.float64)
    as_matrix = values.ndim == 3 and values.shape[1:] == (3, 3)
    if not as_matrix and not (values.ndim == 2 and values.shape[1] == 4):
        raise InputError("rotation", "shape (n, 3, 3) or (n, 4)", f"shape {values.shape}")
    n = values.shape[0]
    window, order, dt = int(window), int(order), float(dt)
    if order < 2:
        raise InputError("order", "at least 2, for an acceleration", repr(order))
    check_settings(window, order, 2, dt)
    if n < window:
        raise InputError("rotation", f"at least one window of {window} samples", f"{n} samples")
    q = lie.matrix_to_quaternion_wxyz(values) if as_matrix else values
    integrals = integrated_rates(q, dt)
    shift, first, second = rotation_filters(window, order, dt).T
    delta = correlate_centred(integrals, shift, n)
    smoothed = lie.quaternion_multiply_wxyz(q, lie.quaternion_exp_wxyz(delta))
    return RotationDerivatives(
        lie.quaternion_wxyz_to_matrix(smoothed) if as_matrix else smoothed,
        correlate_centred(integrals, first, n),
        correlate_centred(integrals, second, n),
    )


@lru_cache(maxsize=64)
def rotation_filters(window: int, order: int, dt: float) -> FloatArray:
    """Weights (window - 1, 3) of the integrated rates around a sample: for the smoothing correction, the rate and the acceleration."""
    weights = [np.array(savgol_weights(window, order, deriv, dt)) for deriv in (0, 1, 2)]
    weights[0][window // 2] -= 1.0  # of psi_{k+j} - psi_k: the correction to R_k
    # sum_j c_j psi_{k+j} with sum_j c_j = 0, written in the steps of psi: no running sum that a gap would break.
    out = np.stack([np.cumsum(c[::-1])[::-1][1:] for c in weights], axis=1)
    out.setflags(write=False)
    return out


def rotation_steps(q: FloatArray, dt: float) -> FloatArray:
    """Rotation vectors ``log(R_k' R_{k+1})``, (n - 1, 3), between quaternions [w, x, y, z], (n, 4)."""
    a, b = q[:-1], q[1:]
    # log(conj(a) b), written out: this also runs on a few samples at a time.
    w = np.einsum("ij,ij->i", a, b)
    v = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - cross(a[:, 1:], b[:, 1:])
    sine = np.sqrt(np.einsum("ij,ij->i", v, v))
    scale = 2.0 * np.arctan2(sine, np.abs(w)) / np.where(sine == 0.0, 1.0, sine)
    steps = np.copysign(scale, w)[:, None] * v
    square = np.einsum("ij,ij->i", steps, steps)
    if np.any(square > LARGEST_ROTATION_PER_SAMPLE**2):
        row = int(np.nanargmax(square))
        raise InputError(
            "rotation",
            f"at most {np.rad2deg(LARGEST_ROTATION_PER_SAMPLE):.0f} deg between two samples",
            f"{np.rad2deg(np.sqrt(square[row])):.1f} deg from sample {row} to {row + 1} ({dt:g} s)",
            "Sample faster, or check the quaternions' order [w, x, y, z]",
        )
    return np.asarray(steps)


def coning(steps: FloatArray, change: FloatArray) -> FloatArray:
    """What a rotation step (n, 3) has more than the integral of the rate, with its `change` from one step to the next."""
    return cross(steps, change) / 12.0


def integrated_rates(q: FloatArray, dt: float) -> FloatArray:
    """Integral of the body rate over each step, (n - 1, 3), from quaternions [w, x, y, z], (n, 4)."""
    steps = rotation_steps(q, dt)
    before, after = np.empty_like(steps), np.empty_like(steps)
    before[1:], before[0] = steps[:-1], np.nan
    after[:-1], after[-1] = steps[1:], np.nan
    change = 0.5 * (after - before)
    # Beside a gap one side must do.
    lone = np.isnan(change)
    change[lone] = (after - steps)[lone]
    lone = np.isnan(change)
    change[lone] = (steps - before)[lone]
    np.nan_to_num(change, copy=False)
    out: FloatArray = steps - coning(steps, change)
    return out


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a x b`` of rows (n, 3); numpy.cross takes five times as long."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return out

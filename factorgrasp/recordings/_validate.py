"""Checks that every recording passes on its way in: one place, one wording."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.lie import continuous_quaternions
from factorgrasp.typing import FloatArray

# A quaternion from a text file is rounded to perhaps 1e-4; 1e-2 off is another quantity (order, Euler angles,
# rotation vector).
QUATERNION_NORM_TOLERANCE = 1e-2
# Recorders that interpolate component by component leave short quaternions at a change of sign. A few such rows are dropouts of a sound
# recording; more of them, or long quaternions, which no interpolation makes, are another quantity.
INTERPOLATED_SHARE = 0.02


def read_only(array: FloatArray) -> FloatArray:
    """The array, protected against later writes; the caller must own it."""
    array.setflags(write=False)
    return array


def own(value: npt.ArrayLike, field: str) -> FloatArray:
    """A read-only float64 array: a copy, unless it already is one that nobody can write to."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(field, "an array of numbers", str(error)) from error
    if array.flags.writeable or not array.flags.c_contiguous:
        array = read_only(np.array(array, order="C"))
    return array


def times(value: npt.ArrayLike, field: str) -> FloatArray:
    """Time stamps in seconds, shape (n,), n >= 2, finite and strictly increasing."""
    t = own(value, field)
    if t.ndim != 1:
        raise InputError(field, "shape (n,)", f"shape {t.shape}")
    if t.size == 0:
        raise InputError(field, "at least two samples", "an empty recording")
    if t.size == 1:
        raise InputError(field, "at least two samples", "one sample")
    finite = np.isfinite(t)
    if not finite.all():
        row = int(np.argmin(finite))
        raise InputError(
            field,
            "finite time stamps [s]",
            f"{int((~finite).sum())} not finite, the first in sample {row}: {t[row]}",
        )
    steps = np.diff(t)
    if (steps < 0.0).any():
        row = int(np.argmax(steps < 0.0)) + 1
        raise InputError(
            field,
            "strictly increasing time stamps [s]",
            f"time running backwards in sample {row} (counted from 0): {float(t[row])!r} after "
            f"{float(t[row - 1])!r}, {int((steps < 0.0).sum())} time(s) in all",
            "Sort the recording, or cut it where the clock was reset",
        )
    if (steps == 0.0).any():
        row = int(np.argmax(steps == 0.0)) + 1
        raise InputError(
            field,
            "strictly increasing time stamps [s]",
            f"duplicate stamps: sample {row} (counted from 0) has the time of the one before it, "
            f"{float(t[row])!r}, {int((steps == 0.0).sum())} time(s) in all",
            "Drop the repeated rows, or write the time with more digits",
        )
    return t


def channels(value: npt.ArrayLike, field: str, n: int, columns: Sequence[str] | int, unit: str) -> FloatArray:
    """Values of shape (n, len(columns)): finite or NaN (a gap), and no column all NaN.

    ``columns`` may be a count when the columns have no names of their own.
    """
    array = own(value, field)
    width = columns if isinstance(columns, int) else len(columns)
    if array.ndim != 2 or array.shape[1] != width:
        raise InputError(field, f"shape ({n}, {width}) in {unit}", f"shape {array.shape}")
    if array.shape[0] != n:
        raise InputError(
            field, f"{n} rows, one for each time stamp (shape ({n}, {width}))", f"shape {array.shape}"
        )

    def name(column: int) -> str:
        return str(column) if isinstance(columns, int) else columns[column]

    if np.isfinite(array).all():
        return array
    infinite = np.isinf(array)
    if infinite.any():
        row, column = (int(i) for i in np.argwhere(infinite)[0])
        raise InputError(
            field,
            f"finite values in {unit}, or NaN for a gap",
            f"{array[row, column]} in sample {row} (counted from 0), column {name(column)}"
            f", {int(infinite.sum())} in all",
        )
    empty = np.isnan(array).all(axis=0)
    if empty.any():
        raise InputError(
            field,
            f"values in {unit}",
            "nothing but NaN in column " + ", ".join(name(int(c)) for c in np.flatnonzero(empty)),
        )
    return array


def quaternions(value: npt.ArrayLike, field: str, n: int) -> FloatArray:
    """Unit quaternions [w, x, y, z], (n, 4): renormalised, signs continuous in time; NaN rows are gaps.

    At most 2 % of short ones (interpolated across a change of sign) become gaps, with a warning that counts them.
    """
    array = channels(value, field, n, ("qw", "qx", "qy", "qz"), "unit quaternion [w, x, y, z]")
    norm = np.sqrt(np.einsum("ij,ij->i", array, array))
    off = np.abs(norm - 1.0)
    wrong = off > QUATERNION_NORM_TOLERANCE
    if (
        wrong.any()
        and np.nanmax(norm) <= 1.0 + QUATERNION_NORM_TOLERANCE
        and wrong.mean() <= INTERPOLATED_SHARE
    ):
        count, short = int(wrong.sum()), float(norm[wrong].min())
        warnings.warn(
            f"{field}: {count} quaternion(s) shorter than 1 (down to {short:.3g}), as interpolation across a change of sign leaves "
            "them; taken as gaps",
            UserWarning,
            stacklevel=4,
        )
        array = np.where(wrong[:, None], np.nan, array)
        norm, off, wrong = np.where(wrong, np.nan, norm), np.where(wrong, np.nan, off), np.zeros_like(wrong)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(
            field,
            "unit quaternions [w, x, y, z]",
            f"norm {norm[row]:.6g} in sample {row} (counted from 0), {int(wrong.sum())} such row(s) in all",
            "Euler angles, a rotation vector, a missing component, or interpolation across a change of sign? "
            "Rows of nan are gaps",
        )
    # An already clean array is kept, so that slices of a stream share its memory.
    if not (off > 1e-15).any() and not np.isnan(array).any():
        signs = np.einsum("ij,ij->i", array[1:], array[:-1]) < 0.0
        if not signs.any():
            return array
    # A row with one NaN is no rotation at all: the whole row becomes the gap (norm is NaN there).
    return read_only(continuous_quaternions(array / norm[:, None]))

"""Interpolation to other times that never crosses a gap."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.typing import BoolArray, FloatArray, IntArray

# A step longer than this many median steps is a gap when the caller does not say what is.
GAP_IN_STEPS = 3.0
# Stamps this close to a grid point (in median steps) are on it: `t0 + k dt` never equals a stored stamp exactly.
_ON_GRID = 1e-6


def _snap(t: FloatArray, step: float) -> float:
    """Distance (s) within which times are the same; stamps since 1970 are only good to 2e-7 s."""
    return max(_ON_GRID * step, 4.0 * float(np.spacing(np.max(np.abs(t)))))


@dataclass(frozen=True)
class _Stencil:
    """Where each grid point lies among the good samples, and the weights of the up to four around it."""

    index: IntArray  # of the good sample at or before the grid point
    ok: BoolArray  # False: in a gap, or outside the recording
    weights: tuple[FloatArray, ...]  # for index, index + 1 (linear) or index - 1, ..., index + 2 (cubic)


def _grid(t: FloatArray, grid: float | npt.ArrayLike) -> FloatArray:
    points = np.asarray(grid, dtype=np.float64)
    if points.ndim == 0:
        dt = float(points)
        if not (np.isfinite(dt) and dt > 0.0):
            raise InputError("grid", "a positive time step [s], or an array of times", repr(dt))
        points = t[0] + dt * np.arange(int((t[-1] - t[0] + _snap(t, dt)) / dt) + 1)
    if points.ndim != 1 or not np.isfinite(points).all():
        raise InputError("grid", "a time step, or finite times of shape (m,) [s]", f"shape {points.shape}")
    return points


def _stamps(t: npt.ArrayLike, rows: int) -> FloatArray:
    stamps = np.asarray(t, dtype=np.float64)
    if stamps.shape != (rows,):
        raise InputError("t", f"shape ({rows},), one stamp for each row", f"shape {stamps.shape}")
    if rows < 2 or not (np.diff(stamps) > 0.0).all():
        raise InputError("t", "at least two strictly increasing, finite times [s]", "something else")
    return stamps


def _stencil(
    t: FloatArray,
    good: BoolArray,
    points: FloatArray,
    max_gap: float | None,
    kind: Literal["linear", "cubic"],
) -> _Stencil:
    if kind not in ("linear", "cubic"):
        raise InputError("kind", "'linear' or 'cubic'", repr(kind))
    if max_gap is not None and not max_gap > 0.0:
        raise InputError("max_gap", "a positive time [s]", repr(max_gap))
    step = float(np.median(np.diff(t)))
    snap = _snap(t, step)
    longest = (GAP_IN_STEPS * step if max_gap is None else max_gap) + snap
    stamps = t if good.all() else t[good]
    n = stamps.size
    if n < 2:
        raise InputError("x", "at least two samples that are not NaN", str(n))
    index = np.clip(np.searchsorted(stamps, points, side="right") - 1, 0, n - 2)
    h = np.diff(stamps)
    whole = h <= longest
    width = h[index]
    x = points - stamps[index]
    bridged = whole[index]
    ok = bridged & (x >= -snap) & (x <= width + snap)
    ok |= (np.abs(x) <= snap) | (np.abs(x - width) <= snap)
    np.clip(x, 0.0, width, out=x)
    if kind == "linear":
        u = x / width
        return _Stencil(index, ok, (1.0 - u, u))
    # Lagrange through the neighbours that belong to the same stretch of data: four of them inside (exact for
    # cubics), three or two beside a gap.
    left = np.zeros(n - 1, dtype=np.bool_)
    left[1:] = whole[1:] & whole[:-1]
    right = np.zeros(n - 1, dtype=np.bool_)
    right[:-1] = whole[1:] & whole[:-1]
    has_a, has_b = left[index], right[index]
    # A missing neighbour is moved to infinity: its weight is 0 and its factor in the other weights 1.
    a = -h[np.maximum(index - 1, 0)]
    b = width + h[np.minimum(index + 1, n - 2)]
    xa, xb, xh = x - a, b - x, width - x

    def factor(has: BoolArray, value: FloatArray) -> FloatArray:
        return np.where(has, value, 1.0)

    w0 = xh / width * factor(has_a, xa / -a) * factor(has_b, xb / b)
    w1 = x / width * factor(has_a, xa / (width - a)) * factor(has_b, xb / (b - width))
    wa = np.where(has_a, -x * xh / (a * (a - width)) * factor(has_b, xb / (b - a)), 0.0)
    wb = np.where(has_b, -x * xh / (b * (b - width)) * factor(has_a, xa / (b - a)), 0.0)
    return _Stencil(index, ok, (wa, w0, w1, wb))


def resample_uniform(
    t: npt.ArrayLike,
    x: npt.ArrayLike,
    grid: float | npt.ArrayLike,
    *,
    max_gap: float | None = None,
    kind: Literal["linear", "cubic"] = "linear",
) -> tuple[FloatArray, FloatArray]:
    """Interpolate signals to other times, never across a gap.

    Parameters
    ----------
    t : array_like, shape (n,)
        Strictly increasing times (s), uniform or not.
    x : array_like, shape (n,) or (n, c)
        Samples; a row with a NaN is missing as a whole.
    grid : float or array_like, shape (m,)
        Time step (s) of a uniform grid over the recording, or the times themselves.
    max_gap : float, optional
        Longest time (s) between two good samples that is bridged; three median steps by default.
    kind : {"linear", "cubic"}
        Cubic is the local four-point Lagrange polynomial (exact for cubics); beside a gap it has three points
        or two.

    Returns
    -------
    grid : ndarray, shape (m,)
    values : ndarray, shape (m,) or (m, c)
        NaN inside gaps and outside the recording.
    """
    values = np.asarray(x, dtype=np.float64)
    if values.ndim not in (1, 2):
        raise InputError("x", "shape (n,) or (n, channels)", f"shape {values.shape}")
    stamps = _stamps(t, values.shape[0])
    points = _grid(stamps, grid)
    rows = values[:, None] if values.ndim == 1 else values
    good: BoolArray = np.asarray(np.isfinite(rows).all(axis=1))
    stencil = _stencil(stamps, good, points, max_gap, kind)
    kept = rows if good.all() else rows[good]
    last = kept.shape[0] - 1
    first = -1 if kind == "cubic" else 0
    out = np.zeros((points.size, rows.shape[1]))
    for offset, weight in enumerate(stencil.weights, start=first):
        out += weight[:, None] * kept[np.clip(stencil.index + offset, 0, last)]
    out[~stencil.ok] = np.nan
    return points, out[:, 0] if values.ndim == 1 else out


def resample_rotations(
    t: npt.ArrayLike,
    rotation: npt.ArrayLike,
    grid: float | npt.ArrayLike,
    *,
    max_gap: float | None = None,
    kind: Literal["linear", "cubic"] = "linear",
) -> tuple[FloatArray, FloatArray]:
    """Interpolate rotations to other times, never across a gap.

    Parameters
    ----------
    t : array_like, shape (n,)
        Strictly increasing times (s), uniform or not.
    rotation : array_like, shape (n, 3, 3) or (n, 4)
        Matrices, or unit quaternions [w, x, y, z]; a row with a NaN is missing.
    grid, max_gap
        As in :func:`resample_uniform`.
    kind : {"linear", "cubic"}
        Linear is the great arc between two samples (slerp). Cubic interpolates the rotation vector relative
        to the sample before, through four samples.

    Returns
    -------
    grid : ndarray, shape (m,)
    rotations : ndarray, shape (m, 3, 3) or (m, 4), as they came in
        NaN inside gaps and outside the recording.
    """
    values = np.asarray(rotation, dtype=np.float64)
    as_matrix = values.ndim == 3 and values.shape[1:] == (3, 3)
    if not as_matrix and not (values.ndim == 2 and values.shape[1] == 4):
        raise InputError("rotation", "shape (n, 3, 3) or (n, 4)", f"shape {values.shape}")
    stamps = _stamps(t, values.shape[0])
    points = _grid(stamps, grid)
    q = lie.matrix_to_quaternion_wxyz(values) if as_matrix else values
    good: BoolArray = np.asarray(np.isfinite(q).all(axis=1))
    stencil = _stencil(stamps, good, points, max_gap, kind)
    kept = q if good.all() else q[good]
    last = kept.shape[0] - 1
    base = kept[stencil.index]
    inverse = lie.quaternion_conjugate(base)
    first = -1 if kind == "cubic" else 0
    phi = np.zeros((points.size, 3))
    for offset, weight in enumerate(stencil.weights, start=first):
        if offset != 0:
            other = kept[np.clip(stencil.index + offset, 0, last)]
            phi += weight[:, None] * lie.quaternion_log_wxyz(lie.quaternion_multiply_wxyz(inverse, other))
    out = lie.quaternion_multiply_wxyz(base, lie.quaternion_exp_wxyz(phi))
    out[~stencil.ok] = np.nan
    if as_matrix:
        return points, lie.quaternion_wxyz_to_matrix(out)
    return points, lie.continuous_quaternions(out)

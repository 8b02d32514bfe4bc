"""Uninterrupted pieces of a stream, cut at gaps, and their interpolation to a uniform grid as they come."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from factorgrasp import signals
from factorgrasp.typing import BoolArray, FloatArray


class Piece(NamedTuple):
    """Consecutive rows without a gap.

    Attributes
    ----------
    t : (m,) ndarray
        s.
    x : (m, c) ndarray
    starts : bool
        There is a gap before the first row; otherwise it follows the last row of the piece before.
    """

    t: FloatArray
    x: FloatArray
    starts: bool


class GapCutter:
    """Cuts rows into pieces: at rows with a NaN, which are left out, and at steps longer than `limit` (s)."""

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self._last = np.nan

    def cut(self, t: FloatArray, x: FloatArray, plain: bool = False) -> list[Piece]:
        """Pieces of the next rows x (m, c) with ascending stamps t (m,); `plain`: known to be complete and without gaps."""
        if t.size == 0:
            return []
        if plain and t[0] - self._last <= self.limit:
            self._last = t[-1]
            return [Piece(t, x, False)]
        first = not t[0] - self._last <= self.limit
        whole = t.size == 1 or bool((t[1:] - t[:-1]).max() <= self.limit)
        if whole and np.isfinite(x).all():
            self._last = t[-1]
            return [Piece(t, x, first)]
        good: BoolArray = np.asarray(np.isfinite(x).all(axis=1))
        starts = np.concatenate([[first], ~(t[1:] - t[:-1] <= self.limit)])
        # A new piece begins after every long step and after every incomplete row.
        starts[1:] |= ~good[:-1]
        group = np.cumsum(starts)
        out = []
        for k in np.unique(group[good]):
            rows = np.flatnonzero((group == k) & good)
            out.append(Piece(t[rows], x[rows], bool(starts[rows[0]])))
        self._last = t[-1] if good[-1] else np.nan
        return out


Interpolate = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]


def interpolate_rows(t: FloatArray, x: FloatArray, times: FloatArray) -> FloatArray:
    """Cubic interpolation (m, c) of rows x (n, c) without gaps."""
    return signals.resample_uniform(t, x, times, max_gap=np.inf, kind="cubic")[1]


def interpolate_poses(t: FloatArray, x: FloatArray, times: FloatArray) -> FloatArray:
    """The same for rows [position, quaternion wxyz] (n, 7)."""
    position = interpolate_rows(t, x[:, :3], times)
    rotation = signals.resample_rotations(t, x[:, 3:], times, max_gap=np.inf, kind="cubic")[1]
    return np.hstack([position, rotation])


class GridInterpolator:
    """Rows of a piece on a uniform grid of its own that begins with the piece; two rows behind the newest."""

    def __init__(self, step: float, interpolate: Interpolate = interpolate_rows) -> None:
        self.step, self._interpolate = step, interpolate
        self._t = self._x = np.empty(0)
        self._next = 0.0
        self._starts = True

    def push(self, piece: Piece) -> list[Piece]:
        """Grid rows that the new rows settle."""
        if piece.starts or self._t.size == 0:
            self._t, self._x = piece.t, piece.x
            self._next, self._starts = float(piece.t[0]), True
        else:
            self._t = np.concatenate([self._t, piece.t])
            self._x = np.concatenate([self._x, piece.x])
        if self._t.size < 4:
            return []
        count = int(np.floor((self._t[-2] - self._next) / self.step + 1e-9)) + 1
        if count <= 0:
            return []
        times: FloatArray = self._next + self.step * np.arange(count, dtype=np.float64)
        out = Piece(times, self._interpolate(self._t, self._x, times), self._starts)
        self._next, self._starts = float(times[-1] + self.step), False
        keep = max(int(np.searchsorted(self._t, self._next)) - 2, 0)
        self._t, self._x = self._t[keep:], self._x[keep:]
        return [out]

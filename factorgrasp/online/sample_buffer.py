"""Samples of one clock, put in order as they arrive: late, out-of-order, duplicate and missing stamps."""

from __future__ import annotations

import math

import numpy as np

from factorgrasp.typing import FloatArray

# A step longer than this many nominal steps may be a sample that is still on its way.
_HOLE = 1.5
# Steps that differ from the nominal one by less than this part are regular, as in the batch problem.
_REGULAR = 0.02
_FIRST_ROWS = 2048


class SampleBuffer:
    """A bounded queue of rows in order of their stamps.

    Rows up to the *frontier* are settled: nothing will be put between them any more. On a regular stream every row is settled on
    arrival. Where a stamp is missing, the rows behind the hole wait for it until the newest stamp is `lateness` ahead; then the hole is
    a gap. What comes later than that is dropped and counted.

    Parameters
    ----------
    columns : int
    lateness : float
        s.
    keep : float
        s; rows older than this against the newest are let go even if nobody took them.
    """

    def __init__(self, columns: int, lateness: float, keep: float) -> None:
        self.lateness, self.keep = lateness, keep
        self.step = 0.0
        """Nominal step (s); zero while it is unknown, and nothing is settled."""
        self.limit = np.inf
        """A longer step (s) is a gap."""
        self.plain_since = np.inf
        """Settled rows later than this (s) are complete and regular, up to the newest."""
        self.received = self.late = self.duplicates = self.overflown = self.incomplete = self.gaps = 0
        self._t = np.empty(_FIRST_ROWS)
        self._x = np.empty((_FIRST_ROWS, columns))
        self._begin = self._settled = self._end = 0
        self._newest = self._frontier = -np.inf

    @property
    def newest(self) -> float:
        """Latest stamp so far (s)."""
        return self._newest

    @property
    def frontier(self) -> float:
        """Stamp of the last settled row (s)."""
        return self._frontier

    @property
    def columns(self) -> int:
        """Values a row."""
        return self._x.shape[1]

    def add(self, t: FloatArray, x: FloatArray) -> None:
        """Take rows x (m, columns) with stamps t (m,)."""
        n = t.size
        if n == 0:
            return
        self.received += n
        first = float(t[0]) - self._newest
        if n > 1:
            steps = t[1:] - t[:-1]
            least, most = min(first, float(steps.min())), max(first, float(steps.max()))
        else:
            least = most = first
        if least <= 0.0:
            self._merge(t, x)
            self._settle()
            return
        whole = self._settled == self._end and most <= _HOLE * self.step
        self._append(t, x)
        if not whole:
            self._settle()
            return
        complete = math.isfinite(x.sum())
        if not complete:
            self.incomplete += int(np.count_nonzero(np.isnan(x).any(axis=1)))
        if not complete or most > (1.0 + _REGULAR) * self.step or least < (1.0 - _REGULAR) * self.step:
            self.plain_since = self._newest
        self._settled, self._frontier = self._end, self._newest

    def settled(self) -> tuple[FloatArray, FloatArray]:
        """Stamps and rows up to the frontier that have not been let go (views)."""
        return self._t[self._begin : self._settled], self._x[self._begin : self._settled]

    def everything(self) -> tuple[FloatArray, FloatArray]:
        """All stamps and rows held (views)."""
        return self._t[self._begin : self._end], self._x[self._begin : self._end]

    def release(self, rows: int) -> None:
        """Let the oldest `rows` settled rows go."""
        self._begin = min(self._begin + max(rows, 0), self._settled)

    def start(self, step: float, limit: float) -> None:
        """Declare the nominal step and the longest one that is no gap (s); from now on rows get settled."""
        self.step, self.limit = step, limit
        self._settle()

    def _append(self, t: FloatArray, x: FloatArray) -> None:
        n = t.size
        if self._end + n > self._t.size:
            self._make_room(n)
        self._t[self._end : self._end + n] = t
        self._x[self._end : self._end + n] = x
        self._end += n
        self._newest = float(t[-1])
        oldest = self._newest - self.keep
        if self._t[self._begin] < oldest:
            gone = int(np.searchsorted(self._t[self._begin : self._end], oldest))
            self.overflown += gone
            self._begin += gone
            self._settled = max(self._settled, self._begin)

    def _make_room(self, n: int) -> None:
        held = slice(self._begin, self._end)
        size = self._end - self._begin
        t, x = self._t, self._x
        if 2 * (size + n) > t.size:
            t, x = np.empty(2 * t.size + n), np.empty((2 * t.size + n, self.columns))
        t[:size], x[:size] = self._t[held], self._x[held]
        self._t, self._x = t, x
        self._settled -= self._begin
        self._begin, self._end = 0, size

    def _merge(self, t: FloatArray, x: FloatArray) -> None:
        in_time = t > self._frontier
        self.late += int(t.size - np.count_nonzero(in_time))
        if not in_time.any():
            return
        waiting = slice(self._settled, self._end)
        stamps = np.concatenate([self._t[waiting], t[in_time]])
        rows = np.concatenate([self._x[waiting], x[in_time]])
        order = np.argsort(stamps, kind="stable")
        stamps, rows = stamps[order], rows[order]
        first = np.concatenate([[True], stamps[1:] > stamps[:-1]])
        self.duplicates += int(stamps.size - np.count_nonzero(first))
        self._end = self._settled
        self._append(stamps[first], rows[first])

    def _settle(self) -> None:
        if self.step <= 0.0 or self._settled == self._end:
            return
        t = self._t[self._settled : self._end]
        steps = np.empty(t.size)
        steps[0], steps[1:] = t[0] - self._frontier, t[1:] - t[:-1]
        count = t.size
        for hole in np.flatnonzero(steps > _HOLE * self.step):
            # Nothing was settled before the very first row.
            before = t[hole] - steps[hole]
            if np.isfinite(before) and self._newest - before <= self.lateness:
                count = int(hole)
                break
        if count == 0:
            return
        new = slice(self._settled, self._settled + count)
        self.incomplete += int(np.count_nonzero(np.isnan(self._x[new]).any(axis=1)))
        self.gaps += int(np.count_nonzero((steps[:count] > self.limit) & np.isfinite(steps[:count])))
        self._settled += count
        self._frontier = self.plain_since = float(t[count - 1])

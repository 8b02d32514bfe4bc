"""The newest rows of a stream in one contiguous block of memory."""

from __future__ import annotations

import numpy as np

from factorgrasp.typing import FloatArray


class RowHistory:
    """The last `rows` rows and their times, contiguous, with the length of the uninterrupted piece at the end."""

    def __init__(self, rows: int, columns: int) -> None:
        self.rows = rows
        self._t = np.empty(4 * rows)
        self._x = np.empty((4 * rows, columns))
        self._end = 0
        self.run = 0
        """Rows since the last gap (may exceed what is kept)."""

    def append(self, t: FloatArray, x: FloatArray, starts: bool) -> None:
        """Add at most `rows` rows x (m, columns); `starts`: after a gap."""
        n = t.size
        if self._end + n > self._t.size:
            kept = slice(self._end - self.rows, self._end)
            self._t[: self.rows], self._x[: self.rows] = self._t[kept], self._x[kept]
            self._end = self.rows
        self._t[self._end : self._end + n], self._x[self._end : self._end + n] = t, x
        self._end += n
        self.run = n if starts else self.run + n

    def last(self, rows: int) -> FloatArray:
        """The newest rows (view)."""
        return self._x[max(self._end - rows, 0) : self._end]

    def last_times(self, rows: int) -> FloatArray:
        """Their times (view)."""
        return self._t[max(self._end - rows, 0) : self._end]

    @property
    def kept(self) -> int:
        """Rows of the uninterrupted piece at the end that are still here."""
        return min(self.run, self.rows)

"""Robot and hand brought together: the rows z of both relations on one uniform grid, as far as both clocks have come.

The layout is ``[w_r, w_h, dw_h, 1 | f_r, al_r, vech(w_r w_r'), f_h, df_h, 1, (R_w_r' E)]``: z_g and z_a of
:mod:`factorgrasp.problems.grasp_model` side by side.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from factorgrasp import signals
from factorgrasp.errors import InputError
from factorgrasp.online.robot_feed import ROBOT_WIDTH
from factorgrasp.online.sample_buffer import SampleBuffer
from factorgrasp.online.stream_pieces import Piece
from factorgrasp.problems.grasp_averaging import average
from factorgrasp.problems.grasp_model import ACCELEROMETER_WIDTH, GYRO_WIDTH, TILTED_WIDTH
from factorgrasp.problems.grasp_recording import shifted_rows
from factorgrasp.typing import FloatArray

GYRO = slice(0, GYRO_WIDTH)
ACCELEROMETER = slice(GYRO_WIDTH, None)
_HAND_RATE, _RATE_SLOPE = slice(3, 6), slice(6, 9)
_HAND_FORCE, _FORCE_SLOPE = slice(GYRO_WIDTH + 12, GYRO_WIDTH + 15), slice(GYRO_WIDTH + 15, GYRO_WIDTH + 18)
# Steps that differ by less than this part are taken for equal, as in the batch problem.
_UNIFORM = 0.02


def row_width(tilted: bool) -> int:
    """Entries of one row."""
    return GYRO_WIDTH + (TILTED_WIDTH if tilted else ACCELEROMETER_WIDTH)


def shift_hand(z: FloatArray, shift: float) -> None:
    """Read the hand later by `shift` (s), to first order, in rows or coefficients z (..., c); in place."""
    z[..., _HAND_RATE] += shift * z[..., _RATE_SLOPE]
    z[..., _HAND_FORCE] += shift * z[..., _FORCE_SLOPE]


class HandReader:
    """The hand's settled samples at other times of its clock; never across a gap."""

    def __init__(self, buffer: SampleBuffer) -> None:
        self._buffer = buffer

    @property
    def ready(self) -> float:
        """Times up to this can be read (s)."""
        t, _ = self._buffer.settled()
        return float(t[-2]) if t.size > 2 else -np.inf

    def at(self, times: FloatArray) -> FloatArray:
        """Angular velocity and specific force (m, 6) at ascending, evenly spaced times (m,); NaN in gaps and outside."""
        t, x = self._buffer.settled()
        low = max(int(np.searchsorted(t, times[0])) - 3, 0)
        high = int(np.searchsorted(t, times[-1])) + 3
        t, x = t[low:high], x[low:high]
        if t.size < 4:
            return np.full((times.size, 6), np.nan)
        if times.size > 1 and (t[0] > self._buffer.plain_since or self._plain(t, x)):
            slope = (t[-1] - t[0]) / (t.size - 1)
            first, last = (times[0] - t[0]) / slope, (times[-1] - t[0]) / slope
            if abs((last - first) - (times.size - 1)) < _UNIFORM:
                return shifted_rows(x, 0.5 * (first + last - (times.size - 1)), times.size)
        try:
            return signals.resample_uniform(t, x, times, max_gap=self._buffer.limit, kind="cubic")[1]
        except InputError:  # fewer than two good samples around
            return np.full((times.size, 6), np.nan)

    def _plain(self, t: FloatArray, x: FloatArray) -> bool:
        step = self._buffer.step
        return bool(np.all(np.abs(t[1:] - t[:-1] - step) < _UNIFORM * step) and np.isfinite(x).all())

    def release_before(self, time: float) -> None:
        """Let samples go that no time after `time` needs."""
        t, _ = self._buffer.settled()
        self._buffer.release(int(np.searchsorted(t, time)) - 4)


class Coupler:
    """Queues the robot's rows until the hand has come as far, then makes rows of z.

    Parameters
    ----------
    hand : HandReader
    averaged : int
        Rows of the robot whose mean is one row.
    averaged_hand : int
        Readings of the hand whose mean joins one row of the robot.
    step : float
        s, between rows.
    tilted : bool
    keep : float
        s; the robot's rows wait no longer than this for the hand.
    """

    def __init__(
        self, hand: HandReader, averaged: int, averaged_hand: int, step: float, tilted: bool, keep: float
    ) -> None:
        self._hand, self._averaged, self._step, self._keep = hand, averaged, step, keep
        self._averaged_hand = averaged_hand
        self._inside = ((np.arange(averaged_hand) + 0.5) / averaged_hand - 0.5) * step / averaged
        self._width = row_width(tilted)
        self._queue: deque[Piece] = deque()
        self.overflown = 0
        self._done = -np.inf
        self._break()

    def push(self, pieces: list[Piece]) -> None:
        """Queue rows of the robot."""
        for piece in pieces:
            if self._queue and not piece.starts:
                # One piece is read and averaged faster than two.
                last = self._queue.pop()
                piece = Piece(
                    np.concatenate([last.t, piece.t]), np.concatenate([last.x, piece.x]), last.starts
                )
            self._queue.append(piece)
        while len(self._queue) > 1 and self._queue[-1].t[-1] - self._queue[0].t[-1] > self._keep:
            self.overflown += self._queue.popleft().t.size
            self._break()

    def pull(self, offset: float) -> list[Piece]:
        """Rows of z, with the hand read at ``t + offset``: all that both clocks allow."""
        ready = self._ready(offset)
        out: list[Piece] = []
        while self._queue and self._queue[0].t[0] <= ready:
            piece = self._queue.popleft()
            if piece.t[-1] > ready:
                count = int(np.searchsorted(piece.t, ready, side="right"))
                self._queue.appendleft(Piece(piece.t[count:], piece.x[count:], False))
                piece = Piece(piece.t[:count], piece.x[:count], piece.starts)
            if piece.starts:
                self._break()
            out += self._couple(piece.t, piece.x, self._read(piece.t + offset))
            self._done = float(piece.t[-1])
        return out

    def _ready(self, offset: float) -> float:
        """Rows of the robot up to this time (s) can be joined."""
        return self._hand.ready - offset - float(self._inside[-1])

    def _read(self, times: FloatArray) -> FloatArray:
        """The hand (m, 6) at times (m,) of its clock, averaged as the robot is."""
        if self._averaged_hand == 1:
            return self._hand.at(times)
        return average(self._hand.at((times[:, None] + self._inside).ravel()), self._averaged_hand)

    def available(self, offset: float) -> float:
        """Time (s) that could be pulled now."""
        if not self._queue:
            return 0.0
        return min(self._ready(offset), float(self._queue[-1].t[-1])) - float(self._queue[0].t[0])

    def release(self, offset: float) -> None:
        """Let the hand's samples go that no later row needs."""
        self._hand.release_before(self._done + offset)

    def _break(self) -> None:
        """What follows is a new piece."""
        self._left = (np.empty(0), np.empty((0, 0)))
        self._means = (np.empty(0), np.empty((0, 0)))
        self._starts = True

    def _couple(self, t: FloatArray, robot: FloatArray, hand: FloatArray) -> list[Piece]:
        if math.isfinite(hand[:, 0].sum()):
            return self._average(t, np.hstack([robot, hand]))
        lost = ~np.isfinite(hand[:, 0])
        out: list[Piece] = []
        for part in np.split(np.arange(t.size), np.flatnonzero(np.diff(lost)) + 1):
            if lost[part[0]]:
                self._break()
            else:
                out += self._average(t[part], np.hstack([robot[part], hand[part]]))
        return out

    def _average(self, t: FloatArray, x: FloatArray) -> list[Piece]:
        """Means over whole blocks; what is left over waits for more."""
        t, x = _joined(self._left, t, x)
        used = t.size - t.size % self._averaged
        self._left = (t[used:], x[used:])
        if used == 0:
            return []
        t, x = average(t[:used, None], self._averaged)[:, 0], average(x[:used], self._averaged)
        t, x = _joined(self._means, t, x)
        # A slope needs a row on either side.
        self._means = (t[-2:], x[-2:])
        if t.size < 3:
            return []
        starts, self._starts = self._starts, False
        return [Piece(t[1:-1], self._row(x), starts)]

    def _row(self, x: FloatArray) -> FloatArray:
        inner, slope = x[1:-1], (x[2:, -6:] - x[:-2, -6:]) / (2.0 * self._step)
        z = np.empty((inner.shape[0], self._width))
        z[:, 0:3], z[:, _HAND_RATE], z[:, _RATE_SLOPE], z[:, 9] = (
            inner[:, 0:3],
            inner[:, -6:-3],
            slope[:, :3],
            1.0,
        )
        z[:, 10:22], z[:, _HAND_FORCE], z[:, _FORCE_SLOPE], z[:, 28] = (
            inner[:, 3:15],
            inner[:, -3:],
            slope[:, 3:],
            1.0,
        )
        z[:, 29:] = inner[:, ROBOT_WIDTH:-6]
        return z


def _joined(
    before: tuple[FloatArray, FloatArray], t: FloatArray, x: FloatArray
) -> tuple[FloatArray, FloatArray]:
    if before[0].size == 0:
        return t, x
    return np.concatenate([before[0], t]), np.concatenate([before[1], x])

"""The robot's side as it streams in: poses, motion or IMU samples become the robot's entries of z, gaps cut out, at a fixed small lag."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from factorgrasp import lie, signals
from factorgrasp.online.stream_pieces import (
    GapCutter,
    GridInterpolator,
    Piece,
    interpolate_poses,
    interpolate_rows,
)
from factorgrasp.problems.grasp_kinematics import DERIVATIVE_ORDER, to_body
from factorgrasp.problems.grasp_recording import vech_products
from factorgrasp.signals.rotations import coning, cross, rotation_filters, rotation_steps
from factorgrasp.signals.savgol import savgol_weights
from factorgrasp.typing import FloatArray

RobotKind = Literal["poses", "motion", "imu"]

COLUMNS: dict[RobotKind, int] = {"poses": 7, "motion": 9, "imu": 6}
ROBOT_WIDTH = 15


class PoseAverager:
    """Means of consecutive rows [position, quaternion wxyz] of a fast stream, as the batch problem takes them before it differentiates."""

    def __init__(self, samples: int) -> None:
        self._samples, self._starts = samples, True
        self._t, self._x = np.empty(0), np.empty((0, 7))

    def push(self, piece: Piece) -> list[Piece]:
        """Means of whole groups of samples; what is left over waits for more."""
        t, x = piece.t, piece.x
        starts = piece.starts
        if starts:
            self._starts = True
        elif self._t.size:
            t, x = np.concatenate([self._t, t]), np.concatenate([self._x, x])
        used = t.size - t.size % self._samples
        self._t, self._x = t[used:], x[used:]
        if used == 0:
            return []
        groups = x[:used].reshape(-1, self._samples, 7)
        # Either sign of a quaternion is the same rotation: all of a group take that of its first.
        signs = np.where(np.einsum("gsi,gi->gs", groups[:, :, 3:], groups[:, 0, 3:]) < 0.0, -1.0, 1.0)
        out = np.empty((groups.shape[0], 7))
        out[:, :3] = groups[:, :, :3].mean(axis=1)
        out[:, 3:] = np.einsum("gs,gsi->gi", signs, groups[:, :, 3:])
        out[:, 3:] /= np.sqrt(np.einsum("ij,ij->i", out[:, 3:], out[:, 3:]))[:, None]
        starts, self._starts = self._starts, False
        return [Piece(t[:used].reshape(-1, self._samples).mean(axis=1), out, starts)]


class Differentiator(Protocol):
    """Rows of a stream to rows [w, f, al (each 3), vech(w w') (6), R_w_r' E (6, with base tilt)]."""

    def push(self, piece: Piece) -> list[Piece]: ...


def robot_rows(
    w: FloatArray, f: FloatArray, al: FloatArray, rotation: FloatArray | None, tilt: FloatArray | None
) -> FloatArray:
    """The robot's entries of z (m, 15, or 21 with base tilt), products formed."""
    parts = [w, f, al, vech_products(w)]
    if tilt is not None and rotation is not None:
        parts += [np.matmul(rotation.transpose(0, 2, 1), tilt[:, i]) for i in (0, 1)]
    return np.hstack(parts)


class MotionRows:
    """Nothing to differentiate: rows [w, al, f], and the rotation's quaternion where the base tilt is estimated."""

    def __init__(self, tilt: FloatArray | None) -> None:
        self._tilt = tilt

    def push(self, piece: Piece) -> list[Piece]:
        """One row for every row."""
        x = piece.x
        rotation = None if self._tilt is None else lie.quaternion_wxyz_to_matrix(x[:, 9:13])
        z = robot_rows(x[:, 0:3], x[:, 6:9], x[:, 3:6], rotation, self._tilt)
        return [Piece(piece.t, z, piece.starts)]


class _Fixed:
    """A fixed-lag filter over uniform rows: keeps what the next rows' windows need."""

    def __init__(self, window: int, step: float) -> None:
        self.window, self.step = window, step
        self._t = self._x = np.empty(0)
        self._starts = True

    def _take(self, piece: Piece) -> tuple[FloatArray, FloatArray]:
        if piece.starts or self._t.size == 0:
            self._starts = True
            return piece.t, piece.x
        return np.concatenate([self._t, piece.t]), np.concatenate([self._x, piece.x])

    def _give(self, t: FloatArray, x: FloatArray, inner: slice, z: FloatArray) -> list[Piece]:
        kept = 2 * inner.start
        self._t, self._x = t[-kept:], x[-kept:]
        starts, self._starts = self._starts, False
        return [Piece(t[inner], z, starts)]

    def _wait(self, t: FloatArray, x: FloatArray) -> list[Piece]:
        self._t, self._x = t, x
        return []


class PoseRows(_Fixed):
    """Savitzky-Golay derivatives of rows [position, quaternion wxyz], as in the batch problem, half a window (and a sample) late."""

    def __init__(self, window: int, step: float, gravity: FloatArray, tilt: FloatArray | None) -> None:
        super().__init__(window, step)
        self._gravity, self._tilt = gravity, tilt
        self._filters = rotation_filters(window, DERIVATIVE_ORDER, step)
        self._second = savgol_weights(window, DERIVATIVE_ORDER, 2, step)

    def push(self, piece: Piece) -> list[Piece]:
        """Rows whose window the new rows complete."""
        t, x = self._take(piece)
        # One row more on either side: the coning term of a step looks at its neighbours.
        half = self.window // 2 + 1
        if t.size <= 2 * half:
            return self._wait(t, x)
        inner = slice(half, t.size - half)
        steps = rotation_steps(x[:, 3:], self.step)
        rates = steps[1:-1] - coning(steps[1:-1], 0.5 * (steps[2:] - steps[:-2]))
        windows = sliding_window_view(rates, self.window - 1, axis=0)
        delta, w, al = np.matmul(windows, self._filters).transpose(2, 0, 1)
        positions = sliding_window_view(x[1:-1, :3], self.window, axis=0)
        acceleration = np.matmul(positions, self._second)
        rotation = lie.quaternion_wxyz_to_matrix(x[inner, 3:])
        if self._tilt is None:
            force = to_body(rotation, acceleration - self._gravity)
            # The smoothed rotation is R exp(delta), with a delta as small as the noise.
            turned = cross(delta, force)
            force = force - turned + 0.5 * cross(delta, turned)
        else:
            rotation = rotation @ lie.so3_exp(delta)
            force = to_body(rotation, acceleration - self._gravity)
        return self._give(t, x, inner, robot_rows(w, force, al, rotation, self._tilt))


class ImuRows(_Fixed):
    """Rows [w, f] of an IMU on the robot: its rate smoothed and differentiated, half a window late."""

    def push(self, piece: Piece) -> list[Piece]:
        """Rows whose window the new rows complete."""
        t, x = self._take(piece)
        half = self.window // 2
        if t.size <= 2 * half:
            return self._wait(t, x)
        inner = slice(half, t.size - half)
        w = signals.savgol_derivatives(x[:, :3], self.step, self.window, DERIVATIVE_ORDER, 0)[inner]
        al = signals.savgol_derivatives(x[:, :3], self.step, self.window, DERIVATIVE_ORDER, 1)[inner]
        return self._give(t, x, inner, robot_rows(w, x[inner, 3:6], al, None, None))


class RobotFeed:
    """Raw rows of the robot in, rows of z on a locally uniform grid out.

    Parameters
    ----------
    cutter : GapCutter
    averager : PoseAverager or None
    differentiator : Differentiator
    step : float
        s, nominal.
    regular : bool
        The stamps are uniform already; otherwise rows are interpolated to their nominal step first.
    finer_step : float or None
        s; step of the finer grid to which z is interpolated when the hand is sampled faster than the robot.
    poses : bool
    """

    def __init__(
        self,
        cutter: GapCutter,
        averager: PoseAverager | None,
        differentiator: Differentiator,
        step: float,
        regular: bool,
        finer_step: float | None,
        poses: bool,
    ) -> None:
        self._cutter, self._averager = cutter, averager
        self._differentiator = differentiator
        self._regulariser = (
            None if regular else GridInterpolator(step, interpolate_poses if poses else interpolate_rows)
        )
        self._refiner = None if finer_step is None else GridInterpolator(finer_step)

    def push(self, t: FloatArray, x: FloatArray, plain: bool = False) -> list[Piece]:
        """Pieces of z that settled rows x (m, c) with stamps t (m,) complete; `plain`: they are complete and regular."""
        pieces = self._cutter.cut(t, x, plain)
        if self._regulariser is not None:
            pieces = [out for piece in pieces for out in self._regulariser.push(piece)]
        if self._averager is not None:
            pieces = [out for piece in pieces for out in self._averager.push(piece)]
        pieces = [out for piece in pieces for out in self._differentiator.push(piece)]
        if self._refiner is not None:
            pieces = [out for piece in pieces for out in self._refiner.push(piece)]
        return pieces

"""What the human's wrist does while the robot excites: it rests, travels, moves in all six dimensions, or goes from A to B."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.motion_basis import BSplineBasis, minimum_jerk
from factorgrasp.typing import FloatArray


@dataclass(frozen=True, eq=False)
class HumanMotion:
    """The motion that the human wants of the wrist, over the duration of the excitation.

    Attributes
    ----------
    mode : str
        "static", "planar", "six_dof" or "task".
    duration : float
        s.
    position : callable
        Times (n,) to (3, 3, n): ``p_w_h``, its velocity and its acceleration.
    turn : callable
        Times (n,) to (3, n): rotation vector of the hand from its first orientation, in the hand's axes.
    rotation : ndarray, shape (3, 3)
        First orientation ``R_w_h``.
    axis : callable
        Times (n,) to (3, n): direction of travel in the world, zero where there is none.
    corners : tuple of float
        s; where the direction of travel changes.
    """

    mode: str
    duration: float
    position: Callable[[FloatArray], FloatArray]
    turn: Callable[[FloatArray], FloatArray]
    rotation: FloatArray
    axis: Callable[[FloatArray], FloatArray]
    corners: tuple[float, ...] = ()

    def orientation(self, t: FloatArray) -> FloatArray:
        """``R_w_h`` (n, 3, 3)."""
        return np.asarray(self.rotation @ lie.so3_exp(self.turn(t).T))

    def given(self, R_r_h: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Times (n,) to the numbers (24, n) of :mod:`factorgrasp.problems.excitation_expressions`, for a grasp."""

        def numbers(t: FloatArray) -> FloatArray:
            t = np.asarray(t, dtype=float)
            if t.size == 0:
                return np.empty((24, 0))
            R_d = self.orientation(t) @ R_r_h.T
            rate, change = self._rates(t)
            p = self.position(t)
            axis = np.einsum("nji,jn->in", R_d, self.axis(t))
            columns = R_d.transpose(2, 1, 0).reshape(9, -1)
            return np.concatenate([columns, R_r_h @ rate, R_r_h @ change, p[0], p[2], axis])

        return numbers

    def _rates(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Angular velocity and acceleration (3, n) in the hand's axes, by central differences of a smooth function."""
        step = 1e-4
        before, here, after = (self.turn(t + k * step) for k in (-1, 0, 1))
        if not np.any(before) and not np.any(after):
            return np.zeros((3, t.size)), np.zeros((3, t.size))
        E = lie.so3_exp(here.T)
        ahead = lie.so3_log(np.swapaxes(E, 1, 2) @ lie.so3_exp(after.T))
        behind = lie.so3_log(np.swapaxes(E, 1, 2) @ lie.so3_exp(before.T))
        return (ahead - behind).T / (2.0 * step), (ahead + behind).T / step**2


def _still(t: FloatArray) -> FloatArray:
    return np.zeros((3, np.size(t)))


def static_human(duration: float, position: FloatArray, rotation: FloatArray) -> HumanMotion:
    """The wrist rests (paper IV.A)."""

    def place(t: FloatArray) -> FloatArray:
        out = np.zeros((3, 3, np.size(t)))
        out[0] = np.asarray(position)[:, None]
        return out

    return HumanMotion("static", duration, place, _still, np.asarray(rotation), _still)


def planar_human(duration: float, waypoints: FloatArray, rotation: FloatArray) -> HumanMotion:
    """The wrist travels along straight legs between waypoints (k, 3), each with minimum jerk, and does not turn (paper IV.B).

    Raises
    ------
    InputError
        With fewer than two waypoints, or two equal ones in a row.
    """
    points = np.asarray(waypoints, dtype=float)
    legs = np.diff(points, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    if points.shape[0] < 2 or np.any(lengths < 1e-6):
        raise InputError(
            "human.waypoints",
            "at least two positions, each different from the one before",
            f"{points.tolist()}",
        )
    # Legs of equal peak acceleration take time as the root of their length.
    share = np.sqrt(lengths) / np.sum(np.sqrt(lengths))
    ends = np.concatenate([[0.0], np.cumsum(share) * duration])

    def leg(t: FloatArray) -> tuple[Any, FloatArray]:
        k = np.clip(np.searchsorted(ends, t, side="right") - 1, 0, len(legs) - 1)
        return k, (t - ends[k]) / (ends[k + 1] - ends[k])

    def place(t: FloatArray) -> FloatArray:
        k, s = leg(t)
        span = ends[k + 1] - ends[k]
        path = minimum_jerk(s)
        value = points[k].T + legs[k].T * path[0]
        return np.stack([value, legs[k].T * path[1] / span, legs[k].T * path[2] / span**2])

    def axis(t: FloatArray) -> FloatArray:
        k, _ = leg(t)
        return np.asarray((legs / lengths[:, None])[k].T)

    return HumanMotion(
        "planar", duration, place, _still, np.asarray(rotation), axis, tuple(ends[1:-1].tolist())
    )


def task_human(
    duration: float, start: tuple[FloatArray, FloatArray], goal: tuple[FloatArray, FloatArray]
) -> HumanMotion:
    """The wrist goes from pose A to pose B ``(position (3,), R_w_h (3, 3))`` with minimum jerk: the task that excites on its way."""
    (p_a, R_a), (p_b, R_b) = start, goal
    way, turn = np.asarray(p_b) - np.asarray(p_a), lie.so3_log(np.asarray(R_a).T @ np.asarray(R_b))
    length = float(np.linalg.norm(way))

    def place(t: FloatArray) -> FloatArray:
        path = minimum_jerk(np.asarray(t) / duration)
        value = np.asarray(p_a)[:, None] + np.outer(way, path[0])
        return np.stack([value, np.outer(way, path[1]) / duration, np.outer(way, path[2]) / duration**2])

    def axis(t: FloatArray) -> FloatArray:
        return np.tile((way / length if length > 0.0 else way)[:, None], (1, np.size(t)))

    return HumanMotion(
        "task", duration, place, lambda t: np.outer(turn, minimum_jerk(np.asarray(t) / duration)[0]), np.asarray(R_a), axis
    )  # fmt: skip


def recorded_human(
    t: FloatArray, position: FloatArray, rotation: FloatArray, duration: float, bandwidth: float = 3.0
) -> HumanMotion:
    """A recorded motion of the wrist in all six dimensions (paper IV.C), smoothed by B-splines of a bandwidth.

    Parameters
    ----------
    t : (n,) ndarray
        s, from 0 to at least `duration`.
    position : (n, 3) ndarray
        ``p_w_h``, m.
    rotation : (n, 3, 3) ndarray
        ``R_w_h``, less than half a turn from the first.
    duration, bandwidth : float
        s and Hz.
    """
    t = np.asarray(t, dtype=float) - float(t[0])
    if t[-1] < duration * (1.0 - 1e-9):
        raise InputError(
            "human.file", f"a recording of at least the duration, {duration:g} s", f"{t[-1]:g} s"
        )
    used = t <= duration
    basis = BSplineBasis(duration, bandwidth)
    B = basis.values(t[used]).T
    first = np.asarray(rotation[0])
    turn = lie.so3_log(first.T @ np.asarray(rotation)[used])
    if np.max(np.linalg.norm(turn, axis=1)) > 3.0:
        raise InputError(
            "human.file", "a hand that turns by less than half a turn from its first orientation", "more"
        )
    both = np.linalg.lstsq(B, np.hstack([np.asarray(position)[used], turn]), rcond=None)[0]

    def place(time: FloatArray) -> FloatArray:
        return np.stack([both[:, :3].T @ basis.values(time, d) for d in range(3)])

    return HumanMotion(
        "six_dof", duration, place, lambda time: both[:, 3:].T @ basis.values(time), first, _still
    )

"""Motions of a wrist with exact derivatives: anatomical angles and the joint's centre over time, and the pose that follows.

The angles compose as ``R_W0_W = R_y(flexion) R_z(deviation) R_x(pronation)``. The marker on the wrist is the origin of ``W``; it sits
on the skin, above the joint's centre, and so it moves when the wrist turns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.lie import so3_exp
from factorgrasp.typing import FloatArray

Motion: TypeAlias = Literal["abduction", "flexion", "pronation", "three_axes", "reach"]
MOTIONS: tuple[str, ...] = get_args(Motion)

JOINT_CENTER = (-0.010, 0.0, -0.015)
"""Centre of the wrist joint in ``W`` (m): behind the marker and under the skin."""

AMPLITUDES: dict[str, tuple[float, float, float]] = {
    "abduction": (0.0, 25.0, 0.0),
    "flexion": (45.0, 0.0, 0.0),
    "pronation": (0.0, 0.0, 40.0),
    "three_axes": (40.0, 22.0, 35.0),
    "reach": (0.0, 0.0, 0.0),
}
"""Half ranges of motion (deg) about y, z and x: flexion, deviation, pronation. 25 deg of abduction is the paper's Fig. 4."""

START = 0.5
"""The hand rests in the neutral posture until then (s)."""

_REACH_TO = (0.28, 0.06, 0.0)
_REACH_LIFT = (0.0, 0.0, 0.2)  # 50 mm half way
_REACH_ANGLES = np.deg2rad((-25.0, 8.0, -30.0))
_REACH_TIMES = (1.4, 0.8, 1.6, 0.7)  # there, hold, back, rest

_Signal: TypeAlias = Callable[[Any], Any]
"""From times (n,) to values (n, 3), analytic, so that a complex step differentiates it exactly."""


@dataclass(frozen=True, eq=False)
class WristMotion:
    """Where the wrist is at given times.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s.
    angles : ndarray, shape (n, 3)
        Rotations about y, z and x of ``W`` (rad): flexion, deviation, pronation.
    rotation : ndarray, shape (n, 3, 3)
        ``R_W0_W``.
    position : ndarray, shape (n, 3)
        ``p_W0_W`` (m).
    velocity : ndarray, shape (n, 3)
        Of the origin of ``W``, in ``W0`` (m/s).
    angular_velocity : ndarray, shape (n, 3)
        Of ``W``, in ``W`` (rad/s).
    """

    t: FloatArray
    angles: FloatArray
    rotation: FloatArray
    position: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray

    @property
    def pose(self) -> FloatArray:
        """``T_W0_W``, shape (n, 4, 4)."""
        out = np.zeros((self.t.size, 4, 4))
        out[:, :3, :3], out[:, :3, 3], out[:, 3, 3] = self.rotation, self.position, 1.0
        return out


def wrist_motion(motion: str, t: FloatArray, seed: int = 0, speed: float = 1.0) -> WristMotion:
    """One of the paper's movements.

    Parameters
    ----------
    motion : {"abduction", "flexion", "pronation", "three_axes", "reach"}
    t : ndarray, shape (n,)
        s; at 0 the pose is the identity.
    seed : int
        Of the periods, of the small turns about the other axes and of the arm's sway.
    speed : float
        1: cycles of about 2.5 s, reaching in 1.4 s.

    Raises
    ------
    InputError
        For an unknown motion.
    """
    if motion not in MOTIONS:
        raise InputError("motion", "one of " + ", ".join(map(repr, MOTIONS)), repr(motion))
    angles, center = _signals(motion, np.random.default_rng([seed, 2014]), speed)
    t = np.asarray(t, dtype=np.float64)
    phi, dphi = _derivative(angles, t)
    c, dc = _derivative(center, t)
    y, z, x = np.eye(3)[[1, 2, 0]]
    R_y, R_z, R_x = (so3_exp(phi[:, k, None] * axis) for k, axis in enumerate((y, z, x)))
    R = R_y @ R_z @ R_x
    R_zx = R_z @ R_x
    # Each axis' rate, seen from W: v @ R is R' v.
    w = dphi[:, :1] * (y @ R_zx) + dphi[:, 1:2] * (z @ R_x) + dphi[:, 2:] * x
    offset = np.array(JOINT_CENTER)
    position = c + offset - R @ offset
    velocity = dc - np.einsum("nij,nj->ni", R, np.cross(w, offset))
    return WristMotion(t, phi, R, position, velocity, w)


def _derivative(signal: _Signal, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    step = 1e-20
    value = signal(t + 1j * step)
    return value.real.copy(), value.imag / step


def _signals(motion: str, rng: np.random.Generator, speed: float) -> tuple[_Signal, _Signal]:
    amplitude = np.deg2rad(AMPLITUDES[motion])
    period = np.array([2.9, 2.5, 3.3]) * rng.uniform(0.95, 1.05, 3) / speed
    phase = np.where(np.count_nonzero(amplitude) > 1, rng.uniform(0.0, 2.0 * np.pi, 3), 0.0)
    # Nobody turns about one axis alone, and no arm is quite still.
    stray = np.where(amplitude == 0.0, np.deg2rad(2.5), 0.0)
    stray_f, stray_phase = rng.uniform(0.15, 0.45, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
    sway_f, sway_phase = rng.uniform(0.1, 0.4, (2, 3)), rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    sway = np.array([0.004, 0.0015])

    def angles(t: Any) -> Any:
        after = t - START
        turn = amplitude * np.sin(2.0 * np.pi * after[:, None] / period + phase)
        small = stray * (np.sin(2.0 * np.pi * stray_f * t[:, None] + stray_phase) - np.sin(stray_phase))
        out = _ramp(after / 0.8)[:, None] * turn + _ramp(t / 2.0)[:, None] * small
        if motion == "reach":
            out = out + _there_and_back(t, speed)[:, None] * _REACH_ANGLES
        return out

    def center(t: Any) -> Any:
        out = sum(
            a * (np.sin(2.0 * np.pi * f * t[:, None] + p) - np.sin(p))
            for a, f, p in zip(sway, sway_f, sway_phase, strict=True)
        )
        out = _ramp(t / 2.0)[:, None] * out
        if motion == "reach":
            s = _there_and_back(t, speed)
            out = out + s[:, None] * np.array(_REACH_TO) + (s * (1.0 - s))[:, None] * np.array(_REACH_LIFT)
        return out

    return angles, center


def _ramp(s: Any) -> Any:
    """Minimum-jerk step from 0 at 0 to 1 at 1."""
    inside = s**3 * (10.0 + s * (6.0 * s - 15.0))
    return np.where(s.real <= 0.0, 0.0 * s, np.where(s.real >= 1.0, 1.0 + 0.0 * s, inside))


def _there_and_back(t: Any, speed: float) -> Any:
    there, hold, back, rest = (time / speed for time in _REACH_TIMES)
    cycle = there + hold + back + rest
    after = t - START
    phase = np.where(after.real > 0.0, after - cycle * np.floor(after.real / cycle), 0.0 * after)
    return _ramp(phase / there) - _ramp((phase - there - hold) / back)

"""A smooth curve by the samples of a pose stream: poses and velocities at any time, never across a gap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp import lie, signals
from factorgrasp.errors import InputError
from factorgrasp.problems.grasp_kinematics import gap_limit
from factorgrasp.recordings import PoseStream
from factorgrasp.typing import BoolArray, FloatArray, IntArray

# White noise is read off differences of this order: a hand's motion hardly reaches them.
# Nobody's hand makes a corner in this time (s).
_LONGEST_SMOOTHING = 0.1


def transposed(R: FloatArray) -> FloatArray:
    """``R'`` of every matrix of a stack."""
    return np.swapaxes(R, -1, -2)


def apply(R: FloatArray, v: FloatArray) -> FloatArray:
    """``R v`` for stacks of matrices and vectors."""
    return np.asarray(np.matmul(R, v[..., None])[..., 0])


@dataclass(frozen=True)
class CurvePoints:
    """Poses between samples, with the velocities of that motion.

    Attributes
    ----------
    rotation : (n, 3, 3) ndarray
    position : (n, 3) ndarray
    angular_velocity : (n, 3) ndarray
        rad/s, body frame.
    velocity : (n, 3) ndarray
        m/s, world frame.
    inside : (n,) ndarray
        Whether the time lies between two samples without a gap between them.
    """

    rotation: FloatArray
    position: FloatArray
    angular_velocity: FloatArray
    velocity: FloatArray
    inside: BoolArray


@dataclass(frozen=True)
class PoseCurve:
    """A smooth curve by the complete samples of a pose stream, in stretches without gaps.

    At a sample: pose and velocity of the parabola fitted to the `half_width` samples on either side (1: through the sample itself).
    Between samples: the cubic with these ends (Hermite), rotations in rotation vectors from the sample before. Straight lines and
    great arcs would leave velocities that jump at every sample, and noisy samples an interpolated noise that is smallest between two of
    them: either way the time offset goes astray.

    Attributes
    ----------
    t : (n,) ndarray
        s.
    rotation, position : (n, 3, 3) and (n, 3) ndarray
    turn, leaving, arriving : (n - 1, 3) ndarray
        From each sample to the next: rotation vector (rad), and its rate at both ends (rad/s).
    velocity : (n, 3) ndarray
        World frame, m/s.
    stretch : (n,) ndarray of int
        Counts the stretches without gaps.
    step : float
        Median step of the stream, s.
    noise : (2, 2) ndarray
        White noise of [rotation; position] (rad, m) and of their velocities (rad/s, m/s) per axis.
    """

    t: FloatArray
    rotation: FloatArray
    position: FloatArray
    turn: FloatArray
    leaving: FloatArray
    arriving: FloatArray
    velocity: FloatArray
    stretch: IntArray
    step: float
    noise: FloatArray

    @classmethod
    def from_stream(cls, stream: PoseStream, max_gap: float | None, smooth: bool = False) -> PoseCurve:
        """Incomplete rows are left out; what is then further apart than the limit is a gap.

        With `smooth`, the parabolas are as wide as the noise needs for velocities of a fifth of the motion's, at most 0.1 s.
        """
        good = stream.valid
        t, R, p = stream.t[good], stream.rotation[good], stream.position[good]
        if t.size < 2:
            raise InputError(stream.name, "at least two complete poses", str(t.size))
        stretch = np.concatenate([[0], np.cumsum(np.diff(t) > gap_limit(stream.t, max_gap))]).astype(np.intp)
        sd = _white_noise(R, p, stretch)
        half = _half_width(R, p, stream.step, sd) if smooth else 1
        fit, rates = _local_parabolas(t, R, p, stretch, half)
        R = R @ lie.so3_exp(fit[:, :3])
        rate = apply(lie.so3_right_jacobian(fit[:, :3]), rates[:, :3])
        turn = lie.so3_log(transposed(R[:-1]) @ R[1:])
        squares = np.arange(-half, half + 1.0) ** 2
        # Variance of the middle and of the slope of a parabola fitted to uniform samples.
        middle = (squares**2).sum() / (squares.size * (squares**2).sum() - squares.sum() ** 2)
        slope = 1.0 / squares.sum() / stream.step**2
        return cls(
            t,
            R,
            p + fit[:, 3:],
            turn,
            rate[:-1],
            apply(lie.so3_right_jacobian_inverse(turn), rate[1:]),
            rates[:, 3:],
            stretch,
            stream.step,
            np.stack([sd * np.sqrt(middle), sd * np.sqrt(slope)]),
        )

    def at(self, times: FloatArray) -> CurvePoints:
        """Interpolated poses; outside of stretches the values mean nothing and `inside` is False."""
        i = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, self.t.size - 2)
        h = (self.t[i + 1] - self.t[i])[:, None]
        u = (times[:, None] - self.t[i, None]) / h
        inside = (u[:, 0] >= 0.0) & (u[:, 0] <= 1.0) & (self.stretch[i] == self.stretch[i + 1])
        u = np.clip(u, 0.0, 1.0)
        phi, phi_slope = _hermite(u, self.turn[i], h * self.leaving[i], h * self.arriving[i])
        way = self.position[i + 1] - self.position[i]
        moved, moved_slope = _hermite(u, way, h * self.velocity[i], h * self.velocity[i + 1])
        return CurvePoints(
            self.rotation[i] @ lie.so3_exp(phi),
            self.position[i] + moved,
            apply(lie.so3_right_jacobian(phi), phi_slope) / h,
            moved_slope / h,
            inside,
        )

    def covers(self, times: FloatArray, margin: float) -> BoolArray:
        """Whether ``[t - margin, t + margin]`` lies within one stretch."""
        first = np.searchsorted(self.t, times - margin, side="right") - 1
        last = np.searchsorted(self.t, times + margin, side="left")
        within = (first >= 0) & (last < self.t.size)
        return np.asarray(
            within & (self.stretch[np.maximum(first, 0)] == self.stretch[np.minimum(last, self.t.size - 1)])
        )


def _white_noise(R: FloatArray, p: FloatArray, stretch: IntArray) -> FloatArray:
    """White noise (rad, m) per axis; no difference reaches across the end of a stretch."""
    rotation, position = lie.matrix_to_quaternion_wxyz(R, continuous=True), p.copy()
    ends = np.flatnonzero(stretch[1:] != stretch[:-1]) + 1
    rotation, position = np.insert(rotation, ends, np.nan, axis=0), np.insert(position, ends, np.nan, axis=0)
    return np.array([signals.rotation_noise_sd(rotation), signals.white_noise_sd(position)])


def _half_width(R: FloatArray, p: FloatArray, step: float, sd: FloatArray) -> int:
    """Samples on either side that a parabola needs for velocities with a fifth of the motion's rms as noise."""
    most = max(1, int(_LONGEST_SMOOTHING / step))
    lag = min(most, len(p) - 1)
    moved = np.stack([lie.so3_log(transposed(R[:-lag]) @ R[lag:]), p[lag:] - p[:-lag]])
    motion = np.sqrt(np.maximum((moved**2).sum(axis=2).mean(axis=1) - 6.0 * sd**2, 0.0)) / lag
    half = 1
    while half < most and np.any(
        np.sqrt(3.0 / (half * (half + 1) * (2 * half + 1) / 3.0)) * sd > 0.2 * motion
    ):
        half += 1
    return half


def _local_parabolas(
    t: FloatArray, R: FloatArray, p: FloatArray, stretch: IntArray, half: int
) -> tuple[FloatArray, FloatArray]:
    """Middle (n, 6), relative to the sample, and slope (n, 6) of parabolas in [rotation vector; position]."""
    n = t.size
    index = np.arange(n)[:, None] + np.arange(-half, half + 1)
    inside = (index >= 0) & (index < n)
    index = np.clip(index, 0, n - 1)
    inside &= stretch[index] == stretch[:, None]
    turn = lie.so3_log(transposed(R)[:, None] @ R[index])
    values = np.concatenate([turn, p[index] - p[:, None]], axis=2)
    scale = half * float(np.median(np.diff(t)))
    x = (t[index] - t[:, None]) / scale
    design = np.stack([np.ones_like(x), x, x * x], axis=2) * inside[:, :, None]
    normal = transposed(design) @ design
    # Two samples make a line, a lonely one stands still: hardly any curvature or slope is as good as none.
    normal[:, 1, 1] += 1e-12
    normal[:, 2, 2] += 1e-10
    fit = np.linalg.solve(normal, transposed(design) @ values)
    return fit[:, 0], fit[:, 1] / scale


def _hermite(
    u: FloatArray, way: FloatArray, leaving: FloatArray, arriving: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Cubic from 0 (u = 0) to `way` (u = 1) with the given slopes in u, and its slope."""
    rest = 1.0 - u
    value = (3.0 - 2.0 * u) * u**2 * way + u * rest**2 * leaving - u**2 * rest * arriving
    slope = 6.0 * u * rest * way + rest * (1.0 - 3.0 * u) * leaving + u * (3.0 * u - 2.0) * arriving
    return value, slope

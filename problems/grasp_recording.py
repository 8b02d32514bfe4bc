"""Both sides of a grasp recording brought onto one grid and into spectral windows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp import signals
from factorgrasp.errors import InputError
from factorgrasp.problems.grasp_averaging import average, averaged_samples
from factorgrasp.problems.grasp_kinematics import RobotKinematics, gap_limit, uniform_grid
from factorgrasp.problems.grasp_model import VECH
from factorgrasp.problems.grasp_settings import GraspSettings
from factorgrasp.problems.grasp_windows import Windowing, finite_windows
from factorgrasp.recordings import ImuStream
from factorgrasp.typing import BoolArray, FloatArray

# Below this the two angular rates are not the same motion at any offset.
SMALLEST_CORRELATION = 0.5
# Gyroscopes are off by a few per cent; a larger factor between the rates of one body is a wrong unit.
_LARGEST_GAIN = 1.3
# Steps by which two uniform clocks may drift apart over a recording and still be called the same grid.
_DRIFT = 1e-3


@dataclass(frozen=True)
class HandSignals:
    """The hand IMU: angular velocity and specific force side by side in `both` (n, 6); rows with NaN are gaps."""

    t: FloatArray
    both: FloatArray
    limit: float
    uniform: bool

    @property
    def angular_velocity(self) -> FloatArray:
        """(n, 3), rad/s."""
        return self.both[:, :3]

    @classmethod
    def from_stream(cls, hand: ImuStream, max_gap: float | None) -> HandSignals:
        """Samples as they are; only rows with a NaN become gaps as a whole."""
        both = np.hstack([hand.angular_velocity, hand.specific_force])
        both[~hand.valid] = np.nan
        return cls(hand.t, both, gap_limit(hand.t, max_gap), uniform_grid(hand.t)[1])

    def at(self, times: FloatArray) -> FloatArray:
        """Angular velocity and specific force (n, 6) at other, uniform times of the hand's clock; NaN in gaps and outside."""
        if self.uniform:
            step = (self.t[-1] - self.t[0]) / (self.t.size - 1)
            first, last = (times[0] - self.t[0]) / step, (times[-1] - self.t[0]) / step
            if abs((last - first) - (times.size - 1)) < _DRIFT:
                return shifted_rows(self.both, 0.5 * (first + last - (times.size - 1)), times.size)
        return signals.resample_uniform(self.t, self.both, times, max_gap=self.limit, kind="cubic")[1]


def shifted_rows(x: FloatArray, start: float, count: int) -> FloatArray:
    """Rows ``start, start + 1, ...`` of x (n, c), `start` not whole, by the four-point Lagrange polynomial; NaN where it lacks a row."""
    whole = int(np.floor(start + 1e-9))
    u = start - whole
    out = np.full((count, x.shape[1]), np.nan)
    if abs(u) < 1e-6:
        low, high = max(0, -whole), min(count, x.shape[0] - whole)
        if high > low:
            out[low:high] = x[low + whole : high + whole]
        return out
    weights = (
        -u * (u - 1.0) * (u - 2.0) / 6.0,
        (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0,
        -(u + 1.0) * u * (u - 2.0) / 2.0,
        (u + 1.0) * u * (u - 1.0) / 6.0,
    )
    low, high = max(0, 1 - whole), min(count, x.shape[0] - whole - 2)
    if high > low:
        part = weights[0] * x[low + whole - 1 : high + whole - 1]
        for offset in (0, 1, 2):
            part += weights[offset + 1] * x[low + whole + offset : high + whole + offset]
        out[low:high] = part
    return out


@dataclass(frozen=True)
class CoupledWindows:
    """Coefficients of z_g and z_a in every window without gaps.

    Attributes
    ----------
    gyro, accelerometer : (windows, bins, 2, 10) and (windows, bins, 2, 19 or 25) ndarray
    t : (windows,) ndarray
        Centres, s, robot clock.
    dropped : int
        Windows left out because they touch a gap.
    """

    gyro: FloatArray
    accelerometer: FloatArray
    t: FloatArray
    dropped: int


@dataclass(frozen=True)
class CouplingGrid:
    """The robot side on the common grid, ready to be coupled with the hand at any time offset.

    Products are formed at the full rate; then every entry of z is averaged over `averaged` samples, which
    keeps the relations exact and the windows short.
    """

    t: FloatArray
    fine: FloatArray
    averaged: int
    coefficients: FloatArray
    windowing: Windowing
    tilted: bool
    mean_force: FloatArray
    rate_moment: FloatArray

    def couple(self, hand: HandSignals, time_offset: float) -> CoupledWindows:
        """Windows of z with the hand's signals read at ``t + time_offset``."""
        values = average(hand.at(self.fine + time_offset), self.averaged)
        step = self.windowing.step
        slope = np.full_like(values, np.nan)
        slope[1:-1] = (values[2:] - values[:-2]) / (2.0 * step)
        hand_side = self.windowing.transform(np.hstack([values, slope]))
        good = finite_windows(self.coefficients, hand_side)
        robot = self.coefficients[good]
        hand_part = hand_side[good]
        one = np.broadcast_to(self.windowing.constant()[None, :, :, None], (*robot.shape[:3], 1))
        gyro = np.concatenate([robot[..., 0:3], hand_part[..., 0:3], hand_part[..., 6:9], one], axis=3)
        parts = [robot[..., 3:15], hand_part[..., 3:6], hand_part[..., 9:12], one]
        if self.tilted:
            parts.append(robot[..., 15:21])
        accelerometer = np.concatenate(parts, axis=3)
        centres = self.t[0] + self.windowing.centres(good.size)
        return CoupledWindows(gyro, accelerometer, centres[good], int(np.count_nonzero(~good)))


def vech_products(w: FloatArray) -> FloatArray:
    """``vech(w w')`` of every row, (n, 6)."""
    out = np.empty((w.shape[0], 6))
    for k, (i, j) in enumerate(VECH):
        np.multiply(w[:, i], w[:, j], out=out[:, k])
    return out


def tilt_axes(gravity: FloatArray) -> FloatArray:
    """``E`` (3, 2): change of gravity (m/s^2, world frame) per rad of tilt about the two horizontal axes."""
    size = float(np.linalg.norm(gravity))
    down = gravity / size
    seed = np.eye(3)[int(np.argmin(np.abs(down)))]
    first = np.cross(down, seed)
    first /= np.linalg.norm(first)
    return np.asarray(size * np.column_stack([first, np.cross(down, first)]))


def coupling_grid(
    robot: RobotKinematics, hand_rate: float, bandwidth: float, window: float, tilt: FloatArray | None
) -> CouplingGrid:
    """Products of the robot's signals on the finer of the two grids, in windows.

    Parameters
    ----------
    robot : RobotKinematics
    hand_rate : float
        Hz.
    bandwidth, window : float
        Hz and s.
    tilt : (3, 2) ndarray or None
        Axes of the base tilt, when it is estimated.
    """
    parts = [robot.specific_force, robot.angular_acceleration, vech_products(robot.angular_velocity)]
    if tilt is not None:
        if robot.rotation is None:
            raise InputError("estimate.base_tilt", "a robot stream with orientations", "one without")
        parts += [np.matmul(robot.rotation.transpose(0, 2, 1), tilt[:, i]) for i in (0, 1)]
    z, t, step = np.hstack([robot.angular_velocity, *parts]), robot.t, robot.step
    if robot.averaged > 1:
        # The robot's signals are means over their step already; the hand's are averaged over the same.
        averaged = max(robot.averaged, round(hand_rate * step))
        inside = ((np.arange(averaged) + 0.5) / averaged - 0.5) * step
        fine = (t[:, None] + inside).ravel()
    else:
        if hand_rate > 1.05 / step:
            # The hand is sampled faster: its extra samples carry information, so the smooth robot side goes
            # onto a finer grid.
            t = t[0] + np.arange(int((t[-1] - t[0]) * hand_rate) + 1) / hand_rate
            z = signals.resample_uniform(robot.t, z, t, max_gap=1.6 * step, kind="cubic")[1]
        step = float((t[-1] - t[0]) / (t.size - 1))
        averaged = averaged_samples(step, bandwidth)
        z, fine, t = average(z, averaged), t, average(t[:, None], averaged)[:, 0]
        step *= averaged
    windowing = Windowing.for_grid(step, window, bandwidth, t.size)
    rows = z[np.isfinite(z).all(axis=1)]
    if rows.shape[0] == 0:
        raise InputError(
            "robot", "at least one stretch without gaps", "none: every differentiation window touches a gap"
        )
    return CouplingGrid(
        t=t,
        fine=fine,
        averaged=averaged,
        coefficients=windowing.transform(z),
        windowing=windowing,
        tilted=tilt is not None,
        mean_force=rows[:, 3:6].mean(axis=0),
        rate_moment=rows[:, :3].T @ rows[:, :3] / rows.shape[0],
    )


@dataclass(frozen=True)
class ClockSearch:
    """Result of the coarse search for the time offset.

    Attributes
    ----------
    offset : float
        s, hand clock minus robot clock.
    correlation : float
        Of the two angular rates at it, rotation and bias removed, 0 to 1.
    ambiguity : float
        Second highest peak over the highest, 0 to 1.
    gain : float
        Rate of the hand per rate of the robot, best rotation removed: 1 for one body in the same unit.
    """

    offset: float
    correlation: float
    ambiguity: float
    gain: float = 1.0


def search_time_offset(
    robot: RobotKinematics, hand: HandSignals, guess: float, reach: float, bandwidth: float
) -> ClockSearch:
    """Coarse offset from the rotation-invariant correlation of the two angular rates.

    For every lag the best rotation between the rates is Wahba's; what it explains is the sum of the singular
    values of their cross-correlation (the least of them signed by the determinant). Unlike the correlation of
    the norms, this sees coning, whose norm is constant.

    Raises
    ------
    InputError
        When the recordings do not overlap at any offset within reach.
    """
    step = max(robot.step, 1.0 / max(4.0 * bandwidth, 40.0))
    grid = np.arange(robot.t[0], robot.t[-1], step)
    if grid.size < 16:
        raise InputError("robot", "a recording of at least 16 samples", f"{grid.size}")
    x = signals.resample_uniform(
        robot.t, robot.angular_velocity, grid, max_gap=max(1.6 * robot.step, 1.1 * step)
    )[1]
    hand_grid = np.arange(grid[0] + guess - reach, grid[-1] + guess + reach + step, step)
    y = signals.resample_uniform(
        hand.t, hand.angular_velocity, hand_grid, max_gap=max(hand.limit, 1.1 * step)
    )[1]
    correlations = _rotation_invariant_correlation(x, y)
    lags: FloatArray = guess - reach + step * np.arange(correlations.size, dtype=np.float64)
    if correlations.size == 0 or not np.any(np.isfinite(y)):
        raise InputError(
            "robot and hand",
            "recordings that overlap in time",
            f"robot {robot.t[0]:.6g} to {robot.t[-1]:.6g} s, hand {hand.t[0]:.6g} to {hand.t[-1]:.6g} s",
            "Put both on one time base, or widen estimate.max_time_offset",
        )
    if not np.isfinite(correlations).any():
        # One side does not rotate at all: no offset can be found, and none matters.
        return ClockSearch(guess, 0.0, 1.0)
    found = _best_peak(lags, np.nan_to_num(correlations, nan=-1.0), guess, step)
    if found.correlation < SMALLEST_CORRELATION:
        return found
    return _sharpened(found, grid, x, hand, min(step, reach))


def find_clock(
    robot: RobotKinematics, hand: HandSignals, settings: GraspSettings, bandwidth: float
) -> ClockSearch:
    """Coarse time offset as the settings ask for it; the guess where there is no common motion to find one by.

    Raises
    ------
    InputError
        When the two sides turn together, but one of them faster than a sensor's error explains.
    """
    guess = settings.time_offset_guess
    # Without a search the correlation at the guess is still wanted: it tells whether the two sides moved together at all.
    reach = settings.max_time_offset if settings.time_offset else 1e-9
    found = search_time_offset(robot, hand, guess, reach, bandwidth)
    if not settings.time_offset or found.correlation < SMALLEST_CORRELATION:
        found = ClockSearch(guess, found.correlation, found.ambiguity, found.gain)
    if found.correlation > SMALLEST_CORRELATION and not 1.0 / _LARGEST_GAIN < found.gain < _LARGEST_GAIN:
        side, factor = ("hand", found.gain) if found.gain > 1.0 else ("robot", 1.0 / found.gain)
        suspicion = " (180/pi = 57.3: degrees suspected)" if 45.0 < factor < 70.0 else ""
        raise InputError(
            f"{side} angular velocity",
            "rad/s on both sides, which turn as one body",
            f"rates that are {factor:.3g} times those of the other side{suspicion}",
            "Declare the unit in the file's header, e.g. wx [deg/s], or mend the sensor's scale",
        )
    return found


def _sharpened(
    found: ClockSearch, grid: FloatArray, x: FloatArray, hand: HandSignals, most: float
) -> ClockSearch:
    """One Gauss-Newton step on the offset with rotation and bias held.

    The parabola through the correlation's peak is a few tenths of a step off.
    """
    step = float(grid[1] - grid[0])
    y = signals.resample_uniform(
        hand.t, hand.angular_velocity, grid + found.offset, max_gap=max(hand.limit, 1.1 * step), kind="cubic"
    )[1]
    slope = np.full_like(y, np.nan)
    slope[1:-1] = (y[2:] - y[:-2]) / (2.0 * step)
    good: BoolArray = np.asarray(np.isfinite(np.hstack([x, slope, y])).all(axis=1))
    if np.count_nonzero(good) < 16:
        return found
    a, b, d = (part[good] - part[good].mean(axis=0) for part in (x, y, slope))
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    turned = d @ R.T
    shift = float(np.sum(turned * (a - b @ R.T)) / max(np.sum(turned**2), 1e-300))
    gain = float(np.sum(a * (b @ R.T)) / max(np.sum(a**2), 1e-300))
    return ClockSearch(
        found.offset + float(np.clip(shift, -most, most)), found.correlation, found.ambiguity, gain
    )


def _rotation_invariant_correlation(x: FloatArray, y: FloatArray) -> FloatArray:
    """Correlation (lags,) of x (n, 3) with every stretch of y (m, 3), m >= n, best rotation and means removed."""
    from scipy import fft

    good_x: BoolArray = np.asarray(np.isfinite(x).all(axis=1))
    good_y: BoolArray = np.asarray(np.isfinite(y).all(axis=1))
    if good_x.sum() < 8 or good_y.sum() < 8:
        return np.full(y.shape[0] - x.shape[0] + 1, np.nan)
    a = np.where(good_x[:, None], x - x[good_x].mean(axis=0), 0.0)
    b = np.where(good_y[:, None], y - y[good_y].mean(axis=0), 0.0)
    size = fft.next_fast_len(x.shape[0] + y.shape[0], real=True)
    lags = y.shape[0] - x.shape[0] + 1

    def slide(left: FloatArray, right: FloatArray) -> FloatArray:
        product = np.conj(fft.rfft(left, size, axis=0)) * fft.rfft(right, size, axis=0)
        return np.asarray(fft.irfft(product, size, axis=0)[:lags])

    mask_x, mask_y = good_x.astype(float)[:, None], good_y.astype(float)[:, None]
    pairs = slide(mask_x, mask_y)[:, 0]
    energy_x = slide(np.sum(a**2, axis=1, keepdims=True), mask_y)[:, 0]
    energy_y = slide(mask_x, np.sum(b**2, axis=1, keepdims=True))[:, 0]
    cross = np.stack([slide(a[:, i : i + 1], b) for i in range(3)], axis=1)
    singular = np.linalg.svd(cross, compute_uv=False)
    best = singular[:, 0] + singular[:, 1] + np.sign(np.linalg.det(cross)) * singular[:, 2]
    scale = np.sqrt(np.maximum(energy_x, 0.0) * np.maximum(energy_y, 0.0))
    enough = (pairs > 0.25 * min(good_x.sum(), good_y.sum())) & (scale > 1e-9 * max(scale.max(), 1e-300))
    return np.where(enough, best / np.where(scale > 0, scale, 1.0), np.nan)


def _best_peak(lags: FloatArray, r: FloatArray, guess: float, step: float) -> ClockSearch:
    inner = (r[1:-1] >= r[:-2]) & (r[1:-1] > r[2:])
    peaks = np.flatnonzero(inner) + 1
    if peaks.size == 0:
        return ClockSearch(float(lags[int(np.argmax(r))]), float(r.max()), 1.0)
    top = float(r[peaks].max())
    # A periodic motion has many equal peaks: the one nearest to the guess is the only defensible choice.
    near = peaks[r[peaks] > top - 0.01]
    best = int(near[int(np.argmin(np.abs(lags[near] - guess)))])
    others = peaks[peaks != best]
    bend = r[best - 1] - 2.0 * r[best] + r[best + 1]
    shift = 0.5 * (r[best - 1] - r[best + 1]) / bend if bend < 0.0 else 0.0
    second = float(r[others].max()) if others.size else 0.0
    return ClockSearch(float(lags[best] + shift * step), float(r[best]), max(second, 0.0) / max(top, 1e-12))


def used_samples(grid: CouplingGrid, windows: CoupledWindows) -> BoolArray:
    """Grid samples that lie in at least one window that was used, (n,)."""
    out = np.zeros(grid.t.size, dtype=bool)
    half = grid.windowing.length // 2
    starts = np.rint((windows.t - grid.t[0]) / grid.windowing.step).astype(int) - half
    for start in starts:
        out[start : start + 2 * half] = True
    return out


__all__ = [
    "SMALLEST_CORRELATION",
    "ClockSearch",
    "CoupledWindows",
    "CouplingGrid",
    "HandSignals",
    "coupling_grid",
    "find_clock",
    "search_time_offset",
    "shifted_rows",
    "tilt_axes",
    "used_samples",
    "vech_products",
]

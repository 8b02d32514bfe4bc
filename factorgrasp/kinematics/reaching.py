"""Movements of the wrist as a point: where they begin and end, path length, straightness, peak speed, smoothness.

The speed of a track that a camera's pixels gave is noisy at high frequencies, where an arm does nothing. So ways and speed profiles are
those of the motion up to :data:`BANDWIDTH`, and jerk, whose noise grows with the seventh power of frequency, goes up to the second
harmonic of a movement's duration. A movement begins and ends where its speed crosses a tenth of its peak, or where it is least when the
wrist does not come to rest between two movements.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.kinematics.measure import Measure, measured
from factorgrasp.kinematics.smoothness import (
    log_dimensionless_jerk,
    low_pass,
    second_derivative,
    spectral_arc_length,
)
from factorgrasp.typing import FloatArray, JsonDict

BANDWIDTH = 4.0
"""Hz, of ways and speed profiles."""
JERK_HARMONICS = 2.0
"""Jerk is that of the motion up to so many times the inverse of a movement's duration."""
ONSET = 0.1
"""Share of the peak speed at which a movement begins and ends."""
SMALLEST = 0.05
"""Shorter ways (m) are no reaching."""

_SMALLER_PEAKS = 0.3
_VALLEY = 0.5
"""A speed that falls below this share of the peak and rises again by half as much parts two movements."""
_NEAR = 0.2
"""s: the drawn tracks' movements begin and end that near to the estimated one's."""
_LARGEST_GAP = 2.5
_UNITS = {
    "distance": "m",
    "path_length": "m",
    "straightness": "",
    "peak_speed": "m/s",
    "sparc": "",
    "ldlj": "",
}


@dataclass(frozen=True)
class Movement:
    """One movement of the wrist from rest to rest.

    Attributes
    ----------
    start, end : float
        s.
    time_to_peak : float
        From the start to the largest speed (s).
    distance : Measure
        From the first to the last position (m).
    path_length : Measure
        Along the way (m).
    straightness : Measure
        Distance over path length; 1 for a straight line.
    peak_speed : Measure
        m/s.
    sparc : Measure
        Spectral arc length of the speed; about -1.5 for minimum jerk, less when less smooth.
    ldlj : Measure
        Log dimensionless jerk; about -5 for minimum jerk, less when less smooth. NaN when the track's noise hides it.
    """

    start: float
    end: float
    time_to_peak: float
    distance: Measure
    path_length: Measure
    straightness: Measure
    peak_speed: Measure
    sparc: Measure
    ldlj: Measure

    def to_dict(self) -> JsonDict:
        """Plain numbers."""
        out: JsonDict = {}
        for field in fields(self):
            value = getattr(self, field.name)
            out[field.name] = value.to_dict() if isinstance(value, Measure) else value
        return out


def movements(
    t: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    position_samples: FloatArray,
    velocity_samples: FloatArray,
    smallest: float = SMALLEST,
    onset: float = ONSET,
    bandwidth: float = BANDWIDTH,
) -> tuple[Movement, ...]:
    """All movements of a smoothed track, in order.

    Parameters
    ----------
    t : ndarray, shape (n,)
        s.
    position, velocity : ndarray, shape (n, 3)
        m, m/s; NaN where they are not known. A movement that touches a gap, or within a window of the ends of the track, is left out.
    position_samples, velocity_samples : ndarray, shape (K, n, 3)
        Drawn tracks, from which the standard deviations come.
    smallest : float
        Least distance (m).
    onset : float
        Share of the peak speed.
    bandwidth : float
        Hz.
    """
    if t.size < 5:
        raise InputError("t", "at least five frames", f"{t.size}")
    dt = float(np.median(np.diff(t)))
    clock = np.arange(t[0], t[-1] + 1e-9, dt)
    rate = 1.0 / dt
    p, v = (
        on_clock(clock, t, np.concatenate([one[None], drawn]))
        for one, drawn in ((position, position_samples), (velocity, velocity_samples))
    )
    p, slow = low_pass(p, rate, bandwidth), low_pass(v, rate, bandwidth)
    speed = np.nan_to_num(np.linalg.norm(slow[0], axis=1), nan=0.0)
    known = np.isfinite(slow[0]).all(axis=1) & np.isfinite(p[0]).all(axis=1)
    out = []
    for first, peak, last in _stretches(speed, onset):
        # One sample more on each side: the crossing lies between two.
        if first < 1 or last + 2 > clock.size or last - first < 4 or not known[first - 1 : last + 2].all():
            continue
        made = _movement(clock, p, v, slow, (first, peak, last), onset, rate, smallest)
        if made is not None:
            out.append(made)
    return tuple(out)


def on_clock(clock: FloatArray, t: FloatArray, values: FloatArray) -> FloatArray:
    """Values (K, n, 3) at the times of a uniform clock, linearly between frames that follow each other closely; else NaN."""
    before = np.clip(np.searchsorted(t, clock, side="right") - 1, 0, t.size - 2)
    span = t[before + 1] - t[before]
    share = np.where(span <= _LARGEST_GAP * (clock[1] - clock[0]), (clock - t[before]) / span, np.nan)
    # A frame exactly on the clock needs no neighbour.
    out: FloatArray = values[:, before] + share[:, None] * (values[:, before + 1] - values[:, before])
    exact = np.abs(clock - t[before]) < 1e-9
    out[:, exact] = values[:, before[exact]]
    return out


def _stretches(speed: FloatArray, onset: float) -> list[tuple[int, int, int]]:
    """First, peak and last index of each movement."""
    out: list[tuple[int, int, int]] = []
    free = speed.copy()
    largest = float(speed.max())
    while largest > 0.0:
        peak = int(np.argmax(free))
        if free[peak] < _SMALLER_PEAKS * largest:
            break
        first = peak - _extent(free[peak::-1], onset)
        last = peak + _extent(free[peak:], onset)
        free[first : last + 1] = 0.0
        out.append((first, peak, last))
    return sorted(out)


def _extent(speed: FloatArray, onset: float) -> int:
    """Samples from a peak, the first one, to where the speed has fallen to the onset or is about to rise again."""
    least = 0
    for k in range(1, speed.size):
        if speed[k] <= onset * speed[0]:
            return k - 1
        if speed[k] < speed[least]:
            least = k
        if speed[least] < _VALLEY * speed[0] and speed[k] > speed[least] + 0.5 * _VALLEY * speed[0]:
            return least
    return speed.size - 1


def _around(values: FloatArray, peak: int, level: float) -> tuple[int, int]:
    first = last = peak
    while first > 0 and values[first - 1] > level:
        first -= 1
    while last + 1 < values.size and values[last + 1] > level:
        last += 1
    return first, last


def _boundary(speed: FloatArray, near: int, level: float, reach: int) -> float:
    """Where, between samples, a speed crosses a level nearest to an index; where it is least when it does not."""
    low, high = max(0, near - reach), min(speed.size, near + reach + 1)
    s = speed[low:high]
    crossed = np.flatnonzero((s[:-1] <= level) != (s[1:] <= level))
    if crossed.size:
        at = low + crossed + (level - s[crossed]) / (s[crossed + 1] - s[crossed])
        return float(at[np.argmin(np.abs(at - near))])
    return float(low + np.argmin(s))


def _movement(
    clock: FloatArray,
    p: FloatArray,
    v: FloatArray,
    slow: FloatArray,
    where: tuple[int, int, int],
    onset: float,
    rate: float,
    smallest: float,
) -> Movement | None:
    # Nothing further away than the windows of the jerk and the search for the ends matters.
    first, peak, last = where
    margin = round(_NEAR * rate) + (last - first) // 2 + 5
    low, high = max(0, first - margin), last + margin + 1
    clock, p, v, slow = clock[low:high], p[:, low:high], v[:, low:high], slow[:, low:high]
    where = (first - low, peak - low, last - low)
    found = [_describe(clock, p[k], slow[k], where, onset, rate) for k in range(len(p))]
    own = found[0]
    if own is None or not own["distance"] >= smallest:
        return None
    rows = [one for one in found[1:] if one is not None]
    if len(rows) < 0.5 * (len(found) - 1):
        return None  # the track is too uncertain to say that this is a movement
    drawn = {name: np.array([one[name] for one in rows]) for name in own}
    measures = {
        name: _debiased(own[name], drawn[name], unit) for name, unit in _UNITS.items() if name != "ldlj"
    }
    ldlj = _ldlj(v, own, drawn, rate, clock)
    return Movement(own["start"], own["end"], clock[where[1]] - own["start"], ldlj=ldlj, **measures)


def _describe(
    clock: FloatArray, p: FloatArray, v: FloatArray, where: tuple[int, int, int], onset: float, rate: float
) -> dict[str, float] | None:
    """The measures of one track's movement near first, peak and last index of the estimated one; None when it is not known there."""
    speed = np.nan_to_num(np.linalg.norm(v, axis=1), nan=0.0)
    reach = max(1, round(_NEAR * rate))
    low = max(0, where[1] - reach)
    peak = low + int(np.argmax(speed[low : where[1] + reach + 1]))
    top = _vertex(speed, peak)
    # Between samples, so that noise moves the ends a little instead of by whole frames.
    start, end = (_boundary(speed, k, onset * top, reach) for k in (where[0], where[2]))
    first, last = int(np.floor(start)) + 1, int(np.ceil(end)) - 1
    if last - first < 3:
        return None
    at = np.concatenate([[start], np.arange(first, last + 1), [end]])
    index = np.arange(speed.size)
    way = np.stack([np.interp(at, index, column) for column in p.T], axis=1)
    even = np.linspace(start, end, max(8, last - first + 2))
    profile = np.interp(even, index, speed)
    distance = float(np.linalg.norm(way[-1] - way[0]))
    if not np.isfinite(distance):
        return None
    length = float(np.sum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    sampled = (even.size - 1) / (end - start) * rate
    return {
        "start": float(np.interp(start, index, clock)),
        "end": float(np.interp(end, index, clock)),
        "distance": distance,
        "path_length": length,
        "straightness": distance / length,
        "peak_speed": top,
        "sparc": spectral_arc_length(profile, sampled),
    }


def _vertex(speed: FloatArray, peak: int) -> float:
    """Largest speed, by a parabola through what exceeds 85 % of the sample at the peak."""
    first, last = _around(speed, peak, 0.85 * speed[peak])
    rows = np.arange(first, last + 1)
    if rows.size < 4:
        return float(speed[peak])
    s = 2.0 * (rows - first) / (last - first) - 1.0
    a, b, c = np.polyfit(s, speed[rows], 2)
    inside = np.clip(-0.5 * b / a, -1.0, 1.0) if a < 0.0 else 0.0
    return float(c + b * inside + a * inside**2)


def _debiased(value: float, drawn: FloatArray, unit: str) -> Measure:
    """Noise lengthens paths and raises peaks; as much as drawing it once more adds is taken off."""
    added = float(np.mean(drawn)) - value if drawn.size else 0.0
    return measured(value - added, drawn, unit)


def _ldlj(
    v: FloatArray, own: dict[str, float], drawn: dict[str, FloatArray], rate: float, clock: FloatArray
) -> Measure:
    missing = Measure(float("nan"), float("nan"), "")
    duration = own["end"] - own["start"]
    jerk = second_derivative(v, rate, JERK_HARMONICS / duration)
    even = np.linspace(own["start"], own["end"], max(8, round(duration * rate) + 1))
    inside = on_clock(even, clock, jerk)
    if not np.isfinite(inside).all() or drawn["peak_speed"].size + 1 != len(v):
        return missing
    energy = np.sum(inside**2, axis=(1, 2))
    added = float(np.mean(energy[1:]) - energy[0])
    true = float(energy[0]) - added
    if true <= 0.25 * energy[0]:
        return missing
    # The noise's own energy is taken off; what remains scatters like the energy of the draws.
    raw = log_dimensionless_jerk(inside[0], (even.size - 1) / duration, own["peak_speed"])
    relative = float(np.std(energy[1:], ddof=1)) / true
    sd = np.sqrt(np.log1p(relative**2) + 4.0 * np.var(np.log(drawn["peak_speed"])))
    return Measure(raw - float(np.log(true / energy[0])), float(sd), "")

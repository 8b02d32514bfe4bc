"""Range of motion of a joint: the mean of the extremes of its cycles.

The largest sample of a noisy angle is too large, and the more so the noisier it is. So the extremes are found roughly first, and each one
is then the vertex of a polynomial that is fitted to the samples about it. Over a stretch in which the angle is within 15 % of the range
from its extreme, that is unbiased to 0.1 % of the range for a sinusoid, and averages the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.kinematics.measure import Measure, measured
from factorgrasp.typing import BoolArray, FloatArray, JsonDict

PROMINENCE = 0.25
"""A turn of the angle counts as the end of a cycle when it stands out by this share of the whole range."""
STRETCH = 0.15
_QUARTIC_FROM = 12
_UNCERTAIN = 4.0


@dataclass(frozen=True)
class RangeOfMotion:
    """Range of one axis.

    Attributes
    ----------
    axis : str
        Such as ``"flexion_extension"``.
    directions : (str, str)
        What a positive and what a negative angle is called.
    range : Measure
        Mean of the maxima minus mean of the minima (rad). Cycles of less than 90 % of the usual extent count less, of half of it not.
    maximum, minimum : Measure
        Those means (rad).
    largest : Measure
        From the lowest to the highest angle of the whole track (rad), both of them fitted as well: what irregular motion has instead of a
        range of its cycles.
    cycles : int
        Complete cycles that entered; 0 when the angle did not turn back and forth, and the ends of the track count.
    cycle_sd : float
        Standard deviation of the range from cycle to cycle (rad); NaN for fewer than two.
    words : str
        Empty, or what limits the figures.
    """

    axis: str
    directions: tuple[str, str]
    range: Measure
    maximum: Measure
    minimum: Measure
    largest: Measure
    cycles: int
    cycle_sd: float
    words: str = ""

    def to_dict(self) -> JsonDict:
        """Plain numbers, rad."""
        return {
            "range": self.range.value,
            "sd": self.range.sd,
            "interval_95": list(self.range.interval),
            self.directions[0]: self.maximum.to_dict(),
            self.directions[1]: self.minimum.to_dict(),
            "largest": self.largest.to_dict(),
            "cycles": self.cycles,
            "cycle_sd": self.cycle_sd,
            "unit": "rad",
            "words": self.words,
        }


def range_of_motion(
    t: FloatArray,
    angle: FloatArray,
    sd: FloatArray,
    samples: FloatArray,
    axis: str = "angle",
    directions: tuple[str, str] = ("positive", "negative"),
) -> RangeOfMotion:
    """Range of motion of one angle of a smoothed track.

    Parameters
    ----------
    t : ndarray, shape (n,)
        s.
    angle : ndarray, shape (n,)
        rad; NaN where it is not known.
    sd : ndarray, shape (n,)
        rad; extremes where it is four times its median or more (in a gap) do not count.
    samples : ndarray, shape (K, n)
        Drawn tracks of the same angle, from which the standard deviations come.
    axis, directions
        For the result.

    Raises
    ------
    InputError
        When fewer than five samples are known.
    """
    known = np.isfinite(angle) & np.isfinite(sd)
    if known.sum() < 5:
        raise InputError(axis, "at least five frames with a pose", f"{int(known.sum())}")
    typical = float(np.median(sd[known]))
    good = known & (sd <= _UNCERTAIN * typical)
    low, high = np.percentile(angle[good], [2.0, 98.0])
    threshold = max(PROMINENCE * (high - low), 4.0 * typical)
    tops, bottoms = _alternating(angle, known, threshold)
    tops, bottoms = [k for k in tops if good[k]], [k for k in bottoms if good[k]]
    words = ""
    cycles = min(len(tops), len(bottoms))
    order = np.flatnonzero(good)
    highest, lowest = int(order[np.argmax(angle[good])]), int(order[np.argmin(angle[good])])
    if not cycles:
        words = "no full cycle: the largest and the smallest angle of the whole track"
        tops, bottoms = [highest], [lowest]
    elif len(tops) + len(bottoms) < 3:
        words = "one cycle only"
    level = STRETCH * (high - low)
    both = np.vstack([angle[None], samples])
    upper = np.stack([_vertex(t, both, angle, good, k, level, 1.0) for k in tops], axis=1)
    lower = np.stack([_vertex(t, both, angle, good, k, level, -1.0) for k in bottoms], axis=1)
    middle = 0.5 * (np.median(upper[0]) + np.median(lower[0]))
    maximum, minimum = upper @ _weights(upper[0] - middle), lower @ _weights(middle - lower[0])
    largest = _vertex(t, both, angle, good, highest, level, 1.0) - _vertex(
        t, both, angle, good, lowest, level, -1.0
    )
    spans = upper[0, :cycles] - lower[0, :cycles]
    return RangeOfMotion(
        axis,
        directions,
        measured(maximum[0] - minimum[0], maximum[1:] - minimum[1:], "rad"),
        measured(maximum[0], maximum[1:], "rad"),
        measured(minimum[0], minimum[1:], "rad"),
        measured(largest[0], largest[1:], "rad"),
        cycles,
        float(np.std(spans, ddof=1)) if cycles > 1 else float("nan"),
        words,
    )


def _weights(height: FloatArray) -> FloatArray:
    """Weights of the extremes of cycles: full from 90 % of the median height on, none below a half."""
    share = np.clip((height / np.median(height) - 0.5) / 0.4, 0.0, 1.0)
    out: FloatArray = share / np.sum(share)
    return out


def _alternating(angle: FloatArray, known: BoolArray, threshold: float) -> tuple[list[int], list[int]]:
    """Indices of maxima and minima, in turn, between which the angle changes by `threshold` at least."""
    tops: list[int] = []
    bottoms: list[int] = []
    rows = np.flatnonzero(known)
    high = low = int(rows[0])
    rising: bool | None = None
    for k in map(int, rows):
        if angle[k] > angle[high]:
            high = k
        if angle[k] < angle[low]:
            low = k
        if rising is not False and angle[high] - angle[k] > threshold:
            # The first turn may be where the track begins, which is not an end of a movement.
            if rising is not None or high != rows[0]:
                tops.append(high)
            rising, low = False, k
        elif rising is not True and angle[k] - angle[low] > threshold:
            if rising is not None or low != rows[0]:
                bottoms.append(low)
            rising, high = True, k
    return tops, bottoms


def _vertex(
    t: FloatArray, values: FloatArray, angle: FloatArray, good: BoolArray, k: int, level: float, sign: float
) -> FloatArray:
    """Extreme (K,) near sample k of tracks (K, n), by a polynomial about it."""
    inside = good & (sign * (angle[k] - angle) <= level)
    first, last = k, k
    while first > 0 and inside[first - 1]:
        first -= 1
    while last + 1 < t.size and inside[last + 1]:
        last += 1
    rows = np.arange(first, last + 1)
    if rows.size < 4:
        out: FloatArray = values[:, k]
        return out
    half = 0.5 * (t[last] - t[first])
    s = (t[rows] - t[first]) / half - 1.0
    order = 4 if rows.size >= _QUARTIC_FROM else 2
    coefficients = np.linalg.pinv(np.vander(s, order + 1)) @ values[:, rows].T
    fine = np.vander(np.linspace(-1.0, 1.0, 41), order + 1) @ coefficients
    # Looked for where the estimated track has it, for all draws alike: the largest of each would be biased again.
    at = int(np.argmax(sign * fine[:, 0]))
    return np.asarray(fine[at])

"""What the paper wants a wrist's track for: angles, ranges of motion, speeds and movements, each with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp.kinematics.angles import (
    AXES,
    ISB_NAMES,
    OPPOSITES,
    Facing,
    Hand,
    angle_covariance,
    isb_signs,
    wrist_angles,
)
from factorgrasp.kinematics.measure import Measure, measured
from factorgrasp.kinematics.range_of_motion import RangeOfMotion, range_of_motion
from factorgrasp.kinematics.reaching import BANDWIDTH, Movement, movements, on_clock
from factorgrasp.kinematics.smoothness import low_pass
from factorgrasp.kinematics.track_errors import SAMPLES, sample_tracks
from factorgrasp.lie import skew, so3_exp
from factorgrasp.typing import FloatArray, JsonDict

if TYPE_CHECKING:
    from factorgrasp.problems.wrist_track import WristTrack

_FEWEST = 8


@dataclass(frozen=True, eq=False)
class WristMeasures:
    """Kinematic measures of one track.

    Attributes
    ----------
    hand : {"right", "left"}
    angles, angles_sd : ndarray, shape (n, 3)
        Flexion, ulnar deviation, pronation against the start posture (rad), positive in the direction of their names; NaN where lost.
    range_of_motion : tuple of RangeOfMotion
        Flexion/extension, radial/ulnar deviation, pronation/supination; empty when the track is too short.
    peak_angular_speed, peak_speed : Measure
        Largest speed of turning (rad/s) and of the wrist's marker (m/s), of the motion up to 4 Hz.
    movements : tuple of Movement
        Ways of 50 mm and more from rest to rest.
    words : tuple of str
        What limits the figures.
    """

    hand: Hand
    angles: FloatArray
    angles_sd: FloatArray
    range_of_motion: tuple[RangeOfMotion, ...]
    peak_angular_speed: Measure
    peak_speed: Measure
    movements: tuple[Movement, ...]
    words: tuple[str, ...] = ()

    def to_dict(self) -> JsonDict:
        """Plain numbers (rad, m, s)."""
        return {
            "hand": self.hand,
            "range_of_motion": {one.axis: one.to_dict() for one in self.range_of_motion},
            "peak_angular_speed": self.peak_angular_speed.to_dict(),
            "peak_speed": self.peak_speed.to_dict(),
            "movements": [one.to_dict() for one in self.movements],
            "words": list(self.words),
        }


def wrist_measures(
    track: WristTrack,
    hand: Hand = "right",
    facing: Facing = "back",
    samples: int = SAMPLES,
    seed: int = 0,
) -> WristMeasures:
    """Measures of a track; smoothed ones only, for a filter's noise makes ranges of motion 2 to 3 degrees too large.

    Parameters
    ----------
    track : WristTrack
    hand : {"right", "left"}
        Decides the signs of deviation and pronation.
    facing : {"back", "palm"}
        The side of the hand out of which z of ``W`` points.
    samples : int
        Tracks that are drawn for the standard deviations.
    seed : int
        Of the draws: the same track gives the same numbers.
    """
    # A pose of a frame without a measurement is a guess, and no measure may rest on it.
    unknown_pose = track.lost[:, None, None]
    R = np.where(unknown_pose, np.nan, track.rotation)
    P = np.where(unknown_pose | ~np.isfinite(track.covariance), np.nan, track.covariance)
    position, velocity, rate = (
        np.where(track.lost[:, None], np.nan, values)
        for values in (track.position, track.velocity, track.angular_velocity)
    )
    signs = isb_signs(hand, facing)
    angles = signs * wrist_angles(R)
    variance = np.einsum("nii->ni", angle_covariance(R, P[:, :3, :3]))
    sd = np.sqrt(np.maximum(variance, 0.0))
    known = np.isfinite(angles).all(axis=1) & np.isfinite(sd).all(axis=1)
    unknown = Measure(float("nan"), float("nan"), "")
    if known.sum() < _FEWEST:
        few = f"only {int(known.sum())} frames have a pose: too few for kinematic measures"
        return WristMeasures(hand, angles, sd, (), unknown, unknown, (), (few,))
    words: list[str] = []
    if track.delay >= 0:
        words.append(
            "the track is not smoothed over the whole recording: its noise makes ranges of motion too large"
        )
    drawn = sample_tracks(
        track.t, R, position, velocity, rate, P, track.velocity_covariance, samples, seed,
    )  # fmt: skip
    turn = frame_errors(track.markers.points, track.markers.covariance, samples, seed)[:, None]
    drawn_angles = signs * wrist_angles(np.swapaxes(turn, -1, -2) @ drawn.rotation @ turn)
    ranges = tuple(
        range_of_motion(
            track.t, angles[:, i], sd[:, i], drawn_angles[..., i], AXES[i], (ISB_NAMES[i], OPPOSITES[i])
        )
        for i in range(3)
    )
    return WristMeasures(
        hand,
        angles,
        sd,
        ranges,
        _peak(track.t, rate, drawn.angular_velocity, "rad/s"),
        _peak(track.t, velocity, drawn.velocity, "m/s"),
        movements(track.t, position, velocity, drawn.position, drawn.velocity),
        tuple(words),
    )


def frame_errors(points: FloatArray, covariance: FloatArray, samples: int, seed: int = 0) -> FloatArray:
    """Rotations (K, 3, 3) by which the frame ``W`` may be turned against the hand, since its markers are known to a covariance only.

    Such a turn is the same in all frames. It cancels in the rotation against the start up to its axes, so that a motion about one axis
    shows as one about another: the layout turned by d makes ``Exp(d)' R Exp(d)`` of R.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Markers in ``W`` (m).
    covariance : ndarray, shape (3n, 3n)
        m^2.
    samples, seed
        Number of draws, and what they derive from.
    """
    # Displacements d x c_i of a turn about the centre, and the turn that fits displacements best.
    J = -skew(points - points.mean(axis=0)).reshape(-1, 3)
    gain = np.linalg.solve(J.T @ J, J.T)
    values, axes = np.linalg.eigh(gain @ covariance @ gain.T)
    rng = np.random.default_rng([seed, 78])
    d = rng.standard_normal((samples, 3)) @ (axes * np.sqrt(np.maximum(values, 0.0))).T
    return so3_exp(d)


def _peak(t: FloatArray, values: FloatArray, drawn: FloatArray, unit: str) -> Measure:
    """Largest norm of a vector signal below the bandwidth, less what noise adds to it."""
    dt = float(np.median(np.diff(t)))
    clock = np.arange(t[0], t[-1] + 1e-9, dt)
    slow = low_pass(on_clock(clock, t, np.concatenate([values[None], drawn])), 1.0 / dt, BANDWIDTH)
    size = np.linalg.norm(slow, axis=2)
    if not np.isfinite(size[0]).any():
        return Measure(float("nan"), float("nan"), unit)
    at = int(np.nanargmax(size[0]))
    added = float(np.nanmean(size[1:, at]) - size[0, at])
    return measured(size[0, at] - added, size[1:, at], unit)

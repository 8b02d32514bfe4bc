"""The typed view of a solved wrist-pose problem."""

from __future__ import annotations

from dataclasses import dataclass

from factorgrasp.estimate import Estimate
from factorgrasp.problems.wrist_track import WristTrack


@dataclass(frozen=True, eq=False)
class WristPoseEstimate:
    """Track of the whole recording with what else was learnt from it.

    Attributes
    ----------
    estimate : Estimate
    track : WristTrack
        Smoothed over the whole recording.
    detection, clutter : float
        Estimated probability that a marker is seen, and blobs a frame that are no marker.
    pixel_sd, depth_sd : float
        Residual standard deviations found, px and m.
    warnings : tuple of str
        What a user should know: suspected intrinsics, ambiguity, lost stretches.
    """

    estimate: Estimate
    track: WristTrack
    detection: float
    clutter: float
    pixel_sd: float
    depth_sd: float
    warnings: tuple[str, ...] = ()

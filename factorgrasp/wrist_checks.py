"""Does a track make sense? Signs that the layout, the columns or the intrinsics are not what they are said to be."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from factorgrasp.models.camera import Camera
from factorgrasp.problems.wrist_track import WristTrack
from factorgrasp.recordings.blobs import BlobRecording
from factorgrasp.typing import FloatArray

REACH = 0.25
"""m: blobs further from the wrist's origin are no markers on a hand."""
RADIUS = 0.008
"""m: blobs within this of each other in the hand's frame may be one marker."""
LEAST_SHARE = 0.3
"""Share of the frames in which a blob must be at one place of the hand to count as a marker."""
_MOST = 8


def seen_from_behind(track: WristTrack) -> tuple[str, ...]:
    """A word when the markers are on the far side of the hand, which no camera can see."""
    seen = ~track.lost
    if not seen.any():
        return ()
    towards = np.einsum("ni,ni->n", track.camera_rotation[seen][:, :, 2], track.camera_position[seen])
    if np.mean(towards > 0.0) < 0.5:
        return ()
    return (
        "the markers are on the side of the hand that the camera cannot see: are the columns u and v swapped, or is the layout that of "
        "the other hand, or its z axis not out of the back of the hand?",
    )


def riding_blobs(track: WristTrack, blobs: BlobRecording, camera: Camera) -> FloatArray:
    """Places in the hand's frame (k, 3), m, at which blobs that were given to no marker sit in many frames: they move with the hand.

    Clutter does not; a marker that the layout does not have, or has elsewhere, does.
    """
    rows = np.flatnonzero((track.association == 0) & np.isfinite(blobs.depth) & ~track.lost[blobs.frame])
    nothing = np.zeros((0, 3))
    tracked = int(np.count_nonzero(~track.lost))
    if rows.size < 3 or tracked < 5:
        return nothing
    frame = blobs.frame[rows]
    seen = camera.back_project(blobs.uv[rows], blobs.depth[rows])
    points = np.einsum("nij,ni->nj", track.camera_rotation[frame], seen - track.camera_position[frame])
    near = np.linalg.norm(points, axis=1) < REACH
    points, frame = points[near], frame[near]
    found: list[FloatArray] = []
    while len(points) and len(found) < _MOST:
        neighbours = cKDTree(points).query_ball_point(points, RADIUS)
        best = max(neighbours, key=len)
        if np.unique(frame[best]).size < LEAST_SHARE * tracked:
            break
        found.append(points[best].mean(axis=0))
        keep = np.linalg.norm(points - found[-1], axis=1) > 1.5 * RADIUS
        points, frame = points[keep], frame[keep]
    return np.array(found).reshape(-1, 3)


def riding_words(places: FloatArray) -> tuple[str, ...]:
    """What :func:`riding_blobs` means."""
    if not len(places):
        return ()
    where = "; ".join("(" + ", ".join(f"{1e3 * x:.0f}" for x in place) + ")" for place in places)
    return (
        f"{len(places)} blobs move with the hand and are no marker of the layout, in its frame at {where} mm: does the layout belong to "
        "this hand, to its other side, or to other markers?",
    )

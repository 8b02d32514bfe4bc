"""The marker layout of a hand from the first frames of a recording of blobs with depth, in place of a measurement by hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from factorgrasp.errors import InputError, NotSolvedError
from factorgrasp.losses import make_loss
from factorgrasp.models.camera import Camera
from factorgrasp.models.marker_files import write_layout
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.palm_labels import MOST_POINTS, Labelling, label_points, nearest_together
from factorgrasp.problems.palm_layout import PalmConvention, PalmLayout, PalmView, in_palm_frame, palm_frame
from factorgrasp.recordings.blobs import BlobFrame, BlobRecording
from factorgrasp.solvers.solve import solve
from factorgrasp.typing import FloatArray, IntArray

Side = Literal["right", "left"]
Facing = Literal["back", "palm"]

_SAME_HAND = 0.012
"""m: rms by which the points of a frame may differ from the layout of the frames before."""
_LIKE_A_HAND = 0.016
"""m: rms by which a hand may differ from the template of its size."""
_PIXEL_SD = 1.0
_DEPTH_SD = (1.2e-3, 1.9e-3)
"""Where a recording holds no covariances: sd of depth, m and 1/m, about 0.4 m."""


@dataclass(frozen=True, eq=False)
class PalmCalibration:
    """A calibrated layout.

    Attributes
    ----------
    layout : MarkerLayout
        With its joint covariance. Frame: origin at the wrist marker, x to the marker at the middle finger's joint, z normal to the palm
        out of the side that the camera saw.
    frames : ndarray of int, shape (k,)
        Frames of the recording that were used.
    blobs : ndarray of int, shape (k, n)
        Row of the recording of each marker in each of them.
    rotation : ndarray, shape (k, 3, 3)
        ``R_c_w`` there.
    position : ndarray, shape (k, 3)
        ``p_c_w``, m.
    consistency : float
        Squared whitened residuals per degree of freedom: about 1 when the covariances of the blobs hold.
    scale : float
        Size of the hand relative to the template.
    """

    layout: MarkerLayout
    frames: IntArray
    blobs: IntArray
    rotation: FloatArray
    position: FloatArray
    consistency: float
    scale: float

    def save(self, path: str | Path) -> Path:
        """Write the layout as JSON, to be used again: :func:`factorgrasp.models.marker_files.read_layout`."""
        return write_layout(
            path, self.layout, frames=self.frames.tolist(), consistency=self.consistency, scale=self.scale
        )


def calibrate_palm(
    blobs: BlobRecording,
    camera: Camera,
    side: Side = "right",
    facing: Facing = "back",
    template: MarkerLayout | None = None,
    frames: int = 30,
    look: int = 300,
    systematic_sd: float = 5e-5,
) -> PalmCalibration:
    """The layout from the first frames in which all markers are seen with depth.

    Every labelling of a frame's points is compared with a template hand of any usual size; with the layout of the frames before once
    there is one. Layout and poses then come from one least-squares fit, weighted by the blobs' covariances.

    Parameters
    ----------
    blobs : BlobRecording
        With depth.
    camera : Camera
    side : {"right", "left"}
    facing : {"back", "palm"}
        The side of the hand that bears the markers and faces the camera.
    template : MarkerLayout, optional
        Names and rough places of the markers; by default the six of :meth:`MarkerLayout.palm`, mirrored where `side` and `facing`
        ask for it.
    frames : int
        Most frames to use.
    look : int
        Frames of the recording among which they are sought.
    systematic_sd : float
        Error of a coordinate that all frames share, m: added to the covariance.

    Raises
    ------
    InputError
        When no frame shows all markers with depth, or the points of none are like a hand.
    NotSolvedError
        When the fit fails.
    """
    if side not in ("right", "left") or facing not in ("back", "palm"):
        raise InputError("side, facing", "right or left, and back or palm", f"{side!r}, {facing!r}")
    if frames < 1 or look < 1 or not 0.0 <= systematic_sd < 0.1:
        raise InputError(
            "frames, look, systematic_sd",
            "at least 1, at least 1, metres",
            f"{frames}, {look}, {systematic_sd:g}",
        )
    if template is None:
        standard = MarkerLayout.palm()
        mirror = np.array([1.0, -1.0 if (side == "left") != (facing == "palm") else 1.0, 1.0])
        # Seen from the palm's side, what lies below the back lies above.
        mirror[2] = -1.0 if facing == "palm" else 1.0
        template = MarkerLayout(standard.names, standard.points * mirror, standard.covariance)
    convention = PalmConvention.of(template.names)
    views, used, rows, scale = _collect(blobs, camera, template, frames, look, convention)
    start = np.mean([(view.points - view.position) @ view.rotation for view in views], axis=0)
    problem = PalmLayout(
        template.names, start, views, convention, make_loss("huber", 3.0) if len(views) > 2 else None
    )
    estimate = solve(problem)
    if not estimate.solved:
        raise NotSolvedError(f"palm calibration: {estimate.message}")
    system = problem.linearize(estimate.values)
    squares = float(np.sum(system.residuals(np.zeros(system.size))[:-1] ** 2))
    degrees = 3 * len(template) * len(views) - (problem.variables[0].size - 1) - 6 * len(views)
    consistency = squares / degrees if degrees > 0 else 1.0
    found = problem.layout(estimate)
    # Blobs that scatter more than they claim say less than they claim.
    covariance = found.covariance * max(consistency, 1.0) + systematic_sd**2 * _moved(found)
    return PalmCalibration(
        MarkerLayout(found.names, found.points, covariance),
        np.array(used, dtype=np.intp),
        np.array(rows, dtype=np.intp),
        np.array([estimate.values[f"rotation {k}"] for k in range(len(views))]),
        np.array([estimate.values[f"position {k}"] for k in range(len(views))]),
        consistency,
        scale,
    )


def _moved(layout: MarkerLayout) -> FloatArray:
    """Covariance (3n, 3n) in the palm frame of coordinates that each had variance 1: the frame moves with its markers."""
    return in_palm_frame(MarkerLayout(layout.names, layout.points, np.eye(3 * len(layout)))).covariance


def _collect(
    blobs: BlobRecording,
    camera: Camera,
    template: MarkerLayout,
    most: int,
    look: int,
    convention: PalmConvention,
) -> tuple[list[PalmView], list[int], list[IntArray], float]:
    """Labelled frames, their numbers, the blobs of the markers, and the size of the hand."""
    markers = len(template)
    views: list[PalmView] = []
    used: list[int] = []
    rows: list[IntArray] = []
    layout: FloatArray | None = None
    scale, unlike, closest = 1.0, 0, np.inf
    counts = []
    for k in range(min(len(blobs), look)):
        frame = blobs.at(k)
        known = np.flatnonzero(np.isfinite(frame.depth))
        counts.append(known.size)
        if known.size < markers:
            continue
        points = camera.back_project(frame.uv[known], frame.depth[known])
        if known.size > MOST_POINTS:
            near = nearest_together(points, MOST_POINTS)
            known, points = known[near], points[near]
        found: Labelling | None
        if layout is None:
            found = label_points(points, template.points)
            limit = _LIKE_A_HAND
        else:
            found = label_points(points, layout, (0.93, 1.07))
            limit = _SAME_HAND
        if found is None or found.rms > limit * max(found.scale, 0.7) or found.rms > 0.8 * found.second:
            unlike += 1
            closest = min(closest, np.inf if found is None else found.rms)
            continue
        chosen = points[found.order]
        R, p = palm_frame(chosen, convention, found.rotation[:, 2])
        if layout is None:
            layout, scale = (chosen - p) @ R, found.scale
        picked = known[found.order]
        views.append(PalmView(chosen, _point_covariance(frame, picked, camera), R, p))
        used.append(k)
        rows.append(blobs.rows(k).start + picked)
        if len(views) == most:
            break
    if not views:
        if unlike == 0:
            best = max(counts, default=0)
            raise InputError(
                f"{blobs.name}: palm calibration",
                f"a frame that shows all {markers} markers with depth",
                f"at most {best} blobs with depth in the first {len(counts)} frames",
                "Begin the recording with the whole hand in view, or give a stored layout",
            )
        raise InputError(
            f"{blobs.name}: palm calibration",
            "blobs that lie like the markers of a hand",
            f"{unlike} frames with enough blobs, none like the template (nearest: {1e3 * closest:.0f} mm rms)",
            "Is the other hand meant, or the other side of it (side, facing)? Are the camera's intrinsics right?",
        )
    return views, used, rows, scale


def _point_covariance(frame: BlobFrame, rows: IntArray, camera: Camera) -> FloatArray:
    """Covariance (n, 3, 3) of back-projected blobs in the camera frame, m^2."""
    z = frame.depth[rows]
    uv = np.tile(_PIXEL_SD**2 * np.eye(2), (rows.size, 1, 1))
    if frame.covariance_uv is not None:
        uv = frame.covariance_uv[rows]
    along = (_DEPTH_SD[0] + _DEPTH_SD[1] * (z - 0.4) ** 2) ** 2
    if frame.covariance_depth is not None:
        along = frame.covariance_depth[rows]
    direction = camera.undistort(frame.uv[rows])
    J = np.zeros((rows.size, 3, 3))
    # The lens' own slope is 1 to a few percent: enough for a covariance.
    J[:, 0, 0], J[:, 1, 1] = z / camera.fx, z / camera.fy
    J[:, :2, 2], J[:, 2, 2] = direction, 1.0
    both = np.zeros((rows.size, 3, 3))
    both[:, :2, :2], both[:, 2, 2] = uv, along
    return np.asarray(J @ both @ np.swapaxes(J, 1, 2))

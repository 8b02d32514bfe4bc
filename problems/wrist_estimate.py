"""The typed view of a solved wrist-pose problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp import lie
from factorgrasp.estimate import Estimate
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.wrist_chain import Marginals, marginals
from factorgrasp.problems.wrist_flat import DECIDED, second_pose
from factorgrasp.problems.wrist_frames import StartFrame, in_start_frame, start_pose
from factorgrasp.problems.wrist_model import Pairs
from factorgrasp.problems.wrist_rows import Rows
from factorgrasp.problems.wrist_track import CameraPose, Gap, WristTrack
from factorgrasp.problems.wrist_tracker import Node
from factorgrasp.typing import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from factorgrasp.problems.wrist_pose import WristPose

FOCAL_SUSPECT = 0.015
"""Error of the focal length (a fraction) from which on it is worth a warning, when it is also significant."""
SIGNIFICANT = 4.0


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
        Residual standard deviations found, px and m; NaN where there was no depth.
    rotation_density, translation_density : float
        Square roots of the spectral densities of the motion that were used in the end.
    focal_error, focal_error_sd : float
        By which fraction the focal length seems wrong (tested, not corrected), with its standard deviation; NaN without depth.
    warnings : tuple of str
        What a user should know: suspected intrinsics, ambiguity, lost stretches.
    """

    estimate: Estimate
    track: WristTrack
    detection: float
    clutter: float
    pixel_sd: float
    depth_sd: float
    rotation_density: float
    translation_density: float
    focal_error: float
    focal_error_sd: float
    warnings: tuple[str, ...] = ()

    @property
    def solved(self) -> bool:
        """Whether the solver answered."""
        return self.estimate.solved

    @property
    def markers(self) -> MarkerLayout:
        """The layout with what the recording taught about it."""
        return self.track.markers

    def summary(self) -> str:
        """A few lines for a terminal."""
        track = self.track
        seen = ~track.lost & np.isfinite(track.position).all(axis=1)
        sd = np.sqrt(np.einsum("nii->ni", track.covariance[seen])) if seen.any() else np.full((1, 6), np.nan)
        turn, way = np.degrees(np.median(sd[:, :3])), 1e3 * np.median(sd[:, 3:])
        lines = [
            f"wrist pose: {self.estimate.status.value}, {len(track)} frames, {int(track.lost.sum())} lost, {len(track.gaps)} gaps",
            f"  typical sd of an axis      {turn:.2f} deg, {way:.2f} mm",
            f"  markers seen               {100.0 * self.detection:.1f} %, clutter {self.clutter:.2f} blobs a frame",
            f"  residuals                  {self.pixel_sd:.2f} px, {1e3 * self.depth_sd:.2f} mm of depth",
        ]
        if self.estimate.message:
            lines.append(f"  {self.estimate.message}")
        return "\n".join([*lines, *(f"  warning: {words}" for words in self.warnings)])

    def save(self, directory: str | Path) -> Path:
        """Write the solver's estimate; returns the JSON's path."""
        return self.estimate.save(directory)


def make_view(problem: WristPose, estimate: Estimate) -> WristPoseEstimate:
    """From a solution to the track."""
    state = estimate.values
    R, x, layout = problem.nodes_of(state)
    batch = problem._posed.batch
    rows = batch.rows(R, x, layout)
    found = problem.marginals(state)
    shared = layout.size if problem.estimates_layout else 0
    covariance = found.border[:shared, :shared] if shared else problem.markers.covariance
    markers = MarkerLayout(problem.markers.names, layout, 0.5 * (covariance + covariance.T))
    used = np.zeros(len(problem.blobs), dtype=bool)
    used[batch.pairs.node + problem.frames.start] = True
    gaps = find_gaps(problem.blobs.t, used, problem.association.lost_after)
    nodes = _nodes(problem, R, x, found, shared, used)
    start = problem.camera_pose or first_frames(problem, nodes, markers)
    track = make_track(
        nodes, start, problem.association_now, gaps, markers, lost_frames(problem.blobs.t, gaps, nodes), -1
    )
    px, depth = residual_sd(batch.pairs, rows, problem)
    focal, focal_sd = focal_error(problem, rows, x)
    densities = np.sqrt(batch.densities)
    return WristPoseEstimate(
        estimate,
        track,
        problem._posed.detection,
        problem._posed.clutter,
        px,
        depth,
        float(densities[0]),
        float(densities[1]),
        focal,
        focal_sd,
        _warnings(problem, track, px, depth, focal, focal_sd),
    )


def _nodes(
    problem: WristPose, R: FloatArray, x: FloatArray, found: Marginals, shared: int, used: BoolArray
) -> list[Node]:
    """One node a frame of the recording; those outside of the batch as the first pass left them."""
    out = list(problem.first_pass.nodes)
    for i, k in enumerate(problem.frames):
        covariance = found.nodes[i]
        if problem.first_pass.nodes[k].ambiguous:
            covariance = _with_doubt(problem, k, R[i], x[i], covariance)
        out[k] = Node(
            float(problem.blobs.t[k]),
            R[i],
            x[i],
            covariance,
            found.with_border[i, :, :shared],
            False,
            bool(used[k]),
            problem.first_pass.nodes[k].ambiguous,
        )
    return out


def _with_doubt(
    problem: WristPose, k: int, R: FloatArray, x: FloatArray, covariance: FloatArray
) -> FloatArray:
    """The covariance of a node with the second pose that its pixels allow in it."""
    rows = problem.blobs.rows(k)
    uvz = np.concatenate([problem.blobs.uv[rows], problem.blobs.depth[rows, None]], axis=1)
    marker = problem.association_now[rows] - 1
    layout = problem.markers
    other = second_pose(
        problem.camera, layout.points, layout.blocks, R, x[:3], uvz, problem.covariances[rows], marker
    )
    if other is None or other[1] > DECIDED:
        return covariance
    out = covariance.copy()
    out[:6, :6] += 0.5 * np.outer(other[0], other[0])
    return out


def first_frames(problem: WristPose, nodes: Sequence[Node], markers: MarkerLayout) -> CameraPose:
    """``W0``: the hand in its first frames, as long as it is at rest."""
    exact = problem.settings.layout == "exact"
    covariance = np.zeros_like(markers.covariance) if exact else markers.covariance
    start = StartFrame(problem.camera, markers.points, covariance, problem.settings.start_frames)
    pairs = problem.pairs
    for i, k in enumerate(problem.frames):
        mine = np.flatnonzero(pairs.node == i)
        start.add(float(problem.blobs.t[k]), pairs.select(mine), nodes[k].R, nodes[k].x[:3])
        if start.closed:
            break
    if start.pose is not None:
        return start.pose
    i = problem.frames.start
    rows = np.flatnonzero(pairs.node == 0)
    return start_pose(
        problem.camera, markers.points, covariance, pairs.select(rows), nodes[i].R, nodes[i].x[:3]
    )


def make_track(
    nodes: Sequence[Node],
    start: CameraPose,
    association: IntArray,
    gaps: tuple[Gap, ...],
    markers: MarkerLayout,
    lost: BoolArray,
    delay: int,
) -> WristTrack:
    """A track in ``W0`` from nodes in the camera frame."""
    poses = [in_start_frame(start, n.R, n.x, n.covariance, n.with_layout) for n in nodes]
    R = np.stack([q.R for q in poses])
    known = np.isfinite(R).all(axis=(1, 2))
    wxyz = np.full((len(nodes), 4), np.nan)
    if known.any():
        wxyz[known] = lie.matrix_to_quaternion_wxyz(R[known], continuous=True)
    covariance = np.stack([q.covariance for q in poses])
    spread = np.stack([q.velocity_covariance for q in poses])
    covariance[~known] = spread[~known] = np.diag(np.full(6, np.inf))
    return WristTrack(
        t=np.array([n.t for n in nodes]),
        rotation_wxyz=wxyz,
        position=np.stack([q.p for q in poses]),
        velocity=np.stack([q.v for q in poses]),
        angular_velocity=np.stack([q.w for q in poses]),
        covariance=covariance,
        velocity_covariance=spread,
        association=np.array(association),
        lost=np.array(lost, dtype=bool),
        ambiguous=np.array([n.ambiguous for n in nodes], dtype=bool),
        gaps=gaps,
        markers=markers,
        camera_pose=start,
        delay=delay,
    )


def find_gaps(t: FloatArray, used: BoolArray, lost_after: float) -> tuple[Gap, ...]:
    """Stretches of frames in which no marker was used."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ~used, [False]]).astype(int)))
    out = []
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        before = t[first - 1] if first > 0 else -np.inf
        after = t[end] if end < t.size else None
        lost = first == 0 or (t[end - 1] if after is None else after) - before > lost_after
        out.append(
            Gap(
                float(t[first]),
                float(t[end - 1]),
                int(end - first),
                bool(lost),
                None if after is None else float(after),
            )
        )
    return tuple(out)


def lost_frames(t: FloatArray, gaps: Sequence[Gap], nodes: Sequence[Node]) -> BoolArray:
    """(n,) frames in a gap that was too long to be bridged, or without any pose."""
    out = np.array([not np.isfinite(n.x).all() for n in nodes], dtype=bool)
    for gap in gaps:
        if gap.lost:
            out |= (t >= gap.start) & (t <= gap.end)
    return out


def residual_sd(pairs: Pairs, rows: Rows, problem: WristPose) -> tuple[float, float]:
    """Robust standard deviations of what is left of pixels and depths, their degrees of freedom accounted for."""
    away = rows.seen - pairs.uvz
    deep = pairs.deep > 0.0
    numbers = 2 * len(pairs) + int(deep.sum())
    # A node's pose is pinned by its own blobs and its neighbours: about half of its six unknowns are its own.
    share = np.sqrt(numbers / max(numbers - 3 * len(problem.frames), numbers // 4, 1))
    px = share * 1.4826 * float(np.median(np.abs(away[:, :2]))) if len(pairs) else float("nan")
    depth = share * 1.4826 * float(np.median(np.abs(away[deep, 2]))) if deep.any() else float("nan")
    return px, depth


def focal_error(problem: WristPose, rows: Rows, x: FloatArray) -> tuple[float, float]:
    """One Gauss-Newton step of a common factor on both focal lengths, with all poses and the layout free to follow.

    Depth and the layout's size together say how large the palm's image should be.
    """
    batch = problem._posed.batch
    pairs = batch.pairs
    if np.count_nonzero(pairs.deep) < 30:
        return float("nan"), float("nan")
    centre = np.array([problem.camera.cx, problem.camera.cy])
    J = np.zeros((len(pairs), 3, 1))
    J[:, :2, 0] = rows.seen[:, :2] - centre
    extra = pairs.root @ J
    chain, _, border_rhs = batch.chain(rows, problem.loss, problem.layout_information, extra)
    # At a solution every other gradient is zero.
    border_rhs[:-1] = 0.0
    found: Marginals = marginals(chain, None, border_rhs)
    return float(found.border_step[-1]), float(np.sqrt(found.border[-1, -1]))


def _warnings(
    problem: WristPose, track: WristTrack, px: float, depth: float, focal: float, focal_sd: float
) -> tuple[str, ...]:
    out = []
    if np.isfinite(focal) and abs(focal) > max(FOCAL_SUSPECT, SIGNIFICANT * focal_sd):
        out.append(
            f"the intrinsics are suspected: the palm's image would fit its depth and layout better with focal lengths "
            f"{100.0 * focal:+.1f} % (sd {100.0 * focal_sd:.1f} %); check fx and fy, the unit of the layout, and the depth's scale"
        )
    noise = problem.noise
    if problem.blobs.covariance_uv is None and px > 2.0 * noise.pixel_sd:
        out.append(
            f"pixels scatter by {px:.2f} px where {noise.pixel_sd:g} px were assumed: covariances are too small; set noise.pixel_sd"
        )
    if noise.depth_sd is not None and np.isfinite(depth) and depth > 2.0 * noise.depth_sd:
        out.append(
            f"depths scatter by {1e3 * depth:.1f} mm where {1e3 * noise.depth_sd:.1f} mm were assumed; set noise.depth_sd"
        )
    if problem.first_pass.not_rigid:
        out.append(
            "the markers do not move as one rigid palm with the measured layout: the layout was not estimated, its covariance was added to "
            "every residual; check the layout, or give the markers that move on the skin or on fingers a larger sd"
        )
    if track.ambiguous.any():
        share = 100.0 * float(np.mean(track.ambiguous))
        out.append(
            f"without depth two poses explain the pixels of {share:.0f} % of the frames (the markers are nearly coplanar): the "
            "orientation there is ambiguous; use the camera's depth"
        )
    lost = [gap for gap in track.gaps if gap.lost]
    if lost:
        seconds = sum(gap.end - gap.start for gap in lost)
        out.append(
            f"the hand was lost {len(lost)} times, {seconds:.1f} s in all; those frames hold no measurement"
        )
    return tuple(out)

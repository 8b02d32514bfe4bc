"""A wrist recording with everything that one wants from it: the problem, the way to smooth it, and the measures of the track."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, Literal, cast

import numpy as np

from factorgrasp.errors import NotSolvedError
from factorgrasp.estimate import Estimate
from factorgrasp.kinematics.angles import Facing, Hand
from factorgrasp.kinematics.wrist_measures import wrist_measures
from factorgrasp.least_squares import LeastSquares
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.wrist_estimate import (
    WristPoseEstimate,
    find_gaps,
    first_frames,
    lost_frames,
    make_track,
)
from factorgrasp.problems.wrist_pose import WristPose
from factorgrasp.problems.wrist_settings import WristAssociation, WristNoise, WristSettings
from factorgrasp.problems.wrist_track import CameraPose, WristTrack
from factorgrasp.provenance import versions
from factorgrasp.recordings.blobs import BlobRecording
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, State
from factorgrasp.wrist_checks import riding_blobs, riding_words, seen_from_behind
from factorgrasp.wrist_result import WristResult

MOST_AMBIGUOUS = 0.2
"""Share of the frames that may be ambiguous before the answer as a whole is."""
LEAST_FOUND = 0.5
"""Share of the frames in which the hand has to be found."""
LEAST_DETECTION = 0.6
"""Share of the markers that have to be seen for an answer about which there are doubts."""


class WristTask:
    """What ``kind = "wrist_pose"`` of a problem file states.

    Parameters
    ----------
    camera : Camera
    blobs : BlobRecording
    markers : MarkerLayout
    association, noise, settings, camera_pose
        As for :class:`factorgrasp.problems.WristPose`.
    method : {"batch", "fixed_lag", "filter"}
        Smoothed over the whole recording; or each frame as it is known `settings.lag` frames later, or at once.
    hand : {"right", "left"}
    facing : {"back", "palm"}
        The side of the hand that bears the markers.
    remarks : sequence of str
        What the reader of the recording noticed.
    """

    kind = "wrist_pose"

    def __init__(
        self,
        camera: Camera,
        blobs: BlobRecording,
        markers: MarkerLayout,
        *,
        association: WristAssociation | None = None,
        noise: WristNoise | None = None,
        settings: WristSettings | None = None,
        camera_pose: CameraPose | None = None,
        method: Literal["batch", "fixed_lag", "filter"] = "batch",
        hand: Hand = "right",
        facing: Facing = "back",
        remarks: tuple[str, ...] = (),
    ) -> None:
        self.problem = WristPose(camera, blobs, markers, association, noise, settings, camera_pose)
        self.method, self.hand, self.facing, self.remarks = method, hand, facing, tuple(remarks)

    def solve(self, solver: str | None = None) -> WristResult:
        """Track, smooth and measure.

        Parameters
        ----------
        solver : str, optional
            Of the batch; a filter and a fixed lag have their own.

        Returns
        -------
        WristResult
            Also when the hand was not found, with the reason.
        """
        from factorgrasp.solvers.solve import solve

        try:
            solved = (
                cast(WristPoseEstimate, solve(self.problem, solver))
                if self.method == "batch"
                else self._forward()
            )
        except NotSolvedError as error:
            solved = self._nothing(str(error))
        measures = wrist_measures(solved.track, self.hand, self.facing)
        track = solved.track
        riding = riding_blobs(track, self.problem.blobs, self.problem.camera)
        behind, others = seen_from_behind(track), riding_words(riding)
        status, message = self._judged(solved, behind, others)
        doubts = (*behind, *others)
        warnings = [*self.remarks, *solved.warnings, *doubts, *measures.words]
        estimate = replace(solved.estimate, status=status, message=message)
        return WristResult(
            estimate,
            solved,
            measures,
            self.problem.blobs,
            self.problem.camera,
            self.hand,
            self.method,
            tuple(dict.fromkeys(warnings)),
        )

    # ---- for the comparison of solvers: the batch

    def initial_state(self) -> State:
        """As for :class:`factorgrasp.problems.WristPose`, and so the three below."""
        return self.problem.initial_state()

    def linearize(self, state: State) -> LeastSquares:
        """The rows of the batch."""
        return self.problem.linearize(state)

    def retract(self, state: State, step: FloatArray) -> State:
        """Move the state."""
        return self.problem.retract(state, step)

    def view(self, estimate: Estimate) -> WristPoseEstimate:
        """The track of a solution."""
        return self.problem.view(estimate)

    def factor_graph(self, state: State | None = None) -> Any:
        """The batch as ``gtsam.NonlinearFactorGraph``."""
        return self.problem.factor_graph(state)

    def graph_values(self, state: State) -> Any:
        """A state as ``gtsam.Values``."""
        return self.problem.graph_values(state)

    def graph_state(self, values: Any) -> State:
        """``gtsam.Values`` as a state."""
        return self.problem.graph_state(values)

    # ---- a filter and a fixed lag

    def _forward(self) -> WristPoseEstimate:
        """The track as an online estimator gives it, newest or lagged."""
        problem = self.problem
        started = time.perf_counter()
        first, newest = problem.forward
        elapsed = time.perf_counter() - started
        nodes = first.nodes if self.method == "fixed_lag" else newest
        used = np.array([node.used for node in newest])
        gaps = find_gaps(problem.blobs.t, used, problem.association.lost_after)
        markers = MarkerLayout(problem.markers.names, first.layout, problem.markers.covariance)
        start = problem.camera_pose or first_frames(problem, first.nodes, markers)
        track = make_track(
            nodes,
            start,
            first.marker,
            gaps,
            markers,
            lost_frames(problem.blobs.t, gaps, nodes),
            problem.settings.lag if self.method == "fixed_lag" else 0,
        )
        estimate = self._estimate(Status.SOLVED, "", "tracker", {"solve": elapsed})
        nan = float("nan")
        densities = np.sqrt(first.densities)
        return WristPoseEstimate(
            estimate, track, first.detection, first.clutter, nan, nan, float(densities[0]), float(densities[1]), nan, nan
        )  # fmt: skip

    # ---- what came of it

    def _estimate(self, status: Status, message: str, solver: str, timing: dict[str, float]) -> Estimate:
        return Estimate(
            status, self.kind, solver, (), {}, message, timing=timing, versions=versions(("gtsam", "qdldl"))
        )

    def _nothing(self, reason: str) -> WristPoseEstimate:
        """A track in which nothing is known, so that the reason is written like any other answer."""
        problem = self.problem
        n = len(problem.blobs)
        unknown = np.full((n, 6, 6), np.inf)
        no = np.zeros(n, dtype=bool)
        nowhere = CameraPose(np.full((3, 3), np.nan), np.full(3, np.nan), np.full((6, 6), np.nan))
        nothing = np.full((n, 3), np.nan)
        nobody = np.zeros(problem.blobs.frame.size, dtype=np.intp)
        track = WristTrack(
            problem.blobs.t, np.full((n, 4), np.nan), nothing, nothing, nothing, unknown, unknown, nobody, ~no, no, (),
            problem.markers, nowhere,
        )  # fmt: skip
        estimate = self._estimate(Status.UNOBSERVABLE, reason, "tracker", {})
        nan = float("nan")
        clutter = problem.blobs.frame.size / max(n, 1)
        return WristPoseEstimate(estimate, track, 0.0, clutter, nan, nan, nan, nan, nan, nan)

    def _judged(
        self, solved: WristPoseEstimate, behind: tuple[str, ...], others: tuple[str, ...]
    ) -> tuple[Status, str]:
        """Whether the track as a whole answers the question."""
        status, message = solved.estimate.status, solved.estimate.message
        track = solved.track
        if not status.ok:
            return status, message
        ambiguous = float(np.mean(track.ambiguous[~track.lost])) if not track.lost.all() else 0.0
        if ambiguous > MOST_AMBIGUOUS:
            return Status.UNOBSERVABLE, (
                f"the orientation is ambiguous in {100.0 * ambiguous:.0f} % of the frames: without depth two poses explain the pixels of "
                "nearly coplanar markers; give depths (z), or markers that are not in one plane"
            )
        found = 1.0 - float(np.mean(track.lost))
        if found < LEAST_FOUND:
            return Status.UNOBSERVABLE, (
                f"the hand was found in {100.0 * found:.0f} % of the frames only; check the layout, the units of the depth and the "
                "intrinsics"
            )
        # A layout with its z axis the other way round fits well from behind; a mirror image leaves blobs that fit nowhere.
        if (behind and others) or ((behind or others) and solved.detection < LEAST_DETECTION):
            return Status.INFEASIBLE, (
                f"no motion of this layout explains the blobs, {100.0 * solved.detection:.0f} % of its markers are seen: "
                + " ".join((*behind, *others))
                + " Are the intrinsics right?"
            )
        return status, message

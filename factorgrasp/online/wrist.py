"""The wrist's pose while the camera runs."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.wrist_frames import StartFrame, in_start_frame
from factorgrasp.problems.wrist_settings import WristAssociation, WristNoise, WristSettings
from factorgrasp.problems.wrist_track import CameraPose, Gap
from factorgrasp.problems.wrist_tracker import Node, Step, WristTracker
from factorgrasp.recordings.blobs import BlobFrame
from factorgrasp.typing import FloatArray, IntArray

MOST_GAPS = 256


@dataclass(frozen=True, eq=False)
class WristState:
    """Pose of ``W`` in ``W0`` at one time; NaN before the hand was found for the first time.

    Attributes
    ----------
    t : float
        s.
    rotation : (3, 3) ndarray
        ``R_w0_w``.
    position : (3,) ndarray
        ``p_w0_w``, m.
    velocity : (3,) ndarray
        In W0, m/s.
    angular_velocity : (3,) ndarray
        In W, rad/s.
    covariance : (6, 6) ndarray
        [rotation; translation], as in `WristTrack`.
    lost, ambiguous : bool
    """

    t: float
    rotation: FloatArray
    position: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    covariance: FloatArray
    lost: bool
    ambiguous: bool

    @property
    def rotation_wxyz(self) -> FloatArray:
        """Unit quaternion [w, x, y, z]."""
        return lie.matrix_to_quaternion_wxyz(self.rotation)


@dataclass(frozen=True, eq=False)
class OnlineWristEstimate:
    """What is known after one frame.

    Attributes
    ----------
    newest : WristState
        Of the newest frame, without delay.
    lagged : WristState or None
        Of the frame that has left the lag last: smoothed, final; None until one has.
    finished : tuple of WristState
        All frames that have become final with this one, in order: one as a rule, more when the hand was lost.
    association : (m,) ndarray of int
        Of this frame's blobs: 0 clutter, 1..n the marker.
    gap : float
        s since the last frame in which a marker was used; 0 when it is this one.
    message : str
        Empty, or what is wrong in words: not found yet, lost, ambiguous, late frame dropped.
    latency : float
        Seconds that the step took.
    """

    newest: WristState
    lagged: WristState | None
    finished: tuple[WristState, ...]
    association: IntArray
    gap: float
    message: str
    latency: float


@dataclass(frozen=True)
class WristCounts:
    """What became of the frames: all, put in their place although late, too late, found again by a search."""

    frames: int = 0
    late: int = 0
    dropped: int = 0
    searches: int = 0


class OnlineWristPose:
    """Streaming form of :class:`factorgrasp.problems.wrist_pose.WristPose`: the same terms over a window of frames.

    Memory does not grow. Frames may be missing, and may come late: one that is younger than the lag is put in its place.

    Parameters
    ----------
    camera, markers, association, noise, settings, camera_pose
        As for the problem.
    late : float
        s that a frame may come after a newer one and still be put in its place.
    """

    def __init__(
        self,
        camera: Camera,
        markers: MarkerLayout,
        association: WristAssociation | None = None,
        noise: WristNoise | None = None,
        settings: WristSettings | None = None,
        camera_pose: CameraPose | None = None,
        late: float = 0.2,
    ) -> None:
        self.camera, self.markers, self.late = camera, markers, float(late)
        self.settings = settings or WristSettings()
        self._tracker = WristTracker(
            camera, markers, association or WristAssociation(), noise or WristNoise(), self.settings
        )
        exact = self.settings.layout == "exact"
        covariance = np.zeros_like(markers.covariance) if exact else markers.covariance
        self._start = StartFrame(camera, markers.points, covariance, self.settings.start_frames, camera_pose)
        self._newest_t = -np.inf
        self._lagged: WristState | None = None
        self._gap_start: float | None = None
        self._gap_frames = 0
        self._gap_end = -np.inf
        self._before_gap = -np.inf
        self.gaps: deque[Gap] = deque(maxlen=MOST_GAPS)
        self.counts = WristCounts()

    # ---- what is known

    @property
    def camera_pose(self) -> CameraPose | None:
        """``W0`` as the camera sees it; None before the hand was found. It settles over the first frames of a hand at rest."""
        return self._start.pose

    @property
    def layout(self) -> MarkerLayout:
        """The markers with what the stream has taught about them so far."""
        covariance = self._tracker.layout_covariance
        return MarkerLayout(self.markers.names, self._tracker.layout, 0.5 * (covariance + covariance.T))

    @property
    def detection(self) -> float:
        """Probability that a marker is seen."""
        return self._tracker.detection

    @property
    def clutter(self) -> float:
        """Blobs a frame that are no marker."""
        return self._tracker.clutter

    @property
    def held(self) -> int:
        """Frames that are kept; never more than the lag and one."""
        return self._tracker.held

    # ---- the stream

    def push(
        self,
        t: float,
        uv: ArrayLike,
        depth: ArrayLike | None = None,
        covariance_uv: ArrayLike | None = None,
        covariance_depth: ArrayLike | None = None,
    ) -> OnlineWristEstimate:
        """Take the blobs of one frame.

        Parameters
        ----------
        t : float
            s.
        uv : (m, 2) array_like
            px; m may be 0.
        depth : (m,) array_like, optional
            m, NaN (or 0) where it is missing.
        covariance_uv : (m, 2, 2) array_like, optional
            px^2.
        covariance_depth : (m,) array_like, optional
            m^2.

        Raises
        ------
        InputError
            For a time that is none, pixels that are NaN or outside of the image, depths that are negative or in millimetres.
        """
        started = time.perf_counter()
        blobs = self._checked(t, uv, depth, covariance_uv, covariance_depth)
        message = ""
        if blobs.t <= self._newest_t:
            step = self._tracker.insert(blobs) if blobs.t > self._newest_t - self.late else None
            if step is None:
                return self._dropped(blobs, started)
            self._count(late=1)
        else:
            step = self._tracker.push(blobs)
            self._newest_t = blobs.t
            self._count(searches=int(step.searched))
            self._watch_gap(blobs.t, step.newest)
        return self._answer(step, started, message)

    def finish(self) -> tuple[WristState, ...]:
        """The frames that are still in the lag, smoothed as far as they will be. The stream may go on; they will come again then."""
        tracker = self._tracker
        if not tracker.tracking:
            return ()
        frames, flags = tracker._frames.copy(), tracker._flags.copy()
        out = tuple(self._state(node) for _, node in tracker.flush())
        tracker._frames, tracker._flags = frames, flags
        return out

    # ---- internals

    def _answer(self, step: Step, started: float, message: str) -> OnlineWristEstimate:
        if step.pairs is not None and not self._start.closed and not step.newest.lost:
            self._start.add(step.newest.t, step.pairs, step.newest.R, step.newest.x[:3])
        finished = tuple(self._state(node) for _, node in step.finished)
        if finished:
            self._lagged = finished[-1]
        newest = self._state(step.newest)
        gap = max(0.0, self._newest_t - self._tracker.last_used)
        if newest.lost:
            found = self._tracker.found
            message = (
                f"the hand is lost for {gap:.2f} s: the pose is a prediction"
                if found
                else "the hand was not found yet: at least three markers with depth have to be seen at once"
            )
        elif newest.ambiguous:
            message = "without depth two poses explain the pixels: the orientation is ambiguous"
        return OnlineWristEstimate(
            newest, self._lagged, finished, step.marker, gap, message, time.perf_counter() - started
        )

    def _dropped(self, blobs: BlobFrame, started: float) -> OnlineWristEstimate:
        self._count(dropped=1)
        node = self._tracker.newest_node()
        gap = max(0.0, self._newest_t - self._tracker.last_used)
        words = f"a frame came {1e3 * (self._newest_t - blobs.t):.0f} ms after a newer one: too late, dropped"
        nobody = np.zeros(len(blobs), dtype=np.intp)
        return OnlineWristEstimate(
            self._state(node), self._lagged, (), nobody, gap, words, time.perf_counter() - started
        )

    def _state(self, node: Node) -> WristState:
        start = self._start.pose
        if start is None or not np.isfinite(node.x).all():
            nothing = np.full(3, np.nan)
            unknown = np.diag(np.full(6, np.inf))
            return WristState(
                node.t, np.full((3, 3), np.nan), nothing, nothing, nothing, unknown, True, node.ambiguous
            )
        q = in_start_frame(start, node.R, node.x, node.covariance, node.with_layout)
        return WristState(node.t, q.R, q.p, q.v, q.w, q.covariance, node.lost, node.ambiguous)

    def _watch_gap(self, t: float, node: Node) -> None:
        if not node.used:
            if self._gap_start is None:
                self._gap_start, self._gap_frames = t, 0
            self._gap_frames += 1
            self._gap_end = t
            return
        if self._gap_start is not None:
            lost = t - self._before_gap > self._tracker.association.lost_after
            self.gaps.append(Gap(self._gap_start, self._gap_end, self._gap_frames, lost, t))
            self._gap_start = None
        self._before_gap = t

    def _count(self, late: int = 0, dropped: int = 0, searches: int = 0) -> None:
        c = self.counts
        self.counts = WristCounts(c.frames + 1, c.late + late, c.dropped + dropped, c.searches + searches)

    def _checked(
        self,
        t: float,
        uv: ArrayLike,
        depth: ArrayLike | None,
        covariance_uv: ArrayLike | None,
        covariance_depth: ArrayLike | None,
    ) -> BlobFrame:
        if not np.isfinite(t):
            raise InputError("t", "a time in seconds", repr(t))
        pixels = np.asarray(uv, dtype=float)
        pixels = pixels.reshape(-1, 2) if pixels.size == 0 else pixels
        if pixels.ndim != 2 or pixels.shape[1] != 2:
            raise InputError("uv", "shape (m, 2), px", f"shape {pixels.shape}")
        count = pixels.shape[0]
        z = np.full(count, np.nan) if depth is None else np.array(depth, dtype=float).reshape(-1)
        if z.shape != (count,):
            raise InputError("depth", f"shape ({count},), m", f"shape {z.shape}")
        if not np.isfinite(pixels).all():
            raise InputError("uv", "finite pixels", "NaN or infinity", "Leave a blob that was not found out")
        if count and not self.camera.inside(pixels, -2.0).all():
            swapped = bool(self.camera.inside(pixels[:, ::-1], -2.0).all())
            row = pixels[~self.camera.inside(pixels, -2.0)][0]
            raise InputError(
                "uv",
                f"pixels within the image of {self.camera.width} x {self.camera.height}",
                f"({row[0]:g}, {row[1]:g})",
                "Are u and v swapped?"
                if swapped
                else "Are the resolution and the intrinsics those of these images?",
            )
        z[z == 0.0] = np.nan
        known = z[np.isfinite(z)]
        if np.isinf(z).any() or np.any(known < 0.0):
            raise InputError("depth", "metres above zero, NaN where missing", "a negative or infinite depth")
        if known.size and np.median(known) > 20.0:
            raise InputError("depth", "metres", f"a median of {np.median(known):g}", "Is it in millimetres?")
        C = None if covariance_uv is None else np.asarray(covariance_uv, dtype=float)
        s = None if covariance_depth is None else np.asarray(covariance_depth, dtype=float)
        if C is not None and C.shape != (count, 2, 2):
            raise InputError("covariance_uv", f"shape ({count}, 2, 2)", str(C.shape))
        if s is not None and s.shape != (count,):
            raise InputError("covariance_depth", f"shape ({count},)", str(s.shape))
        return BlobFrame(float(t), pixels, z, C, s)

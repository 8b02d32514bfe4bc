"""The wrist frame by frame: predict, associate, smooth over the lag, notice when it is lost, find it again.

Everything here is in the camera frame; ``W0`` enters only when results are read out (:mod:`factorgrasp.problems.wrist_frames`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp import lie
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.wrist_assign import Prediction, Rates, assign
from factorgrasp.problems.wrist_flat import DECIDED, DEEP_ENOUGH, LOOSE, flat_search, second_pose
from factorgrasp.problems.wrist_model import NODE_SIZE, Pairs, blob_covariances, predict, roots
from factorgrasp.problems.wrist_search import Found, Guess, prediction, search
from factorgrasp.problems.wrist_settings import WristAssociation, WristNoise, WristSettings
from factorgrasp.problems.wrist_window import Leaving, Window
from factorgrasp.recordings.blobs import BlobFrame
from factorgrasp.typing import FloatArray, IntArray

POSE_SD = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
"""rad and m: how little is known of a pose before it is found."""
RATE_SD = np.array([1.5, 1.5, 1.5, 0.5, 0.5, 0.5, 15.0, 15.0, 15.0, 5.0, 5.0, 5.0])
"""rad/s, m/s, rad/s^2, m/s^2: how fast a hand moves that has just been found."""
_RATE_FRAMES = 30.0
_MEMORY_FRAMES = 300.0
_MEMORY_SECONDS = 3.0
_DENSITY_WEIGHT = 3.0
_DENSITY_BOUNDS = (0.1, 100.0)
NOT_RIGID = 70.0
"""Squared deviation of the learnt layout in its own covariance: of 18 coordinates, less than one in a million rigid palms."""
_DECISIVE_FRAMES = 30
"""Frames in a row that have to decide between two poses before one of them is believed without reserve."""


@dataclass(frozen=True, eq=False)
class Node:
    """The wrist in one frame, seen from the camera.

    Attributes
    ----------
    t : float
    R : (3, 3) ndarray
        ``R_c_w``; NaN before it was found for the first time.
    x : (D - 3,) ndarray
        ``[p_c_w, w (in W), v (in c), ...]``.
    covariance : (D, D) ndarray
        Of ``[theta, p, w, v, ...]``.
    with_layout : (D, 3n or 0) ndarray
        Covariance with the layout's coordinates.
    lost, used, ambiguous : bool
        Not trusted; updated by at least one marker; explained by two poses.
    """

    t: float
    R: FloatArray
    x: FloatArray
    covariance: FloatArray
    with_layout: FloatArray
    lost: bool
    used: bool
    ambiguous: bool


@dataclass(frozen=True, eq=False)
class Step:
    """What a frame brought.

    Attributes
    ----------
    newest : Node
    marker : (m,) ndarray of int
        Of every blob: 0 clutter, 1..n.
    finished : list of (int, Node)
        Frames (numbers as they were pushed, from 0) whose smoothing ended with this one.
    searched : bool
    pairs : Pairs or None
        What was used.
    """

    newest: Node
    marker: IntArray
    finished: list[tuple[int, Node]]
    searched: bool
    pairs: Pairs | None = None


class WristTracker:
    """Tracks one hand.

    Parameters
    ----------
    camera : Camera
    markers : MarkerLayout
    association : WristAssociation
    noise : WristNoise
    settings : WristSettings
    """

    def __init__(
        self,
        camera: Camera,
        markers: MarkerLayout,
        association: WristAssociation,
        noise: WristNoise,
        settings: WristSettings,
    ) -> None:
        self.camera, self.markers = camera, markers
        self.association, self.noise, self.settings = association, noise, settings
        self.size = NODE_SIZE[noise.motion]
        prior: FloatArray | None = None
        if settings.layout == "estimate" and np.any(markers.covariance > 0.0):
            # An exact coordinate among uncertain ones still needs a finite weight.
            prior = np.asarray(np.linalg.inv(markers.covariance + 1e-12 * np.eye(3 * len(markers))))
        self.window = Window(
            camera,
            markers.points.copy(),
            prior,
            noise.motion,
            noise.densities,
            settings.lag,
            settings.loss_scale,
        )
        self._blocks = markers.blocks if settings.layout != "exact" else np.zeros((len(markers), 3, 3))
        self._frames: list[int] = []
        self._flags: list[tuple[bool, FloatArray | None]] = []
        self.frame = -1
        self.found = False
        self.tracking = False
        self.last_used = -np.inf
        self.usual_depth = 0.8
        self._detected = association.detection * _RATE_FRAMES
        self._clutter = association.clutter * _RATE_FRAMES
        self._looks = _RATE_FRAMES
        self._fit = np.zeros((2, 2))
        self._poor = 0
        self._shallow = 0
        self.not_rigid = False
        self._last_doubt: FloatArray | None = None
        self._against = self._decisive = 0
        self._handed_over: list[tuple[int, Node]] = []

    # ---- what is known

    @property
    def detection(self) -> float:
        """Probability that a marker is seen."""
        return float(np.clip(self._detected / self._looks, 0.02, 0.999))

    @property
    def clutter(self) -> float:
        """Blobs a frame that are no marker."""
        return float(self._clutter / self._looks)

    @property
    def rates(self) -> Rates:
        """Both, with the image."""
        return Rates(self.detection, self.clutter, self.camera.pixels)

    @property
    def layout(self) -> FloatArray:
        """(n, 3) markers in W as they are known now."""
        return self.window.layout

    @property
    def layout_covariance(self) -> FloatArray:
        """(3n, 3n)."""
        s = self.window.shared
        return self.window.covariance_newest[:s, :s] if s and self.found else self.markers.covariance

    @property
    def held(self) -> int:
        """Frames that are kept: bounded by the lag."""
        return len(self._frames)

    # ---- one frame

    def push(self, blobs: BlobFrame) -> Step:
        """Take the blobs of the next frame, later than all before."""
        self.frame += 1
        uvz = np.concatenate([blobs.uv, blobs.depth[:, None]], axis=1)
        covariance = blob_covariances(
            self.camera,
            self.noise,
            blobs.depth,
            self.usual_depth,
            blobs.covariance_uv,
            blobs.covariance_depth,
        )
        finished: list[tuple[int, Node]] = []
        if self.tracking and blobs.t - self.last_used > self.association.lost_after:
            finished += self._drain()
            self.tracking = False
        if not self.tracking:
            return self._seek(blobs.t, uvz, covariance, finished)
        return self._follow(blobs.t, uvz, covariance, finished)

    def _follow(
        self, t: float, uvz: FloatArray, covariance: FloatArray, finished: list[tuple[int, Node]]
    ) -> Step:
        """A frame of a hand that is being tracked."""
        R, x, P = self.window.predicted(t)
        predicted = self._prediction(R, x, P)
        searched = False
        if predicted.pixel_sd <= self.association.uncertain_px:
            used_covariance = covariance
            if not self.association.depth:
                used_covariance = covariance.copy()
                used_covariance[:, 2, 2] = np.nan
            marker = assign(
                self.association.method, predicted, uvz, used_covariance, self.rates, self.association.gate
            ).marker
            better = self._elsewhere(marker, uvz, covariance)
            if better is not None:
                finished += self._drain()
                return self._begin(t, better, uvz, covariance, finished)
        else:
            searched = True
            s = self.window.shared
            guess = Guess(R, x[:3], P[s : s + 6, s : s + 6])
            found = self._search(uvz, covariance, guess)
            marker = np.full(len(uvz), -1, dtype=np.intp)
            if found is not None:
                marker, R, x = found.assignment.marker, found.R, np.concatenate([found.p, x[3:]])
        used = bool(np.any(marker >= 0))
        self._frames.append(self.frame)
        self._flags.append((used, None))
        pairs = self._pairs(uvz, covariance, marker, R, x)
        try:
            leaving = self.window.push(t, pairs, R, x)
        except np.linalg.LinAlgError:
            self.tracking = False
            self._frames, self._flags = [], []
            return Step(self._nothing(t), np.zeros(len(uvz), dtype=np.intp), finished, searched)
        if leaving is not None:
            finished.append(self._finish(leaving))
            self._adapt_densities(leaving)
        if used:
            self.last_used = t
        self._count(marker, predicted)
        doubt = self._doubt(self.window.R[-1], self.window.x[-1, :3], uvz, covariance, marker)
        self._flags[-1] = used, doubt
        if self._against >= 3 and doubt is not None:
            self._turn_over(doubt)
        elif self._contradicts_layout():
            self._stop_learning(uvz, covariance, marker)
        newest = self._newest(t, used, doubt)
        finished += self._handed_over
        self._handed_over = []
        return Step(newest, marker + 1, finished, searched, pairs)

    def _seek(
        self, t: float, uvz: FloatArray, covariance: FloatArray, finished: list[tuple[int, Node]]
    ) -> Step:
        """A frame in which the hand has to be found."""
        found = self._search(uvz, covariance, None)
        if found is not None:
            return self._begin(t, found, uvz, covariance, finished)
        finished.append((self.frame, self._nothing(t)))
        return Step(self._nothing(t), np.zeros(len(uvz), dtype=np.intp), finished, True)

    def _begin(
        self,
        t: float,
        found: Found,
        uvz: FloatArray,
        covariance: FloatArray,
        finished: list[tuple[int, Node]],
    ) -> Step:
        if not np.isfinite(uvz[found.assignment.marker >= 0, 2]).any():
            self._last_doubt, self._decisive = np.zeros(6), 0
        self.window.start(t, found.R, found.p, POSE_SD, RATE_SD)
        marker = found.assignment.marker
        x = self.window.x[-1]
        pairs = self._pairs(uvz, covariance, marker, found.R, x)
        self.window.refresh(pairs)
        self.tracking = self.found = True
        self.last_used, self._poor = t, 0
        doubt = self._doubt(self.window.R[-1], self.window.x[-1, :3], uvz, covariance, marker)
        self._frames, self._flags = [self.frame], [(True, doubt)]
        return Step(self._newest(t, True, doubt), marker + 1, finished, True, pairs)

    def insert(self, blobs: BlobFrame) -> Step | None:
        """Take a frame that comes late, at its own time; None when it is too old to change anything that is still open."""
        if not self.tracking:
            return None
        place = self.window.place(blobs.t)
        if place is None:
            return None
        self.frame += 1
        uvz = np.concatenate([blobs.uv, blobs.depth[:, None]], axis=1)
        covariance = blob_covariances(
            self.camera,
            self.noise,
            blobs.depth,
            self.usual_depth,
            blobs.covariance_uv,
            blobs.covariance_depth,
        )
        R, x = self.window.between(blobs.t)
        # The newest node is the least known of the window: its covariance is on the safe side.
        predicted = self._prediction(R, x, self.window.covariance_newest)
        marker = np.full(len(uvz), -1, dtype=np.intp)
        if predicted.pixel_sd <= self.association.uncertain_px:
            marker = assign(
                self.association.method, predicted, uvz, covariance, self.rates, self.association.gate
            ).marker
        used = bool(np.any(marker >= 0))
        self._frames.insert(place, self.frame)
        self._flags.insert(place, (used, self._last_doubt))
        pairs = self._pairs(uvz, covariance, marker, R, x)
        leaving = self.window.insert(blobs.t, pairs)
        finished = [] if leaving is None else [self._finish(leaving)]
        return Step(self._newest(self.window.t[-1], *self._flags[-1]), marker + 1, finished, False, pairs)

    def flush(self) -> list[tuple[int, Node]]:
        """What is still in the lag, smoothed as far as it will be."""
        return self._drain() if self.tracking else []

    # ---- parts

    def _prediction(self, R: FloatArray, x: FloatArray, P: FloatArray) -> Prediction:
        """Markers in the frame to come; what the layout's error moves together with the pose is not counted twice."""
        s = self.window.shared
        points = self.window.layout
        if not s:
            return prediction(self.camera, points, self._blocks, R, x[:3], P[:6, :6])
        count = len(points)
        uvz, J, J_point = predict(
            self.camera, np.broadcast_to(R, (count, 3, 3)), np.broadcast_to(x[:3], (count, 3)), points
        )
        if not np.isfinite(uvz).all():
            return prediction(self.camera, points, self._blocks, R, x[:3], P[s : s + 6, s : s + 6])
        layout = P[:s, :s]
        gain = np.linalg.solve(layout, P[:s, s : s + 6]).T
        pose = P[s : s + 6, s : s + 6] - gain @ P[:s, s : s + 6]
        G = J @ gain
        own_columns = G.reshape(count, 3, count, 3)
        own_columns[np.arange(count), :, np.arange(count)] += J_point
        G = own_columns.reshape(count, 3, s)
        own = G @ layout @ np.swapaxes(G, 1, 2)
        return Prediction(uvz, J, 0.5 * (pose + pose.T), own)

    def _pairs(
        self, uvz: FloatArray, covariance: FloatArray, marker: IntArray, R: FloatArray, x: FloatArray
    ) -> Pairs:
        used = np.flatnonzero(marker >= 0)
        C = covariance[used]
        if (self.settings.layout == "noise" or self.not_rigid) and used.size:
            points = self.window.layout[marker[used]]
            shape = (used.size, 3, 3)
            J = predict(
                self.camera, np.broadcast_to(R, shape), np.broadcast_to(x[:3], (used.size, 3)), points
            )[2]
            C = C + J @ self._blocks[marker[used]] @ np.swapaxes(J, 1, 2)
        node = np.zeros(used.size, dtype=np.intp)
        values = np.where(np.isfinite(uvz[used]), uvz[used], 0.0)
        if used.size:
            deep = uvz[used, 2]
            if np.isfinite(deep).any():
                self.usual_depth = float(np.nanmedian(deep))
        return Pairs(node, marker[used], values, roots(C), C)

    def _search(self, uvz: FloatArray, covariance: FloatArray, guess: Guess | None) -> Found | None:
        support, gate = self.association.support, self.association.gate
        if len(uvz) >= support:
            found = search(
                self.camera,
                self.window.layout,
                self._blocks,
                uvz,
                covariance,
                self.rates,
                support,
                gate,
                guess,
            )
            if found is not None:
                return found
        if guess is None and len(uvz) >= 4 and not np.isfinite(uvz[:, 2]).any():
            # Without any depth for a while: the hand is taken to lie as the paper asks, its back towards the camera.
            self._shallow += 1
            if self._shallow > 2:
                return flat_search(
                    self.camera, self.window.layout, self._blocks, uvz, covariance, self.rates, gate
                )
        return None

    def _elsewhere(self, marker: IntArray, uvz: FloatArray, covariance: FloatArray) -> Found | None:
        """A pose with much more support than the present track, when that has had little for a while."""
        count = int(np.count_nonzero(marker >= 0))
        free = int(np.count_nonzero((marker < 0) & np.isfinite(uvz[:, 2])))
        self._poor = self._poor + 1 if count < 3 and free >= 4 else 0
        if self._poor < 3:
            return None
        found = self._search(uvz, covariance, None)
        if found is None or found.assignment.count < max(4, count + 2):
            return None
        return found

    def _doubt(
        self, R: FloatArray, p: FloatArray, uvz: FloatArray, covariance: FloatArray, marker: IntArray
    ) -> FloatArray | None:
        """How far away (6,) the pose may be because there is (almost) no depth; None when the pixels leave no doubt."""
        used = marker >= 0
        if not used.any():
            return self._last_doubt
        if np.count_nonzero(np.isfinite(uvz[used, 2])) >= DEEP_ENOUGH:
            self._last_doubt, self._against = None, 0
            return None
        if np.isfinite(uvz[:, 2]).any() and self._last_doubt is None:
            # A camera with depth whose few markers lack it just now: the track remembers which of the two poses it was.
            return None
        # Judged by the layout as it was measured: one that was learnt under a wrong pose would speak for it.
        points = self.markers.points
        other = second_pose(self.camera, points, self._blocks, R, p, uvz, covariance, marker)
        s = self.window.shared
        P = self.window.covariance_newest[s : s + 3, s : s + 3]
        loose = float(np.sqrt(np.linalg.eigvalsh(P)[-1])) > LOOSE
        if other is not None and other[1] < DECIDED:
            self._last_doubt, self._decisive = other[0], 0
            self._against = self._against + 1 if other[1] < -DECIDED else 0
        elif loose or np.count_nonzero(used) < 4:
            self._last_doubt = np.zeros(6) if self._last_doubt is None else self._last_doubt
            self._decisive = 0
        elif other is not None:
            self._against = 0
            self._decisive += 1
            if self._decisive >= _DECISIVE_FRAMES:
                self._last_doubt = None
        return self._last_doubt

    def _count(self, marker: IntArray, predicted: Prediction) -> None:
        if not self.association.adapt or predicted.pixel_sd > self.association.uncertain_px:
            return
        seen = self.camera.inside(predicted.uvz[:, :2])
        share = np.count_nonzero(marker >= 0) / max(int(seen.sum()), 1)
        forget = 1.0 - 1.0 / _MEMORY_FRAMES
        self._detected = forget * self._detected + min(share, 1.0)
        self._clutter = forget * self._clutter + np.count_nonzero(marker < 0)
        self._looks = forget * self._looks + 1.0

    def _adapt_densities(self, leaving: Leaving) -> None:
        """Variance-component estimate of the spectral densities, with the defaults as a few transitions' worth of data."""
        noise = self.noise
        if not noise.adapt:
            return
        forget = float(np.exp(-1.0 / (_MEMORY_SECONDS * self.camera.rate)))
        freedom = np.maximum(leaving.transition_freedom, 0.0)
        self._fit = forget * self._fit + np.stack([leaving.transition_chi2 * self.window.densities, freedom])
        usual = noise.densities
        found = (self._fit[0] + _DENSITY_WEIGHT * usual) / (self._fit[1] + _DENSITY_WEIGHT)
        found = np.clip(found, _DENSITY_BOUNDS[0] * usual, _DENSITY_BOUNDS[1] * usual)
        fixed = np.array([noise.rotation_density is not None, noise.translation_density is not None])
        self.window.densities = np.where(fixed, usual, found)

    # ---- results

    def _contradicts_layout(self) -> bool:
        """Whether the markers that were learnt cannot be those that were measured: not rigid, or not where they were said to be."""
        s = self.window.shared
        if not s:
            return False
        away = (self.window.layout - self.markers.points).ravel()
        return float(away @ np.linalg.solve(self.markers.covariance + 1e-12 * np.eye(s), away)) > NOT_RIGID

    def _stop_learning(self, uvz: FloatArray, covariance: FloatArray, marker: IntArray) -> None:
        """From here on the layout is the measured one, and its covariance is noise of every residual."""
        w = self.window
        R, x, t, doubt = w.R[-1], w.x[-1], w.t[-1], self._flags[-1][1]
        self._handed_over += self._drain_but_newest()
        self.not_rigid = True
        self.window = Window(
            self.camera, self.markers.points.copy(), None, w.motion, w.densities, w.lag, w.loss_scale
        )
        self.window.start(t, R, x[:3], POSE_SD, RATE_SD)
        self.window.refresh(self._pairs(uvz, covariance, marker, R, x))
        self._frames, self._flags = [self.frame], [(bool(np.any(marker >= 0)), doubt)]

    def _turn_over(self, doubt: FloatArray) -> None:
        """The pixels of several frames speak for the other pose: go on from there."""
        R, p = self.window.R[-1] @ lie.so3_exp(doubt[:3]), self.window.x[-1, :3] + doubt[3:]
        pairs, t = self.window.pairs[-1], self.window.t[-1]
        self._handed_over += self._drain_but_newest()
        self.window.start(t, R, p, POSE_SD, RATE_SD)
        self.window.refresh(pairs)
        self._frames, self._flags = [self.frame], [(True, doubt)]
        self._against = 0

    def _newest(self, t: float, used: bool, doubt: FloatArray | None) -> Node:
        s, P = self.window.shared, self.window.covariance_newest
        return _node(t, self.window.R[-1], self.window.x[-1], P[s:, s:], P[s:, :s], used, doubt)

    def newest_node(self) -> Node:
        """The newest node as it is now."""
        if not self.tracking:
            return self._nothing(self.window.t[-1] if self.window.t else 0.0)
        return self._newest(self.window.t[-1], *self._flags[-1])

    def _nothing(self, t: float) -> Node:
        """A lost hand: the last track moved on, with a covariance that grows; NaN before there was one."""
        if not self.found:
            n, s = self.size, self.window.shared
            unknown = np.full((n, n), np.inf)
            return Node(
                t,
                np.full((3, 3), np.nan),
                np.full(n - 3, np.nan),
                unknown,
                np.zeros((n, s)),
                True,
                False,
                False,
            )
        R, x, P = self.window.predicted(t)
        s = self.window.shared
        return Node(t, R, x, P[s:, s:], P[s:, :s], True, False, False)

    def _finish(self, leaving: Leaving) -> tuple[int, Node]:
        used, doubt = self._flags.pop(0)
        parts = leaving.R, leaving.x, leaving.covariance, leaving.with_layout
        return self._frames.pop(0), _node(self.window.left, *parts, used, doubt)

    def _drain(self) -> list[tuple[int, Node]]:
        out = []
        for t, leaving in zip(self.window.t, self.window.drain(), strict=True):
            used, doubt = self._flags.pop(0)
            parts = leaving.R, leaving.x, leaving.covariance, leaving.with_layout
            out.append((self._frames.pop(0), _node(t, *parts, used, doubt)))
        return out

    def _drain_but_newest(self) -> list[tuple[int, Node]]:
        return self._drain()[:-1]


def _node(
    t: float,
    R: FloatArray,
    x: FloatArray,
    covariance: FloatArray,
    with_layout: FloatArray,
    used: bool,
    doubt: FloatArray | None,
) -> Node:
    """A node; its covariance covers a second pose where there is one."""
    if doubt is not None:
        covariance = covariance.copy()
        covariance[:6, :6] += 0.5 * np.outer(doubt, doubt)
    return Node(t, R, x, covariance, with_layout, False, used, doubt is not None)

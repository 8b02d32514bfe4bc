"""Wrist pose from unlabelled blobs: the whole recording at once (mathematics 5; Cordella 2014).

A first pass tracks the hand frame by frame and gives blobs to markers; the batch then smooths pose, velocity and marker layout over the
recording, blobs are given to markers again under the smoothed poses, and so on until nothing changes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import NotSolvedError
from factorgrasp.estimate import Estimate
from factorgrasp.least_squares import LeastSquares
from factorgrasp.losses import GemanMcClure
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.wrist_assign import Prediction, Rates, assign
from factorgrasp.problems.wrist_chain import Marginals, marginals
from factorgrasp.problems.wrist_estimate import WristPoseEstimate, make_view
from factorgrasp.problems.wrist_graph import WristGraph
from factorgrasp.problems.wrist_model import NODE_SIZE, Pairs, blob_covariances, predict, roots
from factorgrasp.problems.wrist_rows import Batch, Rows
from factorgrasp.problems.wrist_settings import WristAssociation, WristNoise, WristSettings
from factorgrasp.problems.wrist_system import System
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.problems.wrist_tracker import RATE_SD, Node, WristTracker
from factorgrasp.recordings.blobs import BlobRecording
from factorgrasp.typing import BoolArray, FloatArray, IntArray, State
from factorgrasp.variables import Variable, retract

MOST_ROUNDS = 4
SETTLED_DENSITY = 0.1


@dataclass(frozen=True, eq=False)
class FirstPass:
    """What the frame-by-frame pass over the recording left."""

    nodes: tuple[Node, ...]
    marker: IntArray
    detection: float
    clutter: float
    densities: FloatArray
    layout: FloatArray
    not_rigid: bool


def track_forward(
    camera: Camera,
    blobs: BlobRecording,
    markers: MarkerLayout,
    association: WristAssociation,
    noise: WristNoise,
    settings: WristSettings,
) -> tuple[FirstPass, tuple[Node, ...]]:
    """Fixed-lag nodes of every frame with associations and rates; and the newest (filtered) node of every frame."""
    tracker = WristTracker(camera, markers, association, noise, settings)
    lagged: list[Node | None] = [None] * len(blobs)
    newest: list[Node] = []
    given = np.zeros(blobs.frame.size, dtype=np.intp)
    for k in range(len(blobs)):
        step = tracker.push(blobs.at(k))
        newest.append(step.newest)
        given[blobs.rows(k)] = step.marker
        for number, node in step.finished:
            lagged[number] = node
    for number, node in tracker.flush():
        lagged[number] = node
    whole = tuple(node if node is not None else newest[k] for k, node in enumerate(lagged))
    first = FirstPass(
        whole,
        given,
        tracker.detection,
        tracker.clutter,
        tracker.window.densities,
        tracker.layout.copy(),
        tracker.not_rigid,
    )
    return first, tuple(newest)


class WristPose:
    """Pose and velocity of the wrist over a recording of blobs.

    Parameters
    ----------
    camera : Camera
    blobs : BlobRecording
    markers : MarkerLayout
    association : WristAssociation, optional
    noise : WristNoise, optional
    settings : WristSettings, optional
    camera_pose : CameraPose, optional
        ``W0`` as the camera sees it; by default the pose of the hand in the first frames (neutral posture).

    Raises
    ------
    InputError
        For blobs outside of the camera's image.

    Notes
    -----
    Variables: ``layout`` (3n, m; unless its use is "noise" or "exact"), and of every frame between the first and the last that show the
    hand ``rotation_k`` (``R_c_w``) and ``motion_k`` (``[p_c_w, w, v]``, with "jerk" also accelerations). Rows: 3 a blob, and the motion
    between frames (mathematics 5.1).
    """

    kind = "wrist_pose"

    def __init__(
        self,
        camera: Camera,
        blobs: BlobRecording,
        markers: MarkerLayout,
        association: WristAssociation | None = None,
        noise: WristNoise | None = None,
        settings: WristSettings | None = None,
        camera_pose: CameraPose | None = None,
    ) -> None:
        self.camera, self.blobs, self.markers = camera, blobs, markers
        self.association = association or WristAssociation()
        self.noise = noise or WristNoise()
        self.settings = settings or WristSettings()
        self.camera_pose = camera_pose
        self.round = 0
        blobs.check_camera(camera)
        self.size = NODE_SIZE[self.noise.motion]
        scale = self.settings.loss_scale
        self.loss = GemanMcClure(scale) if np.isfinite(scale) else None

    # ---- the first pass

    @cached_property
    def forward(self) -> tuple[FirstPass, tuple[Node, ...]]:
        """Tracked frame by frame, once, when it is first needed: what came out, and the newest (filtered) node of every frame.

        Raises
        ------
        NotSolvedError
            When the hand is found in no frame, with the reason.
        """
        self.blobs.check_camera(self.camera)
        first, newest = track_forward(
            self.camera, self.blobs, self.markers, self.association, self.noise, self.settings
        )
        if not any(node.used for node in first.nodes):
            raise NotSolvedError(self._why_nothing())
        return first, newest

    @property
    def first_pass(self) -> FirstPass:
        """The lagged nodes, associations and rates of :attr:`forward`."""
        return self.forward[0]

    def _why_nothing(self) -> str:
        counts = self.blobs.counts
        if not self.blobs.frame.size:
            return "the recording holds no blobs: nothing was detected in any frame; check the detector or the video"
        if counts.max() < 3:
            return f"never more than {int(counts.max())} blobs in a frame: at least three markers have to be seen at once to find the hand"
        deep = np.isfinite(self.blobs.depth)
        if not deep.any():
            return (
                "the hand was not found: without any depth the first frames have to show it flat, its back towards the camera, with at "
                "least four markers; give depth (z) if the camera has it"
            )
        enough = np.bincount(self.blobs.frame[deep], minlength=len(self.blobs)).max() >= 3
        if not enough:
            return (
                "never three blobs with depth in one frame: the hand cannot be found; check the depth images"
            )
        return (
            "no frame shows blobs at the distances of the markers: check the layout (metres? the right hand?), the units of the depth, and "
            "the intrinsics"
        )

    @cached_property
    def estimates_layout(self) -> bool:
        """Whether the layout is an unknown: when that is asked for, it is uncertain, and the markers behave as a rigid palm's."""
        uncertain = bool(np.any(self.markers.covariance > 0.0))
        return self.settings.layout == "estimate" and uncertain and not self.first_pass.not_rigid

    @property
    def layout_is_noise(self) -> bool:
        """Whether the layout's covariance is added to every residual."""
        return self.settings.layout == "noise" or (
            self.settings.layout == "estimate" and self.first_pass.not_rigid
        )

    # ---- the batch as it is posed now

    @cached_property
    def _posed(self) -> _Posed:
        first = self.first_pass
        used = np.array([node.used for node in first.nodes])
        return self._pose(first.marker, used, first.densities, first.detection, first.clutter)

    def _pose(
        self, marker: IntArray, used: BoolArray, densities: FloatArray, detection: float, clutter: float
    ) -> _Posed:
        """Pairs and terms for an association (m,), 0 for clutter."""
        frames = np.flatnonzero(used)
        first, last = int(frames[0]), int(frames[-1])
        rows = np.flatnonzero((marker > 0) & (self.blobs.frame >= first) & (self.blobs.frame <= last))
        C = self.covariances[rows]
        chosen = marker[rows] - 1
        if self.layout_is_noise:
            nodes = self.first_pass.nodes
            R = np.stack([nodes[f].R for f in self.blobs.frame[rows]])
            p = np.stack([nodes[f].x[:3] for f in self.blobs.frame[rows]])
            J = predict(self.camera, R, p, self.markers.points[chosen])[2]
            C = C + J @ self.markers.blocks[chosen] @ np.swapaxes(J, 1, 2)
        uvz = np.concatenate([self.blobs.uv[rows], self.blobs.depth[rows, None]], axis=1)
        pairs = Pairs(
            self.blobs.frame[rows] - first, chosen, np.where(np.isfinite(uvz), uvz, 0.0), roots(C), C
        )
        t = self.blobs.t[first : last + 1]
        batch = Batch(self.camera, t, pairs, self.noise.motion, densities, RATE_SD)
        return _Posed(first, batch, marker, densities, detection, clutter)

    @cached_property
    def covariances(self) -> FloatArray:
        """(m, 3, 3) of all blobs."""
        usual = float(np.nanmedian(self.blobs.depth)) if np.isfinite(self.blobs.depth).any() else 0.8
        return blob_covariances(
            self.camera,
            self.noise,
            self.blobs.depth,
            usual,
            self.blobs.covariance_uv,
            self.blobs.covariance_depth,
        )

    @property
    def frames(self) -> range:
        """Frames of the recording that have a node."""
        posed = self._posed
        return range(posed.first, posed.first + posed.batch.t.size)

    @property
    def pairs(self) -> Pairs:
        """Blobs that were given to markers."""
        return self._posed.batch.pairs

    @property
    def association_now(self) -> IntArray:
        """(m,) of every blob: 0 clutter, 1..n."""
        return self._posed.marker

    @cached_property
    def layout_information(self) -> FloatArray | None:
        """(3n, 3n) of the layout's prior; None when it is not estimated."""
        if not self.estimates_layout:
            return None
        return np.asarray(np.linalg.inv(self.markers.covariance + 1e-12 * np.eye(3 * len(self.markers))))

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """All unknowns, in the order of the tangent space."""
        out = [Variable("layout", 3 * len(self.markers), unit="m")] if self.estimates_layout else []
        for k in self.frames:
            out += [
                Variable(f"rotation_{k}", 3, "rotation", "rad"),
                Variable(f"motion_{k}", self.size - 3),
            ]
        return tuple(out)

    @cached_property
    def _system(self) -> System:
        return System(
            self._posed.batch,
            self.frames,
            len(self.markers),
            self.variables,
            self.loss,
            self.layout_information,
        )

    # ---- the protocol of a nonlinear problem

    def initial_state(self) -> State:
        """The smoothed first pass; gaps are bridged along the shortest way."""
        if self._start is not None:
            return self._start
        nodes = [self.first_pass.nodes[k] for k in self.frames]
        R, x = bridge(self._posed.batch.t, nodes)
        return self.state_of(R, x, self.first_pass.layout)

    _start: State | None = None

    def state_of(self, R: FloatArray, x: FloatArray, layout: FloatArray) -> State:
        """A state from nodes R (n, 3, 3), x (n, D - 3) and a layout (n_markers, 3)."""
        out: dict[str, FloatArray] = {"layout": np.array(layout).ravel()} if self.estimates_layout else {}
        for i, k in enumerate(self.frames):
            out[f"rotation_{k}"], out[f"motion_{k}"] = R[i], x[i]
        return out

    def nodes_of(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Nodes R (n, 3, 3), x (n, D - 3) and the layout (n_markers, 3) of a state."""
        R = np.stack([state[f"rotation_{k}"] for k in self.frames])
        x = np.stack([state[f"motion_{k}"] for k in self.frames])
        layout = state["layout"].reshape(-1, 3) if self.estimates_layout else self.markers.points
        return R, x, layout

    def rows(self, state: State) -> Rows:
        """Whitened residuals and derivatives of all terms."""
        return self._posed.batch.rows(*self.nodes_of(state))

    def linearize(self, state: State) -> LeastSquares:
        """Rows of all markers, of the motion and of the priors."""
        R, x, layout = self.nodes_of(state)
        deviation = (layout - self.markers.points).ravel()
        return self._system.fill(self._posed.batch.rows(R, x, layout), x[0], deviation)

    def retract(self, state: State, step: FloatArray) -> State:
        """Move the state by a tangent step (n,)."""
        return retract(self.variables, state, step)

    def refine(self, state: State) -> WristPose | None:
        """Give blobs to markers again under the smoothed poses, and fit the motion's densities; None when nothing changes."""
        if self.round >= MOST_ROUNDS:
            return None
        posed = self._posed
        found = self.marginals(state)
        densities = self._fit_densities(state, found)
        marker, detection, clutter = self._assign_again(state, found)
        used = np.zeros(len(self.blobs), dtype=bool)
        used[self.blobs.frame[marker > 0]] = True
        used[: self.frames.start] = used[self.frames.stop :] = False
        changed = float(np.max(np.abs(np.log(densities / posed.densities))))
        if np.array_equal(marker, posed.marker) and (changed < SETTLED_DENSITY or self.round >= 2):
            return None
        if np.count_nonzero(marker) < 3:
            return None
        out = copy.copy(self)
        for name in ("_posed", "_system", "variables"):
            out.__dict__.pop(name, None)
        out.round = self.round + 1
        first_frames = np.flatnonzero(used)
        out.__dict__["_posed"] = self._pose(marker, used, densities, detection, clutter)
        out._start = {
            name: value
            for name, value in state.items()
            if name == "layout" or first_frames[0] <= int(name.split("_")[1]) <= first_frames[-1]
        }
        return out

    def marginals(self, state: State) -> Marginals:
        """Covariances of all nodes and the layout at a solution."""
        chain, _, _ = self._posed.batch.chain(self.rows(state), self.loss, self.layout_information)
        return marginals(chain)

    def _fit_densities(self, state: State, found: Marginals) -> FloatArray:
        """Variance components: normalised squares of the smoothed accelerations over what is expected of them."""
        posed, noise = self._posed, self.noise
        if not noise.adapt or posed.batch.t.size < 10:
            return posed.densities
        rows = self.rows(state)
        A, B = rows.J_first, rows.J_second
        cross = A @ found.neighbours @ np.swapaxes(B, 1, 2)
        spread = A @ found.nodes[:-1] @ np.swapaxes(A, 1, 2) + B @ found.nodes[1:] @ np.swapaxes(B, 1, 2)
        left = 1.0 - np.einsum("kii->ki", spread) - 2.0 * np.einsum("kii->ki", cross)
        part = (np.arange(self.size) // 3) % 2
        out = posed.densities.copy()
        given = (noise.rotation_density, noise.translation_density)
        for i in (0, 1):
            freedom = float(np.sum(np.maximum(left[:, part == i].sum(axis=1), 0.0)))
            if given[i] is None and freedom > 1.0:
                out[i] *= float(np.sum(rows.motion[:, part == i] ** 2)) / freedom
        usual = noise.densities
        return np.asarray(np.clip(out, 1e-3 * usual, 100.0 * usual))

    def _assign_again(self, state: State, found: Marginals) -> tuple[IntArray, float, float]:
        """Association of every frame under its smoothed pose, with the rates that the recording shows."""
        posed = self._posed
        R, x, layout = self.nodes_of(state)
        rates = Rates(posed.detection, posed.clutter, self.camera.pixels)
        marker = posed.marker.copy()
        visible = hits = clutter = 0
        blocks = self.markers.blocks if self.layout_is_noise else np.zeros((len(layout), 3, 3))
        for i, k in enumerate(self.frames):
            rows = self.blobs.rows(k)
            if rows.start == rows.stop:
                continue
            predicted = self._predicted(R[i], x[i], layout, found.nodes[i][:6, :6], blocks)
            if predicted.pixel_sd > self.association.uncertain_px:
                clutter += rows.stop - rows.start
                marker[rows] = 0
                continue
            uvz = np.concatenate([self.blobs.uv[rows], self.blobs.depth[rows, None]], axis=1)
            chosen = assign(
                "joint" if self.association.method == "joint" else self.association.method,
                predicted,
                uvz,
                self.covariances[rows],
                rates,
                self.association.gate,
            )
            marker[rows] = chosen.marker + 1
            visible += int(np.count_nonzero(self.camera.inside(predicted.uvz[:, :2])))
            hits += chosen.count
            clutter += rows.stop - rows.start - chosen.count
        frames = max(len(self.frames), 1)
        detection = float(np.clip((hits + 1.0) / (visible + 2.0), 0.02, 0.999))
        if not self.association.adapt:
            return marker, self.association.detection, self.association.clutter
        return marker, detection, clutter / frames

    def _predicted(
        self, R: FloatArray, x: FloatArray, layout: FloatArray, pose: FloatArray, blocks: FloatArray
    ) -> Prediction:
        count = len(layout)
        uvz, J, J_point = predict(
            self.camera, np.broadcast_to(R, (count, 3, 3)), np.broadcast_to(x[:3], (count, 3)), layout
        )
        own = J_point @ blocks @ np.swapaxes(J_point, 1, 2)
        return Prediction(uvz, J, pose, own)

    def view(self, estimate: Estimate) -> WristPoseEstimate:
        """The track with layout, rates, gaps and warnings."""
        return make_view(self, estimate)

    # ---- as a gtsam graph

    @cached_property
    def _graph(self) -> WristGraph:
        prior = (
            None
            if self.layout_information is None
            else np.asarray(np.linalg.cholesky(self.layout_information).T)
        )
        return WristGraph(self._posed.batch, self.markers.points, prior, self.loss)

    def factor_graph(self, _state: State | None = None) -> Any:
        """``gtsam.NonlinearFactorGraph``: one ``CustomFactor`` a frame for its markers and the motion to it."""
        return self._graph.graph()

    def graph_values(self, state: State) -> Any:
        """A state as ``gtsam.Values``: ``r<i>`` (Rot3), ``x<i>`` (vector) of the i-th node, ``l0`` the layout."""
        return self._graph.values(*self.nodes_of(state))

    def graph_state(self, values: Any) -> State:
        """``gtsam.Values`` as a state."""
        return self.state_of(*self._graph.read(values))

    def increments(self) -> Iterator[tuple[list[Any], Any | Callable[[Any], Any], dict[int, float]]]:
        """The graph frame by frame for a smoother: ``(factors, new values, stamps)``; see `solvers.gtsam_fixed_lag`."""
        return self._graph.increments(*self.nodes_of(self.initial_state()))


@dataclass(frozen=True, eq=False)
class _Posed:
    """The batch for one association."""

    first: int
    batch: Batch
    marker: IntArray
    densities: FloatArray
    detection: float
    clutter: float


def bridge(t: FloatArray, nodes: list[Node]) -> tuple[FloatArray, FloatArray]:
    """Nodes R (n, 3, 3), x (n, D - 3) with lost ones put on the way between their neighbours."""
    R, x = np.stack([n.R for n in nodes]), np.stack([n.x for n in nodes])
    good = np.flatnonzero([not n.lost and bool(np.isfinite(n.x).all()) for n in nodes])
    for k in np.setdiff1d(np.arange(len(nodes)), good):
        before, after = good[good < k], good[good > k]
        if not before.size or not after.size:
            i = int(after[0] if after.size else before[-1])
            R[k], x[k] = R[i], x[i]
            continue
        i, j = int(before[-1]), int(after[0])
        share = (t[k] - t[i]) / (t[j] - t[i])
        turn = lie.so3_log(R[i].T @ R[j])
        R[k] = R[i] @ lie.so3_exp(share * turn)
        x[k] = x[i] + share * (x[j] - x[i])
        x[k, 3:6], x[k, 6:9] = turn / (t[j] - t[i]), (x[j, :3] - x[i, :3]) / (t[j] - t[i])
        x[k, 9:] = 0.0
    return R, x

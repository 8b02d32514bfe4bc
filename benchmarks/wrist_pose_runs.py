"""One run of the wrist benchmark: a simulated recording, the streaming estimator and the paper's filter on identical data."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.baselines.cordella2014 import UkfSettings, WristUkf
from factorgrasp.online.wrist import OnlineWristPose, WristState
from factorgrasp.problems.wrist_settings import LayoutUse, WristAssociation, WristNoise, WristSettings
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.simulation.wrist import WristRecording, cordella2014
from factorgrasp.typing import BoolArray, FloatArray

LOST_ANGLE = np.deg2rad(15.0)
LOST_DISTANCE = 0.05
LOST_SHARE = 0.1
SURE = 5.0
"""Normalised squared error per degree of freedom from which on a pose that was said without reserve counts as confidently wrong."""


@dataclass(frozen=True)
class Setting:
    """One column of the benchmark."""

    name: str
    motion: str = "three_axes"
    duration: float = 8.0
    options: dict[str, Any] = field(default_factory=dict)
    layout_sd: float = 1e-3
    peers: bool = True
    association: str = "joint"
    start_given: bool = False


@dataclass
class Score:
    """Errors of one estimator over one run."""

    angle_rms: float
    angle_median: float
    position_rms: float
    position_median: float
    nees: float
    lost: bool
    wrong: int = 0
    given: int = 0


@dataclass
class Run:
    """What came out of one seed of a setting."""

    setting: str
    seed: int
    scores: dict[str, Score]
    seconds: FloatArray
    extra: dict[str, float]


def errors(recording: WristRecording, R: FloatArray, p: FloatArray) -> FloatArray:
    """``[rotation; translation]`` (n, 6) against the truth in ``W0``."""
    turn = lie.so3_log(np.swapaxes(R, 1, 2) @ recording.truth.rotation)
    return np.concatenate([turn, recording.truth.position - p], axis=1)


def score(e: FloatArray, P: FloatArray, judged: BoolArray) -> Score:
    """Statistics of the judged frames; NaN rows count as lost frames."""
    known = judged & np.isfinite(e).all(axis=1)
    angle, distance = np.linalg.norm(e[:, :3], axis=1), np.linalg.norm(e[:, 3:], axis=1)
    off = ~known | (angle > LOST_ANGLE) | (distance > LOST_DISTANCE)
    lost = bool(np.mean(off[judged]) > LOST_SHARE or np.mean(off[-15:][judged[-15:]]) > 0.5)
    value = np.einsum("ni,ni->n", e[known], np.linalg.solve(P[known], e[known][..., None])[..., 0]) / 6.0
    return Score(
        float(np.degrees(np.sqrt(np.mean(angle[known] ** 2)))),
        float(np.degrees(np.median(angle[known]))),
        float(1e3 * np.sqrt(np.mean(distance[known] ** 2))),
        float(1e3 * np.median(distance[known])),
        float(np.mean(value)),
        lost,
    )


def states(
    recording: WristRecording, by_time: dict[float, WristState]
) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray]:
    """Errors, covariances, lost and ambiguous of all frames of a recording."""
    rows = [by_time.get(float(t)) for t in recording.truth.t]
    R = np.stack([np.full((3, 3), np.nan) if s is None else s.rotation for s in rows])
    p = np.stack([np.full(3, np.nan) if s is None else s.position for s in rows])
    P = np.stack([np.full((6, 6), np.nan) if s is None else s.covariance for s in rows])
    lost = np.array([s is None or s.lost for s in rows])
    ambiguous = np.array([s is not None and s.ambiguous for s in rows])
    return errors(recording, R, p), P, lost, ambiguous


def stream(
    recording: WristRecording, estimator: OnlineWristPose
) -> tuple[dict[float, WristState], dict[float, WristState], FloatArray, FloatArray, FloatArray]:
    """Push all frames in the order of their arrival: newest and final states by time, wall and processor seconds, associations."""
    newest: dict[float, WristState] = {}
    final: dict[float, WristState] = {}
    wall, cpu = [], []
    given = np.zeros(recording.blobs.frame.size, dtype=np.intp)
    for k in np.argsort(recording.arrival, kind="stable"):
        blobs = recording.blobs.at(int(k))
        a, b = time.perf_counter(), time.process_time()
        estimate = estimator.push(blobs.t, blobs.uv, blobs.depth)
        wall.append(time.perf_counter() - a)
        cpu.append(time.process_time() - b)
        given[recording.blobs.rows(int(k))] = estimate.association
        newest.setdefault(blobs.t, estimate.newest)
        final.update({s.t: s for s in estimate.finished})
    final.update({s.t: s for s in estimator.finish()})
    return newest, final, np.array(wall), np.array(cpu), given


def run(setting: Setting, seed: int) -> Run:
    """One seed of one setting."""
    recording = cordella2014(
        seed,
        motion=setting.motion,  # type: ignore[arg-type]
        duration=setting.duration,
        layout_sd=max(setting.layout_sd, 1e-6),
        **setting.options,
    )
    start = None
    if setting.start_given:
        T = recording.truth.T_c_W0
        start = CameraPose(T[:3, :3], T[:3, 3])
    return judge(setting, seed, recording, start)


def judge(
    setting: Setting,
    seed: int,
    recording: WristRecording,
    given: CameraPose | None = None,
    layout: LayoutUse = "estimate",
) -> Run:
    """The streaming estimator and its peers on one recording."""
    association = WristAssociation(method=setting.association)  # type: ignore[arg-type]
    estimator = OnlineWristPose(
        recording.camera,
        recording.layout,
        association,
        WristNoise(),
        WristSettings(layout=layout),
        given,
        late=0.3,
    )
    newest, final, wall, cpu, markers = stream(recording, estimator)
    # A pose is judged where there was something to see; what is said about blackouts is judged apart.
    dark = np.zeros(len(recording.blobs), dtype=bool)
    for first, end in recording.sensing.blackouts:
        dark[first : end + 3] = True
    scores: dict[str, Score] = {}
    label = recording.label
    wrong = int(np.count_nonzero((markers > 0) & (markers != label)))
    for name, by_time in (("newest", newest), ("lag 10", final)):
        e, P, _, _ = states(recording, by_time)
        scores[name] = score(e, P, ~dark)
        scores[name].wrong, scores[name].given = wrong, int(np.count_nonzero(label > 0))
    extra = _about_gaps(recording, final, newest)
    extra.update(_about_confidence(recording, final))
    extra["frames"] = float(len(recording.blobs))
    start = estimator.camera_pose
    if setting.peers and start is not None:
        scores.update(_peers(recording, start, ~dark))
    return Run(setting.name, seed, scores, np.stack([wall, cpu]), extra)


def _peers(recording: WristRecording, start: CameraPose, judged: BoolArray) -> dict[str, Score]:
    """The paper's filter from the same start frame: with depth on the manifold, and with image points only."""
    out = {}
    for name, settings in (
        ("UKF depth", UkfSettings(acceleration_sd=1.0, rate_sd=1.0)),
        ("UKF image", UkfSettings(acceleration_sd=1.0, rate_sd=1.0, depth=False)),
    ):
        try:
            with np.errstate(all="ignore"):
                track = WristUkf(recording.camera, recording.layout, start, settings=settings).run(
                    recording.blobs
                )
                e = errors(recording, track.rotation, track.position)
                out[name] = score(e, track.covariance, judged)
        except np.linalg.LinAlgError:
            out[name] = Score(np.nan, np.nan, np.nan, np.nan, np.nan, True)
            continue
        label = recording.label
        out[name].wrong = int(np.count_nonzero((track.association > 0) & (track.association != label)))
        out[name].given = int(np.count_nonzero(label > 0))
    return out


def _about_gaps(
    recording: WristRecording, final: dict[float, WristState], newest: dict[float, WristState]
) -> dict[str, float]:
    """How soon after a blackout the newest pose is right again, and whether it said so meanwhile."""
    out: dict[str, float] = {}
    blackouts = recording.sensing.blackouts
    if not blackouts:
        return out
    e, _, lost, _ = states(recording, newest)
    good = (np.linalg.norm(e[:, :3], axis=1) < LOST_ANGLE) & (
        np.linalg.norm(e[:, 3:], axis=1) < LOST_DISTANCE
    )
    waits, silent = [], 0
    for _, end in blackouts:
        back = np.flatnonzero(good[end:] & ~lost[end:])
        waits.append(float(back[0]) + 1.0 if back.size else np.inf)
        silent += int(np.count_nonzero(~good[end - 5 : end] & ~lost[end - 5 : end]))
    out["frames until found"] = max(waits)
    out["wrong and not said in the dark"] = float(silent)
    return out


def _about_confidence(recording: WristRecording, final: dict[float, WristState]) -> dict[str, float]:
    """Frames that were wrong without a word."""
    e, P, lost, ambiguous = states(recording, final)
    known = np.isfinite(e).all(axis=1) & ~lost
    value = np.full(e.shape[0], 0.0)
    value[known] = np.einsum("ni,ni->n", e[known], np.linalg.solve(P[known], e[known][..., None])[..., 0]) / 6
    angle = np.linalg.norm(e[:, :3], axis=1)
    sure = known & ~ambiguous
    wrong = sure & (value > SURE) & (angle > np.deg2rad(8.0))
    return {
        "ambiguous": float(np.mean(ambiguous)),
        "confident": float(np.mean(sure)),
        "confident wrong": float(np.count_nonzero(wrong)),
    }

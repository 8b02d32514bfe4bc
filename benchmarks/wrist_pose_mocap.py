"""Real hand motion (optical motion capture) before a simulated camera: beside the paper's filter and a frame-by-frame fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from metrics import Metric
from wrist_pose_runs import Setting, errors, judge, score

from factorgrasp.problems.wrist_assign import Assignment
from factorgrasp.problems.wrist_model import blob_covariances
from factorgrasp.problems.wrist_search import fit
from factorgrasp.problems.wrist_settings import LayoutUse, WristNoise
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.simulation.wrist import WristRecording
from factorgrasp.simulation.wrist_mocap import wrist_mocap
from factorgrasp.tables import Column, Table

DURATION = 20.0
RECORDING = "hand_mocap_dfki/recording_first30s.npz"


def frame_by_frame(recording: WristRecording) -> tuple[float, float]:
    """A fit of every frame by itself to its *true* labels: RMSE in deg and mm over frames with three markers and depth."""
    blobs, layout = recording.blobs, recording.layout
    covariance = blob_covariances(recording.camera, WristNoise(), blobs.depth, 0.8)
    uvz = np.concatenate([blobs.uv, blobs.depth[:, None]], axis=1)
    R = np.full((len(blobs), 3, 3), np.nan)
    p = np.full((len(blobs), 3), np.nan)
    T, T_0 = recording.truth.T_c_W, recording.truth.T_c_W0
    for k in range(len(blobs)):
        rows = np.arange(blobs.rows(k).start, blobs.rows(k).stop)
        mine = rows[recording.label[rows] > 0]
        if np.count_nonzero(np.isfinite(blobs.depth[mine])) < 3:
            continue
        marker = recording.label[mine] - 1
        found = fit(
            recording.camera, layout.points, layout.blocks, T[k, :3, :3], T[k, :3, 3], uvz[mine], covariance[mine],
            Assignment(marker, 0.0), None, 10,
        )  # fmt: skip
        R[k], p[k] = T_0[:3, :3].T @ found[0], T_0[:3, :3].T @ (found[1] - T_0[:3, 3])
    e = errors(recording, R, p)
    known = np.isfinite(e).all(axis=1)
    result = score(e, np.broadcast_to(np.eye(6), (len(blobs), 6, 6)), known)
    return result.angle_rms, result.position_rms


def measure(folder: Path, seeds: int) -> tuple[list[Metric], Table | None, str]:
    """Targets, the table and, where the data are not there, the reason."""
    path = folder / RECORDING
    if not path.is_file():
        return [], None, f"real motion: {RECORDING} is not in the data folder"
    metrics, rows = [], []
    for markers in ("virtual", "real"):
        results = []
        # The real markers sit on skin and fingers: they are known not to be rigid, so their layout is no constant to be learnt.
        layout: LayoutUse = "estimate" if markers == "virtual" else "noise"
        for seed in range(seeds):
            recording = wrist_mocap(path, seed, markers=markers, start=0.1, duration=DURATION)  # type: ignore[arg-type]
            T = recording.truth.T_c_W0
            outcome = judge(
                Setting(f"mocap {markers}"), seed, recording, CameraPose(T[:3, :3], T[:3, 3]), layout
            )
            results.append((outcome.scores, frame_by_frame(recording), outcome))
        names = ("newest", "lag 10", "UKF depth", "UKF image")
        for name in names:
            rows.append(
                {
                    "markers": markers,
                    "estimator": name,
                    "angle": float(np.mean([s[name].angle_rms for s, _, _ in results])),
                    "way": float(np.mean([s[name].position_rms for s, _, _ in results])),
                    "angle_median": float(np.mean([s[name].angle_median for s, _, _ in results])),
                    "way_median": float(np.mean([s[name].position_median for s, _, _ in results])),
                    "nees": float(np.mean([s[name].nees for s, _, _ in results])),
                    "lost": sum(s[name].lost for s, _, _ in results),
                    "wrong": float(
                        np.mean([100.0 * s[name].wrong / max(s[name].given, 1) for s, _, _ in results])
                    ),
                }
            )
        single = np.mean([f for _, f, _ in results], axis=0)
        rows.append(
            {
                "markers": markers,
                "estimator": "frame by frame, true labels",
                "angle": float(single[0]),
                "way": float(single[1]),
            }
        )
        mine, peer = (
            next(r for r in rows if r["markers"] == markers and r["estimator"] == n) for n in names[1:3]
        )
        metrics += [
            Metric(
                f"mocap {markers}/runs lost, lag 10",
                float(mine["lost"]),  # type: ignore[arg-type]
                "",
                "lower" if markers == "virtual" else "none",
                0 if markers == "virtual" else None,
                "" if markers == "virtual" else f"UKF with depth: {peer['lost']}",
            ),
            Metric(
                f"mocap {markers}/median orientation over UKF with depth",
                mine["angle_median"] / peer["angle_median"],  # type: ignore[operator]
                "",
                "lower",
                1.0,
            ),
            Metric(
                f"mocap {markers}/median position over UKF with depth",
                mine["way_median"] / peer["way_median"],  # type: ignore[operator]
                "",
                "lower",
                1.0,
            ),
        ]
    columns = (
        Column("markers"),
        Column("estimator"),
        Column("angle", "orientation RMSE", "deg", ".2f"),
        Column("way", "position RMSE", "mm", ".2f"),
        Column("angle_median", "median", "deg", ".2f"),
        Column("way_median", "median", "mm", ".2f"),
        Column("nees", "NEES per dof", "", ".2f"),
        Column("lost", "runs lost"),
        Column("wrong", "wrong associations", "%", ".2f"),
    )
    return (
        metrics,
        Table(columns, tuple(rows), f"Real motion, {DURATION:.0f} s, {seeds} seeds of the camera"),
        "",
    )

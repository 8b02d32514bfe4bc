"""The stream: as good as it says, through gaps, late frames and searches, in bounded memory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.online import OnlineWristPose
from factorgrasp.online.wrist import OnlineWristEstimate, WristState
from factorgrasp.problems import WristAssociation, WristNoise, WristSettings
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.simulation.wrist import WristRecording, cordella2014


def make(recording: WristRecording, **others: object) -> OnlineWristPose:
    T = recording.truth.T_c_W0
    start = CameraPose(T[:3, :3], T[:3, 3])
    return OnlineWristPose(recording.camera, recording.layout, camera_pose=start, **others)  # type: ignore[arg-type]


def feed(
    stream: OnlineWristPose, recording: WristRecording, order: np.ndarray | None = None
) -> tuple[list[OnlineWristEstimate], dict[float, WristState]]:
    out, final = [], {}
    for k in range(len(recording.blobs)) if order is None else order:
        blobs = recording.blobs.at(int(k))
        out.append(stream.push(blobs.t, blobs.uv, blobs.depth))
        final.update({s.t: s for s in out[-1].finished})
    final.update({s.t: s for s in stream.finish()})
    return out, final


def errors(recording: WristRecording, states: dict[float, WristState]) -> tuple[np.ndarray, np.ndarray]:
    rows = [states[float(t)] for t in recording.truth.t]
    R, p = np.stack([s.rotation for s in rows]), np.stack([s.position for s in rows])
    turn = lie.so3_log(np.swapaxes(R, 1, 2) @ recording.truth.rotation)
    return np.concatenate([turn, recording.truth.position - p], axis=1), np.stack(
        [s.covariance for s in rows]
    )


def test_lag_is_better_than_newest_and_both_are_honest() -> None:
    value = {"newest": 0.0, "final": 0.0}
    rms = {"newest": 0.0, "final": 0.0}
    seeds = 3
    for seed in range(seeds):
        recording = cordella2014(seed, motion="three_axes", duration=4.0, layout_sd=0.58e-3)
        out, final = feed(make(recording), recording)
        assert set(final) == set(map(float, recording.truth.t))
        for name, states in (("newest", {e.newest.t: e.newest for e in out}), ("final", final)):
            e, P = errors(recording, states)
            value[name] += float(np.mean(np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e))) / (6 * seeds)
            rms[name] += float(np.mean(np.sum(e[:, :3] ** 2, axis=1))) / seeds
        for k, estimate in enumerate(out):
            label = recording.label[recording.blobs.rows(k)]
            assert not np.any((estimate.association > 0) & (estimate.association != label))
    assert np.sqrt(rms["final"] / rms["newest"]) < 0.8
    assert np.degrees(np.sqrt(rms["final"])) < 1.4
    assert 0.4 < value["final"] < 1.7
    assert 0.4 < value["newest"] < 1.7


def test_five_dark_frames_are_bridged() -> None:
    for seed in range(2):
        recording = cordella2014(seed, motion="three_axes", duration=3.0, blackouts=((40, 45), (70, 75)))
        stream = make(recording)
        out, final = feed(stream, recording)
        e, _ = errors(recording, final)
        assert not any(s.lost for s in final.values())
        assert np.degrees(np.max(np.linalg.norm(e[:, :3], axis=1))) < 12.0
        dark = [out[44].newest, out[39].newest]
        assert np.all(np.diag(dark[0].covariance) > 2.0 * np.diag(dark[1].covariance))
        assert out[44].gap == pytest.approx(5 / 30, abs=1e-6)
        assert [g.frames for g in stream.gaps if g.frames > 2] == [5, 5]


def test_after_a_second_of_darkness_the_hand_is_found_at_once() -> None:
    recording = cordella2014(1, motion="three_axes", duration=4.0, blackouts=((60, 90),))
    stream = make(recording)
    out, _ = feed(stream, recording)
    assert out[85].newest.lost
    assert "lost" in out[85].message
    sd = [np.sqrt(np.trace(out[k].newest.covariance[:3, :3])) for k in (62, 70, 80, 88)]
    assert np.all(np.diff(sd) > 0.0)
    again = next(k for k in range(90, 100) if not out[k].newest.lost)
    assert again <= 92
    R = out[again].newest.rotation
    assert lie.angle_between(R, recording.truth.rotation[again]) < np.deg2rad(10.0)
    (gap,) = [g for g in stream.gaps if g.frames > 10]
    assert gap.lost
    assert gap.frames == 30
    assert stream.counts.searches >= 2


def test_late_frames_find_their_place() -> None:
    recording = cordella2014(2, motion="abduction", duration=1.5)
    quiet = {"noise": WristNoise(adapt=False), "association": WristAssociation(adapt=False)}
    order = np.arange(len(recording.blobs))
    order[20:23] = [21, 22, 20]
    order[30:32] = [31, 30]
    _, punctual = feed(make(recording, **quiet), recording)
    stream = make(recording, **quiet)
    out, final = feed(stream, recording, order)
    assert stream.counts.late == 2
    assert stream.counts.dropped == 0
    assert set(final) == set(punctual)
    for t, state in final.items():
        assert lie.angle_between(state.rotation, punctual[t].rotation) < np.deg2rad(0.3)
    too_late = recording.blobs.at(5)
    answer = stream.push(too_late.t, too_late.uv, too_late.depth)
    assert "late" in answer.message
    assert stream.counts.dropped == 1
    assert answer.newest.t == out[-1].newest.t


def test_memory_does_not_grow() -> None:
    recording = cordella2014(0, motion="abduction", duration=3.0)
    stream = make(recording, settings=WristSettings(lag=4))
    half = len(recording.blobs) // 2
    sizes = []
    tracemalloc.start()
    for k in range(len(recording.blobs)):
        blobs = recording.blobs.at(k)
        stream.push(blobs.t, blobs.uv, blobs.depth)
        assert stream.held <= 5
        if k in (half, len(recording.blobs) - 1):
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert sizes[1] - sizes[0] < 50_000


def test_before_the_hand_is_seen_nothing_is_made_up() -> None:
    recording = cordella2014(0, duration=0.5)
    stream = OnlineWristPose(recording.camera, recording.layout)
    for t in (0.0, 0.03):
        answer = stream.push(t, np.empty((0, 2)))
        assert answer.newest.lost
        assert np.isnan(answer.newest.position).all()
        assert np.isinf(np.diag(answer.newest.covariance)).all()
        assert "not found" in answer.message
    assert stream.camera_pose is None
    blobs = recording.blobs.at(3)
    assert not stream.push(0.1, blobs.uv, blobs.depth).newest.lost
    assert stream.camera_pose is not None


def test_the_start_frame_is_where_the_hand_was_at_rest() -> None:
    recording = cordella2014(5, motion="abduction", duration=1.0)
    stream = OnlineWristPose(recording.camera, recording.layout)
    feed(stream, recording)
    start, T = stream.camera_pose, recording.truth.T_c_W0
    assert start is not None
    assert start.frames >= 5
    away = np.concatenate([lie.so3_log(start.rotation.T @ T[:3, :3]), T[:3, 3] - start.position])
    assert away @ np.linalg.solve(start.covariance, away) < 22.5  # 99.9 % of chi-square with 6


def test_what_the_layout_is_like_is_learnt() -> None:
    recording = cordella2014(0, motion="three_axes", duration=2.5, layout_sd=2e-3)
    stream = make(recording)
    feed(stream, recording)
    assert np.trace(stream.layout.covariance) < np.trace(recording.layout.covariance)


@pytest.mark.parametrize(
    ("t", "uv", "depth", "word"),
    [
        (np.nan, [[1.0, 2.0]], None, "time"),
        (0.0, [[1.0, np.nan]], None, "finite"),
        (0.0, [[100.0, 600.0]], None, "swapped"),
        (0.0, [[700.0, 600.0]], None, "resolution"),
        (0.0, [[1.0, 2.0]], [700.0], "millimetres"),
        (0.0, [[1.0, 2.0]], [-0.7], "negative"),
        (0.0, [[1.0, 2.0]], [0.7, 0.7], "shape"),
    ],
)
def test_bad_frames_are_named(t: float, uv: list[list[float]], depth: list[float] | None, word: str) -> None:
    recording = cordella2014(0, duration=0.2)
    with pytest.raises(InputError, match=word):
        OnlineWristPose(recording.camera, recording.layout).push(t, uv, depth)

"""The whole recording: truth, honest covariances, one answer from all solvers, and words for what is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgrasp import compare, solve
from factorgrasp.errors import InputError, NotSolvedError
from factorgrasp.models.camera import Camera
from factorgrasp.problems import WristNoise, WristPose, WristPoseEstimate, WristSettings
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.recordings import BlobRecording
from factorgrasp.simulation.wrist import WristRecording, cordella2014
from factorgrasp.uncertainty import nees_band


def posed(recording: WristRecording, **others: object) -> WristPose:
    return WristPose(recording.camera, recording.blobs, recording.layout, **others)  # type: ignore[arg-type]


def true_start(recording: WristRecording) -> CameraPose:
    T = recording.truth.T_c_W0
    return CameraPose(T[:3, :3], T[:3, 3])


def errors(estimate: WristPoseEstimate, recording: WristRecording) -> np.ndarray:
    return estimate.track.errors_to(recording.truth.rotation, recording.truth.position)


@pytest.fixture(scope="module")
def nominal() -> tuple[WristRecording, WristPoseEstimate]:
    recording = cordella2014(1, motion="three_axes", duration=4.0)
    return recording, solve(posed(recording))


def test_the_track_is_near_the_truth(nominal: tuple[WristRecording, WristPoseEstimate]) -> None:
    recording, found = nominal
    e = errors(found, recording)
    assert found.solved
    assert np.degrees(np.sqrt(np.mean(np.sum(e[:, :3] ** 2, axis=1)))) < 2.0
    assert np.sqrt(np.mean(np.sum(e[:, 3:] ** 2, axis=1))) < 2.5e-3
    label = recording.label
    assert np.count_nonzero((found.track.association > 0) & (found.track.association != label)) == 0
    assert np.count_nonzero((found.track.association == 0) & (label > 0)) <= 2
    v = np.sqrt(np.mean(np.sum((found.track.velocity - recording.truth.velocity) ** 2, axis=1)))
    w = np.sqrt(
        np.mean(np.sum((found.track.angular_velocity - recording.truth.angular_velocity) ** 2, axis=1))
    )
    assert v < 0.02
    assert w < 0.5
    assert not found.track.lost.any()
    assert not found.track.ambiguous.any()
    assert found.warnings == ()
    assert 0.85 < found.detection < 1.0
    assert 1.5 < found.clutter < 2.6
    assert found.pixel_sd == pytest.approx(1.0, rel=0.2)
    assert found.depth_sd == pytest.approx(1.37e-3, rel=0.25)
    assert "deg" in found.summary()


def test_gtsam_and_ours_give_one_answer() -> None:
    recording = cordella2014(1, motion="three_axes", duration=0.7)
    table = compare([posed(recording)], solvers=["gtsam", "cholesky"])
    assert [row.correct for row in table.rows] == [True, True]
    assert all(row.mean_difference is not None and row.mean_difference < 1e-6 for row in table.rows)
    one, two = (solve(posed(recording), solver=name) for name in ("cholesky", "gtsam"))
    sd = np.sqrt(np.einsum("nii->ni", one.track.covariance))
    assert np.max(np.abs(one.track.errors_to(two.track.rotation, two.track.position)) / sd) < 1e-6
    assert one.estimate.objective == pytest.approx(two.estimate.objective, rel=1e-9)


@pytest.mark.parametrize("layout_sd", [0.58e-3, 2e-3])
def test_covariances_are_honest(layout_sd: float) -> None:
    runs, total, count = 6, 0.0, 0
    for seed in range(runs):
        recording = cordella2014(seed, motion="flexion", duration=1.2, layout_sd=layout_sd)
        found = solve(posed(recording, camera_pose=true_start(recording)))
        e, P = errors(found, recording), found.track.covariance
        total += float(np.mean(np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e)))
        count += 6
    low, high = nees_band(6, runs, 0.99)
    assert low < total / count < high


def test_an_estimated_layout_is_nearer_to_the_truth() -> None:
    recording = cordella2014(0, motion="three_axes", duration=3.0, layout_sd=2e-3)
    found = solve(posed(recording))

    def shape_error(points: np.ndarray) -> float:
        true = recording.truth.points
        one, two = (np.linalg.norm(q[:, None] - q[None], axis=-1) for q in (points, true))
        return float(np.sqrt(np.mean((one - two) ** 2)))

    assert shape_error(found.markers.points) < 0.4 * shape_error(recording.layout.points)


def test_layout_noise_and_jerk_are_ways_to_solve_it_too() -> None:
    recording = cordella2014(3, motion="abduction", duration=1.0)
    for others in ({"settings": WristSettings(layout="noise")}, {"noise": WristNoise(motion="jerk")}):
        found = solve(posed(recording, **others))
        assert found.solved
        e = errors(found, recording)
        assert np.degrees(np.sqrt(np.mean(np.sum(e[:, :3] ** 2, axis=1)))) < 2.5


def test_a_gap_is_reported_and_its_covariance_grows() -> None:
    recording = cordella2014(2, motion="three_axes", duration=4.0, blackouts=((50, 80),))
    found = solve(posed(recording))
    (gap,) = [g for g in found.track.gaps if g.frames > 20]
    assert gap.frames == 30
    assert gap.lost
    assert gap.start == pytest.approx(50 / 30)
    assert gap.found == pytest.approx(80 / 30)
    assert found.track.lost[50:80].all()
    assert not found.track.lost[:50].any()
    sd = np.sqrt(np.einsum("nii->ni", found.track.covariance))
    assert np.all(sd[65, :3] > 3.0 * sd[40, :3])
    assert any("lost" in words for words in found.warnings)
    after = errors(found, recording)[85:]
    assert np.degrees(np.max(np.linalg.norm(after[:, :3], axis=1))) < 8.0


def test_wrong_intrinsics_are_suspected_and_right_ones_are_not() -> None:
    for error in (0.0, 0.06):
        recording = cordella2014(4, motion="three_axes", duration=1.5, focal_error=error, layout_sd=0.5e-3)
        found = solve(posed(recording))
        assert any("intrinsics" in words for words in found.warnings) == (error != 0.0)
    assert found.focal_error == pytest.approx(-0.06, abs=0.02)


def test_without_depth_the_ambiguity_is_said() -> None:
    recording = cordella2014(0, motion="flexion", duration=2.0, depth=False)
    found = solve(posed(recording))
    assert found.track.ambiguous.mean() > 0.5
    assert any("ambiguous" in words for words in found.warnings)
    e, P = errors(found, recording), found.track.covariance
    known = np.isfinite(e).all(axis=1) & ~found.track.ambiguous & ~found.track.lost
    value = np.einsum("ni,nij,nj->n", e[known], np.linalg.inv(P[known]), e[known]) / 6.0
    assert not np.any((value > 8.0) & (np.linalg.norm(e[known, :3], axis=1) > np.deg2rad(10.0)))


# ---- bad input


def only(blobs: BlobRecording, keep: np.ndarray) -> BlobRecording:
    return replace(blobs, frame=blobs.frame[keep], uv=blobs.uv[keep], depth=blobs.depth[keep], label=None)


def test_nothing_to_see_is_said() -> None:
    recording = cordella2014(0, duration=0.5)
    blobs = recording.blobs
    label = recording.label
    nothing = only(blobs, np.zeros(label.size, dtype=bool))
    with pytest.raises(NotSolvedError, match="no blobs"):
        solve(WristPose(recording.camera, nothing, recording.layout))
    two = only(blobs, (label == 1) | (label == 4))
    with pytest.raises(NotSolvedError, match="at least three"):
        solve(WristPose(recording.camera, two, recording.layout))
    shallow = replace(
        only(blobs, (label > 0) & (label < 4)), depth=np.full(int(((label > 0) & (label < 4)).sum()), np.nan)
    )
    with pytest.raises(NotSolvedError, match="without any depth"):
        solve(WristPose(recording.camera, shallow, recording.layout))
    other = replace(recording.layout, points=2.5 * recording.layout.points)
    with pytest.raises(NotSolvedError, match="distances"):
        solve(WristPose(recording.camera, blobs, other))


def test_another_cameras_blobs_are_named() -> None:
    recording = cordella2014(0, duration=0.5)
    swapped = replace(recording.blobs, uv=recording.blobs.uv[:, ::-1])
    with pytest.raises(InputError, match="swapped"):
        WristPose(recording.camera, swapped, recording.layout)
    small = Camera(262.0, 262.0, 159.5, 119.5, 320, 240)
    with pytest.raises(InputError, match="resolution"):
        WristPose(small, recording.blobs, recording.layout)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"pixel_sd": 0.0}, "pixel_sd"),
        ({"depth_sd": 1.5}, "millimetres"),
        ({"calibration_sd": -1.0}, "calibration"),
        ({"motion": "snap"}, "motion"),
    ],
)
def test_impossible_noise_is_named(change: dict[str, object], word: str) -> None:
    with pytest.raises(InputError, match=word):
        WristNoise(**change)  # type: ignore[arg-type]

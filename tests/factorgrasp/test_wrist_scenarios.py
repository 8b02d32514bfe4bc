"""The wrist scenarios: the motion is consistent, the blobs are those of the truth, and every option does what it says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.lie import angle_between, so3_log
from factorgrasp.recordings.blobs import read_blobs
from factorgrasp.simulation.scenarios import make_scenario
from factorgrasp.simulation.wrist import WristRecording, cordella2014
from factorgrasp.simulation.wrist_files import write_wrist_recording
from factorgrasp.simulation.wrist_mocap import wrist_mocap
from factorgrasp.simulation.wrist_motion import AMPLITUDES, MOTIONS, wrist_motion
from factorgrasp.typing import FloatArray


@pytest.mark.parametrize("motion", MOTIONS)
def test_velocities_are_the_derivatives_of_the_poses(motion: str) -> None:
    t = np.arange(0.0, 6.0, 1e-3)
    found = wrist_motion(motion, t, seed=4)
    v = np.gradient(found.position, t, axis=0)
    w = so3_log(np.swapaxes(found.rotation[:-1], 1, 2) @ found.rotation[1:]) / 1e-3
    np.testing.assert_allclose(found.velocity[2:-2], v[2:-2], atol=2e-6)
    np.testing.assert_allclose(0.5 * (found.angular_velocity[1:] + found.angular_velocity[:-1]), w, atol=2e-5)
    np.testing.assert_allclose(found.pose[0], np.eye(4), atol=1e-15)


def test_abduction_has_the_papers_range_about_its_axis_only() -> None:
    found = wrist_motion("abduction", np.arange(0.0, 12.0, 1e-2))
    spread = np.rad2deg(np.ptp(found.angles, axis=0))
    assert abs(spread[1] - 2.0 * AMPLITUDES["abduction"][1]) < 0.1
    assert np.all(spread[[0, 2]] < 6.0)


def _errors(recording: WristRecording) -> tuple[FloatArray, FloatArray]:
    """Pixel and depth errors of the blobs of markers."""
    truth, blobs = recording.truth, recording.blobs
    rows = recording.label > 0
    T = truth.T_c_W[blobs.frame[rows]]
    P = np.einsum("nij,nj->ni", T[:, :3, :3], truth.points[recording.label[rows] - 1]) + T[:, :3, 3]
    return blobs.uv[rows] - truth.camera.project(P), blobs.depth[rows] - P[:, 2]


def test_nominal_blobs_have_the_stated_statistics() -> None:
    recording = cordella2014(3, duration=40.0)
    uv, z = _errors(recording)
    assert np.allclose(uv.std(axis=0), 1.0, atol=0.05)
    assert 1.25e-3 < np.nanstd(z) < 1.5e-3
    assert 0.03 < np.isnan(z).mean() < 0.07
    frames = len(recording.blobs)
    assert frames == 1201
    assert abs((recording.label == 0).sum() / frames - 2.0) < 0.2
    assert abs(recording.truth.hidden.mean() - 0.05) < 0.03
    seen = (recording.label > 0).sum() / (~recording.truth.hidden).sum()
    assert abs(seen - 0.98) < 0.01


def test_options() -> None:
    quiet = {"clutter": 0.0, "occlusion": 0.0, "p_miss": 0.0}
    dark = cordella2014(0, blackouts=((100, 130),), **quiet)
    assert np.all(dark.blobs.counts[100:130] == 0)
    assert np.all(dark.blobs.counts[:100] == 6)
    half = cordella2014(0, half_hidden=True, **quiet)
    assert np.all(half.blobs.counts[15:] == 3)
    assert np.isnan(cordella2014(0, depth=False).blobs.depth).all()
    lost = cordella2014(0, drop_frames=0.1, late_frames=0.2)
    assert 0.85 * 361 < len(lost.blobs) < 0.95 * 361
    assert np.diff(lost.arrival).min() < 0.0
    assert np.all(lost.arrival >= lost.truth.t)
    wrong = cordella2014(0, focal_error=0.1)
    assert wrong.camera.fx == pytest.approx(1.1 * wrong.truth.camera.fx)
    left, right = cordella2014(0, hand="left"), cordella2014(0)
    np.testing.assert_allclose(left.truth.points * [1.0, -1.0, 1.0], right.truth.points)
    near = cordella2014(0, clutter=0.0, clutter_near=5.0)
    assert np.nanmax(np.abs(near.blobs.depth[near.label == 0] - 0.7)) < 0.12
    with pytest.raises(InputError, match="pixel_sd"):
        cordella2014(0, pixels_sd=2.0)
    with pytest.raises(InputError, match="motion"):
        cordella2014(0, motion="waving")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="p_miss"):
        cordella2014(0, p_miss=1.5)


def test_the_same_seed_gives_the_same_numbers() -> None:
    one, two, other = (make_scenario("cordella2014", seed=seed, motion="reach") for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.blobs.uv, two.blobs.uv)
    assert one.blobs.uv.shape != other.blobs.uv.shape or not np.allclose(one.blobs.uv, other.blobs.uv)


def test_written_files_hold_the_recording(tmp_path: Path) -> None:
    recording = cordella2014(1, motion="reach", duration=2.0, blackouts=((20, 25),))
    file = write_wrist_recording(recording, tmp_path)
    assert file.name == "wrist.toml"
    blobs = read_blobs(tmp_path / "blobs.csv", recording.camera)
    np.testing.assert_allclose(blobs.uv, recording.blobs.uv)
    np.testing.assert_allclose(blobs.t, recording.blobs.t)
    np.testing.assert_array_equal(blobs.frame, recording.blobs.frame)
    assert blobs.label is None
    with np.load(tmp_path / "truth.npz") as truth:
        np.testing.assert_allclose(truth["position"], recording.truth.position)


@pytest.mark.parametrize("markers", ["virtual", "real"])
def test_measured_hand(markers: str, dataset: Callable[[str], Path]) -> None:
    path = dataset("hand_mocap_dfki/recording_first30s.npz")
    recording = wrist_mocap(path, 0, markers=markers, start=0.1, duration=10.0)  # type: ignore[arg-type]
    uv, z = _errors(recording)
    truth = recording.truth
    step = np.diff(truth.t)
    moved = 0.5 * (truth.velocity[1:] + truth.velocity[:-1]) * step[:, None]
    np.testing.assert_allclose(np.diff(truth.position, axis=0), moved, atol=4e-4)
    turned = np.linalg.norm(0.5 * (truth.angular_velocity[1:] + truth.angular_velocity[:-1]), axis=1) * step
    # The rate is that of 70 ms of motion.
    error = angle_between(truth.rotation[:-1], truth.rotation[1:]) - turned
    assert np.sqrt(np.mean(error**2)) < 4e-3
    assert np.corrcoef(error + turned, turned)[0, 1] > 0.9
    if markers == "virtual":
        assert np.allclose(uv.std(axis=0), 1.0, atol=0.06)
        assert np.nanstd(z) < 4e-3
    else:
        # The proximal fingers move against the back of the hand, the triad does not.
        rigid = recording.label[recording.label > 0] <= 3
        assert uv[rigid].std() < 1.1 < uv[~rigid].std()

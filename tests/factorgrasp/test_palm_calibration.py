"""The layout of a palm from unlabelled points: labels, frame, covariance, and what cannot be calibrated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.models.marker_files import read_layout, write_layout
from factorgrasp.models.markers import PALM_NAMES, PALM_POINTS, MarkerLayout
from factorgrasp.palm_calibration import calibrate_palm
from factorgrasp.problems.palm_labels import label_points
from factorgrasp.problems.palm_layout import PalmConvention, PalmLayout, PalmView, in_palm_frame, palm_frame
from factorgrasp.recordings.blobs import BlobRecording

CAMERA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
R_DOWN = np.diag([1.0, -1.0, -1.0])


def make_blobs(
    layout: np.ndarray,
    rng: np.random.Generator,
    frames: int = 6,
    sd: float = 0.3,
    sd_z: float = 1e-3,
    clutter: int = 1,
) -> tuple[BlobRecording, np.ndarray]:
    """A hand that moves a little, its blobs in random order with clutter; and the row of each marker (frames, n)."""
    uv, z, frame, rows = [], [], [], []
    R = lie.so3_exp([0.0, 0.0, rng.uniform(-3.0, 3.0)]) @ R_DOWN @ lie.so3_exp(rng.normal(0.0, 0.2, 3))
    for k in range(frames):
        R = R @ lie.so3_exp(rng.normal(0.0, 0.05, 3))
        points = np.array([0.0, 0.0, 0.7]) + rng.normal(0.0, 0.02, 3) + (layout - layout.mean(axis=0)) @ R.T
        points = np.vstack([points, np.array([0.0, 0.0, 0.7]) + rng.uniform(-0.15, 0.15, (clutter, 3))])
        order = rng.permutation(len(points))
        rows.append(len(z) + np.argsort(order)[: len(layout)])
        points = points[order]
        uv += list(CAMERA.project(points) + rng.normal(0.0, sd, (len(points), 2)))
        z += list(points[:, 2] + rng.normal(0.0, sd_z, len(points)))
        frame += [k] * len(points)
    recording = BlobRecording(
        t=np.arange(frames) / 30.0,
        frame=np.array(frame),
        uv=np.array(uv),
        depth=np.array(z),
        covariance_uv=np.tile(sd**2 * np.eye(2), (len(z), 1, 1)),
        covariance_depth=np.full(len(z), sd_z**2),
    )
    return recording, np.array(rows)


def random_hand(rng: np.random.Generator, left: bool = False) -> np.ndarray:
    layout = rng.uniform(0.8, 1.25) * np.array(PALM_POINTS)
    layout[1:] += rng.normal(0.0, 0.003, (5, 3))
    layout[:, 1] *= -1.0 if left else 1.0
    return layout


def test_layouts_are_right_and_their_covariances_honest() -> None:
    nees = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        left = bool(seed % 2)
        layout = random_hand(rng, left)
        blobs, rows = make_blobs(layout, rng)
        found = calibrate_palm(blobs, CAMERA, "left" if left else "right", systematic_sd=0.0)
        np.testing.assert_array_equal(found.blobs, rows[found.frames])
        truth = in_palm_frame(MarkerLayout(PALM_NAMES, layout))
        error = (found.layout.points - truth.points).ravel()
        assert np.abs(error).max() < 4e-3
        values, vectors = np.linalg.eigh(found.layout.covariance)
        assert values[5] < 1e-3 * values[6]  # the convention fixes six of the eighteen directions
        nees.append(float(np.mean((vectors[:, 6:].T @ error) ** 2 / values[6:])))
    # 16 x 12 degrees of freedom: 95 % between 0.81 and 1.21 if all held; a tenth more for covariances scaled up by chance.
    assert 0.75 < np.mean(nees) < 1.35


def test_the_frame_is_that_of_the_convention() -> None:
    rng = np.random.default_rng(3)
    layout = random_hand(rng)
    found = calibrate_palm(make_blobs(layout, rng)[0], CAMERA).layout.points
    np.testing.assert_allclose(found[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(found[3, 1:], 0.0, atol=1e-12)
    assert found[3, 0] > 0.05
    assert found[1, 1] > 0.0  # thumb of a right hand seen from its back
    assert abs(found[2:, 1] @ found[2:, 2]) < 1e-7
    R, p = palm_frame(found, PalmConvention(), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(R, np.eye(3), atol=1e-3)
    np.testing.assert_allclose(p, 0.0, atol=1e-12)


def test_one_frame_suffices_and_more_are_better() -> None:
    rng = np.random.default_rng(4)
    blobs, _ = make_blobs(np.array(PALM_POINTS), rng, frames=12)
    one, many = calibrate_palm(blobs, CAMERA, frames=1), calibrate_palm(blobs, CAMERA, frames=12)
    assert one.frames.size == 1
    assert many.frames.size == 12
    assert np.trace(many.layout.covariance) < 0.3 * np.trace(one.layout.covariance)


def test_gross_outliers_do_not_pull_the_layout() -> None:
    rng = np.random.default_rng(5)
    blobs, rows = make_blobs(np.array(PALM_POINTS), rng, frames=10, clutter=0)
    depth = blobs.depth.copy()
    depth[rows[4, 2]] += 0.012
    bad = BlobRecording(blobs.t, blobs.frame, blobs.uv, depth, blobs.covariance_uv, blobs.covariance_depth)
    found, clean = calibrate_palm(bad, CAMERA), calibrate_palm(blobs, CAMERA)
    assert np.abs(found.layout.points - clean.layout.points).max() < 1e-3


def test_the_other_hand_is_not_taken_for_this_one() -> None:
    rng = np.random.default_rng(6)
    blobs, _ = make_blobs(random_hand(rng, left=True), rng, clutter=0)
    right = label_points(CAMERA.back_project(blobs.at(0).uv, blobs.at(0).depth), np.array(PALM_POINTS))
    left = label_points(
        CAMERA.back_project(blobs.at(0).uv, blobs.at(0).depth), np.array(PALM_POINTS) * [1.0, -1.0, 1.0]
    )
    assert left is not None
    assert right is None or left.rms < 0.7 * right.rms


def test_a_hand_is_found_among_much_clutter() -> None:
    rng = np.random.default_rng(11)
    layout = random_hand(rng)
    blobs, rows = make_blobs(layout, rng, frames=3, clutter=0)
    t, uv, depth, frame, shift = blobs.t, [], [], [], []
    for k in range(3):
        far = CAMERA.project(np.column_stack([rng.uniform(-0.3, 0.3, (12, 2)), rng.uniform(0.9, 1.1, 12)]))
        uv += [far, blobs.at(k).uv]
        depth += [rng.uniform(0.9, 1.1, 12), blobs.at(k).depth]
        frame += [k] * (12 + len(blobs.at(k)))
        shift.append(12 * (k + 1))
    cluttered = BlobRecording(t, np.array(frame), np.concatenate(uv), np.concatenate(depth))
    found = calibrate_palm(cluttered, CAMERA)
    np.testing.assert_array_equal(found.blobs, rows + np.array(shift)[:, None])


def test_what_cannot_be_calibrated_is_said() -> None:
    rng = np.random.default_rng(7)
    blobs, rows = make_blobs(np.array(PALM_POINTS), rng, clutter=0)
    missing = blobs.depth.copy()
    missing[rows[:, 3]] = np.nan
    without = BlobRecording(blobs.t, blobs.frame, blobs.uv, missing)
    with pytest.raises(InputError, match="at most 5 blobs with depth in the first 6 frames"):
        calibrate_palm(without, CAMERA)
    scattered = BlobRecording(
        blobs.t,
        blobs.frame,
        rng.uniform(100.0, 400.0, blobs.uv.shape),
        rng.uniform(0.5, 1.0, blobs.depth.shape),
    )
    with pytest.raises(InputError, match="like the markers of a hand"):
        calibrate_palm(scattered, CAMERA)
    with pytest.raises(InputError, match="right or left"):
        calibrate_palm(blobs, CAMERA, "both")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="frames"):
        calibrate_palm(blobs, CAMERA, frames=0)
    with pytest.raises(InputError, match="at least one frame"):
        PalmLayout(PALM_NAMES, np.array(PALM_POINTS), [])


def test_derivatives_of_the_problem_by_finite_differences() -> None:
    rng = np.random.default_rng(8)
    layout = random_hand(rng)
    views = []
    for _ in range(2):
        R, p = R_DOWN @ lie.so3_exp(rng.normal(0.0, 0.3, 3)), np.array([0.0, 0.1, 0.7])
        points = p + layout @ R.T + rng.normal(0.0, 0.002, layout.shape)
        views.append(PalmView(points, np.tile(1e-6 * np.eye(3), (6, 1, 1)), R, p))
    problem = PalmLayout(PALM_NAMES, layout, views)
    state = problem.initial_state()
    system = problem.linearize(state)
    matrix, rhs = (np.array(part) for part in (system.whitened()[0].toarray(), system.whitened()[1]))
    size, step = system.size, 1e-6
    numeric = np.empty_like(matrix)
    for i in range(size):
        moved = []
        for sign in (1.0, -1.0):
            fresh = PalmLayout(PALM_NAMES, layout, views)
            moved.append(
                -fresh.linearize(problem.retract(state, sign * step * np.eye(size)[i])).whitened()[1]
            )
        numeric[:, i] = (moved[0] - moved[1]) / (2.0 * step)
    scale = np.abs(matrix).max(axis=1, keepdims=True)
    np.testing.assert_allclose(matrix / scale, numeric / scale, atol=1e-5)
    assert np.isfinite(rhs).all()


def test_layouts_are_stored_and_used_again(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    found = calibrate_palm(make_blobs(random_hand(rng), rng)[0], CAMERA)
    stored = read_layout(found.save(tmp_path / "hand.json"))
    assert stored.names == found.layout.names
    np.testing.assert_array_equal(stored.points, found.layout.points)
    np.testing.assert_array_equal(stored.covariance, found.layout.covariance)
    write_layout(tmp_path / "millimetres.json", MarkerLayout(("a", "b", "c"), np.eye(3)))
    text = (tmp_path / "millimetres.json").read_text(encoding="utf-8").replace("1.0", "1000.0")
    (tmp_path / "millimetres.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="millimetres"):
        read_layout(tmp_path / "millimetres.json")
    with pytest.raises(InputError, match="no such file"):
        read_layout(tmp_path / "none.json")
    (tmp_path / "broken.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match="names, points and covariance"):
        read_layout(tmp_path / "broken.json")

"""Who is who: cases with a known answer for the three ways to associate, the labelling search, and the second pose of a flat palm."""

from __future__ import annotations

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.wrist_assign import Prediction, Rates, assign
from factorgrasp.problems.wrist_flat import DECIDED, flat_search, mirrored, second_pose
from factorgrasp.problems.wrist_model import blob_covariances
from factorgrasp.problems.wrist_search import prediction, search
from factorgrasp.problems.wrist_settings import WristNoise

CAMERA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
PALM = MarkerLayout.palm(1e-3)
RATES = Rates(0.9, 2.0, CAMERA.pixels)
GATE = 0.9995
LOOKING = np.diag([1.0, -1.0, -1.0])


def scene(
    rng: np.random.Generator, clutter: int = 0, depth: bool = True, tilt: float = 0.3, noise: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A pose, its shuffled blobs (u, v, z) with covariances, and who they are (-1 clutter)."""
    R = lie.so3_exp([0.0, 0.0, rng.uniform(-0.5, 0.5)]) @ LOOKING @ lie.so3_exp(rng.normal(0.0, tilt, 3))
    p = np.array([rng.uniform(-0.1, 0.0), rng.uniform(-0.05, 0.05), rng.uniform(0.6, 0.8)])
    seen = PALM.points @ R.T + p
    uvz = np.concatenate([CAMERA.project(seen), seen[:, 2:]], axis=1)
    uvz += noise * rng.standard_normal((6, 3)) * [1.0, 1.0, 1.4e-3]
    stray = rng.uniform([0.0, 0.0, 0.5], [639.0, 479.0, 1.2], (clutter, 3))
    everything = np.concatenate([uvz, stray])
    label = np.concatenate([np.arange(6), np.full(clutter, -1)])
    order = rng.permutation(6 + clutter)
    everything, label = everything[order], label[order]
    if not depth:
        everything[:, 2] = np.nan
    return R, p, everything, blob_covariances(CAMERA, WristNoise(), everything[:, 2], 0.7), label


def two_markers(pose_sd: float) -> Prediction:
    """Two markers side by side that a common error may shift along u."""
    J = np.zeros((2, 3, 6))
    J[:, 0, 0] = 1.0
    pose = np.diag([pose_sd**2, *[1e-12] * 5])
    return Prediction(np.array([[100.0, 100.0, 0.7], [120.0, 100.0, 0.7]]), J, pose, np.zeros((2, 3, 3)))


@pytest.mark.parametrize(
    ("method", "expected"), [("blob", [1, -1]), ("assignment", [0, 1]), ("joint", [0, 1])]
)
def test_a_common_shift_is_seen_by_joint_ways_only(method: str, expected: list[int]) -> None:
    # Everything is 16 px to the right: the first marker's blob lies nearer to where the second was expected.
    uvz = np.array([[116.0, 100.0, 0.7], [136.0, 100.0, 0.7]])
    C = np.diag([1.0, 1.0, 1.4e-3**2])[None].repeat(2, axis=0)
    found = assign(method, two_markers(10.0), uvz, C, RATES, GATE)  # type: ignore[arg-type]
    assert found.marker.tolist() == expected


def test_joint_compatibility_knows_that_neighbours_move_together() -> None:
    # A lone blob between the two, beside the second marker's own: one by one it would be taken for the first.
    uvz = np.array([[112.0, 100.0, 0.7], [120.5, 100.0, 0.7]])
    C = np.diag([1.0, 1.0, 1.4e-3**2])[None].repeat(2, axis=0)
    one_by_one = assign("assignment", two_markers(10.0), uvz, C, RATES, GATE)
    together = assign("joint", two_markers(10.0), uvz, C, RATES, GATE)
    assert one_by_one.marker.tolist() == [0, 1]
    assert np.count_nonzero(together.marker >= 0) == 1


@pytest.mark.parametrize("method", ["joint", "assignment", "blob"])
@pytest.mark.parametrize("depth", [True, False])
def test_a_good_prediction_finds_all_and_no_clutter(
    method: str, depth: bool, rng: np.random.Generator
) -> None:
    wrong = missed = 0
    for _ in range(30):
        R, p, uvz, C, label = scene(rng, clutter=6, depth=depth)
        predicted = prediction(CAMERA, PALM.points, PALM.blocks, R, p, np.diag([1e-4] * 3 + [1e-6] * 3))
        found = assign(method, predicted, uvz, C, RATES, GATE)  # type: ignore[arg-type]
        wrong += int(np.count_nonzero((found.marker >= 0) & (found.marker != label)))
        missed += int(np.count_nonzero((label >= 0) & (found.marker != label)))
    assert wrong <= 1
    assert missed <= 3


def test_no_blobs_and_far_blobs_are_nobody() -> None:
    predicted = two_markers(1.0)
    none = assign("joint", predicted, np.empty((0, 3)), np.empty((0, 3, 3)), RATES, GATE)
    assert none.marker.size == 0
    C = np.diag([1.0, 1.0, 1e-6])[None]
    far = assign("joint", predicted, np.array([[400.0, 300.0, 0.7]]), C, RATES, GATE)
    assert far.marker.tolist() == [-1]
    wrong_depth = assign("joint", predicted, np.array([[100.0, 100.0, 0.9]]), C, RATES, GATE)
    assert wrong_depth.marker.tolist() == [-1]


def test_more_clutter_asks_for_more_evidence() -> None:
    few, many = Rates(0.9, 0.1, CAMERA.pixels), Rates(0.9, 50.0, CAMERA.pixels)
    assert many.reward(np.array([1.0])) < few.reward(np.array([1.0]))
    assert Rates(0.5, 2.0, CAMERA.pixels).reward(np.array([1.0])) < RATES.reward(np.array([1.0]))


@pytest.mark.parametrize("clutter", [0, 6])
def test_the_search_labels_a_hand_that_nothing_was_known_of(clutter: int, rng: np.random.Generator) -> None:
    found_all = 0
    for _ in range(12):
        R, p, uvz, C, label = scene(rng, clutter=clutter, tilt=0.6)
        found = search(CAMERA, PALM.points, PALM.blocks, uvz, C, RATES, 3, GATE)
        assert found is not None
        assert not np.any((found.assignment.marker >= 0) & (found.assignment.marker != label))
        assert lie.angle_between(found.R, R) < np.deg2rad(8.0)
        away = np.concatenate([lie.so3_log(found.R.T @ R), p - found.p])
        assert away @ np.linalg.solve(found.covariance, away) < 40.0
        found_all += found.assignment.count == 6
    assert found_all >= 10


def test_clutter_alone_is_no_hand(rng: np.random.Generator) -> None:
    for _ in range(20):
        uvz = rng.uniform([200.0, 150.0, 0.65], [440.0, 330.0, 0.75], (6, 3))
        C = blob_covariances(CAMERA, WristNoise(), uvz[:, 2], 0.7)
        found = search(CAMERA, PALM.points, PALM.blocks, uvz, C, RATES, 3, GATE)
        assert found is None or found.assignment.count < 4


def test_two_blobs_are_too_few(rng: np.random.Generator) -> None:
    _, _, uvz, C, _ = scene(rng)
    assert search(CAMERA, PALM.points, PALM.blocks, uvz[:2], C[:2], RATES, 3, GATE) is None


def test_the_mirrored_pose_has_the_same_image_from_afar() -> None:
    far, flat = np.array([0.3, -0.2, 40.0]), PALM.points * [1.0, 1.0, 0.0]
    R = LOOKING @ lie.so3_exp([0.4, 0.3, 0.2])
    other, p = mirrored(flat, R, far)
    assert lie.angle_between(R, other) > np.deg2rad(30.0)
    one, two = (CAMERA.project(flat @ Q.T + q) for Q, q in ((R, far), (other, p)))
    assert np.max(np.abs(one - two)) < 0.02


def test_pixels_alone_leave_two_poses_and_depth_one(rng: np.random.Generator) -> None:
    undecided = 0
    for _ in range(10):
        R, p, uvz, C, label = scene(rng, depth=False)
        # Without the thumb the palm is as good as flat.
        flat = label != 1
        other = second_pose(CAMERA, PALM.points, PALM.blocks, R, p, uvz[flat], C[flat], label[flat])
        undecided += other is not None and other[1] < DECIDED
        R, p, uvz, C, label = scene(rng, depth=True)
        assert second_pose(CAMERA, PALM.points, PALM.blocks, R, p, uvz, C, label) is None
    assert undecided >= 3


def test_a_flat_hand_is_found_without_depth(rng: np.random.Generator) -> None:
    right = 0
    for _ in range(8):
        _, _, uvz, C, label = scene(rng, clutter=2, depth=False, tilt=0.05)
        found = flat_search(CAMERA, PALM.points, PALM.blocks, uvz, C, RATES, GATE)
        right += found is not None and not np.any(
            (found.assignment.marker >= 0) & (found.assignment.marker != label)
        )
    assert right >= 7

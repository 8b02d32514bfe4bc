"""The grasp problem on real recordings (see their NOTE.md); skipped where they are absent."""

from __future__ import annotations

import numpy as np
import pytest

from factorgrasp import lie, solve
from factorgrasp.problems import GraspPose
from factorgrasp.recordings import ImuStream, PoseStream
from factorgrasp.status import Status

TRIALS = (
    "06_undisturbed_fast_rotation_A",
    "07_undisturbed_fast_rotation_B",
    "16_undisturbed_fast_translation_B",
    "21_undisturbed_fast_combined",
)
OFFSET, TURN = np.array([0.25, -0.2, 0.24]), np.array([0.9, -0.9, 0.8])  # 0.4 m and 1.5 rad


@pytest.mark.parametrize("trial", TRIALS)
def test_optical_body_and_imu_are_aligned_and_the_clocks_four_milliseconds_apart(broad_trial, trial):
    robot, hand = broad_trial(trial)
    found = solve(GraspPose(robot, hand))
    assert found.status is Status.SOLVED
    assert np.rad2deg(lie.angle_between(found.rotation, np.eye(3))) < 0.4
    assert found.time_offset == pytest.approx(4.2e-3, abs=0.4e-3)
    # The lever arm of this mounting is not published, but it is a centimetre at most.
    assert np.linalg.norm(found.translation) < 0.02


@pytest.mark.parametrize("trial", TRIALS)
def test_a_moved_body_moves_the_estimate_by_exactly_that(broad_trial, trial):
    robot, hand = broad_trial(trial)
    moved, _ = broad_trial(trial, offset=OFFSET, turn=TURN)
    a, b = solve(GraspPose(robot, hand)), solve(GraspPose(moved, hand))
    R = lie.so3_exp(TURN)
    assert np.linalg.norm(b.translation - R.T @ (a.translation - OFFSET)) < 1e-3
    assert np.rad2deg(lie.angle_between(b.rotation, R.T @ a.rotation)) < 0.05


@pytest.mark.parametrize("trial", TRIALS)
def test_halves_agree_within_three_claimed_sigmas(broad_trial, trial):
    first, second = (solve(GraspPose(*broad_trial(trial, half=half))) for half in (0, 1))
    difference = first.error_to(second.rotation, second.translation)
    sd = np.sqrt(np.diag(first.covariance) + np.diag(second.covariance))
    assert np.max(np.abs(difference / sd)) < 3.0
    # Honest, and still useful: millimetres and hundredths of a degree.
    assert np.max(sd[3:]) < 2e-3
    assert np.max(sd[:3]) < np.deg2rad(0.1)


def test_drone_poses_recover_a_virtual_body_and_the_published_biases(dataset):
    truth = np.genfromtxt(dataset("euroc_v102/V102_groundtruth_first40s.csv"), delimiter=",")
    imu = np.genfromtxt(dataset("euroc_v102/imu0_data.csv"), delimiter=",", skip_header=1)
    start = truth[0, 0]
    R = lie.quaternion_wxyz_to_matrix(truth[:, 4:8])
    offset, turn = np.array([0.12, -0.08, 0.15]), lie.so3_exp(np.array([0.3, 1.0, -0.5]))
    robot = PoseStream(
        (truth[:, 0] - start) * 1e-9,
        truth[:, 1:4] + R @ offset,
        lie.matrix_to_quaternion_wxyz(R @ turn, continuous=True),
    )
    hand = ImuStream((imu[:, 0] - start) * 1e-9, imu[:, 1:4], imu[:, 4:7])
    found = solve(GraspPose(robot, hand))
    assert found.status is Status.SOLVED
    error = found.error_to(turn.T, -turn.T @ offset)
    sd = np.sqrt(np.diag(found.covariance))
    assert np.max(np.abs(error[3:] / sd[3:])) < 3.0
    assert np.linalg.norm(error[3:]) < 5e-3
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.2
    # Biases of the ground truth's own filter, in the last seconds of the excerpt.
    np.testing.assert_allclose(found.gyro_bias, truth[-1, 11:14], atol=1.5e-3)
    np.testing.assert_allclose(found.accelerometer_bias, truth[-1, 14:17], atol=0.03)


@pytest.mark.parametrize(
    "name",
    ["V_300_Sequencia1", "V_500_Sequencia1", "V_800_Sequencia1", "eV50p_Sequencia1", "V_500_Sequencia4"],
)
@pytest.mark.filterwarnings("ignore:.*shorter than 1")
def test_interpolated_robot_poses_show_rotation_and_lag_but_no_lever_arm(dataset, name):
    table = np.genfromtxt(dataset(f"abb_imu_robot/MPU9150_{name}.csv"), delimiter=",", names=True)
    columns = {c: np.asarray(table[c]) for c in table.dtype.names}

    def stack(names: str) -> np.ndarray:
        return np.column_stack([columns[c] for c in names.split()])

    robot = PoseStream(columns["t"], stack("px py pz"), stack("qw qx qy qz"))
    hand = ImuStream(columns["t"], stack("wx wy wz"), stack("ax ay az"))
    found = solve(GraspPose(robot, hand))
    assert found.time_offset == pytest.approx(0.085, abs=0.012)
    assert np.rad2deg(lie.angle_between(found.rotation, np.eye(3))) < 8.0
    assert np.rad2deg(np.sqrt(np.diag(found.covariance)[:3])).max() < 3.0
    assert found.status is Status.UNOBSERVABLE
    assert {d.variable for d in found.observability.missing} == {"translation"}
    assert np.sqrt(np.diag(found.covariance)[3:]).min() > 0.02

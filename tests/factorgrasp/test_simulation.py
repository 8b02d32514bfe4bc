from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.lie import angle_between, quaternion_wxyz_to_matrix, skew, so3_exp, so3_log
from factorgrasp.recordings.csv import read_imu, read_motion, read_poses
from factorgrasp.recordings.streams import MotionStream, PoseStream
from factorgrasp.simulation import list_scenarios, make_scenario
from factorgrasp.simulation.cehajic2015 import XSENS, cehajic2015
from factorgrasp.simulation.cehajic2015_figures import excitation_gramian
from factorgrasp.simulation.grasp import (
    GraspChange,
    HandImu,
    RobotSensing,
    gravity_error,
    simulate_grasp,
)
from factorgrasp.simulation.grasp_files import write_recording
from factorgrasp.simulation.grasp_truth import GraspTruth, hand_motion
from factorgrasp.simulation.trajectory import RigidMotion, RigidTrajectory, Sinusoids, body_rates

R_GRASP = so3_exp((0.4, -0.3, 2.5))
P_GRASP = np.array((1.11, 0.16, 0.08))


def trajectory(scale: float = 1.0) -> RigidTrajectory:
    rng = np.random.default_rng(7)
    return RigidTrajectory(
        rotation=Sinusoids(
            scale * rng.normal(size=3),
            scale * rng.normal(size=(3, 3)),
            (0.3, 0.7, 1.1),
            rng.normal(size=(3, 3)),
        ),
        center=Sinusoids((1.0, 0.0, 1.0), 0.1 * rng.normal(size=(2, 3)), (0.2, 0.9), rng.normal(size=(2, 3))),
        lever=(0.5, -0.2, 0.1),
        mean_rotation_wxyz=(0.5, 0.5, -0.5, 0.5),
    )


def check_kinematics(at, t: np.ndarray, h: float = 1e-4) -> None:
    """Velocities and accelerations against central differences of pose and rate."""
    before, now, after = at(t - h), at(t), at(t + h)
    w = so3_log(np.swapaxes(before.rotation, 1, 2) @ after.rotation) / (2 * h)
    np.testing.assert_allclose(now.angular_velocity, w, atol=2e-6)
    al = (after.angular_velocity - before.angular_velocity) / (2 * h)
    np.testing.assert_allclose(now.angular_acceleration, al, atol=2e-5)
    a_w = (after.position - 2 * now.position + before.position) / h**2
    np.testing.assert_allclose(
        now.acceleration, np.einsum("nji,nj->ni", now.rotation, a_w), atol=1e-5 * max(1.0, np.abs(a_w).max())
    )


@pytest.mark.parametrize("scale", [1e-9, 0.05, 0.3, 1.0])
def test_trajectory_derivatives_match_finite_differences(scale):
    check_kinematics(trajectory(scale).at, np.linspace(0.0, 7.0, 151))


def test_body_rates_are_continuous_where_series_and_closed_form_meet():
    rng = np.random.default_rng(0)
    direction, dphi, ddphi = rng.normal(size=(3, 40, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    below, above = (body_rates(s * direction, dphi, ddphi) for s in (0.5 - 1e-12, 0.5 + 1e-12))
    np.testing.assert_allclose(below[0], above[0], atol=1e-11)
    np.testing.assert_allclose(below[1], above[1], atol=1e-11)


def slipping_truth() -> GraspTruth:
    changes = (
        GraspChange(1.0, 2.0, R_GRASP @ so3_exp((0.2, 0.1, -0.3)), P_GRASP + np.array((0.05, -0.02, 0.03))),
        GraspChange(4.0, 0.0, R_GRASP, P_GRASP),
    )
    zero = np.zeros(3)
    return GraspTruth(R_GRASP, P_GRASP, zero, zero, 0.0, zero, changes)


def test_hand_on_a_slipping_grasp_matches_finite_differences():
    truth = slipping_truth()
    check_kinematics(lambda t: hand_motion(trajectory(), truth, t), np.linspace(0.5, 3.9, 150))


def test_grasp_changes_begin_and_end_where_they_say():
    truth = slipping_truth()
    R, p = truth.grasp_at([0.0, 0.999, 3.0, 3.9, 4.0, 9.0])
    first, second = truth.changes
    for k, (want_R, want_p) in enumerate(
        [(R_GRASP, P_GRASP)] * 2
        + [(first.rotation, first.translation)] * 2
        + [(second.rotation, second.translation)] * 2
    ):
        np.testing.assert_allclose(R[k], want_R, atol=1e-14)
        np.testing.assert_allclose(p[k], want_p, atol=1e-14)


def test_rigid_coupling_holds_exactly_without_noise():
    recording = simulate_grasp(trajectory(), R_GRASP, P_GRASP, duration=2.0)
    robot, hand = recording.robot, recording.hand
    assert isinstance(robot, MotionStream)
    np.testing.assert_array_equal(robot.t, hand.t)
    np.testing.assert_allclose(robot.angular_velocity, hand.angular_velocity @ R_GRASP.T, atol=1e-12)
    phi = skew(robot.angular_acceleration) + skew(robot.angular_velocity) @ skew(robot.angular_velocity)
    np.testing.assert_allclose(
        robot.specific_force + phi @ P_GRASP, hand.specific_force @ R_GRASP.T, rtol=0, atol=1e-11
    )


def test_hand_reads_gravity_upwards_at_rest():
    still = RigidTrajectory(Sinusoids())
    hand = simulate_grasp(still, np.eye(3), P_GRASP, duration=0.1).hand
    np.testing.assert_allclose(hand.specific_force, np.tile((0.0, 0.0, 9.80665), (100, 1)), atol=1e-12)


def test_time_offset_delays_the_stamps_of_the_hand():
    tau = 0.0437
    recording = simulate_grasp(
        trajectory(), R_GRASP, P_GRASP, duration=2.0, hand=HandImu(rate=200.0), time_offset=tau
    )
    # A hand sample stamped t shows the robot's motion at t - tau.
    w_r = trajectory().at(recording.hand.t - tau).angular_velocity
    np.testing.assert_allclose(recording.hand.angular_velocity @ R_GRASP.T, w_r, atol=1e-9)
    assert recording.hand.rate == pytest.approx(200.0)


def test_base_tilt_is_seen_by_the_hand_only():
    dg = gravity_error((0.01, -0.02, 0.0))
    recording = simulate_grasp(trajectory(), R_GRASP, P_GRASP, duration=1.0, base_tilt=dg)
    robot, hand = recording.robot, recording.hand
    phi = skew(robot.angular_acceleration) + skew(robot.angular_velocity) @ skew(robot.angular_velocity)
    left = hand.specific_force @ R_GRASP.T - (robot.specific_force + phi @ P_GRASP)
    np.testing.assert_allclose(left, -dg @ recording.robot_truth.rotation, atol=1e-11)
    assert np.linalg.norm(dg) == pytest.approx(9.80665 * np.hypot(0.01, 0.02), rel=1e-3)


@pytest.mark.parametrize("rate", [100.0, 1000.0])
def test_noise_has_the_stated_density_and_bias(rate):
    imu = replace(XSENS, rate=rate)
    recording = simulate_grasp(trajectory(), R_GRASP, P_GRASP, duration=20.0, hand=imu, seed=3)
    truth, exact = recording.truth, recording.hand_truth
    for noise, bias, density in (
        (
            recording.hand.angular_velocity - exact.angular_velocity,
            truth.gyro_bias,
            imu.gyro_noise_density,
        ),
        (
            recording.hand.specific_force - exact.specific_force(recording.gravity),
            truth.accelerometer_bias,
            imu.accelerometer_noise_density,
        ),
    ):
        sd = density * np.sqrt(rate)
        n = len(noise)
        np.testing.assert_allclose((noise - bias).std(axis=0), sd, rtol=4.0 / np.sqrt(2 * n))
        assert np.all(np.abs(noise.mean(axis=0) - bias) < 4.0 * sd / np.sqrt(n))
        assert np.all(bias != 0.0)


def test_robot_noise_has_the_stated_deviations():
    sensing = RobotSensing(
        rate=500.0,
        rotation_sd=1e-3,
        angular_velocity_sd=0.01,
        angular_acceleration_sd=0.3,
        acceleration_sd=0.2,
    )
    recording = simulate_grasp(trajectory(), R_GRASP, P_GRASP, duration=20.0, robot=sensing)
    robot, exact = recording.robot, recording.robot_truth
    assert isinstance(robot, MotionStream)
    turn = so3_log(np.swapaxes(exact.rotation, 1, 2) @ quaternion_wxyz_to_matrix(robot.rotation_wxyz))
    for noise, sd in (
        (robot.angular_velocity - exact.angular_velocity, 0.01),
        (robot.angular_acceleration - exact.angular_acceleration, 0.3),
        (robot.specific_force - exact.specific_force(recording.gravity), 0.2),
        (turn, 1e-3),
    ):
        np.testing.assert_allclose(noise.std(axis=0), sd, rtol=0.03)
    poses = replace(sensing, output="pose", position_sd=1e-4)
    recording = simulate_grasp(trajectory(), R_GRASP, P_GRASP, duration=20.0, robot=poses)
    assert isinstance(recording.robot, PoseStream)
    np.testing.assert_allclose(
        (recording.robot.position - recording.robot_truth.position).std(axis=0), 1e-4, rtol=0.03
    )
    angle = angle_between(recording.robot.rotation, recording.robot_truth.rotation)
    assert np.sqrt(np.mean(angle**2) / 3.0) == pytest.approx(1e-3, rel=0.03)


def test_seed_reproduces_and_options_do_not_touch_each_others_draws():
    def simulate(seed=5, **imu):
        return simulate_grasp(
            trajectory(), R_GRASP, P_GRASP, duration=5.0, hand=replace(XSENS, **imu), seed=seed
        )

    one, same, other = simulate(), simulate(), simulate(seed=6)
    np.testing.assert_array_equal(one.hand.specific_force, same.hand.specific_force)
    assert np.all(one.truth.gyro_bias != other.truth.gyro_bias)
    gappy = simulate(dropout_fraction=0.2, dropout_length=10.0)
    kept = np.isin(one.hand_sample_time, gappy.hand_sample_time)
    np.testing.assert_array_equal(gappy.hand.angular_velocity, one.hand.angular_velocity[kept])


def test_dropouts_lose_the_stated_share_in_bursts():
    imu = HandImu(dropout_fraction=0.1, dropout_length=25.0)
    recording = simulate_grasp(trajectory(), R_GRASP, P_GRASP, duration=60.0, hand=imu)
    lost = 1.0 - len(recording.hand) / 60000
    assert lost == pytest.approx(0.1, abs=0.03)
    gaps = recording.hand.gaps(max_gap=0.0015)
    assert 60000 * lost / gaps.count == pytest.approx(25.0, rel=0.3)


def test_jitter_moves_stamps_but_not_samples():
    imu = HandImu(rate=100.0, stamp_jitter_sd=0.002)
    recording = simulate_grasp(trajectory(), R_GRASP, P_GRASP, duration=20.0, hand=imu)
    late = recording.hand.t - recording.hand_sample_time
    assert late.std() == pytest.approx(0.002, rel=0.1)
    assert np.all(np.diff(recording.hand.t) > 0.0)
    w_r = trajectory().at(recording.hand_sample_time).angular_velocity
    np.testing.assert_allclose(recording.hand.angular_velocity @ R_GRASP.T, w_r, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"rotation": np.ones((3, 3))}, "rotation"),
        ({"translation": (1.0, np.nan, 0.0)}, "translation"),
        ({"hand": HandImu(rate=0.0)}, "hand.rate"),
        ({"hand": HandImu(dropout_fraction=1.0)}, "hand.dropout_fraction"),
        ({"hand": HandImu(dropout_fraction=0.9, dropout_length=2.0)}, "hand.dropout_length"),
        ({"changes": slipping_truth().changes[::-1]}, "changes"),
    ],
)
def test_bad_settings_are_named(change, field):
    settings = {"rotation": R_GRASP, "translation": P_GRASP, "duration": 1.0} | change
    with pytest.raises(InputError) as caught:
        simulate_grasp(trajectory(), **settings)
    assert caught.value.field == field


# ------------------------------------------------------------------------------------ the paper's experiment


def test_printed_motion_is_as_printed_and_has_one_axis():
    motion = cehajic2015(motion="printed").robot_truth
    w = np.multiply.outer(np.sin(motion.t), np.deg2rad((10.0, 40.0, 20.0)))
    np.testing.assert_allclose(motion.angular_velocity, w, atol=1e-12)
    # v_r = r0 x w in the body frame, by central differences of position.
    h = motion.t[1] - motion.t[0]
    v = np.einsum("nji,nj->ni", motion.rotation[1:-1], (motion.position[2:] - motion.position[:-2]) / (2 * h))
    np.testing.assert_allclose(v, np.cross((0.5, 0.0, 0.0), w[1:-1]), atol=1e-6)
    eigenvalues = np.linalg.eigvalsh(excitation_gramian(motion))
    rate = np.deg2rad(np.linalg.norm((10.0, 40.0, 20.0)))
    t = motion.t
    closed = np.trapezoid((rate * np.cos(t)) ** 2 + (rate * np.sin(t)) ** 4, t)
    np.testing.assert_allclose(eigenvalues, (0.0, closed, closed), rtol=2e-4, atol=1e-11)
    np.testing.assert_allclose(eigenvalues[1:], 28.4, atol=0.05)


def test_exciting_motion_excites_and_keeps_the_wrist_at_rest():
    recording = cehajic2015(motion="exciting")
    eigenvalues = np.linalg.eigvalsh(excitation_gramian(recording.robot_truth))
    assert eigenvalues[0] > 100.0
    assert np.all(np.ptp(recording.hand_truth.position, axis=0) < 0.01)
    motion = recording.robot_truth
    peak = np.rad2deg(np.linalg.norm(motion.angular_velocity, axis=1).max())
    assert peak == pytest.approx(67.0, abs=0.5)
    # A rotation error d shows in the specific force as f x d and a bias as b: what tells them apart is the scatter of gravity's
    # direction in the sensor's frame, and for every axis of d it is large.
    scatter = np.cov(motion.rotation[:, 2].T)
    assert np.linalg.eigvalsh(np.trace(scatter) * np.eye(3) - scatter)[0] > 0.25**2


def test_excitation_of_coning_matches_its_closed_form():
    amplitude, frequency, T = 0.02, 0.8, 50.0
    u, v = np.eye(3)[:2]
    quarter = np.full(3, 0.5 * np.pi)
    coning = RigidTrajectory(
        Sinusoids((0, 0, 0), [amplitude * u, amplitude * v], [frequency] * 2, [quarter, np.zeros(3)])
    )
    smallest = np.linalg.eigvalsh(excitation_gramian(coning.at(np.arange(0.0, T, 0.002))))[0]
    assert smallest == pytest.approx(T * (2 * np.pi * frequency) ** 4 * amplitude**2 / 2, rel=0.01)


def test_determinant_of_the_regressor_is_minus_the_cross_product_squared():
    motion: RigidMotion = trajectory().at(np.linspace(0.0, 5.0, 50))
    w, al = motion.angular_velocity, motion.angular_acceleration
    phi = skew(al) + skew(w) @ skew(w)
    cross = np.cross(w, al)
    np.testing.assert_allclose(np.linalg.det(phi), -np.einsum("ij,ij->i", cross, cross), rtol=1e-9, atol=1e-9)


def test_every_scenario_can_be_made():
    for name, summary in list_scenarios().items():
        if name not in ("cehajic2015", "grasp_regrasp", "grasp_slip"):
            continue
        assert summary
        recording = make_scenario(name, seed=2)
        assert recording.name.startswith(name)
        assert len(recording.hand) == 60000
    with pytest.raises(InputError, match="cehajic2015"):
        make_scenario("no such thing")


def test_regrasp_and_slip_have_the_stated_sizes():
    for name, angle, distance in (("grasp_regrasp", 10.0, 0.07), ("grasp_slip", 3.0, 0.02)):
        R, p = make_scenario(name, seed=4).truth.grasp_at([0.0, 59.0])
        assert np.rad2deg(angle_between(R[0], R[1])) == pytest.approx(angle)
        assert np.linalg.norm(p[1] - p[0]) == pytest.approx(distance)


@pytest.mark.parametrize("output", ["motion", "pose"])
def test_written_recording_reads_back(tmp_path, output):
    recording = cehajic2015(seed=1, duration=1.0, robot=RobotSensing(output=output), time_offset=0.01)
    toml = write_recording(recording, tmp_path / "new" / "folder")
    problem = tomllib.loads(toml.read_text())
    assert problem["kind"] == "grasp_pose"
    assert problem["robot"]["gravity"] == [0.0, 0.0, -9.80665]
    read = {"motion": read_motion, "pose": read_poses}[output]
    robot = read(toml.parent / problem["robot"]["file"])
    np.testing.assert_array_equal(robot.t, recording.robot.t)
    np.testing.assert_allclose(robot.rotation_wxyz, recording.robot.rotation_wxyz, atol=1e-15)
    hand = read_imu(toml.parent / problem["hand"]["file"])
    np.testing.assert_array_equal(hand.specific_force, recording.hand.specific_force)
    truth = json.loads((toml.parent / "truth.json").read_text())
    assert truth["time_offset"] == 0.01
    np.testing.assert_allclose(truth["translation"], recording.truth.translation)
    assert sorted(p.name for p in toml.parent.iterdir()) == [
        "grasp.toml",
        "imu.csv",
        "robot.csv",
        "truth.json",
    ]

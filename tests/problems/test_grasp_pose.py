"""The grasp problem on simulated recordings with known truth, and on input that it must refuse or call unobservable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgrasp import lie, solve
from factorgrasp.errors import InputError
from factorgrasp.problems import GraspNoise, GraspPose, GraspPrior, GraspSettings
from factorgrasp.recordings import ImuStream, JointStream, PoseStream
from factorgrasp.simulation.cehajic2015 import ENCODER_POSES, ROUGH_ENCODER_NOISE, cehajic2015
from factorgrasp.simulation.grasp import RobotSensing
from factorgrasp.status import Status
from factorgrasp.uncertainty import nees


def grasp_error(estimate, truth) -> np.ndarray:
    return estimate.error_to(truth.rotation, truth.translation)


@pytest.fixture(scope="module")
def recording():
    return cehajic2015(seed=5, duration=30.0, time_offset=0.0237)


@pytest.fixture(scope="module")
def estimate(recording):
    return solve(GraspPose(recording.robot, recording.hand))


def test_finds_the_grasp_the_clock_and_the_biases(recording, estimate):
    truth = recording.truth
    assert estimate.status is Status.SOLVED
    error = grasp_error(estimate, truth)
    assert np.linalg.norm(error[:3]) < np.deg2rad(0.03)
    assert np.linalg.norm(error[3:]) < 0.002
    assert nees(error, estimate.covariance) < 6 * 3.0
    assert estimate.time_offset == pytest.approx(0.0237, abs=4 * estimate.time_offset_sd)
    assert estimate.time_offset_sd < 2e-4
    np.testing.assert_allclose(estimate.gyro_bias, truth.gyro_bias, atol=4 * estimate.gyro_bias_sd.max())
    np.testing.assert_allclose(
        estimate.accelerometer_bias, truth.accelerometer_bias, atol=4 * estimate.accelerometer_bias_sd.max()
    )
    assert estimate.observability.complete


def test_a_good_sensor_gets_no_calibration_unknowns_and_a_bad_one_does(recording, estimate):
    names = [v.name for v in estimate.estimate.variables]
    assert names == ["rotation", "translation", "gyro_bias", "accelerometer_bias", "time_offset"]
    bent = ImuStream(
        recording.hand.t,
        recording.hand.angular_velocity * [1.01, 0.995, 1.0],
        recording.hand.specific_force * [1.0, 1.006, 0.99],
    )
    found = solve(GraspPose(recording.robot, bent))
    values = found.estimate.values
    # The model maps readings to truth, so the found factors are the inverse of the applied ones.
    np.testing.assert_allclose(values["gyro_calibration"][:3], [-0.0099, 0.005, 0.0], atol=2e-3)
    np.testing.assert_allclose(
        np.diag(values["accelerometer_calibration"].reshape(3, 3)), [0.0, -0.006, 0.0101], atol=2e-3
    )
    error = grasp_error(found, recording.truth)
    assert nees(error, found.covariance) < 6 * 3.0
    trusting = solve(GraspPose(recording.robot, bent, settings=GraspSettings(sensor_errors="never")))
    densities = [e.diagnostics.accelerometer_density[:2].max() for e in (found, trusting)]
    assert densities[1] > 1.5 * densities[0]


@pytest.mark.parametrize("forgetting", [None, 10.0])
def test_covariance_is_consistent(forgetting):
    values = []
    for seed in range(10):
        run = cehajic2015(seed=100 + seed, duration=20.0)
        settings = GraspSettings(forgetting_time=forgetting)
        found = solve(GraspPose(run.robot, run.hand, settings=settings))
        values.append(nees(grasp_error(found, run.truth), found.covariance) / 6)
    # 99.9 % band of 60 degrees of freedom; the 50-seed band is checked in the benchmark.
    assert 0.5 < np.mean(values) < 1.7


def test_errors_in_variables_correction_removes_the_shrinking_of_the_lever_arm():
    shrink = {True: [], False: []}
    for seed in range(3):
        run = cehajic2015(seed=seed, robot=ROUGH_ENCODER_NOISE)
        direction = run.truth.translation / np.linalg.norm(run.truth.translation)
        for corrected in shrink:
            settings = GraspSettings(errors_in_variables=corrected, adapt_noise=False)
            found = solve(GraspPose(run.robot, run.hand, settings=settings))
            shrink[corrected].append(direction @ (found.translation - run.truth.translation))
    assert np.mean(shrink[False]) < -0.002
    assert abs(np.mean(shrink[True])) < 0.5 * abs(np.mean(shrink[False]))


def test_robust_loss_survives_knocks(recording):
    force = recording.hand.specific_force.copy()
    rng = np.random.default_rng(3)
    for start in rng.integers(0, force.shape[0] - 300, 6):
        force[start : start + 200] += 8.0 * rng.standard_normal(3)
    knocked = ImuStream(recording.hand.t, recording.hand.angular_velocity, force)
    plain = solve(GraspPose(recording.robot, knocked))
    for loss in ("huber", "cauchy", "geman_mcclure"):
        found = solve(GraspPose(recording.robot, knocked, settings=GraspSettings(loss=loss)))
        error = grasp_error(found, recording.truth)
        assert np.linalg.norm(error[3:]) < 0.2 * np.linalg.norm(grasp_error(plain, recording.truth)[3:])
        assert nees(error, found.covariance) < 6 * 3.0
        assert found.diagnostics.window_weight.min() < 0.5


def test_base_tilt_is_found_when_asked_for():
    run = cehajic2015(seed=2, duration=30.0, robot=ENCODER_POSES, base_tilt=(0.1, -0.15, 0.0))
    without = solve(GraspPose(run.robot, run.hand))
    problem = GraspPose(run.robot, run.hand, settings=GraspSettings(base_tilt=True))
    found = solve(problem)
    sd = found.estimate.sd("base_tilt")
    # 0.18 m/s^2 of gravity's 9.81 pointing sideways.
    assert np.linalg.norm(found.estimate.values["base_tilt"]) == pytest.approx(
        np.hypot(0.1, 0.15) / 9.80665, abs=4 * sd.max()
    )
    error = grasp_error(found, run.truth)
    assert nees(error, found.covariance) < 6 * 3.0
    assert np.linalg.norm(error[3:]) < np.linalg.norm(grasp_error(without, run.truth)[3:])
    motion = cehajic2015(seed=2, duration=5.0).robot
    bare = replace(motion, rotation_wxyz=None)
    with pytest.raises(InputError, match="base_tilt"):
        GraspPose(bare, run.hand, settings=GraspSettings(base_tilt=True))


def test_robot_side_as_slow_poses_or_as_imu(recording):
    slow = cehajic2015(
        seed=5,
        duration=30.0,
        robot=RobotSensing(output="pose", rate=100.0, position_sd=1e-4, rotation_sd=2e-4),
    )
    found = solve(GraspPose(slow.robot, slow.hand))
    assert nees(grasp_error(found, slow.truth), found.covariance) < 6 * 3.0
    assert np.linalg.norm(grasp_error(found, slow.truth)[3:]) < 0.003
    rng = np.random.default_rng(0)
    exact = recording.robot_truth
    w, f = exact.angular_velocity, exact.specific_force((0.0, 0.0, -9.80665))
    sd = np.sqrt(1000.0)
    imu = ImuStream(
        recording.robot.t,
        w + 5e-4 * sd * rng.standard_normal(w.shape),
        f + 2e-3 * sd * rng.standard_normal(w.shape),
        name="robot",
    )
    found = solve(GraspPose(imu, recording.hand))
    assert nees(grasp_error(found, recording.truth), found.covariance) < 6 * 3.0
    assert np.linalg.norm(grasp_error(found, recording.truth)[3:]) < 0.003


def test_robot_side_as_joint_positions():
    pytest.importorskip("pinocchio")
    import pinocchio

    from factorgrasp.models.robot import end_effector_poses

    model = pinocchio.buildSampleModelManipulator()
    frame = model.frames[model.nframes - 1].name
    rate, n = 250.0, 5000
    t = np.arange(n) / rate
    rng = np.random.default_rng(1)
    phase, speed = rng.uniform(0, 6, (2, model.nq))
    q = 0.5 * np.sin((0.6 + 0.25 * speed) * t[:, None] * 2 + phase)
    # Truth from forward kinematics at many times the rate, differentiated centrally.
    h = 1e-4
    at = [
        end_effector_poses(model, frame, 0.5 * np.sin((0.6 + 0.25 * speed) * (t[:, None] + d) * 2 + phase))
        for d in (-h, 0.0, h)
    ]
    R = [lie.quaternion_wxyz_to_matrix(quaternion) for _, quaternion in at]
    acceleration = (at[2][0] - 2 * at[1][0] + at[0][0]) / h**2
    ahead, behind = (lie.so3_log(np.swapaxes(R[1], 1, 2) @ R[k]) / h for k in (2, 0))
    w, al = 0.5 * (ahead - behind), (ahead + behind) / h
    f = np.einsum("nji,nj->ni", R[1], acceleration + np.array([0, 0, 9.80665]))
    R_r_h, p_r_h = lie.so3_exp(np.array([0.4, -1.1, 0.7])), np.array([0.05, -0.12, 0.2])
    at_hand = f + np.cross(al, p_r_h) + np.cross(w, np.cross(w, p_r_h))
    hand = ImuStream(
        t,
        w @ R_r_h + 0.008 * rng.standard_normal(w.shape),
        at_hand @ R_r_h + 0.03 * rng.standard_normal(w.shape),
    )
    robot = JointStream(t, q, tuple(f"q{i + 1}" for i in range(model.nq)))
    found = solve(GraspPose(robot, hand, robot_model=model, frame=frame))
    assert found.solved
    error = np.concatenate([lie.so3_log(found.rotation.T @ R_r_h), p_r_h - found.translation])
    assert np.linalg.norm(error[3:]) < 0.002
    assert nees(error, found.covariance) < 6 * 3.0
    with pytest.raises(InputError, match=r"robot\.frame"):
        GraspPose(robot, hand, robot_model=model, frame="no such frame")
    with pytest.raises(InputError, match="urdf"):
        GraspPose(robot, hand)


def test_gaps_are_used_around_and_counted(recording, estimate):
    rate = recording.hand.angular_velocity.copy()
    rate[10_000:12_000] = np.nan
    rate[500::6000] = np.nan
    keep = np.ones(rate.shape[0], dtype=bool)
    keep[20_000:21_500] = False
    hand = ImuStream(recording.hand.t[keep], rate[keep], recording.hand.specific_force[keep])
    found = solve(GraspPose(recording.robot, hand))
    assert nees(grasp_error(found, recording.truth), found.covariance) < 6 * 3.0
    count, seconds, rows = found.diagnostics.hand_gaps
    assert (rows, count) == (2005, 7)
    assert seconds == pytest.approx(3.5, abs=0.05)
    assert found.diagnostics.windows_dropped > estimate.diagnostics.windows_dropped
    # A wild value inside a gap row must not matter at all.
    force = recording.hand.specific_force[keep].copy()
    force[10_500] = 1e6
    again = solve(GraspPose(recording.robot, ImuStream(hand.t, hand.angular_velocity, force)))
    np.testing.assert_array_equal(again.translation, found.translation)


def test_moving_the_robot_body_moves_the_answer_exactly():
    run = cehajic2015(seed=4, duration=20.0, robot=ENCODER_POSES)
    offset, turn = np.array([0.3, -0.2, 0.15]), lie.so3_exp(np.array([0.9, -0.8, 0.9]))
    R = lie.quaternion_wxyz_to_matrix(run.robot.rotation_wxyz)
    moved = PoseStream(
        run.robot.t, run.robot.position + R @ offset, lie.matrix_to_quaternion_wxyz(R @ turn, continuous=True)
    )
    noise = GraspNoise(robot_position_sd=5e-5, robot_rotation_sd=5e-5)
    a = solve(GraspPose(run.robot, run.hand, noise=noise))
    b = solve(GraspPose(moved, run.hand, noise=noise))
    assert np.linalg.norm(b.translation - turn.T @ (a.translation - offset)) < 1e-3
    assert lie.angle_between(b.rotation, turn.T @ a.rotation) < np.deg2rad(0.01)


def test_the_printed_motion_is_called_unobservable_in_words():
    run = cehajic2015(seed=0, motion="printed", duration=30.0)
    found = solve(GraspPose(run.robot, run.hand))
    assert found.status is Status.UNOBSERVABLE
    missing = found.observability.missing
    assert [d.variable for d in missing] == ["translation"]
    assert "rotation axis" in missing[0].words
    assert "second axis" in found.message
    axis = np.array([10.0, 40.0, 20.0]) / np.linalg.norm([10, 40, 20])
    assert abs(missing[0].vector @ axis) > 0.999
    # What the motion did show is right, within its sigma.
    error = grasp_error(found, run.truth)
    across = np.eye(3) - np.outer(axis, axis)
    assert np.linalg.norm(across @ error[3:]) < 0.02


def test_a_prior_fills_in_what_the_motion_does_not_show():
    run = cehajic2015(seed=0, motion="printed", duration=20.0)
    prior = GraspPrior(
        translation=run.truth.translation + np.array([0.003, -0.004, 0.002]), translation_sd=0.005
    )
    found = solve(GraspPose(run.robot, run.hand, prior=prior))
    assert found.status is Status.SOLVED
    assert np.linalg.norm(found.translation - run.truth.translation) < 0.01
    rotation = run.truth.rotation @ lie.so3_exp(np.array([0.002, 0.0, -0.001]))
    prior = GraspPrior(rotation=rotation, rotation_sd=1e-6)
    assert lie.angle_between(solve(GraspPose(run.robot, run.hand, prior=prior)).rotation, rotation) < 1e-5


def test_still_and_unrelated_recordings_are_said_to_be_so():
    rng = np.random.default_rng(0)
    t = np.arange(8000) / 400.0
    still = PoseStream(t, 1e-5 * rng.standard_normal((t.size, 3)), np.tile([1.0, 0, 0, 0], (t.size, 1)))
    hand = ImuStream(
        t, 0.01 * rng.standard_normal((t.size, 3)), [0, 0, 9.8] + 0.05 * rng.standard_normal((t.size, 3))
    )
    found = solve(GraspPose(still, hand))
    assert found.status is Status.UNOBSERVABLE
    assert "hardly rotates" in found.message
    assert found.covariance[0, 0] > 1.0
    one, other = cehajic2015(seed=1, duration=20.0), cehajic2015(seed=2, duration=20.0, motion="printed")
    found = solve(GraspPose(one.robot, other.hand))
    assert found.status is Status.UNOBSERVABLE
    assert "do not turn together" in found.message


def test_bad_input_names_the_field(recording):
    robot, hand = recording.robot, recording.hand
    degrees = ImuStream(hand.t, np.rad2deg(hand.angular_velocity), hand.specific_force, check_units=False)
    with pytest.raises(InputError, match=r"hand angular velocity.*degrees suspected"):
        GraspPose(robot, degrees)
    fast = ImuStream(hand.t, 1.6 * hand.angular_velocity, hand.specific_force)
    with pytest.raises(InputError, match=r"hand angular velocity.*1\.6 times"):
        GraspPose(robot, fast)
    with pytest.raises(InputError, match="overlap"):
        GraspPose(robot, hand.shifted(500.0))
    with pytest.raises(InputError, match="gravity"):
        GraspPose(robot, hand, gravity=(0, 0, -9806.65))
    with pytest.raises(InputError, match="ImuStream"):
        GraspPose(robot, robot)
    with pytest.raises(InputError, match=r"noise\.gyro_density.*singular"):
        GraspNoise(gyro_density=0.0)
    with pytest.raises(InputError, match=r"noise\.accelerometer_bias_sd"):
        GraspNoise(accelerometer_bias_sd=float("nan"))
    with pytest.raises(InputError, match=r"estimate\.bandwidth"):
        GraspSettings(bandwidth=-1.0)
    with pytest.raises(InputError, match="loss"):
        GraspSettings(loss="tukey")
    with pytest.raises(InputError, match=r"prior\.rotation"):
        GraspPrior(rotation=np.eye(3))
    with pytest.raises(InputError, match="at least 16 samples"):
        GraspPose(robot.slice(0.0, 0.02), hand)
    torn = robot.specific_force.copy()
    torn[::20] = np.nan
    with pytest.raises(InputError, match="at least two common windows"):
        GraspPose(replace(robot, specific_force=torn), hand)


def slow_poses(**options):
    robot = RobotSensing(output="pose", rate=200.0, position_sd=1e-4, rotation_sd=1e-4)
    return cehajic2015(seed=6, robot=robot, **options)


def test_dense_gaps_shorten_the_windows():
    run = slow_poses(duration=30.0)
    torn = run.hand.angular_velocity.copy()
    torn[np.random.default_rng(0).random(torn.shape[0]) < 0.003] = np.nan
    found = solve(GraspPose(run.robot, ImuStream(run.hand.t, torn, run.hand.specific_force)))
    assert found.status is Status.SOLVED
    assert found.diagnostics.window_seconds < 0.6
    assert nees(grasp_error(found, run.truth), found.covariance) < 6 * 3.0


def test_gravity_of_the_wrong_sign_is_suspected():
    run = slow_poses(duration=20.0)
    found = solve(GraspPose(run.robot, run.hand, gravity=(0.0, 0.0, 9.80665)))
    assert found.status is not Status.SOLVED
    assert "gravity" in found.message


def test_every_solver_gives_the_same_answer(recording, estimate):
    problem = GraspPose(recording.robot, recording.hand)
    for solver in ("kkt", "gtsam", "gtsam-gauss-newton", "gtsam-levenberg-marquardt", "gtsam-isam2", "osqp"):
        other = solve(problem, solver=solver)
        assert other.status is Status.SOLVED
        assert np.linalg.norm(other.translation - estimate.translation) < 1e-6
        assert lie.angle_between(other.rotation, estimate.rotation) < 1e-6


def test_a_wrong_start_is_escaped(recording):
    problem = GraspPose(recording.robot, recording.hand)
    state = dict(problem.initial_state())
    # A rotation half a turn off, at which nothing pulls: the certificate refuses it and the relaxation finds the
    # right basin, which is then certified.
    state["rotation"] = state["rotation"] @ lie.so3_exp(np.array([np.pi, 0.0, 0.0]))
    better = problem.escape(state)
    assert better is not None
    assert lie.angle_between(better["rotation"], recording.truth.rotation) < np.deg2rad(1.0)
    assert problem.escape(better) is None

"""The grasp problem with two pose streams: derivatives, truth, honest covariance, degenerate motion, real recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.errors import InputError, UnobservableError
from factorgrasp.problems.cluster_scores import (
    cluster_score_covariance,
    drowned_directions,
    without_noise_information,
)
from factorgrasp.problems.grasp_from_poses import (
    GraspFromPosesNoise,
    GraspFromPosesSettings,
    GraspPoseFromPoses,
)
from factorgrasp.problems.grasp_from_poses_estimate import GraspFromPosesEstimate
from factorgrasp.problems.hand_eye_curve import PoseCurve
from factorgrasp.problems.hand_eye_math import coupling_rows
from factorgrasp.recordings import ImuStream, PoseStream
from factorgrasp.simulation.trajectory import RigidTrajectory, Sinusoids
from factorgrasp.solvers.solve import solve
from factorgrasp.status import Status
from factorgrasp.uncertainty import nees, nees_band

LEVER = np.array([0.08, -0.04, 0.12])


@dataclass(frozen=True)
class Scene:
    robot: PoseStream
    hand: PoseStream
    rotation: np.ndarray
    world_rotation: np.ndarray
    world_translation: np.ndarray
    time_offset: float

    def error(self, found: GraspFromPosesEstimate) -> np.ndarray:
        return np.concatenate([lie.so3_log(self.rotation.T @ found.rotation), found.translation - LEVER])


def correlated(rng: np.random.Generator, n: int, step: float, time_constant: float) -> np.ndarray:
    """Unit noise (n, 3), white or of first order."""
    white = rng.normal(size=(n, 3))
    if time_constant == 0.0:
        return white
    keep = np.exp(-step / time_constant)
    out = np.empty_like(white)
    out[0] = white[0]
    for k in range(1, n):
        out[k] = keep * out[k - 1] + np.sqrt(1.0 - keep**2) * white[k]
    return out


def scene(
    seed: int,
    *,
    duration: float = 25.0,
    rates: tuple[float, float] = (100.0, 20.0),
    robot_sd: tuple[float, float] = (1e-4, 1e-4),
    hand_sd: tuple[float, float] = (0.008, 0.004),
    time_constant: float = 0.0,
    time_offset: float = 0.037,
    outliers: float = 0.0,
    camera: bool = False,
    axes: int = 3,
    travel: bool = True,
) -> Scene:
    """Robot and hand from closed forms, each at its own times. `camera`: noise in the target's place as the camera sees it."""
    rng = np.random.default_rng(seed)
    frequency = np.array([0.07, 0.13, 0.23, 0.41])
    size = np.array([0.35, 0.25, 0.15, 0.06])[:, None]
    amplitude, phase = size * rng.normal(size=(4, 3)), rng.uniform(0.0, 2.0 * np.pi, (4, 3))
    if axes == 1:
        amplitude, phase = size * np.array([0.0, 0.6, 0.8]), np.repeat(phase[:, :1], 3, axis=1)
    way = (0.4 if travel else 0.0) * size * rng.normal(size=(4, 3))
    trajectory = RigidTrajectory(
        Sinusoids(amplitude=amplitude if axes else 0.0 * amplitude, frequency=frequency, phase=phase),
        Sinusoids((0.5, 0.1, 0.4), way, 1.17 * frequency, rng.uniform(0.0, 2.0 * np.pi, (4, 3))),
        mean_rotation_wxyz=lie.quaternion_exp_wxyz(rng.normal(size=3)),
    )
    X, Y = lie.so3_exp(rng.normal(size=(2, 3)))
    t_robot = np.arange(0.0, duration, 1.0 / rates[0])
    t_hand = np.arange(0.3, duration - 0.3, 1.0 / rates[1])
    t_hand = t_hand + rng.uniform(-0.05, 0.05, t_hand.size) / rates[1]
    robot, hand = trajectory.at(t_robot), trajectory.at(t_hand)
    origin = hand.position.mean(axis=0) + np.array([0.9, 0.0, 0.0])
    R_t_h = Y.T @ hand.rotation @ X
    p_t_h = (hand.position + hand.rotation @ LEVER - origin) @ Y
    turn, shift = (sd * correlated(rng, t_hand.size, 1.0 / rates[1], time_constant) for sd in hand_sd)
    noisy = R_t_h @ lie.so3_exp(turn)
    if camera:
        p_h_t = -np.einsum("nji,nj->ni", R_t_h, p_t_h) + shift
        p_t_h = -np.einsum("nij,nj->ni", noisy, p_h_t)
    else:
        p_t_h = p_t_h + np.einsum("nij,nj->ni", R_t_h, shift)
    wrong = rng.random(t_hand.size) < outliers
    noisy[wrong] = noisy[wrong] @ lie.so3_exp(rng.normal(size=(wrong.sum(), 3)))
    p_t_h[wrong] += 0.3 * rng.normal(size=(wrong.sum(), 3))
    n = t_robot.size
    return Scene(
        PoseStream(
            t_robot,
            robot.position + robot_sd[1] * rng.normal(size=(n, 3)),
            lie.quaternion_multiply_wxyz(
                robot.rotation_wxyz, lie.quaternion_exp_wxyz(robot_sd[0] * rng.normal(size=(n, 3)))
            ),
        ),
        PoseStream(t_hand + time_offset, p_t_h, lie.matrix_to_quaternion_wxyz(noisy), name="hand"),
        X,
        Y,
        origin,
        time_offset,
    )


def quiet(**kw: object) -> Scene:
    return scene(1, robot_sd=(0.0, 0.0), hand_sd=(0.0, 0.0), **kw)  # type: ignore[arg-type]


# ---- derivatives ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rates", [(100.0, 25.0), (25.0, 100.0)])
def test_jacobian_matches_differences(rates):
    made = scene(3, duration=8.0, rates=rates, hand_sd=(0.05, 0.02))
    problem = GraspPoseFromPoses(made.robot, made.hand)
    state = problem.initial_state()
    rng = np.random.default_rng(0)
    state = problem.retract(state, 0.05 * rng.normal(size=13))
    state["time_offset"] = np.array([made.time_offset + 0.003])
    samples = problem._samples
    analytic = coupling_rows(state, problem._coupling.at(samples, float(state["time_offset"][0])))[1]
    for column in range(13):
        step = np.zeros(13)
        # The curves have jumps in their second derivative only, so central differences hold across samples, too.
        step[column] = 1e-6
        sides = []
        for sign in (1.0, -1.0):
            moved = problem.retract(state, sign * step)
            sides.append(
                coupling_rows(moved, problem._coupling.at(samples, float(moved["time_offset"][0])))[0]
            )
        numeric = (sides[0] - sides[1]) / 2e-6
        np.testing.assert_allclose(analytic[:, :, column], numeric, atol=2e-5, err_msg=f"column {column}")


def test_linearize_is_the_residual_and_its_jacobian():
    made = scene(3, duration=8.0)
    problem = GraspPoseFromPoses(made.robot, made.hand, settings=GraspFromPosesSettings(loss="none"))
    state = problem.initial_state()
    system = problem.linearize(state)
    step = 1e-5 * np.random.default_rng(1).normal(size=system.size)
    before, predicted = system.residuals(np.zeros(system.size)), system.residuals(step)
    landed = problem.linearize(problem.retract(state, step)).residuals(np.zeros(system.size))
    np.testing.assert_allclose(predicted, landed, atol=1e-4)
    assert np.abs(predicted - before).max() > 1e-3


# ---- the curve --------------------------------------------------------------------------------------------


def test_curve_passes_through_samples_and_never_bridges_a_gap():
    made = quiet(duration=40.0)
    keep = ~((made.robot.t > 10.0) & (made.robot.t < 10.5))
    position = made.robot.position.copy()
    position[2000:2010] = np.nan
    stream = PoseStream(made.robot.t[keep], position[keep], made.robot.rotation_wxyz[keep])
    curve = PoseCurve.from_stream(stream, None)
    at = curve.at(curve.t[5:20])
    np.testing.assert_allclose(at.position, curve.position[5:20], atol=1e-12)
    np.testing.assert_allclose(at.rotation, curve.rotation[5:20], atol=1e-12)
    inside = curve.at(np.array([9.995, 10.25, 10.505, 20.05, 19.985, -0.1, 40.2])).inside
    np.testing.assert_array_equal(inside, [True, False, True, False, True, False, False])
    covers = curve.covers(np.array([9.9, 9.98, 10.25, 10.6, 20.05, 39.98]), 0.05)
    np.testing.assert_array_equal(covers, [True, False, False, True, False, False])


def test_curve_velocities_are_its_derivatives():
    made = scene(2, duration=5.0, robot_sd=(0.01, 0.003))
    curve = PoseCurve.from_stream(made.robot, None, smooth=True)
    t = np.linspace(1.0, 3.0, 77)
    ahead, behind, here = curve.at(t + 1e-6), curve.at(t - 1e-6), curve.at(t)
    np.testing.assert_allclose((ahead.position - behind.position) / 2e-6, here.velocity, atol=5e-5)
    turn = lie.so3_log(np.swapaxes(behind.rotation, 1, 2) @ ahead.rotation) / 2e-6
    np.testing.assert_allclose(turn, here.angular_velocity, atol=2e-4)


def test_white_noise_is_measured_and_smoothing_lowers_it():
    made = scene(2, robot_sd=(0.01, 0.003))
    raw = PoseCurve.from_stream(made.robot, None)
    np.testing.assert_allclose(raw.noise[0], [0.01, 0.003], rtol=0.1)
    smooth = PoseCurve.from_stream(made.robot, None, smooth=True)
    clean = PoseCurve.from_stream(scene(2, robot_sd=(0.0, 0.0)).robot, None)
    inner = slice(50, -50)
    turn = lie.so3_log(np.swapaxes(clean.rotation, 1, 2) @ smooth.rotation)[inner]
    way = (smooth.position - clean.position)[inner]
    np.testing.assert_allclose([turn.std(), way.std()], smooth.noise[0], rtol=0.15)
    assert np.all(smooth.noise < 0.6 * raw.noise)


# ---- truth ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rates", [(100.0, 25.0), (25.0, 100.0), (50.0, 50.0)])
def test_noise_free_recording_gives_the_truth(rates):
    made = quiet(rates=rates)
    found = solve(GraspPoseFromPoses(made.robot, made.hand))
    assert found.status is Status.SOLVED
    assert np.abs(made.error(found)).max() < 2e-5
    assert found.time_offset == pytest.approx(made.time_offset, abs=1e-5)
    assert lie.angle_between(found.world_rotation, made.world_rotation) < 2e-5
    np.testing.assert_allclose(found.world_translation, made.world_translation, atol=2e-5)
    np.testing.assert_allclose(found.pose[:3, :3] @ found.pose[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("offset", [-0.85, 0.4])
def test_sign_and_size_of_the_time_offset(offset):
    # The same instant is stamped t by the robot and t + offset by the hand.
    made = quiet(time_offset=offset)
    found = solve(GraspPoseFromPoses(made.robot, made.hand))
    assert found.time_offset == pytest.approx(offset, abs=1e-5)


def test_given_time_offset_is_kept():
    made = scene(4, time_offset=0.05)
    settings = GraspFromPosesSettings(time_offset=False, time_offset_guess=0.05)
    found = solve(GraspPoseFromPoses(made.robot, made.hand, settings=settings))
    assert found.time_offset == 0.05
    assert found.time_offset_sd == 0.0
    assert nees(made.error(found), found.covariance) < 25.0
    wrong = solve(
        GraspPoseFromPoses(made.robot, made.hand, settings=GraspFromPosesSettings(time_offset=False))
    )
    assert np.abs(made.error(wrong)).max() > 3.0 * np.abs(made.error(found)).max()


def test_far_apart_worlds_and_grasps():
    # Half turns on both sides: no closed form may depend on being near the identity.
    made = quiet()
    half = np.diag([-1.0, -1.0, 1.0])
    hand = PoseStream(
        made.hand.t,
        made.hand.position @ half + np.array([5.0, -7.0, 2.0]),
        lie.matrix_to_quaternion_wxyz(half @ made.hand.rotation @ half),
        name="hand",
    )
    found = solve(GraspPoseFromPoses(made.robot, hand))
    assert lie.angle_between(found.rotation, made.rotation @ half) < 2e-5
    np.testing.assert_allclose(found.translation, LEVER, atol=2e-5)


# ---- honest covariance ------------------------------------------------------------------------------------


def many(
    seeds: range, settings: GraspFromPosesSettings | None = None, **kw: object
) -> tuple[float, np.ndarray]:
    """Mean NEES per degree of freedom, and the errors (runs, 6)."""
    errors, consistency = [], []
    for seed in seeds:
        made = scene(seed, **kw)  # type: ignore[arg-type]
        found = solve(GraspPoseFromPoses(made.robot, made.hand, settings=settings))
        assert found.status is Status.SOLVED, found.message
        errors.append(made.error(found))
        consistency.append(nees(errors[-1], found.covariance) / 6.0)
    return float(np.mean(consistency)), np.array(errors)


def test_covariance_is_consistent_for_white_noise():
    mean, _ = many(range(20))
    low, high = nees_band(6, 20, 0.99)
    assert low < mean < high


def test_covariance_knows_of_correlated_errors():
    mean, _ = many(range(10), time_constant=0.3)
    naive, _ = many(range(3), GraspFromPosesSettings(clusters=0), time_constant=0.3)
    # A dozen stretches tell a covariance with its own scatter, which costs some consistency.
    assert 0.5 < mean < 2.0
    assert naive > 5.0


def test_noise_on_both_sides_does_not_lead_the_clock_astray():
    for seed in range(4):
        made = scene(seed, robot_sd=(0.01, 0.003))
        found = solve(GraspPoseFromPoses(made.robot, made.hand))
        assert found.status is Status.SOLVED
        assert abs(found.time_offset - made.time_offset) < 4.0 * found.time_offset_sd
        assert abs(found.time_offset - made.time_offset) < 0.004
        assert nees(made.error(found), found.covariance) < 30.0


def test_full_covariance_pays_for_a_camera():
    # A camera's rotation error moves a target 0.9 m away: position and rotation err together.
    camera = {"camera": True, "hand_sd": (0.008, 0.001)}
    _, plain = many(range(5), **camera)
    mean, full = many(range(5), GraspFromPosesSettings(adapt_noise="full"), **camera)
    assert np.sqrt(np.mean(full[:, 3:] ** 2)) < 0.75 * np.sqrt(np.mean(plain[:, 3:] ** 2))
    assert 0.4 < mean < 1.8


def test_outliers_hardly_matter():
    mean, errors = many(range(4), outliers=0.1)
    _, clean = many(range(4))
    assert np.sqrt(np.mean(errors**2)) < 2.0 * np.sqrt(np.mean(clean**2))
    assert mean < 2.5
    made = scene(0, outliers=0.1)
    loose = solve(GraspPoseFromPoses(made.robot, made.hand, settings=GraspFromPosesSettings(loss="none")))
    assert np.abs(made.error(loose)).max() > 3.0 * np.abs(errors[0]).max()


def test_noise_is_estimated_from_the_residuals():
    made = scene(5)
    problem = GraspPoseFromPoses(made.robot, made.hand, noise=GraspFromPosesNoise(0.1, 0.1))
    found = solve(problem)
    sd = np.sqrt(np.diag(found.diagnostics.noise_covariance))
    np.testing.assert_allclose(sd, np.repeat([0.008, 0.004], 3), rtol=0.1)
    assert found.diagnostics.rotation_rms == pytest.approx(np.sqrt(3.0) * 0.008, rel=0.1)
    # The problem itself is as it was: solving again gives the same.
    again = solve(problem)
    np.testing.assert_allclose(again.translation, found.translation, atol=1e-9)


# ---- what the motion does not show ------------------------------------------------------------------------


@pytest.mark.parametrize("robot_sd", [(1e-4, 1e-4), (0.01, 0.003)])
def test_one_axis_hides_the_lever_arm_along_it(robot_sd):
    made = scene(2, axes=1, robot_sd=robot_sd)
    found = solve(GraspPoseFromPoses(made.robot, made.hand))
    assert found.status is Status.UNOBSERVABLE
    assert "lever arm along end-effector axis" in found.message
    assert "which is the rotation axis" in found.message
    assert "second axis" in found.message
    axis = np.array([0.0, 0.6, 0.8])
    covariance = found.covariance[3:, 3:]
    assert np.sqrt(axis @ covariance @ axis) > 1.0
    # Everything else holds.
    error = made.error(found)
    across = np.linalg.svd(axis[None])[2][1:]
    assert np.abs(across @ error[3:]).max() < 0.004
    assert np.abs(error[:3]).max() < 0.01


def test_turning_in_place_hides_the_turn_about_the_axis_too():
    made = scene(2, axes=1, travel=False, robot_sd=(0.002, 0.001))
    found = solve(GraspPoseFromPoses(made.robot, made.hand))
    assert found.status is Status.UNOBSERVABLE
    assert "rotation about hand axis" in found.message
    assert np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1]) > 1.0


@pytest.mark.parametrize("robot_sd", [(1e-4, 1e-4), (0.01, 0.003)])
def test_without_rotation_there_is_no_lever_arm(robot_sd):
    made = scene(3, axes=0, robot_sd=robot_sd)
    found = solve(GraspPoseFromPoses(made.robot, made.hand))
    assert found.status is Status.UNOBSERVABLE
    assert "hardly rotates" in found.message
    assert np.all(np.sqrt(np.diag(found.covariance)[3:]) > 1.0)
    # Displacements alone tell how both are turned.
    assert np.abs(made.error(found)[:3]).max() < 0.02


def test_robot_at_rest_is_refused():
    made = scene(3, axes=0, travel=False)
    with pytest.raises(UnobservableError, match="stands still"):
        GraspPoseFromPoses(made.robot, made.hand)


def test_prior_fills_what_the_motion_does_not_show():
    from factorgrasp.problems.grasp_settings import GraspPrior

    made = scene(2, axes=1)
    prior = GraspPrior(
        translation=LEVER + 0.002, translation_sd=0.005, rotation=made.rotation, rotation_sd=0.1
    )
    found = solve(GraspPoseFromPoses(made.robot, made.hand, prior=prior))
    assert found.status is Status.SOLVED
    assert np.abs(made.error(found)[3:]).max() < 0.01
    axis = np.array([0.0, 0.6, 0.8])
    assert np.sqrt(axis @ found.covariance[3:, 3:] @ axis) == pytest.approx(0.005, rel=0.2)


# ---- gaps, solvers, results -------------------------------------------------------------------------------


def test_gaps_stay_gaps():
    made = scene(6)
    away = (made.robot.t > 12.0) & (made.robot.t < 15.0)
    q = made.robot.rotation_wxyz.copy()
    q[away] = np.nan
    robot = PoseStream(made.robot.t, made.robot.position, q)
    found = solve(GraspPoseFromPoses(robot, made.hand))
    hidden = (found.diagnostics.t - made.time_offset > 12.0) & (found.diagnostics.t - made.time_offset < 15.0)
    assert not hidden.any()
    assert found.diagnostics.samples_dropped > 60
    assert nees(made.error(found), found.covariance) < 25.0


@pytest.mark.parametrize("name", ["gtsam", "osqp"])
def test_every_solver_finds_the_same(name):
    made = scene(7, duration=12.0)
    reference = solve(GraspPoseFromPoses(made.robot, made.hand))
    other = solve(GraspPoseFromPoses(made.robot, made.hand), solver=name)
    assert other.status is Status.SOLVED
    sd = np.sqrt(np.diag(reference.covariance))
    np.testing.assert_allclose(other.translation, reference.translation, atol=0.02 * sd[3:].max())
    np.testing.assert_allclose(other.covariance, reference.covariance, atol=0.02 * sd.max() ** 2)


def test_result_is_saved_and_summarised(tmp_path: Path):
    made = scene(8, duration=12.0)
    found = solve(GraspPoseFromPoses(made.robot, made.hand))
    text = found.summary()
    assert "time offset hand - robot" in text
    assert "R_r_h" in text
    found.save(tmp_path)
    arrays = np.load(tmp_path / "estimate.npz")
    np.testing.assert_allclose(arrays["translation"], found.translation)
    assert arrays["rotation_residual"].shape == (found.diagnostics.samples_used, 3)
    assert (tmp_path / "estimate.json").read_text().count("world") >= 1


def test_bad_input_is_named():
    made = scene(9, duration=5.0)
    imu = ImuStream(made.hand.t, np.zeros((len(made.hand), 3)) + 0.1, np.zeros((len(made.hand), 3)) + 6.0)
    with pytest.raises(InputError, match="hand: expected a PoseStream"):
        GraspPoseFromPoses(made.robot, imu)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="robot and hand"):
        GraspPoseFromPoses(made.robot, made.hand.shifted(100.0))
    with pytest.raises(InputError, match=r"noise\.rotation_sd"):
        GraspFromPosesNoise(rotation_sd=0.0)
    with pytest.raises(InputError, match=r"estimate\.clusters"):
        GraspFromPosesSettings(clusters=2)
    with pytest.raises(InputError, match=r"estimate\.adapt_noise"):
        GraspFromPosesSettings(adapt_noise="often")  # type: ignore[arg-type]


# ---- covariance of scores ---------------------------------------------------------------------------------


def test_cluster_scores_of_white_noise_are_the_information():
    rng = np.random.default_rng(0)
    prior = np.diag([0.0, 0.0, 4.0])
    ratios = []
    for _ in range(40):
        rows = rng.normal(size=(600, 3)) * np.array([1.0, 100.0, 0.01])
        noise = 2.0 * rng.normal(size=600)
        H = rows.T @ rows + prior
        residual = noise - rows @ np.linalg.solve(H, rows.T @ noise)
        M = cluster_score_covariance(rows, residual, np.arange(600) // 50, prior)
        ratios.append(np.diag(M - prior) / np.diag(rows.T @ rows))
    np.testing.assert_allclose(np.mean(ratios, axis=0), 4.0, rtol=0.12)


def test_cluster_scores_see_errors_that_last():
    rng = np.random.default_rng(1)
    cluster = np.repeat(np.arange(12), 50)
    found, true = [], []
    for _ in range(60):
        rows = np.repeat(rng.normal(size=(12, 2)), 50, axis=0)
        noise = np.repeat(rng.normal(size=12), 50)
        H = rows.T @ rows
        step = np.linalg.solve(H, rows.T @ noise)
        M = cluster_score_covariance(rows, noise - rows @ step, cluster, np.zeros((2, 2)))
        found.append(np.trace(np.linalg.solve(H, M) @ np.linalg.inv(H)))
        true.append(float(step @ step))
    assert 0.8 < np.mean(found) / np.mean(true) < 1.8


def test_information_that_is_noise_is_taken_out():
    rng = np.random.default_rng(2)
    prior = np.diag([0.0, 1.0])
    real = np.column_stack([rng.normal(size=4000), np.zeros(4000)])
    shaken = real + 0.1 * rng.normal(size=real.shape)
    H = shaken.T @ shaken + prior
    noise = 4000 * 0.01 * np.eye(2)
    M = without_noise_information(H, H, prior, noise)
    sd = np.sqrt(np.diag(np.linalg.solve(H, M) @ np.linalg.inv(H)))
    assert sd[0] == pytest.approx(1.0 / np.sqrt(4000.0), rel=0.1)
    assert sd[1] == pytest.approx(1.0, rel=0.05)
    rows = drowned_directions(H, prior, noise)
    assert rows.shape == (1, 2)
    assert abs(rows[0, 1]) > 20.0 * abs(rows[0, 0])
    np.testing.assert_allclose(without_noise_information(H, H, prior, 0.0 * noise), H)


# ---- real recordings --------------------------------------------------------------------------------------


def read(path: Path, name: str) -> PoseStream:
    table = np.genfromtxt(path, delimiter=",", names=True)
    # The Vicon recording holds five stamps twice.
    table = table[np.concatenate([[True], np.diff(table["t"]) > 0.0])]
    columns = [
        np.column_stack([table[c] for c in names]) for names in (("px", "py", "pz"), ("qw", "qx", "qy", "qz"))
    ]
    return PoseStream(table["t"], *columns, name=name)


@pytest.mark.parametrize(
    ("robot_file", "hand_file", "time_offset", "translation", "rms"),
    [
        (
            "robot_arm_fk_base_T_hinge.csv",
            "robot_arm_target_T_camera_ir.csv",
            0.017,
            (-0.7, -19.1, 4.9),
            (0.7, 12.0),
        ),
        (
            "vicon_T_primesense_body.csv",
            "target_T_primesense_camera.csv",
            None,
            (78.9, 44.3, 28.9),
            (2.2, 33.0),
        ),
    ],
)
def test_real_pose_pairs(
    dataset: Callable[[str], Path], robot_file, hand_file, time_offset, translation, rms
):
    folder = dataset("handeye_real")
    robot, hand = read(folder / robot_file, "robot"), read(folder / hand_file, "camera")
    whole = solve(GraspPoseFromPoses(robot, hand))
    assert whole.status is Status.SOLVED
    # An independent estimate (gyro-type rotation, linear least squares) of the same data; its halves differ by 5 to 10 mm.
    np.testing.assert_allclose(1e3 * whole.translation, translation, atol=4.0)
    if time_offset is not None:
        assert whole.time_offset == pytest.approx(time_offset, abs=0.003)
    assert np.degrees(whole.diagnostics.rotation_rms) < rms[0]
    assert 1e3 * whole.diagnostics.position_rms < rms[1]
    middle = 0.5 * (hand.t[0] + hand.t[-1])
    one, two = (
        solve(GraspPoseFromPoses(robot, part))
        for part in (hand.slice(hand.t[0], middle), hand.slice(middle, hand.t[-1]))
    )
    difference = np.concatenate(
        [lie.so3_log(one.rotation.T @ two.rotation), two.translation - one.translation]
    )
    covariance = one.covariance + two.covariance
    assert np.all(np.abs(difference) < 3.0 * np.sqrt(np.diag(covariance)))
    # Not by being vague: half a minute of recording gives the lever arm to a few millimetres.
    assert np.all(np.sqrt(np.diag(whole.covariance))[3:] < 0.004)
    assert np.all(np.sqrt(np.diag(whole.covariance))[:3] < np.radians(0.2))
    spread = np.hypot(one.time_offset_sd, two.time_offset_sd)
    assert abs(two.time_offset - one.time_offset) < 3.0 * spread

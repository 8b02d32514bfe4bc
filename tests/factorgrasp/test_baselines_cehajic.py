from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi

from factorgrasp.baselines.cehajic2015 import (
    CehajicInputs,
    CehajicRecursion,
    batch_cehajic2015,
    estimate_cehajic2015,
)
from factorgrasp.errors import InputError
from factorgrasp.lie import angle_between, project_to_so3, quaternion_wxyz_to_matrix, skew, so3_exp
from factorgrasp.simulation.cehajic2015 import (
    ENCODER_POSES,
    ROUGH_ENCODER_NOISE,
    TRANSLATION,
    XSENS,
    cehajic2015,
    gravity_compensated,
    paper_inputs,
)
from factorgrasp.simulation.cehajic2015_figures import (
    error_curve,
    excitation_gramian,
    final_errors,
    norm_band,
    reproduce_fig4,
)
from factorgrasp.simulation.grasp import HandImu, RobotSensing

NOISE_FREE = {"robot": RobotSensing(), "hand": HandImu()}


def clean_inputs(motion="exciting", duration=5.0) -> CehajicInputs:
    recording = cehajic2015(motion=motion, duration=duration, **NOISE_FREE)
    return paper_inputs(recording, orientation_error=0.0)


def regressors(inputs: CehajicInputs) -> np.ndarray:
    w = skew(inputs.robot_angular_velocity)
    return skew(inputs.robot_angular_acceleration) + w @ w


def test_corrected_recursion_finds_the_grasp_from_clean_data():
    result = estimate_cehajic2015(clean_inputs(duration=20.0))
    assert result.status == "completed"
    R = quaternion_wxyz_to_matrix(result.rotation_wxyz[-1])
    assert angle_between(R, so3_exp((0.0, 0.0, np.pi))) < 1e-6
    np.testing.assert_allclose(result.translation[-1], TRANSLATION, atol=1e-6)
    # The first samples still show the far-off start.
    assert np.linalg.norm(result.translation[0] - TRANSLATION) > 0.1


def test_recursion_equals_weighted_least_squares_in_closed_form():
    inputs = paper_inputs(cehajic2015(seed=3, duration=1.5))
    result = estimate_cehajic2015(inputs)
    n = inputs.t.size
    age = np.arange(n)[::-1]

    keep_q = np.exp(-0.5e-3)
    B = (
        np.einsum("n,ni,nj->ij", keep_q**age, inputs.robot_angular_velocity, inputs.hand_angular_velocity)
        + 2 * keep_q**n * quaternion_wxyz_to_matrix((0.5, 0.5, 0.5, 0.5)) * 0.5
    )
    R = quaternion_wxyz_to_matrix(result.rotation_wxyz)
    assert angle_between(project_to_so3(B), R[-1]) < 1e-9

    keep_r = np.exp(-0.9e-3)
    psi = -regressors(inputs)
    y = inputs.robot_acceleration - np.einsum("nij,nj->ni", R, inputs.hand_acceleration)
    information = np.einsum("n,nji,njk->ik", keep_r**age, psi, psi) + keep_r**n * np.eye(3)
    vector = np.einsum("n,nji,nj->i", keep_r**age, psi, y) + keep_r**n * np.array((0.5, 0.0, 0.0))
    np.testing.assert_allclose(result.translation[-1], np.linalg.solve(information, vector), atol=1e-9)
    assert result.covariance_norm[-1] == pytest.approx(keep_r / np.linalg.eigvalsh(information)[0], rel=2e-3)


def test_batch_is_the_recursion_without_forgetting_and_start():
    # An exact gyroscope and start: the recursion believes one rotation all along, as the batch does.
    hand = HandImu(accelerometer_noise_density=0.002, accelerometer_bias_sd=0.05)
    inputs = paper_inputs(cehajic2015(seed=3, duration=4.0, robot=RobotSensing(), hand=hand))
    result = estimate_cehajic2015(
        inputs,
        rotation_forgetting=0.0,
        translation_forgetting=0.0,
        initial_rotation_wxyz=(0.0, 0.0, 0.0, 1.0),
        initial_covariance=1e9 * np.eye(3),
    )
    R, r = batch_cehajic2015(inputs)
    assert angle_between(R, quaternion_wxyz_to_matrix(result.rotation_wxyz[-1])) < 1e-9
    np.testing.assert_allclose(r, result.translation[-1], atol=1e-7)
    assert np.linalg.norm(r - TRANSLATION) > 1e-3


def test_literal_update_is_what_the_paper_prints():
    rng = np.random.default_rng(1)
    w_r, al_r, a_r, w_h, a_h = rng.normal(size=(5, 3))
    recursion = CehajicRecursion(1e-3, literal=True)
    recursion.update(w_r, al_r, a_r, w_h, a_h)
    d = np.exp(-0.9e-3)
    block = np.outer(w_h, w_r) + np.outer(w_r, w_h) - (w_r @ w_h) * np.eye(3)
    corner = np.cross(w_h, w_r)[:, None]
    davenport = np.block([[block, corner], [corner.T, np.array([[w_r @ w_h]])]])
    q = recursion.rotation_wxyz
    np.testing.assert_allclose(davenport @ q, np.linalg.eigvalsh(davenport)[-1] * q, atol=1e-12)
    eta, eps = q[0], q[1:]
    R = (2 * eta**2 - 1) * np.eye(3) + 2 * skew(eps) + 2 * np.outer(eps, eps)
    phi = skew(al_r) + skew(w_r) @ skew(w_r)
    r0, P0 = np.array((0.5, 0.0, 0.0)), np.eye(3)
    K = P0 @ phi @ np.linalg.inv(d * np.eye(3) - phi @ P0 @ phi)
    np.testing.assert_allclose(recursion.translation, r0 + K @ (a_r - R @ a_h - phi @ r0), atol=1e-12)
    np.testing.assert_allclose(recursion.covariance, (np.eye(3) + K @ phi) @ P0 / d, atol=1e-12)


@pytest.mark.parametrize("motion", ["printed", "exciting"])
def test_literal_formulas_diverge_even_on_clean_data(motion):
    result = estimate_cehajic2015(clean_inputs(motion), literal=True)
    assert result.status == "diverged"
    assert "m" in result.message
    assert np.isfinite(result.translation).all()
    assert np.linalg.norm(result.translation[-1]) > 1e3


def test_forgetting_winds_up_on_the_printed_motion():
    result = estimate_cehajic2015(clean_inputs("printed", duration=20.0))
    # Nothing is learnt about the axis of rotation, so P grows there as exp(mu_r t).
    assert result.covariance_norm[-1] == pytest.approx(np.exp(0.9 * 20.0), rel=1e-3)


def test_recursion_breaks_off_cleanly_and_keeps_its_history():
    inputs = clean_inputs("printed")
    result = estimate_cehajic2015(inputs, translation_forgetting=500.0)
    assert result.status == "diverged"
    assert 10 < result.t.size < inputs.t.size
    assert str(result.t.size) in result.message
    assert result.translation.shape == (result.t.size, 3)
    assert np.isfinite(result.translation).all()
    assert np.isfinite(result.rotation_wxyz).all()
    assert np.isfinite(result.covariance_norm).all()


def test_one_fixed_axis_leaves_the_lever_along_it_at_its_initial_value():
    inputs = clean_inputs("printed", duration=3.0)
    result = estimate_cehajic2015(inputs, initial_rotation_wxyz=(0.0, 0.0, 0.0, 1.0))
    axis = np.array((1.0, 4.0, 2.0)) / np.sqrt(21.0)
    error = result.translation[-1] - TRANSLATION
    missed = np.array((0.5, 0.0, 0.0)) - TRANSLATION
    assert error @ axis == pytest.approx(missed @ axis, abs=1e-3)
    assert abs(missed @ axis) == pytest.approx(0.308, abs=1e-3)
    assert np.linalg.norm(error - (error @ axis) * axis) < 0.01


def test_gravity_compensation_and_its_error():
    recording = cehajic2015(duration=0.5, **NOISE_FREE)
    inputs = paper_inputs(recording, orientation_error=0.0)
    np.testing.assert_allclose(inputs.hand_acceleration, recording.hand_truth.acceleration, atol=1e-11)
    np.testing.assert_allclose(inputs.robot_acceleration, recording.robot_truth.acceleration, atol=1e-11)
    # The paper says that 0.1 degrees cause 1.71 m/s^2; it is a hundredth of that.
    R = so3_exp((np.deg2rad(0.1), 0.0, 0.0))
    left = gravity_compensated(np.array([[0.0, 0.0, 9.81]]), R[None], (0.0, 0.0, -9.81))
    assert np.linalg.norm(left) == pytest.approx(0.0171, abs=1e-4)
    wrong = paper_inputs(recording, orientation_error=np.deg2rad(1.0), seed=2).hand_acceleration
    size = np.linalg.norm(wrong - inputs.hand_acceleration, axis=1)
    assert np.all(size <= 9.80665 * np.deg2rad(1.0) * 1.001)
    assert size.max() > 0.05


def test_inputs_skip_gaps_and_need_rates():
    gappy = cehajic2015(
        duration=5.0, robot=RobotSensing(), hand=HandImu(dropout_fraction=0.2, dropout_length=20.0)
    )
    inputs = paper_inputs(gappy, orientation_error=0.0)
    full = clean_inputs()
    assert 3500 < inputs.t.size < 4700
    rows = np.searchsorted(full.t, inputs.t)
    np.testing.assert_allclose(inputs.hand_acceleration, full.hand_acceleration[rows], atol=1e-3)
    with pytest.raises(InputError, match="MotionStream"):
        paper_inputs(cehajic2015(duration=1.0, robot=ENCODER_POSES))
    with pytest.raises(InputError, match="hand_acceleration"):
        CehajicInputs(*(full.t if k == 0 else np.zeros((full.t.size, 3 + (k == 5))) for k in range(6)))


def test_encoder_noise_shortens_the_lever_by_the_predicted_amount():
    recording = cehajic2015(seed=1, robot=ROUGH_ENCODER_NOISE, hand=HandImu(), duration=60.0)
    inputs = paper_inputs(recording, orientation_error=0.0)
    psi = -regressors(inputs)
    y = inputs.robot_acceleration - inputs.hand_acceleration @ recording.truth.rotation.T
    A, b = np.einsum("nji,njk->ik", psi, psi), np.einsum("nji,nj->i", psi, y)
    bias = np.linalg.solve(A, b) - TRANSLATION
    noise = 2.0 * ROUGH_ENCODER_NOISE.angular_acceleration_sd**2 * np.eye(3)
    G = excitation_gramian(recording.robot_truth) / 60.0
    predicted = -np.linalg.solve(G + noise, noise @ TRANSLATION)
    # The size that the scenario's documentation states.
    assert np.linalg.norm(predicted) == pytest.approx(0.2, abs=0.02)
    # What is left is the scatter of this one run: noise of psi (about 1.1 m away) and of the acceleration, through A.
    left = np.hypot(ROUGH_ENCODER_NOISE.acceleration_sd, 1.12 * ROUGH_ENCODER_NOISE.angular_acceleration_sd)
    scatter = left * np.sqrt(np.diag(np.linalg.inv(A)))
    assert np.all(scatter < 0.003)
    assert np.all(np.abs(bias - predicted) < 4.0 * scatter)


def errors_from_biases(seed: int, duration: float) -> tuple[float, float]:
    """First-order final errors (rad, m) of the two stages from the biases and the gravity error alone."""
    recording = cehajic2015(seed, duration=duration, robot=RobotSensing(), hand=BIASED)
    inputs, truth = paper_inputs(recording, seed=seed), recording.truth
    R, w, t = truth.rotation, recording.robot_truth.angular_velocity, inputs.t
    weight_q, weight_r = np.exp(0.5 * (t - t[-1])), np.exp(0.9 * (t - t[-1]))
    # Stage one minimises |w - exp(theta) (w + R b)|^2: sum (|w|^2 - w w') theta = R b x sum w.
    W = np.cumsum(weight_q[:, None, None] * w[:, :, None] * w[:, None, :], axis=0)
    A = np.trace(W, axis1=1, axis2=2)[:, None, None] * np.eye(3) - W
    pull = np.cross(R @ truth.gyro_bias, np.cumsum(weight_q[:, None] * w, axis=0))
    late = slice(2000, None)
    theta = np.linalg.solve(A[late], pull[late][:, :, None])[:, :, 0]
    # Stage two takes the turned and biased acceleration of the hand for that of the end-effector's other point.
    a_h = recording.hand_truth.acceleration @ R.T
    wrong = inputs.hand_acceleration @ R.T - a_h
    left = -np.cross(theta, a_h[late]) - wrong[late]
    psi = -regressors(inputs)[late]
    N = np.einsum("n,nji,njk->ik", weight_r[late], psi, psi)
    error = np.linalg.solve(N, np.einsum("n,nji,nj->i", weight_r[late], psi, left))
    return float(np.linalg.norm(theta[-1])), float(np.linalg.norm(error))


BIASED = replace(XSENS, gyro_noise_density=0.0, accelerometer_noise_density=0.0)


def test_errors_over_seeds_are_those_of_the_neglected_biases():
    duration, seeds = 12.0, range(2)
    errors = final_errors("exciting", seeds, robot=RobotSensing(), hand=BIASED, duration=duration)
    assert errors.diverged == 0
    predicted = np.array([errors_from_biases(seed, duration) for seed in seeds])
    assert np.all(predicted[:, 1] > 5e-3)
    np.testing.assert_allclose(errors.angle, predicted[:, 0], rtol=0.05)
    np.testing.assert_allclose(errors.translation, predicted[:, 1], rtol=0.05)


def test_band_of_a_norm_is_that_of_the_chi_distribution():
    band = norm_band(np.array([4.0 * np.eye(3), np.diag([0.0, 0.0, 9.0])]))
    np.testing.assert_allclose(band[0], 2.0 * chi(3).ppf([0.025, 0.975]), rtol=0.03)
    # Sampling error of the lower quantile of |N(0, 1)| from 20 000 draws: sqrt(0.025 * 0.975 / 20000) / 0.8 = 0.0014.
    np.testing.assert_allclose(band[1], 3.0 * chi(1).ppf([0.025, 0.975]), rtol=0.02, atol=3.0 * 3.0 * 0.0014)


def test_error_curve_states_where_errors_should_lie():
    recording = cehajic2015(duration=1.0)
    truth, t = recording.truth, np.array((0.2, 0.8))
    covariance = np.array([np.diag([1e-6] * 3 + [1e-4] * 3), np.diag([4e-6] * 3 + [9e-4] * 3)])
    history = (t, np.tile(truth.rotation_wxyz, (2, 1)), np.tile(truth.translation, (2, 1)), covariance)
    curve = error_curve(recording, history)
    # Half the angle, as a quaternion has it; three equal axes.
    np.testing.assert_allclose(
        curve.quaternion_band[:, 1], 0.5 * np.array((1e-3, 2e-3)) * chi(3).ppf(0.975), rtol=0.02
    )
    np.testing.assert_allclose(
        curve.translation_band[:, 1], np.array((0.01, 0.03)) * chi(3).ppf(0.975), rtol=0.02
    )
    assert error_curve(recording, history[:3]).translation_band is None


def test_figure_4_with_another_estimator(tmp_path):
    def oracle(recording):
        t = recording.robot.t[::100]
        n = t.size
        return (
            t,
            -np.tile(recording.truth.rotation_wxyz, (n, 1)),
            np.tile(recording.truth.translation, (n, 1)),
        )

    target = tmp_path / "fig4.png"
    data = reproduce_fig4(target, duration=2.0, extra_curves={"oracle": oracle})
    assert target.stat().st_size > 20000
    assert set(data.curves) == {"printed", "exciting"}
    for motion, curves in data.curves.items():
        assert len(curves) == 3
        # -q is the same rotation as q.
        np.testing.assert_allclose(curves["oracle"].quaternion_norm, 0.0, atol=1e-12)
        np.testing.assert_allclose(curves["oracle"].translation_norm, 0.0, atol=1e-12)
        assert (data.excitation[motion][0] > 1.0) == (motion == "exciting")

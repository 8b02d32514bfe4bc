"""Measures of excitation: closed forms, noise taken out, and the predicted covariance against what the estimator really does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgrasp import lie, solve
from factorgrasp.errors import InputError
from factorgrasp.excitation_measures import (
    excitation_index,
    noise_matrix,
    phi_parts,
    window_measures,
)
from factorgrasp.excitation_prediction import predict_grasp
from factorgrasp.problems import GraspPose
from factorgrasp.problems.grasp_kinematics import RobotKinematics, robot_kinematics
from factorgrasp.problems.grasp_settings import GraspNoise
from factorgrasp.simulation.cehajic2015 import ENCODER_NOISE, ROUGH_ENCODER_NOISE, XSENS, cehajic2015
from factorgrasp.simulation.grasp import RobotSensing
from factorgrasp.typing import FloatArray
from factorgrasp.uncertainty import nees_band

GRAVITY = np.array([0.0, 0.0, -9.80665])


def coning(
    amplitude: float, rate: float, seconds: float, step: float = 1e-3
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angular velocity and acceleration of ``rho = A (u cos wt + v sin wt)`` for small A (body frame, first order)."""
    t = np.arange(round(seconds / step) + 1) * step
    c, s, zero = np.cos(rate * t), np.sin(rate * t), np.zeros_like(t)
    w = amplitude * rate * np.stack([-s, c, zero], axis=1)
    return t, w, -amplitude * rate**2 * np.stack([c, s, zero], axis=1)


def test_coning_has_the_closed_form() -> None:
    amplitude, rate = 1e-3, 2.0 * np.pi
    t, w, al = coning(amplitude, rate, 6.0)
    found = window_measures(t, w, al, 3.0, centred=False)
    np.testing.assert_allclose(found.lambda_min, 3.0 * rate**4 * amplitude**2 / 2.0, rtol=1e-4)
    # al turns in a plane: what is perpendicular to it is seen twice as well.
    np.testing.assert_allclose(found.eigenvalues[:, 2], 3.0 * rate**4 * amplitude**2, rtol=1e-4)
    np.testing.assert_allclose(found.condition, 2.0, rtol=1e-4)
    np.testing.assert_allclose(found.log_det, np.log(found.eigenvalues).sum(axis=1))


def test_index_is_the_determinant() -> None:
    w, al = np.random.default_rng(0).standard_normal((2, 50, 3))
    phi = phi_parts(w, al)
    np.testing.assert_allclose(excitation_index(w, al), np.linalg.det(phi), atol=1e-12)
    r = np.array([0.3, -0.2, 0.7])
    np.testing.assert_allclose(phi @ r, np.cross(al, r) + np.cross(w, np.cross(w, r)), atol=1e-12)


def test_one_axis_shows_nothing_along_it() -> None:
    axis = np.array([10.0, 40.0, 20.0]) / np.linalg.norm([10.0, 40.0, 20.0])
    t = np.arange(0.0, 20.0, 2e-3)
    w, al = 0.8 * np.sin(t)[:, None] * axis, 0.8 * np.cos(t)[:, None] * axis
    found = window_measures(t, w, al, 2.0 * np.pi)
    assert np.max(np.abs(found.lambda_min)) < 1e-12
    assert np.all(np.isinf(found.condition))
    assert np.all(np.isneginf(found.log_det))
    np.testing.assert_allclose(found.weakest, np.tile(axis, (len(found.weakest), 1)), atol=1e-6)
    assert not found.meets(1e-6)
    np.testing.assert_allclose(excitation_index(w, al), 0.0, atol=1e-20)


def test_centred_matrix_takes_out_what_a_bias_explains() -> None:
    rng = np.random.default_rng(1)
    t, w, al = coning(0.2, 3.0, 8.0)
    al = al + rng.standard_normal(3)
    centred = window_measures(t, w, al, 8.0)
    weight = np.full(t.size, 1e-3)
    weight[[0, -1]] *= 0.5
    phi = phi_parts(w, al)
    mean = np.einsum("n,nij->ij", weight, phi) / 8.0
    direct = np.einsum("n,nji,njk->ik", weight, phi - mean, phi - mean)
    np.testing.assert_allclose(centred.matrix[0], direct, rtol=1e-9)


@pytest.mark.parametrize("size", [0.05, 0.5])
def test_noise_is_taken_out(size: float) -> None:
    rng = np.random.default_rng(2)
    t, w, al = coning(0.05, 4.0, 60.0)
    exact = window_measures(t, w, al, 60.0).eigenvalues[0]
    noisy = w + 0.1 * size * rng.standard_normal(w.shape), al + size * rng.standard_normal(al.shape)
    expected = noise_matrix(w, (0.1 * size) ** 2, size**2)
    found = window_measures(t, *noisy, 60.0, noise=expected)
    np.testing.assert_allclose(found.eigenvalues[0], exact, rtol=0.02, atol=60.0 * size**2 * 0.03)
    assert found.noise == pytest.approx(60.0 * 2.0 * size**2, rel=0.02)


def test_a_gap_counts_as_no_excitation() -> None:
    t, w, al = coning(0.1, 5.0, 4.0)
    whole = window_measures(t, w, al, 2.0, centred=False).eigenvalues.sum(axis=1)
    w[1000:1200] = np.nan
    found = window_measures(t, w, al, 2.0, centred=False).eigenvalues.sum(axis=1)
    # A tenth of the first windows is missing; the last ones do not touch the gap.
    np.testing.assert_allclose(found[500:900] / whole[500:900], 0.9, rtol=2e-3)
    np.testing.assert_allclose(found[1300:], whole[1300:])
    w[:] = np.nan
    with pytest.raises(InputError, match="gaps only"):
        window_measures(t, w, al, 1.0)


def _quiet(sensing: RobotSensing) -> RobotSensing:
    return replace(sensing, angular_velocity_sd=0.0, angular_acceleration_sd=0.0, acceleration_sd=0.0)


def _noise(sensing: RobotSensing) -> GraspNoise:
    root = sensing.rate**-0.5
    return GraspNoise(
        gyro_density=XSENS.gyro_noise_density,
        accelerometer_density=XSENS.accelerometer_noise_density,
        robot_angular_velocity_density=sensing.angular_velocity_sd * root,
        robot_angular_acceleration_density=sensing.angular_acceleration_sd * root,
        robot_acceleration_density=sensing.acceleration_sd * root,
    )


@pytest.mark.parametrize("sensing", [ENCODER_NOISE, ROUGH_ENCODER_NOISE], ids=["fine", "rough"])
def test_predicted_covariance_is_the_scatter_of_the_estimates(sensing: RobotSensing) -> None:
    noise, runs, seconds, hand = _noise(sensing), 24, 12.0, replace(XSENS, rate=200.0)
    plan = cehajic2015(0, duration=seconds, robot=_quiet(sensing), hand=hand)
    motion = robot_kinematics(plan.robot, noise, GRAVITY, 40.0)
    P = predict_grasp(motion, plan.truth.rotation, plan.truth.translation, noise).grasp_covariance
    total, stated = 0.0, []
    for seed in range(runs):
        recording = cehajic2015(seed, duration=seconds, robot=sensing, hand=hand)
        estimate = solve(GraspPose(recording.robot, recording.hand, noise))
        error = np.concatenate(
            [
                lie.so3_log(estimate.rotation.T @ plan.truth.rotation),
                plan.truth.translation - estimate.translation,
            ]
        )
        total += float(error @ np.linalg.solve(P, error)) / runs
        stated.append(np.diag(estimate.covariance))
    low, high = nees_band(6, runs, 0.99)
    assert low < total / 6.0 < high
    np.testing.assert_allclose(np.sqrt(np.diag(P)), np.sqrt(np.median(stated, axis=0)), rtol=0.12)


def test_recorded_and_planned_motion_predict_the_same() -> None:
    """The noise within a recording is no excitation."""
    hand, sensing = replace(XSENS, rate=200.0), ROUGH_ENCODER_NOISE
    noise = _noise(sensing)
    truth = cehajic2015(0, duration=2.0, hand=hand).truth
    predictions = []
    for robot, noisy in ((_quiet(sensing), False), (sensing, True)):
        recording = cehajic2015(3, duration=15.0, robot=robot, hand=hand)
        motion = robot_kinematics(recording.robot, noise, GRAVITY, 40.0)
        contained = motion.noise if noisy else None
        predictions.append(
            predict_grasp(motion, truth.rotation, truth.translation, noise, contained=contained)
        )
    np.testing.assert_allclose(predictions[0].sd, predictions[1].sd, rtol=0.05)


def test_prediction_names_what_the_motion_does_not_show() -> None:
    recording = cehajic2015(0, motion="printed", duration=15.0, robot=_quiet(ENCODER_NOISE))
    motion = robot_kinematics(recording.robot, _noise(ENCODER_NOISE), GRAVITY, 40.0)
    predicted = predict_grasp(motion, recording.truth.rotation, recording.truth.translation)
    (missing,) = predicted.observability.missing
    assert "lever arm along end-effector axis (0.22, 0.87, 0.44), which is the rotation axis" in missing.words
    # No worse than what was known before.
    assert missing.sd == pytest.approx(3.0, rel=1e-3)
    assert "second axis" in predicted.observability.advice
    assert np.isnan(predicted.seconds_to(0.01, 0.01))


def test_predicted_sd_falls_with_time() -> None:
    recording = cehajic2015(0, duration=30.0, robot=_quiet(ENCODER_NOISE), hand=replace(XSENS, rate=200.0))
    motion = robot_kinematics(recording.robot, _noise(ENCODER_NOISE), GRAVITY, 40.0)
    predicted = predict_grasp(motion, recording.truth.rotation, recording.truth.translation)
    falling = predicted.worst_sd_over_time
    assert np.all(np.diff(falling, axis=0) <= 1e-9)
    after = predicted.seconds_to(*(1.5 * falling[-1]))
    assert 5.0 < after < 30.0


def test_motion_must_last_two_windows() -> None:
    t = np.arange(20) * 0.01
    zero = np.zeros((20, 3))
    motion = RobotKinematics(t, zero, zero, zero + GRAVITY, None, lambda f: None, np.inf)  # type: ignore[arg-type, return-value]
    motion.angular_velocity[5:] = np.nan
    with pytest.raises(InputError, match="two windows"):
        predict_grasp(motion, np.eye(3), np.zeros(3))

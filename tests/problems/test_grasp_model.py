"""The coupling model and its windows against finite differences, closed forms and exact signals."""

from __future__ import annotations

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.problems.grasp_global import lifted_residuals, rotation_cost
from factorgrasp.problems.grasp_model import GraspModel, phi_information, phi_matrix, quadratic_forms
from factorgrasp.problems.grasp_noise import noise_moments
from factorgrasp.problems.grasp_recording import tilt_axes, vech_products
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.problems.grasp_system import floored_inverse, grasp_variables, positive_part, prior_precision
from factorgrasp.problems.grasp_windows import Windowing, compress, finite_windows, stretches


def random_state(model: GraspModel, rng: np.random.Generator) -> dict[str, np.ndarray]:
    state = {v.name: 0.1 * rng.standard_normal(v.size) for v in model.variables}
    state["rotation"] = lie.so3_exp(rng.standard_normal(3))
    state["translation"] = rng.standard_normal(3)
    return state


@pytest.fixture(params=[False, True], ids=["level", "tilt"])
def model(request):
    return GraspModel(*grasp_variables(GraspNoise(), GraspSettings(base_tilt=request.param)))


def test_jacobians_match_central_differences(model, rng):
    state = random_state(model, rng)
    exact = model.jacobians(state)
    h = 1e-6
    for k in range(model.size):
        step = np.zeros(model.size)
        step[k] = h

        def moved(sign, step=step):
            at = {
                v.name: v.retract(state[v.name], sign * step[model.columns[v.name]]) for v in model.variables
            }
            return model.matrices(at)

        for ahead, behind, jacobian in zip(moved(1.0), moved(-1.0), exact, strict=True):
            np.testing.assert_allclose(jacobian[k], (ahead - behind) / (2 * h), atol=1e-8)


def test_residuals_vanish_on_exact_rigid_motion(model, rng):
    """Signals of a rigid body from first principles, sensor errors included: L z = 0 for every sample."""
    state = random_state(model, rng)
    # Without the second-order product of offset and curvature the model is exact only at zero offset.
    for name in ("time_offset", "accelerometer_delay"):
        state[name] = np.zeros(1)
    r = state["translation"]
    n = 20
    w, al, a_r = rng.standard_normal((3, n, 3))
    R_w_r = lie.so3_exp(rng.standard_normal((n, 3)))
    gravity = np.array([0.0, 0.0, -9.80665])
    tilt = state.get("base_tilt", np.zeros(2))
    axes = tilt_axes(gravity)
    true_gravity = gravity + axes @ tilt
    assumed_force = a_r - gravity @ R_w_r
    true_force = a_r - true_gravity @ R_w_r
    at_hand = true_force + np.cross(al, r) + np.cross(w, np.cross(w, r))
    M_g, M_a = model.sensor_matrices(state)
    w_h = w @ np.linalg.inv(M_g).T + state["gyro_bias"]
    f_h = at_hand @ np.linalg.inv(M_a).T + state["accelerometer_bias"]
    one, zero = np.ones((n, 1)), np.zeros((n, 3))
    z_g = np.hstack([w, w_h, zero, one])
    parts = [assumed_force, al, vech_products(w), f_h, zero, one]
    if "base_tilt" in state:
        parts += [axes[:, i] @ R_w_r for i in (0, 1)]
    L_g, L_a = model.matrices(state)
    np.testing.assert_allclose(z_g @ L_g.T, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.hstack(parts) @ L_a.T, 0.0, atol=1e-11)


def test_quadratic_forms_are_sums_over_samples(model, rng):
    state = random_state(model, rng)
    z = rng.standard_normal((50, 10))
    L, J = model.matrices(state)[0], model.jacobians(state)[0]
    value, gradient, matrix = quadratic_forms(L, J, z.T @ z)
    e, Je = z @ L.T, np.einsum("nij,sj->sin", J, z)
    assert value == pytest.approx(0.5 * np.sum(e**2))
    np.testing.assert_allclose(gradient, np.einsum("sin,si->n", Je, e))
    np.testing.assert_allclose(matrix, np.einsum("sin,sim->nm", Je, Je), atol=1e-12)


def test_phi_information_is_the_regressor_gramian(rng):
    w, al = rng.standard_normal((2, 30, 3))
    z = np.hstack([np.zeros((30, 3)), al, vech_products(w)])
    phi = lie.skew(al) + lie.skew(w) @ lie.skew(w)
    np.testing.assert_allclose(phi_information(z.T @ z), np.einsum("nji,njk->ik", phi, phi))
    r = rng.standard_normal(3)
    np.testing.assert_allclose(z @ phi_matrix(r).T, phi @ r, atol=1e-12)
    # det phi = -|w x al|^2 (mathematics 2.2): the pointwise excitation index.
    np.testing.assert_allclose(np.linalg.det(phi), -np.sum(np.cross(w, al) ** 2, axis=1), rtol=1e-9)


def test_windows_are_a_tight_frame_with_calibrated_noise(rng):
    windowing = Windowing(step=0.01, length=100, bins=51)
    x = rng.standard_normal((20_000, 2))
    c = windowing.transform(x)
    # Away from the ends the coefficients hold the energy of the signal. The Nyquist bin has no sine.
    inner = x[50:-50]
    assert np.sum(c**2) == pytest.approx(np.sum(inner**2), rel=0.02)
    power = np.sum(c**2, axis=(0, 2)) / c.shape[0]
    np.testing.assert_allclose(power[:-1], windowing.dof[:-1, None] * np.ones(2), rtol=0.2)


def test_a_relation_between_entries_survives_windowing(rng):
    windowing = Windowing(step=0.005, length=200, bins=21)
    x = np.cumsum(rng.standard_normal((3000, 3)), axis=0)
    z = np.hstack([x, x @ rng.standard_normal((3, 2)), np.ones((3000, 1))])
    relation = np.linalg.svd(z - 0.0)[2][-2:]
    np.testing.assert_allclose(windowing.transform(z) @ relation.T, 0.0, atol=1e-9)
    np.testing.assert_allclose(
        windowing.transform(np.ones((400, 1)))[0, :, :, 0], windowing.constant(), atol=1e-12
    )


def test_a_gap_drops_just_the_windows_that_touch_it(rng):
    windowing = Windowing(step=0.01, length=100, bins=11)
    x = rng.standard_normal((1000, 2))
    x[333, 1] = np.nan
    good = finite_windows(windowing.transform(x))
    starts = 50 * np.arange(good.size)
    touched = (starts <= 333) & (starts + 100 > 333)
    np.testing.assert_array_equal(good, ~touched)


def test_compression_is_exact_whatever_the_stretches(rng):
    windowing = Windowing(step=0.01, length=20, bins=5)
    g, a = rng.standard_normal((40, 5, 2, 10)), rng.standard_normal((40, 5, 2, 19))
    weights = rng.uniform(0.1, 1.0, 40)
    one = compress(windowing, g, a, stretches(40, 1), weights)
    many = compress(windowing, g, a, stretches(40, 12), weights)
    direct = np.einsum("f,fksi,fksj->kij", weights, a, a)
    np.testing.assert_allclose(one.accelerometer[0], direct, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(many.accelerometer.sum(axis=0), direct, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        many.gyro_squared.sum(axis=0), np.einsum("f,fksi,fksj->kij", weights**2, g, g), rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(one.dof[0], weights.sum() * windowing.dof)
    half = many.scaled(0.5)
    np.testing.assert_allclose(half.gyro_squared, 0.25 * many.gyro_squared)
    np.testing.assert_allclose(half.dof, 0.5 * many.dof)


def test_expected_noise_moments_match_sampled_noise(rng):
    """Noise added to true signals moves the moments by what `noise_moments` predicts."""
    from factorgrasp.problems.grasp_kinematics import RobotNoise

    windowing = Windowing(step=0.01, length=100, bins=6)
    n = 60_000
    t = 0.01 * np.arange(n)
    w = np.column_stack([np.sin(0.3 * t), np.cos(0.5 * t), 0.5 * np.sin(0.2 * t)])
    sd_w, sd_al = 0.05, 0.2
    noisy_w, noise_al = w + sd_w * rng.standard_normal((n, 3)), sd_al * rng.standard_normal((n, 3))
    difference = np.hstack([np.zeros((n, 3)), noise_al, vech_products(noisy_w) - vech_products(w)])
    c = windowing.transform(difference)
    measured = np.einsum("fksi,fksj->kij", c, c) / (c.shape[0] * windowing.dof[:, None, None])
    flat = np.ones(6)
    expected = noise_moments(
        RobotNoise(sd_w**2 * 0.01 * flat, sd_al**2 * 0.01 * flat, 0.0 * flat, 0.0 * flat),
        GraspNoise(),
        windowing,
        np.zeros(3),
        w.T @ w / n,
        19,
    ).accelerometer
    measured = measured[1:]  # bin 0 also holds the mean of the squared noise
    np.testing.assert_allclose(measured[:, 3:6, 3:6], expected[1:, 3:6, 3:6], atol=0.15 * sd_al**2)
    np.testing.assert_allclose(measured[:, 6:12, 6:12], expected[1:, 6:12, 6:12], atol=0.3 * sd_w**2)


def test_positive_part_is_the_nearest_and_keeps_what_is_positive(rng):
    A = rng.standard_normal((8, 8))
    Z = A @ A.T
    root = positive_part(Z)
    np.testing.assert_allclose(root @ root.T, Z, atol=1e-10)
    root = positive_part(Z - 3.0 * np.outer(A[0], A[0]))
    assert np.all(np.isfinite(root))
    assert np.linalg.eigvalsh(root @ root.T)[0] > -1e-9
    assert not np.any(positive_part(np.zeros((3, 3))))


def test_floored_inverse_inverts_and_survives_nothing(rng):
    A = rng.standard_normal((6, 6)) * np.logspace(-4, 4, 6)
    H = A.T @ A
    np.testing.assert_allclose(floored_inverse(H) @ H, np.eye(6), atol=1e-4)
    H[0], H[:, 0] = 0.0, 0.0
    assert floored_inverse(H)[0, 0] > 1e10


def test_rotation_cost_is_the_profile_of_the_full_cost(model, rng):
    """x'Qx equals twice the cost with every other linear unknown at its best, for any rotation."""
    state = random_state(model, rng)
    A, B = rng.standard_normal((40, 10)), rng.standard_normal((60, model.accelerometer_width))
    Z_g, Z_a = A.T @ A, B.T @ B
    noise, prior = GraspNoise(), GraspPrior(translation=np.array([0.3, -0.2, 0.5]))
    precision = prior_precision(model, noise, prior)
    precision[model.columns["rotation"]] = 0.0
    Q = rotation_cost(model, state, Z_g, Z_a, precision, prior)
    B_g, B_a = lifted_residuals(model, state)
    for _ in range(3):
        R = lie.so3_exp(rng.standard_normal(3))
        x = np.append(R.T.ravel(), 1.0)
        size = B_g.shape[2]
        free = [*range(9, size - 1)]
        G = np.einsum("imk,mn,inl->kl", B_g, Z_g, B_g) + np.einsum("imk,mn,inl->kl", B_a, Z_a, B_a)
        weight = np.zeros(size)
        weight[9:12] = precision[model.columns["translation"]]
        weight[12:15] = precision[model.columns["gyro_bias"]]
        weight[15:18] = precision[model.columns["accelerometer_bias"]]
        if "base_tilt" in model.columns:
            weight[18:20] = precision[model.columns["base_tilt"]]
        centre = np.zeros(size)
        centre[9:12] = prior.translation

        def cost(y, G=G, weight=weight, centre=centre):
            return y @ G @ y + np.sum(weight * (y - centre) ** 2)

        y = np.zeros(size)
        y[:9], y[-1] = x[:9], 1.0
        lhs = G[np.ix_(free, free)] + np.diag(weight[free])
        y[free] = np.linalg.solve(lhs, -(G @ y)[free] + weight[free] * centre[free])
        assert x @ Q @ x == pytest.approx(cost(y), rel=1e-9)

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import savgol_filter

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.signals import (
    choose_savgol,
    differentiate_rotations,
    estimate_lag,
    resample_rotations,
    resample_uniform,
    rotation_noise_sd,
    savgol_bandwidth,
    savgol_derivatives,
    savgol_frequency_response,
    savgol_noise_gain,
    white_noise_sd,
)

DT = 1e-3


def coning(t, amplitude, rate):
    """Rotation, body rate and body acceleration of a cone: rotation vector ``A (cos, sin, 0)``, in closed form."""
    c, s, zero = np.cos(rate * t), np.sin(rate * t), np.zeros_like(t)
    R = lie.so3_exp(amplitude * np.stack([c, s, zero], axis=1))
    # w = J_r(phi) dphi/dt with dphi/dt perpendicular to phi.
    across, along = rate * np.sin(amplitude), -rate * (1.0 - np.cos(amplitude))
    w = np.stack([-across * s, across * c, np.full_like(t, along)], axis=1)
    al = rate * across * np.stack([-c, -s, zero], axis=1)
    return R, w, al


# ------------------------------------------------------------------------------------------ Savitzky-Golay


@pytest.mark.parametrize(
    ("window", "order", "deriv"), [(5, 2, 0), (11, 3, 1), (21, 4, 2), (41, 3, 2), (7, 6, 3)]
)
def test_savgol_agrees_with_scipy_inside(rng, window, order, deriv):
    x = rng.normal(size=(300, 3))
    ours = savgol_derivatives(x, 0.01, window, order, deriv)
    theirs = savgol_filter(x, window, order, deriv=deriv, delta=0.01, axis=0)
    half = window // 2
    scale = np.abs(theirs).max()
    np.testing.assert_allclose(ours[half:-half], theirs[half:-half], atol=1e-11 * scale)
    assert np.isnan(ours[:half]).all()
    assert np.isnan(ours[-half:]).all()


def test_savgol_is_exact_for_polynomials_of_its_order():
    t = np.arange(100) * 0.02
    polynomial = np.polynomial.Polynomial([3.0, -1.0, 0.5, 2.0])
    for deriv in range(4):
        ours = savgol_derivatives(polynomial(t), 0.02, 9, 3, deriv)
        exact = polynomial.deriv(deriv)(t) if deriv else polynomial(t)
        np.testing.assert_allclose(ours[4:-4], exact[4:-4], rtol=1e-9, atol=1e-9)


def test_savgol_gap_spreads_by_half_a_window_and_no_further(rng):
    x = rng.normal(size=(200, 2))
    whole = savgol_derivatives(x, DT, 11, 3, 1)
    broken = x.copy()
    broken[100, 1] = np.nan
    ours = savgol_derivatives(broken, DT, 11, 3, 1)
    np.testing.assert_array_equal(ours[:, 0], whole[:, 0])
    assert np.isnan(ours[95:106, 1]).all()
    np.testing.assert_array_equal(
        np.delete(ours[:, 1], slice(95, 106)), np.delete(whole[:, 1], slice(95, 106))
    )


def test_savgol_of_one_channel_keeps_its_shape(rng):
    x = rng.normal(size=50)
    ours = savgol_derivatives(x, DT, 7, 2, 1)
    np.testing.assert_array_equal(ours, savgol_derivatives(x[:, None], DT, 7, 2, 1)[:, 0])


@pytest.mark.parametrize(("deriv", "f"), [(0, 7.0), (0, 130.0), (1, 7.0), (1, 60.0), (2, 7.0), (2, 200.0)])
def test_frequency_response_is_what_a_sinusoid_sees(deriv, f):
    t = np.arange(2000) * DT
    phase = 0.4
    out = savgol_derivatives(np.cos(2 * np.pi * f * t + phase), DT, 25, 4, deriv)
    gain = savgol_frequency_response(25, 4, deriv, DT, f)
    expected = np.real(gain * np.exp(1j * (2 * np.pi * f * t + phase)))
    np.testing.assert_allclose(out[12:-12], expected[12:-12], atol=1e-10 * max(1.0, abs(gain)))


def test_frequency_response_tends_to_the_ideal_derivative():
    f = np.array([0.1, 1.0])
    for deriv in (0, 1, 2):
        gain = savgol_frequency_response(31, 4, deriv, DT, f)
        np.testing.assert_allclose(gain, (2j * np.pi * f) ** deriv, rtol=1e-3)


@pytest.mark.parametrize(("window", "order", "deriv"), [(21, 3, 0), (21, 3, 1), (31, 4, 2)])
def test_noise_gain_is_the_variance_of_filtered_white_noise(rng, window, order, deriv):
    sigma = 0.3
    out = savgol_derivatives(sigma * rng.normal(size=(400_000,)), DT, window, order, deriv)
    # Independent samples only: one from each window.
    independent = out[window::window]
    independent = independent[np.isfinite(independent)]
    ratio = np.mean(independent**2) / (sigma**2 * savgol_noise_gain(window, order, deriv, DT))
    # Five standard deviations of a chi-square mean.
    assert abs(ratio - 1.0) < 5.0 * np.sqrt(2.0 / independent.size)


def test_noise_gain_is_the_integral_of_the_response():
    f = np.linspace(-0.5 / DT, 0.5 / DT, 4001)[:-1]
    for deriv in (0, 1, 2):
        power = np.mean(np.abs(savgol_frequency_response(31, 4, deriv, DT, f)) ** 2)
        assert savgol_noise_gain(31, 4, deriv, DT) == pytest.approx(power, rel=1e-10)


@pytest.mark.parametrize("deriv", [0, 1, 2])
def test_bandwidth_is_the_first_half_power_point(deriv):
    window, order = 41, 3
    band = savgol_bandwidth(window, order, DT, deriv)
    f = np.linspace(0.05, band * 0.999, 500)
    relative = np.abs(savgol_frequency_response(window, order, deriv, DT, f)) / (2 * np.pi * f) ** deriv
    assert (relative > np.sqrt(0.5)).all()
    at = np.abs(savgol_frequency_response(window, order, deriv, DT, band)) / (2 * np.pi * band) ** deriv
    assert at == pytest.approx(np.sqrt(0.5), rel=1e-9)


def test_bandwidth_of_an_interpolating_filter_is_half_the_rate():
    assert savgol_bandwidth(5, 4, DT) == 500.0


def test_bandwidth_matches_the_published_approximation():
    # Schafer 2011: f_c / f_N = (order + 1) / (3.2 half - 4.6), within a few percent for half >= 25.
    half, order = 40, 4
    approximate = (order + 1) / (3.2 * half - 4.6) * 0.5 / DT
    assert savgol_bandwidth(2 * half + 1, order, DT) == pytest.approx(approximate, rel=0.04)


@pytest.mark.parametrize(
    ("band", "dt", "order", "deriv"), [(20, 1e-3, 3, 0), (6, 5e-3, 2, 0), (40, 1e-3, 4, 2), (90, 5e-3, 4, 0)]
)
def test_chosen_window_is_the_longest_that_passes_the_band(band, dt, order, deriv):
    window = choose_savgol(band, dt, order, deriv)
    assert window % 2 == 1
    assert savgol_bandwidth(window, order, dt, deriv) >= band
    for longer in range(window + 2, window + 12, 2):
        assert savgol_bandwidth(longer, order, dt, deriv) < band


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: savgol_derivatives(np.zeros(50), DT, 10, 3, 1), "window"),
        (lambda: savgol_derivatives(np.zeros(50), DT, 11, 11, 1), "order"),
        (lambda: savgol_derivatives(np.zeros(50), DT, 11, 2, 3), "deriv"),
        (lambda: savgol_derivatives(np.zeros(50), 0.0, 11, 3, 1), "dt"),
        (lambda: savgol_derivatives(np.zeros(10), DT, 11, 3, 1), "x"),
        (lambda: savgol_derivatives(np.zeros((20, 2, 2)), DT, 11, 3, 1), "x"),
        (lambda: choose_savgol(600.0, DT, 3), "bandwidth_hz"),
        (lambda: choose_savgol(0.0, DT, 3), "bandwidth_hz"),
    ],
)
def test_savgol_settings_that_cannot_be(call, field):
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.field == field


# ------------------------------------------------------------------------------------------ rotations


@pytest.mark.parametrize(
    ("amplitude", "rate", "dt", "window"),
    [(0.5, 10.0, 1e-3, 21), (1.5, 30.0, 1e-3, 21), (1.0, 10.0, 5e-3, 7)],
)
@pytest.mark.parametrize("order", [2, 3, 4])
def test_coning_rates_are_the_filtered_true_rates(amplitude, rate, dt, window, order):
    """At any amplitude the only error is the filter's own gain, which is known; |w| is up to 41 rad/s here."""
    t = np.arange(800) * dt
    R, w, al = coning(t, amplitude, rate)
    out = differentiate_rotations(R, dt, window, order)
    f = rate / (2 * np.pi)
    gain_w = savgol_frequency_response(window, order, 1, dt, f) / (1j * rate)
    gain_al = savgol_frequency_response(window, order, 2, dt, f) / (1j * rate) ** 2
    inside = slice(window, -window)
    # What is left is the Magnus expansion's remainder, of relative order (w dt)^4.
    step = (np.linalg.norm(w, axis=1).max() * dt) ** 4 + 1e-10
    expected_w = w * [gain_w.real, gain_w.real, 1.0]
    np.testing.assert_allclose(out.angular_velocity[inside], expected_w[inside], atol=0.05 * step * rate)
    np.testing.assert_allclose(
        out.angular_acceleration[inside], (gain_al.real * al)[inside], atol=0.05 * step * rate**2 + 1e-8
    )
    smoothing = abs(1.0 - savgol_frequency_response(window, order, 0, dt, f).real)
    assert lie.angle_between(out.rotation, R)[inside].max() < 2.0 * amplitude * smoothing + step


def test_coning_term_matters():
    """Without it the rate would be off by dt^2 / 12 |w x dw/dt|: the test above must be able to fail."""
    dt = 5e-3
    t = np.arange(400) * dt
    R, w, al = coning(t, 1.0, 10.0)
    naive = lie.so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / dt
    middle = coning(t[:-1] + dt / 2, 1.0, 10.0)[1]
    bias = (naive - middle)[:, 2]
    predicted = dt**2 / 12 * np.cross(w, al)[0, 2]
    np.testing.assert_allclose(bias, predicted, rtol=1e-2)
    ours = differentiate_rotations(R, dt, 5, 4).angular_velocity[10:-10, 2]
    assert np.abs(ours - w[0, 2]).max() < 1e-2 * abs(predicted)


def test_constant_rate_is_exact_with_full_turns(rng):
    w = np.array([3.0, -20.0, 11.0])
    t = np.arange(3000) * DT
    R = lie.so3_exp(rng.normal(size=3)) @ lie.so3_exp(t[:, None] * w)
    out = differentiate_rotations(R, DT, 31, 3)
    inside = slice(15, -15)
    np.testing.assert_allclose(out.angular_velocity[inside], np.broadcast_to(w, (2970, 3)), atol=1e-10)
    np.testing.assert_allclose(out.angular_acceleration[inside], 0.0, atol=1e-7)
    assert lie.angle_between(out.rotation, R)[inside].max() < 1e-12


def test_planar_rotation_equals_differentiating_the_angle():
    t = np.arange(600) * DT
    angle = 2.0 * np.sin(7.0 * t) + t**3
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    out = differentiate_rotations(lie.so3_exp(angle[:, None] * axis), DT, 21, 3)
    for deriv, ours in ((1, out.angular_velocity), (2, out.angular_acceleration)):
        expected = savgol_derivatives(angle, DT, 21, 3, deriv)
        np.testing.assert_allclose(ours, expected[:, None] * axis, atol=1e-7, equal_nan=True)
    smooth = savgol_derivatives(angle, DT, 21, 3, 0)[10:-10]
    assert lie.angle_between(out.rotation[10:-10], lie.so3_exp(smooth[:, None] * axis)).max() < 1e-12


def test_quaternions_in_quaternions_out(rng):
    t = np.arange(300) * DT
    R, _, _ = coning(t, 1.0, 20.0)
    q = lie.matrix_to_quaternion_wxyz(R, continuous=True)
    q *= rng.choice([-1.0, 1.0], size=(300, 1))  # either sign is the same rotation
    a, b = differentiate_rotations(R, DT, 11, 3), differentiate_rotations(q, DT, 11, 3)
    assert b.rotation.shape == (300, 4)
    np.testing.assert_allclose(a.angular_velocity, b.angular_velocity, atol=1e-9, equal_nan=True)
    np.testing.assert_allclose(a.rotation[5:-5], lie.quaternion_wxyz_to_matrix(b.rotation[5:-5]), atol=1e-12)


def test_rotation_gaps_spread_by_half_a_window():
    t = np.arange(300) * DT
    R, _, _ = coning(t, 1.0, 20.0)
    whole = differentiate_rotations(R, DT, 11, 3)
    broken = R.copy()
    broken[100:103] = np.nan
    out = differentiate_rotations(broken, DT, 11, 3)
    lost = slice(95, 108)
    for ours, theirs in zip(out, whole, strict=True):
        assert np.isnan(ours[lost]).all()
        kept_ours, kept_theirs = np.delete(ours, lost, axis=0), np.delete(theirs, lost, axis=0)
        assert np.isnan(kept_ours[:5]).all()
        assert np.isfinite(kept_ours[5:-5]).all()
        np.testing.assert_allclose(kept_ours[5:-5], kept_theirs[5:-5], rtol=1e-6, atol=1e-5)


def test_rotation_noise_follows_the_noise_gain(rng):
    """White attitude noise through the filter: the propagated variances hold while the body moves."""
    sigma, window, order = 1e-3, 31, 3
    t = np.arange(30_000) * DT
    R, _, _ = coning(t, 0.8, 6.0)
    noisy = R @ lie.so3_exp(sigma * rng.normal(size=(t.size, 3)))
    clean, out = (differentiate_rotations(M, DT, window, order) for M in (R, noisy))
    errors = (
        lie.so3_log(np.swapaxes(clean.rotation, 1, 2) @ out.rotation),
        out.angular_velocity - clean.angular_velocity,
        out.angular_acceleration - clean.angular_acceleration,
    )
    for deriv, error in enumerate(errors):
        independent = error[window::window]
        independent = independent[np.isfinite(independent).all(axis=1)]
        ratio = np.mean(independent**2) / (sigma**2 * savgol_noise_gain(window, order, deriv, DT))
        # Sampling error, and w T = 0.15 rad by which the noise turns within a window.
        assert abs(ratio - 1.0) < 5.0 * np.sqrt(2.0 / independent.size) + 0.02


def test_too_slow_sampling_is_an_error():
    t = np.arange(50) * 0.1
    with pytest.raises(InputError, match="Sample faster"):
        differentiate_rotations(lie.so3_exp(t[:, None] * [0.0, 0.0, 20.0]), 0.1, 5, 2)


@pytest.mark.parametrize("call", [
    lambda: differentiate_rotations(np.zeros((20, 3)), DT, 5, 2),
    lambda: differentiate_rotations(np.tile(np.eye(3), (20, 1, 1)), DT, 5, 1),
    lambda: differentiate_rotations(np.tile(np.eye(3), (4, 1, 1)), DT, 5, 2),
])  # fmt: skip
def test_rotation_settings_that_cannot_be(call):
    with pytest.raises(InputError):
        call()


# ------------------------------------------------------------------------------------------ resampling


def jittered(rng, n=2000, dt=DT):
    return np.arange(n) * dt + rng.uniform(-0.3, 0.3, n) * dt


def test_linear_agrees_with_numpy(rng):
    t = jittered(rng)
    x = rng.normal(size=(t.size, 3))
    grid, y = resample_uniform(t, x, DT)
    np.testing.assert_allclose(np.diff(grid), DT, rtol=1e-9)
    for c in range(3):
        np.testing.assert_allclose(y[:, c], np.interp(grid, t, x[:, c]), atol=1e-12)


def test_cubic_is_exact_for_cubics_on_uneven_stamps(rng):
    t = jittered(rng)
    polynomial = np.polynomial.Polynomial([1.0, 2.0, -3.0, 4.0])
    grid, y = resample_uniform(t, polynomial(t), 0.7e-3, kind="cubic")
    np.testing.assert_allclose(y[3:-3], polynomial(grid)[3:-3], atol=1e-12)


def test_cubic_is_of_fourth_order(rng):
    def worst(dt):
        t = np.arange(0.0, 2.0, dt)
        grid, y = resample_uniform(t, np.sin(20.0 * t), 0.37 * dt, kind="cubic")
        inside = (grid > 0.1) & (grid < 1.9)
        return np.abs(y - np.sin(20.0 * grid))[inside].max()

    assert worst(0.01) / worst(0.005) == pytest.approx(16.0, rel=0.1)


def test_samples_themselves_come_back(rng):
    t = jittered(rng, 500)
    x = rng.normal(size=500)
    for kind in ("linear", "cubic"):
        _, y = resample_uniform(t, x, t, kind=kind)
        np.testing.assert_allclose(y, x, atol=1e-14)


@pytest.mark.parametrize("kind", ["linear", "cubic"])
@pytest.mark.parametrize("how", ["nan", "missing"])
def test_gaps_are_never_bridged(kind, how):
    t = np.arange(100) * 0.01
    x = np.stack([t, t**2], axis=1)
    if how == "nan":
        x[40:50, 1] = np.nan  # one lost channel loses the row
    else:
        t, x = np.delete(t, slice(40, 50)), np.delete(x, slice(40, 50), axis=0)
    grid, y = resample_uniform(t, x, np.arange(0.0, 0.9901, 0.0025), max_gap=0.03, kind=kind)
    inside = (grid > 0.39 + 1e-6) & (grid < 0.50 - 1e-6)
    assert inside.sum() == 43
    assert np.isnan(y[inside]).all()
    assert np.isfinite(y[~inside]).all()
    np.testing.assert_allclose(y[~inside, 0], grid[~inside], atol=1e-12)
    if kind == "cubic":
        # Three points beside the gap are still exact for a parabola.
        np.testing.assert_allclose(y[~inside, 1], grid[~inside] ** 2, atol=1e-12)


def test_nothing_crosses_a_gap(rng):
    """What stands on one side of a gap does not depend on the other side."""
    t = np.arange(100) * 0.01
    x = rng.normal(size=100)
    x[40:50] = np.nan
    R = lie.so3_exp(0.3 * rng.normal(size=(100, 3)))
    R[40:50] = np.nan
    grid = np.arange(0.0, 0.99, 0.0037)
    for changed, kept in ((slice(50, None), grid < 0.4), (slice(0, 40), grid > 0.49)):
        other_x, other_R = x.copy(), R.copy()
        other_x[changed] += 5.0
        other_R[changed] = np.eye(3)
        for kind in ("linear", "cubic"):
            a, b = (resample_uniform(t, v, grid, kind=kind)[1] for v in (x, other_x))
            np.testing.assert_array_equal(a[kept], b[kept])
            assert (a != b)[~kept & np.isfinite(a)].all()
            a, b = (resample_rotations(t, v, grid, kind=kind)[1] for v in (R, other_R))
            np.testing.assert_array_equal(a[kept], b[kept])


def test_short_gaps_are_bridged_up_to_the_limit():
    t = np.arange(20) * 0.01
    x = t.copy()
    x[10] = np.nan
    for max_gap, filled in ((0.02, True), (0.019, False), (None, True)):
        _, y = resample_uniform(t, x, t, max_gap=max_gap)
        assert np.isfinite(y[10]) == filled
        assert np.isfinite(np.delete(y, 10)).all()


def test_single_good_sample_between_gaps_is_kept():
    t = np.arange(30) * 0.01
    x = np.sin(t)
    x[5:15] = np.nan
    x[16:25] = np.nan
    _, y = resample_uniform(t, x, t, max_gap=0.03, kind="cubic")
    np.testing.assert_array_equal(np.isfinite(y), np.isfinite(x))
    assert y[15] == pytest.approx(np.sin(0.15), abs=1e-15)


def test_nothing_outside_the_recording():
    t = np.arange(10) * 0.1
    grid, y = resample_uniform(t, t, np.array([-0.01, 0.0, 0.45, 0.9, 0.91]))
    np.testing.assert_array_equal(np.isfinite(y), [False, True, True, True, False])
    assert grid.size == 5


def test_epoch_time_stamps_keep_their_grid():
    t = 1.4e9 + np.arange(200) * 0.005
    grid, y = resample_uniform(t, np.arange(200.0), 0.005)
    assert grid.size == 200
    np.testing.assert_allclose(y, np.arange(200), atol=2e-4)  # 4 ulp of 1.4e9 s in steps of 5 ms


def test_rotation_slerp_is_exact_for_a_constant_rate(rng):
    t = jittered(rng, 800)
    w = np.array([3.0, -10.0, 4.0])
    R = lie.so3_exp(t[:, None] * w)
    grid, out = resample_rotations(t, R, DT)
    assert lie.angle_between(out, lie.so3_exp(grid[:, None] * w)).max() < 1e-13
    q = lie.matrix_to_quaternion_wxyz(R) * rng.choice([-1.0, 1.0], size=(800, 1))
    _, as_quaternion = resample_rotations(t, q, DT)
    np.testing.assert_allclose(lie.quaternion_wxyz_to_matrix(as_quaternion), out, atol=1e-13)
    assert (np.einsum("ij,ij->i", as_quaternion[1:], as_quaternion[:-1]) > 0.0).all()


def test_rotation_cubic_is_of_fourth_order():
    def worst(dt, kind):
        t = np.arange(0.0, 2.0, dt)
        grid, out = resample_rotations(t, coning(t, 1.0, 15.0)[0], 0.37 * dt, kind=kind)
        inside = (grid > 0.1) & (grid < 1.9)
        return lie.angle_between(out, coning(grid, 1.0, 15.0)[0])[inside].max()

    assert worst(0.01, "cubic") / worst(0.005, "cubic") == pytest.approx(16.0, rel=0.15)
    assert worst(0.01, "linear") / worst(0.005, "linear") == pytest.approx(4.0, rel=0.15)


@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_rotation_gaps_are_never_bridged(kind):
    t = np.arange(100) * 0.01
    R, _, _ = coning(t, 0.5, 3.0)
    R[30:60] = np.nan
    grid, out = resample_rotations(t, R, 0.005, kind=kind)
    inside = (grid > 0.29 + 1e-6) & (grid < 0.60 - 1e-6)
    assert np.isnan(out[inside]).all()
    assert lie.angle_between(out, coning(grid, 0.5, 3.0)[0])[~inside].max() < 1e-4


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: resample_uniform([0.0, 1.0], [1.0, 2.0, 3.0], 0.1), "t"),
        (lambda: resample_uniform([0.0, 0.0, 1.0], [1.0, 2.0, 3.0], 0.1), "t"),
        (lambda: resample_uniform([0.0, np.nan, 1.0], [1.0, 2.0, 3.0], 0.1), "t"),
        (lambda: resample_uniform([0.0, 1.0, 2.0], [1.0, np.nan, np.nan], 0.1), "x"),
        (lambda: resample_uniform([0.0, 1.0], [1.0, 2.0], -0.1), "grid"),
        (lambda: resample_uniform([0.0, 1.0], [1.0, 2.0], [0.0, np.nan]), "grid"),
        (lambda: resample_uniform([0.0, 1.0], [1.0, 2.0], 0.1, max_gap=0.0), "max_gap"),
        (lambda: resample_uniform([0.0, 1.0], [1.0, 2.0], 0.1, kind="spline"), "kind"),
        (lambda: resample_rotations([0.0, 1.0], np.zeros((2, 3)), 0.1), "rotation"),
    ],
)
def test_resampling_input_that_cannot_be(call, field):
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.field == field


# ------------------------------------------------------------------------------------------ time offset


def wave(t):
    """A smooth, aperiodic motion that can be evaluated at any time."""
    phases = np.random.default_rng(5).uniform(0, 2 * np.pi, 40)
    f = np.linspace(0.2, 6.0, 40) * (1.0 + 0.05 * np.cos(phases))
    return np.cos(2 * np.pi * f * t[:, None] + phases).sum(axis=1)


@pytest.mark.parametrize("lag", [0.0, 0.0123, -0.0457, 0.3])
def test_lag_to_a_hundredth_of_a_step(lag):
    dt = 0.005
    t = np.arange(4000) * dt
    found = estimate_lag(wave(t), 3.0 * wave(t - lag) + 100.0, dt, 0.5)
    # y(t + lag) = x(t): the second signal is late for a positive lag.
    assert found.lag == pytest.approx(lag, abs=0.01 * dt)
    assert found.correlation > 0.9999
    assert found.ambiguity < 0.5
    assert not found.at_limit


def test_lag_with_gaps_and_noise(rng):
    dt = 0.005
    t = np.arange(4000) * dt
    x, y = wave(t), wave(t - 0.0123)
    x += 0.2 * x.std() * rng.normal(size=t.size)
    y += 0.2 * y.std() * rng.normal(size=t.size)
    x[500:900] = np.nan
    y[2000:2600] = np.nan
    found = estimate_lag(x, y, dt, 0.5)
    assert found.lag == pytest.approx(0.0123, abs=0.3 * dt)
    # Correlation of two signals with 4 % noise power each.
    assert found.correlation == pytest.approx(1.0 / 1.04, abs=0.01)


def test_correlation_equals_pearson_on_the_common_samples(rng):
    x, y = rng.normal(size=(2, 300)) + 0.02 * np.arange(
        300
    )  # the means of the common samples differ from all
    y[3:] += x[:-3]
    x[40:60] = np.nan
    y[150:] = np.nan
    found = estimate_lag(x, y, 1.0, 20.0)
    both = np.isfinite(x[:-3]) & np.isfinite(y[3:])
    expected = np.corrcoef(x[:-3][both], y[3:][both])[0, 1]
    # The parabola's top lies at most a little above the best sample.
    assert round(found.lag) == 3
    assert expected <= found.correlation < expected + 0.05


def test_periodic_motion_is_ambiguous():
    t = np.arange(4000) * 0.005
    found = estimate_lag(np.sin(2 * np.pi * t), np.sin(2 * np.pi * (t - 0.1)), 0.005, 3.0)
    assert found.ambiguity > 0.99


def test_lag_beyond_the_search_is_said():
    t = np.arange(2000) * 0.005
    slow = np.sin(2 * np.pi * 0.15 * t)
    found = estimate_lag(slow, np.sin(2 * np.pi * 0.15 * (t - 1.0)), 0.005, 0.2)
    assert found.at_limit


@pytest.mark.parametrize(
    "call",
    [
        lambda: estimate_lag(np.zeros(100), np.arange(100.0), 0.01, 0.1),
        lambda: estimate_lag(np.full(100, np.nan), np.arange(100.0), 0.01, 0.1),
        lambda: estimate_lag(np.arange(90.0), np.arange(100.0), 0.01, 0.1),
        lambda: estimate_lag(np.arange(100.0), np.arange(100.0), 0.01, 0.0),
        lambda: estimate_lag(np.arange(100.0), np.arange(100.0), -0.01, 0.1),
    ],
)
def test_lag_input_that_cannot_be(call):
    with pytest.raises(InputError):
        call()


# ------------------------------------------------------------------------------------------ real data


def test_real_motion_capture_against_its_gyroscope(dataset):
    """BROAD, fast rotation: the differentiated optical orientation agrees with the IMU, some 4 ms apart."""
    data = np.load(dataset("broad/06_undisturbed_fast_rotation_A.npz"))
    dt = 1.0 / float(data["fs"])
    window = choose_savgol(12.0, dt, 3)
    out = differentiate_rotations(data["opt_quat"], dt, window, 3)
    gyro = data["imu_gyr"].astype(np.float64)
    bias = np.nanmean(gyro[: int(4.0 / dt)], axis=0)
    smooth = savgol_derivatives(gyro - bias, dt, window, 3, 0)
    found = estimate_lag(
        np.linalg.norm(out.angular_velocity, axis=1), np.linalg.norm(smooth, axis=1), dt, 0.2
    )
    assert found.correlation > 0.99
    assert abs(found.lag) < 0.010
    t = np.arange(len(smooth)) * dt
    _, aligned = resample_uniform(t - found.lag, smooth, t, kind="cubic")
    error = aligned - out.angular_velocity
    assert np.sqrt(np.nanmean(error**2)) < 0.03 * np.sqrt(np.nanmean(smooth**2))
    # Gaps of the recording remain: rows of NaN in the poses are rows of NaN in the rates.
    lost = np.isnan(data["opt_quat"]).any(axis=1)
    assert lost.any()
    assert np.isnan(out.angular_velocity[lost]).all()


def test_noise_levels_are_read_from_what_is_too_fast_to_be_motion(rng):
    t = 0.004 * np.arange(6000)
    motion = np.column_stack([np.sin(3.0 * t), np.cos(2.0 * t + 1.0), 0.3 * t])
    noisy = motion + 2e-4 * rng.standard_normal(motion.shape)
    noisy[1000:1100] = np.nan
    assert white_noise_sd(noisy) == pytest.approx(2e-4, rel=0.08)
    assert white_noise_sd(motion) < 1e-9
    for turn in (motion, 1e-3 * motion):
        R = lie.so3_exp(turn) @ lie.so3_exp(5e-4 * rng.standard_normal(turn.shape))
        q = lie.matrix_to_quaternion_wxyz(R, continuous=True)
        q[2000:2003] = np.nan
        assert rotation_noise_sd(q) == pytest.approx(5e-4, rel=0.08)
    assert white_noise_sd(noisy[:8]) == 0.0

"""Kinematic measures: formulas against finite differences and closed forms, uncertainties against errors over many runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.kinematics import (
    WristMeasures,
    angle_covariance,
    angle_jacobian,
    euler_zyz,
    isb_angles,
    log_dimensionless_jerk,
    movements,
    range_of_motion,
    sample_tracks,
    spectral_arc_length,
    wrist_angles,
    wrist_measures,
    wrist_rotation,
)
from factorgrasp.kinematics.wrist_measures import frame_errors
from factorgrasp.lie import matrix_to_quaternion_wxyz, project_to_so3, so3_exp, so3_log
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.wrist_track import CameraPose, WristTrack
from factorgrasp.simulation.wrist_motion import WristMotion, wrist_motion
from factorgrasp.typing import BoolArray, FloatArray

RATE = 30.0


# ---- angles --------------------------------------------------------------------------------------------------


def test_angles_invert_their_rotation(rng: np.random.Generator) -> None:
    angles = rng.uniform(-1.5, 1.5, (200, 3))
    R = wrist_rotation(angles)
    np.testing.assert_allclose(wrist_angles(R), angles, atol=1e-14)
    # The formulas of the mathematics, section 5.3.
    np.testing.assert_allclose(np.arcsin(R[:, 1, 0]), angles[:, 1], atol=1e-12)
    np.testing.assert_allclose(np.arctan2(-R[:, 2, 0], R[:, 0, 0]), angles[:, 0], atol=1e-12)
    np.testing.assert_allclose(np.arctan2(-R[:, 1, 2], R[:, 1, 1]), angles[:, 2], atol=1e-12)


def test_angles_mean_what_they_are_called() -> None:
    fingers, thumb = (
        np.array([1.0, 0.0, 0.0]),
        {"right": np.array([0.0, 1.0, 0.0]), "left": np.array([0.0, -1.0, 0.0])},
    )
    for hand in ("right", "left"):
        for k, (moved, towards) in enumerate(
            [
                (fingers, [0.0, 0.0, -1.0]),  # flexion: the fingers go to the palm's side
                (fingers, -thumb[hand]),  # ulnar deviation: away from the thumb's side
                (
                    thumb[hand],
                    [0.0, 0.0, -1.0],
                ),  # pronation: the thumb's side goes down, the back of the hand up
            ]
        ):
            for sign in (1.0, -1.0):
                wanted = np.zeros(3)
                wanted[k] = 0.3 * sign
                axis = np.cross(moved, towards)
                found = isb_angles(so3_exp(0.3 * sign * axis), hand)
                np.testing.assert_allclose(found, wanted, atol=1e-12)
    with pytest.raises(InputError, match="hand"):
        isb_angles(np.eye(3), "both")  # type: ignore[arg-type]


def test_angle_jacobian_by_finite_differences(rng: np.random.Generator) -> None:
    R = wrist_rotation(rng.uniform(-1.2, 1.2, (50, 3)))
    h = 1e-6
    numeric = np.stack(
        [(wrist_angles(R @ so3_exp(h * e)) - wrist_angles(R @ so3_exp(-h * e))) / (2 * h) for e in np.eye(3)],
        axis=-1,
    )
    np.testing.assert_allclose(angle_jacobian(R), numeric, atol=1e-8)
    P = 1e-6 * np.diag([1.0, 2.0, 3.0])
    d = rng.standard_normal((200_000, 3)) @ np.sqrt(P)
    sampled = np.cov(wrist_angles(R[0] @ so3_exp(d)).T)
    np.testing.assert_allclose(angle_covariance(R[0], P), sampled, rtol=0.03, atol=3e-8)
    assert np.isnan(angle_jacobian(wrist_rotation([0.1, 0.5 * np.pi, 0.2]))[0, 1])


def test_zyz(rng: np.random.Generator) -> None:
    R = wrist_rotation(rng.uniform(-1.2, 1.2, (50, 3)))
    a = euler_zyz(R)
    y, z = np.eye(3)[[1, 2]]
    np.testing.assert_allclose(
        so3_exp(a[:, :1] * z) @ so3_exp(a[:, 1:2] * y) @ so3_exp(a[:, 2:] * z), R, atol=1e-12
    )
    np.testing.assert_allclose(euler_zyz(so3_exp([0.0, 0.0, 0.4])), [0.4, 0.0, 0.0], atol=1e-12)


# ---- smoothness ----------------------------------------------------------------------------------------------


def _minimum_jerk(duration: float, rate: float) -> tuple[FloatArray, FloatArray]:
    s = np.linspace(0.0, 1.0, round(duration * rate) + 1)
    return 30.0 * s**2 * (1.0 - s) ** 2 / duration, (60.0 - 360.0 * s + 360.0 * s**2) / duration**3


def test_smoothness_of_minimum_jerk() -> None:
    for duration in (0.5, 2.0):
        speed, jerk = _minimum_jerk(duration, 1000.0)
        vector = 0.3 * jerk[:, None] * np.array([0.6, 0.0, 0.8])
        # 720 / 1.875^2
        assert log_dimensionless_jerk(vector, 1000.0, 0.3 * float(speed.max())) == pytest.approx(
            -np.log(204.8), abs=2e-3
        )
        assert spectral_arc_length(speed, 1000.0) == pytest.approx(-1.41, abs=0.02)
    halting = np.concatenate([speed, speed])
    assert spectral_arc_length(halting, 1000.0) < -1.8


# ---- tracks --------------------------------------------------------------------------------------------------


def _smooth(y: FloatArray, r: float, q: float, dt: float) -> tuple[FloatArray, FloatArray]:
    """Rauch-Tung-Striebel smoother of a signal with white acceleration: states (n, 2), covariances (n, 2, 2)."""
    F, H = np.array([[1.0, dt], [0.0, 1.0]]), np.array([1.0, 0.0])
    Q = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    m, P = np.array([y[0], 0.0]), np.diag([r, 10.0])
    means, covariances, ahead = [], [], []
    for k in range(y.size):
        if k:
            m, P = F @ m, F @ P @ F.T + Q
        ahead.append((m, P))
        K = P @ H / (H @ P @ H + r)
        m, P = m + K * (y[k] - m[0]), P - np.outer(K, H @ P)
        means.append(m)
        covariances.append(P)
    for k in range(y.size - 2, -1, -1):
        G = covariances[k] @ F.T @ np.linalg.inv(ahead[k + 1][1])
        means[k] = means[k] + G @ (means[k + 1] - ahead[k + 1][0])
        covariances[k] = covariances[k] + G @ (covariances[k + 1] - ahead[k + 1][1]) @ G.T
    return np.array(means), np.array(covariances)


def _track(motion: str, seed: int, duration: float = 12.0) -> tuple[WristMotion, WristTrack]:
    """A smoothed track of a known motion: 1.5 degrees and 1 mm of noise a frame."""
    rng = np.random.default_rng([seed, 3])
    t = np.arange(round(duration * RATE)) / RATE
    true = wrist_motion(motion, t, seed)
    noise = np.array([*np.deg2rad([1.5] * 3), *[1e-3] * 3])
    signals = np.concatenate([true.angles, true.position], axis=1)
    found = [
        _smooth(
            signals[:, i] + noise[i] * rng.standard_normal(t.size),
            noise[i] ** 2,
            3.0 if i < 3 else 0.1,
            1 / RATE,
        )
        for i in range(6)
    ]
    x = np.stack([states[:, 0] for states, _ in found], axis=1)
    v = np.stack([states[:, 1] for states, _ in found], axis=1)
    P, V = np.zeros((t.size, 6, 6)), np.zeros((t.size, 6, 6))
    for i, (_, covariances) in enumerate(found):
        P[:, i, i], V[:, i, i] = covariances[:, 0, 0], covariances[:, 1, 1]
    R = wrist_rotation(x[:, :3])
    E = np.linalg.inv(angle_jacobian(R))
    for C in (P, V):
        C[:, :3, :3] = E @ C[:, :3, :3] @ np.swapaxes(E, 1, 2)
    no = np.zeros(t.size, dtype=bool)
    return true, WristTrack(
        t, matrix_to_quaternion_wxyz(R), x[:, 3:], v[:, 3:], np.einsum("nij,nj->ni", E, v[:, :3]), P, V,
        np.zeros(0, dtype=int), no, no, (), MarkerLayout.palm(0.0), CameraPose(np.eye(3), np.zeros(3)),
    )  # fmt: skip


def _exact(true: WristMotion) -> WristMeasures:
    """The same measures of the truth."""
    n = true.t.size
    tiny = np.broadcast_to(1e-16 * np.eye(6), (n, 6, 6))
    no = np.zeros(n, dtype=bool)
    track = WristTrack(
        true.t, matrix_to_quaternion_wxyz(true.rotation), true.position, true.velocity, true.angular_velocity,
        tiny, tiny, np.zeros(0, dtype=int), no, no, (), MarkerLayout.palm(0.0), CameraPose(np.eye(3), np.zeros(3)),
    )  # fmt: skip
    return wrist_measures(track, samples=3)


def test_drawn_errors_have_the_tracks_spectrum() -> None:
    true, track = _track("reach", 0, 40.0)
    drawn = sample_tracks(
        track.t, track.rotation, track.position, track.velocity, track.angular_velocity, track.covariance,
        track.velocity_covariance, 40,
    )  # fmt: skip
    inner = slice(10, -10)
    np.testing.assert_allclose(
        (drawn.position - track.position)[:, inner].std(axis=(0, 1)),
        np.sqrt(track.covariance[100, [3, 4, 5], [3, 4, 5]]),
        rtol=0.05,
    )
    stated, found = (drawn.velocity - track.velocity)[:, inner], (track.velocity - true.velocity)[inner]
    f = np.fft.rfftfreq(found.shape[0], 1 / RATE)
    for low, high in ((0.5, 2.0), (2.0, 4.0), (4.0, 8.0)):
        band = (f >= low) & (f < high)
        ratio = np.mean(np.abs(np.fft.rfft(found, axis=0)[band]) ** 2) / np.mean(
            np.abs(np.fft.rfft(stated, axis=1)[:, band]) ** 2
        )
        assert 0.4 < ratio < 1.6, (low, high, ratio)


def test_ranges_of_motion_are_unbiased_and_their_intervals_cover() -> None:
    runs = 12
    error, sd, naive = np.empty((runs, 3)), np.empty((runs, 3)), np.empty((runs, 3))
    for seed in range(runs):
        true, track = _track("three_axes", seed)
        found, exact = wrist_measures(track, samples=60, seed=seed), _exact(true)
        for i in range(3):
            error[seed, i] = found.range_of_motion[i].range.value - exact.range_of_motion[i].range.value
            sd[seed, i] = found.range_of_motion[i].range.sd
            naive[seed, i] = np.ptp(found.angles[:, i]) - np.ptp(exact.angles[:, i])
    assert np.rad2deg(np.abs(error.mean(axis=0))).max() < 0.3
    assert np.rad2deg(np.abs(error.mean())) < 0.15
    assert np.rad2deg(naive.mean()) > 0.6
    assert np.mean(np.abs(error) < 1.96 * sd) > 0.88
    assert np.mean((error / sd) ** 2) > 0.4  # and they are not too wide


def test_range_of_motion_of_the_papers_abduction() -> None:
    _, track = _track("abduction", 1)
    found = wrist_measures(track, "right")
    deviation = found.range_of_motion[1]
    assert deviation.axis == "radial_ulnar_deviation"
    assert deviation.cycles >= 3
    assert np.rad2deg(deviation.range.value) == pytest.approx(50.0, abs=1.0)
    assert np.rad2deg(deviation.largest.value) == pytest.approx(50.0, abs=2.0)
    assert np.rad2deg(deviation.maximum.value) == pytest.approx(25.0, abs=1.0)
    mirrored = wrist_measures(track, "left").range_of_motion[1]
    assert mirrored.maximum.value == pytest.approx(-deviation.minimum.value)


def test_movements_and_their_intervals() -> None:
    names = ("distance", "path_length", "straightness", "peak_speed", "sparc", "ldlj")
    rows = []
    for seed in range(8):
        true, track = _track("reach", seed)
        found, exact = wrist_measures(track, samples=60, seed=seed).movements, _exact(true).movements
        assert len(found) == len(exact) == 5
        for one, other in zip(found, exact, strict=True):
            assert one.start == pytest.approx(other.start, abs=0.05)
            rows.append(
                [(getattr(one, n).value - getattr(other, n).value, getattr(one, n).sd) for n in names]
            )
    error, sd = np.moveaxis(np.array(rows), -1, 0)
    assert np.isfinite(error).all()
    covered = np.mean(np.abs(error) < 1.96 * sd, axis=0)
    assert np.all(covered > 0.85), dict(zip(names, covered, strict=True))
    assert np.all(np.sqrt(np.mean((error / sd) ** 2, axis=0)) > 0.4)
    distance, length, straightness, peak = (np.abs(error[:, i]).mean() for i in range(4))
    assert distance < 2e-3
    assert length < 3e-3
    assert straightness < 5e-3
    assert peak < 0.02


def _without(track: WristTrack, hidden: BoolArray) -> WristTrack:
    def holed(values: FloatArray, hole: float) -> FloatArray:
        return np.where(hidden.reshape(-1, *[1] * (values.ndim - 1)), hole, values)

    return replace(
        track,
        rotation_wxyz=holed(track.rotation_wxyz, np.nan),
        position=holed(track.position, np.nan),
        velocity=holed(track.velocity, np.nan),
        angular_velocity=holed(track.angular_velocity, np.nan),
        covariance=holed(track.covariance, np.inf),
        velocity_covariance=holed(track.velocity_covariance, np.inf),
        lost=hidden,
    )


def test_an_uncertain_layout_widens_ranges_of_motion_by_its_turn() -> None:
    _, track = _track("flexion", 1)
    sure = wrist_measures(track).range_of_motion
    loose = wrist_measures(replace(track, markers=MarkerLayout.palm(4e-3))).range_of_motion
    assert loose[1].range.sd > 1.5 * sure[1].range.sd  # flexion shows as deviation
    assert loose[0].range.sd < 1.2 * sure[0].range.sd
    # Drawn layouts, turned back by the best fit.
    layout, rng = MarkerLayout.palm(2e-3), np.random.default_rng(0)
    centred = layout.points - layout.points.mean(axis=0)
    moved = centred + 2e-3 * rng.standard_normal((4000, 6, 3))
    fitted = so3_log(
        project_to_so3(np.einsum("kni,nj->kij", moved - moved.mean(axis=1, keepdims=True), centred))
    )
    drawn = so3_log(frame_errors(layout.points, layout.covariance, 4000))
    np.testing.assert_allclose(drawn.std(axis=0), fitted.std(axis=0), rtol=0.08)


def test_movements_without_rest_between_them() -> None:
    """There and back without a halt, on a way that is not straight: two movements, parted where the speed is least."""
    t = np.arange(90) / RATE
    turn = np.clip((t - 0.5) / 2.0, 0.0, 1.0)
    s = turn**3 * (10.0 + turn * (6.0 * turn - 15.0))
    angle, rate = np.pi * s, np.gradient(np.pi * s, t)
    # Half an ellipse that is long and narrow.
    p = np.stack([0.25 * np.sin(angle), 0.04 * np.cos(angle), 0.0 * t], axis=1)
    v = np.stack([0.25 * np.cos(angle) * rate, -0.04 * np.sin(angle) * rate, 0.0 * t], axis=1)
    rng = np.random.default_rng(1)
    drawn = v + 0.005 * rng.standard_normal((50, *v.shape))
    found = movements(t, p, v, np.tile(p, (50, 1, 1)), drawn)
    assert len(found) == 2
    assert found[0].end == pytest.approx(1.5, abs=0.1)
    assert found[1].start == pytest.approx(1.5, abs=0.1)
    for one in found:
        assert one.distance.value == pytest.approx(0.25, abs=0.02)
        assert one.distance.sd < 0.01
        assert 0.9 < one.straightness.value <= 1.01


def test_gaps_are_left_out() -> None:
    _, track = _track("reach", 2)
    whole = wrist_measures(track)
    hidden = (track.t > 1.0) & (track.t < 1.3)  # within the first reach
    holed = _without(track, hidden)
    found = wrist_measures(holed)
    assert len(found.movements) == len(whole.movements) - 1
    assert np.isnan(found.angles[hidden]).all()
    assert all(np.isfinite(one.range.sd) for one in found.range_of_motion)


def test_without_cycles_the_whole_track_counts_and_says_so() -> None:
    t = np.arange(60) / RATE
    angle = 0.5 * t
    found = range_of_motion(t, angle, np.full(60, 1e-3), np.tile(angle, (5, 1)))
    assert found.cycles == 0
    assert "no full cycle" in found.words
    assert found.range.value == pytest.approx(0.5 * t[-1], rel=0.05)
    with pytest.raises(InputError):
        range_of_motion(t, np.full(60, np.nan), np.ones(60), np.zeros((5, 60)))


def test_too_few_frames() -> None:
    _, track = _track("reach", 0, 1.0)
    empty = _without(track, np.ones(30, dtype=bool))
    found = wrist_measures(empty)
    assert found.range_of_motion == ()
    assert "0 frames" in found.words[0]
    assert (
        movements(
            track.t,
            np.full((30, 3), np.nan),
            np.full((30, 3), np.nan),
            np.zeros((2, 30, 3)),
            np.zeros((2, 30, 3)),
        )
        == ()
    )

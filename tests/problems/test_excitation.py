"""Planned excitations: exact derivatives, the closed form of coning, limits that hold between nodes, and what cannot be had, in words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.excitation_task import plan_excitation
from factorgrasp.models.motion_basis import make_basis, minimum_jerk
from factorgrasp.problems.excitation import GRAVITY, Excitation, information_of
from factorgrasp.problems.excitation_human import (
    HumanMotion,
    planar_human,
    recorded_human,
    static_human,
    task_human,
)
from factorgrasp.problems.excitation_settings import ExcitationSettings, GraspBelief, HumanWrist
from factorgrasp.status import Status

LEVER = np.array([0.4, 0.1, 0.05])
GRASP = GraspBelief(lie.so3_exp(np.array([0.3, -0.2, 0.5])), LEVER)


def static(T: float) -> HumanMotion:
    return static_human(T, np.array([0.5, 0.0, 0.4]), np.eye(3))


def moving(T: float) -> HumanMotion:
    turned = lie.so3_exp(np.array([0.2, -0.4, 0.3]))
    return task_human(T, (np.zeros(3), np.eye(3)), (np.array([0.3, -0.2, 0.1]), turned))


def problem(human: HumanMotion | None = None, wrist: HumanWrist | None = None, **settings: Any) -> Excitation:
    stated = {"alpha": 3.0, "duration": 3.0, "bandwidth": 1.0, "window": 3.0, "step": 2e-3} | settings
    if stated["alpha"] is None:
        stated.pop("window")
    made = ExcitationSettings(**stated)
    return Excitation(GRASP, human or static(made.duration), made, wrist)


@pytest.mark.parametrize("kind", ["fourier", "bspline"])
def test_bases_are_differentiated_exactly(kind: str) -> None:
    basis, t, h = make_basis(kind, 2.0, 1.5), np.linspace(0.1, 1.9, 7), 1e-5
    for order in range(3):
        numeric = (basis.values(t + h, order) - basis.values(t - h, order)) / (2 * h)
        right = basis.values(t, order + 1)
        assert np.max(np.abs(numeric - right)) < 1e-5 * np.max(np.abs(right))
    path = minimum_jerk(np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(path[0], [0.0, 0.5, 1.0])
    np.testing.assert_allclose(path[1:3, [0, 2]], 0.0)


@pytest.mark.parametrize("human", [static, moving])
@pytest.mark.parametrize(
    "demand", [{"alpha": 5.0}, {"alpha": None, "rotation_sd": 0.01, "translation_sd": 0.004}]
)
def test_derivatives_of_the_program(human: Any, demand: dict[str, Any]) -> None:
    made = problem(human(3.0), HumanWrist(max_force=20.0), max_angular_velocity=1.0, **demand)
    program = made.nonlinear_program()
    rng, e = np.random.default_rng(1), 1e-6
    x = program.start + 0.02 * rng.normal(size=program.size)
    d, y = rng.normal(size=program.size), rng.normal(size=program.row_lower.size)
    slope = (program.objective(x + e * d) - program.objective(x - e * d)) / (2 * e)
    assert program.gradient(x) @ d == pytest.approx(slope, rel=1e-6)
    moved = (program.rows(x + e * d) - program.rows(x - e * d)) / (2 * e)
    assert np.max(np.abs(program.jacobian(x) @ d - moved)) < 1e-6 * np.max(np.abs(moved))

    def lagrangian(point: np.ndarray) -> np.ndarray:
        return 0.7 * program.gradient(point) + program.jacobian(point).T @ y

    bent = (lagrangian(x + e * d) - lagrangian(x - e * d)) / (2 * e)
    assert np.max(np.abs(program.hessian(x, 0.7, y) @ d - bent)) < 1e-6 * np.max(np.abs(bent))


def test_motion_that_is_read_off_is_the_derivative_of_its_pose() -> None:
    """Rates and specific force against finite differences of R(t) and of the wrist's place."""
    made = problem(moving(3.0), step=1e-3)
    C = made.start()
    space, t = made.task, made.grid
    z = np.concatenate([made.on_grid(space, C, order) for order in range(3)])
    read = space.read.values(z, space.motion.given(t))
    R, p, w, al, f = (
        read[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1),
        read[:, 9:12],
        read[:, 12:15],
        read[:, 15:18],
        read[:, 18:21],
    )
    h = t[1] - t[0]
    numeric = lie.so3_log(R[:-2].transpose(0, 2, 1) @ R[2:]) / (2 * h)
    assert np.max(np.abs(numeric - w[1:-1])) < 1e-4
    assert np.max(np.abs((w[2:] - w[:-2]) / (2 * h) - al[1:-1])) < 2e-3
    wrist = p + R @ LEVER
    np.testing.assert_allclose(wrist, made.human.position(t)[0].T, atol=1e-12)
    a = (wrist[2:] - 2 * wrist[1:-1] + wrist[:-2]) / h**2
    numeric = np.einsum("nji,nj->ni", R[1:-1], a - GRAVITY)
    assert np.max(np.abs(numeric - f[1:-1])) < 1e-4


def test_excitation_of_coning_is_the_closed_form() -> None:
    """``lambda_min = T w^4 A^2 / 2`` for rho = A (u cos wt + v sin wt), to second order in A."""
    made = problem(rest=False, centred=False, duration=2.0, window=2.0, bandwidth=2.0)
    A, w = 1e-3, 2 * np.pi * 2.0
    C = np.zeros((3, made.basis.size))
    C[0, -2], C[1, -1] = A, A
    G = made.excitation_matrix(made.task, C, 0.0, 2.0)
    assert np.linalg.eigvalsh(G)[0] == pytest.approx(2.0 * w**4 * A**2 / 2, rel=1e-4)


def test_plan_is_never_worse_than_coning() -> None:
    plan = plan_excitation(problem(rest=False, centred=False, duration=2.0, window=2.0, bandwidth=2.0))
    assert plan.status is Status.SOLVED
    assert plan.share >= 1.0
    assert plan.coning_ratio <= 1.0005 / 1.0 + 1e-3
    assert np.min(plan.lambda_min) >= 3.0


def test_plan_holds_limits_and_windows_on_the_fine_grid() -> None:
    """Force, rotation and rate limits that bind, windows that slide, rest at both ends; all recomputed from the trajectory itself."""
    wrist = HumanWrist(max_rotation=0.2, max_force=2.4)
    made = problem(static(4.0), wrist, alpha=4.0, duration=4.0, window=2.0, max_angular_velocity=0.75)
    plan = plan_excitation(made)
    assert plan.status is Status.SOLVED, plan.message
    assert not plan.check.violated
    rate = np.linalg.norm(plan.angular_velocity, axis=1)
    assert np.max(rate) <= 0.75 + 1e-6
    assert np.max(np.linalg.norm(plan.turn, axis=1)) <= 0.2 + 1e-6
    assert np.max(plan.force_rms) <= 2.4 + 1e-5
    assert min(one.relative for one in plan.check.margins) < 0.05  # one of them binds
    for end in (0, -1):
        assert rate[end] < 1e-9
        assert np.linalg.norm(plan.angular_acceleration[end]) < 1e-8
    # Excitation of every window, by another route: phi from the trajectory's rates, in numpy.
    phi = lie.skew(plan.angular_acceleration) + lie.skew(plan.angular_velocity) @ lie.skew(
        plan.angular_velocity
    )
    count = round(2.0 / (plan.t[1] - plan.t[0]))
    for first in (0, 137, 500, plan.t.size - 1 - count):
        part, t = phi[first : first + count + 1], plan.t[first : first + count + 1]
        mean = np.trapezoid(part, t, axis=0)
        G = np.trapezoid(np.swapaxes(part, 1, 2) @ part, t, axis=0) - mean.T @ mean / 2.0
        assert np.linalg.eigvalsh(G)[0] >= 4.0 * (1 - 1e-9)


def test_random_starts_end_at_one_optimum() -> None:
    made = problem(bandwidth=1.5, duration=2.0, window=2.0)
    objectives = [plan_excitation(made, seed=seed).objective for seed in (None, 0, 1)]
    assert np.ptp(objectives) < 0.01 * min(objectives)


def test_target_standard_deviations_are_met_and_are_the_estimators() -> None:
    plan = plan_excitation(problem(alpha=None, rotation_sd=0.004, translation_sd=0.002))
    assert plan.status is Status.SOLVED
    assert np.all(plan.predicted_sd <= np.repeat([0.004, 0.002], 3) * (1 + 1e-6))
    assert np.max(plan.predicted_sd / np.repeat([0.004, 0.002], 3)) > 0.99  # and no more effort than that
    # The same information by stacking the Jacobians of both residuals, biases as unknowns.
    made, rate = plan.problem, 1.0 / (plan.t[1] - plan.t[0])
    w, al, f = plan.angular_velocity, plan.angular_acceleration, plan.specific_force
    phi, eye, zero = (
        lie.skew(al) + lie.skew(w) @ lie.skew(w),
        np.tile(np.eye(3), (w.shape[0], 1, 1)),
        np.zeros((w.shape[0], 3, 3)),
    )
    J_g = np.concatenate([lie.skew(w), zero, eye, zero], axis=2) / (made.sensor_noise.gyro * np.sqrt(rate))
    J_a = np.concatenate([lie.skew(f), phi, zero, eye], axis=2) / (
        made.sensor_noise.accelerometer * np.sqrt(rate)
    )
    trapezoid = np.ones(w.shape[0])
    trapezoid[[0, -1]] = 0.5
    H = sum(np.einsum("n,nij,nik->jk", trapezoid, J, J) for J in (J_g, J_a))
    H[:6, :6] += made.grasp.information_r
    H[6:, 6:] += np.diag([made.noise.gyro_bias_sd**-2] * 3 + [made.noise.accelerometer_bias_sd**-2] * 3)
    np.testing.assert_allclose(np.linalg.inv(H)[:6, :6], plan.predicted_covariance, rtol=1e-6, atol=1e-14)


def test_travel_in_two_directions_shows_all_and_in_one_does_not() -> None:
    """The paper's IV.B: turning about the direction of travel, along an L and along a line."""
    corner = np.array([[0.0, 0, 0], [0.3, 0, 0], [0.3, 0.3, 0]])
    wrist = HumanWrist(max_rotation=1.0)
    both = plan_excitation(
        problem(
            planar_human(4.0, corner, np.eye(3)),
            wrist,
            duration=4.0,
            window=4.0,
            axes="travel",
            alpha=1.0,
            basis="bspline",
        )
    )
    assert both.status is Status.SOLVED, both.message
    # The turn is about the way of each leg, in the end-effector's axes.
    way = GRASP.rotation @ np.eye(3)[0]
    first = both.turn[both.t < 1.9]
    assert np.max(np.linalg.norm(np.cross(first, way), axis=1)) < 1e-12
    one = plan_excitation(
        problem(
            planar_human(4.0, corner[:2], np.eye(3)),
            wrist,
            duration=4.0,
            window=4.0,
            axes="travel",
            alpha=1.0,
            basis="bspline",
        )
    )
    assert one.status is Status.INFEASIBLE
    assert "never shows the lever arm along" in one.message


def test_a_human_who_moves_enough_is_left_alone() -> None:
    t = np.linspace(0.0, 3.0, 301)
    turn = 0.6 * np.stack([np.sin(4.2 * t), np.sin(6.3 * t) - 0.0, np.cos(5.0 * t) - 1.0], axis=1)
    human = recorded_human(t, np.zeros((t.size, 3)), lie.so3_exp(turn), 3.0)
    plan = plan_excitation(problem(human))
    assert plan.status is Status.SOLVED, plan.message
    assert np.max(np.linalg.norm(plan.turn, axis=1)) < 0.01
    assert plan_excitation(problem(static(3.0))).objective > 10.0 * plan.objective


def test_what_cannot_be_had_names_what_binds() -> None:
    plan = plan_excitation(problem(alpha=2000.0, max_angular_velocity=0.8))
    assert plan.status is Status.INFEASIBLE
    assert "alpha = 2000" in plan.message
    assert "angular velocity of the end-effector" in plan.message
    assert 0.0 < plan.share < 0.5
    assert not plan.check.violated


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({}, "either alpha"),
        ({"alpha": 1.0, "rotation_sd": 0.1}, "either alpha"),
        ({"alpha": -1.0}, "excitation.alpha"),
        ({"alpha": 1.0, "window": 20.0}, "excitation.window"),
        ({"alpha": 1.0, "step": 1.0}, "excitation.step"),
        ({"alpha": 1.0, "duration": float("nan")}, "excitation.duration"),
    ],
)
def test_bad_settings_are_named(settings: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match=field):
        ExcitationSettings(**settings)


def test_bad_belief_and_human_are_named() -> None:
    with pytest.raises(InputError, match=r"grasp\.rotation"):
        GraspBelief(2.0 * np.eye(3))
    with pytest.raises(InputError, match="negative variance"):
        GraspBelief(covariance=-np.eye(6))
    with pytest.raises(InputError, match="waypoints"):
        planar_human(1.0, np.zeros((2, 3)), np.eye(3))
    with pytest.raises(InputError, match="does not travel"):
        problem(axes="travel")
    with pytest.raises(InputError, match="at least 1 / duration"):
        problem(bandwidth=0.1, duration=3.0)


def test_information_needs_no_casadi_objects() -> None:
    plan = plan_excitation(problem())
    again = plan.problem.predicted_information(plan.space, plan.coefficients)
    np.testing.assert_allclose(np.linalg.inv(again), plan.predicted_covariance, rtol=1e-8, atol=1e-16)
    assert callable(information_of)


def test_files_of_a_plan(tmp_path: Path) -> None:
    plan = plan_excitation(problem())
    plan.save(tmp_path)
    names = (tmp_path / "trajectory.csv").read_text().splitlines()[0].split(",")
    data = np.loadtxt(tmp_path / "trajectory.csv", delimiter=",", skiprows=1)
    assert names == [
        "t",
        "px",
        "py",
        "pz",
        "qw",
        "qx",
        "qy",
        "qz",
        "fx",
        "fy",
        "fz",
        "mx",
        "my",
        "mz",
        "force_rms",
    ]
    assert data.shape == (plan.t.size, len(names))
    np.testing.assert_allclose(np.linalg.norm(data[:, 4:8], axis=1), 1.0, atol=1e-8)

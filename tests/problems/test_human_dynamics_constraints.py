"""Inequalities: each kind binds where it should, multipliers are honest, hard dynamics hold exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgrasp import solve
from factorgrasp.errors import InputError
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_constraints import (
    CentreOfPressure,
    DynamicsConstraint,
    FrictionPyramid,
    TorqueLimit,
    UnilateralContact,
    feet_on_the_floor,
)
from factorgrasp.problems.human_dynamics_sensors import ExternalWrench
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.solvers.frames import solve_frames

from .human_dynamics_body import standing

pytest.importorskip("pinocchio")
pytest.importorskip("piqp")
NOISE = HumanDynamicsNoise(1e-3, 1e-3, 1e-3)


def problem(
    *constraints: DynamicsConstraint, hard: bool = False, foot: object = None, count: int = 2
) -> HumanDynamics:
    """Noisy plates under both feet, loose enough for a constraint to move them."""
    motion, wrenches = standing(count)
    values = dict(wrenches)
    if foot is not None:
        values["left_foot"] = np.tile(foot, (count, 1))
    sensors = [ExternalWrench(values[link], 25.0, link=link) for link in ("left_foot", "right_foot")]
    return HumanDynamics(motion, sensors, NOISE, constraints=constraints, hard_dynamics=hard)


def wrench_of_foot(estimate, name="left_foot"):  # type: ignore[no-untyped-def]
    return estimate.external_wrench[:, estimate.links.index(name)]


def test_a_foot_does_not_pull() -> None:
    """A plate that reads a pull of 60 N gives a foot without normal force, and says so."""
    pull = np.array([0.0, 0.0, -60.0, 0.0, 0.0, 0.0])
    free = solve_frames(problem(foot=pull))
    held = solve_frames(problem(UnilateralContact("left_foot"), foot=pull))
    assert free.solved
    assert held.solved
    assert held.solver == "active-set"
    assert np.all(wrench_of_foot(free)[:, 2] < -1.0)
    assert np.allclose(wrench_of_foot(held)[:, 2], 0.0, atol=1e-6)
    assert {a.name for a in held.active} == {"unilateral contact of left_foot"}
    assert all(a.multiplier > 0.0 and "does not press" in a.words for a in held.active)
    assert np.all(held.external_wrench_sd[:, held.links.index("left_foot"), 2] < 1e-3)


def test_friction_and_sole() -> None:
    """Tangential force within the pyramid, centre of pressure within the sole: in the frame of the contact."""
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    p = np.array([0.02, 0.01, -0.05])
    slip = np.array([90.0, 0.0, 100.0, 0.0, -40.0, 0.0])
    friction = FrictionPyramid("left_foot", R, p, 0.5)
    held = solve_frames(problem(*feet_on_the_floor(("left_foot",), 0.5, R_l_s=R, p_l_s=p), foot=slip))
    w = wrench_of_foot(held)
    force = w[:, :3] @ R
    assert np.all(np.linalg.norm(force[:, :2], axis=1) <= 0.5 * force[:, 2] + 1e-6)
    assert np.any(
        np.linalg.norm(force[:, :2], axis=1) > 0.9 * 0.5 * force[:, 2] * np.cos(np.pi / friction.sides)
    )
    moment = (w[:, 3:] - np.cross(p, w[:, :3])) @ R
    pressure = np.stack([-moment[:, 1], moment[:, 0]], axis=1) / force[:, [2]]
    low, high = (
        CentreOfPressure("left_foot").corners.min(axis=0),
        CentreOfPressure("left_foot").corners.max(axis=0),
    )
    assert np.all(pressure > low - 1e-6)
    assert np.all(pressure < high + 1e-6)
    assert any("friction limit" in a.words for a in held.active)


def test_torque_limits_and_what_their_multiplier_means() -> None:
    """At its limit, and giving way by 1 mNm lowers half the chi-square by the multiplier's thousandth."""
    free = solve_frames(problem(count=1))
    j = free.dof_names.index("left_knee")
    limit = float(np.abs(free.torque[0, j])) * 0.8
    bound = TorqueLimit("left_knee", -limit, limit)
    one = problem(bound, count=1)
    held = solve(one, solver="piqp")
    assert np.abs(held.torque[0, j]) == pytest.approx(limit, abs=1e-6)
    assert held.torque_sd[0, j] < 1e-3
    active = held.active[0]
    assert "left_knee is at its" in active.words

    def cost(value: float) -> float:
        again = problem(TorqueLimit("left_knee", -value, value), count=1)
        system = again.frame(0)
        found = solve(again, solver="piqp")
        columns = again.system.columns
        x = np.concatenate([
            found.acceleration.ravel(), found.external_wrench.ravel(), found.joint_wrench.ravel(), found.joint_acceleration.ravel()
        ])  # fmt: skip
        assert x.size == system.size
        assert columns.joint_wrench.max() < x.size
        return system.objective(x)

    slope = (cost(limit - 0.01) - cost(limit + 0.01)) / 0.02
    assert active.multiplier == pytest.approx(slope, rel=1e-3)


def test_inactive_limits_change_nothing() -> None:
    """Far away limits: the same estimate and covariance as without."""
    free = solve_frames(problem())
    held = solve_frames(problem(TorqueLimit("left_knee", -1e4, 1e4)))
    assert np.allclose(free.torque, held.torque, atol=1e-5)
    assert np.allclose(free.torque_sd, held.torque_sd, rtol=1e-4)
    assert held.active == ()


def test_hard_dynamics() -> None:
    """As equality constraints: what tiny variances tend to, and exact."""
    hard = solve_frames(problem(hard=True))
    tight = problem()
    soft = solve_frames(
        HumanDynamics(tight.motion, tight.sensors, replace(NOISE, propagation=1e-9, balance=1e-9))
    )
    assert hard.solved
    assert hard.solver == "kkt"
    assert np.allclose(hard.torque, soft.torque, atol=1e-3)
    assert np.allclose(hard.torque_sd, soft.torque_sd, rtol=1e-3)
    both = solve_frames(problem(TorqueLimit("left_knee", -5.0, 5.0), hard=True))
    assert both.solved
    assert np.all(np.abs(both.torque[:, both.dof_names.index("left_knee")]) < 5.0 + 1e-5)


def test_bad_constraints_are_named() -> None:
    """Before any solve."""
    for make, words in (
        (lambda: problem(UnilateralContact("tail")), "link of unilateral"),
        (lambda: problem(TorqueLimit("tail", -1.0, 1.0)), "joint of torque limit"),
        (lambda: problem(TorqueLimit("left_knee", 1.0, -1.0)), "lower <= upper"),
        (lambda: problem(TorqueLimit("spine", [-1.0, -1.0], 1.0)), "3 limits"),
        (lambda: FrictionPyramid("left_foot", friction=0.0), "coefficient above zero"),
        (
            lambda: CentreOfPressure("left_foot", corners=np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]])),
            "counter-clockwise",
        ),
    ):
        with pytest.raises(InputError, match=words):
            make()


def test_active_set_equals_a_qp_solver() -> None:
    """Torque limits, friction and soles at once, in frames where many bind: the same optimum, multipliers and covariance as piqp's."""
    made = problem(count=6)
    free = solve_frames(made)
    limits = [
        TorqueLimit(name, -0.7 * np.abs(free.torque[:, free.dof_names.index(name)]).max(), 1e3)
        for name in ("left_knee", "right_knee", "left_elbow")
    ]
    bound = HumanDynamics(
        made.motion,
        made.sensors,
        NOISE,
        constraints=[*limits, *feet_on_the_floor(("left_foot", "right_foot"))],
    )
    fast, slow = solve_frames(bound), solve_frames(bound, "piqp")
    assert fast.solved
    assert slow.solved
    assert len(fast.active) > 4
    assert np.allclose(fast.torque, slow.torque, atol=1e-5)
    assert np.allclose(fast.external_wrench, slow.external_wrench, atol=1e-4)
    # A foot without any force is at all its limits at once: which of them hold it there is anybody's choice.
    lifted = {a.frame for a in fast.active if a.name.startswith("unilateral")}
    ours = {(a.frame, a.name, a.row): a.multiplier for a in fast.active if a.frame not in lifted}
    theirs = {(a.frame, a.name, a.row): a.multiplier for a in slow.active if a.frame not in lifted}
    assert len(ours) > 2
    assert set(ours) == set(theirs)
    assert all(ours[key] == pytest.approx(theirs[key], rel=1e-3, abs=1e-5) for key in ours)
    firm = [f for f in range(6) if f not in lifted]
    assert np.allclose(fast.torque_sd[firm], slow.torque_sd[firm], rtol=1e-2, atol=1e-3)

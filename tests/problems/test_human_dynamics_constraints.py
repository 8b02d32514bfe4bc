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
from factorgrasp.solvers.frame_active_set import ActiveSetSolver
from factorgrasp.solvers.frame_piqp import PiqpFrames
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
    assert slow.solver == "piqp"
    assert np.allclose(fast.torque, slow.torque, atol=1e-6)
    assert np.allclose(fast.external_wrench, slow.external_wrench, atol=1e-6)
    assert np.allclose(fast.joint_wrench, slow.joint_wrench, atol=1e-6)
    # And as the general solver has it, frame by frame from its own iterate.
    for f in (0, 3):
        alone = solve(bound.at(f), solver="piqp")
        assert np.allclose(fast.torque[f], alone.torque[0], atol=1e-5)
    # A foot without any force is at all its limits at once: which of them hold it there is anybody's choice.
    lifted = {a.frame for a in fast.active if a.name.startswith("unilateral")}
    ours = {(a.frame, a.name, a.row): a.multiplier for a in fast.active if a.frame not in lifted}
    theirs = {(a.frame, a.name, a.row): a.multiplier for a in slow.active if a.frame not in lifted}
    assert len(ours) > 2
    assert set(ours) == set(theirs)
    assert all(ours[key] == pytest.approx(theirs[key], rel=1e-5, abs=1e-6) for key in ours)
    firm = [f for f in range(6) if f not in lifted]
    assert np.allclose(fast.torque_sd[firm], slow.torque_sd[firm], rtol=1e-4, atol=1e-6)


def test_optimality_of_the_active_set() -> None:
    """Conditions of Karush, Kuhn and Tucker, computed apart from both paths: no descent is left but against a limit that pushes back."""
    made = problem(count=4)
    free = solve_frames(made)
    j = free.dof_names.index("left_knee")
    limit = TorqueLimit(
        "left_knee", -0.6 * np.abs(free.torque[:, j]).max(), 0.6 * np.abs(free.torque[:, j]).max()
    )
    bound = HumanDynamics(
        made.motion, made.sensors, NOISE, constraints=[limit, *feet_on_the_floor(("left_foot", "right_foot"))]
    )
    for machine in (ActiveSetSolver(bound), PiqpFrames(bound)):
        found = machine.solve(slice(0, 4), covariance=False)
        # A foot without any force is at all of its limits: there the plain active set may go round in circles, and says so.
        assert found.settled.sum() >= 3
        for f in np.flatnonzero(found.settled):
            system = bound.frame(f)
            A, b = system.whitened()
            G, h = system.inequalities.matrix, system.inequalities.rhs
            x, z = found.result.x[f], found.result.solutions[f].z
            gradient, push = A.T @ (A @ x - b), G.T @ z
            size = np.abs(A.T @ np.abs(b)).max()
            assert np.abs(gradient + push).max() < 1e-9 * size
            assert (G @ x - h).max() < 1e-6
            assert np.abs(z * (h - G @ x)).max() < 1e-6 * max(z.max(), 1.0)
            assert z.min() >= 0.0


def test_hard_and_soft_dynamics_with_limits() -> None:
    """Equality constraints and inequalities together: Newton-Euler holds exactly, limits hold, and it is what a
    trusted soft model tends to."""
    made = problem(count=2)
    free = solve_frames(made)
    j = free.dof_names.index("right_knee")
    limit = 0.7 * float(np.abs(free.torque[:, j]).max())
    bounds = [TorqueLimit("right_knee", -limit, limit), *feet_on_the_floor(("left_foot",), friction=0.4)]
    hard = solve_frames(
        HumanDynamics(made.motion, made.sensors, NOISE, constraints=bounds, hard_dynamics=True)
    )
    tight = replace(NOISE, propagation=1e-8, balance=1e-8)
    soft = solve_frames(HumanDynamics(made.motion, made.sensors, tight, constraints=bounds))
    assert hard.solved
    assert soft.solved
    assert np.allclose(hard.torque, soft.torque, atol=2e-2)
    assert {(a.frame, a.name, a.row) for a in hard.active if a.name.startswith("torque")} == {
        (a.frame, a.name, a.row) for a in soft.active if a.name.startswith("torque")
    }
    system = HumanDynamics(made.motion, made.sensors, NOISE, constraints=bounds, hard_dynamics=True)
    for f in range(2):
        frame = system.frame(f)
        x = np.zeros(frame.size)
        columns = system.system.columns
        x[columns.acceleration.ravel()] = hard.acceleration[f].ravel()
        x[columns.external_wrench.ravel()] = hard.external_wrench[f].ravel()
        x[columns.joint_wrench.ravel()] = hard.joint_wrench[f].ravel()
        x[np.concatenate(columns.joint_acceleration)] = hard.joint_acceleration[f]
        assert np.abs(frame.equalities.matrix @ x - frame.equalities.rhs).max() < 1e-6


@pytest.mark.parametrize("variance", [1e-12, 1e-4, 1.0])
@pytest.mark.parametrize("solver", ["active-set", "piqp"])
def test_limits_with_covariances_over_twelve_orders(solver: str, variance: float) -> None:
    """Model variances from 1e-12 to 1 beside plates of 25 N^2 and priors of 1e6: limits hold, variances are those of
    a dense QR with the active rows."""
    made = problem(count=2)
    noise = HumanDynamicsNoise(variance, variance, max(variance, 1e-12))
    free = solve_frames(HumanDynamics(made.motion, made.sensors, noise))
    j = free.dof_names.index("left_knee")
    limit = 0.8 * float(np.abs(free.torque[:, j]).min())
    bound = HumanDynamics(
        made.motion, made.sensors, noise, constraints=[TorqueLimit("left_knee", -limit, limit)]
    )
    held = solve_frames(bound, solver)
    assert held.solved
    assert held.solver == solver
    assert np.allclose(np.abs(held.torque[:, j]), limit, atol=1e-6)
    A, b = bound.frame(1).whitened()
    G, h = bound.frame(1).inequalities.matrix.toarray(), bound.frame(1).inequalities.rhs
    row = next(a.row for a in held.active if a.frame == 1)
    # Null space of the active row, then an orthogonal factor, which squares nothing.
    basis = np.linalg.svd(G[[row]])[2][1:].T
    start = np.linalg.lstsq(G[[row]], h[[row]], rcond=None)[0]
    dense = A.toarray()
    Q, R = np.linalg.qr(dense @ basis)
    x = start + basis @ np.linalg.solve(R, Q.T @ (b - dense @ start))
    columns = bound.system.columns.joint_wrench.ravel()
    assert np.allclose(held.joint_wrench[1].ravel(), x[columns], atol=1e-6 if variance > 1e-6 else 0.02)
    machine = ActiveSetSolver(bound) if solver == "active-set" else PiqpFrames(bound)
    ours = machine.solve(slice(1, 2), covariance=False).result.x[0]
    cost = float(np.sum((dense @ ours - b) ** 2))
    assert cost <= (1.0 + 1e-6) * float(np.sum((dense @ x - b) ** 2))
    sd = np.sqrt(np.sum((basis @ np.linalg.inv(R)) ** 2, axis=1))[columns]
    free_sd = free.torque_sd[1, j]
    assert np.allclose(held.joint_wrench_sd[1].ravel(), sd, rtol=1e-4, atol=2e-3 * free_sd)

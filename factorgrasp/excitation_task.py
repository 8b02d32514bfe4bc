"""An excitation as a problem file makes it: task space first, then the robot's joints, then one plan with all its margins."""

from __future__ import annotations

import hashlib
import time
from dataclasses import replace
from typing import Any

import numpy as np

from factorgrasp.estimate import Estimate
from factorgrasp.excitation_plan import ExcitationPlan
from factorgrasp.problems.excitation import Excitation, Margin
from factorgrasp.problems.excitation_arm import follow
from factorgrasp.problems.excitation_program import TrajectoryProgram
from factorgrasp.problems.excitation_space import PlanSpace
from factorgrasp.provenance import versions
from factorgrasp.solvers.nlp import NlpSolver, get_nlp_solver
from factorgrasp.solvers.nlp_exchange import ExchangeResult, solve_by_exchange
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray

MISSED = 1e-3
"""m and rad: a tool pose that inverse kinematics misses by more is out of the robot's reach."""
MOST_PAIR_ROUNDS = 3
IK_STEPS = 8
"""Poses per period of the bandwidth that inverse kinematics follows."""


class ExcitationTask:
    """A plan to be made.

    Parameters
    ----------
    problem : Excitation
    options : dict, optional
        Of the solver: ``max_iterations``, ``tolerance``, ``time_limit``, ``extra``.
    """

    kind = "excitation"

    def __init__(self, problem: Excitation, options: dict[str, Any] | None = None) -> None:
        self.problem, self.options = problem, options or {}

    def nonlinear_program(self) -> TrajectoryProgram:
        """The plan in task space, on which solvers are compared."""
        return self.problem.nonlinear_program()

    def solve(self, solver: str | None = None, seed: int | None = None) -> ExcitationPlan:
        """Plan.

        Parameters
        ----------
        solver : str, optional
            One that takes nonlinear programs; ipopt by default.
        seed : int, optional
            Of a random start, in place of the deterministic one.
        """
        return plan_excitation(self.problem, get_nlp_solver(solver, **self.options), seed)


def plan_excitation(
    problem: Excitation, solver: NlpSolver | None = None, seed: int | None = None
) -> ExcitationPlan:
    """The motion that meets the demand with the least wrench at the human's wrist, and what the fine grid shows of it.

    Raises
    ------
    SolverError
        When the solver takes no nonlinear programs.
    """
    began = time.perf_counter()
    chosen = solver or get_nlp_solver()
    outside = _outside(problem) or _blind(problem)
    start = problem.start(seed)
    space = problem.task
    if outside:
        result = None
        C, status, message = 0.0 * start, Status.INFEASIBLE, outside
    else:
        result = solve_by_exchange(problem, space, chosen, start)
        C, status, message = result.C, result.status, _words(problem, result)
    timing = {"task": time.perf_counter() - began}
    if problem.arm is not None and not outside:
        C_task = C
        t, q, missed = _inverse_kinematics(problem, C_task)
        timing["inverse_kinematics"] = time.perf_counter() - began - timing["task"]
        if missed:
            status, message, result = Status.INFEASIBLE, missed, None
        else:
            space = problem.joint
            start = problem.fit(space, t, q)
            C = start
            if status.ok and problem.settings.refine:
                problem, result = _in_joints(problem, chosen, start)
                space = problem.joint
                C, status, message = result.C, result.status, _words(problem, result)
            timing["joint"] = time.perf_counter() - began - sum(timing.values())
    share = 1.0 if result is None else result.share
    check = problem.check(space, C, problem.first_points(space), share)
    if status.ok:
        bad = check.violated
        if bad:
            status = Status.NOT_CONVERGED
            message = "limits are violated: " + "; ".join(margin_words(one) for one in bad[:4])
        elif check.share < 1.0:
            status, message = (
                Status.INFEASIBLE,
                f"inverse kinematics leave {check.share:.4g} of the excitation",
            )
    timing["solve"] = time.perf_counter() - began
    estimate = Estimate(
        status, problem.kind, chosen.name, (), {}, message,
        objective=_objective(problem, space, C),
        iterations=0 if result is None else result.iterations,
        timing=timing, versions=versions(("casadi", "pin", "numpy")), problem_hash=_hash(problem),
    )  # fmt: skip
    binding = () if result is None else result.binding
    return ExcitationPlan.of(problem, space, C, estimate, check, binding, 0.0 if outside else check.share)


def _in_joints(
    problem: Excitation, solver: NlpSolver, start: FloatArray
) -> tuple[Excitation, ExchangeResult]:
    """The plan in joint space; pairs of links that it brings too near are planned with, too."""
    result = solve_by_exchange(problem, problem.joint, solver, start)
    for _ in range(MOST_PAIR_ROUNDS):
        near = problem.near_pairs(result.C)
        if not near or not result.status.ok:
            return problem, result
        assert problem.arm is not None
        others = tuple(pair for pair in problem.arm.others if pair not in near)
        problem = problem.with_arm(replace(problem.arm, pairs=problem.arm.pairs + near, others=others))
        result = solve_by_exchange(problem, problem.joint, solver, result.C)
    if problem.near_pairs(result.C):
        words = "; ".join(
            sorted({f"distance between {words}" for _, _, words in problem.near_pairs(result.C)})[:3]
        )
        result = replace(result, status=Status.NOT_CONVERGED, message=f"links come too near: {words}")
    return problem, result


def margin_words(margin: Margin) -> str:
    """A margin in words."""
    what = f"{margin.name}: {margin.value:.4g} {margin.unit} at {margin.time:.2f} s, limit {margin.limit:.4g} {margin.unit}"
    return what


def _objective(problem: Excitation, space: PlanSpace, C: FloatArray) -> float:
    """Mean energy of the wrench, relative to the comfort values, on the fine grid."""
    z = np.concatenate([problem.on_grid(space, C, order) for order in range(3)])
    energy = space.integrand.values(z, space.motion.given(problem.grid))[:, 0]
    return float(np.trapezoid(energy, problem.grid) / problem.settings.duration)


def _words(problem: Excitation, result: ExchangeResult) -> str:
    if result.status.ok:
        return f"every limit and window holds; {result.message}" if result.message else ""
    s = problem.settings
    asked = f"alpha = {s.alpha:g} rad^2/s^3" if s.alpha is not None else "the target sd"
    limits = [word for word in result.binding if not word.startswith("excitation between")]
    if result.status is not Status.INFEASIBLE:
        return f"{result.message}; near its end bind: " + ("; ".join(limits[:4]) or "no limit")
    words = f"{asked} cannot be had within the limits: about {max(result.share, result.check.share):.2g} of it can"
    blind = _blind(problem)
    if limits:
        words += "; what binds: " + "; ".join(limits[:5])
    if blind:
        words += f"; {blind}"
    if not limits and not blind:
        words += "; what binds: the bandwidth and the rest at the ends"
    return words


def _blind(problem: Excitation) -> str:
    """The lever arm along which nothing can be seen, when the motion keeps one axis."""
    s = problem.settings
    if s.axes != "travel" or s.alpha is None:
        return ""
    times = np.linspace(0.0, s.duration, 101)[1:-1]
    directions = problem.human.axis(times).T
    if np.linalg.matrix_rank(directions, tol=0.02) > 1 or np.ptp(problem.human.turn(times)) > 1e-3:
        return ""
    return (
        f"turning about one direction of travel ({', '.join(f'{x:.2g}' for x in directions[0])}) alone never shows the lever arm along "
        "it: travel in two directions, or let the axes be free"
    )


def _outside(problem: Excitation) -> str:
    """Why the tool cannot even begin, in words."""
    arm, t = problem.arm, np.zeros(1)
    R = problem.human.orientation(t)[0] @ problem.grasp.rotation.T
    p = problem.human.position(t)[0][:, 0] - R @ problem.grasp.translation
    place = f"({', '.join(f'{x:.3f}' for x in p)}) m"
    if arm is None:
        return ""
    low, high = arm.limits.box_lower, arm.limits.box_upper
    if low is not None and high is not None and (np.any(p < low) or np.any(p > high)):
        axes = [
            f"{a} (range {low[k]:g} to {high[k]:g} m)"
            for k, a in enumerate("xyz")
            if not low[k] <= p[k] <= high[k]
        ]
        return f"with this grasp the end-effector begins at {place}, outside the workspace box along {', '.join(axes)}"
    from factorgrasp.problems.excitation_arm import tool_pose

    _found_R, found_p = tool_pose(arm.robot.model, arm.frame, arm.start)
    miss = float(np.linalg.norm(found_p - p))
    if miss > MISSED:
        q, left = arm.start, miss
        at = [
            str(arm.robot.model.names[j + 1]) for j in range(arm.robot.nv)
            if min(q[j] - arm.limits.position_lower[j], arm.limits.position_upper[j] - q[j])
            < 0.03 * (arm.limits.position_upper[j] - arm.limits.position_lower[j])
        ]  # fmt: skip
        return (
            f"the grasp is outside the robot's workspace: the end-effector would have to begin at {place}, {np.linalg.norm(p):.2f} m from "
            f"the base, and comes no nearer than {left:.3f} m"
            + (f"; joints at their limits: {', '.join(at)}" if at else "")
        )
    return ""


def _inverse_kinematics(problem: Excitation, C: FloatArray) -> tuple[FloatArray, FloatArray, str]:
    """Joint positions along the plan in task space, and what it says when a pose is out of reach."""
    assert problem.arm is not None
    arm, s = problem.arm, problem.settings
    count = int(np.ceil(IK_STEPS * s.duration * s.bandwidth))
    t = np.linspace(0.0, s.duration, count + 1)
    space = problem.task
    z = space.motion.at(C, t).reshape(-1, t.size)
    read = space.read.values(z, space.motion.given(t))
    R, p = read[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1), read[:, 9:12]
    q, errors = follow(arm.robot.model, arm.frame, arm.limits, arm.start, R, p)
    k = int(np.argmax(errors))
    if errors[k] <= MISSED:
        return t, q, ""
    names = [
        str(arm.robot.model.names[j + 1]) for j in range(arm.robot.nv)
        if min(q[j, k] - arm.limits.position_lower[j], arm.limits.position_upper[j] - q[j, k])
        < 0.03 * (arm.limits.position_upper[j] - arm.limits.position_lower[j])
    ]  # fmt: skip
    words = (
        f"the motion leaves the robot's workspace: at {t[k]:.2f} s the end-effector would have to be at "
        f"({', '.join(f'{x:.3f}' for x in p[k])}) m, {np.linalg.norm(p[k]):.2f} m from the base, and misses it by {errors[k]:.3g} (m, rad)"
    )
    return (
        t,
        q,
        words
        + (
            f"; joints at their limits: {', '.join(names)}"
            if names
            else "; the arm is stretched out or singular there"
        ),
    )


def _hash(problem: Excitation) -> str:
    """SHA-256 of what decides the plan."""
    digest = hashlib.sha256()
    times = np.linspace(0.0, problem.settings.duration, 33)
    arrays = [
        problem.grasp.rotation,
        problem.grasp.translation,
        problem.grasp.covariance,
        problem.human.given(problem.grasp.rotation)(times),
        problem.gravity,
    ]
    if problem.arm is not None:
        limits = [value for value in vars(problem.arm.limits).values() if value is not None]
        arrays += [problem.arm.start, *map(np.asarray, limits)]
    for array in arrays:
        digest.update(np.ascontiguousarray(np.round(array, 12) + 0.0, dtype=np.float64).tobytes())
    digest.update(repr((problem.settings, problem.wrist, problem.noise)).encode())
    return digest.hexdigest()

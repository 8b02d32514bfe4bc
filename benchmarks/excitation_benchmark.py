"""Planned excitations: closed form, one optimum, the Panda under all limits, against the paper's reference, solvers, refusals.

    OMP_NUM_THREADS=1 python benchmarks/excitation_benchmark.py [--starts 10] [--quick] [--out benchmarks/results]

Writes ``excitation_benchmark.md`` and ``excitation_benchmark.json``; ends with exit code 1 when a target is missed. About four minutes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from metrics import Metric, metric_table, missed

from factorgrasp import compare, lie
from factorgrasp.atomic import write_text
from factorgrasp.excitation_plan import ExcitationPlan
from factorgrasp.excitation_task import ExcitationTask, plan_excitation
from factorgrasp.models.casadi_robot import CasadiRobot
from factorgrasp.models.robot import load_robot
from factorgrasp.problems.excitation import GRAVITY, ArmTask, Excitation, information_of
from factorgrasp.problems.excitation_arm import limits_of, link_spheres, tool_chain, tool_pose
from factorgrasp.problems.excitation_human import static_human
from factorgrasp.problems.excitation_settings import ExcitationSettings, GraspBelief, HumanWrist
from factorgrasp.simulation.cehajic2015 import PRINTED_RATE
from factorgrasp.solvers.measure import environment

ROBOTS = Path(pin.__file__).resolve().parents[4] / "share/example-robot-data/robots"
PANDA = ROBOTS / "panda_description/urdf/panda_collision.urdf"
START = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
LEVER = np.array([0.4, 0.1, 0.05])
ACCELERATION = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
JERK = np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0])
"""The Panda's limits by its maker (rad/s^2, rad/s^3); the URDF has none."""


def robots() -> Iterator[Metric]:
    """The CasADi robot against pinocchio on every URDF."""
    worst, count = 0.0, 0
    for path in sorted(ROBOTS.rglob("*.urdf")):
        try:
            model = pin.buildModelFromUrdf(str(path))
        except ValueError:
            continue
        if not model.nv:
            continue
        robot, data = CasadiRobot(model), model.createData()
        model.lowerPositionLimit = np.clip(model.lowerPositionLimit, -3.0, 3.0)
        model.upperPositionLimit = np.clip(model.upperPositionLimit, -3.0, 3.0)
        pin.seed(count)
        rng = np.random.default_rng(count)
        q, v, a = pin.randomConfiguration(model), rng.normal(size=model.nv), rng.normal(size=model.nv)
        right = pin.rnea(model, data, q, v, a)
        found = np.array(robot.rnea_function()(q, v, a)).ravel()
        worst = max(worst, float(np.max(np.abs(found - right)) / (1.0 + np.max(np.abs(right)))))
        count += 1
    yield Metric("robot/urdf", count, "", "none", None, "read by pinocchio, with a joint")
    yield Metric(
        "robot/torque_difference", worst, "", "lower", 1e-10, "largest, relative, on a random state of each"
    )


def task(wrist: HumanWrist | None = None, **settings: Any) -> Excitation:
    """A resting wrist without a robot."""
    made = ExcitationSettings(
        **({"alpha": 10.0, "window": 5.0, "duration": 10.0, "bandwidth": 1.0} | settings)
    )
    return Excitation(
        GraspBelief(translation=LEVER), static_human(made.duration, np.zeros(3), np.eye(3)), made, wrist
    )


def coning() -> Iterator[Metric]:
    """Against ``lambda_min = T w^4 A^2 / 2``, steady and from rest to rest."""
    for bandwidth in (0.5, 1.0, 2.0):
        plan = plan_excitation(
            task(rest=False, centred=False, bandwidth=bandwidth, alpha=10.0 * bandwidth, duration=5.0)
        )
        ratio = plan.coning_ratio if plan.status.ok and plan.share >= 1.0 else np.nan
        yield Metric(
            f"coning/steady_{bandwidth:g}_hz",
            ratio,
            "",
            "lower",
            1.001,
            "mean square of the turn over coning's",
        )
    rest = plan_excitation(task(centred=False))
    yield Metric(
        "coning/rest_to_rest",
        rest.coning_ratio,
        "",
        "none",
        None,
        "two windows of 5 s, at rest at 0 and 10 s",
    )


def starts(count: int) -> Iterator[Metric]:
    """One optimum from random starts, and its time."""
    objectives, seconds, processor = [], [], []
    for seed in range(count):
        began, used = time.perf_counter(), time.process_time()
        plan = plan_excitation(task(), seed=seed)
        seconds.append(time.perf_counter() - began)
        processor.append(time.process_time() - used)
        objectives.append(plan.objective if plan.status.ok else np.nan)
    yield Metric(
        "starts/spread",
        float(np.ptp(objectives) / np.min(objectives)),
        "",
        "lower",
        0.01,
        f"{count} random starts",
    )
    yield Metric("starts/seconds", float(np.median(seconds)), "s", "lower", 3.0, "median, wall clock")
    yield Metric("starts/processor_seconds", float(np.median(processor)), "s", "none", None, "median")


def panda(tight: bool) -> ExcitationPlan:
    """The Panda under all its limits; `tight`: at a demand that makes its velocity and comfort limits bind."""
    full = load_robot(PANDA)
    model = tool_chain(full, "panda_hand")
    robot, grasp = CasadiRobot(model), GraspBelief(translation=LEVER)
    stated: dict[str, Any] = {"acceleration": ACCELERATION, "jerk": JERK, "collision_distance": 0.01,
                              "box_lower": np.array([0.1, -0.6, 0.1]), "box_upper": np.array([0.9, 0.6, 1.0])}  # fmt: skip
    if tight:
        stated |= {"velocity": 0.6, "acceleration": 0.5 * ACCELERATION}
    limits = limits_of(model, stated)
    spheres, pairs = link_spheres(robot, PANDA, full, START, 0.01)
    R, p = tool_pose(model, "panda_hand", START)
    settings = ExcitationSettings(alpha=10.0, window=5.0, duration=10.0, bandwidth=1.0)
    arm = ArmTask(robot, "panda_hand", limits, START, None, spheres, pairs[:40], pairs[40:])
    return plan_excitation(
        Excitation(
            grasp, static_human(10.0, p + R @ LEVER, R), settings, HumanWrist(max_rotation=0.15), arm=arm
        )
    )


def joints(quick: bool) -> Iterator[Metric]:
    """Time, margins and excitation on the fine grid."""
    for name, tight in (("panda", False), ("panda_tight", True))[: 1 if quick else 2]:
        began, used = time.perf_counter(), time.process_time()
        plan = panda(tight)
        seconds, processor = time.perf_counter() - began, time.process_time() - used
        least = min(plan.check.margins, key=lambda one: one.relative)
        yield Metric(
            f"{name}/seconds",
            seconds,
            "s",
            "lower",
            30.0,
            "task space, inverse kinematics and joint space, wall clock",
        )
        yield Metric(f"{name}/processor_seconds", processor, "s")
        yield Metric(f"{name}/solved", float(plan.status.ok), "", "higher", 1.0, plan.message)
        yield Metric(
            f"{name}/least_margin",
            least.relative,
            "",
            "higher",
            -1e-6,
            f"of {len(plan.check.margins)} limits at 1 ms: {least.name}",
        )
        yield Metric(
            f"{name}/least_window",
            plan.share,
            "",
            "higher",
            1.0,
            f"of {plan.check.window_start.size} windows, over alpha",
        )
        yield Metric(
            f"{name}/force_rms",
            float(np.sqrt(np.mean(plan.force_rms**2))),
            "N",
            note="with 5 cm of uncertainty",
        )


def reference(duration: float, problem: Excitation) -> tuple[np.ndarray, float, float]:
    """The paper's motion about the (known) wrist: information (6, 6), RMS and peak turn."""
    t = np.linspace(0.0, duration, 20001)
    size = float(np.linalg.norm(PRINTED_RATE))
    axis = PRINTED_RATE / size
    angle = size * (1.0 - np.cos(t))
    R = lie.so3_exp(angle[:, None] * axis)
    read = np.zeros((t.size, 28))
    read[:, 12:15], read[:, 15:18] = size * np.sin(t)[:, None] * axis, size * np.cos(t)[:, None] * axis
    read[:, 18:21] = np.einsum("nji,j->ni", R, -GRAVITY)
    return (
        information_of(read, t, problem.sensor_noise, problem.grasp.information_r),
        float(np.sqrt(np.mean(angle**2))),
        float(np.max(angle)),
    )


def paper() -> Iterator[Metric]:
    """Same bandwidth and peak speed: what is known of the worst direction; same knowledge: what the wrist feels."""
    duration, bandwidth, peak = 8.0 * np.pi, 1.0 / (2.0 * np.pi), float(np.linalg.norm(PRINTED_RATE))
    belief = GraspBelief(
        translation=np.array([1.11, 0.16, 0.08]), covariance=np.diag([0.5**2] * 3 + [0.6**2] * 3)
    )
    human, wrist = static_human(duration, np.zeros(3), np.eye(3)), HumanWrist(max_rotation=1.6)
    shared = {"duration": duration, "bandwidth": bandwidth, "max_angular_velocity": peak, "step": 5e-3}

    def made(**demand: Any) -> Excitation:
        return Excitation(belief, human, ExcitationSettings(**shared, **demand), wrist)

    information, rms, most = reference(duration, made(alpha=1.0))
    spread = np.linalg.eigvalsh(np.linalg.inv(information)[3:, 3:])
    worst, seen = float(np.sqrt(spread[-1])), float(np.sqrt(spread[-2]))
    yield Metric(
        "paper/reference_worst_sd",
        1000.0 * worst,
        "mm",
        note="lever arm along the one axis; 600 mm was known before",
    )
    yield Metric("paper/reference_seen_sd", 1000.0 * seen, "mm", note="the directions across the axis")
    fast = plan_excitation(made(alpha=1e3))
    planned = float(np.sqrt(np.linalg.eigvalsh(fast.predicted_covariance[3:, 3:])[-1]))
    speed = float(np.max(np.linalg.norm(fast.angular_velocity, axis=1)))
    yield Metric(
        "paper/planned_worst_sd",
        1000.0 * planned,
        "mm",
        note=f"peak speed {speed:.3f} of {peak:.3f} rad/s; {fast.share * 1e3:.3g} rad^2/s^3",
    )
    yield Metric(
        "paper/planned_below_prior",
        float(planned < 0.1 * worst),
        "",
        "higher",
        1.0,
        "every direction is seen, at no more than the reference's bandwidth, peak speed and duration",
    )
    equal = plan_excitation(made(translation_sd=seen))
    turn = np.linalg.norm(equal.turn, axis=1)
    found = float(np.sqrt(np.linalg.eigvalsh(equal.predicted_covariance[3:, 3:])[-1]))
    yield Metric(
        "paper/equal_worst_sd",
        1000.0 * found,
        "mm",
        note="planned to know every direction as the reference knows two",
    )
    # Knowledge grows with the turn: a plan that ends a little short of the reference's would need that much more of it.
    short = found / seen
    yield Metric(
        "paper/moment_rms_ratio",
        rms / (short * float(np.sqrt(np.mean(turn**2)))),
        "",
        "higher",
        1.0,
        "reference over planned, at equal knowledge of the worst direction that the reference sees",
    )
    yield Metric(
        "paper/moment_peak_ratio", most / (short * float(np.max(turn))), "", "none", None, "the same"
    )


def solvers() -> Iterator[Metric]:
    """One program, several solvers."""
    rows = compare(
        {"plan": ExcitationTask(task(duration=5.0))}, ["ipopt", "fatrop", "sqpmethod"], repeat=1
    ).rows
    best = min(row.objective for row in rows if row.correct and row.objective is not None)
    for row in rows:
        yield Metric(
            f"solver/{row.solver}",
            (row.solve or np.nan) * 1e3,
            "ms",
            note=f"{row.status}, {row.iterations} iterations, above best {((row.objective or np.nan) - best) / best:.0e}",
        )
    agreeing = sum(bool(row.correct) and row.status == "solved" for row in rows)
    yield Metric("solver/agreeing", agreeing, "", "higher", 2.0, "solved, and right by our own check")


def refusals() -> Iterator[Metric]:
    """What cannot be had names what binds."""
    plan = plan_excitation(task(alpha=2000.0, duration=4.0, window=4.0, max_angular_velocity=0.8))
    named = not plan.status.ok and "angular velocity of the end-effector" in plan.message
    yield Metric("refusal/speed", float(named), "", "higher", 1.0, plan.message)
    plan = plan_excitation(task(alpha=2000.0, duration=4.0, window=4.0))
    named = not plan.status.ok and "max_rotation" in plan.message
    yield Metric("refusal/comfort", float(named), "", "higher", 1.0, plan.message)


def main() -> int:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    chosen = parser.parse_args()
    parts = [
        robots(),
        coning(),
        starts(chosen.starts if not chosen.quick else 3),
        joints(chosen.quick),
        paper(),
        solvers(),
        refusals(),
    ]
    metrics: list[Metric] = []
    for part in parts:
        for metric in part:
            metrics.append(metric)
            print(
                f"{metric.key}: {metric.value:.6g} {metric.unit} {metric.verdict} ({metric.note})",
                flush=True,
            )
    table = metric_table(metrics, "Planned excitations")
    conditions = environment(["factorgrasp", "casadi", "pin", "numpy"])
    write_text(chosen.out / "excitation_benchmark.md", table.markdown() + "\n")
    record = {"conditions": conditions, "metrics": [m.to_dict() for m in metrics]}
    write_text(chosen.out / "excitation_benchmark.json", json.dumps(record, indent=1) + "\n")
    return 1 if missed(metrics) else 0


if __name__ == "__main__":
    sys.exit(main())

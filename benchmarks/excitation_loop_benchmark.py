"""Excitation in closed loop, and of a real log: does the loop find the grasp and spare the wrist, and does the measure say what is true.

    OMP_NUM_THREADS=1 python benchmarks/excitation_loop_benchmark.py [--seeds 10] [--data ../shared/data] [--json out.json]

What is measured:

- closed loop: the receding plan on a simulated seven-axis arm from the paper's wrong start (0.64 m, 120 deg), beside the paper's procedure
  (law (26) fed with the moving estimate of its own estimator, printed motion) on the same noise, and the law (26) fed with our estimate;
- Fig. 5: the printed motion about a biased, the estimated and the true lever arm under the printed impedance;
- the measure: predicted sigma against the scatter of batch estimates (NEES per degree of freedom);
- the real Panda log: predicted sigma and wrist wrench, torques of the model against the measured ones; and a motion about the wrist,
  within the same arm's limits and no longer than the log, that shows the grasp as well or better.

Limits: the wrist is a spring of 300 N/m and 2 Nm/rad, which the paper does not print; the arm's model is exact, its encoders are good
(0.01 mrad). No arm of this size can follow the printed motion about the wrist: the paper's procedure runs without one.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp import lie, solve
from factorgrasp.errors import InfeasibleError
from factorgrasp.excitation_evaluate import ExcitationEvaluationTask
from factorgrasp.excitation_evaluation import ExcitationEvaluation
from factorgrasp.excitation_prediction import predict_grasp
from factorgrasp.models.arm import Arm, panda_arm, panda_urdf
from factorgrasp.models.robot import load_robot
from factorgrasp.pose_reference import Blend, about_point, times
from factorgrasp.problem_file import load_problem
from factorgrasp.problems import GraspPose
from factorgrasp.problems.grasp_kinematics import robot_kinematics
from factorgrasp.problems.grasp_settings import GraspNoise
from factorgrasp.recordings import JointStream
from factorgrasp.simulation.cehajic2015 import ENCODER_NOISE, XSENS, cehajic2015
from factorgrasp.simulation.cehajic2015_loop import cehajic2015_loop
from factorgrasp.simulation.grasp_loop_figures import PAPER_ESTIMATE, reproduce_fig5, spring_force
from factorgrasp.simulation.trajectory import Sinusoids
from factorgrasp.uncertainty import nees_band

sys.path.insert(0, str(Path(__file__).parent))
from metrics import Metric, metric_table, missed

SECONDS = 20.0
LATE = 5.0
FEW = 3
"""Seeds of what is only shown for comparison."""
LEVER = np.array([0.5, 0.0, 0.1])
"""Lever arm at which the real log is judged, m; the log itself has no hand."""
FRAME = "panda_hand_tcp"
HELD = LEVER * (1.0, -1.0, -1.0)
"""The same point in the frame in which the arm's model is led: x alike, y and z the other way."""
# Published by Franka for the Panda: rad/s^2; the URDF has no accelerations.
ACCELERATION = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])


def closed_loop(seeds: int) -> list[Metric]:
    """Rows of the receding plan and of the paper's procedure, seed by seed on the same noise."""
    ours, theirs, law, clock, cpu = [], [], [], [], []
    for seed in range(seeds):
        start = time.process_time()
        ours.append(cehajic2015_loop(seed, duration=SECONDS))
        cpu.append(time.process_time() - start)
        theirs.append(cehajic2015_loop(seed, duration=SECONDS, policy="velocity", arm=False))
        if seed < FEW:
            law.append(cehajic2015_loop(seed, duration=SECONDS, policy="velocity_online"))
            clock.append(cehajic2015_loop(seed, duration=SECONDS, time_offset=True))
        print(f"seed {seed}", file=sys.stderr)
    lever = np.array([run.translation_error[-1] for run in ours])
    angle = np.degrees([run.rotation_error[-1] for run in ours])
    when = np.array([run.settled(np.deg2rad(0.2), 5e-3) for run in ours])
    sd = np.array([run.translation_sd[-1] for run in ours])
    rows = [
        Metric("receding/lever arm error, worst seed", 1e3 * lever.max(), "mm", "lower", 5.0),
        Metric("receding/orientation error, worst seed", angle.max(), "deg", "lower", 0.2),
        Metric("receding/seeds that end within both", float(np.isfinite(when).sum()), "", "higher", float(seeds)),
        Metric("receding/time until within both for good, median", float(np.median(when)), "s"),
        Metric("receding/time until within both for good, worst", float(np.max(when)), "s"),
        Metric("receding/lever arm error over its stated sd, RMS", float(np.sqrt(np.mean((lever / sd) ** 2))), "", "lower", 2.0),
        Metric("receding/torque limit met", float(sum(run.saturated for run in ours)), "steps", "lower", 0.0),
        Metric("receding/CPU for one simulated second", float(np.median(cpu)) / SECONDS, "s", note="all at 1 kHz"),
    ]  # fmt: skip
    for label, runs in (
        ("receding", ours),
        ("paper's procedure", theirs),
        (f"law (26), our estimate ({FEW} seeds)", law),
    ):
        felt, late = [r.felt() for r in runs], [r.felt(SECONDS - LATE) for r in runs]
        rows += [
            Metric(f"{label}/peak force, median", float(np.median([f.peak_force for f in felt])), "N"),
            Metric(f"{label}/peak force, worst seed", max(f.peak_force for f in felt), "N"),
            Metric(f"{label}/RMS force, median", float(np.median([f.rms_force for f in felt])), "N"),
            Metric(f"{label}/RMS force of the last {LATE:g} s, median", float(np.median([f.rms_force for f in late])), "N"),
            Metric(f"{label}/peak torque, median", float(np.median([f.peak_torque for f in felt])), "Nm"),
        ]  # fmt: skip
    far = np.array([run.translation_error[-1] for run in theirs])
    rows.append(Metric("paper's procedure/lever arm error, median", 1e3 * float(np.median(far)), "mm"))
    rows.append(
        Metric(
            "paper's procedure/orientation error, median",
            float(np.median(np.degrees([run.rotation_error[-1] for run in theirs]))),
            "deg",
        )
    )
    group = "receding, clocks unknown"
    lever = 1e3 * max(r.translation_error[-1] for r in clock)
    turn = float(np.degrees(max(r.rotation_error[-1] for r in clock)))
    force = max(r.felt().peak_force for r in clock)
    rows += [
        Metric(f"{group}/lever arm error, worst seed", lever, "mm", note=f"{FEW} seeds"),
        Metric(f"{group}/orientation error, worst seed", turn, "deg"),
        Metric(f"{group}/peak force, worst seed", force, "N"),
    ]
    ratio = [a.felt().peak_force / b.felt().peak_force for a, b in zip(theirs, ours, strict=True)]
    rows.append(Metric("peak force, paper over receding, least seed", min(ratio), "", "higher", 10.0))
    return rows


def figure_five() -> list[Metric]:
    """What the printed impedance does under the printed motion."""
    data, rows = reproduce_fig5(), []
    for name, words in (
        ("biased", "about [0.5, 0, 0]; the paper plots 1 to 4.5 N"),
        ("estimated", "about the paper's estimate; the paper plots up to 1.4 N"),
        ("true", "about the true wrist: what the wrist's own torque leaves"),
        ("stiff", "as biased, with a robot that does not yield in rotation"),
    ):
        felt = getattr(data, name).felt()
        rows.append(Metric(f"Fig. 5/{name}, peak force", felt.peak_force, "N", note=words))
        rows.append(Metric(f"Fig. 5/{name}, RMS force", felt.rms_force, "N"))
    for label, lever in (("biased", (0.5, 0.0, 0.0)), ("estimated", PAPER_ESTIMATE)):
        for stiffness, words in ((150.0, "300 N/m on both sides"), (300.0, "300 N/m against a rigid wrist")):
            rows.append(
                Metric(f"Fig. 5/springs alone, {label}, {stiffness:g} N/m, peak", spring_force(lever, stiffness)[0], "N", note=words)
            )  # fmt: skip
    return rows


def measure(runs: int) -> list[Metric]:
    """NEES of batch estimates under the covariance that was predicted from the motion alone."""
    root, hand = ENCODER_NOISE.rate**-0.5, replace(XSENS, rate=200.0)
    noise = GraspNoise(
        gyro_density=XSENS.gyro_noise_density,
        accelerometer_density=XSENS.accelerometer_noise_density,
        robot_angular_velocity_density=ENCODER_NOISE.angular_velocity_sd * root,
        robot_angular_acceleration_density=ENCODER_NOISE.angular_acceleration_sd * root,
        robot_acceleration_density=ENCODER_NOISE.acceleration_sd * root,
    )
    quiet = replace(ENCODER_NOISE, angular_velocity_sd=0.0, angular_acceleration_sd=0.0, acceleration_sd=0.0)
    plan = cehajic2015(0, duration=20.0, robot=quiet, hand=hand)
    motion = robot_kinematics(plan.robot, noise, np.array([0.0, 0.0, -9.80665]), 40.0)
    start = time.process_time()
    predicted = predict_grasp(motion, plan.truth.rotation, plan.truth.translation, noise)
    cost = time.process_time() - start
    P, total, errors = predicted.grasp_covariance, 0.0, []
    for seed in range(runs):
        recording = cehajic2015(1000 + seed, duration=20.0, hand=hand)
        estimate = solve(GraspPose(recording.robot, recording.hand, noise))
        turn = lie.so3_log(estimate.rotation.T @ plan.truth.rotation)
        error = np.concatenate([turn, plan.truth.translation - estimate.translation])
        errors.append(error)
        total += float(error @ np.linalg.solve(P, error)) / (6 * runs)
    scatter = np.sqrt(np.mean(np.square(errors), axis=0))
    return [
        Metric("prediction/NEES per degree of freedom", total, "", "within", nees_band(6, runs), f"{runs} seeds"),
        Metric("prediction/largest ratio of scatter and predicted sd of a component", float(np.max(scatter / predicted.sd)), ""),
        Metric("prediction/smallest ratio", float(np.min(scatter / predicted.sd)), ""),
        Metric("prediction/CPU for 20 s of motion at 1 kHz", 1e3 * cost, "ms"),
    ]  # fmt: skip


def panda_log(data: Path) -> list[Metric]:
    """The real log, and a motion about the wrist in its place."""
    path, urdf = data / "panda_ident" / "panda_excitation.npz", panda_urdf()
    if not path.is_file() or urdf is None:
        print("no Panda log or no Panda: left out", file=sys.stderr)
        return []
    with np.load(path) as file:
        t, q, tau = file["t"], np.asarray(file["q"], dtype=float), np.asarray(file["tau"], dtype=float)
    model = load_robot(urdf)
    log = ExcitationEvaluationTask(
        JointStream(t, q), translation=LEVER, robot_model=model, frame=FRAME, measured_torque=tau, reference="mean"
    ).solve()  # fmt: skip
    rows = _evaluated("Panda log", log)
    assert log.motion.joints is not None
    assert log.motion.joints.correlation is not None
    for k, value in enumerate(log.motion.joints.correlation):
        rows.append(Metric(f"Panda log/correlation of predicted and measured torque, joint {k + 1}", value))
    rows += _casadi(model, log)
    plan, used = about_the_wrist(float(t[-1] - t[0]))
    mine = ExcitationEvaluationTask(plan, translation=LEVER, robot_model=model, frame=FRAME, reference="mean").solve()  # fmt: skip
    rows += _evaluated("about the wrist", mine)
    rows += [Metric(f"about the wrist/share of the {name} limits", value, "", "lower", 1.0) for name, value in used.items()]  # fmt: skip
    better = [a / b for a, b in zip(log.prediction.worst_sd, mine.prediction.worst_sd, strict=True)]
    assert log.wrench_summary is not None
    assert mine.wrench_summary is not None
    turned = log.wrench_summary.rms_torque / log.wrist.rotation
    rows += [
        Metric("log over ours/rotation sd, worst direction", better[0], "", note=f"the log turns the wrist by {turned:.2f} rad RMS"),
        Metric("log over ours/lever arm sd, worst direction", better[1], "", "higher", 1.0),
        Metric("log over ours/RMS force at the wrist", log.wrench_summary.rms_force / mine.wrench_summary.rms_force, "", "higher", 1.0),
        Metric("log over ours/RMS torque at the wrist", log.wrench_summary.rms_torque / mine.wrench_summary.rms_torque, "", "higher", 1.0),
    ]  # fmt: skip
    return rows


PLAN = """\
kind = "excitation"
[robot]
urdf = "{urdf}"
frame = "{frame}"
start = [0.0, -0.5, 0.0, -2.55, 0.0, 2.05, 0.785]
acceleration = {acceleration}
[grasp]
translation = {lever}
[excitation]
alpha = 40.0
window = 5.0
duration = 10.0
bandwidth = 1.2
"""


def panda_plan(data: Path) -> list[Metric]:
    """The planner's own motion under the Panda's limits, evaluated like the log."""
    path, urdf = data / "panda_ident" / "panda_excitation.npz", panda_urdf()
    if not path.is_file() or urdf is None:
        return []
    text = PLAN.format(urdf=urdf, frame=FRAME, acceleration=ACCELERATION.tolist(), lever=LEVER.tolist())
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plan.toml"
        file.write_text(text, encoding="utf-8")
        start = time.process_time()
        plan = load_problem(file).solve()
        cost = time.process_time() - start
        plan.save(folder)
        file.write_text(text + '[evaluate]\nfile = "trajectory.csv"\nreference = "mean"\n', encoding="utf-8")
        mine = load_problem(file).solve()
        file.write_text(
            text.replace("40.0", "1.0") + f'[evaluate]\nfile = "{path}"\nreference = "mean"\n',
            encoding="utf-8",
        )
        log = load_problem(file).solve()
    worst = [float(result.windows.lambda_min.min()) for result in (mine, log)]
    return [
        Metric("planned/margin to the nearest limit", min(m.relative for m in plan.check.margins), "", "higher", 0.0, "share of its range"),
        *_evaluated("planned, 10 s", mine),
        Metric("planned over log/lambda_min of the worst 5 s", worst[0] / worst[1], "", "higher", 1.0),
        Metric("log over planned/RMS force", log.wrench_summary.rms_force / mine.wrench_summary.rms_force, "", "higher", 1.0),
        Metric("log over planned/RMS torque", log.wrench_summary.rms_torque / mine.wrench_summary.rms_torque, "", "higher", 1.0),
        Metric("planned/CPU", cost, "s"),
    ]  # fmt: skip


def _casadi(model: Any, log: ExcitationEvaluation) -> list[Metric]:
    """The same torques by the CasADi model."""
    from factorgrasp.models.casadi_robot import CasadiRobot

    joints = log.motion.joints
    assert joints is not None
    assert joints.measured_torque is not None
    good = np.isfinite(np.hstack([joints.q, joints.qd, joints.qdd, joints.measured_torque])).all(axis=1)
    # The gripper's fingers stay where they are.
    full = [
        np.hstack([part[good], np.zeros((good.sum(), model.nv - 7))])
        for part in (joints.q, joints.qd, joints.qdd)
    ]
    rnea = CasadiRobot(model).rnea_function().map(int(good.sum()))
    torque = np.array(rnea(*(part.T for part in full)).full()).T[:, :7]
    rows = [
        Metric("Panda log/torque of the CasADi model against pinocchio, largest difference",
               float(np.max(np.abs(torque - joints.torque[good]))), "Nm", "lower", 1e-10),
    ]  # fmt: skip
    for k in range(7):
        value = float(np.corrcoef(torque[:, k], joints.measured_torque[good][:, k])[0, 1])
        rows.append(Metric(f"Panda log/correlation of CasADi's and measured torque, joint {k + 1}", value))
    return rows


def human_modes(seeds: int) -> list[Metric]:
    """Human motion in a plane and in all directions, on the arm."""
    rows = []
    for mode, words in (
        ("planar", "circle of 60 mm in 8 s, turns about the direction of travel"),
        ("full", "the same with turns of 0.12 rad of the human's own"),
    ):
        runs = [cehajic2015_loop(seed, duration=SECONDS, human=mode) for seed in range(seeds)]  # type: ignore[arg-type]
        felt = [run.felt() for run in runs]
        late = [run.felt(SECONDS - LATE) for run in runs]
        lever, angle = max(r.translation_error[-1] for r in runs), max(r.rotation_error[-1] for r in runs)
        rows += [
            Metric(f"human {mode}/lever arm error, worst seed", 1e3 * lever, "mm", "lower", 5.0, words),
            Metric(f"human {mode}/orientation error, worst seed", float(np.degrees(angle)), "deg", "lower", 0.2),
            Metric(f"human {mode}/peak force, worst seed", max(f.peak_force for f in felt), "N"),
            Metric(f"human {mode}/RMS force of the last {LATE:g} s, worst seed", max(f.rms_force for f in late), "N"),
            Metric(f"human {mode}/torque limit met", float(sum(r.saturated for r in runs)), "steps"),
        ]  # fmt: skip
    return rows


def _evaluated(label: str, result: ExcitationEvaluation) -> list[Metric]:
    turn, way = result.prediction.worst_sd
    assert result.wrench_summary is not None
    return [
        Metric(f"{label}/lambda_min over every 5 s, least", float(result.windows.lambda_min.min()), "s^-3"),
        Metric(f"{label}/predicted sd of rotation, worst direction", 1e3 * float(np.degrees(turn)), "mdeg"),
        Metric(f"{label}/predicted sd of lever arm, worst direction", 1e3 * way, "mm"),
        Metric(f"{label}/RMS force at the wrist", result.wrench_summary.rms_force, "N"),
        Metric(f"{label}/RMS torque at the wrist", result.wrench_summary.rms_torque, "Nm"),
    ]


def about_the_wrist(duration: float) -> tuple[JointStream, dict[str, float]]:
    """Three tones about the wrist, as wide as the Panda's limits allow; joint positions and the share of every limit that they use."""
    arm = panda_arm(payload=0.0)
    best: tuple[float, JointStream, dict[str, float]] | None = None
    for frequency in (0.8, 1.0, 1.25):
        angle = 0.2
        for _ in range(4):
            try:
                stream, used = _followed(arm, angle, frequency, duration)
            except InfeasibleError:
                angle *= 0.7
                continue
            share = max(used.values())
            if share <= 1.0 and (best is None or angle * frequency**2 > best[0]):
                best = (angle * frequency**2, stream, used)
            angle *= 0.98 / max(used["velocity"], used["acceleration"], used["torque"])
    assert best is not None
    return best[1], best[2]


def _followed(
    arm: Arm, angle: float, frequency: float, duration: float
) -> tuple[JointStream, dict[str, float]]:
    """Joints that turn the gripper about the wrist, by inverse kinematics, and what they use of the limits."""
    import pinocchio

    t = np.arange(0.0, duration, 5e-3)
    x, y, z = np.eye(3)
    shape = Sinusoids(
        (0, 0, 0), [0.7 * x, 0.5 * z, 0.5 * y], (0.85 * frequency, 1.15 * frequency, frequency), np.zeros((3, 3))
    )  # fmt: skip
    rise = Blend(np.zeros(1))
    rise.go(0.0, np.array([angle]), 1.5)
    fall = Blend(np.ones(1))
    fall.go(duration - 1.6, np.zeros(1), 1.5)
    R, p = arm.placement(arm.start)
    zero = np.zeros((t.size, 3))
    phi = times(times(rise.at(t), fall.at(t)), shape.derivatives(t))
    reference = about_point(p, R, phi, (np.tile(HELD, (t.size, 1)), zero, zero), (zero, zero, zero))
    q = arm.follow(reference.rotation, reference.position, arm.start)
    qd = np.gradient(q, t, axis=0)
    qdd = np.gradient(qd, t, axis=0)
    model, data = arm.model, arm.model.createData()
    torque = np.array([pinocchio.rnea(model, data, *rows) for rows in zip(q, qd, qdd, strict=True)])
    low, high = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
    used = {
        "position": float(np.max(np.abs(q - 0.5 * (low + high)) / (0.5 * (high - low)))),
        "velocity": float(np.max(np.abs(qd) / np.array(model.velocityLimit))),
        "acceleration": float(np.max(np.abs(qdd) / ACCELERATION)),
        "torque": float(np.max(np.abs(torque) / np.array(model.effortLimit))),
    }
    return JointStream(t, q), used


def main(arguments: list[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--runs", type=int, default=50, help="of the check of the measure")
    default = Path(os.environ.get("FACTORGRASP_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=default)
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--only", choices=("loop", "figure", "measure", "log", "plan", "human"), help="one part"
    )
    chosen = parser.parse_args(arguments)
    parts = {
        "figure": figure_five,
        "measure": lambda: measure(chosen.runs),
        "log": lambda: panda_log(chosen.data),
        "loop": lambda: closed_loop(chosen.seeds),
        "plan": lambda: panda_plan(chosen.data),
        "human": lambda: human_modes(max(1, chosen.seeds // 3)),
    }
    rows: list[Metric] = []
    for name, part in parts.items():
        if chosen.only in (None, name):
            rows += part()
            print(f"{name} done", file=sys.stderr)
    print(metric_table(rows, "Excitation, closed loop and real log").text())
    if chosen.json is not None:
        chosen.json.write_text(json.dumps([row.to_dict() for row in rows], indent=1))
    sys.exit(1 if missed(rows) else 0)


if __name__ == "__main__":
    main()

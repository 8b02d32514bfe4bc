"""Human dynamics against iDynTree: the same 66-degree-of-freedom human, frames, sensors and covariances, one run, one thread.

    OMP_NUM_THREADS=1 python benchmarks/human_dynamics_benchmark.py [--frames 1000] [--json out.json]

What is compared:

- like for like: every hinge of the URDF a joint of its own and every massless link a link, as iDynTree has it; matrices and answers are
  the same;
- as we model it: 22 ball joints between 23 links (massless links merged), the same sensors and variances of the links with mass.

Times of iDynTree are those inside its two calls (update and solve); the conversion of its arguments is left out. Ours start from
(q, qd, qdd) and the measurements as numpy arrays and end with torques; "one frame" is the streaming estimator, "many" the recording at
once, its set-up included. Limits: one machine, random motion, the accuracy of timers; first calls (compilation) are left out on both sides.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.online.human_dynamics import OnlineHumanDynamics
from factorgrasp.problems.external_wrenches import ExternalWrenches
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_constraints import TorqueLimit
from factorgrasp.problems.human_dynamics_sensors import Accelerometer, ExternalWrench, JointAcceleration
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.solvers.frames import FrameSolver, solve_frames

SEGMENTS: tuple[tuple[str, str, tuple[float, float, float], float], ...] = (
    ("pelvis", "", (0.0, 0.0, 0.0), 8.0),
    ("l5", "pelvis", (0.0, 0.0, 0.1), 7.0),
    ("l3", "l5", (0.0, 0.0, 0.1), 7.0),
    ("t12", "l3", (0.0, 0.0, 0.1), 7.0),
    ("t8", "t12", (0.0, 0.0, 0.1), 8.0),
    ("neck", "t8", (0.0, 0.0, 0.15), 1.5),
    ("head", "neck", (0.0, 0.0, 0.1), 4.0),
    ("right_shoulder", "t8", (0.0, -0.05, 0.1), 1.5),
    ("right_upper_arm", "right_shoulder", (0.0, -0.13, 0.0), 2.0),
    ("right_forearm", "right_upper_arm", (0.0, -0.3, 0.0), 1.2),
    ("right_hand", "right_forearm", (0.0, -0.25, 0.0), 0.5),
    ("left_shoulder", "t8", (0.0, 0.05, 0.1), 1.5),
    ("left_upper_arm", "left_shoulder", (0.0, 0.13, 0.0), 2.0),
    ("left_forearm", "left_upper_arm", (0.0, 0.3, 0.0), 1.2),
    ("left_hand", "left_forearm", (0.0, 0.25, 0.0), 0.5),
    ("right_thigh", "pelvis", (0.0, -0.09, 0.0), 8.0),
    ("right_shank", "right_thigh", (0.0, 0.0, -0.42), 3.5),
    ("right_foot", "right_shank", (0.0, 0.0, -0.4), 0.9),
    ("right_toe", "right_foot", (0.15, 0.0, -0.05), 0.2),
    ("left_thigh", "pelvis", (0.0, 0.09, 0.0), 8.0),
    ("left_shank", "left_thigh", (0.0, 0.0, -0.42), 3.5),
    ("left_foot", "left_shank", (0.0, 0.0, -0.4), 0.9),
    ("left_toe", "left_foot", (0.15, 0.0, -0.05), 0.2),
)
"""Name, parent, place of the joint in the parent (m) and mass (kg): the layout of a motion-capture suit, round numbers."""

IMUS = (
    "pelvis", "t8", "head", "right_shoulder", "left_shoulder", "right_upper_arm", "left_upper_arm", "right_forearm", "left_forearm",
    "right_hand", "left_hand", "right_thigh", "left_thigh", "right_shank", "left_shank", "right_foot", "left_foot",
)  # fmt: skip
FEET, HANDS = ("right_foot", "left_foot"), ("right_hand", "left_hand")
MODEL, PRIOR, JOINT, IMU, FREE, FOOT = 1e-4, 1e6, 1e-3, 1e-3, 1e-4, (59.0, 59.0, 36.0, 2.25, 2.25, 0.56)
HAND = (1e2, 1e2, 1e2, 1.0, 1.0, 1.0)


def human_urdf() -> str:
    """Three hinges through two massless links a joint: how URDFs write ball joints."""
    parts = ['<robot name="human">']
    for name, parent, place, mass in SEGMENTS:
        parts.append(
            f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="0.01 0.005 0.03" rpy="0 0 0"/>'
            f'<inertia ixx="{0.01 * mass}" iyy="{0.012 * mass}" izz="{0.008 * mass}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
        if not parent:
            continue
        above = parent
        for axis, unit in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1")):
            below = name if axis == "z" else f"{name}_{axis}"
            if below != name:
                parts.append(f'<link name="{below}"/>')
            at = " ".join(str(v) for v in place) if axis == "x" else "0 0 0"
            parts.append(
                f'<joint name="j_{name}_{axis}" type="revolute"><parent link="{above}"/><child link="{below}"/>'
                f'<origin xyz="{at}" rpy="0 0 0"/>'
                f'<axis xyz="{unit}"/><limit effort="999" velocity="99" lower="-9" upper="9"/></joint>'
            )
            above = below
    return "".join([*parts, "</robot>"])


def median(function: Callable[[int], Any], count: int) -> tuple[float, float]:
    """Median and 99th percentile of seconds a call."""
    times = np.empty(count)
    for i in range(count):
        started = time.perf_counter()
        function(i)
        times[i] = time.perf_counter() - started
    return float(np.median(times)), float(np.percentile(times, 99.0))


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    import pinocchio as pin

    n = arguments.frames
    urdf = human_urdf()
    model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    rng = np.random.default_rng(0)
    q = np.concatenate(
        [np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (n, 1)), 0.4 * rng.standard_normal((n, 66))], axis=1
    )
    v, a = rng.standard_normal((n, 72)), 3.0 * rng.standard_normal((n, 72))
    v[:, :3] = 0.0
    t = np.arange(n) / 100.0
    specific = {f"imu_{link}": np.array([0.0, 0.0, 9.81]) + rng.standard_normal((n, 3)) for link in IMUS}
    wrench = {foot: np.array([5.0, 5.0, 350.0, 3.0, 3.0, 1.0]) + rng.standard_normal((n, 6)) for foot in FEET}
    noise = HumanDynamicsNoise(MODEL, MODEL, FREE, HAND, JOINT)
    results: dict[str, float] = {}

    def problem(merge: bool) -> tuple[PinocchioTree, HumanDynamics]:
        tree = PinocchioTree(model, merge_massless=merge, gravity=(0.0, 0.0, -9.81))
        motion = tree.motion(t, q, v, a)
        sensors: list[Any] = [Accelerometer(specific[f"imu_{link}"], IMU, link=link) for link in IMUS]
        sensors += [ExternalWrench(wrench[foot], FOOT, link=foot) for foot in FEET]
        k = motion.kinematics()
        at = 0
        for joint in motion.joints:
            sensors.append(
                JointAcceleration(k.joint_acceleration[:, at : at + joint.size], JOINT, joint=joint.name)
            )
            at += joint.size
        return tree, HumanDynamics(motion, sensors, noise, use_motion=False)

    trees = {"like for like": problem(False), "ball joints": problem(True)}
    peer_seconds: dict[str, float] = {}
    try:
        peer_seconds = _peer(urdf, model, q, v, a, specific, wrench, trees["like for like"][1], results)
    except ModuleNotFoundError as error:
        print(f"iDynTree is not here ({error.name}): pip install idyntree numpy. Ours alone:")
    for name, (tree, whole) in trees.items():
        _ours(name, tree, whole, q, v, a, specific, wrench, results)
    _report(results, peer_seconds, n)
    if arguments.json:
        arguments.json.write_text(json.dumps({"seconds": results, "machine": _machine()}, indent=1))


def _peer(
    urdf: str,
    model: Any,
    q: Any,
    v: Any,
    a: Any,
    specific: Any,
    wrench: Any,
    whole: HumanDynamics,
    results: dict[str, float],
) -> dict[str, float]:
    sys.path.insert(0, str(Path(__file__).parent))
    from idyntree_peer import IDynTreePeer, PeerCovariances

    placed = {name: (name.removeprefix("imu_"), np.eye(3), np.zeros(3)) for name in specific}
    shared = PeerCovariances(MODEL, PRIOR, JOINT, IMU, FREE, dict.fromkeys(FEET, FOOT))
    peer = IDynTreePeer(urdf, placed, shared, "pelvis")
    mine = [str(name) for name in model.names[2:]]
    order = [mine.index(peer.model.getJointName(i)) for i in range(66)]
    names = [mine[i] for i in order]
    count = min(len(q), 60)
    ds, seconds = [], []
    for f in range(count):
        y = peer.measurement(
            {foot: wrench[foot][f] for foot in FEET},
            dict(zip(names, a[f, 6:][order], strict=True)),
            {k: s[f] for k, s in specific.items()},
        )
        d, spent = peer.estimate(q[f, 7:][order], v[f, 6:][order], v[f, 3:6], y)
        ds.append(d)
        seconds.append(spent)
    results["idyntree full MAP"] = float(np.median(seconds))
    place = peer.unknowns()
    found = solve_frames(whole.at(slice(0, count)), covariance=False)
    axes = whole.motion.kinematics(slice(0, count)).axes
    theirs = np.array([[d[place["wrench", joint]] for joint in found.joint_names] for d in ds])
    gap = found.torque - np.einsum("fji,fji->fj", axes, theirs)
    results["largest difference of torques to idyntree, Nm"] = float(np.abs(gap).max())
    loose = PeerCovariances(
        MODEL, PRIOR, JOINT, IMU, FREE, {**dict.fromkeys(FEET, FOOT), **dict.fromkeys(HANDS, HAND)}
    )
    first = IDynTreePeer(urdf, {}, loose, "pelvis", non_collocated=True)
    seconds = []
    for f in range(count):
        y = first.measurement(
            {foot: wrench[foot][f] for foot in FEET}, {}, {}, np.array([0.0, 0.0, 735.0, 0.0, 0.0, 0.0])
        )
        seconds.append(first.estimate(q[f, 7:][order], v[f, 6:][order], v[f, 3:6], y)[1])
    results["idyntree momentum task"] = float(np.median(seconds))
    return {
        "full": results["idyntree full MAP"],
        "both": results["idyntree full MAP"] + results["idyntree momentum task"],
    }


def _ours(
    name: str,
    tree: PinocchioTree,
    whole: HumanDynamics,
    q: Any,
    v: Any,
    a: Any,
    specific: Any,
    wrench: Any,
    results: dict[str, float],
) -> None:
    n = len(q)
    results[f"{name}: unknowns"] = whole.pattern.size
    t = whole.motion.t
    values = np.concatenate([sensor.values for sensor in whole.sensors], axis=1)
    for covariance in (False, True):
        online = OnlineHumanDynamics(
            tree,
            [s.frames(slice(0, 1)) for s in whole.sensors],
            whole.noise,
            use_motion=False,
            covariance=covariance,
        )
        online.step(t[0], q[0], v[0], a[0], values[0])
        step, worst = median(lambda f, step=online.step: step(t[f], q[f], v[f], a[f], values[f]), n)
        results[f"{name}: one frame{' with covariance' if covariance else ''}"] = step
        results[f"{name}: one frame{' with covariance' if covariance else ''}, 99 %"] = worst

    def many(covariance: bool) -> float:
        best = np.inf
        for _ in range(3):
            started = time.perf_counter()
            motion = tree.motion(t, q, v, a)
            problem = HumanDynamics(motion, whole.sensors, whole.noise, use_motion=False)
            solve_frames(problem, covariance=covariance)
            best = min(best, time.perf_counter() - started)
        return best / n

    results[f"{name}: many frames"] = many(False)
    results[f"{name}: many frames with covariance, torque sd, NIS"] = many(True)
    started = time.perf_counter()
    solver = FrameSolver(whole.pattern)
    results[f"{name}: symbolic set-up, once"] = time.perf_counter() - started
    entries, rhs = whole.whitened_frames(slice(0, n))
    for label, rows in (("one", slice(0, 1)), ("many", slice(0, n))):
        parts = {}
        for covariance in (False, True):
            solver.solve(entries[rows], rhs[rows], covariance)
            solve = partial(solver.solve, entries[rows], rhs[rows], covariance)
            parts[covariance] = median(lambda _, run=solve: run(), 30 if label == "one" else 3)[0]
        size = rhs[rows].shape[0]
        results[f"{name}: linear algebra, {label}"] = parts[False] / size
        results[f"{name}: all marginal variances on top, {label}"] = (parts[True] - parts[False]) / size
        if label == "one":
            results[f"{name}: one more solve"] = results[f"{name}: linear algebra, one"]
    contacts = [s for s in whole.sensors if isinstance(s, ExternalWrench)]
    external = ExternalWrenches(whole.motion, contacts, HANDS, whole.noise)
    results[f"{name}: momentum task, many frames"] = median(lambda _: external.estimate(), 3)[0] / n

    def both() -> None:
        motion = tree.motion(t, q, v, a)
        first = ExternalWrenches(motion, contacts, HANDS, whole.noise).estimate()
        others = [s for s in whole.sensors if not isinstance(s, ExternalWrench)]
        solve_frames(
            HumanDynamics(motion, [*others, first.as_sensor()], whole.noise, use_motion=False),
            covariance=False,
        )

    def joint_estimate() -> None:
        motion = tree.motion(t, q, v, a)
        solve_frames(
            HumanDynamics(motion, whole.sensors, whole.noise, HANDS, use_motion=False), covariance=False
        )

    joint_estimate()
    results[f"{name}: both tasks as one joint estimate, many frames"] = (
        median(lambda _: joint_estimate(), 5)[0] / n
    )
    both()
    results[f"{name}: both tasks chained with covariance, many frames"] = median(lambda _: both(), 3)[0] / n
    if name == "ball joints":
        few = slice(0, 100)
        free = solve_frames(whole.at(few), covariance=False)
        j = free.joint_names.index("j_right_shank")
        at = free.dof_names.index("j_right_shank_y")
        limit = 0.5 * float(np.abs(free.torque[:, at]).max())
        bound = HumanDynamics(whole.motion.select(few), [s.frames(few) for s in whole.sensors], whole.noise,
        use_motion=False,
                              constraints=[TorqueLimit(free.joint_names[j], -limit, limit)])  # fmt: skip
        for solver in ("active-set", "piqp"):
            found = solve_frames(bound, solver, covariance=False)
            results[f"ball joints: {solver} with torque limits, one frame"] = found.time / len(found)
            results[f"ball joints: rows at their limit by {solver}"] = float(len(found.active))


def _report(results: dict[str, float], peer: dict[str, float], frames: int) -> None:
    print(f"{frames} frames, one thread; {_machine()}")
    for name, value in results.items():
        plain = any(word in name for word in ("unknowns", "difference", "rows at"))
        line = f"  {name:72s} {value:10.3g}" if plain else f"  {name:72s} {1e3 * value:8.4f} ms"
        if (
            peer
            and not plain
            and "idyntree" not in name
            and "variances" not in name
            and "more solve" not in name
        ):
            against = (
                peer["both"]
                if "both" in name
                else (peer["both"] - peer["full"] if "momentum" in name else peer["full"])
            )
            line += f"   {against / value:8.1f} x"
        print(line)


def _machine() -> str:
    packages = []
    for name in ("numpy", "scipy", "numba", "qdldl", "pin", "piqp", "idyntree"):
        try:
            packages.append(f"{name} {version(name)}")
        except Exception:
            continue
    return f"{platform.machine()}, Python {platform.python_version()}, " + ", ".join(packages)


if __name__ == "__main__":
    main()

"""How fast human dynamics is beside iDynTree: the same 66-degree-of-freedom human, frames, sensors and covariances, one run, one thread.

- like for like: every hinge of the URDF a joint of its own and every massless link a link, as iDynTree has it; matrices and answers are
  the same;
- as we model it: 22 ball joints between 23 links (massless links merged), the same sensors and variances of the links with mass.

Processor times, so that other programs on the machine count for neither side. Those of iDynTree are inside its two
calls (update and solve); the
conversion of its arguments is left out. Ours start from (q, qd, qdd) and the measurements as numpy arrays and end
with torques; "one frame" is the
streaming estimator, "many" the recording at once, its set-up included. First calls (compilation) are left out on both sides.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from metrics import Metric

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
        started = time.process_time()
        function(i)
        times[i] = time.process_time() - started
    return float(np.median(times)), float(np.percentile(times, 99.0))


@dataclass(frozen=True)
class Setup:
    """What both sides get.

    Attributes
    ----------
    urdf : str
    model : pinocchio.Model
    t, q, v, a : ndarray
        Random motion of n frames.
    specific, wrench : dict of str to ndarray
        Specific force by sensor and wrench by foot.
    noise : HumanDynamicsNoise
    """

    urdf: str
    model: Any
    t: Any
    q: Any
    v: Any
    a: Any
    specific: dict[str, Any]
    wrench: dict[str, Any]
    noise: HumanDynamicsNoise

    def problem(self, merge: bool) -> tuple[PinocchioTree, HumanDynamics]:
        """Tree and problem, with or without massless links merged."""
        tree = PinocchioTree(self.model, merge_massless=merge, gravity=(0.0, 0.0, -9.81))
        motion = tree.motion(self.t, self.q, self.v, self.a)
        sensors: list[Any] = [Accelerometer(self.specific[f"imu_{link}"], IMU, link=link) for link in IMUS]
        sensors += [ExternalWrench(self.wrench[foot], FOOT, link=foot) for foot in FEET]
        k = motion.kinematics()
        at = 0
        for joint in motion.joints:
            values = k.joint_acceleration[:, at : at + joint.size]
            sensors.append(JointAcceleration(values, JOINT, joint=joint.name))
            at += joint.size
        return tree, HumanDynamics(motion, sensors, self.noise, use_motion=False)


def setup(frames: int) -> Setup:
    """Random motion and measurements."""
    import pinocchio as pin

    n, urdf = frames, human_urdf()
    model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    rng = np.random.default_rng(0)
    still = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (n, 1))
    q = np.concatenate([still, 0.4 * rng.standard_normal((n, 66))], axis=1)
    v, a = rng.standard_normal((n, 72)), 3.0 * rng.standard_normal((n, 72))
    v[:, :3] = 0.0
    specific = {f"imu_{link}": np.array([0.0, 0.0, 9.81]) + rng.standard_normal((n, 3)) for link in IMUS}
    wrench = {foot: np.array([5.0, 5.0, 350.0, 3.0, 3.0, 1.0]) + rng.standard_normal((n, 6)) for foot in FEET}
    noise = HumanDynamicsNoise(MODEL, MODEL, FREE, HAND, JOINT)
    return Setup(urdf, model, np.arange(n) / 100.0, q, v, a, specific, wrench, noise)


def speed(frames: int = 1000) -> list[Metric]:
    """Every target of speed, and what it is made of."""
    given = setup(frames)
    problems = {"like for like": given.problem(False), "ball joints": given.problem(True)}
    r: dict[str, float] = {}
    peer(given, problems["like for like"][1], r)
    for name, (tree, whole) in problems.items():
        ours(name, tree, whole, given, r)
    return _metrics(r)


def _metrics(r: dict[str, float]) -> list[Metric]:
    nan = float("nan")
    full, task = r.get("idyntree full MAP", nan), r.get("idyntree momentum task", nan)
    both = full + task

    def ratio(key: str, peer_time: float, mine: str, target: float | None, note: str = "") -> Metric:
        words = f"{1e3 * r[mine]:.4f} ms" + (f"; {note}" if note else "")
        return Metric(key, peer_time / r[mine], "x", "none" if target is None else "higher", target, words)

    out = [
        Metric("iDynTree/full MAP", 1e3 * full, "ms"),
        Metric("iDynTree/two-task loop", 1e3 * both, "ms", note="momentum task and full MAP"),
        Metric(
            "iDynTree/largest difference of torques",
            r.get("largest difference", nan),
            "Nm",
            "lower",
            1e-6,
            "like for like",
        ),
        ratio("one frame/against full MAP", full, "ball joints: one frame", 8.0),
        ratio("one frame/against two-task loop", both, "ball joints: one frame, hands unmeasured", 30.0),
        ratio("one frame/like for like, full MAP", full, "like for like: one frame", None),
        ratio("one frame/with covariance, full MAP", full, "ball joints: one frame with covariance", None),
        ratio("many/against full MAP", full, "ball joints: many frames", 13.0),
        ratio(
            "many/two tasks chained with covariance",
            both,
            "ball joints: both tasks chained with covariance",
            65.0,
        ),
        ratio(
            "many/two tasks as one joint estimate",
            both,
            "ball joints: both tasks as one joint estimate",
            65.0,
        ),
        ratio("many/momentum task", task, "ball joints: momentum task, many frames", None),
        ratio("many/like for like, full MAP", full, "like for like: many frames", None),
        ratio(
            "many/with all covariances and NIS, full MAP",
            full,
            "ball joints: many frames with covariance",
            None,
        ),
    ]
    for label in ("one", "many"):
        solve, extra = (
            r[f"ball joints: linear algebra, {label}"],
            r[f"ball joints: variances on top, {label}"],
        )
        target = 0.5 if label == "one" else None
        words = f"{1e3 * extra:.4f} ms on {1e3 * solve:.4f} ms; all 474 variances and joint covariances of every wrench"
        out.append(
            Metric(
                f"variances/of one solve more, {label}",
                extra / solve,
                "x",
                "none" if target is None else "lower",
                target,
                words,
            )
        )
    out += [
        ratio("torque limits/default against iDynTree without", full, "ball joints: active-set with torque limits", 1.0,
              f"active set, {r['ball joints: rows at their limit by active-set']:.0f} rows at their limit"),
        ratio("torque limits/piqp against iDynTree without", full, "ball joints: piqp with torque limits", 1.0,
              f"{r['ball joints: rows at their limit by piqp']:.0f} rows at their limit"),
        Metric("torque limits/difference of both paths", r["ball joints: difference of both paths"], "Nm", "lower", 1e-6),
    ]  # fmt: skip
    return out


def peer(given: Setup, whole: HumanDynamics, results: dict[str, float]) -> None:
    """Times of iDynTree, and how far our answers are from its own."""
    try:
        import idyntree  # noqa: F401
    except ModuleNotFoundError as error:
        print(f"iDynTree is not here ({error.name}): pip install idyntree numpy. Ours alone:")
        return
    from idyntree_peer import IDynTreePeer, PeerCovariances

    urdf, model, q, v, a = given.urdf, given.model, given.q, given.v, given.a
    specific, wrench = given.specific, given.wrench
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
    results["largest difference"] = float(np.abs(gap).max())
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


def ours(
    name: str, tree: PinocchioTree, whole: HumanDynamics, given: Setup, results: dict[str, float]
) -> None:
    """Times of one model."""
    q, v, a = given.q, given.v, given.a
    n = len(q)
    results[f"{name}: unknowns"] = whole.pattern.size
    t = whole.motion.t
    values = np.concatenate([sensor.values for sensor in whole.sensors], axis=1)
    for covariance, hands in ((False, ()), (True, ()), (False, HANDS)):
        online = OnlineHumanDynamics(
            tree,
            [s.frames(slice(0, 1)) for s in whole.sensors],
            whole.noise,
            hands,
            use_motion=False,
            covariance=covariance,
        )
        online.step(t[0], q[0], v[0], a[0], values[0])
        step, worst = median(lambda f, step=online.step: step(t[f], q[f], v[f], a[f], values[f]), n)
        label = ", hands unmeasured" if hands else (" with covariance" if covariance else "")
        results[f"{name}: one frame{label}"] = step
        results[f"{name}: one frame{label}, 99 %"] = worst

    def many(covariance: bool) -> float:
        best = np.inf
        for _ in range(3):
            started = time.process_time()
            motion = tree.motion(t, q, v, a)
            problem = HumanDynamics(motion, whole.sensors, whole.noise, use_motion=False)
            solve_frames(problem, covariance=covariance)
            best = min(best, time.process_time() - started)
        return best / n

    results[f"{name}: many frames"] = many(False)
    results[f"{name}: many frames with covariance"] = many(True)
    started = time.process_time()
    solver = FrameSolver(whole.pattern)
    results[f"{name}: symbolic set-up, once"] = time.process_time() - started
    entries, rhs = whole.whitened_frames(slice(0, n))
    for label, rows in (("one", slice(0, 1)), ("many", slice(0, n))):
        parts = {False: np.inf, True: np.inf}
        # In turn, and the best of several medians: the difference of two times is small against what a busy machine adds.
        for _ in range(7):
            for covariance in (False, True):
                solve = partial(solver.solve, entries[rows], rhs[rows], covariance)
                spent = median(lambda _, run=solve: run(), 100 if label == "one" else 3)[0]
                parts[covariance] = min(parts[covariance], spent)
        size = rhs[rows].shape[0]
        results[f"{name}: linear algebra, {label}"] = parts[False] / size
        results[f"{name}: variances on top, {label}"] = (parts[True] - parts[False]) / size
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
    results[f"{name}: both tasks as one joint estimate"] = median(lambda _: joint_estimate(), 5)[0] / n
    both()
    results[f"{name}: both tasks chained with covariance"] = median(lambda _: both(), 3)[0] / n
    if name == "ball joints":
        few = slice(0, 100)
        free = solve_frames(whole.at(few), covariance=False)
        j = free.joint_names.index("j_right_shank")
        at = free.dof_names.index("j_right_shank_y")
        limit = 0.5 * float(np.abs(free.torque[:, at]).max())
        bound = HumanDynamics(whole.motion.select(few), [s.frames(few) for s in whole.sensors], whole.noise,
        use_motion=False,
                              constraints=[TorqueLimit(free.joint_names[j], -limit, limit)])  # fmt: skip
        torque = {}
        for solver in ("active-set", "piqp"):
            found = solve_frames(bound, solver, covariance=False)
            run = partial(solve_frames, bound, solver, covariance=False)
            spent = median(lambda _, run=run: run(), 3)[0]
            torque[solver] = found.torque
            results[f"ball joints: {solver} with torque limits"] = spent / len(found)
            results[f"ball joints: rows at their limit by {solver}"] = float(len(found.active))
        gap = np.abs(torque["active-set"] - torque["piqp"]).max()
        results["ball joints: difference of both paths"] = float(gap)

"""The papers' experiments on human dynamics as simulations with ground truth (mathematics 4.7).

Bowing (Latella 2018), T-pose with and without a load and carrying while standing, on one foot and walking (Tirupachuri 2021). Joint torques
and the forces under the feet come from the body's equations of motion (pinocchio); what is measured of them has noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.models.anthropometry import Sex
from factorgrasp.models.human import HumanBody, human_body
from factorgrasp.models.joint_motion import differentiate_configurations
from factorgrasp.problems.human_dynamics_sensors import Accelerometer, ExternalWrench, Sensor, plate_wrench
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.problems.link_motion_spatial import rotate_back
from factorgrasp.recordings.forces import ForceRecording
from factorgrasp.simulation.human_motion import (
    KNOT_RATE,
    JointTrajectory,
    Plan,
    ease,
    hip_height,
    realise,
    standing_ankles,
)
from factorgrasp.typing import BoolArray, FloatArray

RATE = 100.0
"""Hz, of all that is recorded."""
FEET = ("RightFoot", "LeftFoot")
HANDS = ("RightHand", "LeftHand")
IMU_LINKS = (
    "Pelvis", "T8", "Head", "RightUpperArm", "LeftUpperArm", "RightForeArm", "LeftForeArm", "RightHand", "LeftHand",
    "RightUpperLeg", "LeftUpperLeg", "RightLowerLeg", "LeftLowerLeg", "RightFoot", "LeftFoot", "RightShoulder", "LeftShoulder",
)  # fmt: skip
"""The 17 trackers of an Xsens suit."""
MOST_ANGLE = 0.5 * np.pi
_CARRY: Mapping[str, float] = {
    "jRightShoulder_x": MOST_ANGLE, "jLeftShoulder_x": -MOST_ANGLE,
    "jRightElbow_z": MOST_ANGLE, "jLeftElbow_z": -MOST_ANGLE,
}  # fmt: skip
_N_POSE: Mapping[str, float] = {"jRightShoulder_x": MOST_ANGLE, "jLeftShoulder_x": -MOST_ANGLE}
# Knees are never quite straight: there the leg's length has no derivative.
_SOFT_KNEES = 0.02


@dataclass(frozen=True)
class HumanNoise:
    """White noise of what is measured, standard deviations of one sample.

    Attributes
    ----------
    force, moment : float
        Of a plate or shoe, N and Nm (about the ankle).
    angle, position, orientation : float
        Of motion capture: joints (rad), pelvis (m and rad).
    accelerometer : float
        m/s^2.
    hand_force, hand_moment : float
        Of a robot's sensor in the hand, N and Nm.
    bandwidth : float
        Hz, of the filter that differentiates the motion; it is applied without noise, too.
    """

    force: float = 2.0
    moment: float = 0.5
    angle: float = 0.001
    position: float = 0.0003
    orientation: float = 0.001
    accelerometer: float = 0.05
    hand_force: float = 0.5
    hand_moment: float = 0.05
    bandwidth: float = 6.0


@dataclass(frozen=True, eq=False)
class HumanTruth:
    """What is true.

    Attributes
    ----------
    trajectory : JointTrajectory
    model : pinocchio.Model
        Of the body as it is, with what is strapped on (not what is held).
    torque : ndarray
        (n, 66) Nm, in the order of `dof_names`.
    dof_names : tuple of str
    external_wrench : dict of str to ndarray
        Link to its net external wrench (n, 6) in its own frame.
    motion : LinkMotion
        Of the body as it is.
    payload : float
        Mass held, kg.
    """

    trajectory: JointTrajectory
    model: Any
    torque: FloatArray
    dof_names: tuple[str, ...]
    external_wrench: Mapping[str, FloatArray]
    motion: LinkMotion
    payload: float = 0.0

    def of(self, dofs: Sequence[str]) -> FloatArray:
        """Torques (n, k) of some degrees of freedom, in that order."""
        return self.torque[:, [self.dof_names.index(name) for name in dofs]]


@dataclass(frozen=True, eq=False)
class HumanRecording:
    """What is recorded of a simulated experiment.

    Attributes
    ----------
    name : str
    body : HumanBody
        As the estimator knows it: without what is strapped on or held.
    truth : HumanTruth
    noise : HumanNoise
    seed : int
    phases : dict of str to (float, float)
        What happens from when to when, s.
    """

    name: str
    body: HumanBody
    truth: HumanTruth
    noise: HumanNoise
    seed: int
    phases: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def t(self) -> FloatArray:
        """(n,) s."""
        return self.truth.trajectory.t

    def during(self, phase: str) -> BoolArray:
        """Which frames (n,) belong to a phase."""
        start, end = self.phases[phase]
        return np.asarray((self.t >= start) & (self.t <= end))

    @cached_property
    def exact_motion(self) -> LinkMotion:
        """The true motion of the body as the estimator knows it."""
        q = self.truth.trajectory
        return PinocchioTree(self.body.model()).motion(q.t, q.q, q.v, q.a)

    @cached_property
    def configurations(self) -> FloatArray:
        """(n, nq) as motion capture has them, with noise."""
        import pinocchio as pin

        rng = np.random.default_rng([self.seed, 1])
        q = self.truth.trajectory.q
        sd = np.full(self.truth.model.nv, self.noise.angle)
        sd[:3], sd[3:6] = self.noise.position, self.noise.orientation
        step = sd * rng.normal(size=(q.shape[0], sd.size))
        return np.array([pin.integrate(self.truth.model, row, d) for row, d in zip(q, step, strict=True)])

    @cached_property
    def measured_motion(self) -> tuple[LinkMotion, BoolArray, HumanDynamicsNoise]:
        """The motion from noisy motion capture, differentiated; which frames (n,) it has; the noise of its accelerations."""
        model = self.body.model()
        found = differentiate_configurations(model, self.configurations, 1.0 / RATE, self.noise.bandwidth)
        keep = found.good
        motion = PinocchioTree(model).motion(self.t[keep], found.q[keep], found.qd[keep], found.qdd[keep])
        n, gain = self.noise, found.acceleration_gain
        root = [n.position**2 * gain] * 3 + [n.orientation**2 * gain] * 3
        variances = HumanDynamicsNoise(
            joint_acceleration=max(n.angle**2 * gain, 1e-12), link_acceleration=np.maximum(root, 1e-12)
        )
        return motion, keep, variances

    @cached_property
    def plates(self) -> dict[str, ForceRecording]:
        """Foot to the force under it, with its centre of pressure on the ground and a free moment, with noise."""
        rng = np.random.default_rng([self.seed, 2])
        out = {}
        for link in FEET:
            i = self.truth.motion.link(link)
            R, p = self.truth.motion.R[:, i], self.truth.motion.p[:, i]
            wrench = self.truth.external_wrench[link]
            f, m = ((R @ part[:, :, None])[..., 0] for part in (wrench[:, :3], wrench[:, 3:]))
            loaded = np.linalg.norm(f, axis=1) > 1.0
            f = f + loaded[:, None] * self.noise.force * rng.normal(size=f.shape)
            m = m + loaded[:, None] * self.noise.moment * rng.normal(size=m.shape)
            about = m + np.cross(p, f)
            safe = np.where(np.abs(f[:, 2]) > 1.0, f[:, 2], np.inf)
            point = np.column_stack([-about[:, 1] / safe, about[:, 0] / safe, np.zeros(len(f))])
            out[link] = ForceRecording(self.t, f, point, about - np.cross(point, f), link)
        return out

    def foot_sensors(self, motion: LinkMotion, keep: BoolArray | slice = slice(None)) -> list[ExternalWrench]:
        """The plates as sensors at the frames of `motion`, with the covariance of their noise."""
        n = self.noise
        variance = np.array([n.force**2] * 3 + [n.moment**2] * 3)
        out = []
        for link, plate in self.plates.items():
            origin = motion.p[:, motion.link(link)]
            values = plate_wrench(plate.force[keep], plate.point[keep], plate.moment[keep], origin)
            out.append(ExternalWrench(values, variance, f"plate under {link}", link=link, frame="world"))
        return out

    def hand_sensors(self, keep: BoolArray | slice = slice(None)) -> list[ExternalWrench]:
        """A robot's force/torque sensors in the hands."""
        rng = np.random.default_rng([self.seed, 3])
        n = self.noise
        sd = np.array([n.hand_force] * 3 + [n.hand_moment] * 3)
        out = []
        for link in HANDS:
            true = self.truth.external_wrench.get(link, np.zeros((self.t.size, 6)))
            values = true + sd * rng.normal(size=true.shape)
            out.append(ExternalWrench(values[keep], sd**2, f"force sensor at {link}", link=link))
        return out

    def imus(self, keep: BoolArray | slice = slice(None), links: Sequence[str] = IMU_LINKS) -> list[Sensor]:
        """Accelerometers at the centres of mass of links, in their axes."""
        rng = np.random.default_rng([self.seed, 4])
        out: list[Sensor] = []
        for link in links:
            motion = self.truth.motion
            i, at = motion.link(link), self.body.segments[link].com
            w, dw = (
                rotate_back(motion.R[:, i], x[:, i])
                for x in (motion.angular_velocity, motion.angular_acceleration)
            )
            f = rotate_back(motion.R[:, i], motion.acceleration[:, i] - motion.gravity)
            f = f + np.cross(dw, at) + np.cross(w, np.cross(w, at))
            values = f + self.noise.accelerometer * rng.normal(size=f.shape)
            out.append(
                Accelerometer(
                    values[keep], self.noise.accelerometer**2, f"accelerometer on {link}", link=link, p_l_s=at
                )
            )
        return out


def human_bowing(
    seed: int = 0,
    *,
    torso_mass: float = 0.0,
    push: float = 0.0,
    repetitions: int = 2,
    height: float = 1.666,
    mass: float = 61.14,
    sex: Sex = "female",
    noise: HumanNoise | None = None,
) -> HumanRecording:
    """Bowing on two force plates (Latella 2018, section 6; height and mass are the means of its subjects).

    Parameters
    ----------
    seed : int
        Of the noise.
    torso_mass : float
        kg, strapped to T8 at its centre of mass; the estimator's body does not have it.
    push : float
        N with which each hand pushes down on a robot's arm (the robot pushes it up), in full when bowed.
    repetitions : int
        Bows, 4 s each.
    height, mass, sex
        Of the person, m and kg.
    noise : HumanNoise, optional
    """
    body = human_body(height, mass, sex)
    wearing = body.with_load("T8", torso_mass, body.segments["T8"].com) if torso_mass > 0.0 else body
    period = 4.0
    duration = 0.5 + period * repetitions + 0.5
    knots = _knots(duration)
    keys = [0.0, *(0.5 + period * k + x for k in range(repetitions) for x in (0.0, 1.6, 2.4, 3.99)), duration]
    bow = ease(knots, np.array(keys), np.array([0.0, *([0.0, 1.0, 1.0, 0.0] * repetitions), 0.0]))
    angles = {name: np.full(knots.size, 0.0) for name in _N_POSE}
    # Arms from hanging down to reaching forward.
    angles |= {name: value * (1.0 - bow) for name, value in _N_POSE.items()}
    angles |= {"jRightShoulder_z": 0.4 * np.pi * bow, "jLeftShoulder_z": -0.4 * np.pi * bow}
    for joint, degrees in (
        ("jL5S1", 12.0),
        ("jL4L3", 12.0),
        ("jL1T12", 10.0),
        ("jT9T8", 6.0),
        ("jT1C7", 5.0),
    ):
        angles[f"{joint}_y"] = np.radians(degrees) * bow
    plan = _standing_plan(body, knots, angles, pitch=np.radians(25.0) * bow)
    t = _samples(duration)
    hands = None
    if push > 0.0:
        share = ease(t, np.array(keys), np.array([0.0, *([0.0, 1.0, 1.0, 0.0] * repetitions), 0.0]))
        hands = {link: np.column_stack([0.0 * share, 0.0 * share, push * share]) for link in HANDS}
    phases = {"bowed": (0.5 + 1.6, 0.5 + 2.4), "standing": (0.0, 0.5)}
    return _record("human_bowing", body, wearing, plan, t, noise, seed, phases, world_forces=hands)


def human_tpose(
    seed: int = 0,
    *,
    payload: float = 0.0,
    height: float = 1.75,
    mass: float = 75.5,
    sex: Sex = "male",
    noise: HumanNoise | None = None,
) -> HumanRecording:
    """From arms hanging to the T-pose and back (Tirupachuri 2021, validation scenario; 75.5 kg, the height is not in the paper).

    Parameters
    ----------
    payload : float
        kg in the right hand, at its centre of mass; then only the right arm is lifted, as in the paper. Held from the beginning.
    """
    body = human_body(height, mass, sex)
    duration = 8.0
    knots = _knots(duration)
    up = ease(knots, np.array([0.0, 1.0, 3.0, 5.0, 7.0, duration]), np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0]))
    angles = {name: np.full(knots.size, value) for name, value in _N_POSE.items()}
    angles["jRightShoulder_x"] = MOST_ANGLE * (1.0 - up)
    if payload == 0.0:
        angles["jLeftShoulder_x"] = -MOST_ANGLE * (1.0 - up)
    plan = _standing_plan(body, knots, angles)
    held = {"RightHand": payload} if payload > 0.0 else {}
    phases = {"N-pose": (0.2, 1.0), "T-pose": (3.05, 4.95)}
    return _record("human_tpose", body, body, plan, _samples(duration), noise, seed, phases, held=held)


Carrying = Literal["standing", "one_foot", "walking"]


def human_carrying(
    seed: int = 0,
    *,
    motion: Carrying = "standing",
    payload: float = 9.55,
    height: float = 1.75,
    mass: float = 75.5,
    sex: Sex = "male",
    noise: HumanNoise | None = None,
) -> HumanRecording:
    """9.55 kg in both hands (Tirupachuri 2021, application scenario) while standing, balancing on one foot, or walking.

    Parameters
    ----------
    motion : {"standing", "one_foot", "walking"}
    payload : float
        kg, half in each hand, at their centres of mass.
    """
    body = human_body(height, mass, sex)
    held = dict.fromkeys(HANDS, 0.5 * payload) if payload > 0.0 else {}
    if motion == "walking":
        return _walking(body, held, noise, seed)
    side = float(standing_ankles(body)["Left"][1])
    if motion == "standing":
        duration, lift, lean = 6.0, None, None
        phases = {"standing": (0.5, 5.5)}
    elif motion == "one_foot":
        duration = 14.0
        lift = {"Right": (2.0, 5.5), "Left": (8.5, 12.0)}
        lean = (
            np.array([0.0, 0.5, 2.0, 5.5, 8.5, 12.0, 13.5]),
            side * np.array([0.0, 0.0, 1.0, 1.0, -1.0, -1.0, 0.0]),
        )
        phases = {"left foot": (2.8, 4.7), "right foot": (9.3, 11.2)}
    else:
        raise InputError("motion", "'standing', 'one_foot' or 'walking'", repr(motion))
    knots = _knots(duration)
    # The arms rise and sink a little: who carries is never quite still.
    sway = 0.08 * np.sin(2.0 * np.pi * 0.4 * knots)
    angles = {name: np.full(knots.size, value) for name, value in _CARRY.items()}
    angles["jRightElbow_z"], angles["jLeftElbow_z"] = MOST_ANGLE + sway, -MOST_ANGLE - sway
    plan = _standing_plan(body, knots, angles, lean=lean, lift=lift)
    return _record(
        f"human_carrying {motion}", body, body, plan, _samples(duration), noise, seed, phases, held=held
    )


def _walking(
    body: HumanBody, held: Mapping[str, float], noise: HumanNoise | None, seed: int
) -> HumanRecording:
    """Eight short steps: centre of mass with the speed of a minimum-jerk move, feet where it will be above them."""
    step_time, double, steps = 0.9, 0.3, 8
    begin, way = 1.5, 1.4
    duration = begin + step_time * steps + 1.5
    knots, t = _knots(duration), _samples(duration)
    stop = begin + step_time * steps
    ankles = standing_ankles(body)
    side = float(ankles["Left"][1])
    forward = ease(knots, np.array([begin, stop]), np.array([0.0, way]))
    feet = {name: np.tile(p, (knots.size, 1)) for name, p in ankles.items()}
    load = np.full(t.size, 0.5)
    lean_t, lean_y = [0.0, begin - 1.0], [0.0, 0.0]
    load_t, load_r = [0.0, begin - 1.0], [0.5, 0.5]
    at = dict.fromkeys(("Right", "Left"), 0.0)
    for k in range(steps):
        swing, stance = ("Right", "Left") if k % 2 == 0 else ("Left", "Right")
        start = begin + k * step_time + 0.5 * double
        land = start + step_time - double
        # Where the centre of mass will be in the middle of this foot's time on the ground.
        target = (
            way if k >= steps - 2 else float(np.interp(land + 0.5 * (step_time + double), knots, forward))
        )
        move = ease(knots, np.array([start, land]), np.array([at[swing], target]))
        inside = (knots >= start) & (knots <= land)
        after = knots > land
        feet[swing][inside | after, 0] = move[inside | after]
        u = np.clip((knots - start) / (land - start), 0.0, 1.0)
        feet[swing][inside, 2] += 0.06 * (4.0 * u * (1.0 - u))[inside] ** 3
        at[swing] = target
        lean_t.append(0.5 * (start + land))
        lean_y.append(0.42 * side * (1.0 if stance == "Left" else -1.0))
        load_t += [start, land]
        load_r += [0.0 if stance == "Left" else 1.0] * 2
    lean_t += [stop + 1.0]
    lean_y += [0.0]
    load_t += [stop + 1.0]
    load_r += [0.5]
    load = ease(t, np.array(load_t), np.array(load_r))
    sway = 0.05 * np.sin(2.0 * np.pi * knots / step_time)
    angles = {name: np.full(knots.size, value) for name, value in _CARRY.items()}
    angles["jRightElbow_z"], angles["jLeftElbow_z"] = MOST_ANGLE + sway, -MOST_ANGLE - sway
    com = np.column_stack([forward + 0.03, ease(knots, np.array(lean_t), np.array(lean_y))])
    high = np.full(knots.size, hip_height(body) - 0.08)
    plan = Plan(knots, com, high, np.zeros(knots.size), feet, angles)
    phases = {"standing": (0.2, begin - 1.0), "walking": (begin, stop)}
    return _record(
        "human_carrying walking", body, body, plan, t, noise, seed, phases, held=held, right_load=load
    )


def _knots(duration: float) -> FloatArray:
    return np.arange(round(duration * KNOT_RATE) + 1) / KNOT_RATE


def _samples(duration: float) -> FloatArray:
    return np.arange(round(duration * RATE)) / RATE


def _standing_plan(
    body: HumanBody,
    knots: FloatArray,
    angles: Mapping[str, FloatArray],
    pitch: FloatArray | None = None,
    lean: tuple[FloatArray, FloatArray] | None = None,
    lift: Mapping[str, tuple[float, float]] | None = None,
) -> Plan:
    """Feet in place (or lifted for a while), the centre of mass over the middle of the feet or as `lean` moves it to the side."""
    feet = {side: np.tile(p, (knots.size, 1)) for side, p in standing_ankles(body).items()}
    for side, (start, end) in (lift or {}).items():
        feet[side][:, 2] += ease(
            knots, np.array([start, start + 0.8, end - 0.8, end]), 0.12 * np.array([0.0, 1.0, 1.0, 0.0])
        )
    com = np.zeros((knots.size, 2))
    com[:, 0] = 0.04
    if lean is not None:
        com[:, 1] = ease(knots, *lean)
    high = np.full(knots.size, hip_height(body) - _SOFT_KNEES - (0.01 if lean is not None else 0.0))
    return Plan(knots, com, high, np.zeros(knots.size) if pitch is None else pitch, feet, angles)


def _record(
    name: str,
    body: HumanBody,
    wearing: HumanBody,
    plan: Plan,
    t: FloatArray,
    noise: HumanNoise | None,
    seed: int,
    phases: Mapping[str, tuple[float, float]],
    held: Mapping[str, float] | None = None,
    world_forces: Mapping[str, FloatArray] | None = None,
    right_load: FloatArray | None = None,
) -> HumanRecording:
    """Truth of a plan: `held` masses at the hands' centres of mass, `world_forces` (n, 3) at the hands' ends."""
    held = held or {}
    # What is strapped on is not balanced out: the motion is the same with and without it, so that torques can be compared.
    balanced = body
    for link, mass in held.items():
        balanced = balanced.with_load(link, mass, body.segments[link].com)
    model = wearing.model()
    trajectory = realise(wearing, model, plan, t, balanced.model())
    motion = PinocchioTree(model).motion(t, trajectory.q, trajectory.v, trajectory.a)
    external = {link: _weight(motion, link, mass, body.segments[link].com) for link, mass in held.items()}
    for link, force in (world_forces or {}).items():
        local = rotate_back(motion.R[:, motion.link(link)], force)
        external[link] = np.concatenate(
            [local, np.cross(np.broadcast_to(body.ends[link], local.shape), local)], axis=1
        )
    torque, feet = _inverse_dynamics(model, trajectory, motion, external, right_load)
    names = tuple(str(n) for n in list(model.names)[2:])
    truth = HumanTruth(trajectory, model, torque, names, {**external, **feet}, motion, sum(held.values()))
    return HumanRecording(name, body, truth, noise or HumanNoise(), seed, phases)


def inverse_dynamics(body: HumanBody, trajectory: JointTrajectory) -> FloatArray:
    """Torques (n, 66) of a body by its equations of motion alone: the feet carry what they ask for, the hands nothing."""
    model = body.model()
    motion = PinocchioTree(model).motion(trajectory.t, trajectory.q, trajectory.v, trajectory.a)
    return _inverse_dynamics(model, trajectory, motion, {}, None)[0]


def _weight(motion: LinkMotion, link: str, mass: float, at: FloatArray) -> FloatArray:
    """Wrench (n, 6) on a link, in its frame, of a point mass that it holds: ``m (g - a)`` at the point `at`."""
    i = motion.link(link)
    R = motion.R[:, i]
    w, dw = (rotate_back(R, x[:, i]) for x in (motion.angular_velocity, motion.angular_acceleration))
    felt = rotate_back(R, motion.gravity - motion.acceleration[:, i])
    arm = np.broadcast_to(at, w.shape)
    force = mass * (felt - np.cross(dw, arm) - np.cross(w, np.cross(w, arm)))
    return np.concatenate([force, np.cross(arm, force)], axis=1)


def _inverse_dynamics(
    model: Any,
    trajectory: JointTrajectory,
    motion: LinkMotion,
    external: Mapping[str, FloatArray],
    right_load: FloatArray | None,
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Joint torques (n, 66), and the wrenches on the feet in their frames that the equations of motion ask for.

    On two feet they share the force as its centre of pressure lies between them (or as `right_load` says), and the rest of the
    moment in the same proportion: one of the many ways in which people stand, and as good as any.
    """
    import pinocchio as pin

    data = model.createData()
    joint = {link: int(model.frames[model.getFrameId(link)].parentJoint) for link in (*external, *FEET)}
    index = {link: motion.link(link) for link in FEET}
    pelvis = motion.link("Pelvis")
    torque = np.zeros((trajectory.t.size, model.nv - 6))
    feet = {link: np.zeros((trajectory.t.size, 6)) for link in FEET}
    forces = pin.StdVec_Force()
    for _ in range(model.njoints):
        forces.append(pin.Force.Zero())
    for k in range(trajectory.t.size):
        for link, wrench in external.items():
            forces[joint[link]] = pin.Force(wrench[k])
        for link in FEET:
            forces[joint[link]] = pin.Force.Zero()
        state = (trajectory.q[k], trajectory.v[k], trajectory.a[k])
        tau = pin.rnea(model, data, *state, forces)
        # What a free-flyer cannot give has to come from the ground; in the world, about its origin.
        total = pin.SE3(motion.R[k, pelvis], motion.p[k, pelvis]).act(pin.Force(tau[:6])).vector
        ankle = {link: motion.p[k, i] for link, i in index.items()}
        share = _share(total, ankle) if right_load is None else float(right_load[k])
        weights = dict(zip(FEET, (share, 1.0 - share), strict=True))
        middle = sum(weights[link] * ankle[link] for link in FEET)
        rest = total[3:] - np.cross(middle, total[:3])
        for link, i in index.items():
            R = motion.R[k, i]
            feet[link][k] = weights[link] * np.concatenate([R.T @ total[:3], R.T @ rest])
            forces[joint[link]] = pin.Force(feet[link][k])
        torque[k] = pin.rnea(model, data, *state, forces)[6:]
    return torque, feet


def _share(total: FloatArray, ankle: Mapping[str, FloatArray]) -> float:
    """The right foot's share: where the centre of pressure lies on the line from the left ankle to the right."""
    cop = np.array([-total[4], total[3]]) / total[2]
    right, left = (ankle[link][:2] for link in FEET)
    line = right - left
    return float(np.clip((cop - left) @ line / (line @ line), 0.0, 1.0))

"""The papers' experiments on human dynamics as simulations with ground truth (mathematics 4.7).

Bowing (Latella 2018), T-pose with and without a load and carrying while standing, on one foot and walking (Tirupachuri 2021). Joint torques
and the forces under the feet come from the body's equations of motion (pinocchio); what is measured of them has noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.models.anthropometry import Sex
from factorgrasp.models.human import HumanBody, human_body
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.problems.link_motion_spatial import rotate_back
from factorgrasp.simulation.human_forces import inverse_dynamics, inverse_dynamics_on_feet, weight_of
from factorgrasp.simulation.human_motion import (
    KNOT_RATE,
    Plan,
    ease,
    hip_height,
    realise,
    standing_ankles,
)
from factorgrasp.simulation.human_recording import (
    FEET,
    HANDS,
    IMU_LINKS,
    RATE,
    HumanNoise,
    HumanRecording,
    HumanTruth,
)
from factorgrasp.typing import FloatArray

__all__ = [
    "FEET",
    "HANDS",
    "IMU_LINKS",
    "RATE",
    "HumanNoise",
    "HumanRecording",
    "HumanTruth",
    "human_bowing",
    "human_carrying",
    "human_tpose",
    "inverse_dynamics",
]

_QUARTER_TURN = 0.5 * np.pi
_CARRY: Mapping[str, float] = {
    "jRightShoulder_x": _QUARTER_TURN, "jLeftShoulder_x": -_QUARTER_TURN,
    "jRightElbow_z": _QUARTER_TURN, "jLeftElbow_z": -_QUARTER_TURN,
}  # fmt: skip
_N_POSE: Mapping[str, float] = {"jRightShoulder_x": _QUARTER_TURN, "jLeftShoulder_x": -_QUARTER_TURN}
# Knees are never quite straight: there the leg's length has no derivative.
_SOFT_KNEES = 0.02


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
    angles["jRightShoulder_x"] = _QUARTER_TURN * (1.0 - up)
    if payload == 0.0:
        angles["jLeftShoulder_x"] = -_QUARTER_TURN * (1.0 - up)
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
    angles["jRightElbow_z"], angles["jLeftElbow_z"] = _QUARTER_TURN + sway, -_QUARTER_TURN - sway
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
    angles["jRightElbow_z"], angles["jLeftElbow_z"] = _QUARTER_TURN + sway, -_QUARTER_TURN - sway
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
    external = {link: weight_of(motion, link, mass, body.segments[link].com) for link, mass in held.items()}
    for link, force in (world_forces or {}).items():
        local = rotate_back(motion.R[:, motion.link(link)], force)
        external[link] = np.concatenate(
            [local, np.cross(np.broadcast_to(body.ends[link], local.shape), local)], axis=1
        )
    torque, feet = inverse_dynamics_on_feet(model, trajectory, motion, external, right_load)
    names = tuple(str(n) for n in list(model.names)[2:])
    truth = HumanTruth(trajectory, model, torque, names, {**external, **feet}, motion, sum(held.values()))
    return HumanRecording(name, body, truth, noise or HumanNoise(), seed, phases)

"""Motions of the body model for simulations: feet where they belong, the centre of mass where it should be, derivatives exact.

Legs follow in closed form from the pelvis and the feet; all coordinates are then quintic splines through knots, so that positions,
velocities and accelerations belong to each other to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.anthropometry import ANKLE_HEIGHT
from factorgrasp.models.human import HumanBody
from factorgrasp.models.joint_motion import free_flyer
from factorgrasp.typing import FloatArray

KNOT_RATE = 50.0
"""Hz."""
_SIDES = (("Right", -1.0), ("Left", 1.0))


class JointTrajectory(NamedTuple):
    """Configurations, velocities and accelerations at times."""

    t: FloatArray
    """(n,) s."""
    q: FloatArray
    """(n, nq), as pinocchio has them."""
    v: FloatArray
    """(n, nv)."""
    a: FloatArray
    """(n, nv)."""


@dataclass(frozen=True, eq=False)
class Plan:
    """What a motion is to be, at the knots.

    Attributes
    ----------
    t : ndarray, shape (k,)
        s, at :data:`KNOT_RATE`.
    com : ndarray, shape (k, 2)
        Where the whole body's centre of mass is to be, x and y in the world, m.
    pelvis_height : ndarray, shape (k,)
        Over the ground, m.
    pelvis_pitch : ndarray, shape (k,)
        Forward, rad.
    ankles : dict of "Right" and "Left" to ndarray (k, 3)
        Positions of the ankle joints, m; feet stay level.
    angles : dict of str to ndarray (k,)
        Hinges of everything above the hips, rad.
    """

    t: FloatArray
    com: FloatArray
    pelvis_height: FloatArray
    pelvis_pitch: FloatArray
    ankles: Mapping[str, FloatArray]
    angles: Mapping[str, FloatArray]


def ease(t: FloatArray, times: FloatArray, values: FloatArray) -> FloatArray:
    """Minimum-jerk moves (quintic, at rest at every key) through keys at increasing times; constant before and after.

    Parameters
    ----------
    t : (n,) ndarray
    times : (k,) ndarray
    values : (k,) or (k, c) ndarray
    """
    keys, stops = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
    if keys.ndim != 1 or stops.shape[0] != keys.size or (np.diff(keys) <= 0.0).any():
        raise InputError(
            "keys", "increasing times with a value each", f"{keys.size} times, {stops.shape[0]} values"
        )
    if keys.size == 1:
        return np.repeat(stops, t.size, axis=0)
    i = np.clip(np.searchsorted(keys, t, side="right") - 1, 0, keys.size - 2)
    u = np.clip((t - keys[i]) / (keys[i + 1] - keys[i]), 0.0, 1.0)
    s = u**3 * (10.0 + u * (-15.0 + 6.0 * u))
    if stops.ndim == 2:
        s = s[:, None]
    return np.asarray(stops[i] + s * (stops[i + 1] - stops[i]))


def hip_height(body: HumanBody) -> float:
    """Mid-hip over the ground with straight legs, m."""
    thigh, shank = (float(np.linalg.norm(body.ends[f"Right{part}"])) for part in ("UpperLeg", "LowerLeg"))
    return thigh + shank + ANKLE_HEIGHT * body.height


def standing_ankles(body: HumanBody) -> dict[str, FloatArray]:
    """Positions (3,) of the ankles below the hips, m."""
    height = ANKLE_HEIGHT * body.height
    return {side: np.array([0.0, float(body.placements[f"j{side}Hip"][1]), height]) for side, _ in _SIDES}


def realise(body: HumanBody, model: Any, plan: Plan, t: FloatArray, balance: Any = None) -> JointTrajectory:
    """The motion of a plan at times `t` (within its knots).

    Parameters
    ----------
    body : HumanBody
    model : pinocchio.Model
        ``body.model()``.
    plan : Plan
    t : (n,) ndarray
        s.
    balance : pinocchio.Model, optional
        Whose centre of mass follows the plan, with loads for instance; `model` by default.

    Raises
    ------
    InputError
        When a leg is too short for the plan.
    """
    import pinocchio as pin

    balance = model if balance is None else balance
    data = balance.createData()
    count = plan.t.size
    columns = {name: int(model.joints[model.getJointId(name)].idx_q) for name in _hinges(body)}
    q = np.zeros((count, model.nq))
    q[:, 4], q[:, 6] = np.sin(0.5 * plan.pelvis_pitch), np.cos(0.5 * plan.pelvis_pitch)
    for name, values in plan.angles.items():
        if name not in columns:
            raise InputError("angles", "hinges of the body", repr(name))
        q[:, columns[name]] = values
    pelvis = np.column_stack([plan.com, plan.pelvis_height])
    for _ in range(6):
        # The legs' share of the mass makes the centre of mass follow the pelvis by less than all: a fixed point.
        q[:, :3] = pelvis
        for side, _sign in _SIDES:
            for name, values in _leg(body, side, pelvis, plan.pelvis_pitch, plan.ankles[side]).items():
                q[:, columns[name]] = values
        # A copy: what pinocchio returns is a view of its one result.
        com = np.array([pin.centerOfMass(balance, data, row)[:2].copy() for row in q])
        miss = com - plan.com
        pelvis[:, :2] -= 1.15 * miss
        if np.abs(miss).max() < 1e-5:
            break
    return _spline(plan, q, t)


def _hinges(body: HumanBody) -> list[str]:
    return [f"{joint}_{axis}" for joint in body.placements for axis in "xyz"]


def _leg(
    body: HumanBody, side: str, pelvis: FloatArray, pitch: FloatArray, ankle: FloatArray
) -> dict[str, FloatArray]:
    """Hip, knee and ankle angles (k,) that put a level foot with its ankle at `ankle` (k, 3).

    With r the hip seen from the ankle: the knee's angle follows from its length; the ankle's y and x bring it into the plane of the knee;
    the hip turns by what is left.
    """
    upper, lower = (float(np.linalg.norm(body.ends[f"{side}{part}"])) for part in ("UpperLeg", "LowerLeg"))
    R_w_p = lie.so3_exp(np.column_stack([0.0 * pitch, pitch, 0.0 * pitch]))
    r = pelvis + R_w_p @ body.placements[f"j{side}Hip"] - ankle
    cosine = (np.sum(r**2, axis=1) - upper**2 - lower**2) / (2.0 * upper * lower)
    if (cosine > 1.0).any():
        k = int(np.argmax(cosine))
        raise InputError(
            f"plan of the {side.lower()} leg",
            f"a hip within {upper + lower:.3f} m of the ankle",
            f"{np.linalg.norm(r[k]):.3f} m at knot {k}",
        )
    knee = np.arccos(np.clip(cosine, -1.0, 1.0))
    reach = np.hypot(r[:, 0], r[:, 2])
    b = np.arcsin(-upper * np.sin(knee) / reach) - np.arctan2(r[:, 0], r[:, 2])
    turned = np.cos(b) * r[:, 2] - np.sin(b) * r[:, 0]
    a = np.arctan2(r[:, 1], turned)
    R_s_f = _about("x", a) @ _about("y", b)
    R = np.swapaxes(R_w_p, 1, 2) @ np.swapaxes(R_s_f, 1, 2) @ _about("y", -knee)
    return {
        f"j{side}Hip_x": np.arctan2(-R[:, 1, 2], R[:, 2, 2]),
        f"j{side}Hip_y": np.arcsin(R[:, 0, 2]),
        f"j{side}Hip_z": np.arctan2(-R[:, 0, 1], R[:, 0, 0]),
        f"j{side}Knee_y": knee,
        f"j{side}Ankle_x": a,
        f"j{side}Ankle_y": b,
    }


def _about(axis: str, angle: FloatArray) -> FloatArray:
    vector = np.zeros((angle.size, 3))
    vector[:, "xyz".index(axis)] = angle
    return lie.so3_exp(vector)


def _spline(plan: Plan, q: FloatArray, t: FloatArray) -> JointTrajectory:
    from scipy.interpolate import make_interp_spline

    if t[0] < plan.t[0] - 1e-9 or t[-1] > plan.t[-1] + 1e-9:
        raise InputError(
            "t",
            f"times within the plan, {plan.t[0]:.3f} to {plan.t[-1]:.3f} s",
            f"{t[0]:.3f} to {t[-1]:.3f} s",
        )
    at = np.clip(t, plan.t[0], plan.t[-1])
    coordinates = np.concatenate([q[:, :3], plan.pelvis_pitch[:, None], q[:, 7:]], axis=1)
    spline = make_interp_spline(plan.t, coordinates, k=5)
    x, xd, xdd = (np.asarray(spline(at, nu=k)) for k in (0, 1, 2))
    zero = np.zeros(t.size)

    def pitch(values: FloatArray) -> FloatArray:
        return np.column_stack([zero, values[:, 3], zero])

    rotation = lie.quaternion_exp_wxyz(pitch(x))
    root = free_flyer(x[:, :3], rotation, xd[:, :3], pitch(xd), xdd[:, :3], pitch(xdd))
    parts = [
        np.concatenate([base, rest[:, 4:]], axis=1) for base, rest in zip(root, (x, xd, xdd), strict=True)
    ]
    return JointTrajectory(t, *parts)

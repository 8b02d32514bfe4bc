"""The tables of a problem file with ``kind = "human_dynamics"``.

[model], [motion], [[forces]], [[sensors]], [covariance], [contacts], [constraints].
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.human_dynamics_forces import PLATE_COVARIANCE, Six, mounting, read_wrenches
from factorgrasp.human_dynamics_inputs import read_sensors
from factorgrasp.human_dynamics_motion import BodyMotion, Vector, read_body_motion
from factorgrasp.human_dynamics_spelling import canonical
from factorgrasp.human_dynamics_task import HumanDynamicsTask
from factorgrasp.problems.human_dynamics_constraints import DynamicsConstraint, TorqueLimit, feet_on_the_floor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise, PerName
from factorgrasp.toml_tables import check_keys, close_matches, convert, get, place, sub_table

TABLES = ("model", "motion", "forces", "sensors", "covariance", "contacts", "constraints")
PRESETS = ("default", "latella2018", "tirupachuri2021")

BASE_RESIDUAL = (900.0,) * 6
"""N^2 and (Nm)^2: what a recorded motion of unstated noise and plates disagree about, as a wrench on the base.

10 to 50 N are common; 5 % of the weight is what Hicks et al. (2015, J. Biomech. Eng. 137(2)) call acceptable.
"""

_NOISE = tuple(field.name for field in fields(HumanDynamicsNoise))
_OF_JOINTS = ("propagation", "joint_acceleration", "prior_joint_wrench", "prior_joint_acceleration")
_Number = float | tuple[float, ...]


def build(table: Mapping[str, Any], base_dir: Path) -> HumanDynamicsTask:
    """The human-dynamics problem of a problem file.

    Parameters
    ----------
    table : mapping
        The tables of the file.
    base_dir : Path
        Folder that its paths are relative to.

    Raises
    ------
    InputError
        Naming the table and the key, or the recording and the column.
    """
    table = canonical(table)
    check_keys(table, TABLES, "")
    contacts, constraints = sub_table(table, "contacts"), sub_table(table, "constraints")
    check_keys(contacts, ("unmeasured", "payload", "points", "method"), "[contacts]")
    check_keys(
        constraints,
        ("feet", "friction", "corners", "position", "rotation_wxyz", "torque_limits", "hard_dynamics"),
        "[constraints]",
    )
    covariance = sub_table(table, "covariance")
    check_keys(covariance, ("preset", "plate", "base_residual", *_NOISE), "[covariance]")
    plate = get(covariance, "plate", Six, "[covariance]", PLATE_COVARIANCE)

    body = read_body_motion(table, base_dir)
    noise = _noise(covariance, body)
    wrenches = read_wrenches(table.get("forces"), body, base_dir, plate)
    bandwidth = get(sub_table(table, "motion"), "bandwidth", float, "[motion]", 6.0)
    sensors = [*wrenches, *read_sensors(table.get("sensors", []), body, base_dir, bandwidth)]
    unmeasured = _links(contacts, "unmeasured", body)
    payload = _links(contacts, "payload", body)
    for link in payload:
        if link not in unmeasured:
            raise InputError("[contacts] payload", "links of [contacts] unmeasured", repr(link))
    base = body.motion.links[body.motion.tree.root]
    touched = {*unmeasured, *(sensor.link for sensor in wrenches)}
    residual = _base_residual(covariance, body, base, touched, alone=not unmeasured)
    if residual is not None:
        noise = replace(noise, free_wrench=_with_one(noise.free_wrench, base, residual))
    points: dict[str, tuple[float, ...]] = {}
    for link, point in sub_table(contacts, "points").items():
        field = f"[contacts.points] {link}"
        if link not in unmeasured:
            raise InputError(
                field, "a link of [contacts] unmeasured", "none", close_matches(link, unmeasured)
            )
        points[link] = convert(point, Vector, field)
    method = get(contacts, "method", Literal["joint", "two_tasks"], "[contacts]", "joint")
    if method == "two_tasks" and points:
        raise InputError("[contacts] method", '"joint", where points are given', repr(method))
    return HumanDynamicsTask(
        body.motion,
        sensors,
        body.clock,
        body.good,
        noise=noise,
        contacts=unmeasured,
        points=points,
        payload=payload,
        method=method,
        constraints=_constraints(constraints, body),
        hard_dynamics=get(constraints, "hard_dynamics", bool, "[constraints]", False),
        residual=None if residual is None else base,
        extras=body.extras,
    )


def _noise(covariance: Mapping[str, Any], body: BodyMotion) -> HumanDynamicsNoise:
    preset = get(
        covariance, "preset", Literal["default", "latella2018", "tirupachuri2021"], "[covariance]", "default"
    )
    presets: dict[str, Callable[[], HumanDynamicsNoise]] = {
        "default": HumanDynamicsNoise,
        "latella2018": HumanDynamicsNoise.latella2018,
        "tirupachuri2021": HumanDynamicsNoise.tirupachuri2021,
    }
    noise = presets[preset]()
    # What follows from the motion goes before a preset, what is stated here before both.
    stated: dict[str, PerName] = dict(body.variances)
    for key in _NOISE:
        if key in covariance:
            known = [j.name for j in body.motion.joints] if key in _OF_JOINTS else list(body.motion.links)
            stated[key] = _per_name(covariance[key], known, place("[covariance]", key))
    return replace(noise, **stated)


def _base_residual(
    covariance: Mapping[str, Any], body: BodyMotion, base: str, touched: Collection[str], alone: bool
) -> tuple[float, ...] | None:
    """Variances of the wrench on the base that makes up for errors of motion and masses; None where there is none.

    Accelerations of a trunk are wrong by more than any noise of markers: soft tissue, arms and head as one segment. Where nothing states
    how wrong, the disagreement is taken up where inverse dynamics leaves it, too, and not by the plates, whose forces would then
    turn into moments of knee and hip.
    """
    field = place("[covariance]", "base_residual")
    if "base_residual" in covariance:
        if body.motion.tree.fixed_base or base in touched:
            raise InputError(field, f"a floating base that nothing else holds ({base})", "one that is held")
        value = convert(covariance["base_residual"], float | Six, field)
        variances = np.broadcast_to(np.asarray(value, dtype=float), (6,))
        if not np.all(variances > 0.0):
            raise InputError(field, "variances above zero, N^2 and (Nm)^2", f"{value}")
        return tuple(variances)
    stated = (
        body.variances or body.motion.state_noise is not None or {"free_wrench", "preset"} & set(covariance)
    )
    unknown = not stated and alone and base not in touched and not body.motion.tree.fixed_base
    return BASE_RESIDUAL if unknown and touched else None


def _with_one(value: PerName, name: str, one: tuple[float, ...]) -> PerName:
    """Variances with another one for a single name."""
    return {**value, name: one} if isinstance(value, Mapping) else {"default": value, name: one}


def _per_name(value: Any, known: Sequence[str], field: str) -> PerName:
    """A variance, one a component, or either by name."""
    if not isinstance(value, Mapping):
        return convert(value, _Number, field)  # type: ignore[no-any-return]
    for name in value:
        if name != "default" and name not in known:
            raise InputError(
                f"{field} {name}", "a name of the model, or default", "none", close_matches(name, known)
            )
    return {name: convert(one, _Number, f"{field} {name}") for name, one in value.items()}


def _links(contacts: Mapping[str, Any], key: str, body: BodyMotion) -> tuple[str, ...]:
    links: tuple[str, ...] = get(contacts, key, tuple[str, ...], "[contacts]", ())
    for link in links:
        if link not in body.motion.links:
            raise InputError(
                place("[contacts]", key),
                "links of the model",
                repr(link),
                close_matches(link, body.motion.links),
            )
    return links


def _constraints(table: Mapping[str, Any], body: BodyMotion) -> list[DynamicsConstraint]:
    where = "[constraints]"
    out: list[DynamicsConstraint] = []
    feet: tuple[str, ...] = get(table, "feet", tuple[str, ...], where, ())
    for link in feet:
        if link not in body.motion.links:
            raise InputError(
                place(where, "feet"), "links of the model", repr(link), close_matches(link, body.motion.links)
            )
    if feet:
        R, p = mounting(table, where)
        corners = (
            get(table, "corners", tuple[tuple[float, float], ...], where, None)
            if "corners" in table
            else None
        )
        made = feet_on_the_floor(feet, get(table, "friction", float, where, 0.7), R_l_s=R, p_l_s=p)
        if corners is not None:
            made = feet_on_the_floor(feet, get(table, "friction", float, where, 0.7), np.array(corners), R, p)
        out += made
    else:
        for key in ("friction", "corners", "position", "rotation_wxyz"):
            if key in table:
                raise InputError(place(where, key), "feet in the same table", "none")
    known = [joint.name for joint in body.motion.joints]
    for joint, limit in sub_table(table, "torque_limits").items():
        field = f"[constraints.torque_limits] {joint}"
        if joint not in known:
            raise InputError(field, "a joint of the model", "none", close_matches(joint, known))
        low, high = limit if isinstance(limit, list) and len(limit) == 2 else (None, limit)
        upper = convert(high, float, field)
        out.append(TorqueLimit(joint, -upper if low is None else convert(low, float, field), upper))
    return out

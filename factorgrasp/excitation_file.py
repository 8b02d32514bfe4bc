"""The tables of a problem file with ``kind = "excitation"``: [robot], [grasp], [human], [excitation], [noise], [solver]; or [evaluate]."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.excitation_task import ExcitationTask
from factorgrasp.problems.excitation import GRAVITY, ArmTask, Excitation
from factorgrasp.problems.excitation_human import (
    HumanMotion,
    planar_human,
    recorded_human,
    static_human,
    task_human,
)
from factorgrasp.problems.excitation_settings import ExcitationSettings, GraspBelief, HumanWrist
from factorgrasp.problems.grasp_settings import GraspNoise
from factorgrasp.toml_tables import check_keys, from_table, get, place, sub_table
from factorgrasp.typing import FloatArray

TABLES = ("robot", "grasp", "human", "excitation", "noise", "solver", "evaluate")
Three = tuple[float, float, float]
Four = tuple[float, float, float, float]
Numbers = float | tuple[float, ...]
_LIMITS = (
    "position_lower", "position_upper", "velocity", "acceleration", "jerk", "torque", "box_lower", "box_upper", "collision_distance",
)  # fmt: skip
_WRIST = tuple(item.name for item in fields(HumanWrist))
_PAIRS = 40


def build(table: Mapping[str, Any], base_dir: Path) -> Any:
    """The plan that a problem file asks for.

    Raises
    ------
    InputError
        Naming the table and the key.
    """
    if "evaluate" in table:
        from factorgrasp.excitation_evaluate import build_evaluation

        return build_evaluation(table, base_dir)
    check_keys(table, TABLES, "")
    settings = from_table(ExcitationSettings, sub_table(table, "excitation", required=True), "[excitation]")
    grasp = read_grasp(sub_table(table, "grasp", required=True), base_dir)
    noise = from_table(GraspNoise, sub_table(table, "noise"), "[noise]")
    human_table = sub_table(table, "human")
    check_keys(
        human_table,
        (
            "mode",
            "position",
            "rotation_wxyz",
            "waypoints",
            "travel",
            "turn",
            "goal_position",
            "goal_rotation_wxyz",
            "file",
            *_WRIST,
        ),
        "[human]",
    )
    wrist = from_table(
        HumanWrist, {key: value for key, value in human_table.items() if key in _WRIST}, "[human]"
    )
    robot = sub_table(table, "robot")
    arm = None if not robot else _Arm(robot, base_dir)
    pose = _wrist_pose(human_table, grasp, arm)
    human = _human(human_table, settings, pose, base_dir)
    arm_task = None if arm is None else arm.task(grasp, human)
    gravity = GRAVITY if arm is None else np.array(arm.model.gravity.linear)
    problem = Excitation(grasp, human, settings, wrist, noise, arm_task, gravity=gravity)
    return ExcitationTask(problem, solver_options(sub_table(table, "solver")))


def solver_options(table: Mapping[str, Any]) -> dict[str, Any]:
    """Options of [solver], less its name."""
    check_keys(table, ("name", "max_iterations", "tolerance", "time_limit"), "[solver]")
    kinds = {"max_iterations": int, "tolerance": float, "time_limit": float}
    out = {key: get(table, key, kind, "[solver]") for key, kind in kinds.items() if key in table}
    for key, value in out.items():
        if value <= 0:
            raise InputError(f"[solver] {key}", "a number above zero", f"{value}")
    return out


def read_grasp(table: Mapping[str, Any], base_dir: Path) -> GraspBelief:
    """[grasp]: an ``estimate.json`` of a grasp, or its numbers; a covariance that is stated goes before the file's."""
    where = "[grasp]"
    check_keys(
        table,
        ("estimate", "rotation_wxyz", "translation", "covariance", "rotation_sd", "translation_sd"),
        where,
    )
    found: dict[str, FloatArray] = {}
    if "estimate" in table:
        for key in ("rotation_wxyz", "translation"):
            if key in table:
                raise InputError(place(where, key), "nothing beside estimate", "a value")
        found = _estimate_file(base_dir / get(table, "estimate", str, where))
    else:
        found["translation"] = np.array(get(table, "translation", Three, where))
        found["rotation_wxyz"] = np.array(get(table, "rotation_wxyz", Four, where, (1.0, 0.0, 0.0, 0.0)))
    quaternion = found["rotation_wxyz"]
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > 1e-3:
        raise InputError(
            f"{where} rotation_wxyz",
            "a unit quaternion [w, x, y, z]",
            f"norm {np.linalg.norm(quaternion):.4g}",
        )
    if "covariance" in table:
        found["covariance"] = _covariance(table["covariance"], f"{where} covariance")
    elif "rotation_sd" in table or "translation_sd" in table or "covariance" not in found:
        sd = [
            get(table, key, float, where, default)
            for key, default in (("rotation_sd", 0.2), ("translation_sd", 0.05))
        ]
        for key, value in zip(("rotation_sd", "translation_sd"), sd, strict=True):
            if value <= 0.0:
                raise InputError(place(where, key), "a number above zero", f"{value:g}")
        found["covariance"] = np.diag(np.repeat(np.square(sd), 3))
    R = lie.quaternion_wxyz_to_matrix(quaternion / np.linalg.norm(quaternion))
    return GraspBelief(R, found["translation"], found["covariance"])


def _covariance(value: Any, field: str) -> FloatArray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise InputError(field, "6 variances, or a matrix (6, 6)", repr(value)[:80]) from None
    if array.shape == (6,):
        array = np.diag(array)
    if array.shape != (6, 6) or not np.all(np.isfinite(array)):
        raise InputError(field, "6 variances, or a matrix (6, 6)", f"shape {array.shape}")
    return array


def _estimate_file(path: Path) -> dict[str, FloatArray]:
    field = "[grasp] estimate"
    if path.is_dir():
        path = path / "estimate.json"
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        values = stored["values"]["grasp"]
        found = {
            key: np.array(values[key], dtype=float) for key in ("rotation_wxyz", "translation", "covariance")
        }
    except FileNotFoundError:
        raise InputError(field, "an estimate.json of a grasp", f"no file {path}") from None
    except (json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(field, "an estimate.json of a grasp", f"{path}: {error}") from None
    # What was not observed is stored as null.
    if not np.all(np.isfinite(found["covariance"])):
        raise InputError(
            field,
            "a grasp with a finite covariance",
            f"{path}: unknown entries",
            "State covariance in [grasp]",
        )
    return found


class _Arm:
    """[robot]."""

    def __init__(self, table: Mapping[str, Any], base_dir: Path) -> None:
        from factorgrasp.models.casadi_robot import CasadiRobot
        from factorgrasp.models.robot import load_robot
        from factorgrasp.problems.excitation_arm import limits_of, link_spheres, tool_chain, with_payload

        where = "[robot]"
        check_keys(
            table, ("urdf", "frame", "start", "gravity", "payload_mass", "payload_center", *_LIMITS), where
        )
        urdf = base_dir / get(table, "urdf", str, where)
        self.frame = get(table, "frame", str, where)
        full = load_robot(urdf)
        model = tool_chain(full, self.frame)
        if "gravity" in table:
            model.gravity.linear = np.array(get(table, "gravity", Three, where))
        mass = get(table, "payload_mass", float, where, 0.0)
        if mass < 0.0:
            raise InputError("[robot] payload_mass", "zero or more, kg", f"{mass:g}")
        if mass > 0.0:
            model = with_payload(
                model, self.frame, mass, np.array(get(table, "payload_center", Three, where, (0.0, 0.0, 0.0)))
            )
        self.model, self.robot = model, CasadiRobot(model)
        stated = {
            key: get(
                table,
                key,
                float if key == "collision_distance" else Three if key.startswith("box") else Numbers,
                where,
            )
            for key in _LIMITS
            if key in table
        }
        if ("box_lower" in stated) != ("box_upper" in stated):
            raise InputError("[robot] box_lower", "box_lower and box_upper together", "one of them")
        try:
            self.limits = limits_of(model, stated)
        except InputError as error:
            raise InputError(
                f"[robot] {error.field.rpartition('.')[2]}", error.expected, error.found, error.hint
            ) from error
        middle = np.clip(0.5 * (self.limits.position_lower + self.limits.position_upper), -np.pi, np.pi)
        self.stated_start = "start" in table
        start = np.array(get(table, "start", tuple[float, ...], where, tuple(middle)))
        if start.shape != (model.nv,):
            raise InputError("[robot] start", f"{model.nv} joint positions", f"{start.size}")
        if np.any(start < self.limits.position_lower) or np.any(start > self.limits.position_upper):
            j = int(
                np.argmax(np.maximum(self.limits.position_lower - start, start - self.limits.position_upper))
            )
            raise InputError(
                "[robot] start", f"joint positions within the limits, {model.names[j + 1]!r} between "
                f"{self.limits.position_lower[j]:.4g} and {self.limits.position_upper[j]:.4g}", f"{start[j]:g}",
            )  # fmt: skip
        self.start: FloatArray = start
        self.spheres: Any = ()
        self.pairs: Any = ()
        self.others: Any = ()
        if self.limits.collision_distance is not None:
            self.spheres, pairs = link_spheres(self.robot, urdf, full, start, self.limits.collision_distance)
            self.pairs, self.others = pairs[:_PAIRS], pairs[_PAIRS:]

    def task(self, grasp: GraspBelief, human: HumanMotion) -> ArmTask:
        """With joint positions that fit the first and the last pose of the wrist."""
        from factorgrasp.problems.excitation_arm import find_configuration, follow, tool_pose

        ends = np.array([0.0, human.duration])
        R = human.orientation(ends) @ grasp.rotation.T
        p = human.position(ends)[0].T - R @ grasp.translation
        start = self.start
        R0, p0 = tool_pose(self.model, self.frame, start)
        if np.max(np.abs(R0 - R[0])) > 1e-9 or np.max(np.abs(p0 - p[0])) > 1e-9:
            # The wrist's pose is stated; the robot has to come to it.
            start, _ = find_configuration(self.model, self.frame, self.limits, R[0], p[0], start)
        times = np.linspace(0.0, human.duration, 41)
        R_all = human.orientation(times) @ grasp.rotation.T
        p_all = human.position(times)[0].T - R_all @ grasp.translation
        q, _ = follow(self.model, self.frame, self.limits, start, R_all, p_all)
        return ArmTask(
            self.robot, self.frame, self.limits, start, q[:, -1], self.spheres, self.pairs, self.others
        )


def _wrist_pose(
    table: Mapping[str, Any], grasp: GraspBelief, arm: _Arm | None
) -> tuple[FloatArray, FloatArray]:
    """Where the wrist is at the start: as stated, or where the robot holds it."""
    from factorgrasp.problems.excitation_arm import tool_pose

    where = "[human]"
    p, R = np.zeros(3), np.eye(3)
    if arm is not None:
        R_w_r, p_w_r = tool_pose(arm.model, arm.frame, arm.start)
        p, R = p_w_r + R_w_r @ grasp.translation, R_w_r @ grasp.rotation
    if "position" in table:
        p = np.array(get(table, "position", Three, where))
    if "rotation_wxyz" in table:
        R = _rotation(table, "rotation_wxyz", where)
    return p, R


def _rotation(table: Mapping[str, Any], key: str, where: str) -> FloatArray:
    q = np.array(get(table, key, Four, where))
    if abs(float(np.linalg.norm(q)) - 1.0) > 1e-3:
        raise InputError(place(where, key), "a unit quaternion [w, x, y, z]", f"norm {np.linalg.norm(q):.4g}")
    return np.asarray(lie.quaternion_wxyz_to_matrix(q / np.linalg.norm(q)))


def _human(
    table: Mapping[str, Any],
    settings: ExcitationSettings,
    pose: tuple[FloatArray, FloatArray],
    base_dir: Path,
) -> HumanMotion:
    where, T = "[human]", settings.duration
    mode = get(table, "mode", Literal["static", "planar", "six_dof", "task"], where, "static")
    known = {
        "static": (),
        "planar": ("waypoints", "travel"),
        "six_dof": ("file",),
        "task": ("travel", "turn", "goal_position", "goal_rotation_wxyz"),
    }
    for key in ("waypoints", "travel", "turn", "goal_position", "goal_rotation_wxyz", "file"):
        if key in table and key not in known[mode]:
            raise InputError(place(where, key), f"nothing in the mode {mode!r}", "a value")
    p, R = pose
    if mode == "static":
        return static_human(T, p, R)
    if mode == "planar":
        if ("waypoints" in table) == ("travel" in table):
            raise InputError(
                f"{where} travel",
                "travel (from the wrist's start) or waypoints (in the world)",
                "neither or both",
            )
        key = "travel" if "travel" in table else "waypoints"
        points = np.array(get(table, key, tuple[Three, ...], where))
        if key == "travel":
            points = np.vstack([p, p + points.reshape(-1, 3)])
        return planar_human(T, points, R)
    if mode == "six_dof":
        return _recorded(base_dir / get(table, "file", str, where), pose, T)
    goal_p, goal_R = p, R
    if "travel" in table:
        goal_p = p + np.array(get(table, "travel", Three, where))
    if "goal_position" in table:
        goal_p = np.array(get(table, "goal_position", Three, where))
    if "turn" in table:
        goal_R = R @ lie.so3_exp(np.array(get(table, "turn", Three, where)))
    if "goal_rotation_wxyz" in table:
        goal_R = _rotation(table, "goal_rotation_wxyz", where)
    if goal_p is p and goal_R is R:
        raise InputError(
            f"{where} travel",
            "where the task leads: travel and turn, or goal_position and goal_rotation_wxyz",
            "none",
        )
    return task_human(T, (p, R), (goal_p, goal_R))


def _recorded(path: Path, pose: tuple[FloatArray, FloatArray], duration: float) -> HumanMotion:
    """A recording of the hand's pose, moved so that it begins where the wrist is."""
    from factorgrasp.recordings.csv import read_poses

    stream = read_poses(path)
    good = np.isfinite(stream.position).all(axis=1) & np.isfinite(stream.rotation_wxyz).all(axis=1)
    R = lie.quaternion_wxyz_to_matrix(stream.rotation_wxyz[good])
    turned = pose[1] @ R[0].T
    position = pose[0] + (stream.position[good] - stream.position[good][0]) @ turned.T
    return recorded_human(stream.t[good], position, turned @ R, duration)

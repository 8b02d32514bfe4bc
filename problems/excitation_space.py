"""The two spaces in which an excitation is planned: rotations about the wrist, and the robot's joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgrasp.models.motion_basis import MotionBasis
from factorgrasp.problems import excitation_expressions as expressions
from factorgrasp.problems.excitation_human import HumanMotion
from factorgrasp.problems.excitation_node import NodeFunction
from factorgrasp.problems.excitation_program import Motion
from factorgrasp.problems.excitation_settings import ExcitationSettings, GraspBelief, HumanWrist, RobotLimits
from factorgrasp.typing import FloatArray

REGULARISATION = 1e-4
"""Weight of the mean squares of the joint rates over their limits: what decides between motions that the wrist cannot tell apart."""


@dataclass(frozen=True)
class PathBound:
    """Bounds of one output of a path function.

    Attributes
    ----------
    lower, upper, scale : float
        In the unit of the output.
    name : str
        What is limited, as a user reads it.
    unit : str
        Of its root, when `root`.
    root : bool
        Whether the output is the square of what is limited.
    """

    lower: float
    upper: float
    scale: float
    name: str
    unit: str
    root: bool = False


@dataclass(frozen=True)
class CoordinateBound:
    """Bounds of one derivative of one coordinate."""

    coordinate: int
    order: int
    lower: float
    upper: float
    name: str
    unit: str

    @property
    def scale(self) -> float:
        """Half the width of the range."""
        return 0.5 * (self.upper - self.lower) if np.isfinite(self.upper - self.lower) else 1.0


@dataclass(frozen=True, eq=False)
class PlanSpace:
    """Coordinates of a plan, what is integrated over it, and what limits it.

    Attributes
    ----------
    name : str
        "task" or "joint".
    motion : Motion
    integrand : NodeFunction
        Energy first, then the moments of excitation (and of information).
    path : NodeFunction or None
    path_bounds : tuple of PathBound
    coordinate_bounds : tuple of CoordinateBound
    fixed : tuple of (time, order, target)
    reach : float
        Bound of the coefficients.
    read : NodeFunction
        ``R_w_r`` (9, column by column), ``p_w_r``, w, al, f, turn (3 each), expected squared displacement of the wrist.
    """

    name: str
    motion: Motion
    integrand: NodeFunction
    path: NodeFunction | None
    path_bounds: tuple[PathBound, ...]
    coordinate_bounds: tuple[CoordinateBound, ...]
    fixed: tuple[tuple[float, int, FloatArray], ...]
    reach: float
    read: NodeFunction


def task_space(
    grasp: GraspBelief,
    wrist: HumanWrist,
    human: HumanMotion,
    settings: ExcitationSettings,
    basis: MotionBasis,
    gravity: FloatArray,
    box: tuple[FloatArray, FloatArray] | None = None,
    start: FloatArray | None = None,
) -> PlanSpace:
    """Rotation vector about the wrist, or the angle about the direction of travel.

    Parameters
    ----------
    start : (3, m) ndarray, optional
        Value, rate and acceleration with which the plan begins, in place of rest.
    """
    import casadi as ca

    m = 1 if settings.axes == "travel" else 3
    z, p = ca.SX.sym("z", 3 * m), ca.SX.sym("p", expressions.GIVEN)
    instant = expressions.about_the_wrist(z, p, grasp.translation, gravity)
    motion = Motion(basis, m, lambda t: np.zeros((4, m, np.size(t))), human.given(grasp.rotation))
    outputs, bounds = _common_path(instant, z, p, grasp, wrist, settings, box)
    fixed: list[tuple[float, int, FloatArray]] = []
    if settings.rest or start is not None:
        for time in motion.ends:
            fixed += [(time, k, np.zeros(m) if start is None or time > 0.0 else start[k]) for k in range(3)]
    if m == 1:
        # The axis jumps at a corner: the object has to be where the human wants it there, and at rest about it.
        fixed += [(corner, k, np.zeros(1)) for corner in human.corners for k in range(3)]
    reach = 2.0 * (wrist.largest_turn or 1.5)
    return PlanSpace(
        "task", motion, _integrand(instant, z, p, grasp, wrist, settings), _path(z, p, outputs), tuple(bounds), (),
        tuple(fixed), reach, _read(instant, z, p, grasp),
    )  # fmt: skip


def joint_space(
    robot: Any,
    frame: str,
    limits: RobotLimits,
    grasp: GraspBelief,
    wrist: HumanWrist,
    human: HumanMotion,
    settings: ExcitationSettings,
    basis: MotionBasis,
    ends: tuple[FloatArray, FloatArray],
    spheres: Sequence[tuple[Any, FloatArray, float]] = (),
    pairs: Sequence[tuple[int, int, str]] = (),
) -> PlanSpace:
    """Joint positions about a motion of minimum jerk between the two `ends` (n,).

    Parameters
    ----------
    robot : CasadiRobot
        Without quaternions or unbounded joints.
    frame : str
    spheres : sequence of (elementary joint, centre in its frame, radius)
    pairs : sequence of (sphere, sphere, words)
        Whose distance is limited by ``limits.collision_distance``.
    """
    import casadi as ca

    from factorgrasp.models.casadi_dynamics import rnea
    from factorgrasp.models.motion_basis import minimum_jerk

    n = robot.nv
    z, p = ca.SX.sym("z", 3 * n), ca.SX.sym("p", expressions.GIVEN)
    gravity = robot.gravity
    instant = expressions.of_the_robot(robot, frame, z, p, grasp.translation, gravity)
    duration, (q_a, q_b) = basis.duration, ends

    def offset(t: FloatArray) -> FloatArray:
        path = minimum_jerk(np.asarray(t) / duration)
        out = np.stack([np.outer(q_b - q_a, path[k]) / duration**k for k in range(4)])
        out[0] += q_a[:, None]
        return out

    motion = Motion(basis, n, offset, human.given(grasp.rotation))
    box = (
        None if limits.box_lower is None or limits.box_upper is None else (limits.box_lower, limits.box_upper)
    )
    outputs, bounds = _common_path(instant, z, p, grasp, wrist, settings, box)
    names = [str(robot.model.names[j]) for j in range(1, robot.model.njoints)]
    if limits.torque is not None:
        outputs.append(rnea(robot, z[:n], z[n : 2 * n], z[2 * n :]))
        bounds += [
            PathBound(-size, size, size, f"torque of {name}", "Nm")
            for name, size in zip(names, limits.torque, strict=True)
        ]
    if limits.collision_distance is not None and pairs:
        walked = robot.motion(z[:n])
        centres = []
        for joint, centre, _ in spheres:
            c = ca.DM(centre)
            centres.append(c if joint < 0 else walked.position[joint] + walked.rotation[joint] @ c)
        for i, j, words in pairs:
            away = centres[i] - centres[j]
            least = spheres[i][2] + spheres[j][2] + limits.collision_distance
            # As a ratio of squares, which is smooth and about one where it matters.
            outputs.append(ca.dot(away, away) / least**2)
            bounds.append(PathBound(1.0, np.inf, 1.0, f"distance between {words}", "of the least", True))
    v_max = np.ones(n) if limits.velocity is None else limits.velocity
    effort = REGULARISATION * ca.sumsqr(z[n : 2 * n] / ca.DM(v_max))
    fixed = tuple((time, k, np.zeros(n)) for time in motion.ends for k in range(3)) if settings.rest else ()
    reach = 2.0 * float(np.max(np.minimum(limits.position_upper - limits.position_lower, 2.0 * np.pi)))
    return PlanSpace(
        "joint", motion, _integrand(instant, z, p, grasp, wrist, settings, effort), _path(z, p, outputs), tuple(bounds),
        tuple(_joint_bounds(limits, names)), fixed, reach, _read(instant, z, p, grasp),
    )  # fmt: skip


def _joint_bounds(limits: RobotLimits, names: Sequence[str]) -> list[CoordinateBound]:
    out = []
    for j, name in enumerate(names):
        out.append(
            CoordinateBound(
                j,
                0,
                float(limits.position_lower[j]),
                float(limits.position_upper[j]),
                f"position of {name}",
                "rad",
            )
        )
        for order, word, unit, sizes in (
            (1, "velocity", "rad/s", limits.velocity),
            (2, "acceleration", "rad/s^2", limits.acceleration),
            (3, "jerk", "rad/s^3", limits.jerk),
        ):
            if sizes is not None and np.isfinite(sizes[j]):
                out.append(
                    CoordinateBound(j, order, -float(sizes[j]), float(sizes[j]), f"{word} of {name}", unit)
                )
    return out


def _common_path(
    instant: Any, z: Any, p: Any, grasp: GraspBelief, wrist: HumanWrist, settings: ExcitationSettings,
    box: tuple[FloatArray, FloatArray] | None,
) -> tuple[list[Any], list[PathBound]]:  # fmt: skip
    """What is limited in either space: the wrist's turn and force, the end-effector's rates and place."""
    import casadi as ca

    outputs: list[Any] = []
    bounds: list[PathBound] = []

    def at_most(square: Any, limit: float | None, name: str, unit: str) -> None:
        if limit is not None:
            outputs.append(square)
            bounds.append(PathBound(-np.inf, limit**2, limit**2, name, unit, True))

    at_most(ca.dot(instant.turn, instant.turn), wrist.largest_turn, wrist.turn_words, "rad")
    if wrist.max_force is not None:
        away = expressions.force_square(instant, p, grasp.covariance_r[3:, 3:]) * wrist.force_stiffness**2
        at_most(away, wrist.max_force, f"force at the human's wrist (max_force {wrist.max_force:g} N)", "N")
    at_most(
        ca.dot(instant.rate, instant.rate),
        settings.max_angular_velocity,
        "angular velocity of the end-effector",
        "rad/s",
    )
    change = instant.rate_change
    at_most(
        ca.dot(change, change),
        settings.max_angular_acceleration,
        "angular acceleration of the end-effector",
        "rad/s^2",
    )
    if box is not None:
        for k, axis in enumerate("xyz"):
            outputs.append(instant.position[k])
            width = float(box[1][k] - box[0][k])
            bounds.append(
                PathBound(float(box[0][k]), float(box[1][k]), 0.5 * width, f"workspace box along {axis}", "m")
            )
    return outputs, bounds


def _path(z: Any, p: Any, outputs: Sequence[Any]) -> NodeFunction | None:
    import casadi as ca

    return NodeFunction("path", z, p, ca.cse(ca.vertcat(*outputs))) if outputs else None


def _integrand(
    instant: Any,
    z: Any,
    p: Any,
    grasp: GraspBelief,
    wrist: HumanWrist,
    settings: ExcitationSettings,
    effort: Any = 0.0,
) -> NodeFunction:
    import casadi as ca

    stiffness, comfort = (
        (wrist.force_stiffness, wrist.moment_stiffness),
        (wrist.comfort_force, wrist.comfort_moment),
    )
    energy = expressions.wrench_energy(instant, p, grasp.covariance_r[3:, 3:], stiffness, comfort)
    parts = [energy + effort, *expressions.excitation_moments(instant)]
    if settings.alpha is None:
        parts += expressions.information_moments(instant)
    return NodeFunction("integrand", z, p, ca.cse(ca.vertcat(*parts)))


def _read(instant: Any, z: Any, p: Any, grasp: GraspBelief) -> NodeFunction:
    import casadi as ca

    away = expressions.Given.of(p).position - instant.wrist
    parts = [
        ca.reshape(instant.rotation, 9, 1), instant.position, instant.rate, instant.rate_change, instant.force,
        instant.turn, expressions.force_square(instant, p, grasp.covariance_r[3:, 3:]), away,
    ]  # fmt: skip
    return NodeFunction("read", z, p, ca.cse(ca.vertcat(*parts)))

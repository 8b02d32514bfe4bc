"""The robot of an excitation: the chain that moves the tool, its limits, inverse kinematics, and spheres for the distance between links."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.models.casadi_robot import CasadiRobot
from factorgrasp.models.robot import frame_id
from factorgrasp.problems.excitation_settings import RobotLimits
from factorgrasp.typing import FloatArray

REACHED = 1e-4
"""m and rad: error of the inverse kinematics below which a pose counts as reached."""


def tool_chain(model: Any, frame: str, posture: FloatArray | None = None) -> Any:
    """The model with every joint locked that does not move the tool (fingers, other arms).

    Raises
    ------
    InputError
        When the tool's frame is unknown, or a joint that moves it has more than one coordinate.
    """
    import pinocchio

    joint = int(model.frames[frame_id(model, frame)].parentJoint)
    moving = set()
    while joint:
        moving.add(joint)
        joint = int(model.parents[joint])
    if not moving:
        raise InputError("robot.frame", "a frame that some joint moves", repr(frame))
    for joint in moving:
        if model.joints[joint].nq != 1 or model.joints[joint].nv != 1:
            raise InputError(
                "robot.urdf", "joints of one bounded coordinate between base and tool",
                f"{model.names[joint]!r} ({model.joints[joint].shortname()})",
            )  # fmt: skip
    locked = [j for j in range(1, model.njoints) if j not in moving]
    reference = pinocchio.neutral(model) if posture is None else posture
    return pinocchio.buildReducedModel(model, locked, reference) if locked else model


def with_payload(model: Any, frame: str, mass: float, center: FloatArray) -> Any:
    """The model with a point mass at `center` (3,) of the tool's frame, such as half of the object that both carry."""
    import pinocchio

    out = model.copy()
    tool = out.frames[frame_id(out, frame)]
    out.appendBodyToJoint(
        tool.parentJoint, pinocchio.Inertia(mass, np.asarray(center), np.zeros((3, 3))), tool.placement
    )
    return out


def limits_of(model: Any, stated: Mapping[str, FloatArray | float | None]) -> RobotLimits:
    """Limits of the URDF, with those that are stated in their place.

    Parameters
    ----------
    model : pinocchio.Model
        Of the chain.
    stated : mapping
        Fields of :class:`RobotLimits`; a number holds for every joint.

    Raises
    ------
    InputError
        For a wrong length, a limit that is not positive, or a range without room.
    """
    n = model.nv

    def known(values: Any) -> FloatArray | None:
        array = np.array(values, dtype=float)
        array[(array <= 0.0) | (array > 1e6)] = np.inf
        return array if np.any(np.isfinite(array)) else None

    made: dict[str, Any] = {
        "position_lower": np.array(model.lowerPositionLimit),
        "position_upper": np.array(model.upperPositionLimit),
        "velocity": known(model.velocityLimit),
        "torque": known(model.effortLimit),
    }
    for name, value in stated.items():
        if value is None:
            continue
        array = np.asarray(value, dtype=float)
        size = 3 if name.startswith("box") else n
        if name == "collision_distance":
            made[name] = float(array)
            continue
        if array.ndim == 0:
            array = np.full(size, float(array))
        if array.shape != (size,) or np.any(np.isnan(array)):
            raise InputError(f"robot.{name}", f"one number, or {size}", f"{array.tolist()}")
        if name in ("velocity", "acceleration", "jerk", "torque") and np.any(array <= 0.0):
            raise InputError(f"robot.{name}", "numbers above zero", f"{array.tolist()}")
        made[name] = array
    limits = RobotLimits(**made)
    if np.any(limits.position_lower >= limits.position_upper):
        raise InputError(
            "robot.position_lower",
            "less than position_upper at every joint",
            f"{limits.position_lower.tolist()}",
        )
    if (
        limits.box_lower is not None
        and limits.box_upper is not None
        and np.any(limits.box_lower >= limits.box_upper)
    ):
        raise InputError(
            "robot.box_lower", "less than box_upper along every axis", f"{limits.box_lower.tolist()}"
        )
    if limits.torque is not None:
        return replace(limits, torque=np.where(np.isfinite(limits.torque), limits.torque, 1e6))
    return limits


def tool_pose(model: Any, frame: str, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``R_w_r`` and ``p_w_r``."""
    import pinocchio

    data = model.createData()
    pinocchio.forwardKinematics(model, data, q)
    placement = pinocchio.updateFramePlacement(model, data, frame_id(model, frame))
    return np.array(placement.rotation), np.array(placement.translation)


def follow(
    model: Any, frame: str, limits: RobotLimits, start: FloatArray, rotation: FloatArray, position: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Joint positions (nv, n) along poses ``R_w_r`` (n, 3, 3), ``p_w_r`` (n, 3), each from the one before, and the errors (n,) left.

    Damped least squares within the position limits; what a redundant arm leaves open is drawn to the start.
    """
    import pinocchio

    data, index = model.createData(), frame_id(model, frame)
    q, out, errors = np.array(start, dtype=float), [], []
    room = 0.01 * (limits.position_upper - limits.position_lower)
    low, high = limits.position_lower + room, limits.position_upper - room
    for R, p in zip(rotation, position, strict=True):
        target = pinocchio.SE3(R, p)
        for number in range(200):
            J = pinocchio.computeFrameJacobian(model, data, q, index, pinocchio.LOCAL)
            pinocchio.forwardKinematics(model, data, q)
            placement = pinocchio.updateFramePlacement(model, data, index)
            error = pinocchio.log6(placement.actInv(target)).vector
            size = float(np.linalg.norm(error))
            if size < 1e-10 and number:
                break
            damping = 1e-8 + 1e-2 * min(size, 1.0) ** 2
            A = J @ J.T + damping * np.eye(6)
            step = J.T @ np.linalg.solve(A, error)
            pull = start - q
            if number < 5:
                # Later it would only keep the pose from being met.
                step += 0.05 * (pull - J.T @ np.linalg.solve(A, J @ pull))
            q = np.clip(q + step * min(1.0, 0.3 / max(1e-12, float(np.max(np.abs(step))))), low, high)
        out.append(q.copy())
        errors.append(size)
    return np.array(out).T, np.array(errors)


def find_configuration(
    model: Any,
    frame: str,
    limits: RobotLimits,
    rotation: FloatArray,
    position: FloatArray,
    seed: FloatArray,
    tries: int = 20,
) -> tuple[FloatArray, float]:
    """A configuration that reaches a pose, from `seed` and from random ones; the best there is, and its error."""
    rng = np.random.default_rng(0)
    low = np.where(np.isfinite(limits.position_lower), limits.position_lower, -np.pi)
    high = np.where(np.isfinite(limits.position_upper), limits.position_upper, np.pi)
    best, left = seed, np.inf
    for k in range(tries):
        q0 = seed if k == 0 else rng.uniform(low, high)
        q, error = follow(model, frame, limits, q0, rotation[None], position[None])
        if error[0] < left:
            best, left = q[:, 0], float(error[0])
        if left < REACHED:
            break
    return best, left


def link_spheres(
    robot: CasadiRobot,
    urdf: str | Path,
    full: Any,
    start: FloatArray,
    distance: float,
    mesh_folders: Sequence[str] = (),
) -> tuple[tuple[tuple[int, FloatArray, float], ...], tuple[tuple[int, int, str], ...]]:
    """Spheres that cover the collision geometry of the URDF, and the pairs of them whose distance is worth watching.

    Cylinders, capsules and boxes are covered by spheres along their longest axis. Pairs on one link or on neighbouring links are left
    out, and pairs that are nearer than asked for at the start: there the geometry is too coarse to say anything.

    Raises
    ------
    InputError
        When the URDF has no collision geometry of simple solids.
    """
    import pinocchio

    geometry = pinocchio.buildGeomFromUrdf(
        full, str(urdf), pinocchio.GeometryType.COLLISION, package_dirs=list(mesh_folders)
    )
    spheres: list[tuple[int, FloatArray, float]] = []
    owner: list[tuple[int, str]] = []
    for one in geometry.geometryObjects:
        name = full.names[int(one.parentJoint)]
        # Links behind locked joints belong to the joint before them; their placement is that of the reduced model's frame.
        frame = full.frames[int(one.parentFrame)].name
        if not robot.model.existFrame(frame):
            continue
        tool = robot.model.frames[robot.model.getFrameId(frame)]
        in_frame = full.frames[int(one.parentFrame)].placement.actInv(one.placement)
        placement = tool.placement.act(in_frame)
        joint = robot.joint_of_frame(frame)
        for centre, radius in _cover(one.geometry):
            spheres.append((joint, placement.act(np.asarray(centre)), radius))
            owner.append((joint, frame if joint >= 0 else "the base"))
        del name
    if not spheres:
        raise InputError(
            "robot.collision_distance",
            "a URDF with simple solids as collision geometry",
            "none (meshes are not read)",
        )
    found = []
    places = sphere_places(robot, spheres, start[:, None])[0]
    for i in range(len(spheres)):
        for j in range(i + 1, len(spheres)):
            (a, first), (b, second) = owner[i], owner[j]
            if abs(a - b) < 2:
                continue
            gap = float(np.linalg.norm(places[i] - places[j])) - spheres[i][2] - spheres[j][2]
            if gap > distance:
                found.append((gap, (i, j, f"{first} and {second}")))
    found.sort(key=lambda one: one[0])
    return tuple(spheres), tuple(pair for _, pair in found)


def sphere_places(
    robot: CasadiRobot, spheres: Sequence[tuple[int, FloatArray, float]], q: FloatArray
) -> FloatArray:
    """(n, spheres, 3): where the centres are in the world, for configurations q (nq, n)."""
    import casadi as ca

    symbol = ca.SX.sym("q", robot.nq)
    motion = robot.motion(symbol)
    points = []
    for joint, centre, _ in spheres:
        c = ca.DM(centre)
        points.append(ca.SX(c) if joint < 0 else motion.position[joint] + motion.rotation[joint] @ c)
    function = ca.Function("places", [symbol], [ca.densify(ca.vertcat(*points))])
    return np.asarray(function.map(q.shape[1])(q).full()).T.reshape(q.shape[1], len(spheres), 3)


def _cover(shape: Any) -> list[tuple[FloatArray, float]]:
    """Centres and radii, in the frame of a solid."""
    kind = type(shape).__name__
    if kind == "Sphere":
        return [(np.zeros(3), float(shape.radius))]
    if kind in ("Capsule", "Cylinder"):
        half, radius = float(shape.halfLength), float(shape.radius)
        return _along(np.array([0.0, 0.0, 1.0]), half, radius)
    if kind == "Box":
        sides = np.array(shape.halfSide, dtype=float)
        longest = int(np.argmax(sides))
        across = float(np.linalg.norm(np.delete(sides, longest)))
        return _along(np.eye(3)[longest], float(sides[longest]), across)
    return []


def _along(axis: FloatArray, half: float, radius: float) -> list[tuple[FloatArray, float]]:
    count = max(1, int(np.ceil(half / max(radius, 1e-3))) + 1)
    step = 2.0 * half / count
    grown = float(np.hypot(radius, 0.5 * step))
    return [(axis * (-half + (k + 0.5) * step), grown) for k in range(count)]

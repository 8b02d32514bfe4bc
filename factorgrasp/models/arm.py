"""A seven-axis arm that holds an object: the Panda where its URDF is installed, else a plain arm of the same proportions."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.errors import InfeasibleError, InputError
from factorgrasp.typing import FloatArray

GRASP_FRAME = "grasp"
"""The frame ``r`` that is added to the arm: between the fingers, x away from the robot and z up when the arm is as at its start."""

_PANDA = "panda_description/urdf/panda.urdf"
# The gripper holds the object's edge from above, 0.4 m in front of the robot, elbow bent: there its wrist can turn about a far point.
_PANDA_START = (0.0, -0.5, 0.0, -2.55, 0.0, 2.05, 0.785)
_FROM_ABOVE = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm, ready to be simulated.

    Attributes
    ----------
    name : str
    model : pinocchio.Model
        Arm joints only, the payload in its last link, with the frame :data:`GRASP_FRAME`.
    frame : int
        Index of that frame.
    start : (7,) ndarray
        A configuration in the middle of the workspace, rad.
    """

    name: str
    model: Any
    frame: int
    start: FloatArray

    def placement(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``R_w_r`` (3, 3) and ``p_w_r`` (3,) at a configuration."""
        import pinocchio

        data = self.model.createData()
        pinocchio.forwardKinematics(self.model, data, q)
        at = pinocchio.updateFramePlacement(self.model, data, self.frame)
        return np.array(at.rotation), np.array(at.translation)

    def reach(self, rotation: FloatArray, position: FloatArray, q: FloatArray | None = None) -> FloatArray:
        """A configuration (n,) with the frame at a pose, within the joint limits, by damped least squares from `q`.

        Raises
        ------
        InfeasibleError
            When none is found.
        """
        import pinocchio

        model, data = self.model, self.model.createData()
        target = pinocchio.SE3(rotation, position)
        low, high = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
        here: FloatArray = np.array(self.start if q is None else q)
        error = np.full(6, np.inf)
        for _ in range(500):
            pinocchio.computeJointJacobians(model, data, here)
            at = pinocchio.updateFramePlacement(model, data, self.frame)
            error = pinocchio.log6(at.actInv(target)).vector
            if np.linalg.norm(error) < 1e-10:
                return here
            J = pinocchio.getFrameJacobian(model, data, self.frame, pinocchio.LOCAL)
            step = J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), error)
            # Towards the middle of the limits where the task leaves that free.
            free = np.eye(model.nv) - np.linalg.pinv(J) @ J
            step += 0.05 * free @ (0.5 * (low + high) - here)
            short = min(1.0, 0.3 / max(float(np.linalg.norm(step)), 1e-12))
            here = np.asarray(np.clip(here + short * step, low, high))
            if np.linalg.norm(error) < 1e-7:
                return here
        raise InfeasibleError(
            f"the {self.name} cannot reach the pose: {1e3 * np.linalg.norm(error[:3]):.1f} mm and "
            f"{np.degrees(np.linalg.norm(error[3:])):.2f} deg remain"
        )

    def follow(self, rotations: FloatArray, positions: FloatArray, q: FloatArray) -> FloatArray:
        """Configurations (n, joints) along poses (n, 3, 3) and (n, 3), each by the smallest step from the one before; the first from `q`.

        Raises
        ------
        InfeasibleError
            Where a pose is out of reach, or a joint would have to leave its limits.
        """
        import pinocchio

        model, data, here = self.model, self.model.createData(), np.array(q, dtype=float)
        low, high = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
        out = np.empty((positions.shape[0], model.nq))
        for k, (rotation, position) in enumerate(zip(rotations, positions, strict=True)):
            target = pinocchio.SE3(rotation, position)
            for _ in range(50):
                pinocchio.computeJointJacobians(model, data, here)
                at = pinocchio.updateFramePlacement(model, data, self.frame)
                error = pinocchio.log6(at.actInv(target)).vector
                if np.linalg.norm(error) < 1e-11:
                    break
                J = pinocchio.getFrameJacobian(model, data, self.frame, pinocchio.LOCAL)
                here = here + J.T @ np.linalg.solve(J @ J.T + 1e-9 * np.eye(6), error)
            if np.linalg.norm(error) > 1e-8 or np.any(here < low) or np.any(here > high):
                raise InfeasibleError(f"the {self.name} cannot follow pose {k} within its joint limits")
            out[k] = here
        return out


def panda_urdf() -> Path | None:
    """The Panda of example-robot-data (extra ``robots``); None when it is not installed."""
    try:
        files = metadata.files("example-robot-data") or []
    except metadata.PackageNotFoundError:
        return None
    for file in files:
        if str(file).endswith(_PANDA):
            path = Path(str(file.locate()))
            return path if path.is_file() else None
    return None


def panda_arm(payload: float = 1.0, payload_size: tuple[float, float, float] = (1.0, 0.8, 0.02)) -> Arm:
    """The Panda with an object in its gripper; see :func:`seven_axis_arm` for one without its URDF.

    Parameters
    ----------
    payload : float
        kg, the robot's share of a plate that is held at two edges (the paper's weighs 2 kg): where the human carries the other half, it
        loads the arm as a body at the grip. Alone at one edge no arm of this class could hold it.
    payload_size : (3,) float
        Of the whole plate, m, along x, y and z of the frame ``r``.

    Raises
    ------
    InputError
        When example-robot-data is not installed.
    """
    import pinocchio

    urdf = panda_urdf()
    if urdf is None:
        raise InputError(
            "arm", "the Panda of example-robot-data", "not installed", "pip install 'factorgrasp[robots]'"
        )
    full = pinocchio.buildModelFromUrdf(str(urdf))
    fingers = [full.getJointId(name) for name in full.names if "finger" in name]
    model = pinocchio.buildReducedModel(full, fingers, pinocchio.neutral(full))
    gripper = model.frames[model.getFrameId("panda_hand_tcp")]
    grip = gripper.placement * pinocchio.SE3(_FROM_ABOVE, np.zeros(3))
    return _finished("Panda", model, int(gripper.parentJoint), grip, payload, payload_size, _PANDA_START)


def seven_axis_arm(payload: float = 1.0, payload_size: tuple[float, float, float] = (1.0, 0.8, 0.02)) -> Arm:
    """A plain seven-axis arm: links like a Panda's, of round masses; needs nothing but pinocchio."""
    import pinocchio

    model = pinocchio.Model()
    model.name = "seven axes"
    axes, parent = ("z", "y", "z", "y", "z", "y", "x"), 0
    # Shoulder at 0.33 m, upper arm 0.32 m, forearm 0.38 m, then a wrist whose last axis is that of the gripper.
    offsets = [(0, 0, 0.33), (0, 0, 0), (0, 0, 0.32), (0, 0, 0), (0, 0, 0.38), (0, 0, 0), (0.09, 0, 0)]
    masses, lengths = (3.0, 3.0, 3.0, 3.0, 2.0, 1.5, 0.8), (0.1, 0.3, 0.1, 0.3, 0.1, 0.1, 0.1)
    limit = np.array([2.9, 1.9, 2.9, 2.7, 2.9, 2.6, 2.9])
    for k, (axis, offset) in enumerate(zip(axes, offsets, strict=True)):
        joint = {"x": pinocchio.JointModelRX, "y": pinocchio.JointModelRY, "z": pinocchio.JointModelRZ}[
            axis
        ]()
        place = pinocchio.SE3(np.eye(3), np.array(offset, dtype=float))
        effort = np.array([87.0 if k < 4 else 12.0])
        parent = model.addJoint(
            parent, joint, place, f"joint{k + 1}", effort, np.array([2.175 if k < 4 else 2.61]),
            -limit[k : k + 1], limit[k : k + 1],
        )  # fmt: skip
        along = np.array([lengths[k] / 2, 0, 0]) if k == 6 else np.array([0, 0, lengths[k] / 2])
        shape = pinocchio.Inertia.FromBox(masses[k], 0.1, 0.1, max(lengths[k], 0.1))
        model.appendBodyToJoint(parent, shape, pinocchio.SE3(np.eye(3), along))
    grip = pinocchio.SE3(np.eye(3), np.array([0.2, 0.0, 0.0]))
    return _finished("arm", model, parent, grip, payload, payload_size, (0.0, -0.5, 0.0, 2.0, 0.0, -1.5, 0.0))


def default_arm(payload: float = 1.0) -> Arm:
    """The Panda where it is installed, else :func:`seven_axis_arm`."""
    return seven_axis_arm(payload) if panda_urdf() is None else panda_arm(payload)


def _finished(
    name: str,
    model: Any,
    joint: int,
    grip: Any,
    payload: float,
    size: tuple[float, float, float],
    start: tuple[float, ...],
) -> Arm:
    import pinocchio

    frame = model.addFrame(pinocchio.Frame(GRASP_FRAME, joint, 0, grip, pinocchio.FrameType.OP_FRAME))
    held = pinocchio.Inertia.FromBox(payload, *size)
    model.appendBodyToJoint(joint, held, grip * pinocchio.SE3(np.eye(3), np.array([0.5 * size[0], 0.0, 0.0])))
    return Arm(name, model, int(frame), np.array(start))

"""Link motion from an OpenSim model with its coordinates: joints keep all of their spatial transform, translations included.

A joint's degrees of freedom are its coordinates, so that torques are OpenSim's generalised forces: that of a knee which slides as it
bends holds the force times the slide.
"""

from __future__ import annotations

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.osim import GROUND, OsimModel
from factorgrasp.problems.link_motion import LinkJoint, LinkMotion
from factorgrasp.typing import FloatArray

_STEP = 1e-3
"""s, of the central differences along the motion; the error grows with its square."""


def from_osim(
    model: OsimModel,
    t: FloatArray,
    q: FloatArray,
    qd: FloatArray,
    qdd: FloatArray,
    gravity: FloatArray | None = None,
) -> LinkMotion:
    """Motion of all bodies.

    Parameters
    ----------
    model : OsimModel
    t : (n,) ndarray
        s.
    q, qd, qdd : (n, c) ndarray
        Coordinates of the model in its order, rad and m, and their derivatives.
    gravity : (3,) ndarray, optional
        m/s^2; the model's by default.

    Raises
    ------
    InputError
        For another number of coordinates, and for more than one body on the ground.
    """
    for name, value in (("q", q), ("qd", qd), ("qdd", qdd)):
        if value.shape != (t.size, len(model.names)):
            raise InputError(name, f"shape ({t.size}, {len(model.names)})", str(value.shape))
    roots = [joint.child for joint in model.joints if joint.parent == GROUND]
    if len(roots) != 1:
        raise InputError("joints of the model", "one body that moves against the ground", ", ".join(roots))
    sides = [q + s * _STEP * qd + 0.5 * (s * _STEP) ** 2 * qdd for s in (-1.0, 0.0, 1.0)]
    (R0, p0), (R, p), (R1, p1) = (model.poses(side) for side in sides)
    before, after = lie.so3_log(R @ np.swapaxes(R0, -1, -2)), lie.so3_log(R1 @ np.swapaxes(R, -1, -2))
    values = [model.values(side) for side in sides]
    second = {
        name: (values[0][name] - 2.0 * values[1][name] + values[2][name]) / _STEP**2 for name in model.names
    }
    joints, centres, accelerations = [], [], []
    for joint in model.joints:
        if joint.parent == GROUND:
            continue
        up, down = model.bodies.index(joint.parent), model.bodies.index(joint.child)
        S = joint.subspace(values[1], t.size) if joint.coordinates else None
        joints.append(LinkJoint(joint.name, up, down, joint.coordinates, S))
        centres.append(p[:, up] + R[:, up] @ joint.p_p)
        accelerations += [second[name] for name in joint.coordinates]
    return LinkMotion(
        t=t, links=model.bodies, mass=model.mass, com=model.com, inertia=model.inertia, R=R, p=p,
        velocity=(p1 - p0) / (2.0 * _STEP), angular_velocity=(before + after) / (2.0 * _STEP),
        acceleration=(p1 - 2.0 * p + p0) / _STEP**2, angular_acceleration=(after - before) / _STEP**2,
        joints=tuple(joints), joint_centre=np.stack(centres, axis=1),
        joint_acceleration=np.column_stack(accelerations) if accelerations else np.zeros((t.size, 0)),
        gravity=model.gravity if gravity is None else gravity,
    )  # fmt: skip

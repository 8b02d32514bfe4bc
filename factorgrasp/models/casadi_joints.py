"""The joints of a pinocchio model as elementary ones that CasADi expressions can follow.

An *elementary* joint has a motion subspace that is constant in the joint's own frame. Composite, universal and Z-Y-X spherical joints are
chains of such joints with massless links between them; a mimic joint is one whose coordinate is another joint's, scaled and shifted.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray

JointKind = Literal["screw", "unbounded", "free_flyer", "planar", "spherical", "translation", "fixed"]


@dataclass(frozen=True, eq=False)
class ElementaryJoint:
    """One link of the walk from the base to the tips.

    Attributes
    ----------
    kind : str
        "screw": one coordinate along `subspace` (revolute, prismatic, helical); "unbounded": a revolute joint with the coordinates
        (cos, sin); "free_flyer": (x, y, z, quaternion x, y, z, w); "planar": (x, y, cos, sin); "spherical": (quaternion x, y, z, w);
        "translation": (x, y, z).
    parent : int
        Index of the elementary joint before it; -1 for the base.
    rotation, position : ndarray
        ``R_p_j`` (3, 3) and ``p_p_j`` (3,): placement in the parent at zero.
    subspace : ndarray, shape (6, nv)
        Spatial velocity ``[linear; angular]`` in the joint's frame per unit of velocity.
    idx_q, nq, idx_v, nv : int
        Where its coordinates and velocities stand; for a mimic joint those of the joint that it follows.
    ratio, offset : float
        Coordinate = ratio * the followed coordinate + offset.
    mass : float
        kg, of the link that it carries; 0 inside a chain.
    center : ndarray, shape (3,)
        Centre of mass in the joint's frame, m.
    inertia : ndarray, shape (3, 3)
        About the centre of mass, kg m^2.
    body : int
        Index of the pinocchio joint whose link this is, 0 inside a chain.
    """

    kind: JointKind
    parent: int
    rotation: FloatArray
    position: FloatArray
    subspace: FloatArray
    idx_q: int
    nq: int
    idx_v: int
    nv: int
    ratio: float = 1.0
    offset: float = 0.0
    mass: float = 0.0
    center: FloatArray = field(default_factory=lambda: np.zeros(3))
    inertia: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    body: int = 0


@dataclass(frozen=True)
class _Part:
    """An elementary piece of one pinocchio joint: kind, placement within the joint, subspace, coordinates relative to the joint's."""

    kind: JointKind
    rotation: FloatArray
    position: FloatArray
    subspace: FloatArray
    q: tuple[int, int]
    v: tuple[int, int]
    ratio: float = 1.0
    offset: float = 0.0


_NO_TURN, _ORIGIN = np.eye(3), np.zeros(3)
_WHOLE: dict[str, tuple[JointKind, tuple[int, ...]]] = {
    # Kind, and which of the six unit twists its velocities are.
    "JointModelFreeFlyer": ("free_flyer", (0, 1, 2, 3, 4, 5)),
    "JointModelPlanar": ("planar", (0, 1, 5)),
    "JointModelSpherical": ("spherical", (3, 4, 5)),
    "JointModelTranslation": ("translation", (0, 1, 2)),
}


def elementary_joints(model: Any) -> tuple[tuple[ElementaryJoint, ...], tuple[int, ...]]:
    """The joints of a ``pinocchio.Model``, parents first, and for every pinocchio joint the elementary one that carries its link.

    Raises
    ------
    InputError
        For a joint whose motion subspace depends on its coordinates in a way that no chain expresses (an ellipsoid joint).
    """
    out: list[ElementaryJoint] = []
    last = [-1] * model.njoints
    for j in range(1, model.njoints):
        placement, inertia = model.jointPlacements[j], model.inertias[j]
        parent = last[model.parents[j]]
        R, p = np.array(placement.rotation), np.array(placement.translation)
        mimics = model.joints[j].shortname() == "JointModelMimic"
        parts = [_mimic(model, j)] if mimics else _parts(model.joints[j], model.names[j])
        for k, part in enumerate(parts):
            tip = k == len(parts) - 1
            out.append(
                ElementaryJoint(
                    part.kind, parent, R @ part.rotation, p + R @ part.position, part.subspace, *part.q, *part.v,
                    part.ratio, part.offset,
                    float(inertia.mass) if tip else 0.0,
                    np.array(inertia.lever) if tip else _ORIGIN,
                    np.array(inertia.inertia) if tip else np.zeros((3, 3)),
                    j if tip else 0,
                )
            )  # fmt: skip
            parent, R, p = len(out) - 1, _NO_TURN, _ORIGIN
        last[j] = parent
    return tuple(out), tuple(last)


def _parts(joint: Any, name: str) -> list[_Part]:
    kind = str(joint.shortname())
    q, v = (int(joint.idx_q), int(joint.nq)), (int(joint.idx_v), int(joint.nv))
    if kind in _WHOLE:
        word, chosen = _WHOLE[kind]
        return [_Part(word, _NO_TURN, _ORIGIN, np.eye(6)[:, list(chosen)], q, v)]
    if kind == "JointModelSphericalZYX":
        return [_turn(axis, q[0] + k, v[0] + k) for k, axis in enumerate(np.eye(3)[::-1])]
    if kind == "JointModelUniversal":
        own = joint.extract()
        return [_turn(np.array(axis), q[0] + k, v[0] + k) for k, axis in enumerate((own.axis1, own.axis2))]
    if kind == "JointModelComposite":
        return _composite(joint.extract(), name)
    if v[1] == 1 and q[1] in (1, 2):
        single: JointKind = "screw" if q[1] == 1 else "unbounded"
        return [_Part(single, _NO_TURN, _ORIGIN, _subspace(joint), q, v)]
    raise InputError("robot joint", "revolute, prismatic, helical, universal, spherical, planar, free-flyer, "
                     "translation, composite or mimic", f"{name!r}: {kind}")  # fmt: skip


def _turn(axis: FloatArray, idx_q: int, idx_v: int) -> _Part:
    return _Part("screw", _NO_TURN, _ORIGIN, np.concatenate([_ORIGIN, axis])[:, None], (idx_q, 1), (idx_v, 1))


def _subspace(joint: Any) -> FloatArray:
    """(6, 1) motion subspace of a joint of one degree of freedom."""
    import pinocchio

    alone = pinocchio.Model()
    alone.addJoint(0, joint, pinocchio.SE3.Identity(), "joint")
    data = alone.createData()
    J = pinocchio.computeJointJacobian(alone, data, pinocchio.neutral(alone), 1)
    return np.asarray(J).reshape(6, 1)


def _composite(joint: Any, name: str) -> list[_Part]:
    out: list[_Part] = []
    for placement, inner in zip(joint.jointPlacements, joint.joints, strict=True):
        parts = _parts(inner, name)
        R, p = np.array(placement.rotation), np.array(placement.translation)
        first = parts[0]
        parts[0] = _Part(
            first.kind,
            R @ first.rotation,
            p + R @ first.position,
            first.subspace,
            first.q,
            first.v,
            first.ratio,
            first.offset,
        )
        out += parts
    return out


def _mimic(model: Any, j: int) -> _Part:
    """A joint that follows another; pinocchio does not show its axis, so that it is read off a motion."""
    import pinocchio

    joint = model.joints[j]
    own, q = joint.extract(), pinocchio.neutral(model)
    ratio, offset = float(own.scaling), float(own.offset)
    (followed,) = (
        one
        for one in range(1, model.njoints)
        if model.joints[one].nv and model.joints[one].idx_q == joint.idx_q
    )
    if model.joints[followed].nq != 1:
        raise InputError(
            "robot mimic joint", "one that follows a joint of one coordinate",
            f"{model.names[j]!r} follows {model.names[followed]!r}",
        )  # fmt: skip
    q[joint.idx_q] = (1.0 - offset) / ratio if ratio else 0.0
    data = model.createData()
    pinocchio.forwardKinematics(model, data, q)
    moved = pinocchio.log6(model.jointPlacements[j].actInv(data.liMi[j])).vector
    # Its coordinate was one; or, without a ratio, it stays at its offset whatever the other does.
    subspace = moved if ratio else moved / (offset or 1.0)
    at = (int(joint.idx_q), 1), (int(joint.idx_v), 1)
    return _Part("screw", _NO_TURN, _ORIGIN, np.array(subspace)[:, None], *at, ratio, offset)

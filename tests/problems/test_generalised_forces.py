"""Generalised forces of coordinates: the power of the joint's wrench, exact for hinges, sliders and a knee that slides while it bends."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.problems.generalised_forces import Coordinate, coordinate_from_motion, generalised_force
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.solvers.frames import solve_frames
from factorgrasp.typing import FloatArray

from .human_dynamics_body import smooth_states

pin = pytest.importorskip("pinocchio")
COUNT = 60


def leg() -> Any:
    """Thigh on a fixed base; the shank slides by two sliders and turns by a hinge."""
    model = pin.Model()
    model.gravity.linear = np.array([0.0, 0.0, -9.80665])
    body = pin.Inertia(3.0, np.array([0.02, 0.0, -0.2]), np.diag([0.05, 0.05, 0.01]))
    hip = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "hip")
    model.appendBodyToJoint(hip, body, pin.SE3.Identity())
    at = hip
    for name, joint in (
        ("slide_x", pin.JointModelPX()),
        ("slide_z", pin.JointModelPZ()),
        ("knee", pin.JointModelRY()),
    ):
        place = pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.4])) if name == "slide_x" else pin.SE3.Identity()
        at = model.addJoint(at, joint, place, name)
    model.appendBodyToJoint(at, body, pin.SE3.Identity())
    return model


def slide(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How the knee slides with its angle: x and z, and their first and second derivatives by it, (2, n)."""
    return (
        np.array([0.01 * np.sin(q), 0.008 * np.cos(2.0 * q)]),
        np.array([0.01 * np.cos(q), -0.016 * np.sin(2.0 * q)]),
        np.array([-0.01 * np.sin(q), -0.032 * np.cos(2.0 * q)]),
    )


@pytest.fixture(scope="module")
def bent() -> tuple[LinkMotion, FloatArray, FloatArray, FloatArray]:
    """Motion of the leg, the knee's angle and rate, and its generalised force by virtual work."""
    model = leg()
    t, q, v, a = smooth_states(model, COUNT)
    T, dT, ddT = slide(q[:, 3])
    q[:, 1:3], v[:, 1:3] = T.T, (dT * v[:, 3]).T
    a[:, 1:3] = (dT * a[:, 3] + ddT * v[:, 3] ** 2).T
    data = model.createData()
    tau = np.array([pin.rnea(model, data, *state) for state in zip(q, v, a, strict=True)])
    truth = tau[:, 3] + np.sum(tau[:, 1:3] * dT.T, axis=1)
    return PinocchioTree(model).motion(t, q, v, a), q[:, 3], v[:, 3], truth


def test_a_sliding_knee(bent: tuple[LinkMotion, FloatArray, FloatArray, FloatArray]) -> None:
    """Turning and sliding together are the virtual work; turning alone is not."""
    motion, q, qd, truth = bent
    estimate = solve_frames(HumanDynamics(motion))
    j = next(i for i, joint in enumerate(motion.joints) if len(joint.dofs) == 3)
    joint = motion.joints[j].name
    found = generalised_force(estimate, coordinate_from_motion(motion, joint, q, qd, "knee angle"))
    assert found.name == "knee angle"
    assert np.abs(found.value - truth).max() < 2e-2
    assert np.abs(found.turning - truth).max() > 0.1
    assert np.allclose(found.turning + found.sliding, found.value)
    s = coordinate_from_motion(motion, joint, q, qd).direction
    P = estimate.joint_wrench_covariance[:, j]
    assert np.allclose(found.sd, np.sqrt(np.einsum("ni,nij,nj->n", s, P, s)))


def test_a_hinge_is_its_torque(bent: tuple[LinkMotion, FloatArray, FloatArray, FloatArray]) -> None:
    """For a joint with a fixed axis the same as the torque, with the same sd."""
    motion = bent[0]
    estimate = solve_frames(HumanDynamics(motion))
    S = motion.joints[0].subspace
    assert S is not None
    found = generalised_force(estimate, Coordinate("hip", "hip", np.tile(S[:, 0], (COUNT, 1))))
    assert np.allclose(found.value, estimate.torque[:, 0])
    assert np.allclose(found.sd, estimate.torque_sd[:, 0])
    assert np.allclose(found.sliding, 0.0)


def test_bad_input_is_named(bent: tuple[LinkMotion, FloatArray, FloatArray, FloatArray]) -> None:
    """Sizes, a joint at rest, a joint that is not there."""
    motion, q, qd, _ = bent
    with pytest.raises(InputError, match="q of hip"):
        coordinate_from_motion(motion, "hip", q[1:], qd)
    with pytest.raises(InputError, match="coordinate moves"):
        coordinate_from_motion(motion, "hip", np.zeros(COUNT), qd)
    estimate = solve_frames(HumanDynamics(motion))
    made = coordinate_from_motion(motion, "hip", q, qd)
    with pytest.raises(InputError, match="one of"):
        generalised_force(estimate, replace(made, joint="elbow"))
    with pytest.raises(InputError, match="direction of"):
        generalised_force(estimate, replace(made, direction=made.direction[1:]))

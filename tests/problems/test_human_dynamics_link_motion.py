"""Link motion: against pinocchio, and the checks that refuse bodies that cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.problems.link_motion import LinkJoint, LinkMotion
from factorgrasp.problems.link_motion_files import load_links
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree, from_pinocchio

from .human_dynamics_body import body, random_states

pin = pytest.importorskip("pinocchio")


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("kinds", ["ball", "hinges"])
def test_vectorised_kinematics_equal_pinocchio(floating: bool, kinds: str) -> None:
    """Both ways to the kinematics agree with each other and with pinocchio's forward kinematics."""
    model = body(floating, kinds)
    q, v, a = random_states(model, 9)
    tree = PinocchioTree(model)
    many = tree.kinematics(q, v, a)
    plain = PinocchioTree(model, compiled=False)
    one = [plain.kinematics(q[f], v[f], a[f]) for f in range(9)]
    slow = plain.kinematics(q, v, a)
    for name in (
        "R",
        "p",
        "velocity",
        "acceleration",
        "transform",
        "bias",
        "joint_acceleration",
        "joint_centre",
    ):
        assert np.allclose(
            getattr(many, name), np.concatenate([getattr(k, name) for k in one]), atol=1e-12
        ), name
        assert np.allclose(getattr(many, name), getattr(slow, name), atol=1e-12), name
    for j, S in enumerate(many.subspaces):
        assert S is not None
        single = np.concatenate([np.asarray(k.subspaces[j]) for k in one])
        assert np.allclose(np.broadcast_to(S, single.shape), single, atol=1e-12)
    assert len(tree.links) == 12
    assert len(tree.joint_names) == 11
    data = model.createData()
    pin.forwardKinematics(model, data, q[3], v[3], a[3])
    frame = model.getFrameId("left_hand")
    classical = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
    motion = tree.motion(np.arange(9.0), q, v, a)
    hand = motion.link("left_hand")
    assert np.allclose(motion.acceleration[3, hand], classical.linear, atol=1e-12)
    assert np.allclose(motion.angular_acceleration[3, hand], classical.angular, atol=1e-12)


def test_other_joint_kinds_go_through_pinocchio() -> None:
    """A joint without a vectorised form (here spherical ZYX and planar) gives the same as pinocchio frame by frame."""
    model = pin.Model()
    first = model.addJoint(0, pin.JointModelSphericalZYX(), pin.SE3.Random(), "first")
    model.appendBodyToJoint(first, pin.Inertia.FromSphere(2.0, 0.1), pin.SE3.Identity())
    second = model.addJoint(first, pin.JointModelPlanar(), pin.SE3.Random(), "second")
    model.appendBodyToJoint(second, pin.Inertia.FromSphere(1.0, 0.1), pin.SE3.Identity())
    q, v, a = random_states(model, 6)
    tree = PinocchioTree(model)
    many, one = tree.kinematics(q, v, a), tree.kinematics(q[2], v[2], a[2])
    assert np.allclose(many.acceleration[2], one.acceleration[0], atol=1e-12)
    assert np.allclose(many.bias[2], one.bias[0], atol=1e-12)


def test_momentum_rate_equals_pinocchio() -> None:
    """The full rate of the centroidal momentum minus weight."""
    model = body()
    q, v, a = random_states(model, 5)
    motion = from_pinocchio(model, np.arange(5.0), q, v, a)
    data = model.createData()
    for f in range(5):
        pin.computeCentroidalMomentumTimeVariation(model, data, q[f], v[f], a[f])
        rate = data.dhg.vector.copy()
        rate[:3] -= motion.total_mass * motion.gravity
        assert np.allclose(motion.momentum_rate[f], rate, atol=1e-9)


def test_motion_of_centres_of_mass_round_trip() -> None:
    """Velocities and accelerations of the centres of mass lead to those of the origins."""
    model = body()
    motion = from_pinocchio(model, np.arange(6.0), *random_states(model, 6))
    arm = np.einsum("nlij,lj->nli", motion.R, motion.com)
    w, dw = motion.angular_velocity, motion.angular_acceleration
    again = LinkMotion.from_com_motion(
        t=motion.t, links=motion.links, mass=motion.mass, com=motion.com, inertia=motion.inertia, R=motion.R, p=motion.p,
        com_velocity=motion.velocity + np.cross(w, arm),
        com_acceleration=motion.acceleration + np.cross(dw, arm) + np.cross(w, np.cross(w, arm)),
        angular_velocity=w, angular_acceleration=dw, joints=motion.joints, joint_centre=motion.joint_centre,
    )  # fmt: skip
    assert np.allclose(again.acceleration, motion.acceleration, atol=1e-12)
    assert np.allclose(again.qdd, motion.qdd, atol=1e-9)


def test_links_of_a_musculoskeletal_model(dataset) -> None:  # type: ignore[no-untyped-def]
    """The archive is read, its ground joint left out, its total mass right."""
    motion = load_links(dataset("opensim_walk_gait2354/links_walk.npz"))
    assert motion.links[motion.root] == "pelvis"
    assert len(motion.joints) == 11
    assert motion.total_mass == pytest.approx(72.5, abs=0.5)


def _motion() -> LinkMotion:
    model = body()
    return from_pinocchio(model, np.arange(5.0), *random_states(model, 5))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"mass": lambda m: np.where(np.arange(m.mass.size) == 2, -1.0, m.mass)}, "mass of"),
        ({"inertia": lambda m: -m.inertia}, "inertia of pelvis"),
        ({"inertia": lambda m: np.array([np.diag([1.0, 1.0, 5.0])] * m.mass.size)}, "inertia of pelvis"),
        ({"links": lambda m: ("pelvis",) * len(m.links)}, "links"),
        ({"links": lambda m: ("", *m.links[1:])}, r"links\[0\]"),
        ({"t": lambda m: m.t[::-1]}, "t of the link motion"),
        ({"p": lambda m: m.p[:, :3]}, "p of the link motion"),
        ({"R": lambda m: 2.0 * m.R}, "orientation of"),
        ({"joints": lambda m: (replace(m.joints[0], name=""), *m.joints[1:])}, r"joints\[0\]"),
        ({"joints": lambda m: (*m.joints[:-1], replace(m.joints[-1], child=m.joints[0].child))}, "joint "),
    ],
)
def test_impossible_bodies_are_refused(change, field) -> None:  # type: ignore[no-untyped-def]
    """One clear error that names what is wrong."""
    motion = _motion()
    with pytest.raises(InputError, match=field):
        replace(motion, **{name: make(motion) for name, make in change.items()})


def test_a_joint_needs_axes_for_its_degrees_of_freedom() -> None:
    """Names without a subspace, or of another number."""
    with pytest.raises(InputError, match="subspace of joint knee"):
        LinkJoint("knee", 0, 1, ("knee",))
    with pytest.raises(InputError, match="subspace of joint knee"):
        LinkJoint("knee", 0, 1, ("knee",), np.zeros((6, 2)))

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from factorgrasp.errors import InputError
from factorgrasp.models.anthropometry import DE_LEVA, REFERENCE_STATURE, Sex
from factorgrasp.models.human import (
    JOINTS,
    LINKS,
    HumanBody,
    check_segments,
    configuration,
    human_body,
    load_body,
)
from factorgrasp.models.solids import Solid, box, join, remove
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree

SIZES: list[tuple[float, float, Sex]] = [
    (1.741, 73.0, "male"),
    (1.735, 61.9, "female"),
    (1.55, 45.0, "female"),
    (2.02, 118.0, "male"),
]


@pytest.fixture(scope="module")
def body() -> HumanBody:
    return human_body(1.78, 75.5, "male")


def placed(body: HumanBody) -> dict[str, Solid]:
    """The segments where they stand in the T-pose, mid-hip at the origin."""
    origin = {"Pelvis": np.zeros(3)}
    for joint, (parent, child) in JOINTS.items():
        origin[child] = origin[parent] + body.placements[joint]
    return {link: body.segments[link].moved(origin[link]) for link in LINKS}


@pytest.mark.parametrize(("height", "mass", "sex"), SIZES)
def test_every_size_is_a_physical_body(height: float, mass: float, sex: Sex) -> None:
    body = human_body(height, mass, sex)
    assert tuple(body.segments) == LINKS
    assert len(LINKS) == 23
    assert len(JOINTS) == 22
    assert sum(solid.mass for solid in body.segments.values()) == pytest.approx(mass, rel=1e-12)
    for solid in body.segments.values():
        moments = np.linalg.eigvalsh(solid.inertia)
        assert moments[0] > 0.0
        assert moments[0] + moments[1] >= moments[2]
    model = body.model()
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    head = data.oMf[model.getFrameId("Head")].translation + body.ends["Head"]
    foot = data.oMf[model.getFrameId("LeftFoot")].translation + body.sole["LeftFoot"][0]
    assert head[2] - foot[2] == pytest.approx(height, rel=1e-12)


@pytest.mark.parametrize("sex", ["female", "male"])
def test_what_was_split_is_together_what_the_table_says(sex: Sex) -> None:
    mass, height = 70.0, REFERENCE_STATURE[sex]
    solids = placed(human_body(height, mass, sex))
    rows = DE_LEVA[sex]
    all_of_it = 1.0 if sex == "male" else 0.9999
    trunk_links = ("Pelvis", "L5", "L3", "T12", "T8", "RightShoulder", "LeftShoulder")
    trunk = join([solids[link] for link in trunk_links])
    parts = [rows[name] for name in ("lower_trunk", "middle_trunk", "upper_trunk")]
    fraction = sum(row.mass for row in parts)
    assert trunk.mass == pytest.approx(fraction * mass / all_of_it, rel=1e-12)
    # Centre of the table's three parts on top of each other, scaled as the model's trunk is.
    stack = solids["Neck"].com[2] - 0.5 * 0.052 * height  # C7 over mid-hip
    scale = stack / sum(row.length for row in parts)
    bottom, moment = 0.0, 0.0
    for row in parts:
        moment += row.mass * (bottom + (1.0 - row.com) * row.length)
        bottom += row.length
    assert trunk.com[2] == pytest.approx(scale * moment / fraction, rel=1e-12)

    head = join([solids["Neck"], solids["Head"]])
    row, length = rows["head"], rows["head"].length * scale
    assert head.mass == pytest.approx(row.mass * mass / all_of_it, rel=1e-12)
    radii = np.sqrt(np.diag(head.inertia) / head.mass) / length
    np.testing.assert_allclose(radii, [row.sagittal, row.transverse, row.longitudinal], rtol=1e-12)
    assert head.com[2] - stack == pytest.approx((1.0 - row.com) * length, rel=1e-12)

    foot = join([solids["LeftFoot"], solids["LeftToe"]])
    row = rows["foot"]
    radii = np.sqrt(np.diag(foot.inertia) / foot.mass) / row.length
    np.testing.assert_allclose(radii, [row.longitudinal, row.sagittal, row.transverse], rtol=1e-12)


def test_solids_taken_apart_and_joined_again(rng: np.random.Generator) -> None:
    a = box(2.0, rng.normal(size=3), np.array([0.1, 0.3, 0.2]))
    b = box(0.5, rng.normal(size=3), np.array([0.2, 0.1, 0.1]))
    left = remove(join([a, b]), b)
    np.testing.assert_allclose(left.com, a.com, atol=1e-12)
    np.testing.assert_allclose(left.inertia, a.inertia, atol=1e-12)


def test_urdf_out_and_in_is_the_same_body(body: HumanBody, tmp_path: Path, rng: np.random.Generator) -> None:
    made, read = body.model(), load_body(body.write_urdf(tmp_path / "human.urdf"))
    assert list(made.names) == list(read.names)
    assert made.nv == 72
    for mine, theirs in zip(made.inertias, read.inertias, strict=True):
        assert theirs.mass == pytest.approx(mine.mass, rel=1e-15)
        np.testing.assert_allclose(theirs.lever, mine.lever, atol=1e-15)
        np.testing.assert_allclose(theirs.inertia, mine.inertia, atol=1e-15)
    data, other = made.createData(), read.createData()
    for _ in range(3):
        q = pin.integrate(made, pin.neutral(made), rng.normal(size=made.nv) * 0.5)
        pin.forwardKinematics(made, data, q)
        pin.forwardKinematics(read, other, q)
        for mine, theirs in zip(data.oMi, other.oMi, strict=True):
            np.testing.assert_allclose(theirs.homogeneous, mine.homogeneous, atol=1e-13)
        np.testing.assert_allclose(pin.crba(made, data, q), pin.crba(read, other, q), atol=1e-12)


@pytest.mark.parametrize("kind", ["revolute", "spherical"])
def test_both_kinds_of_joints_make_22_joints_of_three_degrees_of_freedom(body: HumanBody, kind: str) -> None:
    tree = PinocchioTree(body.model(kind))  # type: ignore[arg-type]
    assert set(tree.links) == set(LINKS)
    assert set(tree.joint_names) == set(JOINTS)
    motion = tree.motion(0.0, pin.neutral(tree.model)[None], np.zeros((1, 72)), np.zeros((1, 72)))
    assert len(motion.dof_names) == 66
    assert "jRightElbow_y" in motion.dof_names
    np.testing.assert_allclose(motion.total_mass, body.mass, rtol=1e-12)


def test_gravity_moment_of_a_stretched_arm_in_closed_form(body: HumanBody) -> None:
    loaded = body.with_load("RightHand", 5.0, body.segments["RightHand"].com)
    lever = np.zeros(3)
    expected = 0.0
    for link in ("RightUpperArm", "RightForeArm", "RightHand"):
        solid = loaded.segments[link]
        expected += solid.mass * 9.80665 * abs(lever[1] + solid.com[1])
        lever = lever + loaded.ends[link]
    for kind in ("revolute", "spherical"):
        model = loaded.model(kind)  # type: ignore[arg-type]
        tau = pin.rnea(model, model.createData(), pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv))
        joint = model.getJointId("jRightShoulder_x" if kind == "revolute" else "jRightShoulder")
        assert abs(tau[model.idx_vs[joint]]) == pytest.approx(expected, rel=1e-12)


def test_configuration_sets_joints_by_name(body: HumanBody) -> None:
    model = body.model()
    q = configuration(model, {"jRightKnee_y": [0.1, 0.2], "jLeftElbow_z": 0.3})
    assert q.shape == (2, model.nq)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q[1])
    shank = data.oMf[model.getFrameId("RightLowerLeg")].rotation
    np.testing.assert_allclose(shank, pin.utils.rotate("y", 0.2), atol=1e-14)
    with pytest.raises(InputError, match=r"jRightKne_y.*Did you mean jRightKnee_y"):
        configuration(model, {"jRightKne_y": 0.0})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"height": 178.0}, "Centimetres"),
        ({"mass": 7.0}, "mass: expected 30 to 250 kg"),
        ({"sex": "m"}, "sex: expected 'female' or 'male'"),
        ({"height": float("nan")}, "height"),
    ],
)
def test_sizes_that_nobody_has_are_refused(change: dict[str, float | str], words: str) -> None:
    arguments = {"height": 1.78, "mass": 75.5, "sex": "male", **change}
    with pytest.raises(InputError, match=words):
        human_body(**arguments)  # type: ignore[arg-type]


def test_unphysical_segments_are_refused(body: HumanBody) -> None:
    with pytest.raises(InputError, match="link of the load"):
        body.with_load("RightFinger", 1.0)
    with pytest.raises(InputError, match="mass of the load"):
        body.with_load("RightHand", -1.0)
    flat = Solid(1.0, np.zeros(3), np.diag([1.0, 1.0, 2.5]))
    with pytest.raises(InputError, match="inertia of Head"):
        check_segments({**body.segments, "Head": flat}, body.mass)
    with pytest.raises(InputError, match="masses of the segments"):
        check_segments(body.segments, body.mass + 1.0)


def test_load_body_says_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="an existing URDF"):
        load_body(tmp_path / "none.urdf")
    (tmp_path / "bad.urdf").write_text("<robot>", encoding="utf-8")
    with pytest.raises(InputError, match="that pinocchio reads"):
        load_body(tmp_path / "bad.urdf")

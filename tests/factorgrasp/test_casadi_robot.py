"""The CasADi robot against pinocchio, on random states of every robot at hand and of joints that no URDF has."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from factorgrasp.errors import InputError
from factorgrasp.models.casadi_robot import CasadiRobot, load_casadi_robot

TOLERANCE = 1e-10


def robot_files() -> list[Path]:
    """The URDF files of example-robot-data, without its loader."""
    folder = Path(pin.__file__).resolve().parents[4] / "share/example-robot-data/robots"
    return sorted(folder.rglob("*.urdf"))


needs_robots = pytest.mark.skipif(not robot_files(), reason="example-robot-data is not installed")


def random_state(model: Any, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    model.lowerPositionLimit = np.clip(model.lowerPositionLimit, -3.0, 3.0)
    model.upperPositionLimit = np.clip(model.upperPositionLimit, -3.0, 3.0)
    pin.seed(int(rng.integers(2**31)))
    return pin.randomConfiguration(model), rng.normal(size=model.nv), rng.normal(size=model.nv)


def check(model: Any, frames: list[str], seed: int, regressor: bool = True) -> None:
    """Kinematics of the frames, torques and regressor agree."""
    robot, data, rng = CasadiRobot(model), model.createData(), np.random.default_rng(seed)
    functions = {frame: robot.kinematics_function(frame) for frame in frames}
    torque = robot.rnea_function()
    for _ in range(2):
        q, v, a = random_state(model, rng)
        pin.forwardKinematics(model, data, q, v, a)
        for frame, function in functions.items():
            index = model.getFrameId(frame)
            placement = pin.updateFramePlacement(model, data, index)
            twist = pin.getFrameVelocity(model, data, index, pin.LOCAL)
            acceleration = pin.getFrameClassicalAcceleration(model, data, index, pin.LOCAL)
            expected = (
                placement.rotation, placement.translation, twist.linear, twist.angular,
                acceleration.linear, acceleration.angular,
            )  # fmt: skip
            for found, right in zip(function(q, v, a), expected, strict=True):
                assert np.max(np.abs(np.array(found).reshape(right.shape) - right)) < TOLERANCE * (
                    1.0 + np.max(np.abs(right))
                )
        right = pin.rnea(model, data, q, v, a)
        found = np.array(torque(q, v, a)).ravel()
        assert np.max(np.abs(found - right), initial=0.0) < TOLERANCE * (
            1.0 + np.max(np.abs(right), initial=0.0)
        )
        if regressor and model.nv:
            right = pin.computeJointTorqueRegressor(model, data, q, v, a)
            found = np.array(robot.regressor_function()(q, v, a))
            assert np.max(np.abs(found - right)) < TOLERANCE * (1.0 + np.max(np.abs(right)))


def some_frames(model: Any) -> list[str]:
    """The last frame and one in the middle."""
    return [model.frames[k].name for k in {model.nframes // 2, model.nframes - 1}]


@needs_robots
@pytest.mark.parametrize("path", robot_files(), ids=lambda path: path.stem)
def test_every_urdf_agrees_with_pinocchio(path: Path) -> None:
    try:
        model = pin.buildModelFromUrdf(str(path))
    except ValueError as error:
        pytest.skip(f"pinocchio itself cannot read it: {error}"[:80])
    # One regressor of a hundred-odd joints takes a second to build; those of up to thirty tell as much.
    check(model, some_frames(model), seed=len(path.stem), regressor=model.nv <= 20)


@needs_robots
@pytest.mark.parametrize("name", ["panda.urdf", "baxter.urdf", "pr2.urdf", "tiago_pro.urdf"])
def test_joints_that_follow_another(name: str) -> None:
    (path,) = (path for path in robot_files() if path.name == name)
    model = pin.buildModelFromUrdf(str(path), mimic=True)
    assert any(joint.shortname() == "JointModelMimic" for joint in model.joints)
    check(model, some_frames(model), seed=3, regressor=False)


@needs_robots
def test_floating_base() -> None:
    (path,) = (path for path in robot_files() if path.name == "solo12.urdf")
    check(pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer()), ["FL_FOOT"], seed=1)


AXIS = np.array([0.36, -0.48, 0.8])
CONTINUOUS = """<robot name="r"><link name="a"/><link name="b"/>
<joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0.36 -0.48 0.8"/></joint></robot>"""


def unbounded_unaligned() -> Any:
    """Its Python constructor takes no axis; a URDF gives it one."""
    return pin.buildModelFromXML(CONTINUOUS).joints[1]


def composite() -> Any:
    joint = pin.JointModelComposite()
    joint.addJoint(pin.JointModelRZ())
    joint.addJoint(pin.JointModelPY(), pin.SE3.Random())
    joint.addJoint(pin.JointModelSphericalZYX(), pin.SE3.Random())
    return joint


JOINTS = {
    "revolute unaligned": lambda: pin.JointModelRevoluteUnaligned(AXIS),
    "unbounded unaligned": unbounded_unaligned,
    "unbounded": pin.JointModelRUBY,
    "prismatic unaligned": lambda: pin.JointModelPrismaticUnaligned(AXIS),
    "helical": lambda: pin.JointModelHX(0.3),
    "helical unaligned": lambda: pin.JointModelHelicalUnaligned(AXIS, 0.2),
    "universal": lambda: pin.JointModelUniversal(np.array([1.0, 0, 0]), np.array([0, 0.6, 0.8])),
    "spherical": pin.JointModelSpherical,
    "spherical zyx": pin.JointModelSphericalZYX,
    "planar": pin.JointModelPlanar,
    "translation": pin.JointModelTranslation,
    "free flyer": pin.JointModelFreeFlyer,
    "composite": composite,
}


@pytest.mark.parametrize("kind", JOINTS)
def test_every_kind_of_joint(kind: str) -> None:
    pin.seed(5)
    model = pin.Model()
    parent = 0
    # Between two revolute ones, so that it is carried and carries.
    for k, joint in enumerate((pin.JointModelRX(), JOINTS[kind](), pin.JointModelRZ())):
        parent = model.addJoint(parent, joint, pin.SE3.Random(), f"joint {k}")
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Random())
        model.addFrame(pin.Frame(f"frame {k}", parent, 0, pin.SE3.Random(), pin.FrameType.OP_FRAME))
    model.lowerPositionLimit, model.upperPositionLimit = -np.ones(model.nq), np.ones(model.nq)
    model.armature = np.linspace(0.1, 0.3, model.nv)
    check(model, ["frame 1", "frame 2"], seed=7)


def test_ellipsoid_joint_is_named() -> None:
    model = pin.Model()
    model.addJoint(0, pin.JointModelEllipsoid(0.1, 0.2, 0.3), pin.SE3.Identity(), "hip")
    with pytest.raises(InputError, match="hip"):
        CasadiRobot(model)


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="existing URDF"):
        load_casadi_robot(tmp_path / "none.urdf")


@needs_robots
def test_an_unknown_frame_lists_the_known_ones() -> None:
    (path,) = (path for path in robot_files() if path.name == "panda.urdf")
    with pytest.raises(InputError, match="panda_link8"):
        load_casadi_robot(path).kinematics_function("hand of god")

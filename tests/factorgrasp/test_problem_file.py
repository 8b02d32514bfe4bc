from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factorgrasp import problem_file
from factorgrasp.errors import InputError
from factorgrasp.grasp_file import build
from factorgrasp.lie import quaternion_wxyz_to_matrix
from factorgrasp.problem_file import load_problem
from factorgrasp.problems import GraspNoise, GraspPose, GraspPoseFromPoses, GraspSettings
from factorgrasp.recordings import ImuStream, JointStream, PoseStream, write_csv
from factorgrasp.simulation.cehajic2015 import ENCODER_POSES, XSENS, cehajic2015
from factorgrasp.simulation.grasp_files import write_recording

ROBOT, HAND = '[robot]\nfile = "robot.csv"\n', '[hand]\nfile = "imu.csv"\n'


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with robot.csv, imu.csv and grasp.toml."""
    folder = tmp_path_factory.mktemp("recorded")
    recording = cehajic2015(
        3, duration=8.0, robot=replace(ENCODER_POSES, rate=100.0), hand=replace(XSENS, rate=100.0)
    )
    write_recording(recording, folder)
    return folder


@pytest.fixture
def write(recorded: Path) -> Callable[[str], Path]:
    """Writes the text of a problem file beside the recordings."""

    def written(text: str) -> Path:
        path = recorded / "problem.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return written


def test_written_recording_loads(recorded: Path) -> None:
    loaded = load_problem(recorded / "grasp.toml")
    assert loaded.kind == "grasp_pose"
    assert (loaded.title, loaded.solver) == ("", None)
    problem = loaded.problem
    assert isinstance(problem, GraspPose)
    robot, hand = problem.streams
    assert isinstance(robot, PoseStream)
    assert (len(robot), len(hand)) == (800, 800)
    assert problem.noise == GraspNoise()
    assert problem.settings == GraspSettings()


def test_everything_stated_arrives(write: Callable[[str], Path]) -> None:
    loaded = load_problem(
        write(
            'kind = "grasp_pose"\ntitle = "first day"\nsolver = "gtsam"\n'
            + ROBOT
            + "gravity = [0, 0.1, -9.8]\nbandwidth = 30\n"
            + HAND
            + "[noise]\ngyro_density = 1e-3\nrobot_position_sd = 1e-4\n"
            + '[estimate]\nbiases = false\nrobust_loss = "cauchy"\nforgetting = 20\ntime_offset = false\nbandwidth = 15\n'
            + "[prior]\ntranslation = [1, 0.2, 0]\ntranslation_sd = 0.5\nrotation_wxyz = [0, 0, 0, 1]\nrotation_sd = 0.2\n"
        )
    )
    problem = loaded.problem
    assert isinstance(problem, GraspPose)
    assert (loaded.title, loaded.solver) == ("first day", "gtsam")
    np.testing.assert_array_equal(problem.gravity, [0.0, 0.1, -9.8])
    assert problem.noise == GraspNoise(gyro_density=1e-3, robot_position_sd=1e-4)
    assert problem.settings == GraspSettings(
        gyro_bias=False,
        accelerometer_bias=False,
        loss="cauchy",
        forgetting_time=20.0,
        time_offset=False,
        bandwidth=15.0,
        kinematics_bandwidth=30.0,
    )
    np.testing.assert_array_equal(problem.prior.translation, [1.0, 0.2, 0.0])
    np.testing.assert_allclose(problem.prior.rotation, quaternion_wxyz_to_matrix([0.0, 0.0, 0.0, 1.0]))
    assert (problem.prior.translation_sd, problem.prior.rotation_sd) == (0.5, 0.2)


def test_a_log_of_everything_serves_both_sides(recorded: Path) -> None:
    """The robot is read as poses, the hand as an IMU, from one table that holds both."""
    loaded = load_problem(recorded / "grasp.toml").problem
    assert isinstance(loaded, GraspPose)
    robot, hand = loaded.streams
    assert isinstance(robot, PoseStream)
    columns = [
        robot.t[:, None],
        robot.position,
        robot.rotation_wxyz,
        hand.angular_velocity,
        hand.specific_force,
    ]
    header = "t,px,py,pz,qw,qx,qy,qz,wx,wy,wz,ax,ay,az"
    np.savetxt(recorded / "all.csv", np.hstack(columns), delimiter=",", header=header, comments="")
    problem = build({"robot": {"file": "all.csv"}, "hand": {"file": "all.csv"}}, recorded)
    assert isinstance(problem.streams[0], PoseStream)
    problem = build({"robot": {"file": "all.csv", "columns": "imu"}, "hand": {"file": "all.csv"}}, recorded)
    assert isinstance(problem.streams[0], ImuStream)
    both = {"robot": {"file": "all.csv"}, "hand": {"file": "all.csv", "columns": "poses"}}
    assert isinstance(build(both, recorded), GraspPoseFromPoses)
    with pytest.raises(InputError, match=r"\[robot\] gravity: expected an IMU in \[hand\] file"):
        build({**both, "robot": {"file": "all.csv", "gravity": [0, 0, -9.8]}}, recorded)
    with pytest.raises(InputError, match=r"\[noise\] gyro_density: expected a known key"):
        build({**both, "noise": {"gyro_density": 1e-3}}, recorded)


def test_joint_positions_through_a_urdf(recorded: Path, write: Callable[[str], Path]) -> None:
    links = "".join(
        f'<link name="l{k + 1}"/><joint name="j{k + 1}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<origin xyz="0.3 0 0"/><axis xyz="{axis}"/><limit lower="-3" upper="3" effort="1" velocity="9"/></joint>'
        for k, axis in enumerate(("0 0 1", "0 1 0", "1 0 0"))
    )
    (recorded / "arm.urdf").write_text(f'<robot name="arm"><link name="l0"/>{links}</robot>')
    t = np.arange(800) / 100.0
    q = 0.4 * np.sin(np.outer(t, [1.9, 2.7, 3.1]))
    write_csv(recorded / "joints.csv", JointStream(t, q))
    stated = 'kind = "grasp_pose"\n[robot]\nfile = "joints.csv"\nurdf = "arm.urdf"\n'
    with pytest.raises(InputError, match=r"\[robot\] frame: expected a string; found no such key"):
        load_problem(write(stated + HAND))
    with pytest.raises(InputError, match=r"frame: expected one of .*l3.*; found 'tool'"):
        load_problem(write(stated + 'frame = "tool"\n' + HAND))
    # The rates of this arm are not those of the recorded hand, but that is for the solver to find out.
    problem = build(
        {
            "robot": {"file": "joints.csv", "urdf": "arm.urdf", "frame": "l3"},
            "hand": {"file": "imu.csv"},
            "estimate": {"time_offset": False},
        },
        recorded,
    )
    assert isinstance(problem.streams[0], JointStream)
    with pytest.raises(InputError, match=r"\[robot\] urdf: expected joint positions"):
        load_problem(write('kind = "grasp_pose"\n' + ROBOT + 'urdf = "arm.urdf"\n' + HAND))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"kind: expected one of 'grasp_pose'.*; found no such key"),
        (
            'kind = "grasp_poes"',
            r"kind: expected one of 'grasp_pose'.*; found 'grasp_poes'. Did you mean grasp_pose",
        ),
        ("kind = 3", "kind: expected a string; found 3"),
        ('kind = "grasp_pose', "expected TOML; found "),
        ('kind = "grasp_pose"\n' + HAND, r"\[robot\]: expected a table of this name; found none"),
        (
            'kind = "grasp_pose"\nrobot = "robot.csv"\n' + HAND,
            r"\[robot\]: expected a table; found the string",
        ),
        ('kind = "grasp_pose"\n[robot]\n' + HAND, r"\[robot\] file: expected a string; found no such key"),
        ('kind = "grasp_pose"\n[robot]\nfile = 1\n' + HAND, r"\[robot\] file: expected a string; found 1"),
        (
            'kind = "grasp_pose"\n[robot]\nfile = "no.csv"\n' + HAND,
            r"no\.csv: expected a recording; found no such file",
        ),
        (
            'kind = "grasp_pose"\n' + ROBOT + "gravty = [0, 0, -9.8]\n" + HAND,
            r"\[robot\] gravty: .*Did you mean gravity\?",
        ),
        (
            'kind = "grasp_pose"\n' + ROBOT + "gravity = [0, -9.8]\n" + HAND,
            r"\[robot\] gravity: expected an array of 3 numbers",
        ),
        (
            'kind = "grasp_pose"\n' + ROBOT + 'columns = "pose"\n' + HAND,
            r"\[robot\] columns: expected one of 'poses', 'imu'",
        ),
        (
            'kind = "grasp_pose"\n' + ROBOT + HAND + "[nosie]\n",
            r"nosie: expected a known key; .*Did you mean noise\?",
        ),
        (
            'kind = "grasp_pose"\n' + ROBOT + HAND + "[noise]\ngyro_density = 0\n",
            r"\[noise\] gyro_density: .*singular covariance",
        ),
        (
            'kind = "grasp_pose"\n' + ROBOT + HAND + '[estimate]\nloss = "tukey"\n',
            r"\[estimate\] loss: expected one of 'none'",
        ),
        (
            'kind = "grasp_pose"\n' + ROBOT + HAND + "[estimate]\ntime_offset = 3\n",
            r"\[estimate\] time_offset: expected true or false",
        ),
        (
            'kind = "grasp_pose"\n' + ROBOT + HAND + "[estimate]\nforgetting = -1\n",
            r"\[estimate\] forgetting_time: ",
        ),
        (
            'kind = "grasp_pose"\n' + ROBOT + HAND + "[estimate]\nbiases = true\ngyro_bias = false\n",
            r"\[estimate\] biases: expected either biases or gyro_bias; found both",
        ),
        (
            'kind = "grasp_pose"\n'
            + ROBOT
            + HAND
            + "[prior]\nrotation_wxyz = [1, 1, 0, 0]\nrotation_sd = 0.1\n",
            r"\[prior\] rotation_wxyz: expected a unit quaternion",
        ),
        ('kind = "grasp_pose"\n' + ROBOT + HAND + "[prior]\nrotation_sd = 0.1\n", r"\[prior\] rotation: "),
    ],
)
def test_mistakes_are_named(write: Callable[[str], Path], text: str, message: str) -> None:
    path = write(text)
    with pytest.raises(InputError, match=message) as raised:
        load_problem(path)
    assert raised.value.field.startswith(str(path))
    assert "\n" not in str(raised.value)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found no such file"):
        load_problem(tmp_path / "none.toml")
    with pytest.raises(InputError, match="found a folder"):
        load_problem(tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(InputError, match="not UTF-8"):
        load_problem(tmp_path / "binary.toml")


def test_every_kind_has_its_builder() -> None:
    for kind in problem_file.KINDS:
        assert callable(problem_file._builder(kind))

"""[[sensors]] of a file: IMUs and joint sensors as tables, against a known motion; archives that are spoilt."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.problem_file import load_problem
from factorgrasp.problems.link_motion_spatial import rotate_back
from factorgrasp.simulation.human_dynamics import HumanRecording, human_bowing
from factorgrasp.simulation.human_dynamics_files import write_recording

SD_GYRO, SD_ACC = 0.005, 0.05


@pytest.fixture(scope="module")
def recording() -> HumanRecording:
    return human_bowing(4, repetitions=1)


@pytest.fixture(scope="module")
def folder(recording: HumanRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("imus")
    problem = write_recording(recording, path)
    text = problem.read_text(encoding="utf-8").replace("[motion]", "[motion]\nend = 3.0")
    problem.write_text(text, encoding="utf-8")
    motion, rng = recording.truth.motion, np.random.default_rng(0)
    i = motion.link("T8")
    w = rotate_back(motion.R[:, i], motion.angular_velocity[:, i])
    dw = rotate_back(motion.R[:, i], motion.angular_acceleration[:, i])
    f = rotate_back(motion.R[:, i], motion.acceleration[:, i] - motion.gravity)
    at = np.array([-0.1, 0.0, 0.15])
    f = f + np.cross(dw, at) + np.cross(w, np.cross(w, at))
    # The sensor is turned by half a turn about z.
    turn = np.diag([-1.0, -1.0, 1.0])
    w = w @ turn + SD_GYRO * rng.normal(size=w.shape)
    f = f @ turn + SD_ACC * rng.normal(size=f.shape)
    header = "time,wx [deg/s],wy [deg/s],wz [deg/s],Ax,Ay,Az"
    rows = np.column_stack([motion.t + 5.0, np.degrees(w), f])
    np.savetxt(path / "imu.csv", rows, "%.9g", ",", header=header, comments="")
    return path


def agreement(folder: Path, more: str) -> dict[str, float]:
    text = (folder / "dynamics.toml").read_text(encoding="utf-8") + more
    (folder / "sensors.toml").write_text(text, encoding="utf-8")
    result = load_problem(folder / "sensors.toml").solve()
    return {found.name: found.ratio for found in result.frames.innovations}


def test_imu_agrees_with_the_motion(folder: Path) -> None:
    mounted = 'file = "imu.csv"\nlink = "T8"\nrotation_wxyz = [0, 0, 0, 1]\ntime_offset = -5.0\n'
    found = agreement(
        folder,
        f'\n[[sensors]]\ntype = "gyroscope"\n{mounted}sd = {SD_GYRO}\n[[sensors]]\ntype = "accelerometer"\n{mounted}'
        f'position = [-0.1, 0, 0.15]\ncolumns = ["Ax", "Ay", "Az"]\ncovariance = {SD_ACC**2}\n',
    )
    # Differentiated noise is the same over the filter's length: few independent values in three seconds.
    assert 0.3 < found["gyroscope on T8"] < 2.0
    assert 0.5 < found["accelerometer on T8"] < 1.6
    wrong = agreement(
        folder,
        f'\n[[sensors]]\ntype = "gyro"\n{mounted.replace("[0, 0, 0, 1]", "[1, 0, 0, 0]")}sd = {SD_GYRO}\n',
    )
    assert wrong["gyroscope on T8"] > 5.0


def test_joint_sensors(folder: Path, recording: HumanRecording) -> None:
    names = recording.truth.dof_names
    at = [names.index(f"jRightKnee_{axis}") for axis in "xyz"]
    rng = np.random.default_rng(1)
    torque = recording.truth.torque[:, at] + 0.5 * rng.normal(size=(recording.t.size, 3))
    acceleration = recording.truth.trajectory.a[:, 6:][:, at] + 0.2 * rng.normal(size=torque.shape)
    header = "t,jRightKnee_x,jRightKnee_y,jRightKnee_z"
    for name, values in (("torque", torque), ("qdd", acceleration)):
        np.savetxt(
            folder / f"{name}.csv",
            np.column_stack([recording.t, values]),
            "%.9g",
            ",",
            header=header,
            comments="",
        )
    found = agreement(
        folder,
        '\n[[sensors]]\ntype = "joint_torque"\nfile = "torque.csv"\njoint = "jRightKnee"\nsd = 0.5\n'
        '[[sensors]]\ntype = "joint_acceleration"\nfile = "qdd.csv"\njoint = "jRightKnee"\nsd = [0.2, 0.2, 0.2]\n',
    )
    assert 0.5 < found["torque of jRightKnee"] < 1.5
    assert 0.5 < found["acceleration of jRightKnee"] < 1.5


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (
            'type = "accelerometer"\nfile = "imu.csv"\nlink = "T8"\ncolumns = ["Ax", "Ay", "Az"]',
            "covariance: expected a variance",
        ),
        (
            'type = "accelerometer"\nfile = "imu.csv"\nlink = "T8"\nsd = 1\ncolumns = ["Ax", "Ay", "Az"]',
            "One clock",
        ),
        ('type = "accelerometer"\nfile = "imu.csv"\nlink = "T8"\nsd = 1', "ax, ay, az"),
        (
            'type = "gyro"\nfile = "imu.csv"\nlink = "T8"\nsd = 1\nposition = [0, 0, 0]',
            "turns everywhere alike",
        ),
        (
            'type = "accelerometer"\nfile = "imu.csv"\nlink = "T8"\nsd = -1\ncovariance = 1',
            "either sd or covariance",
        ),
        (
            'type = "joint_torque"\nfile = "imu.csv"\njoint = "jRightKnee"\nsd = 1\ncolumns = ["Ax"]',
            "3 names",
        ),
        ('type = "joint_torque"\nfile = "imu.csv"\njoint = "jKnee"\nsd = 1', "a joint of the model"),
    ],
)
def test_what_is_wrong_with_a_sensor_is_named(folder: Path, more: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        agreement(folder, f"\n[[sensors]]\n{more}\n")


@pytest.fixture(scope="module")
def archive(recording: HumanRecording) -> dict[str, Any]:
    """The recording as an archive of link-level arrays, z up."""
    m = recording.exact_motion.select(slice(0, 60))
    arm = np.einsum("nlij,lj->nli", m.R, m.com)
    turned = np.cross(m.angular_acceleration, arm) + np.cross(
        m.angular_velocity, np.cross(m.angular_velocity, arm)
    )
    return {
        "t": m.t, "bodies": np.array(m.links), "mass": m.mass, "com": m.com, "inertia": m.inertia, "R": m.R, "p": m.p,
        "w": m.angular_velocity, "al": m.angular_acceleration, "vcom": m.velocity + np.cross(m.angular_velocity, arm),
        "acom": m.acceleration + turned, "joints": np.array([j.name for j in m.joints]),
        "jparent": np.array([m.links[j.parent] for j in m.joints]), "jchild": np.array([m.links[j.child] for j in m.joints]),
        "jpos": m.joint_centre,
    }  # fmt: skip


def test_archive_of_ball_joints_gives_the_torques(
    archive: dict[str, Any], recording: HumanRecording, tmp_path: Path
) -> None:
    """With the joints declared as ball joints the archive has torques, too; the lifted pelvis is the unmeasured contact."""
    np.savez(tmp_path / "links.npz", **archive)
    joints = [str(name) for name in archive["joints"]]
    (tmp_path / "p.toml").write_text(
        f'kind = "human_dynamics"\n[model]\nlinks = "links.npz"\ngravity = [0, 0, -9.80665]\nball_joints = {joints}\n'
        '[contacts]\nunmeasured = ["Pelvis"]\n',
        encoding="utf-8",
    )
    result = load_problem(tmp_path / "p.toml").solve()
    assert result.status.ok
    assert result.arrays()["torque"].shape == (60, 66)


def drop(key: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda data: {name: value for name, value in data.items() if name != key}


def put(key: str, make: Callable[[Any], Any]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda data: {**data, key: make(data[key])}


def mangled(x: Any, index: Any, value: float) -> Any:
    out = np.array(x, dtype=float)
    out[index] = value
    return out


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (drop("acom"), "no acom"),
        (put("R", lambda x: x[:, :-1]), "R: expected shape"),
        (put("jpos", lambda x: x[:-1]), "jpos: expected shape"),
        (put("mass", lambda x: mangled(x, 3, -1.0)), "mass of T12"),
        (put("inertia", lambda x: mangled(x, (2, 0, 0), -1.0)), "inertia of L3"),
        (put("R", lambda x: 1.5 * x), "rotation matrices"),
        (put("bodies", lambda x: np.array([*x[:-1], x[0]])), "Pelvis"),
        (put("joints", lambda x: np.array([*x[:-1], x[0]])), "unique names"),
        (put("jchild", lambda x: np.array([*x[:-1], "Tail"])), "'Tail'"),
        (put("t", lambda x: x[::-1]), "increasing"),
        (put("p", lambda x: x * np.nan), "gaps everywhere"),
    ],
)
def test_spoilt_archives_are_named(
    archive: dict[str, Any], tmp_path: Path, spoil: Callable[[dict[str, Any]], dict[str, Any]], words: str
) -> None:
    np.savez(tmp_path / "links.npz", **spoil(archive))
    (tmp_path / "p.toml").write_text(
        'kind = "human_dynamics"\n[model]\nlinks = "links.npz"\n', encoding="utf-8"
    )
    with pytest.raises(InputError, match=words):
        load_problem(tmp_path / "p.toml")


@pytest.mark.parametrize("content", [b"", b"not an archive", b"PK\x03\x04broken"])
def test_files_that_are_no_archive(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "links.npz").write_bytes(content)
    (tmp_path / "p.toml").write_text(
        'kind = "human_dynamics"\n[model]\nlinks = "links.npz"\n', encoding="utf-8"
    )
    with pytest.raises(InputError, match=r"links\.npz"):
        load_problem(tmp_path / "p.toml")

"""JointTrajectory files: the message's fields, and the same numbers back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.joint_trajectory import JointTrajectory, joint_trajectory


@pytest.fixture
def made() -> JointTrajectory:
    rng = np.random.default_rng(0)
    q, qd, qdd, tau = rng.standard_normal((4, 30, 3))
    qd[0] = [1e-05, -3e-17, 2e20]
    return joint_trajectory(
        5.0 + 0.007 * np.arange(30) + 1e-9, ("joint 1", "joint_2", "true"), q, qd, qdd, tau
    )


@pytest.mark.parametrize("ending", ["json", "yaml", "yml"])
def test_round_trip(tmp_path: Path, made: JointTrajectory, ending: str) -> None:
    back = JointTrajectory.load(made.save(tmp_path / f"trajectory.{ending}"))
    assert back.names == made.names
    np.testing.assert_allclose(back.t, made.t, atol=1e-9)
    for name in ("positions", "velocities", "accelerations", "effort"):
        np.testing.assert_array_equal(getattr(back, name), getattr(made, name))


def test_fields_are_the_message_s(tmp_path: Path, made: JointTrajectory) -> None:
    message = json.loads(made.save(tmp_path / "t.json").read_text())
    assert list(message) == ["header", "joint_names", "points"]
    assert message["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    assert list(message["points"][1]) == [
        "positions",
        "velocities",
        "accelerations",
        "effort",
        "time_from_start",
    ]
    assert message["points"][1]["time_from_start"] == {"sec": 0, "nanosec": 7_000_000}


def test_what_ros_prints_is_read(tmp_path: Path) -> None:
    path = tmp_path / "echo.yaml"
    path.write_text(
        "header:\n  stamp:\n    sec: 12\n    nanosec: 5\n  frame_id: ''\njoint_names:\n- panda_joint1\n- panda_joint2\npoints:\n"
        "- positions:\n  - 0.5\n  - -1.0e-05\n  velocities: []\n  accelerations: []\n  effort: []\n"
        "  time_from_start:\n    sec: 0\n    nanosec: 0\n"
        "- positions:\n  - 0.6\n  - 0.25\n  velocities: []\n  accelerations: []\n  effort: []\n"
        "  time_from_start:\n    sec: 1\n    nanosec: 500000000\n---\n"
    )
    found = JointTrajectory.load(path)
    assert found.names == ("panda_joint1", "panda_joint2")
    np.testing.assert_allclose(found.t, [0.0, 1.5])
    np.testing.assert_allclose(found.positions, [[0.5, -1e-5], [0.6, 0.25]])
    assert found.velocities is None
    path.write_text("points: [\n  oh no")
    with pytest.raises(InputError, match="block style"):
        JointTrajectory.load(path)


def test_whole_seconds_do_not_overflow() -> None:
    t = np.array([0.0, 0.9999999999, 2.0])
    points = JointTrajectory(t, ("a",), np.zeros((3, 1))).to_message()["points"]
    assert points[1]["time_from_start"] == {"sec": 1, "nanosec": 0}
    assert points[2]["velocities"] == []


def test_thinned_keeps_both_ends() -> None:
    t = np.arange(1001) * 1e-3
    some = JointTrajectory(t, ("a",), t[:, None]).thinned(30.0)
    assert some.t[0] == 0.0
    assert some.t[-1] == 1.0
    assert 25 < some.t.size < 40


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "JSON"),
        ('{"joint_names": ["a"]}', "points"),
        ('{"joint_names": ["a"], "points": [{"positions": [1.0]}]}', "time_from_start"),
        (
            '{"joint_names": ["a", "b"], "points": [{"positions": [1.0], "time_from_start": {"sec": 0, "nanosec": 0}}]}',
            "2 numbers",
        ),
    ],
)
def test_bad_files_are_named(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        JointTrajectory.load(path)


def test_bad_arrays_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="increasing"):
        JointTrajectory(np.array([0.0, 0.0]), ("a",), np.zeros((2, 1)))
    with pytest.raises(InputError, match="velocities"):
        JointTrajectory(np.array([0.0, 1.0]), ("a",), np.zeros((2, 1)), np.full((2, 1), np.nan))
    with pytest.raises(InputError, match="ends in"):
        JointTrajectory(np.array([0.0]), ("a",), np.zeros((1, 1))).save(tmp_path / "x.txt")
    with pytest.raises(InputError, match="no such file"):
        JointTrajectory.load(tmp_path / "none.json")

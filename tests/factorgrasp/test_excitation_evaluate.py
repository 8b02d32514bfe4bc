"""``kind = "excitation"`` with ``[evaluate]``: files in, measures and words out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from factorgrasp.cli import app
from factorgrasp.errors import InputError
from factorgrasp.excitation_evaluate import ExcitationEvaluationTask
from factorgrasp.excitation_evaluation import Demands
from factorgrasp.models.arm import panda_urdf
from factorgrasp.models.robot import load_robot
from factorgrasp.models.wrist import WrenchSummary, WristStiffness
from factorgrasp.problem_file import load_problem
from factorgrasp.recordings import JointStream, PoseStream, write_csv
from factorgrasp.simulation.trajectory import RigidTrajectory, Sinusoids

URDF = """<robot name="two"><link name="base"/>
<link name="a"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
  <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="b"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
  <limit lower="-2" upper="2" velocity="2" effort="50"/></joint>
<joint name="j2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
  <limit lower="-2" upper="2" velocity="2" effort="50"/></joint></robot>"""


def cone(seconds: float = 12.0, amplitude: float = 0.15, rate: float = 0.8) -> PoseStream:
    """Coning about a wrist 0.3 m away, which does not move."""
    quarter = 0.5 * np.pi
    motion = RigidTrajectory(
        Sinusoids(
            (0, 0, 0), [(0, amplitude, 0), (0, 0, amplitude)], (rate, rate), [[quarter] * 3, [0.0] * 3]
        ),
        Sinusoids((0.4, 0.0, 0.5)),
        (0.3, 0.0, 0.0),
    ).at(np.arange(0.0, seconds, 4e-3))
    return PoseStream(motion.t, motion.position, motion.rotation_wxyz)


def test_cone_about_the_wrist(tmp_path: Path) -> None:
    write_csv(tmp_path / "trajectory.csv", cone(10.0))
    (tmp_path / "e.toml").write_text(
        'kind = "excitation"\n[evaluate]\nfile = "trajectory.csv"\nwindow = 2.5\nreference = "mean"\n'
        "[grasp]\ntranslation = [0.3, 0.0, 0.0]\n[human]\nforce_stiffness = 500.0\n"
    )
    result = load_problem(tmp_path / "e.toml").solve()
    assert result.status.ok
    expected = 2.5 * (2 * np.pi * 0.8) ** 4 * 0.15**2 / 2.0
    # Second order in the amplitude, and the mean of w w' is taken out.
    np.testing.assert_allclose(result.windows.lambda_min, expected, rtol=0.04)
    # The wrist itself does not move, and feels the rotation only.
    assert result.wrench_summary.peak_force < 0.05
    assert result.wrench_summary.peak_torque == pytest.approx(2.0 * 0.15, rel=0.03)
    again = WrenchSummary.of(result.motion.wrist_wrench(np.zeros(3), WristStiffness(500.0, 5.0), "mean"))
    assert again.peak_force == pytest.approx(500.0 * 0.3 * 0.15, rel=0.05)


def test_command_writes_measures_and_report(tmp_path: Path) -> None:
    write_csv(tmp_path / "trajectory.csv", cone())
    (tmp_path / "e.toml").write_text(
        'kind = "excitation"\ntitle = "Cone"\n[evaluate]\nfile = "trajectory.csv"\n'
    )
    ran = CliRunner().invoke(app, ["solve", str(tmp_path / "e.toml"), "--out", str(tmp_path / "out")])
    assert ran.exit_code == 0, ran.output
    assert "lambda_min over every window of 5.00 s" in ran.output
    found = json.loads((tmp_path / "out" / "estimate.json").read_text())
    assert found["status"] == "solved"
    assert found["excitation"]["lambda_min"] <= found["excitation"]["windows"][0]["eigenvalues"][0]
    assert len(found["predicted_grasp"]["translation_sd"]) == 3
    assert found["predicted_grasp"]["not_shown"] == []
    assert "What will be known of the grasp" in (tmp_path / "out" / "report.html").read_text()
    with np.load(tmp_path / "out" / "estimate.npz") as arrays:
        assert arrays["window_eigenvalues"].shape == (arrays["window_start"].size, 3)


def test_one_axis_is_named(tmp_path: Path) -> None:
    t = np.arange(0.0, 12.0, 4e-3)
    q = np.stack([0.6 * np.sin(2.0 * t), np.zeros_like(t)], axis=1)
    write_csv(tmp_path / "joints.csv", JointStream(t, q))
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "e.toml").write_text(
        'kind = "excitation"\n[evaluate]\nfile = "joints.csv"\n[robot]\nurdf = "arm.urdf"\nframe = "b"\n'
    )
    ran = CliRunner().invoke(app, ["solve", str(tmp_path / "e.toml"), "--out", str(tmp_path / "out")])
    assert ran.exit_code == 1
    assert "lever arm along end-effector axis z, which is the rotation axis" in ran.output
    found = json.loads((tmp_path / "out" / "estimate.json").read_text())
    assert found["excitation"]["weakest_axis"] == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    assert found["joints"]["j1"]["velocity"] == pytest.approx(2.0 - 1.2, abs=0.01)


def test_torques_are_those_of_the_model(tmp_path: Path) -> None:
    """A pendulum about a vertical and a horizontal axis: gravity and inertia by hand."""
    t = np.arange(0.0, 8.0, 4e-3)
    q = np.stack([np.zeros_like(t), 0.5 * np.sin(1.5 * t)], axis=1)
    tau = 1.0 * (0.1**2 + 0.01) * (-0.5 * 2.25 * np.sin(1.5 * t)) - 9.81 * 0.1 * np.cos(q[:, 1])
    np.savez(tmp_path / "log.npz", t=t, q=q, dq=np.gradient(q, t, axis=0), tau=np.stack([0 * t, tau], axis=1))
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "e.toml").write_text(
        'kind = "excitation"\n[evaluate]\nfile = "log.npz"\n[robot]\nurdf = "arm.urdf"\nframe = "b"\n'
    )
    result = load_problem(tmp_path / "e.toml").solve()
    joints = result.motion.joints
    inner = slice(100, -100)
    np.testing.assert_allclose(joints.torque[inner, 1], joints.measured_torque[inner, 1], atol=2e-3)
    assert joints.correlation[1] > 0.9999


def test_what_is_known_before_counts(tmp_path: Path) -> None:
    write_csv(tmp_path / "trajectory.csv", cone())
    rows = [[0.0] * k + [1e-12] + [0.0] * (5 - k) for k in range(6)]
    text = 'kind = "excitation"\n[evaluate]\nfile = "trajectory.csv"\n[grasp]\ncovariance = '
    (tmp_path / "e.toml").write_text(text + json.dumps(rows) + "\n")
    result = load_problem(tmp_path / "e.toml").solve()
    assert np.all(result.prediction.sd <= 1.0001e-6)
    assert np.all(result.prediction.sd > 0.9e-6)


def test_demands_that_are_missed_are_said() -> None:
    task = ExcitationEvaluationTask(cone(), demands=Demands(alpha=1e3, translation_sd=1e-6))
    result = task.solve()
    assert result.status.value == "infeasible"
    assert "alpha = 1e+03 was asked for" in result.message
    assert "lever arm will be known to" in result.message
    with pytest.raises(InputError, match="solves nothing"):
        task.solve("cholesky")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[evaluate]\nfile = "nothing.csv"\n', "no such file"),
        ('[evaluate]\nfile = "trajectory.csv"\nwindow = -1.0\n', "above zero"),
        ('[evaluate]\nfile = "trajectory.csv"\nalhpa = 2.0\n', "Did you mean alpha"),
        ('[evaluate]\nfile = "trajectory.csv"\ncolumns = "joints"\n', "those of joints"),
        ('[evaluate]\nfile = "trajectory.csv"\n[grasp]\nrotation_wxyz = [1.0, 1.0, 0.0, 0.0]\n', "norm 1.41"),
        ('[evaluate]\nfile = "trajectory.csv"\n[grasp]\ncovariance = [[1.0, 2.0]]\n', "6, 6"),
        ('[evaluate]\nfile = "trajectory.csv"\n[human]\nstiffnes = 3.0\n', "an unknown one"),
        ('[evaluate]\nfile = "joints.csv"\n', "urdf"),
        ('[evaluate]\nfile = "joints.csv"\n[robot]\nurdf = "arm.urdf"\nframe = "tool"\n', "one of universe"),
        ('[evaluate]\nfile = "short.csv"\n', "samples"),
        ('[evaluate]\nfile = "empty.csv"\n', "empty"),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    write_csv(tmp_path / "trajectory.csv", cone())
    write_csv(tmp_path / "short.csv", cone(0.05))
    t = np.arange(0.0, 4.0, 4e-3)
    write_csv(tmp_path / "joints.csv", JointStream(t, np.sin(np.stack([t, 2 * t], axis=1))))
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "e.toml").write_text('kind = "excitation"\n' + text)
    ran = CliRunner().invoke(app, ["solve", str(tmp_path / "e.toml"), "--out", str(tmp_path / "out")])
    assert ran.exit_code == 2, ran.output
    assert words in ran.output
    assert not (tmp_path / "out" / "estimate.json").exists()


def test_panda_log(data_dir: Path) -> None:
    """The real log: torque predicted, and as much excitation as its command has."""
    urdf = panda_urdf()
    if urdf is None:
        pytest.skip("example-robot-data is not installed")
    path = data_dir / "panda_ident" / "panda_excitation.npz"
    with np.load(path) as log:
        stream = JointStream(log["t"], np.asarray(log["q"], dtype=float))
        tau = np.asarray(log["tau"], dtype=float)
        step = np.diff(log["t_cmd"])[:, None]
        command = log["q0_cmd"] + np.cumsum(0.5 * (log["dq_cmd"][1:] + log["dq_cmd"][:-1]) * step, axis=0)
        commanded = JointStream(log["t_cmd"][1:], command)
    model = load_robot(urdf)
    real = ExcitationEvaluationTask(
        stream, robot_model=model, frame="panda_hand", measured_torque=tau
    ).solve()
    plan = ExcitationEvaluationTask(commanded, robot_model=model, frame="panda_hand").solve()
    assert np.all(real.motion.joints.correlation[:4] > 0.96)
    ratio = np.median(real.windows.lambda_min) / np.median(plan.windows.lambda_min)
    assert 0.9 < ratio < 1.1
    np.testing.assert_allclose(real.prediction.sd, plan.prediction.sd, rtol=0.05)

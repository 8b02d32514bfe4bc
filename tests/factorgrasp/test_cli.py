from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from factorgrasp import __version__, lie
from factorgrasp.cli import EXAMPLE, app
from factorgrasp.recordings import PoseStream, read_poses, read_table, write_csv
from factorgrasp.simulation.cehajic2015 import ENCODER_POSES, XSENS, cehajic2015
from factorgrasp.simulation.grasp_files import write_recording


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def record(folder: Path, motion: Literal["exciting", "printed"]) -> Path:
    recording = cehajic2015(
        5,
        motion=motion,
        duration=20.0,
        robot=replace(ENCODER_POSES, rate=200.0),
        hand=replace(XSENS, rate=200.0),
        time_offset=0.02,
    )
    return write_recording(recording, folder)


@pytest.fixture(scope="module")
def exciting(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("exciting"), "exciting")


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The motion printed in the paper: about one axis, so that the lever arm along it does not show."""
    return record(tmp_path_factory.mktemp("printed"), "printed")


@pytest.fixture(scope="module")
def solved(exciting: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    out = tmp_path_factory.mktemp("solved") / "new" / "folder"
    return run("solve", exciting, "--out", out), out


def test_solve_answers_and_writes(solved: tuple[Result, Path]) -> None:
    result, out = solved
    assert result.exit_code == 0, result.output
    assert "grasp pose: solved" in result.stdout
    assert sorted(path.name for path in out.iterdir()) == ["estimate.json", "estimate.npz", "report.html"]
    for path in out.iterdir():
        assert str(path) in result.stdout
    assert "solving" in result.stderr


def test_estimate_json_keeps_its_contract(solved: tuple[Result, Path], exciting: Path) -> None:
    _, out = solved
    record = json.loads((out / "estimate.json").read_text(encoding="utf-8"))
    truth = json.loads((exciting.parent / "truth.json").read_text(encoding="utf-8"))
    assert {"status", "solver", "values", "observability", "residuals", "timing", "versions"} <= set(record)
    assert record["status"] == "solved"
    assert record["versions"]["factorgrasp"] == __version__
    values = record["values"]
    covariance = np.array(values["grasp"]["covariance"])
    assert covariance.shape == (6, 6)
    estimated, true = (
        lie.quaternion_wxyz_to_matrix(q) for q in (values["grasp"]["rotation_wxyz"], truth["rotation_wxyz"])
    )
    error = np.concatenate(
        [lie.so3_log(estimated.T @ true), np.subtract(truth["translation"], values["grasp"]["translation"])]
    )
    # Six degrees of freedom: 1e-5 of all honest covariances would exceed this.
    assert error @ np.linalg.solve(covariance, error) < 33.1
    assert np.linalg.norm(error[3:]) < 0.02
    assert abs(values["time_offset"] - truth["time_offset"]) < 5.0 * values["time_offset_sd"]
    for name in ("gyro_bias", "accelerometer_bias"):
        assert np.all(np.abs(np.subtract(values[name], truth[name])) < 5.0 * np.array(values[f"{name}_sd"]))
    for direction in record["observability"]["directions"]:
        assert direction["observable"]
        assert direction["words"]
        assert direction["sd"] > 0.0
    with np.load(out / "estimate.npz", allow_pickle=False) as arrays:
        np.testing.assert_allclose(arrays["covariance"], covariance)


def test_report_asks_the_network_for_nothing(solved: tuple[Result, Path]) -> None:
    page = (solved[1] / "report.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 4
    assert "<script" not in page
    assert "<link" not in page
    assert "@import" not in page
    # Addresses may only be names of XML vocabularies and references inside the page.
    for mark in ('src="', "url("):
        for rest in page.split(mark)[1:]:
            assert rest.startswith(("#", "data:"))
    assert {rest.split('"')[0] for rest in page.split('href="')[1:] if not rest.startswith("#")} == set()


def test_not_solved_is_1_with_reason_and_files(printed: Path, tmp_path: Path) -> None:
    result = run("solve", printed, "--out", tmp_path / "out")
    assert result.exit_code == 1, result.output
    assert "not solved (unobservable)" in result.stderr
    assert "about one axis only" in result.stderr
    record = json.loads((tmp_path / "out" / "estimate.json").read_text(encoding="utf-8"))
    assert record["status"] == "unobservable"
    missing = [d for d in record["observability"]["directions"] if not d["observable"]]
    assert [d["variable"] for d in missing] == ["translation"]
    # The axis of the printed motion, in the end-effector's frame.
    axis = np.array([10.0, 40.0, 20.0]) / np.linalg.norm([10.0, 40.0, 20.0])
    assert abs(axis @ missing[0]["direction"]) > 0.99
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "not fully observable" in page


def test_default_folder_and_named_solver(
    exciting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("solve", exciting, "--solver", "gtsam")
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "results" / "grasp" / "estimate.json").read_text(encoding="utf-8"))
    assert record["solver"] == "gtsam"


def _edit(column: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """A mistake in one column of imu.csv or robot.csv (whichever has it)."""

    def edit(folder: Path) -> None:
        for name in ("imu.csv", "robot.csv"):
            table = read_table(folder / name)
            if column in table and (column != "t" or name == "imu.csv"):
                table[column] = change(table[column])
                header = ",".join(table)
                np.savetxt(
                    folder / name,
                    np.column_stack(list(table.values())),
                    "%.17g",
                    ",",
                    header=header,
                    comments="",
                )

    return edit


def _write(name: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text, encoding="utf-8") and None


def _swap(values: np.ndarray) -> np.ndarray:
    values[[100, 101]] = values[[101, 100]]
    return values


def _repeat(values: np.ndarray) -> np.ndarray:
    values[100] = values[99]
    return values


def _all_rates(folder: Path) -> None:
    for column in ("wx", "wy", "wz"):
        _edit(column, np.rad2deg)(folder)


def _drop_column(folder: Path) -> None:
    text = (folder / "robot.csv").read_text(encoding="utf-8")
    (folder / "robot.csv").write_text(text.replace("qw", "w", 1), encoding="utf-8")


def _append(text: str) -> Callable[[Path], None]:
    def append(folder: Path) -> None:
        with (folder / "grasp.toml").open("a", encoding="utf-8") as file:
            file.write(text)

    return append


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        pytest.param(_edit("t", _swap), ["imu.csv", "t:", "time running backwards"], id="backwards"),
        pytest.param(_edit("t", _repeat), ["imu.csv", "t:", "duplicate stamps"], id="duplicate"),
        pytest.param(_edit("t", lambda t: t + 1000.0), ["overlap"], id="no overlap"),
        pytest.param(
            _edit("qw", lambda q: q + 0.5),
            ["robot.csv", "rotation_wxyz", "unit quaternions"],
            id="quaternion",
        ),
        pytest.param(_all_rates, ["hand", "angular_velocity", "degrees"], id="degrees"),
        pytest.param(_drop_column, ["robot.csv", "qw"], id="missing column"),
        pytest.param(_edit("ax", lambda a: a * np.nan), ["imu.csv", "specific_force", "NaN", "ax"], id="NaN"),
        pytest.param(_write("imu.csv", ""), ["imu.csv", "empty file"], id="empty"),
        pytest.param(
            _write("imu.csv", "t,wx,wy,wz,ax,ay,az\n0,0,0,0,0,0,9.8\n"),
            ["imu.csv", "one sample"],
            id="one sample",
        ),
        pytest.param(
            lambda folder: (folder / "imu.csv").unlink(), ["imu.csv", "no such file"], id="no recording"
        ),
        pytest.param(
            _append("[noise]\ngyro_density = 0\n"), ["[noise] gyro_density", "singular"], id="singular"
        ),
        pytest.param(
            _append("[noise]\ngyro_densty = 1\n"), ["[noise] gyro_densty", "gyro_density"], id="unknown key"
        ),
        pytest.param(_append("[noise\n"), ["TOML"], id="not TOML"),
        pytest.param(_append('[estimate]\nloss = "huge"\n'), ["[estimate] loss", "'huber'"], id="wrong word"),
    ],
)
def test_bad_input_is_2_with_one_line(
    exciting: Path, tmp_path: Path, spoil: Callable[[Path], None], words: list[str]
) -> None:
    for path in exciting.parent.iterdir():
        shutil.copy(path, tmp_path)
    spoil(tmp_path)
    result = run("solve", tmp_path / "grasp.toml", "--out", tmp_path / "out")
    assert result.exit_code == 2, result.output
    lines = [line for line in result.stderr.splitlines() if not line.endswith(" ...")]
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0]
    assert "Traceback" not in result.output
    assert not (tmp_path / "out").exists()


def test_bad_arguments_are_2(exciting: Path, tmp_path: Path) -> None:
    missing = run("solve", tmp_path / "none.toml", "--out", tmp_path / "out")
    assert missing.exit_code == 2
    assert "no such file" in missing.stderr
    unknown = run("solve", exciting, "--solver", "cholesk", "--out", tmp_path / "out")
    assert unknown.exit_code == 2
    assert "Installed: cholesky" in unknown.stderr
    (tmp_path / "file").write_text("x")
    taken = run("solve", exciting, "--out", tmp_path / "file" / "out")
    assert taken.exit_code == 2
    assert "is a file" in taken.stderr
    assert run("solve").exit_code == 2
    assert run("slove").exit_code == 2
    assert not (tmp_path / "out").exists()


def test_hand_with_poses(exciting: Path, tmp_path: Path) -> None:
    """A camera on the hand in a world of its own, without noise but for rounding: the grasp is found to a hundredth of a millimetre."""
    robot = read_poses(exciting.parent / "robot.csv")
    grasp_rotation, grasp = lie.so3_exp([0.4, -1.0, 0.3]), np.array([0.2, -0.1, 0.5])
    world_rotation, world = lie.so3_exp([1.0, 0.5, -2.0]), np.array([3.0, 1.0, -2.0])
    rotation = world_rotation @ robot.rotation @ grasp_rotation
    position = (robot.position + robot.rotation @ grasp) @ world_rotation.T + world
    hand = PoseStream(robot.t, position, lie.matrix_to_quaternion_wxyz(rotation))
    write_csv(tmp_path / "robot.csv", robot)
    write_csv(tmp_path / "camera.csv", hand)
    (tmp_path / "grasp.toml").write_text(
        'kind = "grasp_pose"\n[robot]\nfile = "robot.csv"\n[hand]\nfile = "camera.csv"\n', encoding="utf-8"
    )
    result = run("solve", tmp_path / "grasp.toml", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    values = json.loads((tmp_path / "out" / "estimate.json").read_text(encoding="utf-8"))["values"]["grasp"]
    np.testing.assert_allclose(values["translation"], grasp, atol=1e-5)
    found = lie.quaternion_wxyz_to_matrix(values["rotation_wxyz"])
    assert lie.angle_between(found, grasp_rotation) < 1e-5
    assert "How well both sides agree" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_warnings_are_lines_and_stand_in_the_report(exciting: Path, tmp_path: Path) -> None:
    for path in exciting.parent.iterdir():
        shutil.copy(path, tmp_path)

    def shorten(values: np.ndarray) -> np.ndarray:
        values[500] *= 0.98
        return values

    # As interpolation of quaternions across a change of sign leaves them: all four components shorter, in one row.
    for column in ("qw", "qx", "qy", "qz"):
        _edit(column, shorten)(tmp_path)
    result = run("solve", tmp_path / "grasp.toml", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("warning: ")]
    assert "robot.rotation_wxyz" in line
    assert ".py" not in result.stderr
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert f'<p class="remark">{line.removeprefix("warning: ")}</p>' in page


def test_compare_prints_and_writes(exciting: Path, tmp_path: Path) -> None:
    result = run("compare", exciting, "--solvers", "cholesky,gtsam, osqp", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "comparing solvers on" in result.stderr
    record = json.loads((tmp_path / "out" / "comparison.json").read_text(encoding="utf-8"))
    assert [row["solver"] for row in record["rows"]] == ["cholesky", "gtsam", "osqp"]
    for row in record["rows"]:
        assert row["status"] == "solved"
        assert row["correct"]
        # Ten millionths of a standard deviation: one answer, whoever computes it.
        assert row["mean_difference"] < 1e-5
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "comparison.json",
        "comparison.csv",
        "comparison.md",
    }


def test_compare_refuses_what_it_does_not_know(exciting: Path, tmp_path: Path) -> None:
    for solvers in ("cholesky,nope", ","):
        result = run("compare", exciting, "--solvers", solvers, "--out", tmp_path / "out")
        assert result.exit_code == 2
        assert result.stderr.splitlines()[-1].startswith("error: ")
    assert run("compare", exciting, tmp_path / "none.toml").exit_code == 2
    assert not (tmp_path / "out").exists()


def test_solvers_lists_all(exciting: Path) -> None:
    result = run("solvers")
    assert result.exit_code == 0
    lines = {line.split()[0]: line for line in result.stdout.splitlines() if line.strip()}
    assert {"cholesky", "kkt", "gtsam", "osqp", "clarabel", "gurobi"} <= set(lines)
    assert "yes" in lines["cholesky"]
    assert "inequalities" in lines["osqp"]


def test_help_shows_a_problem_file() -> None:
    for arguments in (["--help"], []):
        result = run(*arguments)
        for line in ('kind = "grasp_pose"', "[robot]", 'file = "robot.csv"', "[noise]", "Exit codes"):
            assert line in result.output
    for command in ("solve", "compare", "solvers", "demo"):
        assert run(command, "--help").exit_code == 0


def test_example_of_the_help_is_a_problem_file(exciting: Path, tmp_path: Path) -> None:
    for name in ("robot.csv", "imu.csv"):
        shutil.copy(exciting.parent / name, tmp_path)
    (tmp_path / "example.toml").write_text(EXAMPLE, encoding="utf-8")
    result = run("solve", tmp_path / "example.toml", "--out", tmp_path / "out")
    assert result.exit_code in (0, 1), result.output


def test_demo_compares_with_the_truth(tmp_path: Path) -> None:
    result = run("demo", "--out", tmp_path / "demo")
    assert result.exit_code == 0, result.output
    rows = {line[:22].strip(): line[22:].split() for line in result.stdout.splitlines()}
    assert rows["position x"][:2] == ["mm", "1110.00"]
    for name in ("position x", "rotation about z", "clock offset", "gyroscope bias y"):
        error, claimed = map(float, rows[name][-2:])
        assert abs(error) < 5.0 * claimed
    assert {path.name for path in (tmp_path / "demo").iterdir()} == {
        "robot.csv", "imu.csv", "truth.json", "grasp.toml", "estimate.json", "estimate.npz", "report.html",
    }  # fmt: skip


def test_module_runs_as_a_program(tmp_path: Path) -> None:
    def python(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "factorgrasp", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)

    shown = python("--version")
    assert (shown.returncode, shown.stdout) == (0, f"factorgrasp {__version__}\n")
    wrong = python("solve", "none.toml")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert wrong.stderr.splitlines()[-1].startswith("error: none.toml: expected a problem file")
    assert list(tmp_path.iterdir()) == []

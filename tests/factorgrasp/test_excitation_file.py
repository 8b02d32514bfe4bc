"""Problem files of excitations through the command line: a robot under all its limits, comparison, and bad input in words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from factorgrasp.cli import app
from factorgrasp.errors import InputError
from factorgrasp.problem_file import load_problem

ROOT = Path(__file__).resolve().parents[2]
PANDA = (
    Path(pin.__file__).resolve().parents[4]
    / "share/example-robot-data/robots/panda_description/urdf/panda_collision.urdf"
)
needs_panda = pytest.mark.skipif(not PANDA.is_file(), reason="example-robot-data is not installed")

GRASP = "[grasp]\ntranslation = [0.4, 0.1, 0.05]\n"
ASKED = "[excitation]\nalpha = 5.0\nduration = 3.0\nbandwidth = 1.0\nstep = 0.002\n"
SMALL = 'kind = "excitation"\n' + GRASP + ASKED


def robot(extra: str = "") -> str:
    return (
        f'[robot]\nurdf = "{PANDA}"\nframe = "panda_hand"\nstart = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]\n'
        "acceleration = [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]\n"
        "jerk = [7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0]\n" + extra
    )


def written(folder: Path, text: str) -> Path:
    file = folder / "plan.toml"
    file.write_text(text, encoding="utf-8")
    return file


def run(*arguments: str) -> Any:
    return CliRunner().invoke(app, list(arguments))


@needs_panda
def test_panda_under_all_limits(tmp_path: Path) -> None:
    """Velocity limits that bind; every limit recomputed from the trajectory file, dynamics by pinocchio itself."""
    file = written(
        tmp_path,
        SMALL
        + robot(
            "velocity = 0.45\ncollision_distance = 0.01\nbox_lower = [0.1, -0.6, 0.1]\nbox_upper = [0.9, 0.6, 1.0]\n"
        ),
    )
    done = run("solve", str(file), "--out", str(tmp_path / "out"))
    assert done.exit_code == 0, done.output
    columns = (tmp_path / "out" / "trajectory.csv").read_text().splitlines()[0].split(",")
    data = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)
    q, qd, qdd, tau = (
        data[:, [columns.index(f"{name}{j}") for j in range(1, 8)]] for name in ("q", "qd", "qdd", "tau")
    )
    step = data[1, 0] - data[0, 0]
    assert np.max(np.abs(qd)) <= 0.45 * (1 + 1e-6)
    assert np.max(np.abs(qd)) > 0.4
    assert np.max(np.abs((q[2:] - q[:-2]) / (2 * step) - qd[1:-1])) < 1e-4
    assert np.max(np.abs((qd[2:] - qd[:-2]) / (2 * step) - qdd[1:-1])) < 5e-3
    full = pin.buildModelFromUrdf(str(PANDA))
    model = pin.buildReducedModel(full, [8, 9], pin.neutral(full))
    assert np.all(q >= model.lowerPositionLimit)
    assert np.all(q <= model.upperPositionLimit)
    body, frame = model.createData(), model.getFrameId("panda_hand")
    for k in range(0, q.shape[0], 150):
        np.testing.assert_allclose(pin.rnea(model, body, q[k], qd[k], qdd[k]), tau[k], atol=1e-6)
        pin.forwardKinematics(model, body, q[k])
        place = pin.updateFramePlacement(model, body, frame).translation
        np.testing.assert_allclose(place, data[k, [columns.index(c) for c in ("px", "py", "pz")]], atol=1e-8)
    assert np.all(np.abs(tau) <= model.effortLimit)
    np.testing.assert_allclose(qd[[0, -1]], 0.0, atol=1e-8)
    found = json.loads((tmp_path / "out" / "estimate.json").read_text())
    assert found["status"] == "solved"
    assert found["excitation"]["lambda_min"] >= 5.0
    names = " ".join(one["limit"] for one in found["margins"])
    for word in (
        "position of",
        "velocity of",
        "acceleration of",
        "jerk of",
        "torque of",
        "distance between",
        "workspace box",
        "rotation of",
    ):
        assert word in names
    assert min(one["relative"] for one in found["margins"]) > -1e-6
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<svg") >= 4


@needs_panda
def test_what_is_out_of_reach_is_said(tmp_path: Path) -> None:
    far = written(
        tmp_path, SMALL.replace("[excitation]", "[human]\nposition = [1.9, 0.0, 0.4]\n[excitation]") + robot()
    )
    done = run("solve", str(far), "--out", str(tmp_path / "far"))
    assert done.exit_code == 1
    assert "outside the robot's workspace" in done.output
    assert (tmp_path / "far" / "estimate.json").is_file()
    box = written(tmp_path, SMALL + robot("box_lower = [0.1, -0.6, 0.9]\nbox_upper = [0.9, 0.6, 1.2]\n"))
    done = run("solve", str(box), "--out", str(tmp_path / "box"))
    assert done.exit_code == 1
    assert "outside the workspace box along z" in done.output


def test_solvers_are_compared(tmp_path: Path) -> None:
    done = run(
        "compare",
        str(written(tmp_path, SMALL)),
        "--solvers",
        "ipopt,fatrop,cholesky",
        "--out",
        str(tmp_path / "out"),
    )
    assert done.exit_code == 0, done.output
    rows = {
        row["solver"]: row for row in json.loads((tmp_path / "out" / "comparison.json").read_text())["rows"]
    }
    assert rows["ipopt"]["correct"] is True
    assert rows["fatrop"]["correct"] is True
    assert rows["fatrop"]["objective"] == pytest.approx(rows["ipopt"]["objective"], rel=0.01)
    assert "nonlinear program" in rows["cholesky"]["skipped"]


def test_solver_may_be_a_table_or_a_name(tmp_path: Path) -> None:
    table = load_problem(written(tmp_path, SMALL + '[solver]\nname = "fatrop"\nmax_iterations = 5\n'))
    assert table.solver == "fatrop"
    assert table.problem.options == {"max_iterations": 5}
    name = load_problem(written(tmp_path, SMALL.replace("[grasp]", 'solver = "ipopt"\n[grasp]', 1)))
    assert name.solver == "ipopt"


def test_grasp_comes_from_an_estimate(tmp_path: Path) -> None:
    grasp = {
        "rotation_wxyz": [0.0, 0.0, 0.0, 1.0],
        "translation": [0.1, 0.2, 0.3],
        "covariance": np.eye(6).tolist(),
    }
    (tmp_path / "estimate.json").write_text(json.dumps({"values": {"grasp": grasp}}))
    belief = load_problem(
        written(tmp_path, SMALL.replace(GRASP, '[grasp]\nestimate = "estimate.json"\n'))
    ).problem.problem.grasp
    np.testing.assert_allclose(belief.rotation, np.diag([-1.0, -1.0, 1.0]), atol=1e-12)
    np.testing.assert_allclose(belief.translation, [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("alpha = 5.0", "alpa = 5.0"), "alpha"),
        (("alpha = 5.0", 'alpha = "five"'), "[excitation] alpha"),
        (("alpha = 5.0", "alpha = 5.0\nrotation_sd = 0.1"), "either alpha"),
        (("[0.4, 0.1, 0.05]", "[0.4, 0.1]"), "[grasp] translation"),
        (("translation =", "rotation_wxyz = [2.0, 0, 0, 0]\ntranslation ="), "unit quaternion"),
        ((GRASP, '[grasp]\nestimate = "nowhere.json"\n'), "no file"),
        (("translation =", "covariance = [1.0, 2.0]\ntranslation ="), "[grasp] covariance"),
        (("[excitation]", '[human]\nmode = "dancing"\n[excitation]'), "[human] mode"),
        (("[excitation]", '[human]\nmode = "planar"\n[excitation]'), "[human] travel"),
        (("[excitation]", '[human]\nmode = "task"\n[excitation]'), "where the task leads"),
        (("[excitation]", "[human]\nturn = [0.0, 0.0, 1.0]\n[excitation]"), "nothing in the mode 'static'"),
        (("[excitation]", '[robot]\nurdf = "none.urdf"\nframe = "x"\n[excitation]'), "URDF"),
        (("[excitation]", "[solver]\nspeed = 3\n[excitation]"), "[solver] speed"),
        (("duration = 3.0", "duration = -3.0"), "duration"),
    ],
)
def test_bad_input_is_named(tmp_path: Path, change: tuple[str, str], words: str) -> None:
    done = run("solve", str(written(tmp_path, SMALL.replace(*change))), "--out", str(tmp_path / "out"))
    assert done.exit_code == 2, done.output
    assert words in done.output
    assert not (tmp_path / "out").exists()


@needs_panda
@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ("velocity = [1.0, 2.0]\n", "[robot] velocity"),
        ("torque = -1.0\n", "[robot] torque"),
        ("box_lower = [0.0, 0.0, 0.0]\n", "box_lower and box_upper"),
        ("payload_mass = -2.0\n", "[robot] payload_mass"),
    ],
)
def test_bad_robots_are_named(tmp_path: Path, extra: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        load_problem(written(tmp_path, SMALL + robot(extra)))
    assert words in str(caught.value)


@needs_panda
def test_the_example_loads(tmp_path: Path) -> None:
    text = (
        (ROOT / "examples" / "excitation.toml")
        .read_text(encoding="utf-8")
        .replace('"panda.urdf"', f'"{PANDA}"')
    )
    stated = load_problem(written(tmp_path, text))
    assert stated.title == "Panda, resting wrist"
    assert stated.problem.problem.arm is not None

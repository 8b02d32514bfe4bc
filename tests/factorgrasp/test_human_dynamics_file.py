from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from factorgrasp import cli
from factorgrasp.errors import InputError
from factorgrasp.human_dynamics_result import HumanDynamicsResult
from factorgrasp.human_dynamics_task import HumanDynamicsTask
from factorgrasp.problem_file import load_problem
from factorgrasp.problems.human_dynamics_constraints import TorqueLimit
from factorgrasp.recordings.tables import read_table
from factorgrasp.simulation.human_dynamics import HumanRecording, human_carrying, human_tpose
from factorgrasp.simulation.human_dynamics_files import write_recording


@pytest.fixture(scope="module")
def recording() -> HumanRecording:
    return human_tpose(3, payload=5.0)


@pytest.fixture(scope="module")
def folder(recording: HumanRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tpose")
    write_recording(recording, path)
    return path


@pytest.fixture(scope="module")
def result(folder: Path) -> HumanDynamicsResult:
    found = load_problem(folder / "dynamics.toml").solve()
    assert isinstance(found, HumanDynamicsResult)
    return found


@pytest.fixture
def changed(folder: Path) -> Callable[..., Path]:
    """The problem file with words replaced, and lines behind."""

    def write(*pairs: tuple[str, str], more: str = "") -> Path:
        text = (folder / "dynamics.toml").read_text(encoding="utf-8")
        for old, new in pairs:
            assert old in text
            text = text.replace(old, new, 1)
        path = folder / "changed.toml"
        path.write_text(text + more, encoding="utf-8")
        return path

    return write


def test_recording_on_disk_gives_the_torques(recording: HumanRecording, result: HumanDynamicsResult) -> None:
    assert result.status.ok
    arrays = result.arrays()
    assert arrays["torque"].shape == (800, 66)
    assert arrays["joint_moment"].shape == (800, 22, 3)
    assert arrays["external_wrench"].shape == (800, 23, 6)
    # The ends, where the filter has no data, are gaps.
    lost = ~result.good
    assert 0 < lost.sum() < 40
    assert np.isnan(arrays["torque"][lost]).all()
    error = arrays["torque"] - recording.truth.of(result.frames.dof_names)
    legs = [k for k, name in enumerate(result.frames.dof_names) if "Knee" in name or "Ankle" in name]
    assert np.sqrt(np.nanmean(error[:, legs] ** 2)) < 1.5
    assert np.nanmean(arrays["payload_mass"]) == pytest.approx(5.0, abs=0.15)


def test_results_are_written_and_readable(result: HumanDynamicsResult, tmp_path: Path) -> None:
    result.save(tmp_path)
    summary = json.loads((tmp_path / "estimate.json").read_text(encoding="utf-8"))
    assert summary["status"] == "solved"
    assert summary["kind"] == "human_dynamics"
    assert summary["frames"] == {
        "all": 800,
        "gaps": int((~result.good).sum()),
        "solved": int(result.good.sum()),
    }
    assert summary["payload"]["links"] == ["RightHand"]
    assert summary["observability"]["directions"]
    assert set(summary["torque"]) == set(result.frames.dof_names)
    with np.load(tmp_path / "estimate.npz", allow_pickle=False) as arrays:
        for name in (
            "t",
            "joint_names",
            "torque",
            "torque_sd",
            "joint_moment",
            "external_wrench",
            "external_wrench_sd",
        ):
            assert name in arrays
        assert np.isfinite(arrays["payload_mass_sd"][result.good]).all()
        np.testing.assert_array_equal(arrays["torque"], result.arrays()["torque"])


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_export_comes_back_as_it_was(result: HumanDynamicsResult, tmp_path: Path, suffix: str) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    table = read_table(result.export(tmp_path / f"torques{suffix}"))
    k = result.frames.dof_names.index("jRightShoulder_x")
    np.testing.assert_allclose(table["torque jRightShoulder_x"], result.arrays()["torque"][:, k], rtol=1e-6)
    assert "wrench RightHand fz" in table
    assert "wrench Head fz" not in table
    with pytest.raises(InputError, match=r"\.csv or \.parquet"):
        result.export(tmp_path / "torques.xls")


def test_command_line_writes_everything(folder: Path, tmp_path: Path) -> None:
    run = CliRunner().invoke(cli.app, ["solve", str(folder / "dynamics.toml"), "--out", str(tmp_path)])
    assert run.exit_code == 0, run.output
    assert "RightHand holds" in run.output
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for words in (
        "Joints that work hardest",
        "Forces from outside",
        "What is held",
        "Do the sensors agree",
        "<svg",
    ):
        assert words in page
    assert "None" not in page
    assert (tmp_path / "estimate.npz").is_file()


@pytest.mark.parametrize(
    ("pair", "more", "words"),
    [
        (("[motion]", "[moton]"), "", "moton: expected a known key.*Did you mean motion"),
        (("height", "hight"), "", r"\[model\]: expected one of: links"),
        (('sex = "male"', 'sex = "m"'), "", r"\[model\] sex"),
        (("height = 1.75", "height = 175.0"), "", r"\[model\] height.*Centimetres"),
        (("bandwidth", "bandwith"), "", r"\[motion\] bandwith.*Did you mean bandwidth"),
        (("bandwidth = 6.0", "bandwidth = 80.0"), "", r"\[motion\] bandwidth_hz"),
        (('"motion.csv"', '"none.csv"'), "", "none.csv"),
        (('link = "RightFoot"', 'link = "RightFot"'), "", r"\[\[forces\]\] 1: link.*Did you mean RightFoot"),
        (("covariance = [4, 4", "covariance = [4, -4"), "", r"\[\[forces\]\] 1 covariance"),
        (('unmeasured = ["RightHand"]', 'unmeasured = ["Hand"]'), "", r"\[contacts\] unmeasured"),
        (('payload = ["RightHand"]', 'payload = ["LeftHand"]'), "", r"\[contacts\] payload"),
        (
            ('unmeasured = ["RightHand"]', 'unmeasured = ["RightHand", "LeftFoot"]'),
            "",
            "without a wrench sensor",
        ),
        (("[covariance]", '[covariance]\npreset = "latela2018"'), "", r"\[covariance\] preset"),
        (
            ("[covariance]", "[covariance]\nbalance = { Hed = 1e-3 }"),
            "",
            r"\[covariance\] balance Hed.*Did you mean Head",
        ),
        (
            ("[covariance]", "[covariance]\nbalence = 1e-3"),
            "",
            r"\[covariance\] balence.*Did you mean balance",
        ),
        (
            ("[model]", "[model]"),
            "[constraints]\nfriction = 0.5\n",
            r"\[constraints\] friction: expected feet",
        ),
        (
            ("[model]", "[model]"),
            "[constraints.torque_limits]\njRightNee = 5\n",
            "jRightNee.*Did you mean jRightKnee",
        ),
        (("[model]", "[model]"), '[[sensors]]\ntype = "giro"\n', r"\[\[sensors\]\] 1 type"),
        (("angle_sd = 0.001", "angle_sd = 0"), "", r"\[motion\] angle_sd"),
        (("angle_sd = 0.001", "[motion.columns]\njHed = 'x'"), "", r"\[motion.columns\] jHed"),
    ],
)
def test_what_is_wrong_is_named(
    changed: Callable[..., Path], pair: tuple[str, str], more: str, words: str
) -> None:
    with pytest.raises(InputError, match=f"(?s){words}"):
        load_problem(changed(pair, more=more))


def test_motion_without_some_joints(
    folder: Path, changed: Callable[..., Path], recording: HumanRecording
) -> None:
    table = np.genfromtxt(folder / "motion.csv", delimiter=",", names=True)
    kept = [name for name in table.dtype.names or () if "Toe" not in name and "BallFoot" not in name]
    text = ",".join(kept) + "\n" + "\n".join(",".join(f"{row[k]:.9g}" for k in kept) for row in table)
    (folder / "fewer.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"6 missing: .*BallFoot.*others = \"zero\""):
        load_problem(changed(('"motion.csv"', '"fewer.csv"')))
    problem = load_problem(changed(('"motion.csv"', '"fewer.csv"\nothers = "zero"'))).problem
    assert isinstance(problem, HumanDynamicsTask)
    assert len(problem.problem.motion.dof_names) == len(recording.truth.dof_names)


def test_gaps_in_motion_and_plates_stay_gaps(folder: Path, changed: Callable[..., Path]) -> None:
    lines = (folder / "motion.csv").read_text(encoding="utf-8").splitlines()
    lines[300:330] = [line.split(",")[0] + "," * 73 for line in lines[300:330]]
    (folder / "holes.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    result = load_problem(changed(('"motion.csv"', '"holes.csv"'), ("[contacts]", "[contacts]"))).solve()
    assert not result.good[299:329].any()
    assert np.isnan(result.arrays()["torque"][299:329]).all()
    # A plate at its limit is a plate that measured nothing.
    limited = load_problem(changed(('link = "RightFoot"', 'link = "RightFoot"\nlimit = 380.0'))).problem
    assert isinstance(limited, HumanDynamicsTask)
    values = next(s for s in limited.problem.sensors if s.name == "force on RightFoot").values
    assert np.isnan(values).any(axis=1).any()
    assert np.nanmax(np.linalg.norm(values[:, :3], axis=1)) < 380.0


def test_everything_stated_arrives(changed: Callable[..., Path]) -> None:
    more = (
        'preset = "tirupachuri2021"\nbalance = { default = 1e-5, Head = 1e-3 }\n'
        '[constraints]\nfeet = ["RightFoot", "LeftFoot"]\nposition = [0.05, 0, -0.07]\nfriction = 0.6\n'
        "corners = [[-0.1, -0.05], [0.1, -0.05], [0.1, 0.05], [-0.1, 0.05]]\n"
        "torque_limits = { jRightKnee = 150, jLeftKnee = [-20, 100] }\n"
    )
    problem = load_problem(changed(more=more)).problem
    assert isinstance(problem, HumanDynamicsTask)
    assert problem.noise.balance == {"default": 1e-5, "Head": 1e-3}
    assert problem.noise.free_wrench == 1e-6
    limits = [c for c in problem.problem.constraints if isinstance(c, TorqueLimit)]
    assert [(limit.joint, limit.lower, limit.upper) for limit in limits] == [
        ("jRightKnee", -150.0, 150.0),
        ("jLeftKnee", -20.0, 100.0),
    ]
    assert len(problem.problem.constraints) == 8


def test_two_tasks_agree_with_one_on_the_mass(tmp_path: Path) -> None:
    recording = human_carrying(1, motion="standing")
    path = write_recording(recording, tmp_path)
    text = path.read_text(encoding="utf-8")
    points = next(line for line in text.splitlines() if line.startswith("points"))
    path.write_text(text.replace(points, 'method = "two_tasks"'), encoding="utf-8")
    result = load_problem(path).solve()
    assert result.payload.mean == pytest.approx(9.55, abs=0.4)
    assert any("shared between" in d.words for d in result.estimate.observability.missing)
    path.write_text(text.replace(points, points + '\nmethod = "two_tasks"'), encoding="utf-8")
    with pytest.raises(InputError, match=r"\[contacts\] method"):
        load_problem(path)


def test_squat_notices_that_the_model_is_too_heavy(dataset: Callable[[str], Path], tmp_path: Path) -> None:
    links = dataset("opencap_squat") / "links_squat.npz"
    path = tmp_path / "squat.toml"
    path.write_text(
        f'kind = "human_dynamics"\n[model]\nlinks = "{links}"\n[motion]\nevery = 8\n[[forces]]\nfile = "{links}"\n',
        encoding="utf-8",
    )
    result = load_problem(path).solve()
    assert result.weighing.mass == pytest.approx(60.2, abs=0.3)
    assert "too heavy by 3." in result.summary()
    result.save(tmp_path)
    written = json.loads((tmp_path / "estimate.json").read_text(encoding="utf-8"))
    assert written["weighing"]["model"] == pytest.approx(62.6, abs=0.1)
    assert written["weighing"]["nis"] > 100.0
    # The weight in excess is what the base carries, unless the base is held to carry nothing: then the plates disagree.
    assert written["base_residual"]["force_rms"] == pytest.approx(9.8 * 2.4, abs=4.0)
    path.write_text(
        path.read_text(encoding="utf-8") + "[covariance]\nbase_residual = 1e-4\n", encoding="utf-8"
    )
    assert load_problem(path).solve().frames.innovation("force on calcn_r").ratio > 4.0


def test_walking_with_its_own_force_files(dataset: Callable[[str], Path], tmp_path: Path) -> None:
    folder = dataset("opensim_walk_gait2354")
    path = tmp_path / "walk.toml"
    path.write_text(
        f'kind = "human_dynamics"\n[model]\nlinks = "{folder / "links_walk.npz"}"\n'
        f'[[forces]]\nfile = "{folder / "subject01_walk1_grf.xml"}"\n[covariance]\nplate = [1e-2, 1e-2, 1e-2, 1e-4, 1e-4, 1e-4]\n'
        "link_acceleration = { default = 1e-3, pelvis = [1, 1, 1, 100, 100, 100] }\n",
        encoding="utf-8",
    )
    result = load_problem(path).solve()
    assert result.status.ok
    with np.load(folder / "ANSWERS_links_walk.npz") as answers:
        joints = [str(name) for name in answers["joints"]]
        reference = answers["joint_moment_world_at_jpos"]
    moments = result.arrays()["joint_moment"]
    # Plates that are trusted leave the residual to the pelvis, as the published inverse dynamics does.
    for name in ("hip_r", "hip_l", "knee_r", "knee_l", "ankle_r", "ankle_l"):
        error = moments[:, result.frames.joint_names.index(name)] - reference[:, joints.index(name)]
        assert np.sqrt(np.nanmean(error**2)) < 1.0


def test_walking_by_default_leaves_the_disagreement_to_the_base(
    dataset: Callable[[str], Path], tmp_path: Path
) -> None:
    folder, path = dataset("opensim_walk_gait2354"), tmp_path / "walk.toml"
    path.write_text(
        f'kind = "human_dynamics"\n[model]\nlinks = "{folder / "links_walk.npz"}"\n', encoding="utf-8"
    )
    result = load_problem(path).solve()
    with np.load(folder / "ANSWERS_links_walk.npz") as answers:
        joints = [str(name) for name in answers["joints"]]
        reference = answers["joint_moment_world_at_jpos"]
    moments = result.arrays()["joint_moment"]
    for name in ("hip_r", "hip_l", "knee_r", "knee_l", "ankle_r", "ankle_l"):
        error = moments[:, result.frames.joint_names.index(name)] - reference[:, joints.index(name)]
        assert np.sqrt(np.nanmean(error**2, axis=0)).max() < 3.0, name
    assert result.frames.innovation("force on calcn_r").ratio < 1.5
    assert "acts on pelvis" in result.summary()


@pytest.mark.parametrize(("value", "found"), [("-1.0", "above zero"), ("[1.0, 2.0]", "base_residual")])
def test_a_base_residual_is_a_variance(changed: Callable[..., Path], value: str, found: str) -> None:
    path = changed(("[covariance]", f"[covariance]\nbase_residual = {value}"))
    with pytest.raises(InputError, match=found):
        load_problem(path)


def test_virtual_payload_on_a_real_squat_is_recovered(dataset: Callable[[str], Path], tmp_path: Path) -> None:
    held, hand = 4.0, "hand_r"
    with np.load(dataset("opencap_squat") / "links_squat.npz") as archive:
        data = {
            name: archive[name][::8] if archive[name].shape[:1] == archive["t"].shape else archive[name]
            for name in archive
        }
    i = list(data["bodies"]).index(hand)
    pull = held * (np.array([0.0, -9.80665, 0.0]) - data["acom"][:, i])
    grf = data["grf"].astype(float)
    # The ground carries it: through the right foot, with its moment about that foot's centre of pressure.
    grf[:, 0, :3] -= pull
    grf[:, 0, 6:] += np.cross(data["pcom"][:, i] - grf[:, 0, 3:6], -pull)
    masses = []
    for name, forces in (("without", data["grf"]), ("with", grf)):
        np.savez(tmp_path / f"{name}.npz", **{**data, "grf": forces})
        com = ", ".join(f"{x:.6f}" for x in data["com"][i])
        (tmp_path / f"{name}.toml").write_text(
            f'kind = "human_dynamics"\n[model]\nlinks = "{name}.npz"\n[[forces]]\nfile = "{name}.npz"\n'
            f'[contacts]\nunmeasured = ["{hand}"]\npayload = ["{hand}"]\npoints = {{ {hand} = [{com}] }}\n'
            "[covariance]\ncontact_wrench = [1e4, 1e4, 1e4, 1e2, 1e2, 1e2]\n",
            encoding="utf-8",
        )
        result = load_problem(tmp_path / f"{name}.toml").solve()
        masses.append(np.nanmean(result.payload.mass))
    assert masses[1] - masses[0] == pytest.approx(held, abs=0.05)


def test_solvers_are_compared_on_the_middle_frame(folder: Path, tmp_path: Path) -> None:
    arguments = [
        "compare",
        str(folder / "dynamics.toml"),
        "--solvers",
        "cholesky,kkt",
        "--out",
        str(tmp_path),
    ]
    run = CliRunner().invoke(cli.app, arguments)
    assert run.exit_code == 0, run.output
    rows = json.loads((tmp_path / "comparison.json").read_text(encoding="utf-8"))
    assert "cholesky" in json.dumps(rows)

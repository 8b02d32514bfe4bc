"""Wrist-pose files from the command line: the answer against the truth, the files that are written, and bad input."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from factorgrasp.cli import app
from factorgrasp.errors import InputError
from factorgrasp.kinematics import isb_signs, range_of_motion
from factorgrasp.lie import angle_between, quaternion_wxyz_to_matrix
from factorgrasp.problem_file import load_problem
from factorgrasp.problems.wrist_settings import WristAssociation, WristNoise, WristSettings
from factorgrasp.recordings import read_poses, read_table
from factorgrasp.simulation.wrist import WristRecording, cordella2014
from factorgrasp.simulation.wrist_files import write_wrist_recording
from factorgrasp.wrist_result import WristResult
from factorgrasp.wrist_task import WristTask

_LAYOUT = re.compile(r"names = .*?\nlayout = \[.*?\n\]\nsd = .*?\n", re.DOTALL)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def recording() -> WristRecording:
    """Six seconds of all three axes, in which nothing is seen for 5 frames and for 25."""
    return cordella2014(0, motion="three_axes", duration=6.0, blackouts=((60, 65), (110, 135)))


@pytest.fixture(scope="module")
def solved(recording: WristRecording, tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    folder = tmp_path_factory.mktemp("wrist")
    file = write_wrist_recording(recording, folder)
    return run("solve", file, "--out", folder / "out"), folder / "out"


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short recording, for what goes wrong."""
    folder = tmp_path_factory.mktemp("short")
    write_wrist_recording(cordella2014(2, motion="three_axes", duration=1.5), folder)
    return folder


@pytest.fixture
def changed(short: Path, tmp_path: Path) -> Callable[..., Path]:
    """The short recording with the problem file and the blobs changed."""

    def write(
        file: Callable[[str], str] = lambda text: text,
        rows: Callable[[list[list[str]]], list[list[str]]] | None = None,
        header: str | None = None,
    ) -> Path:
        text = (short / "wrist.toml").read_text(encoding="utf-8")
        new = file(text)
        (tmp_path / "wrist.toml").write_text(new, encoding="utf-8")
        lines = (short / "blobs.csv").read_text(encoding="utf-8").splitlines()
        cells = [line.split(",") for line in lines[1:]]
        cells = cells if rows is None else rows(cells)
        out = [header or lines[0], *(",".join(row) for row in cells)]
        (tmp_path / "blobs.csv").write_text("\n".join(out) + "\n", encoding="utf-8")
        return tmp_path / "wrist.toml"

    return write


def replaced(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return change


def with_layout(new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert _LAYOUT.search(text)
        return _LAYOUT.sub(new, text)

    return change


# ---- the answer ----------------------------------------------------------------------------------------------


def test_the_track_agrees_with_the_truth(recording: WristRecording, solved: tuple[Result, Path]) -> None:
    result, out = solved
    assert result.exit_code == 0, result.output
    assert "wrist pose, batch: solved" in result.stdout
    assert sorted(path.name for path in out.iterdir()) == [
        "estimate.csv", "estimate.json", "estimate.npz", "report.html",
    ]  # fmt: skip
    truth = recording.truth
    with np.load(out / "estimate.npz") as arrays:
        found = dict(arrays)
    n = truth.t.size
    for name, shape in {
        "t": (n,), "rotation_wxyz": (n, 4), "position": (n, 3), "velocity": (n, 3), "angular_velocity": (n, 3),
        "covariance": (n, 6, 6), "association": recording.label.shape, "lost": (n,), "ambiguous": (n,), "angles": (n, 3),
    }.items():  # fmt: skip
        assert found[name].shape == shape, name
    good = ~found["lost"]
    assert good.sum() > 0.8 * n
    turn = angle_between(quaternion_wxyz_to_matrix(found["rotation_wxyz"][good]), truth.rotation[good])
    way = np.linalg.norm(found["position"] - truth.position, axis=1)[good]
    assert np.degrees(np.sqrt(np.mean(turn**2))) < 2.0
    assert np.sqrt(np.mean(way**2)) < 2.5e-3
    assert np.mean(found["association"] != recording.label) < 0.01
    assert np.sqrt(np.mean((found["velocity"] - truth.velocity)[good] ** 2)) < 0.05
    # In a gap nothing is known, and is said to be so.
    dark = (truth.t > recording.blobs.t[115]) & (truth.t < recording.blobs.t[130])
    assert found["lost"][dark].all()
    bridged = np.arange(60, 65)
    assert not found["lost"][bridged].any()
    sd = np.sqrt(np.trace(found["covariance"], axis1=1, axis2=2))
    assert np.all(sd[bridged[2]] > 1.1 * np.median(sd[good]))


def test_the_summary_says_what_was_found(recording: WristRecording, solved: tuple[Result, Path]) -> None:
    _, out = solved
    summary = json.loads((out / "estimate.json").read_text(encoding="utf-8"))
    assert summary["status"] == "solved"
    assert summary["kind"] == "wrist_pose"
    assert summary["hand"] == "right"
    assert recording.truth.angles is not None
    with np.load(out / "estimate.npz") as arrays:
        angles = np.where(arrays["lost"][:, None], np.nan, isb_signs("right") * recording.truth.angles)
    ranges = summary["range_of_motion"]
    for i, axis in enumerate(("flexion_extension", "radial_ulnar_deviation", "pronation_supination")):
        one, true = ranges[axis], angles[:, i]
        wanted = range_of_motion(
            recording.truth.t, true, np.full(true.size, 1e-4), np.tile(true, (3, 1))
        ).range.value
        assert np.degrees(one["range"]) == pytest.approx(np.degrees(wanted), abs=2.5)
        low, high = one["interval_95"]
        assert low < one["range"] < high
        assert 0.0 < one["sd"] < np.radians(2.0)
    assert set(ranges) == {"flexion_extension", "radial_ulnar_deviation", "pronation_supination"}
    assert ranges["pronation_supination"]["pronation"]["unit"] == "rad"
    gaps = [gap for gap in summary["gaps"] if gap["frames"] > 2]
    assert gaps[0]["start"] == pytest.approx(2.0, abs=0.05)
    assert not gaps[0]["lost"]
    assert any(gap["lost"] for gap in gaps[1:])
    rates = summary["rates"]
    assert rates["clutter"] == pytest.approx(2.0, abs=0.4)
    assert rates["pixel_sd"] == pytest.approx(1.0, abs=0.2)
    assert rates["miss"] == pytest.approx(1.0 - rates["detection"])
    points, sd = np.array(summary["layout"]["points"]), np.array(summary["layout"]["sd"])
    assert np.all(sd < 1.1e-3)
    assert np.abs(points - recording.truth.points).max() < 4e-3
    assert "found again" in " ".join(summary["warnings"]) or "lost" in " ".join(summary["warnings"])


def test_the_table_is_a_recording_of_poses(recording: WristRecording, solved: tuple[Result, Path]) -> None:
    _, out = solved
    poses = read_poses(out / "estimate.csv")
    assert len(poses.t) == recording.truth.t.size
    columns = read_table(
        out / "estimate.csv",
        ("t", "vx", "wx", "flexion", "flexion_sd", "cov_00", "cov_55", "markers", "lost"),
    )
    assert columns["markers"].max() == 6
    first = (out / "estimate.csv").read_text(encoding="utf-8").splitlines()
    at = first[0].split(",").index("association")
    assert [int(word) for word in first[1].split(",")[at].split()] == recording.label[
        recording.blobs.rows(0)
    ].tolist()


def test_the_report_shows_it(solved: tuple[Result, Path]) -> None:
    page = (solved[1] / "report.html").read_text(encoding="utf-8")
    for words in (
        "Ranges of motion",
        "Flexion/extension",
        "Which blob was which marker",
        "In the image",
        "middle mcp",
    ):
        assert words in page
    assert "<script" not in page
    assert len(page) < 2_000_000


def test_parquet(short: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    task = load_problem(short / "wrist.toml").problem
    assert isinstance(task, WristTask)
    task.method = "filter"
    result = task.solve()
    assert isinstance(result, WristResult)
    table = parquet.read_table(result.export(tmp_path / "track.parquet"))
    assert table.num_rows == 46
    assert "association" in table.column_names
    with pytest.raises(InputError, match="csv or"):
        result.export(tmp_path / "track.txt")


@pytest.mark.parametrize("method", ["fixed_lag", "filter"])
def test_other_ways_to_smooth(changed: Callable[..., Path], method: str, tmp_path: Path) -> None:
    file = changed(replaced("[estimate]\n", f'[estimate]\nmethod = "{method}"\nlag = 5\n'))
    result = run("solve", file, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    summary = json.loads((tmp_path / "out" / "estimate.json").read_text(encoding="utf-8"))
    assert summary["method"] == method
    assert summary["delay"] == (5 if method == "fixed_lag" else 0)
    assert "too large" in result.stdout


def test_layout_is_estimated_and_used_again(changed: Callable[..., Path], tmp_path: Path) -> None:
    file = changed(with_layout('layout = "estimate"\n'))
    result = run("solve", file, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "the layout was calibrated from" in result.stdout
    stored = changed(with_layout('layout = "out/estimate.json"\n'))
    task = load_problem(stored).problem
    assert isinstance(task, WristTask)
    summary = json.loads((tmp_path / "out" / "estimate.json").read_text(encoding="utf-8"))
    np.testing.assert_allclose(task.problem.markers.points, summary["layout"]["points"])
    np.testing.assert_allclose(task.problem.markers.covariance, summary["layout"]["covariance"])


def test_solvers_agree(changed: Callable[..., Path], tmp_path: Path) -> None:
    file = changed()
    result = run("compare", file, "--solvers", "cholesky,kkt", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "out" / "comparison.json").read_text(encoding="utf-8"))["rows"]
    assert [row["status"] for row in rows] == ["solved", "solved"]
    assert all(row["mean_difference"] < 1e-3 for row in rows)


# ---- the tables ----------------------------------------------------------------------------------------------


def test_all_keys(changed: Callable[..., Path]) -> None:
    more = (
        '[association]\nmethod = "hungarian"\np_miss = 0.05\nclutter = 1.5\ngate = 0.999\n\n'
        "[noise]\ncalibration = 1e-3\nacceleration_density = 2.0\nangular_acceleration_density = 4.0\ndepth_sd = 2e-3\n"
    )

    def change(text: str) -> str:
        text = text.replace("[noise]\n", more)
        text = re.sub(
            r"fx = .*?cy = [^\n]*\n",
            "matrix = [[525, 0, 320], [0, 525, 240], [0, 0, 1]]\ndistortion = [0.01, 0, 0, 0]\n"
            "rotation_wxyz = [0, 1, 0, 0]\nposition = [-0.05, 0, 0.7]\n",
            text,
            flags=re.DOTALL,
        )
        return text.replace('hand = "right"', 'hand = "left"\nlag = 7\nlayout = "noise"')

    task = load_problem(changed(change)).problem
    assert isinstance(task, WristTask)
    problem = task.problem
    assert task.hand == "left"
    assert (problem.association.method, problem.association.detection) == ("assignment", 0.95)
    assert (
        problem.noise.calibration_sd,
        problem.noise.translation_density,
        problem.noise.rotation_density,
    ) == (1e-3, 2.0, 4.0)
    assert (problem.settings.lag, problem.settings.layout) == (7, "noise")
    assert problem.camera.cx == 320.0
    assert problem.camera_pose is not None
    np.testing.assert_allclose(problem.camera_pose.rotation, np.diag([1.0, -1.0, -1.0]))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("pixel_sd", "pixl_sd", "[noise] pixl_sd: expected a known key; found an unknown one. Did you mean pixel_sd"),
        ("[noise]", "[nosie]", "Did you mean noise"),
        ("[noise]\n", '[association]\nmethod = "munkres"\n[noise]\n', "[association] method"),
        ("[noise]\n", "[association]\np_miss = 1.5\n[noise]\n", "[association] p_miss: expected a probability"),
        ("[noise]\n", "[noise]\ndepth_sd = 2.0\n", "millimetres"),
        ("fx = 525.0", "fx = -525.0", "[camera] fx"),
        ("fx = 525.0\n", "", "[camera] fx"),
        ("cx = 319.5", "cx = 3195", "principal point within the image"),
        ("[640, 480]", "[640]", "[camera] resolution"),
        ("[640, 480]", "[480, 640]", "swapped"),
        ('hand = "right"', 'hand = "both"', "[estimate] hand"),
        ('file = "blobs.csv"', 'file = "none.csv"', "no such file"),
        ('file = "blobs.csv"', 'video = "none.avi"', "[blobs] video"),
        ('file = "blobs.csv"', 'images = "none"', "[blobs] images"),
        ('file = "blobs.csv"', 'file = "blobs.csv"\nvideo = "a.avi"', "one of file, video and images"),
        ("sd = 0.001", "sd = 1.0", "Is it in millimetres"),
        ("sd = 0.001", "sd = [0.001, 0.002]", "[markers] sd"),
        ('names = ["wrist", ', "names = [", "[markers] names"),
    ],
)  # fmt: skip
def test_mistakes_in_the_file(
    changed: Callable[..., Path], old: str, new: str, words: str, tmp_path: Path
) -> None:
    result = run("solve", changed(replaced(old, new)), "--out", tmp_path / "out")
    assert result.exit_code == 2, result.output
    assert words in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("layout", "words"),
    [
        ("layout = [[0, 0, 0], [38, 46, -14], [95, 0, 0]]\n", "millimetres"),
        ("layout = [[0, 0, 0], [0.04, 0.05, -0.01]]\n", "at least three"),
        ("layout = [[0, 0, 0], [0.04, 0, 0], [0.08, 0, 0]]\n", "not on one line"),
        ("layout = [[0, 0], [0.04, 0]]\n", "[markers] layout 1"),
        ('layout = "palm.json"\n', "no such file"),
        ("layout = 3\n", "[markers] layout"),
        ("", "[markers] layout"),
    ],
)
def test_mistakes_in_the_layout(changed: Callable[..., Path], layout: str, words: str) -> None:
    result = run("solve", changed(with_layout(layout)))
    assert result.exit_code == 2, result.output
    assert words in result.stderr


@pytest.mark.parametrize(
    ("rows", "header", "words"),
    [
        (None, "frame,t,v,u,z", "Are the columns u and v swapped"),
        (None, "t,frame,u,v,z", "column frame: expected whole numbers"),
        (None, "frame,t,x,y,z", "u"),
        (lambda R: R[100:] + R[:100], None, "frames in order"),
        (lambda R: [[*r[:4], str(1e3 * float(r[4])) if r[4] else ""] for r in R], None, "metres"),
        (lambda R: [[r[0], str(1e3 * float(r[1])), *r[2:]] for r in R], None, "Milliseconds"),
        (lambda R: [[str(k), str(k / 30), "", "", ""] for k in range(40)], None, "none in any of 40 frames"),
        (lambda R: [], None, "header only"),
        (lambda R: [[*r[:2], "abc", *r[3:]] if k == 5 else r for k, r in enumerate(R)], None, "'abc'"),
        (lambda R: [[*r[:2], "nan", *r[3:]] if k == 5 else r for k, r in enumerate(R)], None, "expected both or none"),
    ],
)  # fmt: skip
def test_mistakes_in_the_blobs(
    changed: Callable[..., Path],
    rows: Callable[[list[list[str]]], list[list[str]]] | None,
    header: str | None,
    words: str,
) -> None:
    result = run("solve", changed(rows=rows, header=header))
    assert result.exit_code == 2, result.output
    assert words in result.stderr


# ---- what the data do not show -------------------------------------------------------------------------------


def _few(rows: list[list[str]]) -> list[list[str]]:
    """Two blobs a frame."""
    counts: dict[str, int] = {}
    out = []
    for row in rows:
        counts[row[0]] = counts.get(row[0], 0) + 1
        if counts[row[0]] <= 2:
            out.append(row)
    return out


def test_fewer_than_three_markers_for_ever(changed: Callable[..., Path], tmp_path: Path) -> None:
    result = run("solve", changed(rows=_few), "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "at least three markers have to be seen at once" in result.stderr
    summary = json.loads((tmp_path / "out" / "estimate.json").read_text(encoding="utf-8"))
    assert summary["status"] == "unobservable"
    assert summary["frames"]["lost"] == summary["frames"]["all"]
    assert summary["range_of_motion"] == {}
    assert (tmp_path / "out" / "report.html").exists()


def test_no_depth_is_never_a_confident_answer(changed: Callable[..., Path], tmp_path: Path) -> None:
    file = changed(rows=lambda R: [[*row[:4], "nan"] for row in R])
    result = run("solve", file, "--out", tmp_path / "out")
    assert result.exit_code == 1, result.output
    assert "ambiguous" in result.output
    assert "depth" in result.stderr


def test_wrong_intrinsics_are_suspected(changed: Callable[..., Path], tmp_path: Path) -> None:
    file = changed(lambda text: text.replace("fx = 525.0", "fx = 580.0").replace("fy = 525.0", "fy = 580.0"))
    result = run("solve", file, "--out", tmp_path / "out")
    assert "intrinsics are suspected" in result.stdout
    summary = json.loads((tmp_path / "out" / "estimate.json").read_text(encoding="utf-8"))
    assert any("intrinsics" in words for words in summary["warnings"])


def test_a_layout_of_something_else_is_no_answer(changed: Callable[..., Path], tmp_path: Path) -> None:
    points = [
        [0, 0, 0],
        [0.08, 0.02, 0.03],
        [0.02, -0.05, 0.001],
        [0.15, 0, 0],
        [0.087, 0.081, -0.002],
        [0.075, 0.14, -0.006],
    ]
    strange = f"layout = {points}\n"
    result = run("solve", changed(with_layout(strange)), "--out", tmp_path / "out")
    assert result.exit_code == 1, result.output
    assert "layout" in result.stderr


def test_the_other_hands_layout_is_noticed(changed: Callable[..., Path], tmp_path: Path) -> None:
    def mirror(text: str) -> str:
        return re.sub(
            r"^  \[(\S+), (\S+), (\S+)\]",
            lambda m: f"  [{m[1]}, {-float(m[2])}, {m[3]}]",
            text,
            flags=re.MULTILINE,
        )

    result = run("solve", changed(mirror), "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "the layout that of the other hand" in result.stderr


def test_images_with_depth_to_the_pose(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    from factorgrasp.simulation.hand_files import write_frames
    from factorgrasp.simulation.hand_motion import swinging_hand

    video = swinging_hand(12, seed=1, speed=1.5)
    write_frames(video, tmp_path, movie=True)
    camera = (
        'kind = "wrist_pose"\n[camera]\nmatrix = [[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]]\nresolution = [640, 480]\n'
        '[markers]\nlayout = "estimate"\n[blobs]\n'
    )
    u, v = np.rint(video.camera.project(video.markers(0))[0])
    file = tmp_path / "wrist.toml"
    file.write_text(camera + f'images = "rgb"\ndepth = "depth"\nclick = [{u}, {v}]\n', encoding="utf-8")
    result = run("solve", file, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    with np.load(tmp_path / "out" / "estimate.npz") as arrays:
        R = quaternion_wxyz_to_matrix(arrays["rotation_wxyz"])
        markers_seen = arrays["markers_seen"]
    # Against the first frame, so that the frame of the calibration does not matter.
    true = np.swapaxes(video.R_c_w[:1], 1, 2) @ video.R_c_w
    turned = np.swapaxes(R[:1], 1, 2) @ R
    angle = np.linalg.norm(
        np.stack([angle_between(np.eye(3), true), angle_between(np.eye(3), turned)]), axis=0
    ) / np.sqrt(2.0)
    assert np.degrees(angle.max()) > 15.0
    np.testing.assert_allclose(
        angle_between(np.eye(3), turned), angle_between(np.eye(3), true), atol=np.radians(1.0)
    )
    assert markers_seen.mean() > 5.5
    # A video alone has no depth: nothing to calibrate by.
    file.write_text(camera + 'video = "movie.avi"\n', encoding="utf-8")
    result = run("solve", file)
    assert result.exit_code == 2
    assert "with depth" in result.stderr
    for line, words in (
        ('images = "rgb"\ndepth = "rgb"\n', "a depth image of one channel"),
        ('images = "rgb"\nclick = [5, 5]\n', "[blobs] click"),
        ('images = "rgb"\ncolour = "none.json"\n', "none.json"),
        ('images = "rgb"\nmarker_size = 3\n', "marker_diameter"),
    ):
        file.write_text(camera + line, encoding="utf-8")
        result = run("solve", file)
        assert result.exit_code == 2
        assert words in result.stderr, result.stderr


# ---- the documentation ---------------------------------------------------------------------------------------

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("heading", "settings", "others"),
    [
        ("### `[association]`", WristAssociation, set()),
        ("### `[noise]`", WristNoise, set()),
        ("### `[estimate]`", WristSettings, {"method", "hand"}),
    ],
)
def test_documented_keys_and_defaults(heading: str, settings: type[Any], others: set[str]) -> None:
    """docs/wrist-pose.md has one row for every setting, with its default, and no others."""
    text = (ROOT / "docs" / "wrist-pose.md").read_text(encoding="utf-8").split(heading)[1].split("\n##")[0]
    cells = [line.split(" | ") for line in text.splitlines() if line.startswith("| `")]
    documented = {row[0].split("`")[1]: row[1].strip("` ") for row in cells}
    assert set(documented) == {field.name for field in fields(settings)} | others
    for field in fields(settings):
        shown = documented[field.name]
        if field.default is None:
            assert shown == "none", field.name
        else:
            assert tomllib.loads(f"value = {shown}")["value"] == field.default, field.name


def test_documented_arrays(solved: tuple[Result, Path]) -> None:
    text = (
        (ROOT / "docs" / "wrist-pose.md")
        .read_text(encoding="utf-8")
        .split("## The answer")[1]
        .split("`estimate.json` has")[0]
    )
    named = {
        name
        for line in text.splitlines()
        if line.startswith("| `")
        for name in re.findall(r"`(\w+)`", line.split(" | ")[0])
    }
    with np.load(solved[1] / "estimate.npz") as arrays:
        assert named == set(arrays.files)


def test_example_problem_file_loads(short: Path, tmp_path: Path) -> None:
    (tmp_path / "blobs.csv").write_bytes((short / "blobs.csv").read_bytes())
    file = tmp_path / "example.toml"
    file.write_text((ROOT / "examples" / "wrist.toml").read_text(encoding="utf-8"), encoding="utf-8")
    assert load_problem(file).title == "abduction and adduction, right hand"

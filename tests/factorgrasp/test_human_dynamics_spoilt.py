"""Spoilt models, motions and forces through the command line: a clear error, or a right answer; and other ways to write a file."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from factorgrasp import cli
from factorgrasp.simulation.human_dynamics import human_carrying
from factorgrasp.simulation.human_dynamics_files import write_recording
from factorgrasp.typing import FloatArray

Table = tuple[list[str], FloatArray]
Spoil = Callable[[list[str], FloatArray], Table]


class Folder:
    """A recording on disk, parts of which can be spoilt."""

    def __init__(self, path: Path) -> None:
        self.path = path
        recording = human_carrying(3, motion="standing")
        self.text = (
            write_recording(recording, path)
            .read_text(encoding="utf-8")
            .replace("[motion]", "[motion]\nend = 0.8")
        )
        recording.body.write_urdf(path / "body.urdf")
        self.urdf = (path / "body.urdf").read_text(encoding="utf-8")

    def table(self, name: str, spoil: Spoil, new: str) -> None:
        lines = (self.path / name).read_text(encoding="utf-8").splitlines()
        values = np.array([[float(x) for x in line.split(",")] for line in lines[1:]])
        header, values = spoil(lines[0].split(","), values)
        rows = [",".join(f"{x:.9g}" if np.isfinite(x) else "" for x in row) for row in values]
        (self.path / new).write_text("\n".join([",".join(header), *rows]) + "\n", encoding="utf-8")

    def with_urdf(self, urdf: str) -> str:
        (self.path / "spoilt.urdf").write_text(urdf, encoding="utf-8")
        return re.sub(r"\[model\].*?\n\n", '[model]\nurdf = "spoilt.urdf"\n\n', self.text, flags=re.DOTALL)

    def solve(self, text: str, out: Path) -> tuple[int, str]:
        file = self.path / "spoilt.toml"
        file.write_text(text, encoding="utf-8")
        run = CliRunner().invoke(cli.app, ["solve", str(file), "--out", str(out)])
        return run.exit_code, re.sub(r"\s+", " ", run.output)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    return Folder(tmp_path_factory.mktemp("spoilt"))


def scaled(pattern: str, factor: float, unit: str = "") -> Spoil:
    def spoil(header: list[str], values: FloatArray) -> Table:
        hit = np.array([re.fullmatch(pattern, name) is not None for name in header])
        named = [
            f"{name} [{unit}]" if unit and there else name for name, there in zip(header, hit, strict=True)
        ]
        return named, np.where(hit, factor * values, values)

    return spoil


def renamed(old: str, new: str) -> Spoil:
    return lambda header, values: ([new if name == old else name for name in header], values)


def lost(pattern: str, rows: slice) -> Spoil:
    def spoil(header: list[str], values: FloatArray) -> Table:
        out = values.copy()
        hit = [k for k, name in enumerate(header) if re.fullmatch(pattern, name)]
        out[rows, hit[0] : hit[-1] + 1] = np.nan
        return header, out

    return spoil


def shifted(seconds: float) -> Spoil:
    return lambda header, values: (header, values + np.array([seconds] + [0.0] * (len(header) - 1)))


def at_rate(rate: float) -> Spoil:
    def spoil(header: list[str], values: FloatArray) -> Table:
        t = np.arange(values[0, 0], values[-1, 0], 1.0 / rate)
        return header, np.column_stack(
            [t, *(np.interp(t, values[:, 0], column) for column in values[:, 1:].T)]
        )

    return spoil


URDFS: Mapping[str, tuple[str, str, str]] = {
    "negative mass": (r'<mass value="[^"]+"', '<mass value="-3"', "mass of Pelvis: expected a finite mass"),
    "mass that is no number": (
        r'<mass value="[^"]+"',
        '<mass value="nan"',
        "mass of Pelvis: expected a finite number",
    ),
    "indefinite inertia": (
        r'ixx="[^"]+"',
        'ixx="-0.1"',
        "inertia of Pelvis: expected a positive semidefinite matrix",
    ),
    "impossible inertia": (r'izz="[^"]+"', 'izz="50"', "principal moments each at most the sum"),
    "empty joint name": (r'<joint name="jL5S1_x"', '<joint name=""', "joint 1: expected a name"),
    "no joint name": (r'<joint name="jL5S1_x"', "<joint", "joint 1: expected a name"),
    "joint twice": (r'"jL5S1_y"', '"jL5S1_x"', "expected unique names; found jL5S1_x more than once"),
    "link twice": (r'<link name="L3">', '<link name="L5">', "expected unique names; found L5 more than once"),
    "unknown parent": (
        r'<parent link="Pelvis"/>',
        '<parent link="Hips"/>',
        "parent of joint jL5S1_x: expected a link of the file",
    ),
    "no XML": (r"^.*$", "hello", "a URDF file that pinocchio reads"),
}


@pytest.mark.parametrize("name", URDFS)
def test_model_that_no_body_has(folder: Folder, tmp_path: Path, name: str) -> None:
    pattern, new, words = URDFS[name]
    urdf = re.sub(pattern, new, folder.urdf, count=1, flags=re.DOTALL if name == "no XML" else 0)
    assert urdf != folder.urdf
    code, output = folder.solve(folder.with_urdf(urdf), tmp_path)
    assert code == 2, output
    assert words in output
    assert not (tmp_path / "estimate.json").exists()


def test_model_without_any_mass(folder: Folder, tmp_path: Path) -> None:
    urdf = re.sub(r"<inertial>.*?</inertial>", "", folder.urdf, flags=re.DOTALL)
    code, output = folder.solve(folder.with_urdf(urdf), tmp_path)
    assert code == 2
    assert "every link is without inertial" in output


MOTIONS: Mapping[str, tuple[Spoil, str]] = {
    "degrees": (scaled("j.*", 180.0 / np.pi), "degrees suspected"),
    "milliseconds": (scaled("t", 1000.0), "milliseconds or finer suspected"),
    "millimetres": (scaled("p[xyz]", 1000.0), "Millimetres?"),
    "another joint name": (renamed("jRightKnee_y", "knee"), "1 missing: jRightKnee_y"),
    "a column twice": (renamed("jRightKnee_y", "jRightKnee_x"), "one column jRightKnee_x; found 2 of them"),
    "a joint that was never seen": (lost("jL5S1_y", slice(None)), "jL5S1_y: expected at least two numbers"),
    "time that is missing": (lost("t", slice(4, 5)), "expected a time in every row"),
    "quaternions that are none": (scaled("q[wxyz]", 2.0), "unit quaternions"),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_that_cannot_be(folder: Folder, tmp_path: Path, name: str) -> None:
    spoil, words = MOTIONS[name]
    folder.table("motion.csv", spoil, "spoilt.csv")
    code, output = folder.solve(
        folder.text.replace("motion.csv", "spoilt.csv").replace("end = 0.8\n", ""), tmp_path
    )
    assert code == 2, output
    assert words in output


FORCES: Mapping[str, tuple[Spoil, str]] = {
    "another clock": (shifted(100.0), "expected times within those of the motion, 0"),
    "kilonewtons": (scaled("f[xyz]", 1e-3), "kN suspected"),
    "millimetres": (scaled("p[xyz]", 1000.0), "Millimetres?"),
    "forces on the ground": (scaled("[fm][xyz]", -1.0), "Turn their sign"),
    "gaps everywhere": (lost("f[xyz]", slice(None)), "gaps everywhere"),
    "a force without z": (renamed("fz", "force"), "columns: expected fx, fy, fz; found fz missing"),
    "a time that goes back": (scaled("t", -1.0), "increasing"),
}


@pytest.mark.parametrize("name", FORCES)
def test_forces_that_cannot_be(folder: Folder, tmp_path: Path, name: str) -> None:
    spoil, words = FORCES[name]
    text = folder.text
    for foot in ("RightFoot", "LeftFoot"):
        folder.table(f"plate_{foot}.csv", spoil, f"spoilt_{foot}.csv")
        text = text.replace(f"plate_{foot}.csv", f"spoilt_{foot}.csv")
    code, output = folder.solve(text, tmp_path)
    assert code == 2, output
    assert words in output


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('link = "RightFoot"', 'link = "RightFoot"\nlimit = 100.0', "at its limit all the time"),
        ('sex = "male"', 'sex = "male"\ngravity = [0, -9.80665, 0]', "Which axis is upright?"),
        ('link = "RightFoot"', 'link = "RightFoot"\nframe = "plat"', "one of world, plate, sensor, link"),
        ('link = "RightFoot"', 'link = "RightFoot"\nposition = [0, 0, 0]', "[[forces]] 1 position"),
        ('link = "RightFoot"', 'link = "RightFoot"\ncolumns = ["a", "b"]', "3 names (force), 6"),
        ('link = "RightFoot"', 'link = "RightFoot"\nsd = [2, 0.5]', "either sd or covariance"),
        ('link = "RightFoot"', 'link = "RightFoot"\nbody = "RightFoot"', "link once"),
        ("end = 0.8", "end = 0.8\ncutoff = 5", "bandwidth once"),
        ("[model]", '[model]\nurdf = "body.urdf"', "expected one of: links"),
        (
            'sex = "male"',
            'sex = "male"\nanthropometry = { height = 1.8 }',
            "[model] height: expected the key once",
        ),
    ],
)
def test_keys_that_cannot_be(folder: Folder, tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in folder.text
    code, output = folder.solve(folder.text.replace(old, new, 1), tmp_path)
    assert code == 2, output
    assert words in output


def mass(out: Path) -> float:
    with np.load(out / "estimate.npz") as arrays:
        weight = 1.0 / arrays["payload_mass_sd"] ** 2
        return float(np.nansum(weight * arrays["payload_mass"]) / np.nansum(weight))


RIGHT: Mapping[str, tuple[Spoil, str, str]] = {
    "a plate of 1000 Hz": (at_rate(1000.0), "", ""),
    "a plate of 37 Hz": (at_rate(37.0), "", ""),
    "a clock that is known": (
        shifted(100.0),
        'link = "RightFoot"',
        'link = "RightFoot"\ntime_offset = -100.0',
    ),
    "a declared unit": (scaled("f[xyz]", 1e-3, "kN"), "", ""),
    "dropouts": (lost("f[xyz]", slice(40, 60)), "", ""),
}


@pytest.mark.parametrize("name", RIGHT)
def test_right_in_spite_of(folder: Folder, tmp_path: Path, name: str) -> None:
    spoil, old, new = RIGHT[name]
    folder.table("plate_RightFoot.csv", spoil, "other.csv")
    text = folder.text.replace("plate_RightFoot.csv", "other.csv")
    assert old in text
    code, output = folder.solve(text.replace(old, new, 1), tmp_path)
    assert code == 0, output
    assert mass(tmp_path) == pytest.approx(9.55, abs=0.35)


def test_other_ways_to_write_it(folder: Folder, tmp_path: Path) -> None:
    """Every section in another of its spellings, columns by other names, a plate in its own frame: the same numbers."""
    code, output = folder.solve(folder.text, tmp_path / "one")
    assert code == 0, output
    names = {
        "fx": "Fx",
        "fy": "Fy",
        "fz": "Fz",
        "px": "Px",
        "py": "Py",
        "pz": "Pz",
        "mx": "Mx",
        "my": "My",
        "mz": "Mz",
        "t": "time",
    }
    folder.table(
        "plate_RightFoot.csv", lambda header, values: ([names[name] for name in header], values), "other.csv"
    )
    # The left plate's frame stands at (0.2, 0.1, 0), turned by half a turn about x.
    turn = np.diag([1.0, -1.0, -1.0])

    def own(header: list[str], values: FloatArray) -> Table:
        out = values.copy()
        out[:, 1:4], out[:, 7:10] = values[:, 1:4] @ turn, values[:, 7:10] @ turn
        out[:, 4:7] = (values[:, 4:7] - [0.2, 0.1, 0.0]) @ turn
        return header, out

    folder.table("plate_LeftFoot.csv", own, "turned.csv")
    text = folder.text
    head = 'kind = "human_dynamics"\n[model]\nanthropometry = { height = 1.75, mass = 75.5, sex = "male" }\n[motion]\ncsv = "motion.csv"\n'
    rest = (
        text[text.index("end = 0.8") : text.index("[[forces]]")]
        .replace('file = "motion.csv"', "")
        .replace("bandwidth", "cutoff")
    )
    columns = str([names[key] for key in ("fx", "fy", "fz", "px", "py", "pz", "mx", "my", "mz")])
    forces = (
        f'[forces.right]\npath = "other.csv"\nbody = "RightFoot"\ncolumns = {columns}\nsd = [2, 2, 2, 0.5, 0.5, 0.5]\nframe = "ground"\n'
        '[forces.left]\nfile = "turned.csv"\nlink = "LeftFoot"\nframe = "plate"\nposition = [0.2, 0.1, 0]\nrotation_wxyz = [0, 1, 0, 0]\n'
        "covariance = [4, 0.25]\n"
    )
    contacts = text[text.index("[contacts]") :]
    contacts = re.sub(r"payload = .*", "payload = true", contacts)
    code, output = folder.solve(head + rest + forces + contacts, tmp_path / "two")
    assert code == 0, output
    with np.load(tmp_path / "one" / "estimate.npz") as one, np.load(tmp_path / "two" / "estimate.npz") as two:
        for name in ("torque", "torque_sd", "external_wrench", "payload_mass"):
            np.testing.assert_allclose(one[name], two[name], atol=1e-5)


def test_export_is_for_tables_over_time(folder: Folder, tmp_path: Path) -> None:
    file = folder.path / "export.toml"
    file.write_text(folder.text, encoding="utf-8")
    run = CliRunner().invoke(cli.app, ["solve", str(file), "--out", str(tmp_path), "--export", "csv"])
    assert run.exit_code == 0
    header = (tmp_path / "estimate.csv").read_text(encoding="utf-8").splitlines()[0]
    assert "torque jRightKnee_y" in header
    assert "torque jRightKnee_y sd" in header
    run = CliRunner().invoke(cli.app, ["solve", str(file), "--out", str(tmp_path), "--export", "xls"])
    assert run.exit_code == 2
    assert "csv or parquet" in run.output

"""The examples run as a newcomer would run them, and the documentation names what exists."""

from __future__ import annotations

import runpy
import sys
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from factorgrasp.demo import write_demo
from factorgrasp.problem_file import load_problem
from factorgrasp.problems import GraspNoise, GraspSettings

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("script", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_example_runs(
    script: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(script)])
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(script), run_name="__main__")
    assert capsys.readouterr().out.strip()


def test_example_problem_file_loads(tmp_path: Path) -> None:
    write_demo(tmp_path, duration=5.0)
    (tmp_path / "example.toml").write_text(
        (ROOT / "examples" / "grasp.toml").read_text(encoding="utf-8"), encoding="utf-8"
    )
    assert load_problem(tmp_path / "example.toml").title == "first session"


def test_problem_file_of_the_readme_loads(tmp_path: Path) -> None:
    write_demo(tmp_path, duration=5.0)
    text = (ROOT / "README.md").read_text(encoding="utf-8").split("```toml\n")[1].split("```")[0]
    assert set(tomllib.loads(text)) == {"kind", "robot", "hand", "noise", "estimate"}
    (tmp_path / "readme.toml").write_text(text, encoding="utf-8")
    assert load_problem(tmp_path / "readme.toml").kind == "grasp_pose"


@pytest.mark.parametrize(
    ("heading", "settings"), [("### `[noise]`", GraspNoise), ("### `[estimate]`", GraspSettings)]
)
def test_documented_keys_and_defaults(heading: str, settings: type[Any]) -> None:
    """docs/problem-files.md has one row for every setting, with its default, and no others."""
    text = (
        (ROOT / "docs" / "problem-files.md").read_text(encoding="utf-8").split(heading)[1].split("\n### ")[0]
    )
    cells = [line.split(" | ") for line in text.splitlines() if line.startswith("| `")]
    documented = {row[0].strip("| `"): row[1].strip("` ") for row in cells}
    assert set(documented) == {field.name for field in fields(settings)}
    for field in fields(settings):
        shown = documented[field.name]
        if field.default is None:
            assert shown in ("none", "from the data"), field.name
        else:
            assert tomllib.loads(f"value = {shown}")["value"] == field.default, field.name

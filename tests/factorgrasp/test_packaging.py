"""Source archive and wheel are built for real, from a copy of the repository, and hold everything."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("factorgrasp", "problems", "solvers", "tests", "benchmarks", "examples", "docs", ".ci")
FILES = (
    "pyproject.toml",
    "MANIFEST.in",
    "README.md",
    "LICENSE",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "Makefile",
    "constraints.txt",
)
SETUPTOOLS = int(version("setuptools").split(".")[0])

needs_setuptools = pytest.mark.skipif(
    SETUPTOOLS < 77, reason=f"building needs setuptools >= 77 in this environment (here: {SETUPTOOLS})"
)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The source archive of a copy of the repository, and the wheel that was built from that archive."""
    folder = tmp_path_factory.mktemp("packaging")
    copy, out = folder / "copy", folder / "dist"
    copy.mkdir()
    for name in SOURCES:
        if (ROOT / name).is_dir():
            ignore = shutil.ignore_patterns("__pycache__", "*.egg-info")
            shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=ignore)
    for name in FILES:
        shutil.copy(ROOT / name, copy / name)
    sdist = _build("build_sdist", copy, out)
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    return sdist, _build("build_wheel", folder / sdist.name.removesuffix(".tar.gz"), out)


def _build(hook: str, source: Path, out: Path) -> Path:
    """Run a hook of the build backend as pip does, with the setuptools of this environment."""
    out.mkdir(exist_ok=True)
    code = f"from setuptools import build_meta; print(build_meta.{hook}({str(out)!r}))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return out / done.stdout.strip().splitlines()[-1]


def _package_files() -> set[str]:
    """Every file of the package as it is imported, symbolic links followed."""
    found = set()
    for folder, folders, names in os.walk(ROOT / "factorgrasp", followlinks=True):
        folders[:] = [name for name in folders if name != "__pycache__"]
        found |= {(Path(folder) / name).relative_to(ROOT).as_posix() for name in names}
    return {name for name in found if not name.endswith((".pyc", ".part"))}


@needs_setuptools
def test_wheel_from_source_archive_holds_the_whole_package(built: tuple[Path, Path]) -> None:
    _, wheel = built
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    packaged = {name for name in names if ".dist-info/" not in name}
    assert packaged == _package_files()
    assert {
        "factorgrasp/py.typed",
        "factorgrasp/report_template.html",
        "factorgrasp/problems/__init__.py",
    } <= packaged
    assert any(name.endswith("licenses/LICENSE") for name in names)


@needs_setuptools
def test_source_archive_holds_what_a_developer_needs(built: tuple[Path, Path]) -> None:
    sdist, _ = built
    with tarfile.open(sdist) as archive:
        names = {member.name.partition("/")[2] for member in archive.getmembers()}
        assert all(member.isfile() or member.isdir() for member in archive.getmembers())
    assert names >= _package_files()
    assert names >= {*FILES, ".ci/run"}
    for folder in ("tests", "benchmarks", "examples", "docs"):
        there = {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*.py")}
        assert names >= there


@needs_setuptools
def test_installed_wheel_imports_and_claims_no_bare_names(built: tuple[Path, Path], tmp_path: Path) -> None:
    _, wheel = built
    venv.create(tmp_path / "venv", with_pip=False, symlinks=True)
    python = tmp_path / "venv" / "bin" / "python"
    site = next((tmp_path / "venv" / "lib").glob("python*")) / "site-packages"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    code = (
        "import importlib.util as u, importlib.metadata as m, factorgrasp.solvers.base, factorgrasp.solvers.registry;"
        "bare = [n for n in ('problems', 'solvers', 'tests', 'benchmarks', 'examples') if u.find_spec(n)];"
        "entry, = [e for e in m.entry_points(group='console_scripts') if e.name == 'factorgrasp'];"
        "print(bare, entry.value, factorgrasp.solvers.__file__)"
    )
    # The dependencies come from the environment of the tests, behind the new one.
    libraries = os.pathsep.join(path for path in sys.path if path.endswith("site-packages"))
    done = subprocess.run(
        [python, "-c", f"import sys; sys.path += {libraries.split(os.pathsep)!r}; {code}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={key: value for key, value in os.environ.items() if key != "PYTHONPATH"},
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == f"[] factorgrasp.cli:main {site / 'factorgrasp/solvers/__init__.py'}"


def test_folders_are_relative_links() -> None:
    links = {name: ROOT / "factorgrasp" / name for name in ("problems", "solvers")}
    if not any(path.is_symlink() for path in links.values()):
        pytest.skip("not a checkout: a source archive holds the folders themselves")
    assert {name: os.readlink(path) for name, path in links.items()} == {
        "problems": "../problems",
        "solvers": "../solvers",
    }


def test_constraints_pin_every_dependency_and_nothing_else() -> None:
    lines = [
        line
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if line and not line.startswith("#")
    ]
    pins = {}
    for line in lines:
        match = re.fullmatch(r"([a-z0-9-]+)==([A-Za-z0-9.+]+)", line)
        assert match, f"not a plain pin: {line}"
        pins[match[1]] = match[2]
    assert len(pins) == len(lines)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [
        *project["dependencies"],
        *(item for extra in project["optional-dependencies"].values() for item in extra),
    ]
    names = {re.split(r"[\[<>=; ]", item)[0] for item in wanted} - {"factorgrasp"}
    assert names <= set(pins)

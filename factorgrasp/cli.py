"""The command line. It holds no mathematics: it reads, calls the library, prints, and answers with an exit code.

Exit codes, on which other programs rely: 0 solved; 1 not solved (what was found is still written, with the reason);
2 bad input or usage (one line says which, and nothing is written); 3 a defect of factorgrasp (a traceback).
"""

from __future__ import annotations

import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console

from factorgrasp.errors import FactorgraspError, InputError, NotSolvedError

if TYPE_CHECKING:
    from factorgrasp.solvers.base import Capabilities
    from factorgrasp.solvers.compare import Comparison

SOLVED, NOT_SOLVED, BAD_INPUT, DEFECT = 0, 1, 2, 3

EXAMPLE = """\
kind = "grasp_pose"

[robot]
file = "robot.csv"       # columns t,px,py,pz,qw,qx,qy,qz
                         # or t,wx,wy,wz,ax,ay,az for an IMU on the robot
                         # or t,q1..qn with urdf = "..." and frame = "..."
gravity = [0, 0, -9.81]  # in the robot's world frame; optional

[hand]
file = "imu.csv"         # columns t,wx,wy,wz,ax,ay,az

[noise]                  # every entry optional
gyro_density = 5e-4      # rad/s/sqrt(Hz)

[estimate]               # every entry optional
time_offset = true
"""

_EPILOG = (
    "A problem file (TOML; SI units, rad, quaternions w first; paths relative to the file):\n\n"
    + EXAMPLE.replace("[", "\\[")
    + '\nOther kinds: "human_dynamics", "wrist_pose", "excitation"; docs/problem-files.md names every key.\n'
    + "\nExit codes: 0 solved, 1 not solved (the reason is printed and written), 2 bad input."
)

app = typer.Typer(
    name="factorgrasp",
    help="Estimation in physical human-robot interaction: from recordings to estimates with honest covariances.",
    epilog=_EPILOG,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_out = Console(highlight=False, markup=False, soft_wrap=True)
_err = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)

FileArgument = Annotated[Path, typer.Argument(metavar="FILE.toml", help="Problem file.", show_default=False)]
FilesArgument = Annotated[
    list[Path], typer.Argument(metavar="FILE.toml...", help="Problem files.", show_default=False)
]


def main() -> NoReturn:
    """Entry point of the command; ends the process with its exit code."""
    try:
        app()
    except Exception:
        # What is not a mistake of the user's is one of ours, and must not look like "not solved".
        traceback.print_exc()
        _err.print("factorgrasp: this is a defect; please report it with the lines above")
        sys.exit(DEFECT)
    sys.exit(SOLVED)


def _print_version(wanted: bool) -> None:
    if wanted:
        from factorgrasp import __version__

        _out.print(f"factorgrasp {__version__}")
        raise typer.Exit(SOLVED)


@app.callback()
def _options(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Options of the command as a whole."""


@app.command("solve")
def solve_command(
    file: FileArgument,
    solver: Annotated[
        str | None,
        typer.Option(help="One of `factorgrasp solvers`; by default the file's, or the best that fits."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Where results go. \\[default: results/<name of FILE>]", show_default=False
        ),
    ] = None,
    export: Annotated[
        str | None,
        typer.Option(
            metavar="csv,parquet",
            help="Also write the table over time (human dynamics) as estimate.csv, estimate.parquet.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Solve a problem file: prints the answer and writes estimate.json, estimate.npz and report.html."""
    with _exit_codes():
        from factorgrasp.results import export_forms, export_tables

        forms = () if export is None else export_forms(export)
        place = out or Path("results") / file.stem
        estimate = _solve(file, solver, place)
        for path in export_tables(estimate, place, forms) if forms else ():
            _out.print(f"wrote {path}")
        _finish(estimate)


@app.command("demo")
def demo_command(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the recording and the results go.")] = Path(
        "demo"
    ),
) -> None:
    """Simulate a grasp recording, solve it from disk, and compare with the truth."""
    with _exit_codes():
        from factorgrasp.demo import truth_table, write_demo

        _check_folder(out)
        with _working(f"simulating a recording into {out}"):
            file = write_demo(out)
        _out.print(f"$ factorgrasp solve {file} --out {out}\n")
        estimate = _solve(file, None, out)
        _out.print("\n" + truth_table(estimate, out).text())
        _out.print(f"open {out / 'report.html'} in a browser")
        _finish(estimate)


@app.command("compare")
def compare_command(
    files: FilesArgument,
    solvers: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,...",
            help="Names from `factorgrasp solvers`. \\[default: all that are installed]",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Also write comparison.json, .csv and .md there.", show_default=False
        ),
    ] = None,
) -> None:
    """Solve problem files with several solvers, and compare claims, accuracy and time."""
    with _exit_codes():
        if out is not None:
            _check_folder(out)
        comparison = _compare(files, None if solvers is None else _names(solvers))
        _out.print(comparison.text())
        if len(files) > 1:
            _out.print("\n" + comparison.summary().text())
        if out is not None:
            from factorgrasp.results import write_comparison

            _out.print("\n" + "\n".join(f"wrote {path}" for path in write_comparison(comparison, out)))
        solved = {row.problem for row in comparison.rows if row.status == "solved"}
        unsolved = [str(file) for file in files if str(file) not in solved]
        if unsolved:
            _err.print(f"not solved by any solver: {', '.join(unsolved)}")
            raise typer.Exit(NOT_SOLVED)


def _compare(files: list[Path], solvers: list[str] | None) -> Comparison:
    """Compare file by file, so that one can see how far it is."""
    from factorgrasp import compare
    from factorgrasp.problem_file import load_problem
    from factorgrasp.solvers.registry import solver_class

    for name in solvers or ():
        solver_class(name)
    stated = []
    for file in files:
        with _working(f"reading {file}"):
            stated.append(load_problem(file))
    parts = []
    for number, each in enumerate(stated, start=1):
        with _working(f"comparing solvers on {each.path} ({number} of {len(stated)})"):
            parts.append(compare({str(each.path): each.problem}, solvers))
    return replace(parts[0], rows=tuple(row for part in parts for row in part.rows))


def _names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise InputError("--solvers", "names of solvers with commas between them", repr(text))
    return names


@app.command("solvers")
def solvers_command() -> None:
    """List the solvers: what is installed, what each one takes, and how to install the others."""
    from factorgrasp.solvers.registry import solver_table
    from factorgrasp.tables import Column, Table

    columns = (Column("name", "solver"), Column("here"), Column("takes"), Column("pip", "to install"))
    rows = [
        {
            "name": row.name,
            "here": row.installed,
            "takes": _takes(row.capabilities),
            "pip": None if row.installed else row.pip,
        }
        for row in solver_table()
    ]
    _out.print(Table(columns, tuple(rows)).text())


def _takes(capabilities: Capabilities) -> str:
    words = {
        "equalities": capabilities.equalities,
        "inequalities": capabilities.inequalities,
        "nonlinear": capabilities.nonlinear,
        "warm start": capabilities.warm_start,
        "nonlinear programs": capabilities.program,
    }
    return ", ".join(word for word, there in words.items() if there)


def _solve(file: Path, solver: str | None, out: Path) -> Any:
    """Solve one file, print the answer and write it into a folder."""
    from factorgrasp.problem_file import load_problem
    from factorgrasp.results import write_all

    _check_folder(out)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        with _working(f"reading {file}"):
            stated = load_problem(file)
        with _working("solving"):
            estimate = stated.solve(solver)
    remarks = list(dict.fromkeys(str(warning.message) for warning in caught))
    for remark in remarks:
        _err.print(f"warning: {remark}")
    with _working(f"writing the report into {out}"):
        written = write_all(estimate, out, title=stated.title, source=str(file), remarks=remarks)
    _out.print(estimate.summary())
    _out.print("\n" + "\n".join(f"wrote {path}" for path in written))
    return estimate


def _finish(estimate: Any) -> None:
    """End with the exit code of an estimate's status."""
    if not estimate.status.ok:
        _err.print(f"not solved ({estimate.status.value}): {estimate.message}")
        raise typer.Exit(NOT_SOLVED)


def _check_folder(out: Path) -> None:
    """Refuse a place for the results that cannot be one, before any work is done."""
    for place in (out, *out.parents):
        if place.exists():
            if not place.is_dir():
                raise InputError("--out", "a folder", f"{place} is a file")
            return


@contextmanager
def _working(what: str) -> Iterator[None]:
    """Say on standard error what takes time: a spinner in a terminal, else one line."""
    if _err.is_terminal:
        with _err.status(what):
            yield
    else:
        _err.print(f"{what} ...")
        yield


@contextmanager
def _exit_codes() -> Iterator[None]:
    """Turn the library's errors into one line and an exit code."""
    try:
        yield
    except NotSolvedError as error:
        _err.print(f"not solved: {error}")
        raise typer.Exit(NOT_SOLVED) from None
    except BrokenPipeError:
        raise
    except (FactorgraspError, OSError) as error:
        _err.print(f"error: {error}")
        raise typer.Exit(BAD_INPUT) from None

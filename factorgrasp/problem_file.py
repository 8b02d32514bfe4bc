"""Problem files: a TOML file says which problem it is (`kind`), where the recordings are and what is assumed."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias, cast

from factorgrasp.errors import InputError
from factorgrasp.problem import Problem
from factorgrasp.threads import one_blas_thread
from factorgrasp.toml_tables import close_matches, describe

SOLVER_TABLES = ("excitation",)
"""Kinds whose file may have a table [solver], with the name in it, in place of the name alone."""

Builder: TypeAlias = Callable[[Mapping[str, Any], Path], Problem]
"""Makes the problem from the tables of its file, and the folder that the file's paths are relative to."""

KINDS: dict[str, str] = {
    "grasp_pose": "factorgrasp.grasp_file:build",
    "human_dynamics": "factorgrasp.human_dynamics_file:build",
    "excitation": "factorgrasp.excitation_file:build",
    "wrist_pose": "factorgrasp.wrist_file:build",
}
"""``"module:function"`` of the builder of every kind, imported when it is needed."""

COMMON_KEYS = ("kind", "title", "solver")
"""Keys that every problem file may have; the builder gets the others."""


@dataclass(frozen=True)
class ProblemFile:
    """A problem as a file states it.

    Attributes
    ----------
    path : Path
    kind : str
    problem : Problem
        Ready for :func:`factorgrasp.solve`.
    title : str
        What the recording is called in a report; empty when the file does not say.
    solver : str or None
        The solver that the file asks for; None leaves the choice to :func:`factorgrasp.solve`.
    """

    path: Path
    kind: str
    problem: Problem
    title: str = ""
    solver: str | None = None

    @one_blas_thread()
    def solve(self, solver: str | None = None) -> Any:
        """The typed view of the estimate; `solver` goes before the one that the file asks for."""
        chosen = solver or self.solver
        own = getattr(self.problem, "solve", None)
        if own is not None:
            # A recording of many frames is not one least-squares problem.
            return own(chosen)
        from factorgrasp import solve

        return solve(self.problem, solver=chosen)


def load_problem(path: str | os.PathLike[str]) -> ProblemFile:
    """Read a problem file and everything that it refers to.

    Parameters
    ----------
    path : path
        A TOML file; paths inside it are relative to its folder.

    Raises
    ------
    InputError
        Naming the file and the key.
    """
    file = Path(path)
    table = read_toml(file)
    try:
        kind = _required_kind(table)
        rest = {key: value for key, value in table.items() if key not in COMMON_KEYS}
        if kind in SOLVER_TABLES and isinstance(table.get("solver"), Mapping):
            rest["solver"] = table["solver"]
            table = {**table, "solver": table["solver"].get("name", "")}
        words = {key: _string(table, key) for key in ("title", "solver") if table.get(key, "") != ""}
        problem = _builder(kind)(rest, file.parent)
    except InputError as error:
        raise InputError(f"{file}: {error.field}", error.expected, error.found, error.hint) from error
    return ProblemFile(file, kind, problem, words.get("title", ""), words.get("solver"))


def read_toml(file: Path) -> dict[str, Any]:
    """The content of a TOML file.

    Raises
    ------
    InputError
        When it is missing or not TOML.
    """
    try:
        return tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise InputError(str(file), "a problem file (TOML)", "no such file") from None
    except IsADirectoryError:
        raise InputError(str(file), "a problem file (TOML)", "a folder") from None
    except UnicodeDecodeError:
        raise InputError(str(file), "a problem file (TOML, UTF-8)", "a file that is not UTF-8 text") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(file), "TOML", str(error)) from None


def _required_kind(table: Mapping[str, Any]) -> str:
    if "kind" not in table:
        raise InputError(
            "kind", "one of " + ", ".join(map(repr, KINDS)), "no such key", 'Add kind = "grasp_pose"'
        )
    kind = _string(table, "kind")
    if kind not in KINDS:
        raise InputError(
            "kind", "one of " + ", ".join(map(repr, KINDS)), repr(kind), close_matches(kind, KINDS)
        )
    return kind


def _string(table: Mapping[str, Any], key: str) -> str:
    value = table[key]
    if not isinstance(value, str):
        raise InputError(key, "a string", describe(value))
    return value


def _builder(kind: str) -> Builder:
    module, _, name = KINDS[kind].partition(":")
    return cast(Builder, getattr(import_module(module), name))

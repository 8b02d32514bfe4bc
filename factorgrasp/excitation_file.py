"""The tables of a problem file with ``kind = "excitation"``: ``[evaluate]`` measures a trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factorgrasp.excitation_evaluate import build_evaluation


def build(table: Mapping[str, Any], base_dir: Path) -> Any:
    """The problem of an excitation file."""
    return build_evaluation(table, base_dir)

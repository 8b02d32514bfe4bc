"""What a solve leaves in a folder: ``estimate.json``, ``estimate.npz`` and ``report.html``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgrasp.atomic import replacing, write_text
from factorgrasp.typing import FloatArray, JsonDict

if TYPE_CHECKING:
    from factorgrasp.solvers.compare import Comparison

JSON_NAME, NPZ_NAME, REPORT_NAME = "estimate.json", "estimate.npz", "report.html"


def write_result(directory: Path, record: JsonDict, arrays: Mapping[str, FloatArray]) -> Path:
    """Write ``estimate.json`` and ``estimate.npz``, each atomically; returns the path of the first.

    Parameters
    ----------
    directory : Path
        Made if missing; files of these names in it are replaced.
    record : dict
        Plain numbers, strings, lists and dicts. What is not finite becomes null: JSON has no other word for "unknown".
    arrays : mapping of str to ndarray
    """
    with replacing(directory / NPZ_NAME) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **dict(arrays))  # type: ignore[arg-type]  # its stubs take the options for names, too
    # The JSON comes last: whoever finds it finds the arrays.
    text = json.dumps(finite(record), indent=2, allow_nan=False, ensure_ascii=False)
    return write_text(directory / JSON_NAME, text + "\n")


def write_comparison(comparison: Comparison, directory: Path) -> list[Path]:
    """Write a comparison of solvers as ``comparison.json``, ``.csv`` and ``.md``, each atomically; returns the paths."""
    forms = {".json": comparison.json, ".csv": comparison.csv, ".md": comparison.markdown}
    return [write_text(directory / f"comparison{suffix}", made()) for suffix, made in forms.items()]


def finite(value: Any) -> Any:
    """The same record with None where a number is NaN or infinite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return value


def write_all(
    estimate: Any, directory: Path, title: str = "", source: str = "", remarks: Sequence[str] = ()
) -> list[Path]:
    """Write the numbers and the report of an estimate (or of the typed view of one); returns the paths.

    Parameters
    ----------
    estimate : Estimate or the typed view of one
    directory : Path
    title : str
        What the recording is called in the report.
    source : str
        The problem file, as provenance.
    remarks : sequence of str
        Warnings that came up, for the report.
    """
    from factorgrasp.report import write_report

    # A page of an earlier solve must not stand beside the numbers of this one, whatever happens in between.
    (directory / REPORT_NAME).unlink(missing_ok=True)
    estimate.save(directory)
    report = write_report(estimate, directory / REPORT_NAME, title, source, remarks)
    more = [directory / name for name in getattr(estimate, "files", ())]
    return [directory / JSON_NAME, directory / NPZ_NAME, *more, report]

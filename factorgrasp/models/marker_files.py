"""Marker layouts on disk: JSON with ``names``, ``points`` (n, 3) in m and ``covariance`` (3n, 3n) in m^2."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.atomic import write_text
from factorgrasp.errors import InputError
from factorgrasp.models.markers import MarkerLayout


def write_layout(path: str | Path, layout: MarkerLayout, **more: Any) -> Path:
    """Write a layout atomically; `more` are further entries for the reader's information."""
    content = {
        "kind": "marker_layout",
        "names": list(layout.names),
        "points": layout.points.tolist(),
        "covariance": layout.covariance.tolist(),
        **more,
    }
    return write_text(Path(path), json.dumps(content, indent=1) + "\n")


def read_layout(path: str | Path) -> MarkerLayout:
    """A layout that :func:`write_layout` wrote, or that of the ``estimate.json`` of a wrist recording.

    Raises
    ------
    InputError
        When the file is none, or its numbers are not those of a layout.
    """
    file = Path(path)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        content = content.get("layout", content)
        names, points = tuple(content["names"]), np.array(content["points"], dtype=float)
        covariance = np.array(content.get("covariance", []), dtype=float)
    except FileNotFoundError:
        raise InputError(str(file), "a marker layout (JSON)", "no such file") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            str(file),
            "a marker layout: JSON with names, points and covariance",
            f"{type(error).__name__}: {error}",
        ) from error
    try:
        return MarkerLayout(names, points, covariance if covariance.size else np.zeros((0, 0)))
    except InputError as error:
        raise InputError(f"{file}: {error.field}", error.expected, error.found, error.hint) from error

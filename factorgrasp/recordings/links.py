"""Archives of link-level arrays (``links_*.npz``): the forces and the coordinates beside the motion in them.

The motion itself is read by :func:`factorgrasp.problems.link_motion_files.load_links`.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.recordings.forces import ForceRecording
from factorgrasp.recordings.opensim import CoordinateTable
from factorgrasp.recordings.tables import PathLike
from factorgrasp.typing import FloatArray


def has_link_forces(path: PathLike) -> bool:
    """Whether an archive holds the forces that :func:`read_link_forces` reads."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return "grf" in archive and "grf_body" in archive
    except (ValueError, OSError, EOFError, zipfile.BadZipFile):
        return False


def read_link_forces(path: PathLike) -> tuple[ForceRecording, ...]:
    """Forces from the fields ``grf`` (n, plates, 9) ``[force, point, moment]`` in ground axes and ``grf_body`` (plates,).

    Raises
    ------
    InputError
        When there are no such fields, or of another shape.
    """
    data = _fields(path, ("t", "grf", "grf_body"))
    grf, bodies = np.asarray(data["grf"], dtype=float), [str(name) for name in data["grf_body"]]
    if grf.ndim != 3 or grf.shape[1:] != (len(bodies), 9):
        raise InputError(f"{path}: grf", f"shape (n, {len(bodies)}, 9)", str(grf.shape))
    t = np.asarray(data["t"], dtype=float)
    return tuple(
        ForceRecording(t, grf[:, k, :3], grf[:, k, 3:6], grf[:, k, 6:], body, f"plate {k + 1} on {body}")
        for k, body in enumerate(bodies)
    )


def read_link_coordinates(path: PathLike) -> tuple[CoordinateTable, FloatArray, FloatArray]:
    """Coordinates from the fields ``names, Q, dQ, ddQ``, in rad and m: the table, velocities (n, c) and accelerations (n, c)."""
    data = _fields(path, ("t", "names", "Q", "dQ", "ddQ"))
    names = tuple(str(name) for name in data["names"])
    t = np.asarray(data["t"], dtype=float)
    values = []
    for key in ("Q", "dQ", "ddQ"):
        array = np.asarray(data[key], dtype=float)
        if array.shape != (t.size, len(names)):
            raise InputError(f"{path}: {key}", f"shape ({t.size}, {len(names)})", str(array.shape))
        values.append(array)
    lengths = tuple(name for name in names if name.endswith(("_tx", "_ty", "_tz")))
    return CoordinateTable(t, names, values[0], lengths), values[1], values[2]


def _fields(path: PathLike, needed: tuple[str, ...]) -> dict[str, np.ndarray]:
    file = Path(path)
    if not file.is_file():
        raise InputError(str(file), "an archive of link-level arrays (.npz)", "no such file")
    try:
        with np.load(file, allow_pickle=False) as archive:
            missing = [name for name in needed if name not in archive]
            if missing:
                raise InputError(
                    str(file), "the fields " + ", ".join(needed), ", ".join(missing) + " missing"
                )
            return {name: archive[name] for name in needed}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(str(file), "an archive of numpy arrays (.npz)", str(error)) from error

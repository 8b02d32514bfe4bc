"""Marker trajectories as a .trc file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from factorgrasp.atomic import write_text
from factorgrasp.errors import InputError
from factorgrasp.recordings.tables import PathLike


def write_trc(path: PathLike, t: npt.ArrayLike, names: Sequence[str], position: npt.ArrayLike) -> Path:
    """Write markers, in mm, atomically; returns the path. A marker that was not seen (NaN) is an empty field.

    Parameters
    ----------
    path : path
    t : (n,) array_like
        s.
    names : sequence of str
    position : (n, m, 3) array_like
        m.
    """
    stamps, points = np.asarray(t, dtype=float), np.asarray(position, dtype=float)
    if points.shape != (stamps.size, len(names), 3) or stamps.size < 2:
        raise InputError(
            "position of the markers", f"shape ({stamps.size}, {len(names)}, 3)", str(points.shape)
        )
    file = Path(path)
    rate = f"{1.0 / float(np.median(np.diff(stamps))):.6g}"
    count, markers = stamps.size, len(names)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{file.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{count}\t{markers}\tmm\t{rate}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t\t",
        "\t\t" + "\t".join(f"{axis}{k}" for k in range(1, markers + 1) for axis in "XYZ"),
        "",
    ]
    for k, row in enumerate(1000.0 * points.reshape(count, -1)):
        cells = "\t".join(f"{value:.5f}" if np.isfinite(value) else "" for value in row)
        lines.append(f"{k + 1}\t{stamps[k]:.6f}\t{cells}")
    return write_text(file, "\n".join(lines) + "\n")

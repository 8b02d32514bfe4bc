"""Unlabelled blobs of a video: pixel positions with or without depth, frame by frame."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgrasp.atomic import write_text
from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.recordings import _validate
from factorgrasp.recordings.tables import PathLike, read_table
from factorgrasp.typing import FloatArray, IntArray

FARTHEST = 20.0
"""m: no depth camera sees a hand further away; a larger number is in millimetres."""
MOST_MISSING = 100_000


@dataclass(frozen=True, eq=False)
class BlobFrame:
    """The blobs of one frame.

    Attributes
    ----------
    t : float
        s.
    uv : (m, 2) ndarray
        px.
    depth : (m,) ndarray
        Along the optical axis, m; NaN where it is not known.
    covariance_uv : (m, 2, 2) ndarray or None
        px^2.
    covariance_depth : (m,) ndarray or None
        m^2.
    """

    t: float
    uv: FloatArray
    depth: FloatArray
    covariance_uv: FloatArray | None = None
    covariance_depth: FloatArray | None = None

    def __len__(self) -> int:
        return int(self.uv.shape[0])


@dataclass(frozen=True, eq=False)
class BlobRecording:
    """Blobs of a whole recording, sorted by frame.

    Attributes
    ----------
    t : (n,) ndarray
        Time of every frame, s; frames without blobs included.
    frame : (m,) ndarray of int
        Index into `t` of every blob, not decreasing.
    uv : (m, 2) ndarray
        px, the centre of the first pixel is (0, 0).
    depth : (m,) ndarray
        Along the optical axis, m; NaN where it is missing.
    covariance_uv : (m, 2, 2) ndarray or None
        px^2, of every centroid; None: the noise of the problem holds for all.
    covariance_depth : (m,) ndarray or None
        m^2.
    label : (m,) ndarray of int or None
        The true marker, for simulations: 0 clutter, 1..n the markers in the order of the layout. Estimators never read it.
    name : str

    Raises
    ------
    InputError
        When shapes do not fit, frames are out of order, or a number is not one.
    """

    t: FloatArray
    frame: IntArray
    uv: FloatArray
    depth: FloatArray
    covariance_uv: FloatArray | None = None
    covariance_depth: FloatArray | None = None
    label: IntArray | None = None
    name: str = "blobs"

    def __post_init__(self) -> None:
        t = _validate.times(self.t, f"{self.name}: t")
        frame = np.array(self.frame, dtype=np.intp)
        count = frame.size
        uv, depth = np.array(self.uv, dtype=float).reshape(-1, 2), np.array(self.depth, dtype=float)
        if frame.ndim != 1 or uv.shape != (count, 2) or depth.shape != (count,):
            raise InputError(
                f"{self.name}",
                "frame (m,), uv (m, 2) and depth (m,)",
                f"{frame.shape}, {uv.shape} and {depth.shape}",
            )
        if count and (frame.min() < 0 or frame.max() >= t.size):
            raise InputError(
                f"{self.name}: frame", f"indices of {t.size} frames", f"{frame.min()} to {frame.max()}"
            )
        if np.any(np.diff(frame) < 0):
            row = int(np.argmax(np.diff(frame) < 0)) + 1
            raise InputError(
                f"{self.name}: frame",
                "frames in order",
                f"frame {frame[row]} after frame {frame[row - 1]} (blob {row}, counted from 0)",
                "Sort the blobs by frame",
            )
        if not np.all(np.isfinite(uv)):
            row = int(np.argmin(np.isfinite(uv).all(axis=1)))
            raise InputError(
                f"{self.name}: u, v",
                "finite pixels; a frame without blobs has none",
                f"NaN or infinity in blob {row}",
            )
        depth[depth == 0.0] = np.nan  # what depth cameras write where they see nothing
        if np.any(np.isinf(depth)) or np.any(depth < 0.0):
            raise InputError(
                f"{self.name}: depth", "metres above zero, or NaN where missing", f"{np.nanmin(depth):g} m"
            )
        known = depth[np.isfinite(depth)]
        if known.size and np.median(known) > FARTHEST:
            raise InputError(
                f"{self.name}: depth",
                "metres",
                f"a median of {np.median(known):g}",
                "Millimetres? Name the column 'z [mm]'",
            )
        for key, value in (("t", t), ("frame", frame), ("uv", uv), ("depth", depth)):
            value.setflags(write=False)
            object.__setattr__(self, key, value)
        shapes = {"covariance_uv": (count, 2, 2), "covariance_depth": (count,), "label": (count,)}
        for key, shape in shapes.items():
            given = getattr(self, key)
            if given is None:
                continue
            array = np.array(given, dtype=np.intp if key == "label" else float)
            if array.shape != shape:
                raise InputError(f"{self.name}: {key}", f"shape {shape}", str(array.shape))
            if key != "label" and not np.all(np.isfinite(array)):
                raise InputError(f"{self.name}: {key}", "finite variances", "NaN or infinity")
            array.setflags(write=False)
            object.__setattr__(self, key, array)
        object.__setattr__(self, "_starts", np.searchsorted(frame, np.arange(t.size + 1)))

    def __len__(self) -> int:
        """Number of frames."""
        return int(self.t.size)

    @property
    def counts(self) -> IntArray:
        """(n,) blobs in every frame."""
        return np.diff(self._starts)  # type: ignore[attr-defined,no-any-return]

    def rows(self, k: int) -> slice:
        """Blobs of frame k as a slice of the blob arrays."""
        starts = self._starts  # type: ignore[attr-defined]
        return slice(int(starts[k]), int(starts[k + 1]))

    def at(self, k: int) -> BlobFrame:
        """The blobs of frame k."""
        rows = self.rows(k)
        return BlobFrame(
            float(self.t[k]),
            self.uv[rows],
            self.depth[rows],
            None if self.covariance_uv is None else self.covariance_uv[rows],
            None if self.covariance_depth is None else self.covariance_depth[rows],
        )

    def check_camera(self, camera: Camera) -> None:
        """Raise InputError when the blobs cannot be of this camera: outside of its image, or columns u and v swapped."""
        if not self.uv.size:
            return
        outside = ~camera.inside(self.uv, margin=-2.0)
        if not outside.any():
            return
        row = int(np.argmax(outside))
        swapped = bool(np.all(camera.inside(self.uv[:, ::-1], margin=-2.0)))
        hint = (
            "Are the columns u and v swapped?"
            if swapped
            else "Are the resolution and the intrinsics those of these images?"
        )
        raise InputError(
            f"{self.name}: u, v",
            f"pixels within the image of {camera.width} x {camera.height}",
            f"{int(outside.sum())} of {outside.size} blobs outside, the first at ({self.uv[row, 0]:g}, {self.uv[row, 1]:g})",
            hint,
        )


def read_blobs(path: PathLike, camera: Camera | None = None) -> BlobRecording:
    """Blobs from a table (CSV, NPZ, Parquet) with columns ``frame, t, u, v`` and optionally ``z, var_u, cov_uv, var_v, var_z, label``.

    One row a blob. A frame without blobs is a row with empty u and v, or is simply absent: frame numbers that are missing between the
    first and the last become frames without blobs, their times interpolated. An empty (or zero) z is a missing depth.

    Parameters
    ----------
    path : path
    camera : Camera, optional
        Checks that the blobs are within its image.

    Raises
    ------
    InputError
        For missing columns, frames out of order, one frame with two times, a u without v, blobs outside of the image.
    """
    file = Path(path)
    table = read_table(file, ("frame", "t", "u", "v"), ("z", "var_u", "cov_uv", "var_v", "var_z", "label"))
    number, t = table["frame"], table["t"]
    if not np.all(np.isfinite(number)) or np.any(number != np.round(number)):
        raise InputError(
            f"{file}: column frame", "whole numbers", "another value, or none", "Is it the time?"
        )
    steps = np.diff(number)
    if np.any(steps < 0):
        row = int(np.argmax(steps < 0)) + 1
        raise InputError(
            f"{file}: column frame",
            "frames in order",
            f"frame {number[row]:g} after frame {number[row - 1]:g} (row {row}, counted from 0)",
            "Sort the rows by frame",
        )
    if np.any((steps == 0) & (np.diff(t) != 0.0)):
        row = int(np.argmax((steps == 0) & (np.diff(t) != 0.0))) + 1
        raise InputError(
            f"{file}: column t", "one time for all blobs of a frame", f"two for frame {number[row]:g}"
        )
    first, last = int(number[0]), int(number[-1])
    present, where = np.unique(number.astype(np.intp) - first, return_index=True)
    if last - first + 1 - present.size > MOST_MISSING:
        raise InputError(f"{file}: column frame", "numbers of successive frames", f"{first} to {last}")
    whole = np.isfinite(table["u"])
    if np.any(whole != np.isfinite(table["v"])):
        row = int(np.argmax(whole != np.isfinite(table["v"])))
        raise InputError(
            f"{file}: columns u, v", "both or none", f"one of them in row {row} (counted from 0)"
        )
    times = np.interp(np.arange(last - first + 1), present, t[where])
    times[present] = t[where]
    covariance = None
    if "var_u" in table and "var_v" in table:
        off = table.get("cov_uv", np.zeros_like(t))
        rows = np.array([[table["var_u"], off], [off, table["var_v"]]])
        covariance = np.moveaxis(rows, -1, 0)[whole]
    try:
        out = BlobRecording(
            t=times,
            frame=(number.astype(np.intp) - first)[whole],
            uv=np.stack([table["u"], table["v"]], axis=-1)[whole],
            depth=table.get("z", np.full_like(t, np.nan))[whole],
            covariance_uv=covariance,
            covariance_depth=table["var_z"][whole] if "var_z" in table else None,
            label=np.asarray(table["label"][whole], dtype=np.intp) if "label" in table else None,
            name=str(file),
        )
    except InputError:
        raise
    if camera is not None:
        out.check_camera(camera)
    return out


def write_blobs(path: PathLike, blobs: BlobRecording) -> Path:
    """Write what :func:`read_blobs` reads, atomically; a frame without blobs is a row with empty u and v."""
    names = ["frame", "t", "u", "v", "z"]
    if blobs.covariance_uv is not None:
        names += ["var_u", "cov_uv", "var_v"]
    if blobs.covariance_depth is not None:
        names += ["var_z"]
    if blobs.label is not None:
        names += ["label"]
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(names)
    for k in range(len(blobs)):
        rows = blobs.rows(k)
        head = [k, repr(float(blobs.t[k]))]
        if rows.start == rows.stop:
            out.writerow([*head, *[""] * (len(names) - 2)])
        for i in range(rows.start, rows.stop):
            cells: list[object] = [*head, *(repr(float(x)) for x in blobs.uv[i])]
            cells.append("" if np.isnan(blobs.depth[i]) else repr(float(blobs.depth[i])))
            if blobs.covariance_uv is not None:
                C = blobs.covariance_uv[i]
                cells += [repr(float(x)) for x in (C[0, 0], C[0, 1], C[1, 1])]
            if blobs.covariance_depth is not None:
                cells.append(repr(float(blobs.covariance_depth[i])))
            if blobs.label is not None:
                cells.append(int(blobs.label[i]))
            out.writerow(cells)
    return write_text(Path(path), text.getvalue())

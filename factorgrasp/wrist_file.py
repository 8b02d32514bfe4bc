"""The tables of a problem file with ``kind = "wrist_pose"``: [camera], [blobs], [markers], [association], [noise], [estimate]."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.kinematics.angles import Facing, Hand
from factorgrasp.lie import quaternion_wxyz_to_matrix
from factorgrasp.models.camera import Camera
from factorgrasp.models.marker_files import read_layout as read_stored
from factorgrasp.models.markers import PALM_NAMES, MarkerLayout
from factorgrasp.problems.wrist_settings import WristAssociation, WristNoise, WristSettings
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.recordings.blobs import BlobRecording, read_blobs
from factorgrasp.toml_tables import check_keys, convert, describe, from_table, get, place, sub_table
from factorgrasp.wrist_task import WristTask

TABLES = ("camera", "blobs", "markers", "association", "noise", "estimate")

_Vector = tuple[float, float, float]
_METHODS = {
    "map": "blob", "blob": "blob", "hungarian": "assignment", "assignment": "assignment", "jcbb": "joint", "joint": "joint",
}  # fmt: skip
_NOISE_ALIASES = {
    "calibration": "calibration_sd",
    "acceleration_density": "translation_density",
    "angular_acceleration_density": "rotation_density",
}


def build(table: Mapping[str, Any], base_dir: Path) -> WristTask:
    """The wrist-pose problem of a problem file.

    Parameters
    ----------
    table : mapping
        The tables of the file.
    base_dir : Path
        Folder that its paths are relative to.

    Raises
    ------
    InputError
        Naming the table and the key, or the recording and the column.
    """
    check_keys(table, TABLES, "")
    blobs_table = sub_table(table, "blobs", required=True)
    markers_table = sub_table(table, "markers", required=True)
    # Cheap mistakes first: a wrong switch is said before a long recording is read.
    camera, camera_pose = read_camera(sub_table(table, "camera", required=True))
    association = _association(sub_table(table, "association"))
    noise = _noise(sub_table(table, "noise"))
    estimate = dict(sub_table(table, "estimate"))
    method = get(estimate, "method", Literal["batch", "fixed_lag", "filter"], "[estimate]", "batch")
    hand = get(estimate, "hand", Literal["right", "left"], "[estimate]", "right")
    settings = from_table(
        WristSettings,
        {key: value for key, value in estimate.items() if key not in ("method", "hand")},
        "[estimate]",
    )
    facing = get(markers_table, "facing", Literal["back", "palm"], "[markers]", "back")
    layout = read_layout(markers_table, base_dir)
    blobs, remarks = read_blob_source(blobs_table, base_dir, camera)
    if layout is None:
        names = get(markers_table, "names", tuple[str, ...], "[markers]", None)
        layout, more = _calibrated(blobs, camera, hand, facing, names)
        remarks = (*remarks, *more)
    return WristTask(
        camera,
        blobs,
        layout,
        association=association,
        noise=noise,
        settings=settings,
        camera_pose=camera_pose,
        method=method,
        hand=hand,
        facing=facing,
        remarks=remarks,
    )


def read_camera(table: Mapping[str, Any]) -> tuple[Camera, CameraPose | None]:
    """[camera]: intrinsics, and where ``W0`` is seen from it when that is known."""
    where = "[camera]"
    keys = (
        "fx", "fy", "cx", "cy", "matrix", "intrinsics", "distortion", "resolution", "rate", "rotation_wxyz", "position",
    )  # fmt: skip
    check_keys(table, keys, where)
    width, height = get(table, "resolution", tuple[int, int], where)
    matrix = [key for key in ("matrix", "intrinsics") if key in table]
    if matrix:
        for key in ("fx", "fy", "cx", "cy"):
            if key in table:
                raise InputError(place(where, key), f"either this or {matrix[0]}", "both")
        K = _matrix(table[matrix[0]], place(where, matrix[0]))
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    else:
        fx, fy, cx, cy = (get(table, key, float, where) for key in ("fx", "fy", "cx", "cy"))
    distortion = get(table, "distortion", tuple[float, ...], where, ())
    rate = get(table, "rate", float, where, 30.0)
    try:
        camera = Camera(float(fx), float(fy), float(cx), float(cy), width, height, tuple(distortion), rate)
    except InputError as error:
        raise InputError(
            error.field.replace("camera:", where), error.expected, error.found, error.hint
        ) from error
    return camera, _camera_pose(table, where)


def _matrix(value: Any, field: str) -> np.ndarray:
    rows = convert(value, tuple[_Vector, _Vector, _Vector], field)
    K = np.array(rows)
    if np.any(K[[0, 1, 2, 2], [1, 0, 0, 1]] != 0.0) or K[2, 2] != 1.0:
        raise InputError(field, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", describe(value))
    return K


def _camera_pose(table: Mapping[str, Any], where: str) -> CameraPose | None:
    given = [key for key in ("rotation_wxyz", "position") if key in table]
    if not given:
        return None
    q = np.array(get(table, "rotation_wxyz", tuple[float, float, float, float], where))
    p = np.array(get(table, "position", _Vector, where))
    if abs(float(np.linalg.norm(q)) - 1.0) > 1e-2:
        raise InputError(
            place(where, "rotation_wxyz"),
            "a unit quaternion [w, x, y, z] of R_c_w0",
            f"norm {np.linalg.norm(q):.6g}",
        )
    return CameraPose(quaternion_wxyz_to_matrix(q), p)


def read_layout(table: Mapping[str, Any], base_dir: Path) -> MarkerLayout | None:
    """[markers]: the layout, or None where it has to come out of the recording (``layout = "estimate"``)."""
    where = "[markers]"
    check_keys(table, ("layout", "names", "sd", "facing"), where)
    value = table.get("layout")
    if value is None:
        raise InputError(
            place(where, "layout"), 'points [[x, y, z], ...] in m, a file, or "estimate"', "no such key"
        )
    if value == "estimate":
        if "sd" in table:
            raise InputError(place(where, "sd"), "a layout that is given", 'layout = "estimate"')
        return None
    if isinstance(value, str):
        return _layout_file(base_dir / value, table)
    if not isinstance(value, list):
        raise InputError(
            place(where, "layout"), 'points [[x, y, z], ...] in m, a file, or "estimate"', describe(value)
        )
    points = [convert(point, _Vector, f"{place(where, 'layout')} {k}") for k, point in enumerate(value, 1)]
    return _layout(np.array(points).reshape(-1, 3), table, where)


def _layout(points: np.ndarray, table: Mapping[str, Any], where: str) -> MarkerLayout:
    default = (
        PALM_NAMES if len(points) == len(PALM_NAMES) else tuple(f"marker_{k + 1}" for k in range(len(points)))
    )
    names = get(table, "names", tuple[str, ...], where, default)
    if len(names) != len(points):
        raise InputError(place(where, "names"), f"{len(points)} names, one a marker", f"{len(names)}")
    sd = convert(table["sd"], float | tuple[float, ...], place(where, "sd")) if "sd" in table else 1e-3
    sds = np.atleast_1d(np.asarray(sd, dtype=float))
    if sds.size not in (1, len(points)) or np.any(sds < 0.0):
        raise InputError(
            place(where, "sd"), f"one number or {len(points)}, m, none negative", describe(table.get("sd"))
        )
    if np.any(sds > 0.05):
        raise InputError(
            place(where, "sd"), "metres, at most 0.05", describe(table.get("sd")), "Is it in millimetres?"
        )
    try:
        return MarkerLayout.with_sd(tuple(names), points, float(sds[0]) if sds.size == 1 else sds)
    except InputError as error:
        raise InputError(place(where, "layout"), error.expected, error.found, error.hint) from error


def _layout_file(path: Path, table: Mapping[str, Any]) -> MarkerLayout:
    """A stored layout: JSON of a calibration or of an estimate, or a table with the columns ``x,y,z`` and perhaps ``sd``."""
    for key in ("names", "sd"):
        if key in table and path.suffix.lower() == ".json":
            raise InputError(place("[markers]", key), "a layout written in this file", f"a layout in {path}")
    if path.suffix.lower() == ".json":
        return read_stored(path)
    from factorgrasp.recordings.tables import read_table

    columns = read_table(path, ("x", "y", "z"), ("sd",))
    points = np.stack([columns["x"], columns["y"], columns["z"]], axis=1)
    if "sd" in columns and "sd" not in table:
        table = {**table, "sd": columns["sd"].tolist()}
    return _layout(points, table, str(path))


def read_blob_source(
    table: Mapping[str, Any], base_dir: Path, camera: Camera
) -> tuple[BlobRecording, tuple[str, ...]]:
    """[blobs]: from a table, or detected in images; with what a user should know about them."""
    where = "[blobs]"
    sources = [key for key in ("file", "video", "images") if key in table]
    if len(sources) != 1:
        raise InputError(where, "one of file, video and images", " and ".join(sources) or "none of them")
    if sources[0] != "file":
        from factorgrasp.vision.problem_table import blobs_from_table

        blobs, remarks = blobs_from_table(table, base_dir, camera)
        return blobs, (*remarks, *blob_remarks(blobs, camera))
    check_keys(table, ("file",), where)
    blobs = read_blobs(base_dir / get(table, "file", str, where), camera)
    return blobs, blob_remarks(blobs, camera)


def blob_remarks(blobs: BlobRecording, camera: Camera) -> tuple[str, ...]:
    """What looks odd in a recording of blobs, and its end where there are none."""
    out = []
    if not blobs.frame.size:
        raise InputError(
            blobs.name, "blobs", f"none in any of {len(blobs)} frames", "Were the markers detected at all?"
        )
    known = np.isfinite(blobs.depth)
    if not known.any():
        out.append(
            "no blob has a depth: two poses explain a nearly flat hand's pixels, and the answer may be ambiguous"
        )
    elif known.mean() < 0.5:
        out.append(f"only {100.0 * known.mean():.0f} % of the blobs have a depth")
    step = float(np.median(np.diff(blobs.t))) if len(blobs) > 1 else float("nan")
    if np.isfinite(step) and not 0.02 < step * camera.rate < 50.0:
        raise InputError(
            f"{blobs.name}: t", f"seconds, about {1.0 / camera.rate:.3g} from frame to frame", f"steps of {step:.4g}",
            "Milliseconds? Name the column 't [ms]'" if step * camera.rate > 1.0 else "",
        )  # fmt: skip
    if np.isfinite(step) and not 0.5 < step * camera.rate < 2.0:
        out.append(
            f"frames come every {1e3 * step:.3g} ms, and [camera] rate says {1e3 / camera.rate:.3g} ms: is the column t in seconds?"
        )
    return tuple(out)


def _calibrated(
    blobs: BlobRecording, camera: Camera, hand: Hand, facing: Facing, names: tuple[str, ...] | None
) -> tuple[MarkerLayout, tuple[str, ...]]:
    """The layout of ``layout = "estimate"``: from the first frames that show all markers with depth."""
    from factorgrasp.palm_calibration import calibrate_palm

    found = calibrate_palm(blobs, camera, hand, facing)
    layout = found.layout
    if names is not None:
        if len(names) != len(layout):
            raise InputError("[markers] names", f"{len(layout)} names, one a marker", f"{len(names)}")
        layout = MarkerLayout(names, layout.points, layout.covariance)
    sd = 1e3 * float(np.sqrt(np.mean(layout.sd**2)))
    return layout, (
        f"the layout was calibrated from {found.frames.size} frames, to {sd:.2f} mm a coordinate",
    )


def _association(table: Mapping[str, Any]) -> WristAssociation:
    where = "[association]"
    values = dict(table)
    if "method" in values:
        words = Literal["map", "hungarian", "jcbb", "blob", "assignment", "joint"]
        values["method"] = _METHODS[convert(values["method"], words, place(where, "method"))]
    if "p_miss" in values:
        if "detection" in values:
            raise InputError(place(where, "p_miss"), "either this or detection, which is 1 - p_miss", "both")
        miss = convert(values.pop("p_miss"), float, place(where, "p_miss"))
        if not 0.0 < miss < 1.0:
            raise InputError(place(where, "p_miss"), "a probability between 0 and 1", repr(miss))
        values["detection"] = 1.0 - miss
    return from_table(WristAssociation, values, where)


def _noise(table: Mapping[str, Any]) -> WristNoise:
    where = "[noise]"
    values: dict[str, Any] = {}
    for key, value in table.items():
        target = _NOISE_ALIASES.get(key, key)
        if target in values:
            raise InputError(place(where, key), f"either this or {target}", "both")
        values[target] = value
    return from_table(WristNoise, values, where)

"""[blobs] of a wrist-pose file that names a video or a folder of images: the detector's part."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.recordings.blobs import BlobRecording
from factorgrasp.toml_tables import check_keys, from_table, get, place, sub_table

_KEYS = (
    "video", "images", "depth", "depth_scale", "rate", "click", "patch", "reference_frame", "colour", "detector",
)  # fmt: skip


def detect_blobs(
    table: Mapping[str, Any], base_dir: Path, camera: Camera
) -> tuple[BlobRecording, tuple[str, ...]]:
    """Blobs of a video or of a folder of images, with or without a folder of depth images.

    Parameters
    ----------
    table : mapping
        [blobs].
    base_dir : Path
        That its paths are relative to.
    camera : Camera

    Returns
    -------
    BlobRecording
    tuple of str
        What the detector found odd.
    """
    from factorgrasp.vision import (
        BlobDetector,
        DetectorSettings,
        detect_recording,
        learn_colour,
        propose_detector,
        read_colour,
        read_frames,
    )

    where = "[blobs]"
    check_keys(table, _KEYS, where)
    given = [key for key in ("click", "patch", "colour") if key in table]
    if len(given) > 1:
        raise InputError(where, "one of click, patch and colour", " and ".join(given))
    settings = from_table(DetectorSettings, sub_table(table, "detector"), "[blobs.detector]")
    paths = {
        key: base_dir / get(table, key, str, where) for key in ("video", "images", "depth") if key in table
    }
    scale, rate = get(table, "depth_scale", float, where, 1e-3), get(table, "rate", float, where, None)
    try:
        source = read_frames(**paths, depth_scale=scale, rate=rate)
    except InputError as error:
        raise InputError(place(where, error.field), error.expected, error.found, error.hint) from error
    number = get(table, "reference_frame", int, where, 0)
    if not 0 <= number < len(source):
        raise InputError(
            place(where, "reference_frame"), f"one of the {len(source)} frames, from 0 on", f"{number}"
        )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        if given == ["colour"]:
            detector = BlobDetector(
                read_colour(base_dir / get(table, "colour", str, where)), settings, camera
            )
        elif given:
            image = next(islice(iter(source), number, None)).rgb
            click = get(table, "click", tuple[float, float], where, None)
            patch = get(table, "patch", tuple[int, int, int, int], where, None)
            try:
                detector = BlobDetector(learn_colour(image, click, patch), settings, camera)
            except InputError as error:
                raise InputError(place(where, given[0]), error.expected, error.found, error.hint) from error
        else:
            detector = propose_detector(source, camera, settings)
        name = str(paths.get("video", paths.get("images")))
        blobs = detect_recording(source, camera, detector, name)
    return blobs, tuple(str(one.message) for one in caught)

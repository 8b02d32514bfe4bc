"""The table ``[blobs]`` of a problem file when it names images: what to read, and how to detect the markers in it.

::

    [blobs]
    video = "wrist.avi"              # or images = "rgb/"
    depth = "depth/"                 # 16-bit PNGs, one a frame
    depth_scale = 0.001              # m a step
    click = [312, 208]               # a pixel of the first frame on a marker; or patch = [u0, v0, u1, v1], or colour = "blue.json";
                                     # none of them: proposed
    marker_diameter = 0.012          # and every other setting of the detector
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.recordings.blobs import BlobRecording
from factorgrasp.toml_tables import from_table, get
from factorgrasp.vision.colour import learn_colour, read_colour
from factorgrasp.vision.detector import BlobDetector
from factorgrasp.vision.frames import read_frames
from factorgrasp.vision.recording import detect_recording, propose_detector
from factorgrasp.vision.settings import DetectorSettings

SOURCE_KEYS = ("video", "images", "depth", "depth_scale", "rate", "colour", "click", "patch")


def blobs_from_table(
    table: Mapping[str, Any], base_dir: Path, camera: Camera, where: str = "[blobs]"
) -> tuple[BlobRecording, tuple[str, ...]]:
    """Blobs detected in the images that a table names, and what the user should know about it.

    Raises
    ------
    InputError
        Naming the key, the file or the frame.
    """
    settings = from_table(
        DetectorSettings, {key: value for key, value in table.items() if key not in SOURCE_KEYS}, where
    )

    def path(key: str) -> Path | None:
        value = get(table, key, str, where, None)
        return None if value is None else base_dir / value

    rate = get(table, "rate", float, where, None)
    try:
        frames = read_frames(
            video=path("video"),
            images=path("images"),
            depth=path("depth"),
            depth_scale=get(table, "depth_scale", float, where, 1e-3),
            rate=rate or camera.rate,
        )
    except InputError as error:
        if error.field.startswith(where):
            raise
        raise InputError(f"{where} {error.field}", error.expected, error.found, error.hint) from error
    colour, click = path("colour"), get(table, "click", tuple[float, float], where, None)
    patch = get(table, "patch", tuple[int, int, int, int], where, None)
    given = [key for key in ("click", "patch", "colour") if key in table]
    if len(given) > 1:
        raise InputError(where, "one of click, patch and colour", " and ".join(given))
    remarks = []
    if colour is not None:
        detector = BlobDetector(read_colour(colour), settings, camera)
    elif given:
        try:
            reference = learn_colour(next(iter(frames)).rgb, click=click, patch=patch)
        except InputError as error:
            raise InputError(f"{where} {given[0]}", error.expected, error.found, error.hint) from error
        detector = BlobDetector(reference, settings, camera)
    else:
        detector = propose_detector(frames, camera, settings)
        remarks.append("the markers' colour was proposed from the first frames: no click or colour was given")
    source = path("images") or path("video")
    blobs = detect_recording(frames, camera, detector, name=str(source))
    empty = int((blobs.counts == 0).sum())
    if empty:
        remarks.append(f"no marker was found in {empty} of {len(blobs)} frames")
    if not frames.depths:
        remarks.append("without depth images a nearly flat palm has two poses that look alike")
    return blobs, tuple(remarks)

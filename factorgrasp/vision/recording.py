"""From frames to a recording of blobs."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.recordings.blobs import BlobRecording
from factorgrasp.typing import FloatArray
from factorgrasp.vision.blobs import DetectedBlobs
from factorgrasp.vision.detector import BlobDetector
from factorgrasp.vision.propose import propose_colour
from factorgrasp.vision.settings import DetectorSettings


class AnyFrame(Protocol):
    """What a frame must have; :class:`factorgrasp.vision.Frame` does."""

    @property
    def t(self) -> float: ...
    @property
    def rgb(self) -> NDArray[np.uint8]: ...
    @property
    def depth(self) -> FloatArray | None: ...


def propose_detector(
    frames: Iterable[AnyFrame],
    camera: Camera | None = None,
    settings: DetectorSettings | None = None,
    looks: int = 5,
) -> BlobDetector:
    """A detector whose reference colour is taken from the first of `looks` frames that shows a group of alike spots.

    Raises
    ------
    InputError
        When none does, with what was found in the last one.
    """
    last: InputError | None = None
    for k, frame in enumerate(frames):
        if k >= looks:
            break
        try:
            return BlobDetector(propose_colour(frame.rgb, frame.depth), settings, camera)
        except InputError as error:
            last = error
    raise last or InputError("frames", "at least one frame", "none")


def detect_recording(
    frames: Iterable[AnyFrame], camera: Camera, detector: BlobDetector | None = None, name: str = "blobs"
) -> BlobRecording:
    """Detect the blobs of every frame.

    Parameters
    ----------
    frames : iterable of Frame
        Such as :func:`factorgrasp.vision.read_frames` gives; without a detector it is started twice.
    camera : Camera
        Of the images; their sizes must agree.
    detector : BlobDetector, optional
        By default one with a proposed reference colour.
    name : str

    Returns
    -------
    BlobRecording
        With the covariance of every centroid and depth. Frames without blobs stay without.

    Raises
    ------
    InputError
        When the images are not the camera's, all are black, or no frame shows a marker.
    """
    if detector is None:
        detector = propose_detector(frames, camera)
    elif detector.camera is None:
        detector = BlobDetector(detector.reference, detector.settings, camera)
    if getattr(frames, "compressed", False):
        s = detector.settings
        worse = replace(
            s,
            centroid_sd=float(np.hypot(s.centroid_sd, s.compression_sd)),
            hidden_sd=float(np.hypot(s.hidden_sd, s.compression_sd)),
        )
        detector = BlobDetector(detector.reference, worse, camera)
    times: list[float] = []
    found: list[DetectedBlobs] = []
    brightest, reasons = 0, Counter[str]()
    for frame in frames:
        if frame.rgb.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"{name}: frame {len(times)}",
                f"images of the camera's size, {camera.width} x {camera.height}",
                f"{frame.rgb.shape[1]} x {frame.rgb.shape[0]}",
                "Intrinsics hold for one resolution only",
            )
        blobs = detector.detect(frame.rgb, frame.depth)
        times.append(frame.t)
        found.append(blobs)
        reasons.update(blobs.rejected)
        brightest = max(brightest, int(frame.rgb[::4, ::4].max()))
    if not found:
        raise InputError(name, "at least one frame", "none")
    counts = np.array([len(blobs) for blobs in found])
    if not counts.any():
        _say_nothing_found(name, len(found), brightest, reasons)
    if np.median(counts) < 3:
        warnings.warn(
            f"{name}: fewer than three blobs in most frames (median {np.median(counts):g}); a pose needs three. Spots of the markers' "
            f"colour that were not taken: {dict(reasons) or 'none'}",
            stacklevel=2,
        )
    return BlobRecording(
        t=np.array(times),
        frame=np.repeat(np.arange(len(found)), counts),
        uv=np.concatenate([blobs.uv for blobs in found]),
        depth=np.concatenate([blobs.depth for blobs in found]),
        covariance_uv=np.concatenate([blobs.covariance_uv for blobs in found]),
        covariance_depth=np.concatenate([blobs.covariance_depth for blobs in found]),
        name=name,
    )


def _say_nothing_found(name: str, count: int, brightest: int, reasons: Counter[str]) -> None:
    if brightest < 25:
        raise InputError(
            name,
            "images with light",
            f"{count} black frames (brightest value {brightest} of 255)",
            "Was the lens covered?",
        )
    raise InputError(
        name,
        "markers in at least one frame",
        f"none in {count} frames; spots of their colour that were not taken: {dict(reasons) or 'none'}",
        "Learn the reference colour in this recording, from a click on a marker",
    )

"""Rendered recordings on disk, in the formats that :func:`factorgrasp.vision.read_frames` reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.atomic import replacing, write_text
from factorgrasp.errors import InputError
from factorgrasp.simulation.hand_rendering import HandVideo
from factorgrasp.vision.opencv import load_cv2


def write_frames(video: HandVideo, folder: str | Path, movie: bool = False) -> Path:
    """Render a recording into a folder.

    Written are ``rgb/000000.png`` (8 bit), ``depth/000000.png`` (16 bit, mm), ``rgb/timestamps.csv``, ``truth.npz`` and, on request,
    ``movie.avi`` (Motion JPEG).
    ``truth.npz`` holds ``t``, ``uv`` (n, 6, 2), ``marker_depth`` (n, 6), ``visible`` (n, 6), ``R_c_w``, ``p_c_w`` and ``layout``.

    Returns
    -------
    Path
        The folder.
    """
    cv2 = load_cv2()
    out = Path(folder)
    (out / "rgb").mkdir(parents=True, exist_ok=True)
    (out / "depth").mkdir(exist_ok=True)
    writer: Any = None
    truth: dict[str, list[Any]] = {"uv": [], "marker_depth": [], "visible": []}
    try:
        if movie:
            size = (video.camera.width, video.camera.height)
            writer = cv2.VideoWriter(
                str(out / "movie.avi"), cv2.VideoWriter_fourcc(*"MJPG"), video.camera.rate, size
            )
            if not writer.isOpened():
                raise InputError(
                    "movie", "an OpenCV that can write Motion JPEG", "one that cannot", "Write PNGs only"
                )
            writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 98)
        for k, frame in enumerate(video):
            colour = frame.rgb[:, :, ::-1]
            cv2.imwrite(str(out / "rgb" / f"{k:06d}.png"), colour)
            cv2.imwrite(str(out / "depth" / f"{k:06d}.png"), np.rint(1e3 * frame.depth).astype(np.uint16))
            if writer is not None:
                writer.write(np.ascontiguousarray(colour))
            for key, values in truth.items():
                values.append(getattr(frame, key))
    finally:
        if writer is not None:
            writer.release()
    write_text(out / "rgb" / "timestamps.csv", "\n".join(["t", *(repr(float(t)) for t in video.t), ""]))
    arrays: dict[str, Any] = {key: np.array(values) for key, values in truth.items()}
    with replacing(out / "truth.npz") as temporary, temporary.open("wb") as handle:
        np.savez(handle, t=video.t, R_c_w=video.R_c_w, p_c_w=video.p_c_w, layout=video.layout, **arrays)
    return out

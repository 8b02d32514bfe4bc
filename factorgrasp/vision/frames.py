"""Frames of a recording: a video, or a folder of images, each with or without a folder of depth images.

Folders hold one file a frame (PNG, JPEG, TIFF, BMP), in the order of the numbers in their names. A file ``timestamps.csv`` beside the
images with a column ``t`` (one row a frame; a unit in the header, as in ``t [ms]``, is converted) gives their times; without it they follow
each other at the rate. Depth images are 16-bit PNGs, 0 where nothing was seen, ``depth_scale`` metres a step, registered to the colours.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.recordings.tables import read_table
from factorgrasp.typing import FloatArray
from factorgrasp.vision.images import ByteImage
from factorgrasp.vision.opencv import load_cv2

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_PLAUSIBLE = (0.1, 12.0)
"""m: what a median depth of a hand's scene may be."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame.

    Attributes
    ----------
    t : float
        s.
    rgb : ndarray of uint8, shape (h, w, 3)
    depth : ndarray or None, shape (h, w)
        m, 0 where missing.
    """

    t: float
    rgb: ByteImage
    depth: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class FrameSource:
    """Frames on disk, read one by one.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s.
    images : tuple of Path
        One file a frame, or the one file of a video.
    depths : tuple of Path
        One file a frame, or none.
    depth_scale : float
        Metres a step.
    """

    t: FloatArray
    images: tuple[Path, ...]
    depths: tuple[Path, ...] = ()
    depth_scale: float = 1e-3
    video: bool = False

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def compressed(self) -> bool:
        """Whether the colours went through a lossy compression, which blurs and shifts small spots."""
        return self.video or any(path.suffix.lower() in (".jpg", ".jpeg") for path in self.images)

    def __iter__(self) -> Iterator[Frame]:
        cv2 = load_cv2()
        size: tuple[int, int] | None = None
        for k, rgb in enumerate(self._colours(cv2)):
            size = size or (rgb.shape[0], rgb.shape[1])
            if rgb.shape[:2] != size:
                raise InputError(
                    str(self.images[k]),
                    f"the size of the first image, {size[1]} x {size[0]}",
                    f"{rgb.shape[1]} x {rgb.shape[0]}",
                )
            depth = self._depth(k, size, cv2) if self.depths else None
            yield Frame(float(self.t[k]), rgb, depth)

    def _colours(self, cv2: Any) -> Iterator[ByteImage]:
        if not self.video:
            for path in self.images:
                image = cv2.imread(str(path), cv2.IMREAD_COLOR)
                if image is None:
                    raise InputError(str(path), "an image", "a file that cannot be read as one")
                yield np.ascontiguousarray(image[:, :, ::-1])
            return
        capture = cv2.VideoCapture(str(self.images[0]))
        try:
            for k in range(len(self)):
                found, image = capture.read()
                if not found:
                    raise InputError(
                        str(self.images[0]),
                        f"{len(self)} frames, as the file says",
                        f"{k}",
                        "Is the file cut off?",
                    )
                yield np.ascontiguousarray(image[:, :, ::-1])
        finally:
            capture.release()

    def _depth(self, k: int, size: tuple[int, int], cv2: Any) -> FloatArray:
        path = self.depths[k]
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise InputError(str(path), "a depth image", "a file that cannot be read as an image")
        if image.ndim != 2 or image.dtype not in (np.uint16, np.float32):
            raise InputError(
                str(path),
                "a depth image of one channel, 16 bits (or 32-bit float)",
                f"{image.shape}, {image.dtype}",
                "Pictures of depth in colours or 8 bits hold no distances",
            )
        if image.shape != size:
            raise InputError(
                str(path), f"the size of the colour image, {size[1]} x {size[0]}", f"{image.shape[1]} x {image.shape[0]}",
                "Register the depth to the colour camera first",
            )  # fmt: skip
        depth: FloatArray = image.astype(float) * self.depth_scale
        if k == 0:
            self._check_scale(depth, path)
        return depth

    def _check_scale(self, depth: FloatArray, path: Path) -> None:
        known = depth[(depth > 0.0) & np.isfinite(depth)]
        if known.size < 0.01 * depth.size:
            return
        middle = float(np.median(known))
        if not _PLAUSIBLE[0] <= middle <= _PLAUSIBLE[1]:
            likely = next(
                (s for s in (1.0, 1e-1, 1e-2, 1e-3, 2e-4, 1e-4) if 0.3 < middle / self.depth_scale * s < 3.0),
                None,
            )
            raise InputError(
                f"{path}: depth_scale",
                f"a median depth between {_PLAUSIBLE[0]:g} and {_PLAUSIBLE[1]:g} m",
                f"{middle:.4g} m with {self.depth_scale:g} m a step",
                "" if likely is None else f"Is the scale {likely:g}?",
            )


def read_frames(
    video: str | Path | None = None,
    images: str | Path | None = None,
    depth: str | Path | None = None,
    depth_scale: float = 1e-3,
    rate: float | None = None,
) -> FrameSource:
    """The frames of a recording, checked, not yet read.

    Parameters
    ----------
    video, images : path, optional
        A video file, or a folder of images; one of both.
    depth : path, optional
        A folder of 16-bit depth images, one for each frame.
    depth_scale : float
        Metres a step of the depth images.
    rate : float, optional
        Frames a second where the files do not say (images without timestamps.csv); 30 by default. For a video it overrules the file.

    Raises
    ------
    InputError
        When a path does not exist or is empty, counts differ, or times do not increase.
    """
    if (video is None) == (images is None):
        raise InputError(
            "frames", "a video or a folder of images", "both" if video is not None else "neither"
        )
    if not 0.0 < depth_scale < 1e3:
        raise InputError("depth_scale", "metres a step, above zero", repr(depth_scale))
    if rate is not None and not 0.0 < rate < 1e5:
        raise InputError("rate", "frames a second, above zero", repr(rate))
    if video is not None:
        source = _open_video(Path(video), rate)
    else:
        folder = Path(str(images))
        files = _image_files(folder, "images")
        t = _timestamps(folder / "timestamps.csv", len(files))
        source = FrameSource(np.arange(len(files)) / (rate or 30.0) if t is None else t, files)
    depths: tuple[Path, ...] = ()
    if depth is not None:
        depths = _image_files(Path(depth), "depth")
        if len(depths) != len(source):
            raise InputError(
                f"{depth}", f"one depth image for each of the {len(source)} frames", f"{len(depths)}",
                "Leave out the frames of which one of both is missing",
            )  # fmt: skip
    return FrameSource(source.t, source.images, depths, depth_scale, source.video)


def _image_files(folder: Path, what: str) -> tuple[Path, ...]:
    if not folder.is_dir():
        raise InputError(
            f"{what}",
            "a folder of images",
            f"no folder {folder}" if not folder.exists() else f"a file, {folder}",
        )
    files = [
        path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
    ]
    if not files:
        raise InputError(f"{what}: {folder}", "images (" + ", ".join(SUFFIXES) + ")", "none")
    return tuple(sorted(files, key=_natural))


def _natural(path: Path) -> tuple[Any, ...]:
    """Order in which frame 10 follows frame 9."""
    return tuple(
        (0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", path.stem)
    )


def _timestamps(path: Path, count: int) -> FloatArray | None:
    if not path.is_file():
        return None
    t = read_table(path, ("t",))["t"]
    if t.size != count:
        raise InputError(str(path), f"one time for each of the {count} images", f"{t.size}")
    if not np.isfinite(t).all() or (np.diff(t) <= 0.0).any():
        row = (
            int(np.argmax(~np.isfinite(t)))
            if not np.isfinite(t).all()
            else int(np.argmax(np.diff(t) <= 0.0)) + 1
        )
        raise InputError(
            f"{path}: t", "finite, strictly increasing times", f"{t[row]!r} in row {row} (counted from 0)"
        )
    return np.asarray(t)


def _open_video(path: Path, rate: float | None) -> FrameSource:
    cv2 = load_cv2()
    if not path.is_file():
        raise InputError("video", "a video file", f"no file {path}")
    capture = cv2.VideoCapture(str(path))
    try:
        times = []
        while capture.grab():
            times.append(1e-3 * float(capture.get(cv2.CAP_PROP_POS_MSEC)))
        declared = float(capture.get(cv2.CAP_PROP_FPS))
    finally:
        capture.release()
    if not times:
        raise InputError(f"{path}", "a video that OpenCV can decode", "no frame")
    t = np.array(times)
    if rate is not None or not np.isfinite(t).all() or (np.diff(t) <= 0.0).any():
        t = np.arange(t.size) / (rate or (declared if 0.0 < declared < 1e4 else 30.0))
    return FrameSource(t, (path,), video=True)

"""The reference colour of the markers: a wide histogram of colour without brightness, and that of what surrounds them.

Colours are pairs ``x = log(red / green)``, ``y = log(blue / green)`` of linear light. More or less light leaves them, another
colour temperature shifts them; the histogram is smoothed by about the shift between a cloudy sky and a lamp, so that it serves in both.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from factorgrasp.atomic import write_text
from factorgrasp.errors import InputError
from factorgrasp.typing import BoolArray, FloatArray
from factorgrasp.vision.images import DARK, LINEAR, LOG_RANGE, LOG_STEPS, ByteImage, check_rgb, log_chroma

BINS = 56
"""Of the histogram, for x and for y."""
SPAN = 3.5
"""The histogram covers x and y from -SPAN to SPAN."""
WIDTH = 0.32
"""Standard deviation of the smoothing: what light of another colour may shift x or y."""
_ANY = 0.06
"""Share of the background that may have any colour at all."""
_MIXTURES = (0.9, 0.8, 0.7, 0.6)
"""Shares of the marker in a pixel that still may seed a blob."""
_LEAST_CONTRAST = 0.5
"""Of a marker against its surroundings, in log chroma."""
_LARGEST_SHARE = 0.02
"""Of the image that one marker may cover."""


@dataclass(frozen=True, eq=False)
class ColourReference:
    """What the markers look like, and what does not belong to them.

    Attributes
    ----------
    marker, background : ndarray, shape (BINS, BINS)
        Histograms over (x, y), each with sum 1, not smoothed.
    marker_mean : ndarray, shape (2,)
        Mean (x, y) of the marker pixels.
    pixels : int
        Number of marker pixels that were learnt from.
    mixtures : ndarray, shape (BINS, BINS)
        Histogram of mixtures of marker and surroundings.
    """

    marker: FloatArray
    background: FloatArray
    marker_mean: FloatArray
    pixels: int

    mixtures: FloatArray

    @cached_property
    def table(self) -> FloatArray:
        """Back-projection: probability of being a marker or its edge, by the two steps of :func:`log_chroma`, offset by LOG_RANGE."""
        return self._back_project(0.5 * self._wide_mixtures + 0.5 * self.wide_marker)

    @cached_property
    def strict_table(self) -> FloatArray:
        """The same for the marker alone, without its edges."""
        return self._back_project(self.wide_marker)

    @cached_property
    def _wide_mixtures(self) -> FloatArray:
        return smooth(self.mixtures, 0.7 * WIDTH)

    def _back_project(self, wide: FloatArray) -> FloatArray:
        axis = np.arange(-LOG_RANGE, LOG_RANGE + 1) / LOG_STEPS
        cell = np.clip((axis + SPAN) * BINS / (2.0 * SPAN) - 0.5, 0.0, BINS - 1.0)
        grid = np.meshgrid(cell, cell, indexing="ij")
        marker = ndimage.map_coordinates(wide, grid, order=1)
        back = ndimage.map_coordinates(smooth(self.background, 0.7 * WIDTH), grid, order=1)
        return np.asarray(marker / (marker + (1.0 - _ANY) * back + _ANY / BINS**2 + 1e-12))

    @cached_property
    def wide_marker(self) -> FloatArray:
        """The marker's histogram, smoothed."""
        return smooth(self.marker, WIDTH)

    @property
    def background_mean(self) -> FloatArray:
        """Mean (2,) colour of the background."""
        axis = (np.arange(BINS) + 0.5) * 2.0 * SPAN / BINS - SPAN
        return np.array([axis @ self.background.sum(axis=1), axis @ self.background.sum(axis=0)])

    def shifted(self, shift: FloatArray) -> ColourReference:
        """The same colours under a lamp that shifts x and y by `shift` (2,)."""
        cells = np.asarray(shift) * BINS / (2.0 * SPAN)

        def moved(counts: FloatArray) -> FloatArray:
            return np.asarray(np.maximum(ndimage.shift(counts, cells, order=1), 0.0))

        return ColourReference(
            moved(self.marker),
            moved(self.background),
            self.marker_mean + shift,
            self.pixels,
            moved(self.mixtures),
        )

    def similarity(self, x: ArrayLike, y: ArrayLike) -> float:
        """Bhattacharyya coefficient (0 to 1) of the pixels' histogram with that of the markers or of their edges, all smoothed."""
        cell = [
            np.clip((np.asarray(c, dtype=float) + SPAN) * BINS / (2.0 * SPAN), 0, BINS - 1).astype(np.intp)
            for c in (x, y)
        ]
        counts = np.bincount(cell[0] * BINS + cell[1], minlength=BINS**2).reshape(BINS, BINS)
        found = _NARROW @ (counts / max(counts.sum(), 1)) @ _NARROW.T
        return float(max(np.sqrt(found * wide).sum() for wide in (self.wide_marker, self._wide_mixtures)))

    def save(self, path: str | Path) -> Path:
        """Write as JSON; :func:`read_colour` reads it."""
        content = {
            "kind": "marker_colour",
            "bins": BINS,
            "span": SPAN,
            "pixels": self.pixels,
            "marker_mean": self.marker_mean.tolist(),
            "marker": _sparse(self.marker),
            "background": _sparse(self.background),
            "mixtures": _sparse(self.mixtures),
        }
        return write_text(Path(path), json.dumps(content) + "\n")


def read_colour(path: str | Path) -> ColourReference:
    """A stored reference colour; InputError when the file is none."""
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        if content["kind"] != "marker_colour" or content["bins"] != BINS or content["span"] != SPAN:
            raise KeyError("kind, bins or span")
        return ColourReference(
            _dense(content["marker"]),
            _dense(content["background"]),
            np.array(content["marker_mean"], dtype=float),
            int(content["pixels"]),
            _dense(content["mixtures"]),
        )
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(
            str(path), "a colour reference written by save()", f"{type(error).__name__}: {error}"
        ) from error


def learn_colour(
    rgb: ArrayLike,
    click: tuple[float, float] | None = None,
    patch: tuple[int, int, int, int] | ArrayLike | None = None,
) -> ColourReference:
    """The reference colour from one image.

    Parameters
    ----------
    rgb : ndarray of uint8, shape (h, w, 3)
    click : (float, float), optional
        A pixel (u, v) on a marker; the spot of like colour around it is taken.
    patch : (int, int, int, int) or ndarray of bool, optional
        A box (u0, v0, u1, v1), last row and column excluded, or a mask (h, w) of marker pixels.

    Raises
    ------
    InputError
        When neither or both are given, the place is outside of the image or too dark, or it is not on a marker: a spot with edges whose
        colour differs from its surroundings.
    """
    image = check_rgb(rgb)
    if (click is None) == (patch is None):
        raise InputError("learn_colour", "a click or a patch", "both" if click is not None else "neither")
    mask = _patch_mask(image, patch) if click is None else _spot_around(image, click)
    return learn_from_mask(image, mask, "click" if click is not None else "patch")


def learn_from_mask(image: ByteImage, mask: BoolArray, field: str) -> ColourReference:
    """The reference colour from the marker pixels `mask`; everything farther than 3 px from them is background."""
    x, y = (channel / LOG_STEPS for channel in log_chroma(image))
    core = ndimage.binary_erosion(mask, iterations=1)
    core = core if core.sum() >= 5 else mask
    if image[core].max() < 25:
        raise InputError(field, "a place with light", f"a brightest value of {image[core].max()} of 255")
    away = ~ndimage.binary_dilation(mask, iterations=3)
    mean = np.array([x[core].mean(), y[core].mean()])
    # Pixels that already look like a marker are other markers, not background.
    away &= np.hypot(x - mean[0], y - mean[1]) > 0.6 * _LEAST_CONTRAST
    if away.sum() < 50:
        raise InputError(
            field, "a marker that differs from the rest of the image", "the same colour everywhere"
        )
    return ColourReference(
        histogram(x[core], y[core]),
        histogram(x[away], y[away]),
        mean,
        int(core.sum()),
        _mixtures(image, mask, core),
    )


def _mixtures(image: ByteImage, mask: BoolArray, core: BoolArray) -> FloatArray:
    """Histogram of mixtures of the marker with what surrounds it, as they occur in small and in blurred markers."""
    ring = ndimage.binary_dilation(mask, iterations=6) & ~ndimage.binary_dilation(mask, iterations=3)
    marker = LINEAR[image[core]]
    around = np.median(LINEAR[image[ring]], axis=0) if ring.any() else marker.mean(axis=0)
    counts = np.zeros((BINS, BINS))
    for share in _MIXTURES:
        logs = np.log(share * marker + (1.0 - share) * around + DARK)
        counts += histogram(logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1])
    return counts / len(_MIXTURES)


def _spot_around(image: ByteImage, click: tuple[float, float]) -> BoolArray:
    h, w = image.shape[:2]
    u, v = (round(float(c)) for c in click)
    where = f"({click[0]:g}, {click[1]:g})"
    if not (0 <= u < w and 0 <= v < h):
        raise InputError("click", f"a pixel (u, v) within {w} x {h}", where)
    near = (slice(max(v - 1, 0), v + 2), slice(max(u - 1, 0), u + 2))
    if image[near].max() < 25:
        raise InputError("click", "a place with light", f"black at {where}")
    x, y = (channel / LOG_STEPS for channel in log_chroma(image))
    centre = np.median(x[near]), np.median(y[near])
    away = np.hypot(x - centre[0], y - centre[1])
    labels, _ = ndimage.label(away < 0.6 * _LEAST_CONTRAST)
    if labels[v, u] == 0:
        raise InputError(
            "click", "the middle of a marker", f"an edge or noise at {where}", "Click well inside a marker"
        )
    spot = labels == labels[v, u]
    if spot.sum() > _LARGEST_SHARE * h * w:
        raise InputError(
            "click",
            "a marker: a small spot that differs from its surroundings",
            f"an area of {int(spot.sum())} px of one colour around {where}: background",
            "Click on a marker, or give a patch",
        )
    ring = ndimage.binary_dilation(spot, iterations=5) & ~ndimage.binary_dilation(spot, iterations=2)
    contrast = np.hypot(np.median(x[ring]) - centre[0], np.median(y[ring]) - centre[1])
    if contrast < _LEAST_CONTRAST or spot.sum() < 6:
        raise InputError(
            "click",
            "a marker: a spot of a colour of its own, at least 6 px large",
            f"{int(spot.sum())} px whose colour differs from its surroundings by {contrast:.2f} (log of channel ratios) at {where}",
            "Click on a marker; markers need another colour than the skin",
        )
    return np.asarray(spot)


def _patch_mask(image: ByteImage, patch: object) -> BoolArray:
    h, w = image.shape[:2]
    array = np.asarray(patch)
    if array.dtype == bool:
        if array.shape != (h, w) or not array.any():
            raise InputError(
                "patch",
                f"a mask of shape ({h}, {w}) with marker pixels",
                f"shape {array.shape}, {int(array.sum())} set",
            )
        return array
    if array.shape != (4,):
        raise InputError("patch", "a box (u0, v0, u1, v1) or a mask", f"shape {array.shape}")
    u0, v0, u1, v1 = (int(value) for value in array)
    if not (0 <= u0 < u1 <= w and 0 <= v0 < v1 <= h) or (u1 - u0) * (v1 - v0) < 4:
        raise InputError(
            "patch", f"a box (u0, v0, u1, v1) of at least 4 px within {w} x {h}", str((u0, v0, u1, v1))
        )
    mask = np.zeros((h, w), dtype=bool)
    mask[v0:v1, u0:u1] = True
    # A box drawn around a marker holds skin at its corners: what looks like the frame of the box is none of the marker.
    frame = mask.copy()
    frame[max(v0 - 2, 0) : v1 + 2, max(u0 - 2, 0) : u1 + 2] = True
    frame &= ~mask
    x, y = (channel / LOG_STEPS for channel in log_chroma(image))
    away = np.hypot(x - np.median(x[frame]), y - np.median(y[frame]))
    inner = mask & (away > max(0.6 * float(np.quantile(away[mask], 0.98)), _LEAST_CONTRAST))
    return inner if 0.1 * mask.sum() < inner.sum() and inner.sum() >= 4 else mask


def histogram(x: ArrayLike, y: ArrayLike) -> FloatArray:
    """Histogram (BINS, BINS) of colours, with sum 1."""
    found, _, _ = np.histogram2d(
        np.clip(np.ravel(x), -SPAN, SPAN),
        np.clip(np.ravel(y), -SPAN, SPAN),
        bins=BINS,
        range=[[-SPAN, SPAN]] * 2,
    )
    return np.asarray(found / max(found.sum(), 1.0))


def smooth(counts: FloatArray, width: float) -> FloatArray:
    """A histogram smoothed by a Gaussian of standard deviation `width` in log chroma."""
    return np.asarray(ndimage.gaussian_filter(counts, width * BINS / (2.0 * SPAN), mode="nearest"))


# Smoothing by half the width as a matrix: twenty times faster than a filter for one blob's few pixels.
_NARROW: FloatArray = ndimage.gaussian_filter1d(
    np.eye(BINS), 0.5 * WIDTH * BINS / (2.0 * SPAN), axis=0, mode="nearest"
)


def _sparse(counts: FloatArray) -> list[list[float]]:
    rows, columns = np.nonzero(counts)
    return [[int(i), int(j), float(counts[i, j])] for i, j in zip(rows, columns, strict=True)]


def _dense(entries: list[list[float]]) -> FloatArray:
    counts = np.zeros((BINS, BINS))
    for i, j, value in entries:
        counts[int(i), int(j)] = value
    return counts

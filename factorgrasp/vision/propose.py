"""A reference colour without a click: the colour of several small, alike spots that differ from all around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from factorgrasp.errors import InputError
from factorgrasp.typing import BoolArray, FloatArray
from factorgrasp.vision.colour import ColourReference, learn_from_mask
from factorgrasp.vision.images import LOG_STEPS, ByteImage, check_depth, check_rgb, log_chroma, metres
from factorgrasp.vision.opencv import load_cv2
from factorgrasp.vision.table_plane import fit_table

_CONTRAST = 0.45
"""Of a spot against the median around it, in log chroma."""
_AROUND = 41
"""px: width of the neighbourhood; a spot must cover less than half of it."""
_LIKE = 0.4
"""Spots of one colour differ by less, in log chroma."""
_LEAST = 3
"""Spots that make a colour the markers'."""


def propose_colour(rgb: ArrayLike, depth: ArrayLike | None = None, count: int = 6) -> ColourReference:
    """The reference colour of the group of spots that most looks like `count` markers.

    Spots are small, compact areas whose colour differs from the median around them; with depth, only what is above the table. Of the
    groups of alike colour and size the one is taken whose number is nearest to `count`; the more distinct one of two.

    Parameters
    ----------
    rgb : ndarray of uint8, shape (h, w, 3)
    depth : ndarray, shape (h, w), optional
        m.
    count : int
        Number of markers.

    Raises
    ------
    InputError
        When no three alike spots are found.
    """
    image = check_rgb(rgb)
    if image.max() < 25:
        raise InputError("rgb", "an image with light", f"a brightest value of {image.max()} of 255: black")
    above = _above_table(image, depth)
    x, y = log_chroma(image)
    labels, spots = _find_spots(image, x, y, above)
    best, best_score = None, -np.inf
    for members in _groups(spots):
        if len(members) < _LEAST:
            continue
        contrast = float(np.mean(spots[members, 3]))
        score = -abs(len(members) - count) + min(contrast, 2.0)
        if score > best_score:
            best, best_score = members, score
    if best is None:
        raise InputError(
            "reference colour",
            f"about {count} small spots of one colour that differ from what is around them",
            f"{len(spots)} spots, no {_LEAST} of which are alike",
            "Learn the colour from a click on a marker: learn_colour(rgb, click=(u, v))",
        )
    mask = np.isin(labels, spots[best, 0].astype(int))
    return learn_from_mask(image, mask, "reference colour")


def _above_table(image: ByteImage, depth: ArrayLike | None) -> BoolArray | None:
    """Pixels more than 8 mm above the table, holes closed; None when depth shows no table."""
    if depth is None:
        return None
    z = metres(check_depth(depth, (image.shape[0], image.shape[1])))
    table = fit_table(z)
    if table is None:
        return None
    v, u = np.mgrid[0 : z.shape[0], 0 : z.shape[1]]
    height = table.depth(np.stack([u, v], axis=-1)) - z
    mask = ndimage.binary_opening(np.nan_to_num(height, nan=0.0) > 0.008, iterations=1)
    return np.asarray(ndimage.binary_closing(mask, iterations=3))


def _find_spots(
    image: ByteImage, x: ArrayLike, y: ArrayLike, above: BoolArray | None
) -> tuple[np.ndarray, FloatArray]:
    """Labels (h, w) and spots (k, 5): label, mean x, mean y, contrast, area."""
    cv2 = load_cv2()
    contrast = np.zeros(image.shape[:2])
    for channel in (x, y):
        shifted = np.clip(np.asarray(channel) + 128, 0, 255).astype(np.uint8)
        smooth = cv2.medianBlur(shifted, 3).astype(float)
        contrast += ((smooth - cv2.medianBlur(shifted, _AROUND)) / LOG_STEPS) ** 2
    # Ratios of dark channels are noise.
    spot = (np.sqrt(contrast) > _CONTRAST) & (image.max(axis=2) > 25)
    if above is not None:
        spot &= above
    count, labels, stats, _ = cv2.connectedComponentsWithStats(spot.astype(np.uint8), connectivity=8)
    rows = []
    most = 0.004 * spot.size
    for label in range(1, count):
        left, top, width, height, area = (int(value) for value in stats[label])
        # A disc fills 0.79 of its box; slanted by 60 degrees, its box has sides 1 : 2.
        if (
            not 6 <= area <= most
            or max(width, height) > 2.6 * min(width, height)
            or area < 0.5 * width * height
        ):
            continue
        inside = labels[top : top + height, left : left + width] == label
        box = (slice(top, top + height), slice(left, left + width))
        mean = [float(np.median(np.asarray(c)[box][inside])) / LOG_STEPS for c in (x, y)]
        rows.append([label, *mean, float(np.sqrt(np.median(contrast[box][inside]))), area])
    return labels, np.array(rows, dtype=float).reshape(-1, 5)


def _groups(spots: FloatArray) -> list[np.ndarray]:
    """Indices of spots alike in colour and size, one group about each spot."""
    out = []
    for spot in spots:
        colour = np.hypot(spots[:, 1] - spot[1], spots[:, 2] - spot[2]) < _LIKE
        size = np.abs(np.log(spots[:, 4] / spot[4])) < np.log(2.2)
        out.append(np.flatnonzero(colour & size))
    return out

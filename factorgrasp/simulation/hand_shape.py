"""A hand made of round cones, built around where its markers sit, for rendered frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray

MARKER_ORDER = ("wrist", "thumb", "index", "middle", "ring", "little")
"""The wrist marker, then the five beside the metacarpophalangeal joints: the order of a layout's rows."""

SKIN_TONES = {
    "light": (0.80, 0.60, 0.48),
    "fair": (0.70, 0.46, 0.34),
    "medium": (0.55, 0.33, 0.22),
    "tan": (0.42, 0.22, 0.13),
    "brown": (0.22, 0.11, 0.065),
    "dark": (0.085, 0.043, 0.028),
}
"""Reflectance (linear red, green, blue) from light to dark skin."""

# Radius of the metacarpal under each marker and of the finger (m), and the lengths of the finger's parts (m).
_METACARPAL = {"thumb": 0.011, "index": 0.013, "middle": 0.0135, "ring": 0.013, "little": 0.012}
_FINGER = {"thumb": 0.0095, "index": 0.0085, "middle": 0.0088, "ring": 0.0083, "little": 0.0073}
_PHALANGES = {
    "thumb": (0.034, 0.028),
    "index": (0.042, 0.025, 0.022),
    "middle": (0.046, 0.029, 0.023),
    "ring": (0.043, 0.027, 0.023),
    "little": (0.034, 0.020, 0.020),
}
_WRIST = 0.021
_FOREARM = (0.026, 0.036, 0.24)
"""Radii at the wrist and at the far end, and the length, m."""


@dataclass(frozen=True, eq=False)
class HandShape:
    """Round cones in the wrist frame W.

    Attributes
    ----------
    start, end : ndarray, shape (k, 3)
        Ends of the axes, m.
    radius : ndarray, shape (k, 2)
        At the start and at the end, m.
    marker_normal : ndarray, shape (6, 3)
        Outward normals of the skin under the markers.
    """

    start: FloatArray
    end: FloatArray
    radius: FloatArray
    marker_normal: FloatArray


def build_hand(layout: FloatArray, outward: float = 1.0, curl: float = 0.12) -> HandShape:
    """A hand whose skin passes through the markers.

    Parameters
    ----------
    layout : ndarray, shape (6, 3)
        Markers in W in the order of :data:`MARKER_ORDER`, m.
    outward : float
        +1 when the marked side of the hand faces +z of W, -1 when it faces -z.
    curl : float
        Bend of each finger joint away from the marked side, rad.
    """
    layout = np.asarray(layout, dtype=float)
    if layout.shape != (6, 3) or not np.isfinite(layout).all():
        raise InputError("layout", "six finite marker positions, shape (6, 3), m", f"shape {layout.shape}")
    out = np.array([0.0, 0.0, np.sign(outward)])
    parts: list[tuple[FloatArray, FloatArray, float, float]] = []
    wrist = layout[0] - _WRIST * out
    knuckles = {}
    for name, marker in zip(MARKER_ORDER[1:], layout[1:], strict=True):
        knuckles[name] = marker - _METACARPAL[name] * out
        # Metacarpals fan out from beside each other, not from one point.
        root = wrist + np.array([0.008, 0.45 * (marker - layout[0])[1], 0.0]) - 0.001 * out
        parts.append((root, knuckles[name], 0.018, _METACARPAL[name]))
        parts += _finger(name, root, knuckles[name], out, curl)
    # The flesh between the metacarpals.
    for one, other in (("index", "middle"), ("middle", "ring"), ("ring", "little"), ("thumb", "index")):
        between = 0.5 * (knuckles[one] + knuckles[other]) - 0.002 * out
        root = wrist + np.array([0.01, 0.45 * between[1], 0.0]) - 0.001 * out
        reach = 0.85 if one == "thumb" else 0.98
        parts.append((root, root + reach * (between - root), 0.0185, 0.0125))
    near, far, length = _FOREARM
    along = np.array([-1.0, 0.0, 0.0])
    # The back of the forearm is level with the wrist marker, never above it.
    sunk = layout[0] - (near + 0.001) * out
    parts.append((sunk, sunk + length * along - (far - near + 0.002) * out, near, far))
    parts.append((wrist, sunk + 0.02 * along, _WRIST, near))
    start, end, first, last = (np.array(column) for column in zip(*parts, strict=True))
    normal = np.tile(out, (6, 1))
    # Skin falls off towards the thumb and the little finger.
    normal[1:, 1] = 2.0 * (layout[1:, 1] - layout[3, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return HandShape(start, end, np.column_stack([first, last]), normal)


def _finger(
    name: str, root: FloatArray, knuckle: FloatArray, out: FloatArray, curl: float
) -> list[tuple[FloatArray, FloatArray, float, float]]:
    """The phalanges of one finger, each bent a little more inwards."""
    ahead = (knuckle - root) * np.array([1.0, 0.7, 0.3])
    ahead /= np.linalg.norm(ahead)
    radius = _FINGER[name] * 1.12
    at, bend, parts = knuckle, 0.0, []
    for length in _PHALANGES[name]:
        bend += curl
        towards = np.cos(bend) * ahead - np.sin(bend) * out
        parts.append((at, at + length * towards, radius, 0.92 * radius))
        at, radius = at + length * towards, 0.92 * radius
    return parts

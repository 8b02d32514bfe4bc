"""Settings of the detector."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from factorgrasp.errors import InputError

Region = Literal["auto", "depth", "skin", "none"]


@dataclass(frozen=True)
class DetectorSettings:
    """What the detector takes for a marker.

    Attributes
    ----------
    marker_diameter : float
        m; 0: unknown. With depth and a camera, what is much larger is no marker or several.
    region : {"auto", "depth", "skin", "none"}
        Where markers are looked for: above the table (depth), surrounded by skin, or everywhere. "auto": above the table where there
        is depth and a table, else surrounded by skin.
    threshold : float
        Probability of the marker's colour from which a pixel seeds a blob.
    least_similarity : float
        Bhattacharyya coefficient of a blob's colours with the reference.
    least_pixels : int
        Seeding pixels of a blob.
    largest_share : float
        Of the image that one blob may cover.
    greatest_elongation : float
        Ratio of its axes.
    least_height : float
        Above the table, m: more than pens, less than the flat hand of a child.
    centroid_sd : float
        Of a whole marker's centroid beside the noise of the pixels, px: pixels, texture, shading.
    hidden_sd : float
        The same for a centre found from a part of the outline, px.
    compression_sd : float
        What compressed images (video, JPEG) add to either, px: their colours have half the resolution, and blocks.
    depth_correlation : float
        Number of neighbouring depth pixels that share one error.
    most_blobs : int
        Of one frame; the most similar ones are kept.
    """

    marker_diameter: float = 0.012
    region: Region = "auto"
    threshold: float = 0.5
    least_similarity: float = 0.25
    least_pixels: int = 2
    largest_share: float = 0.004
    greatest_elongation: float = 3.5
    least_height: float = 0.012
    centroid_sd: float = 0.035
    hidden_sd: float = 0.10
    compression_sd: float = 0.2
    depth_correlation: float = 3.5
    most_blobs: int = 24

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "region" and not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"detector: {field.name}", "a number not below zero", repr(value))
        if self.region not in ("auto", "depth", "skin", "none"):
            raise InputError("detector: region", "auto, depth, skin or none", repr(self.region))
        if not 0.0 < self.threshold < 1.0 or not 0.0 <= self.least_similarity < 1.0:
            raise InputError(
                "detector: threshold, least_similarity",
                "probabilities below 1",
                f"{self.threshold}, {self.least_similarity}",
            )
        if self.marker_diameter > 0.2:
            raise InputError(
                "detector: marker_diameter", "metres", f"{self.marker_diameter:g}", "Is it in millimetres?"
            )

"""What a rendered scene looks like: light, skin, table, sensor, and what hides markers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.simulation.hand_shape import SKIN_TONES
from factorgrasp.typing import FloatArray

_WAVELENGTHS = np.array([610e-9, 550e-9, 465e-9])
"""Of red, green and blue, m."""
_PLANCK = 1.438777e-2
"""Second radiation constant, m K."""
DAYLIGHT = 6500.0


@dataclass(frozen=True)
class Hidden:
    """Something close above a marker that hides a part of it.

    Attributes
    ----------
    marker : int
        Row of the layout.
    fraction : float
        Of the marker's diameter, along `angle`.
    first, last : int
        Frames, both included.
    angle : float
        Direction in the image from which it comes, rad.
    kind : {"skin", "cloth"}
        Another finger, or a grey sleeve.
    """

    marker: int
    fraction: float = 0.5
    first: int = 0
    last: int = 1_000_000_000
    angle: float = 0.0
    kind: Literal["skin", "cloth"] = "skin"


@dataclass(frozen=True)
class HandScene:
    """Settings of a rendered recording.

    Attributes
    ----------
    skin : str
        One of :data:`factorgrasp.simulation.hand_shape.SKIN_TONES`.
    light : float
        Of the nominal exposure; 1.4 clips light skin, as a camera would.
    colour_temperature : float
        Of the lamp, K, for a camera whose white balance is fixed at 6500 K.
    light_gradient : float
        Change of the light from the left to the right of the image, relative.
    shutter : float
        Time for which the shutter is open, s: motion blur.
    lens_blur : float
        Standard deviation of the optics' point spread, px.
    sensor_noise : float
        Standard deviation of a channel at middle grey, in steps of 8 bits.
    marker_diameter : float
        m.
    marker_colour : tuple of float
        Reflectance, linear red, green, blue.
    table : {"wood", "grey"}
    table_gap : float
        From the deepest point of the hand to the table, m.
    distractors : bool
        A blue pen, a teal disc, a piece of denim and a wooden block on the table.
    hidden : tuple of Hidden
    depth_noise : float
        Times that of a structured-light camera, sd 1.2 mm + 1.9 mm/m^2 (z - 0.4 m)^2.
    depth_missing, depth_outliers : float
        Shares of pixels, beside the shadows and the mixed pixels at edges.
    """

    skin: str = "fair"
    light: float = 1.0
    colour_temperature: float = DAYLIGHT
    light_gradient: float = 0.15
    shutter: float = 0.0
    lens_blur: float = 0.6
    sensor_noise: float = 2.0
    marker_diameter: float = 0.012
    marker_colour: tuple[float, float, float] = (0.025, 0.09, 0.40)
    table: Literal["wood", "grey"] = "wood"
    table_gap: float = 0.01
    distractors: bool = True
    hidden: tuple[Hidden, ...] = ()
    depth_noise: float = 1.0
    depth_missing: float = 0.02
    depth_outliers: float = 0.01

    def __post_init__(self) -> None:
        if self.skin not in SKIN_TONES:
            raise InputError("scene: skin", "one of " + ", ".join(SKIN_TONES), repr(self.skin))
        if not 0.0 < self.light <= 10.0:
            raise InputError("scene: light", "a factor above 0, at most 10", repr(self.light))
        if not 1500.0 <= self.colour_temperature <= 25000.0:
            raise InputError("scene: colour_temperature", "1500 to 25000 K", repr(self.colour_temperature))
        for name in (
            "shutter",
            "lens_blur",
            "sensor_noise",
            "depth_noise",
            "depth_missing",
            "depth_outliers",
        ):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InputError(f"scene: {name}", "a number not below zero", repr(getattr(self, name)))
        if not 0.0 < self.marker_diameter < 0.1:
            raise InputError("scene: marker_diameter", "metres, below 0.1", repr(self.marker_diameter))

    @property
    def illuminant(self) -> FloatArray:
        """Gains (3,) of red, green and blue: Planck's law at three wavelengths, relative to daylight and to green."""

        def power(kelvin: float) -> FloatArray:
            return np.asarray(_WAVELENGTHS**-5.0 / np.expm1(_PLANCK / (_WAVELENGTHS * kelvin)))

        gain = power(self.colour_temperature) / power(DAYLIGHT)
        return np.asarray(self.light * gain / gain[1])


def to_srgb(linear: FloatArray) -> FloatArray:
    """Linear light, 1 = white, in 8-bit steps of sRGB (not rounded), clipped at both ends."""
    x = np.clip(linear, 0.0, 1.0)
    return np.asarray(255.0 * np.where(x < 0.0031308, 12.92 * x, 1.055 * np.power(x, 1.0 / 2.4) - 0.055))

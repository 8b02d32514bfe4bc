"""A wrist that moves through its range before a camera, for rendered recordings."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp import lie
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import PALM_POINTS
from factorgrasp.simulation.hand_rendering import HandVideo
from factorgrasp.simulation.hand_scene import HandScene
from factorgrasp.typing import FloatArray

R_CAMERA_NEUTRAL = np.diag([1.0, -1.0, -1.0])
"""``R_c_w`` of a hand flat under the camera, fingers to the right."""
XTION = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
"""An Asus Xtion Pro Live, as in Cordella 2014."""


def wrist_swing(
    t: FloatArray, distance: float = 0.7, speed: float = 1.0, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Flexion, deviation and pronation of +-20 to 25 deg at three frequencies, phases by the seed, and some travel.

    Returns
    -------
    (ndarray, ndarray)
        ``R_c_w`` (n, 3, 3) and ``p_c_w`` (n, 3), m. At speed 1 the peak rates are about 1 rad/s and 0.15 m/s.
    """
    rng = np.random.default_rng([seed, 11])
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    s = speed * np.asarray(t)
    angles = np.column_stack(
        [
            0.35 * np.sin(2.0 * s + phase[0]),
            0.35 * np.sin(1.5 * s + phase[1]),
            0.44 * np.sin(2.5 * s + phase[2]),
        ]
    )
    R = R_CAMERA_NEUTRAL @ lie.so3_exp(angles)
    scale = distance / 0.7
    travel = np.column_stack(
        [
            -0.04 * scale + 0.05 * np.sin(2.0 * s + phase[3]),
            0.01 + 0.04 * np.sin(1.6 * s + phase[4]),
            distance + 0.03 * np.sin(s + phase[5]),
        ]
    )
    return R, travel


def swinging_hand(
    frames: int,
    scene: HandScene | None = None,
    seed: int = 0,
    distance: float = 0.7,
    speed: float = 1.0,
    layout: ArrayLike = PALM_POINTS,
    camera: Camera = XTION,
) -> HandVideo:
    """A rendered recording of :func:`wrist_swing` at the camera's rate."""
    t = np.arange(frames) / camera.rate
    R, p = wrist_swing(t, distance, speed, seed)
    return HandVideo(camera, t, R, p, np.asarray(layout, dtype=float), scene or HandScene(), seed)

"""What the wrist-pose problem assumes about noise, blobs and motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray

Motion = Literal["acceleration", "jerk"]
Method = Literal["joint", "assignment", "blob"]
LayoutUse = Literal["estimate", "noise", "exact"]


@dataclass(frozen=True)
class WristNoise:
    """Standard deviations of the measurements and spectral densities of the motion.

    Attributes
    ----------
    pixel_sd : float
        Of a blob's centroid in u and in v, px, where the recording holds no covariance of its own.
    depth_sd : float or None
        Of a blob's depth, m; None: that of a structured-light camera, ``1.2 mm + 1.9 mm/m^2 (z - 0.4 m)^2`` (Nguyen 2012).
    calibration_sd : float
        Error of the camera's calibration as a displacement across the ray, m; adds ``(f s / z)^2`` to the variance of a pixel.
    motion : {"acceleration", "jerk"}
        What is white noise: the acceleration (constant-velocity prior), or the jerk.
    translation_density : float or None
        Square root of its spectral density: m/s^1.5 (acceleration) or m/s^2.5 (jerk). None: 0.3 or 3, adapted to the data if `adapt`.
    rotation_density : float or None
        rad/s^1.5 or rad/s^2.5. None: 1.5 or 15, adapted to the data if `adapt`.
    adapt : bool
        Fit densities that are None to the motion (expectation maximisation over the smoothed track).
    """

    pixel_sd: float = 1.0
    depth_sd: float | None = None
    calibration_sd: float = 0.0
    motion: Motion = "acceleration"
    translation_density: float | None = None
    rotation_density: float | None = None
    adapt: bool = True

    def __post_init__(self) -> None:
        for name in ("pixel_sd", "depth_sd", "translation_density", "rotation_density"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise InputError(f"noise: {name}", "a finite number above zero", repr(value))
        if not (np.isfinite(self.calibration_sd) and 0.0 <= self.calibration_sd < 0.1):
            raise InputError("noise: calibration_sd", "metres, from 0 to 0.1", repr(self.calibration_sd))
        if self.pixel_sd > 50.0:
            raise InputError("noise: pixel_sd", "pixels, at most 50", repr(self.pixel_sd))
        if self.depth_sd is not None and self.depth_sd > 0.5:
            raise InputError(
                "noise: depth_sd", "metres, at most 0.5", repr(self.depth_sd), "Is it in millimetres?"
            )
        if self.motion not in ("acceleration", "jerk"):
            raise InputError("noise: motion", "'acceleration' or 'jerk'", repr(self.motion))

    def depth_variance(self, depth: FloatArray) -> FloatArray:
        """Variance (m,) of depths (m,), m^2."""
        if self.depth_sd is not None:
            return np.full(np.shape(depth), self.depth_sd**2)
        return np.asarray((1.2e-3 + 1.9e-3 * (np.asarray(depth) - 0.4) ** 2) ** 2)

    @property
    def densities(self) -> FloatArray:
        """Spectral densities [rotation, translation] to begin with: squares of the two attributes or of their defaults."""
        rotation, translation = (1.5, 0.3) if self.motion == "acceleration" else (15.0, 3.0)
        return np.array([self.rotation_density or rotation, self.translation_density or translation]) ** 2


@dataclass(frozen=True)
class WristAssociation:
    """How blobs are given to markers.

    Attributes
    ----------
    method : {"joint", "assignment", "blob"}
        Joint compatibility (the most probable joint assignment), global assignment of independent pairs (Hungarian), or the paper's most
        probable marker of every blob by itself.
    detection : float
        Probability that a marker is seen in a frame. What is missed may be hidden or overlooked.
    clutter : float
        Expected blobs a frame that belong to no marker, spread over the image.
    adapt : bool
        Estimate both rates along with the track (the given values count as 30 frames of data).
    gate : float
        Probability with which a true pair passes the gate.
    depth : bool
        Use depth to associate; False: pixels alone (for comparison: it loses most runs with clutter near the hand).
    uncertain_px : float
        Predicted standard deviation of a pixel above which only `support` jointly compatible markers may update the track.
    support : int
        At least three.
    lost_after : float
        s without a trusted update after which the track is lost and has to be found again by a labelling search.
    """

    method: Method = "joint"
    detection: float = 0.9
    clutter: float = 2.0
    adapt: bool = True
    gate: float = 0.9995
    depth: bool = True
    uncertain_px: float = 30.0
    support: int = 3
    lost_after: float = 0.25

    def __post_init__(self) -> None:
        if self.method not in ("joint", "assignment", "blob"):
            raise InputError("association: method", "'joint', 'assignment' or 'blob'", repr(self.method))
        for name in ("detection", "gate"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InputError(
                    f"association: {name}", "a probability between 0 and 1", repr(getattr(self, name))
                )
        if not (np.isfinite(self.clutter) and 0.0 <= self.clutter <= 1000.0):
            raise InputError("association: clutter", "expected blobs a frame, at least 0", repr(self.clutter))
        if self.support < 3:
            raise InputError("association: support", "at least 3", repr(self.support))
        if not self.uncertain_px > 0.0 or not self.lost_after > 0.0:
            raise InputError(
                "association: uncertain_px and lost_after", "numbers above zero", "another value"
            )


@dataclass(frozen=True)
class WristSettings:
    """How the track is smoothed.

    Attributes
    ----------
    lag : int
        Frames of fixed-lag smoothing.
    layout : {"estimate", "noise", "exact"}
        What is done with the covariance of the layout: the layout is estimated with the track (default), its covariance is added to every
        residual, or it is ignored.
    loss_scale : float
        Of the Geman-McClure loss on every marker, standard deviations; infinite: none.
    start_frames : int
        Most frames that the frame ``W0`` is averaged over, as long as the hand is still.
    """

    lag: int = 10
    layout: LayoutUse = "estimate"
    loss_scale: float = 8.0
    start_frames: int = 15

    def __post_init__(self) -> None:
        if not 0 <= self.lag <= 200:
            raise InputError("settings: lag", "frames, 0 to 200", repr(self.lag))
        if self.layout not in ("estimate", "noise", "exact"):
            raise InputError("settings: layout", "'estimate', 'noise' or 'exact'", repr(self.layout))
        if not self.loss_scale > 1.0:
            raise InputError("settings: loss_scale", "standard deviations, above 1", repr(self.loss_scale))
        if self.start_frames < 1:
            raise InputError("settings: start_frames", "at least 1", repr(self.start_frames))

"""What a user may say about a grasp recording with two pose streams. Every entry has a default."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.losses import LOSSES, Loss, make_loss

FEWEST_CLUSTERS = 4
"""Fewer stretches cannot vouch for a covariance."""

# A norm of six components instead of one: sqrt(chi2) at 95 % for 6 over that for 1 degree of freedom, which keeps a loss's efficiency.
_LOSS_STRETCH = 3.548 / 1.345


@dataclass(frozen=True)
class GraspFromPosesNoise:
    """Noise of one comparison of both poses; starting values when `adapt_noise` is on.

    Attributes
    ----------
    rotation_sd, position_sd : float
        Of each component, both sides and the way between samples together, rad and m.
    time_offset_sd : float
        Prior of the time offset that remains after the coarse search, s.
    """

    rotation_sd: float = 0.01
    position_sd: float = 0.005
    time_offset_sd: float = 0.1

    def __post_init__(self) -> None:
        for item in fields(self):
            _above_zero(f"noise.{item.name}", getattr(self, item.name))


@dataclass(frozen=True)
class GraspFromPosesSettings:
    """What is estimated, and how the recordings are read.

    Attributes
    ----------
    time_offset : bool
        Estimate the offset between the two clocks (hand minus robot).
    time_offset_guess : float
        s; middle of the coarse search, or the known offset when `time_offset` is off.
    max_time_offset : float
        s; half width of the coarse search.
    adapt_noise : {"isotropic", "full", "none"}
        "isotropic": a variance of the rotation and one of the position, from the median residual. "full": a covariance (6, 6) in the
        hand frame, which knows that a camera's error in rotation and the one in position go together; far more precise when the errors are
        noise, but it trusts small systematic ones, too. "none": as declared.
    loss : {"huber", "cauchy", "geman_mcclure", "none"}
        On the whitened norm of each comparison (six components).
    loss_scale : float or None
        In standard deviations of that norm; None: the loss's default, stretched for six components (3.55 for Huber).
    clusters : int
        Number of stretches of the recording whose scores tell the covariance: residuals of different stretches count as independent,
        within a stretch anything is allowed. 0 trusts every sample to be independent.
    max_gap : float or None
        s; samples further apart are a gap, which is never bridged. None: by the regularity of the stamps.
    rotation_resolution, translation_resolution : float
        rad and m; a direction whose posterior sd is larger counts as not identified.
    """

    time_offset: bool = True
    time_offset_guess: float = 0.0
    max_time_offset: float = 1.0
    adapt_noise: Literal["isotropic", "full", "none"] = "isotropic"
    loss: Literal["huber", "cauchy", "geman_mcclure", "none"] = "huber"
    loss_scale: float | None = None
    clusters: int = 12
    max_gap: float | None = None
    rotation_resolution: float = 0.05
    translation_resolution: float = 0.03

    def __post_init__(self) -> None:
        make_loss(self.loss, self.loss_scale)
        if self.adapt_noise not in ("isotropic", "full", "none"):
            raise InputError("estimate.adapt_noise", "one of isotropic, full, none", repr(self.adapt_noise))
        for name in ("max_time_offset", "rotation_resolution", "translation_resolution"):
            _above_zero(f"estimate.{name}", getattr(self, name))
        if self.max_gap is not None:
            _above_zero("estimate.max_gap", self.max_gap)
        if not np.isfinite(self.time_offset_guess):
            raise InputError(
                "estimate.time_offset_guess", "a finite number of seconds", repr(self.time_offset_guess)
            )
        if self.clusters != 0 and self.clusters < FEWEST_CLUSTERS:
            raise InputError("estimate.clusters", f"0, or at least {FEWEST_CLUSTERS}", repr(self.clusters))

    def make_loss(self) -> Loss | None:
        """The loss at its scale for six components."""
        if self.loss == "none":
            return None
        default = LOSSES[self.loss]().scale * _LOSS_STRETCH
        return make_loss(self.loss, default if self.loss_scale is None else self.loss_scale)


def _above_zero(field: str, value: object) -> None:
    if (
        isinstance(value, bool)
        or not isinstance(value, (int, float))
        or not np.isfinite(value)
        or value <= 0.0
    ):
        raise InputError(field, "a finite number above zero", repr(value))

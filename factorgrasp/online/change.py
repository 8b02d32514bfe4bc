"""What the change detectors look for, and what they find."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from factorgrasp.online.jump_detector import Jump
from factorgrasp.typing import FloatArray, State

# Give of a firm hold, as part of the smallest change that is reported.
_GIVE = 0.2
# Soon after a change smaller ones count, by this factor.
_ALERT = 0.3


@dataclass(frozen=True)
class DetectorSettings:
    """When a change of the grasp is reported.

    Attributes
    ----------
    log_bayes_factor : float
        Evidence that is needed.
    smallest_angle, smallest_distance : float
        rad and m; a change that is smaller in both is not reported. No hold is quite rigid: a fifth of them counts as its give.
    """

    log_bayes_factor: float = 15.0
    smallest_angle: float = float(np.deg2rad(1.0))
    smallest_distance: float = 0.008

    @property
    def give(self) -> FloatArray:
        """Variances (6,) of the slight changes that are no event, rad^2 and m^2."""
        return np.repeat([(_GIVE * self.smallest_angle) ** 2, (_GIVE * self.smallest_distance) ** 2], 3)

    def reports(self, step: FloatArray) -> bool:
        """Whether a change by `step` (6,) is large enough."""
        angle, distance = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
        return bool(angle >= self.smallest_angle or distance >= self.smallest_distance)

    def alerted(self) -> DetectorSettings:
        """After a change: what may be the rest of it counts although it is smaller."""
        return replace(
            self,
            smallest_angle=_ALERT * self.smallest_angle,
            smallest_distance=_ALERT * self.smallest_distance,
        )


@dataclass(frozen=True)
class Change:
    """A change of the grasp that was found.

    Attributes
    ----------
    kind : {"regrasp", "slip"}
    time : float
        When it began (s, robot clock).
    rows : int
        Newest rows that belong to the grasp after.
    before : State
    before_covariance : (n, n) ndarray
        Estimate from data before the change.
    jump : Jump
    large : bool
        Above the smallest change that is reported when the grasp has not just changed.
    """

    kind: Literal["regrasp", "slip"]
    time: float
    rows: int
    before: State
    before_covariance: FloatArray
    jump: Jump
    large: bool

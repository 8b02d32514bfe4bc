"""What happened to a grasp while it was watched."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from factorgrasp.typing import FloatArray


@dataclass(frozen=True)
class GraspEvent:
    """The hand holds elsewhere than before: at once (regrasp) or moving slowly (slip).

    Attributes
    ----------
    kind : {"regrasp", "slip"}
    time : float
        When it began, s, robot clock.
    detected : float
        Time of the newest data when it was found first, s.
    until : float
        When it was seen to go on for the last time, s; `detected` if only once.
    step : (6,) ndarray
        How far, [rotation vector; translation]: ``log(R_before' R_after)`` (rad, hand frame before) and ``p_after - p_before`` (m,
        end-effector frame). Refined while data of the grasp after come in, until the next event.
    covariance : (6, 6) ndarray
        Of `step`.
    log_bayes_factor : float
        Evidence for a change against none when it was found.
    """

    kind: Literal["regrasp", "slip"]
    time: float
    detected: float
    until: float
    step: FloatArray
    covariance: FloatArray
    log_bayes_factor: float

    @property
    def rotation(self) -> FloatArray:
        """Rotation vector (3,), rad."""
        return self.step[:3]

    @property
    def translation(self) -> FloatArray:
        """Displacement (3,), m."""
        return self.step[3:]

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad."""
        return float(np.linalg.norm(self.rotation))

    @property
    def distance(self) -> float:
        """Length of the displacement, m."""
        return float(np.linalg.norm(self.translation))

    @property
    def angle_sd(self) -> float:
        """Standard deviation of `angle`, rad."""
        return _norm_sd(self.rotation, self.covariance[:3, :3])

    @property
    def distance_sd(self) -> float:
        """Standard deviation of `distance`, m."""
        return _norm_sd(self.translation, self.covariance[3:, 3:])

    def __str__(self) -> str:
        span = f"{self.time:.2f} s" if self.kind == "regrasp" else f"{self.time:.2f} to {self.until:.2f} s"
        angle, angle_sd = math.degrees(self.angle), math.degrees(self.angle_sd)
        return (
            f"{self.kind} at {span}: {angle:.2f} deg (sd {angle_sd:.2f}), {1e3 * self.distance:.1f} mm "
            f"(sd {1e3 * self.distance_sd:.1f}), log Bayes factor {self.log_bayes_factor:.0f}"
        )


def _norm_sd(vector: FloatArray, covariance: FloatArray) -> float:
    size = float(np.linalg.norm(vector))
    if size == 0.0:
        return float(np.sqrt(np.trace(covariance) / 3.0))
    along = vector / size
    return math.sqrt(max(float(along @ covariance @ along), 0.0))

"""What every typed view of a grasp offers, whichever problem it answers."""

from __future__ import annotations

import numpy as np

from factorgrasp import lie
from factorgrasp.estimate import Estimate
from factorgrasp.observability import Observability
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray


class EstimateView:
    """Views that carry the general answer in `estimate`."""

    estimate: Estimate

    @property
    def status(self) -> Status:
        """How the solve ended."""
        return self.estimate.status

    @property
    def solved(self) -> bool:
        """Whether the status is `Status.SOLVED`."""
        return self.estimate.solved

    @property
    def message(self) -> str:
        """Why it ended so and what would help."""
        return self.estimate.message

    @property
    def observability(self) -> Observability | None:
        """Directions that the motion showed or did not show."""
        return self.estimate.observability

    def closing_lines(self) -> list[str]:
        """The end of a summary: what is not identified, and the message."""
        lines = []
        if self.observability is not None:
            for missing in self.observability.missing:
                size = "unknown" if not np.isfinite(missing.sd) else f"sd {missing.sd:.3g} {missing.unit}"
                lines.append(f"  not identified: {missing.words} ({size})")
        return [*lines, f"  {self.message}"] if self.message else lines


class PoseView:
    """Views of one grasp: `rotation` is ``R_r_h`` (3, 3), `translation` is ``p_r_h`` (3,) in m."""

    rotation: FloatArray
    translation: FloatArray

    @property
    def rotation_wxyz(self) -> FloatArray:
        """``R_r_h`` as unit quaternion [w, x, y, z], w >= 0."""
        return lie.matrix_to_quaternion_wxyz(self.rotation)

    @property
    def pose(self) -> FloatArray:
        """``T_r_h`` as a homogeneous matrix (4, 4)."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation
        return out

    def error_to(self, rotation: FloatArray, translation: FloatArray) -> FloatArray:
        """Tangent vector (6,) from this grasp to another, in the coordinates of its covariance.

        For NEES and comparisons: ``[Log(R' rotation); translation - p]``, rad and m.

        Parameters
        ----------
        rotation : (3, 3) ndarray
            ``R_r_h``.
        translation : (3,) ndarray
            ``p_r_h``, m.
        """
        return np.concatenate([lie.so3_log(self.rotation.T @ rotation), translation - self.translation])


def grasp_covariance(estimate: Estimate) -> FloatArray:
    """Covariance (6, 6) of [rotation; translation]; NaN where the solve left none."""
    if estimate.covariance_source is None:
        return np.full((6, 6), np.nan)
    return estimate.covariance("rotation", "translation")

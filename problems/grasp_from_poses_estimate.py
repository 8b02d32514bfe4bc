"""The typed answer to a grasp problem with two pose streams."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgrasp import lie
from factorgrasp.estimate import Estimate
from factorgrasp.problems.grasp_view import EstimateView, PoseView, grasp_covariance
from factorgrasp.typing import FloatArray, JsonDict, State


@dataclass(frozen=True)
class GraspFromPosesDiagnostics:
    """How the recordings were used, for reports and checks.

    Attributes
    ----------
    t : (n,) ndarray
        Samples compared, s, on the clock of the sampled (slower) side.
    rotation_residual, position_residual : (n, 3) ndarray
        What the robot predicts against what the other sensor measured, hand frame, rad and m.
    weight : (n,) ndarray
        Robust weights, 0 to 1.
    noise_covariance : (6, 6) ndarray
        Of one comparison, [rotation; position], as used for weighting.
    sampled : str
        Name of the sampled side.
    samples_used, samples_dropped : int
        Dropped: outside of the other recording, or beside one of its gaps.
    clock_correlation : float
        Of the coarse time-offset search.
    rotation_spread : (3,) ndarray
        Eigenvalues of ``I - M'M``, M the mean of ``R_w_r``, ascending: information on the lever arm a sample, 0 to 1.
    """

    t: FloatArray
    rotation_residual: FloatArray
    position_residual: FloatArray
    weight: FloatArray
    noise_covariance: FloatArray
    sampled: str
    samples_used: int
    samples_dropped: int
    clock_correlation: float
    rotation_spread: FloatArray

    @property
    def rotation_rms(self) -> float:
        """Root mean square angle between both sides, rad."""
        return float(np.sqrt(np.mean(np.sum(self.rotation_residual**2, axis=1))))

    @property
    def position_rms(self) -> float:
        """Root mean square distance between both sides, m."""
        return float(np.sqrt(np.mean(np.sum(self.position_residual**2, axis=1))))


@dataclass(frozen=True)
class GraspFromPosesEstimate(EstimateView, PoseView):
    """Where the second sensor sits on the end-effector, with an honest covariance.

    Attributes
    ----------
    estimate : Estimate
        The general answer with all unknowns.
    rotation : (3, 3) ndarray
        ``R_r_h``.
    translation : (3,) ndarray
        ``p_r_h``, m.
    covariance : (6, 6) ndarray
        Order [rotation; translation]; rotation as right perturbation of ``R_r_h``, rad and m.
    time_offset, time_offset_sd : float
        s, hand clock minus robot clock; sd 0 when it was given.
    world_rotation : (3, 3) ndarray
        ``R_w_t``: the hand sensor's world in the robot's.
    world_translation : (3,) ndarray
        ``p_w_t``, m.
    diagnostics : GraspFromPosesDiagnostics
    """

    estimate: Estimate
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    time_offset: float
    time_offset_sd: float
    world_rotation: FloatArray
    world_translation: FloatArray
    diagnostics: GraspFromPosesDiagnostics

    @classmethod
    def from_estimate(
        cls, estimate: Estimate, state: State, diagnostics: GraspFromPosesDiagnostics
    ) -> GraspFromPosesEstimate:
        """Typed view of a solver's answer."""
        estimated = any(variable.name == "time_offset" for variable in estimate.variables)
        has_covariance = estimate.covariance_source is not None
        return cls(
            estimate=estimate,
            rotation=np.asarray(state["rotation"]),
            translation=np.asarray(state["translation"]),
            covariance=grasp_covariance(estimate),
            time_offset=float(state["time_offset"][0]),
            time_offset_sd=(float(estimate.sd("time_offset")[0]) if has_covariance else np.nan)
            if estimated
            else 0.0,
            world_rotation=np.asarray(state["world_rotation"]),
            world_translation=np.asarray(state["world_translation"]),
            diagnostics=diagnostics,
        )

    @property
    def world_rotation_wxyz(self) -> FloatArray:
        """``R_w_t`` as unit quaternion [w, x, y, z], w >= 0."""
        return lie.matrix_to_quaternion_wxyz(self.world_rotation)

    def summary(self) -> str:
        """A few lines for a terminal."""
        sd = np.sqrt(np.diag(self.covariance))
        d = self.diagnostics
        lines = [
            f"grasp pose from poses: {self.status.value} by {self.estimate.solver}",
            f"  rotation R_r_h [w x y z]   {_row(self.rotation_wxyz, 6)}   sd {_row(np.degrees(sd[:3]), 3)} deg",
            f"  translation p_r_h          {_row(1e3 * self.translation, 2)} mm   sd {_row(1e3 * sd[3:], 2)} mm",
            f"  time offset hand - robot   {1e3 * self.time_offset:.3f} ms   sd {1e3 * self.time_offset_sd:.3f} ms",
            f"  other world R_w_t, p_w_t   {_row(self.world_rotation_wxyz, 6)}   {_row(self.world_translation, 4)} m",
            f"  residual rms               {np.degrees(d.rotation_rms):.3f} deg   {1e3 * d.position_rms:.2f} mm   "
            f"({d.samples_used} samples of {d.sampled!r}, {d.samples_dropped} left out)",
        ]
        lines += self.closing_lines()
        return "\n".join(lines)

    def to_dict(self) -> JsonDict:
        """The content of ``estimate.json``."""
        d = self.diagnostics
        out = self.estimate.to_dict()
        out["values"] = {
            "grasp": {
                "rotation_wxyz": self.rotation_wxyz.tolist(),
                "translation": self.translation.tolist(),
                "covariance": self.covariance.tolist(),
            },
            "time_offset": self.time_offset,
            "time_offset_sd": self.time_offset_sd,
            "world": {
                "rotation_wxyz": self.world_rotation_wxyz.tolist(),
                "translation": self.world_translation.tolist(),
            },
        }
        out["data"] = {
            "sampled": d.sampled,
            "samples_used": d.samples_used,
            "samples_dropped": d.samples_dropped,
            "rotation_rms": d.rotation_rms,
            "position_rms": d.position_rms,
            "clock_correlation": d.clock_correlation,
            "rotation_spread": d.rotation_spread.tolist(),
        }
        return out

    def arrays(self) -> dict[str, FloatArray]:
        """The content of ``estimate.npz``."""
        d = self.diagnostics
        out = {
            "rotation": self.rotation,
            "rotation_wxyz": self.rotation_wxyz,
            "translation": self.translation,
            "covariance": self.covariance,
            "world_rotation": self.world_rotation,
            "world_translation": self.world_translation,
            "t": d.t,
            "rotation_residual": d.rotation_residual,
            "position_residual": d.position_residual,
            "weight": d.weight,
            "noise_covariance": d.noise_covariance,
        }
        if self.estimate.covariance_source is not None:
            out["full_covariance"] = self.estimate.covariance()
        return out

    def save(self, directory: str | Path) -> Path:
        """Write ``estimate.json`` and ``estimate.npz`` atomically; returns the JSON's path."""
        from factorgrasp.results import write_result

        return write_result(Path(directory), self.to_dict(), self.arrays())


def _row(values: FloatArray, digits: int) -> str:
    return " ".join(f"{v:.{digits}f}" for v in np.atleast_1d(values))

"""The typed answer to a grasp problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp.estimate import Estimate, TermSummary
from factorgrasp.problems import grasp_words
from factorgrasp.problems.grasp_recording import SMALLEST_CORRELATION
from factorgrasp.problems.grasp_view import EstimateView, PoseView, grasp_covariance
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, JsonDict

if TYPE_CHECKING:
    from factorgrasp.problems.grasp_pose import GraspPose


@dataclass(frozen=True)
class GraspDiagnostics:
    """How the recording was used, for reports and checks.

    Attributes
    ----------
    t : (windows,) ndarray
        Centres of the windows used, s, robot clock.
    gyro_residual, accelerometer_residual : (windows,) ndarray
        Root mean square of the residual's norm in every window, rad/s and m/s^2, over the bandwidth used.
    window_weight : (windows,) ndarray
        Weight of every window (forgetting, robust loss).
    frequencies : (K,) ndarray
        Hz.
    gyro_density, accelerometer_density : (K,) ndarray
        Residual per band, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
    declared_gyro_density, declared_accelerometer_density : (K,) ndarray
        What the declared noise predicts.
    windows_used, windows_dropped : int
    window_seconds : float
    samples_used : float
        Share of the grid's samples that lie in a used window.
    robot_gaps, hand_gaps : (int, float, int)
        Number of gaps, seconds missing, incomplete rows.
    excitation : (3,) ndarray
        Eigenvalues of the weighted ``sum phi' phi``: information on the lever arm, 1/m^2, ascending.
    rate_moment : (3, 3) ndarray
        Mean of ``w_r w_r'``.
    clock_correlation, clock_ambiguity : float
        Of the coarse time-offset search.
    bandwidth, kinematics_bandwidth : float
        Hz.
    slow_force_residual : float
        Root mean square per axis of the specific forces' disagreement in the two lowest bands, m/s^2.
    """

    t: FloatArray
    gyro_residual: FloatArray
    accelerometer_residual: FloatArray
    window_weight: FloatArray
    frequencies: FloatArray
    gyro_density: FloatArray
    accelerometer_density: FloatArray
    declared_gyro_density: FloatArray
    declared_accelerometer_density: FloatArray
    windows_used: int
    windows_dropped: int
    window_seconds: float
    samples_used: float
    robot_gaps: tuple[int, float, int]
    hand_gaps: tuple[int, float, int]
    excitation: FloatArray
    rate_moment: FloatArray
    clock_correlation: float
    clock_ambiguity: float
    bandwidth: float
    kinematics_bandwidth: float
    slow_force_residual: float


@dataclass(frozen=True)
class GraspPoseEstimate(EstimateView, PoseView):
    """Where the human grasped, with an honest covariance.

    Attributes
    ----------
    estimate : Estimate
        The general answer with all unknowns.
    rotation : (3, 3) ndarray
        ``R_r_h``, hand to end-effector.
    translation : (3,) ndarray
        ``p_r_h``, hand origin (where its IMU sits) in the end-effector frame, m.
    covariance : (6, 6) ndarray
        Order [rotation; translation]; rotation as right perturbation of ``R_r_h``, rad and m.
    time_offset, time_offset_sd : float
        s, hand clock minus robot clock; sd 0 when it was given.
    gyro_bias, accelerometer_bias : (3,) ndarray
        rad/s and m/s^2, in the hand's sensor frame.
    gyro_bias_sd, accelerometer_bias_sd : (3,) ndarray
    diagnostics : GraspDiagnostics
    """

    estimate: Estimate
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    time_offset: float
    time_offset_sd: float
    gyro_bias: FloatArray
    gyro_bias_sd: FloatArray
    accelerometer_bias: FloatArray
    accelerometer_bias_sd: FloatArray
    diagnostics: GraspDiagnostics

    @classmethod
    def from_estimate(cls, estimate: Estimate, problem: GraspPose) -> GraspPoseEstimate:
        """Typed view of a solver's answer to `problem`."""
        state = estimate.values
        names = {variable.name for variable in estimate.variables}
        shift = float(state["time_offset"][0]) if "time_offset" in names else 0.0
        total = problem.time_offset + shift
        values = dict(state)
        if "time_offset" in names:
            values["time_offset"] = np.array([total])
        diagnostics = problem.diagnostics(state)
        estimate = replace(estimate, values=values, residuals=_summaries(estimate, problem, diagnostics))
        if diagnostics.clock_correlation < SMALLEST_CORRELATION:
            words = grasp_words.unrelated(diagnostics.clock_correlation, diagnostics.rate_moment)
            estimate = replace(estimate, status=Status.UNOBSERVABLE, message=words)
        else:
            words = grasp_words.contradiction(values, problem.noise, diagnostics.slow_force_residual)
            if words:
                estimate = replace(estimate, status=Status.NOT_CONVERGED, message=words)

        def bias(name: str) -> tuple[FloatArray, FloatArray]:
            if name not in names:
                return np.zeros(3), np.zeros(3)
            return np.asarray(values[name]), estimate.sd(name)

        gyro_bias, gyro_bias_sd = bias("gyro_bias")
        accelerometer_bias, accelerometer_bias_sd = bias("accelerometer_bias")
        return cls(
            estimate=estimate,
            rotation=np.asarray(values["rotation"]),
            translation=np.asarray(values["translation"]),
            covariance=grasp_covariance(estimate),
            time_offset=total,
            time_offset_sd=_time_offset_sd(estimate, problem),
            gyro_bias=gyro_bias,
            gyro_bias_sd=gyro_bias_sd,
            accelerometer_bias=accelerometer_bias,
            accelerometer_bias_sd=accelerometer_bias_sd,
            diagnostics=diagnostics,
        )

    def summary(self) -> str:
        """A few lines for a terminal."""
        sd = np.sqrt(np.diag(self.covariance))
        w, x, y, z = self.rotation_wxyz
        lines = [
            f"grasp pose: {self.status.value} by {self.estimate.solver}",
            f"  rotation R_r_h [w x y z]   {w:.6f} {x:.6f} {y:.6f} {z:.6f}   sd {_triple(np.degrees(sd[:3]), 4)} deg",
            f"  translation p_r_h          {_triple(1e3 * self.translation, 2)} mm   sd {_triple(1e3 * sd[3:], 2)} mm",
            f"  time offset hand - robot   {1e3 * self.time_offset:.3f} ms   sd {1e3 * self.time_offset_sd:.3f} ms",
            f"  gyroscope bias             {_triple(self.gyro_bias, 5)} rad/s   sd {_triple(self.gyro_bias_sd, 5)}",
            f"  accelerometer bias         {_triple(self.accelerometer_bias, 4)} m/s^2   sd {_triple(self.accelerometer_bias_sd, 4)}",
        ]
        lines += self.closing_lines()
        return "\n".join(lines)

    def to_dict(self) -> JsonDict:
        """The content of ``estimate.json``."""
        out = self.estimate.to_dict()
        values: JsonDict = {
            "grasp": {
                "rotation_wxyz": self.rotation_wxyz.tolist(),
                "translation": self.translation.tolist(),
                "covariance": self.covariance.tolist(),
            },
            "time_offset": self.time_offset,
            "time_offset_sd": self.time_offset_sd,
            "gyro_bias": self.gyro_bias.tolist(),
            "gyro_bias_sd": self.gyro_bias_sd.tolist(),
            "accelerometer_bias": self.accelerometer_bias.tolist(),
            "accelerometer_bias_sd": self.accelerometer_bias_sd.tolist(),
        }
        for name in ("base_tilt", "accelerometer_delay", "gyro_calibration", "accelerometer_calibration"):
            if name in self.estimate.values:
                values[name] = np.asarray(self.estimate.values[name]).tolist()
                values[f"{name}_sd"] = self.estimate.sd(name).tolist()
        out["values"] = values
        d = self.diagnostics
        out["data"] = {
            "windows_used": d.windows_used,
            "windows_dropped": d.windows_dropped,
            "window_seconds": d.window_seconds,
            "samples_used": d.samples_used,
            "robot": {
                "gaps": d.robot_gaps[0],
                "seconds_missing": d.robot_gaps[1],
                "incomplete_rows": d.robot_gaps[2],
            },
            "hand": {
                "gaps": d.hand_gaps[0],
                "seconds_missing": d.hand_gaps[1],
                "incomplete_rows": d.hand_gaps[2],
            },
            "clock_correlation": d.clock_correlation,
            "bandwidth_hz": d.bandwidth,
            "kinematics_bandwidth_hz": d.kinematics_bandwidth
            if np.isfinite(d.kinematics_bandwidth)
            else None,
        }
        return out

    def arrays(self) -> dict[str, FloatArray]:
        """The content of ``estimate.npz``."""
        d = self.diagnostics
        return {
            "rotation": self.rotation,
            "rotation_wxyz": self.rotation_wxyz,
            "translation": self.translation,
            "covariance": self.covariance,
            "full_covariance": self.estimate.covariance(),
            "t": d.t,
            "gyro_residual": d.gyro_residual,
            "accelerometer_residual": d.accelerometer_residual,
            "window_weight": d.window_weight,
            "frequencies": d.frequencies,
            "gyro_density": d.gyro_density,
            "accelerometer_density": d.accelerometer_density,
            "declared_gyro_density": d.declared_gyro_density,
            "declared_accelerometer_density": d.declared_accelerometer_density,
            "excitation": d.excitation,
        }

    def save(self, directory: str | Path) -> Path:
        """Write ``estimate.json`` and ``estimate.npz`` atomically; returns the JSON's path."""
        from factorgrasp.results import write_result

        return write_result(Path(directory), self.to_dict(), self.arrays())

    def plot(self, path: str | Path) -> Path:
        """Draw the grasp, its uncertainty and the residuals into a picture file."""
        from factorgrasp.grasp_report import plot_grasp

        return plot_grasp(self, Path(path))


def _time_offset_sd(estimate: Estimate, problem: GraspPose) -> float:
    """Posterior sd, s; the prior's where the motion could not show the offset; 0 where it was given."""
    if any(variable.name == "time_offset" for variable in estimate.variables):
        return float(estimate.sd("time_offset")[0])
    return problem.noise.time_offset_sd if problem.settings.time_offset else 0.0


def _triple(values: FloatArray, digits: int) -> str:
    return " ".join(f"{v:.{digits}f}" for v in np.atleast_1d(values))


def _summaries(
    estimate: Estimate, problem: GraspPose, diagnostics: GraspDiagnostics
) -> tuple[TermSummary, ...]:
    """Residual summaries counted in independent numbers of the recording, not in compressed rows."""
    dof = problem.moments.dof.sum(axis=0)
    counts = {
        "gyroscope": round(3.0 * float(dof.sum())),
        "accelerometer": round(3.0 * float(dof[problem.variances.trusted].sum())),
    }
    weights = diagnostics.window_weight
    relative = weights / max(float(weights.max()), 1e-300)
    out = []
    for term in estimate.residuals:
        if term.name in counts:
            rows = counts[term.name]
            rms = float(np.sqrt(term.chi2 / max(rows, 1)))
            down = float(np.mean(relative < 0.5)) if problem.settings.loss != "none" else 0.0
            out.append(replace(term, rows=rows, rms=rms, worst=rms, down_weighted=down))
        else:
            out.append(term)
    return tuple(out)

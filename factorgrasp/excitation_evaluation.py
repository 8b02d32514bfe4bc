"""What measuring a trajectory gives back, and the files that it writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate
from factorgrasp.excitation_measures import WindowMeasures, excitation_index
from factorgrasp.excitation_motion import ExcitationMotion
from factorgrasp.excitation_prediction import GraspPrediction
from factorgrasp.models.wrist import WrenchSummary, WristStiffness
from factorgrasp.problems.grasp_words import axis_words
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, JsonDict

# Windows that estimate.json lists; all of them stand in estimate.npz.
_LISTED = 40


@dataclass(frozen=True)
class Demands:
    """What a motion has to reach.

    Attributes
    ----------
    window : float
        T of the excitation condition, s.
    alpha : float or None
        ``G >= alpha I`` over every window, s^-3.
    rotation_sd, translation_sd : float or None
        Largest standard deviation of the grasp in any direction at the end, rad and m.
    """

    window: float = 5.0
    alpha: float | None = None
    rotation_sd: float | None = None
    translation_sd: float | None = None

    def __post_init__(self) -> None:
        for name in ("window", "alpha", "rotation_sd", "translation_sd"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise InputError(f"evaluate.{name}", "a finite number above zero", repr(value))

    def missed(self, windows: WindowMeasures, prediction: GraspPrediction) -> list[str]:
        """In words, what was asked for and is not reached."""
        out = []
        if self.alpha is not None and not windows.meets(self.alpha):
            worst = windows.worst
            out.append(
                f"over the window from {windows.start[worst]:.2f} s lambda_min is {windows.lambda_min[worst]:.3g} s^-3, "
                f"and alpha = {self.alpha:.3g} was asked for (weakest axis {axis_words(windows.weakest[worst])})"
            )
        turn, way = prediction.worst_sd
        for name, limit, value, scale, unit in (
            ("rotation", self.rotation_sd, turn, 180.0 / np.pi, "deg"),
            ("lever arm", self.translation_sd, way, 1e3, "mm"),
        ):
            if limit is not None and value > limit:
                out.append(
                    f"the {name} will be known to {scale * value:.3g} {unit} (sd, worst direction), and "
                    f"{scale * limit:.3g} {unit} was asked for"
                )
        return out


@dataclass(frozen=True, eq=False)
class ExcitationEvaluation:
    """The excitation of a trajectory.

    Attributes
    ----------
    estimate : Estimate
        Status, message, observability, timing and provenance: what every answer of the library carries.
    motion : ExcitationMotion
    windows : WindowMeasures
    prediction : GraspPrediction
        What :class:`~factorgrasp.problems.GraspPose` will know after the motion.
    demands : Demands
    wrench : (n, 6) ndarray or None
        Of the wrist on the object, N and Nm, world axes; None where the trajectory has no positions.
    wrench_summary : WrenchSummary or None
    wrist : WristStiffness
    reference : str
        Which pose the wrist would keep: "start" or "mean".
    rotation, translation : ndarray
        The grasp at which it is judged.
    """

    estimate: Estimate
    motion: ExcitationMotion
    windows: WindowMeasures
    prediction: GraspPrediction
    demands: Demands
    wrench: FloatArray | None
    wrench_summary: WrenchSummary | None
    wrist: WristStiffness
    reference: str
    rotation: FloatArray
    translation: FloatArray

    @property
    def status(self) -> Status:
        """SOLVED when the motion shows all of the grasp and reaches what was asked for."""
        return self.estimate.status

    @property
    def message(self) -> str:
        """Why not, otherwise."""
        return self.estimate.message

    @property
    def index(self) -> FloatArray:
        """``|w x al|`` (s^-3) at every instant, (n,): the root of ``-det phi``."""
        kin = self.motion.kinematics
        return np.sqrt(-excitation_index(kin.angular_velocity, kin.angular_acceleration))

    def arrays(self) -> dict[str, Any]:
        """What ``estimate.npz`` holds."""
        w, p, kin = self.windows, self.prediction, self.motion.kinematics
        out: dict[str, Any] = {
            "t": kin.t,
            "angular_velocity": kin.angular_velocity,
            "angular_acceleration": kin.angular_acceleration,
            "det_phi": -(self.index**2),
            "window_start": w.start,
            "window_matrix": w.matrix,
            "window_eigenvalues": w.eigenvalues,
            "window_weakest_axis": w.weakest,
            "window_log_det": w.log_det,
            "window_condition": w.condition,
            "prediction_t": p.t,
            "prediction_covariance": p.covariance_over_time,
            "grasp_covariance": p.grasp_covariance,
        }
        if self.wrench is not None:
            out["wrist_wrench"] = self.wrench
        if self.motion.joints is not None:
            j = self.motion.joints
            out |= {"joint_t": j.t, "q": j.q, "qd": j.qd, "qdd": j.qdd, "torque": j.torque}
        return out

    def to_dict(self) -> JsonDict:
        """The summary that ``estimate.json`` holds."""
        from factorgrasp.estimate_io import to_dict

        out = to_dict(self.estimate)
        for key in ("variables", "values", "certificate", "multipliers", "objective", "iterations", "residuals",
                    "solver", "problem_hash"):  # fmt: skip
            out.pop(key, None)
        w, p, kin = self.windows, self.prediction, self.motion.kinematics
        worst, sd = w.worst, p.sd
        turn, way = p.worst_sd
        speed = np.linalg.norm(kin.angular_velocity, axis=1)
        change = np.linalg.norm(kin.angular_acceleration, axis=1)
        listed = np.unique(np.linspace(0, w.start.size - 1, min(_LISTED, w.start.size)).astype(int))
        out["motion"] = {
            "seconds": float(kin.t[-1] - kin.t[0]),
            "peak_angular_velocity": float(np.nanmax(speed)),
            "peak_angular_acceleration": float(np.nanmax(change)),
            "mean_index": float(np.nanmean(self.index)),
        }
        out["excitation"] = {
            "window": w.window,
            "centred": w.centred,
            "alpha": self.demands.alpha,
            "lambda_min": float(w.lambda_min[worst]),
            "lambda_min_median": float(np.median(w.lambda_min)),
            "worst_window_start": float(w.start[worst]),
            "weakest_axis": w.weakest[worst].tolist(),
            "condition_worst": float(np.max(w.condition)),
            "condition_median": float(np.median(w.condition)),
            "log_det_worst": float(np.min(w.log_det)),
            "noise_taken_out": w.noise,
            "windows": [
                {
                    "start": float(w.start[k]),
                    "eigenvalues": w.eigenvalues[k].tolist(),
                    "condition": float(w.condition[k]),
                    "log_det": float(w.log_det[k]),
                }
                for k in listed
            ],
        }
        out["predicted_grasp"] = {
            "rotation_sd": sd[:3].tolist(),
            "translation_sd": sd[3:].tolist(),
            "rotation_worst_sd": turn,
            "translation_worst_sd": way,
            "covariance": p.grasp_covariance.tolist(),
            "at_rotation": self.rotation.tolist(),
            "at_translation": self.translation.tolist(),
            "words": [d.words for d in p.observability.directions],
            "not_shown": [d.words for d in p.observability.missing],
        }
        if self.wrench_summary is not None:
            out["wrist"] = {
                "translation_stiffness": self.wrist.translation,
                "rotation_stiffness": self.wrist.rotation,
                "reference": self.reference,
                **self.wrench_summary.to_dict(),
            }
        if self.motion.joints is not None:
            joints = self.motion.joints
            out["joints"] = joints.margins()
            if joints.correlation is not None:
                for name, value in zip(joints.names, joints.correlation, strict=True):
                    out["joints"][name]["torque_correlation"] = float(value)
        out["units"] = "SI and rad; excitation eigenvalues in s^-3, det phi in s^-6"
        return out

    def save(self, directory: str | Path) -> Path:
        """Write ``estimate.json`` and ``estimate.npz`` into `directory`, each atomically; returns the JSON's path."""
        from factorgrasp.results import write_result

        return write_result(Path(directory), self.to_dict(), self.arrays())

    def summary(self) -> str:
        """A few lines for a terminal."""
        w, p = self.windows, self.prediction
        turn, way = p.worst_sd
        k = w.worst
        lines = [
            f"excitation of {self.motion.t[-1] - self.motion.t[0]:.1f} s: {self.status.value}",
            f"  lambda_min over every window of {w.window:.2f} s: {w.lambda_min[k]:.4g} s^-3 at worst (from {w.start[k]:.2f} s, "
            f"weakest axis {axis_words(w.weakest[k])}), median {np.median(w.lambda_min):.4g}; condition at worst {np.max(w.condition):.3g}",
            f"  the grasp will be known to {np.degrees(turn):.3g} deg and {1e3 * way:.3g} mm (sd of the worst direction)",
        ]
        if self.wrench_summary is not None:
            s = self.wrench_summary
            lines.append(
                f"  a wrist that keeps its {'first' if self.reference == 'start' else 'mean'} pose feels {s.peak_force:.3g} N and "
                f"{s.peak_torque:.3g} Nm at most, {s.rms_force:.3g} N and {s.rms_torque:.3g} Nm RMS"
            )
        joints = self.motion.joints
        if joints is not None and joints.correlation is not None:
            values = ", ".join(f"{value:.3f}" for value in joints.correlation)
            lines.append(f"  correlation of predicted and measured torque by joint: {values}")
        if self.message:
            lines.append(f"  {self.message}")
        return "\n".join(lines)

"""What planning an excitation gives back, and the files that it writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.atomic import replacing
from factorgrasp.estimate import Estimate
from factorgrasp.problems.excitation import Excitation, Margin, PlanCheck, information_of
from factorgrasp.problems.excitation_space import PlanSpace
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, JsonDict

TRAJECTORY_NAME = "trajectory.csv"


@dataclass(frozen=True, eq=False)
class ExcitationPlan:
    """A planned motion on its fine grid.

    Attributes
    ----------
    estimate : Estimate
        Status, reason, objective, timing and provenance.
    problem : Excitation
    space : PlanSpace
    coefficients : ndarray
        Of the basis, in that space.
    t : ndarray (n,)
        s.
    position, rotation : ndarray (n, 3), (n, 3, 3)
        ``p_w_r`` and ``R_w_r`` of the end-effector.
    angular_velocity, angular_acceleration, specific_force : ndarray (n, 3)
        In the end-effector's axes; the last at the wrist.
    turn : ndarray (n, 3)
        Rotation vector from the orientation that the human wants, end-effector's axes, rad.
    q, qd, qdd, tau : ndarray (n, joints)
        Empty without a robot.
    wrench : ndarray (n, 6)
        Predicted ``[force; moment]`` on the robot's side at the wrist by its stiffness, world axes, N and Nm, for the estimated grasp.
    force_rms : ndarray (n,)
        N; size of the force expected over the uncertainty of the grasp.
    check : PlanCheck
    share : float
        Of the excitation asked for that the worst window has.
    binding : tuple of str
        Limits that bind.
    predicted_covariance : ndarray (6, 6)
        Of [turn about the end-effector's axes, lever arm] after the motion, by the grasp estimator's information and what was known.
    """

    estimate: Estimate
    problem: Excitation
    space: PlanSpace
    coefficients: FloatArray
    t: FloatArray
    position: FloatArray
    rotation: FloatArray
    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    specific_force: FloatArray
    turn: FloatArray
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    tau: FloatArray
    wrench: FloatArray
    force_rms: FloatArray
    check: PlanCheck
    share: float
    binding: tuple[str, ...]
    predicted_covariance: FloatArray

    @staticmethod
    def of(
        problem: Excitation, space: PlanSpace, C: FloatArray, estimate: Estimate, check: PlanCheck, binding: tuple[str, ...],
        share: float,
    ) -> ExcitationPlan:  # fmt: skip
        """Read a plan off its coefficients."""
        t, wrist = problem.grid, problem.wrist
        x = [problem.on_grid(space, C, order) for order in range(3)]
        read = space.read.values(np.concatenate(x), space.motion.given(t))
        R = read[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1)
        turn, away = read[:, 21:24], read[:, 25:28]
        reference = problem.human.orientation(t) @ problem.grasp.rotation.T
        moment = -wrist.moment_stiffness * np.einsum("nij,nj->ni", reference, turn)
        none = np.empty((t.size, 0))
        q, qd, qdd, tau = none, none, none, none
        if space.name == "joint" and problem.arm is not None:
            q, qd, qdd = (part.T for part in x)
            tau = np.array(problem.arm.robot.rnea_function().map(t.size)(*x).full()).T
        information = information_of(read, t, problem.sensor_noise, problem.grasp.information_r)
        return ExcitationPlan(
            estimate, problem, space, C, t, read[:, 9:12], R, read[:, 12:15], read[:, 15:18], read[:, 18:21], turn, q, qd, qdd, tau,
            np.hstack([wrist.force_stiffness * away, moment]), wrist.force_stiffness * np.sqrt(np.maximum(read[:, 24], 0.0)),
            check, share, binding, np.asarray(np.linalg.inv(information), dtype=np.float64),
        )  # fmt: skip

    @property
    def status(self) -> Status:
        """How planning ended."""
        return self.estimate.status

    @property
    def message(self) -> str:
        """Why not, when it is not solved."""
        return self.estimate.message

    @property
    def objective(self) -> float:
        """Mean of ``|f|^2 / comfort_force^2 + |m|^2 / comfort_moment^2``."""
        return self.estimate.objective

    @property
    def predicted_sd(self) -> FloatArray:
        """(6,) of [turn about the end-effector's axes (rad), lever arm (m)]."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.predicted_covariance), 0.0)))

    @property
    def lambda_min(self) -> FloatArray:
        """Least eigenvalue of the excitation matrix of every window on the grid; empty when standard deviations were asked for."""
        alpha = self.problem.settings.alpha
        return np.empty(0) if alpha is None else self.check.window_share * alpha

    @property
    def det_phi(self) -> FloatArray:
        """(n,) ``det phi = -|w x al|^2``: how exciting every instant is."""
        cross = np.cross(self.angular_velocity, self.angular_acceleration)
        return np.asarray(-np.sum(cross**2, axis=1))

    @property
    def coning_ratio(self) -> float:
        """Mean square of the turn, over that of steady coning at the bandwidth with the same excitation, ``lambda_min = T w^4 A^2 / 2``."""
        s = self.problem.settings
        if s.alpha is None:
            return float("nan")
        w = 2.0 * np.pi * np.floor(s.duration * s.bandwidth * (1.0 + 1e-9)) / s.duration
        square = 2.0 * s.alpha / (s.window_length * w**4)
        return float(np.trapezoid(np.sum(self.turn**2, axis=1), self.t) / s.duration / square)

    def margin(self, name: str) -> Margin:
        """The margin of a limit whose name contains `name`; the smallest of several."""
        found = [one for one in self.check.margins if name in one.name]
        return min(found, key=lambda one: one.relative)

    def table(self) -> dict[str, FloatArray]:
        """Columns of ``trajectory.csv`` by name."""
        out: dict[str, FloatArray] = {"t": self.t}
        for name, values in (("q", self.q), ("qd", self.qd), ("qdd", self.qdd), ("tau", self.tau)):
            out |= {f"{name}{j + 1}": values[:, j] for j in range(values.shape[1])}
        out |= {f"p{a}": self.position[:, k] for k, a in enumerate("xyz")}
        quaternion = lie.matrix_to_quaternion_wxyz(self.rotation, continuous=True)
        out |= {f"q{a}": quaternion[:, k] for k, a in enumerate("wxyz")}
        out |= {name: self.wrench[:, k] for k, name in enumerate(("fx", "fy", "fz", "mx", "my", "mz"))}
        out["force_rms"] = self.force_rms
        return out

    def arrays(self) -> dict[str, Any]:
        """What ``estimate.npz`` holds."""
        return {
            "t": self.t, "position": self.position, "rotation": self.rotation, "angular_velocity": self.angular_velocity,
            "angular_acceleration": self.angular_acceleration, "turn": self.turn, "q": self.q, "qd": self.qd, "qdd": self.qdd,
            "tau": self.tau, "wrench": self.wrench, "force_rms": self.force_rms, "window_start": self.check.window_start,
            "window_share": self.check.window_share, "coefficients": self.coefficients, "predicted_covariance": self.predicted_covariance,
        }  # fmt: skip

    def to_dict(self) -> JsonDict:
        """The summary that ``estimate.json`` holds."""
        from factorgrasp.estimate_io import to_dict

        out = to_dict(self.estimate)
        for key in ("variables", "certificate", "multipliers", "residuals", "observability"):
            out.pop(key, None)
        s = self.problem.settings
        out["mode"], out["space"] = self.problem.human.mode, self.space.name
        out["duration"], out["step"] = s.duration, float(self.t[1] - self.t[0])
        out["objective_is"] = "mean of |f|^2 / comfort_force^2 + |m|^2 / comfort_moment^2 at the wrist"
        out["excitation"] = {
            "alpha": s.alpha, "window": s.window_length, "centred": s.centred, "share": self.share,
            "lambda_min": float(np.min(self.lambda_min)) if s.alpha is not None else None,
            "lambda_min_per_window": [
                {"start": float(a), "lambda_min": float(b)}
                for a, b in zip(self._seen(self.check.window_start), self._seen(self.lambda_min), strict=False)
            ],
        }  # fmt: skip
        out["predicted_sd"] = {
            "rotation": self.predicted_sd[:3].tolist(), "translation": self.predicted_sd[3:].tolist(),
            "axes": "end-effector", "units": "rad, m",
        }  # fmt: skip
        out["wrench"] = {
            "force_rms": float(np.sqrt(np.mean(self.force_rms**2))), "force_peak": float(np.max(self.force_rms)),
            "moment_rms": float(np.sqrt(np.mean(np.sum(self.wrench[:, 3:] ** 2, axis=1)))),
            "moment_peak": float(np.max(np.linalg.norm(self.wrench[:, 3:], axis=1))), "units": "N, Nm",
        }  # fmt: skip
        out["coning_ratio"] = self.coning_ratio
        out["margins"] = [
            {
                "limit": one.name, "unit": one.unit, "worst": one.value, "bound": one.limit, "margin": one.margin,
                "relative": one.relative, "time": one.time,
            }
            for one in self.check.margins
        ]  # fmt: skip
        out["binding"] = list(self.binding)
        return out

    def save(self, directory: str | Path) -> Path:
        """Write ``trajectory.csv``, ``estimate.npz`` and ``estimate.json`` into `directory`, each atomically; returns the JSON's path."""
        from factorgrasp.excitation_exports import write_exports
        from factorgrasp.results import write_result

        folder, columns = Path(directory), self.table()
        with replacing(folder / TRAJECTORY_NAME) as temporary:
            data = np.column_stack(list(columns.values()))
            np.savetxt(temporary, data, "%.9g", ",", header=",".join(columns), comments="", encoding="utf-8")
        write_exports(self, folder)
        return write_result(folder, self.to_dict(), self.arrays())

    @property
    def extra_files(self) -> tuple[str, ...]:
        """Names of what :meth:`save` writes beside the usual two."""
        from factorgrasp.excitation_exports import export_names

        return (TRAJECTORY_NAME, *export_names(self))

    def summary(self) -> str:
        """A few lines for a terminal."""
        s = self.problem.settings
        asked = (
            f"alpha {s.alpha:g} rad^2/s^3 over {s.window_length:g} s"
            if s.alpha is not None
            else "target standard deviations"
        )
        lines = [
            f"excitation ({self.problem.human.mode}, planned in {self.space.name} space): {self.status.value.replace('_', ' ')}",
            f"asked for {asked}; the worst window has {self.share:.4g} of it",
            f"wrist: force {np.sqrt(np.mean(self.force_rms**2)):.3g} N RMS, {np.max(self.force_rms):.3g} N at most; "
            f"turn {np.degrees(np.max(np.linalg.norm(self.turn, axis=1))):.2f} deg at most",
            "predicted sd: rotation " + ", ".join(f"{np.degrees(x):.3g}" for x in self.predicted_sd[:3]) + " deg; lever arm "
            + ", ".join(f"{1000.0 * x:.3g}" for x in self.predicted_sd[3:]) + " mm",
        ]  # fmt: skip
        if np.isfinite(self.coning_ratio):
            lines.append(
                f"mean square of the turn over steady coning of the same excitation: {self.coning_ratio:.3f}"
            )
        tight = sorted(self.check.margins, key=lambda one: one.relative)[:3]
        lines += [
            f"nearest limit: {one.name}: {one.value:.4g} of {one.limit:.4g} {one.unit} at {one.time:.2f} s"
            for one in tight
        ]
        return "\n".join(lines)

    def _seen(self, values: FloatArray) -> FloatArray:
        """About fifty of many."""
        return values[:: max(1, values.size // 50)]

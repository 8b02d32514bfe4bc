"""What solving a human-dynamics recording gives back, and the files that it writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate
from factorgrasp.human_dynamics_payload import Payload
from factorgrasp.human_dynamics_weighing import Weighing
from factorgrasp.problems.human_dynamics_estimate import HumanDynamicsEstimate
from factorgrasp.problems.human_dynamics_words import agreement_words
from factorgrasp.status import Status
from factorgrasp.typing import BoolArray, FloatArray, JsonDict

_COLUMNS = ("fx", "fy", "fz", "mx", "my", "mz")


@dataclass(frozen=True, eq=False)
class HumanDynamicsResult:
    """The answer to a :class:`HumanDynamicsTask`: arrays over all frames of the clock, NaN in gaps and unsolved frames.

    Attributes
    ----------
    estimate : Estimate
        Status, agreement of the sensors, timing and provenance.
    frames : HumanDynamicsEstimate
        Everything else, at the good frames.
    t : ndarray, shape (n,)
        s.
    good : ndarray, shape (n,)
    rotation : ndarray
        (good frames, L, 3, 3) ``R_w_l`` of every link.
    jointed : tuple of str
        Joints whose axes are known.
    payload : Payload or None
        At the good frames.
    weighing : Weighing or None
        None where no force was measured, or an unmeasured contact carries some of the weight.
    residual : str or None
        The link on which what motion, masses and forces disagree about acts.
    extras : dict of str to ndarray
        Over all frames: the configurations, where they were estimated.
    """

    estimate: Estimate
    frames: HumanDynamicsEstimate
    t: FloatArray
    good: BoolArray
    rotation: FloatArray
    jointed: tuple[str, ...] = ()
    payload: Payload | None = None
    weighing: Weighing | None = None
    residual: str | None = None
    extras: Mapping[str, Any] = field(default_factory=dict)

    @property
    def status(self) -> Status:
        """`Status.SOLVED` when all frames that are no gaps are."""
        return self.estimate.status

    @property
    def message(self) -> str:
        """Why not, otherwise."""
        return self.estimate.message

    def arrays(self) -> dict[str, Any]:
        """What ``estimate.npz`` holds."""
        frames = self.frames
        out: dict[str, Any] = {
            "t": self.t,
            "links": np.array(frames.links),
            "joint_names": np.array(frames.joint_names),
            "dof_names": np.array(frames.dof_names, dtype=np.str_),
        }
        for name in (
            "torque", "torque_sd", "joint_moment", "joint_moment_sd", "joint_force", "external_wrench",
            "external_wrench_sd", "joint_acceleration", "joint_acceleration_sd",
        ):  # fmt: skip
            out[name] = self._all(getattr(frames, name))
        for found in frames.innovations:
            out[f"nis/{found.name}"] = self._all(found.nis / np.where(found.dof > 0, found.dof, np.nan))
        for key in ("mass", "mass_sd"):
            values = np.full(len(frames), np.nan) if self.payload is None else getattr(self.payload, key)
            out[f"payload_{key}"] = self._all(values)
        return {**out, **self.extras}

    def to_dict(self) -> JsonDict:
        """The summary that ``estimate.json`` holds."""
        from factorgrasp.estimate_io import to_dict

        frames, solved = self.frames, np.array([status.ok for status in self.frames.status])
        out = to_dict(self.estimate)
        for key in ("variables", "certificate", "multipliers", "objective", "iterations"):
            out.pop(key)
        out["frames"] = {"all": self.t.size, "gaps": int((~self.good).sum()), "solved": int(solved.sum())}
        out["units"] = (
            "Nm; N for sliding joints; wrenches N and Nm in the frame of their link; moments in world axes, parent on child"
        )
        if solved.any():
            out["torque"] = {
                name: _spread(frames.torque[solved, k], frames.torque_sd[solved, k])
                for k, name in enumerate(frames.dof_names)
            }
            size = np.linalg.norm(frames.joint_moment, axis=2)
            worst = np.sqrt(
                np.maximum(np.linalg.eigvalsh(frames.joint_moment_covariance[solved])[..., -1], 0.0)
            )
            out["joint_moment"] = {
                name: _spread(size[solved, j], worst[:, j]) for j, name in enumerate(frames.joint_names)
            }
        out["sensors"] = [
            {
                "name": found.name,
                "unit": found.unit,
                "nis_per_dof": found.ratio,
                "words": agreement_words(found),
            }
            for found in frames.innovations
        ]
        if self.residual is not None:
            force, moment = self._residual()
            out["base_residual"] = {"link": self.residual, "force_rms": force, "moment_rms": moment}
        if self.weighing is not None:
            w = self.weighing
            # The mean over a recording shows what no single frame does: to the reader it is one more sensor.
            out["sensors"].append({"name": "weight", "unit": "kg", "nis_per_dof": w.nis, "words": w.words})
        out["active_constraints"] = sorted({one.meaning for one in frames.active})
        if self.weighing is not None:
            w = self.weighing
            out["weighing"] = {"mass": w.mass, "sd": w.sd, "model": w.model, "nis": w.nis, "words": w.words}
        if self.payload is not None:
            p = self.payload
            out["payload"] = {"links": list(p.links), "mass": p.mean, "sd": p.mean_sd, "words": p.words}
        return out

    def save(self, directory: str | Path) -> Path:
        """Write ``estimate.json`` and ``estimate.npz`` into `directory`, each atomically; returns the JSON's path."""
        from factorgrasp.results import write_result

        return write_result(Path(directory), self.to_dict(), self.arrays())

    def table(self) -> dict[str, FloatArray]:
        """Columns by name, one row a frame: torques, joint moments, external wrenches that are not zero, each with ``_sd``."""
        arrays = self.arrays()
        out: dict[str, FloatArray] = {"t": self.t}
        for k, name in enumerate(self.frames.dof_names):
            out[f"torque {name}"] = arrays["torque"][:, k]
            out[f"torque {name} sd"] = arrays["torque_sd"][:, k]
        for j, name in enumerate(self.frames.joint_names):
            for axis, letter in enumerate("xyz"):
                out[f"moment {name} {letter}"] = arrays["joint_moment"][:, j, axis]
                out[f"moment {name} {letter} sd"] = arrays["joint_moment_sd"][:, j, axis]
        for i, name in enumerate(self.frames.links):
            if np.nanmax(np.abs(arrays["external_wrench"][:, i]), initial=0.0) < 1e-3:
                continue
            for axis, letter in enumerate(_COLUMNS):
                out[f"wrench {name} {letter}"] = arrays["external_wrench"][:, i, axis]
                out[f"wrench {name} {letter} sd"] = arrays["external_wrench_sd"][:, i, axis]
        if self.payload is not None:
            out["payload mass"], out["payload mass sd"] = arrays["payload_mass"], arrays["payload_mass_sd"]
        return out

    def export(self, path: str | Path) -> Path:
        """Write :meth:`table` as .csv or .parquet (needs pyarrow), atomically; returns the path."""
        from factorgrasp.atomic import replacing

        file, columns = Path(path), self.table()
        if file.suffix.lower() == ".parquet":
            try:
                import pyarrow
                from pyarrow import parquet
            except ImportError as error:
                raise InputError(
                    str(file), "pyarrow, which writes Parquet", "none", "pip install 'factorgrasp[data]'"
                ) from error
            with replacing(file) as temporary:
                parquet.write_table(pyarrow.table(columns), temporary)
        elif file.suffix.lower() == ".csv":
            with replacing(file) as temporary:
                data = np.column_stack(list(columns.values()))
                np.savetxt(
                    temporary, data, "%.9g", ",", header=",".join(columns), comments="", encoding="utf-8"
                )
        else:
            raise InputError(str(file), "a name that ends in .csv or .parquet", file.suffix or "no ending")
        return file

    def summary(self) -> str:
        """A few lines for a terminal."""
        lines = [self.frames.summary()]
        gaps = int((~self.good).sum())
        if gaps:
            lines.append(f"{gaps} of {self.t.size} frames are gaps (no complete motion there)")
        if self.weighing is not None:
            lines.append(self.weighing.words)
        if self.residual is not None:
            lines.append(self.residual_words)
        if self.payload is not None:
            lines.append(self.payload.words)
        return "\n".join(lines)

    @property
    def residual_words(self) -> str:
        """A sentence on what motion, masses and forces disagree about."""
        force, moment = self._residual()
        return f"what motion, masses and forces disagree about acts on {self.residual}: {force:.1f} N, {moment:.1f} Nm RMS"

    def _residual(self) -> tuple[float, float]:
        """RMS size of force and moment that the base link carries, N and Nm."""
        wrench = self.frames.external_wrench[:, self.frames.links.index(self.residual or "")]
        square = np.nanmean(wrench**2, axis=0)
        return float(np.sqrt(square[:3].sum())), float(np.sqrt(square[3:].sum()))

    def _all(self, values: FloatArray) -> FloatArray:
        """Values of the good frames on the whole clock."""
        out = np.full((self.t.size, *values.shape[1:]), np.nan)
        out[self.good] = values
        return out


def _spread(values: FloatArray, sd: FloatArray) -> JsonDict:
    k = int(np.argmax(np.abs(values)))
    return {
        "rms": float(np.sqrt(np.mean(values**2))),
        "largest": float(values[k]),
        "sd": float(np.median(sd)),
    }

"""A human-dynamics problem with its clock: what a problem file makes, and what solving it gives back and writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate, TermSummary
from factorgrasp.human_dynamics_payload import Payload, contact_rows, payload_of, solve_with_contacts
from factorgrasp.least_squares import LeastSquares
from factorgrasp.problems.external_wrenches import ExternalWrenches
from factorgrasp.problems.external_wrenches_estimate import ExternalWrenchesEstimate
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_constraints import DynamicsConstraint
from factorgrasp.problems.human_dynamics_estimate import HumanDynamicsEstimate
from factorgrasp.problems.human_dynamics_innovations import Innovation
from factorgrasp.problems.human_dynamics_sensors import ExternalWrench, Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.human_dynamics_words import agreement_words
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_spatial import rotate
from factorgrasp.provenance import problem_hash, versions
from factorgrasp.status import Status
from factorgrasp.toml_tables import close_matches
from factorgrasp.typing import BoolArray, FloatArray, JsonDict

_COLUMNS = ("fx", "fy", "fz", "mx", "my", "mz")


@dataclass(frozen=True)
class Weighing:
    """What measured forces alone say of the body's mass.

    Attributes
    ----------
    mass : float
        kg.
    sd : float
        From the scatter over the recording, in stretches of a second, kg.
    model : float
        kg.
    """

    mass: float
    sd: float
    model: float

    @property
    def words(self) -> str:
        """A sentence."""
        off = self.mass - self.model
        verdict = "they agree"
        if abs(off) > max(3.0 * self.sd, 0.005 * self.model):
            verdict = (
                f"the model is {'too heavy' if off < 0.0 else 'too light'} by {100.0 * abs(off) / self.model:.1f} %, "
                "or something is held or leant on"
            )
        return f"the measured forces weigh {self.mass:.2f} kg (sd {self.sd:.2f}), the model {self.model:.2f} kg: {verdict}"


class HumanDynamicsTask:
    """A human-dynamics problem on the clock of its recording.

    Parameters
    ----------
    motion : LinkMotion
        At the good frames.
    sensors : sequence of Sensor
        At the good frames.
    clock : (n,) array_like, optional
        All frames, s; those of the motion by default.
    good : (n,) array_like of bool, optional
        Frames that `motion` has.
    noise : HumanDynamicsNoise, optional
    contacts : sequence of str
        Links that may carry a wrench nobody measures.
    points : mapping of str to (3,) array_like
        Contact to the point in its link's frame about which its moment is as small as the noise's `contact_wrench` says; by default
        the origin.
    payload : sequence of str
        Contacts that together hold an object, whose mass is estimated.
    method : {"joint", "two_tasks"}
        One estimate of everything, or the unmeasured wrenches first, from the momentum alone (Tirupachuri 2021), and then all else
        with them.
    constraints : sequence of DynamicsConstraint
    hard_dynamics : bool
    """

    kind = "human_dynamics"

    def __init__(
        self,
        motion: LinkMotion,
        sensors: Sequence[Sensor],
        clock: ArrayLike | None = None,
        good: ArrayLike | None = None,
        *,
        noise: HumanDynamicsNoise | None = None,
        contacts: Sequence[str] = (),
        points: Mapping[str, ArrayLike] | None = None,
        payload: Sequence[str] = (),
        method: Literal["joint", "two_tasks"] = "joint",
        constraints: Sequence[DynamicsConstraint] = (),
        hard_dynamics: bool = False,
    ) -> None:
        self.noise, self.contacts, self.payload = (
            noise or HumanDynamicsNoise(),
            tuple(contacts),
            tuple(payload),
        )
        self.clock = motion.t if clock is None else np.asarray(clock, dtype=float)
        self.good: BoolArray = (
            np.ones(self.clock.size, dtype=bool) if good is None else np.asarray(good, dtype=bool)
        )
        if int(self.good.sum()) != len(motion):
            raise InputError("good", f"{len(motion)} frames, those of the motion", f"{int(self.good.sum())}")
        where = {link: np.asarray(point, dtype=float) for link, point in (points or {}).items()}
        for name, links, known in (
            ("contacts", self.contacts, motion.links), ("payload", self.payload, self.contacts), ("points", tuple(where), self.contacts),
        ):  # fmt: skip
            for link in links:
                if link not in known:
                    raise InputError(
                        name,
                        "links among " + (", ".join(known) or "none"),
                        repr(link),
                        close_matches(link, known),
                    )
        wrenches = [sensor for sensor in sensors if isinstance(sensor, ExternalWrench)]
        self.momentum: ExternalWrenchesEstimate | None = None
        if self.contacts:
            for sensor in wrenches:
                if sensor.link in self.contacts:
                    raise InputError("contacts", "links without a wrench sensor", repr(sensor.link))
            self.momentum = ExternalWrenches(motion, wrenches, self.contacts, self.noise).estimate()
        every: list[Sensor] = list(sensors)
        if self.contacts and method == "joint":
            every.append(contact_rows(motion, self.noise, self.contacts, where))
        elif self.contacts:
            if where:
                raise InputError("points", 'the method "joint"', repr(method))
            assert self.momentum is not None
            every = [sensor for sensor in sensors if not isinstance(sensor, ExternalWrench)]
            every.append(self.momentum.as_sensor())
        self.method, self._points = method, where
        self.problem = HumanDynamics(motion, every, self.noise, (), constraints, hard_dynamics)
        self._weighing = None if self.contacts else weigh(motion, wrenches)

    def solve(self, solver: str | None = None) -> HumanDynamicsResult:
        """Solve all frames; see :func:`factorgrasp.solvers.frames.solve_frames`."""
        from factorgrasp.solvers.frames import solve_frames

        payload = None
        if self.contacts and self.method == "joint":
            frames, x, P = solve_with_contacts(self.problem, solver)
            if self.payload:
                payload = payload_of(
                    self.problem.motion, self.noise, self.contacts, self.payload, x, P, self._points
                )
        else:
            frames = solve_frames(self.problem, solver)
            if self.payload:
                assert self.momentum is not None
                found = self.momentum.payload(self.payload)
                payload = Payload(found.links, found.mass, found.sd, found.mean, float(np.median(found.sd)))
        motion = self.problem.motion
        jointed = tuple(joint.name for joint in motion.joints if joint.dofs)
        return HumanDynamicsResult(
            self._summary(frames), frames, self.clock, self.good, motion.R, jointed, payload, self._weighing
        )

    # ---- the middle frame, for the comparison of solvers ------------------------------------------------------

    def least_squares(self) -> LeastSquares:
        """The frame in the middle of the recording."""
        return self.problem.frame(len(self.problem) // 2)

    def view(self, estimate: Estimate) -> HumanDynamicsEstimate:
        """The typed view of that frame."""
        return self.problem.at(len(self.problem) // 2).view(estimate)

    def _summary(self, frames: HumanDynamicsEstimate) -> Estimate:
        failed = [k for k, status in enumerate(frames.status) if not status.ok]
        status, message = Status.SOLVED, ""
        if failed:
            status = frames.status[failed[0]]
            reason = frames.messages.get(failed[0], status.value)
            message = f"{len(failed)} of {len(frames)} frames are not solved; the first, at {frames.t[failed[0]]:.3f} s: {reason}"
        return Estimate(
            status,
            self.kind,
            frames.solver,
            (),
            {},
            message,
            residuals=tuple(map(_agreement, frames.innovations)),
            observability=None if self.momentum is None else self.momentum.observability(),
            iterations=len(frames),
            timing={"solve": frames.time},
            versions=versions(("pinocchio", "qdldl")),
            problem_hash=problem_hash(self.kind, self.least_squares()),
        )


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
    """

    estimate: Estimate
    frames: HumanDynamicsEstimate
    t: FloatArray
    good: BoolArray
    rotation: FloatArray
    jointed: tuple[str, ...] = ()
    payload: Payload | None = None
    weighing: Weighing | None = None

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
        return out

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
        out["active_constraints"] = sorted({one.meaning for one in frames.active})
        if self.weighing is not None:
            w = self.weighing
            out["weighing"] = {"mass": w.mass, "sd": w.sd, "model": w.model, "words": w.words}
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
        if self.payload is not None:
            lines.append(self.payload.words)
        return "\n".join(lines)

    def _all(self, values: FloatArray) -> FloatArray:
        """Values of the good frames on the whole clock."""
        out = np.full((self.t.size, *values.shape[1:]), np.nan)
        out[self.good] = values
        return out


def weigh(motion: LinkMotion, wrenches: Sequence[ExternalWrench]) -> Weighing | None:
    """The body's mass from the measured forces: ``m = F' a / a' a`` with ``a`` the proper acceleration of its centre of mass."""
    if not wrenches:
        return None
    force = np.zeros((len(motion), 3))
    for sensor in wrenches:
        values = sensor.values[:, :3]
        if sensor.frame == "sensor":
            R = motion.R[:, motion.link(sensor.link)]
            values = rotate(R, values @ sensor.R_l_s.T)
        force += values
    per_kg = motion.momentum_rate[:, :3] / motion.total_mass
    whole = np.isfinite(force).all(axis=1) & np.isfinite(per_kg).all(axis=1)
    # Where nothing carries the body (flight, or a step off the plates) there is nothing to weigh.
    whole &= np.linalg.norm(force, axis=1) > 0.5 * motion.total_mass * np.linalg.norm(per_kg, axis=1)
    if whole.sum() < 10:
        return None
    dot, square = np.sum(force * per_kg, axis=1)[whole], np.sum(per_kg**2, axis=1)[whole]
    mass = float(dot.sum() / square.sum())
    second = (motion.t[whole] - motion.t[whole][0]).astype(int)
    stretches = np.array([dot[second == k].sum() / square[second == k].sum() for k in np.unique(second)])
    sd = float(np.std(stretches, ddof=1) / np.sqrt(stretches.size)) if stretches.size > 1 else float("nan")
    return Weighing(mass, sd, motion.total_mass)


def _agreement(found: Innovation) -> TermSummary:
    rows = int(found.dof.sum())
    chi2 = float(np.nansum(found.nis))
    share = np.where(found.dof > 0, found.nis / np.maximum(found.dof, 1), np.nan)
    worst = float(np.sqrt(np.nanmax(share))) if np.isfinite(share).any() else float("nan")
    return TermSummary(found.name, rows, chi2, float(np.sqrt(chi2 / rows)) if rows else float("nan"), worst)


def _spread(values: FloatArray, sd: FloatArray) -> JsonDict:
    k = int(np.argmax(np.abs(values)))
    return {
        "rms": float(np.sqrt(np.mean(values**2))),
        "largest": float(values[k]),
        "sd": float(np.median(sd)),
    }

"""A human-dynamics problem with its clock: what a problem file makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate, TermSummary
from factorgrasp.human_dynamics_payload import Payload, contact_rows, payload_of, solve_with_contacts
from factorgrasp.human_dynamics_result import HumanDynamicsResult
from factorgrasp.human_dynamics_weighing import weigh
from factorgrasp.least_squares import LeastSquares
from factorgrasp.problems.external_wrenches import ExternalWrenches
from factorgrasp.problems.external_wrenches_estimate import ExternalWrenchesEstimate
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_constraints import DynamicsConstraint
from factorgrasp.problems.human_dynamics_estimate import HumanDynamicsEstimate
from factorgrasp.problems.human_dynamics_innovations import Innovation
from factorgrasp.problems.human_dynamics_sensors import ExternalWrench, Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.provenance import problem_hash, versions
from factorgrasp.status import Status
from factorgrasp.toml_tables import close_matches
from factorgrasp.typing import BoolArray


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
    residual : str, optional
        The link on which what motion, masses and forces disagree about acts (its variance is the noise's `free_wrench`); the result says
        how large it is.
    extras : mapping of str to ndarray
        Over all frames of the clock, to be written beside the result.
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
        residual: str | None = None,
        extras: Mapping[str, Any] | None = None,
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
        self.residual = residual
        self.method, self._points, self.extras = method, where, dict(extras or {})
        self.problem = HumanDynamics(motion, every, self.noise, (), constraints, hard_dynamics)
        self._weighing = None if self.contacts else weigh(motion, wrenches)

    def solve(self, solver: str | None = None) -> HumanDynamicsResult:
        """Solve all frames; see :func:`factorgrasp.solvers.frames.solve_frames`."""
        from factorgrasp.solvers.frames import solve_frames

        payload = None
        if self.contacts and self.method == "joint":
            frames, x, P = solve_with_contacts(self.problem, solver, self.payload)
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
            self._summary(frames),
            frames,
            self.clock,
            self.good,
            motion.R,
            jointed,
            payload,
            self._weighing,
            self.residual,
            self.extras,
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


def _agreement(found: Innovation) -> TermSummary:
    rows = int(found.dof.sum())
    chi2 = float(np.nansum(found.nis))
    share = np.where(found.dof > 0, found.nis / np.maximum(found.dof, 1), np.nan)
    worst = float(np.sqrt(np.nanmax(share))) if np.isfinite(share).any() else float("nan")
    return TermSummary(found.name, rows, chi2, float(np.sqrt(chi2 / rows)) if rows else float("nan"), worst)

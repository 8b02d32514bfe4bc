"""Do the stated covariances of human dynamics hold? Normalised errors (NEES) against known truth, over seeds, in independent frames.

Errors of one frame are Gaussian with the joint covariance of all torques (or of all external wrenches that are not
known to be zero), so that the
sum of ``e' P^-1 e`` over frames whose noise is independent is chi-square: frames of one recording are taken a filter's window apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from factorgrasp.human_dynamics_payload import contact_rows, payload_of
from factorgrasp.problems.external_wrenches import ExternalWrenches
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_sensors import ExternalWrench, Sensor
from factorgrasp.problems.human_dynamics_state import torque_turn
from factorgrasp.simulation.human_dynamics import FEET
from factorgrasp.simulation.human_recording import HumanRecording
from factorgrasp.solvers.frames import FrameSolver
from factorgrasp.typing import BoolArray, FloatArray, IntArray
from factorgrasp.uncertainty import nees_band

EXACT_MODEL = 1e-11
"""Variance of a model that makes no errors, as the simulated one: what is tested is what noise of sensors does."""
ARMS = ("Shoulder", "Elbow", "Wrist")
WRIST = (1e4, 1e4, 1e4, 1e2, 1e2, 1e2)
"""Of a hand's wrench about the wrist."""
Method = Literal["joint, points known", "joint", "two tasks"]
HAND = (1e4, 1e4, 1e4, 1e-8, 1e-8, 1e-8)
"""Of a hand's wrench about where it holds: any force, no moment."""


@dataclass(frozen=True)
class Consistency:
    """Normalised errors of one quantity.

    Attributes
    ----------
    name : str
    chi2 : float
        Sum over all frames.
    dof : int
        Its degrees of freedom.
    """

    name: str
    chi2: float
    dof: int

    @property
    def ratio(self) -> float:
        """NEES per degree of freedom."""
        return self.chi2 / self.dof

    @property
    def band(self) -> tuple[float, float]:
        """In which it lies 95 times of 100."""
        return nees_band(1, self.dof)

    @property
    def inside(self) -> bool:
        """Whether it does."""
        low, high = self.band
        return bool(low <= self.ratio <= high)


@dataclass(frozen=True)
class Errors:
    """Errors of independent frames and what is stated of them.

    Attributes
    ----------
    torque, wrench, payload : ndarray
        (n,) NEES of a frame: of all torques together, of the measured and unmeasured wrenches together, and of the payload.
    torque_dof, wrench_dof : int
        Of all frames together.
    mass_error : ndarray
        (n,) kg, empty without a payload.
    torque_error, torque_sd : ndarray
        (n, dofs) Nm.
    """

    torque: FloatArray
    wrench: FloatArray
    payload: FloatArray
    torque_dof: int
    wrench_dof: int
    mass_error: FloatArray
    torque_error: FloatArray
    torque_sd: FloatArray


def errors_of(
    recording: HumanRecording,
    hands: Sequence[str] = (),
    imus: bool = False,
    state_noise: bool = True,
    offset: int = 0,
    method: Method = "joint, points known",
    model: float = EXACT_MODEL,
) -> Errors:
    """Normalised errors of one recording at frames a window of its filter apart.

    Parameters
    ----------
    recording : HumanRecording
    hands : sequence of str
        Contacts that nobody measures; they hold the payload.
    imus : bool
        Also with accelerometers.
    state_noise : bool
        False: poses taken to be exact, as in the papers.
    offset : int
        First frame.
    method : {"joint, points known", "joint", "two tasks"}
        One estimate with the hands' moments known to be none where they hold; the same with moments of 10 Nm about
        the wrists; or, with those, the
        wrenches by momentum first and their posterior into the second task (Tirupachuri 2021).
    model : float
        Variance of Newton-Euler. Below 1e-10 the smallest torques (toes) are consistent, too; a payload is at 1e-6,
        which is several times faster.
    """
    motion, keep, own = recording.measured_motion
    frames = np.arange(offset, len(motion), recording.filter_window)
    part = motion.select(frames)
    if state_noise:
        part = part.with_state_noise(recording.state_noise)
    at = np.flatnonzero(keep)[frames]
    noise = replace(own, propagation=model, balance=model, free_wrench=1e-12, contact_wrench=HAND)
    sensors: list[Sensor] = [*recording.foot_sensors(part, at, unloaded=1e-10)]
    if imus:
        sensors += recording.imus(at)
    links = (*FEET, *hands)
    points = {link: recording.body.segments[link].com for link in hands}
    if method == "joint, points known":
        contacts = [contact_rows(part, noise, tuple(hands), points)] if hands else []
        problem = HumanDynamics(part, [*sensors, *contacts], noise)
    else:
        noise = replace(noise, contact_wrench=WRIST)
        plates = [sensor for sensor in sensors if isinstance(sensor, ExternalWrench)]
        others = [sensor for sensor in sensors if not isinstance(sensor, ExternalWrench)]
        if method == "two tasks":
            first = ExternalWrenches(part, plates, hands, noise).estimate().as_sensor()
            problem = HumanDynamics(part, [*others, first], noise)
        else:
            problem = HumanDynamics(part, sensors, noise, hands)
    columns = problem.system.columns
    wrenches = np.concatenate([columns.external_wrench[part.link(link)] for link in links])
    held = [columns.external_wrench[part.link(link)] for link in hands]
    held += [columns.acceleration[part.link(link)] for link in hands]
    x, P, groups, nearer = _solved(problem, [wrenches, *([np.concatenate(held)] if hands else [])])
    fit = _told(part.R[:, [part.link(link) for link in hands]])
    # How two hands share a load is the prior's, and with it the torques of the arms.
    names = [n for n in part.dof_names if len(hands) < 2 or not any(joint in n for joint in ARMS)]
    chosen = [part.dof_names.index(name) for name in names]
    torque, reader = (shown[:, chosen] for shown in _torques(nearer, x))
    true = recording.truth.of(names)[at]
    where = groups[0]
    C = reader[:, :, where] @ P[0] @ np.swapaxes(reader[:, :, where], 1, 2)
    blank = np.zeros((len(recording.t), 6))
    wrench = np.concatenate([recording.truth.external_wrench.get(link, blank)[at] for link in links], axis=1)
    error, C_wrench = (
        (fit @ (x[:, groups[1]] - wrench)[..., None])[..., 0],
        fit @ P[1] @ np.swapaxes(fit, 1, 2),
    )
    # A plate that nobody stands on is exactly zero here: nothing to judge.
    told = np.ones(error.shape, dtype=bool)
    for i, link in enumerate(FEET):
        told[:, 6 * i : 6 * i + 6] = np.any(recording.plates[link].force[at], axis=1)[:, None]
    error = np.where(told, error, 0.0)
    C_wrench = np.where(told[:, :, None] & told[:, None, :], C_wrench, np.eye(error.shape[1]))
    payload, mass_error = np.empty(0), np.empty(0)
    if hands and method != "two tasks":
        load = payload_of(part, noise, tuple(hands), tuple(hands), x[:, groups[2]], P[2], points)
        mass_error = load.mass - recording.truth.payload
        payload = (mass_error / load.mass_sd) ** 2
    return Errors(
        _nees(torque - true, C),
        _nees(error, C_wrench),
        payload,
        true.size,
        int(told.sum()),
        mass_error,
        torque - true,
        np.sqrt(np.diagonal(C, axis1=1, axis2=2)),
    )


def _told(R_hands: FloatArray) -> FloatArray:
    """Read-out (n, 12 or 15, 12 + 6 k) of what the data tell: the feet's wrenches and the sum of the hands' forces in the world.

    The hands' moments are what the prior says, and how two hands share a load as well.
    """
    count, hands = R_hands.shape[:2]
    out = np.zeros((count, 12 + 3 * (hands > 0), 12 + 6 * hands))
    out[:, :12, :12] = np.eye(12)
    for k in range(hands):
        out[:, 12:, 12 + 6 * k : 15 + 6 * k] = R_hands[:, k]
    return out


def _solved(
    problem: HumanDynamics, wanted: Sequence[IntArray]
) -> tuple[FloatArray, list[FloatArray], list[IntArray], HumanDynamics]:
    """Unknowns, and joint covariances of all joint wrenches (with what turns their axes) and of the wanted groups."""
    system, every = problem.system, slice(0, len(problem))
    turns = [group[6:] for group in system.turning.values()]
    groups = [np.concatenate([system.columns.joint_wrench.ravel(), *turns]), *wanted]
    solver = FrameSolver(problem.pattern, groups)
    nearer = (
        problem.relinearised(solver.solve(*problem.whitened_frames(every), covariance=False).x) or problem
    )
    result = solver.solve(*nearer.whitened_frames(every))
    return result.x, [np.asarray(block) for block in result.marginals], groups, nearer


def monte_carlo(
    make: Callable[[int], HumanRecording],
    seeds: Iterable[int],
    hands: Sequence[str] = (),
    imus: bool = False,
    state_noise: bool = True,
    model: float = EXACT_MODEL,
) -> Mapping[str, Consistency]:
    """NEES of torques, wrenches and, with hands, the payload over seeds."""
    found = [errors_of(make(seed), hands, imus, state_noise, model=model) for seed in seeds]
    out = {
        "torques": Consistency("torques", _sum(e.torque for e in found), sum(e.torque_dof for e in found)),
        "wrenches": Consistency("wrenches", _sum(e.wrench for e in found), sum(e.wrench_dof for e in found)),
    }
    if hands:
        out["payload"] = Consistency(
            "payload", _sum(e.payload for e in found), sum(e.payload.size for e in found)
        )
    return out


def two_tasks_and_joint(
    make: Callable[[int], HumanRecording], seeds: Iterable[int], hands: Sequence[str]
) -> dict[str, tuple[float, float, float]]:
    """By method: RMS error of torques and the RMS of their stated sd, Nm, and NEES per degree of freedom of all torques together."""
    out: dict[str, tuple[float, float, float]] = {}
    recordings = [make(seed) for seed in seeds]
    methods: tuple[Method, ...] = ("two tasks", "joint", "joint, points known")
    for method in methods:
        found = [errors_of(recording, hands, method=method) for recording in recordings]
        rms, sd = (
            float(np.sqrt(np.mean([np.mean(x**2) for x in each])))
            for each in zip(*((e.torque_error, e.torque_sd) for e in found), strict=True)
        )
        out[method] = rms, sd, _sum(e.torque for e in found) / sum(e.torque_dof for e in found)
    return out


def _sum(parts: Iterable[FloatArray]) -> float:
    return float(sum(part.sum() for part in parts))


def _torques(problem: HumanDynamics, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Torques (n, dofs) and how they are read from the unknowns (n, dofs, size)."""
    system, k = problem.system, problem.kinematics
    out = np.zeros((k.count, k.axes.shape[1], x.shape[1]))
    shown = np.zeros(out.shape[:2])
    ends = np.cumsum([0, *k.sizes])
    for j in system.axes:
        own, columns = slice(ends[j], ends[j + 1]), system.columns.joint_wrench[j]
        S = np.swapaxes(k.axes[:, own], 1, 2)
        out[:, own, columns[0] : columns[-1] + 1] = k.axes[:, own]
        shown[:, own] = (k.axes[:, own] @ x[:, columns, None])[..., 0]
        group = system.turning.get(j)
        if group is not None:
            T = torque_turn(S, x[:, columns])
            out[:, own, group[6] : group[-1] + 1] = T
            shown[:, own] += (T @ x[:, group[6:], None])[..., 0]
    return shown, out


def _nees(error: FloatArray, C: FloatArray) -> FloatArray:
    scale = 1.0 / np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    correlation = C * scale[:, :, None] * scale[:, None, :]
    z = error * scale
    good: BoolArray = np.asarray(np.isfinite(z).all(axis=1))
    return np.asarray(
        np.einsum("ni,ni->n", z[good], np.linalg.solve(correlation[good], z[good][..., None])[..., 0])
    )

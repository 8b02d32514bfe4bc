"""The mass of an object that hands hold, from the wrenches that nobody measured (mathematics 4.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorgrasp.least_squares import LeastSquares
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_estimate import HumanDynamicsEstimate
from factorgrasp.problems.human_dynamics_sensors import WrenchSet
from factorgrasp.problems.human_dynamics_settings import resolve
from factorgrasp.typing import FloatArray, IntArray

_NAME = "wrenches of what is held"


@dataclass(frozen=True, eq=False)
class Payload:
    """Mass of an object over n frames.

    Attributes
    ----------
    links : tuple of str
        What holds it.
    mass, mass_sd : ndarray, shape (n,)
        kg, frame by frame.
    mean, mean_sd : float
        Over all frames, weighted by their variances. The standard deviation is the median one of a single frame: how far errors of
        different frames are independent is not known, and a wrong mass of the body is the same error in all of them.
    """

    links: tuple[str, ...]
    mass: FloatArray
    mass_sd: FloatArray
    mean: float
    mean_sd: float

    @property
    def words(self) -> str:
        """A sentence."""
        return f"{' and '.join(self.links)} hold {self.mean:.3f} kg (sd {self.mean_sd:.3f} kg in one frame)"


def solve_with_payload(
    problem: HumanDynamics, links: tuple[str, ...], solver: str | None
) -> tuple[HumanDynamicsEstimate, Payload]:
    """Solve all frames, and the mass of the one object that some links hold.

    Parameters
    ----------
    problem : HumanDynamics
        With `links` among its contacts.
    links : tuple of str
    solver : str or None

    Notes
    -----
    On hands with the acceleration a, an object of mass m pulls with ``F = m (g - a)``. The posterior of F, the sum of the hands' forces,
    holds a zero-mean prior (the noise's `contact_wrench` and `prior_external_wrench`), which draws masses towards zero. It is taken out:
    with the posterior ``N(mu, P)`` and the prior ``N(0, P0)`` the data alone say ``m = u' P^-1 mu / u' (P^-1 - P0^-1) u``, ``u = g - a``,
    with one over the denominator as variance. Errors of different hands go with each other; their joint covariance is used.
    """
    from factorgrasp.solvers.frames import solve_frames

    # The zeros that stand for these links' wrenches as one measurement of all of them: the same rows, and their joint covariance is known.
    motion, system = problem.motion, problem.system
    loose = resolve(problem.noise.contact_wrench, motion.links, [6] * len(motion.links), "contact_wrench")
    variances = np.concatenate([loose[motion.link(link)] for link in links])
    zeros = WrenchSet(np.zeros((len(problem), variances.size)), np.diag(variances), _NAME, links=links)
    others = tuple(link for link in system.contacts if link not in links)
    watched = HumanDynamics(
        motion, (*problem.sensors, zeros), problem.noise, others, problem.constraints, system.hard_dynamics
    )
    keeper = _Keeper(watched)
    frames: HumanDynamicsEstimate = solve_frames(keeper, solver)
    found = watched.system
    group = found.touched(next(rows for rows in found.sensors if rows.name == _NAME))
    P = next(
        block
        for where, block in zip(found.marginals, keeper.result.marginals, strict=True)
        if np.array_equal(where, group)
    )
    payload = _mass(watched, links, keeper.result.x[:, group], P)
    kept = tuple(one for one in frames.innovations if one.name != _NAME)
    return replace(frames, innovations=kept), payload


class _Keeper:
    """A frame problem that keeps the plain result beside the view of it."""

    def __init__(self, problem: HumanDynamics) -> None:
        self._problem, self.kind = problem, problem.kind
        self.result: Any = None

    @property
    def frame_count(self) -> int:
        return self._problem.frame_count

    @property
    def pattern(self) -> LeastSquares:
        return self._problem.pattern

    @property
    def marginals(self) -> tuple[IntArray, ...]:
        return self._problem.marginals

    def whitened_frames(self, frames: slice) -> tuple[FloatArray, FloatArray]:
        return self._problem.whitened_frames(frames)

    def frame(self, index: int) -> LeastSquares:
        return self._problem.frame(index)

    def view_frames(self, result: Any) -> HumanDynamicsEstimate:
        self.result = result
        return self._problem.view_frames(result)


def _mass(problem: HumanDynamics, links: tuple[str, ...], x: FloatArray, P: FloatArray) -> Payload:
    motion, noise = problem.motion, problem.noise
    at = [motion.link(link) for link in links]
    R = motion.R[:, at]
    # Sum of the forces in the world as a linear read-out of the links' wrenches.
    read = np.zeros((len(motion), 3, 6 * len(links)))
    for k in range(len(links)):
        read[:, :, 6 * k : 6 * k + 3] = R[:, k]
    force = (read @ x[:, :, None])[..., 0]
    covariance = read @ P @ np.swapaxes(read, 1, 2)
    prior = np.zeros((len(motion), 3, 3))
    sizes = [6] * len(motion.links)
    loose = resolve(noise.contact_wrench, motion.links, sizes, "contact_wrench")
    wide = resolve(noise.prior_external_wrench, motion.links, sizes, "prior_external_wrench")
    for k, i in enumerate(at):
        variance = 1.0 / (1.0 / loose[i][:3] + 1.0 / wide[i][:3])
        prior += R[:, k] @ (variance[:, None] * np.swapaxes(R[:, k], 1, 2))
    u = motion.gravity - motion.acceleration[:, at].mean(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        good = np.isfinite(covariance).all(axis=(1, 2))
        posterior = np.linalg.inv(np.where(good[:, None, None], covariance, np.eye(3)))
        information = np.einsum("ni,nij,nj->n", u, posterior - np.linalg.inv(prior), u)
        mass = np.einsum("ni,nij,nj->n", u, posterior, force) / information
        known = good & (information > 0.0)
        mass, sd = np.where(known, mass, np.nan), np.where(known, 1.0 / np.sqrt(information), np.nan)
    weight = np.where(known, information, 0.0)
    if not known.any():
        return Payload(links, mass, sd, float("nan"), float("nan"))
    mean = float(np.sum(np.where(known, weight * mass, 0.0)) / weight.sum())
    return Payload(links, mass, sd, mean, float(np.nanmedian(sd)))

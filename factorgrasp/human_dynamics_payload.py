"""Contacts without a sensor, and the mass of what they hold (mathematics 4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorgrasp.least_squares import LeastSquares
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_estimate import HumanDynamicsEstimate
from factorgrasp.problems.human_dynamics_sensors import WrenchSet
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise, resolve
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_spatial import rotate, skew
from factorgrasp.typing import BoolArray, FloatArray, IntArray

CONTACTS = "unmeasured contacts"


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
        verb = "holds" if len(self.links) == 1 else "hold"
        return f"{' and '.join(self.links)} {verb} {self.mean:.3f} kg (sd {self.mean_sd:.3f} kg in one frame)"


def contact_rows(
    motion: LinkMotion, noise: HumanDynamicsNoise, links: tuple[str, ...], points: Mapping[str, FloatArray]
) -> WrenchSet:
    """The zeros that stand for unmeasured wrenches, as one measurement of all of them, so that their joint covariance comes out.

    The variances (`contact_wrench` of the noise) are those of force and moment at a contact's point, which is the link's origin unless
    `points` says otherwise: a hand that holds something at its middle exerts a moment about the wrist.
    """
    loose = resolve(noise.contact_wrench, motion.links, [6] * len(motion.links), "contact_wrench")
    covariance = np.zeros((6 * len(links), 6 * len(links)))
    for k, link in enumerate(links):
        shift = np.eye(6)
        shift[3:, :3] = skew(np.asarray(points.get(link, np.zeros(3)), dtype=float))
        part = slice(6 * k, 6 * k + 6)
        covariance[part, part] = shift @ np.diag(loose[motion.link(link)]) @ shift.T
    return WrenchSet(np.zeros((len(motion), len(covariance))), covariance, CONTACTS, links=links)


def solve_with_contacts(
    problem: HumanDynamics, solver: str | None
) -> tuple[HumanDynamicsEstimate, FloatArray, FloatArray]:
    """All frames of a problem that has :func:`contact_rows`.

    Returns
    -------
    HumanDynamicsEstimate
        Without the agreement of the contacts' zeros, which are no sensor.
    ndarray, shape (n, 6 k)
        Wrenches of the contacts, each in its link's frame.
    ndarray, shape (n, 6 k, 6 k)
        Their joint covariance.
    """
    from factorgrasp.solvers.frames import solve_frames

    keeper = _Keeper(problem)
    frames: HumanDynamicsEstimate = solve_frames(keeper, solver)
    system = problem.system
    group = system.touched(next(rows for rows in system.sensors if rows.name == CONTACTS))
    P = next(
        block
        for where, block in zip(system.marginals, keeper.result.marginals, strict=True)
        if np.array_equal(where, group)
    )
    kept = tuple(one for one in frames.innovations if one.name != CONTACTS)
    return replace(frames, innovations=kept), keeper.result.x[:, group], P


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


def payload_of(
    motion: LinkMotion,
    noise: HumanDynamicsNoise,
    contacts: tuple[str, ...],
    links: tuple[str, ...],
    x: FloatArray,
    P: FloatArray,
    points: Mapping[str, FloatArray] | None = None,
) -> Payload:
    """The mass of the one object that some of the contacts hold.

    Parameters
    ----------
    motion : LinkMotion
    noise : HumanDynamicsNoise
    contacts, links : tuple of str
        All contacts, and those that hold the object.
    x, P : ndarray
        (n, 6 k) and (n, 6 k, 6 k), of all contacts.
    points : mapping of str to (3,) ndarray, optional
        Where in the link's frame the object is held; the origin by default.

    Notes
    -----
    On hands with the acceleration a, an object of mass m pulls with ``F = m (g - a)``. The posterior of F, the sum of the hands' forces,
    holds a zero-mean prior (the noise's `contact_wrench` and `prior_external_wrench`), which draws masses towards zero. It is taken out:
    with the posterior ``N(mu, P)`` and the prior ``N(0, P0)`` the data alone say ``F = (P^-1 - P0^-1)^-1 P^-1 mu``, and ``m = F' u / u' u``
    with ``u = g - a``. Weighting the components of F by their covariance would use them better if u were exact; with the noise of a, the
    well-known horizontal ones bias the mass by several per cent. Errors of different hands go with each other: their joint covariance
    is used.
    """
    at = [motion.link(link) for link in links]
    R = motion.R[:, at]
    # Sum of the forces in the world as a linear read-out of the contacts' wrenches.
    read = np.zeros((len(motion), 3, 6 * len(contacts)))
    prior = np.zeros((len(motion), 3, 3))
    sizes = [6] * len(motion.links)
    loose = resolve(noise.contact_wrench, motion.links, sizes, "contact_wrench")
    wide = resolve(noise.prior_external_wrench, motion.links, sizes, "prior_external_wrench")
    for k, (link, i) in enumerate(zip(links, at, strict=True)):
        first = 6 * contacts.index(link)
        read[:, :, first : first + 3] = R[:, k]
        variance = 1.0 / (1.0 / loose[i][:3] + 1.0 / wide[i][:3])
        prior += R[:, k] @ (variance[:, None] * np.swapaxes(R[:, k], 1, 2))
    force = (read @ x[:, :, None])[..., 0]
    covariance = read @ P @ np.swapaxes(read, 1, 2)
    arm = rotate(R, np.array([(points or {}).get(link, np.zeros(3)) for link in links]))
    w = motion.angular_velocity[:, at]
    felt = (
        motion.acceleration[:, at]
        + np.cross(motion.angular_acceleration[:, at], arm)
        + np.cross(w, np.cross(w, arm))
    )
    u = motion.gravity - felt.mean(axis=1)
    good: BoolArray = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    posterior = np.linalg.inv(np.where(good[:, None, None], covariance, np.eye(3)))
    data = posterior - np.linalg.inv(prior)
    known: BoolArray = good & np.asarray(
        np.linalg.eigvalsh(data)[:, 0] > 1e-9 * np.linalg.eigvalsh(posterior)[:, 2]
    )
    spread = np.linalg.inv(np.where(known[:, None, None], data, np.eye(3)))
    h = u / np.sum(u**2, axis=1, keepdims=True)
    mass = np.einsum("ni,nij,njk,nk->n", h, spread, posterior, np.where(known[:, None], force, np.nan))
    variance = np.where(known, np.einsum("ni,nij,nj->n", h, spread, h), np.nan)
    sd = np.sqrt(variance)
    if not known.any():
        return Payload(links, mass, sd, float("nan"), float("nan"))
    weight = 1.0 / variance[known]
    mean = float(np.sum(weight * mass[known]) / weight.sum())
    return Payload(links, mass, sd, mean, float(np.nanmedian(sd)))

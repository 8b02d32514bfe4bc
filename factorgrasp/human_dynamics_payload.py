"""Contacts without a sensor, and the mass of what they hold (mathematics 4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from factorgrasp.least_squares import LeastSquares
from factorgrasp.problems.external_wrenches_estimate import ratio_bias
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_estimate import HumanDynamicsEstimate
from factorgrasp.problems.human_dynamics_sensors import WrenchSet
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise, resolve
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_spatial import rotate, skew
from factorgrasp.typing import BoolArray, FloatArray, IntArray

SMOOTHED = 101
"""Frames over which the weights of a mean are smoothed: longer than errors of accelerations last."""
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
        words = (
            f"{' and '.join(self.links)} {verb} {self.mean:.3f} kg (sd {self.mean_sd:.3f} kg in one frame)"
        )
        if self.mean < -2.0 * self.mean_sd:
            words += (
                ": less than nothing, so the model's masses are too large, or something else carries weight"
            )
        return words


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
    problem: HumanDynamics, solver: str | None, moving: tuple[str, ...] = ()
) -> tuple[HumanDynamicsEstimate, FloatArray, FloatArray]:
    """All frames of a problem that has :func:`contact_rows`.

    Parameters
    ----------
    problem : HumanDynamics
    solver : str or None
    moving : tuple of str
        Links whose accelerations are wanted beside the wrenches; none of them the fixed base.

    Returns
    -------
    HumanDynamicsEstimate
        Without the agreement of the contacts' zeros, which are no sensor.
    ndarray, shape (n, 6 k + 6 m)
        Wrenches of the contacts, then proper accelerations of the links that are wanted, each in its link's frame.
    ndarray, shape (n, 6 k + 6 m, 6 k + 6 m)
        Their joint covariance.
    """
    from factorgrasp.solvers.frames import solve_frames

    system = problem.system
    group = system.touched(next(rows for rows in system.sensors if rows.name == CONTACTS))
    at = [system.columns.acceleration[problem.motion.link(link)] for link in moving]
    keeper = _Keeper(problem, np.concatenate([group, *at]))
    frames: HumanDynamicsEstimate = solve_frames(keeper, solver)
    kept = tuple(one for one in frames.innovations if one.name != CONTACTS)
    return replace(frames, innovations=kept), keeper.result.x[:, keeper.group], keeper.result.marginals[-1]


class _Keeper:
    """A frame problem that asks for one more joint covariance and keeps the plain result beside the view of it."""

    def __init__(self, problem: HumanDynamics, group: IntArray) -> None:
        self._problem, self.kind, self.group = problem, problem.kind, group
        self.result: Any = None

    @property
    def frame_count(self) -> int:
        return self._problem.frame_count

    @property
    def pattern(self) -> LeastSquares:
        return self._problem.pattern

    @property
    def marginals(self) -> tuple[IntArray, ...]:
        return (*self._problem.marginals, self.group)

    def inequality_frames(self, frames: slice) -> tuple[FloatArray, FloatArray]:
        return self._problem.inequality_frames(frames)

    def relinearised(self, x: FloatArray) -> _Keeper | None:
        nearer = self._problem.relinearised(x)
        if nearer is None:
            return None
        self._problem = nearer
        return self

    def whitened_frames(self, frames: slice) -> tuple[FloatArray, FloatArray]:
        return self._problem.whitened_frames(frames)

    def frame(self, index: int) -> LeastSquares:
        return self._problem.frame(index)

    def view_frames(self, result: Any) -> HumanDynamicsEstimate:
        self.result = result
        return self._problem.view_frames(replace(result, marginals=result.marginals[:-1]))


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
        (n, 6 k + 6 m) and (n, 6 k + 6 m, 6 k + 6 m): wrenches of all contacts, then proper accelerations of `links`, as
        :func:`solve_with_contacts` gives them.
    points : mapping of str to (3,) ndarray, optional
        Where in the link's frame the object is held; the origin by default.

    Notes
    -----
    On hands with the acceleration a, an object of mass m pulls with ``F = m u``, ``u = g - a``, so that ``m = F' u /
    u' u``. Both F and u are
    estimates with errors that go with each other: an acceleration that is wrong by e changes F by the mass of all
    that moves with it times e.
    Their joint covariance gives the variance of m, and its second-order bias, which is taken out. The posterior of F
    holds a zero-mean prior
    (the noise's `contact_wrench` and `prior_external_wrench`), which draws masses towards zero. It is taken out, too: with the posterior
    ``N(mu, P)`` and the prior's information ``L0`` the data alone say ``(P^-1 - L0)^-1 P^-1 mu``. Weighting the components of F by their
    covariance would use them better if u were exact; with the noise of a, the well-known horizontal ones bias the mass by several per cent.
    """
    at = [motion.link(link) for link in links]
    R, count, inner = motion.R[:, at], len(motion), 6 * len(contacts)
    # Sum of the forces, and minus the mean of the accelerations felt, in the world as linear read-outs.
    read = np.zeros((count, 6, x.shape[1]))
    prior = np.zeros((count, 3, 3))
    sizes = [6] * len(motion.links)
    loose = resolve(noise.contact_wrench, motion.links, sizes, "contact_wrench")
    wide = resolve(noise.prior_external_wrench, motion.links, sizes, "prior_external_wrench")
    known_part = np.zeros((count, 3))
    for k, (link, i) in enumerate(zip(links, at, strict=True)):
        first, second = 6 * contacts.index(link), inner + 6 * k
        read[:, :3, first : first + 3] = R[:, k]
        variance = 1.0 / (1.0 / loose[i][:3] + 1.0 / wide[i][:3])
        prior += R[:, k] @ (variance[:, None] * np.swapaxes(R[:, k], 1, 2))
        arm = np.asarray((points or {}).get(link, np.zeros(3)), dtype=float)
        share = 1.0 / len(links)
        read[:, 3:, second : second + 3] = -share * R[:, k]
        read[:, 3:, second + 3 : second + 6] = share * R[:, k] @ skew(arm)
        w, v = motion.spatial_velocity[:, i, 3:], motion.spatial_velocity[:, i, :3]
        known_part -= share * rotate(R[:, k], np.cross(w, v + np.cross(w, arm)))
    y = (read @ x[:, :, None])[..., 0]
    y[:, 3:] += known_part
    C = read @ P @ np.swapaxes(read, 1, 2)
    good: BoolArray = np.asarray(np.isfinite(C).all(axis=(1, 2)) & np.isfinite(y).all(axis=1))
    C = np.where(good[:, None, None], C, np.eye(6))
    force, u = np.where(good[:, None], y[:, :3], 1.0), np.where(good[:, None], y[:, 3:], 1.0)
    # Without the prior: F alone first, then u, which goes along by its regression on F.
    posterior = np.linalg.inv(C[:, :3, :3])
    data = posterior - np.linalg.inv(prior)
    known: BoolArray = good & np.asarray(
        np.linalg.eigvalsh(data)[:, 0] > 1e-9 * np.linalg.eigvalsh(posterior)[:, 2]
    )
    spread = np.linalg.inv(np.where(known[:, None, None], data, np.eye(3)))
    freed = (spread @ posterior @ force[..., None])[..., 0]
    gain = C[:, 3:, :3] @ posterior
    u = u + (gain @ (freed - force)[..., None])[..., 0]
    cross = gain @ spread
    C_uu = C[:, 3:, 3:] + gain @ (spread - C[:, :3, :3]) @ np.swapaxes(gain, 1, 2)
    mass, variance = _ratio(freed, u, spread, cross, C_uu)
    mass, variance = np.where(known, mass, np.nan), np.where(known, variance, np.nan)
    sd = np.sqrt(variance)
    if not known.any():
        return Payload(links, mass, sd, float("nan"), float("nan"))
    # Variances hold the frame's own F and u: with weights from them, frames whose error is upwards would count for less.
    weight = 1.0 / median_filter(variance[known], SMOOTHED, mode="nearest")
    mean = float(np.sum(weight * mass[known]) / weight.sum())
    return Payload(links, mass, sd, mean, float(np.nanmedian(sd)))


def _ratio(
    F: FloatArray, u: FloatArray, C_FF: FloatArray, C_uF: FloatArray, C_uu: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``F' u / u' u`` (n,) without its second-order bias, and its first-order variance."""
    square, dot = np.sum(u**2, axis=1), np.sum(F * u, axis=1)
    m = dot / square
    by_F = u / square[:, None]
    by_u = (F - 2.0 * m[:, None] * u) / square[:, None]

    def form(a: FloatArray, C: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("ni,nij,nj->n", a, C, b))

    variance = form(by_F, C_FF, by_F) + 2.0 * form(by_u, C_uF, by_F) + form(by_u, C_uu, by_u)
    return m - ratio_bias(F, u, C_uF, C_uu), variance

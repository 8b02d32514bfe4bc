"""What the non-collocated estimate gives back: wrenches with covariances, a payload's mass, and what six equations cannot tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.observability import Direction, Observability
from factorgrasp.problems.external_wrenches_state import StateSpread
from factorgrasp.problems.human_dynamics_sensors import WrenchSet
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_spatial import rotate
from factorgrasp.typing import FloatArray
from factorgrasp.uncertainty import nees_band

AXES = (
    "force along x",
    "force along y",
    "force along z",
    "moment about x",
    "moment about y",
    "moment about z",
)
UNINFORMED = 0.5
"""Share of the prior variance that is left, from which a direction counts as not informed."""


@dataclass(frozen=True)
class Payload:
    """Mass carried by some links.

    Attributes
    ----------
    links : tuple of str
    mass, sd : ndarray
        (n,) kg, frame by frame.
    mean, mean_sd : float
        kg over all frames; the sd allows for errors that last over several frames.
    """

    links: tuple[str, ...]
    mass: FloatArray
    sd: FloatArray
    mean: float
    mean_sd: float


@dataclass(frozen=True)
class ExternalWrenchesEstimate:
    """External wrenches of n frames.

    Attributes
    ----------
    t : ndarray
        (n,) s.
    motion : LinkMotion
    links, measured, contacts : tuple of str
    wrench : ndarray
        (n, L, 6) ``[force; moment]`` in the link's frame, N and Nm.
    covariance, prior_covariance : ndarray
        (n, L, 6, 6) after and before the momentum was looked at.
    seen, gain : ndarray
        (n, L, 6, 6) ``A_i C_i`` and ``S^-1 A_i C_i``, from which the covariance of two links follows.
    momentum_innovation, momentum_covariance : ndarray
        (n, 6) what the momentum's rate says beyond the prior, and (n, 6, 6) its covariance.
    nis : ndarray
        (n,) normalised innovation squared of the six momentum rows.
    spread : StateSpread or None
        What the noise of the configurations does, where the motion tells it; it is counted in all covariances but the prior ones.
    """

    t: FloatArray
    motion: LinkMotion = field(repr=False)
    links: tuple[str, ...]
    measured: tuple[str, ...]
    contacts: tuple[str, ...]
    wrench: FloatArray
    covariance: FloatArray
    prior_covariance: FloatArray
    seen: FloatArray = field(repr=False)
    gain: FloatArray = field(repr=False)
    momentum_innovation: FloatArray = field(repr=False)
    momentum_covariance: FloatArray = field(repr=False)
    nis: FloatArray = field(repr=False)
    spread: StateSpread | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def sd(self) -> FloatArray:
        """(n, L, 6) N and Nm."""
        return np.asarray(np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=2, axis2=3), 0.0)))

    def of(self, link: str) -> FloatArray:
        """(n, 6) wrench on a link in its frame."""
        return self.wrench[:, self._index(link)]

    def world(self, link: str) -> FloatArray:
        """(n, 6) wrench on a link in world axes about the link's origin."""
        i = self._index(link)
        R = self.motion.R[:, i]
        return np.concatenate([rotate(R, self.wrench[:, i, :3]), rotate(R, self.wrench[:, i, 3:])], axis=1)

    def joint_covariance(self, links: Sequence[str], prior: bool = False) -> FloatArray:
        """(n, 6 k, 6 k) of the wrenches of k links together, each in its frame."""
        index = [self._index(link) for link in links]
        n, size = len(self), 6 * len(index)
        out = np.zeros((n, size, size))
        for a, i in enumerate(index):
            for b, j in enumerate(index):
                block = (
                    -np.swapaxes(self.seen[:, i], 1, 2) @ self.gain[:, j]
                    if not prior
                    else np.zeros((n, 6, 6))
                )
                if i == j:
                    block = block + self.prior_covariance[:, i]
                one, other = self._moved(links[a]), self._moved(links[b])
                if one is not None and other is not None:
                    block = block + one @ np.swapaxes(other, 1, 2)
                out[:, 6 * a : 6 * a + 6, 6 * b : 6 * b + 6] = block
        return 0.5 * (out + np.swapaxes(out, 1, 2))

    def _moved(self, link: str) -> FloatArray | None:
        """(n, 6, k) what errors of the configuration do to a measured wrench."""
        if self.spread is None or link not in self.measured:
            return None
        return self.spread.wrench[:, self.measured.index(link)]

    def as_sensor(self, links: Sequence[str] | None = None) -> WrenchSet:
        """These wrenches with their full covariance, as a measurement for ``HumanDynamics``.

        By default of all measured links and contacts. The accelerations of the links are used by both steps, so that the second one is more
        confident than the joint estimate (the same sensors and contacts in one ``HumanDynamics``), which uses them once.
        """
        chosen = tuple(links) if links is not None else (*self.measured, *self.contacts)
        values = np.concatenate([self.of(link) for link in chosen], axis=1)
        return WrenchSet(values, self.joint_covariance(chosen), "external wrenches by momentum", links=chosen)

    def payload(self, links: Sequence[str] | None = None) -> Payload:
        """Mass that hangs on some links (all contacts): ``m = sum_h f_h' u_h / |u_h|^2`` with ``u_h = g - a_h``.

        The links' own acceleration is part of it: dividing by standard gravity alone is biased while they move.
        Where the motion tells the noise
        of its configurations, that of these accelerations is counted, together with what it does to the forces, and
        the bias that it makes is
        taken out.

        Raises
        ------
        InputError
            When a link is not one of the contacts.
        """
        chosen = tuple(links) if links is not None else self.contacts
        for link in chosen:
            if link not in self.contacts:
                raise InputError(
                    "payload", "links among the contacts " + ", ".join(self.contacts), repr(link)
                )
        reader = np.zeros((len(self), 6 * len(chosen)))
        values = np.concatenate([self.of(link) for link in chosen], axis=1)
        carried = None if self.spread is None else np.zeros((len(self), self.spread.innovation.shape[2]))
        bias = np.zeros(len(self))
        for a, link in enumerate(chosen):
            i, part = self._index(link), slice(6 * a, 6 * a + 3)
            u = self.motion.gravity - self.motion.acceleration[:, i]
            along = np.einsum("nij,ni->nj", self.motion.R[:, i], u)
            square = np.sum(u**2, axis=1, keepdims=True)
            reader[:, part] = along / square
            if self.spread is not None and carried is not None:
                felt = self.spread.acceleration[:, self.contacts.index(link), :3]
                share = np.sum(values[:, part] * along, axis=1, keepdims=True) / square
                carried += -np.einsum("ni,nik->nk", (values[:, part] - 2.0 * share * along) / square, felt)
                pull = self.gain[:, i, :, :3]
                force = -np.swapaxes(pull, 1, 2) @ self.spread.innovation
                bias += ratio_bias(
                    values[:, part], along, -felt @ np.swapaxes(force, 1, 2), felt @ np.swapaxes(felt, 1, 2)
                )
        mass = np.einsum("ni,ni->n", reader, values) - bias
        variance = np.einsum("ni,nij,nj->n", reader, self.joint_covariance(chosen), reader)
        if self.spread is not None and carried is not None:
            # What the state's noise does to the forces goes with what it does to the accelerations.
            gain = np.concatenate([self.gain[:, self._index(link)] for link in chosen], axis=2)
            force = -np.einsum("nij,nj,nik->nk", gain, reader, self.spread.innovation)
            variance = variance + np.sum((carried + 2.0 * force) * carried, axis=1)
        weight = 1.0 / variance
        mean = float(np.sum(weight * mass) / np.sum(weight))
        return Payload(
            chosen, mass, np.sqrt(variance), mean, float(np.sqrt(_inflation(mass - mean) / np.sum(weight)))
        )

    def observability(self) -> Observability:
        """What the six momentum rows tell of the contacts: totals, how every two contacts share them, and squeezing, in world axes.

        Two contacts' forces may be told apart through the moments they make, as far as the prior keeps the contacts' own moments small.
        """
        every_C, every_P = self._in_world(prior=True), self._in_world(prior=False)
        C, P = np.mean(every_C, axis=0), np.mean(every_P, axis=0)
        count = len(self.contacts)
        found = []
        for a in range(count):
            for b in range(a + 1, count):
                one, other = self.contacts[a], self.contacts[b]
                line = self.motion.p[:, self._index(other)] - self.motion.p[:, self._index(one)]
                line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-9)
                squeeze = np.zeros((len(self), 6 * count))
                squeeze[:, 6 * a : 6 * a + 3], squeeze[:, 6 * b : 6 * b + 3] = 0.5 * line, -0.5 * line
                before, after = (
                    float(np.mean(np.einsum("ni,nij,nj->n", squeeze, V, squeeze))) for V in (every_C, every_P)
                )
                found.append(
                    _judged(
                        squeeze.mean(axis=0),
                        before,
                        after,
                        f"squeeze between {one} and {other} (force along the line through both)",
                        "N",
                    )
                )
        for axis, words in enumerate(AXES):
            unit = "N" if axis < 3 else "Nm"
            total = np.zeros(6 * count)
            total[axis::6] = 1.0
            what = (
                f"{words} on {self.contacts[0]}"
                if count == 1
                else f"total {words} on {', '.join(self.contacts)}"
            )
            found.append(_direction(total, C, P, what, unit))
            for a in range(count):
                for b in range(a + 1, count):
                    share = np.zeros(6 * count)
                    share[6 * a + axis], share[6 * b + axis] = 0.5, -0.5
                    found.append(
                        _direction(
                            share,
                            C,
                            P,
                            f"how the {words} is shared between {self.contacts[a]} and {self.contacts[b]}",
                            unit,
                        )
                    )
        found.sort(key=lambda d: d.sd / d.resolution, reverse=True)
        missing = any(not d.observable for d in found)
        advice = (
            "A wrench sensor on one of the contacts, or the knowledge that one of them is free, would tell their shares apart"
            if missing
            else ""
        )
        return Observability(tuple(found), advice)

    def mass_words(self) -> str:
        """What the measured forces say of the model's mass when the contacts carried nothing: for recordings without a load."""
        g = self.motion.gravity
        # Vertical part of what motion demands beyond what is measured, as a mass: positive when the model is too heavy.
        extra = -self.momentum_innovation[:, :3] @ g / float(g @ g)
        mean, sd = (
            float(extra.mean()),
            float(np.sqrt(_inflation(extra - extra.mean()) * extra.var() / extra.size)),
        )
        side = "lighter" if mean > 0.0 else "heavier"
        return (
            f"the measured forces carry a body {abs(mean):.2f} kg {side} than the model's {self.motion.total_mass:.2f} kg "
            f"(sd {sd:.2f} kg over {extra.size} frames)"
        )

    def summary(self) -> str:
        """A few lines for a terminal."""
        n = len(self)
        low, high = nees_band(6, n)
        ratio = float(self.nis.mean()) / 6.0
        lines = [
            f"external wrenches: {n} frames; measured on {', '.join(self.measured) or 'nothing'}; unmeasured on {', '.join(self.contacts)}"
        ]
        for link in self.contacts:
            force, sd = np.linalg.norm(self.of(link)[:, :3], axis=1), self.sd[:, self._index(link), :3]
            lines.append(f"  {link}: force {np.median(force):.1f} N (median), sd {np.median(sd):.2f} N")
        load = self.payload()
        lines.append(f"  payload {load.mean:.3f} kg, sd {load.mean_sd:.3f} kg")
        lines.append(
            f"  momentum: NIS per degree of freedom {ratio:.3g} (95 % band {low:.2f} to {high:.2f} for independent frames)"
        )
        lines += [f"  not informed: {d.words} (sd {d.sd:.3g} {d.unit})" for d in self.observability().missing]
        return "\n".join(lines)

    def _index(self, link: str) -> int:
        if link not in self.links:
            raise InputError("link", "one of " + ", ".join(self.links), repr(link))
        return self.links.index(link)

    def _in_world(self, prior: bool) -> FloatArray:
        count = len(self.contacts)
        T = np.zeros((len(self), 6 * count, 6 * count))
        for a, link in enumerate(self.contacts):
            R = self.motion.R[:, self._index(link)]
            for half in (0, 3):
                at = slice(6 * a + half, 6 * a + half + 3)
                T[:, at, at] = R
        return np.asarray(T @ self.joint_covariance(self.contacts, prior) @ np.swapaxes(T, 1, 2))


def _direction(vector: FloatArray, C: FloatArray, P: FloatArray, words: str, unit: str) -> Direction:
    return _judged(vector, float(vector @ C @ vector), float(vector @ P @ vector), words, unit)


def _judged(vector: FloatArray, before: float, after: float, words: str, unit: str) -> Direction:
    norm = float(np.linalg.norm(vector))
    return Direction(
        "contacts",
        vector / (norm or 1.0),
        float(np.sqrt(max(after, 0.0))),
        float(np.sqrt(UNINFORMED * before)),
        words,
        unit,
    )


def ratio_bias(f: FloatArray, u: FloatArray, C_uf: FloatArray, C_uu: FloatArray) -> FloatArray:
    """Second-order bias (n,) of ``f' u / u' u`` by the noise of u and what of f goes with it."""
    square, dot = np.sum(u**2, axis=1), np.sum(f * u, axis=1)

    def form(a: FloatArray, C: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("ni,nij,nj->n", a, C, b))

    trace = np.trace(C_uf, axis1=1, axis2=2) / square - 2.0 * form(u, C_uf, u) / square**2
    bend = -2.0 * form(f, C_uu, u) / square**2 - dot * np.trace(C_uu, axis1=1, axis2=2) / square**2
    return np.asarray(trace + bend + 4.0 * dot * form(u, C_uu, u) / square**3)


def _inflation(residual: FloatArray) -> float:
    """Variance of a mean over that for independent samples, from how long the residuals stay alike (initial positive correlations)."""
    n = residual.size
    centred = residual - residual.mean()
    power = float(centred @ centred)
    if n < 4 or power == 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, n // 2):
        rho = float(centred[lag:] @ centred[:-lag]) / power
        if rho <= 0.05:
            break
        total += 2.0 * rho
    return total

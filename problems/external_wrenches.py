"""Wrenches that no sensor measures, from those that are measured and the rate of the whole body's momentum.

Mathematics 4.2, Tirupachuri 2021. Unknowns of a frame: the net external wrench of every link in its frame. Rows: each against its
measurement, against zero (tight on free links, loose on contacts without a sensor), and six that all share, about the body's centre of
mass in world axes:

    ``sum_i X_G_i* f_i^x = hdot_G - w``,   w = [m g; 0],  hdot_G the full rate of the centroidal momentum.

Everything but these six rows is block-diagonal, so that the estimate has a closed form of rank six (Woodbury), computed for all frames
at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.least_squares import LeastSquares, Term
from factorgrasp.problems.external_wrenches_estimate import ExternalWrenchesEstimate
from factorgrasp.problems.external_wrenches_state import state_spread
from factorgrasp.problems.human_dynamics_names import wrench_on
from factorgrasp.problems.human_dynamics_rows import sensor_rows
from factorgrasp.problems.human_dynamics_sensors import ExternalWrench
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise, PerName, resolve
from factorgrasp.problems.human_dynamics_terms import WRENCH
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_spatial import skew
from factorgrasp.typing import FloatArray
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable

MOTION_CAPTURE = (4.0, 4.0, 4.0, 1.0, 1.0, 1.0)
MODEL_ERROR = 1e-3


class ExternalWrenches:
    """The non-collocated estimate of one recording.

    Parameters
    ----------
    motion : LinkMotion
    sensors : sequence of ExternalWrench
        What is measured, such as the plates under the feet. In a gap (NaN) a link counts as an unmeasured contact.
    contacts : sequence of str
        Links that may carry a wrench nobody measures.
    noise : HumanDynamicsNoise
        Its `free_wrench` and `contact_wrench` are used.
    momentum_rate : PerName, optional
        Variances of ``hdot_G - w``: N^2 and (Nm)^2, six components in world axes. The paper has 1e-3, which is the default where the motion
        tells the noise of its configurations (:attr:`LinkMotion.state_noise`), as what that does to the momentum is counted then; without
        it the default is (4, 4, 4, 1, 1, 1), nearer to what accelerations from motion capture leave.
    """

    kind = "external_wrenches"

    def __init__(
        self,
        motion: LinkMotion,
        sensors: Sequence[ExternalWrench],
        contacts: Sequence[str],
        noise: HumanDynamicsNoise | None = None,
        momentum_rate: PerName | None = None,
    ) -> None:
        self.motion, self.sensors, self.contacts = motion, tuple(sensors), tuple(contacts)
        self.noise = noise or HumanDynamicsNoise()
        links, tree = motion.links, motion.tree
        for link in self.contacts:
            if link not in links:
                raise InputError("contacts", "links among " + ", ".join(links), repr(link))
        if not self.contacts:
            raise InputError("contacts", "at least one link that may carry an unmeasured wrench", "none")
        self._rows = []
        for sensor in self.sensors:
            if not isinstance(sensor, ExternalWrench):
                raise InputError("sensors", "ExternalWrench", type(sensor).__name__)
            if sensor.values.shape[0] != len(motion):
                raise InputError(
                    sensor.name,
                    f"values at the {len(motion)} frames of the motion",
                    f"{sensor.values.shape[0]} rows",
                )
            if sensor.link in self.contacts:
                raise InputError("contacts", "links without a wrench sensor", repr(sensor.link))
            self._rows.append(sensor_rows(tree, sensor))
        measured = [sensor.link for sensor in self.sensors]
        if len(set(measured)) != len(measured):
            raise InputError("sensors", "one a link", ", ".join(measured), "Combine two of one link before")
        self._free = resolve(self.noise.free_wrench, links, [6] * len(links), "free wrench variance")
        self._loose = resolve(self.noise.contact_wrench, links, [6] * len(links), "contact wrench variance")
        if momentum_rate is None:
            momentum_rate = MODEL_ERROR if motion.state_noise is not None else MOTION_CAPTURE
        self._momentum = resolve(momentum_rate, ["the body"], [6], "momentum rate variance")[0]

    def __len__(self) -> int:
        return len(self.motion)

    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean (n, L, 6) and covariance (n, L, 6, 6) of every link's wrench before the momentum is looked at."""
        n, links = len(self), self.motion.links
        k = self.motion.kinematics()
        mean, covariance = np.zeros((n, len(links), 6)), np.zeros((n, len(links), 6, 6))
        for i, link in enumerate(links):
            covariance[:, i] = np.diag(self._loose[i] if link in self.contacts else self._free[i])
        for sensor, rows in zip(self.sensors, self._rows, strict=True):
            i = links.index(sensor.link)
            Y, C = rows.jacobian(k), sensor.variances()
            R = C[..., None] * np.eye(6) if C.ndim == 1 or (C.ndim == 2 and not rows.full) else C
            gaps = np.isnan(sensor.values)
            inverse = np.linalg.inv(Y)
            cov = np.broadcast_to(inverse @ R @ np.swapaxes(inverse, -1, -2), (n, 6, 6)).copy()
            value = (inverse @ np.where(gaps, 0.0, sensor.values)[..., None])[..., 0]
            for f in np.flatnonzero(gaps.any(axis=1)):
                have = ~gaps[f]
                Yf, Rf = Y[f if Y.shape[0] > 1 else 0][have], R[f if R.ndim == 3 else ...][np.ix_(have, have)]
                weight = np.linalg.solve(Rf, Yf) if have.any() else np.zeros((0, 6))
                cov[f] = np.linalg.inv(Yf.T @ weight + np.diag(1.0 / self._loose[i]))
                value[f] = cov[f] @ (weight.T @ sensor.values[f, have])
            mean[:, i], covariance[:, i] = value, cov
        return mean, covariance

    def centroidal_maps(self) -> FloatArray:
        """(n, L, 6, 6) ``X_G_i*``: wrenches in a link's frame to world axes about the body's centre of mass."""
        motion = self.motion
        out = np.zeros((len(self), len(motion.links), 6, 6))
        out[..., :3, :3] = out[..., 3:, 3:] = motion.R
        out[..., 3:, :3] = skew(motion.p - motion.body_com[:, None]) @ motion.R
        return out

    def estimate(self) -> ExternalWrenchesEstimate:
        """All frames by the closed form of rank six."""
        mean, C = self.prior()
        A = self.centroidal_maps()
        found = self._posterior(mean, C, A, mean)
        # The noise of the state acts through the wrenches, those of the contacts included.
        return found if self.motion.state_noise is None else self._posterior(mean, C, A, found.wrench)

    def _posterior(
        self, mean: FloatArray, C: FloatArray, A: FloatArray, wrenches: FloatArray
    ) -> ExternalWrenchesEstimate:
        motion, links = self.motion, self.motion.links
        AC = A @ C
        S = (AC @ np.swapaxes(A, -1, -2)).sum(axis=1) + np.diag(self._momentum)
        spread = None
        if motion.state_noise is not None:
            measured = [links.index(sensor.link) for sensor in self.sensors]
            world = [sensor.frame == "world" for sensor in self.sensors]
            contacts = [links.index(link) for link in self.contacts]
            spread = state_spread(motion, motion.state_noise, A, wrenches, measured, world, contacts)
            F = spread.innovation
            S = S + F @ np.swapaxes(F, 1, 2)
            for i, link in enumerate(measured):
                E = spread.wrench[:, i]
                AC[:, link] += F[:, :, : E.shape[2]] @ np.swapaxes(E, 1, 2)
        innovation = motion.momentum_rate - np.einsum("nlij,nlj->ni", A, mean)
        weighted = np.linalg.solve(S, innovation[..., None])
        gain = np.linalg.inv(S)[:, None] @ AC
        covariance = C - np.swapaxes(AC, -1, -2) @ gain
        if spread is not None:
            for i, link in enumerate(measured):
                covariance[:, link] += spread.wrench[:, i] @ np.swapaxes(spread.wrench[:, i], 1, 2)
        return ExternalWrenchesEstimate(
            t=motion.t,
            motion=motion,
            links=links,
            measured=tuple(sensor.link for sensor in self.sensors),
            contacts=self.contacts,
            wrench=mean + (np.swapaxes(AC, -1, -2) @ weighted[:, None])[..., 0],
            covariance=covariance,
            prior_covariance=C,
            seen=AC,
            gain=gain,
            momentum_innovation=innovation,
            momentum_covariance=S,
            nis=(innovation[:, None] @ weighted)[:, 0, 0],
            spread=spread,
        )

    def frame(self, index: int) -> LeastSquares:
        """One frame for any solver; the closed form needs none."""
        one = slice(index, index + 1)
        part = ExternalWrenches(
            self.motion.select(one), [sensor.frames(one) for sensor in self.sensors],  # type: ignore[misc]
            self.contacts, self.noise, self._momentum,
        )  # fmt: skip
        mean, C = part.prior()
        names = [wrench_on(link) for link in self.motion.links]
        terms = [
            Term(f"prior of {name}", 6, (name,), Covariance.blocks(C[0, i]), unit="N, Nm")
            for i, name in enumerate(names)
        ]
        terms.append(
            Term(
                "centroidal momentum rate", 6, tuple(names), Covariance.diagonal(self._momentum), unit="N, Nm"
            )
        )
        problem = LeastSquares([Variable(name, 6, unit="N, Nm", components=WRENCH) for name in names], terms)
        for i, name in enumerate(names):
            problem.set_term(f"prior of {name}", {name: np.eye(6)}, mean[0, i])
        maps = part.centroidal_maps()[0]
        problem.set_term(
            "centroidal momentum rate", dict(zip(names, maps, strict=True)), part.motion.momentum_rate[0]
        )
        return problem

"""The mass of a body from measured forces alone, against that of its model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgrasp.problems.human_dynamics_sensors import ExternalWrench
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_spatial import rotate


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
    def nis(self) -> float:
        """Squared disagreement in units of its variance: 1 is expected, 10 is a wrong model."""
        return ((self.mass - self.model) / self.sd) ** 2 if self.sd > 0.0 else float("nan")

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
        found = (
            f"the measured forces weigh {self.mass:.2f} kg (sd {self.sd:.2f}), the model {self.model:.2f} kg"
        )
        return f"{found} (NIS {self.nis:.3g}): {verdict}"


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

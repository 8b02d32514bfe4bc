"""What the wrist wants to do while the object is held: nothing, travel in a plane, or travel and turn."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from factorgrasp.pose_reference import Blend, Curve, times
from factorgrasp.simulation.trajectory import Sinusoids
from factorgrasp.typing import FloatArray

HumanMode: TypeAlias = Literal["static", "planar", "full"]


@dataclass(frozen=True)
class HumanMotion:
    """Wanted motion of the wrist from its start, as sums of sinusoids that begin smoothly.

    Attributes
    ----------
    travel : Sinusoids
        Way (m), world axes.
    turn : Sinusoids
        Rotation vector (rad), world axes.
    ramp : float
        s, from rest to the full motion.
    """

    travel: Sinusoids = field(default_factory=Sinusoids)
    turn: Sinusoids = field(default_factory=Sinusoids)
    ramp: float = 2.0

    @property
    def moves(self) -> bool:
        """Whether it wants to move at all."""
        return bool(np.any(np.asarray(self.travel.amplitude)) or np.any(np.asarray(self.turn.amplitude)))

    def at(self, t: FloatArray) -> tuple[Curve, Curve]:
        """Way and rotation vector at times `t` (n,), each (n, 3) with two derivatives."""
        rise = Blend(np.zeros(1))
        rise.go(0.0, np.ones(1), self.ramp)
        up = rise.at(t)
        return times(up, self.travel.derivatives(t)), times(up, self.turn.derivatives(t))


def human_motion(mode: HumanMode, travel: float = 0.06, angle: float = 0.12) -> HumanMotion:
    """The paper's three kinds of human motion (IV.A to IV.C).

    Parameters
    ----------
    mode : {"static", "planar", "full"}
        At rest; once round a circle in the horizontal plane in 8 s; the same with turns about two axes, that excite by themselves.
    travel : float
        Radius of the circle, m.
    angle : float
        Amplitude of the turns, rad.
    """
    quarter = 0.5 * np.pi
    circle = Sinusoids(
        (0.0, 0.0, 0.0), [(travel, 0, 0), (0, travel, 0)], (0.125, 0.125), [[quarter] * 3, [0.0] * 3]
    )
    turns = Sinusoids(
        (0.0, 0.0, 0.0), [(angle, 0, 0), (0, 0, angle)], (0.35, 0.35), [[quarter] * 3, [0.0] * 3]
    )
    if mode == "static":
        return HumanMotion()
    return HumanMotion(circle) if mode == "planar" else HumanMotion(circle, turns)


def about_travel(frequency: float = 1.0, round_trip: float = 0.125) -> Sinusoids:
    """Turns of unit angle about the direction of travel on the circle of :func:`human_motion` (the paper's strategy IV.B).

    ``sin(2 pi f t) (-sin, cos, 0)(2 pi f_c t)``: any two moments of different direction show all of the grasp.
    """
    low, high, quarter = frequency - round_trip, frequency + round_trip, 0.5 * np.pi
    # sin a sin b = (cos(a - b) - cos(a + b)) / 2, sin a cos b = (sin(a - b) + sin(a + b)) / 2.
    amplitude = [(-0.5, 0.5, 0.0), (0.5, 0.5, 0.0)]
    return Sinusoids((0.0, 0.0, 0.0), amplitude, (low, high), [(quarter, 0.0, 0.0)] * 2)

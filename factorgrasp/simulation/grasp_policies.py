"""How the robot moves while the grasp is estimated: the paper's velocity law, a pose-level reference, and the receding plan."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from factorgrasp.online.estimate import OnlineGraspEstimate
from factorgrasp.online.receding_excitation import RecedingExcitation
from factorgrasp.pose_reference import Blend, Curve, PoseReference, about_point, plus, times, turned
from factorgrasp.simulation.trajectory import Sinusoids, cross
from factorgrasp.typing import FloatArray


class Policy(Protocol):
    """Gives the reference block by block, and hears of estimates in between."""

    def observe(self, t: float, estimate: OnlineGraspEstimate | None, lever: FloatArray | None) -> None:
        """Take in what is known at time `t` (s): the online estimate, and the lever arm (3,) in m of whatever estimator runs."""
        ...

    def reference(self, t: FloatArray, travel: Curve, turn: Curve) -> PoseReference:
        """Reference at the next times `t` (n,) while the human wants to travel and turn so (world axes)."""
        ...


class RecedingPolicy:
    """Follows a :class:`~factorgrasp.online.receding_excitation.RecedingExcitation`."""

    def __init__(self, plan: RecedingExcitation) -> None:
        self.plan = plan

    def observe(self, t: float, estimate: OnlineGraspEstimate | None, lever: FloatArray | None) -> None:
        """See :class:`Policy`."""
        self.plan.update(t, estimate)

    def reference(self, t: FloatArray, travel: Curve, turn: Curve) -> PoseReference:
        """See :class:`Policy`."""
        return self.plan.reference(t, travel, turn)


class PosePolicy:
    """Turns about one believed lever arm, or always the newest estimate of it, at pose level and without any gate.

    Parameters
    ----------
    position, rotation : (3,), (3, 3) ndarray
        Start of the end-effector.
    motion : Sinusoids
        Rotation vector (rad, world axes).
    lever : (3,) ndarray
        m, end-effector frame.
    follow : bool
        Take over every new estimate.
    ramp : float
        s, from rest to the full motion; 0 for a motion that begins at rest.
    """

    def __init__(
        self,
        position: FloatArray,
        rotation: FloatArray,
        motion: Sinusoids,
        lever: FloatArray,
        follow: bool = False,
        ramp: float = 0.0,
    ) -> None:
        self._start, self._motion, self._follow = (position, rotation), motion, follow
        self._lever = Blend(lever)
        self._rise = Blend(np.zeros(1) if ramp else np.ones(1))
        if ramp:
            self._rise.go(0.0, np.ones(1), ramp)

    def observe(self, t: float, estimate: OnlineGraspEstimate | None, lever: FloatArray | None) -> None:
        """See :class:`Policy`."""
        if self._follow and lever is not None and not self._lever.busy(t):
            self._lever.go(t, lever, 0.1)

    def reference(self, t: FloatArray, travel: Curve, turn: Curve) -> PoseReference:
        """See :class:`Policy`."""
        phi = plus(times(self._rise.at(t), self._motion.derivatives(t)), turn)
        return about_point(*self._start, phi, self._lever.at(t), travel)


class VelocityPolicy:
    """The paper's law (26): ``v = r_hat x w`` integrated, with the newest estimate of ``r`` (or with one that is kept).

    Parameters
    ----------
    position, rotation : (3,), (3, 3) ndarray
        Start of the end-effector.
    motion : Sinusoids
        Rotation vector (rad, world axes); its rate is the paper's ``w_ref``.
    lever : (3,) ndarray
        ``r_0``, m.
    follow : bool
        Use every new estimate, as the paper does.
    ramp : float
        s, from rest to the full motion; 0 for a motion that begins at rest.
    """

    def __init__(
        self,
        position: FloatArray,
        rotation: FloatArray,
        motion: Sinusoids,
        lever: FloatArray,
        follow: bool = True,
        ramp: float = 0.0,
    ) -> None:
        self._position, self._rotation = np.array(position, dtype=float), np.array(rotation, dtype=float)
        self._motion, self._follow, self._lever = motion, follow, np.array(lever, dtype=float)
        self._rise = Blend(np.zeros(1) if ramp else np.ones(1))
        if ramp:
            self._rise.go(0.0, np.ones(1), ramp)

    def observe(self, t: float, estimate: OnlineGraspEstimate | None, lever: FloatArray | None) -> None:
        """See :class:`Policy`."""
        if self._follow and lever is not None and np.isfinite(lever).all():
            self._lever = lever

    def reference(self, t: FloatArray, travel: Curve, turn: Curve) -> PoseReference:
        """See :class:`Policy`."""
        phi = plus(times(self._rise.at(t), self._motion.derivatives(t)), turn)
        R, w, al = turned(self._rotation, phi)
        arm = R @ self._lever
        velocity = travel[1] - cross(w, arm)
        acceleration = travel[2] - cross(al, arm) - cross(w, cross(w, arm))
        # The velocity of every sample, held for one step, as a controller integrates it.
        step = t[1] - t[0]
        position = self._position + np.cumsum(velocity, axis=0) * step
        self._position = position[-1]
        return PoseReference(position, R, velocity, w, acceleration, al)


__all__ = ["Policy", "PosePolicy", "RecedingPolicy", "VelocityPolicy"]

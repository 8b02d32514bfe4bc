"""The paper's impedance control in its admittance form: a reference that yields to the wrench that the wrist exerts.

    M (xdd_c - xdd_d) + D (xd_c - xd_d) + K (x_c - x_d) = u_h

with the printed M, D, K (Cehajic 2015, V.A). The compliant pose ``x_c`` is what the arm's position control then tracks; a reference that is
tracked without any wrench is tracked exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio

from factorgrasp.errors import InputError
from factorgrasp.pose_reference import PoseReference
from factorgrasp.typing import FloatArray


@dataclass(frozen=True)
class Impedance:
    """Inertia, damping and stiffness, the same about and along all axes; the paper's values by default.

    Attributes
    ----------
    mass, damping, stiffness : float
        kg, Ns/m, N/m.
    inertia, rotational_damping, rotational_stiffness : float
        kg m^2, Nms/rad, Nm/rad (printed as N/m).
    """

    mass: float = 10.0
    damping: float = 180.0
    stiffness: float = 300.0
    inertia: float = 0.5
    rotational_damping: float = 10.0
    rotational_stiffness: float = 50.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"impedance.{name}", "a finite number above zero", repr(value))


class CompliantPose:
    """The compliant pose ``x_c``, integrated step by step (semi-implicit Euler).

    Attributes
    ----------
    position, velocity, angular_velocity : (3,) ndarray
        World axes. Velocities are those half a step before the pose, as the integration has them.
    rotation : (3, 3) ndarray
    acceleration, angular_acceleration : (3,) ndarray
        Of the last step.
    """

    def __init__(self, impedance: Impedance, position: FloatArray, rotation: FloatArray, step: float) -> None:
        self._law, self._step = impedance, step
        self.position, self.rotation = np.array(position, dtype=float), np.array(rotation, dtype=float)
        self.velocity, self.angular_velocity = np.zeros(3), np.zeros(3)
        self.acceleration, self.angular_acceleration = np.zeros(3), np.zeros(3)

    def advance(self, reference: PoseReference, k: int, wrench: FloatArray) -> None:
        """One step towards instant `k` of a reference, under a wrench (6,) on the end-effector's origin (N, Nm, world axes)."""
        law = self._law
        pull = law.damping * (reference.velocity[k] - self.velocity)
        pull += law.stiffness * (reference.position[k] - self.position) + wrench[:3]
        turn = law.rotational_damping * (reference.angular_velocity[k] - self.angular_velocity)
        turn += (
            law.rotational_stiffness * pinocchio.log3(reference.rotation[k] @ self.rotation.T) + wrench[3:]
        )
        self.acceleration = reference.acceleration[k] + pull / law.mass
        self.angular_acceleration = reference.angular_acceleration[k] + turn / law.inertia
        self.velocity = self.velocity + self._step * self.acceleration
        self.angular_velocity = self.angular_velocity + self._step * self.angular_acceleration
        self.position = self.position + self._step * self.velocity
        self.rotation = pinocchio.exp3(self._step * self.angular_velocity) @ self.rotation

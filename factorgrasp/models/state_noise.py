"""How noisy the configurations are that a motion was computed from: the errors of lever arms and directions, and of accelerations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.signals.savgol import savgol_weights
from factorgrasp.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class StateNoise:
    """Covariance of a configuration and, through the filter that differentiated it, of its accelerations.

    The k components are those of the root's displacement in its own frame (linear m, angular rad; floating base only), then those of all
    joints in the order of ``LinkMotion.dof_names`` (rad or m). ``Sigma`` is `covariance`, and

        cov(q) = g_q Sigma,   cov(qdd) = g_a Sigma,   cov(q, qdd) = g_qa Sigma.

    Velocities are left out: in the scenarios of this package their errors change no variance of a torque by a thousandth, because they
    act through products with velocities.

    Attributes
    ----------
    covariance : ndarray
        Of one sample of the configuration, (k,) variances or (k, k); with a leading axis of frames it varies over time.
    position_gain, acceleration_gain, cross_gain : float
        ``g_q``, ``g_a`` (1/s^4) and ``g_qa`` (1/s^2); 1, 0 and 0 where accelerations do not come from these samples, and then
        ``HumanDynamicsNoise`` says how noisy they are.
    acceleration : ndarray or None
        Covariance of the accelerations, (k, k) or (n, k, k), in the order of `covariance`, where a smoother gives it; errors of
        configurations are then taken to tell nothing of them. `acceleration_gain` must be 0.
    """

    covariance: FloatArray
    position_gain: float = 1.0
    acceleration_gain: float = 0.0
    cross_gain: float = 0.0
    acceleration: FloatArray | None = None

    def __post_init__(self) -> None:
        C = np.asarray(self.covariance, dtype=float)
        object.__setattr__(self, "covariance", C)
        if C.ndim not in (1, 2, 3) or not C.size or not np.all(np.isfinite(C)):
            raise InputError(
                "covariance of the state",
                "finite, of shape (k,), (k, k), (n, k) or (n, k, k)",
                f"shape {C.shape}",
            )
        if not self.position_gain > 0.0 or self.acceleration_gain < 0.0:
            raise InputError(
                "gains of the state's noise", "position gain above zero, acceleration gain of at least zero",
                f"{self.position_gain}, {self.acceleration_gain}",
            )  # fmt: skip
        if self.acceleration is not None:
            A = np.asarray(self.acceleration, dtype=float)
            object.__setattr__(self, "acceleration", A)
            if (
                A.shape[-2:] != (self.size, self.size)
                or A.ndim > 3
                or not np.all(np.isfinite(A))
                or self.acceleration_gain
            ):
                raise InputError(
                    "covariance of the accelerations",
                    f"finite, of shape ({self.size}, {self.size}) or (n, {self.size}, {self.size}), without a gain",
                    f"shape {A.shape}",
                )
        if self.acceleration_gain and self.left_gain <= 0.0:
            raise InputError(
                "cross gain of the state's noise", "cross^2 < position * acceleration",
                f"{self.cross_gain}^2 against {self.position_gain} * {self.acceleration_gain}",
            )  # fmt: skip

    @property
    def size(self) -> int:
        """Number of components k."""
        return int(self.covariance.shape[-1])

    @property
    def full(self) -> bool:
        """Whether components are correlated."""
        return self.covariance.ndim == 3 or (
            self.covariance.ndim == 2 and self.covariance.shape[0] == self.size
        )

    @property
    def varies(self) -> bool:
        """Whether it has a leading axis of frames."""
        return self.covariance.ndim == 3 or (self.covariance.ndim == 2 and not self.full)

    @property
    def ratio(self) -> float:
        """``g_qa / g_q``: what an error of the configuration says of that of the acceleration."""
        return self.cross_gain / self.position_gain

    @property
    def left_gain(self) -> float:
        """Gain of an acceleration whose configuration is known: ``g_a - g_qa^2 / g_q``."""
        return self.acceleration_gain - self.cross_gain**2 / self.position_gain

    @property
    def gives_accelerations(self) -> bool:
        """Whether it says how noisy accelerations are."""
        return self.acceleration is not None or self.acceleration_gain > 0.0

    @property
    def left(self) -> StateNoise:
        """Noise of accelerations whose configuration is known, as the `covariance` of one of its own."""
        if self.acceleration is not None:
            return StateNoise(self.acceleration)
        return StateNoise(max(self.left_gain, 0.0) * self.covariance)

    def part(self, index: IntArray) -> FloatArray:
        """``Sigma`` of some components, in the shape it has."""
        return self.covariance[..., index, :][..., index] if self.full else self.covariance[..., index]

    def select(self, frames: IntArray | slice | BoolArray) -> StateNoise:
        """Of some of the frames."""
        out = replace(self, covariance=self.covariance[frames]) if self.varies else self
        if self.acceleration is not None and self.acceleration.ndim == 3:
            out = replace(out, acceleration=self.acceleration[frames])
        return out

    def check(self, size: int, frames: int) -> None:
        """Raise `InputError` when it does not belong to a motion of so many components and frames."""
        if self.size != size or (self.varies and self.covariance.shape[0] != frames):
            raise InputError(
                "state noise of the motion", f"{size} components (root first, then joints) and, where it varies, {frames} frames",
                f"shape {self.covariance.shape}",
            )  # fmt: skip
        lowest = np.linalg.eigvalsh(self.covariance).min() if self.full else self.covariance.min()
        if lowest <= 0.0:
            raise InputError(
                "state noise of the motion",
                "a positive definite covariance",
                f"smallest variance {lowest:.3g}",
            )

    @classmethod
    def through_savgol(cls, covariance: FloatArray, window: int, order: int, dt: float) -> StateNoise:
        """White noise of configurations through the Savitzky-Golay filter that smoothed and differentiated them."""
        c, a = savgol_weights(window, order, 0, dt), savgol_weights(window, order, 2, dt)
        return cls(np.asarray(covariance, dtype=float), float(c @ c), float(a @ a), float(c @ a))

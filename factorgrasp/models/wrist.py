"""The human wrist as a spring between where it wants to be and where it is held (Cehajic 2015 (4))."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray


@dataclass(frozen=True)
class WristStiffness:
    """Stiffness of the human wrist, the same in all directions.

    The paper does not print it. Measured stiffness of a relaxed arm's end point is 100 to 600 N/m; that of the wrist's rotation is some
    Nm/rad.

    Parameters
    ----------
    translation : float
        ``K_h,t``, N/m.
    rotation : float
        ``K_h,r``, Nm/rad.
    """

    translation: float = 300.0
    rotation: float = 2.0

    def __post_init__(self) -> None:
        for name, key in (("translation", "force"), ("rotation", "moment")):
            value = getattr(self, name)
            if not np.isfinite(value) or value < 0.0:
                raise InputError(f"human.{key}_stiffness", "a finite number, zero or more", repr(value))

    def wrench(
        self,
        position: npt.ArrayLike,
        rotation: npt.ArrayLike,
        wanted_position: npt.ArrayLike,
        wanted_rotation: npt.ArrayLike,
    ) -> FloatArray:
        """Wrench [force; torque] (n, 6) of the wrist on the object, in N and Nm, world axes: ``K (x_d - x)``.

        Parameters
        ----------
        position, wanted_position : (n, 3) array_like
            ``p_w_h`` as it is and as the human wants it, m; one of them may be (3,).
        rotation, wanted_rotation : (n, 3, 3) array_like
            ``R_w_h``; one of them may be (3, 3).
        """
        turn = np.asarray(wanted_rotation) @ np.swapaxes(np.asarray(rotation), -1, -2)
        force = self.translation * (np.asarray(wanted_position, dtype=float) - np.asarray(position))
        torque = self.rotation * lie.so3_log(turn)
        force, torque = np.broadcast_arrays(force, torque)
        return np.concatenate([force, torque], axis=-1)


@dataclass(frozen=True)
class WrenchSummary:
    """Size of a wrench over time.

    Attributes
    ----------
    peak_force, rms_force : float
        N.
    peak_torque, rms_torque : float
        Nm.
    """

    peak_force: float
    rms_force: float
    peak_torque: float
    rms_torque: float

    @classmethod
    def of(cls, wrench: npt.ArrayLike) -> WrenchSummary:
        """Of wrenches (n, 6), [force; torque]; rows with NaN are left out, and NaN is the answer where nothing remains."""
        w = np.asarray(wrench, dtype=float)
        sizes = [np.linalg.norm(w[:, part], axis=1) for part in (slice(0, 3), slice(3, 6))]
        out = []
        for size in sizes:
            good = size[np.isfinite(size)]
            out += [float(good.max()), float(np.sqrt(np.mean(good**2)))] if good.size else [float("nan")] * 2
        return cls(*out)

    def to_dict(self) -> dict[str, float]:
        """By name."""
        return {
            "peak_force": self.peak_force,
            "rms_force": self.rms_force,
            "peak_torque": self.peak_torque,
            "rms_torque": self.rms_torque,
        }

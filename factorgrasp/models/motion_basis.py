"""Smooth motions as linear combinations of functions of time: Fourier series and B-splines."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray


class MotionBasis(Protocol):
    """Functions of time on [0, duration].

    Attributes
    ----------
    duration : float
        s.
    size : int
        Number of functions.
    """

    duration: float
    size: int

    def values(self, t: FloatArray, order: int = 0) -> FloatArray:
        """(size, n): the derivative of this order of every function at the times `t` (n,)."""
        ...


class FourierBasis:
    """One and the cosines and sines of the first harmonics of 1 / duration: what a steady bandwidth means literally.

    Parameters
    ----------
    duration : float
        s.
    bandwidth : float
        Hz; harmonics up to it.

    Raises
    ------
    InputError
        When not even one period of the bandwidth fits into the duration.
    """

    def __init__(self, duration: float, bandwidth: float) -> None:
        self.duration = duration
        self.harmonics = int(np.floor(duration * bandwidth * (1.0 + 1e-9)))
        if self.harmonics < 1:
            raise InputError(
                "excitation.bandwidth",
                f"at least 1 / duration = {1.0 / duration:.3g} Hz",
                f"{bandwidth:g} Hz",
            )
        self.size = 2 * self.harmonics + 1

    def values(self, t: FloatArray, order: int = 0) -> FloatArray:
        """(size, n): derivatives of one, cos 1, sin 1, cos 2, ..."""
        t = np.asarray(t, dtype=float)
        out = np.zeros((self.size, t.size))
        if order == 0:
            out[0] = 1.0
        w = 2.0 * np.pi * np.arange(1, self.harmonics + 1) / self.duration
        phase = np.outer(w, t) + 0.5 * np.pi * order
        gain = (w**order)[:, None]
        out[1::2], out[2::2] = gain * np.cos(phase), gain * np.sin(phase)
        return out


class BSplineBasis:
    """B-splines of degree 5 on equal intervals, half a period of the bandwidth each: jerk is continuous, support is local.

    Parameters
    ----------
    duration : float
        s.
    bandwidth : float
        Hz; the intervals are ``1 / (2 bandwidth)`` long.
    """

    degree = 5

    def __init__(self, duration: float, bandwidth: float) -> None:
        self.duration = duration
        intervals = int(np.ceil(2.0 * duration * bandwidth * (1.0 - 1e-9)))
        if intervals < 2:
            raise InputError(
                "excitation.bandwidth",
                f"at least 1 / duration = {1.0 / duration:.3g} Hz",
                f"{bandwidth:g} Hz",
            )
        inner = np.linspace(0.0, duration, intervals + 1)
        self._knots = np.concatenate([np.zeros(self.degree), inner, np.full(self.degree, duration)])
        self.size = intervals + self.degree

    def values(self, t: FloatArray, order: int = 0) -> FloatArray:
        """(size, n)."""
        from scipy.interpolate import BSpline

        splines = BSpline(self._knots, np.eye(self.size), self.degree)
        return np.ascontiguousarray(splines(np.clip(t, 0.0, self.duration), nu=order).T)


def make_basis(kind: str, duration: float, bandwidth: float) -> MotionBasis:
    """A basis by its name, "fourier" or "bspline"."""
    makers: dict[str, type[FourierBasis] | type[BSplineBasis]] = {"fourier": FourierBasis, "bspline": BSplineBasis}  # fmt: skip
    if kind not in makers:
        raise InputError("excitation.basis", "one of " + ", ".join(map(repr, makers)), repr(kind))
    return makers[kind](duration, bandwidth)


def minimum_jerk(s: FloatArray) -> FloatArray:
    """(4, n): ``10 s^3 - 15 s^4 + 6 s^5`` and its three derivatives, for s in [0, 1]; at rest outside."""
    s = np.clip(np.asarray(s, dtype=float), 0.0, 1.0)
    inside = (s > 0.0) & (s < 1.0)
    return np.stack(
        [
            s**3 * (10.0 - 15.0 * s + 6.0 * s**2),
            30.0 * s**2 * (1.0 - s) ** 2,
            60.0 * s * (1.0 - s) * (1.0 - 2.0 * s),
            np.where(inside, 60.0 * (1.0 - 6.0 * s + 6.0 * s**2), 0.0),
        ]
    )

"""Directions of the unknowns that nothing informs: as numbers, and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgrasp.observability import Describe, default_words
from factorgrasp.typing import BoolArray, FloatArray
from factorgrasp.variables import Variable, slices

REACH = 1e-7
"""Share along a null direction, both in conditional standard deviations, above which a read-out or a variable is touched by it."""


MOST_WORDS = 8
"""Directions that a message names before it counts the rest."""


@dataclass(frozen=True)
class NullSpace:
    """Null directions in coordinates without units.

    Attributes
    ----------
    axes : ndarray
        (n, k), orthonormal in the scaled unknowns ``x / scale``.
    scale : ndarray
        (n,) conditional standard deviation of every unknown given all others, or a stand-in where nothing measures it.
    """

    axes: FloatArray
    scale: FloatArray

    @classmethod
    def none(cls, size: int) -> NullSpace:
        """No null direction."""
        return cls(np.empty((size, 0)), np.ones(size))

    @property
    def count(self) -> int:
        """Number of independent directions."""
        return int(self.axes.shape[1])

    @property
    def tangent(self) -> FloatArray:
        """Basis (n, k) in the unknowns' own units."""
        return self.axes * self.scale[:, None]

    def project_out(self, x: FloatArray) -> FloatArray:
        """Remove the part of x (n,) or (n, k) along the null directions, in scaled coordinates."""
        if not self.count:
            return x
        scale = self.scale if x.ndim == 1 else self.scale[:, None]
        return np.asarray(x - scale * (self.axes @ (self.axes.T @ (x / scale))))

    def reaches(self, columns: FloatArray) -> BoolArray:
        """Which read-outs, the columns of (n, k), have a part along a null direction."""
        if not self.count:
            return np.zeros(columns.shape[1], dtype=bool)
        scaled = columns * self.scale[:, None]
        share = np.abs(self.axes.T @ scaled).max(axis=0)
        return np.asarray(share > REACH * np.linalg.norm(scaled, axis=0))

    def reaches_unknowns(self) -> BoolArray:
        """Which unknowns (n,) have a part along a null direction."""
        return np.asarray(np.abs(self.axes).max(axis=1, initial=0.0) > REACH)

    def parts(self, variables: Sequence[Variable]) -> dict[str, FloatArray]:
        """Orthonormal directions (size, r) in the units of every variable that is reached; the others are left out."""
        out: dict[str, FloatArray] = {}
        for name, where in slices(variables).items():
            axes, values, _ = np.linalg.svd(self.axes[where], full_matrices=False)
            reached = values > REACH
            if reached.any():
                directions = axes[:, reached] * self.scale[where, None]
                out[name] = np.linalg.qr(directions / np.linalg.norm(directions, axis=0))[0]
        return out

    def message(self, variables: Sequence[Variable], describe: Describe = default_words) -> str:
        """One sentence that names everything that is reached."""
        parts = self.parts(variables)
        named = _words(variables, parts, describe)
        more = len(named) - MOST_WORDS
        phrases = "; ".join(named if more <= 1 else [*named[:MOST_WORDS], f"and {more} more"])
        if sum(axes.shape[1] for axes in parts.values()) == self.count:
            return f"the data do not inform {phrases}"
        # Variables that share a direction are each lost on their own, though combinations of them may be known.
        return f"the data leave {self.count} direction(s) open that run through {phrases}"


def _words(variables: Sequence[Variable], parts: Mapping[str, FloatArray], describe: Describe) -> list[str]:
    """One phrase a direction, variable by variable."""
    phrases: list[str] = []
    for variable in variables:
        axes = parts.get(variable.name)
        if axes is None:
            continue
        if axes.shape[1] == variable.size:
            phrases.append(f"{variable.name} (all of it)" if variable.size > 1 else variable.labels[0])
        else:
            phrases += [describe(variable, axis * _sign(axis)) for axis in axes.T]
    return phrases


def _sign(axis: FloatArray) -> float:
    return 1.0 if axis[int(np.argmax(np.abs(axis)))] >= 0.0 else -1.0

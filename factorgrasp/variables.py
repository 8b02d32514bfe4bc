"""Named unknowns and the manifolds they live on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray, State

Manifold = Literal["vector", "rotation", "pose"]


@dataclass(frozen=True)
class Variable:
    """One named unknown.

    Attributes
    ----------
    name : str
        Unique within a problem, e.g. ``"rotation"``, ``"gyro_bias"``.
    size : int
        Dimension of its tangent space: the columns that it takes in a linear system.
    manifold : {"vector", "rotation", "pose"}
        ``rotation`` is ``R`` (3, 3) with the right perturbation ``R Exp(d)``; ``pose`` is ``T`` (4, 4) with the right perturbation
        ``T Exp([linear; angular])``.
    unit : str
        Unit of a tangent component, for reports.
    components : tuple of str
        A word for every tangent component, for reports; made from the name when empty.
    resolution : float or None
        Standard deviation (in `unit`) above which a direction of this variable counts as not informed by the data; None: not judged.
    """

    name: str
    size: int
    manifold: Manifold = "vector"
    unit: str = ""
    components: tuple[str, ...] = ()
    resolution: float | None = None

    def __post_init__(self) -> None:
        needed = {"rotation": 3, "pose": 6}.get(self.manifold, self.size)
        if self.size < 1 or self.size != needed:
            raise InputError(f"variable {self.name}", f"a size of {max(needed, 1)}", str(self.size))
        if self.components and len(self.components) != self.size:
            raise InputError(
                f"variable {self.name}", f"{self.size} component names", str(len(self.components))
            )

    @property
    def labels(self) -> tuple[str, ...]:
        """One label a tangent component."""
        if self.components:
            return self.components
        return (self.name,) if self.size == 1 else tuple(f"{self.name}[{i}]" for i in range(self.size))

    def retract(self, value: FloatArray, step: FloatArray) -> FloatArray:
        """Move `value` by the tangent vector `step` (size,)."""
        if self.manifold == "rotation":
            return np.asarray(value @ lie.so3_exp(step), dtype=float)
        if self.manifold == "pose":
            return np.asarray(value @ lie.se3_exp(step), dtype=float)
        return np.asarray(value + step, dtype=float)

    def local(self, origin: FloatArray, value: FloatArray) -> FloatArray:
        """Tangent vector (size,) that `retract` needs to go from `origin` to `value`."""
        if self.manifold == "rotation":
            return np.asarray(lie.so3_log(origin.T @ value), dtype=float)
        if self.manifold == "pose":
            return np.asarray(lie.se3_log(np.linalg.inv(origin) @ value), dtype=float)
        return np.asarray(value - origin, dtype=float)


def slices(variables: Sequence[Variable]) -> dict[str, slice]:
    """Columns of every variable when they stand one after another."""
    out: dict[str, slice] = {}
    start = 0
    for variable in variables:
        if variable.name in out:
            raise InputError("variables", "unique names", f"{variable.name!r} twice")
        out[variable.name] = slice(start, start + variable.size)
        start += variable.size
    return out


def retract(variables: Sequence[Variable], state: State, step: FloatArray) -> dict[str, FloatArray]:
    """Move every variable of `state` by its part of `step` (sum of sizes,)."""
    where: Mapping[str, slice] = slices(variables)
    return {v.name: v.retract(state[v.name], step[where[v.name]]) for v in variables}

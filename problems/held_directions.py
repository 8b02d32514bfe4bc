"""Directions of the unknowns that are kept where they started, because a search along them would only follow noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp import lie
from factorgrasp.least_squares import LeastSquares, Term
from factorgrasp.typing import FloatArray, State
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable

HELD_TERM = "directions without information"
"""Name of the term that holds them."""

# In posterior standard deviations of what noise pretends.
_SD = 0.03


@dataclass(frozen=True)
class HeldDirections:
    """Directions (k, n) of the tangent space along which the state stays where it was."""

    state: State
    rows: FloatArray


def held_term(held: HeldDirections, variables: tuple[Variable, ...]) -> Term:
    """The term of the held directions, to be filled by :func:`fill_held`."""
    names = tuple(variable.name for variable in variables)
    return Term(HELD_TERM, len(held.rows), names, Covariance.scalar(_SD**2), unit="")


def fill_held(system: LeastSquares, held: HeldDirections, state: State) -> None:
    """Rows that pull the state back to where it is held."""
    blocks, total = {}, np.zeros(len(held.rows))
    for variable in system.variables:
        way = variable.local(held.state[variable.name], state[variable.name])
        slope = (
            lie.so3_right_jacobian_inverse(way) if variable.manifold == "rotation" else np.eye(variable.size)
        )
        part = held.rows[:, system.columns[variable.name]]
        blocks[variable.name] = part @ slope
        total += part @ way
    system.set_term(HELD_TERM, blocks, -total)

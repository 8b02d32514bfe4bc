"""Constraints that hold with equality: which, in which frames, and what their multipliers mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgrasp.problems.link_motion import LinkKinematics
from factorgrasp.typing import FloatArray

if TYPE_CHECKING:
    from factorgrasp.problems.human_dynamics import HumanDynamics


@dataclass(frozen=True)
class ActiveConstraint:
    """One row of a constraint that is active in one frame.

    Attributes
    ----------
    frame : int
    name : str
    row : int
    multiplier : float
        How much half the chi-square would fall if the limit gave way by one unit.
    unit : str
        N or Nm.
    meaning : str
    """

    frame: int
    name: str
    row: int
    multiplier: float
    unit: str
    meaning: str

    @property
    def words(self) -> str:
        """A sentence."""
        return f"{self.meaning}; giving way by 1 {self.unit} would lower half the chi-square by {self.multiplier:.3g}"


def active_constraints(
    problem: HumanDynamics, k: LinkKinematics, result: Any
) -> tuple[ActiveConstraint, ...]:
    """All active rows, frame by frame; a row is active when its multiplier is larger than its slack (in N or Nm)."""
    out: list[ActiveConstraint] = []
    if not problem.constraints:
        return ()
    where = problem.pattern.inequalities.slices
    for f in range(result.x.shape[0]):
        if not np.all(np.isfinite(result.x[f])):
            continue
        one = k.select(slice(f, f + 1))
        for constraint in problem.constraints:
            z = _multiplier(result, f, constraint.name, where[constraint.name])
            if z is None:
                continue
            blocks, limit = constraint.rows(problem.system.tree, one)
            value = sum(block @ result.x[f][problem.pattern.columns[v]] for v, block in blocks.items())
            slack = limit - value
            for row in np.flatnonzero((z > slack) & (z > 1e-6)):
                words = constraint.words(int(row))
                out.append(
                    ActiveConstraint(f, constraint.name, int(row), float(z[row]), constraint.unit, words)
                )
    return tuple(out)


def _multiplier(result: Any, frame: int, name: str, rows: slice) -> FloatArray | None:
    solutions = getattr(result, "solutions", ())
    if solutions:
        z = solutions[frame].z
        return np.asarray(z[rows]) if z.size else None
    named = getattr(result, "multipliers", ())
    return np.asarray(named[frame][name]) if named and name in named[frame] else None

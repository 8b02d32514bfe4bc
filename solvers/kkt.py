"""Least squares under equality constraints, by one factorisation of the saddle-point system and refinement through A and E."""

from __future__ import annotations

from typing import ClassVar

from factorgrasp.solvers.base import Capabilities
from factorgrasp.solvers.cholesky import Cholesky


class Kkt(Cholesky):
    """``[[A'A, E'], [E, 0]] [x; y] = [A'b; e]``; small problems through an orthonormal null-space basis of E.

    Constraints may repeat each other; contradictory ones end as `Status.INFEASIBLE` and are named. Without constraints it is the same as
    "cholesky".
    """

    name: ClassVar[str] = "kkt"
    capabilities: ClassVar[Capabilities] = Capabilities(equalities=True)

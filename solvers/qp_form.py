"""A quadratic program as a backend can take it, and the way back for its multipliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from factorgrasp.least_squares import QuadraticProgram
from factorgrasp.solvers.base import Solution
from factorgrasp.typing import FloatArray, IntArray

INFINITE = 1e20
"""Right-hand sides and bounds from here on count as absent."""


@dataclass(frozen=True)
class QpForm:
    """``min 1/2 x'Px + q'x  s.t.  G x <= h, A x = b, lb <= x <= ub`` with every row of G finite.

    `G`, `A` and the bounds are None where there is none. Rows of G: the kept rows of the original, then the folded upper bounds, then the
    folded lower bounds, then a vacuous row for the backends that refuse a problem without constraints.

    Attributes
    ----------
    kept : ndarray
        Rows of the original G that are finite.
    upper, lower : ndarray
        Components whose bounds were folded into G.
    inequalities : int
        Rows of the original G.
    """

    P: sp.csc_matrix
    q: FloatArray
    G: sp.csc_matrix | None
    h: FloatArray | None
    A: sp.csc_matrix | None
    b: FloatArray | None
    lb: FloatArray | None
    ub: FloatArray | None
    kept: IntArray
    upper: IntArray
    lower: IntArray
    inequalities: int

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.q.size)

    def back(self, z: FloatArray, z_box: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Multipliers of the original inequalities and bounds from those of this form."""
        k, u = self.kept.size, self.upper.size
        full = np.zeros(self.inequalities)
        full[self.kept] = z[:k]
        box = z_box.copy() if z_box.size else np.zeros(self.size)
        box[self.upper] += z[k : k + u]
        box[self.lower] -= z[k + u : k + u + self.lower.size]
        return full, box

    def forward(self, start: Solution) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``(y, z, z_box)`` of this form from an earlier solution, zeros where it has none."""
        equalities = 0 if self.b is None else self.b.size
        y = start.y if start.y.size == equalities else np.zeros(equalities)
        z = start.z if start.z.size == self.inequalities else np.zeros(self.inequalities)
        box = start.z_box if start.z_box.size == self.size else np.zeros(self.size)
        height = 0 if self.h is None else self.h.size
        parts = np.concatenate(
            [z[self.kept], np.maximum(box[self.upper], 0.0), np.maximum(-box[self.lower], 0.0)]
        )
        return y, np.pad(parts, (0, height - parts.size)), box


def make_form(qp: QuadraticProgram, fold_bounds: bool = False, needs_rows: bool = False) -> QpForm:
    """Bring a quadratic program into the form of a backend.

    Parameters
    ----------
    qp : QuadraticProgram
    fold_bounds : bool
        Make the finite bounds rows of G, for backends that have no bounds or mishandle infinite ones.
    needs_rows : bool
        Add the vacuous row ``0 x <= 1`` when there is no constraint at all.
    """
    n = qp.q.size
    none = np.empty(0, dtype=np.intp)
    count = 0 if qp.h is None else int(qp.h.size)
    kept = none if qp.h is None else np.flatnonzero(qp.h < INFINITE)
    rows: list[sp.csc_matrix] = []
    sides: list[FloatArray] = []
    if kept.size and qp.G is not None and qp.h is not None:
        rows.append(_csc(qp.G if kept.size == count else sp.csr_array(qp.G)[kept]))
        sides.append(qp.h[kept])
    lb, ub, upper, lower = qp.lb, qp.ub, none, none
    if fold_bounds:
        eye = sp.eye_array(n, format="csr")
        if ub is not None:
            upper = np.flatnonzero(ub < INFINITE)
            rows.append(_csc(eye[upper]))
            sides.append(ub[upper])
        if lb is not None:
            lower = np.flatnonzero(lb > -INFINITE)
            rows.append(_csc(-eye[lower]))
            sides.append(-lb[lower])
        lb = ub = None
    if needs_rows and not any(side.size for side in sides) and qp.A is None:
        rows, sides = [sp.csc_matrix((1, n))], [np.ones(1)]
    height = sum(side.size for side in sides)
    return QpForm(
        P=_csc(qp.P),
        q=qp.q,
        G=None if not height else rows[0] if len(rows) == 1 else sp.vstack(rows, format="csc"),
        h=np.concatenate(sides) if height else None,
        A=None if qp.A is None else _csc(qp.A),
        b=qp.b,
        lb=lb,
        ub=ub,
        kept=kept,
        upper=upper,
        lower=lower,
        inequalities=count,
    )


def _csc(matrix: sp.sparray | sp.spmatrix) -> sp.csc_matrix:
    """The old matrix class with 32-bit indices: what the compiled backends ask for."""
    out = sp.csc_matrix(matrix)
    out.sort_indices()
    if out.indices.dtype != np.int32:
        out = sp.csc_matrix(
            (out.data, out.indices.astype(np.int32), out.indptr.astype(np.int32)), shape=out.shape
        )
    return out

"""Inequalities in many frames of one pattern by PIQP, without building a problem anew for each.

The Hessian ``A' A`` of all frames comes from one list of products, the interior-point solver keeps its ordering and symbolic factorisation,
and what it says of the active rows is polished by the active-set path: its numbers come from normal equations without refinement, and lose
digits where variances differ by many orders.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import scipy.sparse as sp

from factorgrasp.errors import InputError
from factorgrasp.solvers.frame_active_set import ActiveSetResult, ActiveSetSolver, InequalityFrames
from factorgrasp.typing import BoolArray, FloatArray, IntArray

SETTLED = "PIQP_SOLVED"


class PiqpFrames:
    """Solver of one pattern with inequalities.

    Parameters
    ----------
    problem : InequalityFrames
        Without equalities or bounds.
    settings : dict
        Of piqp.
    """

    def __init__(self, problem: InequalityFrames, settings: dict[str, Any] | None = None) -> None:
        piqp: Any = import_module("piqp")

        pattern = problem.pattern
        self._problem, self._polish = problem, ActiveSetSolver(problem)
        self._gram = _Gram(pattern.jacobian.matrix.indptr, pattern.jacobian.matrix.indices, pattern.size)
        rows = pattern.inequalities.matrix
        self._rows = _ByColumn(rows.indptr, rows.indices, rows.shape)
        self._row_of_entry, self._columns = pattern.jacobian.row_of_entry, pattern.jacobian.matrix.indices
        self._solver: Any = piqp.SparseSolver()
        self._solver.settings.verbose = False
        for key, value in (settings or {}).items():
            if not hasattr(self._solver.settings, key):
                raise InputError(f"piqp option {key}", "a setting of piqp", "an unknown name")
            setattr(self._solver.settings, key, value)
        self._ready = False

    def solve(self, frames: slice, covariance: bool = True) -> ActiveSetResult:
        """Solve some frames; those whose active rows piqp and the polish do not agree on are not settled."""
        entries, rhs = self._problem.whitened_frames(frames)
        G, h = self._problem.inequality_frames(frames)
        count, height = h.shape
        start = np.zeros((count, height), dtype=bool)
        known = np.ones(count, dtype=bool)
        q = self._gradient(entries, rhs)
        for f in range(count):
            z, slack = self._one(entries[f], q[f], G[f], h[f])
            known[f] = z is not None
            if z is not None and slack is not None:
                start[f] = z > slack
        found = self._polish.solve_values(entries, rhs, G, h, covariance, start)
        settled: BoolArray = found.settled & known
        return ActiveSetResult(found.result, settled)

    def _one(
        self, entries: FloatArray, q: FloatArray, G: FloatArray, h: FloatArray
    ) -> tuple[FloatArray | None, FloatArray | None]:
        """Multipliers and slacks; None where piqp does not settle."""
        P, rows = self._gram.hessian(entries), self._rows.matrix(G)
        if self._ready:
            self._solver.update(P=P, c=q, G=rows, h_u=h)
        else:
            self._solver.setup(P=P, c=q, G=rows, h_u=h)
            self._ready = True
        if self._solver.solve().name != SETTLED:
            return None, None
        z = np.array(self._solver.result.z_u)
        x = np.asarray(self._solver.result.x)
        return z, np.maximum(h - rows @ x, 0.0)

    def _gradient(self, entries: FloatArray, rhs: FloatArray) -> FloatArray:
        """``-A' b`` (n, size)."""
        products = entries * rhs[:, self._row_of_entry]
        out = np.zeros((rhs.shape[0], self._gram.size))
        order, present, starts = self._gram.columns
        out[:, present] = -np.add.reduceat(products[:, order], starts, axis=1)
        return out


class _Gram:
    """``A' A`` as one csc matrix whose pattern stays, upper triangle."""

    def __init__(self, indptr: IntArray, indices: IntArray, size: int) -> None:
        self.size = size
        counts = np.diff(indptr)
        number = int(indptr[-1])
        partners = np.repeat(indptr[1:], counts) - np.arange(number)
        self._left = np.repeat(np.arange(number), partners)
        first = np.cumsum(partners) - partners
        self._right = self._left + np.arange(self._left.size) - np.repeat(first, partners)
        one, other = indices[self._left].astype(np.int64), indices[self._right].astype(np.int64)
        keys = np.maximum(one, other) * size + np.minimum(one, other)
        order = np.argsort(keys, kind="stable")
        places, self._starts = np.unique(keys[order], return_index=True)
        self._left, self._right = self._left[order], self._right[order]
        columns = places // size
        self._indices = (places % size).astype(np.int32)
        self._indptr = np.concatenate([[0], np.cumsum(np.bincount(columns, minlength=size))]).astype(np.int32)
        by_column = np.argsort(indices, kind="stable")
        present, starts = np.unique(indices[by_column], return_index=True)
        self.columns = by_column, present, starts

    def hessian(self, entries: FloatArray) -> sp.csc_matrix:
        """For the non-zeros (nnz,) of A."""
        data = np.add.reduceat(entries[self._left] * entries[self._right], self._starts)
        return sp.csc_matrix((data, self._indices, self._indptr), shape=(self.size, self.size))


class _ByColumn:
    """A csr pattern whose values are wanted as csc."""

    def __init__(self, indptr: IntArray, indices: IntArray, shape: tuple[int, int]) -> None:
        labels = sp.csr_matrix((np.arange(1.0, indices.size + 1.0), indices, indptr), shape=shape).tocsc()
        labels.sort_indices()
        self._order = labels.data.astype(np.intp) - 1
        self._parts = labels.indices.astype(np.int32), labels.indptr.astype(np.int32)
        self._shape = shape

    def matrix(self, data: FloatArray) -> sp.csc_matrix:
        """For values in csr order."""
        return sp.csc_matrix((data[self._order], *self._parts), shape=self._shape)

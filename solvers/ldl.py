"""Sparse ``L D L'`` of a symmetric (quasi-definite) matrix with a fixed pattern, by qdldl.

qdldl was chosen over eigenpy's SimplicialLDLT, which ships with pin: 1.5 times as fast on our patterns, at the same accuracy, and made for
the quasi-definite systems of equality constraints. Neither pivots, so that both need the refinement their callers do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from factorgrasp.solvers import kernels
from factorgrasp.typing import FloatArray, IntArray


class SparseLdl:
    """Factor of one pattern; ordering and symbolic work are done at the first `factorize`.

    Parameters
    ----------
    indptr, indices : ndarray
        CSC pattern of the upper triangle with its diagonal, sorted.
    """

    def __init__(self, indptr: IntArray, indices: IntArray) -> None:
        size = indptr.size - 1
        self._matrix = sp.csc_matrix(
            (np.zeros(indices.size), indices.astype(np.int32), indptr.astype(np.int32)), shape=(size, size)
        )
        self._solver: Any = None
        self._factors: tuple[sp.csc_array, FloatArray, IntArray] | None = None
        self.size = size

    def factorize(self, values: FloatArray) -> bool:
        """Factor the matrix with these upper-triangle entries; False when a pivot is exactly zero."""
        import qdldl

        self._factors = None
        self._matrix.data = values
        try:
            if self._solver is None:
                self._solver = qdldl.Solver(self._matrix, upper=True)
            else:
                self._solver.update(self._matrix, upper=True)
        except RuntimeError:
            return False
        # An update that meets a zero pivot stops there without a word, and would go on to solve with what it had before.
        return bool(np.all(self.factors()[1] != 0.0))

    def solve(self, rhs: FloatArray) -> FloatArray:
        """``K^-1 rhs`` for one vector (n,) or the columns of (n, k)."""
        solver = self._solver
        if rhs.ndim == 1:
            return np.asarray(solver.solve(rhs))
        # About what the loop below takes: a call and two passes over L for every column.
        seconds = rhs.shape[1] * (5e-6 + 1.2e-9 * self.factors()[0].nnz)
        compiled = kernels.load(seconds) if rhs.shape[1] > 8 else None
        if compiled is None:
            columns = [solver.solve(np.ascontiguousarray(column)) for column in rhs.T]
            return np.column_stack(columns) if columns else np.zeros(rhs.shape)
        lower, pivots, order = self.factors()
        work = np.ascontiguousarray(rhs[order])
        compiled.ldl_solve(lower.indptr, lower.indices, lower.data, pivots, work)
        out = np.empty_like(work)
        out[order] = work
        return out

    def factors(self) -> tuple[sp.csc_array, FloatArray, IntArray]:
        """Strictly lower part of L, diagonal of D and the ordering p: ``K[p][:, p] = L D L'``."""
        if self._factors is None:
            lower, pivots, order = self._solver.factors()
            self._factors = sp.csc_array(lower), np.asarray(pivots), np.asarray(order, dtype=np.intp)
        return self._factors

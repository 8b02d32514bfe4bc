"""Entries of an inverse on the pattern of its sparse factor, without the inverse (Takahashi, Fagan and Chin 1973).

For ``K = L D L'`` with a unit lower triangular L and the inverse ``Z``, from the last column j to the first:

    ``Z_ij = - sum_k Z_ik L_kj``  for i > j in the pattern of column j,
    ``Z_jj = 1 / d_j - sum_k L_kj Z_kj``   (sums over the k > j in the pattern of column j),

and every ``Z_ik`` that is needed lies in the pattern of L itself. D may have negative entries (saddle-point systems).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from factorgrasp.solvers import kernels
from factorgrasp.typing import FloatArray, IntArray


@dataclass(frozen=True)
class SelectedInverse:
    """Inverse of ``K = L D L'`` in factor order, on the diagonal and on the pattern of L.

    Attributes
    ----------
    diagonal : ndarray
        (n,).
    lower : scipy.sparse.csc_array
        Strictly lower part on the pattern of L, row indices sorted.
    """

    diagonal: FloatArray
    lower: sp.csc_array

    def block(self, places: IntArray) -> FloatArray | None:
        """Symmetric block (k, k) at the factor positions `places`; None when an entry lies outside the pattern."""
        high = np.maximum.outer(places, places)
        low = np.minimum.outer(places, places)
        out = np.empty(high.shape)
        for i in range(places.size):
            out[i, i] = self.diagonal[places[i]]
            for j in range(i):
                column, row = low[i, j], high[i, j]
                first, last = self.lower.indptr[column], self.lower.indptr[column + 1]
                at = first + int(np.searchsorted(self.lower.indices[first:last], row))
                if at == last or self.lower.indices[at] != row:
                    return None
                out[i, j] = out[j, i] = self.lower.data[at]
        return out


def selected_inverse(
    lower: sp.csc_array, pivots: FloatArray, compiled: bool | None = None
) -> SelectedInverse:
    """Diagonal and pattern entries of the inverse of ``L D L'``.

    Parameters
    ----------
    lower : scipy.sparse.csc_array
        Strictly lower part of the unit lower triangular L, with the complete fill pattern of a factorisation.
    pivots : ndarray
        Diagonal of D (n,).
    compiled : bool, optional
        Insist on the compiled loop or on numpy; by default compiled where numba is installed.
    """
    lower = sp.csc_array(lower)
    lower.sort_indices()
    below, diagonal = np.zeros(lower.nnz), np.zeros(pivots.size)
    seconds = float("inf") if compiled else 6e-5 * pivots.size
    fast = None if compiled is False else kernels.load(seconds)
    if fast is not None:
        indptr, rows = lower.indptr.astype(np.int64), lower.indices.astype(np.int64)
        fast.selected_inverse(indptr, rows, lower.data, np.ascontiguousarray(pivots), diagonal, below)
    else:
        _by_columns(lower, pivots, diagonal, below)
    return SelectedInverse(diagonal, sp.csc_array((below, lower.indices, lower.indptr), shape=lower.shape))


def _by_columns(lower: sp.csc_array, pivots: FloatArray, diagonal: FloatArray, below: FloatArray) -> None:
    """The recursion with numpy, one column at a time; the entries of Z are looked up by one sorted key."""
    size = pivots.size
    columns = np.repeat(np.arange(size), np.diff(lower.indptr))
    keys = columns * size + lower.indices
    for column in range(size - 1, -1, -1):
        where = slice(lower.indptr[column], lower.indptr[column + 1])
        rows, factors = lower.indices[where].astype(np.intp), lower.data[where]
        total = 1.0 / pivots[column]
        if rows.size:
            high, low = np.maximum.outer(rows, rows), np.minimum.outer(rows, rows)
            off = high != low
            block = np.diag(diagonal[rows])
            block[off] = below[np.searchsorted(keys, (low * size + high)[off])]
            sums = block @ factors
            below[where] = -sums
            total += float(factors @ sums)
        diagonal[column] = total

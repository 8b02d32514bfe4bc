"""``A'A`` of a sparse matrix with a fixed pattern: the index work is done once, new values cost one pass over the products."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from factorgrasp.solvers import kernels
from factorgrasp.typing import FloatArray, IntArray

COMPILED_FROM = 20_000
"""Number of products from which the compiled loop is worth while."""

MOST_PRODUCTS = 8_000_000
"""Above it the index map would take more memory than it saves time, and scipy's product is used."""


class GramPattern:
    """Pattern of the upper triangle of ``A'A``, diagonal always included, in CSC.

    Parameters
    ----------
    indptr, indices : ndarray
        CSR pattern of ``A`` with sorted column indices.
    size : int
        Number of columns of ``A``.

    Attributes
    ----------
    indptr, indices : ndarray
        CSC pattern of the upper triangle, sorted; the diagonal is the last entry of its column.
    diagonal : ndarray
        Positions of the diagonal among the entries (size,).
    """

    def __init__(self, indptr: IntArray, indices: IntArray, size: int) -> None:
        self.size = size
        self._row_indptr = np.ascontiguousarray(indptr, dtype=np.int64)
        self._row_indices = np.ascontiguousarray(indices, dtype=np.int64)
        counts = np.diff(self._row_indptr)
        products = int(np.sum(counts * (counts + 1) // 2))
        diagonal_keys = np.arange(size, dtype=np.int64) * (size + 1)
        self._left: IntArray | None = None
        if products <= MOST_PRODUCTS:
            left, right = _pairs(self._row_indptr, counts)
            keys = self._row_indices[right] * size + self._row_indices[left]
            self._keys = np.union1d(keys, diagonal_keys)
            self._target = np.searchsorted(self._keys, keys)
            self._left, self._right = left, right
        else:
            ones = sp.csr_array((np.ones(self._row_indices.size), self._row_indices, self._row_indptr))
            ones.resize(counts.size, size)
            self._keys = np.union1d(_upper_keys(sp.csc_array(ones.T @ ones))[0], diagonal_keys)
        self.indices: IntArray = self._keys % size
        self.indptr: IntArray = np.searchsorted(self._keys, np.arange(size + 1, dtype=np.int64) * size)
        self.diagonal: IntArray = self.indptr[1:] - 1

    def values(self, entries: FloatArray) -> FloatArray:
        """Entries of the upper triangle of ``A'A`` for the non-zeros `entries` of A, in the order of `indices`."""
        count = self._keys.size
        if self._left is None:
            matrix = sp.csr_array((entries, self._row_indices, self._row_indptr))
            matrix.resize(self._row_indptr.size - 1, self.size)
            keys, values = _upper_keys(sp.csc_array(matrix.T @ matrix))
            out = np.zeros(count)
            out[np.searchsorted(self._keys, keys)] = values
            return out
        compiled = kernels.load(1.5e-9 * self._left.size) if self._left.size >= COMPILED_FROM else None
        if compiled is None:
            products = entries.take(self._left)
            products *= entries.take(self._right)
            return np.asarray(np.bincount(self._target, weights=products, minlength=count), dtype=float)
        out = np.empty(count)
        compiled.gram(entries, self._row_indptr, self._target, out)
        return out


def _pairs(indptr: IntArray, counts: IntArray) -> tuple[IntArray, IntArray]:
    """Positions (e, f), e <= f, of all pairs of entries that share a row, row by row."""
    number = int(indptr[-1])
    partners = np.repeat(indptr[1:], counts) - np.arange(number)
    left = np.repeat(np.arange(number), partners)
    offset = np.arange(left.size) - np.repeat(np.cumsum(partners) - partners, partners)
    return left, left + offset


def _upper_keys(matrix: sp.csc_array) -> tuple[IntArray, FloatArray]:
    """``column * n + row`` and value of every entry of the upper triangle."""
    columns = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))
    upper = matrix.indices <= columns
    return columns[upper] * matrix.shape[1] + matrix.indices[upper], matrix.data[upper]

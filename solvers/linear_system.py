"""The linear algebra under the direct solvers and the covariances: dense for small problems, sparse for large ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from factorgrasp.errors import NotSolvedError
from factorgrasp.least_squares import LeastSquares
from factorgrasp.solvers.dense_system import DenseSystem
from factorgrasp.solvers.sparse_system import SparseSystem
from factorgrasp.typing import FloatArray, IntArray

DENSE_UP_TO = 60
"""Unknowns up to which dense LAPACK beats the overhead of sparse code (measured: it wins up to about 100)."""
DENSE_RESCUE_UP_TO = 1500
"""Unknowns up to which singular values are affordable when a sparse factor has too few digits."""
MOST_DENSE_ENTRIES = 4_000_000

System = DenseSystem | SparseSystem


@dataclass(frozen=True)
class LinearValues:
    """Whitened rows and exact rows of one linear system: ``min || A x - b ||^2  s.t.  E x = e``.

    Attributes
    ----------
    entries : ndarray
        Non-zeros of the whitened A in CSR order.
    rhs : ndarray
        (rows,).
    hard : scipy.sparse.csr_array
        E (p, n).
    hard_rhs : ndarray
        (p,).

    None of them may change afterwards: factors keep them.
    """

    entries: FloatArray
    rhs: FloatArray
    hard: sp.csr_array
    hard_rhs: FloatArray


class LinearSystem:
    """A dense or sparse system for one pattern, chosen by size; falls back from sparse to dense when digits run out.

    Parameters
    ----------
    indptr, indices : ndarray
        CSR pattern of A.
    size : int
        Number of unknowns.
    hard : scipy.sparse.csr_array
        Pattern of E.
    """

    def __init__(self, indptr: IntArray, indices: IntArray, size: int, hard: sp.csr_array) -> None:
        # Copies: the pattern must outlive whatever the caller does with its own.
        self._indptr, self._indices = np.array(indptr, dtype=np.int64), np.array(indices, dtype=np.int64)
        self._hard_pattern = np.array(hard.indptr), np.array(hard.indices)
        self.size = size
        self._rows = indptr.size - 1
        small = size <= DENSE_UP_TO and self._rows * size <= MOST_DENSE_ENTRIES
        self._main: System = self._dense() if small else SparseSystem(self._indptr, self._indices, size, hard)
        self._rescue: DenseSystem | None = None
        self.system: System = self._main

    @classmethod
    def of(cls, problem: LeastSquares, hard: sp.csr_array | None = None) -> LinearSystem:
        """System for the pattern of a problem, with its equalities unless `hard` says otherwise."""
        matrix = problem.jacobian.matrix
        return cls(
            matrix.indptr, matrix.indices, problem.size, problem.equalities.matrix if hard is None else hard
        )

    def fresh(self) -> LinearSystem:
        """Another system for the same pattern."""
        indptr, indices = self._hard_pattern
        hard = sp.csr_array((np.zeros(indices.size), indices, indptr), shape=(indptr.size - 1, self.size))
        return LinearSystem(self._indptr, self._indices, self.size, hard)

    def fits(self, problem: LeastSquares) -> bool:
        """Whether the pattern is that of `problem`, so that the symbolic work can be kept."""
        matrix, hard = problem.jacobian.matrix, problem.equalities.matrix
        return (
            self.size == problem.size
            and np.array_equal(self._indptr, matrix.indptr)
            and np.array_equal(self._indices, matrix.indices)
            and np.array_equal(self._hard_pattern[0], hard.indptr)
            and np.array_equal(self._hard_pattern[1], hard.indices)
        )

    def update(self, values: LinearValues) -> None:
        """Factor and solve for new values; the outcome is in `system`.

        Raises
        ------
        NotSolvedError
            When double precision cannot carry the span of the covariances and the problem is too large for singular values.
        """
        self.system = self._main
        try:
            _fill(self._main, values)
            failed = self._main.stalled
        except ArithmeticError:
            failed = True
        if failed:
            self._use_singular_values(values)

    def for_covariance(self, values: LinearValues) -> System:
        """The system of the last update, of which `values` were the values, in a form that has digits for the covariance.

        Raises
        ------
        NotSolvedError
            As `update`.
        """
        if self.system.imprecise:
            self._use_singular_values(values)
        return self.system

    def _use_singular_values(self, values: LinearValues) -> None:
        if self.size > DENSE_RESCUE_UP_TO:
            raise NotSolvedError(
                "the covariances span more orders of magnitude than double precision can carry for a problem of this size: "
                "raise the smallest ones or state the nearly exact rows as equality constraints"
            )
        if self._rescue is None:
            self._rescue = self._dense()
        _fill(self._rescue, values)
        self.system = self._rescue

    @property
    def stamp(self) -> int:
        """Changes with every update."""
        return self._main.stamp

    def _dense(self) -> DenseSystem:
        return DenseSystem(self._indptr, self._indices, self.size)


def _fill(system: System, values: LinearValues) -> None:
    if isinstance(system, DenseSystem):
        system.update(values.entries, values.rhs, values.hard.toarray(), values.hard_rhs)
    else:
        system.update(values.entries, values.rhs, values.hard, values.hard_rhs)

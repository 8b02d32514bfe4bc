"""Small (or stubborn) least-squares systems by dense LAPACK: normal equations where they suffice, singular values where not.

``min || A x - b ||^2  s.t.  E x = e``. The equalities are eliminated through an orthonormal basis Z of the null space of E; what is left is
factored by Cholesky with one refinement through A, or, when that is ill-conditioned, through the singular values of A itself, which do not
square its condition number and tell a direction without information from a weak one.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.linalg.lapack import dpocon, dpotrf, dpotrs

from factorgrasp.solvers.null_directions import NullSpace
from factorgrasp.typing import FloatArray, IntArray

CONDITION_LIMIT = 1e-11
"""Reciprocal condition of the scaled normal equations below which the singular values of A are used."""

NULL_TOLERANCE = 1e-11
"""Singular value of the column-scaled A (unit columns) below which a direction carries no information at all."""

RANK_TOLERANCE = 1e-10
"""Relative pivot below which a constraint row repeats the others."""


class _Reduced:
    """Unconstrained ``min || B w - c ||`` with everything that its covariance needs."""

    def __init__(self, matrix: FloatArray, rhs: FloatArray) -> None:
        normal = matrix.T @ matrix
        diagonal = normal.diagonal()
        safe = np.where(diagonal > 0.0, diagonal, 1.0)
        self._scale = scale = 1.0 / np.sqrt(safe)
        self._spectrum: tuple[FloatArray, FloatArray] | None = None
        self.null = NullSpace.none(diagonal.size)
        normal *= scale[:, None]
        normal *= scale
        self._upper, info = dpotrf(normal, lower=0, clean=1)
        if info == 0 and dpocon(self._upper, np.abs(normal).sum(axis=0).max(), uplo="U")[0] > CONDITION_LIMIT:
            first = self._cholesky(matrix.T @ rhs)
            self.solution = first + self._cholesky(matrix.T @ (rhs - matrix @ first))
        else:
            self._decompose(matrix, rhs)

    def _cholesky(self, rhs: FloatArray) -> FloatArray:
        scale = self._scale if rhs.ndim == 1 else self._scale[:, None]
        return np.asarray(scale * dpotrs(self._upper, scale * rhs, lower=0)[0])

    def _decompose(self, matrix: FloatArray, rhs: FloatArray) -> None:
        stacked = np.column_stack([matrix * self._scale, rhs])
        if stacked.shape[0] > stacked.shape[1]:
            stacked = np.asarray(np.linalg.qr(stacked, mode="r"))
        left, values, right = np.linalg.svd(stacked[:, :-1], full_matrices=True)
        singular = np.zeros(self._scale.size)
        singular[: values.size] = values
        known = singular > NULL_TOLERANCE
        axes = right.T[:, known] * self._scale[:, None]
        inverse = 1.0 / singular[known]
        self._spectrum = axes, inverse
        self.null = NullSpace(right.T[:, ~known], self._scale)
        self.solution = axes @ (inverse * (left.T @ stacked[:, -1])[: known.size][known[: left.shape[0]]])

    def apply(self, rhs: FloatArray) -> FloatArray:
        """``(B'B)^-1 rhs``, or its generalised inverse on what is known."""
        if self._spectrum is None:
            return self._cholesky(rhs)
        axes, inverse = self._spectrum
        weights = inverse**2 if rhs.ndim == 1 else (inverse**2)[:, None]
        return np.asarray(axes @ (weights * (axes.T @ rhs)))

    def root(self) -> FloatArray:
        """``F`` with ``F F' = (B'B)^-1``."""
        if self._spectrum is not None:
            axes, inverse = self._spectrum
            return np.asarray(axes * inverse)
        identity = np.eye(self._scale.size)
        return np.asarray(self._scale[:, None] * solve_triangular(self._upper, identity, lower=False))


class DenseSystem:
    """Least squares with a fixed pattern of A (rows, columns), filled by `update`.

    Attributes
    ----------
    x, y : ndarray
        Solution (n,) and multipliers (p,) of the equalities, ``A'(A x - b) + E'y = 0``.
    null : NullSpace
        Directions that neither A nor E see; `x` has no part along them.
    violated : ndarray
        Rows of E that contradict the others.
    stamp : int
        Counts the updates, so that a factor taken earlier can tell that the values have changed.
    """

    def __init__(self, indptr: IntArray, indices: IntArray, size: int) -> None:
        rows = indptr.size - 1
        self._flat = np.repeat(np.arange(rows), np.diff(indptr)) * size + indices
        self._matrix = np.zeros((rows, size))
        self.size = size
        self.stalled = self.imprecise = False
        self.stamp = 0

    def update(self, entries: FloatArray, rhs: FloatArray, hard: FloatArray, hard_rhs: FloatArray) -> None:
        """New values: non-zeros of A, b, and the dense E (p, n) with e; solves at once."""
        self.stamp += 1
        matrix = self._matrix
        matrix.reshape(-1)[self._flat] = entries
        self._basis: FloatArray | None = None
        self.violated: IntArray = np.empty(0, dtype=np.intp)
        if hard.shape[0] == 0:
            self._reduced = _Reduced(matrix, rhs)
            self.x, self.null, self.y = self._reduced.solution, self._reduced.null, np.empty(0)
            return
        scale = _column_scale(matrix, hard)
        rows = hard * scale
        heights = np.linalg.norm(rows, axis=1)
        heights[heights == 0.0] = 1.0
        rows, target = rows / heights[:, None], hard_rhs / heights
        basis, upper, order = qr(rows.T, pivoting=True)
        pivots = np.abs(np.diagonal(upper))
        rank = int(np.sum(pivots > RANK_TOLERANCE * max(1.0, float(pivots[0]))))
        kept, spare = order[:rank], order[rank:]
        triangle, image = upper[:rank, :rank], basis[:, :rank]
        particular = image @ solve_triangular(triangle, target[kept], trans="T")
        gap = np.abs(rows[spare] @ particular - target[spare])
        allowed = 1e-8 * (np.abs(target[spare]) + np.linalg.norm(particular)) + 1e-12
        self.violated = spare[gap > allowed]
        self._basis = scale[:, None] * basis[:, rank:]
        origin = scale * particular
        self._reduced = _Reduced(matrix @ self._basis, rhs - matrix @ origin)
        self.x = origin + self._basis @ self._reduced.solution
        # One refinement: first back onto the constraints, then down within them.
        missing = (hard_rhs - hard @ self.x)[kept] / heights[kept]
        self.x += scale * (image @ solve_triangular(triangle, missing, trans="T"))
        self.x += self.apply(matrix.T @ (rhs - matrix @ self.x))
        null = self._reduced.null
        # The basis is orthonormal in scaled coordinates, and so are its combinations up to the reduced unknowns' own scale.
        self.null = (
            NullSpace(np.linalg.qr(basis[:, rank:] @ null.tangent)[0], scale)
            if null.count
            else NullSpace.none(self.size)
        )
        gradient = scale * (matrix.T @ (matrix @ self.x - rhs))
        self.y = np.zeros(hard_rhs.size)
        self.y[kept] = -solve_triangular(triangle, image.T @ gradient) / heights[kept]

    def apply(self, columns: FloatArray) -> FloatArray:
        """``P B`` with ``P = Z (Z'A'A Z)^-1 Z'`` for B (n,) or (n, k)."""
        if self._basis is None:
            return self._reduced.apply(columns)
        return np.asarray(self._basis @ self._reduced.apply(self._basis.T @ columns))

    def variances(self) -> FloatArray:
        """Diagonal of P (n,)."""
        root = self._reduced.root()
        return np.asarray(np.sum((root if self._basis is None else self._basis @ root) ** 2, axis=1))

    def prepare_blocks(self) -> None:
        """Nothing to prepare: solving is cheap here."""

    def block(self, indices: IntArray) -> FloatArray | None:
        """Block of P at `indices`; None where solving for it is no dearer (always, here)."""
        return None


def _column_scale(matrix: FloatArray, hard: FloatArray) -> FloatArray:
    """Scale of every unknown: its sd given all others, or what the constraints suggest when no row of A touches it."""
    information = np.einsum("ij,ij->j", matrix, matrix)
    tied = np.abs(hard).max(axis=0)
    return np.asarray(
        np.where(
            information > 0.0,
            1.0 / np.sqrt(np.where(information > 0.0, information, 1.0)),
            1.0 / np.where(tied > 0.0, tied, 1.0),
        )
    )

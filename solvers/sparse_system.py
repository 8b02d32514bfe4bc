"""Large least-squares systems: sparse ``L D L'`` of the normal equations, or of the saddle-point matrix of the equalities.

``min || A x - b ||^2  s.t.  E x = e``  by  ``[[H, E'], [E, -d]] [x; y] = [A'b + E'R e; e]``  with ``H = A'A + E'R E``: adding the squared
constraints changes neither x nor y, but makes H positive definite whenever the problem is observable at all. R scales every row of E to
unit size in units of the unknowns' own conditional standard deviations, and ``d = 1e-7 R^-1`` keeps the matrix quasi-definite even where
constraints repeat each other. Both are undone by iterative refinement, whose residuals go through A and E, not through H: this brings
back the digits that squaring A costs.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.linalg import qr

from factorgrasp.solvers.dense_system import NULL_TOLERANCE
from factorgrasp.solvers.ldl import SparseLdl
from factorgrasp.solvers.normal_equations import GramPattern
from factorgrasp.solvers.null_directions import NullSpace
from factorgrasp.solvers.selected_inverse import SelectedInverse, selected_inverse
from factorgrasp.typing import BoolArray, FloatArray, IntArray

REGULARISATIONS = (1e-7, 1e-16)
"""Of the constraint rows, relative to R. The first balances what it leaves to refinement against what rounding does; the second comes in
where refinement stalls because weak priors stand under many constraints."""
WELL_CONDITIONED = 1e-6
SUSPICIOUS = 1e-10
"""Estimated smallest eigenvalues of the scaled H above which the factor needs no refinement for covariances, and below which missing
directions are looked for."""
BEYOND_PRECISION = 1e-14
"""The same (times the root of n, by which the estimate may be too large), below which normal equations in double precision say nothing
about the variance of the weakest direction."""
WEAK = 1e-5
"""Singular value of the scaled A below which a direction is looked at twice."""
MOST_REFINEMENTS = 10
ACCURATE = 1e-9
"""Smallest eigenvalue of the scaled H above which the selected inverse is right to six digits."""
ENERGY_TOLERANCE = 1e-9
"""Refinement ends when its next correction will be below this many posterior standard deviations."""


class SparseSystem:
    """See :class:`factorgrasp.solvers.dense_system.DenseSystem` for the interface.

    Parameters
    ----------
    indptr, indices : ndarray
        CSR pattern of A.
    size : int
    hard : scipy.sparse.csr_array
        Pattern of E (p, n); its values are ignored here.
    """

    def __init__(self, indptr: IntArray, indices: IntArray, size: int, hard: sp.csr_array) -> None:
        self.size, self.hard_rows = size, hard.shape[0]
        self._pattern = (indices, indptr)
        self._gram = GramPattern(
            np.concatenate([indptr, indptr[-1] + hard.indptr[1:]]),
            np.concatenate([indices, hard.indices]),
            size,
        )
        # Columns n.. of the upper triangle: a row of E each, then its own diagonal entry.
        ends = np.cumsum(np.diff(hard.indptr) + 1)
        self._tail_diagonal = ends - 1
        tail = np.empty(hard.indices.size + self.hard_rows, dtype=np.int64)
        self._tail_entries = np.setdiff1d(np.arange(tail.size), self._tail_diagonal)
        tail[self._tail_entries] = hard.indices
        tail[self._tail_diagonal] = size + np.arange(self.hard_rows)
        self._ldl = SparseLdl(
            np.concatenate([self._gram.indptr, self._gram.indptr[-1] + ends]),
            np.concatenate([self._gram.indices, tail]),
        )
        self._probe = np.random.default_rng(0).standard_normal(size)
        self._probe /= np.linalg.norm(self._probe)
        self.stamp = 0
        self.stalled = False
        self._regularisation = REGULARISATIONS[0]

    # ---- values -----------------------------------------------------------------------------------------------

    def update(self, entries: FloatArray, rhs: FloatArray, hard: sp.csr_array, hard_rhs: FloatArray) -> None:
        """New values: non-zeros of A, b, E (with the pattern given) and e; factors and solves."""
        self.stamp += 1
        self._inverse: SelectedInverse | None = None
        self._matrix = sp.csr_array((entries, *self._pattern), shape=(rhs.size, self.size))
        self._hard = hard
        self._factor_and_solve(entries, rhs, hard_rhs)
        if self.stalled and self.hard_rows and self._regularisation != REGULARISATIONS[-1]:
            # What one set of values needs the next will need, too: it stays.
            self._regularisation = REGULARISATIONS[-1]
            self._factor_and_solve(entries, rhs, hard_rhs)

    def _factor_and_solve(self, entries: FloatArray, rhs: FloatArray, hard_rhs: FloatArray) -> None:
        self._assemble(entries)
        self.null = NullSpace.none(self.size)
        healthy = self._ldl.factorize(self._values)
        self._weakest = self._smallest_eigenvalue() if healthy else 0.0
        if self._empty.any() or self._weakest < SUSPICIOUS:
            self._handle_weakness(healthy)
        self._solve(rhs, hard_rhs)

    def _assemble(self, entries: FloatArray) -> None:
        hard = self._hard.data
        if self.hard_rows:
            information = np.bincount(self._pattern[0], entries**2, self.size).astype(float)
            self._row_weight = _row_weights(self._hard, information)
            rows = np.repeat(np.sqrt(self._row_weight), np.diff(self._hard.indptr))
            upper = self._gram.values(np.concatenate([entries, rows * hard]))
            tail = np.empty(self._tail_diagonal.size + hard.size)
            tail[self._tail_entries] = hard
            tail[self._tail_diagonal] = -self._regularisation / self._row_weight
            self._values = np.concatenate([upper, tail])
        else:
            self._row_weight = np.empty(0)
            self._values = self._gram.values(entries)
        diagonal = self._values[self._gram.diagonal]
        self._empty: BoolArray = diagonal <= 0.0
        if self._empty.any():
            diagonal = np.where(self._empty, 1.0, diagonal)
            self._values[self._gram.diagonal] = diagonal
        self._scale: FloatArray = 1.0 / np.sqrt(diagonal)

    # ---- linear algebra ---------------------------------------------------------------------------------------

    def _corner(self, columns: FloatArray) -> FloatArray:
        """Upper left block of the inverse of the factored matrix, times columns (n,) or (n, k)."""
        padding = np.zeros((self.hard_rows, *columns.shape[1:]))
        return self._ldl.solve(np.concatenate([columns, padding]))[: self.size]

    def _solve(self, rhs: FloatArray, hard_rhs: FloatArray) -> None:
        matrix, hard, count = self._matrix, self._hard, self.size
        x, y = np.zeros(count), np.zeros(self.hard_rows)
        residual, gap = rhs, hard_rhs
        floor = max(ENERGY_TOLERANCE, 1e-14 * float(np.linalg.norm(rhs)))
        before = remaining = np.inf
        # An error above either of these is one that singular values can still mend.
        tolerable = max(1e-6, 1e-10 * float(np.linalg.norm(rhs)))
        root = np.sqrt(self._row_weight)
        for step in range(MOST_REFINEMENTS + 1):
            right = matrix.T @ residual
            if self.hard_rows:
                right = np.concatenate([right - hard.T @ y + hard.T @ (self._row_weight * gap), gap])
            change = self._ldl.solve(right)
            moved = matrix @ change[:count]
            energy = float(np.hypot(np.linalg.norm(moved), np.linalg.norm(root * (hard @ change[:count]))))
            if not np.isfinite(energy) or (step > 1 and energy > 0.5 * before):
                # At rounding level already, or refinement cannot gain on the error of the factor.
                remaining = before
                break
            x += change[:count]
            y += change[count:]
            if step and (energy <= floor or energy**2 <= floor * before):
                remaining = 0.0
                break
            before = remaining = energy
            residual = rhs - matrix @ x
            gap = hard_rhs - hard @ x if self.hard_rows else hard_rhs
        self.stalled = remaining > tolerable
        self.x, self.y = self.null.project_out(x), y
        self.violated = self._find_violated(hard_rhs)

    def _find_violated(self, hard_rhs: FloatArray) -> IntArray:
        if not self.hard_rows:
            return np.empty(0, dtype=np.intp)
        gap = np.abs(self._hard @ self.x - hard_rhs)
        size = np.abs(self._hard) @ np.abs(self.x) + np.abs(hard_rhs)
        # In conditional standard deviations of the unknowns as well, so that a rounding error of a huge sum is no contradiction.
        return np.flatnonzero((gap > 1e-7 * size) & (gap * np.sqrt(self._row_weight) > 1e-7))

    # ---- covariance -------------------------------------------------------------------------------------------

    @property
    def imprecise(self) -> bool:
        """Whether the factor has no digits left for the variance of the weakest direction; the solution may be right all the same."""
        return bool(self._weakest < BEYOND_PRECISION * np.sqrt(self.size))

    def apply(self, columns: FloatArray) -> FloatArray:
        """``P B`` for B (n,) or (n, k), refined through A and E where the factor alone is not to be trusted."""
        count, weight = self.size, self._row_weight
        if columns.ndim == 2:
            weight = weight[:, None]
        whole = self._ldl.solve(np.concatenate([columns, np.zeros((self.hard_rows, *columns.shape[1:]))]))
        before = np.inf
        for _ in range(MOST_REFINEMENTS if self.hard_rows or self._weakest < WELL_CONDITIONED else 0):
            x, y = whole[:count], whole[count:]
            first = columns - self._matrix.T @ (self._matrix @ x) - self._hard.T @ y
            second = -(self._hard @ x)
            change = self._ldl.solve(np.concatenate([first + self._hard.T @ (weight * second), second]))
            moved = float(np.linalg.norm(change[:count].T / self._scale))
            if moved > 0.5 * before:
                break
            whole, before = whole + change, moved
            if moved <= 1e-13 * float(np.linalg.norm(x.T / self._scale)):
                break
        return self.null.project_out(whole[:count])

    def selected(self) -> SelectedInverse:
        """Entries of the inverse of the factored matrix on its pattern, in factor order."""
        if self._inverse is None:
            lower, pivots, order = self._ldl.factors()
            self._inverse = selected_inverse(lower, pivots)
            self._place = np.empty(order.size, dtype=np.intp)
            self._place[order] = np.arange(order.size)
        return self._inverse

    def variances(self) -> FloatArray:
        """Diagonal of P (n,); right where no null direction reaches.

        By the selected inverse; column by column with refinement where that has too few digits: under constraints, whose regularisation
        it would show, and in ill-conditioned systems.
        """
        if self._selectable:
            return np.maximum(self.selected().diagonal[self._place], 0.0)
        out = np.empty(self.size)
        for part in np.array_split(np.arange(self.size), self.size // 256 + 1):
            columns = np.zeros((self.size, part.size))
            columns[part, np.arange(part.size)] = 1.0
            out[part] = self.apply(columns)[part, np.arange(part.size)]
        return np.maximum(out, 0.0)

    def prepare_blocks(self) -> None:
        """Compute the selected inverse, if `block` may use it."""
        if self._selectable and not self.null.count:
            self.selected()

    def block(self, indices: IntArray) -> FloatArray | None:
        """Block of P at `indices` when the selected inverse is there and holds it."""
        if self._inverse is None or self.null.count or not self._selectable:
            return None
        return self._inverse.block(self._place[indices])

    @property
    def _selectable(self) -> bool:
        return self.hard_rows == 0 and self._weakest >= ACCURATE

    # ---- directions without information -----------------------------------------------------------------------

    def _smallest_eigenvalue(self) -> float:
        """Upper estimate of the smallest eigenvalue of the scaled H on the constraints' null space (one inverse iteration)."""
        image = self._corner(self._probe / self._scale) / self._scale
        norm = float(np.linalg.norm(image))
        return 1.0 / norm if np.isfinite(norm) and norm > 0.0 else 0.0

    def _handle_weakness(self, healthy: bool) -> None:
        """Tell missing directions from weak ones through A itself, and pin the missing ones so that the factor exists."""
        if not healthy:
            shifted = self._values.copy()
            shifted[self._gram.diagonal] *= 1.0 + 1e-12
            if not self._ldl.factorize(shifted):
                raise ArithmeticError("the normal equations cannot be factored")
        axes = self._candidates()
        while axes.shape[1]:
            self._pin(axes)
            axes = self._polish(axes)
            missing = self._seen(axes) < NULL_TOLERANCE
            if missing.all():
                self.null = NullSpace(axes, self._scale)
                break
            axes = axes[:, missing]
        else:
            if not self._ldl.factorize(self._values):
                raise ArithmeticError("the normal equations have no digits left for the weakest direction")
        self._weakest = self._smallest_eigenvalue()

    def _seen(self, axes: FloatArray) -> FloatArray:
        """How much A and E see of orthonormal scaled directions; they are turned so that each stands for one singular value."""
        image = axes * self._scale[:, None]
        seen = np.vstack([self._matrix @ image, (self._hard @ image) * np.sqrt(self._row_weight)[:, None]])
        _, values, right = np.linalg.svd(np.linalg.qr(seen, mode="r"), full_matrices=True)
        out = np.zeros(axes.shape[1])
        out[: values.size] = values
        axes[:] = axes @ right.T
        return out

    def _candidates(self) -> FloatArray:
        """Orthonormal scaled directions (n, k) of which A and E see little, by block inverse iteration."""
        rng = np.random.default_rng(0)
        known = np.flatnonzero(~self._empty)
        untouched = np.flatnonzero(self._empty)
        empty = np.zeros((self.size, untouched.size))
        empty[untouched, np.arange(untouched.size)] = 1.0
        width = 4
        while True:
            width = min(width, known.size)
            block = np.zeros((self.size, width))
            block[known] = rng.standard_normal((known.size, width))
            for _ in range(3):
                image = self._corner(block / self._scale[:, None]) / self._scale[:, None]
                image[self._empty] = 0.0
                block = np.linalg.qr(image)[0]
            weak = self._seen(block) < WEAK
            if not weak.all() or width == known.size:
                return np.hstack([empty, block[:, weak]])
            width *= 2

    def _pin(self, axes: FloatArray) -> None:
        """Factor with as many unknowns held as there are directions: those that tell the directions apart best."""
        _, _, order = qr(axes.T, pivoting=True, mode="economic")
        values = self._values.copy()
        values[self._gram.diagonal[order[: axes.shape[1]]]] *= 2.0
        if not self._ldl.factorize(values):
            raise ArithmeticError("the pinned normal equations cannot be factored")

    def _polish(self, axes: FloatArray) -> FloatArray:
        """Remove what A and E still see of nearly null directions, with residuals through A: a null direction ends at rounding."""
        scale, weight = self._scale[:, None], self._row_weight[:, None]
        for _ in range(3):
            image = axes * scale
            gradient = self._matrix.T @ (self._matrix @ image) + self._hard.T @ (
                weight * (self._hard @ image)
            )
            # The constraints keep their multiplier at zero here: what they see of a direction is to vanish, not to be balanced.
            gap = self._hard @ image
            image = image - self._ldl.solve(np.concatenate([gradient, gap]))[: self.size]
            axes = np.linalg.qr(image / scale)[0]
        return axes


def _row_weights(hard: sp.csr_array, information: FloatArray) -> FloatArray:
    """``R``: one over the variance that a row of E would have if every unknown had its conditional variance."""
    known = information > 0.0
    variance = np.where(known, 1.0 / np.where(known, information, 1.0), 0.0)
    rows = np.repeat(np.arange(hard.shape[0]), np.diff(hard.indptr))
    spread = np.bincount(rows, weights=hard.data**2 * variance[hard.indices], minlength=hard.shape[0])
    plain = np.bincount(rows, weights=hard.data**2, minlength=hard.shape[0])
    return np.asarray(1.0 / np.where(spread > 0.0, spread, np.where(plain > 0.0, plain, 1.0)))

"""Symmetric positive definite block-tridiagonal systems: solves, and the blocks of the inverse that lie in the band.

What smoothing over time makes of many frames. The inverse's blocks follow by the recursion of Takahashi, Fagan and Chin (1973).
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from factorgrasp.errors import NotSolvedError
from factorgrasp.typing import FloatArray


class BlockTridiagonal:
    """Factor of a matrix with diagonal blocks ``D_k`` (b, m, m) and blocks below them ``L_k`` (b - 1, m, m).

    Raises
    ------
    NotSolvedError
        When it is not positive definite, naming the block.
    """

    def __init__(self, diagonal: FloatArray, below: FloatArray) -> None:
        self._factors = []
        self._gains = []
        left = diagonal[0]
        for k in range(len(diagonal)):
            try:
                factor = cho_factor(left, lower=True, check_finite=False)
            except LinAlgError as error:
                raise NotSolvedError(
                    f"block {k} of {len(diagonal)} is not positive definite: {error}"
                ) from error
            self._factors.append(factor)
            if k + 1 < len(diagonal):
                # G' = S^-1 L'
                gain = cho_solve(factor, below[k].T, check_finite=False)
                self._gains.append(gain)
                left = diagonal[k + 1] - below[k] @ gain

    def solve(self, b: FloatArray) -> FloatArray:
        """Solution (b, m) for a right side (b, m)."""
        x = b.copy()
        for k, gain in enumerate(self._gains):
            x[k + 1] -= gain.T @ x[k]
        for k in range(len(x) - 1, -1, -1):
            x[k] = cho_solve(self._factors[k], x[k], check_finite=False)
            if k + 1 < len(x):
                # x_k = S^-1 (y_k - L' x_k+1)
                x[k] -= self._gains[k] @ x[k + 1]
        return x

    def inverse_band(self) -> tuple[FloatArray, FloatArray]:
        """Diagonal blocks (b, m, m) of the inverse, and its blocks (k, k + 1) above them (b - 1, m, m)."""
        count, size = len(self._factors), self._factors[0][0].shape[0]
        diagonal, above = np.empty((count, size, size)), np.empty((count - 1, size, size))
        one = np.eye(size)
        for k in range(count - 1, -1, -1):
            own = cho_solve(self._factors[k], one, check_finite=False)
            if k + 1 < count:
                gain = self._gains[k]
                above[k] = -gain @ diagonal[k + 1]
                own = own - above[k] @ gain.T
            diagonal[k] = 0.5 * (own + own.T)
        return diagonal, above

"""Compiled inner loops, used where numba is installed (extra ``fast``); numpy does the same work without it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from factorgrasp.typing import FloatArray, IntArray


class Kernels(NamedTuple):
    """The compiled functions, see their sources below."""

    gram: Callable[..., None]
    selected_inverse: Callable[..., None]
    ldl_solve: Callable[..., None]


WORTH_SECONDS = 0.5
"""What importing numba and reading its cache takes: compiled loops come in when numpy has spent as much on the same work."""

_spent = 0.0


def load(seconds: float = float("inf")) -> Kernels | None:
    """The compiled functions, when they are there and have become worth their loading.

    Parameters
    ----------
    seconds : float
        What the call at hand takes without them; infinite insists on them.
    """
    global _spent
    _spent += seconds
    if _spent < WORTH_SECONDS:
        return None
    return _compile()


@cache
def _compile() -> Kernels | None:
    if find_spec("numba") is None:
        return None
    import numba

    def compiled(function: Callable[..., None]) -> Any:
        try:
            return numba.njit(cache=True, error_model="numpy")(function)
        except RuntimeError:  # no writable place for the cache
            return numba.njit(error_model="numpy")(function)

    return Kernels(compiled(_gram), compiled(_selected_inverse), compiled(_ldl_solve))


def _gram(values: FloatArray, indptr: IntArray, target: IntArray, out: FloatArray) -> None:
    """``out[target] += values[e] * values[f]`` over all pairs e <= f of entries of one row, in the order of `target`."""
    out[:] = 0.0
    pair = 0
    for row in range(indptr.size - 1):
        for left in range(indptr[row], indptr[row + 1]):
            value = values[left]
            for right in range(left, indptr[row + 1]):
                out[target[pair]] += value * values[right]
                pair += 1


def _selected_inverse(
    indptr: IntArray,
    rows: IntArray,
    values: FloatArray,
    pivots: FloatArray,
    diagonal: FloatArray,
    below: FloatArray,
) -> None:
    """Takahashi's recursion from the last column to the first, see :mod:`factorgrasp.solvers.selected_inverse`."""
    size = pivots.size
    member = np.full(size, -1, dtype=np.int64)
    sums = np.zeros(size)
    entry_of = np.zeros(size)
    for column in range(size - 1, -1, -1):
        first, last = indptr[column], indptr[column + 1]
        for place in range(first, last):
            member[rows[place]] = column
            sums[rows[place]] = 0.0
            entry_of[rows[place]] = values[place]
        for place in range(first, last):
            k = rows[place]
            factor = values[place]
            sums[k] += diagonal[k] * factor
            for deeper in range(indptr[k], indptr[k + 1]):
                row = rows[deeper]
                if member[row] == column:
                    sums[row] += below[deeper] * factor
                    sums[k] += below[deeper] * entry_of[row]
        total = 1.0 / pivots[column]
        for place in range(first, last):
            row = rows[place]
            below[place] = -sums[row]
            total += values[place] * sums[row]
        diagonal[column] = total


def _ldl_solve(
    indptr: IntArray, rows: IntArray, values: FloatArray, pivots: FloatArray, columns: FloatArray
) -> None:
    """Solve ``L D L' X = B`` in place for all columns of B (n, k) at once; L has a unit diagonal that is not stored."""
    size, count = columns.shape
    for j in range(size):
        for place in range(indptr[j], indptr[j + 1]):
            row, factor = rows[place], values[place]
            for c in range(count):
                columns[row, c] -= factor * columns[j, c]
    for j in range(size - 1, -1, -1):
        inverse = 1.0 / pivots[j]
        for c in range(count):
            columns[j, c] *= inverse
        for place in range(indptr[j], indptr[j + 1]):
            row, factor = rows[place], values[place]
            for c in range(count):
                columns[j, c] -= factor * columns[row, c]

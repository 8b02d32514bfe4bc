"""Named rows of a sparse matrix with a fixed pattern: set up once, filled with new values cheaply."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class RowBlock:
    """What one named group of rows needs: its height and, per variable, which entries can be non-zero."""

    name: str
    rows: int
    patterns: Mapping[str, BoolArray]


class BlockRows:
    """Rows of one sparse matrix and its right-hand side, addressed by (row name, variable name).

    Attributes
    ----------
    matrix : scipy.sparse.csr_array
        Shape (rows, columns); `matrix.indices` and `matrix.indptr` never change after construction.
    rhs : ndarray
        Shape (rows,).
    """

    def __init__(self, blocks: Sequence[RowBlock], columns: Mapping[str, slice], width: int) -> None:
        self.slices: dict[str, slice] = {}
        self._patterns: dict[tuple[str, str], BoolArray] = {}
        row_parts: list[IntArray] = []
        column_parts: list[IntArray] = []
        spans: dict[tuple[str, str], tuple[int, int]] = {}
        start = count = 0
        for block in blocks:
            if block.name in self.slices:
                raise InputError("terms and constraints", "unique names", f"{block.name!r} twice")
            self.slices[block.name] = slice(start, start + block.rows)
            for variable, pattern in block.patterns.items():
                if variable not in columns:
                    known = ", ".join(columns)
                    raise InputError(f"{block.name}", f"variables among {known}", repr(variable))
                size = columns[variable].stop - columns[variable].start
                if pattern.shape != (block.rows, size):
                    raise InputError(
                        f"{block.name}/{variable} pattern", f"shape {(block.rows, size)}", str(pattern.shape)
                    )
                rows, cols = np.nonzero(pattern)
                row_parts.append(rows + start)
                column_parts.append(cols + columns[variable].start)
                spans[block.name, variable] = (count, count + rows.size)
                self._patterns[block.name, variable] = pattern
                count += rows.size
            start += block.rows
        rows = np.concatenate(row_parts) if row_parts else np.empty(0, dtype=np.intp)
        cols = np.concatenate(column_parts) if column_parts else np.empty(0, dtype=np.intp)
        order = np.lexsort((cols, rows))
        place = np.empty(count, dtype=np.intp)
        place[order] = np.arange(count)
        self._places = {key: place[a:b] for key, (a, b) in spans.items()}
        indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=start))])
        self.matrix = sp.csr_array((np.zeros(count), cols[order], indptr), shape=(start, width))
        self.rhs: FloatArray = np.zeros(start)
        self.row_of_entry: IntArray = np.repeat(np.arange(start), np.diff(indptr))

    @property
    def height(self) -> int:
        """Number of rows."""
        return int(self.rhs.size)

    def variables_of(self, name: str) -> tuple[str, ...]:
        """Variables that the rows `name` touch."""
        return tuple(variable for row, variable in self._places if row == name)

    def patterns_of(self, name: str) -> dict[str, BoolArray]:
        """Pattern (rows, size) of every variable that the rows `name` touch."""
        return {variable: pattern for (row, variable), pattern in self._patterns.items() if row == name}

    def places(self, name: str, variable: str) -> IntArray:
        """Positions in `matrix.data` of the non-zeros of one block, row by row: the door for vectorised filling."""
        try:
            return self._places[name, variable]
        except KeyError:
            known = ", ".join(self.variables_of(name)) or "none: no such rows"
            raise InputError(f"{name}", f"a variable of these rows ({known})", repr(variable)) from None

    def set_rhs(self, name: str, rhs: ArrayLike) -> None:
        """Fill the right-hand side of the rows `name`; a scalar or (rows,)."""
        where = self._rows(name)
        value = np.asarray(rhs, dtype=float)
        if value.ndim and value.shape != (where.stop - where.start,):
            raise InputError(
                f"{name} right-hand side", f"shape ({where.stop - where.start},)", str(value.shape)
            )
        self.rhs[where] = value

    def set_block(self, name: str, variable: str, value: ArrayLike | sp.sparray) -> None:
        """Fill one block: dense (rows, size), or only its pattern's entries row by row (nnz,)."""
        places = self.places(name, variable)
        pattern = self._patterns[name, variable]
        if isinstance(value, sp.sparray):
            value = value.toarray()
        array = np.asarray(value, dtype=float)
        if array.shape == pattern.shape:
            self.matrix.data[places] = array.ravel() if places.size == array.size else array[pattern]
        elif array.shape == places.shape:
            self.matrix.data[places] = array
        else:
            raise InputError(
                f"{name}/{variable}",
                f"shape {pattern.shape}, or ({places.size},) for its pattern's entries",
                str(array.shape),
            )

    def _rows(self, name: str) -> slice:
        try:
            return self.slices[name]
        except KeyError:
            raise InputError("row name", "one of " + ", ".join(self.slices), repr(name)) from None

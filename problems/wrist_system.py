"""The batch as named least squares: set up once for an association, filled with whitened rows at every state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgrasp.least_squares import LeastSquares, Term
from factorgrasp.losses import GemanMcClure
from factorgrasp.problems.wrist_rows import Batch, Rows
from factorgrasp.typing import BoolArray, FloatArray, IntArray
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable

CHUNK = 25
"""Frames that share one term: few terms, and yet the residual summary says when something did not fit."""


class System:
    """Terms ``markers <from>-<to> s`` and ``motion <from>-<to> s`` over chunks of frames, and the priors.

    Parameters
    ----------
    batch : Batch
    frames : range
        Numbers of the nodes.
    markers : int
    variables : sequence of Variable
    loss : GemanMcClure or None
    layout_information : (3n, 3n) ndarray or None
    """

    def __init__(
        self,
        batch: Batch,
        frames: range,
        markers: int,
        variables: Sequence[Variable],
        loss: GemanMcClure | None,
        layout_information: FloatArray | None,
    ) -> None:
        self.batch, self.frames = batch, frames
        self._root = None if layout_information is None else np.linalg.cholesky(layout_information).T
        n, D = batch.t.size, batch.size
        terms: list[Term] = []
        self._marker_terms: list[tuple[str, IntArray, range]] = []
        self._motion_terms: list[tuple[str, range]] = []
        order = np.argsort(batch.pairs.node, kind="stable")
        if not np.array_equal(order, np.arange(order.size)):
            raise AssertionError("pairs have to be sorted by node")
        for first in range(0, n, CHUNK):
            nodes = range(first, min(first + CHUNK, n))
            span = f"{batch.t[nodes[0]]:.2f}-{batch.t[nodes[-1]]:.2f} s"
            rows = np.flatnonzero((batch.pairs.node >= nodes[0]) & (batch.pairs.node <= nodes[-1]))
            if rows.size:
                name = f"markers {span}"
                self._marker_terms.append((name, rows, nodes))
                terms.append(self._marker_term(name, rows, nodes, markers, loss))
            steps = range(first, min(first + CHUNK, n - 1))
            if len(steps):
                name = f"motion {span}"
                self._motion_terms.append((name, steps))
                terms.append(self._motion_term(name, steps))
        if D > 6:
            pattern = np.zeros((D - 6, D - 3), dtype=bool)
            pattern[:, 3:] = np.eye(D - 6, dtype=bool)
            name = f"motion_{frames[0]}"
            terms.append(Term("rates at the start", D - 6, (name,), pattern={name: pattern}))
        if self._root is not None:
            terms.append(Term("layout as measured", 3 * markers, ("layout",)))
        self.problem = LeastSquares(variables, terms)
        self._places()

    def _names(self, i: int) -> tuple[str, str]:
        return f"rotation_{self.frames[i]}", f"motion_{self.frames[i]}"

    def _marker_term(
        self, name: str, rows: IntArray, nodes: range, markers: int, loss: GemanMcClure | None
    ) -> Term:
        node, marker = self.batch.pairs.node[rows], self.batch.pairs.marker[rows]
        height, D = 3 * rows.size, self.batch.size
        pattern: dict[str, BoolArray] = {}
        for i in nodes:
            mine = np.repeat(node == i, 3)
            if not mine.any():
                continue
            rotation, motion = self._names(i)
            pattern[rotation] = np.repeat(mine[:, None], 3, axis=1)
            pattern[motion] = np.zeros((height, D - 3), dtype=bool)
            pattern[motion][mine, :3] = True
        if self._root is not None:
            layout = np.zeros((height, 3 * markers), dtype=bool)
            columns = 3 * np.repeat(marker, 3)[:, None] + np.arange(3)
            layout[np.arange(height)[:, None], columns] = True
            pattern["layout"] = layout
        one = Covariance.scalar(1.0)
        return Term(name, height, tuple(pattern), one, loss, group=3, pattern=pattern, unit="sd")

    def _motion_term(self, name: str, steps: range) -> Term:
        D = self.batch.size
        height = D * len(steps)
        pattern: dict[str, BoolArray] = {}
        for place, i in enumerate(steps):
            rows = slice(place * D, (place + 1) * D)
            for node in (i, i + 1):
                for variable, size in zip(self._names(node), (3, D - 3), strict=True):
                    pattern.setdefault(variable, np.zeros((height, size), dtype=bool))[rows] = True
        return Term(name, height, tuple(pattern), Covariance.scalar(1.0), group=D, pattern=pattern, unit="sd")

    def _places(self) -> None:
        """Where the derivatives go in the matrix: one index array for every kind of block."""
        jacobian = self.problem.jacobian
        D = self.batch.size
        turn, way, layout = [], [], []
        for name, rows, nodes in self._marker_terms:
            node = self.batch.pairs.node[rows]
            for number in nodes:
                if np.any(node == number):
                    rotation, motion = self._names(number)
                    turn.append(jacobian.places(name, rotation))
                    way.append(jacobian.places(name, motion))
            if self._root is not None:
                layout.append(jacobian.places(name, "layout"))
        self._turn, self._way, self._layout = _join(turn), _join(way), _join(layout)
        count = len(self.batch.dt)
        blocks = np.empty((count, 2, D, D), dtype=np.intp)
        for name, steps in self._motion_terms:
            seen: dict[str, int] = {}
            for i in steps:
                for side, end in enumerate((i, i + 1)):
                    for variable, columns in zip(self._names(end), (slice(0, 3), slice(3, D)), strict=True):
                        width = columns.stop - columns.start
                        start = seen.get(variable, 0)
                        part = jacobian.places(name, variable)[start : start + D * width]
                        seen[variable] = start + D * width
                        blocks[i, side, :, columns] = part.reshape(D, width)
        self._blocks = blocks

    def fill(self, rows: Rows, x_first: FloatArray, layout_deviation: FloatArray) -> LeastSquares:
        """Rows at a state: the problem, refilled."""
        data, rhs = self.problem.jacobian.matrix.data, self.problem.jacobian.rhs
        data[self._turn] = rows.J_pose[:, :, :3].ravel()
        data[self._way] = rows.J_pose[:, :, 3:].ravel()
        if self._root is not None:
            data[self._layout] = rows.J_point.ravel()
        data[self._blocks[:, 0]] = rows.J_first
        data[self._blocks[:, 1]] = rows.J_second
        where = self.problem.jacobian.slices
        for name, chosen, _ in self._marker_terms:
            rhs[where[name]] = -rows.markers[chosen].ravel()
        for name, steps in self._motion_terms:
            rhs[where[name]] = -rows.motion[steps.start : steps.stop].ravel()
        precision = self.batch.rate_precision
        self.problem.set_term(
            "rates at the start", {f"motion_{self.frames[0]}": precision}, -precision * x_first[3:]
        )
        if self._root is not None:
            self.problem.set_term(
                "layout as measured", {"layout": self._root}, -self._root @ layout_deviation
            )
        return self.problem


def _join(parts: list[IntArray]) -> IntArray:
    return np.concatenate(parts) if parts else np.empty(0, dtype=np.intp)

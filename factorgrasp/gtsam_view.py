"""Our linear problems as gtsam factor graphs with readable keys. gtsam is imported when a graph is made, not with this module."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from typing import Any

import numpy as np

from factorgrasp.block_rows import BlockRows
from factorgrasp.least_squares import LeastSquares
from factorgrasp.typing import FloatArray, IntArray
from factorgrasp.variables import Variable


def load_gtsam() -> Any:
    """The gtsam module, untyped: its stubs change from version to version."""
    return import_module("gtsam")


@dataclass(frozen=True)
class Keys:
    """The gtsam key of every variable and back: the first letter of the name with its number, such as ``g0`` for ``gyro_bias``."""

    key: Mapping[str, int]
    name: Mapping[int, str]

    @classmethod
    def of(cls, names: Iterable[str]) -> Keys:
        """Keys for variable names; a number at the end of a name is kept where it is free."""
        gtsam = load_gtsam()

        key: dict[str, int] = {}
        taken: set[int] = set()
        later: list[str] = []
        for name in names:
            number = re.search(r"(\d+)$", name)
            found = (
                gtsam.symbol(_letter(name), int(number.group()))
                if number and len(number.group()) < 15
                else None
            )
            if found is None or found in taken:
                later.append(name)
            else:
                key[name] = found
                taken.add(found)
        for name in later:
            index = 0
            while gtsam.symbol(_letter(name), index) in taken:
                index += 1
            key[name] = gtsam.symbol(_letter(name), index)
            taken.add(key[name])
        return cls(key, {value: name for name, value in key.items()})

    def table(self) -> str:
        """One line a variable, ``g0  gyro_bias``."""
        gtsam = load_gtsam()

        return "\n".join(f"{gtsam.DefaultKeyFormatter(key)}  {name}" for name, key in self.key.items())


def _letter(name: str) -> str:
    return next((c for c in name.lower() if c.isascii() and c.isalpha()), "x")


@dataclass(frozen=True)
class FactorRows:
    """The rows of one factor: those of a term or constraint that touch the same variables.

    Attributes
    ----------
    name : str
        Of the term or constraint.
    rows : ndarray
        Row numbers in the :class:`BlockRows`.
    variables : tuple of Variable
    entries : ndarray
        Positions in ``matrix.data`` of the non-zeros.
    targets : ndarray
        Positions of those entries in the dense (rows, sum of sizes) block of the factor, flattened.
    edges : tuple of int
        Column where each variable's part of that block begins, and its width.
    """

    name: str
    rows: IntArray
    variables: tuple[Variable, ...]
    entries: IntArray
    targets: IntArray
    edges: tuple[int, ...]

    def blocks(self, data: FloatArray) -> list[FloatArray]:
        """Dense block (rows, size) of every variable, from the non-zeros of the matrix."""
        dense = np.zeros((self.rows.size, self.edges[-1]))
        dense.flat[self.targets] = data[self.entries]
        return [dense[:, a:b] for a, b in pairwise(self.edges)]


def split_rows(
    rows: BlockRows, variables: Sequence[Variable], groups: Mapping[str, int] | None = None
) -> list[FactorRows]:
    """Cut the rows into factors: by name, then by the variables they touch, then into residuals where `groups` says so.

    Parameters
    ----------
    rows : BlockRows
    variables : sequence of Variable
        In column order.
    groups : mapping, optional
        Rows that form one residual, for names whose residuals each need a factor of their own (a robust loss acts on one residual).
    """
    groups = groups or {}
    indptr, indices = rows.matrix.indptr, rows.matrix.indices
    sizes = np.array([v.size for v in variables])
    starts = np.concatenate([[0], np.cumsum(sizes)])
    owner = np.repeat(np.arange(len(variables)), sizes)
    out: list[FactorRows] = []
    for name, span in rows.slices.items():
        chunk = groups.get(name, 0)
        found: dict[tuple[int, ...], list[int]] = {}
        first = span.start
        while first < span.stop:
            last = first + (chunk or 1)
            touched = tuple(np.unique(owner[indices[indptr[first] : indptr[last]]]))
            # A residual of its own gets a key of its own, so that no two of them are joined.
            found.setdefault((*touched, -1 - first) if chunk else touched, []).extend(range(first, last))
            first = last
        for key, members in found.items():
            touched = tuple(i for i in key if i >= 0)
            if touched:
                out.append(_factor_rows(name, np.array(members), touched, variables, starts, indptr, indices))
    return out


def _factor_rows(
    name: str,
    members: IntArray,
    touched: tuple[int, ...],
    variables: Sequence[Variable],
    starts: IntArray,
    indptr: IntArray,
    indices: IntArray,
) -> FactorRows:
    own = [variables[i] for i in touched]
    edges = np.concatenate([[0], np.cumsum([v.size for v in own])])
    shift = np.zeros(int(starts[-1]), dtype=np.intp)
    for i, edge in zip(touched, edges[:-1], strict=True):
        shift[starts[i] : starts[i + 1]] = edge + np.arange(starts[i + 1] - starts[i])
    counts = (indptr[members + 1] - indptr[members]).astype(np.intp)
    entries = np.concatenate([np.arange(indptr[r], indptr[r + 1]) for r in members]).astype(np.intp)
    local = np.repeat(np.arange(members.size), counts)
    targets = local * int(edges[-1]) + shift[indices[entries]]
    return FactorRows(name, members, tuple(own), entries, targets, tuple(int(e) for e in edges))


class GaussianView:
    """A :class:`LeastSquares` as a Gaussian factor graph; the cutting into factors is done once for its pattern.

    Rows are whitened, so soft factors have unit noise and their errors are in standard deviations; equalities have constrained noise.
    Inequalities and bounds are not part of the graph: gtsam's elimination has none.

    Attributes
    ----------
    keys : Keys
    entries : ndarray
        Non-zeros of the whitened matrix that the last graph was made of.
    """

    def __init__(self, problem: LeastSquares) -> None:
        gtsam = load_gtsam()

        self.problem = problem
        self.keys = Keys.of(v.name for v in problem.variables)
        self._soft = split_rows(problem.jacobian, problem.variables)
        self._hard = split_rows(problem.equalities, problem.variables)
        self.entries: FloatArray = np.empty(0)
        self._zero = gtsam.Values()
        for variable in problem.variables:
            self._zero.insert(self.keys.key[variable.name], np.zeros(variable.size))

    def fits(self, problem: LeastSquares) -> bool:
        """Whether `problem` has the same variables, rows and patterns, so that it can take the place of the present one."""
        mine = self.problem
        return mine.variables == problem.variables and all(
            a.slices == b.slices
            and np.array_equal(a.matrix.indptr, b.matrix.indptr)
            and np.array_equal(a.matrix.indices, b.matrix.indices)
            for a, b in ((mine.jacobian, problem.jacobian), (mine.equalities, problem.equalities))
        )

    def graph(self, row_weights: FloatArray | None = None) -> Any:
        """``gtsam.GaussianFactorGraph`` of the current values; `row_weights` as in :meth:`LeastSquares.whitened`."""
        gtsam = load_gtsam()

        graph = gtsam.GaussianFactorGraph()
        data, rhs = self.problem.whitened_values(row_weights)
        self.entries = data
        for part in self._soft:
            unit = gtsam.noiseModel.Unit.Create(part.rows.size)
            graph.push_back(self._factor(part, part.blocks(data), rhs[part.rows], unit))
        hard = self.problem.equalities
        for part in self._hard:
            exact = gtsam.noiseModel.Constrained.All(part.rows.size)
            graph.push_back(self._factor(part, part.blocks(hard.matrix.data), hard.rhs[part.rows], exact))
        return graph

    def vector(self, values: Any) -> FloatArray:
        """``gtsam.VectorValues`` as x (n,) in the order of the problem's variables; NaN for variables that no row touches."""
        parts = []
        for variable in self.problem.variables:
            key = self.keys.key[variable.name]
            parts.append(values.at(key) if values.exists(key) else np.full(variable.size, np.nan))
        return np.concatenate(parts)

    def _factor(self, part: FactorRows, blocks: list[FloatArray], rhs: FloatArray, model: Any) -> Any:
        gtsam = load_gtsam()

        keys = [self.keys.key[v.name] for v in part.variables]
        if len(keys) <= 3:
            pairs = [value for pair in zip(keys, blocks, strict=True) for value in pair]
            return gtsam.JacobianFactor(*pairs, rhs, model)

        # The wrapper offers no JacobianFactor of more than three keys: linearising a factor that is linear makes one.
        def error(_this: Any, _values: Any, jacobians: Any) -> FloatArray:
            if jacobians is not None:
                for i, block in enumerate(blocks):
                    jacobians[i] = block
            return -rhs

        return gtsam.CustomFactor(model, keys, error).linearize(self._zero)


def gaussian_factor_graph(problem: LeastSquares, row_weights: FloatArray | None = None) -> tuple[Any, Keys]:
    """A linear problem as ``gtsam.GaussianFactorGraph`` with its keys; see :class:`GaussianView`."""
    view = GaussianView(problem)
    return view.graph(row_weights), view.keys


def variable_of_error(message: str, name: Callable[[int], str]) -> str:
    """Name of the variable that gtsam's IndeterminantLinearSystemException speaks of; empty when it names none."""
    found = re.search(r"variable\s+(\d+)", message)
    return name(int(found.group(1))) if found else ""

"""Our problems as gtsam factor graphs with readable keys: linear ones, and nonlinear ones on gtsam's own manifolds.

gtsam is imported when a graph is made, not with this module. A Python ``CustomFactor`` costs 30 to 340 us a call: the generic nonlinear
graph is for comparison and for problems of some hundred factors; a problem with a native ``factor_graph`` is taken as it is.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgrasp.block_rows import BlockRows
from factorgrasp.errors import SolverError
from factorgrasp.least_squares import LeastSquares
from factorgrasp.losses import Cauchy, GemanMcClure, Huber, Loss
from factorgrasp.problem import NonlinearProblem
from factorgrasp.typing import FloatArray, IntArray, State
from factorgrasp.variables import Variable

# gtsam orders the tangent of a Pose3 as [rotation; translation], we as [linear; angular].
_POSE_ORDER = np.array([3, 4, 5, 0, 1, 2])


@dataclass(frozen=True)
class Keys:
    """The gtsam key of every variable and back: the first letter of the name with its number, such as ``g0`` for ``gyro_bias``."""

    key: Mapping[str, int]
    name: Mapping[int, str]

    @classmethod
    def of(cls, names: Iterable[str]) -> Keys:
        """Keys for variable names; a number at the end of a name is kept where it is free."""
        import gtsam

        key: dict[str, int] = {}
        taken: set[int] = set()
        later: list[str] = []
        for name in names:
            number = re.search(r"(\d+)$", name)
            found = gtsam.symbol(_letter(name), int(number.group())) if number and len(number.group()) < 15 else None
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
        import gtsam

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
        return [dense[:, a:b] for a, b in zip(self.edges[:-1], self.edges[1:], strict=True)]


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
        import gtsam

        self.problem = problem
        self.keys = Keys.of(v.name for v in problem.variables)
        self._soft = split_rows(problem.jacobian, problem.variables)
        self._hard = split_rows(problem.equalities, problem.variables)
        self.entries: FloatArray = np.empty(0)
        self._zero = gtsam.Values()
        for variable in problem.variables:
            self._zero.insert(self.keys.key[variable.name], np.zeros(variable.size))

    def graph(self, row_weights: FloatArray | None = None) -> Any:
        """``gtsam.GaussianFactorGraph`` of the current values; `row_weights` as in :meth:`LeastSquares.whitened`."""
        import gtsam

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
        import gtsam

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


class NonlinearView:
    """A nonlinear problem as a ``gtsam.NonlinearFactorGraph``.

    A problem with ``factor_graph``, ``graph_values`` and ``graph_state`` is taken by these. Any other is wrapped: one ``CustomFactor`` for
    the rows of a term that touch the same variables (one a residual where the term has a robust loss, under gtsam's noise model of that
    loss), linearised through ``problem.linearize``. Rows may depend on the values of their own variables only; the linearisation is shared
    between the factors as long as those values stay.

    Parameters
    ----------
    problem : NonlinearProblem
    state : State
        Where to start.

    Attributes
    ----------
    graph : gtsam.NonlinearFactorGraph
    values : gtsam.Values
    keys : Keys or None
        None for a native graph, whose keys are the problem's own.

    Raises
    ------
    SolverError
        When the problem has inequalities or bounds, or moves its state in a way that gtsam's manifolds do not.
    """

    def __init__(self, problem: NonlinearProblem, state: State) -> None:
        import gtsam

        self._problem: Any = problem
        self._start = dict(state)
        self.native = hasattr(problem, "factor_graph")
        self.keys: Keys | None = None
        if self.native:
            self.graph: Any = self._problem.factor_graph(state)
            self.values: Any = self._problem.graph_values(state)
            return
        linear = problem.linearize(state)
        if linear.has_inequalities:
            raise SolverError("gtsam's optimisers take no inequalities or bounds; use a QP solver such as piqp")
        self._variables = linear.variables
        self._check_manifolds(linear)
        self.keys = Keys.of(v.name for v in self._variables)
        self._cache = _Linearisation(problem, self.state)
        self.graph = gtsam.NonlinearFactorGraph()
        groups = {t.name: t.group or t.rows for t in linear.terms.values() if t.loss is not None}
        for part in split_rows(linear.jacobian, self._variables, groups):
            model = gtsam.noiseModel.Unit.Create(part.rows.size)
            loss = linear.terms[part.name].loss
            if loss is not None:
                model = gtsam.noiseModel.Robust.Create(robust_estimator(loss), model)
            self.graph.push_back(self._custom(part, model, hard=False))
        for part in split_rows(linear.equalities, self._variables):
            self.graph.push_back(self._custom(part, gtsam.noiseModel.Constrained.All(part.rows.size), hard=True))
        self.values = gtsam.Values()
        for variable in self._variables:
            self._insert(variable, state[variable.name])

    def state(self, values: Any) -> State:
        """``gtsam.Values`` as a state; what is not among them stays as it was at the start."""
        if self.native:
            return dict(self._problem.graph_state(values))
        assert self.keys is not None
        out = dict(self._start)
        for variable in self._variables:
            key = self.keys.key[variable.name]
            if values.exists(key):
                out[variable.name] = _read(variable, values, key)
        return out

    def _insert(self, variable: Variable, value: FloatArray) -> None:
        import gtsam

        assert self.keys is not None
        key = self.keys.key[variable.name]
        if variable.manifold == "rotation":
            self.values.insert(key, gtsam.Rot3(np.asarray(value)))
        elif variable.manifold == "pose":
            self.values.insert(key, gtsam.Pose3(np.asarray(value)))
        else:
            self.values.insert(key, np.asarray(value, dtype=float))

    def _check_manifolds(self, linear: LeastSquares) -> None:
        """A small step must move the state as the manifolds of the variables do."""
        step = 1e-3 * np.sin(1.0 + np.arange(linear.size))
        moved = self._problem.retract(self._start, step)
        for variable in self._variables:
            value = np.asarray(self._start[variable.name], dtype=float)
            shape = {"rotation": (3, 3), "pose": (4, 4)}.get(variable.manifold, (variable.size,))
            fits = value.shape == shape
            if fits:
                expected = variable.retract(value, step[linear.columns[variable.name]])
                fits = bool(np.allclose(moved[variable.name], expected, rtol=0.0, atol=1e-6 * (1.0 + np.abs(value).max())))
            if not fits:
                raise SolverError(
                    f"variable {variable.name!r} does not move as a gtsam {variable.manifold} (shape {value.shape}): "
                    "give the problem its own factor_graph, or use a solver of our outer loop"
                )

    def _custom(self, part: FactorRows, model: Any, hard: bool) -> Any:
        import gtsam

        assert self.keys is not None
        keys = [self.keys.key[v.name] for v in part.variables]
        cache = self._cache

        def error(_this: Any, values: Any, jacobians: Any) -> FloatArray:
            own = {v.name: _read(v, values, k) for v, k in zip(part.variables, keys, strict=True)}
            data, rhs = cache.rows(own, values, hard)
            if jacobians is not None:
                for i, (variable, block) in enumerate(zip(part.variables, part.blocks(data), strict=True)):
                    jacobians[i] = block[:, _POSE_ORDER] if variable.manifold == "pose" else block
            return -rhs[part.rows]

        return gtsam.CustomFactor(model, keys, error)


class _Linearisation:
    """The last linearisation of a problem, shared by all factors that ask for it at the same values."""

    def __init__(self, problem: NonlinearProblem, to_state: Callable[[Any], State]) -> None:
        self._problem = problem
        self._to_state = to_state
        self._state: State | None = None
        self._soft: tuple[FloatArray, FloatArray] = (np.empty(0), np.empty(0))
        self._hard = self._soft

    def rows(self, own: Mapping[str, FloatArray], values: Any, hard: bool) -> tuple[FloatArray, FloatArray]:
        """Non-zeros and right-hand side at `values`, of which a factor has read its own variables."""
        if self._state is None or any(not np.array_equal(self._state[name], value) for name, value in own.items()):
            self._state = self._to_state(values)
            linear = self._problem.linearize(self._state)
            self._soft = linear.whitened_values()
            # The problem may refill the same object: keep copies.
            self._hard = linear.equalities.matrix.data.copy(), linear.equalities.rhs.copy()
        return self._hard if hard else self._soft


def _read(variable: Variable, values: Any, key: int) -> FloatArray:
    if variable.manifold == "rotation":
        return np.asarray(values.atRot3(key).matrix())
    if variable.manifold == "pose":
        return np.asarray(values.atPose3(key).matrix())
    return np.asarray(values.atVector(key))


def robust_estimator(loss: Loss) -> Any:
    """gtsam's m-estimator of a loss of ours: the same weight as a function of the whitened norm."""
    import gtsam

    estimators = gtsam.noiseModel.mEstimator
    kinds = {Huber: estimators.Huber, Cauchy: estimators.Cauchy, GemanMcClure: estimators.GemanMcClure}
    for kind, estimator in kinds.items():
        if isinstance(loss, kind):
            return estimator.Create(loss.scale)
    raise SolverError(f"gtsam has no noise model for the loss {type(loss).__name__}; use a solver of our outer loop")


def variable_of_error(message: str, name: Callable[[int], str]) -> str:
    """Name of the variable that gtsam's IndeterminantLinearSystemException speaks of; empty when it names none."""
    found = re.search(r"variable\s+(\d+)", message)
    return name(int(found.group(1))) if found else ""

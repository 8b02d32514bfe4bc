"""Our nonlinear problems as gtsam factor graphs, on gtsam's own manifolds.

A Python ``CustomFactor`` costs 30 to 340 us a call: the generic graph is for comparison and for problems of some hundred factors; a problem
with a native ``factor_graph`` is taken as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from factorgrasp.errors import SolverError
from factorgrasp.gtsam_view import FactorRows, Keys, load_gtsam, split_rows
from factorgrasp.least_squares import LeastSquares
from factorgrasp.losses import Cauchy, GemanMcClure, Huber, Loss
from factorgrasp.problem import NonlinearProblem
from factorgrasp.typing import FloatArray, State
from factorgrasp.variables import Variable

# gtsam orders the tangent of a Pose3 as [rotation; translation], we as [linear; angular].
_POSE_ORDER = np.array([3, 4, 5, 0, 1, 2])


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
        gtsam = load_gtsam()

        self._problem: Any = problem
        self._start = dict(state)
        self.native = hasattr(problem, "factor_graph")
        self.keys: Keys | None = None
        if self.native:
            native: Any = problem
            self.graph: Any = native.factor_graph(state)
            self.values: Any = native.graph_values(state)
            return
        linear = problem.linearize(state)
        if linear.has_inequalities:
            raise SolverError(
                "gtsam's optimisers take no inequalities or bounds; use a QP solver such as piqp"
            )
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
            self.graph.push_back(
                self._custom(part, gtsam.noiseModel.Constrained.All(part.rows.size), hard=True)
            )
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
        gtsam = load_gtsam()

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
                fits = bool(
                    np.allclose(
                        moved[variable.name], expected, rtol=0.0, atol=1e-6 * (1.0 + np.abs(value).max())
                    )
                )
            if not fits:
                raise SolverError(
                    f"variable {variable.name!r} does not move as a gtsam {variable.manifold} (shape {value.shape}): "
                    "give the problem its own factor_graph, or use a solver of our outer loop"
                )

    def _custom(self, part: FactorRows, model: Any, hard: bool) -> Any:
        gtsam = load_gtsam()

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
        if self._state is None or any(
            not np.array_equal(self._state[name], value) for name, value in own.items()
        ):
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
    """Gtsam's m-estimator of a loss of ours: the same weight as a function of the whitened norm."""
    gtsam = load_gtsam()

    estimators = gtsam.noiseModel.mEstimator
    kinds = {Huber: estimators.Huber, Cauchy: estimators.Cauchy, GemanMcClure: estimators.GemanMcClure}
    for kind, estimator in kinds.items():
        if isinstance(loss, kind):
            return estimator.Create(loss.scale)
    raise SolverError(
        f"gtsam has no noise model for the loss {type(loss).__name__}; use a solver of our outer loop"
    )

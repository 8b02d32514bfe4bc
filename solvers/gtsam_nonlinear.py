"""gtsam's own optimisers: Gauss-Newton, Levenberg-Marquardt and iSAM2 on a whole nonlinear problem.

They end by one criterion: the Newton decrement ``1/2 g' H^-1 g`` of the undamped, re-weighted normal
equations is at most ``tolerance^2`` (or at the rounding of the objective), which is an error of about
`tolerance` standard deviations in any direction.

Robust losses act as gtsam noise models, which gives the same iteratively re-weighted normal equations as
ours. They are not folded into the residuals of a custom factor: with weights hidden there Levenberg-Marquardt
judges its steps by the wrong objective and can diverge.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from factorgrasp.gtsam_nonlinear_view import NonlinearView
from factorgrasp.gtsam_view import load_gtsam, variable_of_error
from factorgrasp.problem import NonlinearProblem
from factorgrasp.solvers.base import Capabilities, NonlinearSolution, SolverOptions
from factorgrasp.solvers.gtsam_linear import GtsamElimination
from factorgrasp.status import Status
from factorgrasp.typing import State

MAX_ITERATIONS = 100
_ROUNDING = 1e-15
_STALLED = 1e-11
"""Decrement, relative to the objective (at least one), at which a run that can go no further counts as converged: a few millionths of a
standard deviation, below which the rounding of the objective hides every decrease."""


class GtsamNonlinear(GtsamElimination):
    """Base of gtsam's optimisers. On a linear problem (`setup`, `solve`) they are one elimination."""

    capabilities: ClassVar[Capabilities] = Capabilities(equalities=True, nonlinear=True)

    def solve_problem(
        self, problem: NonlinearProblem, initial_state: State | None = None
    ) -> NonlinearSolution:
        """Iterate from the problem's initial state, or another one, to convergence.

        Raises
        ------
        SolverError
            When the problem cannot be put into gtsam: inequalities, bounds, a loss or a manifold that it has
            not.
        """
        start = time.perf_counter()
        state = problem.initial_state() if initial_state is None else initial_state
        view = NonlinearView(problem, state)
        built = time.perf_counter()
        run = _Run(self.options, time.perf_counter)
        values = view.values
        try:
            values = self._iterate(view, run)
        except RuntimeError as error:
            # An exception of a problem's own linearisation passes through gtsam as it is and is not ours to
            # swallow.
            if "ndetermina" not in str(error):
                raise
            values = run.best if run.best is not None else view.values
            name = variable_of_error(str(error), lambda key: _name_of(view, key))
            run.end(
                Status.UNOBSERVABLE,
                f"the data do not inform {name} (given the other variables): add a measurement or a prior",
            )
        return NonlinearSolution(
            state=view.state(values),
            status=run.status,
            iterations=run.iterations,
            setup_time=built - start,
            solve_time=time.perf_counter() - built,
            message=run.message,
            errors_log=tuple(run.errors),
        )

    @abstractmethod
    def _iterate(self, view: NonlinearView, run: _Run) -> Any:
        """Run the optimiser; returns the last ``gtsam.Values``."""


class _Run:
    """What happened so far, and when to stop."""

    def __init__(self, options: SolverOptions, clock: Callable[[], float]) -> None:
        self.tolerance = options.tolerance
        self.limit = options.max_iterations or MAX_ITERATIONS
        self.deadline = np.inf if options.time_limit is None else clock() + options.time_limit
        self.errors: list[float] = []
        self.iterations = 0
        self.status = Status.NOT_CONVERGED
        self.message = ""
        self.stalls = 0
        self.best: Any = None
        self._clock = clock

    def end(self, status: Status, message: str) -> None:
        self.status, self.message = status, message

    def record(self, values: Any, error: float) -> None:
        self.best = values
        self.errors.append(error)

    def small(self, decrement: float) -> bool:
        """Whether a Newton decrement counts as converged."""
        return decrement <= max(self.tolerance**2, _ROUNDING * abs(self.errors[-1]))

    def judge(self, view: NonlinearView, values: Any) -> bool:
        """Whether the run is over: converged, or without a decrease any more; says so."""
        stalled = len(self.errors) > 1 and self.errors[-1] >= self.errors[-2]
        left = _newton_decrement(view, values)
        if self.small(left) or (stalled and left <= _STALLED * max(1.0, abs(self.errors[-1]))):
            self.end(Status.SOLVED, f"converged in {self.iterations} iterations")
            return True
        if stalled:
            self.stalls += 1
        if self.stalls >= 5:
            self.end(
                Status.NOT_CONVERGED,
                "stalled: no step decreases the objective although its gradient is not zero",
            )
            return True
        return False

    def exhausted(self) -> bool:
        """Whether a limit ends the run; says so."""
        if self.iterations >= self.limit:
            self.end(Status.NOT_CONVERGED, f"iteration limit of {self.limit} reached")
            return True
        if self._clock() > self.deadline:
            self.end(Status.NOT_CONVERGED, "time limit reached")
            return True
        return False


def _name_of(view: NonlinearView, key: int) -> str:
    gtsam = load_gtsam()

    if view.keys is not None and key in view.keys.name:
        return view.keys.name[key]
    return str(gtsam.DefaultKeyFormatter(key))


def _decrement(linear: Any, delta: Any) -> float:
    """Decrease that a step promises on a linearised graph."""
    gtsam = load_gtsam()

    return float(linear.error(gtsam.VectorValues.Zero(delta)) - linear.error(delta))


def _newton_decrement(view: NonlinearView, values: Any) -> float:
    """Decrease that the full, undamped step promises at `values`."""
    gtsam = load_gtsam()

    linear = view.graph.linearize(values)
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
    return _decrement(linear, linear.optimize(ordering, gtsam.EliminateQR))


class _Batch(GtsamNonlinear):
    """The iteration that Gauss-Newton and Levenberg-Marquardt share."""

    @abstractmethod
    def _optimizer(self, view: NonlinearView) -> Any:
        """The optimiser at the view's values."""

    def _iterate(self, view: NonlinearView, run: _Run) -> Any:
        gtsam = load_gtsam()

        optimizer = self._optimizer(view)
        # The wrapper hands out a reference into the optimiser, which the next iteration frees: always copy.
        values = gtsam.Values(optimizer.values())
        run.record(values, optimizer.error())
        while not run.exhausted():
            linear = optimizer.iterate()
            run.iterations += 1
            moved = gtsam.Values(optimizer.values())
            run.record(moved, optimizer.error())
            promised = _decrement(linear, values.localCoordinates(moved))
            values = moved
            if not np.isfinite(run.errors[-1]):
                run.end(Status.NUMERICAL_ERROR, "the objective is not finite")
                break
            # The full check costs an elimination: only when the step was small or did not go down.
            worth_it = run.small(promised) or run.errors[-1] >= run.errors[-2]
            if worth_it and run.judge(view, values):
                break
        return values


class GtsamGaussNewton(_Batch):
    """``gtsam.GaussNewtonOptimizer`` with QR elimination: fastest near the solution, no safeguard far from it."""

    name: ClassVar[str] = "gtsam-gauss-newton"

    def _optimizer(self, view: NonlinearView) -> Any:
        gtsam = load_gtsam()

        params = gtsam.GaussNewtonParams()
        params.setLinearSolverType("MULTIFRONTAL_QR")
        return gtsam.GaussNewtonOptimizer(view.graph, view.values, params)


class GtsamLevenbergMarquardt(_Batch):
    """``gtsam.LevenbergMarquardtOptimizer``: damped, for starts far from the solution."""

    name: ClassVar[str] = "gtsam-levenberg-marquardt"

    def _optimizer(self, view: NonlinearView) -> Any:
        gtsam = load_gtsam()

        params = gtsam.LevenbergMarquardtParams()
        params.setLinearSolverType("MULTIFRONTAL_QR")
        return gtsam.LevenbergMarquardtOptimizer(view.graph, view.values, params)


class GtsamIsam2(GtsamNonlinear):
    """``gtsam.ISAM2``: the factors are fed, then updated until nothing is relinearised any more.

    The whole graph at once by default; ``extra={"increments": n}`` feeds it in up to n parts, each of which
    leaves the variables so far determined. What little the first parts know can lead to another valley than
    the whole graph: a run that does not end well is begun again with the whole graph at once, and the message
    says so.
    """

    name: ClassVar[str] = "gtsam-isam2"

    def _iterate(self, view: NonlinearView, run: _Run) -> Any:
        run.record(view.values, view.graph.error(view.values))
        parts = increments(view, int(self.options.extra.get("increments", 1)))
        if len(parts) > 1:
            try:
                values = self._feed(view, run, parts)
            except RuntimeError as error:
                if "ndetermina" not in str(error):
                    raise
            else:
                if run.status is Status.SOLVED or run.exhausted():
                    return values
            run.stalls = 0
        values = self._feed(view, run, increments(view, 1))
        if len(parts) > 1:
            run.message += " (fed whole: in increments it led away)"
        return values

    def _feed(self, view: NonlinearView, run: _Run, parts: list[tuple[Any, Any]]) -> Any:
        gtsam = load_gtsam()
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.relinearizeSkip = 1
        # Its default does not pass on changes below 1e-3, which ends far from the optimum.
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        params.setRelinearizeThreshold(min(self.options.tolerance, 1e-6))
        isam = gtsam.ISAM2(params)
        for graph, values in parts:
            isam.update(graph, values)
            run.iterations += 1
        values = isam.calculateBestEstimate()
        run.record(values, view.graph.error(values))
        while not run.exhausted():
            isam.update()
            run.iterations += 1
            values = isam.calculateBestEstimate()
            run.record(values, view.graph.error(values))
            if not np.isfinite(run.errors[-1]):
                run.end(Status.NUMERICAL_ERROR, "the objective is not finite")
                break
            if run.judge(view, values):
                break
        return values


def increments(view: NonlinearView, parts: int) -> list[tuple[Any, Any]]:
    """The graph of a view cut into parts, each of which leaves all variables so far determined.

    A part brings some variables, in their order, with every factor that needs none of the later ones: a prior
    comes with its variable, so that no part is solved with less information on its variables than it has to
    be.

    Parameters
    ----------
    view : NonlinearView
    parts : int
        At most.

    Returns
    -------
    list of (gtsam.NonlinearFactorGraph, gtsam.Values)
        New factors and the values of the new variables.
    """
    gtsam = load_gtsam()
    keys = list(view.keys.key.values() if view.keys is not None else view.values.keys())
    rank = {key: i for i, key in enumerate(keys)}
    factors = [view.graph.at(i) for i in range(view.graph.size())]
    last = [max(map(rank.__getitem__, factor.keys()), default=0) for factor in factors]
    whole, fresh = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    out: list[tuple[Any, Any]] = []
    begun = reached = 0
    for edge in np.unique(np.linspace(0, len(keys), max(parts, 1) + 1).astype(int))[1:]:
        for factor, needed in zip(factors, last, strict=True):
            if reached <= needed < edge:
                whole.push_back(factor)
                fresh.push_back(factor)
        reached = int(edge)
        if reached == len(keys) or _determined(whole, view.values, reached):
            out.append((fresh, _subset(view.values, set(keys[begun:reached]))))
            fresh = gtsam.NonlinearFactorGraph()
            begun = reached
    return out


def _determined(graph: Any, values: Any, count: int) -> bool:
    """Whether the factors so far determine the `count` variables so far."""
    gtsam = load_gtsam()
    if graph.size() == 0 or graph.keys().size() < count:
        return False
    linear = graph.linearize(values)
    try:
        linear.optimize(gtsam.Ordering.ColamdGaussianFactorGraph(linear))
    except RuntimeError as error:
        if "ndetermina" not in str(error):
            raise
        return False
    return True


def _subset(values: Any, keys: set[int]) -> Any:
    """The values of some keys, of whatever types they are."""
    gtsam = load_gtsam()

    out = gtsam.Values(values)
    for key in list(values.keys()):
        if key not in keys:
            out.erase(key)
    return out

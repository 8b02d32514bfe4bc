"""The grasp that may wander: one rotation and lever arm per segment, tied by a random walk (mathematics 2.4).

Every segment enters as one factor over its compressed moments. The problem runs on every solver of ours
through `linearize`, on gtsam's optimisers through its native graph, and segment by segment through
`increments`. With ``static=True`` all segments share one rotation and one lever arm: the problem of
:class:`factorgrasp.problems.grasp_pose.GraspPose`, cut into factors.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate
from factorgrasp.least_squares import LeastSquares, Term
from factorgrasp.losses import make_loss
from factorgrasp.problems.grasp_model import GraspModel
from factorgrasp.problems.grasp_pose import (
    SETTLED_OFFSET,
    SETTLED_ROBUST_STEP,
    SETTLED_STEP,
    SETTLED_WEIGHTS,
    GraspPose,
    GraspWeights,
)
from factorgrasp.problems.grasp_recording import SMALLEST_CORRELATION
from factorgrasp.problems.grasp_segment_cut import (
    band_variances,
    common_start,
    segment_labels,
    segment_moments,
    window_norms,
)
from factorgrasp.problems.grasp_segment_factor import Quadratic, SegmentFactor
from factorgrasp.problems.grasp_segment_graph import Increment, SegmentGraph, SegmentKeys
from factorgrasp.problems.grasp_system import (
    floored_inverse,
    grasp_variables,
    insignificant,
    prior_precision,
    prior_residual,
)
from factorgrasp.problems.grasp_track import GraspTrack
from factorgrasp.typing import FloatArray, IntArray, State
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable, retract, slices

# Covariances are dense in the number of unknowns, six a segment.
MOST_SEGMENTS = 500
_GRASP = ("rotation", "translation")


class GraspSegments:
    """One grasp per segment of a recording.

    The grasp of a segment is its mean over the segment; a hand that wanders is away from it by
    ``walk_sd * sqrt(segment_seconds / 6)`` at a random instant.

    Parameters
    ----------
    problem : GraspPose
        The recording with its noise, settings and prior.
    segment_seconds : float
        s; at least one analysis window (``GraspSettings.window``).
    rotation_walk_sd : float
        rad/sqrt(s): standard deviation, about every axis, of how far the hand turns against the end-effector in
        one second.
    translation_walk_sd : float
        m/sqrt(s), along every axis.
    static : bool
        One grasp for all segments; the walk's standard deviations are not used.

    Attributes
    ----------
    t : (K,) ndarray
        Mean time of every segment that holds data, s, robot clock. The walk goes on through gaps.
    factors : tuple of SegmentFactor

    Raises
    ------
    InputError
        For a segment shorter than a window, more than 500 segments, or a walk without width.
    """

    kind = "grasp_segments"

    def __init__(
        self,
        problem: GraspPose,
        segment_seconds: float = 2.0,
        rotation_walk_sd: float = 1e-3,
        translation_walk_sd: float = 1e-3,
        static: bool = False,
    ) -> None:
        if not isinstance(problem, GraspPose):
            raise InputError("problem", "a GraspPose", type(problem).__name__)
        windowing = problem._grid.windowing
        window = windowing.length * windowing.step
        if not (np.isfinite(segment_seconds) and segment_seconds >= 0.999 * window):
            wanted = f"at least one window of {window:.3g} s"
            raise InputError("segment_seconds", wanted, repr(segment_seconds))
        walk = (("rotation_walk_sd", rotation_walk_sd), ("translation_walk_sd", translation_walk_sd))
        for name, value in walk:
            if not static and not (np.isfinite(value) and value > 0.0):
                hint = "A grasp that cannot wander is static=True"
                raise InputError(name, "a finite number above zero", repr(value), hint)
        self.segment_seconds, self.static = float(segment_seconds), static
        self.rotation_walk_sd, self.translation_walk_sd = float(rotation_walk_sd), float(translation_walk_sd)
        self._refined = self._final = False
        self._pose(problem, None)

    def _pose(self, problem: GraspPose, start: State | None) -> None:
        """Cut a recording, with the weights and clocks that it has now, into factors."""
        self.problem, self.model = problem, problem.model
        self._shared = self.model.variables[2:]
        self._label = segment_labels(problem._windows.t, self.segment_seconds)
        count = int(self._label[-1]) + 1
        if count > MOST_SEGMENTS:
            hint = "Take longer segments, or cut the recording"
            raise InputError("segment_seconds", f"at most {MOST_SEGMENTS} segments", f"{count}", hint)
        self._names = tuple(
            _GRASP if self.static else (f"rotation_{k}", f"translation_{k}") for k in range(count)
        )
        self._precision = prior_precision(self.model, problem.noise, problem.prior)
        if start is None:
            start = self.spread(common_start(problem))
        local = [self.local(start, k) for k in range(count)]
        moments = segment_moments(problem, self._label, local)
        keys = SegmentKeys(self._shared, self.static)
        slip = 0.0 if self.static else self.rotation_walk_sd**2 / self.segment_seconds
        self.factors = tuple(
            SegmentFactor(self.model, part, slip, keys.of(k), keys.reader(k))
            for k, part in enumerate(moments)
        )
        self.t = np.array([part.t for part in moments])
        self.variables = self._make_variables()
        self._start: State = {variable.name: start[variable.name] for variable in self.variables}
        self._pattern: LeastSquares | None = None
        self._graph = SegmentGraph(
            keys=keys,
            factors=self.factors,
            t=self.t,
            rotation_walk_sd=self.rotation_walk_sd,
            translation_walk_sd=self.translation_walk_sd,
            prior=problem.prior,
            precision=self._precision,
        )

    def spread(self, state: State) -> State:
        """A state of the unsegmented problem (clock shift, not total offset) with its grasp in every segment."""
        out = {variable.name: np.asarray(state[variable.name]) for variable in self._shared}
        for names in self._names:
            out.update(zip(names, (state["rotation"], state["translation"]), strict=True))
        return out

    def local(self, state: State, k: int) -> State:
        """The values that segment k sees, under the names of the unsegmented problem."""
        rotation, translation = self._names[k]
        shared = {v.name: state[v.name] for v in self._shared}
        return {"rotation": state[rotation], "translation": state[translation], **shared}

    # ---- the protocol of a nonlinear problem

    def initial_state(self) -> State:
        """Every segment near the best common grasp, or where the problem was posed afresh."""
        return self.problem.initial_state() if self.static else self._start

    def linearize(self, state: State) -> LeastSquares:
        """Rows of every segment (see :meth:`Quadratic.rows`), of the walk and of the priors.

        When the grasp is static the segments are summed, which needs no rows of a single one.
        """
        if self.static:
            return self.problem.linearize(state)
        system = self._fill_ties(state)
        rows = [factor.rows(self.local(state, k)) for k, factor in enumerate(self.factors)]
        A, b = np.stack([row[0] for row in rows]), np.stack([row[1] for row in rows])
        blocks: dict[str, FloatArray] = {
            v.name: A[:, :, self.model.columns[v.name]].reshape(-1, v.size) for v in self._shared
        }
        for k, names in enumerate(self._names):
            for name, part in zip(names, (slice(0, 3), slice(3, 6)), strict=True):
                blocks[name] = A[k, :, part].ravel()
        system.set_term("moments", blocks, b.ravel())
        return system

    def retract(self, state: State, step: FloatArray) -> State:
        """Move the state by a tangent step (n,)."""
        return retract(self.variables, state, step)

    def refine(self, state: State) -> GraspSegments | None:
        """Shift the clocks, re-weight the bands, drop needless sensor errors; None when all is settled."""
        if self._final:
            return None
        if self.static:
            fresh = self.problem.refine(state)
            return None if fresh is None else self._again(fresh, None)
        return self._refine_wandering(state)

    def escape(self, state: State) -> State | None:
        """A start in the basin of a better rotation, judged for the mean grasp; None when there is none.

        A problem that was posed afresh stays in the basin that was found before.
        """
        if self.static:
            return self.problem.escape(state)
        if self._refined:
            return None
        shared = {variable.name: state[variable.name] for variable in self._shared}
        rotation = lie.project_to_so3(np.mean([state[names[0]] for names in self._names], axis=0))
        translation = np.mean([state[names[1]] for names in self._names], axis=0)
        found = self.problem.escape({**shared, "rotation": rotation, "translation": translation})
        return None if found is None else self.spread(found)

    def score_covariance(self, state: State) -> FloatArray:
        """Covariance (n, n) of the gradient: noise of measurement, walk and priors.

        Rows take the absolute value of a segment's curvature. Where that differs from the curvature H itself,
        this is what makes the sandwich come out as ``H^-1 M H^-1`` all the same.
        """
        if self.static:
            return self.problem.score_covariance(state)
        forms, tied = self._forms(state), self._tied(state)[0]
        ties = tied.T @ tied
        rows = self._summed(ties, [_gram(f.rows(self.factors[k].offset)[0]) for k, f in enumerate(forms)])
        if self.problem.clock.correlation < SMALLEST_CORRELATION:
            # Robot and hand are not seen to turn together: nothing of the grasp is known but priors and walk.
            return np.asarray(rows @ np.linalg.inv(ties) @ rows)
        gain = rows @ floored_inverse(self._summed(ties, [form.matrix for form in forms]))
        return np.asarray(gain @ self._meat(state) @ gain.T)

    def describe_direction(self, variable: Variable, vector: FloatArray) -> str:
        """Words for a direction of an unknown, with the time of its segment."""
        name, _, number = variable.name.partition("_")
        if name not in _GRASP or not number:
            return self.problem.describe_direction(variable, vector)
        words = self.problem.describe_direction(self.model.variables[_GRASP.index(name)], vector)
        return f"{words} at {self.t[int(number)]:.1f} s"

    @property
    def advice(self) -> str:
        """What would inform the directions that are missing."""
        return self.problem.advice

    def view(self, estimate: Estimate) -> GraspTrack:
        """The grasp over time, with the whole time offset."""
        if self.static:
            return GraspTrack.from_pose(self.problem.view(estimate), self, estimate.values)
        shift = float(estimate.values["time_offset"][0]) if "time_offset" in estimate.values else 0.0
        return GraspTrack.from_estimate(estimate, self, self._names, self.problem.time_offset + shift)

    # ---- as a gtsam graph

    def factor_graph(self, _state: State | None = None) -> Any:
        """``gtsam.NonlinearFactorGraph``: one ``CustomFactor`` a segment, gtsam's own factors for the rest."""
        return self._graph.graph()

    def graph_values(self, state: State) -> Any:
        """A state as ``gtsam.Values``; see :mod:`factorgrasp.problems.grasp_segment_graph` for the keys."""
        return self._graph.values(lambda k: self.local(state, k))

    def graph_state(self, values: Any) -> State:
        """``gtsam.Values`` as a state."""
        read = [self._graph.keys.reader(k)(values) for k in range(self._graph.nodes)]
        out = {variable.name: read[0][variable.name] for variable in self._shared}
        for names, state in zip(self._names, read, strict=False):
            out.update({names[0]: state["rotation"], names[1]: state["translation"]})
        return {variable.name: out[variable.name] for variable in self.variables}

    def increments(self, start: State | None = None) -> Iterator[Increment]:
        """The graph segment by segment, for a smoother: ``(factors, new values, stamps)``.

        Factors are :class:`SegmentFactor` (whose ``hessian`` is to be made at the smoother's values) and gtsam's
        own. The values of a new segment are a function of the smoother's present ones: the grasp of the segment
        before. Stamps (s, robot clock) renew those of the shared unknowns.

        Parameters
        ----------
        start : mapping, optional
            State at whose first grasp and shared unknowns the first segment begins.
        """
        return self._graph.increments(self.graph_values(self._start if start is None else start))

    # ---- what other parts of the library read

    def with_walk(
        self, rotation_walk_sd: float = 1e-3, translation_walk_sd: float = 1e-3, static: bool = False
    ) -> GraspSegments:
        """The same segments with clocks and weights as they are now, not to be refined again, and another walk.

        What :attr:`GraspTrack.log_evidence` compares: ``solve(track.problem.with_walk(...)).log_evidence``.
        """
        walk = (self.problem, self.segment_seconds, rotation_walk_sd, translation_walk_sd, static)
        out = GraspSegments(*walk)
        out._final = True
        return out

    def node_keys(self, k: int) -> tuple[int, ...]:
        """The gtsam keys of the grasp that segment k sees: rotation and translation."""
        return self._graph.keys.of(k)[:2]

    def log_evidence(self, state: State) -> float:
        """Logarithm of the likelihood of the data with all unknowns integrated out (Laplace), at a solution.

        Up to a constant that is the same for every width of the walk, static included, as long as cut, weights
        and clocks are the same: the width that makes it largest is the one that the data speak for.
        """
        forms, (tied, residuals) = self._forms(state), self._tied(state)
        information = self._summed(tied.T @ tied, [form.matrix for form in forms])
        out = -0.5 * float(np.linalg.slogdet(information)[1]) - 0.5 * float(residuals @ residuals)
        for k, (factor, form) in enumerate(zip(self.factors, forms, strict=True)):
            out -= form.value + 0.5 * factor.slip_rate_evidence(self.local(state, k))
        if not self.static:
            steps = float(np.log(np.diff(self.t)).sum())
            width = float(np.log(self.rotation_walk_sd * self.translation_walk_sd))
            out -= 3.0 * (steps + (self.t.size - 1) * width)
        return out

    # ---- internals

    def _own_name(self, variable: Variable) -> str:
        """Name here of an unknown of the unsegmented problem, as the first segment sees it."""
        return self._names[0][_GRASP.index(variable.name)] if variable.name in _GRASP else variable.name

    def _make_variables(self) -> tuple[Variable, ...]:
        if self.static:
            return self.model.variables
        out = []
        for t, names in zip(self.t, self._names, strict=True):
            for whole, name in zip(self.model.variables[:2], names, strict=True):
                words = tuple(f"{label} at {t:.1f} s" for label in whole.labels)
                out.append(Variable(name, 3, whole.manifold, whole.unit, words, whole.resolution))
        return (*out, *self._shared)

    def _make_pattern(self) -> LeastSquares:
        count, rows = len(self.factors), self.model.size + 1
        pattern = {}
        for k, names in enumerate(self._names):
            own = np.zeros((count * rows, 3), dtype=bool)
            own[k * rows : (k + 1) * rows] = True
            pattern.update(dict.fromkeys(names, own))
        everything = tuple(variable.name for variable in self.variables)
        terms = [Term("moments", count * rows, everything, group=rows, pattern=pattern)]
        if count > 1:
            terms.append(self._walk_term("rotation walk", 0, self.rotation_walk_sd, "rad"))
            terms.append(self._walk_term("translation walk", 1, self.translation_walk_sd, "m"))
        for variable in self.model.variables:
            covariance = Covariance.diagonal(1.0 / self._precision[self.model.columns[variable.name]])
            name, own_name = f"prior of {variable.name}", self._own_name(variable)
            terms.append(Term(name, variable.size, (own_name,), covariance, unit=variable.unit))
        return LeastSquares(self.variables, terms)

    def _walk_term(self, name: str, which: int, sd: float, unit: str) -> Term:
        steps = np.diff(self.t)
        pattern = {}
        for k, names in enumerate(self._names):
            own = np.zeros((3 * steps.size, 3), dtype=bool)
            own[3 * max(k - 1, 0) : 3 * (k + 1)] = True
            pattern[names[which]] = own
        covariance = Covariance.diagonal(np.repeat(sd**2 * steps, 3))
        return Term(name, 3 * steps.size, tuple(pattern), covariance, group=3, pattern=pattern, unit=unit)

    def _fill_ties(self, state: State) -> LeastSquares:
        """The system with the values of the walk and the priors filled in."""
        if self._pattern is None:
            self._pattern = self._make_pattern()
        system, first = self._pattern, self.local(state, 0)
        for variable in self.model.variables:
            jacobian, value = prior_residual(variable, first, self.problem.prior)
            system.set_term(f"prior of {variable.name}", {self._own_name(variable): jacobian}, -value)
        if len(self.factors) > 1:
            self._fill_walk(system, state)
        return system

    def _fill_walk(self, system: LeastSquares, state: State) -> None:
        R = np.stack([state[rotation] for rotation, _ in self._names])
        p = np.stack([state[translation] for _, translation in self._names])
        turn = np.matmul(R[:-1].transpose(0, 2, 1), R[1:])
        vector = lie.so3_log(turn)
        after = lie.so3_right_jacobian_inverse(vector)
        before = -np.matmul(after, turn.transpose(0, 2, 1))
        eye = np.broadcast_to(np.eye(3), after.shape)
        for which, name, left, right, value in (
            (0, "rotation walk", before, after, vector),
            (1, "translation walk", -eye, eye, np.diff(p, axis=0)),
        ):
            blocks = {}
            for k, names in enumerate(self._names):
                parts = ([right[k - 1]] if k > 0 else []) + ([left[k]] if k < len(left) else [])
                blocks[names[which]] = np.concatenate(parts).ravel()
            system.set_term(name, blocks, -value.ravel())

    def _columns(self) -> list[IntArray]:
        """Columns of [rotation; translation; shared] of every segment."""
        where = slices(self.variables)
        every = np.arange(sum(v.size for v in self.variables))
        shared = [every[where[v.name]] for v in self._shared]
        return [np.concatenate([every[where[a]], every[where[b]], *shared]) for a, b in self._names]

    def _forms(self, state: State) -> list[Quadratic]:
        return [factor.quadratic(self.local(state, k)) for k, factor in enumerate(self.factors)]

    def _tied(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Whitened rows (m, n) and residuals (m,) of the walk and the priors."""
        system = self.problem.linearize(state) if self.static else self._fill_ties(state)
        ours = np.ones(system.jacobian.height, dtype=bool)
        for name in ("moments", "gyroscope", "accelerometer"):
            if name in system.terms:
                ours[system.jacobian.slices[name]] = False
        matrix, rhs = system.whitened()
        return matrix[ours].toarray(), -rhs[ours]

    def _summed(self, ties: FloatArray, parts: Sequence[FloatArray]) -> FloatArray:
        """Dense (n, n) sum of `ties` and of one matrix a segment, on [rotation; translation; shared]."""
        out = ties.copy()
        for columns, part in zip(self._columns(), parts, strict=True):
            out[np.ix_(columns, columns)] += part
        return out

    def _information(self, state: State) -> FloatArray:
        """Curvature of the whole cost (n, n)."""
        tied = self._tied(state)[0]
        return self._summed(tied.T @ tied, [form.matrix for form in self._forms(state)])

    def _meat(self, state: State) -> FloatArray:
        """Covariance of the gradient of the whole cost (n, n)."""
        tied = self._tied(state)[0]
        parts = [factor.score_covariance(self.local(state, k)) for k, factor in enumerate(self.factors)]
        return self._summed(tied.T @ tied, parts)

    def _again(self, problem: GraspPose, start: State | None) -> GraspSegments:
        out = copy.copy(self)
        out._refined = True
        out._pose(problem, start)
        return out

    def _refine_wandering(self, state: State) -> GraspSegments | None:
        """As :meth:`GraspPose.refine`, with every segment's own grasp."""
        shift = float(state["time_offset"][0]) if "time_offset" in state else 0.0
        moved = abs(shift) > SETTLED_OFFSET
        robust = make_loss(self.problem.settings.loss, self.problem.settings.loss_scale)
        enough = SETTLED_STEP if robust is None else SETTLED_ROBUST_STEP
        if not moved and self._refined and self._moved(state) < enough:
            return self._without_sensor_errors(state)
        cut = self._shifted(state, shift) if moved else self
        state = cut._start if moved else state
        base = cut.problem
        covariance = floored_inverse(cut._information(state))
        local = [cut.local(state, k) for k in range(len(cut.factors))]
        parts = [covariance[np.ix_(columns, columns)] for columns in cut._columns()]
        variances = band_variances(base, cut._label, cut.factors, local, parts)
        changed = variances.change_from(base._weights.variances) > SETTLED_WEIGHTS
        fresh, windows = copy.copy(base), base._forgetting()
        if robust is not None:
            trust = robust.weight(window_norms(base, cut._label, local, variances))
            if base._trust is not None and base._trust.size == trust.size:
                # Redescending losses otherwise hop between two sets of windows.
                trust = np.sqrt(trust * base._trust)
            before = 1.0 if base._weights.windows is None or moved else base._weights.windows
            fresh._trust, windows = trust, trust if windows is None else windows * trust
            changed |= bool(np.max(np.abs(windows - before)) > SETTLED_WEIGHTS)
        if not (moved or changed):
            return cut._without_sensor_errors(state)
        fresh._weights = GraspWeights(variances, windows, base._weights.time_offset)
        if robust is not None:
            fresh._moments = fresh._compress()
        return cut._again(fresh, state)

    def _moved(self, state: State) -> float:
        """Largest change of an unknown since the start, in standard deviations."""
        sd = np.sqrt(np.diag(floored_inverse(self._information(state))))
        step = np.concatenate([v.local(self._start[v.name], state[v.name]) for v in self.variables])
        return float(np.max(np.abs(step / sd)))

    def _shifted(self, state: State, shift: float) -> GraspSegments:
        """Bring the clocks together by `shift` (s); the state is carried over by time where gaps change the cut."""
        fresh = copy.copy(self.problem)
        offset = fresh._weights.time_offset + shift
        fresh._windows = fresh._couple(offset)
        fresh._weights = GraspWeights(fresh._weights.variances, fresh._forgetting(), offset)
        fresh._moments = fresh._compress()
        label = segment_labels(fresh._windows.t, self.segment_seconds)
        carried = {variable.name: state[variable.name] for variable in self._shared}
        carried["time_offset"] = np.zeros(1)
        for k in range(int(label[-1]) + 1):
            t = fresh._windows.t[label == k].mean()
            rotation, translation = self._names[int(np.argmin(np.abs(self.t - t)))]
            carried.update({f"rotation_{k}": state[rotation], f"translation_{k}": state[translation]})
        return self._again(fresh, carried)

    def _without_sensor_errors(self, state: State) -> GraspSegments | None:
        """The same problem less those sensor errors that turned out to be nothing; None when there are none."""
        base = self.problem
        if base.settings.sensor_errors != "auto" or base._pruned:
            return None
        bread = floored_inverse(self._information(state))
        drop = insignificant(self.variables, state, bread @ self._meat(state) @ bread)
        if not drop:
            return None
        fresh = copy.copy(base)
        fresh.model = GraspModel(*grasp_variables(base.noise, base.settings, drop | set(base.model.fixed)))
        fresh._pruned, fresh._pattern = True, None
        return self._again(fresh, state)


def _gram(A: FloatArray) -> FloatArray:
    return np.asarray(A.T @ A)


__all__ = ["MOST_SEGMENTS", "GraspSegments"]

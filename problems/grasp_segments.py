"""The grasp that may wander: one rotation and lever arm per segment of the recording, tied by a random walk (mathematics 2.4).

Every segment enters as one factor over its compressed moments. The problem runs on every solver of ours through `linearize`, on gtsam's
optimisers through its native graph, and segment by segment through `increments`, whose items any gtsam smoother takes. With ``static=True``
all segments share one rotation and one lever arm: the same problem as :class:`factorgrasp.problems.grasp_pose.GraspPose`, cut into factors.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate
from factorgrasp.least_squares import LeastSquares, Term
from factorgrasp.losses import make_loss
from factorgrasp.problems.grasp_model import GraspModel
from factorgrasp.problems.grasp_noise import LARGEST_DISAGREEMENT, PRIOR_DOF, BandVariances
from factorgrasp.problems.grasp_pose import SETTLED_OFFSET, SETTLED_WEIGHTS, GraspPose, GraspWeights
from factorgrasp.problems.grasp_segment_factor import SegmentFactor, SegmentMoments
from factorgrasp.problems.grasp_system import (
    grasp_variables,
    insignificant,
    positive_part,
    prior_precision,
    prior_residual,
)
from factorgrasp.problems.grasp_track import GraspTrack
from factorgrasp.problems.grasp_windows import Moments, compress
from factorgrasp.typing import BoolArray, FloatArray, IntArray, State
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable, retract, slices

MOST_SEGMENTS = 500
_GRASP = ("rotation", "translation")


class GraspSegments:
    """One grasp per segment of a recording.

    Parameters
    ----------
    problem : GraspPose
        The recording with its noise, settings and prior.
    segment_seconds : float
        s; at least one analysis window (``GraspSettings.window``).
    rotation_walk_sd : float
        rad/sqrt(s): standard deviation, about every axis, of how far the hand turns against the end-effector in one second.
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
        window = problem.settings.window
        if not (np.isfinite(segment_seconds) and segment_seconds >= window):
            raise InputError(
                "segment_seconds", f"at least one window of {window:.3g} s", repr(segment_seconds)
            )
        for name, value in (
            ("rotation_walk_sd", rotation_walk_sd),
            ("translation_walk_sd", translation_walk_sd),
        ):
            if not static and not (np.isfinite(value) and value > 0.0):
                raise InputError(
                    name,
                    "a finite number above zero",
                    repr(value),
                    "A grasp that cannot wander is static=True",
                )
        self.segment_seconds, self.static = float(segment_seconds), static
        self.rotation_walk_sd, self.translation_walk_sd = float(rotation_walk_sd), float(translation_walk_sd)
        self._start: State | None = None
        self._pose_problem(problem)

    def _pose_problem(self, problem: GraspPose) -> None:
        """Cut a recording, with the weights and clocks that it has now, into factors."""
        self.problem, self.model = problem, problem.model
        label = segment_labels(problem._windows.t, self.segment_seconds)
        count = int(label[-1]) + 1
        if count > MOST_SEGMENTS:
            raise InputError(
                "segment_seconds",
                f"at most {MOST_SEGMENTS} segments",
                f"{count}",
                "Take longer segments, or cut the recording",
            )
        self._label = label
        self._shared = self.model.variables[2:]
        names = (
            [("rotation", "translation")] * count
            if self.static
            else [(f"rotation_{k}", f"translation_{k}") for k in range(count)]
        )
        self._names = tuple(names)
        rate_variance = 0.0 if self.static else self.rotation_walk_sd**2 / self.segment_seconds
        self.factors = tuple(
            SegmentFactor(self.model, moments, rate_variance, self._keys(k), self._reader(k))
            for k, moments in enumerate(segment_moments(problem, label))
        )
        self.t = np.array([factor.moments.t for factor in self.factors])
        self.variables = self._make_variables()
        self._precision = prior_precision(self.model, problem.noise, problem.prior)
        self._pattern: LeastSquares | None = None

    # ---- the protocol of a nonlinear problem -----------------------------------------------------------------

    def initial_state(self) -> State:
        """Every segment at the grasp that the whole recording starts from."""
        if self._start is not None:
            return self._start
        return self.spread(self.problem.initial_state())

    def spread(self, state: State) -> State:
        """A state of the unsegmented problem (clock shift, not total offset), with its grasp in every segment."""
        out = {variable.name: np.asarray(state[variable.name]) for variable in self._shared}
        for names in self._names:
            out.update(zip(names, (state["rotation"], state["translation"]), strict=True))
        return {variable.name: out[variable.name] for variable in self.variables}

    def linearize(self, state: State) -> LeastSquares:
        """Rows of every segment's factor (see :meth:`Quadratic.rows`), of the walk and of the priors; summed when the grasp is static."""
        if self.static:
            return self.problem.linearize(state)
        if self._pattern is None:
            self._pattern = self._make_pattern()
        system = self._pattern
        rows = [factor.quadratic(self.local(state, k)).rows() for k, factor in enumerate(self.factors)]
        A, b = np.stack([row[0] for row in rows]), np.stack([row[1] for row in rows])
        blocks = {v.name: A[:, :, self.model.columns[v.name]].reshape(-1, v.size) for v in self._shared}
        for k, names in enumerate(self._names):
            for name, part in zip(names, (slice(0, 3), slice(3, 6)), strict=True):
                blocks[name] = A[k, :, part].ravel()
        system.set_term("moments", blocks, b.ravel())
        self._fill_walk(system, state)
        first = self.local(state, 0)
        for variable in self.model.variables:
            name = f"prior of {variable.name}"
            if name in system.terms:
                jacobian, value = prior_residual(variable, first, self.problem.prior)
                own = dict(zip(_GRASP, self._names[0], strict=True)).get(variable.name, variable.name)
                system.set_term(name, {own: jacobian}, -value)
        return system

    def retract(self, state: State, step: FloatArray) -> State:
        """Move the state by a tangent step (n,)."""
        return retract(self.variables, state, step)

    def refine(self, state: State) -> GraspSegments | None:
        """The problem with clocks shifted, bands re-weighted and needless sensor errors dropped; None when settled."""
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
        if self._start is not None:
            return None
        shared = {variable.name: state[variable.name] for variable in self._shared}
        rotation = lie.project_to_so3(np.mean([state[names[0]] for names in self._names], axis=0))
        translation = np.mean([state[names[1]] for names in self._names], axis=0)
        found = self.problem.escape({**shared, "rotation": rotation, "translation": translation})
        return None if found is None else self.spread(found)

    def score_covariance(self, state: State) -> FloatArray:
        """Covariance (n, n) of the gradient: noise of measurement, walk and priors.

        Rows take the absolute value of a segment's curvature H. Where that differs from H, this is what makes the sandwich come out as
        ``H^-1 M H^-1`` all the same.
        """
        if self.static:
            return self.problem.score_covariance(state)
        rows, information, meat = self._information(state)
        gain = rows @ np.linalg.inv(information)
        return np.asarray(gain @ meat @ gain.T)

    def describe_direction(self, variable: Variable, vector: FloatArray) -> str:
        """Words for a direction of a rotation or a lever arm, with the time of its segment."""
        name, _, number = variable.name.partition("_")
        if name not in _GRASP:
            return self.problem.describe_direction(variable, vector)
        words = self.problem.describe_direction(self.model.variables[_GRASP.index(name)], vector)
        return f"{words} at {self.t[int(number)]:.1f} s" if number else words

    @property
    def advice(self) -> str:
        """What would inform the directions that are missing."""
        return self.problem.advice

    def view(self, estimate: Estimate) -> GraspTrack:
        """The grasp over time, with the whole time offset."""
        if self.static:
            return GraspTrack.from_pose(self.problem.view(estimate), float(self.t.mean()))
        shift = float(estimate.values["time_offset"][0]) if "time_offset" in estimate.values else 0.0
        return GraspTrack.from_estimate(
            estimate, self.t, self._names, self.problem.time_offset + shift, self._numbers
        )

    # ---- as a gtsam graph ------------------------------------------------------------------------------------

    def factor_graph(self, _state: State | None = None) -> Any:
        """``gtsam.NonlinearFactorGraph``: one ``CustomFactor`` a segment, the walk and the priors as gtsam's own factors."""
        import gtsam

        graph = gtsam.NonlinearFactorGraph()
        for factor in self.factors:
            graph.push_back(factor.custom())
        for k in range(1, len(self.factors)):
            for factor in self._walk_factors(k):
                graph.push_back(factor)
        for factor in self._prior_factors():
            graph.push_back(factor)
        return graph

    def graph_values(self, state: State) -> Any:
        """A state as ``gtsam.Values``: ``r<k>`` (Rot3) and ``p<k>`` (vector) of every segment, ``c0`` with all shared unknowns."""
        import gtsam

        values = gtsam.Values()
        for k, (rotation, translation) in enumerate(self._names[:1] if self.static else self._names):
            values.insert(gtsam.symbol("r", k), gtsam.Rot3(np.asarray(state[rotation])))
            values.insert(gtsam.symbol("p", k), np.asarray(state[translation], dtype=float))
        if self._shared:
            values.insert(gtsam.symbol("c", 0), np.concatenate([state[v.name] for v in self._shared]))
        return values

    def graph_state(self, values: Any) -> State:
        """``gtsam.Values`` as a state."""
        local = [self._reader(k)(values) for k in range(1 if self.static else len(self.factors))]
        out = {v.name: local[0][v.name] for v in self._shared}
        for names, state in zip(self._names, local, strict=False):
            out.update({names[0]: state["rotation"], names[1]: state["translation"]})
        return {variable.name: out[variable.name] for variable in self.variables}

    def increments(self, start: State | None = None) -> Iterator[tuple[list[Any], Any, dict[int, float]]]:
        """The graph segment by segment, for a smoother: ``(factors, new values, stamps)``.

        Factors are :class:`SegmentFactor` (a Hessian factor to be made at the smoother's values) and gtsam factors. Values of a new
        segment are a function of the smoother's present ones: the grasp of the segment before. Stamps (s, robot clock) renew those of the
        shared unknowns.

        Parameters
        ----------
        start : mapping, optional
            State at whose first grasp and shared unknowns the first segment begins.
        """
        import gtsam

        first = self.graph_values(self.initial_state() if start is None else start)
        for k, factor in enumerate(self.factors):
            factors: list[Any] = [factor, *(self._prior_factors() if k == 0 else self._walk_factors(k))]
            new: Any = gtsam.Values()
            if k == 0:
                for key in factor.keys:
                    _insert_from(first, key, key, new)
            elif not self.static:
                new = self._continuation(k)
            yield factors, new, {key: float(self.t[k]) for key in factor.keys}

    def _continuation(self, k: int) -> Any:
        import gtsam

        def values(known: Any) -> Any:
            out = gtsam.Values()
            for letter in "rp":
                _insert_from(known, gtsam.symbol(letter, k - 1), gtsam.symbol(letter, k), out)
            return out

        return values

    def _keys(self, k: int) -> tuple[int, ...]:
        """Symbols as gtsam packs them (the letter in the highest byte), without importing it."""
        index = 0 if self.static else k
        keys = tuple((ord(letter) << 56) + index for letter in "rp")
        return (*keys, ord("c") << 56) if self._shared else keys

    def _reader(self, k: int) -> Any:
        keys = self._keys(k)
        where = {
            v.name: slice(c.start - 6, c.stop - 6)
            for v, c in ((v, self.model.columns[v.name]) for v in self._shared)
        }

        def read(values: Any) -> dict[str, FloatArray]:
            out = {"rotation": values.atRot3(keys[0]).matrix(), "translation": values.atVector(keys[1])}
            if where:
                shared = values.atVector(keys[2])
                out.update({name: shared[part] for name, part in where.items()})
            return out

        return read

    def _walk_factors(self, k: int) -> list[Any]:
        """What ties segment k to the one before; nothing when the grasp is static."""
        if self.static:
            return []
        import gtsam

        root = float(np.sqrt(self.t[k] - self.t[k - 1]))
        turn = gtsam.noiseModel.Isotropic.Sigma(3, self.rotation_walk_sd * root)
        way = gtsam.noiseModel.Isotropic.Sigma(3, self.translation_walk_sd * root)
        before, after = self._keys(k - 1), self._keys(k)
        return [
            gtsam.BetweenFactorRot3(before[0], after[0], gtsam.Rot3(), turn),
            gtsam.BetweenFactorVector(before[1], after[1], np.zeros(3), way),
        ]

    def _prior_factors(self) -> list[Any]:
        import gtsam

        prior, keys = self.problem.prior, self._keys(0)
        out = [
            gtsam.PriorFactorVector(
                keys[1], prior.translation, gtsam.noiseModel.Isotropic.Sigma(3, prior.translation_sd)
            )
        ]
        if prior.rotation is not None:
            model = gtsam.noiseModel.Isotropic.Sigma(3, prior.rotation_sd)
            out.append(gtsam.PriorFactorRot3(keys[0], gtsam.Rot3(prior.rotation), model))
        if self._shared:
            precision = self._precision[6:]
            model = gtsam.noiseModel.Diagonal.Precisions(precision)
            out.append(gtsam.PriorFactorVector(keys[2], np.zeros(precision.size), model))
        return out

    # ---- what other parts of the library read ----------------------------------------------------------------

    def local(self, state: State, k: int) -> State:
        """The values that segment k sees, under the names of the unsegmented problem."""
        rotation, translation = self._names[k]
        shared = {v.name: state[v.name] for v in self._shared}
        return {"rotation": state[rotation], "translation": state[translation], **shared}

    def log_evidence(self, state: State) -> float:
        """Logarithm of the likelihood of the data with all unknowns integrated out (Laplace), at a solution.

        Up to a constant that is the same for every width of the walk, static included, as long as cut and band weights are the same: the
        width that makes it largest is the one that the data speak for.
        """
        _, information, _ = self._information(state)
        out = -0.5 * float(np.linalg.slogdet(information)[1])
        for k, factor in enumerate(self.factors):
            local = self.local(state, k)
            out -= factor.quadratic(local).value + 0.5 * factor.slip_rate_evidence(local)
        system = self.linearize(state)
        residuals = system.residuals(np.zeros(system.size))[_tying_rows(system)]
        out -= 0.5 * float(residuals @ residuals)
        if not self.static:
            steps = np.log(np.diff(self.t)).sum()
            out -= 3.0 * (
                steps + (self.t.size - 1) * np.log(self.rotation_walk_sd * self.translation_walk_sd)
            )
        return out

    # ---- internals -------------------------------------------------------------------------------------------

    def _again(self, problem: GraspPose, start: State | None) -> GraspSegments:
        out = copy.copy(self)
        out._start = start
        out._pose_problem(problem)
        return out

    def _make_variables(self) -> tuple[Variable, ...]:
        rotation, translation = self.model.variables[:2]
        if self.static:
            return self.model.variables
        out = []
        for k, t in enumerate(self.t):
            for whole, name in zip((rotation, translation), self._names[k], strict=True):
                words = tuple(f"{label} at {t:.1f} s" for label in whole.labels)
                out.append(Variable(name, 3, whole.manifold, whole.unit, words, whole.resolution))
        return (*out, *self._shared)

    def _make_pattern(self) -> LeastSquares:
        count, rows = len(self.factors), self.model.size + 1
        names = tuple(variable.name for variable in self.variables)
        pattern = {}
        for k, (rotation, translation) in enumerate(self._names):
            own = np.zeros((count * rows, 3), dtype=bool)
            own[k * rows : (k + 1) * rows] = True
            pattern[rotation] = pattern[translation] = own
        walks = []
        if count > 1:
            walks = [
                self._walk_term("rotation walk", 0, self.rotation_walk_sd, "rad"),
                self._walk_term("translation walk", 1, self.translation_walk_sd, "m"),
            ]
        terms = [Term("moments", count * rows, names, group=rows, pattern=pattern), *walks]
        for variable in self.model.variables:
            values = self._precision[self.model.columns[variable.name]]
            if values[0] > 0.0:
                own_name = dict(zip(_GRASP, self._names[0], strict=True)).get(variable.name, variable.name)
                covariance = Covariance.diagonal(1.0 / values)
                terms.append(
                    Term(
                        f"prior of {variable.name}",
                        variable.size,
                        (own_name,),
                        covariance,
                        unit=variable.unit,
                    )
                )
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

    def _fill_walk(self, system: LeastSquares, state: State) -> None:
        if len(self.factors) < 2:
            return
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

    def _information(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Information (n, n) as the rows have it and as it is, and the covariance of the gradient; dense."""
        system = self.linearize(state)
        matrix, _ = system.whitened()
        rows = (matrix.T @ matrix).toarray()
        tied = matrix[_tying_rows(system)]
        information = (tied.T @ tied).toarray()
        meat = information.copy()
        for k, columns in enumerate(self._columns()):
            local = self.local(state, k)
            where = np.ix_(columns, columns)
            information[where] += self.factors[k].quadratic(local).matrix
            meat[where] += self.factors[k].score_covariance(local)
        return rows, information, meat

    @property
    def _numbers(self) -> FloatArray:
        return np.array([factor.moments.numbers for factor in self.factors])

    def _refine_wandering(self, state: State) -> GraspSegments | None:
        """As :meth:`GraspPose.refine`, with every segment's own grasp."""
        shift = float(state["time_offset"][0]) if "time_offset" in state else 0.0
        moved = abs(shift) > SETTLED_OFFSET
        cut = self._shifted(state, shift) if moved else self
        state = cut.initial_state() if moved else state
        base = cut.problem
        covariance = np.linalg.inv(cut._information(state)[1])
        variances = cut._band_variances(state, covariance)
        windows = base._forgetting()
        changed = variances.change_from(base._weights.variances) > SETTLED_WEIGHTS
        robust = make_loss(base.settings.loss, base.settings.loss_scale)
        if robust is not None:
            trust = robust.weight(cut._window_norms(state, variances))
            windows = trust if windows is None else windows * trust
            before = 1.0 if base._weights.windows is None or moved else base._weights.windows
            changed |= bool(np.max(np.abs(windows - before)) > SETTLED_WEIGHTS)
        if not (moved or changed):
            return cut._without_sensor_errors(state)
        fresh = copy.copy(base)
        fresh._weights = GraspWeights(variances, windows, base._weights.time_offset)
        if robust is not None:
            fresh._moments = fresh._compress()
        return cut._again(fresh, state)

    def _shifted(self, state: State, shift: float) -> GraspSegments:
        """The clocks brought together by `shift` (s), and the state carried over by time, where gaps made other segments of it."""
        fresh = copy.copy(self.problem)
        offset = fresh._weights.time_offset + shift
        fresh._windows = fresh._couple(offset)
        fresh._weights = GraspWeights(fresh._weights.variances, fresh._forgetting(), offset)
        fresh._moments = fresh._compress()
        out = self._again(fresh, None)
        carried = {variable.name: state[variable.name] for variable in self._shared}
        carried["time_offset"] = np.zeros(1)
        for t, names in zip(out.t, out._names, strict=True):
            nearest = self._names[int(np.argmin(np.abs(self.t - t)))]
            carried.update({new: state[old] for new, old in zip(names, nearest, strict=True)})
        out._start = {variable.name: carried[variable.name] for variable in out.variables}
        return out

    def _without_sensor_errors(self, state: State) -> GraspSegments | None:
        """The same problem less those sensor errors that turned out to be nothing; None when there are none to drop."""
        base = self.problem
        if base.settings.sensor_errors != "auto" or base._pruned:
            return None
        _, information, meat = self._information(state)
        bread = np.linalg.inv(information)
        drop = insignificant(self.variables, state, bread @ meat @ bread)
        if not drop:
            return None
        fresh = copy.copy(base)
        fresh.model = GraspModel(*grasp_variables(base.noise, base.settings, drop))
        fresh._pruned, fresh._pattern = True, None
        out = self._again(fresh, None)
        out._start = {variable.name: state[variable.name] for variable in out.variables}
        return out

    def _band_variances(self, state: State, covariance: FloatArray) -> BandVariances:
        """Residual power of every band as :func:`grasp_noise.estimated_variances`, with every segment's own grasp."""
        base = self.problem
        moments = _cut_moments(base, self._label)
        dof = moments.dof.sum(axis=0)
        powers, spreads = np.zeros((2, dof.size)), np.zeros((2, dof.size))
        for k, columns in enumerate(self._columns()):
            part = self.factors[k].band_powers(
                self.local(state, k),
                covariance[np.ix_(columns, columns)],
                moments.gyro[k],
                moments.accelerometer[k],
            )
            powers += part[0]
            spreads += part[1]
        current, declared = base._weights.variances, base.declared
        trusted = powers[0] <= LARGEST_DISAGREEMENT * np.einsum("bkii->k", moments.gyro[:, :, 0:3, 0:3])
        if not base.settings.adapt_noise:
            return BandVariances(declared.gyro, declared.accelerometer, trusted)
        taken = np.minimum(spreads * np.stack(current.weights) / (3.0 * dof), 0.75)
        prior = np.stack([declared.gyro, declared.accelerometer])
        found = (powers + PRIOR_DOF * prior) / (3.0 * dof * (1.0 - taken) + PRIOR_DOF)
        # Where a free grasp takes most of what a band holds, more power frees more of it: without damping the weights swing to and fro.
        present = np.stack([current.gyro, current.accelerometer])
        gyro, accelerometer = present * (found / present) ** (1.0 - 0.5 * taken)
        return BandVariances(gyro, accelerometer, trusted)

    def _window_norms(self, state: State, variances: BandVariances) -> FloatArray:
        """As :meth:`GraspPose._window_norms`, with every segment's own grasp, (windows,)."""
        windows = self.problem._windows
        out = np.zeros(windows.t.size)
        L = [self.model.matrices(self.local(state, k)) for k in range(len(self.factors))]
        for side, (z, variance) in enumerate(
            ((windows.gyro, variances.gyro), (windows.accelerometer, variances.accelerometer))
        ):
            total = np.empty(windows.t.size)
            for k, matrices in enumerate(L):
                own = self._label == k
                power = np.sum((z[own] @ matrices[side].T) ** 2, axis=(2, 3)) / variance
                total[own] = power.sum(axis=1)
            out += total / max(float(np.median(total)), 1e-300)
        return np.asarray(np.sqrt(0.5 * out))


def segment_labels(t: FloatArray, seconds: float) -> IntArray:
    """Segment of every window centre t (ascending), (windows,): 0, 1, ... without those that hold no window."""
    place = np.floor((t - t[0]) / seconds + 1e-9)
    return np.asarray(np.unique(place, return_inverse=True)[1], dtype=np.intp)


def segment_moments(problem: GraspPose, label: IntArray) -> list[SegmentMoments]:
    """Weighted moments of every segment, less the expected noise; they add up to ``problem.corrected_moments()``.

    Where the whole recording's moments are indefinite, so that the unsegmented problem takes their positive part, every segment takes
    its share of the difference.
    """
    moments = _cut_moments(problem, label)
    variances, expected = problem._weights.variances, problem._expected
    share = moments.dof.sum(axis=1) / moments.dof.sum()
    t = problem._windows.t
    trusted = np.count_nonzero(variances.trusted) / variances.trusted.size
    parts = []
    for weight, every, squared, noise, whole in (
        (
            variances.weights[0],
            moments.gyro,
            moments.gyro_squared,
            expected.gyro,
            problem.corrected_moments()[0],
        ),
        (
            variances.weights[1],
            moments.accelerometer,
            moments.accelerometer_squared,
            expected.accelerometer,
            problem.corrected_moments()[1],
        ),
    ):
        Z = np.tensordot(every, weight, axes=(1, 0))
        score = np.tensordot(every if squared is None else squared, weight, axes=(1, 0))
        if problem.settings.errors_in_variables:
            Z = Z - np.tensordot(moments.dof * weight, noise, axes=(1, 0))
        root = positive_part(whole)
        Z = Z + share[:, None, None] * (root @ root.T - whole)
        parts.append((Z, score))
    return [
        SegmentMoments(
            t=float(t[label == k].mean()),
            gyro=parts[0][0][k],
            accelerometer=parts[1][0][k],
            gyro_score=parts[0][1][k],
            accelerometer_score=parts[1][1][k],
            numbers=3.0 * (1.0 + trusted) * float(moments.dof[k].sum()),
        )
        for k in range(moments.dof.shape[0])
    ]


def _cut_moments(problem: GraspPose, label: IntArray) -> Moments:
    windows = problem._windows
    return compress(
        problem._grid.windowing, windows.gyro, windows.accelerometer, label, problem._weights.windows
    )


def _tying_rows(system: LeastSquares) -> BoolArray:
    """Rows of the walk and the priors."""
    out = np.ones(system.jacobian.height, dtype=bool)
    for name in ("moments", "gyroscope", "accelerometer"):
        if name in system.terms:
            out[system.jacobian.slices[name]] = False
    return out


def _insert_from(source: Any, key: int, name: int, target: Any) -> None:
    """Copy one value of ``gtsam.Values`` under another key: ``r`` is a rotation, the rest are vectors."""
    if key >> 56 == ord("r"):
        target.insert(name, source.atRot3(key))
    else:
        target.insert(name, source.atVector(key))


__all__ = ["GraspSegments", "segment_labels", "segment_moments"]

"""Fixed-lag smoothing of a growing gtsam graph: ``gtsam.IncrementalFixedLagSmoother`` for any sequence of increments.

An increment is ``(factors, new values, stamps)``. Factors are gtsam's own, or *quadratic factors*: objects that
make a Hessian factor at given values. Those enter without a callback into Python and are made again where their
variables have moved; their curvature may be indefinite as long as that of all factors together is not. Stamps
say when a variable was last alive: one that is older than the lag is marginalised, so variables that all
increments share (biases) must be stamped by each of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from factorgrasp.errors import NotSolvedError
from factorgrasp.typing import FloatArray

# Step of all variables together, in their own units, that counts as none.
_STILL = 1e-9
_TYPES = ("Vector", "Rot3", "Pose3", "Point3", "Point2", "Rot2", "Pose2", "Double")


@runtime_checkable
class QuadraticFactor(Protocol):
    """A cost that is handed to gtsam as its second-order model, made again where the values have moved.

    Attributes
    ----------
    keys : tuple of int
    """

    keys: tuple[int, ...]

    def hessian(self, values: Any) -> Any:
        """``gtsam.HessianFactor`` of the cost around ``gtsam.Values``."""
        ...


@dataclass(frozen=True)
class Posterior:
    """What is known of some variables at some moment.

    Attributes
    ----------
    values : tuple of ndarray
        Of every variable: vectors, or matrices of rotations and poses.
    covariance : (n, n) ndarray
        Joint, in gtsam's tangent coordinates, variables one after another.
    """

    values: tuple[FloatArray, ...]
    covariance: FloatArray


@dataclass(frozen=True)
class FixedLagTrack:
    """Estimates of one node an increment.

    Attributes
    ----------
    t : (K,) ndarray
        Stamp of every node when it was new.
    newest : tuple of Posterior or None
        As soon as the node's increment was in; None where the increments so far did not determine it.
    lagged : tuple of Posterior or None
        With the measurements of the lag that followed (all there were, at the end of the sequence).
    seconds : (K,) ndarray
        Time that every increment took, its covariances included.
    """

    t: FloatArray
    newest: tuple[Posterior | None, ...]
    lagged: tuple[Posterior | None, ...]
    seconds: FloatArray


@dataclass
class _Record:
    """A quadratic factor in the smoother: its slot, where it was linearised, and its curvature's diagonal."""

    factor: QuadraticFactor
    slot: int
    point: Any
    diagonal: FloatArray


class FixedLagSmoother:
    """A smoother that takes increments one by one.

    Parameters
    ----------
    lag : float
        s (or whatever the stamps are in); infinite keeps everything.
    relinearize : float
        A quadratic factor is made again when a variable of it has moved by this many standard deviations of its own information.
    threshold : float
        Step beyond which gtsam's own factors are linearised again, in the units of the variables.

    Attributes
    ----------
    held : int
        Increments that wait because what is in does not determine all variables.
    """

    def __init__(self, lag: float = np.inf, relinearize: float = 0.1, threshold: float = 1e-4) -> None:
        self.lag, self.relinearize, self.threshold = float(lag), float(relinearize), float(threshold)
        self._records: list[_Record] = []
        self._waiting: list[tuple[Sequence[Any], Any, Mapping[int, float]]] = []
        self._types: dict[int, str] = {}
        self._smoother = self._empty()
        self._values: Any = self._smoother.calculateEstimate()

    @property
    def held(self) -> int:
        """Increments that wait for more."""
        return len(self._waiting)

    @property
    def values(self) -> Any:
        """Present estimate of all variables within the lag, ``gtsam.Values``."""
        return self._values

    def update(self, factors: Iterable[Any], values: Any, stamps: Mapping[int, float]) -> bool:
        """Add factors and variables, and drop variables whose stamp is older than the lag.

        Parameters
        ----------
        factors : iterable
            gtsam factors and quadratic factors.
        values : gtsam.Values or callable
            Of the new variables; or a function that makes them from the values known so far.
        stamps : mapping
            Stamp of every variable that is new or still alive.

        Returns
        -------
        bool
            False when the factors so far do not determine all variables: the increment then waits for the next.
        """
        known = self._known()
        fresh = values(known) if callable(values) else values
        self._waiting.append((list(factors), fresh, dict(stamps)))
        known.insert(fresh)
        if not self._feed(known):
            return False
        self._waiting = []
        return True

    def settle(self, tolerance: float = 1e-6, most: int = 20) -> int:
        """Update without new factors until nothing is away from where it was linearised, and nothing moves.

        Parameters
        ----------
        tolerance : float
            Distance of a quadratic factor that counts as none, in standard deviations of its own information. What
            it leaves in the estimate is of second order.
        most : int
            Updates.

        Returns
        -------
        int
            Updates that it took.

        Raises
        ------
        NotSolvedError
            When it has not settled after `most` updates.
        """
        import gtsam

        for count in range(most):
            before = self._values
            stale = self._stale(tolerance)
            self._apply([], gtsam.Values(), {}, [], stale, self._values)
            if not stale and before.localCoordinates(self._values).norm() <= _STILL:
                return count + 1
        raise NotSolvedError(f"the smoother has not settled after {most} updates")

    def posterior(self, keys: Sequence[int]) -> Posterior:
        """Estimate and joint covariance of some variables."""
        covariance = self._smoother.getISAM2().jointMarginalCovariance(list(keys)).fullMatrix()
        return Posterior(tuple(self._read(key) for key in keys), np.asarray(covariance))

    def has(self, keys: Sequence[int]) -> bool:
        """Whether all these variables are within the lag and determined."""
        return all(self._values.exists(key) for key in keys)

    # ---- internals

    def _empty(self) -> Any:
        import gtsam

        params = gtsam.ISAM2Params()
        # Curvature that is indefinite in a single factor passes through Cholesky, not through QR.
        params.setFactorization("CHOLESKY")
        params.relinearizeSkip = 1
        params.setRelinearizeThreshold(self.threshold)
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        params.findUnusedFactorSlots = True
        return gtsam.IncrementalFixedLagSmoother(self.lag, params)

    def _known(self) -> Any:
        """The present estimate, and the first values of variables that wait."""
        import gtsam

        out = gtsam.Values(self._values)
        for _, fresh, _ in self._waiting:
            out.insert(fresh)
        return out

    def _feed(self, known: Any) -> bool:
        """All increments that wait, at once."""
        import gtsam

        new = gtsam.Values()
        stamps: dict[int, float] = {}
        native: list[Any] = []
        quadratics: list[QuadraticFactor] = []
        for factors, fresh, alive in self._waiting:
            new.insert(fresh)
            stamps.update(alive)
            for factor in factors:
                (quadratics if isinstance(factor, QuadraticFactor) else native).append(factor)
        return self._apply(native, new, stamps, quadratics, self._stale(self.relinearize), known)

    def _apply(
        self,
        native: Sequence[Any],
        new: Any,
        stamps: Mapping[int, float],
        quadratics: Sequence[QuadraticFactor],
        stale: Sequence[_Record],
        at: Any,
    ) -> bool:
        """One update of gtsam's smoother; without effect, and False, when the system is not determined."""
        import gtsam

        graph = gtsam.NonlinearFactorGraph()
        for factor in native:
            graph.push_back(factor)
        fresh = [self._record(factor, at) for factor in (*quadratics, *(record.factor for record in stale))]
        for _, hessian in fresh:
            graph.push_back(gtsam.LinearContainerFactor(hessian, at))
        # The wrapper hands out references to what the update changes: copy.
        factors = gtsam.NonlinearFactorGraph(self._smoother.getFactors())
        before = factors, gtsam.Values(self._smoother.getLinearizationPoint()), self._smoother.timestamps()
        try:
            result = self._smoother.update(graph, new, dict(stamps), [record.slot for record in stale])
        except RuntimeError as error:
            if "ndetermina" not in str(error):
                raise
            self._restore(*before)
            return False
        slots = self._smoother.getISAM2Result().getNewFactorsIndices()[len(native) :]
        for (record, _), slot in zip(fresh, slots, strict=True):
            record.slot = slot
        old = [record for record in self._records if not any(record is other for other in stale)]
        gone = set(result.getDeletedFactorIndices())
        self._records = [r for r in (*old, *(record for record, _ in fresh)) if r.slot not in gone]
        self._values = self._smoother.calculateEstimate()
        return True

    def _restore(self, factors: Any, point: Any, stamps: Mapping[int, float]) -> None:
        """A smoother as it was before an update that failed half-way."""
        import gtsam

        graph, place = gtsam.NonlinearFactorGraph(), {}
        for slot in range(factors.size()):
            factor = factors.at(slot)
            if factor is None:
                continue
            if isinstance(factor, gtsam.LinearContainerFactor):
                # What gtsam marginalised holds only at its own linearisation point, which it does not name.
                factor = gtsam.LinearContainerFactor(factor.linearize(point), point)
            place[slot] = graph.size()
            graph.push_back(factor)
        self._smoother = self._empty()
        if graph.size():
            self._smoother.update(graph, point, dict(stamps))
            slots = self._smoother.getISAM2Result().getNewFactorsIndices()
            for record in self._records:
                record.slot = slots[place[record.slot]]
            self._values = self._smoother.calculateEstimate()

    def _record(self, factor: QuadraticFactor, at: Any) -> tuple[_Record, Any]:
        hessian = factor.hessian(at)
        point = self._pick(at, factor.keys)
        return _Record(factor, -1, point, np.abs(np.diag(hessian.information()))), hessian

    def _stale(self, step: float) -> list[_Record]:
        """Quadratic factors whose variables have moved by more than `step` standard deviations of their information."""
        out = []
        for record in self._records:
            keys = record.factor.keys
            moved = record.point.localCoordinates(self._pick(self._values, keys))
            vector = np.concatenate([moved.at(key) for key in keys])
            if float(np.max(record.diagonal * vector**2)) > step**2:
                out.append(record)
        return out

    def _pick(self, values: Any, keys: Sequence[int]) -> Any:
        import gtsam

        out = gtsam.Values()
        for key in keys:
            out.insert(key, self._at(values, key))
        return out

    def _read(self, key: int) -> FloatArray:
        value = self._at(self._values, key)
        return np.asarray(value.matrix() if hasattr(value, "matrix") else value, dtype=float)

    def _at(self, values: Any, key: int) -> Any:
        """One value of whatever type it is; gtsam's wrapper has a reader for each."""
        if key in self._types:
            return getattr(values, self._types[key])(key)
        for name in _TYPES:
            try:
                value = getattr(values, f"at{name}")(key)
            except RuntimeError:
                continue
            self._types[key] = f"at{name}"
            return value
        raise NotSolvedError(
            f"the value of {key} has a type that the smoother cannot read: one of {', '.join(_TYPES)}"
        )


def smooth(
    increments: Iterable[tuple[Iterable[Any], Any, Mapping[int, float]]],
    nodes: Callable[[int], Sequence[int]],
    smoother: FixedLagSmoother,
) -> FixedLagTrack:
    """Feed increments to a smoother and keep the estimate of one node of each.

    Parameters
    ----------
    increments : iterable
        ``(factors, new values, stamps)``; see :meth:`FixedLagSmoother.update`.
    nodes : callable
        Keys of the node that belongs to increment k; the stamp of the first is its time.
    smoother : FixedLagSmoother
    """
    times: list[float] = []
    newest: list[Posterior | None] = []
    lagged: list[Posterior | None] = []
    seconds: list[float] = []
    waiting: list[int] = []
    for k, (factors, values, stamps) in enumerate(increments):
        started = time.perf_counter()
        keys = nodes(k)
        now = max(stamps.values())
        times.append(stamps[keys[0]])
        # What leaves with this increment is read before: gtsam forgets it in the update.
        leaving = [i for i in waiting if times[i] < now - smoother.lag]
        for i in leaving:
            lagged[i] = _posterior(smoother, nodes(i))
        waiting = [i for i in waiting if i not in leaving] + [k]
        lagged.append(None)
        newest.append(_posterior(smoother, keys) if smoother.update(factors, values, stamps) else None)
        seconds.append(time.perf_counter() - started)
    if not smoother.held:
        smoother.settle()
    for i in waiting:
        lagged[i] = _posterior(smoother, nodes(i))
    return FixedLagTrack(np.array(times), tuple(newest), tuple(lagged), np.array(seconds))


def _posterior(smoother: FixedLagSmoother, keys: Sequence[int]) -> Posterior | None:
    return smoother.posterior(keys) if smoother.has(keys) else None

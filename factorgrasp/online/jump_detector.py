"""Has the grasp changed? Log Bayes factors of a change in (R, r) at several times back and of several sizes (mathematics 2.3).

Second moments of short segments say what the newest seconds ask for; snapshots of the running estimate say what was known before each
of them. With ``g, H`` the gradient and Gauss-Newton matrix of the segments since a start, ``P`` the covariance of the snapshot taken at
that start and ``u = g + H mu`` the gradient at its mean, a jump ``d ~ N(0, D)`` of the grasp shows through

    W = E' (I + H P)^-1 H E,   q = -E' (I + H P)^-1 u       (E picks rotation and translation)
    log p(segments | jump) / p(segments | none) = 1/2 q' (D^-1 + W)^-1 q - 1/2 log det(I + D W)     for known noise

so the uncertainty of the estimate before and of the biases, which a jump leaves alone, is accounted for. The noise level is not taken as
known: the residual power of the very segments under test decides, through the Student factor of an unknown common variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factorgrasp.online.row_history import RowHistory
from factorgrasp.typing import FloatArray, IntArray

GRASP = 6
# Segments since a change at which it is looked for; all of them begin after it.
STARTS = (1, 2, 3, 4, 6, 8, 12, 17, 24, 34, 48, 68, 96, 125)
# Windows overlap by half: two of them may straddle a change, and belong to neither side.
GUARD = 2
REACH = STARTS[-1] + GUARD
# Sizes of a change, as multiples of 10 deg and 70 mm.
_SCALES = np.array([3.0, 1.0, 0.3, 0.1, 0.03])
_UNIT = np.repeat([np.deg2rad(10.0), 0.07], 3)
# The level of the noise is known beforehand as if from this many residuals.
_PRIOR_RESIDUALS = 60.0
# Whitened residual power of a single segment that is worth a test at once.
_LOUD = 2.0


@dataclass(frozen=True)
class Jump:
    """The best explanation of the newest segments by a change of the grasp.

    Attributes
    ----------
    segments : int
        How many segments lie wholly after it.
    log_bayes_factor : float
        Against no change, with the noise level of the segments since the start: it must convince, also where the noise has just
        become louder.
    evidence : float
        The same with one noise level for all segments held, so that starts and kinds of change can be compared.
    step : (6,) ndarray
        Posterior mean [rotation; translation] of the change, right perturbation of R.
    covariance : (6, 6) ndarray
    """

    segments: int
    log_bayes_factor: float
    evidence: float
    step: FloatArray
    covariance: FloatArray


class JumpDetector:
    """Segments and snapshots of the last seconds, and the test on them.

    Parameters
    ----------
    size : int
        Unknowns of the model.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._segments = RowHistory(REACH, 2 + size + size**2)
        self._snapshots = RowHistory(REACH, size + size**2)

    def add_segments(
        self,
        times: FloatArray,
        costs: FloatArray,
        gradients: FloatArray,
        informations: FloatArray,
        residuals: float,
    ) -> None:
        """Costs (S,), gradients (S, n), Gauss-Newton matrices (S, n, n) at the reference state of segments that end at `times` (S,).

        `residuals` is the number of independent residuals of each.
        """
        count = times.size
        rows = np.column_stack([costs, np.full(count, residuals), gradients, informations.reshape(count, -1)])
        self._segments.append(times, rows, False)

    def add_snapshot(self, time: float, mean: FloatArray, covariance: FloatArray) -> None:
        """Estimate relative to the reference state (n,) and its covariance (n, n) from data up to `time`."""
        self._snapshots.append(np.array([time]), np.concatenate([mean, covariance.ravel()])[None], False)

    def forget_segments(self) -> None:
        """Before the segments are given again for another reference state or other weights."""
        self._segments.run = 0

    def forget(self) -> None:
        """Before another grasp."""
        self._segments.run = self._snapshots.run = 0

    def move(self, shift: FloatArray) -> None:
        """The reference state moved by a tangent step (n,); segments and snapshots follow, to first order."""
        n = self.size
        self._snapshots.last(self._snapshots.kept)[:, :n] -= shift
        rows = self._segments.last(self._segments.kept)
        turned = rows[:, 2 + n :].reshape(-1, n, n) @ shift
        rows[:, 0] += (rows[:, 2 : 2 + n] + 0.5 * turned) @ shift
        rows[:, 2 : 2 + n] += turned

    def widened(self, where: IntArray, size: int, variances: FloatArray) -> JumpDetector:
        """The same for a model of `size` unknowns: those of this one stand at `where`, new ones have prior `variances` (size,)."""
        out = JumpDetector(size)
        n, count = self.size, self._snapshots.kept
        for time, row in zip(self._snapshots.last_times(count), self._snapshots.last(count), strict=True):
            mean, covariance = np.zeros(size), np.diag(variances)
            mean[where] = row[:n]
            covariance[np.ix_(where, where)] = row[n:].reshape(n, n)
            out.add_snapshot(float(time), mean, covariance)
        return out

    def starts(self, candidates: Sequence[int] = STARTS) -> list[int]:
        """Starts for which there is a snapshot."""
        # The newest snapshot was taken after the segment before the newest.
        known = min(self._segments.kept, self._snapshots.kept) - GUARD
        return [k for k in candidates if k <= known]

    def snapshot(self, segments: int) -> tuple[float, FloatArray, FloatArray]:
        """Time, mean (n,) and covariance (n, n) of the estimate before a change that the newest `segments` follow."""
        back = segments + GUARD
        row = self._snapshots.last(back)[0]
        return (
            float(self._snapshots.last_times(back)[0]),
            row[: self.size],
            row[self.size :].reshape(self.size, self.size),
        )

    def loud(self) -> bool:
        """Whether the newest segment fits much worse than the noise lets expect."""
        if not self._segments.kept:
            return False
        cost, count = self._segments.last(1)[0, :2]
        return bool(2.0 * cost > _LOUD * count)

    def jumps(self, starts: list[int], give: FloatArray) -> list[Jump]:
        """The best jump for every start, beyond changes with variances `give` (6,) that are none."""
        n = self.size
        rows = self._segments.last(starts[-1])[::-1]
        sums = np.cumsum(np.add.reduceat(rows, [0, *starts[:-1]], axis=0), axis=0)
        cost, count, g, H = sums[:, 0], sums[:, 1], sums[:, 2 : 2 + n], sums[:, 2 + n :].reshape(-1, n, n)
        cross, own = H[:, :, :GRASP], H[:, :GRASP, :GRASP]
        data = Segments(starts, cost, count, *self._known(starts, give), g, H, g[:, :GRASP], cross, own)
        return explain(data, *self._older(starts))

    def shapes(self, give: FloatArray) -> tuple[Jump, Jump]:
        """The best jump and the best steady drift on the same segments, all that are held; `step` is how far they have come.

        A jump half way in a window counts as a part of it; the windows beside it are shared out 3 to 1.
        """
        n, count = self.size, self.starts(range(1, STARTS[-1] + 1))[-1]
        rows = self._segments.last(count + GUARD)[::-1]
        g, H = rows[:, 2 : 2 + n], rows[:, 2 + n :].reshape(-1, n, n)
        back = np.arange(count + GUARD)
        k = np.arange(1, count + 1)[:, None]
        jumps = np.interp(back - k, [-1.0, 0.0, 1.0, 2.0], [1.0, 0.75, 0.25, 0.0])
        u = np.concatenate([jumps, np.maximum(1.0 - (back + 0.5) / k, 0.0)])
        mean, P = self._known([count], give)
        S = u.shape[0]

        def same(x: FloatArray) -> FloatArray:
            return np.broadcast_to(x, (S, *x.shape))

        data = Segments(
            [*range(1, count + 1)] * 2,
            same(rows[:, 0].sum()),
            same(rows[:, 1].sum()),
            same(mean[0]),
            same(P[0]),
            same(g.sum(axis=0)),
            same(H.sum(axis=0)),
            u @ g[:, :GRASP],
            np.tensordot(u, H[:, :, :GRASP], 1),
            np.tensordot(u**2, H[:, :GRASP, :GRASP], 1),
        )
        found = explain(data, np.zeros(S), np.zeros(S))
        first, second = found[:count], found[count:]
        return max(first, key=lambda jump: jump.evidence), max(second, key=lambda jump: jump.evidence)

    def _known(self, starts: list[int], give: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = self._snapshots.last(starts[-1] + GUARD)[::-1][np.array(starts) + GUARD - 1]
        P = rows[:, self.size :].reshape(-1, self.size, self.size)
        P[:, range(GRASP), range(GRASP)] += give
        return rows[:, : self.size], P

    def _older(self, starts: list[int]) -> tuple[FloatArray, FloatArray]:
        """Cost and number of residuals (S,) of the segments held that end before each start."""
        rows = self._segments.last(self._segments.kept)[::-1, :2]
        sums = np.cumsum(rows, axis=0)
        older = sums[-1] - sums[np.array(starts) + GUARD - 1]
        return older[:, 0], older[:, 1]


class Segments(NamedTuple):
    """Sums over the segments since each of S starts, and what was known before them.

    Attributes
    ----------
    starts : list of int
    cost, residuals : (S,) ndarray
        Cost at the reference state, and number of residuals.
    mean, covariance : (S, n) and (S, n, n) ndarray
        Estimate before, relative to the reference state.
    gradient, information : (S, n) and (S, n, n) ndarray
        Of the unknowns before the change.
    change_gradient, cross, change_information : (S, 6), (S, n, 6) and (S, 6, 6) ndarray
        Of the change.
    """

    starts: list[int]
    cost: FloatArray
    residuals: FloatArray
    mean: FloatArray
    covariance: FloatArray
    gradient: FloatArray
    information: FloatArray
    change_gradient: FloatArray
    cross: FloatArray
    change_information: FloatArray


def explain(data: Segments, older_cost: FloatArray, older_count: FloatArray) -> list[Jump]:
    """Evidence for a change since each start; `older_cost` and `older_count` (S,) are those of the segments before."""
    mean, P, g, H = data.mean, data.covariance, data.gradient, data.information
    n = g.shape[1]
    Hm = np.matmul(H, mean[:, :, None])[:, :, 0]
    u = g + Hm
    B = np.matmul(H, P)
    B[:, np.arange(n), np.arange(n)] += 1.0
    # (P^-1 + H)^-1 = P (I + H P)^-1
    solved = np.matmul(P, np.linalg.solve(B, np.concatenate([u[:, :, None], data.cross], axis=2)))
    rss = 2.0 * data.cost + np.sum((2.0 * g + Hm) * mean, axis=1) - np.sum(u * solved[:, :, 0], axis=1)
    rss = np.maximum(rss, 0.0)
    turned = data.cross.transpose(0, 2, 1)
    pulled = np.matmul(turned, np.stack([mean, solved[:, :, 0]], axis=2))
    q = -(data.change_gradient + pulled[:, :, 0] - pulled[:, :, 1])
    W = data.change_information - np.matmul(turned, solved[:, :, 1:])
    values, vectors = np.linalg.eigh(_UNIT[:, None] * (0.5 * (W + W.transpose(0, 2, 1))) * _UNIT)
    values = np.maximum(values, 0.0)
    y = np.matmul((_UNIT * q)[:, None, :], vectors)[:, 0, :]
    square = (_SCALES**2)[:, None, None]
    gain = square / (1.0 + square * values)
    drop = np.sum(gain * y**2, axis=2)
    occam = 0.5 * np.sum(np.log1p(square * values), axis=2)
    factor = _student(_PRIOR_RESIDUALS + rss, drop, _PRIOR_RESIDUALS + data.residuals) - occam
    before, level = _PRIOR_RESIDUALS + 2.0 * older_cost + rss, _PRIOR_RESIDUALS + older_count + data.residuals
    evidence = _student(before, drop, level) - occam
    best = np.argmax(evidence, axis=0)
    out = []
    for s, k in enumerate(data.starts):
        b = best[s]
        axes = _UNIT[:, None] * vectors[s]
        left = (_PRIOR_RESIDUALS + rss[s] - drop[b, s]) / (_PRIOR_RESIDUALS + data.residuals[s])
        covariance = max(1.0, float(left)) * (axes * gain[b, s]) @ axes.T
        out.append(
            Jump(k, float(factor[b, s]), float(evidence[b, s]), axes @ (gain[b, s] * y[s]), covariance)
        )
    return out


def _student(before: FloatArray, drop: FloatArray, count: FloatArray) -> FloatArray:
    """Log likelihood ratio of `count` residuals of unknown common variance whose sum of squares `before` a change lowers by `drop`."""
    after = np.maximum(before - drop, 1e-3 * before)
    return np.asarray(0.5 * count * np.log(before / after))

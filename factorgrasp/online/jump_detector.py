"""Has the grasp changed? Log Bayes factors of a jump in (R, r) at several times back and of several sizes (mathematics 2.3).

Second moments of short segments (0.1 s apart) say what the newest seconds ask for; snapshots of the running estimate say what was known before each of
them. With ``g, H`` the gradient and Gauss-Newton matrix of the segments since a start, ``P`` the covariance of the snapshot taken at that start and ``u = g + H mu`` the
gradient at its mean, a jump ``d ~ N(0, D)`` of the grasp has evidence through

    W = E' (I + H P)^-1 H E,   q = -E' (I + H P)^-1 u       (E picks rotation and translation)
    log p(segments | jump) / p(segments | none) = 1/2 q' (D^-1 + W)^-1 q - 1/2 log det(I + D W)     for known noise

so the uncertainty of the estimate before and of the biases, which the jump leaves alone, is accounted for. The noise level is not taken as
known: the residual power of the very segments under test decides, through the Student factor of an unknown common variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgrasp.online.row_history import RowHistory
from factorgrasp.typing import FloatArray

GRASP = 6
# Segments back at which a jump may have begun.
STARTS = (1, 2, 3, 4, 6, 8, 11, 15, 20, 27, 36, 50)
# Sizes of a jump, as multiples of 10 deg and 70 mm.
SCALES = (3.0, 1.0, 0.3, 0.1, 0.03)
_UNIT = np.repeat([np.deg2rad(10.0), 0.07], 3)
# The level of the noise is known beforehand as if from this many residuals.
_PRIOR_RESIDUALS = 60.0


@dataclass(frozen=True)
class Jump:
    """The best explanation of the newest segments by a change of the grasp.

    Attributes
    ----------
    segments : int
        How many segments back it began.
    log_bayes_factor : float
    step : (6,) ndarray
        Posterior mean [rotation; translation] of the change, right perturbation of R.
    covariance : (6, 6) ndarray
    """

    segments: int
    log_bayes_factor: float
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
        self._segments = RowHistory(STARTS[-1] + 1, 2 + size + size**2)
        self._snapshots = RowHistory(STARTS[-1] + 1, size + size**2)

    def add_segment(self, time: float, cost: float, gradient: FloatArray, information: FloatArray, residuals: float) -> None:
        """Cost, gradient (n,), Gauss-Newton matrix (n, n) at the reference state of a segment that ends at `time`, and its number of residuals."""
        row = np.concatenate([[cost, residuals], gradient, information.ravel()])
        self._segments.append(np.array([time]), row[None], self._segments.run == 0)

    def add_snapshot(self, time: float, mean: FloatArray, covariance: FloatArray) -> None:
        """Estimate relative to the reference state (n,) and its covariance (n, n) from data up to `time`."""
        self._snapshots.append(np.array([time]), np.concatenate([mean, covariance.ravel()])[None], self._snapshots.run == 0)

    def test(self) -> list[Jump]:
        """The best jump for every start that has a snapshot, newest start first."""
        n = self.size
        # The newest snapshot was taken after the newest segment; one `k` segments back is the (k + 1)-th newest.
        known = min(self._segments.kept, self._snapshots.kept - 1)
        starts = [k for k in STARTS if k <= known]
        if not starts:
            return []
        rows = self._segments.last(starts[-1])[::-1]
        sums = np.cumsum(np.add.reduceat(rows, [0, *starts[:-1]], axis=0), axis=0)
        snapshots = self._snapshots.last(starts[-1] + 1)[::-1][starts]
        mean, P = snapshots[:, :n], snapshots[:, n:].reshape(-1, n, n)
        cost, count, g, H = sums[:, 0], sums[:, 1], sums[:, 2 : 2 + n], sums[:, 2 + n :].reshape(-1, n, n)
        Hm = np.matmul(H, mean[:, :, None])[:, :, 0]
        u = g + Hm
        B = np.matmul(H, P)
        B[:, np.arange(n), np.arange(n)] += 1.0
        solved = np.linalg.solve(B, np.concatenate([u[:, :, None], H[:, :, :GRASP]], axis=2))
        explained = np.einsum("si,sij,sj->s", u, P, solved[:, :, 0])
        rss = 2.0 * cost + np.sum((2.0 * g + Hm) * mean, axis=1) - explained
        q, W = -solved[:, :GRASP, 0], solved[:, :GRASP, 1:]
        values, vectors = np.linalg.eigh(_UNIT[:, None] * (0.5 * (W + W.transpose(0, 2, 1))) * _UNIT)
        values = np.maximum(values, 0.0)
        y = np.matmul((_UNIT * q)[:, None, :], vectors)[:, 0, :]
        square = np.square(SCALES)[:, None, None]
        gain = square / (1.0 + square * values)  # (scales, starts, 6)
        drop = np.sum(gain * y**2, axis=2)
        occam = 0.5 * np.sum(np.log1p(square * values), axis=2)
        level = _PRIOR_RESIDUALS + count
        before = _PRIOR_RESIDUALS + np.maximum(rss, 0.0)
        after = np.maximum(before - drop, 1e-3 * before)
        factor = 0.5 * level * np.log(before / after) - occam
        best = np.argmax(factor, axis=0)
        out = []
        for s, k in enumerate(starts):
            shrink = gain[best[s], s]
            basis = _UNIT[:, None] * vectors[s]
            noise = max(1.0, float(after[best[s], s] / level[s]))
            out.append(
                Jump(k, float(factor[best[s], s]), basis @ (shrink * y[s]), noise * (basis * shrink) @ basis.T)
            )
        return out

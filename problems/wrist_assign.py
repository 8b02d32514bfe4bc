"""Which blob is which marker: joint compatibility, global assignment, and the paper's blob by blob (Cordella 2014, equations 7 to 12).

All three score a blob given to a marker by its predicted density in (u, v, z) against the density of clutter,
``N(r; 0, S) p_d / ((1 - p_d) c)``, ``c`` blobs of clutter per pixel and metre (mathematics 5.1, 5.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from factorgrasp.problems.wrist_settings import Method
from factorgrasp.typing import BoolArray, FloatArray, IntArray

DEPTH_RANGE = 1.0
"""m over which the depth of clutter is taken to be spread."""
BEAM = 48
_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Markers as they are expected in a frame.

    Attributes
    ----------
    uvz : (n, 3) ndarray
    J : (n, 3, 6) ndarray
        By the pose, which all markers share.
    pose : (6, 6) ndarray
        Covariance of the pose, given the layout.
    own : (n, 3, 3) ndarray
        Covariance of what is each marker's own: what the layout's uncertainty leaves.
    """

    uvz: FloatArray
    J: FloatArray
    pose: FloatArray
    own: FloatArray

    @property
    def total(self) -> FloatArray:
        """(n, 3, 3) covariance of every marker by itself, without the blob's noise."""
        return np.asarray(self.J @ self.pose @ np.swapaxes(self.J, 1, 2) + self.own)

    @property
    def pixel_sd(self) -> float:
        """Largest standard deviation of a marker's pixel."""
        total = self.total
        return float(np.sqrt(np.max(np.linalg.eigvalsh(total[:, :2, :2]), initial=0.0)))


@dataclass(frozen=True, eq=False)
class Assignment:
    """Which marker (0..n-1, or -1) every blob is.

    Attributes
    ----------
    marker : (m,) ndarray of int
    score : float
        Logarithm of how much more probable it is than that all blobs are clutter.
    margin : float
        By how much it beats the second best, where that was looked for; infinite otherwise.
    """

    marker: IntArray
    score: float
    margin: float = np.inf

    @property
    def count(self) -> int:
        """Markers that were found."""
        return int(np.count_nonzero(self.marker >= 0))


@dataclass(frozen=True)
class Rates:
    """Probability that a marker is seen, and clutter a frame, with the image they are spread over."""

    detection: float
    clutter: float
    pixels: float

    def reward(self, deep: FloatArray) -> FloatArray:
        """Logarithm of ``p_d / ((1 - p_d) c)`` for blobs with (1) or without (0) depth."""
        per_pixel = max(self.clutter, 0.02) / self.pixels
        odds = self.detection / (1.0 - self.detection)
        return np.asarray(np.log(odds) - np.log(per_pixel) + deep * np.log(DEPTH_RANGE))


def assign(
    method: Method, predicted: Prediction, uvz: FloatArray, covariance: FloatArray, rates: Rates, gate: float
) -> Assignment:
    """Assign blobs (m, 3) with covariances (m, 3, 3), NaN where a depth is missing (or is not to be used), to the predicted markers."""
    blobs, markers = uvz.shape[0], predicted.uvz.shape[0]
    nobody = np.full(blobs, -1, dtype=np.intp)
    if blobs == 0:
        return Assignment(nobody, 0.0)
    deep = np.isfinite(covariance[:, 2, 2]) & np.isfinite(uvz[:, 2])
    distance, logdet = _distances(predicted, uvz, covariance, deep)
    limits = np.where(deep, _limit(gate, 3), _limit(gate, 2))
    inside = distance <= limits[:, None]
    if not inside.any():
        return Assignment(nobody, 0.0)
    reward = rates.reward(deep.astype(float))
    gain = reward[:, None] - 0.5 * (distance + logdet + np.where(deep, 3.0, 2.0)[:, None] * _LOG_2PI)
    gain = np.where(inside, gain, -np.inf)
    if method == "blob":
        return _blob_by_blob(gain)
    if method == "assignment":
        return _global(gain, markers)
    return _joint(predicted, uvz, covariance, deep, inside, reward)


@cache
def _limit(gate: float, rows: int) -> float:
    return float(chi2.ppf(gate, rows))


def _distances(
    predicted: Prediction, uvz: FloatArray, covariance: FloatArray, deep: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis distance (m, n) of every blob to every marker, and the logarithm of the covariance's determinant."""
    r = np.where(np.isfinite(uvz), uvz, 0.0)[:, None] - predicted.uvz[None]
    S = predicted.total[None] + np.where(np.isfinite(covariance), covariance, 0.0)[:, None]
    shallow = ~deep
    if shallow.any():
        S[shallow, :, 2, :] = S[shallow, :, :, 2] = 0.0
        S[shallow, :, 2, 2] = 1.0
        r[shallow, :, 2] = 0.0
    solved = np.linalg.solve(S, r[..., None])[..., 0]
    distance = np.einsum("mni,mni->mn", r, solved)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    return distance, np.log(np.linalg.det(S))


def _blob_by_blob(gain: FloatArray) -> Assignment:
    """Every blob takes its most probable marker; of two for one marker the better one stays."""
    out = np.full(gain.shape[0], -1, dtype=np.intp)
    score = 0.0
    best = np.argmax(gain, axis=1)
    value = gain[np.arange(gain.shape[0]), best]
    for j in np.unique(best[value > 0.0]):
        rows = np.flatnonzero((best == j) & (value > 0.0))
        i = int(rows[np.argmax(value[rows])])
        out[i] = j
        score += float(value[i])
    return Assignment(out, score)


def _global(gain: FloatArray, markers: int) -> Assignment:
    """The assignment of largest total gain; leaving a blob out gains nothing."""
    blobs = gain.shape[0]
    table = np.zeros((blobs, markers + blobs))
    table[:, :markers] = np.where(np.isfinite(gain), gain, -1e9)
    rows, columns = linear_sum_assignment(table, maximize=True)
    out = np.full(blobs, -1, dtype=np.intp)
    real = (columns < markers) & (table[rows, columns] > 0.0)
    out[rows[real]] = columns[real]
    return Assignment(out, float(table[rows[real], columns[real]].sum()))


def _joint(
    predicted: Prediction,
    uvz: FloatArray,
    covariance: FloatArray,
    deep: BoolArray,
    inside: BoolArray,
    reward: FloatArray,
) -> Assignment:
    """The most probable joint assignment: markers one by one, the best `BEAM` hypotheses kept.

    All markers of a frame share the error of the predicted pose. A pair adds ``H'R^-1 H`` and ``H'R^-1 r`` to a 6 x 6 system, so the
    joint density of a whole hypothesis is a small determinant and a small solve.
    """
    blobs, markers = inside.shape
    i, j = np.nonzero(inside)
    lower = np.linalg.cholesky(predicted.pose + 1e-16 * np.eye(6))
    R = np.where(np.isfinite(covariance[i]), covariance[i], 0.0) + predicted.own[j]
    shallow = ~deep[i]
    R[shallow, 2, :] = R[shallow, :, 2] = 0.0
    R[shallow, 2, 2] = 1.0
    r = np.where(np.isfinite(uvz[i]), uvz[i], 0.0) - predicted.uvz[j]
    H = predicted.J[j] @ lower
    H[shallow, 2] = 0.0
    r[shallow, 2] = 0.0
    root = np.linalg.cholesky(R)
    white = np.linalg.solve(root, np.concatenate([H, r[:, :, None]], axis=2))
    Hw, rw = white[:, :, :6], white[:, :, 6]
    A = np.swapaxes(Hw, 1, 2) @ Hw
    b = (np.swapaxes(Hw, 1, 2) @ rw[:, :, None])[:, :, 0]
    logdet = 2.0 * np.log(np.einsum("kii->ki", root)).sum(axis=1)
    constant = reward[i] - 0.5 * (
        np.einsum("ki,ki->k", rw, rw) + logdet + np.where(deep[i], 3.0, 2.0) * _LOG_2PI
    )
    plain = _unrivalled(i, j, A, b, constant, blobs, markers)
    if plain is not None:
        return plain
    order = [m for m in np.argsort(np.bincount(j, minlength=markers), kind="stable") if np.any(j == m)]
    beam = _Beam(blobs)
    for marker in order:
        beam.extend(marker, np.flatnonzero(j == marker), i, A, b, constant)
    return beam.best(blobs)


def _scores(A: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Logarithms of the joint odds of hypotheses from their sums."""
    M = A + np.eye(6)
    solved = np.linalg.solve(M, b[:, :, None])[:, :, 0]
    return np.asarray(c + 0.5 * np.einsum("ki,ki->k", b, solved) - 0.5 * np.log(np.linalg.det(M)))


def _unrivalled(
    i: IntArray, j: IntArray, A: FloatArray, b: FloatArray, c: FloatArray, blobs: int, markers: int
) -> Assignment | None:
    """All pairs together, where no two share a blob or a marker and none is better left out: the usual frame."""
    if np.bincount(i).max() > 1 or np.bincount(j).max() > 1:
        return None
    whole = np.concatenate([[A.sum(axis=0)], A.sum(axis=0) - A])
    score = _scores(
        whole, np.concatenate([[b.sum(axis=0)], b.sum(axis=0) - b]), np.append(c.sum(), c.sum() - c)
    )
    if score[0] < score.max():
        return None
    out = np.full(blobs, -1, dtype=np.intp)
    out[i] = j
    return Assignment(out, float(score[0]), float(score[0] - score[1:].max()))


class _Beam:
    """Hypotheses with their sums, best first."""

    def __init__(self, blobs: int) -> None:
        self.A: FloatArray = np.zeros((1, 6, 6))
        self.b: FloatArray = np.zeros((1, 6))
        self.c: FloatArray = np.zeros(1)
        self.used: BoolArray = np.zeros((1, blobs), dtype=bool)
        self.owner: IntArray = np.full((1, blobs), -1, dtype=np.intp)
        self.score: FloatArray = np.zeros(1)

    def extend(
        self, marker: int, pairs: IntArray, blob: IntArray, A: FloatArray, b: FloatArray, constant: FloatArray
    ) -> None:
        """Every hypothesis goes on without the marker, and with each of its free blobs."""
        parent, which = np.nonzero(~self.used[:, blob[pairs]])
        pair = pairs[which]
        newA, newb, newc = self.A[parent] + A[pair], self.b[parent] + b[pair], self.c[parent] + constant[pair]
        score = _scores(newA, newb, newc)
        everything = np.concatenate([self.score, score])
        kept = np.argsort(-everything, kind="stable")[:BEAM]
        stays, grows = kept[kept < self.score.size], kept[kept >= self.score.size] - self.score.size
        owner = self.owner[parent[grows]].copy()
        used = self.used[parent[grows]].copy()
        rows = np.arange(grows.size)
        owner[rows, blob[pair[grows]]] = marker
        used[rows, blob[pair[grows]]] = True
        self.A = np.concatenate([self.A[stays], newA[grows]])
        self.b = np.concatenate([self.b[stays], newb[grows]])
        self.c = np.concatenate([self.c[stays], newc[grows]])
        self.owner = np.concatenate([self.owner[stays], owner])
        self.used = np.concatenate([self.used[stays], used])
        self.score = np.concatenate([self.score[stays], score[grows]])

    def best(self, blobs: int) -> Assignment:
        order = np.argsort(-self.score, kind="stable")
        margin = float(self.score[order[0]] - self.score[order[1]]) if order.size > 1 else np.inf
        return Assignment(self.owner[order[0]], float(self.score[order[0]]), margin)

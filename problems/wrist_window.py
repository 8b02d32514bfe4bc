"""Fixed-lag smoothing of the wrist: Gauss-Newton over the nodes of the last frames, with what is older in a quadratic prior.

The same terms as the whole problem (:mod:`factorgrasp.problems.wrist_model`). Unknowns stand as ``[layout (3n or 0), node 0, ...]``;
a node that leaves is eliminated at its last linearisation, exactly as a graph's fixed-lag smoother does.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import lapack

from factorgrasp import lie
from factorgrasp.losses import inlier_weight
from factorgrasp.models.camera import Camera
from factorgrasp.problems.wrist_model import (
    NODE_SIZE,
    Pairs,
    motion_root,
    motion_rows,
    predict,
    process_covariance,
    retract,
    transition,
)
from factorgrasp.problems.wrist_settings import Motion
from factorgrasp.typing import FloatArray, IntArray

_SMALL_STEP = 0.6
"""Length of the step of all unknowns together, in standard deviations, after which no other is made: steps shrink by
about six, so a tenth is left over a hundred unknowns, and the next frame goes on."""
_MOST_STEPS = 4


@dataclass
class Prior:
    """Quadratic prior on the layout and the first node: ``1/2 d' information d - vector' d`` around a point."""

    R: FloatArray
    x: FloatArray
    layout: FloatArray
    information: FloatArray
    vector: FloatArray


@dataclass(frozen=True, eq=False)
class Leaving:
    """A node as it leaves the window, smoothed by all that followed within the lag.

    Attributes
    ----------
    R, x : ndarray
    covariance : (D, D) ndarray
    with_layout : (D, 3n or 0) ndarray
        Covariance with the layout.
    transition_chi2, transition_freedom : (2,) ndarray
        How the step to the next node compares with its assumed variance, for [rotation, translation]: squared normalised residual, and
        the value expected of it.
    """

    R: FloatArray
    x: FloatArray
    covariance: FloatArray
    with_layout: FloatArray
    transition_chi2: FloatArray
    transition_freedom: FloatArray


@dataclass
class Window:
    """Nodes of the last frames.

    Parameters
    ----------
    camera : Camera
    layout : (n, 3) ndarray
        Markers in W, m: the values now.
    layout_prior : (3n, 3n) ndarray or None
        Information of the layout; None: it is not estimated.
    motion : {"acceleration", "jerk"}
    densities : (2,) ndarray
        Spectral densities [rotation, translation].
    lag : int
    loss_scale : float
    """

    camera: Camera
    layout: FloatArray
    layout_prior: FloatArray | None
    motion: Motion
    densities: FloatArray
    lag: int
    loss_scale: float
    t: list[float] = field(default_factory=list)
    pairs: list[Pairs] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.size = NODE_SIZE[self.motion]
        self.shared = 0 if self.layout_prior is None else self.layout.size
        self.R: FloatArray = np.empty((0, 3, 3))
        self.x: FloatArray = np.empty((0, self.size - 3))
        self.prior: Prior | None = None
        self._roots: list[FloatArray] = []
        self._layout_information = (
            np.zeros((0, 0)) if self.layout_prior is None else np.array(self.layout_prior)
        )
        self._layout_mean = self.layout.copy()
        self.covariance_newest: FloatArray = np.empty((0, 0))
        self.weights: FloatArray = np.empty(0)
        self.left = float("nan")
        # Blobs as good as their covariance says should count in full, so that the covariance of the pose is honest.
        self._inlier_scale = 1.0 / inlier_weight(self.loss_scale) if np.isfinite(self.loss_scale) else 1.0
        self._joined: tuple[IntArray, Pairs | None, IntArray]

    def __len__(self) -> int:
        return len(self.t)

    def start(self, t: float, R: FloatArray, p: FloatArray, pose_sd: FloatArray, rate_sd: FloatArray) -> None:
        """Begin afresh at one node whose pose (6 sd) is hardly known and whose velocities are within ``rate_sd`` of zero.

        What was learnt of the layout is kept.
        """
        x = np.zeros(self.size - 3)
        x[:3] = p
        kept_information, kept_vector, kept_mean = self._layout_knowledge()
        n = self.shared + self.size
        information = np.zeros((n, n))
        information[: self.shared, : self.shared] = kept_information
        spread = np.concatenate([pose_sd, rate_sd])[: self.size]
        information[np.arange(self.shared, n), np.arange(self.shared, n)] = 1.0 / spread**2
        vector = np.zeros(n)
        vector[: self.shared] = kept_vector
        self.prior = Prior(R.copy(), x.copy(), kept_mean, information, vector)
        self.t, self.pairs, self._roots = [t], [_no_pairs()], []
        self.R, self.x = R[None].copy(), x[None].copy()
        self.covariance_newest = np.asarray(np.linalg.inv(information))

    def _layout_knowledge(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Marginal information, information vector and linearisation point of the layout, from all there is in the window."""
        if not self.shared:
            return np.zeros((0, 0)), np.zeros(0), self.layout.copy()
        if self.prior is None:
            return self._layout_information, np.zeros(self.shared), self._layout_mean
        self._join()
        H, g = self._normal_equations()
        k = self.shared
        gain = np.linalg.solve(H[k:, k:], np.concatenate([H[k:, :k], g[k:, None]], axis=1))
        information = H[:k, :k] - H[:k, k:] @ gain[:, :k]
        vector = g[:k] - H[:k, k:] @ gain[:, k]
        return 0.5 * (information + information.T), vector, self.layout.copy()

    # ---- one frame

    def predicted(self, t: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Newest node moved to time `t`: R, x and the joint covariance of [layout, node]."""
        dt = t - self.t[-1]
        R, x, F = transition(self.R[-1], self.x[-1], dt, self.motion)
        k = self.shared
        P = self.covariance_newest
        out = np.empty_like(P)
        out[:k, :k] = P[:k, :k]
        out[:k, k:] = P[:k, k:] @ F.T
        out[k:, :k] = out[:k, k:].T
        out[k:, k:] = F @ P[k:, k:] @ F.T + process_covariance(dt, self.densities, self.motion)
        return R, x, out

    def push(
        self, t: float, pairs: Pairs, R: FloatArray | None = None, x: FloatArray | None = None
    ) -> Leaving | None:
        """Add a frame at its predicted pose (or at `R`, `x`), smooth, and let the oldest node go when the lag is full."""
        if R is None or x is None:
            R, x, _ = self.predicted(t)
        self._roots.append(motion_root(np.array([t - self.t[-1]]), self.densities, self.motion)[0])
        self.t.append(t)
        self.pairs.append(pairs)
        self.R = np.concatenate([self.R, R[None]])
        self.x = np.concatenate([self.x, x[None]])
        self._smooth()
        return self._leave() if len(self.t) > self.lag + 1 else None

    def refresh(self, pairs: Pairs) -> None:
        """Replace the newest frame's pairs and smooth again."""
        self.pairs[-1] = pairs
        self._smooth()

    def place(self, t: float) -> int | None:
        """Where a late frame belongs: the index of the node after it; None when it is older than the window or has a node's own time."""
        if not self.t or t <= self.t[0] or t >= self.t[-1] or t in self.t:
            return None
        return int(np.searchsorted(self.t, t))

    def between(self, t: float) -> tuple[FloatArray, FloatArray]:
        """A node between two others, from the one before it."""
        k = int(np.searchsorted(self.t, t))
        R, x, _ = transition(self.R[k - 1], self.x[k - 1], t - self.t[k - 1], self.motion)
        return R, x

    def insert(self, t: float, pairs: Pairs) -> Leaving | None:
        """Put a late frame between two nodes, smooth, and let the oldest node go when the lag is full."""
        k = self.place(t)
        assert k is not None
        R, x = self.between(t)
        steps = np.array([t - self.t[k - 1], self.t[k] - t])
        self._roots[k - 1 : k] = list(motion_root(steps, self.densities, self.motion))
        self.t.insert(k, t)
        self.pairs.insert(k, pairs)
        self.R = np.insert(self.R, k, R, axis=0)
        self.x = np.insert(self.x, k, x, axis=0)
        self._smooth()
        return self._leave() if len(self.t) > self.lag + 1 else None

    # ---- linear algebra

    def _normal_equations(self) -> tuple[FloatArray, FloatArray]:
        """Information matrix and vector of the window at the present point."""
        count, D, s = len(self.t), self.size, self.shared
        n = s + count * D
        H, g = np.zeros((n, n)), np.zeros(n)
        self._add_prior(H, g)
        if count > 1:
            self._add_motion(H, g)
        self._add_markers(H, g)
        return H, g

    def _add_prior(self, H: FloatArray, g: FloatArray) -> None:
        prior = self.prior
        assert prior is not None
        s, D = self.shared, self.size
        phi = lie.so3_log(prior.R.T @ self.R[0])
        away = np.concatenate([(self.layout - prior.layout).ravel()[:s], phi, self.x[0] - prior.x])
        J = np.eye(s + D)
        J[s : s + 3, s : s + 3] = lie.so3_right_jacobian_inverse(phi)
        matrix, vector = J.T @ prior.information @ J, J.T @ (prior.vector - prior.information @ away)
        H[: s + D, : s + D] += matrix
        g[: s + D] += vector
        self._first_prior = matrix, vector

    def _add_motion(self, H: FloatArray, g: FloatArray) -> None:
        D, s = self.size, self.shared
        dt = np.diff(self.t)
        residual, first, second = motion_rows(self.R, self.x, dt, self.motion)
        root = np.stack(self._roots)
        J = np.concatenate([root @ first, root @ second], axis=2)
        r = (root @ residual[:, :, None])[:, :, 0]
        gram = np.swapaxes(J, 1, 2) @ J
        right = (np.swapaxes(J, 1, 2) @ r[:, :, None])[:, :, 0]
        self._first_motion = J[0], r[0]
        for k in range(dt.size):
            a = s + k * D
            H[a : a + 2 * D, a : a + 2 * D] += gram[k]
            g[a : a + 2 * D] -= right[k]

    def _add_markers(self, H: FloatArray, g: FloatArray) -> None:
        counts, pairs, node = self._joined
        self._first_markers = np.zeros((0, self.shared + 7))
        if pairs is None:
            self.weights = np.empty(0)
            return
        r, J_pose, J_point = self._marker_rows(pairs, node)
        self.weights = self._weights(r)
        scale = np.sqrt(self.weights)
        s, D, M = self.shared, self.size, node.size
        # Columns of the rows: the layout, then the six of every node's pose; one product makes all blocks.
        A = np.zeros((M, 3, s + 6 * counts.size + 1))
        rows, axes, six = np.arange(M)[:, None], np.arange(3), np.arange(6)
        if s:
            A[rows, :, 3 * pairs.marker[:, None] + axes] = np.swapaxes(J_point * scale[:, None, None], 1, 2)
        A[rows, :, s + 6 * node[:, None] + six] = np.swapaxes(J_pose * scale[:, None, None], 1, 2)
        A[:, :, -1] = r * scale[:, None]
        flat = A.reshape(3 * M, -1)
        own = np.concatenate([np.arange(s + 6), [A.shape[2] - 1]])
        self._first_markers = flat[: 3 * counts[0], own]
        gram = flat.T @ flat
        columns = np.concatenate([np.arange(s), (s + D * np.arange(counts.size)[:, None] + six).ravel()])
        H[columns[:, None], columns] += gram[:-1, :-1]
        g[columns] -= gram[:-1, -1]

    def _marker_rows(self, pairs: Pairs, node: np.ndarray) -> tuple[FloatArray, FloatArray, FloatArray]:
        uvz, J_pose, J_point = predict(self.camera, self.R[node], self.x[node, :3], self.layout[pairs.marker])
        r = (pairs.root @ (uvz - pairs.uvz)[:, :, None])[:, :, 0]
        return r, pairs.root @ J_pose, pairs.root @ J_point

    def _weights(self, r: FloatArray) -> FloatArray:
        if not np.isfinite(self.loss_scale):
            return np.ones(r.shape[0])
        c2 = self.loss_scale**2
        return np.asarray(self._inlier_scale * (c2 / (c2 + np.einsum("mi,mi->m", r, r))) ** 2)

    def _join(self) -> None:
        """All pairs of the window as one, once a frame."""
        counts = np.array([len(p) for p in self.pairs])
        filled = [p for p in self.pairs if len(p)]
        self._joined = (
            counts,
            Pairs.join(filled) if filled else None,
            np.repeat(np.arange(counts.size), counts),
        )

    def _smooth(self) -> None:
        self._join()
        for _ in range(_MOST_STEPS):
            self._at = self.R, self.x, self.layout
            H, g = self._normal_equations()
            factor, info = lapack.dpotrf(H, lower=1, clean=1, overwrite_a=1)
            if info != 0:
                raise np.linalg.LinAlgError("the window's information is not positive definite")
            step, _ = lapack.dpotrs(factor, g, lower=1)
            s = self.shared
            if s:
                self.layout = self.layout + step[:s].reshape(-1, 3)
            self.R, self.x = retract(self.R, self.x, step[s:].reshape(-1, self.size))
            # |L' d|^2 = d' H d: the length of the step in standard deviations.
            if float(step @ g) <= _SMALL_STEP**2:
                break
        self._factor = factor
        self._read_newest()

    def _read_newest(self) -> None:
        """Joint covariance of [layout, newest node]: the newest stands last, so only its columns need solving."""
        s, D, n = self.shared, self.size, self._factor.shape[0]
        columns = np.zeros((n, s + D), order="F")
        columns[np.arange(s), np.arange(s)] = 1.0
        columns[np.arange(n - D, n), np.arange(s, s + D)] = 1.0
        half, _ = lapack.dtrtrs(self._factor, columns, lower=1)
        self.covariance_newest = half.T @ half

    def _leave(self) -> Leaving:
        """Take the oldest node out: its smoothed pose, and its information as a prior on the next."""
        s, D, n = self.shared, self.size, self._factor.shape[0]
        columns = np.eye(n, s + 2 * D, order="F")
        half, _ = lapack.dtrtrs(self._factor, columns, lower=1)
        P = half.T @ half
        chi2, freedom = self._transition_fit(P[s:, s:])
        node = slice(s, s + D)
        out = Leaving(self.R[0], self.x[0], P[node, node], P[node, :s], chi2, freedom)
        self._marginalise()
        return out

    def drain(self) -> list[Leaving]:
        """All nodes as they are smoothed now, oldest first; the window itself stays as it is."""
        s, D, n = self.shared, self.size, self._factor.shape[0]
        half, _ = lapack.dtrtrs(self._factor, np.eye(n, order="F"), lower=1)
        P = half.T @ half
        out = []
        for k in range(len(self.t)):
            node = slice(s + k * D, s + (k + 1) * D)
            out.append(Leaving(self.R[k], self.x[k], P[node, node], P[node, :s], np.zeros(2), np.zeros(2)))
        return out

    def _transition_fit(self, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        J, r = self._first_motion
        spread = np.einsum("ij,ij->i", J @ P, J)
        part = (np.arange(self.size) // 3) % 2
        chi2 = np.array([np.sum(r[part == i] ** 2) for i in (0, 1)])
        return chi2, np.array([np.sum(1.0 - spread[part == i]) for i in (0, 1)])

    def _marginalise(self) -> None:
        """Eliminate node 0 from its prior, its markers and its motion to node 1, as they were linearised last."""
        s, D = self.shared, self.size
        H, g = np.zeros((s + 2 * D, s + 2 * D)), np.zeros(s + 2 * D)
        matrix, vector = self._first_prior
        H[: s + D, : s + D] += matrix
        g[: s + D] += vector
        J, r = self._first_motion
        H[s:, s:] += J.T @ J
        g[s:] -= J.T @ r
        A = self._first_markers
        H[: s + 6, : s + 6] += A[:, :-1].T @ A[:, :-1]
        g[: s + 6] -= A[:, :-1].T @ A[:, -1]
        old = np.arange(s, s + D)
        new = np.concatenate([np.arange(s), np.arange(s + D, s + 2 * D)])
        factor = lapack.dpotrf(H[np.ix_(old, old)], lower=1, clean=1)[0]
        columns = np.concatenate([H[np.ix_(old, new)], g[old, None]], axis=1)
        half, _ = lapack.dtrtrs(factor, columns, lower=1)
        information = H[np.ix_(new, new)] - half[:, :-1].T @ half[:, :-1]
        vector = g[new] - half[:, :-1].T @ half[:, -1]
        R, x, layout = self._at
        self.prior = Prior(
            R[1].copy(), x[1].copy(), layout.copy(), 0.5 * (information + information.T), vector
        )
        self.left = self.t[0]
        self.t, self.pairs, self._roots = self.t[1:], self.pairs[1:], self._roots[1:]
        self.R, self.x = self.R[1:], self.x[1:]


def _no_pairs() -> Pairs:
    none = np.empty(0, dtype=np.intp)
    return Pairs(none, none, np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3, 3)))

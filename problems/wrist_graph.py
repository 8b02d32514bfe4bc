"""The wrist-pose problem as a gtsam graph: one factor a frame, linearised in numpy, so one Python callback a frame.

Keys: ``r<i>`` (Rot3, ``R_c_w`` of node i), ``x<i>`` (vector ``[p_c_w, w, v, ...]``) and ``l0`` (vector, the layout). The robust loss acts
on every marker, so it cannot be a noise model of the frame's factor: a marker's residual r is scaled to ``r sqrt(2 rho) / |r|``, whose
square is the loss itself, and its derivative such that the gradient is that of the loss. gtsam then judges steps by the true objective.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from factorgrasp.losses import GemanMcClure
from factorgrasp.problems.wrist_model import motion_rows, predict
from factorgrasp.problems.wrist_rows import Batch
from factorgrasp.typing import FloatArray

LAYOUT = ord("l") << 56


def keys_of(i: int) -> tuple[int, int]:
    """Keys of node i: rotation and vector."""
    return (ord("r") << 56) + i, (ord("x") << 56) + i


class WristGraph:
    """Makes graphs, values and increments.

    Parameters
    ----------
    batch : Batch
    points : (n, 3) ndarray
        Layout as measured, m.
    layout_root : (3n, 3n) ndarray or None
        Square-root information of the layout; None: it is not estimated.
    loss : GemanMcClure or None
    """

    def __init__(
        self, batch: Batch, points: FloatArray, layout_root: FloatArray | None, loss: GemanMcClure | None
    ) -> None:
        self.batch, self.points, self.root, self.loss = batch, points, layout_root, loss
        self._starts = np.searchsorted(batch.pairs.node, np.arange(batch.t.size + 1))

    def graph(self) -> Any:
        """``gtsam.NonlinearFactorGraph``."""
        import gtsam

        graph = gtsam.NonlinearFactorGraph()
        for i in range(self.batch.t.size):
            for factor in self.factors(i):
                graph.push_back(factor)
        return graph

    def factors(self, i: int) -> list[Any]:
        """Factors that node i brings: its frame's, and the priors with the first."""
        import gtsam

        out = [self._frame(i)]
        if i == 0:
            D = self.batch.size
            precisions = np.concatenate([np.full(3, 1e-9), self.batch.rate_precision**2])
            rates = gtsam.noiseModel.Diagonal.Precisions(precisions)
            out.append(gtsam.PriorFactorVector(keys_of(0)[1], np.zeros(D - 3), rates))
            if self.root is not None:
                model = gtsam.noiseModel.Gaussian.SqrtInformation(self.root)
                out.append(gtsam.PriorFactorVector(LAYOUT, self.points.ravel(), model))
        return out

    def _frame(self, i: int) -> Any:
        """Markers of node i and the motion to it from the node before, as one factor."""
        import gtsam

        batch, D = self.batch, self.batch.size
        rows = slice(int(self._starts[i]), int(self._starts[i + 1]))
        pairs = batch.pairs.select(np.arange(rows.start, rows.stop))
        moving = i > 0
        keys = [*(keys_of(i - 1) if moving else ()), *keys_of(i)]
        estimated = self.root is not None and len(pairs) > 0
        if estimated:
            keys.append(LAYOUT)
        height = (D if moving else 0) + 3 * len(pairs)
        own = 2 if moving else 0

        def error(_this: Any, values: Any, jacobians: Any) -> FloatArray:
            R, x = values.atRot3(keys[own]).matrix(), values.atVector(keys[own + 1])
            out = np.zeros(height)
            blocks = [np.zeros((height, size)) for size in ((3, D - 3) * (2 if moving else 1))]
            if moving:
                before = values.atRot3(keys[0]).matrix(), values.atVector(keys[1])
                e, first, second = motion_rows(
                    np.stack([before[0], R]), np.stack([before[1], x]), batch.dt[i - 1 : i], batch.motion
                )
                root = batch.roots[i - 1]
                out[:D] = root @ e[0]
                for place, J in ((0, first), (2, second)):
                    whole = root @ J[0]
                    blocks[place][:D], blocks[place + 1][:D] = whole[:, :3], whole[:, 3:]
            if len(pairs):
                layout = values.atVector(LAYOUT).reshape(-1, 3) if estimated else self.points
                r, J_pose, J_point = self._markers(pairs, R, x, layout)
                start = height - r.size
                out[start:] = r.ravel()
                blocks[own][start:] = J_pose[:, :, :3].reshape(-1, 3)
                blocks[own + 1][start:, :3] = J_pose[:, :, 3:].reshape(-1, 3)
                if estimated:
                    where = np.zeros((len(pairs), 3, layout.size))
                    index = np.arange(len(pairs))[:, None]
                    where[index, :, 3 * pairs.marker[:, None] + np.arange(3)] = np.swapaxes(J_point, 1, 2)
                    blocks.append(
                        np.concatenate([np.zeros((start, layout.size)), where.reshape(-1, layout.size)])
                    )
            if jacobians is not None:
                for k, block in enumerate(blocks):
                    jacobians[k] = block
            return out

        if height == 0:
            # A first node without markers does not occur, but a graph must not break on it.
            return gtsam.PriorFactorVector(
                keys_of(i)[1], np.zeros(D - 3), gtsam.noiseModel.Isotropic.Precision(D - 3, 1e-12)
            )
        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(height), keys, error)

    def _markers(
        self, pairs: Any, R: FloatArray, x: FloatArray, layout: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals and derivatives of a frame, scaled so that squares are losses."""
        count = len(pairs)
        seen, J_pose, J_point = predict(
            self.batch.camera,
            np.broadcast_to(R, (count, 3, 3)),
            np.broadcast_to(x[:3], (count, 3)),
            layout[pairs.marker],
        )
        r = (pairs.root @ (seen - pairs.uvz)[:, :, None])[:, :, 0]
        J_pose, J_point = pairs.root @ J_pose, pairs.root @ J_point
        if self.loss is not None:
            # a = sqrt(2 rho) / s = sqrt(1 / (1 + s^2/c^2)), weight = a^4: the gradient w J'r is (w/a J)' (a r).
            a = 1.0 / np.sqrt(1.0 + np.einsum("mi,mi->m", r, r) / self.loss.scale**2)
            r = r * a[:, None]
            J_pose, J_point = J_pose * (a**3)[:, None, None], J_point * (a**3)[:, None, None]
        return r, J_pose, J_point

    def values(self, R: FloatArray, x: FloatArray, layout: FloatArray) -> Any:
        """``gtsam.Values`` of nodes and layout."""
        import gtsam

        out = gtsam.Values()
        for i in range(self.batch.t.size):
            self._insert(out, i, R[i], x[i], layout)
        return out

    def _insert(self, values: Any, i: int, R: FloatArray, x: FloatArray, layout: FloatArray) -> None:
        import gtsam

        rotation, vector = keys_of(i)
        values.insert(rotation, gtsam.Rot3(np.asarray(R)))
        values.insert(vector, np.asarray(x, dtype=float))
        if i == 0 and self.root is not None:
            values.insert(LAYOUT, np.asarray(layout, dtype=float).ravel())

    def read(self, values: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Nodes and layout of ``gtsam.Values``."""
        keys = [keys_of(i) for i in range(self.batch.t.size)]
        R = np.stack([values.atRot3(key[0]).matrix() for key in keys])
        x = np.stack([values.atVector(key[1]) for key in keys])
        layout = values.atVector(LAYOUT).reshape(-1, 3) if self.root is not None else self.points
        return R, x, layout

    def increments(
        self, R: FloatArray, x: FloatArray, layout: FloatArray
    ) -> Iterator[tuple[list[Any], Any | Callable[[Any], Any], dict[int, float]]]:
        """Node by node: factors, first values, and stamps (s) of the node and the layout."""
        import gtsam

        for i in range(self.batch.t.size):
            new = gtsam.Values()
            self._insert(new, i, R[i], x[i], layout)
            now = float(self.batch.t[i])
            stamps = dict.fromkeys(keys_of(i), now)
            if self.root is not None:
                stamps[LAYOUT] = now
            yield self.factors(i), new, stamps

"""All rows of the batch problem at once: whitened residuals and derivatives of markers and motion over the whole recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.losses import GemanMcClure, inlier_weight
from factorgrasp.models.camera import Camera
from factorgrasp.problems.wrist_chain import Chain
from factorgrasp.problems.wrist_model import NODE_SIZE, Pairs, motion_root, motion_rows, predict
from factorgrasp.problems.wrist_settings import Motion
from factorgrasp.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Rows:
    """Whitened residuals ``r`` with derivatives at one state.

    Attributes
    ----------
    markers : (M, 3) ndarray
    J_pose : (M, 3, 6) ndarray
    J_point : (M, 3, 3) ndarray
    motion : (n - 1, D) ndarray
    J_first, J_second : (n - 1, D, D) ndarray
    seen : (M, 3) ndarray
        Predicted (u, v, z).
    """

    markers: FloatArray
    J_pose: FloatArray
    J_point: FloatArray
    motion: FloatArray
    J_first: FloatArray
    J_second: FloatArray
    seen: FloatArray


class Batch:
    """What does not change with the state: times, pairs, motion roots, priors.

    Parameters
    ----------
    camera : Camera
    t : (n,) ndarray
    pairs : Pairs
        `node` indexes `t`, not decreasing.
    motion : {"acceleration", "jerk"}
    densities : (2,) ndarray
    rate_sd : (D - 6,) ndarray
        Prior standard deviations of the first node's velocities (about zero).
    """

    def __init__(
        self,
        camera: Camera,
        t: FloatArray,
        pairs: Pairs,
        motion: Motion,
        densities: FloatArray,
        rate_sd: FloatArray,
    ) -> None:
        self.camera, self.t, self.pairs, self.motion = camera, t, pairs, motion
        self.densities = densities
        self.size = NODE_SIZE[motion]
        self.dt = np.diff(t)
        self.roots = motion_root(self.dt, densities, motion)
        self.rate_precision = 1.0 / rate_sd[: self.size - 6]

    def rows(self, R: FloatArray, x: FloatArray, layout: FloatArray) -> Rows:
        """Residuals and derivatives at nodes R (n, 3, 3), x (n, D - 3) and a layout (n_markers, 3)."""
        pairs = self.pairs
        seen, J_pose, J_point = predict(self.camera, R[pairs.node], x[pairs.node, :3], layout[pairs.marker])
        r = (pairs.root @ (seen - pairs.uvz)[:, :, None])[:, :, 0]
        e, first, second = motion_rows(R, x, self.dt, self.motion)
        e = (self.roots @ e[:, :, None])[:, :, 0]
        return Rows(
            r, pairs.root @ J_pose, pairs.root @ J_point, e, self.roots @ first, self.roots @ second, seen
        )

    def chain(
        self,
        rows: Rows,
        loss: GemanMcClure | None,
        layout_information: FloatArray | None,
        extra: FloatArray | None = None,
    ) -> tuple[Chain, FloatArray, FloatArray]:
        """Information of all nodes and the layout at a state, with the gradient's negative.

        `extra` (M, 3, e) are whitened derivatives of the marker rows by further shared unknowns (a focal length), which stand last.
        """
        n, D = self.t.size, self.size
        # Blobs as good as their covariance says count in full: the covariance of the pose is to be honest.
        full = 1.0 if loss is None else 1.0 / inlier_weight(loss.scale)
        weights = full * self.weights(rows, loss)[:, None, None]
        shared = 0 if layout_information is None else layout_information.shape[0]
        others = 0 if extra is None else extra.shape[2]
        diagonal, upper = np.zeros((n, D, D)), np.zeros((max(n - 1, 0), D, D))
        border, corner = np.zeros((n, D, shared + others)), np.zeros((shared + others, shared + others))
        rhs, border_rhs = np.zeros((n, D)), np.zeros(shared + others)
        node, marker = self.pairs.node, self.pairs.marker
        Jw = np.swapaxes(rows.J_pose * weights, 1, 2)
        np.add.at(diagonal[:, :6, :6], node, Jw @ rows.J_pose)
        np.add.at(rhs[:, :6], node, -(Jw @ rows.markers[:, :, None])[:, :, 0])
        if shared + others:
            J_shared = np.zeros((len(self.pairs), 3, shared + others))
            if shared:
                index = np.arange(len(self.pairs))[:, None]
                J_shared[index, :, 3 * marker[:, None] + np.arange(3)] = np.swapaxes(rows.J_point, 1, 2)
            if extra is not None:
                J_shared[:, :, shared:] = extra
            np.add.at(border[:, :6], node, Jw @ J_shared)
            flat = (J_shared * np.sqrt(weights)).reshape(-1, shared + others)
            corner += flat.T @ flat
            border_rhs -= flat.T @ (rows.markers * np.sqrt(weights[:, :, 0])).ravel()
        if layout_information is not None:
            corner[:shared, :shared] += layout_information
        A, B = np.swapaxes(rows.J_first, 1, 2), np.swapaxes(rows.J_second, 1, 2)
        diagonal[:-1] += A @ rows.J_first
        diagonal[1:] += B @ rows.J_second
        upper += A @ rows.J_second
        rhs[:-1] -= (A @ rows.motion[:, :, None])[:, :, 0]
        rhs[1:] -= (B @ rows.motion[:, :, None])[:, :, 0]
        rates = np.arange(6, D)
        diagonal[0, rates, rates] += self.rate_precision**2
        return Chain(diagonal, upper, border, corner), rhs, border_rhs

    @staticmethod
    def weights(rows: Rows, loss: GemanMcClure | None) -> FloatArray:
        """(M,) robust weights."""
        if loss is None:
            return np.ones(rows.markers.shape[0])
        return loss.weight(np.sqrt(np.einsum("mi,mi->m", rows.markers, rows.markers)))

"""Covariances of sensors over frames: square-root informations of what is there, with the rows of gaps taken out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgrasp.problems.human_dynamics_sensors import Sensor
from factorgrasp.problems.human_dynamics_system import HumanDynamicsSystem
from factorgrasp.typing import BoolArray, FloatArray
from factorgrasp.uncertainty import Covariance


class Whitening:
    """Turns raw rows of n frames into whitened ones.

    Parameters
    ----------
    system : HumanDynamicsSystem
    sensors : sequence of Sensor
        Those of the system, in the same order; a covariance may vary over frames.
    """

    def __init__(self, system: HumanDynamicsSystem, sensors: Sequence[Sensor]) -> None:
        self._system = system
        pattern = system.pattern
        self._scale = np.ones(pattern.jacobian.height)
        for name, term in pattern.terms.items():
            if term.covariance.kind != "blocks":
                self._scale[pattern.jacobian.slices[name]] = term.covariance.rows_root(term.rows)
        self._covariances = [sensor.variances() for sensor in sensors]
        self._varying: list[int] = []
        for i, (rows, C) in enumerate(zip(system.sensors, self._covariances, strict=True)):
            where = pattern.jacobian.slices[rows.name]
            if rows.full or C.ndim > 1:
                self._varying.append(i)
                self._scale[where] = 1.0
            else:
                self._scale[where] = 1.0 / np.sqrt(C)
        self._entry_scale = self._scale[pattern.jacobian.row_of_entry]

    def covariance(self, sensor: int, frame: int, gaps: FloatArray) -> Covariance:
        """Covariance of a sensor's rows in one frame, for a :class:`LeastSquares` term; rows of gaps stand alone."""
        C = self._covariances[sensor]
        full = self._system.sensors[sensor].full
        now = C if C.ndim == (2 if full else 1) else C[frame]
        if not full:
            return Covariance.diagonal(now)
        return Covariance.blocks(_without(now, np.isnan(gaps)))

    def apply(self, entries: FloatArray, rhs: FloatArray, values: FloatArray, frames: slice) -> None:
        """Whiten raw non-zeros (n, nnz) and right-hand sides (n, rows) in place, for all sensors' values (n, m) side by side."""
        entries *= self._entry_scale
        rhs *= self._scale
        soft = self._system.pattern.jacobian
        for i in self._varying:
            rows, C = self._system.sensors[i], self._covariances[i]
            where = soft.slices[rows.name]
            first, last = int(soft.matrix.indptr[where.start]), int(soft.matrix.indptr[where.stop])
            if not rows.full:
                root = 1.0 / np.sqrt(C[frames])
                entries[:, first:last] *= root[:, soft.row_of_entry[first:last] - where.start]
                rhs[:, where] *= root
                continue
            now = C if C.ndim == 2 else C[frames]
            gaps = np.isnan(values[:, self._system.value_slices[i]])
            if gaps.any():
                now = _without(np.broadcast_to(now, (gaps.shape[0], *now.shape[-2:])), gaps)
            W = np.linalg.inv(np.linalg.cholesky(now))
            block = entries[:, first:last].reshape(entries.shape[0], rows.size, -1)
            entries[:, first:last] = (W @ block).reshape(entries.shape[0], -1)
            rhs[:, where] = (W @ rhs[:, where, None])[..., 0]


def _without(C: FloatArray, gaps: BoolArray) -> FloatArray:
    """Covariances (..., k, k) of what is there, with ones where a row is missing."""
    missing = gaps[..., :, None] | gaps[..., None, :]
    return np.where(missing, np.eye(C.shape[-1]), C)

"""Markers on an OpenSim model as residuals of its coordinates."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.models.osim import GROUND, OsimModel
from factorgrasp.problems.body_observations import LIMIT_SD, BodyObservations, ObservedBody
from factorgrasp.toml_tables import close_matches
from factorgrasp.typing import BoolArray, FloatArray

_TURNS = 8


class ObservedOsim:
    """Residuals and their derivatives of many configurations (n, c) at once; a step is added to the coordinates.

    Parameters
    ----------
    model : OsimModel
    observations : BodyObservations
        Of markers only.

    Raises
    ------
    InputError
        For a marker on a body that the model does not have.
    """

    floating = False

    def __init__(self, model: OsimModel, observations: BodyObservations) -> None:
        if observations.posed:
            raise InputError("observations", "markers, for an OpenSim model", "poses of links")
        self.model, self.observations = model, observations
        self.nv = len(model.names)
        place = observations.placement
        for name, link in zip(place.names, place.links, strict=True):
            if link not in model.bodies:
                raise InputError(
                    f"link of {name}", "a body of the model", repr(link), close_matches(link, model.bodies)
                )
        self._at = np.array([model.bodies.index(link) for link in place.links], dtype=np.intp)
        self._weights = np.repeat(1.0 / place.sd, 3)
        self.still: BoolArray = np.array([c.locked or c.name in model.coupled for c in model.coordinates])
        first = next(joint for joint in model.joints if joint.parent == GROUND)
        self.root = np.array([model.names.index(name) for name in first.coordinates], dtype=np.intp)
        above = {joint.child: joint for joint in model.joints}
        # Which coordinates move which body.
        self._moves = np.zeros((self.nv, len(model.bodies)), dtype=bool)
        for k, body in enumerate(model.bodies):
            link = body
            while link != GROUND:
                joint = above[link]
                self._moves[[model.names.index(name) for name in joint.coordinates], k] = True
                link = joint.parent

    def neutral(self) -> FloatArray:
        """The model's default coordinates (c,)."""
        return np.array([c.default for c in self.model.coordinates])

    def markers(self, q: FloatArray) -> FloatArray:
        """Positions (n, m, 3) of the markers in the world."""
        R, p = self.model.poses(q)
        at = self.observations.placement.position
        return np.asarray(p[:, self._at] + np.einsum("nmij,mj->nmi", R[:, self._at], at))

    def link_axes(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``R_w_l`` (n, m, 3, 3) and origin (n, m, 3) of the body of every marker."""
        R, p = self.model.poses(q)
        return R[:, self._at], p[:, self._at]

    def residuals(self, q: FloatArray, frames: Any = slice(None)) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (n, 3 m) and Jacobians (n, 3 m, c); both zero where nothing was seen, and for what does not move."""
        count, model = q.shape[0], self.model
        values = model.values(q)
        R, p = model.poses(q)
        where = p[:, self._at] + np.einsum(
            "nmij,mj->nmi", R[:, self._at], self.observations.placement.position
        )
        moved = np.zeros((count, *where.shape[1:], self.nv))
        for joint in model.joints:
            if not joint.coordinates:
                continue
            S = joint.subspace(values, count)
            down = model.bodies.index(joint.child)
            for k, name in enumerate(joint.coordinates):
                linear, angular = (
                    np.einsum("nij,nj->ni", R[:, down], S[:, part, k]) for part in (slice(0, 3), slice(3, 6))
                )
                column = model.names.index(name)
                reach = self._moves[column, self._at]
                velocity = linear[:, None] + np.cross(angular[:, None], where - p[:, down, None])
                rate: FloatArray | float = 1.0
                if name in model.coupled:
                    leader, function = model.coupled[name]
                    x = values[leader]
                    share = (function(x + 1e-6) - function(x - 1e-6)) / 2e-6
                    column, rate = model.names.index(leader), share[:, None, None]
                moved[..., column] += np.where(reach[None, :, None], rate * velocity, 0.0)
        moved[..., self.still] = 0.0
        residual = (where - self.observations.markers[frames]).reshape(count, -1)
        jacobian = moved.reshape(count, -1, self.nv)
        lost = ~np.isfinite(residual)
        residual = np.where(lost, 0.0, residual) * self._weights
        jacobian *= np.where(lost, 0.0, self._weights)[..., None]
        return residual, jacobian

    def step(self, q: FloatArray, d: FloatArray) -> FloatArray:
        """Coordinates after steps; those that are locked stay, and those that follow others are put right."""
        values = self.model.values(q + np.where(self.still, 0.0, d))
        return np.column_stack([values[name] for name in self.model.names])

    def difference(self, q0: FloatArray, q1: FloatArray) -> FloatArray:
        """The step from q0 to q1."""
        return np.asarray(q1 - q0)

    def starts(self, frame: int, rest: FloatArray) -> list[FloatArray]:
        """The model's posture, turned about each of the root's axes in eight steps, and moved to where the markers are."""
        seen = self.observations.markers[frame]
        some = np.isfinite(seen).all(axis=1)
        turning = [k for k in self.root if not self.model.coordinates[k].slides]
        sliding = [k for k in self.root if self.model.coordinates[k].slides]
        out = []
        for k in turning or [None]:
            for turn in range(_TURNS if k is not None else 1):
                q = rest.copy()
                if k is not None:
                    q[k] += 2.0 * np.pi * (turn - _TURNS // 2) / _TURNS
                off = (seen - self.markers(q[None])[0])[some].mean(axis=0)
                for column in sliding:
                    ahead = q.copy()
                    ahead[column] += 1.0
                    axis = self.markers(ahead[None])[0].mean(axis=0) - self.markers(q[None])[0].mean(axis=0)
                    q[column] += float(axis @ off)
                miss = (seen - self.markers(q[None])[0])[some]
                out.append((float(np.sum(miss**2)), q))
        out.sort(key=lambda one: one[0])
        return [q for _, q in out[:3]]

    def nearest(self, q: FloatArray, rest: FloatArray) -> FloatArray:
        """The same angles without whole turns."""
        turns = np.array([not c.slides for c in self.model.coordinates]) & ~self.still
        return np.where(turns, q - 2.0 * np.pi * np.round((q - rest) / (2.0 * np.pi)), q)

    def limits(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far (n, c) coordinates other than the root's are beyond their range, and the information that pulls them back."""
        beyond = np.zeros(q.shape)
        for k, one in enumerate(self.model.coordinates):
            if k in self.root or self.still[k] or not one.low < one.high:
                continue
            beyond[:, k] = np.maximum(q[:, k] - one.high, 0.0) + np.minimum(q[:, k] - one.low, 0.0)
        return beyond, np.where(beyond != 0.0, LIMIT_SD**-2, 0.0)

    def derivatives(self, q: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """Velocities and accelerations (n, c) of uniform coordinates by central differences."""
        v, a = np.zeros_like(q), np.zeros_like(q)
        v[1:-1], a[1:-1] = (q[2:] - q[:-2]) / (2.0 * dt), (q[2:] - 2.0 * q[1:-1] + q[:-2]) / dt**2
        v[[0, -1]], a[[0, -1]] = v[[1, -2]], a[[1, -2]]
        return v, a


Observed: TypeAlias = ObservedBody | ObservedOsim


def observed(model: Any, observations: BodyObservations) -> Observed:
    """The residuals of a pinocchio model or of an OpenSim model."""
    return (
        ObservedOsim(model, observations)
        if isinstance(model, OsimModel)
        else ObservedBody(model, observations)
    )

"""Gauss-Newton on second moments with a Gaussian prior on all unknowns: a few small matrix products a solve."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from factorgrasp import lie
from factorgrasp.problems.grasp_model import GYRO_WIDTH, GraspModel, quadratic_forms
from factorgrasp.problems.grasp_system import floored_inverse, positive_part
from factorgrasp.typing import FloatArray, State

# 1/rad^2; a rotation's prior below this is none.
_KNOWN = 1.0


@dataclass(frozen=True)
class GaussianPrior:
    """Mean and information matrix (n, n) of all unknowns of a model, in tangent order."""

    mean: State
    information: FloatArray

    @cached_property
    def knows_rotation(self) -> bool:
        """Whether it says anything of the rotation; otherwise it only keeps the system regular."""
        return bool(self.information[0, 0] > _KNOWN)


class Moment(NamedTuple):
    """Weighted second moments, less their expected noise, and the squared-weight ones with it."""

    gyro: FloatArray
    accelerometer: FloatArray
    gyro_squared: FloatArray
    accelerometer_squared: FloatArray

    def to_row(self) -> FloatArray:
        """All entries in one row."""
        return np.concatenate([part.ravel() for part in self])

    @classmethod
    def from_row(cls, row: FloatArray, width: int) -> Moment:
        """Back from :meth:`to_row`, with `width` entries of z_a."""
        sizes = (GYRO_WIDTH, width, GYRO_WIDTH, width)
        edges = np.cumsum([size**2 for size in sizes])[:-1]
        return cls(
            *(part.reshape(size, size) for part, size in zip(np.split(row, edges), sizes, strict=True))
        )


@dataclass(frozen=True)
class Fit:
    """A state with its Gauss-Newton matrix and the covariance of its gradient (both (n, n))."""

    model: GraspModel
    state: State
    cost: float
    information: FloatArray
    meat: FloatArray

    def covariance(self) -> FloatArray:
        """``H^-1 M H^-1`` (n, n)."""
        bread = inverse(self.information)
        return np.asarray(bread @ self.meat @ bread)


def inverse(H: FloatArray) -> FloatArray:
    """Inverse (n, n) of an information matrix with a prior in it; what holds no information at all gets a huge variance."""
    diagonal = H.diagonal()
    if diagonal.min() <= 0.0:
        return floored_inverse(H)
    scale = 1.0 / np.sqrt(diagonal)
    try:
        out = scale[:, None] * np.linalg.inv(scale[:, None] * H * scale) * scale
    except np.linalg.LinAlgError:
        return floored_inverse(H)
    return out if out.diagonal().min() > 0.0 else floored_inverse(H)


def retract(model: GraspModel, state: State, step: FloatArray) -> dict[str, FloatArray]:
    """Move a state by a tangent step (n,)."""
    moved: dict[str, FloatArray] = {}
    for variable, where in zip(model.variables, model.columns.values(), strict=True):
        value, part = state[variable.name], step[where]
        moved[variable.name] = value @ _turn(part) if variable.manifold == "rotation" else value + part
    return moved


def local(model: GraspModel, origin: State, state: State) -> FloatArray:
    """Tangent step (n,) from `origin` to `state`."""
    parts = [
        _rotation_between(origin[v.name], state[v.name])
        if v.manifold == "rotation"
        else state[v.name] - origin[v.name]
        for v in model.variables
    ]
    return np.concatenate(parts)


def _turn(v: FloatArray) -> FloatArray:
    """``exp(v)`` (3, 3); for a single one several times faster than the batched exponential."""
    x, y, z = v.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-8:
        a, b = 1.0, 0.5
    else:
        a, b = math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def _rotation_between(A: FloatArray, B: FloatArray) -> FloatArray:
    """``log(A' B)`` (3,); for a single one several times faster than the batched logarithm."""
    M = A.T @ B
    v = 0.5 * np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])
    sine, cosine = math.sqrt(v @ v), 0.5 * (M[0, 0] + M[1, 1] + M[2, 2] - 1.0)
    if cosine < -0.9:
        return lie.so3_log(M)
    return np.asarray(v if sine == 0.0 else v * (math.atan2(sine, cosine) / sine))


class Linearised:
    """Both residual matrices at a state, for the normal equations of many moments."""

    def __init__(self, model: GraspModel, state: State) -> None:
        self._size = model.size
        self._parts = tuple(
            (L, J.reshape(-1, J.shape[2]), J.reshape(model.size, -1).T, L.ravel())
            for L, J in zip(model.matrices(state), model.jacobians(state), strict=True)
        )

    def normals(
        self, moments: tuple[FloatArray, FloatArray], noise: tuple[FloatArray, FloatArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Costs (S,), gradients (S, n) and covariances of these (S, n, n) of `moments` (S, 10, 10) and (S, m, m).

        The expected `noise` in each is taken out of the gradients only: their covariance has it in, and stays positive semidefinite.
        """
        n = self._size
        cost, gradient, information = np.zeros(1), np.zeros(1), np.zeros(1)
        for (L, tall, wide, flat), Z, E in zip(self._parts, moments, noise, strict=True):
            JZ = np.matmul(tall, Z).reshape(-1, n, flat.size)
            cost = cost + 0.5 * np.matmul(np.matmul(L, Z).reshape(-1, flat.size), flat)
            gradient = gradient + np.matmul(JZ, flat) - (tall @ E).reshape(n, -1) @ flat
            information = information + np.matmul(JZ, wide)
        return cost, gradient, information


def descend(
    model: GraspModel,
    start: State,
    moment: Moment,
    prior: GaussianPrior,
    iterations: int,
    tolerance: float = 1e-3,
    indefinite: bool = True,
) -> Fit:
    """Gauss-Newton from `start` until a step is below `tolerance` standard deviations.

    Parameters
    ----------
    model : GraspModel
    start : State
    moment : Moment
    prior : GaussianPrior
    iterations : int
        At most.
    indefinite : bool
        The moments may have negative eigenvalues, since their expected noise was taken out; their positive part is used.
    tolerance : float
        The last step is still taken. It is off by its square times the curvature, which is tiny: half a standard deviation is a good
        tolerance for a warm start.
    """
    Z_g, Z_a = moment.gyro, moment.accelerometer
    if indefinite:
        Z_g, Z_a = _positive(Z_g), _positive(Z_a)
    state, cost, gained = dict(start), 0.0, 0.0
    for _ in range(iterations):
        cost, gradient, H, J_g, J_a = _normal(model, state, Z_g, Z_a, prior)
        step = np.asarray(-np.linalg.solve(H, gradient), dtype=np.float64)
        state = retract(model, state, step)
        gained = -float(step @ gradient)
        if gained < tolerance**2:
            break
    return Fit(model, state, cost - 0.5 * gained, H, _meat(J_g, J_a, moment, prior))


def evaluate(model: GraspModel, state: State, moment: Moment, prior: GaussianPrior) -> Fit:
    """The same without a step: all matrices at `state` itself."""
    Z_g, Z_a = _positive(moment.gyro), _positive(moment.accelerometer)
    cost, _, H, J_g, J_a = _normal(model, state, Z_g, Z_a, prior)
    return Fit(model, state, cost, H, _meat(J_g, J_a, moment, prior))


def _normal(
    model: GraspModel, state: State, Z_g: FloatArray, Z_a: FloatArray, prior: GaussianPrior
) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Cost, gradient, Gauss-Newton matrix, and the Jacobians of both residual matrices."""
    L_g, L_a = model.matrices(state)
    J_g, J_a = model.jacobians(state)
    gyro, accelerometer = quadratic_forms(L_g, J_g, Z_g), quadratic_forms(L_a, J_a, Z_a)
    error = _prior_error(model, prior, state)
    pull = prior.information @ error
    cost = gyro[0] + accelerometer[0] + 0.5 * float(error @ pull)
    return cost, gyro[1] + accelerometer[1] + pull, gyro[2] + accelerometer[2] + prior.information, J_g, J_a


def _meat(J_g: FloatArray, J_a: FloatArray, moment: Moment, prior: GaussianPrior) -> FloatArray:
    out = prior.information
    for J, Z in ((J_g, moment.gyro_squared), (J_a, moment.accelerometer_squared)):
        n, width = J.shape[0], J.shape[2]
        out = out + (J.reshape(-1, width) @ Z).reshape(n, -1) @ J.reshape(n, -1).T
    return out


def _prior_error(model: GraspModel, prior: GaussianPrior, state: State) -> FloatArray:
    if prior.knows_rotation:
        return local(model, prior.mean, state)
    parts = [
        np.zeros(3) if v.name == "rotation" else state[v.name] - prior.mean[v.name] for v in model.variables
    ]
    return np.concatenate(parts)


def definite(Z: FloatArray, margin: float = 0.0) -> bool:
    """Whether Z (m, m) is positive definite, by `margin` when its diagonal is scaled to one."""
    scale = 1.0 / np.sqrt(np.maximum(Z.diagonal(), 1e-300))
    scaled = scale[:, None] * Z * scale
    scaled[np.arange(Z.shape[0]), np.arange(Z.shape[0])] -= margin
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return False
    return True


def _positive(Z: FloatArray) -> FloatArray:
    """Z (m, m), or the nearest positive semidefinite matrix: taking the expected noise out can leave small negative eigenvalues."""
    if definite(Z):
        return Z
    root = positive_part(Z)
    return np.asarray(root @ root.T)

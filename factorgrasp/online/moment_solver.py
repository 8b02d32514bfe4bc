"""Gauss-Newton on second moments with a Gaussian prior on all unknowns: a few small matrix products a solve."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factorgrasp.problems.grasp_model import GraspModel, quadratic_forms
from factorgrasp.problems.grasp_system import floored_inverse, positive_part
from factorgrasp.typing import FloatArray, State


@dataclass(frozen=True)
class GaussianPrior:
    """Mean and information matrix (n, n) of all unknowns of a model, in tangent order."""

    mean: State
    information: FloatArray


class Moment(NamedTuple):
    """Weighted second moments, less their expected noise, and the squared-weight ones with it."""

    gyro: FloatArray
    accelerometer: FloatArray
    gyro_squared: FloatArray
    accelerometer_squared: FloatArray


class Normal(NamedTuple):
    """Cost, gradient (n,) and Gauss-Newton matrix (n, n) at a state."""

    cost: float
    gradient: FloatArray
    information: FloatArray


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
        bread = floored_inverse(self.information)
        return np.asarray(bread @ self.meat @ bread)


def retract(model: GraspModel, state: State, step: FloatArray) -> dict[str, FloatArray]:
    """Move a state by a tangent step (n,)."""
    return {v.name: v.retract(state[v.name], step[where]) for v, where in zip(model.variables, model.columns.values(), strict=True)}


def local(model: GraspModel, origin: State, state: State) -> FloatArray:
    """Tangent step (n,) from `origin` to `state`."""
    return np.concatenate([v.local(origin[v.name], state[v.name]) for v in model.variables])


def data_normal(model: GraspModel, state: State, Z_g: FloatArray, Z_a: FloatArray) -> Normal:
    """The data's part."""
    L_g, L_a = model.matrices(state)
    J_g, J_a = model.jacobians(state)
    gyro, accelerometer = quadratic_forms(L_g, J_g, Z_g), quadratic_forms(L_a, J_a, Z_a)
    return Normal(gyro[0] + accelerometer[0], gyro[1] + accelerometer[1], gyro[2] + accelerometer[2])


def descend(
    model: GraspModel, start: State, moment: Moment, prior: GaussianPrior, iterations: int, tolerance: float = 1e-3
) -> Fit:
    """Gauss-Newton from `start` until a step is below `tolerance` standard deviations.

    Taking the expected noise out can leave small negative eigenvalues in the moments where nothing excites; their positive part is used.
    """
    roots = positive_part(moment.gyro), positive_part(moment.accelerometer)
    Z_g, Z_a = (root @ root.T for root in roots)
    state = dict(start)
    for iteration in range(iterations + 1):
        data = data_normal(model, state, Z_g, Z_a)
        error = local(model, prior.mean, state)
        pull = prior.information @ error
        H = data.information + prior.information
        if iteration == iterations:
            break
        gradient = data.gradient + pull
        step = -np.linalg.solve(H, gradient)
        state = retract(model, state, step)
        if -float(step @ gradient) < tolerance**2:
            break
    L_g, L_a = model.matrices(state)
    J_g, J_a = model.jacobians(state)
    meat = quadratic_forms(L_g, J_g, moment.gyro_squared)[2] + quadratic_forms(L_a, J_a, moment.accelerometer_squared)[2]
    return Fit(model, state, data.cost + 0.5 * float(error @ pull), H, meat + prior.information)

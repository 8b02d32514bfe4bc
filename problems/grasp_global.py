"""Is the rotation found the best there is? The grasp cost as a quadratic in the rotation's entries alone.

With clocks and sensor calibration held at their estimates, both residuals are linear in ``y = [vec R, r, c_g,
c_a, tilt, 1]``, ``c = M b``: the cost is ``y' G y``. Eliminating everything but ``x = [vec R, 1]`` (Schur
complement) leaves ``x' Q x`` over SO(3), for which :mod:`factorgrasp.rotation_relaxation` has a certificate
and a relaxation (mathematics 2.3).
"""

from __future__ import annotations

import numpy as np

from factorgrasp import rotation_relaxation
from factorgrasp.problems.grasp_model import TILTED_WIDTH, GraspModel, phi_matrix
from factorgrasp.problems.grasp_settings import GraspPrior
from factorgrasp.typing import FloatArray, State


def lifted_residuals(model: GraspModel, state: State) -> tuple[FloatArray, FloatArray]:
    """``B_g`` (3, 10, k) and ``B_a`` (3, m, k) with ``L = B y`` for ``y = [vec R (columns), r, c_g, c_a, tilt (if any), 1]``."""
    tau = float(model.value(state, "time_offset")[0])
    tau_a = tau + float(model.value(state, "accelerometer_delay")[0])
    M_g, M_a = model.sensor_matrices(state)
    gain_g, gain_a = state["rotation"].T @ M_g, state["rotation"].T @ M_a
    width = model.accelerometer_width
    size = 19 + (2 if width == TILTED_WIDTH else 0)
    B_g, B_a = np.zeros((3, 10, size)), np.zeros((3, width, size))
    for column in range(3):
        for row in range(3):
            k = 3 * column + row
            # Entry (row, column) of R times row `column` of the sensor gain.
            B_g[row, 3:6, k], B_g[row, 6:9, k] = -gain_g[column], -tau * gain_g[column]
            B_a[row, 12:15, k], B_a[row, 15:18, k] = -gain_a[column], -tau_a * gain_a[column]
    eye = np.eye(3)
    for i in range(3):
        B_a[:, :12, 9 + i] = phi_matrix(eye[i])
        B_g[i, 9, 12 + i] = 1.0
        B_a[i, 18, 15 + i] = 1.0
        B_g[i, i, -1] = 1.0
        B_a[i, i, -1] = 1.0
    if width == TILTED_WIDTH:
        B_a[:, 19:22, 18], B_a[:, 22:25, 19] = -eye, -eye
    return B_g, B_a


def rotation_cost(
    model: GraspModel,
    state: State,
    Z_g: FloatArray,
    Z_a: FloatArray,
    precision: FloatArray,
    prior: GraspPrior,
) -> FloatArray:
    """``Q`` (10, 10) with ``x' Q x`` twice the cost at the best other unknowns, ``x = [vec R (columns), 1]``."""
    B_g, B_a = lifted_residuals(model, state)
    G = np.sum(B_g.transpose(0, 2, 1) @ Z_g @ B_g, axis=0) + np.sum(
        B_a.transpose(0, 2, 1) @ Z_a @ B_a, axis=0
    )
    where = model.columns
    G[9:12, 9:12] += np.diag(precision[where["translation"]])
    pull = precision[where["translation"]] * prior.translation
    G[9:12, -1] -= pull
    G[-1, 9:12] -= pull
    G[-1, -1] += float(pull @ prior.translation)
    places = {"gyro_bias": slice(12, 15), "accelerometer_bias": slice(15, 18), "base_tilt": slice(18, 20)}
    gone: list[int] = list(range(9, 12))
    for name, place in places.items():
        if name in where:
            G[place, place] += np.diag(precision[where[name]])
            gone += range(place.start, place.stop)
    if prior.rotation is not None and prior.rotation_sd is not None:
        # |R - R_0|_F^2 = 2 |angle|^2 near the prior.
        weight = 0.5 / prior.rotation_sd**2
        target = prior.rotation.T.ravel()
        G[:9, :9] += weight * np.eye(9)
        G[:9, -1] -= weight * target
        G[-1, :9] -= weight * target
        G[-1, -1] += weight * float(target @ target)
    kept = [*range(9), G.shape[0] - 1]
    inner = G[np.ix_(gone, gone)]
    cross = G[np.ix_(gone, kept)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(inner), 1e-300))
    solved = scale[:, None] * np.linalg.solve(
        scale[:, None] * inner * scale + 1e-14 * np.eye(len(gone)), scale[:, None] * cross
    )
    Q = G[np.ix_(kept, kept)] - cross.T @ solved
    return np.asarray(0.5 * (Q + Q.T))


def better_rotation(Q: FloatArray, rotation: FloatArray) -> FloatArray | None:
    """A rotation of lower cost than the local optimum `rotation`; None when that is certified or nothing better is found."""
    if rotation_relaxation.certify_rotation(Q, rotation).certified:
        return None
    found = rotation_relaxation.solve_rotation_sdp(Q).rotation
    costs = rotation_relaxation.rotation_cost(Q, np.stack([rotation, found]))
    return found if costs[1] < costs[0] - 1e-6 * abs(costs[0]) else None

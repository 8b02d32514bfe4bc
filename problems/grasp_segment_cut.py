"""A grasp recording cut into segments: their moments, and the weights that a grasp of their own asks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgrasp.problems.grasp_noise import LARGEST_DISAGREEMENT, PRIOR_DOF, BandVariances
from factorgrasp.problems.grasp_pose import GraspPose
from factorgrasp.problems.grasp_segment_factor import SegmentFactor, SegmentMoments
from factorgrasp.problems.grasp_system import positive_part, prior_precision, prior_residual
from factorgrasp.problems.grasp_windows import Moments, compress
from factorgrasp.typing import FloatArray, IntArray, State

# A fit that takes more than this part of a band's numbers leaves too few to tell the band's noise.
_MOST_TAKEN = 0.75


def segment_labels(t: FloatArray, seconds: float) -> IntArray:
    """Segment of every window centre t (ascending), (windows,): 0, 1, ... without those that hold no window."""
    place = np.floor((t - t[0]) / seconds + 1e-9)
    return np.asarray(np.unique(place, return_inverse=True)[1], dtype=np.intp)


def cut_moments(problem: GraspPose, label: IntArray) -> Moments:
    """Second moments of every segment and band, with the window weights that the problem has now."""
    windows = problem._windows
    return compress(
        problem._grid.windowing, windows.gyro, windows.accelerometer, label, problem._weights.windows
    )


def segment_moments(
    problem: GraspPose, label: IntArray, references: Sequence[State]
) -> tuple[SegmentMoments, ...]:
    """Weighted moments of every segment, less the expected noise; they add up to those of the whole problem.

    Where the whole recording's moments are indefinite, so that the unsegmented problem takes their positive
    part, every segment takes its share of the difference.

    Parameters
    ----------
    references : sequence of State
        A state near every segment's solution, in the names of the unsegmented problem.
    """
    moments = cut_moments(problem, label)
    variances, expected = problem._weights.variances, problem._expected
    dof = moments.dof
    share = dof.sum(axis=1) / dof.sum()
    totals = problem.corrected_moments()
    L = [problem.model.matrices(state) for state in references]
    taken_out = np.zeros(dof.shape[0])
    Z, scores = [], []
    for side, (weight, every, squared, noise) in enumerate(
        (
            (variances.weights[0], moments.gyro, moments.gyro_squared, expected.gyro),
            (
                variances.weights[1],
                moments.accelerometer,
                moments.accelerometer_squared,
                expected.accelerometer,
            ),
        )
    ):
        corrected = np.tensordot(every, weight, axes=(1, 0))
        if problem.settings.errors_in_variables:
            correction = np.tensordot(dof * weight, noise, axes=(1, 0))
            corrected = corrected - correction
            taken_out += [np.sum((m[side] @ C) * m[side]) for m, C in zip(L, correction, strict=True)]
        root = positive_part(totals[side])
        Z.append(corrected + share[:, None, None] * (root @ root.T - totals[side]))
        scores.append(np.tensordot(every if squared is None else squared, weight, axes=(1, 0)))
    t = problem._windows.t
    numbers = 3.0 * (1.0 + float(np.mean(variances.trusted))) * dof.sum(axis=1)
    return tuple(
        SegmentMoments(
            t=float(t[label == k].mean()),
            gyro=Z[0][k],
            accelerometer=Z[1][k],
            gyro_score=scores[0][k],
            accelerometer_score=scores[1][k],
            numbers=float(numbers[k]),
            taken_out=float(max(taken_out[k], 0.0)),
        )
        for k in range(dof.shape[0])
    )


def common_start(problem: GraspPose) -> State:
    """The problem's own start, brought near the best common grasp by a few Gauss-Newton steps."""
    model = problem.model
    precision = prior_precision(model, problem.noise, problem.prior)
    gyro, accelerometer = (root @ root.T for root in map(positive_part, problem.corrected_moments()))
    whole = SegmentFactor(model, SegmentMoments(0.0, gyro, accelerometer, gyro, accelerometer, 0.0), 0.0)
    state = start = problem.initial_state()
    values = []
    for _ in range(8):
        form = whole.quadratic(state)
        gradient, value = form.gradient.copy(), form.value
        for variable in model.variables:
            columns = model.columns[variable.name]
            jacobian, residual = prior_residual(variable, state, problem.prior)
            gradient[columns] += jacobian.T @ (precision[columns] * residual)
            value += 0.5 * float(precision[columns] @ residual**2)
        values.append(value)
        step = np.asarray(-np.linalg.solve(form.matrix + np.diag(precision), gradient), dtype=float)
        if not np.all(np.isfinite(step)) or values[-1] > values[0]:
            return start
        state = problem.retract(state, step)
        if np.max(np.abs(step)) < 1e-6:
            break
    return state


def band_variances(
    problem: GraspPose,
    label: IntArray,
    factors: Sequence[SegmentFactor],
    states: Sequence[State],
    covariances: Sequence[FloatArray],
) -> BandVariances:
    """Residual power of every band as :func:`grasp_noise.estimated_variances`, with every segment's own grasp.

    Parameters
    ----------
    states : sequence of State
        What every segment sees, in the names of the unsegmented problem.
    covariances : sequence of (n, n) ndarray
        Of what every segment sees.
    """
    moments = cut_moments(problem, label)
    dof = moments.dof.sum(axis=0)
    powers, spreads = np.zeros((2, dof.size)), np.zeros((2, dof.size))
    for k, factor in enumerate(factors):
        power, spread = factor.band_powers(
            states[k], covariances[k], moments.gyro[k], moments.accelerometer[k]
        )
        powers += power
        spreads += spread
    current, declared = problem._weights.variances, problem.declared
    trusted = powers[0] <= LARGEST_DISAGREEMENT * np.einsum("bkii->k", moments.gyro[:, :, 0:3, 0:3])
    if not problem.settings.adapt_noise:
        return BandVariances(declared.gyro, declared.accelerometer, trusted)
    taken = np.minimum(spreads * np.stack(current.weights) / (3.0 * dof), _MOST_TAKEN)
    prior = np.stack([declared.gyro, declared.accelerometer])
    found = (powers + PRIOR_DOF * prior) / (3.0 * dof * (1.0 - taken) + PRIOR_DOF)
    # Where a free grasp takes most of what a band holds, more power frees more of it: without damping the
    # weights swing to and fro.
    present = np.stack([current.gyro, current.accelerometer])
    gyro, accelerometer = present * (found / present) ** (1.0 - 0.5 * taken)
    return BandVariances(gyro, accelerometer, trusted)


def window_norms(
    problem: GraspPose, label: IntArray, states: Sequence[State], variances: BandVariances
) -> FloatArray:
    """Root mean square of every window's whitened residual, with every segment's own grasp, (windows,)."""
    windows = problem._windows
    out = np.zeros(windows.t.size)
    L = [problem.model.matrices(state) for state in states]
    for side, (z, variance) in enumerate(
        ((windows.gyro, variances.gyro), (windows.accelerometer, variances.accelerometer))
    ):
        total = np.empty(windows.t.size)
        for k, matrices in enumerate(L):
            own = label == k
            total[own] = (np.sum((z[own] @ matrices[side].T) ** 2, axis=(2, 3)) / variance).sum(axis=1)
        # Outliers have inflated the estimated variances; the median window sets the scale.
        out += total / max(float(np.median(total)), 1e-300)
    return np.asarray(np.sqrt(0.5 * out))

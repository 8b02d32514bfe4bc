"""One segment of a grasp recording as one cost on [rotation; translation; shared unknowns].

The cost ``1/2 tr(L(x) Z L(x)')`` of a segment's moments Z (mathematics 2.3, 2.4) in three dresses: value, gradient and Gauss-Newton matrix;
rows of a least-squares term; and gtsam factors. Taking the expected noise out can leave Z slightly indefinite where the segment excites
nothing. That is kept as it is: with a clipped Z in every segment the segments would no longer add up to the recording. Value and
gradient are always exact; rows, which cannot be indefinite, take the absolute value of the curvature, which changes the path of an
iteration and not where it ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgrasp.problems.grasp_model import GraspModel, quadratic_forms
from factorgrasp.typing import FloatArray, State

# Curvature below this part of the largest (in scaled unknowns) is rounding.
_ROUNDING = 1e-13


@dataclass(frozen=True)
class SegmentMoments:
    """What one segment says.

    Attributes
    ----------
    t : float
        Mean centre of its windows, s, robot clock.
    gyro, accelerometer : (10, 10) and (m, m) ndarray
        Weighted sums over bands, less the expected noise.
    gyro_score, accelerometer_score : (10, 10) and (m, m) ndarray
        The same with squared window weights and with the noise in: the covariance of the scores.
    numbers : float
        Independent numbers in the residuals of both sensors.
    taken_out : float
        Sum of squares that the expected noise makes up at the start: what was taken out of the moments there.
    """

    t: float
    gyro: FloatArray
    accelerometer: FloatArray
    gyro_score: FloatArray
    accelerometer_score: FloatArray
    numbers: float
    taken_out: float = 0.0


@dataclass(frozen=True)
class Quadratic:
    """``value + gradient' d + 1/2 d' matrix d`` of a step d (n,)."""

    value: float
    gradient: FloatArray
    matrix: FloatArray

    def rows(self, offset: float) -> tuple[FloatArray, FloatArray]:
        """``A`` (n + 1, n) and ``b`` (n + 1,): ``A'A = |matrix|``, ``A'b = -gradient``, ``|b|^2 = 2 (value + offset)``.

        The last row of A is zero; its entry of b holds what no step can change. Where an indefinite matrix leaves
        hardly any curvature to a gradient, the promised decrease would exceed the value: there the curvature is
        raised until it does not.
        """
        size = self.gradient.size
        diagonal = np.abs(np.diag(self.matrix))
        scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        values, vectors = np.linalg.eigh(self.matrix / np.outer(scale, scale))
        curvature = np.abs(values)
        pull = vectors.T @ (self.gradient / scale)
        rounding = _ROUNDING * curvature.max(initial=1e-300)
        promised = np.where(curvature > rounding, pull**2 / np.maximum(curvature, rounding), 0.0)
        total = max(2.0 * (self.value + offset), 1e-12)
        if promised.sum() > total:
            most = _cap(promised, total)
            raised = promised > most
            curvature[raised] = pull[raised] ** 2 / most
            promised = np.minimum(promised, most)
        root = np.sqrt(curvature)
        A, b = np.zeros((size + 1, size)), np.zeros(size + 1)
        A[:size] = root[:, None] * vectors.T * scale
        b[:size] = -np.sign(pull) * np.sqrt(promised)
        b[size] = np.sqrt(max(total - float(promised.sum()), 0.0))
        return A, b


def _cap(parts: FloatArray, total: float) -> float:
    """The largest value that every part may have so that they add up to `total` at most."""
    left, count = total, parts.size
    for part in np.sort(parts):
        if part > left / count:
            break
        left, count = left - part, count - 1
    return float(left / max(count, 1))


class SegmentFactor:
    """The cost of one segment at any values of the unknowns.

    Parameters
    ----------
    model : GraspModel
    moments : SegmentMoments
    slip_rate_variance : float
        (rad/s)^2, of the mean angular velocity at which the hand turns against the end-effector within the segment. The gyroscope feels it
        as a bias of this segment alone; it is eliminated. Zero for a hand that does not slip.
    keys : tuple of int
        gtsam keys of rotation, translation and the vector of shared unknowns (the last absent when there are none).
    read : callable
        From ``gtsam.Values`` to a state with the names of the grasp model.
    """

    def __init__(
        self,
        model: GraspModel,
        moments: SegmentMoments,
        slip_rate_variance: float,
        keys: tuple[int, ...] = (),
        read: Callable[[Any], State] = dict,
    ) -> None:
        self.model, self.moments, self.keys = model, moments, keys
        self._gyro, self._accelerometer = _signed_root(moments.gyro), _signed_root(moments.accelerometer)
        self._slip_rate_variance = slip_rate_variance
        self._read = read

    @property
    def offset(self) -> float:
        """Constant that rows add to the value, which less the expected noise may be negative."""
        return 0.5 * (self.moments.numbers + self.moments.taken_out)

    def rows(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Rows of a least-squares term at a state; see :meth:`Quadratic.rows`."""
        return self.quadratic(state).rows(self.offset)

    def quadratic(self, state: State) -> Quadratic:
        """Second-order model of the cost at a state with the names of the grasp model."""
        L_g, L_a, J_g, J_a, slip = self._residuals(state)
        c_g, g_g, H_g = _forms(L_g, J_g, *self._gyro)
        c_a, g_a, H_a = _forms(L_a, J_a, *self._accelerometer)
        value, gradient, matrix = c_g + c_a, g_g + g_a, H_g + H_a
        if slip is not None:
            value += 0.5 * float(slip.rate @ slip.rate) / self._slip_rate_variance
            matrix = matrix - slip.cross @ slip.covariance @ slip.cross.T
        return Quadratic(value, gradient, matrix)

    def score_covariance(self, state: State) -> FloatArray:
        """Covariance (n, n) of the gradient, from the noise of measurement and from the slip."""
        moments = self.moments
        L_g, L_a, J_g, J_a, slip = self._residuals(state)
        meat = quadratic_forms(L_g, J_g, moments.gyro_score)[2]
        if slip is not None:
            gain = slip.cross @ slip.covariance
            cross = _cross(J_g, moments.gyro_score, slip.gain) @ gain.T
            own = slip.gain.T @ slip.gain * moments.gyro_score[9, 9] + np.eye(3) / self._slip_rate_variance
            meat = meat - cross - cross.T + gain @ own @ gain.T
        return np.asarray(meat + quadratic_forms(L_a, J_a, moments.accelerometer_score)[2])

    def band_powers(
        self, state: State, covariance: FloatArray, gyro: FloatArray, accelerometer: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Residual power of every band, and the part ``tr(C J Z J')`` of it that the fit took: (2, bands) each.

        Parameters
        ----------
        covariance : (n, n) ndarray
            Of the unknowns that the segment sees.
        gyro, accelerometer : (bands, 10, 10) and (bands, m, m) ndarray
            Moments of the segment, not weighted.
        """
        L_g, L_a, J_g, J_a, slip = self._residuals(state)
        spread = covariance
        if slip is not None:
            lift = np.vstack([np.eye(covariance.shape[0]), -slip.covariance @ slip.cross.T])
            spread = lift @ covariance @ lift.T
            spread[-3:, -3:] += slip.covariance
            own = np.zeros((3, *J_g.shape[1:]))
            own[:, :, 9] = slip.gain.T
            J_g = np.concatenate([J_g, own])
        powers, taken = [], []
        for L, J, C, Z in ((L_g, J_g, spread, gyro), (L_a, J_a, covariance, accelerometer)):
            size, _, width = J.shape
            powers.append(np.sum((L @ Z) * L, axis=(1, 2)))
            turned = (C @ J.reshape(size, -1)).reshape(-1, width)
            taken.append(np.sum((turned @ Z) * J.reshape(-1, width), axis=(1, 2)))
        return np.stack(powers), np.stack(taken)

    def slip_rate_evidence(self, state: State) -> float:
        """``log det (I + variance H)`` of the slip rate that was eliminated."""
        if self._slip_rate_variance == 0.0:
            return 0.0
        gain = self.model.sensor_matrices(state)[0]
        matrix = gain.T @ gain * self.moments.gyro[9, 9]
        return float(np.linalg.slogdet(np.eye(3) + self._slip_rate_variance * matrix)[1])

    def _residuals(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, _Slip | None]:
        """``L_g``, ``L_a`` and their derivatives, the gyroscope's at the best slip rate."""
        (L_g, L_a), (J_g, J_a) = self.model.matrices(state), self.model.jacobians(state)
        if self._slip_rate_variance == 0.0:
            return L_g, L_a, J_g, J_a, None
        # The rate adds to the bias: it enters the last column of L_g as M_g times the rate, and columns 3 to 5 hold -M_g.
        Z, gain = self.moments.gyro, -L_g[:, 3:6]
        own = np.linalg.inv(gain.T @ gain * Z[9, 9] + np.eye(3) / self._slip_rate_variance)
        rate = -own @ (gain.T @ (L_g @ Z[:, 9]))
        L_g[:, 9] += gain @ rate
        J_g[:, :, 9] -= J_g[:, :, 3:6] @ rate
        return L_g, L_a, J_g, J_a, _Slip(rate, gain, own, _cross(J_g, Z, gain))

    # ---- gtsam -----------------------------------------------------------------------------------------------

    def hessian(self, values: Any) -> Any:
        """``gtsam.HessianFactor`` at ``gtsam.Values``, curvature as it is: to be made again where the values have moved."""
        import gtsam

        form = self.quadratic(self._read(values))
        parts = [slice(0, 3), slice(3, 6), slice(6, None)][: len(self.keys)]
        arguments: list[Any] = list(self.keys)
        for i, part in enumerate(parts):
            arguments += [form.matrix[part, other] for other in parts[i:]]
            arguments.append(-form.gradient[part])
        make: Any = gtsam.HessianFactor
        return make(*arguments, 2.0 * form.value)

    def custom(self) -> Any:
        """``gtsam.CustomFactor`` that hands out the rows at any values: exact for any of gtsam's optimisers, a callback a linearisation."""
        import gtsam

        def error(_this: Any, values: Any, jacobians: Any) -> FloatArray:
            A, b = self.rows(self._read(values))
            if jacobians is not None:
                jacobians[0], jacobians[1] = A[:, 0:3], A[:, 3:6]
                if len(self.keys) == 3:
                    jacobians[2] = A[:, 6:]
            return -b

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(self.model.size + 1), list(self.keys), error)


def _signed_root(Z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``S`` (m, m) and signs (m,) with ``Z = S diag(signs) S'``.

    A residual ``L S`` loses its digits to gravity once; ``L Z L'`` would lose them squared.
    """
    diagonal = np.abs(np.diag(Z))
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(Z / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.abs(values)), np.sign(values)


def _forms(
    L: FloatArray, J: FloatArray, root: FloatArray, signs: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """As :func:`quadratic_forms`, of ``root diag(signs) root'``."""
    size, _, width = J.shape
    residual = L @ root
    signed = residual * signs
    rows = (J.reshape(-1, width) @ root).reshape(size, -1)
    matrix = (rows * np.tile(signs, 3)) @ rows.T
    return 0.5 * float(np.sum(residual * signed)), rows @ signed.ravel(), matrix


@dataclass(frozen=True)
class _Slip:
    """The best slip rate (3,), ``M_g``, the rate's conditional covariance, and the curvature (n, 3) that it shares with the unknowns."""

    rate: FloatArray
    gain: FloatArray
    covariance: FloatArray
    cross: FloatArray


def _cross(J_g: FloatArray, Z: FloatArray, gain: FloatArray) -> FloatArray:
    return np.asarray((J_g @ Z[:, 9]) @ gain)

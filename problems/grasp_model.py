"""The rigid coupling of robot and hand as residuals that are linear in second-moment entries.

With ``R = R_r_h``, ``r = p_r_h`` and ``phi(w, al) = S(al) + S(w)^2`` (mathematics 2.1, Cehajic 2015 (10),
(12)-(14) in corrected form)

    e_g = w_r - M_g (w_h + tau dw_h) + M_g b_g                                    (gyroscope) e_a = f_r + phi
    r - M_a (f_h + tau_a df_h - b_a) - R_w_r' E tilt              (accelerometer, specific force on both
    sides)

where ``M = R (I + C)`` carries the scale and misalignment errors C of the hand's sensor axes and ``tau_a =
tau + delay``. Both are ``L(x) z`` with the measured ``z`` below, so that second moments of z hold all that a
recording says:

    z_g = [w_r (3), w_h (3), dw_h (3), 1] z_a = [f_r (3), al_r (3), vech(w_r w_r') (6), f_h (3), df_h (3), 1,
    R_w_r' E (3 + 3, when the tilt is estimated)]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgrasp import lie
from factorgrasp.typing import FloatArray, State
from factorgrasp.variables import Variable, slices

GYRO_WIDTH = 10
ACCELEROMETER_WIDTH = 19
TILTED_WIDTH = 25
VECH = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _vech_matrices() -> FloatArray:
    """(6, 3, 3): ``(w w' - |w|^2 I) r = sum_k vech(w w')_k V_k r``, the centripetal part of phi r."""
    out = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(VECH):
        out[k, i, j] = out[k, j, i] = 1.0
        if i == j:
            out[k] -= np.eye(3)
    return out


def _unit_matrices() -> FloatArray:
    return np.asarray(np.eye(9).reshape(9, 3, 3))


def _symmetric_matrices() -> FloatArray:
    out = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        out[k, i, j] = out[k, j, i] = 1.0
    return out


_V = _vech_matrices()
_SKEW = lie.skew(np.eye(3))
_FULL = _unit_matrices()
# A rotation of the gyroscope's axes is what R itself means, so only the symmetric part of its errors is a
# parameter.
_SYMMETRIC = _symmetric_matrices()


def _translation_jacobian() -> FloatArray:
    """(3, 3, 12): derivative of ``L_a[:, :12]`` by each component of r; constant."""
    out = np.zeros((3, 3, 12))
    for q in range(3):
        out[q, :, 3:6] = -_SKEW[q]
        out[q, :, 6:12] = _V[:, :, q].T
    return out


_PHI_JACOBIAN = _translation_jacobian()


def phi_matrix(translation: FloatArray) -> FloatArray:
    """(3, 12) matrix that gives ``phi r`` from [f_r, al_r, vech(w_r w_r')] for ``r = translation`` (3,)."""
    return np.asarray((translation @ _PHI_JACOBIAN.reshape(3, 36)).reshape(3, 12))


@dataclass(frozen=True)
class GraspModel:
    """Residual matrices L(x) and their derivatives for the chosen unknowns.

    Attributes
    ----------
    variables : tuple of Variable
        In tangent order; ``rotation`` and ``translation`` come first.
    fixed : mapping
        Values of the unknowns that are not estimated (time offset 0, biases 0, ...).
    """

    variables: tuple[Variable, ...]
    fixed: Mapping[str, FloatArray]

    @cached_property
    def size(self) -> int:
        """Dimension of the tangent space."""
        return sum(variable.size for variable in self.variables)

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Columns of every variable."""
        return slices(self.variables)

    @cached_property
    def accelerometer_width(self) -> int:
        """Entries of z_a."""
        return TILTED_WIDTH if any(v.name == "base_tilt" for v in self.variables) else ACCELEROMETER_WIDTH

    def value(self, state: State, name: str) -> FloatArray:
        """Current value of an unknown, estimated or fixed."""
        return state[name] if name in state else self.fixed[name]

    def matrices(self, state: State) -> tuple[FloatArray, FloatArray]:
        """``L_g`` (3, 10) and ``L_a`` (3, 19 or 25)."""
        tau = float(self.value(state, "time_offset")[0])
        tau_a = tau + float(self.value(state, "accelerometer_delay")[0])
        M_g, M_a = self.sensor_matrices(state)
        L_g = np.empty((3, GYRO_WIDTH))
        L_g[:, 0:3] = np.eye(3)
        L_g[:, 3:6] = -M_g
        L_g[:, 6:9] = -tau * M_g
        L_g[:, 9] = M_g @ self.value(state, "gyro_bias")
        L_a = np.zeros((3, self.accelerometer_width))
        L_a[:, 0:3] = np.eye(3)
        L_a[:, 0:12] += phi_matrix(state["translation"])
        L_a[:, 12:15] = -M_a
        L_a[:, 15:18] = -tau_a * M_a
        L_a[:, 18] = M_a @ self.value(state, "accelerometer_bias")
        if L_a.shape[1] == TILTED_WIDTH:
            tilt = state["base_tilt"]
            L_a[:, 19:22] = -tilt[0] * np.eye(3)
            L_a[:, 22:25] = -tilt[1] * np.eye(3)
        return L_g, L_a

    def sensor_matrices(self, state: State) -> tuple[FloatArray, FloatArray]:
        """``M_g`` and ``M_a`` (3, 3): hand sensor axes to end-effector axes."""
        R = state["rotation"]
        c_g, c_a = self.value(state, "gyro_calibration"), self.value(state, "accelerometer_calibration")
        M_g = R + R @ np.tensordot(c_g, _SYMMETRIC, 1) if c_g.any() else R
        M_a = R + R @ c_a.reshape(3, 3) if c_a.any() else R
        return M_g, M_a

    def jacobians(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Derivatives of L_g (n, 3, 10) and L_a (n, 3, width) by the tangent components."""
        R = state["rotation"]
        tau = float(self.value(state, "time_offset")[0])
        tau_a = tau + float(self.value(state, "accelerometer_delay")[0])
        b_g, b_a = self.value(state, "gyro_bias"), self.value(state, "accelerometer_bias")
        M_g, M_a = self.sensor_matrices(state)
        J_g = np.zeros((self.size, 3, GYRO_WIDTH))
        J_a = np.zeros((self.size, 3, self.accelerometer_width))
        where = self.columns

        def gyro_gain(rows: slice, dM: FloatArray) -> None:
            J_g[rows, :, 3:6] = -dM
            J_g[rows, :, 6:9] = -tau * dM
            J_g[rows, :, 9] = dM @ b_g

        def accelerometer_gain(rows: slice, dM: FloatArray) -> None:
            J_a[rows, :, 12:15] = -dM
            J_a[rows, :, 15:18] = -tau_a * dM
            J_a[rows, :, 18] = dM @ b_a

        turned = R @ _SKEW
        gyro_gain(where["rotation"], turned if M_g is R else turned @ (R.T @ M_g))
        accelerometer_gain(where["rotation"], turned if M_a is R else turned @ (R.T @ M_a))
        J_a[where["translation"], :, :12] = _PHI_JACOBIAN
        if "gyro_bias" in where:
            J_g[where["gyro_bias"], :, 9] = M_g.T
        if "accelerometer_bias" in where:
            J_a[where["accelerometer_bias"], :, 18] = M_a.T
        if "time_offset" in where:
            J_g[where["time_offset"], :, 6:9] = -M_g
            J_a[where["time_offset"], :, 15:18] = -M_a
        if "accelerometer_delay" in where:
            J_a[where["accelerometer_delay"], :, 15:18] = -M_a
        if "base_tilt" in where:
            rows = where["base_tilt"]
            J_a[rows.start, :, 19:22] = -np.eye(3)
            J_a[rows.start + 1, :, 22:25] = -np.eye(3)
        if "gyro_calibration" in where:
            gyro_gain(where["gyro_calibration"], R @ _SYMMETRIC)
        if "accelerometer_calibration" in where:
            accelerometer_gain(where["accelerometer_calibration"], R @ _FULL)
        return J_g, J_a


def quadratic_forms(L: FloatArray, J: FloatArray, Z: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Value, gradient (n,) and Gauss-Newton matrix (n, n) of ``1/2 tr(L Z L')`` for derivatives J (n, 3, m) of L (3, m)."""
    size, _, width = J.shape
    JZ = (J.reshape(-1, width) @ Z).reshape(size, -1)
    return 0.5 * float(np.sum((L @ Z) * L)), JZ @ L.ravel(), JZ @ J.reshape(size, -1).T


def phi_information(Z: FloatArray) -> FloatArray:
    """``sum phi' phi`` (3, 3) from the moments (12, 12) of [f_r, al_r, vech(w_r w_r')]: the excitation of the lever arm."""
    J = _PHI_JACOBIAN.reshape(9, 12)
    return np.asarray(((J @ Z).reshape(3, -1)) @ _PHI_JACOBIAN.reshape(3, -1).T)

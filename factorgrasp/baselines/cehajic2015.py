"""The recursive grasp estimator of Cehajic et al., IROS 2015 (eqs. 15-22): quaternion estimator, then least squares for r.

Two stages per sample: (i) ``R_r_h`` from the angular velocities, as the eigenvector of a matrix that accumulates with
forgetting (Wahba's problem by Davenport's method, eq. 18); (ii) ``p_r_h`` from the accelerations by recursive least squares with
forgetting (eq. 22), taking the first stage's result as exact. No biases, no covariance of the orientation, no time offset.

The printed formulas contain errors; by default their corrected forms run, ``literal=True`` follows the print:

=====================================================  =====================================================================
printed                                                corrected
=====================================================  =====================================================================
``R(q) = (2 eta^2 - 1) I + 2 S(eps) + 2 eps eps'``     ``2 eta S(eps)``
(14), (16), (20): ``v_r = R v_h + phi r``              ``v_r = R v_h - phi r``, as (9), (10) and (13) require
``K = P phi (d I - phi P phi)^-1``                     with ``Psi = -phi``: ``K = P Psi' (d I + Psi P Psi')^-1``
``P+ = (I + K phi) P / d``                             ``P+ = (I - K Psi) P / d``
``q`` is the eigenvector of ``phi_q,k``                of the accumulated ``Phi_q,k``
``q = [eta, eps]`` (1), used for (18) too              the matrix of (18) is ordered ``[eps, eta]``
=====================================================  =====================================================================

(``v`` stands for the acceleration, ``phi = S(al_r) + S(w_r)^2``.) The literal recursion diverges on any motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.lie import project_to_so3, quaternion_wxyz_to_matrix, skew
from factorgrasp.typing import FloatArray

ROTATION_FORGETTING = 0.5
"""``mu_q`` of the paper (1/s)."""
TRANSLATION_FORGETTING = 0.9
"""``mu_r`` of the paper (1/s)."""
INITIAL_QUATERNION_WXYZ = (0.5, 0.5, 0.5, 0.5)
INITIAL_TRANSLATION = (0.5, 0.0, 0.0)
DIVERGED_BEYOND = 1000.0
"""A lever arm longer than this (m) is no estimate of a grasp."""


@dataclass(frozen=True, eq=False)
class CehajicInputs:
    """What the estimator reads, all on one clock.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s, uniform (the paper: 1 ms).
    robot_angular_velocity, robot_angular_acceleration : ndarray, shape (n, 3)
        ``w_r`` (rad/s) and ``al_r`` (rad/s^2), frame ``r``.
    robot_acceleration : ndarray, shape (n, 3)
        Of the end-effector's origin, gravity not included, frame ``r`` (m/s^2).
    hand_angular_velocity : ndarray, shape (n, 3)
        ``w_h`` (rad/s), frame ``h``.
    hand_acceleration : ndarray, shape (n, 3)
        Of the hand, **gravity compensated** with the hand's own orientation estimate, frame ``h`` (m/s^2).
    """

    t: FloatArray
    robot_angular_velocity: FloatArray
    robot_angular_acceleration: FloatArray
    robot_acceleration: FloatArray
    hand_angular_velocity: FloatArray
    hand_acceleration: FloatArray

    def __post_init__(self) -> None:
        n = np.size(self.t)
        for key in self.__dataclass_fields__:
            value = np.asarray(getattr(self, key), dtype=np.float64)
            shape = (n,) if key == "t" else (n, 3)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(
                    f"CehajicInputs.{key}", f"finite numbers, shape {shape}", f"shape {value.shape}"
                )
            object.__setattr__(self, key, value)
        if n < 2:
            raise InputError("CehajicInputs.t", "at least two samples", f"{n}")


@dataclass(frozen=True, eq=False)
class CehajicResult:
    """The estimates after every sample.

    Attributes
    ----------
    t : ndarray, shape (k,)
        s; shorter than the input when the recursion broke off.
    translation : ndarray, shape (k, 3)
        ``p_r_h`` (m).
    rotation_wxyz : ndarray, shape (k, 4)
        ``R_r_h`` as quaternions [w, x, y, z].
    covariance_norm : ndarray, shape (k,)
        Spectral norm of the recursion's ``P`` (the sign of a wind-up; it is no calibrated covariance).
    status : {"completed", "diverged"}
    message : str
        What happened, when it diverged.
    """

    t: FloatArray
    translation: FloatArray
    rotation_wxyz: FloatArray
    covariance_norm: FloatArray
    status: Literal["completed", "diverged"]
    message: str


class CehajicRecursion:
    """One sample at a time: the paper's estimator as it would run on the robot.

    Parameters
    ----------
    step : float
        Sampling time ``t_s`` (s).
    rotation_forgetting, translation_forgetting : float
        ``mu_q``, ``mu_r`` (1/s); the factors are ``exp(-mu t_s)``.
    initial_rotation_wxyz : array_like, shape (4,)
        ``q_0``, [w, x, y, z].
    initial_translation : array_like, shape (3,)
        ``r_0`` (m).
    initial_covariance : array_like, shape (3, 3), optional
        ``P_0``; the identity by default.
    initial_rotation_weight : float
        How much ``q_0`` weighs at the start, in (rad/s)^2: as three perfect samples about three orthogonal axes with this squared
        rate. The paper leaves it open; the default is the counterpart of ``P_0 = I``.
    literal : bool
        Follow the printed formulas, errors included.

    Attributes
    ----------
    rotation_wxyz, translation, covariance : ndarray
        The present estimate: [w, x, y, z], (3,) in m, and ``P`` (3, 3).
    """

    def __init__(
        self,
        step: float,
        *,
        rotation_forgetting: float = ROTATION_FORGETTING,
        translation_forgetting: float = TRANSLATION_FORGETTING,
        initial_rotation_wxyz: npt.ArrayLike = INITIAL_QUATERNION_WXYZ,
        initial_translation: npt.ArrayLike = INITIAL_TRANSLATION,
        initial_covariance: npt.ArrayLike | None = None,
        initial_rotation_weight: float = 1.0,
        literal: bool = False,
    ) -> None:
        self.literal = literal
        self._keep_q = float(np.exp(-rotation_forgetting * step))
        self._keep_r = float(np.exp(-translation_forgetting * step))
        self._floor = self._keep_r * np.eye(3)
        q = np.array(initial_rotation_wxyz, dtype=np.float64)
        self.rotation_wxyz: FloatArray = q / np.linalg.norm(q)
        self.translation: FloatArray = np.array(initial_translation, dtype=np.float64)
        self.covariance: FloatArray = np.array(
            np.eye(3) if initial_covariance is None else initial_covariance, dtype=np.float64
        )
        vector_first = np.roll(self.rotation_wxyz, -1)
        # Davenport's matrix of three orthogonal unit vectors seen through q_0: eigenvalue 3 for q_0, -1 for the rest.
        self._accumulated: FloatArray = initial_rotation_weight * (
            4.0 * np.outer(vector_first, vector_first) - np.eye(4)
        )

    def update(
        self, w_r: FloatArray, al_r: FloatArray, a_r: FloatArray, w_h: FloatArray, a_h: FloatArray
    ) -> None:
        """Take in one sample: rates and accelerations of the robot (frame ``r``) and the hand (frame ``h``), each (3,)."""
        self._update_rotation(w_r.tolist(), w_h.tolist())
        self._update_translation(w_r.tolist(), al_r.tolist(), a_r, a_h)

    def _update_rotation(self, w_r: list[float], w_h: list[float]) -> None:
        a, b, c = w_r
        x, y, z = w_h
        # The lower triangle is all that eigh reads; plain floats are faster than array operations of this size.
        d = a * x + b * y + c * z
        sample = np.array(
            (
                (2.0 * a * x - d, 0.0, 0.0, 0.0),
                (a * y + b * x, 2.0 * b * y - d, 0.0, 0.0),
                (a * z + c * x, b * z + c * y, 2.0 * c * z - d, 0.0),
                (y * c - z * b, z * a - x * c, x * b - y * a, d),
            )
        )
        self._accumulated *= self._keep_q
        self._accumulated += sample
        top = np.linalg.eigh(sample if self.literal else self._accumulated)[1][:, 3]
        # As printed the eigenvector is q = [eta, eps]; the matrix is built for [eps, eta].
        q = top if self.literal else np.array((top[3], top[0], top[1], top[2]))
        # The eigenvector's sign is arbitrary: stay close to the previous quaternion.
        self.rotation_wxyz = q if q @ self.rotation_wxyz >= 0.0 else -q

    def _update_translation(self, w: list[float], al: list[float], a_r: FloatArray, a_h: FloatArray) -> None:
        p, q, r = w
        u, v, s = al
        phi = np.array(
            (
                (-q * q - r * r, p * q - s, p * r + v),
                (p * q + s, -p * p - r * r, q * r - u),
                (p * r - v, q * r + u, -p * p - q * q),
            )
        )
        P = self.covariance
        if self.literal:
            error = a_r - _printed_rotation(self.rotation_wxyz) @ a_h - phi @ self.translation
            gain = P @ phi @ np.linalg.inv(self._floor - phi @ P @ phi)
            self.covariance = (P + gain @ (phi @ P)) / self._keep_r
        else:
            psi = -phi
            error = a_r - quaternion_wxyz_to_matrix(self.rotation_wxyz) @ a_h - psi @ self.translation
            psi_P = psi @ P
            gain = np.linalg.solve(self._floor + psi_P @ psi.T, psi_P).T
            P = (P - gain @ psi_P) / self._keep_r
            # Rounding makes P unsymmetric, and forgetting would let that grow.
            self.covariance = 0.5 * (P + P.T)
        self.translation = self.translation + gain @ error


def _printed_rotation(q: FloatArray) -> FloatArray:
    """``R(q)`` as printed below eq. (1): the factor ``eta`` of ``2 eta S(eps)`` is missing."""
    eta, x, y, z = q.tolist()
    d = 2.0 * eta * eta - 1.0
    return np.array(
        (
            (d + 2.0 * x * x, 2.0 * (x * y - z), 2.0 * (x * z + y)),
            (2.0 * (x * y + z), d + 2.0 * y * y, 2.0 * (y * z - x)),
            (2.0 * (x * z - y), 2.0 * (y * z + x), d + 2.0 * z * z),
        )
    )


def estimate_cehajic2015(
    inputs: CehajicInputs,
    *,
    rotation_forgetting: float = ROTATION_FORGETTING,
    translation_forgetting: float = TRANSLATION_FORGETTING,
    initial_rotation_wxyz: npt.ArrayLike = INITIAL_QUATERNION_WXYZ,
    initial_translation: npt.ArrayLike = INITIAL_TRANSLATION,
    initial_covariance: npt.ArrayLike | None = None,
    initial_rotation_weight: float = 1.0,
    literal: bool = False,
) -> CehajicResult:
    """Run :class:`CehajicRecursion` over a recording and keep every estimate.

    Breaks off, keeping the history, when a number is no longer finite or ``P`` is no longer positive (a covariance that wound
    up until rounding ruled it); the literal formulas are only stopped by numbers that are not finite. A lever arm that ends
    beyond :data:`DIVERGED_BEYOND` counts as diverged, too.

    Parameters
    ----------
    inputs : CehajicInputs
        The signals of both sides on one clock.
    rotation_forgetting, translation_forgetting, initial_rotation_wxyz, initial_translation, initial_covariance
        As for :class:`CehajicRecursion`; the paper's values by default.
    initial_rotation_weight, literal
        Likewise.

    Returns
    -------
    CehajicResult
    """
    step = float(np.median(np.diff(inputs.t)))
    recursion = CehajicRecursion(
        step,
        rotation_forgetting=rotation_forgetting,
        translation_forgetting=translation_forgetting,
        initial_rotation_wxyz=initial_rotation_wxyz,
        initial_translation=initial_translation,
        initial_covariance=initial_covariance,
        initial_rotation_weight=initial_rotation_weight,
        literal=literal,
    )
    n = inputs.t.size
    translation, rotation, covariance = np.empty((n, 3)), np.empty((n, 4)), np.empty((n, 3, 3))
    done, message = n, ""
    signals = (
        inputs.robot_angular_velocity,
        inputs.robot_angular_acceleration,
        inputs.robot_acceleration,
        inputs.hand_angular_velocity,
        inputs.hand_acceleration,
    )
    with np.errstate(over="ignore", invalid="ignore"):
        for k, sample in enumerate(zip(*signals, strict=True)):
            try:
                recursion.update(*sample)
            except np.linalg.LinAlgError as error:
                done, message = k, f"{error} in sample {k}"
                break
            P = recursion.covariance
            smallest = min(P[0, 0], P[1, 1], P[2, 2])
            # A sum is finite only if all its terms are.
            if not np.isfinite(P.sum() + recursion.translation.sum()):
                done, message = k, f"not finite in sample {k}"
                break
            if not literal and smallest <= 0.0:
                done, message = k, f"P not positive in sample {k}"
                break
            translation[k], rotation[k], covariance[k] = recursion.translation, recursion.rotation_wxyz, P
        norm = np.linalg.norm(covariance[:done], ord=2, axis=(1, 2)) if done else np.empty(0)
    last = float(np.linalg.norm(translation[done - 1])) if done else float("nan")
    if not message and last > DIVERGED_BEYOND:
        message = f"the lever arm has grown to {last:.3g} m"
    return CehajicResult(
        inputs.t[:done],
        translation[:done],
        rotation[:done],
        norm,
        "diverged" if message else "completed",
        message,
    )


def batch_cehajic2015(inputs: CehajicInputs) -> tuple[FloatArray, FloatArray]:
    """Both stages over a whole recording at once: every sample weighs alike, and nothing is known at the start.

    What :class:`CehajicRecursion` tends to without forgetting and with a weak start, except that the second stage here uses the
    final rotation for all samples.

    Parameters
    ----------
    inputs : CehajicInputs
        The signals of both sides on one clock.

    Returns
    -------
    rotation : ndarray, shape (3, 3)
        ``R_r_h``, Wahba's solution for the angular velocities.
    translation : ndarray, shape (3,)
        ``p_r_h`` (m), least squares on ``a_r - R a_h = -phi r``.
    """
    R = project_to_so3(inputs.robot_angular_velocity.T @ inputs.hand_angular_velocity)
    w = skew(inputs.robot_angular_velocity)
    psi = -(skew(inputs.robot_angular_acceleration) + w @ w).reshape(-1, 3)
    left = (inputs.robot_acceleration - inputs.hand_acceleration @ R.T).reshape(-1)
    return R, np.asarray(np.linalg.solve(psi.T @ psi, psi.T @ left))

"""Batched SO(3) and SE(3) maps over numpy arrays.

Every function works on the last axes and broadcasts over all leading ones: a rotation vector is ``(..., 3)``,
a rotation matrix ``(..., 3, 3)``, a quaternion ``(..., 4)`` in the order ``[w, x, y, z]`` (Hamilton), a twist
``(..., 6)`` in the order ``[linear; angular]`` and a pose ``(..., 4, 4)``. Angles are in radians. NaN in, NaN
out: a gap stays a gap.

Names follow Barfoot, *State Estimation for Robotics*: ``so3_exp(phi + dphi) = so3_exp(J_l dphi) so3_exp(phi)
= so3_exp(phi) so3_exp(J_r dphi)`` to first order.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray

# Below this angle (rad) the closed forms of the Jacobians lose digits to cancellation (1e-14 here) and the
# series here are exact to rounding.
_SERIES_BELOW = 0.5
# |B_2k| / (2 k)! for k = 1 ... 7, with the Bernoulli numbers: the series of (1 - theta/2 cot(theta/2)) / theta^2.
_INVERSE_SERIES = (
    1.0 / 12.0,
    1.0 / 720.0,
    1.0 / 30240.0,
    1.0 / 1209600.0,
    1.0 / 47900160.0,
    691.0 / 1307674368000.0,
    1.0 / 74724249600.0,
)


def _array(value: npt.ArrayLike, name: str, tail: tuple[int, ...]) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape[-len(tail) :] != tail:
        want = "(..., " + ", ".join(str(n) for n in tail) + ")"
        raise InputError(name, f"shape {want}", f"shape {array.shape}")
    return array


def skew(v: npt.ArrayLike) -> FloatArray:
    """Cross-product matrix ``S(v)`` with ``S(v) u = v x u``: ``(..., 3)`` to ``(..., 3, 3)``."""
    v = _array(v, "v", (3,))
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1] = -v[..., 2]
    out[..., 0, 2] = v[..., 1]
    out[..., 1, 0] = v[..., 2]
    out[..., 1, 2] = -v[..., 0]
    out[..., 2, 0] = -v[..., 1]
    out[..., 2, 1] = v[..., 0]
    return out


def vee(S: npt.ArrayLike) -> FloatArray:
    """Inverse of :func:`skew`; of a general matrix, the vector of its skew-symmetric part."""
    S = _array(S, "S", (3, 3))
    out = np.empty(S.shape[:-1])
    out[..., 0] = S[..., 2, 1] - S[..., 1, 2]
    out[..., 1] = S[..., 0, 2] - S[..., 2, 0]
    out[..., 2] = S[..., 1, 0] - S[..., 0, 1]
    out *= 0.5
    return out


def _squared_norm(v: FloatArray) -> FloatArray:
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    out: FloatArray = x * x + y * y + z * z
    return out


def _identity_plus(v: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """``I + a S(v) + b S(v)^2``, written out: six times faster than stacked matrix products."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    bx, by, bz = b * x, b * y, b * z
    ax, ay, az = a * x, a * y, a * z
    xx, yy, zz = bx * x, by * y, bz * z
    xy, xz, yz = bx * y, bx * z, by * z
    out = np.empty((*v.shape, 3))
    out[..., 0, 0] = 1.0 - (yy + zz)
    out[..., 0, 1] = xy - az
    out[..., 0, 2] = xz + ay
    out[..., 1, 0] = xy + az
    out[..., 1, 1] = 1.0 - (xx + zz)
    out[..., 1, 2] = yz - ax
    out[..., 2, 0] = xz - ay
    out[..., 2, 1] = yz + ax
    out[..., 2, 2] = 1.0 - (xx + yy)
    return out


def _sinc(x: FloatArray) -> FloatArray:
    """``sin(x) / x`` with 1 at 0 (numpy's sinc has a factor pi in it)."""
    at_zero = x == 0.0
    out: FloatArray = np.where(at_zero, 1.0, np.sin(x) / np.where(at_zero, 1.0, x))
    return out


def so3_exp(phi: npt.ArrayLike) -> FloatArray:
    """Rotation matrix of a rotation vector (Rodrigues): ``(..., 3)`` rad to ``(..., 3, 3)``."""
    phi = _array(phi, "phi", (3,))
    half = 0.5 * np.sqrt(_squared_norm(phi))
    k = _sinc(half)
    return _identity_plus(phi, k * np.cos(half), 0.5 * k * k)


def so3_log(R: npt.ArrayLike) -> FloatArray:
    """Rotation vector of a rotation matrix, angle in [0, pi]: ``(..., 3, 3)`` to ``(..., 3)`` rad.

    Goes through the quaternion, which keeps full precision at both ends (near 0 and near pi). At exactly pi
    the sign of the axis is arbitrary but always the same for the same matrix.
    """
    return quaternion_log_wxyz(matrix_to_quaternion_wxyz(R))


def quaternion_exp_wxyz(phi: npt.ArrayLike) -> FloatArray:
    """Unit quaternion ``[w, x, y, z]`` of a rotation vector: ``(..., 3)`` rad to ``(..., 4)``."""
    phi = _array(phi, "phi", (3,))
    half = 0.5 * np.sqrt(_squared_norm(phi))
    out = np.empty((*phi.shape[:-1], 4))
    out[..., 0] = np.cos(half)
    out[..., 1:] = (0.5 * _sinc(half))[..., None] * phi
    return out


def quaternion_log_wxyz(q: npt.ArrayLike) -> FloatArray:
    """Rotation vector, angle in [0, pi], of a quaternion ``[w, x, y, z]`` (any norm, either sign)."""
    q = _array(q, "q", (4,))
    w, v = q[..., 0], q[..., 1:]
    sine = np.sqrt(_squared_norm(v))
    at_zero = sine == 0.0
    angle = 2.0 * np.arctan2(sine, np.abs(w))
    # With v = 0 the direction does not matter; anything finite will do.
    scale = angle / np.where(at_zero, 1.0, sine)
    out: FloatArray = np.copysign(scale, w)[..., None] * v
    return out


def _third_coefficient(theta2: FloatArray) -> FloatArray:
    """``(theta - sin theta) / theta^3``."""
    small = theta2 < _SERIES_BELOW**2
    safe = np.where(small, 1.0, theta2)
    theta = np.sqrt(safe)
    t = np.where(small, theta2, 0.0)
    series = (
        1.0
        - t
        / 20.0
        * (1.0 - t / 42.0 * (1.0 - t / 72.0 * (1.0 - t / 110.0 * (1.0 - t / 156.0 * (1.0 - t / 210.0)))))
    ) / 6.0
    out: FloatArray = np.where(small, series, (theta - np.sin(theta)) / (safe * theta))
    return out


def so3_left_jacobian(phi: npt.ArrayLike) -> FloatArray:
    """Left Jacobian ``J_l(phi) = I + (1 - cos) / theta^2 S + (theta - sin) / theta^3 S^2``."""
    phi = _array(phi, "phi", (3,))
    theta2 = _squared_norm(phi)
    k = _sinc(0.5 * np.sqrt(theta2))
    return _identity_plus(phi, 0.5 * k * k, _third_coefficient(theta2))


def so3_right_jacobian(phi: npt.ArrayLike) -> FloatArray:
    """Right Jacobian ``J_r(phi) = J_l(-phi)``; for ``R = so3_exp(phi)`` the body rate is ``J_r(phi) dphi/dt``."""
    return so3_left_jacobian(-np.asarray(phi, dtype=np.float64))


def so3_left_jacobian_inverse(phi: npt.ArrayLike) -> FloatArray:
    """Inverse left Jacobian ``I - S / 2 + (1 - theta/2 cot(theta/2)) / theta^2 S^2``; singular at 2 pi."""
    phi = _array(phi, "phi", (3,))
    theta2 = _squared_norm(phi)
    small = theta2 < _SERIES_BELOW**2
    safe = np.where(small, 1.0, theta2)
    half = 0.5 * np.sqrt(safe)
    t = np.where(small, theta2, 0.0)
    series = np.full_like(t, _INVERSE_SERIES[-1])
    for coefficient in reversed(_INVERSE_SERIES[:-1]):
        series = coefficient + t * series
    closed = (1.0 - half * np.cos(half) / np.sin(half)) / safe
    return _identity_plus(phi, np.full_like(theta2, -0.5), np.where(small, series, closed))


def so3_right_jacobian_inverse(phi: npt.ArrayLike) -> FloatArray:
    """Inverse right Jacobian ``J_r^-1(phi) = J_l^-1(-phi)``; ``dphi/dt = J_r^-1(phi) w``, ``w`` the body rate."""
    return so3_left_jacobian_inverse(-np.asarray(phi, dtype=np.float64))


def quaternion_wxyz_to_matrix(q: npt.ArrayLike) -> FloatArray:
    """Rotation matrix of a quaternion ``[w, x, y, z]`` of any norm but 0: ``(..., 4)`` to ``(..., 3, 3)``."""
    q = _array(q, "q", (4,))
    w, v = q[..., 0], q[..., 1:]
    # 2 / |q|^2 instead of 2: a rotation results even from a quaternion rounded in a text file.
    s = 2.0 / (w * w + _squared_norm(v))
    return _identity_plus(v, s * w, s)


def matrix_to_quaternion_wxyz(R: npt.ArrayLike, *, continuous: bool = False) -> FloatArray:
    """Unit quaternion ``[w, x, y, z]`` of a rotation matrix: ``(..., 3, 3)`` to ``(..., 4)``.

    Parameters
    ----------
    R : array_like, shape (..., 3, 3)
        Rotation matrices.
    continuous : bool
        False: every quaternion has ``w >= 0``. True: ``R`` is a sequence ``(n, 3, 3)``, and signs are chosen
        such that neighbours are close (rows of NaN are skipped); the first has ``w >= 0``.
    """
    R = _array(R, "R", (3, 3))
    r00, r11, r22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    wx, wy, wz = (
        R[..., 2, 1] - R[..., 1, 2],
        R[..., 0, 2] - R[..., 2, 0],
        R[..., 1, 0] - R[..., 0, 1],
    )
    out = np.empty((*R.shape[:-2], 4))
    ww = 1.0 + r00 + r11 + r22
    out[..., 0], out[..., 1], out[..., 2], out[..., 3] = ww, wx, wy, wz
    # Shepperd: divide by the largest component. Up to about 140 degrees that may be w (4 w^2 >= 0.5 loses no
    # digits worth having), so only the others need their own row of 4 q q'.
    rest = ww < 0.5
    if np.any(rest):
        M = R[rest]
        m00, m11, m22 = M[:, 0, 0], M[:, 1, 1], M[:, 2, 2]
        xy, xz, yz = M[:, 0, 1] + M[:, 1, 0], M[:, 0, 2] + M[:, 2, 0], M[:, 1, 2] + M[:, 2, 1]
        vx, vy, vz = wx[rest], wy[rest], wz[rest]
        outer = np.stack(
            [
                np.stack([vx, 1.0 + m00 - m11 - m22, xy, xz], axis=-1),
                np.stack([vy, xy, 1.0 - m00 + m11 - m22, yz], axis=-1),
                np.stack([vz, xz, yz, 1.0 - m00 - m11 + m22], axis=-1),
            ],
            axis=-2,
        )
        largest = np.argmax(np.stack([m00, m11, m22], axis=-1), axis=-1)
        row = outer[np.arange(largest.size), largest]
        out[rest] = np.where(row[:, :1] < 0.0, -row, row)
    x, y, z, w = out[..., 1], out[..., 2], out[..., 3], out[..., 0]
    out /= np.sqrt(w * w + x * x + y * y + z * z)[..., None]
    return continuous_quaternions(out) if continuous else out


def continuous_quaternions(q: npt.ArrayLike) -> FloatArray:
    """The same rotations, ``(n, 4)``, with signs such that neighbours in time are close; NaN rows are skipped."""
    q = _array(q, "q", (4,))
    if q.ndim != 2:
        raise InputError("q", "a sequence, shape (n, 4)", f"shape {q.shape}")
    known = np.flatnonzero(np.isfinite(q).all(axis=1))
    if known.size < 2:
        return q.copy()
    kept = q if known.size == len(q) else q[known]
    flips = np.einsum("ij,ij->i", kept[1:], kept[:-1]) < 0.0
    out = q.copy()
    if flips.any():
        odd = np.flatnonzero(np.logical_xor.accumulate(flips)) + 1
        out[known[odd]] *= -1.0
    return out


def quaternion_multiply_wxyz(a: npt.ArrayLike, b: npt.ArrayLike) -> FloatArray:
    """Hamilton product ``a b`` of quaternions ``[w, x, y, z]``: the rotation ``R(a) R(b)``."""
    a, b = _array(a, "a", (4,)), _array(b, "b", (4,))
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = aw * bw - ax * bx - ay * by - az * bz
    out[..., 1] = aw * bx + ax * bw + ay * bz - az * by
    out[..., 2] = aw * by - ax * bz + ay * bw + az * bx
    out[..., 3] = aw * bz + ax * by - ay * bx + az * bw
    return out


def quaternion_conjugate(q: npt.ArrayLike) -> FloatArray:
    """Conjugate of quaternions ``[w, x, y, z]``; the inverse rotation for a unit quaternion."""
    out = _array(q, "q", (4,)).copy()
    out[..., 1:] *= -1.0
    return out


def se3_exp(xi: npt.ArrayLike) -> FloatArray:
    """Pose of a twist ``[linear; angular]`` (m, rad): ``(..., 6)`` to ``(..., 4, 4)``."""
    xi = _array(xi, "xi", (6,))
    rho, phi = xi[..., :3], xi[..., 3:]
    out = np.zeros((*xi.shape[:-1], 4, 4))
    out[..., :3, :3] = so3_exp(phi)
    out[..., :3, 3] = np.einsum("...ij,...j->...i", so3_left_jacobian(phi), rho)
    out[..., 3, 3] = 1.0
    return out


def se3_log(T: npt.ArrayLike) -> FloatArray:
    """Twist ``[linear; angular]`` (m, rad) of a pose, angle in [0, pi]: ``(..., 4, 4)`` to ``(..., 6)``."""
    T = _array(T, "T", (4, 4))
    phi = so3_log(T[..., :3, :3])
    out = np.empty((*T.shape[:-2], 6))
    out[..., 3:] = phi
    out[..., :3] = np.einsum("...ij,...j->...i", so3_left_jacobian_inverse(phi), T[..., :3, 3])
    return out


def project_to_so3(M: npt.ArrayLike) -> FloatArray:
    """Nearest rotation in the Frobenius norm, by singular values: ``(..., 3, 3)``; always determinant +1.

    Rows with NaN give NaN.
    """
    M = _array(M, "M", (3, 3))
    finite = np.asarray(np.isfinite(M).all(axis=(-2, -1)))
    # LAPACK refuses NaN for the whole stack, so gaps stand aside as identities.
    U, _, Vt = np.linalg.svd(M if finite.all() else np.where(finite[..., None, None], M, np.eye(3)))
    U = U.copy()
    U[..., :, 2] *= (np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    out: FloatArray = U @ Vt
    return out if finite.all() else np.where(finite[..., None, None], out, np.nan)


def angle_between(Ra: npt.ArrayLike, Rb: npt.ArrayLike) -> FloatArray:
    """Angle in [0, pi] (rad) of ``Ra' Rb``; full precision near 0 and near pi."""
    Ra, Rb = _array(Ra, "Ra", (3, 3)), _array(Rb, "Rb", (3, 3))
    relative = np.swapaxes(Ra, -1, -2) @ Rb
    sine = np.sqrt(_squared_norm(vee(relative)))
    cosine = 0.5 * (np.trace(relative, axis1=-2, axis2=-1) - 1.0)
    out: FloatArray = np.arctan2(sine, cosine)
    return out

"""What excitation, wrench and information are at one instant, as CasADi expressions (mathematics 2.1 and 3).

Frames: world ``w``, end-effector ``r``, the human's hand ``h``; ``d`` marks what the human wants: wrist position ``p_d`` and the
orientation ``R_d`` of the end-effector that goes with the wanted orientation of the hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgrasp.typing import FloatArray

GIVEN = 24
"""Numbers of an instant: R_d (9, column by column), w_d (3) and its rate (3) in frame d, p_d (3), its acceleration (3), an axis (3)."""
MOMENTS = 37
"""energy, phi'phi (6), al (3), vech w w' (6), w (3), vech f f' (6), f (3), S(f)'phi (9)."""
_SERIES = 9


@dataclass(frozen=True, eq=False)
class Given:
    """The numbers of an instant by name."""

    rotation: Any
    rate: Any
    rate_change: Any
    position: Any
    acceleration: Any
    axis: Any

    @staticmethod
    def of(p: Any) -> Given:
        """From their column (24,)."""
        ca = _casadi()
        return Given(ca.reshape(p[:9], 3, 3), p[9:12], p[12:15], p[15:18], p[18:21], p[21:24])


@dataclass(frozen=True, eq=False)
class Instant:
    """Motion of the end-effector at an instant, in its own axes where nothing else is said.

    Attributes
    ----------
    rotation, position : ``R_w_r``, ``p_w_r``
    rate, rate_change : angular velocity and acceleration.
    force : specific force at the wrist ``R_w_r' (a_h - g)``.
    wrist : ``p_w_h`` with the estimated grasp.
    turn : rotation vector from the orientation that the human wants to the one there is.
    """

    rotation: Any
    position: Any
    rate: Any
    rate_change: Any
    force: Any
    wrist: Any
    turn: Any


def about_the_wrist(z: Any, p: Any, lever: FloatArray, gravity: FloatArray) -> Instant:
    """The end-effector turns about the wrist: ``R_w_r = R_d Exp(rho)``, ``p_r = p_d - R_w_r r`` (pose level, mathematics 3).

    `z` is ``[rho, d rho, d2 rho]`` with three coordinates, or one: the angle about the given axis.
    """
    ca = _casadi()
    given = Given.of(p)
    m = z.numel() // 3
    rho, first, second = (z[k * m : (k + 1) * m] for k in range(3))
    if m == 1:
        rho, first, second = (given.axis * part for part in (rho, first, second))
    square = ca.dot(rho, rho)
    a, b = _series(square, 0), _series(square, 1)
    c = _series(square, 2)
    S = ca.skew(rho)
    E = ca.DM.eye(3) + a * S + b * (S @ S)
    right = ca.DM.eye(3) - b * S + c * (S @ S)
    own = right @ first
    own_change = right @ second + ca.jtimes(own, rho, first) if m == 3 else second
    turned = E.T @ given.rate
    rate = turned + own
    change = E.T @ given.rate_change + ca.cross(turned, own) + own_change
    R = given.rotation @ E
    force = R.T @ (given.acceleration - ca.DM(gravity))
    return Instant(R, given.position - R @ ca.DM(lever), rate, change, force, given.position, rho)


def of_the_robot(robot: Any, frame: str, z: Any, p: Any, lever: FloatArray, gravity: FloatArray) -> Instant:
    """The end-effector of a :class:`factorgrasp.models.casadi_robot.CasadiRobot`; `z` is [q, v, a] of a robot without quaternions."""
    ca = _casadi()
    given, n = Given.of(p), robot.nv
    motion = robot.motion(z[:n], z[n : 2 * n], z[2 * n :])
    R, position = robot.placement(motion, frame)
    _, rate = robot.twist(motion, frame)
    acceleration, change = robot.acceleration(motion, frame)
    r = ca.DM(lever)
    at_wrist = acceleration + phi_matrix(rate, change) @ r
    turn = rotation_vector(given.rotation.T @ R)
    return Instant(R, position, rate, change, at_wrist - R.T @ ca.DM(gravity), position + R @ r, turn)


def phi_matrix(rate: Any, change: Any) -> Any:
    """``S(al) + S(w)^2`` (3, 3)."""
    ca = _casadi()
    return ca.skew(change) + ca.skew(rate) @ ca.skew(rate)


def wrench_energy(
    instant: Instant,
    p: Any,
    covariance: FloatArray,
    stiffness: tuple[float, float],
    comfort: tuple[float, float],
) -> Any:
    """Expected ``|f|^2 / f_0^2 + |m|^2 / m_0^2`` at the wrist through its stiffness (paper (4), with the pose error).

    The wrist is where the human wants it at the start, so that an error of the lever arm shows as far as the object has turned:
    ``p_d - p_h = (p_d - p_hat) + (R_d - R) (r - r_hat)``.
    """
    ca = _casadi()
    k_f, k_m = stiffness[0] / comfort[0], stiffness[1] / comfort[1]
    force = k_f**2 * force_square(instant, p, covariance)
    return force + k_m**2 * ca.dot(instant.turn, instant.turn)


def force_square(instant: Instant, p: Any, covariance: FloatArray) -> Any:
    """Expected square of the wrist's displacement, m^2; `covariance` (3, 3) of the lever arm."""
    ca = _casadi()
    given = Given.of(p)
    away = given.position - instant.wrist
    moved = given.rotation - instant.rotation
    return ca.dot(away, away) + ca.trace(moved @ ca.DM(covariance) @ moved.T)


def excitation_moments(instant: Instant) -> list[Any]:
    """``phi'phi`` (6), ``al`` (3), ``vech w w'`` (6): all that the centred excitation matrix needs."""
    _casadi()
    phi = phi_matrix(instant.rate, instant.rate_change)
    return [_upper(phi.T @ phi), instant.rate_change, _upper(instant.rate @ instant.rate.T)]


def information_moments(instant: Instant) -> list[Any]:
    """The rest of what the information about (R, r) and the biases is made of."""
    ca = _casadi()
    phi, f = phi_matrix(instant.rate, instant.rate_change), instant.force
    return [instant.rate, _upper(f @ f.T), f, ca.reshape(ca.skew(f).T @ phi, 9, 1)]


def centred_excitation(s: Any, length: float, alpha: float, centred: bool) -> Any:
    """Upper triangle (6,) of the excitation matrix of a window over `alpha`, from its integrals [energy, phi'phi, al, vech w w', ...].

    Centred: what a constant accelerometer bias cannot explain, ``int phi'phi - (int phi)' (int phi) / T``.
    """
    _casadi()
    G = _symmetric(s[1:7])
    if centred:
        mean = _mean_phi(s)
        G = G - mean.T @ mean / length
    return _upper(G) / alpha


def _mean_phi(s: Any) -> Any:
    """``int phi`` from ``int al`` and ``int vech w w'``."""
    ca = _casadi()
    W = _symmetric(s[10:16])
    return ca.skew(s[7:10]) + W - ca.trace(W) * ca.DM.eye(3)


@dataclass(frozen=True)
class SensorNoise:
    """What the information of a motion depends on.

    Attributes
    ----------
    gyro, accelerometer : float
        Densities of the two residuals, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz), the robot's part included.
    gyro_bias, accelerometer_bias : float
        Prior sd; zero where the bias is known.
    """

    gyro: float
    accelerometer: float
    gyro_bias: float
    accelerometer_bias: float


def grasp_information(s: Any, noise: SensorNoise, length: float, prior: FloatArray) -> Any:
    """Information (6, 6) about [turn of R about the axes of r, lever arm], biases projected out, from the integrals of a window.

    Residuals (mathematics 2.1): ``e_g = w_r - R w_h`` with Jacobian ``[S(w), 0, I, 0]`` and ``e_a = f_r + phi r - R f_h`` with
    ``[S(f), phi, 0, I]`` by (turn, lever arm, gyroscope bias, accelerometer bias), white with the given densities; `prior` (6, 6) is
    what was known before.
    """
    ca = _casadi()
    w_g, w_a = 1.0 / noise.gyro**2, 1.0 / noise.accelerometer**2
    WW, FF = _symmetric(s[10:16]), _symmetric(s[19:25])
    cross = ca.reshape(s[28:37], 3, 3)
    top = ca.horzcat(w_g * _cross_square(WW) + w_a * _cross_square(FF), w_a * cross)
    bottom = ca.horzcat(w_a * cross.T, w_a * _symmetric(s[1:7]))
    information = ca.vertcat(top, bottom) + ca.DM(prior)
    zero = ca.DM.zeros(3, 3)
    if noise.gyro_bias > 0.0:
        mixed = w_g * ca.vertcat(ca.skew(s[16:19]).T, zero)
        information -= mixed @ mixed.T / (w_g * length + 1.0 / noise.gyro_bias**2)
    if noise.accelerometer_bias > 0.0:
        mixed = w_a * ca.vertcat(ca.skew(s[25:28]).T, _mean_phi(s).T)
        information -= mixed @ mixed.T / (w_a * length + 1.0 / noise.accelerometer_bias**2)
    return information


def _cross_square(M: Any) -> Any:
    """``int S(v)' S(v)`` from ``int v v'``."""
    ca = _casadi()
    return ca.trace(M) * ca.DM.eye(3) - M


def variance_ratios(information: Any, targets: FloatArray) -> Any:
    """``target_i^2 / P_ii`` (6,) for the covariance P: at least one where the target sd is met. NaN where the target is infinite."""
    ca = _casadi()
    # Scaled by the targets first: rotations and lengths have units of their own.
    wanted = [i for i in range(6) if np.isfinite(targets[i])]
    D = ca.DM(np.diag(np.where(np.isfinite(targets), targets, 1.0)))
    L = _cholesky(D @ information @ D)
    inverse = _lower_inverse(L)
    return ca.vertcat(*[1.0 / ca.dot(inverse[:, i], inverse[:, i]) for i in wanted])


def _cholesky(A: Any) -> Any:
    ca = _casadi()
    n = A.shape[0]
    L = ca.SX(n, n)
    for j in range(n):
        rest = A[j, j] - ca.dot(L[j, :j], L[j, :j]) if j else A[j, j]
        L[j, j] = ca.sqrt(rest)
        for i in range(j + 1, n):
            L[i, j] = (A[i, j] - (ca.dot(L[i, :j], L[j, :j]) if j else 0.0)) / L[j, j]
    return L


def _lower_inverse(L: Any) -> Any:
    ca = _casadi()
    n = L.shape[0]
    out = ca.SX(n, n)
    for j in range(n):
        out[j, j] = 1.0 / L[j, j]
        for i in range(j + 1, n):
            out[i, j] = -ca.dot(L[i, j:i].T, out[j:i, j]) / L[i, i]
    return out


def rotation_vector(R: Any) -> Any:
    """Logarithm (3,) of a rotation, smooth at zero; to 1e-8 up to a right angle, an even function of the angle beyond."""
    ca = _casadi()
    axis = 0.5 * ca.vertcat(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    u = 1.0 - 0.5 * (ca.trace(R) - 1.0)
    # theta / sin(theta) as a series in u = 1 - cos(theta).
    term, total = 1.0, 1.0
    for n in range(1, 30):
        term = term * u * n / (2 * n + 1)
        total = total + term
    return axis * total


def _series(square: Any, kind: int) -> Any:
    """sin(x)/x, (1 - cos x)/x^2 or (x - sin x)/x^3 by its Taylor series in x^2: smooth at zero, exact to rounding up to two radians."""
    first = (1.0, 0.5, 1.0 / 6.0)[kind]
    total, term = first, first
    for n in range(1, _SERIES):
        term = -term * square / ((2 * n + kind) * (2 * n + kind + 1))
        total = total + term
    return total


def _upper(M: Any) -> Any:
    ca = _casadi()
    n = M.shape[0]
    return ca.vertcat(*[M[i, j] for i in range(n) for j in range(i, n)])


def _symmetric(v: Any) -> Any:
    ca = _casadi()
    return ca.vertcat(
        ca.horzcat(v[0], v[1], v[2]), ca.horzcat(v[1], v[3], v[4]), ca.horzcat(v[2], v[4], v[5])
    )


def _casadi() -> Any:
    import casadi

    return casadi

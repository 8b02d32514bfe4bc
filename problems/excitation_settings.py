"""What a user says about an excitation: the grasp as it is known, the human's wrist, what is asked for, and the robot's limits."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.problems.grasp_settings import GraspNoise
from factorgrasp.typing import FloatArray


@dataclass(frozen=True, eq=False)
class GraspBelief:
    """The grasp as it is known before the motion.

    Attributes
    ----------
    rotation : ndarray, shape (3, 3)
        ``R_r_h``.
    translation : ndarray, shape (3,)
        ``p_r_h``, m.
    covariance : ndarray, shape (6, 6)
        Of [rotation about the hand's axes (rad), translation (m)].
    """

    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    translation: FloatArray = field(default_factory=lambda: np.zeros(3))
    covariance: FloatArray = field(default_factory=lambda: np.diag([0.2**2] * 3 + [0.05**2] * 3))

    def __post_init__(self) -> None:
        R, P = np.asarray(self.rotation, dtype=float), np.asarray(self.covariance, dtype=float)
        if R.shape != (3, 3) or np.max(np.abs(R.T @ R - np.eye(3))) > 1e-6 or np.linalg.det(R) < 0.0:
            raise InputError("grasp.rotation", "a rotation matrix (3, 3)", f"{R.tolist()}")
        if np.shape(self.translation) != (3,) or not np.all(np.isfinite(self.translation)):
            raise InputError("grasp.translation", "3 finite numbers, m", f"{self.translation}")
        if (
            P.shape != (6, 6)
            or not np.all(np.isfinite(P))
            or np.max(np.abs(P - P.T)) > 1e-9 * max(1.0, np.abs(P).max())
        ):
            raise InputError("grasp.covariance", "a symmetric matrix (6, 6)", f"shape {P.shape}")
        if np.min(np.linalg.eigvalsh(P)) < -1e-12 * np.max(np.abs(P)):
            raise InputError(
                "grasp.covariance",
                "no negative variance in any direction",
                f"{np.min(np.linalg.eigvalsh(P)):.2g}",
            )

    @property
    def covariance_r(self) -> FloatArray:
        """Covariance with the rotation about the axes of the end-effector."""
        A = np.eye(6)
        A[:3, :3] = self.rotation
        return np.asarray(A @ self.covariance @ A.T)

    @property
    def information_r(self) -> FloatArray:
        """Inverse of it; a direction that is known exactly counts as known to a thousandth of a millimetre or milliradian."""
        return np.asarray(np.linalg.inv(self.covariance_r + 1e-12 * np.eye(6)))


def _positive(owner: str, item: Any, names: tuple[str, ...]) -> None:
    for name in names:
        value = getattr(item, name)
        if value is None:
            continue
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not np.isfinite(value)
            or value <= 0.0
        ):
            raise InputError(f"{owner}.{name}", "a finite number above zero", repr(value))


@dataclass(frozen=True)
class HumanWrist:
    """Stiffness and comfort of the human's wrist.

    Attributes
    ----------
    force_stiffness : float
        N/m, of the wrist's position (paper (4), ``K_h,t``).
    moment_stiffness : float
        Nm/rad, of its orientation (``K_h,r``).
    comfort_force, comfort_moment : float
        N and Nm: what counts as one in the objective.
    max_rotation : float or None
        rad, of the object from where the human wants it.
    max_force, max_moment : float or None
        N, RMS over what is not known of the grasp; and Nm.
    """

    force_stiffness: float = 300.0
    moment_stiffness: float = 2.0
    comfort_force: float = 10.0
    comfort_moment: float = 1.0
    max_rotation: float | None = 0.35
    max_force: float | None = None
    max_moment: float | None = None

    def __post_init__(self) -> None:
        _positive("human", self, tuple(item.name for item in fields(self)))

    @property
    def largest_turn(self) -> float | None:
        """The smaller of the limits of rotation and of moment, as an angle."""
        found = [self.max_rotation] if self.max_rotation is not None else []
        if self.max_moment is not None:
            found.append(self.max_moment / self.moment_stiffness)
        return min(found) if found else None

    @property
    def turn_words(self) -> str:
        """What that limit is called."""
        if self.max_moment is not None and self.largest_turn == self.max_moment / self.moment_stiffness:
            return f"moment at the human's wrist (max_moment {self.max_moment:g} Nm)"
        return f"rotation of the human's wrist (max_rotation {np.degrees(self.max_rotation or 0.0):.1f} deg)"


@dataclass(frozen=True)
class ExcitationSettings:
    """What is asked for.

    Attributes
    ----------
    alpha : float or None
        ``integral phi' phi dt >= alpha I`` over every window, rad^2/s^3 (paper (23)).
    rotation_sd, translation_sd : float or None
        rad and m: instead of `alpha`, the predicted posterior sd of every component after the whole duration.
    window : float or None
        s; None: the whole duration.
    duration : float
        s.
    bandwidth : float
        Hz.
    basis : {"fourier", "bspline"}
    centred : bool
        Count only the excitation that a constant accelerometer bias cannot explain.
    axes : {"free", "travel"}
        Turn about any axis; or about the direction of travel alone, the paper's strategy for planar motion.
    rest : bool
        Start and end at rest; without it the motion is the steady one of a periodic basis.
    max_angular_velocity, max_angular_acceleration : float or None
        rad/s and rad/s^2, of the end-effector.
    step : float
        s; of the grid on which limits and excitation are checked.
    refine : bool
        With a robot: plan in joint space after the plan in task space. Without it the task-space plan is followed by inverse kinematics.
    """

    alpha: float | None = None
    rotation_sd: float | None = None
    translation_sd: float | None = None
    window: float | None = None
    duration: float = 10.0
    bandwidth: float = 1.0
    basis: Literal["fourier", "bspline"] = "fourier"
    centred: bool = True
    axes: Literal["free", "travel"] = "free"
    rest: bool = True
    max_angular_velocity: float | None = None
    max_angular_acceleration: float | None = None
    step: float = 1e-3
    refine: bool = True

    def __post_init__(self) -> None:
        names = (
            "alpha", "rotation_sd", "translation_sd", "window", "duration", "bandwidth", "max_angular_velocity",
            "max_angular_acceleration", "step",
        )  # fmt: skip
        _positive("excitation", self, names)
        if (self.alpha is None) == (self.rotation_sd is None and self.translation_sd is None):
            raise InputError(
                "excitation", "either alpha, or rotation_sd and translation_sd (one of them suffices)",
                "none of them" if self.alpha is None else "both",
            )  # fmt: skip
        if self.window is not None and self.window > self.duration * (1.0 + 1e-9):
            raise InputError(
                "excitation.window", f"at most the duration of {self.duration:g} s", f"{self.window:g} s"
            )
        if self.alpha is None and self.window is not None and self.window < self.duration:
            raise InputError(
                "excitation.window",
                "none with target sd: they hold after the whole duration",
                f"{self.window:g} s",
            )
        if self.step > 0.25 / self.bandwidth:
            raise InputError(
                "excitation.step", "at most a quarter of a period of the bandwidth", f"{self.step:g} s"
            )

    @property
    def window_length(self) -> float:
        """S."""
        return self.duration if self.window is None else self.window

    @property
    def targets(self) -> FloatArray:
        """(6,) target sd, infinite where none is given."""
        parts = (self.rotation_sd, self.translation_sd)
        return np.repeat([np.inf if part is None else part for part in parts], 3)


@dataclass(frozen=True, eq=False)
class RobotLimits:
    """Limits of a robot's joints and of where its end-effector may be; None where there is none.

    Attributes
    ----------
    position_lower, position_upper : ndarray (n,)
        rad or m.
    velocity, acceleration, jerk, torque : ndarray (n,) or None
        Absolute values.
    box_lower, box_upper : ndarray (3,) or None
        m, of the end-effector's origin in the world.
    collision_distance : float or None
        m; None: self-collision is not checked.
    """

    position_lower: FloatArray
    position_upper: FloatArray
    velocity: FloatArray | None = None
    acceleration: FloatArray | None = None
    jerk: FloatArray | None = None
    torque: FloatArray | None = None
    box_lower: FloatArray | None = None
    box_upper: FloatArray | None = None
    collision_distance: float | None = None


def sensor_densities(noise: GraspNoise, lever: FloatArray) -> tuple[float, float]:
    """Densities of the gyroscope's and the accelerometer's residual: the hand's sensors, and the robot's signals where declared."""
    w = noise.robot_angular_velocity_density or 0.0
    al = noise.robot_angular_acceleration_density or 0.0
    a = noise.robot_acceleration_density or 0.0
    reach = float(lever @ lever)
    return (
        float(np.hypot(noise.gyro_density, w)),
        float(np.sqrt(noise.accelerometer_density**2 + a**2 + reach * al**2)),
    )

"""What holds the object: a seven-axis arm under inverse kinematics and joint control, or a hand that tracks its command exactly."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pinocchio

from factorgrasp.errors import InputError
from factorgrasp.models.arm import GRASP_FRAME, Arm
from factorgrasp.simulation.impedance import CompliantPose
from factorgrasp.typing import FloatArray


class Plant(Protocol):
    """An end-effector that follows a compliant pose.

    Attributes
    ----------
    position, rotation : (3,), (3, 3) ndarray
        ``p_w_r`` and ``R_w_r`` as they are.
    angular_velocity, angular_acceleration, acceleration : (3,) ndarray
        In the end-effector frame; gravity is not in the acceleration. All three hold at the same instant, that of the pose before the step.
    """

    position: FloatArray
    rotation: FloatArray
    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    acceleration: FloatArray

    def step(self, command: CompliantPose, wrench: FloatArray) -> None:
        """One step of time under the wrist's wrench (6,) at the end-effector's origin (N, Nm, world axes)."""
        ...

    def measured(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Position (3,) and rotation (3, 3) as the robot's encoders show them, before the step."""
        ...


class ExactPlant:
    """Tracks the compliant pose exactly: the paper's law without an arm, and without an arm's limits.

    Parameters
    ----------
    position, rotation : (3,), (3, 3) ndarray
    step : float
        s.
    position_sd, rotation_sd : float
        Of one measured pose, m and rad.
    """

    def __init__(
        self,
        position: FloatArray,
        rotation: FloatArray,
        step: float,
        position_sd: float = 5e-5,
        rotation_sd: float = 5e-5,
    ) -> None:
        self.position, self.rotation = np.array(position, dtype=float), np.array(rotation, dtype=float)
        self.angular_velocity, self.angular_acceleration = np.zeros(3), np.zeros(3)
        self.acceleration = np.zeros(3)
        self._step, self._sd = step, (position_sd, rotation_sd)
        self._before = (self.position, self.rotation)

    def step(self, command: CompliantPose, wrench: FloatArray) -> None:
        """See :class:`Plant`."""
        back = self.rotation.T
        # The integration's velocity is that of half a step later.
        rate = command.angular_velocity - 0.5 * self._step * command.angular_acceleration
        self.angular_velocity = back @ rate
        self.angular_acceleration = back @ command.angular_acceleration
        self.acceleration = back @ command.acceleration
        self._before = (self.position, self.rotation)
        self.position, self.rotation = command.position, command.rotation

    def measured(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """See :class:`Plant`."""
        position, rotation = self._before
        noise = rng.standard_normal(6)
        return position + self._sd[0] * noise[:3], rotation @ pinocchio.exp3(self._sd[1] * noise[3:])


@dataclass(frozen=True)
class JointControl:
    """The arm's inner loops.

    Attributes
    ----------
    bandwidth : float
        Hz, of the critically damped joint position control.
    ik_rate : float
        Hz, of the inverse kinematics; between its answers joints are interpolated by cubic polynomials.
    encoder_sd : float
        rad, of one joint reading.
    solver : str or None
        Of the inverse kinematics' quadratic programs (qpsolvers' name); None: the fastest that is installed.
    """

    bandwidth: float = 15.0
    ik_rate: float = 200.0
    encoder_sd: float = 1e-5
    solver: str | None = None


class ArmPlant:
    """Rigid-body dynamics of an arm under computed torque, its joints led by inverse kinematics (pink; damped least squares without it).

    The force sensor's reading is fed forward, one step late; torques stop at the joints' limits.

    Parameters
    ----------
    arm : Arm
    q : (n,) ndarray
        Start, at rest, rad.
    step : float
        s.
    control : JointControl
    gravity : (3,) ndarray
        m/s^2, world frame.
    """

    def __init__(
        self,
        arm: Arm,
        q: FloatArray,
        step: float,
        control: JointControl | None = None,
        gravity: FloatArray | None = None,
    ) -> None:
        self.arm, self.control = arm, control or JointControl()
        self._model, self._data, self._seen = arm.model, arm.model.createData(), arm.model.createData()
        if gravity is not None:
            self._model.gravity.linear = np.asarray(gravity, dtype=float)
        self._step = step
        self._every = max(1, round(1.0 / (self.control.ik_rate * step)))
        self._ik = _inverse_kinematics(arm, np.array(q), self._every * step, self.control.solver)
        gain = 2.0 * np.pi * self.control.bandwidth
        self._kp, self._kd = gain**2, 2.0 * gain
        self.q, self.qd = np.array(q, dtype=float), np.zeros(self._model.nv)
        self.torque, self.saturated = np.zeros(self._model.nv), 0
        self._limit = np.array(self._model.effortLimit)
        self._felt = np.zeros(6)
        self._count = 0
        self._knots = (self.q, self.qd, self.q, self.qd)
        self._q_before = self.q
        self.rotation, self.position = arm.placement(self.q)
        self.angular_velocity, self.angular_acceleration = np.zeros(3), np.zeros(3)
        self.acceleration = np.zeros(3)
        pinocchio.computeJointJacobians(self._model, self._data, self.q)

    def step(self, command: CompliantPose, wrench: FloatArray) -> None:
        """See :class:`Plant`."""
        if self._count % self._every == 0:
            self._next_knot(command)
        model, data = self._model, self._data
        wanted, rate, change = self._interpolated((self._count % self._every) * self._step)
        change = change + self._kd * (rate - self.qd) + self._kp * (wanted - self.q)
        pinocchio.computeJointJacobians(model, data, self.q)
        J = pinocchio.getFrameJacobian(model, data, self.arm.frame, pinocchio.LOCAL_WORLD_ALIGNED)
        torque = pinocchio.rnea(model, data, self.q, self.qd, change) - J.T @ self._felt
        held = np.clip(torque, -self._limit, self._limit)
        self.saturated += int(np.any(held != torque))
        self.torque = held
        qdd = pinocchio.aba(model, data, self.q, self.qd, held + J.T @ wrench)
        self._felt = wrench
        middle = self.qd + 0.5 * self._step * qdd
        pinocchio.forwardKinematics(model, data, self.q, middle, qdd)
        self.angular_velocity = pinocchio.getFrameVelocity(
            model, data, self.arm.frame, pinocchio.LOCAL
        ).angular
        moved = pinocchio.getFrameClassicalAcceleration(model, data, self.arm.frame, pinocchio.LOCAL)
        self.acceleration, self.angular_acceleration = moved.linear, moved.angular
        self._q_before = self.q
        self.qd = self.qd + self._step * qdd
        self.q = self.q + self._step * self.qd
        pinocchio.forwardKinematics(model, data, self.q)
        at = pinocchio.updateFramePlacement(model, data, self.arm.frame)
        self.position, self.rotation = at.translation.copy(), at.rotation.copy()
        self._count += 1

    def measured(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """See :class:`Plant`."""
        seen = self._q_before + self.control.encoder_sd * rng.standard_normal(self._q_before.size)
        pinocchio.forwardKinematics(self._model, self._seen, seen)
        at = pinocchio.updateFramePlacement(self._model, self._seen, self.arm.frame)
        return at.translation.copy(), at.rotation.copy()

    def _next_knot(self, command: CompliantPose) -> None:
        """Where the joints shall be one period of the inverse kinematics from now."""
        ahead = self._every * self._step
        position = command.position + ahead * (command.velocity + 0.5 * ahead * command.acceleration)
        turn = ahead * (command.angular_velocity + 0.5 * ahead * command.angular_acceleration)
        rotation = pinocchio.exp3(turn) @ command.rotation
        twist = np.concatenate(
            [
                command.velocity + ahead * command.acceleration,
                command.angular_velocity + ahead * command.angular_acceleration,
            ]
        )
        q, qd = self._knots[2], self._knots[3]
        self._knots = (q, qd, *self._ik.to(position, rotation, twist))

    def _interpolated(self, t: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cubic Hermite polynomial between the knots, with its derivatives."""
        T = self._every * self._step
        q0, v0, q1, v1 = self._knots
        u = t / T
        jump = q1 - q0 - T * v0
        c, d = 3.0 * jump - T * (v1 - v0), T * (v1 - v0) - 2.0 * jump
        q = q0 + T * v0 * u + (c + d * u) * u * u
        return q, v0 + (2.0 * c + 3.0 * d * u) * u / T, (2.0 * c + 6.0 * d * u) / T**2


class _DampedLeastSquares:
    """Inverse kinematics without quadratic programs: the fallback where pink is not installed."""

    def __init__(self, arm: Arm, q: FloatArray, period: float) -> None:
        self._arm, self._data, self._q, self._period = arm, arm.model.createData(), q, period
        self._low, self._high = np.array(arm.model.lowerPositionLimit), np.array(arm.model.upperPositionLimit)

    def to(
        self, position: FloatArray, rotation: FloatArray, twist: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Joints and their velocity at a pose with a twist (6,) [linear; angular], world axes."""
        model, data, q = self._arm.model, self._data, self._q
        for _ in range(2):
            pinocchio.computeJointJacobians(model, data, q)
            at = pinocchio.updateFramePlacement(model, data, self._arm.frame)
            error = np.concatenate([position - at.translation, pinocchio.log3(rotation @ at.rotation.T)])
            J = pinocchio.getFrameJacobian(model, data, self._arm.frame, pinocchio.LOCAL_WORLD_ALIGNED)
            q = np.clip(q + J.T @ np.linalg.solve(J @ J.T + 1e-8 * np.eye(6), error), self._low, self._high)
        self._q = q
        return q, _rates(self._arm, data, q, twist)


class _Pink:
    """Inverse kinematics by pink: pose and posture tasks under the joints' position and velocity limits."""

    def __init__(self, arm: Arm, q: FloatArray, period: float, solver: str | None) -> None:
        import pink
        from pink.tasks import FrameTask, PostureTask

        self._solve, self._period, self._arm = pink.solve_ik, period, arm
        self._solver = solver or _fastest()
        self._configuration = pink.Configuration(arm.model, arm.model.createData(), q)
        self._task = FrameTask(
            GRASP_FRAME, position_cost=1.0, orientation_cost=1.0, lm_damping=1e-8, gain=1.0
        )
        posture = PostureTask(cost=1e-4)
        posture.set_target(q)
        self._tasks = [self._task, posture]

    def to(
        self, position: FloatArray, rotation: FloatArray, twist: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Joints and their velocity at a pose with a twist (6,) [linear; angular], world axes."""
        self._task.set_target(pinocchio.SE3(rotation, position))
        with warnings.catch_warnings():
            # Solvers warn that pink's matrices are dense, as a seven-axis arm's are.
            warnings.simplefilter("ignore")
            velocity = self._solve(
                self._configuration, self._tasks, self._period, solver=self._solver, safety_break=False
            )
        self._configuration.integrate_inplace(velocity, self._period)
        q = np.array(self._configuration.q)
        return q, _rates(self._arm, self._configuration.data, q, twist)


def _rates(arm: Arm, data: Any, q: FloatArray, twist: FloatArray) -> FloatArray:
    """Smallest joint velocities with a twist of the frame."""
    pinocchio.computeJointJacobians(arm.model, data, q)
    J = pinocchio.getFrameJacobian(arm.model, data, arm.frame, pinocchio.LOCAL_WORLD_ALIGNED)
    out = J.T @ np.linalg.solve(J @ J.T + 1e-5 * np.eye(6), twist)
    limit = np.array(arm.model.velocityLimit)
    return np.asarray(np.clip(out, -limit, limit))


def _fastest() -> str:
    import qpsolvers

    for name in ("daqp", "quadprog", "proxqp", "piqp", "osqp"):
        if name in qpsolvers.available_solvers:
            return name
    raise InputError(
        "control.solver", "a solver of quadratic programs", "none", "pip install 'factorgrasp[solvers]'"
    )


def _inverse_kinematics(arm: Arm, q: FloatArray, period: float, solver: str | None) -> Any:
    try:
        return _Pink(arm, q, period, solver)
    except ImportError:
        return _DampedLeastSquares(arm, q, period)

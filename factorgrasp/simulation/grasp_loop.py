"""The paper's experiment as a closed loop: arm, impedance, object, wrist, sensors, and the estimator whose estimate moves the arm.

Every step of 1 ms: the wrist's springs pull at the object (Cehajic 2015 (4), (5)); the impedance control yields to that; inverse kinematics
and joint control move the arm; encoders and the IMU on the wrist are read. Every block of 20 ms the estimator gets the readings, and the
policy gives the next piece of the reference. The object is rigid and so are both grasps; the robot carries the object's weight.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pinocchio

from factorgrasp import lie
from factorgrasp.baselines.cehajic2015 import CehajicRecursion
from factorgrasp.models.wrist import WrenchSummary, WristStiffness
from factorgrasp.online.estimate import OnlineGraspEstimate
from factorgrasp.online.grasp import OnlineGraspPose
from factorgrasp.recordings import ImuStream, PoseStream
from factorgrasp.simulation.grasp import STANDARD_GRAVITY, HandImu
from factorgrasp.simulation.grasp_plants import Plant
from factorgrasp.simulation.grasp_policies import Policy
from factorgrasp.simulation.grasp_truth import GraspTruth
from factorgrasp.simulation.human_wrist import HumanMotion
from factorgrasp.simulation.impedance import CompliantPose, Impedance
from factorgrasp.typing import FloatArray


@dataclass(frozen=True)
class PaperEstimator:
    """Runs the paper's recursion in the loop, on the same readings as the online estimator.

    Its inputs are better than its readings could be: the robot's rates and accelerations with white noise instead of differentiated poses,
    and the hand's acceleration compensated with an orientation that is wrong by a constant angle.

    Attributes
    ----------
    make : callable
        Step (s) to a :class:`CehajicRecursion`.
    every : int
        Steps of the simulation between its updates.
    orientation_error : (3,) ndarray
        Rotation vector, rad, of the error of the hand's believed orientation.
    rate_sd, angular_acceleration_sd, acceleration_sd : float
        White noise of the robot's signals, rad/s, rad/s^2, m/s^2.
    """

    make: Callable[[float], CehajicRecursion]
    every: int = 5
    orientation_error: FloatArray = field(default_factory=lambda: np.zeros(3))
    rate_sd: float = 0.001
    angular_acceleration_sd: float = 0.05
    acceleration_sd: float = 0.02


@dataclass(frozen=True, eq=False)
class GraspLoopResult:
    """A run of the closed loop.

    Attributes
    ----------
    name : str
    t : (n,) ndarray
        s.
    wrench : (n, 6) ndarray
        Force (N) and torque (Nm) that the wrist feels: what the object exerts on it, world axes.
    position, rotation_wxyz : (n, 3), (n, 4) ndarray
        End-effector, ``p_w_r`` (m) and ``R_w_r`` as quaternions [w, x, y, z].
    wanted_position : (n, 3) ndarray
        Reference of the end-effector, m.
    hand_position : (n, 3) ndarray
        ``p_w_h``, m.
    t_estimate : (m,) ndarray
        When estimates were taken, s.
    rotation_error, translation_error : (m,) ndarray
        Angle (rad) and distance (m) between estimate and truth; NaN before the first estimate.
    rotation_sd, translation_sd : (m,) ndarray
        Stated sd of the worst direction, rad and m; infinite before, NaN for an estimator that states none.
    lever : (m, 3) ndarray
        Estimates of ``p_r_h``, m.
    robot, hand : PoseStream, ImuStream
        What the sensors read: a recording like any other.
    truth : GraspTruth
    joints : (n, k) ndarray or None
        Joint positions (rad), with an arm.
    torques : (n, k) ndarray or None
        Nm.
    saturated : int
        Steps in which a torque limit was met.
    final : OnlineGraspEstimate or None
    """

    name: str
    t: FloatArray
    wrench: FloatArray
    position: FloatArray
    rotation_wxyz: FloatArray
    wanted_position: FloatArray
    hand_position: FloatArray
    t_estimate: FloatArray
    rotation_error: FloatArray
    translation_error: FloatArray
    rotation_sd: FloatArray
    translation_sd: FloatArray
    lever: FloatArray
    robot: PoseStream
    hand: ImuStream
    truth: GraspTruth
    joints: FloatArray | None
    torques: FloatArray | None
    saturated: int
    final: OnlineGraspEstimate | None

    @cached_property
    def force(self) -> FloatArray:
        """Size of the force at the wrist, N, (n,)."""
        return np.asarray(np.linalg.norm(self.wrench[:, :3], axis=1))

    def felt(self, start: float = 0.0, end: float = np.inf) -> WrenchSummary:
        """Peaks and RMS of the wrench between two times (s)."""
        return WrenchSummary.of(self.wrench[(self.t >= start) & (self.t <= end)])

    def settled(self, rotation: float, translation: float) -> float:
        """When (s) both errors are below these (rad, m) for good; NaN when they are not at the end."""
        good = (self.rotation_error <= rotation) & (self.translation_error <= translation)
        if not good.size or not good[-1]:
            return float("nan")
        bad = np.flatnonzero(~good)
        return float(self.t_estimate[bad[-1] + 1 if bad.size else 0])


def run_grasp_loop(
    plant: Plant,
    policy: Policy,
    truth: GraspTruth,
    *,
    duration: float,
    estimator: OnlineGraspPose | PaperEstimator | None,
    wrist: WristStiffness | None = None,
    human: HumanMotion | None = None,
    impedance: Impedance | None = None,
    imu: HandImu | None = None,
    step: float = 1e-3,
    block: int = 20,
    gravity: tuple[float, float, float] = STANDARD_GRAVITY,
    seed: int = 0,
    name: str = "grasp loop",
) -> GraspLoopResult:
    """Run the closed loop.

    Parameters
    ----------
    plant : Plant
        At rest at its start; the wrist is relaxed there.
    policy : Policy
    truth : GraspTruth
        The grasp and the IMU's biases.
    duration : float
        s.
    estimator : OnlineGraspPose, PaperEstimator or None
    wrist : WristStiffness
    human : HumanMotion
        What the wrist wants to do; at rest by default.
    impedance : Impedance
        The paper's by default.
    imu : HandImu
        Noise of the IMU, whose rate is that of the simulation here.
    step : float
        s.
    block : int
        Steps between two looks of policy and estimator.
    gravity : (3,) float
        World frame, m/s^2.
    seed : int
        Of all noise: the same for every policy and estimator.
    name : str

    Returns
    -------
    GraspLoopResult
    """
    wrist, human, imu = wrist or WristStiffness(), human or HumanMotion(), imu or HandImu()
    blocks = int(np.ceil(duration / (step * block)))
    n = blocks * block
    R_rh, r_rh, g = truth.rotation, truth.translation, np.array(gravity)
    start_hand, start_turn = plant.position + plant.rotation @ r_rh, plant.rotation @ R_rh
    compliant = CompliantPose(impedance or Impedance(), plant.position, plant.rotation, step)
    gyros, forces, paper_noise, encoders = (
        np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(4)
    )
    sd = np.sqrt(1.0 / step)
    gyro_noise = imu.gyro_noise_density * sd * gyros.standard_normal((n, 3)) + truth.gyro_bias
    force_noise = imu.accelerometer_noise_density * sd * forces.standard_normal((n, 3))
    force_noise += truth.accelerometer_bias
    t: FloatArray = step * np.arange(n, dtype=np.float64)

    wrench, position, wanted = np.empty((n, 6)), np.empty((n, 3)), np.empty((n, 3))
    rotation, seen_position = np.empty((n, 3, 3)), np.empty((n, 3))
    seen_rotation = np.empty((n, 3, 3))
    rates, changes, pulls = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    joints = np.empty((n, plant.q.size)) if hasattr(plant, "q") else None
    torques = None if joints is None else np.empty_like(joints)
    paper = estimator.make(step * estimator.every) if isinstance(estimator, PaperEstimator) else None
    history = _History(truth)
    stiffness = np.repeat([wrist.translation, wrist.rotation], 3)
    estimate: OnlineGraspEstimate | None = None
    lever: FloatArray | None = None
    for b in range(blocks):
        now = slice(b * block, (b + 1) * block)
        if isinstance(estimator, OnlineGraspPose) and b % 5 == 0 and b:
            estimate = estimator.estimate()
            lever = estimate.translation if np.isfinite(estimate.translation).all() else None
            history.online(t[now.start], estimate)
        elif paper is not None and b:
            lever = paper.translation
            if b % 5 == 0:
                history.paper(t[now.start], paper)
        policy.observe(float(t[now.start]), estimate, lever)
        # What is reached after a step is compared with the reference at its end.
        travel, turn = human.at(t[now] + step)
        reference = policy.reference(t[now] + step, travel, turn)
        hand_wanted = start_hand + human.at(t[now])[0][0]
        turn_wanted = lie.so3_exp(human.at(t[now])[1][0]) @ start_turn
        wanted[now] = reference.position
        for i in range(block):
            k = now.start + i
            R, p = plant.rotation, plant.position
            arm = R @ r_rh
            pull = stiffness[:3] * (hand_wanted[i] - p - arm)
            twist = stiffness[3:] * pinocchio.log3(turn_wanted[i] @ (R @ R_rh).T)
            wrench[k, :3], wrench[k, 3:] = pull, twist
            position[k], rotation[k] = p, R
            at_robot = np.concatenate([pull, twist + _cross(arm, pull)])
            compliant.advance(reference, i, at_robot)
            plant.step(compliant, at_robot)
            rates[k], changes[k] = plant.angular_velocity, plant.angular_acceleration
            pulls[k] = plant.acceleration - g @ R
            seen_position[k], seen_rotation[k] = plant.measured(encoders)
            if joints is not None and torques is not None:
                joints[k], torques[k] = plant.q, plant.torque  # type: ignore[attr-defined]
        w, al, f = rates[now], changes[now], pulls[now]
        held = f + np.cross(al, r_rh) + np.cross(w, np.cross(w, r_rh))
        gyro, force = w @ R_rh + gyro_noise[now], held @ R_rh + force_noise[now]
        gyro_noise[now], force_noise[now] = gyro, force
        if isinstance(estimator, OnlineGraspPose):
            estimator.add_robot(t[now], seen_position[now], lie.matrix_to_quaternion_wxyz(seen_rotation[now]))
            estimator.add_hand(t[now], gyro, force)
        elif paper is not None and isinstance(estimator, PaperEstimator):
            believed = lie.so3_exp(estimator.orientation_error) @ (rotation[now] @ R_rh)
            own = f + g @ rotation[now]
            noise = paper_noise.standard_normal((block, 9))
            for i in range(0, block, estimator.every):
                paper.update(
                    w[i] + estimator.rate_sd * noise[i, :3],
                    al[i] + estimator.angular_acceleration_sd * noise[i, 3:6],
                    own[i] + estimator.acceleration_sd * noise[i, 6:],
                    gyro[i],
                    force[i] + g @ believed[i],
                )
    return GraspLoopResult(
        name=name,
        t=t,
        wrench=-wrench,
        position=position,
        rotation_wxyz=lie.matrix_to_quaternion_wxyz(rotation, continuous=True),
        wanted_position=wanted,
        hand_position=position + rotation @ r_rh,
        **history.arrays(),
        robot=PoseStream(
            t, seen_position, lie.matrix_to_quaternion_wxyz(seen_rotation, continuous=True), "robot", False
        ),
        hand=ImuStream(t, gyro_noise, force_noise, "hand", False),
        truth=truth,
        joints=joints,
        torques=torques,
        saturated=int(getattr(plant, "saturated", 0)),
        final=estimator.estimate() if isinstance(estimator, OnlineGraspPose) else None,
    )


class _History:
    """Errors of the estimates over time."""

    def __init__(self, truth: GraspTruth) -> None:
        self._truth = truth
        self._rows: list[tuple[float, float, float, float, float, float, float, float]] = []

    def online(self, t: float, estimate: OnlineGraspEstimate) -> None:
        P = estimate.covariance
        sds = [float("inf"), float("inf")]
        if np.isfinite(P).all():
            sds = [
                float(np.sqrt(max(np.linalg.eigvalsh(P[part, part])[-1], 0.0)))
                for part in (slice(0, 3), slice(3, 6))
            ]
        self._add(t, estimate.rotation, estimate.translation, sds)

    def paper(self, t: float, paper: CehajicRecursion) -> None:
        R = lie.quaternion_wxyz_to_matrix(paper.rotation_wxyz)
        self._add(t, R, paper.translation, [float("nan")] * 2)

    def _add(self, t: float, R: FloatArray, r: FloatArray, sds: list[float]) -> None:
        turn, way = float("nan"), float("nan")
        if np.isfinite(R).all():
            turn = float(lie.angle_between(self._truth.rotation, R))
            way = float(np.linalg.norm(self._truth.translation - r))
        self._rows.append((t, turn, way, *sds, *map(float, r)))  # type: ignore[arg-type]

    def arrays(self) -> dict[str, FloatArray]:
        rows = np.array(self._rows).reshape(-1, 8)
        names = ("t_estimate", "rotation_error", "translation_error", "rotation_sd", "translation_sd")
        out: dict[str, FloatArray] = {name: rows[:, k] for k, name in enumerate(names)}
        return {**out, "lever": rows[:, 5:]}


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    x, y, z = a.tolist()
    u, v, w = b.tolist()
    return np.array((y * w - z * v, z * u - x * w, x * v - y * u))

"""The experiment of Cehajic et al., IROS 2015, section V, in closed loop: what the printed control and stiffness really do to the wrist.

The scenario ``cehajic2015_loop``. Printed: the impedance (M, D, K), 1 ms, the grasp ``r = [1.11, 0.16, 0.08]``, ``q = [0, 0, 0, 1]``, the
wrong start ``r_0 = [0.5, 0, 0]``, ``q_0`` (120 deg), ``w_ref = [10, 40, 20] deg/s sin t``. Not printed: the stiffness of the human wrist
(see :class:`factorgrasp.models.wrist.WristStiffness`), the robot's noise, the IMU's biases.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from factorgrasp.baselines.cehajic2015 import CehajicRecursion
from factorgrasp.errors import InputError
from factorgrasp.lie import quaternion_wxyz_to_matrix, so3_exp
from factorgrasp.models.arm import default_arm
from factorgrasp.models.wrist import WristStiffness
from factorgrasp.online.grasp import OnlineGraspPose
from factorgrasp.online.receding_excitation import RecedingExcitation, RecedingSettings, two_tones
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.simulation.cehajic2015 import (
    PRINTED_CENTER,
    PRINTED_RATE,
    QUATERNION_WXYZ,
    TRANSLATION,
    XSENS,
)
from factorgrasp.simulation.grasp import HandImu
from factorgrasp.simulation.grasp_loop import GraspLoopResult, PaperEstimator, run_grasp_loop
from factorgrasp.simulation.grasp_plants import ArmPlant, ExactPlant, JointControl, Plant
from factorgrasp.simulation.grasp_policies import Policy, PosePolicy, RecedingPolicy, VelocityPolicy
from factorgrasp.simulation.grasp_truth import GraspTruth
from factorgrasp.simulation.human_wrist import HumanMode, about_travel, human_motion
from factorgrasp.simulation.impedance import Impedance
from factorgrasp.simulation.trajectory import Sinusoids
from factorgrasp.typing import FloatArray

PolicyName: TypeAlias = Literal["receding", "velocity", "velocity_online", "biased", "fixed"]
_POLICIES = ("receding", "velocity", "velocity_online", "biased", "fixed")

NOISE = GraspNoise(
    gyro_density=XSENS.gyro_noise_density,
    accelerometer_density=XSENS.accelerometer_noise_density,
    gyro_bias_sd=XSENS.gyro_bias_sd,
    accelerometer_bias_sd=XSENS.accelerometer_bias_sd,
)
"""What the estimator is told of the scenario's sensors."""
ORIENTATION_ERROR = float(np.deg2rad(1.0))
"""Of the hand's own orientation, by which the paper compensates gravity, rad."""
GUESS_SD = 0.4
"""Of every component of the first guess of the lever arm, m: its error of 0.64 m is one of 0.93 sd in all three together."""
_START = np.array([0.5, 0.0, 0.4])


def printed_motion(scale: float = 1.0) -> Sinusoids:
    """The rotation vector of ``w_ref = [10, 40, 20] deg/s sin t``: ``w_ref (1 - cos t)``, one axis; begins at rest."""
    w = scale * PRINTED_RATE
    return Sinusoids(w, [-w], [1.0 / (2.0 * np.pi)], np.full((1, 3), 0.5 * np.pi))


def cehajic2015_loop(
    seed: int = 0,
    *,
    policy: PolicyName = "receding",
    duration: float = 20.0,
    arm: bool = True,
    human: HumanMode = "static",
    wrist: WristStiffness | None = None,
    lever: tuple[float, float, float] | None = None,
    scale: float = 1.0,
    receding: RecedingSettings | None = None,
    pattern: Sinusoids | None = None,
    impedance: Impedance | None = None,
    imu: HandImu = XSENS,
    time_offset: bool = False,
    control: JointControl | None = None,
) -> GraspLoopResult:
    """The paper's set-up in closed loop.

    Parameters
    ----------
    seed : int
        Of all noise and biases; the same for every policy.
    policy : {"receding", "velocity", "velocity_online", "biased", "fixed"}
        - receding: :class:`RecedingExcitation` with the online estimator, from the paper's wrong start;
        - velocity: the paper's procedure, its law (26) fed with its own moving estimate, under its printed motion;
        - velocity_online: the law (26) alone, under the receding plan's pattern at 0.05 rad and fed with the online estimator's estimate;
        - biased: the law (26) with the lever arm kept at `lever` (``r_0`` by default), under the printed motion: Fig. 5;
        - fixed: a pose-level reference about a kept `lever`, under the printed motion.
    duration : float
        s.
    arm : bool
        A seven-axis arm (the Panda where its URDF is installed); False: the impedance's pose is reached exactly. No arm of this size can
        follow the printed amplitude about the wrist (0.8 m to and fro): there, take False, or a smaller `scale`.
    human : {"static", "planar", "full"}
        What the wrist wants to do; with "planar" the receding plan turns about the direction of travel, with "full" it adds nothing to the
        human's own turns as long as they excite.
    wrist : WristStiffness
    lever : (3,) float, optional
        m.
    scale : float
        Of the printed motion.
    receding : RecedingSettings
    pattern : Sinusoids, optional
        Rotation vector of unit angle for the receding plan; by default two tones about 1 Hz.
    impedance : Impedance
    imu : HandImu
    time_offset : bool
        Whether the online estimator also estimates the offset between the clocks. In the paper there is one clock.
    control : JointControl

    Returns
    -------
    GraspLoopResult
    """
    if policy not in _POLICIES:
        raise InputError("policy", "one of " + ", ".join(_POLICIES), repr(policy))
    rng = np.random.default_rng([seed, 5])
    truth = GraspTruth(
        quaternion_wxyz_to_matrix(QUATERNION_WXYZ),
        np.array(TRANSLATION),
        imu.gyro_bias_sd * rng.standard_normal(3),
        imu.accelerometer_bias_sd * rng.standard_normal(3),
        0.0,
        np.zeros(3),
    )
    axis = rng.standard_normal(3)
    error = ORIENTATION_ERROR * axis / np.linalg.norm(axis)
    motion = printed_motion(scale)
    # Half of the one-sided printed turn before the middle of the workspace, half behind.
    online = policy in ("receding", "velocity_online")
    first = np.eye(3) if online else so3_exp(-np.asarray(motion.offset))
    plant, position, rotation = _plant(arm, first, control, np.array(lever or PRINTED_CENTER))
    guess = GraspPrior(translation=np.array(PRINTED_CENTER), translation_sd=GUESS_SD)
    chosen: Policy
    estimator: OnlineGraspPose | PaperEstimator | None
    if online:
        settings = GraspSettings(time_offset=time_offset, max_time_offset=0.1)
        shape = pattern or (about_travel() if human == "planar" else two_tones())
        chosen = (
            RecedingPolicy(RecedingExcitation(position, rotation, guess, shape, receding, NOISE, settings))
            if policy == "receding"
            else VelocityPolicy(position, rotation, _scaled(shape, 0.05), guess.translation, ramp=1.0)
        )
        estimator = OnlineGraspPose(NOISE, settings, prior=guess)
    else:
        kept = np.array(PRINTED_CENTER if lever is None else lever)
        chosen = (
            PosePolicy(position, rotation, motion, kept)
            if policy == "fixed"
            else VelocityPolicy(position, rotation, motion, kept, follow=policy == "velocity")
        )
        estimator = PaperEstimator(CehajicRecursion, orientation_error=error)
    return run_grasp_loop(
        plant,
        chosen,
        truth,
        duration=duration,
        estimator=estimator,
        wrist=wrist,
        human=human_motion(human),
        impedance=impedance,
        imu=imu,
        seed=seed,
        name=f"cehajic2015_loop ({policy}, {human} wrist)",
    )


def _scaled(shape: Sinusoids, factor: float) -> Sinusoids:
    return Sinusoids(
        factor * np.asarray(shape.offset), factor * np.asarray(shape.amplitude), shape.frequency, shape.phase
    )


def _plant(
    arm: bool, first: FloatArray, control: JointControl | None, lever: FloatArray
) -> tuple[Plant, FloatArray, FloatArray]:
    """The plant at its start, turned by `first` about the wrist that is believed, and its pose."""
    if not arm:
        position = _START + (np.eye(3) - first) @ lever
        return ExactPlant(position, first, 1e-3), position, first
    held = default_arm()
    middle, place = held.placement(held.start)
    rotation, position = first @ middle, place + (np.eye(3) - first) @ (middle @ lever)
    plant = ArmPlant(held, held.reach(rotation, position), 1e-3, control)
    return plant, plant.position, plant.rotation

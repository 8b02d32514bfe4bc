"""Excite the grasp while it is being estimated: as much as the wrist bears now, as little as the target needs (mathematics 3).

The reference is one of **poses**: with the wrist's place ``c = p_0 + R_0 r`` at the start, ``p_d = c - R_d r``. Whatever ``r`` was
believed before, the reference of now follows from the ``r`` of now: an error that is corrected pulls no longer. (The paper's velocity law
(26), integrated under a moving estimate, keeps the way it went while the estimate was wrong.)

An error ``e`` of the lever arm moves the wrist by ``(R_d - R_0) e``, at most ``2 sin(A/2) |e|`` for turns up to an angle A. So A is small
while the covariance is large, and grows with what is known. It never grows beyond what the target still needs: the wrist also feels the
turn itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.excitation_prediction import predict_grasp
from factorgrasp.lie import matrix_to_quaternion_wxyz, so3_exp
from factorgrasp.online.estimate import OnlineGraspEstimate
from factorgrasp.pose_reference import Blend, Curve, PoseReference, about_point, plus, times
from factorgrasp.problems.grasp_kinematics import robot_kinematics
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.recordings import PoseStream
from factorgrasp.simulation.trajectory import RigidTrajectory, Sinusoids
from factorgrasp.typing import FloatArray

# The pattern whose information is taken as the measure of others: s, rad, Hz.
_SAMPLE, _SAMPLE_ANGLE, _SAMPLE_RATE = 12.0, 0.05, 200.0
# The reference follows an estimate that has sharpened by this factor, or has moved by so many of its sd.
_SHARPER, _MOVED = 0.8, 2.0


def cone(
    frequency: float = 1.0, first: tuple[float, float, float] = (1.0, 0.0, 0.0),
    second: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Sinusoids:  # fmt: skip
    """Coning of unit angle: ``u cos(2 pi f t) + v sin(2 pi f t)`` (rotation vector, world axes).

    Its excitation over T is ``T w^4 A^2 / 2`` in the plane of u and v and twice that across, for a small angle A.
    """
    quarter = 0.5 * np.pi
    return Sinusoids((0.0, 0.0, 0.0), [first, second], (frequency, frequency), [[quarter] * 3, [0.0] * 3])


def two_tones(
    frequency: float = 1.0, first: tuple[float, float, float] = (1.0, 0.0, 0.0),
    second: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Sinusoids:  # fmt: skip
    """Turns about two axes at two frequencies, 15 % below and above `frequency` (Hz); both begin at zero angle.

    What a cone does, and more: a cone that is seen late looks like one that is seen by a turned sensor, so it cannot tell an offset between
    the clocks from a rotation about its axis. Two tones can.
    """
    return Sinusoids((0.0, 0.0, 0.0), [first, second], (0.85 * frequency, 1.15 * frequency), np.zeros((2, 3)))


@dataclass(frozen=True)
class RecedingSettings:
    """How the excitation is dosed.

    Attributes
    ----------
    rotation_sd, translation_sd : float
        Largest standard deviations (rad, m; worst direction) that are wanted; then the motion ends.
    force : float
        N; what an error of the lever arm may pull at the wrist.
    stiffness : float
        N/m; what holds the end-effector and the wrist together (robot and wrist in series): the force is this times the displacement.
    angle, smallest_angle : float
        rad; largest turn that the wrist and the robot bear, and the smallest that is worth while.
    speed, acceleration : float
        m/s, m/s^2; what the robot's end-effector may reach while it turns about the wrist.
    horizon : float
        s; in this time the target shall be reached, when the wrist allows it.
    period : float
        s; between replans; a new amplitude or lever arm is approached within this time.
    confidence : float
        How many standard deviations of the lever arm count as its possible error.
    gate : float
        m; an estimate with a larger sd never becomes the reference.
    """

    rotation_sd: float = float(np.deg2rad(0.04))
    translation_sd: float = 1.5e-3
    force: float = 3.0
    stiffness: float = 150.0
    angle: float = 0.12
    smallest_angle: float = 0.01
    speed: float = 0.6
    acceleration: float = 4.0
    horizon: float = 5.0
    period: float = 0.5
    confidence: float = 2.0
    gate: float = 0.05

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"receding.{name}", "a finite number above zero", repr(value))


@dataclass(frozen=True)
class Replan:
    """One decision.

    Attributes
    ----------
    t : float
        s.
    angle : float
        Amplitude from now on, rad.
    needed, allowed : float
        What the target needs and what the wrist bears, rad.
    lever_sd : float
        Worst direction of the lever arm, m; infinite before the first estimate.
    followed : bool
        Whether the reference took over the lever arm of the estimate.
    reason : str
        What decided the amplitude.
    """

    t: float
    angle: float
    needed: float
    allowed: float
    lever_sd: float
    followed: bool
    reason: str


class RecedingExcitation:
    """Plans the motion about the wrist afresh whenever the estimate of the grasp has sharpened.

    Parameters
    ----------
    position, rotation : (3,), (3, 3) array_like
        Pose of the end-effector at the start, ``p_w_r`` (m) and ``R_w_r``.
    guess : GraspPrior
        What is believed of the grasp before: its lever arm is the first reference, its sd the first error that is reckoned with.
    pattern : Sinusoids
        Rotation vector (world axes) of unit angle, such as :func:`two_tones` (the default) or a planned motion.
    settings : RecedingSettings
    noise, estimation : GraspNoise, GraspSettings
        Of the estimator; they tell how much a motion of some amplitude will show.
    """

    def __init__(
        self,
        position: FloatArray,
        rotation: FloatArray,
        guess: GraspPrior | None = None,
        pattern: Sinusoids | None = None,
        settings: RecedingSettings | None = None,
        noise: GraspNoise | None = None,
        estimation: GraspSettings | None = None,
    ) -> None:
        self.settings, self.pattern = settings or RecedingSettings(), pattern or two_tones()
        self.guess = guess or GraspPrior()
        self._position, self._rotation = np.array(position, dtype=float), np.array(rotation, dtype=float)
        self._lever = Blend(self.guess.translation)
        self._angle = Blend(np.zeros(1))
        # A prior sd of every component: its worst direction, with the confidence of a whole vector.
        self._reference_sd = self.guess.translation_sd
        self._information = _information_per_square_angle(
            self.pattern, self._rotation, noise or GraspNoise(), estimation or GraspSettings()
        )
        _, rate, change = self.pattern.derivatives(np.arange(0.0, _SAMPLE, 1.0 / _SAMPLE_RATE))
        self._peaks = tuple(float(np.max(np.linalg.norm(x, axis=1))) for x in (rate, change))
        self._next = 0.0
        self.replans: list[Replan] = []

    @property
    def lever(self) -> FloatArray:
        """``p_r_h`` (3,) that the reference turns about, or is on its way to, m."""
        return self._lever.target

    @property
    def angle(self) -> float:
        """Amplitude now or soon, rad."""
        return float(self._angle.target[0])

    @property
    def done(self) -> bool:
        """Whether the target is reached, so that the motion has ended or is about to."""
        return bool(self.replans) and self.replans[-1].reason == "target reached"

    def update(self, t: float, estimate: OnlineGraspEstimate | None) -> Replan | None:
        """Replan at time `t` (s) with what is known of the grasp; None when it is not time yet."""
        if t < self._next or self._angle.busy(t) or self._lever.busy(t):
            return None
        self._next = t + self.settings.period
        s = self.settings
        known = estimate is not None and bool(np.isfinite(estimate.covariance).all())
        lever_sd, followed = np.inf, False
        possible = float(s.confidence * self._reference_sd)
        if known:
            assert estimate is not None
            lever_sd = _worst(estimate.covariance[3:, 3:])
            away = float(np.linalg.norm(estimate.translation - self._lever.target))
            if lever_sd <= s.gate and (lever_sd < _SHARPER * self._reference_sd or away > _MOVED * lever_sd):
                self._lever.go(t, estimate.translation, s.period)
                self._reference_sd, followed, away = lever_sd, True, 0.0
            # What the reference may be wrong by, as far as is known now: never less than it was wrong by until now.
            possible = (
                min(possible, away + s.confidence * lever_sd) if not followed else s.confidence * lever_sd
            )
        reach = float(np.linalg.norm(self._lever.target))
        robot = min(
            s.speed / max(self._peaks[0] * reach, 1e-9), s.acceleration / max(self._peaks[1] * reach, 1e-9)
        )
        largest = min(s.angle, robot)
        allowed = min(largest, s.force / (s.stiffness * max(possible, 1e-9)))
        needed = self._needed(estimate) if known else s.angle
        if needed == 0.0:
            angle, reason = 0.0, "target reached"
        elif needed <= allowed:
            angle, reason = needed, "as much as the target needs"
        elif allowed < largest:
            angle, reason = allowed, "as much as the wrist bears with an error of the lever arm"
        else:
            angle, reason = largest, "largest angle" if largest == s.angle else "as much as the robot can"
        if followed and angle > self.angle:
            # First the better reference, then more motion.
            angle, reason = self.angle, "lever arm first"
        self._angle.go(t, np.array([angle]), s.period)
        plan = Replan(t, angle, needed, allowed, lever_sd, followed, reason)
        self.replans.append(plan)
        return plan

    def reference(
        self, t: FloatArray, travel: Curve | None = None, turn: Curve | None = None
    ) -> PoseReference:
        """The reference at times `t` (n,), none of them before the last :meth:`update`.

        Parameters
        ----------
        t : (n,) ndarray
            s.
        travel : Curve, optional
            Way of the wrist that the human wants (n, 3), world axes, m, with its derivatives.
        turn : Curve, optional
            Rotation vector (n, 3) that the human wants, world axes, rad: the motion is added to it.
        """
        zero = np.zeros((t.size, 3))
        still = (zero, zero, zero)
        phi = times(self._angle.at(t), self.pattern.derivatives(t))
        return about_point(
            self._position,
            self._rotation,
            plus(phi, turn) if turn is not None else phi,
            self._lever.at(t),
            travel or still,
        )

    def _needed(self, estimate: OnlineGraspEstimate | None) -> float:
        """Smallest amplitude that reaches both target sd within the horizon; zero when they are reached."""
        assert estimate is not None
        s = self.settings
        P = estimate.covariance
        if _worst(P[:3, :3]) <= s.rotation_sd and _worst(P[3:, 3:]) <= s.translation_sd:
            return 0.0
        # The rotation's information is known in the end-effector's axes, its covariance is in the hand's.
        turn = np.eye(6)
        turn[:3, :3] = estimate.rotation
        now = np.linalg.inv(turn @ P @ turn.T + 1e-16 * np.eye(6))
        low, high = 0.0, s.angle
        for _ in range(20):
            middle = 0.5 * (low + high)
            after = np.asarray(np.linalg.inv(now + middle**2 * s.horizon * self._information), dtype=float)
            enough = _worst(after[:3, :3]) <= s.rotation_sd and _worst(after[3:, 3:]) <= s.translation_sd
            low, high = (low, middle) if enough else (middle, high)
        return max(high, s.smallest_angle)


def _worst(P: FloatArray) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(P)[-1], 0.0)))


def _information_per_square_angle(
    pattern: Sinusoids, rotation: FloatArray, noise: GraspNoise, settings: GraspSettings
) -> FloatArray:
    """Information (6, 6) of [rotation; lever arm] per second and per rad^2 of amplitude, in the end-effector's axes.

    Of the grasp alone, after all other unknowns have been estimated from the same motion; for a hand whose axes are the end-effector's.
    """
    small = Sinusoids(
        _SAMPLE_ANGLE * np.asarray(pattern.offset),
        _SAMPLE_ANGLE * np.asarray(pattern.amplitude),
        pattern.frequency,
        pattern.phase,
    )
    motion = RigidTrajectory(small, mean_rotation_wxyz=(1.0, 0.0, 0.0, 0.0)).at(
        np.arange(0.0, _SAMPLE, 1.0 / _SAMPLE_RATE)
    )
    R = so3_exp(small.derivatives(motion.t)[0]) @ rotation
    stream = PoseStream(motion.t, motion.position, matrix_to_quaternion_wxyz(R, continuous=True))
    kinematics = robot_kinematics(stream, noise, np.array([0.0, 0.0, -9.80665]), 40.0)
    predicted = predict_grasp(
        kinematics, np.eye(3), np.zeros(3), noise, settings, GraspPrior(translation_sd=30.0)
    )
    return np.asarray(np.linalg.inv(predicted.grasp_covariance) / (_SAMPLE * _SAMPLE_ANGLE**2))

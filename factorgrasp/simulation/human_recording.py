"""A simulated human-dynamics experiment: what is true, and what is recorded of it with noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from factorgrasp.models.human import HumanBody
from factorgrasp.models.joint_motion import ORDER, differentiate_configurations
from factorgrasp.problems.human_dynamics_sensors import Accelerometer, ExternalWrench, Sensor, plate_wrench
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion import LinkMotion, StateNoise
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.problems.link_motion_spatial import rotate_back
from factorgrasp.recordings.forces import ForceRecording
from factorgrasp.signals import choose_savgol
from factorgrasp.simulation.human_motion import (
    JointTrajectory,
)
from factorgrasp.typing import BoolArray, FloatArray, IntArray

RATE = 100.0
"""Hz, of all that is recorded."""
FEET = ("RightFoot", "LeftFoot")
HANDS = ("RightHand", "LeftHand")
IMU_LINKS = (
    "Pelvis", "T8", "Head", "RightUpperArm", "LeftUpperArm", "RightForeArm", "LeftForeArm", "RightHand", "LeftHand",
    "RightUpperLeg", "LeftUpperLeg", "RightLowerLeg", "LeftLowerLeg", "RightFoot", "LeftFoot", "RightShoulder", "LeftShoulder",
)  # fmt: skip
"""The 17 trackers of an Xsens suit."""


@dataclass(frozen=True)
class HumanNoise:
    """White noise of what is measured, standard deviations of one sample.

    Attributes
    ----------
    force, moment : float
        Of a plate or shoe, N and Nm (about the ankle).
    angle, position, orientation : float
        Of motion capture: joints (rad), pelvis (m and rad).
    accelerometer : float
        m/s^2.
    hand_force, hand_moment : float
        Of a robot's sensor in the hand, N and Nm.
    bandwidth : float
        Hz, of the filter that differentiates the motion; it is applied without noise, too.
    """

    force: float = 2.0
    moment: float = 0.5
    angle: float = 0.001
    position: float = 0.0003
    orientation: float = 0.001
    accelerometer: float = 0.05
    hand_force: float = 0.5
    hand_moment: float = 0.05
    bandwidth: float = 6.0


@dataclass(frozen=True, eq=False)
class HumanTruth:
    """What is true.

    Attributes
    ----------
    trajectory : JointTrajectory
    model : pinocchio.Model
        Of the body as it is, with what is strapped on (not what is held).
    torque : ndarray
        (n, 66) Nm, in the order of `dof_names`.
    dof_names : tuple of str
    external_wrench : dict of str to ndarray
        Link to its net external wrench (n, 6) in its own frame.
    motion : LinkMotion
        Of the body as it is.
    payload : float
        Mass held, kg.
    """

    trajectory: JointTrajectory
    model: Any
    torque: FloatArray
    dof_names: tuple[str, ...]
    external_wrench: Mapping[str, FloatArray]
    motion: LinkMotion
    payload: float = 0.0

    def of(self, dofs: Sequence[str]) -> FloatArray:
        """Torques (n, k) of some degrees of freedom, in that order."""
        return self.torque[:, [self.dof_names.index(name) for name in dofs]]


@dataclass(frozen=True, eq=False)
class HumanRecording:
    """What is recorded of a simulated experiment.

    Attributes
    ----------
    name : str
    body : HumanBody
        As the estimator knows it: without what is strapped on or held.
    truth : HumanTruth
    noise : HumanNoise
    seed : int
    phases : dict of str to (float, float)
        What happens from when to when, s.
    """

    name: str
    body: HumanBody
    truth: HumanTruth
    noise: HumanNoise
    seed: int
    phases: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def t(self) -> FloatArray:
        """(n,) s."""
        return self.truth.trajectory.t

    def during(self, phase: str) -> BoolArray:
        """Which frames (n,) belong to a phase."""
        start, end = self.phases[phase]
        return np.asarray((self.t >= start) & (self.t <= end))

    @cached_property
    def exact_motion(self) -> LinkMotion:
        """The true motion of the body as the estimator knows it."""
        q = self.truth.trajectory
        return PinocchioTree(self.body.model()).motion(q.t, q.q, q.v, q.a)

    @cached_property
    def configurations(self) -> FloatArray:
        """(n, nq) as motion capture has them, with noise."""
        import pinocchio as pin

        rng = np.random.default_rng([self.seed, 1])
        q = self.truth.trajectory.q
        sd = np.full(self.truth.model.nv, self.noise.angle)
        sd[:3], sd[3:6] = self.noise.position, self.noise.orientation
        step = sd * rng.normal(size=(q.shape[0], sd.size))
        return np.array([pin.integrate(self.truth.model, row, d) for row, d in zip(q, step, strict=True)])

    @cached_property
    def measured_motion(self) -> tuple[LinkMotion, BoolArray, HumanDynamicsNoise]:
        """The motion from noisy motion capture, differentiated; which frames (n,) it has; the noise of its accelerations."""
        model = self.body.model()
        found = differentiate_configurations(model, self.configurations, 1.0 / RATE, self.noise.bandwidth)
        keep = found.good
        motion = PinocchioTree(model).motion(self.t[keep], found.q[keep], found.qd[keep], found.qdd[keep])
        n, gain = self.noise, found.acceleration_gain
        root = [n.position**2 * gain] * 3 + [n.orientation**2 * gain] * 3
        variances = HumanDynamicsNoise(
            joint_acceleration=max(n.angle**2 * gain, 1e-12), link_acceleration=np.maximum(root, 1e-12)
        )
        return motion, keep, variances

    @cached_property
    def plates(self) -> dict[str, ForceRecording]:
        """Foot to the force under it, with its centre of pressure on the ground and a free moment, with noise."""
        rng = np.random.default_rng([self.seed, 2])
        out = {}
        for link in FEET:
            i = self.truth.motion.link(link)
            R, p = self.truth.motion.R[:, i], self.truth.motion.p[:, i]
            wrench = self.truth.external_wrench[link]
            f, m = ((R @ part[:, :, None])[..., 0] for part in (wrench[:, :3], wrench[:, 3:]))
            loaded = np.linalg.norm(f, axis=1) > 1.0
            f = f + loaded[:, None] * self.noise.force * rng.normal(size=f.shape)
            m = m + loaded[:, None] * self.noise.moment * rng.normal(size=m.shape)
            about = m + np.cross(p, f)
            safe = np.where(np.abs(f[:, 2]) > 1.0, f[:, 2], np.inf)
            point = np.column_stack([-about[:, 1] / safe, about[:, 0] / safe, np.zeros(len(f))])
            out[link] = ForceRecording(self.t, f, point, about - np.cross(point, f), link)
        return out

    @cached_property
    def state_noise(self) -> StateNoise:
        """Noise of the configurations of :attr:`measured_motion`, for its ``with_state_noise``."""
        n, tree = self.noise, PinocchioTree(self.body.model())
        sd = np.array([n.position] * 3 + [n.orientation] * 3 + [n.angle] * (tree.model.nv - 6))
        return StateNoise.through_savgol(sd[tree.tangent_columns] ** 2, self.filter_window, ORDER, 1.0 / RATE)

    @property
    def filter_window(self) -> int:
        """Samples of the filter of :attr:`measured_motion`: frames so far apart have independent errors."""
        return choose_savgol(self.noise.bandwidth, 1.0 / RATE, ORDER)

    def foot_sensors(
        self,
        motion: LinkMotion,
        keep: BoolArray | IntArray | slice = slice(None),
        unloaded: float | None = None,
    ) -> list[ExternalWrench]:
        """The plates as sensors at the frames of `motion`, with the covariance of their noise.

        A plate that nobody stands on reads zero without noise here; `unloaded` is the variance (N^2, (Nm)^2) to state of it then.
        """
        n = self.noise
        variance = np.array([n.force**2] * 3 + [n.moment**2] * 3)
        out = []
        for link, plate in self.plates.items():
            origin = motion.p[:, motion.link(link)]
            values = plate_wrench(plate.force[keep], plate.point[keep], plate.moment[keep], origin)
            stated = variance
            if unloaded is not None:
                stated = np.where(np.any(plate.force[keep], axis=1)[:, None], variance, unloaded)
            out.append(ExternalWrench(values, stated, f"plate under {link}", link=link, frame="world"))
        return out

    def hand_sensors(self, keep: BoolArray | slice = slice(None)) -> list[ExternalWrench]:
        """A robot's force/torque sensors in the hands."""
        rng = np.random.default_rng([self.seed, 3])
        n = self.noise
        sd = np.array([n.hand_force] * 3 + [n.hand_moment] * 3)
        out = []
        for link in HANDS:
            true = self.truth.external_wrench.get(link, np.zeros((self.t.size, 6)))
            values = true + sd * rng.normal(size=true.shape)
            out.append(ExternalWrench(values[keep], sd**2, f"force sensor at {link}", link=link))
        return out

    def imus(
        self, keep: BoolArray | IntArray | slice = slice(None), links: Sequence[str] = IMU_LINKS
    ) -> list[Sensor]:
        """Accelerometers at the centres of mass of links, in their axes."""
        rng = np.random.default_rng([self.seed, 4])
        out: list[Sensor] = []
        for link in links:
            motion = self.truth.motion
            i, at = motion.link(link), self.body.segments[link].com
            w, dw = (
                rotate_back(motion.R[:, i], x[:, i])
                for x in (motion.angular_velocity, motion.angular_acceleration)
            )
            f = rotate_back(motion.R[:, i], motion.acceleration[:, i] - motion.gravity)
            f = f + np.cross(dw, at) + np.cross(w, np.cross(w, at))
            values = f + self.noise.accelerometer * rng.normal(size=f.shape)
            out.append(
                Accelerometer(
                    values[keep], self.noise.accelerometer**2, f"accelerometer on {link}", link=link, p_l_s=at
                )
            )
        return out

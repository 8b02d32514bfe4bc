"""The terms of the human-dynamics problem: which unknowns they touch, how sure they are; the sensors' own terms stand elsewhere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.least_squares import Term
from factorgrasp.problems.human_dynamics_names import (
    acceleration_of,
    joint_acceleration_of,
    pose_error_of,
    wrench_of,
    wrench_on,
)
from factorgrasp.problems.human_dynamics_sensors import Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise, resolve
from factorgrasp.problems.human_dynamics_state import holders
from factorgrasp.problems.link_motion import BodyTree
from factorgrasp.typing import FloatArray
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable

MOTION = np.ones((6, 6), dtype=bool)
MOTION[3:, :3] = False
"""Pattern of a motion transform; that of a wrench is its transpose."""

ACCELERATION = ("linear x", "linear y", "linear z", "angular x", "angular y", "angular z")
WRENCH = ("force x", "force y", "force z", "moment x", "moment y", "moment z")


class DynamicsTerms:
    """Variables and terms for one body, noise and set of contacts.

    Attributes
    ----------
    axes : tuple of int
        Joints with known axes.
    motion_joints, motion_links : list of int
        Joints and links whose accelerations are taken from the motion; filled by :meth:`kinematic`.
    """

    def __init__(
        self, tree: BodyTree, noise: HumanDynamicsNoise, contacts: tuple[str, ...], state_errors: bool = False
    ) -> None:
        self.tree, self.noise, self.contacts, self.state_errors = tree, noise, contacts, state_errors
        self.axes = tuple(j for j, dofs in enumerate(tree.dofs) if dofs)
        self.motion_joints: list[int] = []
        self.motion_links: list[int] = []

    def variables(self) -> list[Variable]:
        """Accelerations and external wrenches of links, wrenches and accelerations of joints."""
        tree = self.tree
        out = [
            Variable(acceleration_of(link), 6, unit="m/s^2, rad/s^2", components=ACCELERATION)
            for i, link in enumerate(tree.links)
            if not (tree.fixed_base and i == tree.root)
        ]
        out += [Variable(wrench_on(link), 6, unit="N, Nm", components=WRENCH) for link in tree.links]
        out += [Variable(wrench_of(joint), 6, unit="N, Nm", components=WRENCH) for joint in tree.joints]
        out += [
            Variable(
                joint_acceleration_of(tree.joints[j]),
                len(tree.dofs[j]),
                unit="rad/s^2",
                components=tree.dofs[j],
            )
            for j in self.axes
        ]
        if self.state_errors:
            out += [Variable(name, at.size, unit="rad, m") for name, at in holders(tree)]
        return out

    def dynamics(self) -> list[Term]:
        """Propagation through every joint with known axes, and balance of every link."""
        tree, noise = self.tree, self.noise
        eye = np.eye(6, dtype=bool)
        joints = [tree.joints[j] for j in self.axes]
        propagation = resolve(noise.propagation, joints, [6] * len(joints), "propagation variance")
        balance = resolve(noise.balance, tree.links, [6] * len(tree.links), "balance variance")
        terms = []
        for j, variance in zip(self.axes, propagation, strict=True):
            pattern = {acceleration_of(tree.links[tree.children[j]]): eye}
            if not self.given(tree.parents[j]):
                pattern[acceleration_of(tree.links[tree.parents[j]])] = MOTION
            S = tree.subspaces[j]
            pattern[joint_acceleration_of(tree.joints[j])] = (
                np.ones((6, len(tree.dofs[j])), dtype=bool) if S is None else S != 0.0
            )
            if self.state_errors:
                pattern[pose_error_of(tree.joints[j])] = np.ones((6, len(tree.dofs[j])), dtype=bool)
            name = f"propagation through {tree.joints[j]}"
            terms.append(
                Term(
                    name,
                    6,
                    tuple(pattern),
                    Covariance.diagonal(variance),
                    pattern=pattern,
                    unit="m/s^2, rad/s^2",
                )
            )
        for i, link in enumerate(tree.links):
            pattern = {wrench_on(link): eye}
            if not self.given(i) and np.any(tree.spatial_inertia[i]):
                pattern[acceleration_of(link)] = tree.spatial_inertia[i] != 0.0
            for j, joint in enumerate(tree.joints):
                if tree.children[j] == i:
                    pattern[wrench_of(joint)] = eye
                elif tree.parents[j] == i:
                    pattern[wrench_of(joint)] = MOTION.T
                    if self.state_errors:
                        pattern[pose_error_of(joint)] = np.ones((6, len(tree.dofs[j])), dtype=bool)
            terms.append(
                Term(
                    f"balance of {link}",
                    6,
                    tuple(pattern),
                    Covariance.diagonal(balance[i]),
                    pattern=pattern,
                    unit="N, Nm",
                )
            )
        return terms

    def given(self, link: int) -> bool:
        """Whether the acceleration of a link is given: that of a fixed base."""
        return self.tree.fixed_base and link == self.tree.root

    def kinematic(self, sensors: Sequence[Sensor]) -> list[Term]:
        """The motion's own accelerations, where no sensor gives them."""
        tree, noise = self.tree, self.noise
        have = {(sensor.kind, sensor.where) for sensor in sensors}
        self.motion_joints = [j for j in self.axes if ("joint acceleration", tree.joints[j]) not in have]
        behind = {int(tree.children[j]) for j, dofs in enumerate(tree.dofs) if not dofs}
        if not tree.fixed_base:
            behind.add(tree.root)
        self.motion_links = [i for i in sorted(behind) if ("link acceleration", tree.links[i]) not in have]
        names = [tree.joints[j] for j in self.axes]
        spread = resolve(
            noise.joint_acceleration,
            names,
            [len(tree.dofs[j]) for j in self.axes],
            "joint acceleration variance",
        )
        by_joint = dict(zip(self.axes, spread, strict=True))
        by_link = resolve(
            noise.link_acceleration, tree.links, [6] * len(tree.links), "link acceleration variance"
        )
        terms = []
        for j in self.motion_joints:
            name = joint_acceleration_of(tree.joints[j])
            size = len(tree.dofs[j])
            pattern = {name: np.eye(size, dtype=bool)}
            terms.append(
                Term(
                    f"motion: {name}",
                    size,
                    (name,),
                    Covariance.diagonal(by_joint[j]),
                    pattern=pattern,
                    unit="rad/s^2",
                )
            )
        for i in self.motion_links:
            name = acceleration_of(tree.links[i])
            terms.append(
                Term(
                    f"motion: {name}",
                    6,
                    (name,),
                    Covariance.diagonal(by_link[i]),
                    pattern={name: np.eye(6, dtype=bool)},
                )
            )
        return terms

    def zero(self, sensors: Sequence[Sensor]) -> list[Term]:
        """Zero external wrench: tight on free links, loose on contacts that nobody measures, none on a fixed base."""
        tree = self.tree
        measured = {
            link
            for s in sensors
            if s.kind.startswith("external wrench")
            for link in getattr(s, "links", (s.where,))
        }
        twice = measured & set(self.contacts)
        if twice:
            raise InputError(
                "contacts",
                "links without a wrench sensor",
                ", ".join(sorted(twice)),
                "A measured wrench needs no entry here",
            )
        free = resolve(self.noise.free_wrench, tree.links, [6] * len(tree.links), "free wrench variance")
        loose = resolve(
            self.noise.contact_wrench, tree.links, [6] * len(tree.links), "contact wrench variance"
        )
        terms = []
        for i, link in enumerate(tree.links):
            # What holds a fixed base is not measured either, and it is never nothing.
            if link in measured or (self.given(i) and link not in self.contacts):
                continue
            touched = link in self.contacts
            name = f"unmeasured wrench on {link}" if touched else f"no wrench on {link}"
            pattern = {wrench_on(link): np.eye(6, dtype=bool)}
            variance = loose[i] if touched else free[i]
            terms.append(
                Term(
                    name, 6, (wrench_on(link),), Covariance.diagonal(variance), pattern=pattern, unit="N, Nm"
                )
            )
        return terms

    def prior(self, variables: Sequence[Variable]) -> list[Term]:
        """Prior with mean zero on every unknown."""
        tree, noise = self.tree, self.noise
        links = [6] * len(tree.links)
        by_name: dict[str, FloatArray] = {}
        for name, variance in zip(
            tree.links,
            resolve(noise.prior_link_acceleration, tree.links, links, "prior variance"),
            strict=True,
        ):
            by_name[acceleration_of(name)] = variance
        for name, variance in zip(
            tree.links, resolve(noise.prior_external_wrench, tree.links, links, "prior variance"), strict=True
        ):
            by_name[wrench_on(name)] = variance
        joints = resolve(noise.prior_joint_wrench, tree.joints, [6] * len(tree.joints), "prior variance")
        for name, variance in zip(tree.joints, joints, strict=True):
            by_name[wrench_of(name)] = variance
        names = [tree.joints[j] for j in self.axes]
        sizes = [len(tree.dofs[j]) for j in self.axes]
        for name, variance in zip(
            names, resolve(noise.prior_joint_acceleration, names, sizes, "prior variance"), strict=True
        ):
            by_name[joint_acceleration_of(name)] = variance
        out = []
        for v in variables:
            if v.name not in by_name:
                continue
            covariance = Covariance.diagonal(by_name[v.name])
            pattern = {v.name: np.eye(v.size, dtype=bool)}
            out.append(
                Term(f"prior of {v.name}", v.size, (v.name,), covariance, pattern=pattern, unit=v.unit)
            )
        return out

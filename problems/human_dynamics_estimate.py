"""What the human-dynamics problem gives back: torques, joint moments, wrenches and accelerations with covariances, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgrasp.problems.human_dynamics_innovations import Innovation, innovations
from factorgrasp.problems.human_dynamics_state import torque_turn
from factorgrasp.problems.link_motion_spatial import rotate_back, skew
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, IntArray

if TYPE_CHECKING:
    from factorgrasp.problems.human_dynamics import HumanDynamics
    from factorgrasp.problems.human_dynamics_active import ActiveConstraint


@dataclass(frozen=True)
class HumanDynamicsEstimate:
    """Estimates of n frames; NaN in frames that were not solved, and in all sd and covariances when none was asked for.

    Attributes
    ----------
    t : ndarray
        (n,) s.
    links, joint_names, dof_names : tuple of str
    torque, torque_sd : ndarray
        (n, dofs) of every degree of freedom with known axes, Nm (N for a sliding one).
    torque_covariance : tuple of ndarray
        (n, n_j, n_j) by joint with known axes.
    joint_moment, joint_force : ndarray
        (n, J, 3) world axes, action of the parent on the child, the moment about the joint centre, Nm and N.
    joint_moment_covariance : ndarray
        (n, J, 3, 3).
    joint_wrench, joint_wrench_sd : ndarray
        (n, J, 6) ``[force; moment]`` in the child's frame.
    joint_wrench_covariance : ndarray
        (n, J, 6, 6).
    external_wrench, external_wrench_sd : ndarray
        (n, L, 6) net external wrench on every link in its frame.
    external_wrench_covariance : ndarray
        (n, L, 6, 6).
    acceleration, acceleration_sd : ndarray
        (n, L, 6) proper spatial acceleration of every link in its frame; that of a fixed base is given (sd 0).
    joint_acceleration, joint_acceleration_sd : ndarray
        (n, dofs).
    innovations : tuple of Innovation
        One a sensor: how well each agrees with what all the others predict for it.
    status : tuple of Status
    messages : mapping of int to str
        By frame, where there is something to say.
    solver : str
    time : float
        Seconds of the solve, all frames.
    active : tuple of ActiveConstraint
        Constraints that hold with equality, with their multipliers.
    """

    t: FloatArray
    links: tuple[str, ...]
    joint_names: tuple[str, ...]
    dof_names: tuple[str, ...]
    torque: FloatArray
    torque_sd: FloatArray
    torque_covariance: tuple[FloatArray, ...]
    joint_moment: FloatArray
    joint_force: FloatArray
    joint_moment_covariance: FloatArray
    joint_wrench: FloatArray
    joint_wrench_sd: FloatArray
    joint_wrench_covariance: FloatArray
    external_wrench: FloatArray
    external_wrench_sd: FloatArray
    external_wrench_covariance: FloatArray
    acceleration: FloatArray
    acceleration_sd: FloatArray
    joint_acceleration: FloatArray
    joint_acceleration_sd: FloatArray
    innovations: tuple[Innovation, ...]
    status: tuple[Status, ...]
    messages: Mapping[int, str] = field(default_factory=dict)
    solver: str = ""
    time: float = float("nan")
    active: tuple[ActiveConstraint, ...] = ()

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def solved(self) -> bool:
        """Whether every frame is solved."""
        return all(status.ok for status in self.status)

    @property
    def joint_moment_sd(self) -> FloatArray:
        """(n, J, 3) Nm."""
        return np.asarray(
            np.sqrt(np.maximum(np.diagonal(self.joint_moment_covariance, axis1=2, axis2=3), 0.0))
        )

    def innovation(self, sensor: str) -> Innovation:
        """Innovation of a sensor by its name."""
        from factorgrasp.errors import InputError

        for found in self.innovations:
            if found.name == sensor:
                return found
        raise InputError("sensor", "one of " + ", ".join(i.name for i in self.innovations), repr(sensor))

    def summary(self) -> str:
        """A few lines for a terminal: torques, agreement of the sensors, constraints that are active."""
        from factorgrasp.problems.human_dynamics_words import summarize

        return summarize(self)


def _by_group(groups: Sequence[IntArray], blocks: Sequence[FloatArray]) -> dict[tuple[int, ...], FloatArray]:
    return (
        {tuple(map(int, group)): block for group, block in zip(groups, blocks, strict=True)} if blocks else {}
    )


def _nothing(*shape: int) -> FloatArray:
    return np.broadcast_to(np.nan, shape)


def _at(sd: FloatArray | None, columns: IntArray, count: int) -> FloatArray:
    """Standard deviations (n, ...) of some unknowns."""
    return (
        _nothing(count, *columns.shape)
        if sd is None
        else sd[:, columns.ravel()].reshape(count, *columns.shape)
    )


def read_frames(problem: HumanDynamics, result: Any) -> HumanDynamicsEstimate:
    """Typed view of a :class:`factorgrasp.solvers.frames.FrameResult`."""
    from factorgrasp.problems.human_dynamics_active import active_constraints

    system, motion = problem.system, problem.motion
    tree, columns, x = system.tree, system.columns, result.x
    count, links, joints = x.shape[0], len(tree.links), len(tree.joints)
    k = problem.kinematics
    have = bool(result.marginals)
    known = _by_group(system.marginals, result.marginals)
    turning = system.turning
    # Without covariances: views of a single NaN, as arrays of it would take longer than the solve.
    P_joint = (
        np.stack(result.marginals[:joints], axis=1) if have and joints else _nothing(count, joints, 6, 6)
    )
    P_link = (
        np.stack(result.marginals[joints : joints + links], axis=1) if have else _nothing(count, links, 6, 6)
    )
    sd = np.sqrt(np.maximum(result.variances, 0.0)) if have else None
    acceleration = x[:, columns.acceleration.ravel()].reshape(count, links, 6)
    acceleration_sd = _at(sd, columns.acceleration, count)
    if tree.fixed_base:
        acceleration[:, tree.root] = k.acceleration[:, tree.root]
        if have:
            acceleration_sd[:, tree.root] = 0.0
    wrench = x[:, columns.joint_wrench.ravel()].reshape(count, joints, 6)
    torque, torque_cov = [], []
    for j in system.axes:
        S = k.subspaces[j]
        assert S is not None
        back = np.swapaxes(S, 1, 2)
        torque.append((back @ wrench[:, j, :, None])[..., 0])
        group = turning.get(j)
        if group is None and not have:
            torque_cov.append(_nothing(count, S.shape[2], S.shape[2]))
            continue
        if group is None:
            torque_cov.append(np.asarray(back @ P_joint[:, j] @ S))
            continue
        # Errors of the joint's position turn its axes.
        T = torque_turn(S, wrench[:, j])
        torque[-1] = torque[-1] + (T @ x[:, group[6:], None])[..., 0]
        reader = np.concatenate([back, T], axis=2)
        P = known.get(tuple(map(int, group)))
        blank = _nothing(count, S.shape[2], S.shape[2])
        torque_cov.append(blank if P is None else np.asarray(reader @ P @ np.swapaxes(reader, 1, 2)))
    dofs = [columns.joint_acceleration[j] for j in system.axes]
    at = np.concatenate([*dofs, np.empty(0, dtype=np.intp)]).astype(np.intp)
    torque_var = [np.diagonal(C, axis1=1, axis2=2) for C in torque_cov]
    R = k.R[:, tree.children]
    centre = rotate_back(R, k.joint_centre - k.p[:, tree.children])
    T = np.concatenate([-R @ skew(centre), R], axis=-1)
    return HumanDynamicsEstimate(
        t=motion.t,
        links=tree.links,
        joint_names=tree.joints,
        dof_names=motion.dof_names,
        torque=np.concatenate(torque, axis=1) if torque else np.zeros((count, 0)),
        torque_sd=np.sqrt(np.maximum(np.concatenate(torque_var, axis=1), 0.0))
        if torque
        else np.zeros((count, 0)),
        torque_covariance=tuple(torque_cov),
        joint_moment=(T @ wrench[..., None])[..., 0],
        joint_force=(R @ wrench[..., :3, None])[..., 0],
        joint_moment_covariance=T @ P_joint @ np.swapaxes(T, -1, -2)
        if have
        else _nothing(count, joints, 3, 3),
        joint_wrench=wrench,
        joint_wrench_sd=_at(sd, columns.joint_wrench, count),
        joint_wrench_covariance=P_joint,
        external_wrench=x[:, columns.external_wrench.ravel()].reshape(count, links, 6),
        external_wrench_sd=_at(sd, columns.external_wrench, count),
        external_wrench_covariance=P_link,
        acceleration=acceleration,
        acceleration_sd=acceleration_sd,
        joint_acceleration=x[:, at],
        joint_acceleration_sd=_at(sd, at, count),
        innovations=innovations(problem, k, result) if have else (),
        status=tuple(result.status),
        messages=dict(result.messages),
        solver=result.solver,
        time=result.time,
        active=active_constraints(problem, k, result),
    )

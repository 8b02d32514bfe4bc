"""What noise of the configuration does to the non-collocated estimate: to the rate of momentum, to measured wrenches, to accelerations.

With ``delta`` the true less the measured configuration and ``eps`` the same of its accelerations, the momentum's rows of the truth read at
the measured motion are

    ``hdot - sum_i A_i w_i = sum_i A_i (e_i + B(w_i) J_i delta) - sum_i A_i (B(W_i) J_i delta + I_i dalpha_i)``

with ``J_i`` the twist of link i by ``delta``, ``W_i`` its inertial wrench, ``xi x* w = B(w) xi``, and ``e_i`` true
less measured. Where a wrench
is given in world axes, ``e_i`` holds ``-B(w_i) J_i delta``: what plates measure does not depend on the motion. The
shift of the centre of mass is
the same on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgrasp.problems.human_dynamics_state import places, wrench_turn
from factorgrasp.problems.link_motion import BodyTree, LinkKinematics, LinkMotion, StateNoise
from factorgrasp.problems.link_motion_spatial import cross_motion, skew, velocity_wrench
from factorgrasp.typing import FloatArray

AT_ONCE = 200
"""Frames whose Jacobians of all links are held at a time."""


@dataclass(frozen=True)
class StateSpread:
    """First-order effect of the state's noise, as factors on 2 k independent standard normal numbers (those of ``delta`` first).

    Attributes
    ----------
    innovation : ndarray
        (n, 6, 2 k) on ``hdot - sum A_i w_i``.
    wrench : ndarray
        (n, m, 6, k) on the wrenches that are measured in world axes, zero for other measured ones; true less measured.
    acceleration : ndarray
        (n, c, 6, 2 k) on the proper accelerations of the contacts, in their frames; true less measured.
    """

    innovation: FloatArray
    wrench: FloatArray
    acceleration: FloatArray


def state_spread(
    motion: LinkMotion,
    noise: StateNoise,
    maps: FloatArray,
    wrenches: FloatArray,
    measured: Sequence[int],
    in_world: Sequence[bool],
    contacts: Sequence[int],
) -> StateSpread:
    """Spread of all frames.

    Parameters
    ----------
    motion : LinkMotion
    noise : StateNoise
    maps : ndarray
        (n, L, 6, 6) ``A_i``.
    wrenches : ndarray
        (n, L, 6) external wrenches in the links' frames, as far as they are known.
    measured : sequence of int
        Links with a sensor; `in_world` says which of them give world axes.
    contacts : sequence of int
        Links whose wrenches nobody measures.
    """
    parts = []
    for first in range(0, len(motion), AT_ONCE):
        frames = slice(first, min(first + AT_ONCE, len(motion)))
        k = motion.kinematics(frames)
        parts.append(
            _spread(
                motion.tree,
                noise.select(frames),
                k,
                maps[frames],
                wrenches[frames],
                measured,
                in_world,
                contacts,
            )
        )
    return StateSpread(*(np.concatenate(group) for group in zip(*parts, strict=True)))


def _spread(
    tree: BodyTree, noise: StateNoise, k: LinkKinematics, maps: FloatArray, wrenches: FloatArray,
    measured: Sequence[int], in_world: Sequence[bool], contacts: Sequence[int],
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    J, dalpha = link_jacobians(tree, k, noise.size)
    inertial = (tree.spatial_inertia @ k.acceleration[..., None])[..., 0] - velocity_wrench(
        tree.spatial_inertia, k.velocity
    )
    turned = inertial.copy()
    for link in contacts:
        turned[:, link] -= wrenches[:, link]
    for link, world in zip(measured, in_world, strict=True):
        if not world:
            turned[:, link] -= wrenches[:, link]
    by_q = -np.einsum("nlij,nljk->nik", maps, wrench_turn(turned) @ J + tree.spatial_inertia @ dalpha)
    by_a = -np.einsum("nlij,nljk->nik", maps @ tree.spatial_inertia, J)
    first, cross, left = np.sqrt(noise.position_gain), noise.ratio * np.sqrt(noise.position_gain), noise.left
    innovation = np.concatenate([_times(first * by_q + cross * by_a, noise), _times(by_a, left)], axis=2)
    wrench = np.zeros((k.count, len(measured), 6, noise.size))
    for i, (link, world) in enumerate(zip(measured, in_world, strict=True)):
        if world:
            wrench[:, i] = _times(-first * wrench_turn(wrenches[:, link]) @ J[:, link], noise)
    acceleration = np.zeros((k.count, len(contacts), 6, 2 * noise.size))
    for i, link in enumerate(contacts):
        acceleration[:, i, :, : noise.size] = _times(first * dalpha[:, link] + cross * J[:, link], noise)
        acceleration[:, i, :, noise.size :] = _times(J[:, link], left)
    return innovation, wrench, acceleration


def link_jacobians(tree: BodyTree, k: LinkKinematics, size: int) -> tuple[FloatArray, FloatArray]:
    """Twists and proper accelerations of links by errors of the configuration: ``J_i``, ``d alpha_i / d delta``, (n, L, 6, k).

    By errors of the accelerations it is ``d alpha_i / d eps = J_i``.
    """
    J, dalpha = np.zeros((k.count, len(tree.links), 6, size)), np.zeros((k.count, len(tree.links), 6, size))
    if not tree.fixed_base:
        root = tree.root
        J[:, root, :, :6] = np.eye(6)
        v = k.velocity[:, root]
        dalpha[:, root, :3, 3:6] = skew(k.acceleration[:, root, :3] + np.cross(v[:, 3:], v[:, :3]))
    ends, columns = np.cumsum([0, *k.sizes]), places(tree)
    for j in reversed(tree.from_leaves):
        up, down, own = int(tree.parents[j]), int(tree.children[j]), slice(ends[j], ends[j + 1])
        X, S = k.transform[:, j], k.axes[:, own]
        J[:, down] = X @ J[:, up]
        dalpha[:, down] = X @ dalpha[:, up]
        at = slice(int(columns[j][0]), int(columns[j][-1]) + 1)
        J[:, down, :, at] += np.swapaxes(S, 1, 2)
        carried = (X @ k.acceleration[:, up, :, None])[..., 0]
        change = cross_motion(carried[:, None], S)
        if tree.subspaces[j] is None:
            term = S * k.joint_acceleration[:, own, None]
            change = change - cross_motion(S, np.cumsum(term, axis=1) - term)
        dalpha[:, down, :, at] += np.swapaxes(change, 1, 2)
    return J, dalpha


def _times(A: FloatArray, noise: StateNoise) -> FloatArray:
    """``A L`` (n, 6, k) with ``L L'`` the covariance of the configuration."""
    if noise.full:
        return np.asarray(A @ np.linalg.cholesky(noise.covariance))
    return np.asarray(A * np.sqrt(noise.covariance)[..., None, :])

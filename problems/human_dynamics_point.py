"""Wrenches at which errors of poses are linearised: those that Newton and Euler's recursion makes of what is measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgrasp.problems.human_dynamics_sensors import ExternalWrench, Sensor, WrenchSet
from factorgrasp.problems.link_motion import BodyTree, LinkKinematics
from factorgrasp.problems.link_motion_spatial import rotate, rotate_back, skew, velocity_wrench
from factorgrasp.typing import FloatArray


def newton_euler(tree: BodyTree, k: LinkKinematics, external: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Joint wrenches (n, J, 6), parent on child in the child's frame, and the wrench (n, 6) on the root that is left unexplained.

    Parameters
    ----------
    tree : BodyTree
    k : LinkKinematics
    external : ndarray
        (n, L, 6) net external wrenches in the links' frames.
    """
    net = (
        (tree.spatial_inertia @ k.acceleration[..., None])[..., 0]
        - velocity_wrench(tree.spatial_inertia, k.velocity)
        - external
    )
    f = np.zeros((k.count, len(tree.joints), 6))
    for j in tree.from_leaves:
        f[:, j] = net[:, tree.children[j]]
        net[:, tree.parents[j]] += (np.swapaxes(k.transform[:, j], 1, 2) @ f[:, j, :, None])[..., 0]
    return f, net[:, tree.root]


def measured_wrenches(
    tree: BodyTree, k: LinkKinematics, sensors: Sequence[Sensor], values: Sequence[FloatArray]
) -> tuple[FloatArray, bool]:
    """External wrenches (n, L, 6) in the links' frames as sensors have them, zero elsewhere; and whether that is all there is.

    Parameters
    ----------
    tree : BodyTree
    k : LinkKinematics
    sensors : sequence of Sensor
    values : sequence of ndarray
        (n, size) of every sensor.
    """
    out, complete = np.zeros((k.count, len(tree.links), 6)), True
    for sensor, value in zip(sensors, values, strict=True):
        if not isinstance(sensor, ExternalWrench | WrenchSet):
            continue
        gaps = np.isnan(value)
        complete = complete and not gaps.any()
        known = np.where(gaps, 0.0, value)
        if isinstance(sensor, WrenchSet):
            # Zeros of contacts that nobody measures come so as well.
            complete = complete and bool(np.any(known))
            for i, link in enumerate(sensor.links):
                out[:, tree.links.index(link)] += known[:, 6 * i : 6 * i + 6]
            continue
        at = tree.links.index(sensor.link)
        force, moment = known[:, :3], known[:, 3:]
        if sensor.frame == "world":
            R = k.R[:, at]
            out[:, at] += np.concatenate([rotate_back(R, force), rotate_back(R, moment)], axis=1)
        else:
            R_l_s, p = np.asarray(sensor.R_l_s, dtype=float), np.asarray(sensor.p_l_s, dtype=float)
            F = rotate(R_l_s, force)
            out[:, at] += np.concatenate([F, rotate(R_l_s, moment) + F @ skew(p).T], axis=1)
    return out, complete

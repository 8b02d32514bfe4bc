"""Entries of the human-dynamics rows that change from frame to frame: functions of the kinematics, written into fixed places."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from factorgrasp.problems.human_dynamics_terms import MOTION
from factorgrasp.problems.link_motion import BodyTree, LinkKinematics
from factorgrasp.typing import BoolArray, FloatArray, IntArray

Writer = Callable[[LinkKinematics], FloatArray]


def flat(make: Writer) -> Writer:
    """Blocks as one row of entries a frame."""
    return lambda k: make(k).reshape(k.count, -1)


def minus_axes(tree: BodyTree, joints: Sequence[int]) -> Writer:
    """``-S`` of joints whose axes move."""
    ends = np.cumsum([len(dofs) for dofs in tree.dofs])
    chosen = []
    for j in joints:
        size = len(tree.dofs[j])
        column, row = np.tile(np.arange(ends[j] - size, ends[j]), 6), np.repeat(np.arange(6), size)
        chosen.append(6 * column + row)
    index = np.concatenate(chosen)
    return lambda k: np.negative(k.axes.reshape(k.count, -1).take(index, axis=1))


def minus_transform(joints: IntArray) -> Writer:
    """``-X`` of joints, the entries of its pattern."""
    rows, cols = np.nonzero(MOTION)
    index = (36 * joints[:, None] + 6 * rows + cols).ravel()
    return lambda k: np.negative(k.transform.reshape(k.count, -1).take(index, axis=1))


def transposed_transform(joints: IntArray) -> Writer:
    """``X'`` of joints, the entries of its pattern."""
    rows, cols = np.nonzero(MOTION.T)
    index = (36 * joints[:, None] + 6 * cols + rows).ravel()
    return lambda k: k.transform.reshape(k.count, -1).take(index, axis=1)


def masked(make: Writer, pattern: BoolArray) -> Writer:
    """The entries of a pattern."""
    return lambda k: make(k)[:, pattern]

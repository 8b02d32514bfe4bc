"""What the covariances of an estimated state are for the rows of human dynamics."""

from __future__ import annotations

from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.body_state import BodyState
from factorgrasp.models.osim import GROUND, OsimModel
from factorgrasp.problems.human_dynamics_settings import PerName
from factorgrasp.problems.link_motion import StateNoise
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.typing import FloatArray


def state_noise(state: BodyState, tree: PinocchioTree) -> StateNoise:
    """Noise of configurations and accelerations at the good frames, in the order and frames that a link motion has.

    Accelerations keep their correlations: joints that take turns in an error, as vertebrae between two markers do, move nothing else.
    """
    at = tree.tangent_columns
    variance, A = state.q_variance[state.good].copy(), state.qdd_covariance
    A = A[state.good] if A.ndim == 3 else A
    if tree.floating:
        turn = lie.quaternion_wxyz_to_matrix(np.roll(state.q[state.good, 3:7], 1, axis=1))
        back = np.swapaxes(turn, 1, 2)
        variance[:, :3] = np.diagonal(back @ state.root_covariance[state.good] @ turn, axis1=1, axis2=2)
        if A.ndim == 3:
            A = A.copy()
            A[:, :3] = back @ A[:, :3]
            A[:, :, :3] = A[:, :, :3] @ turn
    A = A[..., at, :][..., at]
    return StateNoise(
        variance[:, at], acceleration=0.5 * (A + np.swapaxes(A, -1, -2)) + 1e-10 * np.eye(at.size)
    )


def acceleration_variances(model: Any, state: BodyState) -> dict[str, PerName]:
    """Variances of the accelerations of joints and of the root, medians over the recording."""
    middle = np.median(state.qdd_variance[state.good], axis=0)
    if isinstance(model, OsimModel):
        return _osim_variances(model, state, middle)
    tree = PinocchioTree(model)
    floating = tree.floating
    joints: dict[str, Any] = {
        name: tuple(float(v) for v in np.maximum(middle[columns], 1e-10))
        for name, columns in zip(tree.joint_names, tree.columns, strict=True)
    }
    out: dict[str, PerName] = {"joint_acceleration": {"default": 1e-3, **joints}}
    if floating:
        # Of the translation along world axes: its mean holds along the body's, too.
        linear = float(np.mean(middle[:3]))
        out["link_acceleration"] = tuple(float(max(v, 1e-10)) for v in (linear, linear, linear, *middle[3:6]))
    return out


def _osim_variances(model: OsimModel, state: BodyState, middle: FloatArray) -> dict[str, PerName]:
    at = {name: k for k, name in enumerate(model.names)}
    joints = {
        joint.name: tuple(float(max(middle[at[name]], 1e-8)) for name in joint.coordinates)
        for joint in model.joints
        if joint.parent != GROUND and joint.coordinates
    }
    root = next(joint for joint in model.joints if joint.parent == GROUND)
    some = np.flatnonzero(state.good)[:: max(1, int(state.good.sum()) // 20)]
    S = root.subspace(model.values(state.q[some]), some.size)
    spread = np.mean(S**2 @ middle[[at[name] for name in root.coordinates]][None, :, None], axis=0)[:, 0]
    return {
        "joint_acceleration": {"default": 1e-3, **joints},
        "link_acceleration": tuple(float(max(v, 1e-8)) for v in spread),
    }

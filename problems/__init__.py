"""Problems: what is unknown, what is measured, how they are tied. One file a problem; none knows a solver.

Names load when first used, so that one problem does not pay for the others.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from factorgrasp.problems.grasp_estimate import GraspPoseEstimate
    from factorgrasp.problems.grasp_from_poses import GraspPoseFromPoses
    from factorgrasp.problems.grasp_from_poses_estimate import GraspFromPosesEstimate
    from factorgrasp.problems.grasp_from_poses_settings import GraspFromPosesNoise, GraspFromPosesSettings
    from factorgrasp.problems.grasp_pose import GraspPose
    from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings

_WHERE = {
    "GraspFromPosesEstimate": "grasp_from_poses_estimate",
    "GraspFromPosesNoise": "grasp_from_poses_settings",
    "GraspFromPosesSettings": "grasp_from_poses_settings",
    "GraspNoise": "grasp_settings",
    "GraspPose": "grasp_pose",
    "GraspPoseEstimate": "grasp_estimate",
    "GraspPoseFromPoses": "grasp_from_poses",
    "GraspPrior": "grasp_settings",
    "GraspSettings": "grasp_settings",
}

__all__ = [
    "GraspFromPosesEstimate",
    "GraspFromPosesNoise",
    "GraspFromPosesSettings",
    "GraspNoise",
    "GraspPose",
    "GraspPoseEstimate",
    "GraspPoseFromPoses",
    "GraspPrior",
    "GraspSettings",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_WHERE[name]}"), name)

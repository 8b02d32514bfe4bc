"""Problems: what is unknown, what is measured, how they are tied. One file a problem; none knows a solver."""

from __future__ import annotations

from factorgrasp.problems.grasp_estimate import GraspPoseEstimate
from factorgrasp.problems.grasp_pose import GraspPose
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings

__all__ = ["GraspNoise", "GraspPose", "GraspPoseEstimate", "GraspPrior", "GraspSettings"]

"""Problems: what is unknown, what is measured, how they are tied. One file a problem; none knows a solver.

Names load when first used, so that one problem does not pay for the others.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from factorgrasp.problems.external_wrenches import ExternalWrenches
    from factorgrasp.problems.external_wrenches_estimate import ExternalWrenchesEstimate
    from factorgrasp.problems.grasp_estimate import GraspPoseEstimate
    from factorgrasp.problems.grasp_from_poses import GraspPoseFromPoses
    from factorgrasp.problems.grasp_from_poses_estimate import GraspFromPosesEstimate
    from factorgrasp.problems.grasp_from_poses_settings import GraspFromPosesNoise, GraspFromPosesSettings
    from factorgrasp.problems.grasp_pose import GraspPose
    from factorgrasp.problems.grasp_segments import GraspSegments
    from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
    from factorgrasp.problems.grasp_track import GraspTrack
    from factorgrasp.problems.human_dynamics import HumanDynamics
    from factorgrasp.problems.human_dynamics_constraints import (
        CentreOfPressure,
        FrictionPyramid,
        TorqueLimit,
        UnilateralContact,
    )
    from factorgrasp.problems.human_dynamics_estimate import HumanDynamicsEstimate
    from factorgrasp.problems.human_dynamics_sensors import (
        Accelerometer,
        ExternalWrench,
        GyroscopeDerivative,
        JointAcceleration,
        JointTorque,
    )
    from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
    from factorgrasp.problems.link_motion import LinkMotion
    from factorgrasp.problems.wrist_estimate import WristPoseEstimate
    from factorgrasp.problems.wrist_pose import WristPose
    from factorgrasp.problems.wrist_settings import WristAssociation, WristNoise, WristSettings
    from factorgrasp.problems.wrist_track import WristTrack

_WHERE = {
    "Accelerometer": "human_dynamics_sensors",
    "CentreOfPressure": "human_dynamics_constraints",
    "ExternalWrench": "human_dynamics_sensors",
    "ExternalWrenches": "external_wrenches",
    "ExternalWrenchesEstimate": "external_wrenches_estimate",
    "FrictionPyramid": "human_dynamics_constraints",
    "GraspFromPosesEstimate": "grasp_from_poses_estimate",
    "GraspFromPosesNoise": "grasp_from_poses_settings",
    "GraspFromPosesSettings": "grasp_from_poses_settings",
    "GraspNoise": "grasp_settings",
    "GraspPose": "grasp_pose",
    "GraspPoseEstimate": "grasp_estimate",
    "GraspPoseFromPoses": "grasp_from_poses",
    "GraspPrior": "grasp_settings",
    "GraspSegments": "grasp_segments",
    "GraspSettings": "grasp_settings",
    "GraspTrack": "grasp_track",
    "GyroscopeDerivative": "human_dynamics_sensors",
    "HumanDynamics": "human_dynamics",
    "HumanDynamicsEstimate": "human_dynamics_estimate",
    "HumanDynamicsNoise": "human_dynamics_settings",
    "JointAcceleration": "human_dynamics_sensors",
    "JointTorque": "human_dynamics_sensors",
    "LinkMotion": "link_motion",
    "TorqueLimit": "human_dynamics_constraints",
    "UnilateralContact": "human_dynamics_constraints",
    "WristAssociation": "wrist_settings",
    "WristNoise": "wrist_settings",
    "WristPose": "wrist_pose",
    "WristPoseEstimate": "wrist_estimate",
    "WristSettings": "wrist_settings",
    "WristTrack": "wrist_track",
}

__all__ = [
    "Accelerometer",
    "CentreOfPressure",
    "ExternalWrench",
    "ExternalWrenches",
    "ExternalWrenchesEstimate",
    "FrictionPyramid",
    "GraspFromPosesEstimate",
    "GraspFromPosesNoise",
    "GraspFromPosesSettings",
    "GraspNoise",
    "GraspPose",
    "GraspPoseEstimate",
    "GraspPoseFromPoses",
    "GraspPrior",
    "GraspSegments",
    "GraspSettings",
    "GraspTrack",
    "GyroscopeDerivative",
    "HumanDynamics",
    "HumanDynamicsEstimate",
    "HumanDynamicsNoise",
    "JointAcceleration",
    "JointTorque",
    "LinkMotion",
    "TorqueLimit",
    "UnilateralContact",
    "WristAssociation",
    "WristNoise",
    "WristPose",
    "WristPoseEstimate",
    "WristSettings",
    "WristTrack",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_WHERE[name]}"), name)

"""Wrist pose from unlabelled blobs (mathematics 5; Cordella 2014)."""

from __future__ import annotations

from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems.wrist_settings import WristAssociation, WristNoise, WristSettings
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.recordings.blobs import BlobRecording


class WristPose:
    """Pose and velocity of the wrist over a recording of blobs.

    Parameters
    ----------
    camera : Camera
    blobs : BlobRecording
    markers : MarkerLayout
    association : WristAssociation, optional
    noise : WristNoise, optional
    settings : WristSettings, optional
    camera_pose : CameraPose, optional
        ``W0`` as the camera sees it; by default the pose of the hand in the first frames (neutral posture).
    """

    kind = "wrist_pose"

    def __init__(
        self,
        camera: Camera,
        blobs: BlobRecording,
        markers: MarkerLayout,
        association: WristAssociation | None = None,
        noise: WristNoise | None = None,
        settings: WristSettings | None = None,
        camera_pose: CameraPose | None = None,
    ) -> None:
        self.camera, self.blobs, self.markers = camera, blobs, markers
        self.association = association or WristAssociation()
        self.noise = noise or WristNoise()
        self.settings = settings or WristSettings()
        self.camera_pose = camera_pose
        blobs.check_camera(camera)

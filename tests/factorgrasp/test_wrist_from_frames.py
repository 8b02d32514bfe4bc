"""From rendered images to the pose of the wrist: detector, palm calibration and estimator together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgrasp import lie, solve
from factorgrasp.palm_calibration import calibrate_palm
from factorgrasp.problems.palm_layout import PalmConvention, palm_frame
from factorgrasp.problems.wrist_pose import WristPose
from factorgrasp.simulation.hand_motion import XTION, swinging_hand
from factorgrasp.simulation.hand_scene import HandScene, Hidden
from factorgrasp.vision import Frame, detect_recording

pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'factorgrasp[vision]'")


def test_wrist_pose_from_rendered_frames() -> None:
    scene = HandScene(hidden=(Hidden(3, 0.5, 8, 13, 0.5), Hidden(1, 1.0, 10, 15, 2.0)))
    video = swinging_hand(18, scene, seed=3)
    frames = [Frame(float(t), frame.rgb, frame.depth) for t, frame in zip(video.t, video, strict=True)]
    blobs = detect_recording(frames, XTION)
    palm = calibrate_palm(blobs, XTION)
    track = solve(WristPose(XTION, blobs, palm.layout)).track
    # The layout's frame is laid into the markers by convention; the truth follows.
    R_w_p, p_w_p = palm_frame(video.layout, PalmConvention(), np.array([0.0, 0.0, 1.0]))
    rotation = video.R_c_w @ R_w_p
    position = video.p_c_w + video.R_c_w @ p_w_p
    turn = lie.so3_log(np.swapaxes(rotation, 1, 2) @ track.camera_rotation)
    assert not track.lost.any()
    assert np.degrees(np.sqrt(np.mean(np.sum(turn**2, axis=1)))) < 0.6
    assert np.sqrt(np.mean(np.sum((track.camera_position - position) ** 2, axis=1))) < 0.8e-3


def test_frames_without_a_hand_are_frames_without_blobs() -> None:
    video = swinging_hand(4, seed=3)
    frames = [Frame(float(t), frame.rgb, frame.depth) for t, frame in zip(video.t, video, strict=True)]
    dark = replace(frames[2], rgb=np.zeros_like(frames[2].rgb))
    blobs = detect_recording([*frames[:2], dark, frames[3]], XTION)
    assert blobs.counts.tolist() == [6, 6, 0, 6]

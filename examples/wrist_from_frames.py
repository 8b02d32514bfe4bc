"""Colour and depth images of a hand with six markers: detect the markers, calibrate the palm, follow the wrist."""

from __future__ import annotations

import numpy as np

from factorgrasp import solve
from factorgrasp.palm_calibration import calibrate_palm
from factorgrasp.problems.wrist_pose import WristPose
from factorgrasp.simulation.hand_files import write_frames
from factorgrasp.simulation.hand_motion import XTION, swinging_hand
from factorgrasp.vision import detect_recording, read_frames

# Stand-in for your own recording: 12 rendered frames, rgb/*.png and depth/*.png (16 bit, mm).
folder = write_frames(swinging_hand(12, seed=1), "frames")

frames = read_frames(images=folder / "rgb", depth=folder / "depth")
blobs = detect_recording(
    frames, XTION
)  # the markers' colour is proposed; learn_colour(rgb, click=...) overrules it
print(f"{blobs.uv.shape[0]} blobs in {len(blobs)} frames")

palm = calibrate_palm(blobs, XTION, side="right")
palm.save("hand.json")
for name, point, sd in zip(palm.layout.names, palm.layout.points, palm.layout.sd, strict=True):
    print(f"{name:>10}  {np.round(1e3 * point, 1)} mm, sd {np.round(1e3 * sd, 2)} mm")

track = solve(WristPose(XTION, blobs, palm.layout)).track
print(f"wrist at {np.round(1e3 * track.camera_position[-1], 1)} mm from the camera in the last frame")

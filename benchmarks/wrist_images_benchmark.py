"""From rendered images to the wrist's pose: detector, palm calibration and batch estimator in a row, against the renderer's truth.

    OMP_NUM_THREADS=1 python benchmarks/wrist_images_benchmark.py [--frames 45] [--seeds 3]

Nothing is given but the camera and the images: the markers' colour is proposed, the layout comes from the first frames. Errors are those
of the pose in the camera frame, the truth expressed in the calibrated layout's convention; NEES is per degree of freedom of the pose. Row
"hidden": one marker after the other is half hidden, and for six frames three of them wholly.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from metrics import Metric, metric_table
from wrist_detection_benchmark import half_hidden

from factorgrasp import lie, solve
from factorgrasp.palm_calibration import calibrate_palm
from factorgrasp.problems.palm_layout import PalmConvention, palm_frame
from factorgrasp.problems.wrist_pose import WristPose
from factorgrasp.simulation.hand_motion import XTION, swinging_hand
from factorgrasp.simulation.hand_scene import HandScene, Hidden
from factorgrasp.vision import Frame, detect_recording

GONE = tuple(Hidden(marker, 1.0, 20, 25, 1.3 * marker) for marker in (1, 3, 5))
ROWS = {
    "nominal": HandScene(),
    "dark skin, lamp 3500 K, light 0.6": HandScene(skin="dark", colour_temperature=3500.0, light=0.6),
    "shutter 15 ms": HandScene(shutter=0.015),
    "hidden": HandScene(hidden=(*half_hidden(0.5), *GONE)),
}


def run(scene: HandScene, frames: int, seed: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Errors (n, 6) [rad, m] in the camera frame, NEES (n,) and the number of lost frames."""
    video = swinging_hand(frames, scene, 50 + seed)
    images = [Frame(float(t), frame.rgb, frame.depth) for t, frame in zip(video.t, video, strict=True)]
    blobs = detect_recording(images, XTION)
    palm = calibrate_palm(blobs, XTION)
    track = solve(WristPose(XTION, blobs, palm.layout)).track
    R_w_p, p_w_p = palm_frame(video.layout, PalmConvention(), np.array([0.0, 0.0, 1.0]))
    turn = lie.so3_log(np.swapaxes(track.camera_rotation, 1, 2) @ (video.R_c_w @ R_w_p))
    shift = video.p_c_w + video.R_c_w @ p_w_p - track.camera_position
    used = ~track.lost
    error = np.concatenate([turn, shift @ track.camera_pose.rotation], axis=1)[used]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.covariance[used]), error) / 6.0
    return error, nees, int(track.lost.sum())


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=45)
    parser.add_argument("--seeds", type=int, default=3)
    chosen = parser.parse_args(arguments)
    print("| images | orientation RMSE deg | position RMSE mm | NEES | frames lost |")
    print("|---|---|---|---|---|")
    metrics = []
    for name, scene in ROWS.items():
        parts = [run(scene, chosen.frames, seed) for seed in range(chosen.seeds)]
        error, nees = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
        degrees = float(np.degrees(np.sqrt(np.mean(np.sum(error[:, :3] ** 2, axis=1)))))
        millimetres = 1e3 * float(np.sqrt(np.mean(np.sum(error[:, 3:] ** 2, axis=1))))
        lost = sum(p[2] for p in parts)
        print(f"| {name} | {degrees:.2f} | {millimetres:.2f} | {nees.mean():.2f} | {lost} |", flush=True)
        metrics.append(Metric(f"{name}/orientation", degrees, "deg", "lower", 1.2))
        metrics.append(Metric(f"{name}/position", millimetres, "mm", "lower", 1.5))
        metrics.append(Metric(f"{name}/lost", lost, "frames", "lower", 0))
    print(metric_table(metrics, "Targets").text())
    return sum(metric.passed is False for metric in metrics)


if __name__ == "__main__":
    sys.exit(main())

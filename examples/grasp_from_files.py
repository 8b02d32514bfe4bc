"""Grasp pose from two files: the shortest way.

Run it with the paths of your recordings, or without any to see it work on simulated ones:

    python examples/grasp_from_files.py robot.csv imu.csv
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from factorgrasp import solve
from factorgrasp.problems import GraspPose
from factorgrasp.recordings import read_imu, read_poses

if len(sys.argv) == 3:
    robot_csv, imu_csv = sys.argv[1:]
else:
    from factorgrasp.demo import write_demo

    folder = Path(tempfile.mkdtemp())
    write_demo(folder)
    robot_csv, imu_csv = str(folder / "robot.csv"), str(folder / "imu.csv")

estimate = solve(GraspPose(robot=read_poses(robot_csv), hand=read_imu(imu_csv)))
print(estimate.summary())

"""How much a trajectory shows of the grasp, and what the wrist feels: measured before anything moves.

The same from the command line: ``factorgrasp solve evaluate.toml``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorgrasp.problem_file import load_problem
from factorgrasp.recordings import PoseStream, write_csv
from factorgrasp.simulation.trajectory import RigidTrajectory, Sinusoids

# Turn the object by 0.1 rad about two axes, about a wrist that is 0.4 m in front of the gripper.
turns = Sinusoids(amplitude=[(0.0, 0.1, 0.0), (0.0, 0.0, 0.1)], frequency=(0.8, 1.1), phase=np.zeros((2, 3)))
motion = RigidTrajectory(turns, Sinusoids((0.9, 0.0, 0.5)), lever=(0.4, 0.0, 0.0)).at(
    np.arange(0.0, 15.0, 5e-3)
)
write_csv("trajectory.csv", PoseStream(motion.t, motion.position, motion.rotation_wxyz))

Path("evaluate.toml").write_text(
    """\
kind = "excitation"
title = "Two tones about the wrist"

[evaluate]
file = "trajectory.csv"      # t,px,py,pz,qw,qx,qy,qz; or joints t,q1,...,qn with [robot] urdf and frame
window = 5.0                 # s, of the excitation condition
translation_sd = 2e-3        # m; what shall be reached, every entry optional

[grasp]
translation = [0.4, 0.0, 0.0]

[human]
force_stiffness = 300.0      # N/m
""",
    encoding="utf-8",
)
result = load_problem("evaluate.toml").solve()
print(result.summary())
print(f"predicted sd of the lever arm after 5 s: {1e3 * result.prediction.worst_sd_over_time[9, 1]:.2g} mm")

"""Task and identification together: the object goes from A to B, and the grasp is known to a target when it arrives."""

from __future__ import annotations

import numpy as np

from factorgrasp import lie
from factorgrasp.excitation_task import plan_excitation
from factorgrasp.problems.excitation import Excitation
from factorgrasp.problems.excitation_human import task_human
from factorgrasp.problems.excitation_settings import ExcitationSettings, GraspBelief

grasp = GraspBelief(np.eye(3), np.array([0.4, 0.1, 0.05]), np.diag([0.1**2] * 3 + [0.05**2] * 3))
start = np.array([0.5, 0.0, 0.4]), np.eye(3)
goal = np.array([0.5, 0.4, 0.5]), lie.so3_exp(np.array([0.0, 0.0, 0.5]))
settings = ExcitationSettings(rotation_sd=0.005, translation_sd=0.002, duration=5.0, bandwidth=1.0)
plan = plan_excitation(Excitation(grasp, task_human(5.0, start, goal), settings))
print(plan.summary())

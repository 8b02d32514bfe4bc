"""A motion in task space that reveals the grasp of a resting wrist: turn about it, twice a window, with the least wrench."""

from __future__ import annotations

import numpy as np

from factorgrasp.excitation_task import plan_excitation
from factorgrasp.problems.excitation import Excitation
from factorgrasp.problems.excitation_human import static_human
from factorgrasp.problems.excitation_settings import ExcitationSettings, GraspBelief

# What is known of the grasp: R_r_h, p_r_h (m), and how well (rad and m, as variances).
grasp = GraspBelief(np.eye(3), np.array([0.4, 0.1, 0.05]), np.diag([0.1**2] * 3 + [0.05**2] * 3))
settings = ExcitationSettings(alpha=10.0, window=3.0, duration=6.0, bandwidth=1.0)
plan = plan_excitation(Excitation(grasp, static_human(6.0, np.zeros(3), np.eye(3)), settings))

print(plan.summary())
plan.save("excitation")

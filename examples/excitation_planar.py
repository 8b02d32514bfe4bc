"""The paper's strategy for planar motion: the wrist travels along an L, and the object turns about the direction of travel."""

from __future__ import annotations

import numpy as np

from factorgrasp.excitation_task import plan_excitation
from factorgrasp.problems.excitation import Excitation
from factorgrasp.problems.excitation_human import planar_human
from factorgrasp.problems.excitation_settings import ExcitationSettings, GraspBelief, HumanWrist

grasp = GraspBelief(np.eye(3), np.array([0.4, 0.1, 0.05]))
corner = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.3, 0.0]])
settings = ExcitationSettings(alpha=2.0, duration=5.0, bandwidth=1.0, basis="bspline", axes="travel")
wrist = HumanWrist(max_rotation=0.8)
plan = plan_excitation(Excitation(grasp, planar_human(5.0, corner, np.eye(3)), settings, wrist))
print(plan.summary())

# Along one line alone, the lever arm along it stays unknown; planning says so.
line = planar_human(5.0, corner[:2], np.eye(3))
print(plan_excitation(Excitation(grasp, line, settings, wrist)).message)

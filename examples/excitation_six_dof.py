"""A human who moves in all six dimensions: where the own motion of the hand excites, the robot has nothing to add."""

from __future__ import annotations

import numpy as np

from factorgrasp import lie
from factorgrasp.excitation_task import plan_excitation
from factorgrasp.problems.excitation import Excitation
from factorgrasp.problems.excitation_human import recorded_human
from factorgrasp.problems.excitation_settings import ExcitationSettings, GraspBelief

# Stand-ins for a recording of the hand: time (s), position (m), R_w_h.
t = np.linspace(0.0, 4.0, 401)
for strength in (0.6, 0.1):
    turn = strength * np.stack([np.sin(4.2 * t), np.sin(6.3 * t), np.cos(5.0 * t) - 1.0], axis=1)
    human = recorded_human(t, np.zeros((t.size, 3)), lie.so3_exp(turn), 4.0)
    grasp = GraspBelief(np.eye(3), np.array([0.4, 0.1, 0.05]))
    plan = plan_excitation(
        Excitation(grasp, human, ExcitationSettings(alpha=10.0, duration=4.0, bandwidth=1.0))
    )
    added = np.degrees(np.max(np.linalg.norm(plan.turn, axis=1)))
    print(
        f"human turns by up to {np.degrees(strength):.0f} deg: the robot adds {added:.2f} deg ({plan.status})"
    )

"""The motion decides what can be known: the same grasp under a motion about one axis and under one whose axis turns."""

from __future__ import annotations

from factorgrasp import solve
from factorgrasp.problems import GraspPose
from factorgrasp.simulation import make_scenario

for motion in ("printed", "exciting"):
    recording = make_scenario("cehajic2015", seed=2, motion=motion, duration=20.0)
    estimate = solve(GraspPose(robot=recording.robot, hand=recording.hand, gravity=recording.gravity))
    print(f"--- {motion} motion: {estimate.status.value}")
    for direction in estimate.observability.directions:
        if direction.variable == "translation":
            mark = "known" if direction.observable else "NOT KNOWN"
            print(f"{mark:>9}  {direction.words}: sd {1e3 * direction.sd:.2g} mm")
    print(estimate.message)

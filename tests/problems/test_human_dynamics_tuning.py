"""Covariances proposed from innovations: a sensor that is mis-tuned by ten, either way, comes back within the stated limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_innovations import propose_covariances
from factorgrasp.problems.human_dynamics_sensors import Accelerometer, ExternalWrench, Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.solvers.frames import solve_frames
from factorgrasp.typing import FloatArray

from .human_dynamics_body import standing

pytest.importorskip("pinocchio")
COUNT = 250
NOISE = HumanDynamicsNoise(1e-6, 1e-6, 1e-8, joint_acceleration=1e-4, link_acceleration=1e-4)
FORCE = np.array([2.0, 2.0, 3.0, 0.4, 0.4, 0.3])
SPECIFIC = 0.2


def recorded() -> tuple[LinkMotion, list[Sensor]]:
    """Two plates and an accelerometer on the trunk with the noise that their covariances say."""
    motion, wrenches = standing(COUNT, seed=11)
    rng = np.random.default_rng(3)
    i = motion.link("trunk")
    felt = motion.proper_acceleration[:, i]
    v = motion.spatial_velocity[:, i]
    specific = felt[:, :3] + np.cross(v[:, 3:], v[:, :3]) + SPECIFIC * rng.standard_normal((COUNT, 3))
    out: list[Sensor] = [
        ExternalWrench(wrenches[foot] + FORCE * rng.standard_normal((COUNT, 6)), FORCE**2, link=foot)
        for foot in ("left_foot", "right_foot")
    ]
    return motion, [*out, Accelerometer(specific, SPECIFIC**2, link="trunk")]


def tuned(
    motion: LinkMotion, sensors: list[Sensor], rounds: int = 8
) -> tuple[list[Sensor], FloatArray, float]:
    """Solve and propose until it settles: sensors, the stated sd of the last proposal, and the last change."""
    sd, change = np.empty(0), np.inf
    for _ in range(rounds):
        problem = HumanDynamics(motion, sensors, NOISE)
        proposals = propose_covariances(problem, solve_frames(problem))
        change = max(
            float(np.nanmax(np.abs(p.proposed / np.asarray(s.covariance) - 1.0)))
            for p, s in zip(proposals, sensors, strict=True)
        )
        sensors = [replace(s, covariance=p.proposed) for p, s in zip(proposals, sensors, strict=True)]
        sd = np.concatenate([p.sd for p in proposals])
    return sensors, sd, change


@pytest.mark.parametrize("factor", [0.01, 0.1, 10.0, 100.0])
def test_mistuned_sensors_come_back(factor: float) -> None:
    """Plates (both) off by that much in their variances: the proposals lie within four of their stated sd of the truth."""
    motion, right = recorded()
    wrong = [
        replace(s, covariance=np.asarray(s.covariance) * factor) if isinstance(s, ExternalWrench) else s
        for s in right
    ]
    before = solve_frames(HumanDynamics(motion, wrong, NOISE))
    ratio = before.innovations[0].ratio
    assert ratio > 1.5 if factor < 1.0 else ratio < 0.7
    found, sd, change = tuned(motion, wrong)
    # Settled: what still changes is small against what the proposal itself is unsure of.
    assert change < 0.3 * float(sd.max())
    truth = np.concatenate([FORCE**2, FORCE**2, np.full(3, SPECIFIC**2)])
    proposed = np.concatenate([np.broadcast_to(np.asarray(s.covariance), (s.size,)) for s in found])
    assert np.all(sd < 0.6)
    assert np.all(np.abs(proposed / truth - 1.0) < 4.0 * sd)
    after = solve_frames(HumanDynamics(motion, found, NOISE))
    for one in after.innovations:
        low, high = one.band(probability=0.999)
        assert low < one.ratio < high


def test_right_covariances_stay() -> None:
    """Nothing to mend: the proposal is what was said, within its sd, and the words have nothing against it."""
    motion, right = recorded()
    problem = HumanDynamics(motion, right, NOISE)
    for proposal in propose_covariances(problem, solve_frames(problem)):
        assert np.all(np.abs(proposal.proposed / proposal.current - 1.0) < 4.0 * proposal.sd)
        assert proposal.words == ""
        assert proposal.samples > 0.5 * COUNT


def test_what_stands_against_a_proposal_is_said() -> None:
    """A constant error, few samples, and a sensor that nothing else checks."""
    motion, right = recorded()
    pushed = replace(right[0], values=right[0].values + 30.0)
    problem = HumanDynamics(motion, [pushed, *right[1:]], NOISE)
    assert "constant error" in propose_covariances(problem, solve_frames(problem))[0].words
    few = problem.at(np.arange(10))
    assert "independent samples" in propose_covariances(few, solve_frames(few))[0].words
    # Both feet unmeasured but for one: the six equations are used up by the other.
    alone = HumanDynamics(motion, right[:1], replace(NOISE, contact_wrench=1e8), contacts=("right_foot",))
    assert "checked by nothing else" in propose_covariances(alone, solve_frames(alone))[0].words

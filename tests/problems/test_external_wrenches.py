"""Wrenches that nobody measures: exact, equal to a general solver, consistent, chained and joint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgrasp import solve
from factorgrasp.baselines.inverse_dynamics import inverse_dynamics
from factorgrasp.errors import InputError
from factorgrasp.problems.external_wrenches import ExternalWrenches
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_sensors import ExternalWrench
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.solvers.frames import solve_frames
from factorgrasp.typing import FloatArray
from factorgrasp.uncertainty import nees_band

from .human_dynamics_body import random_wrenches, standing

pytest.importorskip("pinocchio")
FEET = ("left_foot", "right_foot")
SHARP = HumanDynamicsNoise(free_wrench=1e-6, contact_wrench=(1e5, 1e5, 1e5, 1e3, 1e3, 1e3))


def carrying(
    mass: float, hands: tuple[str, ...], count: int = 30, seed: int = 0
) -> tuple[LinkMotion, dict[str, FloatArray]]:
    """A payload shared by the hands, in random motion."""
    motion, _ = standing(count, seed)
    load = {}
    for hand in hands:
        i = motion.link(hand)
        force = mass / len(hands) * (motion.gravity - motion.acceleration[:, i])
        load[hand] = np.concatenate(
            [(np.swapaxes(motion.R[:, i], 1, 2) @ force[..., None])[..., 0], np.zeros((count, 3))], axis=1
        )
    return standing(count, seed, load)


def feet(wrenches: dict[str, FloatArray], variance: object = 1e-6) -> list[ExternalWrench]:
    """Plates under both feet."""
    return [ExternalWrench(wrenches[foot], variance, link=foot) for foot in FEET]  # type: ignore[arg-type]


@pytest.mark.parametrize("hands", [("left_hand",), ("left_hand", "right_hand")])
def test_five_kilograms_are_recovered(hands: tuple[str, ...]) -> None:
    """Noise-free to 0.01 kg, in one hand and shared by two, while everything accelerates."""
    motion, wrenches = carrying(5.0, hands)
    found = ExternalWrenches(motion, feet(wrenches), hands, SHARP, 1e-6).estimate().payload()
    if len(hands) == 1:
        assert np.abs(found.mass - 5.0).max() < 0.01
    assert found.mean == pytest.approx(5.0, abs=0.01 if len(hands) == 1 else 0.1)


def test_two_hands_at_rest_to_ten_grams() -> None:
    """Where both hands feel the same acceleration the total is exact, whatever the shares."""
    motion, wrenches = carrying(5.0, ("left_hand", "right_hand"))
    still = replace(
        motion,
        acceleration=0.0 * motion.p,
        angular_acceleration=0.0 * motion.p,
        velocity=0.0 * motion.p,
        angular_velocity=0.0 * motion.p,
    )
    load = {
        h: np.concatenate(
            [motion.R[:, motion.link(h)].swapaxes(1, 2) @ (2.5 * motion.gravity), np.zeros((30, 3))], axis=1
        )
        for h in ("left_hand", "right_hand")
    }
    wrenches = {**load, "left_foot": wrenches["left_foot"]}
    root = inverse_dynamics(still, wrenches).root_residual
    sensors = [
        ExternalWrench(wrenches["left_foot"], 1e-6, link="left_foot"),
        ExternalWrench(root, 1e-6, link="pelvis"),
    ]
    found = ExternalWrenches(still, sensors, ("left_hand", "right_hand"), SHARP, 1e-6).estimate().payload()
    assert np.abs(found.mass - 5.0).max() < 0.01


def test_closed_form_equals_a_general_solver() -> None:
    """The rank-six update against the Cholesky solver on the full problem: means and covariances, with a gap in a plate."""
    motion, wrenches = standing(4, carried=random_wrenches(("left_hand", "right_hand"), 4))
    C = np.diag([4.0, 4.0, 9.0, 0.5, 0.5, 0.5]) + 0.1
    sensors = feet(wrenches, C)
    sensors[1].values[2, :4] = np.nan
    world = motion.R[:, motion.link("left_foot")]
    turned = np.concatenate(
        [(world @ wrenches["left_foot"][:, s, None])[..., 0] for s in (slice(0, 3), slice(3, 6))], axis=1
    )
    sensors[0] = ExternalWrench(turned, C, link="left_foot", frame="world")
    problem = ExternalWrenches(
        motion, sensors, ("left_hand", "right_hand"), HumanDynamicsNoise(free_wrench=1e-2)
    )
    found = problem.estimate()
    for f in (1, 2):
        one = solve(problem.frame(f))
        for i, link in enumerate(motion.links):
            assert np.allclose(one.values[f"external wrench on {link}"], found.wrench[f, i], atol=1e-6)
        pair = ("left_hand", "right_foot")
        names = [f"external wrench on {link}" for link in pair]
        assert np.allclose(one.covariance(*names), found.joint_covariance(pair)[f], rtol=1e-6, atol=1e-6)


def test_the_full_momentum_rate_is_needed() -> None:
    """Weight alone would put the body's own acceleration into the hand."""
    motion, wrenches = standing(20, carried=random_wrenches(("left_hand",), 20))
    found = ExternalWrenches(motion, feet(wrenches), ("left_hand",), SHARP, 1e-6).estimate()
    assert np.abs(found.of("left_hand") - wrenches["left_hand"]).max() < 0.01
    still = replace(
        motion,
        acceleration=0.0 * motion.p,
        angular_acceleration=0.0 * motion.p,
        angular_velocity=0.0 * motion.p,
    )
    weight_only = ExternalWrenches(still, feet(wrenches), ("left_hand",), SHARP, 1e-6).estimate()
    assert np.sqrt(np.mean((weight_only.of("left_hand") - wrenches["left_hand"])[:, :3] ** 2)) > 10.0


def test_consistent_with_noise() -> None:
    """NEES of both hands together and NIS of the momentum inside their bands; the payload's sd as well."""
    n, hands = 200, ("left_hand", "right_hand")
    rng = np.random.default_rng(1)
    spread = np.array([30.0, 30.0, 30.0, 3.0, 3.0, 3.0])
    motion, wrenches = standing(n, 5, {hand: spread * rng.standard_normal((n, 6)) for hand in hands})
    foot_sd, rate_sd = np.array([2.0, 2.0, 3.0, 0.5, 0.5, 0.4]), np.array([1.5, 1.5, 1.5, 0.8, 0.8, 0.8])
    noisy = {foot: wrenches[foot] + foot_sd * rng.standard_normal((n, 6)) for foot in FEET}
    noise = HumanDynamicsNoise(free_wrench=1e-8, contact_wrench=spread**2)
    # An error in the rate of momentum is the same as one in what the feet carry, about the centre of mass.
    problem = ExternalWrenches(motion, feet(noisy, foot_sd**2), hands, noise, rate_sd**2)
    shifted = motion.momentum_rate + rate_sd * rng.standard_normal((n, 6))
    motion.__dict__["momentum_rate"] = shifted
    found = problem.estimate()
    error = np.concatenate([found.of(hand) - wrenches[hand] for hand in hands], axis=1)
    nees = (
        np.einsum(
            "ni,ni->n", error, np.linalg.solve(found.joint_covariance(hands), error[..., None])[..., 0]
        ).mean()
        / 12.0
    )
    low, high = nees_band(12, n)
    assert low < nees < high
    low, high = nees_band(6, n)
    assert low < found.nis.mean() / 6.0 < high


def test_what_six_equations_cannot_tell_apart_is_said() -> None:
    """One hand: everything informed. Two hands: squeezing and the sharing of moments are not, the total force is."""
    motion, wrenches = standing(5)
    one = ExternalWrenches(motion, feet(wrenches), ("left_hand",), SHARP).estimate().observability()
    assert one.complete
    two = ExternalWrenches(motion, feet(wrenches), ("left_hand", "right_hand"), SHARP).estimate()
    found = two.observability()
    missing = [d.words for d in found.missing]
    assert any("squeeze between left_hand and right_hand" in words for words in missing)
    assert not any(words.startswith("total force") for words in missing)
    assert "wrench sensor" in found.advice
    assert "not informed" in two.summary()


def test_chained_and_joint_estimates() -> None:
    """Both find the torques; the joint one is a little less sure of itself, because it uses the accelerations once."""
    motion, wrenches = carrying(5.0, ("left_hand",))
    truth = inverse_dynamics(motion, wrenches)
    noise = replace(SHARP, propagation=1e-4, balance=1e-4, link_acceleration=1e-2, joint_acceleration=1e-2)
    sensors = feet(wrenches, 1.0)
    first = ExternalWrenches(motion, sensors, ("left_hand",), noise).estimate()
    chained = solve_frames(HumanDynamics(motion, [first.as_sensor()], noise))
    joint = solve_frames(HumanDynamics(motion, sensors, noise, contacts=("left_hand",)))
    for estimate in (chained, joint):
        assert np.sqrt(np.mean((estimate.torque - truth.torque) ** 2)) < 0.2
    assert np.median(chained.torque_sd) < np.median(joint.torque_sd)
    assert np.allclose(chained.torque, joint.torque, atol=1.0)


def test_a_wrong_mass_is_said() -> None:
    """A model that is 3 kg too heavy: the words say so."""
    motion, wrenches = standing(40)
    mass = motion.mass.copy()
    mass[motion.link("trunk")] += 3.0
    heavy = replace(motion, mass=mass)
    words = ExternalWrenches(heavy, feet(wrenches), ("left_hand",)).estimate().mass_words()
    assert "lighter" in words


def test_bad_input_is_named() -> None:
    """What is wrong and what was expected."""
    motion, wrenches = standing(3)
    for contacts, words in (
        ((), "at least one"),
        (("tail",), "links among"),
        (("left_foot",), "without a wrench sensor"),
    ):
        with pytest.raises(InputError, match=words):
            ExternalWrenches(motion, feet(wrenches), contacts)
    with pytest.raises(InputError, match="payload"):
        ExternalWrenches(motion, feet(wrenches), ("left_hand",)).estimate().payload(("right_hand",))

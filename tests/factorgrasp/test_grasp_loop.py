"""The closed loop: impedance and wrist by closed forms, the arm, and the estimator that moves it."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.errors import InfeasibleError, InputError
from factorgrasp.models.arm import Arm, panda_arm, panda_urdf, seven_axis_arm
from factorgrasp.models.wrist import WristStiffness
from factorgrasp.online.receding_excitation import RecedingExcitation, RecedingSettings, cone, two_tones
from factorgrasp.pose_reference import Blend, about_point, times
from factorgrasp.problems.grasp_settings import GraspPrior
from factorgrasp.simulation import make_scenario
from factorgrasp.simulation.cehajic2015_loop import cehajic2015_loop
from factorgrasp.simulation.grasp_loop import run_grasp_loop
from factorgrasp.simulation.grasp_plants import ArmPlant, ExactPlant
from factorgrasp.simulation.grasp_policies import PosePolicy
from factorgrasp.simulation.grasp_truth import GraspTruth
from factorgrasp.simulation.human_wrist import about_travel, human_motion
from factorgrasp.simulation.impedance import CompliantPose, Impedance
from factorgrasp.simulation.trajectory import Sinusoids
from factorgrasp.typing import FloatArray

LEVER = np.array([1.11, 0.16, 0.08])


def truth(lever: FloatArray = LEVER) -> GraspTruth:
    return GraspTruth(np.eye(3), lever, np.zeros(3), np.zeros(3), 0.0, np.zeros(3))


def still(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    zero = np.zeros((n, 3))
    return zero, zero, zero


def test_reference_and_its_derivatives() -> None:
    t = np.arange(0.0, 2.0, 1e-4)
    rise = Blend(np.zeros(1))
    rise.go(0.3, np.array([0.4]), 1.0)
    lever = Blend(np.array([0.5, 0.0, 0.0]))
    lever.go(0.5, LEVER, 1.2)
    phi = times(rise.at(t), two_tones().derivatives(t))
    travel = human_motion("planar").at(t)[0]
    R0 = lie.so3_exp(np.array([0.3, -0.2, 0.5]))
    ref = about_point(np.array([0.4, 0.1, 0.3]), R0, phi, lever.at(t), travel)
    h = t[1] - t[0]
    inner = slice(2, -2)
    for value, rate in (
        (ref.position, ref.velocity),
        (ref.velocity, ref.acceleration),
        (ref.angular_velocity, ref.angular_acceleration),
    ):
        np.testing.assert_allclose(np.gradient(value, h, axis=0)[inner], rate[inner], atol=2e-3)
    turn = lie.so3_log(ref.rotation[1:] @ np.swapaxes(ref.rotation[:-1], 1, 2)) / h
    middle = 0.5 * (ref.angular_velocity[1:] + ref.angular_velocity[:-1])
    np.testing.assert_allclose(turn, middle, atol=1e-4)
    # The believed wrist stays where it is believed to be, but for its travel.
    wrist = ref.position + np.einsum("nij,nj->ni", ref.rotation, lever.at(t)[0])
    expected = np.array([0.4, 0.1, 0.3]) + lever.at(t)[0] @ R0.T + travel[0]
    np.testing.assert_allclose(wrist, expected, atol=1e-12)


def test_impedance_yields_as_its_springs_say() -> None:
    law = Impedance()
    compliant = CompliantPose(law, np.zeros(3), np.eye(3), 1e-3)
    n = 6000
    ref = about_point(np.zeros(3), np.eye(3), still(n), still(n), still(n))
    wrench = np.array([6.0, 0.0, -3.0, 0.0, 2.0, 0.0])
    for k in range(n):
        compliant.advance(ref, k, wrench)
    np.testing.assert_allclose(compliant.position, wrench[:3] / law.stiffness, rtol=1e-3)
    np.testing.assert_allclose(lie.so3_log(compliant.rotation), [0.0, 2.0 / 50.0, 0.0], atol=1e-5)


def test_impedance_without_wrench_tracks() -> None:
    t = np.arange(1, 4001) * 1e-3
    rise = Blend(np.zeros(1))
    rise.go(0.0, np.array([0.1]), 1.0)
    ref = about_point(
        np.zeros(3),
        np.eye(3),
        times(rise.at(t), two_tones().derivatives(t)),
        (np.tile(LEVER, (t.size, 1)), *still(t.size)[1:]),
        still(t.size),
    )
    compliant = CompliantPose(Impedance(), np.zeros(3), np.eye(3), 1e-3)
    worst = 0.0
    for k in range(t.size):
        compliant.advance(ref, k, np.zeros(6))
        worst = max(worst, float(np.linalg.norm(compliant.position - ref.position[k])))
    assert worst < 2e-3


class _Shifted(PosePolicy):
    """A reference that is displaced by a constant."""

    def __init__(self, shift: FloatArray) -> None:
        super().__init__(shift, np.eye(3), Sinusoids(), np.zeros(3))


@pytest.mark.parametrize("stiffness", [150.0, 300.0, 900.0])
def test_steady_force_is_that_of_springs_in_series(stiffness: float) -> None:
    shift = np.array([0.02, -0.01, 0.0])
    result = run_grasp_loop(
        ExactPlant(np.zeros(3), np.eye(3), 1e-3),
        _Shifted(shift),
        truth(np.zeros(3)),
        duration=6.0,
        estimator=None,
        wrist=WristStiffness(stiffness, 5.0),
    )
    series = stiffness * 300.0 / (stiffness + 300.0)
    # What the object exerts on the wrist points where the reference pulls.
    np.testing.assert_allclose(result.wrench[-1, :3], series * shift, rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize("make", [seven_axis_arm, panda_arm])
def test_arm_feels_the_same_springs(make: object) -> None:
    if make is panda_arm and panda_urdf() is None:
        pytest.skip("example-robot-data is not installed")
    arm: Arm = make()  # type: ignore[operator]
    plant = ArmPlant(arm, arm.start, 1e-3)
    shift = np.array([0.01, 0.0, -0.01])
    start, turned = plant.position.copy(), plant.rotation.copy()
    policy = PosePolicy(start + shift, turned, Sinusoids(), np.zeros(3))
    result = run_grasp_loop(plant, policy, truth(np.zeros(3)), duration=4.0, estimator=None)
    np.testing.assert_allclose(result.wrench[-1, :3], 150.0 * shift, rtol=0.02, atol=0.01)
    assert result.saturated == 0
    assert result.joints is not None
    assert np.all(result.joints <= np.array(arm.model.upperPositionLimit) + 1e-9)


def test_arm_without_pink_tracks_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    plants = importlib.import_module("factorgrasp.simulation.grasp_plants")

    def missing(*args: object) -> None:
        raise ImportError("pink")

    monkeypatch.setattr(plants, "_Pink", missing)
    arm = seven_axis_arm()
    plant = ArmPlant(arm, arm.start, 1e-3)
    motion = Sinusoids((0, 0, 0), [(0.02, 0.03, 0.0)], [0.5], np.zeros((1, 3)))
    policy = PosePolicy(plant.position.copy(), plant.rotation.copy(), motion, LEVER, ramp=1.0)
    result = run_grasp_loop(
        plant, policy, truth(), duration=2.0, estimator=None, wrist=WristStiffness(0.0, 0.0)
    )
    assert np.max(np.linalg.norm(result.position - result.wanted_position, axis=1)) < 2e-3


def test_sensors_agree_with_the_motion() -> None:
    """The IMU of the arm's simulation reads what differentiated poses say."""
    arm = seven_axis_arm()
    plant = ArmPlant(arm, arm.start, 1e-3)
    motion = Sinusoids((0, 0, 0), [(0.03, 0.0, 0.02)], [0.8], np.zeros((1, 3)))
    policy = PosePolicy(plant.position.copy(), plant.rotation.copy(), motion, LEVER, ramp=1.0)
    result = run_grasp_loop(plant, policy, truth(), duration=2.0, estimator=None)
    R = lie.quaternion_wxyz_to_matrix(result.rotation_wxyz)
    turn = lie.so3_log(np.swapaxes(R[:-2], 1, 2) @ R[2:]) / 2e-3
    np.testing.assert_allclose(turn, result.hand.angular_velocity[1:-1], atol=2e-3)
    acceleration = np.diff(result.hand_position, 2, axis=0) * 1e6
    pulled = np.einsum("nij,nj->ni", R[1:-1], result.hand.specific_force[1:-1])
    np.testing.assert_allclose(acceleration, pulled + np.array([0.0, 0.0, -9.80665]), atol=0.02)


def test_unreachable_pose_is_said() -> None:
    with pytest.raises(InfeasibleError, match=r"cannot reach the pose: .* mm"):
        seven_axis_arm().reach(np.eye(3), np.array([3.0, 0.0, 0.0]))


def test_receding_plan_finds_the_grasp_and_spares_the_wrist() -> None:
    result = cehajic2015_loop(1, duration=9.0, arm=False)
    assert result.translation_error[-1] < 5e-3
    assert np.degrees(result.rotation_error[-1]) < 0.2
    assert result.felt().peak_force < 3.0
    # Later than half of the run the wrist feels next to nothing of the lever arm's error.
    assert result.felt(7.0).rms_force < 0.4
    # Errors are as large as they are said to be.
    assert result.translation_error[-1] < 4.0 * result.translation_sd[-1]
    assert result.rotation_error[-1] < 4.0 * result.rotation_sd[-1]


def test_velocity_law_keeps_what_the_wrong_estimate_did() -> None:
    ours = cehajic2015_loop(1, duration=8.0, arm=False)
    theirs = cehajic2015_loop(1, duration=8.0, arm=False, policy="velocity_online")
    paper = cehajic2015_loop(1, duration=8.0, arm=False, policy="velocity")
    assert theirs.translation_error[-1] < 5e-3
    # With as good an estimate, the way that was gone before it came is kept for good.
    assert theirs.felt(6.0).rms_force > 2.0 * ours.felt(6.0).rms_force
    assert paper.felt().peak_force > 20.0 * ours.felt().peak_force


def test_amplitude_follows_the_covariance() -> None:
    settings = RecedingSettings(force=2.0, stiffness=100.0, angle=0.1)
    plan = RecedingExcitation(
        np.zeros(3),
        np.eye(3),
        GraspPrior(translation=np.array([0.5, 0, 0]), translation_sd=0.5),
        None,
        settings,
    )
    first = plan.update(0.0, None)
    assert first is not None
    # 2 N / (100 N/m * 2 sd of 0.5 m).
    assert first.angle == pytest.approx(0.02)
    assert plan.update(0.2, None) is None
    t = np.arange(0.0, 0.5, 1e-3)
    reference = plan.reference(t)
    np.testing.assert_allclose(reference.velocity[0], 0.0, atol=1e-12)
    wrist = reference.position + reference.rotation @ np.array([0.5, 0.0, 0.0])
    np.testing.assert_allclose(wrist, np.tile([0.5, 0.0, 0.0], (t.size, 1)), atol=1e-12)


def test_patterns_have_unit_angle() -> None:
    t = np.arange(0.0, 20.0, 1e-2)
    np.testing.assert_allclose(np.linalg.norm(cone().derivatives(t)[0], axis=1), 1.0)
    for pattern, largest in ((two_tones(), np.sqrt(2.0)), (about_travel(), 1.0)):
        size = np.linalg.norm(pattern.derivatives(t)[0], axis=1)
        assert 0.95 * largest < size.max() <= largest + 1e-9
    # About the direction of travel, at every instant.
    way = human_motion("planar").travel.derivatives(t)[1]
    turn = about_travel().derivatives(t)[0]
    np.testing.assert_allclose(np.cross(way, turn), 0.0, atol=1e-12)


def test_same_seed_same_noise_whatever_the_length() -> None:
    short = cehajic2015_loop(4, duration=0.5, arm=False)
    long = make_scenario("cehajic2015_loop", 4, duration=1.0, arm=False)
    np.testing.assert_array_equal(short.hand.specific_force, long.hand.specific_force[:500])


def test_bad_arguments() -> None:
    with pytest.raises(InputError, match="policy: expected one of receding"):
        cehajic2015_loop(0, policy="none")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="above zero"):
        Impedance(mass=-1.0)
    with pytest.raises(InputError, match="above zero"):
        RecedingSettings(force=0.0)
    with pytest.raises(InputError, match="force_stiffness"):
        WristStiffness(-3.0)

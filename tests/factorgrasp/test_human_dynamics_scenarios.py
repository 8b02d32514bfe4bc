from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from factorgrasp import plots
from factorgrasp.errors import InputError
from factorgrasp.human_dynamics_task import HumanDynamicsTask
from factorgrasp.models.human import human_body
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.simulation import human_dynamics_figures as figures
from factorgrasp.simulation.human_dynamics import (
    FEET,
    HANDS,
    HumanNoise,
    HumanRecording,
    human_bowing,
    human_carrying,
    human_tpose,
)
from factorgrasp.simulation.human_motion import ease
from factorgrasp.simulation.scenarios import make_scenario

SILENT = HumanNoise(1e-9, 1e-9, 0.0, 0.0, 0.0, 1e-9, 1e-9, 1e-9)
SURE = HumanDynamicsNoise(
    propagation=1e-6,
    balance=1e-6,
    free_wrench=1e-8,
    contact_wrench=(1e4, 1e4, 1e4, 1e-4, 1e-4, 1e-4),
    joint_acceleration=1e-6,
    link_acceleration=1e-6,
)


@pytest.fixture(scope="module")
def walking() -> HumanRecording:
    return human_carrying(motion="walking", noise=SILENT)


def test_trajectory_is_its_own_derivative(walking: HumanRecording) -> None:
    model, path = walking.truth.model, walking.truth.trajectory
    h = path.t[1] - path.t[0]
    for k in range(2, len(path.t) - 2, 37):
        step = (pin.difference(model, path.q[k - 1], path.q[k + 1])) / (2.0 * h)
        np.testing.assert_allclose(step, path.v[k], atol=0.05 * np.abs(path.v[k]).max() + 2e-3)
    central = (path.v[2:] - path.v[:-2]) / (2.0 * h)
    away = np.abs(central[:, 6:] - path.a[1:-1, 6:]).max()
    assert away < 0.05 * np.abs(path.a[:, 6:]).max()


def test_feet_stand_still_while_they_carry(walking: HumanRecording) -> None:
    motion = walking.truth.motion
    for link in FEET:
        f = walking.truth.external_wrench[link]
        standing = np.linalg.norm(f[:, :3], axis=1) > 50.0
        speed = np.linalg.norm(motion.velocity[:, motion.link(link)], axis=1)
        assert np.percentile(speed[standing], 95) < 0.02
        assert standing.any()
        assert (~standing).any()
        # Where it stands, its centre of pressure is in the sole, or within 3 cm of it.
        plate = walking.plates[link]
        local = plate.point[standing] - motion.p[standing, motion.link(link)]
        sole = np.vstack([walking.body.sole[link], walking.body.sole[link.replace("Foot", "Toe")]])
        reach = sole[:, 0].max() + walking.body.placements[f"j{link.replace('Foot', 'BallFoot')}"][0]
        assert local[:, 0].min() > sole[:, 0].min() - 0.03
        assert local[:, 0].max() < reach
        assert np.abs(local[:, 1]).max() < sole[:, 1].max() + 0.03


def test_external_wrenches_are_the_rate_of_momentum(walking: HumanRecording) -> None:
    motion, total = walking.truth.motion, np.zeros((len(walking.t), 3))
    for link, wrench in walking.truth.external_wrench.items():
        total += (motion.R[:, motion.link(link)] @ wrench[:, :3, None])[..., 0]
    np.testing.assert_allclose(total, motion.momentum_rate[:, :3], atol=1e-8)


@pytest.mark.parametrize("payload", [0.0, 5.0])
def test_silent_recordings_give_the_true_torques_and_mass(payload: float) -> None:
    recording = human_tpose(payload=payload, noise=SILENT)
    assert _exact(recording, ("RightHand",) if payload else ()) < 1e-3


def test_two_hands_and_walking(walking: HumanRecording) -> None:
    # Two hands share the load by the prior: the sum is exact, each arm within what the share leaves open.
    assert _exact(walking, HANDS) < 0.05


def _exact(recording: HumanRecording, hands: tuple[str, ...]) -> float:
    """Largest torque error (Nm); checks the payload, too."""
    motion = recording.exact_motion
    every = slice(None, None, 10)
    sensors = [
        type(s)(s.values[every], 1e-6, s.name, link=s.link, frame="world")
        for s in recording.foot_sensors(motion)
    ]
    points = {link: recording.body.segments[link].com for link in hands}
    part = motion.select(every)
    result = HumanDynamicsTask(
        part, sensors, noise=SURE, contacts=hands, points=points, payload=hands
    ).solve()
    if hands:
        assert result.payload is not None
        np.testing.assert_allclose(result.payload.mass, recording.truth.payload, atol=0.01)
    truth = recording.truth.of(result.frames.dof_names)[every]
    return float(np.abs(result.frames.torque - truth).max())


def test_noisy_payload_within_a_tenth_of_a_kilogram() -> None:
    # Consistency of single frames: tests/problems/test_human_dynamics_state.py.
    for seed in range(2):
        recording = human_tpose(seed, payload=5.0)
        result, keep = figures.solve_recording(recording, contacts=("RightHand",), payload=("RightHand",))
        assert result.payload is not None
        during = recording.during("T-pose")[keep]
        assert abs(np.nanmean(result.payload.mass[during]) - 5.0) < 0.1
        assert result.payload.mean == pytest.approx(5.0, abs=0.05)


def test_robustness_figure_orders_the_methods() -> None:
    shown = figures.robustness()
    for row in shown.rows:
        _, deterministic, trusted, distrusted = map(float, row[1:])
        assert distrusted < trusted < deterministic
    assert shown.figure is not None


def test_variances_fall_with_sensors_and_hips_more_than_ankles() -> None:
    rows = figures.sensor_sets(subjects=1).rows
    values = np.array([[float(cell) for cell in row[1:5]] for row in rows])
    assert (np.diff(values, axis=0) < 0.0).all()
    fall = values[0] / values[2]
    assert fall[2:].min() > 1.3 * fall[:2].max()


def test_tpose_efforts_with_a_load_need_the_hand() -> None:
    rows = figures.tpose_efforts().rows
    for row in rows:
        ideal, true, found, blind = map(float, row[2:])
        assert true == pytest.approx(ideal, rel=0.02)
        assert found == pytest.approx(true, rel=0.05)
        if row[0] == "5 kg":
            assert blind < 0.5 * true


def test_feet_are_followed_as_far_as_they_are_trusted() -> None:
    force = [float(row[1]) for row in figures.feet_covariances().rows]
    assert force[0] < 1e-2
    assert (np.diff(force) > 0.0).all()


def test_hand_covariances_as_in_the_paper() -> None:
    shown = figures.hand_covariances()
    paper, joint, payload = (np.array([float(row[k]) for row in shown.rows]) for k in (1, 2, 3))
    # Below the covariance of the momentum's rate nothing is found, above it all of it.
    assert paper[0] < 1.0
    assert np.abs(paper[2:] - 5.0).max() < 0.3
    # The plain estimate grows with its prior; with the prior taken out nothing depends on it.
    assert (np.diff(joint) >= 0.0).all()
    assert joint[0] < 0.1
    assert np.ptp(payload) < 0.02


def test_page_is_renewed_in_its_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def small() -> figures.Shown:
        return figures.Shown(("variance", "kg"), (("1e-04", "0.5"),), plots.figure(2.0, 1.0)[0])

    monkeypatch.setitem(figures.FIGURES, "hand_covariances", small)
    page = tmp_path / figures.PAGE
    page.write_text("before\n<!-- hand_covariances -->\nold\n<!-- end -->\nafter\n", encoding="utf-8")
    written = figures.write_page(tmp_path, ["hand_covariances"])
    text = page.read_text(encoding="utf-8")
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert "| 1e-04 |" in text
    assert {path.suffix for path in written} == {".png", ".md"}
    with pytest.raises(InputError, match="one of robustness"):
        figures.write_page(tmp_path, ["nothing"])
    with pytest.raises(InputError, match="a place for robustness"):
        figures.write_page(tmp_path, ["robustness"])


def test_strapped_mass_is_not_in_the_estimators_body() -> None:
    with_mass, without = human_bowing(torso_mass=6.0, repetitions=1), human_bowing(repetitions=1)
    np.testing.assert_array_equal(with_mass.truth.trajectory.q, without.truth.trajectory.q)
    assert with_mass.truth.motion.total_mass == pytest.approx(without.truth.motion.total_mass + 6.0)
    assert with_mass.body.mass == without.body.mass


def test_scenarios_have_names_and_seeds() -> None:
    one, same, other = (make_scenario("human_tpose", seed=seed, payload=5.0) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.plates["LeftFoot"].force, same.plates["LeftFoot"].force)
    assert np.abs(one.plates["LeftFoot"].force - other.plates["LeftFoot"].force).max() > 1.0
    with pytest.raises(InputError, match="'standing', 'one_foot' or 'walking'"):
        human_carrying(motion="running")  # type: ignore[arg-type]


def test_ease_stops_at_every_key() -> None:
    t = np.linspace(-1.0, 4.0, 5001)
    x = ease(t, np.array([0.0, 1.0, 3.0]), np.array([0.0, 1.0, -1.0]))
    assert x[0] == 0.0
    assert x[-1] == -1.0
    at = np.searchsorted(t, 1.0)
    assert x[at] == pytest.approx(1.0, abs=1e-6)
    assert abs(np.gradient(x, t)[at]) < 1e-2


def test_plan_that_legs_cannot_follow_is_refused() -> None:
    from factorgrasp.simulation.human_motion import Plan, realise, standing_ankles

    body = human_body(1.75, 75.5)
    t = np.arange(30) / 50.0
    ankles = {side: np.tile(p, (30, 1)) for side, p in standing_ankles(body).items()}
    plan = Plan(t, np.zeros((30, 2)), np.full(30, 1.2), np.zeros(30), ankles, {})
    with pytest.raises(InputError, match="plan of the right leg"):
        realise(body, body.model(), plan, t)

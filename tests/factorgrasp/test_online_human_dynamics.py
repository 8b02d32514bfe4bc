"""Streaming human dynamics: the same as all frames at once, gaps, flat memory, bounded work."""

from __future__ import annotations

import importlib.util
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.online.human_dynamics import OnlineHumanDynamics
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_sensors import Accelerometer, ExternalWrench, Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.solvers.frames import solve_frames
from factorgrasp.status import Status

pytest.importorskip("pinocchio")
NOISE = HumanDynamicsNoise()
CONTACTS = ("left_hand",)


def _body() -> Any:
    path = Path(__file__).parents[1] / "problems" / "human_dynamics_body.py"
    spec = importlib.util.spec_from_file_location("human_dynamics_body", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["human_dynamics_body"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def stream() -> tuple[PinocchioTree, Any, list[Sensor]]:
    """A tree, its states, and three sensors with gaps."""
    made = _body()
    model = made.body()
    states = made.random_states(model, 20)
    rng = np.random.default_rng(0)
    C = np.diag(np.full(6, 2.0)) + 0.3
    sensors: list[Sensor] = [
        ExternalWrench(rng.standard_normal((20, 6)), C, link="left_foot"),
        ExternalWrench(rng.standard_normal((20, 6)), 0.5, link="right_foot"),
        Accelerometer(rng.standard_normal((20, 3)), 0.1, link="trunk", p_l_s=np.array([0.1, 0.0, 0.2])),
    ]
    sensors[0].values[3, 2:4] = np.nan
    sensors[2].values[5] = np.nan
    return PinocchioTree(model), states, sensors


def test_frame_by_frame_equals_all_at_once(stream: tuple[PinocchioTree, Any, list[Sensor]]) -> None:
    """Means, sd and covariances; a sensor that is not named counts as a gap."""
    tree, (q, v, a), sensors = stream
    batch = solve_frames(HumanDynamics(tree.motion(np.arange(20.0), q, v, a), sensors, NOISE, CONTACTS))
    online = OnlineHumanDynamics(tree, sensors, NOISE, CONTACTS)
    for f in range(20):
        values = {s.name: s.values[f] for s in sensors if not np.isnan(s.values[f]).all()}
        got = online.step(float(f), q[f], v[f], a[f], values)
        assert got.status is Status.SOLVED
        assert got.latency > 0.0
        assert np.allclose(got.torque, batch.torque[f], atol=1e-7)
        assert np.allclose(got.torque_sd, batch.torque_sd[f], rtol=1e-6)
        assert np.allclose(got.external_wrench, batch.external_wrench[f], atol=1e-6)
        assert np.allclose(
            got.external_wrench_covariance, batch.external_wrench_covariance[f], rtol=1e-5, atol=1e-8
        )
        flat = online.step(float(f), q[f], v[f], a[f], np.concatenate([s.values[f] for s in sensors]))
        assert np.array_equal(flat.torque, got.torque)
    assert online.frames == 40
    assert online.worst_latency > 0.0


def test_links_from_elsewhere(stream: tuple[PinocchioTree, Any, list[Sensor]]) -> None:
    """Kinematics of one frame, whatever they come from."""
    tree, (q, v, a), sensors = stream
    online = OnlineHumanDynamics(tree, sensors, NOISE, CONTACTS, covariance=False)
    values = {s.name: s.values[7] for s in sensors}
    motion = tree.motion(np.arange(20.0), q, v, a)
    one = online.step_links(7.0, motion.kinematics(slice(7, 8)), values)
    assert np.allclose(one.torque, online.step(7.0, q[7], v[7], a[7], values).torque, atol=1e-9)
    assert one.torque_sd.size == 0
    with pytest.raises(InputError, match="one frame"):
        online.step_links(7.0, motion.kinematics(), values)


def test_memory_is_flat(stream: tuple[PinocchioTree, Any, list[Sensor]]) -> None:
    """A thousand more frames leave no more behind than a few kilobytes."""
    tree, (q, v, a), sensors = stream
    online = OnlineHumanDynamics(tree, sensors, NOISE, CONTACTS)
    values = {s.name: s.values[0] for s in sensors}
    for _ in range(20):
        online.step(0.0, q[0], v[0], a[0], values)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for f in range(1000):
        online.step(float(f), q[f % 20], v[f % 20], a[f % 20], values)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 100_000


def test_a_broken_frame_does_not_break_the_stream(stream: tuple[PinocchioTree, Any, list[Sensor]]) -> None:
    """NaN in the motion: no estimate and a reason; the next frame is as good as ever."""
    tree, (q, v, a), sensors = stream
    online = OnlineHumanDynamics(tree, sensors, NOISE, CONTACTS)
    values = {s.name: s.values[0] for s in sensors}
    whole = online.step(0.0, q[0], v[0], a[0], values)
    broken = online.step(1.0, q[0], v[0] * np.nan, a[0], values)
    assert broken.status is Status.NUMERICAL_ERROR
    assert "motion of this frame" in broken.message
    assert np.isnan(broken.torque).all()
    assert np.array_equal(online.step(2.0, q[0], v[0], a[0], values).torque, whole.torque)


def test_bad_values_are_named(stream: tuple[PinocchioTree, Any, list[Sensor]]) -> None:
    """A name that no sensor has, or another size."""
    tree, (q, v, a), sensors = stream
    online = OnlineHumanDynamics(tree, sensors, NOISE, CONTACTS)
    with pytest.raises(InputError, match="values"):
        online.step(0.0, q[0], v[0], a[0], {"plate": np.zeros(6)})
    with pytest.raises(InputError, match="external wrench of left_foot"):
        online.step(0.0, q[0], v[0], a[0], {"external wrench of left_foot": np.zeros(5)})
    with pytest.raises(InputError, match="values"):
        online.step(0.0, q[0], v[0], a[0], np.zeros(4))
    with pytest.raises(InputError, match="does not change"):
        OnlineHumanDynamics(tree, [ExternalWrench(np.zeros((20, 6)), np.ones((20, 6)), link="left_foot")])

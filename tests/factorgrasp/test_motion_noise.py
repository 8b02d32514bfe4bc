"""Noise of recorded angles and poses through resampling and differentiation, against Monte-Carlo."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from factorgrasp.human_dynamics_motion import read_body_motion
from factorgrasp.models.human import human_body
from factorgrasp.models.joint_motion import differentiate_configurations
from factorgrasp.signals import savgol_derivatives, savgol_noise_gain, synchronise
from factorgrasp.typing import FloatArray


@pytest.mark.parametrize("deriv", [0, 1, 2])
def test_savgol_noise_by_monte_carlo(deriv: int, rng: np.random.Generator) -> None:
    """The variance of a derivative, and how neighbouring samples of it go together, over 4000 recordings."""
    window, order, dt = 31, 4, 0.01
    out = savgol_derivatives(0.3 * rng.normal(size=(window + 4, 4000)), dt, window, order, deriv)
    inside = out[window // 2 : -(window // 2)]
    assert inside.shape[0] == 5
    assert np.var(inside) / (0.09 * savgol_noise_gain(window, order, deriv, dt)) == pytest.approx(
        1.0, abs=0.05
    )
    # Nothing of it is made up where the window is not whole.
    assert np.isnan(out[: window // 2]).all()


def test_accelerations_of_a_body_by_monte_carlo(rng: np.random.Generator) -> None:
    """Variances that `differentiate_configurations` states, for hinges, and for place and turn of the root."""
    model = human_body(1.75, 75.0).model()
    sd = np.full(model.nv, 1e-3)
    sd[:3] = 3e-4
    neutral = np.asarray(pin.neutral(model))
    errors: list[FloatArray] = []
    for _ in range(6):
        step = sd * rng.normal(size=(200, model.nv))
        q = np.array([pin.integrate(model, neutral, d) for d in step])
        found = differentiate_configurations(model, q, 0.01, 6.0)
        errors.append(found.qdd[found.good])
    share = np.mean(np.concatenate(errors) ** 2, axis=0) / (sd**2 * found.acceleration_gain)
    assert np.mean(share[6:]) == pytest.approx(1.0, abs=0.05)
    assert np.mean(share[:3]) == pytest.approx(1.0, abs=0.25)
    assert np.mean(share[3:6]) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("rate", [60.0, 100.0, 200.0])
def test_noise_of_another_rate(tmp_path: Path, rng: np.random.Generator, rate: float) -> None:
    """Angles at 60 to 200 Hz on a clock of 100 Hz: the stated variance of accelerations is the one they have."""
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="a"/><link name="b"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"'
        ' iyz="0"/></inertial></link><joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>',
        encoding="utf-8",
    )
    t = np.arange(0.0, 60.0, 1.0 / rate)
    sd = 2e-3
    rows = np.column_stack([t, sd * rng.normal(size=t.size)])
    np.savetxt(tmp_path / "q.csv", rows, "%.9g", ",", header="t,j", comments="")
    table: Mapping[str, Any] = {
        "model": {"urdf": "arm.urdf", "base": "fixed"},
        "motion": {"file": "q.csv", "rate": 100.0, "bandwidth": 6.0, "angle_sd": sd},
    }
    body = read_body_motion(table, tmp_path)
    stated = body.variances["joint_acceleration"]
    assert isinstance(stated, float)
    assert np.var(body.motion.qdd) / stated == pytest.approx(1.0, abs=0.25)


def test_gaps_of_every_source_stay_where_they_are(rng: np.random.Generator) -> None:
    """Sources of 37, 100 and 1000 Hz on one clock: NaN exactly where a source is silent, and nowhere else."""
    clock = np.arange(0.0, 4.0, 0.01)
    sources = {}
    for rate in (37.0, 100.0, 1000.0):
        t = np.arange(0.0, 4.2, 1.0 / rate)
        x = np.column_stack([np.sin(t), np.cos(t)])
        x[(t > 1.5) & (t < 2.5), 1] = np.nan
        sources[f"{rate:.0f}"] = (t, x)
    found = synchronise(clock, sources)
    for name, values in found.items():
        step = 1.0 / float(name)
        silent = (clock > 1.5 + 2 * step + 0.01) & (clock < 2.5 - 2 * step - 0.01)
        heard = (clock < 1.5 - 2 * step) | (clock > 2.5 + 2 * step)
        assert np.isnan(values[silent]).all(), name
        assert np.isfinite(values[heard]).all(), name
        np.testing.assert_allclose(
            values[heard], np.column_stack([np.sin(clock), np.cos(clock)])[heard], atol=2e-4
        )

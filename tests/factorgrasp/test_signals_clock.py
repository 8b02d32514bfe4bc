from __future__ import annotations

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.signals import common_clock, synchronise


def test_clock_covers_what_all_sources_cover() -> None:
    clock = common_clock({"a": [0.0, 10.0], "b": [0.5, 9.0]}, 100.0)
    assert clock[0] == 0.5
    assert clock[-1] == pytest.approx(9.0)
    assert np.allclose(np.diff(clock), 0.01)
    with pytest.raises(InputError, match="a ends at 1 s, b begins at 2 s"):
        common_clock({"a": [0.0, 1.0], "b": [2.0, 3.0]}, 100.0)
    with pytest.raises(InputError, match="rate"):
        common_clock({"a": [0.0, 1.0]}, 0.0)


def test_slow_and_fast_sources_meet_on_one_clock(rng: np.random.Generator) -> None:
    clock = np.arange(0.0, 2.0, 0.01)

    def signal(t: np.ndarray) -> np.ndarray:
        return np.column_stack([3.0 + 2.0 * t, np.sin(2.0 * t)])

    slow, fast = np.arange(0.0, 2.0, 0.02), np.sort(rng.uniform(0.0, 2.0, 4000))
    noise = 0.1 * rng.normal(size=(fast.size, 2))
    found = synchronise(clock, {"slow": (slow, signal(slow)), "fast": (fast, signal(fast) + noise)})
    np.testing.assert_allclose(found["slow"][2:-2], signal(clock)[2:-2], atol=3e-4)
    # Twenty samples a step: the noise falls by their square root, and straight lines are met without bias.
    error = (found["fast"] - signal(clock))[5:-5]
    assert 0.7 * 0.1 / np.sqrt(20) < np.nanstd(error) < 1.4 * 0.1 / np.sqrt(20)
    assert abs(np.nanmean(error)) < 4.0 * 0.1 / np.sqrt(4000)


def test_gaps_stay_gaps() -> None:
    clock = np.arange(0.0, 1.0, 0.01)
    fast = np.arange(0.0, 1.0, 0.001)
    x = np.where((fast > 0.3) & (fast < 0.5), np.nan, 1.0)
    lost = fast[(fast < 0.6) | (fast > 0.8)]
    found = synchronise(clock, {"nan": (fast, x), "missing": (lost, np.ones(lost.size))})
    assert np.isnan(found["nan"][(clock > 0.306) & (clock < 0.494)]).all()
    assert np.isfinite(found["nan"][(clock < 0.295) | (clock > 0.505)]).all()
    assert np.isnan(found["missing"][(clock > 0.606) & (clock < 0.794)]).all()
    np.testing.assert_allclose(found["missing"][clock < 0.59], 1.0)
    later = synchronise(clock + 5.0, {"gone": (fast, x)})["gone"]
    assert np.isnan(later).all()


def test_bad_input_names_the_source() -> None:
    with pytest.raises(InputError, match="plate: t"):
        synchronise([0.0, 1.0], {"plate": ([0.0, 0.0, 0.1], [1.0, 2.0, 3.0])})
    with pytest.raises(InputError, match="clock"):
        synchronise([1.0, 0.0], {})

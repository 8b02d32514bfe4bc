"""Ground truth for every problem: analytic motions, sensor models, and the papers' experiments as named scenarios."""

from __future__ import annotations

from factorgrasp.simulation.scenarios import list_scenarios, make_scenario

__all__ = ["list_scenarios", "make_scenario"]

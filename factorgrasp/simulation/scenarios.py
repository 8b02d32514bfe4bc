"""The named scenarios: one line each; the module is imported when its scenario is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from factorgrasp.errors import InputError


@dataclass(frozen=True)
class Scenario:
    """Where a scenario's generator lives and what it stands for.

    Attributes
    ----------
    location : str
        ``"module:function"``; the function takes ``seed: int`` and its own options and returns a recording with its truth.
    summary : str
        One line for people.
    """

    location: str
    summary: str

    def load(self) -> Callable[..., Any]:
        """The generator itself."""
        module, function = self.location.split(":")
        generator: Callable[..., Any] = getattr(import_module(module), function)
        return generator


scenarios: dict[str, Scenario] = {
    "cehajic2015": Scenario(
        "factorgrasp.simulation.cehajic2015:cehajic2015",
        "grasp pose, rigid object, wrist at rest (Cehajic 2015, section V; options motion='exciting' | 'printed')",
    ),
    "cordella2014": Scenario(
        "factorgrasp.simulation.wrist:cordella2014",
        "wrist pose from six blobs (Cordella 2014; option motion='abduction' | 'flexion' | 'pronation' | 'three_axes' | 'reach')",
    ),
    "cehajic2015_loop": Scenario(
        "factorgrasp.simulation.cehajic2015_loop:cehajic2015_loop",
        "closed loop of Cehajic 2015: arm, impedance, wrist, estimator (options policy='receding' | 'velocity' | 'biased', arm)",
    ),
    "grasp_regrasp": Scenario(
        "factorgrasp.simulation.cehajic2015:grasp_regrasp",
        "grasp pose as in cehajic2015, and the hand takes another grasp half way (default 10 deg, 70 mm)",
    ),
    "human_bowing": Scenario(
        "factorgrasp.simulation.human_dynamics:human_bowing",
        "human dynamics, bowing on two plates (Latella 2018; options torso_mass=6 kg, push in N on a robot's arms)",
    ),
    "human_carrying": Scenario(
        "factorgrasp.simulation.human_dynamics:human_carrying",
        "human dynamics, 9.55 kg in both hands (Tirupachuri 2021; option motion='standing' | 'one_foot' | 'walking')",
    ),
    "human_tpose": Scenario(
        "factorgrasp.simulation.human_dynamics:human_tpose",
        "human dynamics, arms to the T-pose and back (Tirupachuri 2021; option payload=5 kg in the right hand)",
    ),
    "grasp_slip": Scenario(
        "factorgrasp.simulation.cehajic2015:grasp_slip",
        "grasp pose as in cehajic2015, and the hand slips slowly along the object (default 20 mm, 3 deg in 20 s)",
    ),
}
"""Name to scenario. Add one by adding its line."""


def list_scenarios() -> dict[str, str]:
    """Name and one-line summary of every scenario, sorted by name."""
    return {name: scenarios[name].summary for name in sorted(scenarios)}


def make_scenario(name: str, seed: int = 0, **options: Any) -> Any:
    """Generate a named scenario.

    Parameters
    ----------
    name : str
        One of :func:`list_scenarios`.
    seed : int
        Everything random derives from it; the same seed and options give the same numbers.
    **options
        Passed to the scenario's generator, which documents them.

    Returns
    -------
    A recording with its ground truth; for grasp scenarios a :class:`factorgrasp.simulation.grasp.GraspRecording`.

    Raises
    ------
    InputError
        For an unknown name; the message lists the known ones.
    """
    if name not in scenarios:
        raise InputError("scenario", "one of " + ", ".join(sorted(scenarios)), repr(name))
    return scenarios[name].load()(seed=seed, **options)

"""Pixels without depth: finding the hand, and the second pose that explains them as well (mathematics 5.1)."""

from __future__ import annotations

from dataclasses import dataclass

from factorgrasp.models.camera import Camera
from factorgrasp.problems.wrist_assign import Rates
from factorgrasp.problems.wrist_search import Found
from factorgrasp.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Flat:
    """A pose found without depth."""

    found: Found


def flat_search(
    camera: Camera,
    points: FloatArray,
    blocks: FloatArray,
    uvz: FloatArray,
    covariance: FloatArray,
    rates: Rates,
    gate: float,
) -> Flat | None:
    """Not yet."""
    return None


def rival() -> None:
    """Not yet."""

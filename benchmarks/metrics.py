"""One number of a benchmark with its target: the same object makes the line of the report and the verdict of the gate."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from factorgrasp.tables import Column, Table, plain

Direction = Literal["lower", "higher", "within", "none"]


@dataclass(frozen=True)
class Metric:
    """What was measured, and what it should be.

    Attributes
    ----------
    key : str
        Unique within a benchmark, words joined by slashes.
    value : float
        NaN when it could not be measured: such a metric fails its target.
    unit : str
    direction : {"lower", "higher", "within", "none"}
        Lower or higher is better, or it should lie within a band; "none" is information without a target.
    target : float or (float, float) or None
        Bound, or the ends of the band; None exactly with direction "none".
    note : str
        Conditions, or what the number is compared with.
    """

    key: str
    value: float
    unit: str = ""
    direction: Direction = "none"
    target: float | tuple[float, float] | None = None
    note: str = ""

    def __post_init__(self) -> None:
        shape = {"lower": float, "higher": float, "within": tuple, "none": type(None)}[self.direction]
        target = float(self.target) if isinstance(self.target, int) else self.target
        if not isinstance(target, shape):
            raise ValueError(f"metric {self.key!r}: direction {self.direction!r} with target {self.target!r}")
        object.__setattr__(self, "value", float(self.value))
        object.__setattr__(self, "target", target)

    @property
    def passed(self) -> bool | None:
        """Whether the target is met; None without one."""
        if isinstance(self.target, tuple):
            return bool(self.target[0] <= self.value <= self.target[1])
        if self.target is None:
            return None
        return bool(self.value <= self.target if self.direction == "lower" else self.value >= self.target)

    def without_target(self, note: str) -> Metric:
        """The same as information only, with a note why."""
        return replace(
            self, direction="none", target=None, note=f"{note}; {self.note}" if self.note else note
        )

    @property
    def target_words(self) -> str:
        """The target as people read it."""
        if isinstance(self.target, tuple):
            return f"{self.target[0]:.4g} to {self.target[1]:.4g}"
        return (
            "" if self.target is None else f"{'<=' if self.direction == 'lower' else '>='} {self.target:.4g}"
        )

    @property
    def verdict(self) -> str:
        """``pass``, ``FAIL`` or nothing."""
        return {True: "pass", False: "FAIL", None: ""}[self.passed]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        target = list(self.target) if isinstance(self.target, tuple) else self.target
        return {
            "key": self.key,
            "value": plain(self.value),
            "unit": self.unit,
            "direction": self.direction,
            "target": target,
            "passed": self.passed,
            "note": self.note,
        }


def metric_table(metrics: Sequence[Metric], title: str = "", notes: tuple[str, ...] = ()) -> Table:
    """One line a metric: value, target and verdict side by side."""
    columns = (
        Column("key", "measured"),
        Column("value", "value"),
        Column("unit"),
        Column("target"),
        Column("verdict"),
        Column("note"),
    )
    rows = tuple(
        {
            "key": m.key,
            "value": "not measured" if math.isnan(m.value) else f"{m.value:.4g}",
            "unit": m.unit,
            "target": m.target_words,
            "verdict": m.verdict,
            "note": m.note,
        }
        for m in metrics
    )
    return Table(columns, rows, title, notes)


def missed(metrics: Iterable[Metric]) -> list[Metric]:
    """The metrics whose target is not met, in order."""
    return [m for m in metrics if m.passed is False]

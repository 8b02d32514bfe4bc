"""An estimate as a few aligned lines for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgrasp import lie
from factorgrasp.estimate import Estimate
from factorgrasp.observability import Direction
from factorgrasp.typing import FloatArray
from factorgrasp.variables import Variable

MOST_ROWS = 40
"""Components printed before the rest is counted instead."""


def summarize(estimate: Estimate) -> str:
    """Status, every component with its standard deviation, the agreement of every term, and what the data did not inform."""
    lines = [_headline(estimate)]
    if estimate.message and not estimate.solved:
        lines.append(f"  {estimate.message}")
    lines += ["", *_values(estimate)]
    if estimate.residuals:
        lines += ["", *_terms(estimate)]
    words = _observability(estimate)
    if words:
        lines += ["", *words]
    return "\n".join(lines)


def _headline(estimate: Estimate) -> str:
    words = estimate.status.value.replace("_", " ")
    total = estimate.timing.get("total")
    spent = "" if total is None else f" in {_seconds(total)}"
    steps = f", {estimate.iterations} iterations" if estimate.iterations > 1 else ""
    return f"{estimate.kind}: {words} by {estimate.solver}{spent}{steps}, objective {estimate.objective:.6g}"


def _values(estimate: Estimate) -> list[str]:
    rows: list[tuple[str, str, str, str]] = []
    for variable in estimate.variables:
        sd = _sd(estimate, variable)
        for label, value, spread in zip(
            variable.labels, coordinates(variable, estimate.values[variable.name]), sd, strict=True
        ):
            rows.append(
                (label, f"{value:.6g}", "" if np.isnan(spread) else f"+- {_short(spread)}", variable.unit)
            )
    shown = rows[:MOST_ROWS]
    lines = _align([("", "value", "sd", "unit"), *shown], "<><<")
    if len(rows) > len(shown):
        lines.append(f"  ... and {len(rows) - len(shown)} more components")
    turned = [v.name for v in estimate.variables if v.manifold != "vector"]
    if turned:
        lines.append(f"  {', '.join(turned)}: rotation vector of the value; sd about its own (body) axes")
    return lines


def coordinates(variable: Variable, value: FloatArray) -> FloatArray:
    """A value as one number a tangent component (size,): rotation vectors (rad) for rotations, position and rotation vector for poses."""
    if variable.manifold == "rotation":
        return np.asarray(lie.so3_log(value))
    if variable.manifold == "pose":
        return np.concatenate([value[:3, 3], lie.so3_log(value[:3, :3])])
    return np.asarray(value)


def _sd(estimate: Estimate, variable: Variable) -> FloatArray:
    """Standard deviations (size,); infinite where nothing informs a component, NaN where there is no covariance."""
    if estimate.covariance_source is None:
        return np.full(variable.size, np.nan)
    sd = estimate.sd(variable.name)
    lost = [d for d in _missing(estimate) if d.variable == variable.name and not np.isfinite(d.sd)]
    for direction in lost:
        sd = np.where(np.isnan(sd) & (np.abs(direction.vector) > 1e-6), np.inf, sd)
    return np.asarray(sd)


def _terms(estimate: Estimate) -> list[str]:
    robust = any(term.down_weighted > 0.0 for term in estimate.residuals)
    header = ("term", "rows", "rms/sd", "worst/sd", *(("down-weighted",) if robust else ()))
    rows = [
        (
            term.name,
            str(term.rows),
            f"{term.rms:.3g}",
            f"{term.worst:.3g}",
            *((f"{100.0 * term.down_weighted:.1f} %",) if robust else ()),
        )
        for term in estimate.residuals
    ]
    return _align([header, *rows], "<>>>>")


def _observability(estimate: Estimate) -> list[str]:
    found = estimate.observability
    if found is None or not found.directions:
        return []
    missing = _missing(estimate)
    if not missing:
        worst = found.directions[0]
        unit = f" {worst.unit}" if worst.unit else ""
        return [f"  all judged directions informed; weakest: {worst.words} (sd {worst.sd:.3g}{unit})"]
    lines = ["  not informed by the data:"]
    for direction in missing:
        unit = f" {direction.unit}" if direction.unit else ""
        size = (
            "nothing informs it"
            if not np.isfinite(direction.sd)
            else (f"sd {direction.sd:.3g}{unit}, needed {direction.resolution:.3g}{unit}")
        )
        lines.append(f"    {direction.words}: {size}")
    if found.advice:
        lines.append(f"  {found.advice}")
    return lines


def _missing(estimate: Estimate) -> tuple[Direction, ...]:
    return () if estimate.observability is None else estimate.observability.missing


def _align(rows: Sequence[Sequence[str]], sides: str) -> list[str]:
    """Rows of cells as lines with aligned columns; the first row is the header."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  "
        + "  ".join(
            f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=False)
        ).rstrip()
        for row in rows
    ]


def _short(number: float) -> str:
    return "inf" if np.isinf(number) else f"{number:.2g}"


def _seconds(seconds: float) -> str:
    return f"{seconds * 1e3:.3g} ms" if seconds < 1.0 else f"{seconds:.3g} s"

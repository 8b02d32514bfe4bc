"""One self-contained HTML page an estimate: what was found, how sure it is, what the data showed and did not show.

A kind of problem that has more to say than means and residuals registers a builder in :data:`BUILDERS`; the page itself, its style and its
general sections live here, and nothing in it asks the network for anything.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np

from factorgrasp.atomic import write_text
from factorgrasp.estimate import Estimate
from factorgrasp.observability import Direction
from factorgrasp.status import Status

BUILDERS: dict[str, str] = {
    "grasp_pose": "factorgrasp.grasp_report:build",
    "grasp_pose_from_poses": "factorgrasp.grasp_report:build_from_poses",
    "human_dynamics": "factorgrasp.human_dynamics_report:build",
    "excitation_evaluation": "factorgrasp.excitation_evaluation_report:build",
    "excitation": "factorgrasp.excitation_report:build",
}
"""``"module:function"`` of the builder of a kind; it takes the typed view of an estimate and returns a :class:`Report`."""

Builder: TypeAlias = Callable[[Any], "Report"]

NBSP = "\u00a0"
PM = "±" + NBSP
"""Plus-minus with a space that does not break."""

STATUS_WORDS: dict[Status, str] = {
    Status.SOLVED: "solved",
    Status.UNOBSERVABLE: "not fully observable",
    Status.INFEASIBLE: "infeasible",
    Status.UNBOUNDED: "unbounded",
    Status.NOT_CONVERGED: "not converged",
    Status.NUMERICAL_ERROR: "numerical error",
}


@dataclass(frozen=True)
class Card:
    """One headline figure: ``label``, its ``value`` with its uncertainty, and a line of explanation."""

    label: str
    value: str
    spread: str = ""
    note: str = ""


@dataclass(frozen=True)
class Bar:
    """One direction as a bar: ``fill`` in [0, 1] (1: known much better than asked), good or not."""

    label: str
    value: str
    fill: float
    good: bool


@dataclass(frozen=True)
class Table:
    """Rows of words; the first column is text, the others are figures."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Section:
    """One part of the page, in the order title, text, figure with caption, bars, table."""

    title: str
    text: str = ""
    svg: str = ""
    caption: str = ""
    bars: tuple[Bar, ...] = ()
    table: Table | None = None


@dataclass(frozen=True)
class Report:
    """What stands on a page, free of markup.

    Attributes
    ----------
    title, sentence : str
        The heading, and the answer in one sentence.
    cards : tuple of Card
    sections : tuple of Section
    """

    title: str
    sentence: str
    cards: tuple[Card, ...] = ()
    sections: tuple[Section, ...] = field(default=())


def build_report(estimate: Any) -> Report:
    """The report of an estimate or of the typed view of one."""
    inner = core(estimate)
    if inner.kind in BUILDERS and inner is not estimate:
        module, _, name = BUILDERS[inner.kind].partition(":")
        return cast(Builder, getattr(import_module(module), name))(estimate)
    return Report(
        inner.kind.replace("_", " ").capitalize(),
        inner.message or STATUS_WORDS[inner.status].capitalize() + ".",
        sections=general_sections(inner),
    )


def core(estimate: Any) -> Estimate:
    """The :class:`Estimate` itself, or the one that a typed view carries."""
    return estimate if isinstance(estimate, Estimate) else cast(Estimate, estimate.estimate)


def write_report(
    estimate: Any, path: Path, title: str = "", source: str = "", remarks: Sequence[str] = ()
) -> Path:
    """Write the page of an estimate.

    Parameters
    ----------
    estimate : Estimate or a typed view of one
    path : Path
        Of the HTML file; it appears when it is complete.
    title : str
        Of the recording, above the heading.
    source : str
        The problem file.
    remarks : sequence of str
        Warnings that came up on the way.
    """
    return write_text(path, render(build_report(estimate), core(estimate), title, source, remarks))


def render(
    report: Report, estimate: Estimate, title: str = "", source: str = "", remarks: Sequence[str] = ()
) -> str:
    """The page as HTML text."""
    from jinja2 import Environment, StrictUndefined

    template = files("factorgrasp").joinpath("report_template.html").read_text(encoding="utf-8")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(template).render(
        report=report,
        title=title,
        source=source,
        remarks=remarks,
        status=STATUS_WORDS[estimate.status],
        solved=estimate.status.ok,
        message=estimate.message,
        solver=estimate.solver,
        timing=[(name, seconds_words(value)) for name, value in estimate.timing.items()],
        versions=sorted(estimate.versions.items()),
        problem_hash=estimate.problem_hash,
        iterations=estimate.iterations,
        certificate=estimate.certificate,
    )


def general_sections(estimate: Estimate) -> tuple[Section, ...]:
    """Values, observability and residuals of any estimate."""
    sections = [_values_section(estimate)]
    if estimate.observability is not None:
        sections.append(observability_section(estimate))
    if estimate.residuals:
        sections.append(residual_section(estimate))
    return tuple(sections)


def _values_section(estimate: Estimate) -> Section:
    rows = []
    for variable in estimate.variables:
        value = estimate.values[variable.name]
        # Tangent components of a rotation or a pose are not its value; there the matrix has the say.
        shown = value.ravel() if variable.manifold == "vector" else np.full(variable.size, np.nan)
        sd = (
            estimate.sd(variable.name)
            if estimate.covariance_source is not None
            else np.full(variable.size, np.nan)
        )
        for label, mean, spread in zip(variable.labels, shown, sd, strict=True):
            rows.append((label, "" if np.isnan(mean) else f"{mean:.6g}", f"{spread:.2g}", variable.unit))
    return Section("Values", table=Table(("unknown", "mean", "sd", "unit"), tuple(rows)))


def observability_section(estimate: Estimate) -> Section:
    """Which directions the data informed, as bars."""
    assert estimate.observability is not None
    observability = estimate.observability
    text = (
        "Every direction of the unknowns is informed well enough by the motion."
        if observability.complete
        else "What stands in red was not informed: its standard deviation is larger than the resolution that is asked for. "
        + observability.advice
    )
    return Section(
        "What the motion showed",
        text,
        bars=tuple(_bar(direction) for direction in observability.directions),
        caption="A full bar: known a thousand times better than the resolution that is asked for. An empty one: no better than that.",
    )


def _bar(direction: Direction) -> Bar:
    words = direction.words[:1].upper() + direction.words[1:]
    if not np.isfinite(direction.sd):
        return Bar(words, "nothing is known", 0.0, False)
    margin = np.log10(direction.resolution / direction.sd) / 3.0 if direction.sd > 0.0 else 1.0
    value = f"{PM}{quantity(direction.sd, direction.unit)} (asked for: {quantity(direction.resolution, direction.unit)})"
    return Bar(
        words, value, float(np.clip(margin, 0.02 if direction.observable else 0.0, 1.0)), direction.observable
    )


def residual_section(estimate: Estimate) -> Section:
    """Whitened residuals per term: who disagrees."""
    rows = tuple(
        (
            term.name.replace("_", " "),
            f"{term.rows}",
            f"{term.rms:.2f}",
            f"{term.worst:.1f}",
            f"{100.0 * term.down_weighted:.1f} %" if term.down_weighted > 0.0 else "none",
        )
        for term in estimate.residuals
    )
    return Section(
        "Agreement with the noise model",
        "In units of the stated standard deviations: an RMS of 1 means that the residuals are as large as the noise model says.",
        table=Table(("measurements", "rows", "RMS", "worst", "down-weighted"), rows),
    )


def quantity(value: float, unit: str, digits: int = 2) -> str:
    """A quantity as people say it: radians as degrees, small metres and seconds in milli."""
    if unit.startswith("rad"):
        value, unit = float(np.degrees(value)), "°" + unit[3:]
        return f"{significant(value, digits)}{unit}"
    if unit in ("m", "s") and abs(value) < 0.9995:
        value, unit = 1000.0 * value, "m" + unit
    return f"{significant(value, digits)}{NBSP}{unit.replace('^2', '²')}".rstrip()


def significant(value: float, digits: int = 2) -> str:
    """A number with `digits` significant digits and without an exponent where that is readable."""
    if value == 0.0 or not np.isfinite(value):
        return f"{value:g}"
    # Rounded first: 0.9996 to two digits is 1.0, not 1.00.
    power = int(np.floor(np.log10(abs(float(f"{value:.{digits - 1}e}")))))
    if -5 <= power < 6:
        return f"{value:.{max(0, digits - 1 - power)}f}"
    return f"{value:.{digits - 1}e}"


def decimals(spread: float) -> int:
    """Decimals with which a value is written, so that its standard deviation shows two significant digits."""
    if not np.isfinite(spread) or spread <= 0.0:
        return 6
    return int(np.clip(1 - np.floor(np.log10(spread)), 0, 9))


def seconds_words(value: float) -> str:
    """A duration for a reader."""
    return quantity(value, "s", 3)


def join_words(words: Sequence[str]) -> str:
    """``a, b and c``."""
    words = list(words)
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]

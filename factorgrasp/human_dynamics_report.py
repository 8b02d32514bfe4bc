"""The report of human dynamics: which joints work hardest, what pushes on the body, and how well the sensors agree."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp import plots
from factorgrasp.human_dynamics_result import HumanDynamicsResult
from factorgrasp.problems.human_dynamics_words import agreement_words
from factorgrasp.problems.link_motion_spatial import rotate
from factorgrasp.report import (
    NBSP,
    PM,
    Card,
    Report,
    Section,
    Table,
    decimals,
    join_words,
    observability_section,
    quantity,
    significant,
)
from factorgrasp.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHOWN = 6
"""Joints and links that get a picture of their own: those with the largest moments and forces."""
_MOST_POINTS = 800
_FELT = 2.0
"""Forces below this, N, are not drawn: links that touch nothing."""


def build(result: HumanDynamicsResult) -> Report:
    """The report of a solved recording."""
    frames = result.frames
    solved = np.array([status.ok for status in frames.status])
    if not solved.any():
        return Report("Joint torques", result.message or "No frame could be solved.")
    sections = [_moments(result), _forces(result)]
    if result.payload is not None:
        sections.append(_payload(result))
    if result.estimate.observability is not None:
        sections.append(_contacts(result))
    sections += [_table(result), _agreement(result)]
    if frames.active:
        sections.append(_active(result))
    return Report("Joint torques", _sentence(result), _cards(result), tuple(sections))


def _sentence(result: HumanDynamicsResult) -> str:
    names, size, sd = _moment_sizes(result)
    j = int(np.argmax(np.nanmax(size, axis=0)))
    f = int(np.nanargmax(size[:, j]))
    return (
        f"The joint {names[j]} carries the largest moment: {_with_sd(size[f, j], sd[f, j], 'Nm')} at {result.t[f]:.2f}{NBSP}s."
        + (f" {result.payload.words[:1].upper()}{result.payload.words[1:]}." if result.payload else "")
    )


def _cards(result: HumanDynamicsResult) -> tuple[Card, ...]:
    frames = result.frames
    span = f"{quantity(float(result.t[-1] - result.t[0]), 's', 3)}, {result.t.size} frames"
    gaps = int((~result.good).sum())
    missing = [f"{gaps} frames are gaps"] if gaps else []
    failed = sum(not status.ok for status in frames.status)
    missing += [f"{failed} frames were not solved"] if failed else []
    cards = [
        Card("Recording", span, "", join_words(missing) if missing else "every frame was solved"),
        Card("Body", f"{len(frames.links)} links, {len(frames.joint_names)} joints", "", _mass_words(result)),
    ]
    if result.payload is not None:
        p = result.payload
        cards.append(
            Card(
                "Held mass",
                *_value_and_sd(p.mean, p.mean_sd, "kg"),
                f"by {join_words(p.links)}; the spread is that of one frame",
            )
        )
    return tuple(cards)


def _mass_words(result: HumanDynamicsResult) -> str:
    return "" if result.weighing is None else result.weighing.words


def _moment_sizes(result: HumanDynamicsResult) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Size of every joint's moment (n, J), Nm, and the standard deviation along it."""
    frames = result.frames
    size = np.linalg.norm(frames.joint_moment, axis=2)
    along = frames.joint_moment / np.where(size > 0.0, size, 1.0)[..., None]
    variance = np.einsum("njk,njkl,njl->nj", along, frames.joint_moment_covariance, along)
    return frames.joint_names, _on_clock(result, size), _on_clock(result, np.sqrt(np.maximum(variance, 0.0)))


def _moments(result: HumanDynamicsResult) -> Section:
    names, size, sd = _moment_sizes(result)
    order = np.argsort(-np.nanmax(size, axis=0))[:_SHOWN]
    made = _panels([(names[j], "Nm", [("", size[:, j], sd[:, j], "z")]) for j in order], result.t)
    return Section(
        "Joints that work hardest",
        "Size of the moment that the parent exerts on the child at the joint's centre.",
        svg=plots.to_svg(made, "moments"),
        caption="The band holds the moment with a probability of 95 % in every frame. Where the motion has a gap, the line breaks.",
    )


def _forces(result: HumanDynamicsResult) -> Section:
    frames = result.frames
    R = result.rotation
    force = _on_clock(result, rotate(R, frames.external_wrench[..., :3]))
    P = frames.external_wrench_covariance[..., :3, :3]
    variance = np.diagonal(R @ P @ np.swapaxes(R, -1, -2), axis1=2, axis2=3)
    sd = _on_clock(result, np.sqrt(np.maximum(variance, 0.0)))
    size = np.nanmax(np.linalg.norm(force, axis=2), axis=0)
    order = [int(i) for i in np.argsort(-size)[:_SHOWN] if size[i] > _FELT]
    if not order:
        return Section("Forces from outside", "No link feels more than 2 N.")
    panels = [
        (frames.links[i], "N", [(axis, force[:, i, k], sd[:, i, k], axis) for k, axis in enumerate("xyz")])
        for i in order
    ]
    others = sum(bool(s > _FELT) for s in size) - len(order)
    caption = "Force on the link, in world axes, with its 95 % band."
    if others > 0:
        caption += f" {others} more links feel less."
    return Section(
        "Forces from outside", svg=plots.to_svg(_panels(panels, result.t), "forces"), caption=caption
    )


def _payload(result: HumanDynamicsResult) -> Section:
    assert result.payload is not None
    p = result.payload
    mass, sd = _on_clock(result, p.mass), _on_clock(result, p.mass_sd)
    made = _panels([("Held mass", "kg", [("", mass, sd, "accent")])], result.t)
    return Section(
        "What is held",
        f"{p.words[:1].upper()}{p.words[1:]}. It is what the forces that nobody measured would have to carry, their acceleration "
        "counted in. A body whose mass is wrong shows here as a held mass of the difference.",
        svg=plots.to_svg(made, "payload"),
        caption="Frame by frame, with the 95 % band.",
    )


def _contacts(result: HumanDynamicsResult) -> Section:
    """What the momentum of the body tells of contacts without a sensor."""
    known = observability_section(result.estimate)
    text = (
        "Six equations, the rate of the whole body's momentum, tell of all contacts that nobody measures. In red is what they leave open: "
        "there the estimate is what the prior says. "
    )
    advice = result.estimate.observability.advice if result.estimate.observability else ""
    caption = "A full bar: known a thousand times better than the prior's standard deviation; an empty one: no better than that."
    return replace(
        known,
        title="What is known of the contacts without a sensor",
        text=text + (advice and advice + "."),
        caption=caption,
    )


def _table(result: HumanDynamicsResult) -> Section:
    frames = result.frames
    solved = np.array([status.ok for status in frames.status])
    rows = []
    for k, name in enumerate(frames.dof_names):
        values, sd = frames.torque[solved, k], float(np.median(frames.torque_sd[solved, k]))
        rows.append((name, *_figures(values, sd)))
    _, size, spread = _moment_sizes(result)
    with_axes = set(result.jointed)
    for j, name in enumerate(frames.joint_names):
        if name not in with_axes:
            values = size[result.good][solved, j]
            rows.append((f"moment of {name}", *_figures(values, float(np.nanmedian(spread[:, j])))))
    return Section(
        "Torque of every degree of freedom" if with_axes else "Moment of every joint",
        table=Table(
            ("degree of freedom" if with_axes else "joint", "RMS (Nm)", "largest (Nm)", "sd (Nm)"),
            tuple(rows),
        ),
    )


def _figures(values: FloatArray, sd: float) -> tuple[str, str, str]:
    digits = min(decimals(sd), 3)
    rms, largest = float(np.sqrt(np.mean(values**2))), float(values[int(np.argmax(np.abs(values)))])
    return f"{rms:.{digits}f}", f"{largest:.{digits}f}", significant(sd)


def _agreement(result: HumanDynamicsResult) -> Section:
    rows = []
    for found in result.frames.innovations:
        ratio = found.ratio
        words = agreement_words(found).split(": ", 1)[1]
        words = words.split("; ", 1)[-1] if np.isfinite(ratio) else words
        rows.append((f"{found.name}: {words}", significant(ratio) if np.isfinite(ratio) else "none"))
    text = (
        "Every sensor is compared with what all the others and the model say it should read. One is what its covariance promises; "
        "a sensor that stands far above it is wrong, or the model is, or the covariance is too small."
    )
    if result.weighing is not None:
        text += f" By weight: {result.weighing.words}."
    if result.residual is not None:
        text += f" {result.residual_words[0].upper()}{result.residual_words[1:]}."
    return Section(
        "Do the sensors agree", text, table=Table(("sensor", "NIS per degree of freedom"), tuple(rows))
    )


def _active(result: HumanDynamicsResult) -> Section:
    counted = Counter(one.meaning for one in result.frames.active)
    rows = tuple((meaning, f"{count}") for meaning, count in counted.most_common(12))
    return Section("Limits that were met", table=Table(("limit", "frames"), rows))


def _on_clock(result: HumanDynamicsResult, values: FloatArray) -> FloatArray:
    out = np.full((result.t.size, *values.shape[1:]), np.nan)
    out[result.good] = values
    return out


def _value_and_sd(value: float, sd: float, unit: str) -> tuple[str, str]:
    digits = decimals(sd) if np.isfinite(sd) else 3
    return f"{value:.{digits}f}{NBSP}{unit}", f"{PM}{significant(sd)}{NBSP}{unit}"


def _with_sd(value: float, sd: float, unit: str) -> str:
    digits = min(decimals(sd), 3)
    return f"{value:.{digits}f} {PM}{significant(sd)}{NBSP}{unit}"


Curve = tuple[str, FloatArray, FloatArray, str]


def _panels(panels: list[tuple[str, str, list[Curve]]], t: FloatArray) -> Figure:
    """Small pictures over time, two in a row, each with curves (label, values, sd, colour) and their bands."""
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    made, axes = plots.figure(7.2, 1.75 * rows + 0.2, rows=rows, columns=columns, sharex=True)
    for ax in axes[len(panels) :]:
        ax.remove()
    for k, (ax, (title, unit, curves)) in enumerate(zip(axes, panels, strict=False)):
        _draw(ax, title, unit, curves, t)
        # The lowest picture of a column has the axis of time, whether or not its row is full.
        if k + columns >= len(panels):
            ax.set_xlabel("time (s)")
            ax.tick_params(labelbottom=True)
    return made


@plots.styled
def _draw(ax: Axes, title: str, unit: str, curves: list[Curve], t: FloatArray) -> None:
    every = slice(None, None, max(1, t.size // _MOST_POINTS))
    for label, values, sd, colour in curves:
        shade = plots.PALETTE[colour]
        low, high = values - 1.96 * sd, values + 1.96 * sd
        ax.fill_between(t[every], low[every], high[every], color=shade, alpha=0.18, linewidth=0.0)
        ax.plot(t[every], values[every], color=shade, label=label or None)
    ax.set_title(title)
    ax.set_ylabel(unit)
    if len(curves) > 1:
        ax.legend(
            ncols=3,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            borderaxespad=0.0,
            handlelength=1.4,
            columnspacing=1.2,
        )

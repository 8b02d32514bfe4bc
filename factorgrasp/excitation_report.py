"""The page of a planned excitation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from factorgrasp import plots
from factorgrasp.excitation_plan import ExcitationPlan
from factorgrasp.report import NBSP, PM, Bar, Card, Report, Section, Table, significant
from factorgrasp.typing import FloatArray

_MOST_POINTS = 800


def build(plan: ExcitationPlan) -> Report:
    """What the plan moves, what it shows, what it costs the human, and how near it comes to every limit."""
    s = plan.problem.settings
    sd = plan.predicted_sd
    worst_turn, worst_arm = float(np.degrees(np.max(sd[:3]))), 1000.0 * float(np.max(sd[3:]))
    cards = (
        Card("Excitation", f"{100.0 * plan.share:.1f}{NBSP}%", note="of what was asked for, in the worst window"),
        Card("Lever arm after it", f"{PM}{significant(worst_arm)}{NBSP}mm", note="predicted sd of the worst component"),
        Card("Rotation after it", f"{PM}{significant(worst_turn)}°", note="predicted sd of the worst component"),
        Card(
            "Force at the wrist", f"{significant(float(np.sqrt(np.mean(plan.force_rms**2))))}{NBSP}N",
            note="RMS, with what is not known of the grasp",
        ),
    )  # fmt: skip
    sections = [_motion(plan), _windows(plan), _wrist(plan)]
    if plan.q.shape[1]:
        sections.append(_joints(plan))
    sections += [_margins(plan), _table(plan)]
    sentence = plan.message[:1].upper() + plan.message[1:] + "." if plan.message else (
        f"A motion of {s.duration:g} s that reveals the grasp: every window has the excitation asked for, and no limit is violated "
        f"anywhere on a grid of {1000.0 * s.step:g} ms."
    )  # fmt: skip
    return Report("Planned excitation", sentence, cards, tuple(sections))


def _thin(values: FloatArray) -> FloatArray:
    return values[:: max(1, values.shape[0] // _MOST_POINTS)]


@plots.styled
def _three(panels: Sequence[tuple[str, str, FloatArray, Any, tuple[str, ...]]]) -> str:
    """Curves over time: (title, unit, t, values (n, k), labels)."""
    made, axes = plots.figure(7.2, 1.75 * len(panels) + 0.2, rows=len(panels), sharex=True)
    colours = [plots.PALETTE[key] for key in ("x", "y", "z", "accent", "ink", "muted", "line")]
    for ax, (title, unit, t, values, labels) in zip(axes, panels, strict=True):
        for k in range(values.shape[1]):
            ax.plot(
                _thin(t),
                _thin(values[:, k]),
                color=colours[k % len(colours)],
                label=labels[k] if labels else None,
            )
        ax.set_title(title)
        ax.set_ylabel(unit)
        if labels:
            ax.legend(
                ncols=len(labels),
                loc="lower right",
                bbox_to_anchor=(1.0, 1.0),
                borderaxespad=0.0,
                handlelength=1.4,
                columnspacing=1.0,
            )
    axes[-1].set_xlabel("time (s)")
    return plots.to_svg(made, panels[0][0].split()[0].lower())


def _motion(plan: ExcitationPlan) -> Section:
    turn = np.degrees(plan.turn)
    moved = 1000.0 * (plan.position - plan.position[0])
    text = "The object turns about the human's wrist, so that the wrist stays where the human wants it; the end-effector moves around it."
    panels = [
        ("turn from what the human wants, end-effector's axes", "deg", plan.t, turn, plots.AXES),
        ("end-effector's place from its start, world axes", "mm", plan.t, moved, plots.AXES),
    ]
    return Section("The motion", text, svg=_three(panels))


def _windows(plan: ExcitationPlan) -> Section:
    s = plan.problem.settings
    index = np.sqrt(np.maximum(-plan.det_phi, 0.0))[:, None]
    panels = [("|w × al|: how exciting every instant is", "rad²/s³", plan.t, index, ())]
    if plan.lambda_min.size > 1:
        panels.insert(
            0,
            (
                "least eigenvalue of the excitation of every window",
                "rad²/s³",
                plan.check.window_start,
                plan.lambda_min[:, None],
                (),
            ),
        )
    about = (
        f"{s.alpha:g} rad²/s³ in every window of {s.window_length:g} s"
        if s.alpha is not None
        else "standard deviations after the whole motion"
    )
    text = f"Asked for: {about}. The worst window has {100.0 * plan.share:.2f} % of it."
    if plan.lambda_min.size == 1:
        text += f" Least eigenvalue of the one window: {plan.lambda_min[0]:.4g} rad²/s³."
    if np.isfinite(plan.coning_ratio):
        text += (
            " The mean square of the turn, over that of steady coning at the same bandwidth with the same excitation: "
            f"{plan.coning_ratio:.3f}" + (" (the plan also starts and ends at rest)." if s.rest else ".")
        )
    bars = []
    names = ("rotation", "lever arm")
    for k in range(6):
        sd, before = plan.predicted_sd[k], float(np.sqrt(plan.problem.grasp.covariance_r[k, k]))
        value = f"{PM}{significant(float(np.degrees(sd)))}° (before: {significant(float(np.degrees(before)))}°)" if k < 3 else (
            f"{PM}{significant(1000.0 * sd)}{NBSP}mm (before: {significant(1000.0 * before)}{NBSP}mm)"
        )  # fmt: skip
        fill = float(np.clip(np.log10(before / sd) / 3.0, 0.02, 1.0)) if sd > 0.0 else 1.0
        bars.append(Bar(f"{names[k // 3]} {'xyz'[k % 3]}", value, fill, sd < 0.9 * before))
    return Section(
        "What it shows",
        text,
        svg=_three(panels),
        bars=tuple(bars),
        caption="Predicted sd after the motion; a full bar: a thousand times better than before.",
    )


def _wrist(plan: ExcitationPlan) -> Section:
    panels = [
        (
            "force expected at the wrist, with what is not known of the grasp",
            "N",
            plan.t,
            plan.force_rms[:, None],
            (),
        ),
        ("moment at the wrist, world axes", "Nm", plan.t, plan.wrench[:, 3:], plots.AXES),
    ]
    w = plan.problem.wrist
    text = f"Through a wrist of {w.force_stiffness:g} N/m and {w.moment_stiffness:g} Nm/rad."
    return Section("What the human feels", text, svg=_three(panels))


def _joints(plan: ExcitationPlan) -> Section:
    labels = tuple(str(j + 1) for j in range(plan.q.shape[1]))
    panels = [
        ("position of the joints from the start", "deg", plan.t, np.degrees(plan.q - plan.q[0]), labels),
        ("velocity", "deg/s", plan.t, np.degrees(plan.qd), ()),
        ("torque", "Nm", plan.t, plan.tau, ()),
    ]
    return Section("The robot's joints", svg=_three(panels))


def _margins(plan: ExcitationPlan) -> Section:
    bars = []
    for one in sorted(plan.check.margins, key=lambda one: one.relative)[:16]:
        value = f"{significant(one.value, 3)} of {significant(one.limit, 3)} {one.unit} at {one.time:.2f} s"
        bars.append(Bar(one.name, value, float(np.clip(one.relative, 0.0, 1.0)), one.relative >= -1e-6))
    text = "On the whole grid, not only where the plan was made to keep them. A full bar: the limit is far; an empty one: it is reached."
    if plan.binding:
        text += " What binds: " + "; ".join(plan.binding[:5]) + "."
    return Section("Limits", text, bars=tuple(bars))


def _table(plan: ExcitationPlan) -> Section:
    rows = tuple(
        (one.name, f"{one.value:.4g}", f"{one.limit:.4g}", f"{one.margin:.3g}", one.unit)
        for one in plan.check.margins
    )
    return Section("All margins", table=Table(("limit", "worst", "bound", "left", "unit"), rows))

"""The report of an evaluated trajectory: what it will show of the grasp, what it will not, and what the wrist feels."""

from __future__ import annotations

import numpy as np

from factorgrasp import excitation_plots, plots
from factorgrasp.excitation_evaluation import ExcitationEvaluation
from factorgrasp.problems.grasp_words import axis_words
from factorgrasp.report import (
    NBSP,
    Card,
    Report,
    Section,
    Table,
    observability_section,
    quantity,
    significant,
)


def build(result: ExcitationEvaluation) -> Report:
    """The report of an evaluation."""
    sections = [_windows(result), observability_section(result.estimate), _prediction(result)]
    if result.wrench is not None:
        sections.append(_wrench(result))
    if result.motion.joints is not None:
        sections.append(_joints(result))
    return Report("What the motion shows", _sentence(result), _cards(result), tuple(sections))


def _sentence(result: ExcitationEvaluation) -> str:
    turn, way = result.prediction.worst_sd
    seconds = quantity(float(result.motion.t[-1] - result.motion.t[0]), "s", 3)
    if result.prediction.observability.complete:
        return (
            f"After {seconds} of this motion the grasp will be known to {significant(float(np.degrees(turn)))}{NBSP}deg and "
            f"{significant(1e3 * way)}{NBSP}mm (standard deviation of the worst direction). {result.message}".rstrip()
        )
    return result.message


def _cards(result: ExcitationEvaluation) -> tuple[Card, ...]:
    w = result.windows
    turn, way = result.prediction.worst_sd
    k = w.worst
    cards = [
        Card(
            "Smallest eigenvalue",
            f"{significant(float(w.lambda_min[k]), 3)}{NBSP}s⁻³",
            "",
            f"worst of all windows of {w.window:.3g} s, from {w.start[k]:.2f} s; weakest axis {axis_words(w.weakest[k])}",
        ),
        Card(
            "Condition",
            significant(float(np.max(w.condition)), 3),
            "",
            f"worst window; median {np.median(w.condition):.3g}",
        ),
        Card(
            "Rotation",
            f"{significant(float(np.degrees(turn)))}{NBSP}deg",
            "",
            "predicted sd, worst direction",
        ),
        Card("Lever arm", f"{significant(1e3 * way)}{NBSP}mm", "", "predicted sd, worst direction"),
    ]
    if result.wrench_summary is not None:
        s = result.wrench_summary
        cards.append(
            Card(
                "Wrist",
                f"{significant(s.peak_force, 3)}{NBSP}N",
                "",
                f"peak; RMS {s.rms_force:.3g} N; torque {s.peak_torque:.3g} Nm peak",
            )
        )
    return tuple(cards)


def _windows(result: ExcitationEvaluation) -> Section:
    made, axes = plots.figure(7.2, 4.2, rows=2, sharex=True)
    excitation_plots.draw_windows(axes[0], result.windows, result.demands.alpha)
    excitation_plots.draw_index(axes[1], result.motion.t, result.index)
    axes[0].label_outer()
    text = (
        "Noise is taken out, and what an accelerometer bias would explain, too."
        if result.windows.centred
        else "Noise is taken out; the accelerometer counts as free of bias."
    )
    return Section(
        "Does every window excite",
        text,
        svg=plots.to_svg(made, "windows"),
        caption="Above: eigenvalues of the excitation matrix against the middle of the window. Below: zero where angular velocity and "
        "acceleration are parallel.",
    )


def _prediction(result: ExcitationEvaluation) -> Section:
    made, axes = plots.figure(7.2, 2.1, columns=2)
    excitation_plots.draw_prediction(axes[0], result.prediction, 0, result.demands.rotation_sd)
    excitation_plots.draw_prediction(axes[1], result.prediction, 1, result.demands.translation_sd)
    rows = []
    sd = result.prediction.sd
    for k, axis in enumerate("xyz"):
        rows.append((axis, f"{np.degrees(sd[k]):.3g}", f"{1e3 * sd[3 + k]:.3g}"))
    return Section(
        "What will be known of the grasp",
        "The covariance that the grasp estimator is going to state, from its own information matrix: with the sensors' noise, and with "
        "biases and clock offset unknown.",
        svg=plots.to_svg(made, "prediction"),
        caption="Against the time that the motion has run.",
        table=Table(("axis", "rotation about hand axis, sd (deg)", "lever arm, sd (mm)"), tuple(rows)),
    )


def _wrench(result: ExcitationEvaluation) -> Section:
    assert result.wrench is not None
    made, axes = plots.figure(7.2, 3.8, rows=2, sharex=True)
    for part in (0, 1):
        excitation_plots.draw_wrench(axes[part], result.motion.t, result.wrench, part)
    axes[0].label_outer()
    return Section(
        "What the wrist feels",
        f"A wrist of {result.wrist.translation:g} N/m and {result.wrist.rotation:g} Nm/rad that would keep its "
        f"{'first' if result.reference == 'start' else 'mean'} pose.",
        svg=plots.to_svg(made, "wrench"),
        caption="World axes.",
    )


def _joints(result: ExcitationEvaluation) -> Section:
    joints = result.motion.joints
    assert joints is not None
    margins, correlation = joints.margins(), joints.correlation
    header: tuple[str, ...] = (
        "joint",
        "to position limit (rad)",
        "peak speed (rad/s)",
        "of limit",
        "peak acceleration (rad/s²)",
        "peak torque (Nm)",
        "of limit",
    )
    rows = []
    for k, name in enumerate(joints.names):
        m = margins[name]
        speed, torque = joints.velocity_limits[k], joints.torque_limits[k]
        row = [
            name,
            f"{m['position']:.3f}",
            f"{m['peak_velocity']:.3g}",
            f"{100 * m['peak_velocity'] / speed:.0f} %",
            f"{m['peak_acceleration']:.3g}",
            f"{m['peak_torque']:.3g}",
            f"{100 * m['peak_torque'] / torque:.0f} %",
        ]
        if correlation is not None:
            row.append(f"{correlation[k]:.3f}")
        rows.append(tuple(row))
    if correlation is not None:
        header = (*header, "correlation with measured torque")
    shares = {}
    for k, name in enumerate(joints.names):
        for what, peak, limit in (
            ("speed", margins[name]["peak_velocity"], joints.velocity_limits[k]),
            ("torque", margins[name]["peak_torque"], joints.torque_limits[k]),
        ):
            if np.isfinite(limit):
                shares[f"{name} {what}"] = float(peak / limit)
    svg = ""
    if shares:
        made, axes = plots.figure(7.2, 0.4 + 0.2 * len(shares))
        excitation_plots.draw_margins(axes[0], shares)
        svg = plots.to_svg(made, "joints")
    return Section(
        "Joints",
        "Torques are those of the rigid-body model; friction is not in it.",
        svg=svg,
        table=Table(header, tuple(rows)),
    )

"""The report of a grasp pose: where the hand holds, how sure that is, and how well both sides of the grasp agree."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorgrasp import lie, plots
from factorgrasp.atomic import replacing
from factorgrasp.problems.grasp_estimate import GraspDiagnostics, GraspPoseEstimate
from factorgrasp.report import (
    NBSP,
    PM,
    Card,
    Report,
    Section,
    Table,
    observability_section,
    quantity,
    residual_section,
    significant,
)
from factorgrasp.typing import FloatArray

_GYRO_UNIT, _FORCE_UNIT = "mrad/s/√Hz", "mm/s²/√Hz"
# A second peak of the clock search this close to the best one could be the right one.
_AMBIGUOUS = 0.95


def build(estimate: GraspPoseEstimate) -> Report:
    """The report of a grasp pose."""
    inner = estimate.estimate
    sections = [_scene(estimate)]
    if inner.observability is not None:
        sections.append(observability_section(inner))
    sections += [_agreement(estimate.diagnostics), _spectrum(estimate.diagnostics), _data(estimate)]
    if inner.residuals:
        sections.append(residual_section(inner))
    return Report("Where the hand holds", _sentence(estimate), _cards(estimate), tuple(sections))


def plot_grasp(estimate: GraspPoseEstimate, path: Path) -> Path:
    """Draw the grasp, the residuals over time and their spectra into one picture; the suffix of `path` says which format."""
    d = estimate.diagnostics
    made, axes = plots.figure(9.0, 8.0, rows=3, columns=2, height_ratios=(1.7, 1.0, 1.0))
    grid = axes[0].get_gridspec()
    assert grid is not None
    for unused in axes[:2]:
        unused.remove()
    plots.draw_grasp(
        made.add_subplot(grid[0, :]), estimate.rotation, estimate.translation, estimate.covariance[3:, 3:]
    )
    for ax, (title, unit, t, level, declared) in zip(axes[2:4], _levels(d), strict=True):
        plots.draw_over_time(ax, title, unit, t, level, declared, d.window_seconds)
    for ax, (title, unit, frequency, measured, declared_density) in zip(axes[4:], _densities(d), strict=True):
        plots.draw_spectrum(ax, title, unit, frequency, measured, declared_density)
    with replacing(path) as temporary:
        made.savefig(
            temporary, format=path.suffix.lstrip(".") or "png", dpi=150, facecolor=plots.PALETTE["paper"]
        )
    return path


def _sentence(estimate: GraspPoseEstimate) -> str:
    distance = float(np.linalg.norm(estimate.translation))
    angle = float(lie.angle_between(np.eye(3), estimate.rotation))
    rotation, position = _rms_sd(estimate.covariance)
    if not estimate.status.ok:
        return (
            f"The hand is turned against the robot's end-effector by {significant(float(np.degrees(angle)), 4)}° "
            f"{PM}{quantity(rotation, 'rad')}; where it holds is known only in part: {quantity(distance, 'm', 3)} away, "
            f"{PM}{quantity(position, 'm')} in the mean over all directions."
        )
    return (
        f"The hand is {quantity(distance, 'm', 4)} from the robot's end-effector and turned against it by "
        f"{significant(float(np.degrees(angle)), 5)}°. Its position is known to {PM}{quantity(position, 'm')}, "
        f"its orientation to {PM}{quantity(rotation, 'rad')}."
    )


def _rms_sd(covariance: FloatArray) -> tuple[float, float]:
    """Root of the mean variance of rotation (rad) and translation (m)."""
    variances = np.diag(covariance)
    return float(np.sqrt(variances[:3].mean())), float(np.sqrt(variances[3:].mean()))


def _cards(estimate: GraspPoseEstimate) -> tuple[Card, ...]:
    sd = np.sqrt(np.diag(estimate.covariance))
    cards = [
        Card(
            "Position of the hand x, y, z",
            ", ".join(f"{1000.0 * value:.1f}" for value in estimate.translation) + f"{NBSP}mm",
            PM + ", ".join(significant(1000.0 * value) for value in sd[3:]) + f"{NBSP}mm",
            "p_r_h: where the hand's sensor sits, in the end-effector's axes",
        ),
        Card(
            "Orientation of the hand w, x, y, z",
            ", ".join(f"{value:.4f}" for value in estimate.rotation_wxyz),
            PM + ", ".join(significant(float(np.degrees(value))) for value in sd[:3]) + "°",
            "R_r_h as a unit quaternion; its spread about the hand's x, y, z",
        ),
    ]
    if estimate.time_offset_sd > 0.0:
        ahead = "ahead of" if estimate.time_offset >= 0.0 else "behind"
        cards.append(
            Card(
                "Clocks",
                f"{1000.0 * abs(estimate.time_offset):.2f} ms",
                PM + quantity(estimate.time_offset_sd, "s"),
                f"the hand's clock is {ahead} the robot's",
            )
        )
    if np.any(estimate.gyro_bias_sd > 0.0):
        cards.append(
            _bias_card(
                "Gyroscope bias x, y, z", estimate.gyro_bias, estimate.gyro_bias_sd, 180.0 / np.pi, "°/s"
            )
        )
    if np.any(estimate.accelerometer_bias_sd > 0.0):
        cards.append(
            _bias_card(
                "Accelerometer bias x, y, z",
                estimate.accelerometer_bias,
                estimate.accelerometer_bias_sd,
                1000.0,
                "mm/s²",
            )
        )
    return tuple(cards)


def _bias_card(label: str, value: FloatArray, sd: FloatArray, scale: float, unit: str) -> Card:
    digits = max(0, 1 - int(np.floor(np.log10(scale * float(sd.min()))))) if float(sd.min()) > 0.0 else 3
    return Card(
        label,
        ", ".join(f"{scale * v:.{digits}f}" for v in value) + f"{NBSP}{unit}",
        PM + ", ".join(significant(scale * v) for v in sd) + f"{NBSP}{unit}",
        "constant, in the sensor's axes",
    )


def _scene(estimate: GraspPoseEstimate) -> Section:
    drawn, magnification = plots.grasp_scene(
        estimate.rotation, estimate.translation, estimate.covariance[3:, 3:]
    )
    size = "at its true size" if magnification == 1.0 else f"{magnification:g} times enlarged"
    return Section(
        "The grasp",
        svg=plots.to_svg(drawn, "grasp"),
        caption="The dashed path leads from the end-effector to the hand along the end-effector's own axes. "
        f"The ellipsoid holds the hand's position with a probability of 95 %; it is drawn {size}.",
    )


def _levels(d: GraspDiagnostics) -> list[tuple[str, str, FloatArray, FloatArray, float]]:
    """Residual of every window as a mean density, and the declared one: title, unit, times, level, declared."""
    out = []
    for title, unit, residual, measured, declared in (
        ("Angular rates", _GYRO_UNIT, d.gyro_residual, d.gyro_density, d.declared_gyro_density),
        (
            "Specific forces",
            _FORCE_UNIT,
            d.accelerometer_residual,
            d.accelerometer_density,
            d.declared_accelerometer_density,
        ),
    ):
        # Windows and bands hold the same power, so that both pictures can share the unit of the bands.
        scale = _rms(measured) / max(_rms(residual), 1e-300)
        out.append((title, unit, d.t, 1000.0 * scale * residual, 1000.0 * _rms(declared)))
    return out


def _densities(d: GraspDiagnostics) -> list[tuple[str, str, FloatArray, FloatArray, FloatArray]]:
    """Residual density of every band and the declared one: title, unit, frequency, measured, declared."""
    return [
        (
            "Angular rates",
            _GYRO_UNIT,
            d.frequencies,
            1000.0 * d.gyro_density,
            1000.0 * d.declared_gyro_density,
        ),
        (
            "Specific forces",
            _FORCE_UNIT,
            d.frequencies,
            1000.0 * d.accelerometer_density,
            1000.0 * d.declared_accelerometer_density,
        ),
    ]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _agreement(d: GraspDiagnostics) -> Section:
    ratios = [_rms(level) / declared for _, _, _, level, declared in _levels(d)]
    return Section(
        "How well both sides agree",
        "What the hand's sensor read, less what the robot's motion predicts there for this grasp. "
        f"Angular rates differ by {_ratio_words(ratios[0])} what the noise model declares, "
        f"specific forces by {_ratio_words(ratios[1])}. A grasp that slips or a mount that gives way shows as a rise.",
        svg=plots.to_svg(plots.over_time(_levels(d), d.window_seconds), "agreement"),
        caption=f"Every point is a window of {quantity(d.window_seconds, 's')}. Where windows touch a gap, the line breaks.",
    )


def _ratio_words(ratio: float) -> str:
    if 0.8 <= ratio <= 1.25:
        return "just about"
    return f"{significant(ratio)} times"


def _spectrum(d: GraspDiagnostics) -> Section:
    differentiation = (
        f" The robot's poses were differentiated up to {d.kinematics_bandwidth:.3g} Hz."
        if np.isfinite(d.kinematics_bandwidth)
        else ""
    )
    return Section(
        "Noise per frequency",
        f"The relations between both sides are used up to {d.bandwidth:.3g} Hz.{differentiation} "
        "Each frequency is weighted by the noise that was found there, not only by the noise that was declared.",
        svg=plots.to_svg(plots.spectrum(_densities(d)), "spectrum"),
    )


def _data(estimate: GraspPoseEstimate) -> Section:
    d = estimate.diagnostics
    rates = np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(d.rate_moment)[::-1], 0.0)))
    text = (
        f"{d.windows_used} windows of {quantity(d.window_seconds, 's')} were used, {d.windows_dropped} touch a gap and were left out: "
        f"{100.0 * d.samples_used:.1f} % of the time that both sides cover. Nothing was filled in. "
        f"The object turned with {significant(float(rates[0]), 2)}, {significant(float(rates[1]), 2)} and "
        f"{significant(float(rates[2]), 2)} °/s (root mean square) about its three principal axes."
    )
    if estimate.time_offset_sd > 0.0:
        text += f" The two angular rates correlate to {d.clock_correlation:.3f} at the clock offset that was found."
        if d.clock_ambiguity > _AMBIGUOUS:
            text += " Another offset fits nearly as well, because the motion repeats itself; the one nearest to the guess was taken."
    rows = tuple(
        (side, f"{count}", quantity(seconds, "s", 3) if seconds else "none", f"{rows}")
        for side, (count, seconds, rows) in (("robot", d.robot_gaps), ("hand", d.hand_gaps))
    )
    span = float(d.t[0] - 0.5 * d.window_seconds), float(d.t[-1] + 0.5 * d.window_seconds)
    return Section(
        "Use of the data",
        text,
        svg=plots.to_svg(plots.coverage(d.t, d.window_seconds, span), "coverage"),
        caption="Green: used. Red: a window there touches a gap on one of the two sides.",
        table=Table(("side", "gaps", "missing", "incomplete rows"), rows),
    )

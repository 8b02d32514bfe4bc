"""The report of a grasp pose: where the hand holds, how sure that is, and how well both sides of the grasp agree."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import numpy as np

from factorgrasp import lie, plots
from factorgrasp.atomic import replacing
from factorgrasp.grasp_scene import draw_grasp, grasp_scene
from factorgrasp.problems.grasp_estimate import GraspDiagnostics, GraspPoseEstimate
from factorgrasp.problems.grasp_from_poses_estimate import GraspFromPosesEstimate
from factorgrasp.report import (
    NBSP,
    PM,
    Card,
    Report,
    Section,
    Table,
    decimals,
    observability_section,
    quantity,
    residual_section,
    significant,
)
from factorgrasp.typing import FloatArray

AnyGrasp: TypeAlias = GraspPoseEstimate | GraspFromPosesEstimate

_GYRO_UNIT, _FORCE_UNIT = "mrad/s/√Hz", "mm/s²/√Hz"
# A second peak of the clock search this close to the best one could be the right one.
_AMBIGUOUS = 0.95


def build(estimate: GraspPoseEstimate) -> Report:
    """The report of a grasp pose from an IMU on the hand."""
    d = estimate.diagnostics
    middle = (_agreement(d), _spectrum(d), _data(estimate))
    return _report(estimate, (*_pose_cards(estimate), *_clock_card(estimate), *_bias_cards(estimate)), middle)


def build_from_poses(estimate: GraspFromPosesEstimate) -> Report:
    """The report of a grasp pose from poses of the hand."""
    return _report(estimate, (*_pose_cards(estimate), *_clock_card(estimate)), (_pose_agreement(estimate),))


def _report(estimate: AnyGrasp, cards: tuple[Card, ...], middle: tuple[Section, ...]) -> Report:
    inner = estimate.estimate
    sections = [_scene(estimate)]
    if inner.observability is not None:
        sections.append(observability_section(inner))
    sections += middle
    if inner.residuals:
        sections.append(residual_section(inner))
    return Report("Where the hand holds", _sentence(estimate), cards, tuple(sections))


def plot_grasp(estimate: GraspPoseEstimate, path: Path) -> Path:
    """Draw the grasp, the residuals over time and their spectra into one picture; the suffix of `path` says which format."""
    d = estimate.diagnostics
    made, axes = plots.figure(9.0, 8.0, rows=3, columns=2, height_ratios=(1.7, 1.0, 1.0))
    grid = axes[0].get_gridspec()
    assert grid is not None
    for unused in axes[:2]:
        unused.remove()
    draw_grasp(
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


def _sentence(estimate: AnyGrasp) -> str:
    distance = quantity(float(np.linalg.norm(estimate.translation)), "m", 4)
    angle = f"{significant(float(np.degrees(lie.angle_between(np.eye(3), estimate.rotation))), 5)}°"
    if not np.isfinite(estimate.covariance).all():
        return (
            f"The last step had the hand {distance} from the robot's end-effector, turned against it by {angle}; "
            "how sure that is cannot be said."
        )
    rotation, position = (PM + words for words in _rms_sd(estimate.covariance))
    if not estimate.status.ok:
        return (
            f"The hand is turned against the robot's end-effector by {angle} {rotation}; where it holds is known only "
            f"in part: {distance} away, {position} in the mean over all directions."
        )
    return (
        f"The hand is {distance} from the robot's end-effector and turned against it by {angle}. "
        f"Its position is known to {position}, its orientation to {rotation}."
    )


def _rms_sd(covariance: FloatArray) -> tuple[str, str]:
    """Root of the mean variance of rotation and translation, in words."""
    variances = np.diag(covariance)
    return quantity(float(np.sqrt(variances[:3].mean())), "rad"), quantity(
        float(np.sqrt(variances[3:].mean())), "m"
    )


def _pose_cards(estimate: AnyGrasp) -> tuple[Card, ...]:
    sd = np.sqrt(np.diag(estimate.covariance))
    turn = lie.so3_log(estimate.rotation)
    angle = float(np.linalg.norm(turn))
    # Adding zero turns -0.0 into 0.0.
    axis = ", ".join(f"{value:.3f}" for value in np.round(turn / max(angle, 1e-12), 3) + 0.0)
    about = f"a turn by {np.degrees(angle):.4g}° about ({axis})"
    spread = ", ".join(significant(float(np.degrees(value))) for value in sd[:3])
    return (
        _card(
            "Position of the hand x, y, z",
            1000.0 * estimate.translation,
            1000.0 * sd[3:],
            f"{NBSP}mm",
            "p_r_h: where the hand's sensor sits, in the end-effector's axes",
        ),
        Card(
            "Orientation of the hand w, x, y, z",
            ", ".join(f"{value:.5f}" for value in estimate.rotation_wxyz),
            f"{PM}{spread}°" if np.isfinite(sd).all() else "",
            f"R_r_h as a unit quaternion: {about}. Its spread is about the hand's x, y, z",
        ),
    )


def _clock_card(estimate: AnyGrasp) -> tuple[Card, ...]:
    if estimate.time_offset_sd == 0.0:
        return ()
    ahead = "ahead of" if estimate.time_offset >= 0.0 else "behind"
    offset, sd = (
        np.array([1000.0 * value]) for value in (abs(estimate.time_offset), estimate.time_offset_sd)
    )
    return (_card("Clocks", offset, sd, f"{NBSP}ms", f"the hand's clock is {ahead} the robot's"),)


def _bias_cards(estimate: GraspPoseEstimate) -> list[Card]:
    return [
        _card(f"{name} bias x, y, z", scale * bias, scale * sd, unit, "constant, in the sensor's axes")
        for name, bias, sd, scale, unit in (
            ("Gyroscope", estimate.gyro_bias, estimate.gyro_bias_sd, 180.0 / np.pi, "°/s"),
            (
                "Accelerometer",
                estimate.accelerometer_bias,
                estimate.accelerometer_bias_sd,
                1000.0,
                f"{NBSP}mm/s²",
            ),
        )
        if np.any(sd != 0.0)
    ]


def _card(label: str, values: FloatArray, sd: FloatArray, unit: str, note: str) -> Card:
    """Values to the second digit of the smallest standard deviation."""
    digits = decimals(float(sd.min())) if np.isfinite(sd).all() else 3
    return Card(
        label,
        ", ".join(f"{value:.{digits}f}" for value in values) + unit,
        PM + ", ".join(significant(float(value)) for value in sd) + unit if np.isfinite(sd).all() else "",
        note,
    )


def _scene(estimate: AnyGrasp) -> Section:
    picture, drawn = grasp_scene(estimate.rotation, estimate.translation, estimate.covariance[3:, 3:])
    caption = "The dashed path leads from the end-effector to the hand along the end-effector's own axes."
    if drawn.magnification > 0.0:
        size = "at its true size" if drawn.magnification == 1.0 else f"{drawn.magnification:g} times enlarged"
        exceeds = ", and exceeds the picture" if drawn.exceeds else ""
        caption += f" The ellipsoid holds the hand's position with a probability of 95 %; it is drawn {size}{exceeds}."
    return Section("The grasp", svg=plots.to_svg(picture, "grasp"), caption=caption)


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


def _pose_agreement(estimate: GraspFromPosesEstimate) -> Section:
    d = estimate.diagnostics
    declared = np.sqrt(np.diag(d.noise_covariance))
    order = np.argsort(d.t)
    t, turn, shift = d.t[order], np.degrees(d.rotation_residual[order]), 1000.0 * d.position_residual[order]
    panels = [
        ("Rotation", "°", t, np.abs(turn), float(np.degrees(_rms(declared[:3])))),
        ("Position", "mm", t, np.abs(shift), 1000.0 * _rms(declared[3:])),
    ]
    return Section(
        "How well both sides agree",
        f"{d.samples_used} samples of the {d.sampled} side were compared, {d.samples_dropped} lie beside a gap or outside of the other "
        f"recording and were left out. Both sides differ by {quantity(d.rotation_rms, 'rad')} and {quantity(d.position_rms, 'm')} "
        "(root mean square).",
        svg=plots.to_svg(plots.over_time(panels, 5.0 * float(np.median(np.diff(t)))), "agreement"),
        caption="Size of the difference along each axis of the hand (root mean square in short stretches of time), against the standard "
        "deviation with which it was weighted.",
    )

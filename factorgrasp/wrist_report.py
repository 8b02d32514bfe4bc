"""The report of a wrist recording: ranges of motion, angles, the way of the wrist, and which blob was which marker when."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from factorgrasp import plots
from factorgrasp.report import PM, Card, Report, Section, Table, quantity, residual_section, significant
from factorgrasp.typing import FloatArray
from factorgrasp.wrist_result import WristResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ANGLE_TITLES = (
    ("Flexion (+) and extension (-)", "y"),
    ("Ulnar (+) and radial (-) deviation", "z"),
    ("Pronation (+) and supination (-)", "x"),
)
MARKER_COLOURS = ("#1b2430", "#c2473d", "#b8791a", "#2c8a57", "#2d69c4", "#7a4fa3", "#138086", "#667282")
_MOST_BLOBS = 2500
_TWO_SIDED = 1.96


def build(result: WristResult) -> Report:
    """The report of a tracked recording."""
    title = "Wrist pose"
    if result.track.lost.all():
        return Report(title, result.message, _cards(result), (_image_section(result),))
    sections = [
        _angles_section(result),
        _range_section(result),
        _position_section(result),
        *_movement_section(result),
        _association_section(result),
        _image_section(result),
        _layout_section(result),
    ]
    if result.warnings:
        sections.insert(0, _warning_section(result))
    if result.estimate.residuals:
        sections.append(residual_section(result.estimate))
    return Report(title, _sentence(result), _cards(result), tuple(sections))


def _sentence(result: WristResult) -> str:
    if not result.status.ok:
        return result.message[:1].upper() + result.message[1:] + "."
    ranges = result.measures.range_of_motion
    if not ranges:
        return "The hand was tracked, for too short a time to measure its motion."
    widest = max(ranges, key=lambda one: one.range.value)
    words = widest.axis.replace("_", "/", 1).replace("_", " ")
    moves = len(result.measures.movements)
    out = f"The largest range of motion is that of {words}: {_degrees(widest.range.value, widest.range.sd)}"
    return out + (f"; the wrist moved {moves} times from rest to rest." if moves > 1 else ".")


def _degrees(value: float, sd: float) -> str:
    return f"{np.degrees(value):.1f}° {PM}{np.degrees(sd):.1f}°"


def _cards(result: WristResult) -> tuple[Card, ...]:
    track = result.track
    lost = int(track.lost.sum())
    cards = [
        Card(
            "Recording",
            f"{quantity(float(track.t[-1] - track.t[0]), 's', 3)}, {len(track)} frames",
            "",
            f"{lost} frames without the hand" if lost else "the hand in every frame",
        ),
        Card(
            "Markers",
            f"{result.markers_seen.mean():.1f} of {len(track.markers)} a frame",
            "",
            f"{result.solved.clutter:.2f} other blobs a frame",
        ),
    ]
    for one in result.measures.range_of_motion:
        words = one.axis.replace("_", "/", 1).replace("_", " ")
        note = f"{one.cycles} cycles" if one.cycles > 1 else (one.words or "one cycle")
        cards.append(
            Card(
                words[:1].upper() + words[1:],
                f"{np.degrees(one.range.value):.1f}°",
                f"{PM}{np.degrees(one.range.sd):.1f}°",
                note,
            )
        )
    return tuple(cards)


def _warning_section(result: WristResult) -> Section:
    return Section(
        "What to know",
        table=Table(("remark",), tuple((words[:1].upper() + words[1:],) for words in result.warnings)),
    )


def _angles_section(result: WristResult) -> Section:
    return Section(
        "Angles",
        "Against the start posture, in the order of the joint coordinate system of the International Society of Biomechanics.",
        svg=plots.to_svg(angle_figure(result), "angles"),
        caption="The band holds the angle with a probability of 95 % in every frame. Grey: no marker was seen there.",
    )


@plots.styled
def angle_figure(result: WristResult) -> Figure:
    """The three angles over time with 95 % bands (deg)."""
    made, axes = plots.figure(7.2, 5.0, rows=3, sharex=True)
    for i, (ax, (title, axis)) in enumerate(zip(axes, ANGLE_TITLES, strict=True)):
        values = np.degrees(result.measures.angles[:, i])
        spread = np.degrees(result.measures.angles_sd[:, i])
        _line(ax, result, values, spread, plots.PALETTE[axis])
        ax.set_title(title)
        ax.set_ylabel("deg")
        _shade_gaps(ax, result)
        ax.label_outer()
    axes[-1].set_xlabel("time (s)")
    return made


def _line(
    ax: Axes, result: WristResult, values: FloatArray, sd: FloatArray, colour: str, label: str = ""
) -> None:
    hidden = result.track.lost
    values, sd = np.where(hidden, np.nan, values), np.where(hidden, np.nan, sd)
    ax.fill_between(
        result.track.t,
        values - _TWO_SIDED * sd,
        values + _TWO_SIDED * sd,
        color=colour,
        alpha=0.25,
        linewidth=0.0,
    )
    ax.plot(result.track.t, values, color=colour, label=label or None)


def _shade_gaps(ax: Axes, result: WristResult) -> None:
    for gap in result.track.gaps:
        if gap.frames > 2:
            ax.axvspan(
                gap.start,
                gap.end,
                color=plots.PALETTE["muted"],
                alpha=0.25 if gap.lost else 0.12,
                linewidth=0.0,
            )


def _range_section(result: WristResult) -> Section:
    rows = []
    for one in result.measures.range_of_motion:
        low, high = np.degrees(one.range.interval)
        up, down = (words.replace("_", " ") for words in one.directions)
        rows.append(
            (
                one.axis.replace("_", "/", 1).replace("_", " "),
                f"{np.degrees(one.range.value):.1f}",
                f"{low:.1f} to {high:.1f}",
                f"{up} {np.degrees(one.maximum.value):.1f}",
                f"{down} {np.degrees(-one.minimum.value):.1f}",
                f"{one.cycles}",
                "" if np.isnan(one.cycle_sd) else f"{np.degrees(one.cycle_sd):.1f}",
                f"{np.degrees(one.largest.value):.1f} {PM}{np.degrees(one.largest.sd):.1f}",
            )
        )
    return Section(
        "Ranges of motion",
        "Mean of the extremes of the cycles, each of them fitted to the smoothed angle.",
        table=Table(
            (
                "axis",
                "range (deg)",
                "95 % interval",
                "one way",
                "other way",
                "cycles",
                "between cycles",
                "largest (deg)",
            ),
            tuple(rows),
        ),
    )


@plots.styled
def _position_section(result: WristResult) -> Section:
    made, axes = plots.figure(7.2, 3.6, rows=2, sharex=True)
    track = result.track
    sd = np.sqrt(np.einsum("nii->ni", track.covariance)[:, 3:])
    for k, axis in enumerate(plots.AXES):
        _line(axes[0], result, 1e3 * track.position[:, k], 1e3 * sd[:, k], plots.PALETTE[axis], axis)
    speed = np.where(track.lost, np.nan, np.linalg.norm(track.velocity, axis=1))
    axes[1].plot(track.t, speed, color=plots.PALETTE["accent"])
    axes[0].set_title("Position of the wrist's marker")
    axes[0].set_ylabel("mm")
    axes[0].legend(ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
    axes[1].set_title("Speed")
    axes[1].set_ylabel("m/s")
    axes[1].set_xlabel("time (s)")
    for ax in axes:
        _shade_gaps(ax, result)
        ax.label_outer()
    return Section(
        "Position",
        "In the start frame: x from the wrist to the middle finger, z out of the back of the hand.",
        svg=plots.to_svg(made, "position"),
        caption="Bands as above.",
    )


def _movement_section(result: WristResult) -> list[Section]:
    rows = []
    for move in result.measures.movements:
        rows.append(
            (
                f"{move.start:.2f} to {move.end:.2f} s",
                *(
                    f"{scale * m.value:.{digits}f} {PM}{significant(scale * m.sd)}"
                    for m, scale, digits in (
                        (move.distance, 1e3, 1),
                        (move.path_length, 1e3, 1),
                        (move.straightness, 1.0, 3),
                        (move.peak_speed, 1.0, 3),
                        (move.sparc, 1.0, 2),
                    )
                ),
                "hidden by noise"
                if np.isnan(move.ldlj.value)
                else f"{move.ldlj.value:.2f} {PM}{significant(move.ldlj.sd)}",
            )
        )
    if not rows:
        return []
    return [
        Section(
            "Movements",
            "Ways of 50 mm and more from rest to rest. SPARC and LDLJ measure smoothness; nearer to zero is smoother.",
            table=Table(
                ("when", "distance (mm)", "way (mm)", "straightness", "peak speed (m/s)", "SPARC", "LDLJ"),
                tuple(rows),
            ),
        )
    ]


@plots.styled
def _association_section(result: WristResult) -> Section:
    track, blobs = result.track, result.blobs
    names = track.markers.names
    made, axes = plots.figure(
        7.2, 0.9 + 0.24 * (len(names) + 3), rows=2, sharex=True, height_ratios=(len(names), 3)
    )
    for j in range(len(names)):
        frames = blobs.frame[track.association == j + 1]
        axes[0].plot(
            track.t[frames],
            np.full(frames.size, j),
            "|",
            color=MARKER_COLOURS[j % 8],
            markersize=7.0,
            markeredgewidth=0.8,
        )
    axes[0].set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    axes[0].set_ylim(len(names) - 0.4, -0.6)
    axes[0].grid(False)
    clutter = np.bincount(blobs.frame[track.association == 0], minlength=len(blobs))
    axes[1].bar(
        track.t, clutter, width=np.median(np.diff(track.t)), color=plots.PALETTE["muted"], linewidth=0.0
    )
    axes[1].set_ylabel("others")
    axes[1].set_xlabel("time (s)")
    for ax in axes:
        _shade_gaps(ax, result)
        ax.label_outer()
    text = (
        f"A marker is missed {100.0 * (1.0 - result.solved.detection):.1f} % of the time; "
        f"{result.solved.clutter:.2f} blobs a frame belong to none."
    )
    gaps = [gap for gap in track.gaps if gap.frames > 2]
    rows = tuple(
        (
            f"{gap.start:.2f} to {gap.end:.2f} s",
            f"{gap.frames}",
            "lost" if gap.lost else "bridged",
            "never" if gap.found is None else f"{gap.found:.2f} s",
        )
        for gap in gaps
    )
    return Section(
        "Which blob was which marker",
        text,
        svg=plots.to_svg(made, "association"),
        caption="One stroke for each frame in which a marker was seen, and the number of blobs that were none.",
        table=Table(("gap", "frames", "track", "found again"), rows) if rows else None,
    )


@plots.styled
def _image_section(result: WristResult) -> Section:
    track, blobs, camera = result.track, result.blobs, result.camera
    made, (ax,) = plots.figure(5.2, 5.2 * camera.height / camera.width + 0.3)
    which = np.arange(blobs.frame.size)
    if which.size > _MOST_BLOBS:
        which = which[:: int(np.ceil(which.size / _MOST_BLOBS))]
    for j in range(len(track.markers) + 1):
        uv = blobs.uv[which[track.association[which] == j]]
        colour = plots.PALETTE["line"] if j == 0 else MARKER_COLOURS[(j - 1) % 8]
        ax.plot(uv[:, 0], uv[:, 1], ".", color=colour, markersize=2.5, zorder=1 if j == 0 else 2)
    good = np.flatnonzero(~track.lost)
    if good.size:
        T = track.markers.points @ track.camera_rotation[good[0]].T + track.camera_position[good[0]]
        uv = camera.project(T)
        for j in range(1, len(uv)):
            ax.plot(uv[[0, j], 0], uv[[0, j], 1], color=plots.PALETTE["ink"], linewidth=1.0, zorder=3)
    ax.set_xlim(0, camera.width)
    ax.set_ylim(camera.height, 0)
    ax.set_aspect("equal")
    ax.grid(False)
    for side in ("top", "right"):
        ax.spines[side].set_visible(True)
    return Section(
        "In the image",
        svg=plots.to_svg(made, "image"),
        caption="All blobs, coloured by marker, grey where they are none; the lines join the wrist to the other markers at the start (px).",
    )


def _layout_section(result: WristResult) -> Section:
    layout = result.track.markers
    rows = tuple(
        (
            name.replace("_", " "),
            *(f"{1e3 * x:.1f} {PM}{significant(1e3 * s)}" for x, s in zip(point, sd, strict=True)),
        )
        for name, point, sd in zip(layout.names, layout.points, layout.sd, strict=True)
    )
    start = result.track.camera_pose
    where = f" The hand's start frame is {quantity(float(np.linalg.norm(start.position)), 'm', 3)} from the camera."
    return Section(
        "Markers on the hand",
        "As they were used, in the wrist's frame." + (where if np.isfinite(start.position).all() else ""),
        table=Table(("marker", "x (mm)", "y (mm)", "z (mm)"), rows),
    )

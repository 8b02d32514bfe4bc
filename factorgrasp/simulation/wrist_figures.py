"""Figures 3 to 6 of Cordella et al. 2014 from the scenarios, with the truth that the paper lacks, beside the paper's own filter.

``python -m factorgrasp.simulation.wrist_figures docs`` writes the figures into ``docs/figures`` and renews the table in
``docs/wrist-pose.md``.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp import plots
from factorgrasp.atomic import write_text
from factorgrasp.baselines.cordella2014 import UkfSettings, UkfTrack, WristUkf
from factorgrasp.errors import InputError
from factorgrasp.kinematics import isb_angles, range_of_motion, wrist_angles
from factorgrasp.lie import angle_between
from factorgrasp.simulation.wrist import WristRecording, cordella2014
from factorgrasp.typing import FloatArray
from factorgrasp.wrist_result import WristResult
from factorgrasp.wrist_task import WristTask

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAGE = "wrist-pose.md"
PLANES = (("XY", 0, 1), ("ZX", 0, 2), ("ZY", 1, 2))
"""The paper's views: name, axis to the right, axis upwards."""
SMOOTHED, DEPTH, PIXELS = "factorgrasp, smoothed", "paper's filter with depth", "paper's filter, pixels only"
COLOURS = {SMOOTHED: plots.PALETTE["z"], DEPTH: plots.PALETTE["accent"], PIXELS: plots.PALETTE["x"]}
TRUTH = plots.PALETTE["ink"]


@dataclass(frozen=True, eq=False)
class Run:
    """One recording with what three estimators made of it.

    Attributes
    ----------
    recording : WristRecording
    result : WristResult
        Smoothed.
    filters : mapping of str to UkfTrack
        The paper's filter on the manifold, with depth and with image points only.
    """

    recording: WristRecording
    result: WristResult
    filters: dict[str, UkfTrack]

    def errors(self) -> dict[str, tuple[float, float]]:
        """RMS error of orientation (rad) and position (m) by estimator."""
        truth, track = self.recording.truth, self.result.track
        poses = {SMOOTHED: (track.rotation, track.position)}
        poses |= {name: (one.rotation, one.position) for name, one in self.filters.items()}
        return {
            name: (
                float(np.sqrt(np.mean(angle_between(R, truth.rotation) ** 2))),
                float(np.sqrt(np.mean(np.sum((p - truth.position) ** 2, axis=1)))),
            )
            for name, (R, p) in poses.items()
        }


def run(motion: str, seed: int = 0) -> Run:
    """Simulate and estimate the nominal conditions of one motion."""
    recording = cordella2014(seed, motion=motion)  # type: ignore[arg-type]
    result = WristTask(recording.camera, recording.blobs, recording.layout, hand="right").solve()
    filters = {
        name: WristUkf(
            recording.camera,
            recording.layout,
            result.track.camera_pose,
            settings=UkfSettings(depth=depth),
        ).run(recording.blobs)
        for name, depth in ((DEPTH, True), (PIXELS, False))
    }
    return Run(recording, result, filters)


@plots.styled
def draw_orientation(one: Run) -> Figure:
    """Fig. 3: the axes of the wrist frame in three views, every third frame."""
    made, axes = plots.figure(9.0, 6.4, 2, 3)
    rows = ((SMOOTHED, one.result.track.rotation), (PIXELS, one.filters[PIXELS].rotation))
    for row, (name, R) in enumerate(rows):
        for column, (plane, right, up) in enumerate(PLANES):
            ax = axes[3 * row + column]
            _fan(ax, R[::3], right, up)
            ax.set_title(f"{name}, {plane}" if column == 0 else plane)
    return made


def _fan(ax: Axes, R: FloatArray, right: int, up: int) -> None:
    for k, axis in enumerate(plots.AXES):
        for tip in R[:, :, k]:
            ax.plot([0.0, tip[right]], [0.0, tip[up]], color=plots.PALETTE[axis], linewidth=0.5, alpha=0.4)
        ax.plot([], [], color=plots.PALETTE[axis], label=axis)
    ax.set(
        xlim=(-1.15, 1.15),
        ylim=(-1.15, 1.15),
        aspect="equal",
        xlabel=plots.AXES[right],
        ylabel=plots.AXES[up],
    )
    ax.grid(False)


@plots.styled
def draw_angles(one: Run) -> Figure:
    """Fig. 4: the angles during abduction and adduction."""
    made, axes = plots.figure(9.0, 6.2, 3, 1, sharex=True)
    truth = one.recording.truth
    assert truth.angles is not None
    t = truth.t
    mine, sd = one.result.measures.angles, np.degrees(one.result.measures.angles_sd)
    true = isb_angles(truth.rotation)
    titles = ("Ulnar (+) and radial (-) deviation", "Flexion (+)", "Pronation (+)")
    for ax, k, title in zip(axes, (1, 0, 2), titles, strict=True):
        for name in (PIXELS, DEPTH):
            found = np.degrees(isb_angles(one.filters[name].rotation))
            ax.plot(t, found[:, k], color=COLOURS[name], linewidth=0.8, label=name)
        values = np.degrees(mine[:, k])
        ax.fill_between(
            t,
            values - 1.96 * sd[:, k],
            values + 1.96 * sd[:, k],
            color=COLOURS[SMOOTHED],
            alpha=0.25,
            linewidth=0.0,
        )
        ax.plot(t, values, color=COLOURS[SMOOTHED], label=SMOOTHED)
        ax.plot(t, np.degrees(true[:, k]), color=TRUTH, linewidth=0.9, linestyle=(0, (3, 2)), label="truth")
        ax.set_title(title)
        ax.set_ylabel("deg")
        ax.set_ylim(-38.0, 38.0)
    found_range = one.result.measures.range_of_motion[1].range
    axes[0].set_title(
        f"{titles[0]}: range {np.degrees(found_range.value):.1f} ± {np.degrees(found_range.sd):.1f} deg"
    )
    axes[1].legend(ncols=4, loc="lower right", fontsize=8.0)
    axes[-1].set_xlabel("time (s)")
    return made


@plots.styled
def draw_way(one: Run) -> Figure:
    """Fig. 5: the way of the wrist while it reaches, in three views."""
    made, axes = plots.figure(9.0, 3.3, 1, 3)
    ways = {
        PIXELS: one.filters[PIXELS].position,
        DEPTH: one.filters[DEPTH].position,
        SMOOTHED: one.result.track.position,
    }
    frames = one.recording.truth.t < 2.8
    for ax, (plane, right, up) in zip(axes, PLANES, strict=True):
        for name, way in ways.items():
            ax.plot(
                1e3 * way[frames, right],
                1e3 * way[frames, up],
                color=COLOURS[name],
                linewidth=1.0,
                label=name,
            )
        way = one.recording.truth.position
        ax.plot(
            1e3 * way[frames, right],
            1e3 * way[frames, up],
            color=TRUTH,
            linewidth=0.9,
            linestyle=(0, (3, 2)),
            label="truth",
        )
        ax.set_title(plane)
        ax.set(xlabel=f"{plots.AXES[right]} (mm)", ylabel=f"{plots.AXES[up]} (mm)")
        ax.set_aspect("equal", adjustable="datalim")
    axes[1].legend(loc="upper center", fontsize=7.0)
    return made


@plots.styled
def draw_velocity(one: Run) -> Figure:
    """Fig. 6: the speed of the wrist while it reaches and comes back."""
    made, (ax,) = plots.figure(9.0, 3.2)
    truth, track = one.recording.truth, one.result.track
    shown = truth.t < 5.5
    frame = np.arange(truth.t.size)[shown]
    for name in (PIXELS, DEPTH):
        speed = np.linalg.norm(one.filters[name].velocity, axis=1)
        ax.plot(frame, speed[shown], color=COLOURS[name], linewidth=0.8, label=name)
    speed = np.linalg.norm(track.velocity, axis=1)
    along = track.velocity / np.maximum(speed, 1e-6)[:, None]
    sd = np.sqrt(np.einsum("ni,nij,nj->n", along, track.velocity_covariance[:, 3:, 3:], along))
    ax.fill_between(
        frame,
        (speed - 1.96 * sd)[shown],
        (speed + 1.96 * sd)[shown],
        color=COLOURS[SMOOTHED],
        alpha=0.25,
        linewidth=0.0,
    )
    ax.plot(frame, speed[shown], color=COLOURS[SMOOTHED], label=SMOOTHED)
    true = np.linalg.norm(truth.velocity, axis=1)
    ax.plot(frame, true[shown], color=TRUTH, linewidth=0.9, linestyle=(0, (3, 2)), label="truth")
    ax.set(xlabel="frame", ylabel="m/s", ylim=(0.0, None))
    ax.set_title("Speed of the wrist, there and back")
    ax.legend(loc="upper center", ncols=2, fontsize=8.0)
    return made


def table(runs: dict[str, Run]) -> str:
    """RMS errors and ranges of motion as a Markdown table."""
    names = (SMOOTHED, DEPTH, PIXELS)
    lines = [
        "| motion | " + " | ".join(f"{name} (deg / mm)" for name in names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for motion, one in runs.items():
        errors = one.errors()
        cells = [f"{np.degrees(errors[name][0]):.2f} / {1e3 * errors[name][1]:.1f}" for name in names]
        lines.append(f"| {motion} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def ranges(runs: dict[str, Run]) -> str:
    """Ranges of motion with their intervals beside the truth."""
    lines = ["| motion | axis | true range (deg) | measured | 95 % interval |", "|---|---|---|---|---|"]
    for motion, one in runs.items():
        truth = one.recording.truth
        angles = wrist_angles(truth.rotation)
        for k, found in enumerate(one.result.measures.range_of_motion):
            exact = np.full(truth.t.size, 1e-6)
            true = range_of_motion(truth.t, angles[:, k], exact, np.tile(angles[:, k], (3, 1))).range.value
            if true < np.radians(20.0):
                continue
            low, high = np.degrees(found.range.interval)
            lines.append(
                f"| {motion} | {found.axis.replace('_', '/', 1).replace('_', ' ')} | {np.degrees(true):.1f} | "
                f"{np.degrees(found.range.value):.1f} | {low:.1f} to {high:.1f} |"
            )
    return "\n".join(lines) + "\n"


def write(folder: Path, seed: int = 0) -> list[Path]:
    """Draw the figures into ``folder/figures`` and renew the tables between ``<!-- name -->`` and ``<!-- end -->`` in the page.

    Raises
    ------
    InputError
        When the page has no place for a table.
    """
    runs = {motion: run(motion, seed) for motion in ("abduction", "three_axes", "reach")}
    figures = folder / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    out = []
    for name, made in (
        ("wrist_fig3", draw_orientation(runs["abduction"])),
        ("wrist_fig4", draw_angles(runs["abduction"])),
        ("wrist_fig5", draw_way(runs["reach"])),
        ("wrist_fig6", draw_velocity(runs["reach"])),
    ):
        out.append(figures / f"{name}.png")
        made.savefig(out[-1], dpi=110)
    page = folder / PAGE
    text = page.read_text(encoding="utf-8")
    for name, content in (("errors", table(runs)), ("ranges", ranges(runs))):
        place = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not place.search(text):
            raise InputError(str(page), f"a place for {name}: <!-- {name} --> ... <!-- end -->", "none")
        text = place.sub(lambda match, content=content: match[1] + content + match[2], text)  # type: ignore[misc]
    write_text(page, text)
    return [*out, page]


def main(arguments: Sequence[str] | None = None) -> None:
    """Write everything; prints the paths."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", default=Path("docs"))
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    for path in write(chosen.folder, chosen.seed):
        print(path)


if __name__ == "__main__":
    main()

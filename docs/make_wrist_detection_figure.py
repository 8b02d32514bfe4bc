"""Draw the picture of docs/wrist-detection.md: a rendered frame, its depth, and what the detector says of the markers.

python docs/make_wrist_detection_figure.py [--out docs/figures/wrist_detection.png] [--seed 2]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp import plots
from factorgrasp.models.markers import PALM_POINTS
from factorgrasp.simulation.hand_motion import XTION, swinging_hand
from factorgrasp.simulation.hand_rendering import RenderedFrame
from factorgrasp.simulation.hand_scene import HandScene, Hidden
from factorgrasp.vision import BlobDetector, DetectedBlobs, propose_colour

COLOURS = {"whole": "#ffd23f", "hidden": "#ff5d5d", "split": "#5dff9b"}
HALF = 12


def draw_image(axes: Any, frame: RenderedFrame, blobs: DetectedBlobs) -> None:
    """The whole image with a ring about every blob."""
    axes.imshow(frame.rgb)
    for uv, kind, z in zip(blobs.uv, blobs.kind, blobs.depth, strict=True):
        axes.plot(
            *uv,
            "o",
            markersize=11,
            markerfacecolor="none",
            markeredgecolor=COLOURS[kind],
            markeredgewidth=1.3,
        )
        axes.annotate(
            f"{1e3 * z:.0f}" if np.isfinite(z) else "no depth",
            uv,
            (7, 6),
            textcoords="offset points",
            color="white",
            fontsize=7,
        )
    axes.set_title("colour, with the blobs and their depths [mm]")


def draw_depth(axes: Any, frame: RenderedFrame) -> None:
    """Depth as the simulated sensor reads it; black is missing."""
    depth = np.where(frame.depth > 0.0, frame.depth, np.nan)
    axes.set_facecolor("black")
    low, high = np.nanquantile(depth, [0.002, 0.998])
    axes.imshow(depth, cmap="viridis_r", vmin=low, vmax=high)
    axes.set_title("depth (black: missing)")


def draw_marker(axes: Any, frame: RenderedFrame, blobs: DetectedBlobs, marker: int, words: str) -> None:
    """One marker, enlarged: truth (cross), detection (point) and three standard deviations."""
    i = int(np.argmin(np.linalg.norm(blobs.uv - frame.uv[marker], axis=1)))
    axes.imshow(frame.rgb, interpolation="nearest")
    middle = np.rint(frame.uv[marker])
    axes.set(xlim=(middle[0] - HALF, middle[0] + HALF), ylim=(middle[1] + HALF, middle[1] - HALF))
    turn = np.linspace(0.0, 2.0 * np.pi, 60)
    circle = np.linalg.cholesky(blobs.covariance_uv[i]) @ np.array([np.cos(turn), np.sin(turn)])
    axes.plot(*(blobs.uv[i][:, None] + 3.0 * circle), color=COLOURS[blobs.kind[i]], linewidth=1.0)
    axes.plot(*blobs.uv[i], ".", color=COLOURS[blobs.kind[i]], markersize=4)
    axes.plot(*frame.uv[marker], "+", color="white", markersize=8, markeredgewidth=0.8)
    error = float(np.linalg.norm(blobs.uv[i] - frame.uv[marker]))
    axes.set_title(f"{words}: {error:.2f} px off", fontsize=8)


@plots.styled
def draw(path: Path, seed: int) -> None:
    """All panels, from one frame."""
    layout = np.array(PALM_POINTS)
    layout[4] = layout[5] + [0.005, 0.0085, 0.002]
    scene = HandScene(hidden=(Hidden(1, 0.5, angle=2.2),))
    frame = swinging_hand(1, scene, seed, layout=layout).frame(0)
    blobs = BlobDetector(propose_colour(frame.rgb, frame.depth), camera=XTION).detect(frame.rgb, frame.depth)
    made, panels = plots.figure(10.5, 6.6, 2, 6)
    grid: Any = panels[0].get_gridspec()
    for panel in panels:
        panel.remove()
    wide = [made.add_subplot(grid[0, :3]), made.add_subplot(grid[0, 3:])]
    small = [made.add_subplot(grid[1, 2 * k : 2 * k + 2]) for k in range(3)]
    draw_image(wide[0], frame, blobs)
    draw_depth(wide[1], frame)
    middle = frame.uv.mean(axis=0)
    for panel in wide:
        panel.set(xlim=(middle[0] - 180, middle[0] + 110), ylim=(middle[1] + 90, middle[1] - 90))
    for panel, marker, words in zip(
        small, (2, 1, 5), ("whole", "half hidden by a finger", "overlapping another"), strict=True
    ):
        draw_marker(panel, frame, blobs, marker, words)
    for panel in (*wide, *small):
        panel.set(xticks=[], yticks=[])
        panel.grid(False)
        for spine in panel.spines.values():
            spine.set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    made.savefig(path, dpi=110)
    print(f"{len(blobs)} blobs: {', '.join(blobs.kind)}; left out: {dict(blobs.rejected)}")
    away = np.linalg.norm(blobs.uv[:, None] - frame.uv[None], axis=2).min(axis=0)
    print("distance of each marker to its blob [px]: " + ", ".join(f"{value:.2f}" for value in away))


def main(arguments: list[str] | None = None) -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "figures" / "wrist_detection.png")
    parser.add_argument("--seed", type=int, default=2)
    chosen = parser.parse_args(arguments)
    draw(chosen.out, chosen.seed)


if __name__ == "__main__":
    main()

"""Pictures of an excitation: every window's eigenvalues, the pointwise index, predicted sd, wrist wrench, distance to limits.

Each function draws into axes that the caller made, so that reports, documents and the closed loop share them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp import plots
from factorgrasp.excitation_measures import WindowMeasures
from factorgrasp.excitation_prediction import GraspPrediction
from factorgrasp.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_POINTS = 800
_COLOURS = ("x", "y", "z")


@plots.styled
def draw_windows(ax: Axes, windows: WindowMeasures, alpha: float | None = None) -> None:
    """The three eigenvalues of the excitation matrix against the middle of their window, with the level `alpha` that is asked for."""
    every = _every(windows.start.size)
    middle = windows.start[every] + 0.5 * windows.window
    top = max(float(np.max(windows.eigenvalues)), 1e-12)
    shown = np.maximum(windows.eigenvalues[every], 1e-6 * top)
    for k, (label, colour) in enumerate(
        zip(("smallest", "middle", "largest"), ("x", "accent", "z"), strict=True)
    ):
        ax.plot(middle, shown[:, k], color=plots.PALETTE[colour], label=label)
    if alpha is not None:
        ax.axhline(
            alpha,
            color=plots.PALETTE["muted"],
            linestyle=(0, (4, 3)),
            linewidth=1.0,
            label="asked for (alpha)",
        )
    ax.set_yscale("log")
    _dress(ax, f"Excitation over every window of {windows.window:.3g} s", "eigenvalue (s⁻³)")
    _legend(ax)


@plots.styled
def draw_index(ax: Axes, t: FloatArray, index: FloatArray) -> None:
    """``|w x al|`` over time: where it is zero the motion turns about one axis at that instant."""
    every = _every(t.size)
    ax.fill_between(t[every], 0.0, index[every], color=plots.PALETTE["z"], alpha=0.35, linewidth=0.0)
    ax.set_ylim(bottom=0.0)
    _dress(ax, "Excitation at every instant, |w × α|", "s⁻³")


@plots.styled
def draw_prediction(
    ax: Axes, prediction: GraspPrediction, part: int, limit: float | None = None, scale: float = 1.0
) -> None:
    """Standard deviation of the worst direction against the time spent: rotation (part 0, deg) or lever arm (part 1, mm)."""
    unit, factor = (("deg", 180.0 / np.pi), ("mm", 1e3))[part]
    values = factor * scale * prediction.worst_sd_over_time[:, part]
    ax.plot(prediction.t, values, color=plots.PALETTE["z"], label="predicted")
    if limit is not None:
        ax.axhline(
            factor * limit,
            color=plots.PALETTE["muted"],
            linestyle=(0, (4, 3)),
            linewidth=1.0,
            label="asked for",
        )
        _legend(ax)
    ax.set_yscale("log")
    _dress(ax, ("Rotation", "Lever arm")[part] + ", sd of the worst direction", unit)


@plots.styled
def draw_wrench(ax: Axes, t: FloatArray, wrench: FloatArray, part: int, title: str = "") -> None:
    """Force (part 0, N) or torque (part 1, Nm) of a wrench (n, 6) over time, in its three components."""
    every = _every(t.size)
    for k, name in enumerate(_COLOURS):
        ax.plot(t[every], wrench[every, 3 * part + k], color=plots.PALETTE[name], label=name)
    _dress(ax, title or ("Force at the wrist", "Torque at the wrist")[part], ("N", "Nm")[part])
    _legend(ax)


@plots.styled
def draw_margins(
    ax: Axes, used: Mapping[str, float], title: str = "Share of the limits that is used"
) -> None:
    """Bars of the share (1: at the limit) that a motion uses of every limit, by name."""
    names = list(used)
    values = np.array([used[name] for name in names])
    colours = [plots.PALETTE["x" if value > 1.0 else "y"] for value in values]
    ax.barh(np.arange(len(names)), 100.0 * values, color=colours, height=0.65)
    ax.axvline(100.0, color=plots.PALETTE["muted"], linewidth=1.0, linestyle=(0, (4, 3)))
    ax.set_yticks(np.arange(len(names)), names)
    ax.invert_yaxis()
    ax.grid(False)
    ax.set_title(title)
    ax.set_xlabel("%")


def _every(count: int) -> slice:
    return slice(None, None, max(1, count // _MOST_POINTS))


def _dress(ax: Axes, title: str, unit: str) -> None:
    ax.set_title(title)
    ax.set_ylabel(unit)
    ax.set_xlabel("time (s)")


def _legend(ax: Axes) -> None:
    ax.legend(
        ncols=4,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.0,
        handlelength=1.4,
        columnspacing=1.2,
    )

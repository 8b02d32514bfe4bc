"""Figures for reports: plain matplotlib, no global state, no window.

All colours come from :data:`PALETTE`; :func:`to_svg` turns them into CSS variables, so that one figure is at home on a light
and on a dark page.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

from factorgrasp.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALETTE: Mapping[str, str] = {
    "ink": "#1b2430",
    "muted": "#667282",
    "line": "#d5dae1",
    "band": "#e6ecf4",
    "paper": "#fcfcfb",
    "x": "#c2473d",
    "y": "#2c8a57",
    "z": "#2d69c4",
    "accent": "#b8791a",
}
AXES = ("x", "y", "z")

_MOST_POINTS = 600

# matplotlib types its settings by a literal of all their names; a plain mapping is clearer here.
_STYLE: Any = {
    "font.size": 9.0,
    "font.family": "sans-serif",
    "text.color": PALETTE["ink"],
    "axes.labelcolor": PALETTE["muted"],
    "axes.edgecolor": PALETTE["line"],
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlecolor": PALETTE["ink"],
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": PALETTE["line"],
    "grid.linewidth": 0.6,
    "xtick.color": PALETTE["muted"],
    "ytick.color": PALETTE["muted"],
    "xtick.major.size": 0.0,
    "ytick.major.size": 0.0,
    "xtick.minor.size": 0.0,
    "ytick.minor.size": 0.0,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.2,
    "lines.solid_capstyle": "round",
    "svg.fonttype": "none",
}


P = ParamSpec("P")
T = TypeVar("T")


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """Run a function with the style of this file: matplotlib reads its settings at every step, not only at the first."""

    @wraps(draw)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        import matplotlib

        with matplotlib.rc_context(_STYLE):
            return draw(*args, **kwargs)

    return wrapped


@styled
def figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **subplots: Any
) -> tuple[Figure, list[Axes]]:
    """A styled figure of `width` x `height` inches and its axes, row by row."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout="constrained")
    axes = made.subplots(rows, columns, squeeze=False, **subplots)
    return made, list(axes.ravel())


@styled
def to_svg(made: Figure, name: str) -> str:
    """The figure as an ``<svg>`` element to stand inside a page; `name` keeps its ids apart from those of other figures."""
    import matplotlib

    text = io.StringIO()
    # Without a date and with a fixed salt, the same estimate gives the same page.
    with matplotlib.rc_context({"svg.hashsalt": name}):
        made.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, count=1, flags=re.DOTALL)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r"font: ([0-9.]+px)[^;\"]*", r"font-size: \1", svg)
    svg = re.sub(
        r' id="(?:figure|axes|patch|line2d|text|matplotlib|PolyCollection|FillBetween|LineCollection)[^"]*"',
        "",
        svg,
    )
    for key, colour in PALETTE.items():
        svg = svg.replace(colour, f"var(--{key})")
    return svg


def over_time(panels: Sequence[tuple[str, str, FloatArray, FloatArray, float]], width: float) -> Figure:
    """One panel a sensor of :func:`draw_over_time`: (title, unit, t, level, declared) each."""
    made, axes = figure(7.2, 1.75 * len(panels) + 0.2, rows=len(panels), sharex=True)
    for ax, (title, unit, t, level, declared) in zip(axes, panels, strict=True):
        draw_over_time(ax, title, unit, t, level, declared, width)
        ax.label_outer()
    return made


@styled
def draw_over_time(
    ax: Axes, title: str, unit: str, t: FloatArray, level: FloatArray, declared: float, width: float
) -> None:
    """Size of the residuals over time against the level that was declared.

    Parameters
    ----------
    ax : Axes
    title, unit : str
    t : (n,) ndarray
        Centres of the windows that were used, s.
    level : (n,) or (n, 3) ndarray
        In `unit`, of all axes together or of each.
    declared : float
        In `unit`.
    width : float
        s; windows further apart than this have a gap between them, and the line breaks.
    """
    level = level.reshape(t.size, -1)
    if t.size > _MOST_POINTS:
        # A picture has room for some hundred points, a recording may have a million.
        t, level = rms_per_stretch(t, level)
        width = max(width, 1.5 * float(np.min(np.diff(t))))
    times, values = _broken(t, level, width)
    for k in range(values.shape[1]):
        single = values.shape[1] == 1
        ax.plot(
            times,
            values[:, k],
            color=PALETTE["z" if single else AXES[k]],
            label="measured" if single else AXES[k],
        )
    ax.axhline(declared, color=PALETTE["muted"], linewidth=1.0, linestyle=(0, (4, 3)), label="declared")
    ax.set_ylim(0.0, 1.15 * max(float(np.nanmax(level)), declared))
    ax.set_title(title)
    ax.set_ylabel(unit)
    ax.set_xlabel("time on the robot's clock (s)")
    _legend_above(ax)


def _legend_above(ax: Axes) -> None:
    """A legend in the line of the title, where it covers nothing."""
    ax.legend(
        ncols=4,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.0,
        handlelength=1.4,
        columnspacing=1.2,
    )


def rms_per_stretch(t: FloatArray, values: FloatArray, stretches: int = 300) -> tuple[FloatArray, FloatArray]:
    """RMS of the columns of `values` (n, k) in equal stretches of time: centres (m,) and RMS (m, k) of those with samples."""
    edges = np.linspace(float(t[0]), float(t[-1]), stretches + 1)
    where = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, stretches - 1)
    count = np.bincount(where, minlength=stretches)
    filled = count > 0
    power = [np.bincount(where, weights=column**2, minlength=stretches)[filled] for column in values.T]
    return 0.5 * (edges[1:] + edges[:-1])[filled], np.sqrt(np.stack(power, axis=1) / count[filled, None])


def _broken(t: FloatArray, values: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """The same lines with NaN where neighbours are further apart than `width`, so that nothing is drawn across a gap."""
    after = np.flatnonzero(np.diff(t) > 1.01 * width) + 1
    return np.insert(t, after, np.nan), np.insert(values, after, np.nan, axis=0)


def spectrum(panels: Sequence[tuple[str, str, FloatArray, FloatArray, FloatArray]]) -> Figure:
    """One panel a sensor of :func:`draw_spectrum`, side by side: (title, unit, frequency, measured, declared) each."""
    made, axes = figure(7.2, 2.5, columns=len(panels))
    for ax, (title, unit, frequency, measured, declared) in zip(axes, panels, strict=True):
        draw_spectrum(ax, title, unit, frequency, measured, declared)
    return made


@styled
def draw_spectrum(
    ax: Axes, title: str, unit: str, frequency: FloatArray, measured: FloatArray, declared: FloatArray
) -> None:
    """Noise density of the residuals over frequency, measured and declared.

    Parameters
    ----------
    ax : Axes
    title, unit : str
    frequency : (bands,) ndarray
        Hz.
    measured, declared : (bands,) ndarray
        In `unit`.
    """
    from matplotlib.ticker import LogLocator, NullLocator

    ax.plot(frequency, measured, color=PALETTE["z"], label="measured")
    ax.plot(frequency, declared, color=PALETTE["muted"], linestyle=(0, (4, 3)), label="declared")
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_locator(NullLocator())
    both = np.concatenate([measured, declared])
    low, high = float(both[both > 0.0].min()), float(both.max())
    # At least one decade: what differs by a tenth should not look like a mountain.
    middle, half = np.sqrt(low * high), max(np.sqrt(10.0), 1.3 * np.sqrt(high / low))
    ax.set_ylim(middle / half, middle * half)
    ax.set_title(title)
    ax.set_ylabel(unit)
    ax.set_xlabel("frequency (Hz)")
    _legend_above(ax)


@styled
def coverage(
    t: FloatArray, width: float, span: tuple[float, float], events: Sequence[tuple[float, str]] = ()
) -> Figure:
    """A strip that shows which parts of a recording were used.

    Parameters
    ----------
    t : (n,) ndarray
        Centres of the windows that were used, s.
    width : float
        Length of a window, s.
    span : (start, end)
        Of the recording, s.
    events : sequence of (time, label)
    """
    made, (ax,) = figure(7.2, 0.7 + (0.25 if events else 0.0))
    ax.grid(False)
    ax.spines["left"].set_visible(False)
    ax.set_yticks([])
    ax.barh(0.0, span[1] - span[0], left=span[0], height=0.6, color=PALETTE["x"], alpha=0.35, linewidth=0.0)
    breaks = np.flatnonzero(np.diff(t) > 1.01 * width)
    starts = np.concatenate([t[:1], t[breaks + 1]]) - 0.5 * width
    ends = np.concatenate([t[breaks], t[-1:]]) + 0.5 * width
    ax.barh(np.zeros(starts.size), ends - starts, left=starts, height=0.6, color=PALETTE["y"], linewidth=0.0)
    for time, label in events:
        ax.axvline(time, color=PALETTE["accent"], linewidth=1.4)
        ax.annotate(
            label, (time, 0.5), (3, 2), textcoords="offset points", fontsize=8.0, color=PALETTE["accent"]
        )
    ax.set_xlim(*span)
    ax.set_xlabel("time on the robot's clock (s)")
    return made

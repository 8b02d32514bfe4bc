"""Figures for reports: plain matplotlib, no global state, no window.

All colours come from :data:`PALETTE`; :func:`to_svg` turns them into CSS variables, so that one figure is at home on a light
and on a dark page.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar

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
CHI2_95 = 7.815
"""95 % quantile of chi-square with 3 degrees of freedom: an ellipsoid of that many squared standard deviations holds 95 %."""

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


def _styled(draw: Callable[P, T]) -> Callable[P, T]:
    """Run a function with the style of this file: matplotlib reads its settings at every step, not only at the first."""

    @wraps(draw)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        import matplotlib

        with matplotlib.rc_context(_STYLE):
            return draw(*args, **kwargs)

    return wrapped


@_styled
def figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **subplots: Any
) -> tuple[Figure, list[Axes]]:
    """A styled figure of `width` x `height` inches and its axes, row by row."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout="constrained")
    axes = made.subplots(rows, columns, squeeze=False, **subplots)
    return made, list(axes.ravel())


@_styled
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


def grasp_scene(
    rotation: FloatArray, translation: FloatArray, covariance: FloatArray
) -> tuple[Figure, float]:
    """Both frames of a grasp in a picture as high as it needs; see :func:`draw_grasp`."""
    _, low, high = _scene_limits(rotation, translation)
    width = 7.2
    made, (axes,) = figure(width, float(np.clip(width * (high[1] - low[1]) / (high[0] - low[0]), 2.2, 4.5)))
    return made, draw_grasp(axes, rotation, translation, covariance)


def _arrow(translation: FloatArray) -> float:
    """Length of a frame's axes in the scene, m."""
    return float(np.clip(0.3 * np.linalg.norm(translation), 0.06, 0.25))


def _scene_limits(rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """View (2, 3), and lower left and upper right of what it shows, in m."""
    view, arrow = _view(rotation, translation), _arrow(translation)
    tips = arrow * np.hstack([np.eye(3), rotation]).T + np.repeat([np.zeros(3), translation], 3, axis=0)
    ends = np.vstack([_legs(translation), tips]) @ view.T
    return view, ends.min(axis=0) - 0.4 * arrow, ends.max(axis=0) + 0.4 * arrow


def _legs(translation: FloatArray) -> FloatArray:
    """Corners (4, 3) of the way from the origin to a point along x, then y, then z."""
    return np.asarray(np.tril(np.ones((4, 3)), -1) * translation)


@_styled
def draw_grasp(axes: Axes, rotation: FloatArray, translation: FloatArray, covariance: FloatArray) -> float:
    """Both frames of a grasp in a parallel projection, with the 95 % ellipsoid of the hand's position.

    Parameters
    ----------
    axes : Axes
    rotation : (3, 3) ndarray
        ``R_r_h``.
    translation : (3,) ndarray
        ``p_r_h``, m.
    covariance : (3, 3) ndarray
        Of the translation, m^2.

    Returns
    -------
    float
        How many times its size the ellipsoid is drawn.
    """
    from matplotlib.patches import Ellipse

    reach, arrow = float(np.linalg.norm(translation)), _arrow(translation)
    view, low, high = _scene_limits(rotation, translation)
    path = _legs(translation) @ view.T
    axes.set_axis_off()
    axes.set_aspect("equal", adjustable="box")
    axes.plot(path[[0, 3], 0], path[[0, 3], 1], color=PALETTE["ink"], linewidth=2.2, zorder=3)
    for k, axis in enumerate(AXES):
        (x0, y0), (x1, y1) = path[k], path[k + 1]
        axes.plot([x0, x1], [y0, y1], color=PALETTE[axis], linewidth=1.0, linestyle=(0, (2, 2)), zorder=2)
        # A word beside a short leg would only cover the hand; the figures stand in the text, too.
        if np.hypot(x1 - x0, y1 - y0) > 0.25 * reach:
            upright = abs(y1 - y0) > abs(x1 - x0)
            axes.annotate(
                f"{axis} {1000.0 * translation[k]:.0f} mm",
                (0.5 * (x0 + x1), 0.5 * (y0 + y1)),
                (6, 0) if upright else (0, -9),
                textcoords="offset points",
                ha="left" if upright else "center",
                va="center",
                fontsize=8.0,
                color=PALETTE[axis],
            )
    _triad(axes, view, np.zeros(3), np.eye(3), arrow, "robot end-effector r", path[3])
    _triad(axes, view, translation, rotation, arrow, "hand h", -path[3])

    shadow = _shadow(view, covariance)
    magnification = _magnification(shadow.half_axes[1], 0.35 * arrow)
    axes.add_patch(
        Ellipse(
            _pair(view @ translation),
            2.0 * magnification * shadow.half_axes[0],
            2.0 * magnification * shadow.half_axes[1],
            angle=shadow.angle,
            facecolor=PALETTE["accent"],
            edgecolor=PALETTE["accent"],
            alpha=0.28,
            linewidth=1.0,
            zorder=1,
        )
    )
    # A position that is hardly known may be larger than the picture; a part of it says so well enough.
    room = np.minimum(magnification * shadow.extent, max(reach, 2.0 * arrow))
    centre = view @ translation
    low, high = np.minimum(low, centre - 1.1 * room), np.maximum(high, centre + 1.1 * room)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    return magnification


class _Shadow(NamedTuple):
    """Ellipse that an ellipsoid casts: half axes ascending (m), angle of the first (deg), half extent right and up (m)."""

    half_axes: tuple[float, float]
    angle: float
    extent: FloatArray


def _shadow(view: FloatArray, covariance: FloatArray) -> _Shadow:
    """Under a parallel projection, an ellipsoid casts the ellipse of its projected covariance."""
    flat = view @ covariance @ view.T
    values, vectors = np.linalg.eigh(0.5 * (flat + flat.T))
    half = np.sqrt(np.maximum(values, 0.0) * CHI2_95)
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    extent = np.sqrt(np.maximum(np.diag(flat), 0.0) * CHI2_95)
    return _Shadow((float(half[0]), float(half[1])), angle, extent)


def _view(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Rows: right and up of the picture, in frame r; chosen so that the lever arm and all six axes can be told apart."""
    best, best_score = np.eye(3)[:2], -np.inf
    reach = float(np.linalg.norm(translation))
    for azimuth in np.deg2rad(np.arange(0.0, 360.0, 15.0)):
        for elevation in np.deg2rad((20.0, 30.0)):
            right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
            back = np.array(
                [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
            )
            view = np.vstack([right, np.cross(back, right)])
            clarity = min(_clarity(view), _clarity(view @ rotation))
            along = float(np.linalg.norm(view @ translation)) / reach if reach > 0.0 else 1.0
            # Left to right reads best.
            rightwards = float(right @ translation) / reach if reach > 0.0 else 0.0
            score = 2.0 * along + clarity + 0.5 * rightwards
            if score > best_score:
                best, best_score = view, score
    return best


def _clarity(tips: FloatArray) -> float:
    """How well three projected unit axes (2, 3) can be told apart: their smallest distance from each other and from their origin."""
    points = np.column_stack([tips, np.zeros(2)])
    return float(min(np.linalg.norm(points[:, i] - points[:, j]) for i in range(4) for j in range(i)))


def _triad(
    axes: Axes,
    view: FloatArray,
    origin: FloatArray,
    rotation: FloatArray,
    length: float,
    label: str,
    towards: FloatArray,
) -> None:
    """A frame's axes with its name, which goes where neither they nor the way `towards` the other frame lead."""
    start = _pair(view @ origin)
    for k, axis in enumerate(AXES):
        end = _pair(view @ (origin + length * rotation[:, k]))
        axes.annotate(
            "",
            end,
            start,
            arrowprops={
                "arrowstyle": "-|>,head_length=0.45,head_width=0.2",
                "color": PALETTE[axis],
                "linewidth": 2.0,
                "shrinkA": 0.0,
                "shrinkB": 0.0,
            },
            zorder=5,
        )
        tip = _pair(view @ (origin + 1.13 * length * rotation[:, k]))
        axes.text(
            tip[0], tip[1], axis, color=PALETTE[axis], ha="center", va="center", fontsize=9.0, weight="bold"
        )
    axes.plot([start[0]], [start[1]], marker="o", markersize=5.0, color=PALETTE["ink"], zorder=6)
    apart = float(np.linalg.norm(towards))
    if apart < 0.3 * length:
        # Both frames in one place: one name above, one below.
        x, y, align = 0.0, (16.0 if label.startswith("hand") else -16.0), "center"
    else:
        ways = [view @ rotation[:, k] for k in range(3)] + [towards / apart]
        candidates = {(0.0, -1.0): "center", (0.0, 1.0): "center", (1.0, 0.0): "left", (-1.0, 0.0): "right"}
        x, y = min(candidates, key=lambda way: max(float(np.dot(way, other)) for other in ways))
        align = candidates[x, y]
        x, y = 9.0 * x, 15.0 * y
    axes.annotate(
        label,
        start,
        (x, y),
        textcoords="offset points",
        ha=align,
        va="center",
        fontsize=9.5,
        color=PALETTE["ink"],
        zorder=7,
    )


def _pair(point: FloatArray) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _magnification(size: float, wanted: float) -> float:
    """1, 2, 5, 10, ... times, so that `size` is drawn at about `wanted` and never smaller than it is."""
    if size <= 0.0 or wanted <= size:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(wanted / size))
    return float(decade * max(step for step in (1.0, 2.0, 5.0) if step * decade <= wanted / size))


def over_time(panels: Sequence[tuple[str, str, FloatArray, FloatArray, float]], width: float) -> Figure:
    """One panel a sensor of :func:`draw_over_time`: (title, unit, t, level, declared) each."""
    made, axes = figure(7.2, 1.75 * len(panels) + 0.2, rows=len(panels), sharex=True)
    for ax, (title, unit, t, level, declared) in zip(axes, panels, strict=True):
        draw_over_time(ax, title, unit, t, level, declared, width)
        ax.label_outer()
    return made


@_styled
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
    times, values = _broken(t, level.reshape(t.size, -1), width)
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


@_styled
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


@_styled
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

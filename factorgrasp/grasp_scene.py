"""The picture of a grasp: both frames in a parallel projection, with the ellipsoid of the hand's position."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from factorgrasp.plots import AXES, PALETTE, figure, styled
from factorgrasp.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CHI2_95 = 7.815
"""95 % quantile of chi-square with 3 degrees of freedom: an ellipsoid of that many squared standard deviations holds 95 %."""

# Width of a character of the labels, relative to its height; a little more than needed.
_CHARACTER = 0.56


class Drawn(NamedTuple):
    """What the reader of a scene must be told: how many times enlarged the ellipsoid is (0: none), and whether it exceeds the picture."""

    magnification: float
    exceeds: bool


class _Shadow(NamedTuple):
    """Ellipse that an ellipsoid casts, enlarged: half axes ascending (m), angle of the first (deg), half extent right and up (m)."""

    half_axes: tuple[float, float]
    angle: float
    extent: FloatArray
    magnification: float


class _Scene(NamedTuple):
    """Everything in picture coordinates (right, up), m."""

    view: FloatArray  # (2, 3), frame r to picture
    legs: FloatArray  # (4, 2), the way from r to h along x, y, z
    arrow: float
    low: FloatArray
    high: FloatArray
    size: _Shadow | None


def grasp_scene(
    rotation: FloatArray, translation: FloatArray, covariance: FloatArray
) -> tuple[Figure, Drawn]:
    """A picture of its own, as high as it needs; see :func:`draw_grasp`."""
    scene = _scene(rotation, translation, covariance)
    width, size = 7.2, scene.high - scene.low
    made, (axes,) = figure(width, float(np.clip(width * size[1] / size[0], 2.2, 4.5)))
    return made, draw_grasp(axes, rotation, translation, covariance)


@styled
def draw_grasp(axes: Axes, rotation: FloatArray, translation: FloatArray, covariance: FloatArray) -> Drawn:
    """Draw both frames, the way between them, and the 95 % ellipsoid of the hand's position.

    Parameters
    ----------
    axes : Axes
    rotation : (3, 3) ndarray
        ``R_r_h``.
    translation : (3,) ndarray
        ``p_r_h``, m.
    covariance : (3, 3) ndarray
        Of the translation, m^2; NaN where it is not known, and nothing is drawn.
    """
    from matplotlib.patches import Ellipse

    scene = _scene(rotation, translation, covariance)
    axes.set_axis_off()
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(scene.low[0], scene.high[0])
    axes.set_ylim(scene.low[1], scene.high[1])

    hand = scene.legs[3]
    if scene.size is not None:
        width, height = (2.0 * half for half in scene.size.half_axes)
        colour = PALETTE["accent"]
        axes.add_patch(
            Ellipse(
                _pair(hand),
                width,
                height,
                angle=scene.size.angle,
                facecolor=colour,
                edgecolor=colour,
                alpha=0.28,
                zorder=1,
            )
        )
    axes.plot(*scene.legs[[0, 3]].T, color=PALETTE["ink"], linewidth=2.2, zorder=3)
    for k, axis in enumerate(AXES):
        axes.plot(
            *scene.legs[k : k + 2].T, color=PALETTE[axis], linewidth=1.0, linestyle=(0, (2, 2)), zorder=2
        )
    _triad(axes, scene, np.zeros(3), np.eye(3))
    _triad(axes, scene, translation, rotation)

    lines = [scene.legs[[0, 3]], *(scene.legs[k : k + 2] for k in range(3))]
    for origin, turn in ((np.zeros(3), np.eye(3)), (translation, rotation)):
        tips = (origin[:, None] + 1.2 * scene.arrow * turn).T @ scene.view.T
        lines += [np.array([scene.view @ origin, tip]) for tip in tips]
    _Labels(axes, scene, lines).put_all(translation)
    if scene.size is None:
        return Drawn(0.0, False)
    room = 1.05 * np.maximum(scene.high - hand, hand - scene.low)
    return Drawn(scene.size.magnification, bool(np.any(scene.size.extent > room)))


def _scene(rotation: FloatArray, translation: FloatArray, covariance: FloatArray) -> _Scene:
    arrow = float(np.clip(0.3 * np.linalg.norm(translation), 0.06, 0.25))
    view = _view(rotation, translation)
    legs = np.tril(np.ones((4, 3)), -1) * translation @ view.T
    tips = np.vstack([arrow * np.eye(3), translation + arrow * rotation.T]) @ view.T
    ends = np.vstack([legs, tips])
    size = _shadow(view, covariance, 0.35 * arrow) if np.isfinite(covariance).all() else None
    # A position that is hardly known may be larger than the picture; a part of it says so well enough.
    room = 1.1 * np.minimum(size.extent if size is not None else 0.0, (2.0 * arrow, arrow))
    margin = 0.25 * arrow
    low = np.minimum(ends.min(axis=0) - margin, legs[3] - room)
    high = np.maximum(ends.max(axis=0) + margin, legs[3] + room)
    return _Scene(view, legs, arrow, low, high, size)


def _shadow(view: FloatArray, covariance: FloatArray, wanted: float) -> _Shadow:
    """Under a parallel projection, an ellipsoid casts the ellipse of its projected covariance; enlarged to about `wanted`."""
    flat = view @ covariance @ view.T
    values, vectors = np.linalg.eigh(0.5 * (flat + flat.T))
    half = np.sqrt(np.maximum(values, 0.0) * CHI2_95)
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    extent = np.sqrt(np.maximum(np.diag(flat), 0.0) * CHI2_95)
    k = _magnification(float(half[1]), wanted)
    return _Shadow((k * float(half[0]), k * float(half[1])), angle, k * extent, k)


def _magnification(size: float, wanted: float) -> float:
    """1, 2, 5, 10, ... times, so that `size` is drawn at about `wanted` and never smaller than it is."""
    if size <= 0.0 or wanted <= size:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(wanted / size))
    return float(decade * max(step for step in (1.0, 2.0, 5.0) if step * decade <= wanted / size))


def _view(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Rows: right and up of the picture, in frame r; chosen so that the lever arm and all six axes can be told apart."""
    best, best_score = np.eye(3)[:2], -np.inf
    reach = float(np.linalg.norm(translation))
    for azimuth in np.deg2rad(np.arange(0.0, 360.0, 15.0)):
        for elevation in np.deg2rad((20.0, 30.0)):
            ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            right = np.array([-ahead[1], ahead[0], 0.0])
            back = np.cos(elevation) * ahead + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
            view = np.vstack([right, np.cross(back, right)])
            score = min(_clarity(view), _clarity(view @ rotation))
            if reach > 0.0:
                # A long lever arm, from left to right, reads best.
                score += (
                    2.0 * float(np.linalg.norm(view @ translation)) + 0.5 * float(right @ translation)
                ) / reach
            if score > best_score:
                best, best_score = view, score
    return best


def _clarity(tips: FloatArray) -> float:
    """How well three projected unit axes (2, 3) can be told apart: their smallest distance from each other and from their origin."""
    points = np.column_stack([tips, np.zeros(2)])
    return float(min(np.linalg.norm(points[:, i] - points[:, j]) for i in range(4) for j in range(i)))


def _triad(axes: Axes, scene: _Scene, origin: FloatArray, rotation: FloatArray) -> None:
    start = _pair(scene.view @ origin)
    for k, axis in enumerate(AXES):
        colour = PALETTE[axis]
        axes.annotate(
            "",
            _pair(scene.view @ (origin + scene.arrow * rotation[:, k])),
            start,
            arrowprops={
                "arrowstyle": "-|>,head_length=0.45,head_width=0.2",
                "color": colour,
                "linewidth": 2.0,
                "shrinkA": 0.0,
                "shrinkB": 0.0,
            },
            zorder=5,
        )
        x, y = _pair(scene.view @ (origin + 1.13 * scene.arrow * rotation[:, k]))
        axes.text(x, y, axis, color=colour, ha="center", va="center", fontsize=9.0, weight="bold")
    axes.plot([start[0]], [start[1]], marker="o", markersize=5.0, color=PALETTE["ink"], zorder=6)


class _Labels:
    """Puts words where they cover the least of what is drawn."""

    # Offsets in units of the label's half size; below and above first, when nothing else decides.
    _PLACES = ((0, -1), (0, 1), (1, 0), (-1, 0), (1, -1), (-1, -1), (1, 1), (-1, 1))

    def __init__(self, axes: Axes, scene: _Scene, lines: list[FloatArray]) -> None:
        self._axes, self._scene = axes, scene
        drawn = axes.get_figure(root=True)
        assert drawn is not None
        points = 72.0 * drawn.get_size_inches() * axes.get_position().size
        self._scale = float(np.min(points / (scene.high - scene.low)))
        steps = np.linspace(0.0, 1.0, 60)[:, None]
        self._taken = self._scale * np.vstack([line[0] + steps * (line[1] - line[0]) for line in lines])

    def put_all(self, translation: FloatArray) -> None:
        """Names of both frames, and the lengths of those legs that have room for them."""
        legs = self._scene.legs
        self._put("robot end-effector r", legs[0], 9.5, PALETTE["ink"])
        self._put("hand h", legs[3], 9.5, PALETTE["ink"])
        reach = float(np.linalg.norm(translation))
        for k, axis in enumerate(AXES):
            # A word beside a short leg would only cover the hand; the figures stand in the text, too.
            length = float(np.linalg.norm(legs[k + 1] - legs[k]))
            if length > 0.25 * reach and self._scale * length > 45.0:
                middle = 0.5 * (legs[k] + legs[k + 1])
                self._put(f"{axis} {1000.0 * translation[k]:.0f} mm", middle, 8.0, PALETTE[axis])

    def _put(self, text: str, at: FloatArray, size: float, colour: str) -> None:
        half = np.array([0.5 * _CHARACTER * size * len(text), 0.62 * size])
        centre = self._scale * at
        offsets = [np.array(place) * (half + 6.0) for place in self._PLACES]
        covered = [
            np.sum(np.all(np.abs(self._taken - centre - offset) < half + 2.0, axis=1)) for offset in offsets
        ]
        offset = offsets[int(np.argmin(covered))]
        self._axes.annotate(
            text,
            _pair(at),
            _pair(offset),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=size,
            color=colour,
            zorder=7,
        )
        grid = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 24), np.linspace(-1.0, 1.0, 5)), axis=-1).reshape(
            -1, 2
        )
        self._taken = np.vstack([self._taken, centre + offset + half * grid])


def _pair(point: FloatArray) -> tuple[float, float]:
    return float(point[0]), float(point[1])

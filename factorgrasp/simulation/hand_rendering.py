"""Rendered RGB-D frames of a moving hand with six markers over a table, with the truth about the markers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.simulation.hand_raster import Canvas, draw_cone, draw_disc
from factorgrasp.simulation.hand_scene import HandScene, Hidden, to_srgb
from factorgrasp.simulation.hand_shape import SKIN_TONES, HandShape, build_hand
from factorgrasp.typing import FloatArray

_EXPOSURES = 7
"""Instants that a frame with motion blur is the mean of."""
_WOOD = np.array([0.50, 0.30, 0.16])
_GREY = np.array([0.42, 0.42, 0.40])
_CLOTH = np.array([0.20, 0.20, 0.21])
_GREATEST_DEPTH = 65.535


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """One frame and what is true in it.

    Attributes
    ----------
    rgb : ndarray of uint8, shape (h, w, 3)
    depth : ndarray, shape (h, w)
        m, along the optical axis, in whole millimetres; 0 where the sensor saw nothing.
    uv : ndarray, shape (6, 2)
        Projections of the markers' centres at the middle of the exposure, px.
    marker_depth : ndarray, shape (6,)
        m.
    visible : ndarray, shape (6,)
        Share of each marker that is seen: 0 when it is hidden, turned away or outside.
    """

    rgb: NDArray[np.uint8]
    depth: FloatArray
    uv: FloatArray
    marker_depth: FloatArray
    visible: FloatArray


@dataclass(frozen=True, eq=False)
class HandVideo:
    """A recording that is rendered frame by frame, on demand; a frame depends on the seed and its number only.

    Attributes
    ----------
    camera : Camera
    t : ndarray, shape (n,)
        s.
    R_c_w : ndarray, shape (n, 3, 3)
        Wrist frame W in the camera frame.
    p_c_w : ndarray, shape (n, 3)
        m.
    layout : ndarray, shape (6, 3)
        Markers in W, m: wrist, thumb, index, middle, ring, little.
    scene : HandScene
    seed : int

    Raises
    ------
    InputError
        When shapes do not fit or the hand is not in front of the camera.
    """

    camera: Camera
    t: FloatArray
    R_c_w: FloatArray
    p_c_w: FloatArray
    layout: FloatArray
    scene: HandScene = field(default_factory=HandScene)
    seed: int = 0

    def __post_init__(self) -> None:
        t, p = np.atleast_1d(np.asarray(self.t, dtype=float)), np.asarray(self.p_c_w, dtype=float)
        R, layout = np.asarray(self.R_c_w, dtype=float), np.asarray(self.layout, dtype=float)
        if t.ndim != 1 or R.shape != (t.size, 3, 3) or p.shape != (t.size, 3):
            raise InputError(
                "hand video: t, R_c_w, p_c_w",
                "shapes (n,), (n, 3, 3) and (n, 3)",
                f"{t.shape}, {R.shape}, {p.shape}",
            )
        if p[:, 2].min() < 0.15:
            raise InputError(
                "hand video: p_c_w", "a hand at least 0.15 m before the camera", f"{p[:, 2].min():.3g} m"
            )
        for name, value in (("t", t), ("R_c_w", R), ("p_c_w", p), ("layout", layout)):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return int(self.t.size)

    def __iter__(self) -> Iterator[RenderedFrame]:
        return (self.frame(k) for k in range(len(self)))

    @cached_property
    def outward(self) -> float:
        """+1 when the side of the hand that the camera sees first is +z of W, else -1."""
        return 1.0 if self.R_c_w[0, :, 2] @ self.p_c_w[0] < 0.0 else -1.0

    @cached_property
    def shape(self) -> HandShape:
        """The hand in W."""
        return build_hand(self.layout, self.outward)

    @cached_property
    def table(self) -> tuple[FloatArray, float]:
        """Normal n (3,), towards the camera, and offset d of the table ``n' x = d``, camera frame, m."""
        normal = self.outward * self.R_c_w[0, :, 2]
        corners = np.concatenate([self.shape.start, self.shape.end])
        radius = np.concatenate([self.shape.radius[:, 0], self.shape.radius[:, 1]])
        height = (self.p_c_w[:, None] + np.einsum("nij,kj->nki", self.R_c_w, corners)) @ normal - radius
        return normal, float(height.min() - self.scene.table_gap)

    def pose(self, k: int, late: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Wrist pose `late` seconds after frame k, at the velocity that its neighbours show."""
        if late == 0.0 or len(self) == 1:
            return self.R_c_w[k], self.p_c_w[k]
        before, after = max(k - 1, 0), min(k + 1, len(self) - 1)
        share = late / (self.t[after] - self.t[before])
        turn = lie.so3_log(self.R_c_w[before].T @ self.R_c_w[after])
        R = self.R_c_w[k] @ lie.so3_exp(share * turn)
        return R, self.p_c_w[k] + share * (self.p_c_w[after] - self.p_c_w[before])

    def markers(self, k: int) -> FloatArray:
        """Centres of the markers (6, 3) in the camera frame at frame k, m."""
        return np.asarray(self.p_c_w[k] + self.layout @ self.R_c_w[k].T)

    def frame(self, k: int) -> RenderedFrame:
        """Render frame k."""
        scene, rng = self.scene, np.random.default_rng([self.seed, k])
        instants = np.array([0.0])
        if scene.shutter > 0.0 and len(self) > 1:
            instants = scene.shutter * np.linspace(-0.5, 0.5, _EXPOSURES)
        light = np.zeros(self._background.light.shape)
        depth, visible = self._background.depth, np.zeros(6)
        for i, late in enumerate(instants):
            canvas, seen = self._draw(k, *self.pose(k, late))
            light += canvas.light / instants.size
            visible += seen / instants.size
            if i == instants.size // 2:
                depth = canvas.depth
        gradient = 1.0 + scene.light_gradient * np.linspace(-0.5, 0.5, self.camera.width)[None, :, None]
        light = light * gradient * scene.illuminant
        if scene.lens_blur > 0.0:
            light = ndimage.gaussian_filter(light, (scene.lens_blur, scene.lens_blur, 0.0))
        values = to_srgb(light)
        if scene.sensor_noise > 0.0:
            sd = scene.sensor_noise * np.sqrt(0.3 + 0.7 * values / 127.0)
            values = values + sd * rng.normal(size=values.shape)
        markers = self.markers(k)
        return RenderedFrame(
            np.clip(np.rint(values), 0, 255).astype(np.uint8),
            measure_depth(depth, scene, rng),
            self.camera.project(markers),
            markers[:, 2].copy(),
            visible,
        )

    @cached_property
    def _background(self) -> Canvas:
        """Table and what lies on it."""
        camera = self.camera
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
        direction = camera.undistort(np.stack([u, v], axis=-1))
        rays = np.concatenate([direction, np.ones((*direction.shape[:2], 1))], axis=2)
        normal, offset = self.table
        slope = rays @ normal
        depth = np.where(slope < -1e-3, offset / np.minimum(slope, -1e-3), np.inf)
        across = np.cross(normal, [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        point = rays * np.minimum(depth, 5.0)[..., None]
        light = _table_light(point @ across, point @ np.cross(normal, across), self.scene.table, self.seed)
        canvas = Canvas(rays, 0.5 * (camera.fx + camera.fy), light, depth)
        if self.scene.distractors:
            self._put_distractors(canvas, normal, across)
        return canvas

    def _put_distractors(self, canvas: Canvas, normal: FloatArray, across: FloatArray) -> None:
        along = np.cross(normal, across)
        foot = self.p_c_w[0] + normal * (self.table[1] - normal @ self.p_c_w[0])

        def at(right: float, down: float, up: float) -> FloatArray:
            return np.asarray(foot + right * across + down * along + up * normal)

        # Both signs of `across` and `along` occur; the places surround the hand either way.
        draw_cone(
            canvas,
            at(-0.15, -0.13, 0.005),
            at(-0.05, -0.16, 0.005),
            np.array([0.004, 0.004]),
            np.array([0.03, 0.07, 0.30]),
        )
        draw_disc(canvas, at(0.16, 0.12, 0.002), normal, 0.007, np.array([0.04, 0.16, 0.24]))
        draw_disc(canvas, at(-0.2, 0.1, 0.001), normal, 0.045, np.array([0.10, 0.15, 0.26]))
        draw_cone(canvas, at(0.18, -0.12, 0.02), at(0.18, -0.06, 0.02), np.array([0.022, 0.022]), _WOOD * 0.8)

    def _draw(self, k: int, R: FloatArray, p: FloatArray) -> tuple[Canvas, FloatArray]:
        """The scene with the hand at a pose, and the share of each marker that is seen."""
        back, shape, scene = self._background, self.shape, self.scene
        canvas = Canvas(back.rays, back.focal, back.light.copy(), back.depth.copy())
        skin = np.array(SKIN_TONES[scene.skin])
        for a, b, radius in zip(p + shape.start @ R.T, p + shape.end @ R.T, shape.radius, strict=True):
            draw_cone(canvas, a, b, radius, skin, texture=0.04)
        seen = []
        for centre, normal in zip(p + self.layout @ R.T, shape.marker_normal @ R.T, strict=True):
            seen.append(
                draw_disc(canvas, centre, normal, 0.5 * scene.marker_diameter, np.array(scene.marker_colour))
            )
        covers = [
            self._cover(canvas, hidden, p + self.layout[hidden.marker] @ R.T)
            for hidden in scene.hidden
            if hidden.first <= k <= hidden.last
        ]
        visible = np.zeros(6)
        for i, drawn in enumerate(seen):
            if drawn is None:
                continue
            window, full, part = drawn
            left = np.zeros(back.depth.shape)
            left[window] = part
            for cover in covers:
                if cover is not None:
                    left[cover[0]] *= 1.0 - cover[1]
            # What is outside of the image counts as hidden.
            z = (p + self.layout[i] @ R.T)[2]
            slant = abs(float(shape.marker_normal[i] @ R.T @ (p + self.layout[i] @ R.T))) / np.linalg.norm(p)
            whole = np.pi * (0.5 * scene.marker_diameter * back.focal / z) ** 2 * slant
            visible[i] = min(left.sum() / max(full.sum(), 0.98 * whole, 1e-9), 1.0)
        return canvas, visible

    def _cover(
        self, canvas: Canvas, hidden: Hidden, centre: FloatArray
    ) -> tuple[tuple[slice, slice], FloatArray] | None:
        """Draw what hides a marker: a finger whose edge runs over it."""
        radius = 0.009
        towards = np.array([np.cos(hidden.angle), np.sin(hidden.angle), 0.0])
        along = np.array([-towards[1], towards[0], 0.0])
        lifted = centre * (1.0 - 0.012 / centre[2])
        edge = 0.5 * self.scene.marker_diameter * (1.0 - 2.0 * hidden.fraction)
        axis = lifted + (edge + radius) * towards
        colour = np.array(SKIN_TONES[self.scene.skin]) if hidden.kind == "skin" else _CLOTH
        size = np.array([radius, radius])
        return draw_cone(canvas, axis - 0.012 * along, axis + 0.05 * along, size, colour, texture=0.04)


def render_hand(
    camera: Camera,
    R_c_w: ArrayLike,
    p_c_w: ArrayLike,
    layout: ArrayLike,
    scene: HandScene | None = None,
    seed: int = 0,
) -> RenderedFrame:
    """One frame of a hand at rest; see :class:`HandVideo`."""
    video = HandVideo(
        camera,
        np.zeros(1),
        np.asarray(R_c_w, dtype=float)[None],
        np.asarray(p_c_w, dtype=float)[None],
        np.asarray(layout, dtype=float),
        scene or HandScene(),
        seed,
    )
    return video.frame(0)


def measure_depth(true: FloatArray, scene: HandScene, rng: np.random.Generator) -> FloatArray:
    """What a structured-light camera reads of a depth image (h, w), m: noise, shadows, mixed pixels, outliers, whole mm."""
    z = np.where(true < _GREATEST_DEPTH, true, 0.0)
    sd = scene.depth_noise * (1.2e-3 + 1.9e-3 * (z - 0.4) ** 2)
    # Neighbouring pixels share the pattern that is matched, and with it a part of the error.
    fine, coarse = rng.normal(size=z.shape), ndimage.gaussian_filter(rng.normal(size=z.shape), 1.0)
    read = z + sd * (0.8 * fine + 0.6 * coarse / 0.282)
    if scene.depth_noise > 0.0:
        near = ndimage.minimum_filter(np.where(z > 0.0, z, np.inf), size=(1, 5))
        far = ndimage.maximum_filter(z, size=(3, 3))
        read = np.where(z - near > 0.02, 0.0, read)
        # A pixel on an edge is a mixture of before and behind.
        edge = (far - z > 0.02) & (rng.random(z.shape) < 0.4)
        read = np.where(edge, z + rng.random(z.shape) * (far - z), read)
    if scene.depth_outliers > 0.0:
        wrong = rng.random(z.shape) < scene.depth_outliers
        read = np.where(wrong, read + rng.uniform(-0.08, 0.08, size=z.shape), read)
    if scene.depth_missing > 0.0:
        h, w = z.shape
        spots = rng.random((h // 3 + 1, w // 3 + 1)) < scene.depth_missing
        read = np.where(np.kron(spots, np.ones((3, 3), dtype=bool))[:h, :w], 0.0, read)
    return np.where((z > 0.0) & (read > 0.0), np.rint(1e3 * read) * 1e-3, 0.0)


def _table_light(x: FloatArray, y: FloatArray, kind: str, seed: int) -> FloatArray:
    """Wood with a grain, or plain grey, at points (h, w) of the table, m."""
    if kind == "grey":
        return np.broadcast_to(_GREY, (*x.shape, 3)).copy()
    rng = np.random.default_rng([seed, 77])
    wave = np.zeros(x.shape)
    for a, f, g in ((0.5, 180.0, 6.0), (0.3, 420.0, 9.0), (0.2, 1100.0, 4.0)):
        wave += a * np.sin(f * y + 3.0 * np.sin(g * x + rng.uniform(0, 6)) + rng.uniform(0, 6))
    tone = (1.0 + 0.22 * wave)[..., None]
    return np.asarray(_WOOD * tone ** np.array([0.9, 1.0, 1.2]))

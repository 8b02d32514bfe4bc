"""Round cones and discs drawn with anti-aliased edges into an image of linear light with depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.typing import FloatArray

_LIGHT = np.array([-0.35, -0.45, -0.82])
"""Direction to the lamp in the camera frame: above and to the left of the camera."""
_AMBIENT = 0.45
_SUPERSAMPLING = 8


@dataclass(eq=False)
class Canvas:
    """What is drawn so far.

    Attributes
    ----------
    rays : ndarray, shape (h, w, 3)
        Directions of the pixel centres in the camera frame, z = 1, without lens distortion.
    focal : float
        Pixels a radian at the centre.
    light : ndarray, shape (h, w, 3)
        Linear light.
    depth : ndarray, shape (h, w)
        Along the optical axis, m; infinite where there is nothing.
    """

    rays: FloatArray
    focal: float
    light: FloatArray
    depth: FloatArray

    def window(self, points: FloatArray, margin: FloatArray | float) -> tuple[slice, slice] | None:
        """Rows and columns that hold balls of radius `margin` (m) about `points` (k, 3); None when outside."""
        z = np.maximum(points[:, 2], 0.05)
        pixel = points[:, :2] / z[:, None] * self.focal
        # Rays are regular up to lens distortion, for which the window is a little wider.
        centre = self.rays[0, 0, :2] * self.focal
        last = self.rays[-1, -1, :2] * self.focal
        scale = (np.array(self.rays.shape[1::-1]) - 1) / (last - centre)
        at = (pixel - centre) * scale
        grow = (np.asarray(margin) / z * self.focal * 1.15 + 3.0)[:, None] * scale
        low = np.floor((at - grow).min(axis=0)).astype(int)
        high = np.ceil((at + grow).max(axis=0)).astype(int) + 1
        low = np.maximum(low, 0)
        high = np.minimum(high, self.rays.shape[1::-1])
        if (high <= low).any():
            return None
        return slice(low[1], high[1]), slice(low[0], high[0])


def lambert(normal: FloatArray) -> FloatArray:
    """Shading of surfaces with camera-frame normals (..., 3)."""
    towards = _LIGHT / np.linalg.norm(_LIGHT)
    return np.asarray(_AMBIENT + (1.0 - _AMBIENT) * np.maximum(normal @ towards, 0.0))


def draw_cone(
    canvas: Canvas, a: FloatArray, b: FloatArray, radius: FloatArray, colour: FloatArray, texture: float = 0.0
) -> tuple[tuple[slice, slice], FloatArray] | None:
    """Draw a round cone from a to b (camera frame, m) in front of what is farther away.

    Returns
    -------
    (window, coverage) or None
        What part of each pixel it covers, for the caller to account for what it hides.
    """
    window = canvas.window(np.array([a, b]), radius)
    if window is None or min(a[2], b[2]) < 0.05:
        return None
    ray = canvas.rays[window]
    unit = ray / np.linalg.norm(ray, axis=2, keepdims=True)
    axis = b - a
    along = unit @ axis
    towards = unit @ a
    t = np.clip((towards * along - a @ axis) / np.maximum(axis @ axis - along**2, 1e-12), 0.0, 1.0)
    reach = towards + t * along
    point = a + t[..., None] * axis
    size = radius[0] + t * (radius[1] - radius[0])
    across = np.sqrt(np.maximum(np.einsum("...i,...i", point, point) - reach**2, 0.0))
    coverage = np.clip(0.5 + (size - across) * canvas.focal / reach, 0.0, 1.0)
    along_ray = reach - np.sqrt(np.maximum(size**2 - across**2, 0.0))
    depth = along_ray * unit[..., 2]
    normal = (along_ray[..., None] * unit - point) / size[..., None]
    length = np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-9)
    shade = lambert(normal / length)
    if texture > 0.0:
        # Wrinkles: a pattern that is fixed to the cone.
        shade = shade * (
            1.0 + texture * np.sin(900.0 * t * np.linalg.norm(axis)) * np.sin(7.0 * normal[..., 1])
        )
    visible = coverage * (depth < canvas.depth[window])
    light = canvas.light[window]
    light += visible[..., None] * (shade[..., None] * colour - light)
    behind = canvas.depth[window]
    np.copyto(behind, depth, where=visible >= 0.5)
    return window, visible


def draw_disc(
    canvas: Canvas,
    centre: FloatArray,
    normal: FloatArray,
    radius: float,
    colour: FloatArray,
    tolerance: float = 0.004,
) -> tuple[tuple[slice, slice], FloatArray, FloatArray] | None:
    """Draw a flat disc that lies on a surface; what is more than `tolerance` (m) before it hides it.

    Returns
    -------
    (window, full, visible) or None
        Coverage of each pixel were the disc alone, and what is seen of it.
    """
    window = canvas.window(centre[None], radius)
    if window is None or centre[2] < 0.05:
        return None
    ray = canvas.rays[window]
    offset = (np.arange(_SUPERSAMPLING) + 0.5) / _SUPERSAMPLING - 0.5
    step_u, step_v = _pixel_steps(canvas, window)
    fine = (
        ray[:, :, None, None, :]
        + offset[None, None, None, :, None] * step_u
        + offset[None, None, :, None, None] * step_v
    )
    slope = fine @ normal
    facing = slope < -1e-6
    reach = (centre @ normal) / np.where(facing, slope, -1.0)
    gap = fine * reach[..., None] - centre
    inside = facing & (np.einsum("...i,...i", gap, gap) < radius**2)
    full = inside.mean(axis=(2, 3))
    level = ray @ normal
    depth = np.where(level < -1e-6, (centre @ normal) / np.minimum(level, -1e-6), centre[2])
    visible = full * (canvas.depth[window] > depth - tolerance)
    light = canvas.light[window]
    light += visible[..., None] * (lambert(normal) * colour - light)
    np.copyto(canvas.depth[window], depth, where=visible >= 0.5)
    return window, full, visible


def _pixel_steps(canvas: Canvas, window: tuple[slice, slice]) -> tuple[FloatArray, FloatArray]:
    """How a ray changes from one pixel to the next in u and in v, near the middle of a window."""
    h, w = canvas.rays.shape[:2]
    row = min((window[0].start + window[0].stop) // 2, h - 2)
    column = min((window[1].start + window[1].stop) // 2, w - 2)
    here = canvas.rays[row, column]
    return canvas.rays[row, column + 1] - here, canvas.rays[row + 1, column] - here

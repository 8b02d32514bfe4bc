"""A pinhole camera with lens distortion, with or without depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray

_UNDISTORT_STEPS = 20
_NEAREST = 1e-6


@dataclass(frozen=True)
class Camera:
    """Pinhole camera. Camera frame c: x right, y down, z along the optical axis; depth is z, m.

    A point ``p`` (m, in c) is seen at ``[fx a' + cx, fy b' + cy]`` with ``[a, b] = [px, py] / pz`` and ``[a', b']`` the distorted
    direction (Brown-Conrady, OpenCV's order of coefficients). The centre of the first pixel is (0, 0).

    Attributes
    ----------
    fx, fy : float
        Focal lengths, px.
    cx, cy : float
        Principal point, px.
    width, height : int
        Image size, px.
    distortion : tuple of float
        ``(k1, k2, p1, p2)`` or ``(k1, k2, p1, p2, k3)``; empty: none.
    rate : float
        Frames a second.

    Raises
    ------
    InputError
        For focal lengths or sizes that are not positive, a principal point outside of the image, another number of coefficients.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    rate: float = 30.0

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy", "width", "height", "rate"):
            value = getattr(self, name)
            if not np.isfinite(value) or (value <= 0.0 and name not in ("cx", "cy")):
                raise InputError(f"camera: {name}", "a finite number above zero", repr(value))
        if not (-0.5 <= self.cx <= self.width - 0.5 and -0.5 <= self.cy <= self.height - 0.5):
            raise InputError(
                "camera: cx, cy",
                f"a principal point within the image of {self.width} x {self.height} px",
                f"({self.cx:g}, {self.cy:g})",
                "Are width and height, or cx and cy, swapped?",
            )
        coefficients = tuple(float(k) for k in self.distortion)
        if len(coefficients) not in (0, 4, 5) or not np.all(np.isfinite(coefficients)):
            raise InputError(
                "camera: distortion", "(k1, k2, p1, p2) or (k1, k2, p1, p2, k3)", repr(self.distortion)
            )
        object.__setattr__(self, "distortion", coefficients if any(coefficients) else ())

    @property
    def matrix(self) -> FloatArray:
        """``K`` (3, 3), px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def pixels(self) -> float:
        """Number of pixels: the area over which clutter is spread."""
        return float(self.width * self.height)

    def inside(self, uv: ArrayLike, margin: float = 0.0) -> np.ndarray:
        """Whether image points (..., 2) are within the image, at least `margin` px from its edge."""
        u, v = np.moveaxis(np.asarray(uv, dtype=float), -1, 0)
        low = -0.5 + margin
        return np.asarray(
            (u >= low) & (u <= self.width - 0.5 - margin) & (v >= low) & (v <= self.height - 0.5 - margin)
        )

    def project(self, points: ArrayLike) -> FloatArray:
        """Image points (..., 2), px, of points (..., 3) in the camera frame, m; NaN behind the camera."""
        p = np.asarray(points, dtype=float)
        z = np.where(p[..., 2] > _NEAREST, p[..., 2], np.nan)
        a, b = self._distort(p[..., 0] / z, p[..., 1] / z)
        return np.stack([self.fx * a + self.cx, self.fy * b + self.cy], axis=-1)

    def project_with_jacobian(self, points: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Image points (..., 2), px, and their derivatives (..., 2, 3) by the point, px/m; NaN behind the camera."""
        p = np.asarray(points, dtype=float)
        z = np.where(p[..., 2] > _NEAREST, p[..., 2], np.nan)
        x, y = p[..., 0] / z, p[..., 1] / z
        J = np.empty((*p.shape[:-1], 2, 3))
        if self.distortion:
            a, b, (aa, ab, ba, bb) = self._distort_with_jacobian(x, y)
        else:
            a, b, aa, ab, ba, bb = x, y, 1.0, 0.0, 0.0, 1.0  # type: ignore[assignment]
        for row, (f, dx, dy) in enumerate(((self.fx, aa, ab), (self.fy, ba, bb))):
            J[..., row, 0] = f * dx / z
            J[..., row, 1] = f * dy / z
            J[..., row, 2] = -f * (dx * x + dy * y) / z
        return np.stack([self.fx * a + self.cx, self.fy * b + self.cy], axis=-1), J

    def undistort(self, uv: ArrayLike) -> FloatArray:
        """Directions ``[x / z, y / z]`` (..., 2) of image points (..., 2), px."""
        q = np.asarray(uv, dtype=float)
        goal_a, goal_b = (q[..., 0] - self.cx) / self.fx, (q[..., 1] - self.cy) / self.fy
        x, y = goal_a, goal_b
        if self.distortion:
            for _ in range(_UNDISTORT_STEPS):
                a, b, (aa, ab, ba, bb) = self._distort_with_jacobian(x, y)
                ra, rb, det = goal_a - a, goal_b - b, aa * bb - ab * ba
                dx, dy = (bb * ra - ab * rb) / det, (aa * rb - ba * ra) / det
                x, y = x + dx, y + dy
                if not np.any(np.abs(dx) + np.abs(dy) > 1e-14):
                    break
        return np.stack([x, y], axis=-1)

    def back_project(self, uv: ArrayLike, depth: ArrayLike) -> FloatArray:
        """Points (..., 3) in the camera frame, m, of image points (..., 2) with depths (...,) along the optical axis."""
        direction = self.undistort(uv)
        z = np.broadcast_to(np.asarray(depth, dtype=float), direction.shape[:-1])
        return np.stack([direction[..., 0] * z, direction[..., 1] * z, z], axis=-1)

    def _coefficients(self) -> tuple[float, float, float, float, float]:
        k1, k2, p1, p2, *rest = self.distortion
        return k1, k2, p1, p2, (rest[0] if rest else 0.0)

    def _distort(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not self.distortion:
            return x, y
        k1, k2, p1, p2, k3 = self._coefficients()
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )

    def _distort_with_jacobian(
        self, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
        k1, k2, p1, p2, k3 = self._coefficients()
        a, b = self._distort(x, y)
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        aa = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        ab = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        bb = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        return a, b, (aa, ab, ab, bb)

"""What an RGB-D camera and a blob detector make of markers: noise, misses, occlusions, clutter, blackouts, lost and late frames."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from factorgrasp.models.camera import Camera

_PROBABILITIES = (
    "p_miss", "occlusion", "depth_missing", "depth_outliers", "drop_frames", "late_frames",
)  # fmt: skip


@dataclass(frozen=True)
class WristSensing:
    """How the markers are seen. The defaults are the nominal conditions of the mathematics, section 5.2.

    Attributes
    ----------
    rate : float
        Frames a second (Hz).
    pixel_sd : float
        Of a blob's centre, per coordinate (px).
    depth_sd : float or None
        Of a blob's depth (m); None: that of a structured-light camera, 1.37 mm at 0.7 m (:func:`structured_light_sd`).
    depth : bool
        False: a camera without depth; every `z` is NaN.
    depth_missing : float
        Share of the blobs without depth.
    depth_outliers : float
        Share of the markers whose depth is that of what lies 30 to 150 mm behind them.
    p_miss : float
        Probability that a marker in view is not detected, frame by frame.
    occlusion, occlusion_time : float
        Share of the time that a marker is covered, and how long for on average (s).
    clutter : float
        Blobs a frame that are no markers, anywhere in the image (Poisson mean).
    clutter_near : float
        The same within 70 px of a marker and 60 mm of the hand's depth.
    blackouts : tuple of (first, end)
        All markers are hidden in the frames ``first <= frame < end``.
    half_hidden : bool
        Three of the six markers (half of them) are hidden at any time; others every half second.
    min_facing : float
        A marker is seen when the cosine between its normal (z of ``W``) and the ray to the camera is larger.
    drop_frames : float
        Share of the frames that never arrive.
    late_frames, late_by : float
        Share of the frames that arrive late, and by how much at most (s); frames may then arrive out of order.
    latency : float
        From a frame's stamp to its arrival otherwise (s).
    focal_error, principal_error : float
        The intrinsics that are given to the estimator: focal lengths wrong by this fraction, principal point by so many px.
    depth_scale_error : float
        Depths are too long by this fraction.
    """

    rate: float = 30.0
    pixel_sd: float = 1.0
    depth_sd: float | None = None
    depth: bool = True
    depth_missing: float = 0.05
    depth_outliers: float = 0.0
    p_miss: float = 0.02
    occlusion: float = 0.05
    occlusion_time: float = 0.2
    clutter: float = 2.0
    clutter_near: float = 0.0
    blackouts: tuple[tuple[int, int], ...] = ()
    half_hidden: bool = False
    min_facing: float = 0.15
    drop_frames: float = 0.0
    late_frames: float = 0.0
    late_by: float = 0.15
    latency: float = 0.02
    focal_error: float = 0.0
    principal_error: float = 0.0
    depth_scale_error: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float | int) and not np.isfinite(value):
                raise InputError(field.name, "a finite number", repr(value))
            if field.name in _PROBABILITIES and not 0.0 <= value < 1.0:
                raise InputError(field.name, "a share between 0 and 1", repr(value))
        for name in ("pixel_sd", "depth_sd", "clutter", "clutter_near", "late_by", "latency"):
            value = getattr(self, name)
            if value is not None and value < 0.0:
                raise InputError(name, "a number that is not negative", repr(value))
        for name in ("rate", "occlusion_time"):
            if getattr(self, name) <= 0.0:
                raise InputError(name, "a positive number", repr(getattr(self, name)))


@dataclass(frozen=True, eq=False)
class SensedBlobs:
    """All blobs of all frames, frame after frame, in no order within one.

    Attributes
    ----------
    frame : ndarray, shape (m,)
        Number of the frame of each blob.
    uv : ndarray, shape (m, 2)
        px.
    z : ndarray, shape (m,)
        Depth along the optical axis (m); NaN where it is missing.
    label : ndarray, shape (m,)
        0 for clutter, ``j`` for the j-th marker, from 1 on.
    hidden : ndarray, shape (n, k)
        Markers that are covered, turned away or blacked out in each frame.
    """

    frame: IntArray
    uv: FloatArray
    z: FloatArray
    label: IntArray
    hidden: BoolArray


def structured_light_sd(z: FloatArray) -> FloatArray:
    """Axial noise (m) of a structured-light camera at depths z (m): ``1.2 mm + 1.9 mm/m^2 (z - 0.4 m)^2`` (Nguyen et al. 2012)."""
    out: FloatArray = 1.2e-3 + 1.9e-3 * (z - 0.4) ** 2
    return out


def sense(
    camera: Camera,
    points: FloatArray,
    facing: FloatArray,
    sensing: WristSensing,
    rng: np.random.Generator,
    covered: BoolArray | None = None,
) -> SensedBlobs:
    """Blobs of markers.

    Parameters
    ----------
    camera : Camera
        The true one.
    points : ndarray, shape (n, k, 3)
        Markers in the camera's frame (m); NaN where a marker does not exist.
    facing : ndarray, shape (n, k)
        Cosine between a marker's normal and the ray to the camera.
    sensing : WristSensing
    rng : Generator
    covered : ndarray, shape (n, k), optional
        Further frames in which a marker cannot be seen.
    """
    n, k = points.shape[:2]
    hidden = (facing < sensing.min_facing) | ~np.isfinite(points).all(axis=2) | _occluded(n, k, sensing, rng)
    if sensing.half_hidden:
        hidden |= _half_hidden(n, k, sensing, rng)
    if covered is not None:
        hidden |= covered
    for first, end in sensing.blackouts:
        hidden[first:end] = True
    seen = ~hidden & (rng.random((n, k)) >= sensing.p_miss)

    frame, marker = np.nonzero(seen)
    P = points[frame, marker]
    uv = camera.project(P) + sensing.pixel_sd * rng.standard_normal((frame.size, 2))
    z = P[:, 2] * (1.0 + sensing.depth_scale_error)
    sd = structured_light_sd(z) if sensing.depth_sd is None else sensing.depth_sd
    z = z + sd * rng.standard_normal(frame.size)
    behind = rng.random(frame.size) < sensing.depth_outliers
    z = np.where(behind, z + rng.uniform(0.03, 0.15, frame.size), z)
    parts = [(frame, uv, z, marker + 1)]
    parts.append(_anywhere(n, camera, sensing.clutter, rng))
    if sensing.clutter_near > 0.0:
        parts.append(_near(n, camera, points, sensing.clutter_near, rng))

    frames, uvs, depths, labels = (np.concatenate(column) for column in zip(*parts, strict=True))
    depths = np.where(rng.random(frames.size) < sensing.depth_missing, np.nan, depths)
    if not sensing.depth:
        depths = np.full(frames.size, np.nan)
    inside = camera.inside(uvs)
    order = np.lexsort((rng.random(frames.size), frames))
    order = order[inside[order]]
    return SensedBlobs(frames[order], uvs[order], depths[order], labels[order], hidden)


def arrivals(t: FloatArray, sensing: WristSensing, rng: np.random.Generator) -> tuple[BoolArray, FloatArray]:
    """Which frames arrive at all, shape (n,), and when (s), shape (n,). The first five always do: the camera is placed by them."""
    arrive = (rng.random(t.size) >= sensing.drop_frames) | (np.arange(t.size) < 5)
    late = rng.random(t.size) < sensing.late_frames
    return arrive, t + sensing.latency + np.where(late, rng.uniform(0.0, sensing.late_by, t.size), 0.0)


def _occluded(n: int, k: int, sensing: WristSensing, rng: np.random.Generator) -> BoolArray:
    """A two-state chain for each marker: covered for `occlusion_time` on average, `occlusion` of the time."""
    if sensing.occlusion == 0.0:
        return np.zeros((n, k), dtype=bool)
    leave = min(1.0, 1.0 / (sensing.occlusion_time * sensing.rate))
    enter = leave * sensing.occlusion / (1.0 - sensing.occlusion)
    draws = rng.random((n, k))
    out = np.zeros((n, k), dtype=bool)
    # The hand starts in the neutral posture with all its markers in view, as the paper asks.
    for i in range(1, n):
        out[i] = np.where(out[i - 1], draws[i] >= leave, draws[i] < enter)
    return out


def _half_hidden(n: int, k: int, sensing: WristSensing, rng: np.random.Generator) -> BoolArray:
    hold = max(1, round(0.5 * sensing.rate))
    out = np.zeros((n, k), dtype=bool)
    # From the first change on: the first half second shows everything.
    for first in range(hold, n, hold):
        out[first : first + hold, rng.permutation(k)[: k // 2]] = True
    return out


_Blobs = tuple[IntArray, FloatArray, FloatArray, IntArray]


def _anywhere(n: int, camera: Camera, mean: float, rng: np.random.Generator) -> _Blobs:
    frame = np.repeat(np.arange(n), rng.poisson(mean, n))
    uv = rng.uniform((0.0, 0.0), (camera.width - 1, camera.height - 1), (frame.size, 2))
    return frame, uv, rng.uniform(0.5, 1.2, frame.size), np.zeros(frame.size, dtype=np.intp)


def _near(n: int, camera: Camera, points: FloatArray, mean: float, rng: np.random.Generator) -> _Blobs:
    frame = np.repeat(np.arange(n), rng.poisson(mean, n))
    around = points[frame, rng.integers(points.shape[1], size=frame.size)]
    exists = np.isfinite(around).all(axis=1)
    frame, around = frame[exists], around[exists]
    radius, angle = 70.0 * np.sqrt(rng.random(frame.size)), rng.uniform(0.0, 2.0 * np.pi, frame.size)
    uv = camera.project(around) + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    z = around[:, 2] + rng.uniform(-0.06, 0.06, frame.size)
    return frame, uv, z, np.zeros(frame.size, dtype=np.intp)

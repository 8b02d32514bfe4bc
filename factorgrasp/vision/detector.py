"""Markers in one RGB or RGB-D image: unlabelled blobs with sub-pixel centroids, depths and their covariances."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.typing import BoolArray, FloatArray
from factorgrasp.vision.blob_depth import disc_depth
from factorgrasp.vision.colour import ColourReference
from factorgrasp.vision.images import (
    LOG_LIGHT,
    LOG_STEPS,
    ByteImage,
    check_depth,
    check_rgb,
    chroma_index,
    metres,
)
from factorgrasp.vision.images import middle as median
from factorgrasp.vision.light import NOTICEABLE, light_shift, mean_chroma
from factorgrasp.vision.opencv import load_cv2
from factorgrasp.vision.outline_fit import FittedCentre, fit_outline, outline_rms, split_blob
from factorgrasp.vision.settings import DetectorSettings
from factorgrasp.vision.soft_blob import SoftBlob, soften
from factorgrasp.vision.table_plane import TablePlane, fit_table

Kind = Literal["whole", "hidden", "split"]

_MARGIN = 8
_MOST_COMPONENTS = 200
_MOST_EXAMINED = 40
_ROUND = 1.15
"""Elongation of what certainly is no half of a disc (1.9)."""
_SURE = 3
"""Whole markers of one size that settle it."""
_MOST_FUZZY = 3.5
"""Size of a component relative to its sure inside from which only the inside is taken."""
_FEW = 6
"""Blobs: with fewer, another lamp is considered."""
_SEVERAL = 24
"""px: a component of that size may be several markers."""
_UNKNOWN_DEPTH_VARIANCE = 1.0
_LEAST_ALIKE = 0.5
"""Similarity relative to the most similar blob: all markers are in the same light."""
_WHOLE = (0.93, 1.30)
"""Area of a whole marker relative to what is expected."""
_SHARES = (0.22, 3.6)
"""Area of anything that may be markers."""
_POOR_SPLIT = 0.2
"""Root mean square of alpha's residuals from which a blob is no union of markers."""
_ROUGH = 0.33
"""px: an outline that fits that well about the centroid is that of a whole marker, no search needed."""
_SHIFT = 0.12
"""px: a centroid that differs that much from the fitted outline's centre is that of a part of a marker."""


@dataclass(frozen=True, eq=False)
class DetectedBlobs:
    """The blobs of one image, the most similar first.

    Attributes
    ----------
    uv : ndarray, shape (k, 2)
        px; the centre of the first pixel is (0, 0).
    covariance_uv : ndarray, shape (k, 2, 2)
        px^2.
    depth : ndarray, shape (k,)
        m, NaN where it is missing.
    covariance_depth : ndarray, shape (k,)
        m^2; 1 where the depth is missing.
    similarity : ndarray, shape (k,)
        Bhattacharyya coefficient with the reference colour.
    area : ndarray, shape (k,)
        px, of what is seen.
    kind : tuple of {"whole", "hidden", "split"}
        Whether the whole marker was seen, a part of it, or one that touches another.
    rejected : mapping of str to int
        Why other spots of the markers' colour are not among them.
    table : TablePlane or None
    """

    uv: FloatArray
    covariance_uv: FloatArray
    depth: FloatArray
    covariance_depth: FloatArray
    similarity: FloatArray
    area: FloatArray
    kind: tuple[Kind, ...]
    rejected: Mapping[str, int]
    table: TablePlane | None = None

    def __len__(self) -> int:
        return int(self.uv.shape[0])


@dataclass(frozen=True, eq=False)
class _Candidate:
    soft: SoftBlob
    similarity: float
    depth: float
    depth_variance: float
    near: FloatArray | None = None

    def depth_at(self, centre: FloatArray, radius: float, correlated: float) -> tuple[float, float]:
        """Depth and variance of the part of the blob about a centre, for markers that touch."""
        if self.near is None:
            return np.nan, np.nan
        v, u = np.mgrid[0 : self.near.shape[0], 0 : self.near.shape[1]]
        mask = (np.hypot(u - centre[0], v - centre[1]) < radius) & (self.soft.alpha > 0.5) & self.soft.window
        return disc_depth(self.near, mask, centre, correlated)


_Component = tuple[int, tuple[int, int, int, int, int]]
"""Label, and (left, top, width, height, area)."""


@dataclass(frozen=True, eq=False)
class _Look:
    """A reference colour as a table of seeds by :func:`chroma_index`: 1 perhaps the edge of a marker, 2 surely inside of one."""

    reference: ColourReference
    seeds: Any

    @classmethod
    def of(cls, reference: ColourReference, threshold: float) -> _Look:
        found = (reference.table >= threshold).astype(np.uint8)
        found += (reference.strict_table >= threshold).astype(np.uint8)
        seeds = np.zeros(1 << 16, dtype=np.uint8)
        seeds[: found.size] = found.ravel()
        return cls(reference, seeds)


class BlobDetector:
    """Finds markers of one colour.

    It remembers one thing from image to image: the lamp. When fewer than six blobs are found and the colours of the image have shifted
    as another lamp shifts them, the reference is shifted likewise and, if that finds more, kept so.

    Parameters
    ----------
    reference : ColourReference
        From :func:`factorgrasp.vision.learn_colour` or :func:`factorgrasp.vision.propose_colour`.
    settings : DetectorSettings, optional
    camera : Camera, optional
        With it and with depth the size of a marker is known; without, sizes are compared with each other only.
    """

    def __init__(
        self,
        reference: ColourReference,
        settings: DetectorSettings | None = None,
        camera: Camera | None = None,
    ) -> None:
        self.reference = reference
        self.settings = settings or DetectorSettings()
        self.camera = camera
        self._kernels: tuple[Any, ...] = ()
        self._looks = {(0.0, 0.0): _Look.of(reference, self.settings.threshold)}
        self._look = (0.0, 0.0)

    def detect(self, rgb: ArrayLike, depth: ArrayLike | None = None) -> DetectedBlobs:
        """The blobs of an image.

        Parameters
        ----------
        rgb : ndarray of uint8, shape (h, w, 3)
        depth : ndarray, shape (h, w), optional
            m along the optical axis, registered to the colours; 0 or NaN where missing.

        Raises
        ------
        InputError
            When the image is not 8-bit colour, or its size is neither the depth's nor the camera's.
        """
        cv2 = load_cv2()
        if not self._kernels:
            self._kernels = tuple(_kernel(cv2, radius) for radius in (1, 3, 6))
        image = check_rgb(rgb)
        size = image.shape[:2]
        if self.camera is not None and size != (self.camera.height, self.camera.width):
            raise InputError(
                "rgb",
                f"images of the camera's size, {self.camera.width} x {self.camera.height}",
                f"{size[1]} x {size[0]}",
                "Intrinsics hold for one resolution only",
            )
        z = None if depth is None else check_depth(depth, (size[0], size[1]))
        if self.settings.region == "depth" and z is None:
            raise InputError("depth", "a depth image, since region = 'depth'", "none")
        table = None
        if z is not None and self.settings.region in ("auto", "depth"):
            table = fit_table(z)
        index = chroma_index(image, cv2)
        look = self._looks[self._look]
        blobs = self._detect(image, z, table, index, look, cv2)
        if table is not None and len(blobs) < 3 and blobs.rejected.get("on the table", 0) >= 3:
            # A hand pressed flat on the table, or a plane that is the hand's: markers on it are markers if they are on skin and alike.
            flat = self._detect(image, z, None, index, look, cv2)
            if len(flat) > 3 and flat.kind.count("whole") > 3:
                return flat
        if len(blobs) < _FEW:
            blobs = self._try_other_light(blobs, image, z, table, index, cv2)
        return blobs

    def _try_other_light(
        self, blobs: DetectedBlobs, image: ByteImage, z: Any, table: TablePlane | None, index: Any, cv2: Any
    ) -> DetectedBlobs:
        """More blobs, if the image looks as if the lamp had changed and the reference, shifted accordingly, finds more."""
        shift = light_shift(mean_chroma(image) - self.reference.background_mean)
        name = (round(float(shift[0]), 1), round(float(shift[1]), 1))
        if np.hypot(name[0] - self._look[0], name[1] - self._look[1]) < NOTICEABLE:
            return blobs
        if name not in self._looks:
            self._looks[name] = _Look.of(self.reference.shifted(np.array(name)), self.settings.threshold)
        other = self._detect(image, z, table, index, self._looks[name], cv2)
        if len(other) < max(3, len(blobs) + 1):
            return blobs
        self._look = name
        return other

    def _detect(
        self, image: ByteImage, z: Any, table: TablePlane | None, index: Any, look: _Look, cv2: Any
    ) -> DetectedBlobs:
        seeds = look.seeds.take(index)
        rejected: Counter[str] = Counter()
        candidates = self._candidates(image, z, table, seeds, look.reference, rejected, cv2)
        return self._finish(candidates, rejected, table)

    def _candidates(
        self,
        image: ByteImage,
        z: Any,
        table: TablePlane | None,
        seeds: Any,
        reference: ColourReference,
        rejected: Counter[str],
        cv2: Any,
    ) -> list[_Candidate]:
        """Connected components that pass every test which needs no other blob."""
        s = self.settings
        most = int(s.largest_share * seeds.size)
        labels, stats = _components(seeds, s.least_pixels, most, cv2)
        if table is not None and stats:
            kept = self._clear_of(table, z, stats)
            rejected["on the table"] += len(stats) - len(kept)
            stats = kept
        out = []
        for label, (left, top, width, height, area) in stats[:_MOST_EXAMINED]:
            if area > most:
                rejected["too large"] += 1
                continue
            rows = slice(max(top - _MARGIN, 0), min(top + height + _MARGIN, image.shape[0]))
            columns = slice(max(left - _MARGIN, 0), min(left + width + _MARGIN, image.shape[1]))
            found = self._examine(image[rows, columns], labels[rows, columns], label, reference, cv2)
            if found is None:
                rejected["no contrast"] += 1
                continue
            inside, ring, window, similarity = found
            if similarity < s.least_similarity:
                rejected["other colour"] += 1
                continue
            corner = np.array([columns.start, rows.start], dtype=float)
            near = None if z is None else metres(z[rows, columns])
            if (
                table is not None
                and near is not None
                and not self._above(table, near, inside, window, corner)
            ):
                rejected["on the table"] += 1
                continue
            if table is None and s.region in ("auto", "skin") and not _on_skin(image[rows, columns][ring]):
                rejected["not on skin"] += 1
                continue
            soft = soften(image[rows, columns], inside, ring, window, corner)
            if soft is None:
                rejected["no contrast"] += 1
                continue
            value, variance = np.nan, np.nan
            if near is not None:
                value, variance = disc_depth(
                    near, window & (soft.alpha > 0.5), soft.centroid, s.depth_correlation
                )
                if table is not None and table.depth(corner + soft.centroid) - value < s.least_height:
                    rejected["on the table"] += 1
                    continue
            out.append(_Candidate(soft, similarity, value, variance, near))
        return out

    def _examine(
        self, rgb: ByteImage, labels: Any, label: int, reference: ColourReference, cv2: Any
    ) -> tuple[BoolArray, BoolArray, BoolArray, float] | None:
        """Pixels of a component, its ring and its window, and its similarity with the reference."""
        inside = labels == label
        mine = inside.astype(np.uint8)
        others = ((labels != 0) & ~inside).astype(np.uint8)
        small, medium, wide = self._kernels
        window = cv2.dilate(mine, medium).astype(bool)
        taken = cv2.dilate(others, medium).astype(bool)
        ring = cv2.dilate(mine, wide).astype(bool) & ~window & ~taken
        if taken.any():
            # What lies between two blobs belongs to the nearer one.
            own = cv2.distanceTransform(1 - mine, cv2.DIST_L2, 3)
            other = cv2.distanceTransform(1 - others, cv2.DIST_L2, 3)
            window &= own <= other
        if ring.sum() < 8:
            return None
        core = cv2.erode(mine, small).astype(bool)
        core = core if core.sum() >= 4 else inside
        logs = LOG_LIGHT[rgb[core]].astype(float) / LOG_STEPS
        similarity = reference.similarity(logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1])
        return inside, ring, window, similarity

    def _clear_of(self, table: TablePlane, z: Any, stats: list[_Component]) -> list[_Component]:
        """Components but for those whose middle certainly is on the table: cheap, before any is examined."""
        boxes = np.array([box for _, box in stats])
        middle = boxes[:, :2] + boxes[:, 2:4] // 2
        near = np.arange(-1, 2)
        u = np.clip(middle[:, 0, None, None] + near[None, None, :], 0, z.shape[1] - 1)
        v = np.clip(middle[:, 1, None, None] + near[None, :, None], 0, z.shape[0] - 1)
        values = metres(z[v, u]).reshape(len(stats), 9)
        values = np.sort(np.where(np.isfinite(values), values, -np.inf), axis=1)
        # With most of nine pixels known, the fifth largest is the median or nearer than it.
        low = table.depth(middle.astype(float)) - values[:, 4] < 0.5 * self.settings.least_height
        return [item for item, on_table in zip(stats, low, strict=True) if not on_table]

    def _above(
        self, table: TablePlane, near: FloatArray, inside: BoolArray, window: BoolArray, corner: FloatArray
    ) -> bool:
        """Whether the pixels of a blob are above the table; a blob without any depth is given the benefit of the doubt."""
        mask, values = inside, near[inside & np.isfinite(near)]
        if values.size < 3:
            mask, values = window, near[window & np.isfinite(near)]
        if values.size < 3:
            return True
        v, u = np.nonzero(mask)
        middle = corner + np.array([u.mean(), v.mean()])
        return bool(float(table.depth(middle)) - float(median(values)) > self.settings.least_height)

    def _finish(
        self, candidates: list[_Candidate], rejected: Counter[str], table: TablePlane | None
    ) -> DetectedBlobs:
        """Sizes compared with each other: what is whole, hidden, merged or no marker."""
        alike = max((c.similarity for c in candidates), default=0.0) * _LEAST_ALIKE
        rejected["other colour"] += sum(c.similarity < alike for c in candidates)
        candidates = [c for c in candidates if c.similarity >= alike]
        scale = _scales(candidates)
        expected, votes = _consensus(candidates, scale)
        # Several whole markers know their size better than the settings do.
        sure = votes >= _SURE
        if not sure and self.camera is not None and self.settings.marker_diameter > 0.0:
            known = palm_moment(candidates, self.camera, self.settings.marker_diameter)
            # Were most markers half hidden, they would agree on a size that is too small.
            if known is not None and (
                expected is None or np.linalg.det(expected) < 0.6 * np.linalg.det(known)
            ):
                expected = known
        rows: list[tuple[FloatArray, FloatArray, _Candidate, Kind]] = []
        for candidate, factor in zip(candidates, scale, strict=True):
            soft = candidate.soft
            moment = None if expected is None else expected / factor
            most = np.inf if sure else self._largest(candidate)
            if moment is None and soft.area > 1.35 * most:
                # Nothing to compare with: the known diameter bounds a marker, seen from whichever side.
                moment = np.eye(2) * most / (4.0 * np.pi)
            if moment is not None:
                share = soft.area / float(4.0 * np.pi * np.sqrt(np.linalg.det(moment)))
                if not _SHARES[0] <= share <= _SHARES[1]:
                    rejected["other size"] += 1
                    continue
            centres = [] if soft.area > _SHARES[1] * most else self._centres(soft, moment)
            rejected["other shape"] += not centres
            for found, kind in centres:
                part = candidate
                if kind == "split":
                    radius = 0.9 * np.sqrt(soft.area / (np.pi * len(centres)))
                    value = candidate.depth_at(found.centre, radius, self.settings.depth_correlation)
                    part = replace(candidate, depth=value[0], depth_variance=value[1])
                rows.append((soft.corner + found.centre, found.covariance, part, kind))
        rows.sort(key=lambda row: -row[2].similarity)
        rows = rows[: self.settings.most_blobs]
        depth = np.array([row[2].depth for row in rows], dtype=float)
        variance = np.array([row[2].depth_variance for row in rows], dtype=float)
        return DetectedBlobs(
            np.array([row[0] for row in rows], dtype=float).reshape(-1, 2),
            np.array([row[1] for row in rows], dtype=float).reshape(-1, 2, 2),
            depth,
            np.where(np.isfinite(depth), variance, _UNKNOWN_DEPTH_VARIANCE),
            np.array([row[2].similarity for row in rows], dtype=float),
            np.array([row[2].soft.area for row in rows], dtype=float),
            tuple(row[3] for row in rows),
            {reason: number for reason, number in rejected.items() if number},
            table,
        )

    def _largest(self, candidate: _Candidate) -> float:
        """Area of a marker seen face on at the blob's depth, px; infinite when that is not known."""
        if self.camera is None or not np.isfinite(candidate.depth) or self.settings.marker_diameter == 0.0:
            return np.inf
        radius = 0.5 * self.settings.marker_diameter / candidate.depth
        return float(np.pi * radius**2 * self.camera.fx * self.camera.fy)

    def _centres(self, soft: SoftBlob, moment: FloatArray | None) -> list[tuple[FittedCentre, Kind]]:
        """The centres in one blob, with covariances that hold for what was seen of them; none when it has no shape of markers."""
        long = soft.elongation > self.settings.greatest_elongation
        floor = self.settings.centroid_sd**2 * np.eye(2)
        plain = FittedCentre(soft.centroid, soft.covariance + floor, 1.0, 0.0)
        if moment is not None:
            # A sliver may be hidden without being noticed.
            radius = float(np.linalg.det(4.0 * moment)) ** 0.25
            missing = max(0.98 - soft.area / (np.pi * radius**2), 0.0)
            # A marker drawn out by motion blends with what is beside it.
            drawn = 0.1 * radius * max(soft.elongation - 1.5, 0.0)
            more = (0.4 * radius * missing) ** 2 + drawn**2
            plain = replace(plain, covariance=plain.covariance + more * np.eye(2))
        if moment is None:
            # Nothing tells a part of a disc from a slanted one: an elongated blob may be either.
            if long:
                return []
            doubt = 0.08 * np.sqrt(soft.area) * max(soft.elongation - 1.3, 0.0)
            widened = FittedCentre(soft.centroid, plain.covariance + doubt**2 * np.eye(2), 1.0, 0.0)
            return [(widened, "whole")]
        share = soft.area / float(4.0 * np.pi * np.sqrt(np.linalg.det(moment)))
        if share > 1.45:
            parts = split_blob(soft, moment, 2 if share < 2.45 else 3)
            apart = min(np.linalg.norm(a.centre - b.centre) for a in parts for b in parts if a is not b)
            if apart > 0.7 * np.sqrt(soft.area / len(parts)) and parts[0].rms < _POOR_SPLIT:
                rest = self.settings.hidden_sd**2 * 0.4 * np.eye(2)
                return [(FittedCentre(p.centre, p.covariance + rest, 1.0, p.rms), "split") for p in parts]
        if long:
            return []
        if _WHOLE[0] <= share <= _WHOLE[1] and outline_rms(soft.outline, moment, soft.centroid) < _ROUGH:
            return [(plain, "whole")]
        fitted = fit_outline(soft.outline, moment, soft.middle)
        off = float(np.linalg.norm(fitted.centre - soft.centroid))
        if share >= _WHOLE[0] - 0.1 and off < _SHIFT:
            return [(plain, "whole")]
        hidden = self.settings.hidden_sd**2 * np.eye(2)
        return [(FittedCentre(fitted.centre, fitted.covariance + hidden, fitted.share, fitted.rms), "hidden")]


def _components(seeds: Any, least: int, most: int, cv2: Any) -> tuple[Any, list[_Component]]:
    """Connected components: labels (h, w), and label and (left, top, width, height, area) of each, the largest first.

    A component with several sure insides, or one that is too large, falls into its sure insides: markers whose edges touch, or a
    marker beside a large thing of a similar colour.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(seeds, 8, cv2.CV_16U, cv2.CCL_BBDT)
    area = stats[:, cv2.CC_STAT_AREA]
    chosen = [int(label) for label in np.flatnonzero(area >= least) if label != 0]
    chosen = sorted(chosen, key=lambda label: -int(area[label]))[:_MOST_COMPONENTS]
    out = []
    following = int(stats.shape[0])
    for label in chosen:
        left, top, width, height, count = (int(value) for value in stats[label])
        box = (slice(top, top + height), slice(left, left + width))
        if count >= _SEVERAL:
            sure = ((labels[box] == label) & (seeds[box] == 2)).astype(np.uint8)
            found, inner, parts, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
                sure, 8, cv2.CV_16U, cv2.CCL_BBDT
            )
            sound = [i for i in range(1, found) if parts[i, cv2.CC_STAT_AREA] >= max(least, 4)]
            core = sum(int(parts[i, cv2.CC_STAT_AREA]) for i in sound)
            # Grey cloth has the colour of a marker's edge, and joins the marker that it half hides.
            fuzzy = count > most or count > _MOST_FUZZY * core
            if sound and (len(sound) > 1 or fuzzy) and following + len(sound) < 60_000:
                labels[box][labels[box] == label] = 0
                for i in sound:
                    labels[box][inner == i] = following
                    x, y, w, h, n = (int(value) for value in parts[i])
                    out.append((following, (left + x, top + y, w, h, n)))
                    following += 1
                continue
        out.append((label, (left, top, width, height, count)))
    return labels, sorted(out, key=lambda item: -item[1][4])


def _kernel(cv2: Any, radius: int) -> Any:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _on_skin(pixels: ByteImage) -> bool:
    """Whether most of the pixels are redder than blue, as skin of every tone is (and wood, and more)."""
    logs = LOG_LIGHT[pixels].astype(float) / LOG_STEPS
    return bool(np.mean(logs[:, 0] - logs[:, 2] > 0.2) > 0.5)


def _scales(candidates: list[_Candidate]) -> FloatArray:
    """Factor (k,) by which an area is to be multiplied to compare it with the others: they shrink with distance squared."""
    depth = np.array([candidate.depth for candidate in candidates], dtype=float)
    if not np.isfinite(depth).any():
        return np.ones(depth.size)
    middle = float(np.nanmedian(depth))
    return np.asarray((np.where(np.isfinite(depth), depth, middle) / middle) ** 2)


def _elliptic(soft: SoftBlob) -> bool:
    """Whether the outline of a blob is an ellipse, as that of a whole marker is."""
    rough = max(0.2, 0.045 * np.sqrt(soft.area))
    if soft.elongation < _ROUND:
        return True
    return soft.elongation < 2.5 and outline_rms(soft.outline, soft.moment, soft.middle) < rough


def palm_moment(candidates: list[_Candidate], camera: Camera, diameter: float) -> FloatArray | None:
    """Second moment (2, 2) of a disc of known diameter that lies in the plane of the blobs, at their middle distance, px^2.

    None unless four blobs with depth span a plane that the camera sees from above.
    """
    known = [c for c in candidates if np.isfinite(c.depth)]
    if len(known) < 4:
        return None
    uv = np.array([c.soft.corner + c.soft.centroid for c in known])
    points = camera.back_project(uv, np.array([c.depth for c in known]))
    middle = np.median(points, axis=0)
    _, spread, axes = np.linalg.svd(points - points.mean(axis=0))
    if spread[1] < 0.01 or spread[2] > 0.4 * spread[1]:
        return None
    normal = axes[2]
    if abs(normal @ middle) < 0.35 * np.linalg.norm(middle):
        return None
    _, J = camera.project_with_jacobian(middle)
    within = np.eye(3) - np.outer(normal, normal)
    return np.asarray(diameter**2 / 16.0 * J @ within @ J.T)


def _consensus(candidates: list[_Candidate], scale: FloatArray) -> tuple[FloatArray | None, int]:
    """Second moment (2, 2) of a whole marker at the middle distance, from the size that most blobs share, and their number."""
    if len(candidates) < 2:
        return None, 0
    area = np.array([candidate.soft.area for candidate in candidates]) * scale
    round_ = np.array([_elliptic(candidate.soft) for candidate in candidates])
    if round_.sum() < 2:
        return None, 0
    shape = np.array([c.soft.moment / np.sqrt(np.linalg.det(c.soft.moment)) for c in candidates])
    # Halves of discs are as large as each other, but cut in different directions.
    other = np.linalg.norm(shape[:, None] - shape[None], axis=(2, 3)) > 0.5
    alike = (np.abs(np.log(area[:, None] / area[None])) < 0.22) & ~other & round_[:, None] & round_[None]
    votes = alike.sum(axis=1) + 1e-6 * area / area.max()
    best = int(np.argmax(votes))
    members = np.flatnonzero(alike[best])
    if members.size < 2:
        return None, 0
    moments = np.array([candidates[i].soft.moment * scale[i] for i in members])
    return np.asarray(np.median(moments, axis=0)), int(members.size)

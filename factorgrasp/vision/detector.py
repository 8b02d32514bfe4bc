"""Markers in one RGB or RGB-D image: unlabelled blobs with sub-pixel centroids, depths and their covariances."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.typing import BoolArray, FloatArray
from factorgrasp.vision.blob_centres import blob_centres
from factorgrasp.vision.blob_depth import disc_depth
from factorgrasp.vision.blob_sizes import area_scales, common_size, largest_area, palm_moment
from factorgrasp.vision.blobs import Candidate, DetectedBlobs, Kind
from factorgrasp.vision.colour import ColourReference
from factorgrasp.vision.components import Component, find_components
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
from factorgrasp.vision.settings import DetectorSettings
from factorgrasp.vision.soft_blob import soften
from factorgrasp.vision.table_plane import TablePlane, fit_table

_MARGIN = 8
_MOST_EXAMINED = 40
_UNKNOWN_DEPTH_VARIANCE = 1.0
_LEAST_ALIKE = 0.5
"""Similarity relative to the most similar blob: all markers are in the same light."""
_SHARES = (0.22, 3.6)
"""Area of anything that may be markers."""
_SURE = 3
"""Whole markers of one size that settle it."""
_LONGEST = 5.0
"""Square of a component's extent relative to the largest area: discs have 1.3, ellipses of ratio 3.5 have 4.5."""
_SPARSEST = 0.2
"""Share of its box that a component fills: a disc 0.79, the halves of two that touch 0.5."""
_FEW = 6
"""Blobs: with fewer, another lamp is considered."""


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
    ) -> list[Candidate]:
        """Connected components that pass every test which needs no other blob."""
        s = self.settings
        most = int(s.largest_share * seeds.size)
        labels, stats = find_components(seeds, s.least_pixels, most, cv2)
        if table is not None and stats:
            kept = self._clear_of(table, z, stats)
            rejected["on the table"] += len(stats) - len(kept)
            stats = kept
        out = []
        for label, (left, top, width, height, area) in stats[:_MOST_EXAMINED]:
            if area > most or max(width, height) ** 2 > _LONGEST * most:
                rejected["too large"] += 1
                continue
            if area < _SPARSEST * width * height:
                rejected["other shape"] += 1
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
            out.append(Candidate(soft, similarity, value, variance, near))
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

    def _clear_of(self, table: TablePlane, z: Any, stats: list[Component]) -> list[Component]:
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
        self, candidates: list[Candidate], rejected: Counter[str], table: TablePlane | None
    ) -> DetectedBlobs:
        """Sizes compared with each other: what is whole, hidden, merged or no marker."""
        alike = max((c.similarity for c in candidates), default=0.0) * _LEAST_ALIKE
        rejected["other colour"] += sum(c.similarity < alike for c in candidates)
        candidates = [c for c in candidates if c.similarity >= alike]
        scale = area_scales(candidates)
        expected, votes = common_size(candidates, scale)
        # Several whole markers know their size better than the settings do.
        sure = votes >= _SURE
        if not sure and self.camera is not None and self.settings.marker_diameter > 0.0:
            known = palm_moment(candidates, self.camera, self.settings.marker_diameter)
            # Were most markers half hidden, they would agree on a size that is too small.
            if known is not None and (
                expected is None or np.linalg.det(expected) < 0.6 * np.linalg.det(known)
            ):
                expected = known
        rows: list[tuple[FloatArray, FloatArray, Candidate, Kind]] = []
        for candidate, factor in zip(candidates, scale, strict=True):
            soft = candidate.soft
            moment = None if expected is None else expected / factor
            most = np.inf if sure else largest_area(candidate, self.camera, self.settings.marker_diameter)
            if moment is None and soft.area > 1.35 * most:
                # Nothing to compare with: the known diameter bounds a marker, seen from whichever side.
                moment = np.eye(2) * most / (4.0 * np.pi)
            if moment is not None:
                share = soft.area / float(4.0 * np.pi * np.sqrt(np.linalg.det(moment)))
                if not _SHARES[0] <= share <= _SHARES[1]:
                    rejected["other size"] += 1
                    continue
            centres = [] if soft.area > _SHARES[1] * most else blob_centres(soft, moment, self.settings)
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


def _kernel(cv2: Any, radius: int) -> Any:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _on_skin(pixels: ByteImage) -> bool:
    """Whether most of the pixels are redder than blue, as skin of every tone is (and wood, and more)."""
    logs = LOG_LIGHT[pixels].astype(float) / LOG_STEPS
    return bool(np.mean(logs[:, 0] - logs[:, 2] > 0.2) > 0.5)

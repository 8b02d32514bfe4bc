"""What a detector returns, and what it holds on the way there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from factorgrasp.typing import FloatArray
from factorgrasp.vision.blob_depth import disc_depth
from factorgrasp.vision.soft_blob import SoftBlob
from factorgrasp.vision.table_plane import TablePlane

Kind = Literal["whole", "hidden", "split"]


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
class Candidate:
    """A blob that passed every test which needs no other blob; its depth window is kept for touching markers."""

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

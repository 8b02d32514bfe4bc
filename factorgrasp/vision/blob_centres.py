"""The centres of the markers in one blob: its centroid, the centre of an outline that is partly hidden, or several."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgrasp.typing import FloatArray
from factorgrasp.vision.blobs import Kind
from factorgrasp.vision.outline_fit import FittedCentre, fit_outline, outline_rms, split_blob
from factorgrasp.vision.settings import DetectorSettings
from factorgrasp.vision.soft_blob import SoftBlob

_WHOLE = (0.93, 1.30)
"""Area of a whole marker relative to what is expected."""
_POOR_SPLIT = 0.2
"""Root mean square of alpha's residuals from which a blob is no union of markers."""
_ROUGH = 0.33
"""px: an outline that fits that well about the centroid is that of a whole marker, no search needed."""
_SHIFT = 0.12
"""px: a centroid that differs that much from the fitted outline's centre is that of a part of a marker."""


def blob_centres(
    soft: SoftBlob, moment: FloatArray | None, settings: DetectorSettings
) -> list[tuple[FittedCentre, Kind]]:
    """The centres in one blob, with covariances that hold for what was seen of them; none when it has no shape of markers."""
    long = soft.elongation > settings.greatest_elongation
    floor = settings.centroid_sd**2 * np.eye(2)
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
            rest = settings.hidden_sd**2 * 0.4 * np.eye(2)
            return [(FittedCentre(p.centre, p.covariance + rest, 1.0, p.rms), "split") for p in parts]
    if long:
        return []
    if _WHOLE[0] <= share <= _WHOLE[1] and outline_rms(soft.outline, moment, soft.centroid) < _ROUGH:
        return [(plain, "whole")]
    fitted = fit_outline(soft.outline, moment, soft.middle)
    off = float(np.linalg.norm(fitted.centre - soft.centroid))
    if share >= _WHOLE[0] - 0.1 and off < _SHIFT:
        return [(plain, "whole")]
    hidden = settings.hidden_sd**2 * np.eye(2)
    return [(FittedCentre(fitted.centre, fitted.covariance + hidden, fitted.share, fitted.rms), "hidden")]

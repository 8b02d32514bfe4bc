"""Connected components of seed pixels, those of several markers taken apart."""

from __future__ import annotations

from typing import Any

import numpy as np

_SEVERAL = 24
"""px: a component of that size may be several markers."""
_MOST_FUZZY = 3.5
"""Size of a component relative to its sure inside from which only the inside is taken."""
_MOST_PARTS = 30
"""Of one component: denim in noise has thousands."""
MOST = 200
"""Components that are looked at."""

Component = tuple[int, tuple[int, int, int, int, int]]
"""Label, and (left, top, width, height, area)."""


def find_components(seeds: Any, least: int, most: int, cv2: Any) -> tuple[Any, list[Component]]:
    """Connected components: labels (h, w), and label and (left, top, width, height, area) of each, the largest first.

    A component with several sure insides, or one that is too large, falls into its sure insides: markers whose edges touch, or a
    marker beside a large thing of a similar colour.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(seeds, 8, cv2.CV_16U, cv2.CCL_BBDT)
    area = stats[:, cv2.CC_STAT_AREA]
    chosen = [int(label) for label in np.flatnonzero(area >= least) if label != 0]
    chosen = sorted(chosen, key=lambda label: -int(area[label]))[:MOST]
    out = []
    following = int(stats.shape[0])
    for label in chosen:
        left, top, width, height, count = (int(value) for value in stats[label])
        box = (slice(top, top + height), slice(left, left + width))
        if count >= _SEVERAL:
            sure = ((labels[box] == label) & (seeds[box] == 2)).astype(np.uint8)
            _, inner, parts, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
                sure, 8, cv2.CV_16U, cv2.CCL_BBDT
            )
            sizes = parts[:, cv2.CC_STAT_AREA].copy()
            sizes[0] = 0
            sound = np.flatnonzero(sizes >= max(least, 4))
            sound = sound[np.argsort(-sizes[sound], kind="stable")][:_MOST_PARTS]
            core = int(sizes[sound].sum())
            # Grey cloth has the colour of a marker's edge, and joins the marker that it half hides.
            fuzzy = count > most or count > _MOST_FUZZY * core
            if sound.size and (sound.size > 1 or fuzzy) and following + sound.size < 60_000:
                labels[box][labels[box] == label] = 0
                for i in sound:
                    x, y, w, h, n = (int(value) for value in parts[i])
                    place = (slice(y, y + h), slice(x, x + w))
                    labels[box][place][inner[place] == i] = following
                    out.append((following, (left + x, top + y, w, h, n)))
                    following += 1
                continue
        out.append((label, (left, top, width, height, count)))
    return labels, sorted(out, key=lambda item: -item[1][4])

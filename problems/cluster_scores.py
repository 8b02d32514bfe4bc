"""Covariance of a gradient whose residuals are correlated in time: from the scatter of its parts over stretches of the recording."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from factorgrasp.typing import FloatArray, IntArray

# One stretch may hold nearly all that is known of a direction; the others then cannot vouch for it more than this.
_LARGEST_LEVERAGE = 0.9


def cluster_score_covariance(
    rows: FloatArray, residual: FloatArray, cluster: IntArray, prior: FloatArray
) -> FloatArray:
    """``M`` (n, n) of the sandwich ``H^-1 M H^-1``, ``H = rows' rows + prior``.

    Parameters
    ----------
    rows : (m, n) ndarray
        Whitened, robustly weighted Jacobian of the data.
    residual : (m,) ndarray
        Likewise whitened and weighted.
    cluster : (m,) ndarray of int
        The stretch of every row; residuals of different stretches count as independent.
    prior : (n, n) ndarray
        Information of the priors, positive semidefinite.

    Notes
    -----
    The score of a stretch is made larger by its leverage, ``(I - H_c H^-1)^-1 s_c``, which makes the sum the delete-one-stretch
    jackknife (CR3: Bell and McCaffrey 2002). A dozen scores do not tell a whole matrix: in coordinates where ``H = I`` it is drawn
    towards a common factor times the data's information (the variance factor), by as much as the scores' own scatter asks for
    (Ledoit and Wolf 2004).
    """
    labels, index = np.unique(cluster, return_inverse=True)
    order = np.argsort(index, kind="stable")
    bounds = np.searchsorted(index[order], np.arange(labels.size + 1))
    parts = [order[a:b] for a, b in pairwise(bounds)]
    informations = np.array([rows[part].T @ rows[part] for part in parts])
    scores = np.array([rows[part].T @ residual[part] for part in parts])
    data = informations.sum(axis=0)
    # A unit diagonal first: metres, radians and seconds stand side by side.
    scale = np.sqrt(np.maximum(np.diag(data + prior), 1e-300))
    values, vectors = np.linalg.eigh((data + prior) / np.outer(scale, scale))
    kept = values > 1e-13 * values[-1]
    # root' H root = I, on the directions that anything informs.
    root = (vectors[:, kept] / np.sqrt(values[kept])) / scale[:, None]
    back = (vectors[:, kept] * np.sqrt(values[kept])) * scale[:, None]
    leverage, axes = np.linalg.eigh(root.T @ informations @ root)
    grown = 1.0 / (1.0 - np.clip(leverage, 0.0, _LARGEST_LEVERAGE))
    white = scores @ root
    white = np.einsum("cij,cj,ckj,ck->ci", axes, grown, axes, white)
    white_data = root.T @ data @ root
    count = len(parts)
    moment = white.T @ white * ((count - 1.0) / count)
    factor = float(np.trace(moment) / max(np.trace(white_data), 1e-300))
    share = _shrinkage(white, factor / count * white_data)
    drawn = share * factor * white_data + (1.0 - share) * moment
    out = back @ drawn @ back.T + prior
    return np.asarray(0.5 * (out + out.T))


def _shrinkage(scores: FloatArray, target: FloatArray) -> float:
    """Weight of `target` that minimises the expected Frobenius error of the mixture with ``scores' scores / count``."""
    count = scores.shape[0]
    moment = scores.T @ scores / count
    distance = float(np.sum((moment - target) ** 2))
    outer = np.einsum("ci,cj->cij", scores, scores)
    noise = float(np.sum((outer - moment) ** 2)) / count**2
    return min(noise / distance, 1.0) if distance > 0.0 else 1.0

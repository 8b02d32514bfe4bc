"""Covariances of a gradient that do not believe every row: residuals correlated in time, information that is only noise."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from factorgrasp.typing import FloatArray, IntArray

# Of the information in a direction this part may be noise; above, the direction counts as not excited at all.
_LARGEST_NOISE_SHARE = 0.5
_SMALLEST_SHARE = 1e-14
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
    root, back = white_coordinates(data + prior)
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


def without_noise_information(
    score: FloatArray, information: FloatArray, prior: FloatArray, noise: FloatArray
) -> FloatArray:
    """``M`` widened where measurement noise in the Jacobian itself only pretends to inform.

    Parameters
    ----------
    score : (n, n) ndarray
        ``M`` of the sandwich ``H^-1 M H^-1``.
    information : (n, n) ndarray
        ``H``, prior included.
    prior : (n, n) ndarray
        What is known without the data; it limits the widening.
    noise : (n, n) ndarray
        What noise in the Jacobian adds to ``H`` on average: ``E[dJ' W dJ]``.

    Notes
    -----
    Excitation has to be judged after taking the noise out (mathematics 2.3): a body that turns about one axis, measured with noise,
    seems to turn a little about all others, a thousand times over. In the directions where ``noise`` makes up the share ``r`` of ``H`` the
    variance is divided by ``1 - r``; where it is most of what the data offer, the prior alone is left.
    """
    root, back = white_coordinates(information)
    shares, axes = np.linalg.eigh(root.T @ noise @ root)
    known = np.einsum("ij,ik,kj->j", root @ axes, prior, root @ axes)
    drowned = shares > _LARGEST_NOISE_SHARE * (1.0 - known)
    left = np.where(
        drowned, np.maximum(known, _SMALLEST_SHARE), 1.0 - np.clip(shares, 0.0, _LARGEST_NOISE_SHARE)
    )
    widening = (axes / np.sqrt(left)) @ axes.T
    out = back @ widening @ (root.T @ score @ root) @ widening @ back.T
    return np.asarray(0.5 * (out + out.T))


def drowned_directions(information: FloatArray, prior: FloatArray, noise: FloatArray) -> FloatArray:
    """Rows (k, n) whose products with a tangent step are zero along all that the data inform: what noise alone seems to inform.

    A row is scaled so that one posterior standard deviation along its direction gives 1. Arguments as in :func:`without_noise_information`.
    """
    root, back = white_coordinates(information)
    shares, axes = np.linalg.eigh(root.T @ noise @ root)
    known = np.einsum("ij,ik,kj->j", root @ axes, prior, root @ axes)
    return np.asarray((back @ axes[:, shares > _LARGEST_NOISE_SHARE * (1.0 - known)]).T)


def white_coordinates(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``root`` and ``back`` (n, n) with ``root' H root = I`` and ``back root' = I``."""
    # A unit diagonal first: metres, radians and seconds stand side by side.
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    values = np.maximum(values, 1e-15 * values[-1])
    return (vectors / np.sqrt(values)) / scale[:, None], (vectors * np.sqrt(values)) * scale[:, None]

"""Marginal covariances of a chain of nodes that share some unknowns: block-tridiagonal information with a border, in O(n)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Chain:
    """Information of n nodes (D each) and a border (B).

    Attributes
    ----------
    diagonal : (n, D, D) ndarray
    upper : (n - 1, D, D) ndarray
        Between node k and node k + 1.
    border : (n, D, B) ndarray
    corner : (B, B) ndarray
    """

    diagonal: FloatArray
    upper: FloatArray
    border: FloatArray
    corner: FloatArray


@dataclass(frozen=True, eq=False)
class Marginals:
    """Covariances and, where a right-hand side was given, the solution.

    Attributes
    ----------
    nodes : (n, D, D) ndarray
    neighbours : (n - 1, D, D) ndarray
        Of node k with node k + 1.
    with_border : (n, D, B) ndarray
    border : (B, B) ndarray
    step : (n, D), border_step : (B,) ndarray
    """

    nodes: FloatArray
    neighbours: FloatArray
    with_border: FloatArray
    border: FloatArray
    step: FloatArray
    border_step: FloatArray


def marginals(chain: Chain, rhs: FloatArray | None = None, border_rhs: FloatArray | None = None) -> Marginals:
    """Block elimination forward, Takahashi's recursion backward.

    Raises
    ------
    numpy.linalg.LinAlgError
        When the information is singular.
    """
    count, D = chain.diagonal.shape[:2]
    B = chain.corner.shape[0]
    b = np.zeros((count, D)) if rhs is None else rhs
    c = np.zeros(B) if border_rhs is None else border_rhs
    # Columns [border, rhs] travel together through the elimination.
    tail = np.concatenate([chain.border, b[:, :, None]], axis=2)
    pivot_inverse = np.empty((count, D, D))
    gain = np.empty((max(count - 1, 0), D, D))
    eliminated = np.empty((count, D, B + 1))
    corner, right = chain.corner.copy(), c.copy()
    pivot, current = chain.diagonal[0], tail[0]
    for k in range(count):
        inverse = np.linalg.inv(pivot)
        inverse = 0.5 * (inverse + inverse.T)
        pivot_inverse[k] = inverse
        eliminated[k] = inverse @ current
        corner = corner - current[:, :B].T @ eliminated[k, :, :B]
        right = right - current[:, :B].T @ eliminated[k, :, B]
        if k + 1 < count:
            U = chain.upper[k]
            gain[k] = inverse @ U
            pivot = chain.diagonal[k + 1] - U.T @ gain[k]
            current = tail[k + 1] - U.T @ eliminated[k]
    border: FloatArray = np.asarray(np.linalg.inv(corner)) if B else np.zeros((0, 0))
    border_step = border @ right
    nodes, with_border = np.empty((count, D, D)), np.empty((count, D, B))
    neighbours, step = np.empty((max(count - 1, 0), D, D)), np.empty((count, D))
    for k in range(count - 1, -1, -1):
        E = eliminated[k, :, :B]
        if k + 1 < count:
            G = gain[k]
            neighbours[k] = -G @ nodes[k + 1] - E @ with_border[k + 1].T
            with_border[k] = -G @ with_border[k + 1] - E @ border
            nodes[k] = pivot_inverse[k] - G @ neighbours[k].T - E @ with_border[k].T
            step[k] = eliminated[k, :, B] - E @ border_step - G @ step[k + 1]
        else:
            with_border[k] = -E @ border
            nodes[k] = pivot_inverse[k] - E @ with_border[k].T
            step[k] = eliminated[k, :, B] - E @ border_step
        nodes[k] = 0.5 * (nodes[k] + nodes[k].T)
    return Marginals(nodes, neighbours, with_border, border, step, border_step)

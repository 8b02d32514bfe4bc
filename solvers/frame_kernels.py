"""Compiled inner loop of :mod:`factorgrasp.solvers.frames`: many least-squares problems of one pattern, several at a time.

The frames go through every loop in lockstep, `lanes` of them side by side in memory, so that one instruction serves several frames. All
index work (fill of the factor, where every product goes) is done beforehand: the loops hold no decision that depends on a value.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from factorgrasp.typing import FloatArray, IntArray


@cache
def load(lanes: int) -> Callable[..., None] | None:
    """The loop for so many frames side by side, compiled (or read from numba's cache) on first use; None without numba."""
    if find_spec("numba") is None:
        return None
    import numba

    source = _solver(lanes)
    try:
        return numba.njit(cache=True, error_model="numpy", fastmath={"contract"})(source)
    except RuntimeError:  # no writable place for the cache
        return numba.njit(error_model="numpy", fastmath={"contract"})(source)


def _solver(lanes: int) -> Any:
    def solve_frames(
        entries: FloatArray,
        rhs: FloatArray,
        indptr: IntArray,
        indices: IntArray,
        gram_target: IntArray,
        factor_indptr: IntArray,
        factor_rows: IntArray,
        update_target: IntArray,
        update_start: IntArray,
        place: IntArray,
        pair_place: IntArray,
        most_refinements: int,
        covariance: bool,
        x_out: FloatArray,
        variance_out: FloatArray,
        pair_out: FloatArray,
        info: FloatArray,
    ) -> None:
        frames, number = entries.shape
        height, size, below = rhs.shape[1], place.size, factor_rows.size
        a = np.empty((number) * lanes)
        b = np.empty((height) * lanes)
        r = np.empty((height) * lanes)
        L = np.empty((below + size) * lanes)
        Z = np.empty((below + size) * lanes)
        diagonal = np.empty((size) * lanes)
        x = np.empty((size) * lanes)
        g = np.empty((size) * lanes)
        sums = np.empty((size) * lanes)
        inverse = np.empty(lanes)
        total = np.empty(lanes)
        energy = np.empty(lanes)
        before = np.empty(lanes)
        floor = np.empty(lanes)
        state = np.empty(lanes)
        for first in range(0, frames, lanes):
            for w in range(lanes):
                frame = min(first + w, frames - 1)
                for e in range(number):
                    a[e * lanes + w] = entries[frame, e]
                for i in range(height):
                    b[i * lanes + w] = rhs[frame, i]
            # ---- normal equations, in factor order
            L[:] = 0.0
            pair = 0
            for i in range(height):
                for e in range(indptr[i], indptr[i + 1]):
                    for f in range(e, indptr[i + 1]):
                        t = gram_target[pair]
                        pair += 1
                        for w in range(lanes):
                            L[t * lanes + w] += a[e * lanes + w] * a[f * lanes + w]
            for j in range(size):
                for w in range(lanes):
                    diagonal[j * lanes + w] = L[(below + j) * lanes + w]
            # ---- L D L'
            for w in range(lanes):
                state[w] = 0.0
            for j in range(size):
                for w in range(lanes):
                    pivot = L[(below + j) * lanes + w]
                    if not pivot > 1e-15 * diagonal[j * lanes + w]:
                        state[w] = 1.0
                        pivot = max(diagonal[j * lanes + w], 1e-300)
                        L[(below + j) * lanes + w] = pivot
                    inverse[w] = 1.0 / pivot
                pair = update_start[j]
                if lanes == 1:
                    scale = inverse[0]
                    for p in range(factor_indptr[j], factor_indptr[j + 1]):
                        mine = L[p]
                        for q in range(factor_indptr[j], p):
                            # Entries before p are scaled already: with this one, not scaled yet, they make the update.
                            L[update_target[pair]] -= mine * L[q]
                            pair += 1
                        L[update_target[pair]] -= mine * mine * scale
                        pair += 1
                        L[p] = mine * scale
                    continue
                for p in range(factor_indptr[j], factor_indptr[j + 1]):
                    for w in range(lanes):
                        total[w] = L[p * lanes + w] * inverse[w]
                    for q in range(factor_indptr[j], p):
                        t = update_target[pair]
                        pair += 1
                        # Entries before p are scaled already: L D of them is what the update takes.
                        for w in range(lanes):
                            L[t * lanes + w] -= L[p * lanes + w] * L[q * lanes + w]
                    t = update_target[pair]
                    pair += 1
                    for w in range(lanes):
                        L[t * lanes + w] -= L[p * lanes + w] * total[w]
                        L[p * lanes + w] = total[w]
            # ---- solve and refine through A
            x[:] = 0.0
            for w in range(lanes):
                total[w] = 0.0
                before[w] = np.inf
            for i in range(height):
                for w in range(lanes):
                    total[w] += b[i * lanes + w] * b[i * lanes + w]
                    r[i * lanes + w] = b[i * lanes + w]
            for w in range(lanes):
                floor[w] = max(1e-9, 1e-14 * np.sqrt(total[w]))
            for step in range(most_refinements + 1):
                g[:] = 0.0
                for i in range(height):
                    for e in range(indptr[i], indptr[i + 1]):
                        t = place[indices[e]]
                        for w in range(lanes):
                            g[t * lanes + w] += a[e * lanes + w] * r[i * lanes + w]
                for j in range(size):
                    for p in range(factor_indptr[j], factor_indptr[j + 1]):
                        t = factor_rows[p]
                        for w in range(lanes):
                            g[t * lanes + w] -= L[p * lanes + w] * g[j * lanes + w]
                for j in range(size - 1, -1, -1):
                    for w in range(lanes):
                        g[j * lanes + w] /= L[(below + j) * lanes + w]
                    for p in range(factor_indptr[j], factor_indptr[j + 1]):
                        t = factor_rows[p]
                        for w in range(lanes):
                            g[j * lanes + w] -= L[p * lanes + w] * g[t * lanes + w]
                for w in range(lanes):
                    energy[w] = 0.0
                for i in range(height):
                    for w in range(lanes):
                        total[w] = 0.0
                    for e in range(indptr[i], indptr[i + 1]):
                        t = place[indices[e]]
                        for w in range(lanes):
                            total[w] += a[e * lanes + w] * g[t * lanes + w]
                    for w in range(lanes):
                        r[i * lanes + w] -= total[w]
                        energy[w] += total[w] * total[w]
                for j in range(size):
                    for w in range(lanes):
                        x[j * lanes + w] += g[j * lanes + w]
                settled = step > 0
                for w in range(lanes):
                    energy[w] = np.sqrt(energy[w])
                    done = energy[w] <= floor[w] or energy[w] * energy[w] <= floor[w] * before[w]
                    if not done:
                        settled = False
                    if step == most_refinements and not done:
                        state[w] = max(state[w], 2.0)
                    before[w] = energy[w]
                if settled:
                    break
            for w in range(lanes):
                if first + w < frames:
                    for j in range(size):
                        x_out[first + w, j] = x[place[j] * lanes + w]
                    info[first + w, 0] = state[w]
            if not covariance:
                continue
            # ---- selected inverse
            for j in range(size - 1, -1, -1):
                start, stop = factor_indptr[j], factor_indptr[j + 1]
                for p in range(start, stop):
                    for w in range(lanes):
                        sums[(p - start) * lanes + w] = 0.0
                pair = update_start[j]
                if lanes == 1:
                    for p in range(start, stop):
                        mine, sum_here = L[p], 0.0
                        for q in range(start, p):
                            z = Z[update_target[pair]]
                            pair += 1
                            sum_here += z * L[q]
                            sums[q - start] += z * mine
                        sums[p - start] += sum_here + Z[update_target[pair]] * mine
                        pair += 1
                    whole = 1.0 / L[below + j]
                    for p in range(start, stop):
                        Z[p] = -sums[p - start]
                        whole += L[p] * sums[p - start]
                    Z[below + j] = whole
                    continue
                for p in range(start, stop):
                    for q in range(start, p):
                        t = update_target[pair]
                        pair += 1
                        for w in range(lanes):
                            sums[(p - start) * lanes + w] += Z[t * lanes + w] * L[q * lanes + w]
                            sums[(q - start) * lanes + w] += Z[t * lanes + w] * L[p * lanes + w]
                    t = update_target[pair]
                    pair += 1
                    for w in range(lanes):
                        sums[(p - start) * lanes + w] += Z[t * lanes + w] * L[p * lanes + w]
                for w in range(lanes):
                    total[w] = 1.0 / L[(below + j) * lanes + w]
                for p in range(start, stop):
                    for w in range(lanes):
                        Z[p * lanes + w] = -sums[(p - start) * lanes + w]
                        total[w] += L[p * lanes + w] * sums[(p - start) * lanes + w]
                for w in range(lanes):
                    Z[(below + j) * lanes + w] = total[w]
            for w in range(lanes):
                if first + w < frames:
                    spread = 0.0
                    for j in range(size):
                        variance_out[first + w, j] = Z[(below + place[j]) * lanes + w]
                        spread += Z[(below + j) * lanes + w] * diagonal[j * lanes + w]
                    info[first + w, 1] = spread
                    for k in range(pair_place.size):
                        pair_out[first + w, k] = Z[pair_place[k] * lanes + w]

    return solve_frames

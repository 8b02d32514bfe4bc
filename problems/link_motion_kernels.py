"""Compiled kinematics of a tree of joints, used where numba is installed (extra ``fast``); numpy does the same work without it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from factorgrasp.typing import FloatArray, IntArray

KINDS = {"revolute": 0, "unbounded": 1, "prismatic": 2, "spherical": 3, "freeflyer": 4, "translation": 5}
"""Joints that the loop knows, by their number in it."""


class Kernels(NamedTuple):
    """The compiled functions, see their sources below."""

    kinematics: Callable[..., None]
    velocity_wrench: Callable[..., None]
    centripetal: Callable[..., None]


@cache
def load() -> Kernels | None:
    """Compile (or read from numba's cache) on first use; None without numba."""
    if find_spec("numba") is None:
        return None
    import numba

    def compiled(function: Any) -> Any:
        try:
            return numba.njit(cache=True, error_model="numpy")(function)
        except RuntimeError:  # no writable place for the cache
            return numba.njit(error_model="numpy")(function)

    return Kernels(compiled(_kinematics), compiled(_velocity_wrench), compiled(_centripetal))


def _velocity_wrench(inertia: FloatArray, v: FloatArray, out: FloatArray) -> None:
    """``-v x* I v`` of every link: inertia (L, 6, 6), v and out (n, L, 6)."""
    h = np.empty(6)
    for f in range(v.shape[0]):
        for link in range(v.shape[1]):
            for i in range(6):
                h[i] = 0.0
                for j in range(6):
                    h[i] += inertia[link, i, j] * v[f, link, j]
            for i in range(3):
                b, c = (i + 1) % 3, (i + 2) % 3
                out[f, link, i] = v[f, link, 3 + c] * h[b] - v[f, link, 3 + b] * h[c]
                out[f, link, 3 + i] = (
                    v[f, link, c] * h[b]
                    - v[f, link, b] * h[c]
                    + v[f, link, 3 + c] * h[3 + b]
                    - v[f, link, 3 + b] * h[3 + c]
                )


def _centripetal(v: FloatArray, links: IntArray, back: FloatArray, arm: FloatArray, out: FloatArray) -> None:
    """``R_s_l [w x (v + w x r)]`` of every accelerometer: v (n, L, 6), back (S, 3, 3), arm (S, 3), out (n, S, 3)."""
    u, a = np.empty(3), np.empty(3)
    for f in range(v.shape[0]):
        for s in range(links.size):
            link = links[s]
            for i in range(3):
                b, c = (i + 1) % 3, (i + 2) % 3
                u[i] = v[f, link, i] + v[f, link, 3 + b] * arm[s, c] - v[f, link, 3 + c] * arm[s, b]
            for i in range(3):
                b, c = (i + 1) % 3, (i + 2) % 3
                a[i] = v[f, link, 3 + b] * u[c] - v[f, link, 3 + c] * u[b]
            for i in range(3):
                out[f, s, i] = back[s, i, 0] * a[0] + back[s, i, 1] * a[1] + back[s, i, 2] * a[2]


def _kinematics(
    kind: IntArray, axis: FloatArray, place_R: FloatArray, place_p: FloatArray, parent: IntArray, iq: IntArray, iv: IntArray,
    q: FloatArray, qd: FloatArray, qdd: FloatArray, gravity: FloatArray,
    kept: IntArray, up: IntArray, down: IntArray, column_joint: IntArray, column_part: IntArray, column_chain: IntArray, column_v: IntArray,
    R_out: FloatArray, p_out: FloatArray, v_out: FloatArray, a_out: FloatArray, X_out: FloatArray, bias_out: FloatArray, S_out: FloatArray,
) -> None:  # fmt: skip
    """Joint 0 is the world, spatial vectors are ``[linear; angular]``; see ``PinocchioTree`` of ``link_motion_pinocchio``."""
    number = kind.size
    R, p = np.zeros((number, 3, 3)), np.zeros((number, 3))
    v, a = np.zeros((number, 6)), np.zeros((number, 6))
    for i in range(3):
        R[0, i, i] = 1.0
    J, Ru, pj, pu = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    vj, aj, t, r = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(3)
    for f in range(q.shape[0]):
        for n in range(1, number):
            k, u, first, start = kind[n], parent[n], iq[n], iv[n]
            vj[:] = 0.0
            aj[:] = 0.0
            pj[:] = 0.0
            J[:] = 0.0
            J[0, 0] = J[1, 1] = J[2, 2] = 1.0
            if k <= 1:
                c, s = (
                    (np.cos(q[f, first]), np.sin(q[f, first])) if k == 0 else (q[f, first], q[f, first + 1])
                )
                x, y, z = axis[n, 0], axis[n, 1], axis[n, 2]
                o = 1.0 - c
                J[0, 0], J[0, 1], J[0, 2] = c + x * x * o, x * y * o - z * s, x * z * o + y * s
                J[1, 0], J[1, 1], J[1, 2] = y * x * o + z * s, c + y * y * o, y * z * o - x * s
                J[2, 0], J[2, 1], J[2, 2] = z * x * o - y * s, z * y * o + x * s, c + z * z * o
                for i in range(3):
                    vj[3 + i], aj[3 + i] = axis[n, i] * qd[f, start], axis[n, i] * qdd[f, start]
            elif k == 2:
                for i in range(3):
                    pj[i] = axis[n, i] * q[f, first]
                    vj[i], aj[i] = axis[n, i] * qd[f, start], axis[n, i] * qdd[f, start]
            elif k == 5:
                for i in range(3):
                    pj[i], vj[i], aj[i] = q[f, first + i], qd[f, start + i], qdd[f, start + i]
            else:
                shift = 3 if k == 4 else 0
                if k == 4:
                    for i in range(3):
                        pj[i] = q[f, first + i]
                        vj[i], aj[i] = qd[f, start + i], qdd[f, start + i]
                for i in range(3):
                    vj[3 + i], aj[3 + i] = qd[f, start + shift + i], qdd[f, start + shift + i]
                x, y, z, w = (
                    q[f, first + shift],
                    q[f, first + shift + 1],
                    q[f, first + shift + 2],
                    q[f, first + shift + 3],
                )
                m = 2.0 / (x * x + y * y + z * z + w * w)
                J[0, 0], J[0, 1], J[0, 2] = (
                    1.0 - m * (y * y + z * z),
                    m * (x * y - z * w),
                    m * (x * z + y * w),
                )
                J[1, 0], J[1, 1], J[1, 2] = (
                    m * (x * y + z * w),
                    1.0 - m * (x * x + z * z),
                    m * (y * z - x * w),
                )
                J[2, 0], J[2, 1], J[2, 2] = (
                    m * (x * z - y * w),
                    m * (y * z + x * w),
                    1.0 - m * (x * x + y * y),
                )
            for i in range(3):
                pu[i] = place_p[n, i]
                for j in range(3):
                    pu[i] += place_R[n, i, j] * pj[j]
                    Ru[i, j] = (
                        place_R[n, i, 0] * J[0, j] + place_R[n, i, 1] * J[1, j] + place_R[n, i, 2] * J[2, j]
                    )
            for i in range(3):
                p[n, i] = p[u, i] + R[u, i, 0] * pu[0] + R[u, i, 1] * pu[1] + R[u, i, 2] * pu[2]
                for j in range(3):
                    R[n, i, j] = R[u, i, 0] * Ru[0, j] + R[u, i, 1] * Ru[1, j] + R[u, i, 2] * Ru[2, j]
            for second in range(2):
                m6 = a[u] if second else v[u]
                for i in range(3):
                    b, c3 = (i + 1) % 3, (i + 2) % 3
                    t[i] = m6[i] + m6[3 + b] * pu[c3] - m6[3 + c3] * pu[b]
                    t[3 + i] = m6[3 + i]
                for i in range(3):
                    low = Ru[0, i] * t[0] + Ru[1, i] * t[1] + Ru[2, i] * t[2]
                    high = Ru[0, i] * t[3] + Ru[1, i] * t[4] + Ru[2, i] * t[5]
                    if second:
                        a[n, i], a[n, 3 + i] = low + aj[i], high + aj[3 + i]
                    else:
                        v[n, i], v[n, 3 + i] = low + vj[i], high + vj[3 + i]
            for i in range(3):
                b, c3 = (i + 1) % 3, (i + 2) % 3
                a[n, i] += (
                    v[n, 3 + b] * vj[c3] - v[n, 3 + c3] * vj[b] + v[n, b] * vj[3 + c3] - v[n, c3] * vj[3 + b]
                )
                a[n, 3 + i] += v[n, 3 + b] * vj[3 + c3] - v[n, 3 + c3] * vj[3 + b]
        for link in range(kept.size):
            n = kept[link]
            for i in range(3):
                p_out[f, link, i] = p[n, i]
                v_out[f, link, i], v_out[f, link, 3 + i] = v[n, i], v[n, 3 + i]
                down_g = R[n, 0, i] * gravity[0] + R[n, 1, i] * gravity[1] + R[n, 2, i] * gravity[2]
                a_out[f, link, i], a_out[f, link, 3 + i] = a[n, i] - down_g, a[n, 3 + i]
                for j in range(3):
                    R_out[f, link, i, j] = R[n, i, j]
        for chain in range(up.size):
            one, other = kept[up[chain]], kept[down[chain]]
            for i in range(3):
                r[i] = 0.0
                for j in range(3):
                    r[i] += R[one, j, i] * (p[other, j] - p[one, j])
            for i in range(3):
                for j in range(3):
                    Ru[i, j] = (
                        R[other, 0, i] * R[one, 0, j]
                        + R[other, 1, i] * R[one, 1, j]
                        + R[other, 2, i] * R[one, 2, j]
                    )
            for i in range(3):
                for j in range(3):
                    b, c3 = (j + 1) % 3, (j + 2) % 3
                    X_out[f, chain, i, j] = X_out[f, chain, 3 + i, 3 + j] = Ru[i, j]
                    X_out[f, chain, 3 + i, j] = 0.0
                    X_out[f, chain, i, 3 + j] = Ru[i, c3] * r[b] - Ru[i, b] * r[c3]
            for i in range(6):
                total = a_out[f, down[chain], i]
                for j in range(6):
                    total -= X_out[f, chain, i, j] * a_out[f, up[chain], j]
                bias_out[f, chain, i] = total
        for column in range(column_joint.size):
            n, part, chain = column_joint[column], column_part[column], column_chain[column]
            other = kept[down[chain]]
            t[:] = 0.0
            k = kind[n]
            if k <= 1:
                for i in range(3):
                    t[3 + i] = axis[n, i]
            elif k == 2:
                for i in range(3):
                    t[i] = axis[n, i]
            elif k == 3:
                t[3 + part] = 1.0
            else:
                t[part] = 1.0
            for i in range(3):
                r[i] = 0.0
                for j in range(3):
                    r[i] += R[n, j, i] * (p[other, j] - p[n, j])
            for i in range(3):
                b, c3 = (i + 1) % 3, (i + 2) % 3
                pu[i] = t[i] + t[3 + b] * r[c3] - t[3 + c3] * r[b]
            for i in range(3):
                low = high = 0.0
                for j in range(3):
                    e = (
                        R[other, 0, i] * R[n, 0, j]
                        + R[other, 1, i] * R[n, 1, j]
                        + R[other, 2, i] * R[n, 2, j]
                    )
                    low += e * pu[j]
                    high += e * t[3 + j]
                S_out[f, column, i], S_out[f, column, 3 + i] = low, high
            for i in range(6):
                bias_out[f, chain, i] -= S_out[f, column, i] * qdd[f, column_v[column]]

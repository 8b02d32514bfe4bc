"""Spatial vectors ``[linear; angular]`` of links, batched over any leading axes (Featherstone 2008, with the linear part first)."""

from __future__ import annotations

import numpy as np

from factorgrasp.problems import link_motion_kernels
from factorgrasp.typing import FloatArray, IntArray


def skew(v: FloatArray) -> FloatArray:
    """``S(v)`` with ``S(v) u = v x u``; v (..., 3), out (..., 3, 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a x b`` over the last axis; a few times faster than numpy's for few vectors."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    out[..., 0] = a1 * b2 - a2 * b1
    out[..., 1] = a2 * b0 - a0 * b2
    out[..., 2] = a0 * b1 - a1 * b0
    return out


def motion_transform(R_b_a: FloatArray, p_a_b: FloatArray) -> FloatArray:
    """``X`` that turns a motion vector in frame a into frame b: ``[[R, -R S(p)], [0, R]]``.

    Its transpose turns a wrench in frame b into frame a.

    Parameters
    ----------
    R_b_a : (..., 3, 3) ndarray
    p_a_b : (..., 3) ndarray
        Origin of b in a, m.
    """
    out = np.zeros((*np.broadcast_shapes(R_b_a.shape[:-2], p_a_b.shape[:-1]), 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R_b_a
    out[..., :3, 3:] = -R_b_a @ skew(p_a_b)
    return out


def rotate(R: FloatArray, v: FloatArray) -> FloatArray:
    """``R v`` for stacks (..., 3, 3) and (..., 3)."""
    return np.asarray((R @ v[..., None])[..., 0])


def rotate_back(R: FloatArray, v: FloatArray) -> FloatArray:
    """``R' v`` for stacks (..., 3, 3) and (..., 3)."""
    return np.asarray((np.swapaxes(R, -1, -2) @ v[..., None])[..., 0])


def spatial_inertia(mass: FloatArray, com: FloatArray, inertia: FloatArray) -> FloatArray:
    """``I = [[m 1, -m S(c)], [m S(c), I_c - m S(c) S(c)]]`` about the link's origin.

    Parameters
    ----------
    mass : (...,) ndarray
        kg.
    com : (..., 3) ndarray
        Centre of mass in the link's frame, m.
    inertia : (..., 3, 3) ndarray
        About the centre of mass, in the link's axes, kg m^2.
    """
    S = skew(com)
    out = np.zeros((*mass.shape, 6, 6))
    out[..., :3, :3] = mass[..., None, None] * np.eye(3)
    out[..., :3, 3:] = -mass[..., None, None] * S
    out[..., 3:, :3] = mass[..., None, None] * S
    out[..., 3:, 3:] = inertia - mass[..., None, None] * (S @ S)
    return out


def cross_force(v: FloatArray, f: FloatArray) -> FloatArray:
    """``v x* f = [w x f_lin; v_lin x f_lin + w x f_ang]`` for (..., 6)."""
    out = np.empty(np.broadcast_shapes(v.shape, f.shape))
    turned = cross(v[..., None, 3:], f.reshape(*f.shape[:-1], 2, 3))
    out[..., :3] = turned[..., 0, :]
    out[..., 3:] = turned[..., 1, :] + cross(v[..., :3], f[..., :3])
    return out


def cross_motion(v: FloatArray, m: FloatArray) -> FloatArray:
    """``v x m = [w x m_lin + v_lin x m_ang; w x m_ang]`` for (..., 6)."""
    linear, angular = v[..., :3], v[..., 3:]
    first, second = m[..., :3], m[..., 3:]
    return np.concatenate([cross(angular, first) + cross(linear, second), cross(angular, second)], axis=-1)


def velocity_wrench(inertia: FloatArray, velocity: FloatArray) -> FloatArray:
    """``-v x* I v`` of every link: spatial inertias (L, 6, 6), velocities (n, L, 6)."""
    kernels = link_motion_kernels.load()
    if kernels is None:
        return -cross_force(velocity, (inertia @ velocity[..., None])[..., 0])
    out = np.empty(velocity.shape)
    kernels.velocity_wrench(inertia, velocity, out)
    return out


def centripetal(velocity: FloatArray, links: IntArray, R_s_l: FloatArray, p_l_s: FloatArray) -> FloatArray:
    """Known part (n, S, 3) of what accelerometers on `links` (S,) read: ``R_s_l [w x (v + w x p)]``."""
    kernels = link_motion_kernels.load()
    if kernels is None:
        v, w = velocity[:, links, :3], velocity[:, links, 3:]
        return np.asarray((R_s_l @ cross(w, v + cross(w, p_l_s))[..., None])[..., 0])
    out = np.empty((velocity.shape[0], links.size, 3))
    kernels.centripetal(velocity, links, R_s_l, p_l_s, out)
    return out

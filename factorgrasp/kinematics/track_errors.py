"""Errors that a smoothed track may have, drawn from its covariance: what a measure's uncertainty is worked out with.

A track states the covariance of every frame's pose and velocity, P and V. How the errors of different frames hang together follows from
the two. A smoother with white noise on the acceleration as its prior lets measurement noise through with the gain
``1 / (1 + (w / w_c)^4)``, where ``w_c^2 = V / P``, and so the noise in the track has the square of that as its spectrum. (The stated
V holds for motions as rough as the prior, whose velocities change without end between two frames; a hand's do not, and noise alone
gives the velocity a third of it.) Such a process is two damped oscillators in a row, driven by white noise, simulated here frame by frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

from factorgrasp.lie import so3_exp
from factorgrasp.typing import BoolArray, FloatArray

SAMPLES = 100
"""Tracks that are drawn by default: standard deviations are then known to 7 %."""
_LARGEST_STEP = 50.0


@dataclass(frozen=True, eq=False)
class TrackSamples:
    """K drawn tracks of n frames; NaN where the track itself has no pose.

    Attributes
    ----------
    rotation : ndarray, shape (K, n, 3, 3)
        ``R_W0_W``.
    position, velocity, angular_velocity : ndarray, shape (K, n, 3)
        As in a WristTrack.
    """

    rotation: FloatArray
    position: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray


def sample_tracks(
    t: FloatArray,
    rotation: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    angular_velocity: FloatArray,
    covariance: FloatArray,
    velocity_covariance: FloatArray,
    samples: int = SAMPLES,
    seed: int = 0,
) -> TrackSamples:
    """Draw tracks.

    Parameters
    ----------
    t : ndarray, shape (n,)
        s.
    rotation : ndarray, shape (n, 3, 3)
        ``R_W0_W``.
    position, velocity, angular_velocity : ndarray, shape (n, 3)
    covariance : ndarray, shape (n, 6, 6)
        [rotation; translation], rotation as right perturbation.
    velocity_covariance : ndarray, shape (n, 6, 6)
        [angular velocity; velocity].
    samples : int
    seed : int

    Returns
    -------
    TrackSamples
    """
    n = t.size
    parts = (covariance, velocity_covariance, position, rotation)
    known: BoolArray = np.isfinite(np.concatenate([part.reshape(n, -1) for part in parts], axis=1)).all(
        axis=1
    )
    P = np.where(known[:, None, None], covariance, np.eye(6))
    V = np.where(known[:, None, None], velocity_covariance, np.eye(6))
    value, rate = _unit_processes(t, P, V, known, samples, np.random.default_rng([seed, 77]))
    pose_error = np.einsum("nij,knj->kni", _root(P), value)
    rate_error = np.einsum("nij,knj->kni", _root(V), rate)  # rate is in units of w_c
    pose_error[:, ~known] = np.nan
    return TrackSamples(
        rotation @ so3_exp(pose_error[..., :3]),
        position + pose_error[..., 3:],
        velocity + rate_error[..., 3:],
        angular_velocity + rate_error[..., :3],
    )


def _unit_processes(
    t: FloatArray, P: FloatArray, V: FloatArray, known: BoolArray, samples: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Values (K, n, 6) of six processes, each of variance 1, and their rates divided by ``w_c``."""
    diagonal = np.arange(6)
    w = np.sqrt(V[:, diagonal, diagonal] / np.maximum(P[:, diagonal, diagonal], 1e-30))
    w[~known] = np.median(w[known], axis=0) if known.any() else 1.0
    step = np.clip(np.diff(t)[:, None] * 0.5 * (w[1:] + w[:-1]), 0.0, _LARGEST_STEP)
    # Steps of a hundredth of a radian are told apart; there are few of them in a track.
    different, which = np.unique(np.round(step, 2), return_inverse=True)
    transition = expm(_OSCILLATORS * different[:, None, None])
    F = transition[which.reshape(step.shape)]
    Q = _root(_STATIONARY - transition @ _STATIONARY @ np.swapaxes(transition, -1, -2))[
        which.reshape(step.shape)
    ]
    x = rng.standard_normal((samples, 6, 4)) @ _root(_STATIONARY)
    out = np.empty((samples, t.size, 6, 4))
    out[:, 0] = x
    for k in range(t.size - 1):
        x = np.einsum("cij,kcj->kci", F[k], x)
        x += np.einsum("cij,kcj->kci", Q[k], rng.standard_normal((samples, 6, 4)))
        out[:, k + 1] = x
    return out[..., 0], out[..., 1]


def _root(P: FloatArray) -> FloatArray:
    """The symmetric root, which is continuous in P."""
    values, vectors = np.linalg.eigh(0.5 * (P + np.swapaxes(P, -1, -2)))
    out: FloatArray = (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ np.swapaxes(
        vectors, -1, -2
    )
    return out


def _oscillators() -> tuple[FloatArray, FloatArray]:
    """Two oscillators with damping 1 / sqrt(2) and frequency 1, the second one driving the first: dynamics (4, 4), covariance (4, 4)."""
    root2 = np.sqrt(2.0)
    A = np.array(
        [[0.0, 1.0, 0.0, 0.0], [-1.0, -root2, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -1.0, -root2]]
    )
    P = np.asarray(solve_continuous_lyapunov(A, -np.diag([0.0, 0.0, 0.0, 1.0])))
    scale = np.sqrt(np.array([P[0, 0], P[0, 0], P[2, 2], P[2, 2]]))
    return A * scale / scale[:, None], P / np.outer(scale, scale)


_OSCILLATORS, _STATIONARY = _oscillators()

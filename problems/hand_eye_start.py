"""Where to start with two pose streams: the time offset by correlation, rotations in closed form, translations by least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.problems.hand_eye_curve import PoseCurve, apply, transposed
from factorgrasp.problems.hand_eye_math import PoseCoupling
from factorgrasp.typing import BoolArray, FloatArray, IntArray

# Relative motions over this time (s) tell more than the noise of two camera poses and still less than a turn.
_PAIR_SECONDS = 0.5
_MOST_PAIRS, _FEW_PAIRS = 800, 160
_COARSE_STEP, _FINE_STEP = 0.02, 0.002
# A second singular value of the relative rotations below this part of the first: they share one axis.
_ONE_AXIS = 0.02


@dataclass(frozen=True)
class ClockMatch:
    """Time offset (s, hand minus robot) at which both sides move most alike, and how much alike (0 to 1)."""

    offset: float
    correlation: float


@dataclass(frozen=True)
class _Pairs:
    """Pairs of samples about half a second apart, with the relative motion of the sampled side."""

    first: FloatArray
    last: FloatArray
    turn: FloatArray
    way: FloatArray

    def thinned(self, most: int) -> _Pairs:
        """At most this many of them, evenly."""
        every = -(-self.first.size // most)
        return _Pairs(self.first[::every], self.last[::every], self.turn[::every], self.way[::every])


def _pairs(curve: PoseCurve) -> _Pairs:
    last = np.searchsorted(curve.t, curve.t + _PAIR_SECONDS)
    first = np.flatnonzero(last < curve.t.size)
    first = first[curve.t[last[first]] - curve.t[first] < 1.5 * _PAIR_SECONDS]
    if first.size < 3:
        raise InputError(
            "robot and hand",
            f"poses over more than {_PAIR_SECONDS:g} s on both sides",
            f"{np.ptp(curve.t):.3g} s",
        )
    last = last[first]
    turn = lie.so3_log(transposed(curve.rotation[first]) @ curve.rotation[last])
    pairs = _Pairs(curve.t[first], curve.t[last], turn, curve.position[last] - curve.position[first])
    return pairs.thinned(_MOST_PAIRS)


def _other_side(
    coupling: PoseCoupling, pairs: _Pairs, offset: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    one = coupling.interpolated.at(coupling.other_times(pairs.first, offset))
    two = coupling.interpolated.at(coupling.other_times(pairs.last, offset))
    turn = lie.so3_log(transposed(one.rotation) @ two.rotation)
    return turn, two.position - one.position, one.inside & two.inside


def _alike(a: FloatArray, b: FloatArray) -> float:
    """Largest ``sum a . R b`` over rotations R, relative to the lengths: a correlation that knows no common frame."""
    size = float(np.sqrt(np.sum(a * a) * np.sum(b * b)))
    if not size > 0.0:
        return 0.0
    U, s, Vt = np.linalg.svd(a.T @ b)
    return float((s[0] + s[1] + s[2] * np.linalg.det(U @ Vt)) / size)


def match_clocks(coupling: PoseCoupling, guess: float, reach: float) -> ClockMatch:
    """Time offset within `reach` (s) of `guess` by correlating relative rotations; displacements where there is hardly any rotation.

    The relative motions are vectors in unknown frames, so their correlation is that after the best rotation (Wahba's): it uses the
    directions as well as ``|w|``, and pairs of samples need nothing of what lies between them, gaps included.
    """
    pairs = _pairs(coupling.sampled)

    def scores(offset: float, pairs: _Pairs = pairs) -> tuple[float, float]:
        turn, way, inside = _other_side(coupling, pairs, offset)
        if np.count_nonzero(inside) < max(3, 0.25 * inside.size):
            return -1.0, -1.0
        return _alike(turn[inside], pairs.turn[inside]), _alike(way[inside], pairs.way[inside])

    coarse = guess + _COARSE_STEP * np.arange(-round(reach / _COARSE_STEP), round(reach / _COARSE_STEP) + 1)
    few = pairs.thinned(_FEW_PAIRS)
    table = np.array([scores(float(offset), few) for offset in coarse])
    kind = 0 if table[:, 0].max() >= min(0.5, table[:, 1].max()) else 1
    if table[:, kind].max() < 0.0:
        return ClockMatch(guess, 0.0)
    middle = float(coarse[int(np.argmax(table[:, kind]))])
    fine = middle + _FINE_STEP * np.arange(-10, 11)
    values = np.array([scores(float(offset))[kind] for offset in fine])
    best = int(np.argmax(values))
    return ClockMatch(float(fine[best]), float(np.clip(values[best], 0.0, 1.0)))


def start_state(
    coupling: PoseCoupling, samples: IntArray, offset: float, lever: FloatArray
) -> dict[str, FloatArray]:
    """Rotations in closed form, then translations by linear least squares.

    The grasp's rotation is Wahba's on pairs of relative rotations. Where these share one axis (or there are none) it is only known up
    to a turn about that axis: several turns, and the rotation that the displacements suggest, then compete. `lever` (3,) is the lever
    arm where nothing shows it.
    """
    pairs = _pairs(coupling.sampled)
    turn, _, inside = _other_side(coupling, pairs, offset)
    robot_turn, hand_turn = (turn, pairs.turn) if coupling.at_hand else (pairs.turn, turn)
    cross = robot_turn[inside].T @ hand_turn[inside]
    poses = coupling.at(samples, offset)
    A, B = poses.robot_rotation[poses.inside], poses.hand_rotation[poses.inside]
    a, b = poses.robot_position[poses.inside], poses.hand_position[poses.inside]
    U, singular, Vt = np.linalg.svd(cross)
    best = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    candidates = [best]
    if singular[1] < _ONE_AXIS * singular[0] or singular[0] == 0.0:
        angles = 2.0 * np.pi * np.arange(1, 24) / 24.0
        candidates += list(best @ lie.so3_exp(angles[:, None] * Vt[0]))
        world = lie.project_to_so3((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
        candidates.append(lie.project_to_so3((transposed(A) @ world @ B).sum(axis=0)))
    noise = float(coupling.robot.noise[0, 0])
    found = [_completed(X, A, a, B, b, noise, lever) for X in candidates]
    state = min(found, key=lambda item: item[0])[1]
    state["time_offset"] = np.array([offset])
    return state


def _completed(
    X: FloatArray,
    A: FloatArray,
    a: FloatArray,
    B: FloatArray,
    b: FloatArray,
    turn_noise: float,
    lever: FloatArray,
) -> tuple[float, dict[str, FloatArray]]:
    """World rotation (mean) and translations (least squares) that go with a grasp rotation, and a robust measure of the misfit."""
    Y = lie.project_to_so3((A @ X @ transposed(B)).sum(axis=0))
    target = b @ Y.T - a
    mean_A, mean_target = A.mean(axis=0), target.mean(axis=0)
    spread, axes = np.linalg.eigh(np.eye(3) - mean_A.T @ mean_A)
    cross = apply(transposed(A), target).mean(axis=0) - mean_A.T @ mean_target
    # An orientation that only noise changes says nothing of the lever arm along that axis.
    seen = spread > 6.0 * turn_noise**2 + 1e-9
    p = axes @ np.where(seen, (axes.T @ cross) / np.where(seen, spread, 1.0), axes.T @ lever)
    q = mean_A @ p - mean_target
    angle = lie.angle_between(A @ X, Y @ B)
    distance = np.linalg.norm(A @ p + a - b @ Y.T - q, axis=1)
    # 1 deg of misfit counts as much as 1 cm of it.
    misfit = float(np.median(angle) / np.deg2rad(1.0) + np.median(distance) / 0.01)
    return misfit, {"rotation": X, "translation": p, "world_rotation": Y, "world_translation": q}

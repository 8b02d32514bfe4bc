"""Two pose streams of one rigid body: interpolation, residuals with their derivatives, and a start.

Robot poses ``(R_w_r, p_w_r)`` and hand poses ``(R_t_h, p_t_h)`` in another world ``t``. Rigid coupling with the grasp
``(R_r_h, p_r_h)`` and the other world ``(R_w_t, p_w_t)``: ``R_w_r R_r_h = R_w_t R_t_h`` and
``R_w_r p_r_h + p_w_r = R_w_t p_t_h + p_w_t``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.problems.grasp_kinematics import gap_limit, white_noise_sd
from factorgrasp.recordings import PoseStream
from factorgrasp.typing import BoolArray, FloatArray, IntArray, State

COLUMNS = {
    "rotation": slice(0, 3),
    "translation": slice(3, 6),
    "world_rotation": slice(6, 9),
    "world_translation": slice(9, 12),
    "time_offset": slice(12, 13),
}
"""Columns of the Jacobian of :func:`coupling_rows`."""

# Relative motions over this time (s) tell more than the noise of two camera poses and still less than a turn.
_PAIR_SECONDS = 0.5
_MOST_PAIRS = 800
# Nobody's hand makes a corner in this time (s).
_LONGEST_SMOOTHING = 0.1
_COARSE_STEP, _FINE_STEP = 0.02, 0.002
# A second singular value of the relative rotations below this part of the first: they share one axis.
_ONE_AXIS = 0.02


def transposed(R: FloatArray) -> FloatArray:
    """``R'`` of every matrix of a stack."""
    return np.swapaxes(R, -1, -2)


def apply(R: FloatArray, v: FloatArray) -> FloatArray:
    """``R v`` for stacks of matrices and vectors."""
    return np.asarray(np.matmul(R, v[..., None])[..., 0])


@dataclass(frozen=True)
class CurvePoints:
    """Poses between samples, with the velocities of that motion.

    Attributes
    ----------
    rotation : (n, 3, 3) ndarray
    position : (n, 3) ndarray
    angular_velocity : (n, 3) ndarray
        rad/s, body frame.
    velocity : (n, 3) ndarray
        m/s, world frame.
    inside : (n,) ndarray
        Whether the time lies between two samples without a gap between them.
    """

    rotation: FloatArray
    position: FloatArray
    angular_velocity: FloatArray
    velocity: FloatArray
    inside: BoolArray


@dataclass(frozen=True)
class PoseCurve:
    """A smooth curve by the complete samples of a pose stream, in stretches without gaps.

    At a sample: pose and velocity of the parabola fitted to the `half_width` samples on either side (1: through the sample itself).
    Between samples: the cubic with these ends (Hermite), rotations in rotation vectors from the sample before. Straight lines and
    great arcs would leave velocities that jump at every sample, and noisy samples an interpolated noise that is smallest between two of
    them: either way the time offset goes astray.

    Attributes
    ----------
    t : (n,) ndarray
        s.
    rotation, position : (n, 3, 3) and (n, 3) ndarray
    angular_velocity, velocity : (n, 3) ndarray
        Body frame rad/s, world frame m/s.
    stretch : (n,) ndarray of int
        Counts the stretches without gaps.
    step : float
        Median step of the stream, s.
    noise : (2, 2) ndarray
        White noise of [rotation; position] (rad, m) and of their velocities (rad/s, m/s) per axis.
    """

    t: FloatArray
    rotation: FloatArray
    position: FloatArray
    angular_velocity: FloatArray
    velocity: FloatArray
    stretch: IntArray
    step: float
    noise: FloatArray

    @classmethod
    def from_stream(cls, stream: PoseStream, max_gap: float | None, smooth: bool = False) -> PoseCurve:
        """Incomplete rows are left out; what is then further apart than the limit is a gap.

        With `smooth`, the parabolas are as wide as the noise needs for velocities of a fifth of the motion's, at most 0.1 s.
        """
        good = stream.valid
        t, R, p = stream.t[good], stream.rotation[good], stream.position[good]
        if t.size < 2:
            raise InputError(stream.name, "at least two complete poses", str(t.size))
        stretch = np.concatenate([[0], np.cumsum(np.diff(t) > gap_limit(stream.t, max_gap))]).astype(np.intp)
        # What is too fast to be motion.
        sd = np.array([2.0 * white_noise_sd(stream.rotation_wxyz), white_noise_sd(stream.position)])
        half = _half_width(R, p, stream.step, sd) if smooth else 1
        fit, rates = _local_parabolas(t, R, p, stretch, half)
        turn = fit[:, :3]
        squares = np.arange(-half, half + 1.0) ** 2
        # Variance of the middle and of the slope of a parabola fitted to uniform samples.
        middle = (squares**2).sum() / (squares.size * (squares**2).sum() - squares.sum() ** 2)
        slope = 1.0 / squares.sum() / stream.step**2
        return cls(
            t,
            R @ lie.so3_exp(turn),
            p + fit[:, 3:],
            apply(lie.so3_right_jacobian(turn), rates[:, :3]),
            rates[:, 3:],
            stretch,
            stream.step,
            np.stack([sd * np.sqrt(middle), sd * np.sqrt(slope)]),
        )

    def at(self, times: FloatArray) -> CurvePoints:
        """Interpolated poses; outside of stretches the values mean nothing and `inside` is False."""
        i = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, self.t.size - 2)
        h = (self.t[i + 1] - self.t[i])[:, None]
        u = (times[:, None] - self.t[i, None]) / h
        inside = (u[:, 0] >= 0.0) & (u[:, 0] <= 1.0) & (self.stretch[i] == self.stretch[i + 1])
        u = np.clip(u, 0.0, 1.0)
        turn = lie.so3_log(transposed(self.rotation[i]) @ self.rotation[i + 1])
        leaving = h * self.angular_velocity[i]
        arriving = h * apply(lie.so3_right_jacobian_inverse(turn), self.angular_velocity[i + 1])
        phi, phi_slope = _hermite(u, turn, leaving, arriving)
        way = self.position[i + 1] - self.position[i]
        moved, moved_slope = _hermite(u, way, h * self.velocity[i], h * self.velocity[i + 1])
        return CurvePoints(
            self.rotation[i] @ lie.so3_exp(phi),
            self.position[i] + moved,
            apply(lie.so3_right_jacobian(phi), phi_slope) / h,
            moved_slope / h,
            inside,
        )

    def covers(self, times: FloatArray, margin: float) -> BoolArray:
        """Whether ``[t - margin, t + margin]`` lies within one stretch."""
        first = np.searchsorted(self.t, times - margin, side="right") - 1
        last = np.searchsorted(self.t, times + margin, side="left")
        within = (first >= 0) & (last < self.t.size)
        return np.asarray(
            within & (self.stretch[np.maximum(first, 0)] == self.stretch[np.minimum(last, self.t.size - 1)])
        )


def _half_width(R: FloatArray, p: FloatArray, step: float, sd: FloatArray) -> int:
    """Samples on either side that a parabola needs for velocities with a fifth of the motion's rms as noise."""
    most = max(1, int(_LONGEST_SMOOTHING / step))
    lag = min(most, len(p) - 1)
    moved = np.stack([lie.so3_log(transposed(R[:-lag]) @ R[lag:]), p[lag:] - p[:-lag]])
    motion = np.sqrt(np.maximum((moved**2).sum(axis=2).mean(axis=1) - 6.0 * sd**2, 0.0)) / lag
    half = 1
    while half < most and np.any(
        np.sqrt(3.0 / (half * (half + 1) * (2 * half + 1) / 3.0)) * sd > 0.2 * motion
    ):
        half += 1
    return half


def _local_parabolas(
    t: FloatArray, R: FloatArray, p: FloatArray, stretch: IntArray, half: int
) -> tuple[FloatArray, FloatArray]:
    """Middle (n, 6), relative to the sample, and slope (n, 6) of parabolas in [rotation vector; position]."""
    n = t.size
    index = np.arange(n)[:, None] + np.arange(-half, half + 1)
    inside = (index >= 0) & (index < n)
    index = np.clip(index, 0, n - 1)
    inside &= stretch[index] == stretch[:, None]
    turn = lie.so3_log(transposed(R)[:, None] @ R[index])
    values = np.concatenate([turn, p[index] - p[:, None]], axis=2)
    scale = half * float(np.median(np.diff(t)))
    x = (t[index] - t[:, None]) / scale
    design = np.stack([np.ones_like(x), x, x * x], axis=2) * inside[:, :, None]
    normal = transposed(design) @ design
    # Two samples make a line, a lonely one stands still: hardly any curvature or slope is as good as none.
    normal[:, 1, 1] += 1e-12
    normal[:, 2, 2] += 1e-10
    fit = np.linalg.solve(normal, transposed(design) @ values)
    return fit[:, 0], fit[:, 1] / scale


def _hermite(
    u: FloatArray, way: FloatArray, leaving: FloatArray, arriving: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Cubic from 0 (u = 0) to `way` (u = 1) with the given slopes in u, and its slope."""
    rest = 1.0 - u
    value = (3.0 - 2.0 * u) * u**2 * way + u * rest**2 * leaving - u**2 * rest * arriving
    slope = 6.0 * u * rest * way + rest * (1.0 - 3.0 * u) * leaving + u * (3.0 * u - 2.0) * arriving
    return value, slope


@dataclass(frozen=True)
class CoupledPoses:
    """Both bodies at the same instants; one side is interpolated, and moves when the time offset does.

    Attributes
    ----------
    robot_rotation, robot_position : ndarray
        ``R_w_r`` (n, 3, 3), ``p_w_r`` (n, 3).
    hand_rotation, hand_position : ndarray
        ``R_t_h`` (n, 3, 3), ``p_t_h`` (n, 3).
    robot_slide, hand_slide : (n, 6) ndarray or None
        Derivative of the pose by the time offset, [angular in the body frame; linear in its world]; None for the side that is sampled.
    inside : (n,) ndarray
    """

    robot_rotation: FloatArray
    robot_position: FloatArray
    hand_rotation: FloatArray
    hand_position: FloatArray
    robot_slide: FloatArray | None
    hand_slide: FloatArray | None
    inside: BoolArray


@dataclass(frozen=True)
class PoseCoupling:
    """Robot and hand on their own clocks; ``t_hand = t_robot + time offset``.

    The slower stream is taken at its samples, the faster one is interpolated: that bridges the shorter steps.
    """

    robot: PoseCurve
    hand: PoseCurve

    @classmethod
    def from_streams(cls, robot: PoseStream, hand: PoseStream, max_gap: float | None) -> PoseCoupling:
        """Only the interpolated side is smoothed: its samples in between are there to be used, too."""
        at_hand = hand.step >= robot.step
        return cls(
            PoseCurve.from_stream(robot, max_gap, smooth=at_hand),
            PoseCurve.from_stream(hand, max_gap, smooth=not at_hand),
        )

    @property
    def at_hand(self) -> bool:
        """Whether the samples are those of the hand."""
        return self.hand.step >= self.robot.step

    @property
    def sampled(self) -> PoseCurve:
        """The slower side."""
        return self.hand if self.at_hand else self.robot

    @property
    def interpolated(self) -> PoseCurve:
        """The faster side."""
        return self.robot if self.at_hand else self.hand

    def other_times(self, t: FloatArray, time_offset: float) -> FloatArray:
        """Times on the clock of the interpolated side."""
        return t - time_offset if self.at_hand else t + time_offset

    def usable(self, time_offset: float, margin: float) -> IntArray:
        """Samples whose interpolation stays clear of gaps for all offsets within `margin` (s) of this one."""
        return np.flatnonzero(self.interpolated.covers(self.other_times(self.sampled.t, time_offset), margin))

    def at(self, samples: IntArray, time_offset: float) -> CoupledPoses:
        """Both sides at some of the samples."""
        own = self.sampled
        R, p = own.rotation[samples], own.position[samples]
        points = self.interpolated.at(self.other_times(own.t[samples], time_offset))
        slide = np.hstack([points.angular_velocity, points.velocity])
        if self.at_hand:
            return CoupledPoses(points.rotation, points.position, R, p, -slide, None, points.inside)
        return CoupledPoses(R, p, points.rotation, points.position, None, slide, points.inside)


def coupling_rows(state: State, poses: CoupledPoses) -> tuple[FloatArray, FloatArray]:
    """Residuals of the rigid coupling and their derivatives.

    Both are what the robot predicts against what the other sensor measured, in the hand frame:
    ``log((R_w_r R_r_h)' R_w_t R_t_h)`` (rad) and ``(R_w_t R_t_h)' (R_w_r p_r_h + p_w_r - R_w_t p_t_h - p_w_t)`` (m).

    Returns
    -------
    residual : (n, 6) ndarray
        [rotation; position]; zero where the interpolated side has a gap.
    jacobian : (n, 6, 13) ndarray
        Columns as in `COLUMNS`, rotations by right perturbations.
    """
    X, lever, Y, origin = (
        state[k] for k in ("rotation", "translation", "world_rotation", "world_translation")
    )
    A, B = poses.robot_rotation, poses.hand_rotation
    BT = transposed(B)
    error = lie.so3_log(transposed(A @ X) @ Y @ B)
    left = lie.so3_left_jacobian_inverse(error)
    right = lie.so3_right_jacobian_inverse(error)
    seen = (A @ lever + poses.robot_position - origin) @ Y  # hand origin as the robot has it, in t
    back = BT @ Y.T
    residual = np.concatenate([error, apply(BT, seen - poses.hand_position)], axis=1)

    jacobian = np.zeros((len(A), 6, 13))
    jacobian[:, :3, 0:3] = -left
    jacobian[:, :3, 6:9] = right @ BT
    jacobian[:, 3:, 3:6] = back @ A
    jacobian[:, 3:, 6:9] = BT @ lie.skew(seen)
    jacobian[:, 3:, 9:12] = -back
    if poses.robot_slide is not None:
        w, v = poses.robot_slide[:, :3], poses.robot_slide[:, 3:]
        jacobian[:, :3, 12] = -apply(left, w @ X)
        jacobian[:, 3:, 12] = apply(back, apply(A, np.cross(w, lever)) + v)
    if poses.hand_slide is not None:
        w, v = poses.hand_slide[:, :3], poses.hand_slide[:, 3:]
        jacobian[:, :3, 12] = apply(right, w)
        jacobian[:, 3:, 12] = -np.cross(w, residual[:, 3:]) - apply(BT, v)
    outside = ~poses.inside
    residual[outside] = 0.0
    jacobian[outside] = 0.0
    return residual, jacobian


def noise_information(
    state: State, poses: CoupledPoses, robot_noise: FloatArray, hand_noise: FloatArray, whitener: FloatArray
) -> FloatArray:
    """Information (13, 13) that noise of the poses adds by shaking the Jacobian: ``sum dJ' W' W dJ`` for one draw of such noise.

    Parameters
    ----------
    robot_noise, hand_noise : (2, 2) ndarray
        As :attr:`PoseCurve.noise`.
    whitener : (n, 6, 6) ndarray
        ``W`` of every sample, robust weights included.
    """
    rng = np.random.default_rng(0)

    def draw(sd: FloatArray) -> FloatArray:
        return np.asarray(np.repeat(sd, 3) * rng.standard_normal((len(poses.robot_position), 6)))

    robot, hand = draw(robot_noise[0]), draw(hand_noise[0])
    shaken = replace(
        poses,
        robot_rotation=poses.robot_rotation @ lie.so3_exp(robot[:, :3]),
        robot_position=poses.robot_position + robot[:, 3:],
        hand_rotation=poses.hand_rotation @ lie.so3_exp(hand[:, :3]),
        hand_position=poses.hand_position + hand[:, 3:],
        robot_slide=None if poses.robot_slide is None else poses.robot_slide + draw(robot_noise[1]),
        hand_slide=None if poses.hand_slide is None else poses.hand_slide + draw(hand_noise[1]),
    )
    change = (whitener @ (coupling_rows(state, shaken)[1] - coupling_rows(state, poses)[1])).reshape(-1, 13)
    return np.asarray(change.T @ change)


# ---- start --------------------------------------------------------------------------------------------------


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
    first = first[:: -(-first.size // _MOST_PAIRS)]
    last = last[first]
    turn = lie.so3_log(transposed(curve.rotation[first]) @ curve.rotation[last])
    return _Pairs(curve.t[first], curve.t[last], turn, curve.position[last] - curve.position[first])


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

    def scores(offset: float) -> tuple[float, float]:
        turn, way, inside = _other_side(coupling, pairs, offset)
        if np.count_nonzero(inside) < max(3, 0.25 * inside.size):
            return -1.0, -1.0
        return _alike(turn[inside], pairs.turn[inside]), _alike(way[inside], pairs.way[inside])

    coarse = guess + _COARSE_STEP * np.arange(-round(reach / _COARSE_STEP), round(reach / _COARSE_STEP) + 1)
    table = np.array([scores(float(offset)) for offset in coarse])
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

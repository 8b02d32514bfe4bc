"""The terms of the wrist problem by finite differences, its linear algebra against dense matrices."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.problems import WristPose, WristSettings
from factorgrasp.problems.wrist_chain import Chain, marginals
from factorgrasp.problems.wrist_frames import in_start_frame
from factorgrasp.problems.wrist_model import (
    NODE_SIZE,
    motion_covariance,
    motion_rows,
    predict,
    process_covariance,
    retract,
    transition,
)
from factorgrasp.problems.wrist_settings import Motion, WristNoise
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.problems.wrist_tracker import WristTracker
from factorgrasp.simulation.wrist import cordella2014
from factorgrasp.solvers.gtsam_fixed_lag import FixedLagSmoother, smooth

CAMERA = Camera(525.0, 520.0, 315.0, 244.0, 640, 480, (0.12, -0.25, 1e-3, -2e-3, 0.08))
MOTIONS: tuple[Motion, ...] = ("acceleration", "jerk")


def nodes(rng: np.random.Generator, count: int, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    R = lie.so3_exp(rng.normal(0.0, 0.6, (count, 3)))
    x = rng.normal(0.0, 0.5, (count, NODE_SIZE[motion] - 3))
    x[:, :3] = rng.uniform([-0.1, -0.1, 0.6], [0.1, 0.1, 0.9], (count, 3))
    return R, x


def test_markers_have_the_derivatives_that_they_say(rng: np.random.Generator) -> None:
    R, x = nodes(rng, 6, "acceleration")
    m = MarkerLayout.palm().points
    _, J_pose, J_point = predict(CAMERA, R, x[:, :3], m)
    h = 1e-6
    for i in range(6):
        step = np.zeros(12)
        step[i] = h
        ends = []
        for sign in (1.0, -1.0):
            R_moved, x_moved = retract(R, x, np.broadcast_to(sign * step, (6, 12)))
            ends.append(predict(CAMERA, R_moved, x_moved[:, :3], m)[0])
        np.testing.assert_allclose(J_pose[:, :, i], (ends[0] - ends[1]) / (2 * h), atol=2e-4)
    for i in range(3):
        away = h * np.eye(3)[i]
        ends = [predict(CAMERA, R, x[:, :3], m + sign * away)[0] for sign in (1.0, -1.0)]
        np.testing.assert_allclose(J_point[:, :, i], (ends[0] - ends[1]) / (2 * h), atol=2e-4)


@pytest.mark.parametrize("motion", MOTIONS)
def test_motion_has_the_derivatives_that_it_says(motion: Motion, rng: np.random.Generator) -> None:
    R, x = nodes(rng, 2, motion)
    R[1] = R[0] @ lie.so3_exp([0.3, -0.2, 0.4])
    dt, D, h = np.array([0.04]), NODE_SIZE[motion], 1e-6
    _, first, second = motion_rows(R, x, dt, motion)
    for node, J in ((0, first), (1, second)):
        for i in range(D):
            ends = []
            for sign in (1.0, -1.0):
                step = np.zeros((2, D))
                step[node, i] = sign * h
                ends.append(motion_rows(*retract(R, x, step), dt, motion)[0][0])
            np.testing.assert_allclose(J[0, :, i], (ends[0] - ends[1]) / (2 * h), atol=1e-7)


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_node_moved_on_leaves_no_residual(motion: Motion, rng: np.random.Generator) -> None:
    R, x = nodes(rng, 1, motion)
    R_next, x_next, F = transition(R[0], x[0], 0.05, motion)
    residual, _, _ = motion_rows(np.stack([R[0], R_next]), np.stack([x[0], x_next]), np.array([0.05]), motion)
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)
    h, D = 1e-6, NODE_SIZE[motion]
    for i in range(D):
        ends = []
        for sign in (1.0, -1.0):
            moved = retract(R, x, sign * h * np.eye(D)[i : i + 1])
            out = transition(moved[0][0], moved[1][0], 0.05, motion)
            ends.append(np.concatenate([lie.so3_log(R_next.T @ out[0]), out[1] - x_next]))
        np.testing.assert_allclose(F[:, i], (ends[0] - ends[1]) / (2 * h), atol=1e-6)


@pytest.mark.parametrize("motion", MOTIONS)
def test_process_noise_of_two_steps_is_that_of_one(motion: Motion) -> None:
    order = 2 if motion == "acceleration" else 3
    a, b = 0.03, 0.05
    F = np.eye(order)
    F[0, 1] = b
    if order == 3:
        F[1, 2], F[0, 2] = b, b * b / 2.0
    two = F @ motion_covariance(a, motion) @ F.T + motion_covariance(b, motion)
    np.testing.assert_allclose(two, motion_covariance(a + b, motion), rtol=1e-12)
    whole = process_covariance(a, np.array([4.0, 9.0]), motion)
    np.testing.assert_allclose(whole[0, 0], 4.0 * motion_covariance(a, motion)[0, 0])
    np.testing.assert_allclose(whole[4, 10], 9.0 * motion_covariance(a, motion)[0, 1])


def test_marginals_of_a_chain_are_those_of_the_inverse(rng: np.random.Generator) -> None:
    n, D, B = 7, 4, 3
    A = rng.standard_normal((n * D + B, n * D + B))
    H = A @ A.T + 60.0 * np.eye(n * D + B)
    for i in range(n):
        for j in range(n):
            if abs(i - j) > 1:
                H[i * D : (i + 1) * D, j * D : (j + 1) * D] = 0.0
    g = rng.standard_normal(n * D + B)
    blocks = [slice(i * D, (i + 1) * D) for i in range(n)]
    tail = slice(n * D, None)
    chain = Chain(
        np.stack([H[b, b] for b in blocks]),
        np.stack([H[a, b] for a, b in pairwise(blocks)]),
        np.stack([H[b, tail] for b in blocks]),
        H[tail, tail],
    )
    found = marginals(chain, g[: n * D].reshape(n, D), g[tail])
    P, x = np.linalg.inv(H), np.linalg.solve(H, g)
    np.testing.assert_allclose(found.border, P[tail, tail], atol=1e-12)
    np.testing.assert_allclose(found.step.ravel(), x[: n * D], atol=1e-12)
    np.testing.assert_allclose(found.border_step, x[tail], atol=1e-12)
    for k, b in enumerate(blocks):
        np.testing.assert_allclose(found.nodes[k], P[b, b], atol=1e-12)
        np.testing.assert_allclose(found.with_border[k], P[b, tail], atol=1e-12)
        if k:
            np.testing.assert_allclose(found.neighbours[k - 1], P[blocks[k - 1], b], atol=1e-12)


def test_covariance_in_the_start_frame_is_that_of_samples(rng: np.random.Generator) -> None:
    R_0, R = lie.so3_exp([3.0, 0.2, -0.1]), lie.so3_exp([2.7, 0.4, 0.3])
    p_0, p = np.array([0.02, -0.01, 0.7]), np.array([0.12, 0.05, 0.66])
    layout = 3
    A = 1e-3 * rng.standard_normal((12, 12 + layout))
    gain, own = rng.standard_normal((6, layout)), 1e-3 * rng.standard_normal((6, 6))
    z, s = rng.standard_normal((200_000, 12 + layout)), rng.standard_normal((200_000, 6))
    dm = 1e-3 * z[:, 12:]
    node, start = z @ A.T, dm @ gain.T + s @ own.T
    R_s, p_s = R @ lie.so3_exp(node[:, :3]), p + node[:, 3:6]
    R0_s, p0_s = R_0 @ lie.so3_exp(start[:, :3]), p_0 + start[:, 3:]
    x = np.zeros(9)
    x[:3] = p
    C_0 = own @ own.T + 1e-6 * gain @ gain.T
    found = in_start_frame(CameraPose(R_0, p_0, C_0, 1, gain), R, x, A @ A.T, 1e-3 * A[:, 12:])
    back = np.swapaxes(R0_s, 1, 2)
    e = np.concatenate(
        [lie.so3_log(found.R.T @ (back @ R_s)), (back @ (p_s - p0_s)[:, :, None])[:, :, 0] - found.p], axis=1
    )
    sampled = e.T @ e / len(e)
    scale = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
    np.testing.assert_allclose(found.covariance / scale, sampled / scale, atol=0.02)


@pytest.mark.parametrize("motion", MOTIONS)
def test_rows_of_the_whole_problem_have_the_derivatives_that_they_say(motion: Motion) -> None:
    recording = cordella2014(1, motion="three_axes", duration=2.0)
    problem = WristPose(recording.camera, recording.blobs, recording.layout, noise=WristNoise(motion=motion))
    state = problem.initial_state()
    system = problem.linearize(state)
    d = 1e-6 * np.random.default_rng(0).standard_normal(system.size)
    step = system.whitened()[0] @ d
    plus = problem.linearize(problem.retract(state, d)).whitened()[1].copy()
    minus = problem.linearize(problem.retract(state, -d)).whitened()[1].copy()
    np.testing.assert_allclose((minus - plus) / 2.0, step, atol=1e-8 * np.abs(step).max())


def test_a_window_as_long_as_the_recording_is_the_batch() -> None:
    recording = cordella2014(2, motion="flexion", duration=1.5)
    noise = WristNoise(adapt=False)
    settings = WristSettings(lag=60, loss_scale=np.inf)
    tracker = WristTracker(
        recording.camera, recording.layout, WristPose(recording.camera, recording.blobs, recording.layout).association,
        noise, settings,
    )  # fmt: skip
    for k in range(len(recording.blobs)):
        tracker.push(recording.blobs.at(k))
    tracker.window._smooth()
    tracker.window._smooth()
    nodes = [node for _, node in tracker.flush()]
    problem = WristPose(recording.camera, recording.blobs, recording.layout, noise=noise, settings=settings)
    problem.round = 99  # the association of the first pass, as it is
    from factorgrasp import solve

    found = solve(problem)
    R, x, _ = problem.nodes_of(found.estimate.values)
    P = problem.marginals(found.estimate.values).nodes
    sd = np.sqrt(np.einsum("kii->ki", P))
    turn = lie.so3_log(np.swapaxes(R, 1, 2) @ np.stack([n.R for n in nodes]))
    # The window begins with a loose prior on the pose that the batch has not.
    assert np.max(np.abs(turn) / sd[:, :3]) < 0.02
    assert np.max(np.abs(x[:, :3] - np.stack([n.x[:3] for n in nodes])) / sd[:, 3:6]) < 0.02
    np.testing.assert_allclose(np.stack([np.diag(n.covariance) for n in nodes]), sd**2, rtol=0.02)


def test_fixed_lag_in_gtsam_and_ours_are_one() -> None:
    recording = cordella2014(3, motion="three_axes", duration=1.5, occlusion=0.0, clutter=0.0)
    noise, settings = WristNoise(adapt=False), WristSettings(loss_scale=np.inf)
    problem = WristPose(recording.camera, recording.blobs, recording.layout, noise=noise, settings=settings)
    first = problem.first_pass
    keys = problem._graph
    track = smooth(problem.increments(), _keys, FixedLagSmoother(lag=10.5 / 30.0))
    assert keys is problem._graph
    for k in range(len(recording.blobs) - 11):
        theirs = track.lagged[k]
        assert theirs is not None
        mine = first.nodes[problem.frames.start + k]
        sd = np.sqrt(np.diag(mine.covariance))
        turn = lie.so3_log(mine.R.T @ theirs.values[0])
        assert np.max(np.abs(turn) / sd[:3]) < 0.05
        assert np.max(np.abs(theirs.values[1][:3] - mine.x[:3]) / sd[3:6]) < 0.05


def _keys(k: int) -> tuple[int, ...]:
    from factorgrasp.problems.wrist_graph import keys_of

    return keys_of(k)

"""A grasp that may wander: factors against finite differences, all solvers against each other, tracks against truth."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from factorgrasp import lie, solve
from factorgrasp.errors import InputError
from factorgrasp.problems import GraspNoise, GraspPose, GraspSettings
from factorgrasp.problems.grasp_segment_cut import segment_labels
from factorgrasp.problems.grasp_segment_factor import Quadratic
from factorgrasp.problems.grasp_segments import GraspSegments
from factorgrasp.problems.grasp_track import GraspTrack
from factorgrasp.recordings import ImuStream
from factorgrasp.simulation.cehajic2015 import (
    QUATERNION_WXYZ,
    ROUGH_ENCODER_NOISE,
    TRANSLATION,
    cehajic2015,
    grasp_slip,
)
from factorgrasp.simulation.grasp import GraspChange, GraspRecording
from factorgrasp.solvers.base import SolverOptions
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, State
from factorgrasp.variables import retract

BROAD = "07_undisturbed_fast_rotation_B"


def posed(recording: GraspRecording, **settings: Any) -> GraspPose:
    return GraspPose(recording.robot, recording.hand, settings=GraspSettings(**settings))


def wandering(seed: int, sd: float, duration: float = 30.0, **options: Any) -> GraspRecording:
    """A hand that takes a random step of ``sd`` rad and m every second."""
    rng = np.random.default_rng([seed, 7])
    R, p = lie.quaternion_wxyz_to_matrix(QUATERNION_WXYZ), np.array(TRANSLATION)
    changes = []
    for t in np.arange(duration):
        R, p = R @ lie.so3_exp(sd * rng.standard_normal(3)), p + sd * rng.standard_normal(3)
        changes.append(GraspChange(float(t), 1.0, R, p))
    return cehajic2015(seed, duration=duration, changes=tuple(changes), **options)


def errors(track: GraspTrack, recording: GraspRecording, seconds: float) -> FloatArray:
    """Against the mean of the true grasp over every segment, (K, 6)."""
    out = []
    for k, t in enumerate(track.t):
        R, p = recording.truth.grasp_at(t + np.linspace(-0.5, 0.5, 21) * seconds)
        turn = lie.so3_log(np.matmul(R.transpose(0, 2, 1), track.rotation[k])).mean(axis=0)
        out.append(np.concatenate([turn, track.translation[k] - p.mean(axis=0)]))
    return np.array(out)


@pytest.fixture(scope="module")
def still() -> GraspRecording:
    return cehajic2015(2, duration=30.0)


@pytest.fixture(scope="module")
def slip() -> GraspRecording:
    return grasp_slip(1, at=8.0, time=20.0, duration=36.0)


@pytest.fixture(scope="module")
def slip_track(slip: GraspRecording) -> GraspTrack:
    track: GraspTrack = solve(GraspSegments(posed(slip), 1.0, 4e-3, 4e-3))
    return track


def everything(recording: GraspRecording) -> GraspSegments:
    """All unknowns there are, with a robot whose noise is worth taking out."""
    problem = posed(recording, base_tilt=True, sensor_errors="always")
    return GraspSegments(problem, 2.0, 2e-3, 2e-3)


def nearby(segments: GraspSegments, seed: int = 0, size: float = 0.02) -> State:
    start = segments.initial_state()
    step = size * np.random.default_rng(seed).standard_normal(sum(v.size for v in segments.variables))
    return segments.retract(start, step)


# ---- one factor


@pytest.mark.parametrize("static", [False, True])
def test_value_and_gradient_of_a_factor_are_exact(static: bool) -> None:
    recording = cehajic2015(5, duration=12.0, robot=ROUGH_ENCODER_NOISE)
    segments = everything(recording)
    if static:
        segments = GraspSegments(segments.problem, 2.0, static=True)
    assert [v.name for v in segments.model.variables][2:] == [
        "gyro_bias",
        "accelerometer_bias",
        "time_offset",
        "accelerometer_delay",
        "base_tilt",
        "gyro_calibration",
        "accelerometer_calibration",
    ]
    state, factor = segments.local(nearby(segments), 2), segments.factors[2]
    form = factor.quadratic(state)
    size, h = segments.model.size, 1e-5
    values = np.empty((2, size))
    gradients = np.empty((2, size, size))
    for i in range(size):
        for side, sign in enumerate((1.0, -1.0)):
            moved = factor.quadratic(retract(segments.model.variables, state, sign * h * np.eye(size)[i]))
            values[side, i], gradients[side, i] = moved.value, moved.gradient
    numerical = (values[0] - values[1]) / (2.0 * h)
    np.testing.assert_allclose(form.gradient, numerical, rtol=1e-5, atol=1e-6 * np.abs(form.gradient).max())
    # The lever arm enters linearly: there the Gauss-Newton matrix is the second derivative.
    second = (gradients[0] - gradients[1])[3:6, 3:6] / (2.0 * h)
    np.testing.assert_allclose(form.matrix[3:6, 3:6], second, rtol=1e-6)


def test_slip_rate_is_eliminated_as_a_bias_of_the_segment_alone() -> None:
    recording = cehajic2015(5, duration=12.0)
    segments = GraspSegments(posed(recording), 2.0, 5e-3, 5e-3)
    plain = GraspSegments(segments.problem, 2.0, static=True).factors[1]
    factor = segments.factors[1]
    state = segments.local(nearby(segments), 1)
    columns = segments.model.columns["gyro_bias"]
    precision = 2.0 / 5e-3**2  # variance of the mean rate: sd^2 / segment_seconds
    rate = np.zeros(3)
    for _ in range(3):
        form = plain.quadratic({**state, "gyro_bias": state["gyro_bias"] + rate})
        H = form.matrix[columns, columns] + precision * np.eye(3)
        rate = rate - np.linalg.solve(H, form.gradient[columns] + precision * rate)
    form = plain.quadratic({**state, "gyro_bias": state["gyro_bias"] + rate})
    found = factor.quadratic(state)
    assert np.linalg.norm(rate) > 1e-4
    assert found.value == pytest.approx(form.value + 0.5 * precision * rate @ rate, rel=1e-10)
    cross = form.matrix[:, columns]
    H = form.matrix[columns, columns] + precision * np.eye(3)
    scale = np.sqrt(np.diag(form.matrix))
    np.testing.assert_allclose(
        found.gradient / scale, form.gradient / scale, atol=1e-7 * np.linalg.norm(form.gradient / scale)
    )
    reduced = form.matrix - cross @ np.linalg.solve(H, cross.T)
    np.testing.assert_allclose(
        found.matrix / np.outer(scale, scale), reduced / np.outer(scale, scale), atol=1e-9
    )
    by_hand = np.log(np.linalg.det(np.eye(3) + form.matrix[columns, columns] / precision))
    assert factor.slip_rate_evidence(state) == pytest.approx(by_hand, rel=1e-6)


@pytest.mark.parametrize("negative", [0, 1, 3])
def test_rows_hold_value_gradient_and_curvature_even_of_an_indefinite_cost(
    negative: int, rng: np.random.Generator
) -> None:
    basis = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    curvature = np.array([4.0, 2.0, 1.0, 0.5, 0.2, 0.1])
    curvature[:negative] *= -1.0
    scale = 10.0 ** rng.uniform(-3, 3, 6)
    H = scale[:, None] * (basis * curvature @ basis.T) * scale
    g = scale * rng.normal(size=6)
    A, b = Quadratic(30.0, g, H).rows(5.0)
    assert A.shape == (7, 6)
    np.testing.assert_array_equal(A[-1], 0.0)
    np.testing.assert_allclose(A.T @ b, -g, rtol=1e-9)
    assert 0.5 * b @ b == pytest.approx(35.0, rel=1e-12)
    M = A.T @ A
    assert np.linalg.eigvalsh(M / np.outer(scale, scale))[0] > 0.0
    if negative == 0:
        np.testing.assert_allclose(M / np.outer(scale, scale), H / np.outer(scale, scale), atol=1e-12)
    else:
        # At least as curved as the cost in every direction, so that a step never overshoots.
        assert np.linalg.eigvalsh((M - H) / np.outer(scale, scale))[0] > -1e-12


def test_rows_never_promise_more_than_the_value() -> None:
    H, g = np.diag([1.0, 1e-9, -1e-9]), np.array([1.0, 2.0, 0.5])
    A, b = Quadratic(3.0, g, H).rows(1.0)
    np.testing.assert_allclose(A.T @ b, -g, rtol=1e-12)
    assert 0.5 * b @ b == pytest.approx(4.0)
    assert A[:, 0] @ A[:, 0] == pytest.approx(1.0)


# ---- the cut


@pytest.mark.parametrize("motion", ["exciting", "printed"])
def test_segments_add_up_to_the_recording(motion: Any) -> None:
    recording = cehajic2015(3, motion=motion, duration=30.0, robot=ROUGH_ENCODER_NOISE)
    problem = posed(recording)
    segments = GraspSegments(problem, 2.0, static=True)
    state = problem.initial_state()
    system = problem.linearize(state)
    matrix, rhs = system.whitened()
    own = np.zeros(rhs.size, dtype=bool)
    for name in ("gyroscope", "accelerometer"):
        own[system.jacobian.slices[name]] = True
    A, b = matrix.toarray()[own], rhs[own]
    forms = [factor.quadratic(state) for factor in segments.factors]
    H = np.sum([form.matrix for form in forms], axis=0)
    scale = np.sqrt(np.diag(H))
    np.testing.assert_allclose(H / np.outer(scale, scale), A.T @ A / np.outer(scale, scale), atol=1e-9)
    g = np.sum([form.gradient for form in forms], axis=0)
    np.testing.assert_allclose(g / scale, -A.T @ b / scale, atol=1e-9 * np.linalg.norm(b))
    assert sum(form.value for form in forms) == pytest.approx(0.5 * b @ b, rel=1e-9)
    # With this robot single segments do have negative curvature on the printed motion; they are not clipped.
    lowest = min(np.linalg.eigvalsh(form.matrix / np.outer(scale, scale))[0] for form in forms)
    assert lowest < 0.0 or motion == "exciting"


def test_labels_leave_out_what_holds_no_window() -> None:
    t = np.array([0.5, 1.0, 1.5, 2.0, 9.0, 9.5, 11.0])
    np.testing.assert_array_equal(segment_labels(t, 1.0), [0, 0, 1, 1, 2, 3, 4])


def test_the_walk_goes_on_through_a_gap(still: GraspRecording) -> None:
    hand = still.hand
    kept = (hand.t < 10.0) | (hand.t > 16.0)
    gapped = ImuStream(hand.t[kept], hand.angular_velocity[kept], hand.specific_force[kept])
    segments = GraspSegments(GraspPose(still.robot, gapped), 2.0, 1e-3, 1e-3)
    steps = np.diff(segments.t)
    assert steps.max() > 6.0
    system = segments.linearize(segments.initial_state())
    variances = system.terms["translation walk"].covariance.rows_root(3 * steps.size) ** -2.0
    np.testing.assert_allclose(variances, np.repeat(1e-6 * steps, 3), rtol=1e-9)
    track = solve(segments)
    assert track.status is Status.SOLVED
    np.testing.assert_allclose(
        track.translation, np.broadcast_to(still.truth.translation, track.translation.shape), atol=4e-3
    )


# ---- the whole problem


def test_linearisation_against_finite_differences() -> None:
    segments = everything(cehajic2015(5, duration=12.0))
    state = nearby(segments, 1)
    system = segments.linearize(state)
    matrix, rhs = (np.copy(part) for part in (system.whitened()[0].toarray(), system.whitened()[1]))
    ties = np.ones(rhs.size, dtype=bool)
    ties[system.jacobian.slices["moments"]] = False
    h = 1e-6
    for i in range(0, system.size, 5):
        step = h * np.eye(system.size)[i]
        plus = segments.linearize(segments.retract(state, step)).whitened()[1].copy()
        minus = segments.linearize(segments.retract(state, -step)).whitened()[1].copy()
        # Rows are A d - b, so that b falls where the residual rises.
        np.testing.assert_allclose((minus - plus)[ties] / (2 * h), matrix[ties, i], rtol=1e-5, atol=1e-4)
        slope = (0.5 * plus @ plus - 0.5 * minus @ minus) / (2 * h)
        assert -matrix[:, i] @ rhs == pytest.approx(
            slope, rel=1e-4, abs=1e-4 * np.linalg.norm(matrix[:, i]) * np.linalg.norm(rhs)
        )


@pytest.mark.parametrize("solver", ["cholesky", "gtsam-isam2", "gtsam-levenberg-marquardt"])
def test_static_segments_agree_with_the_compressed_solver(still: GraspRecording, solver: str) -> None:
    problem = posed(still)
    compressed = solve(problem)
    options = SolverOptions(extra={"increments": 15})
    track = solve(GraspSegments(problem, static=True), solver, options if solver == "gtsam-isam2" else None)
    assert track.status is Status.SOLVED
    assert track.rotation.shape == (1, 3, 3)
    assert lie.angle_between(track.rotation[0], compressed.rotation) < 1e-8
    np.testing.assert_allclose(track.translation[0], compressed.translation, atol=1e-8)
    assert track.time_offset == pytest.approx(compressed.time_offset, abs=1e-9)
    np.testing.assert_allclose(track.covariance[0], compressed.covariance, rtol=1e-4, atol=1e-12)


def test_a_walk_without_width_is_a_static_grasp(still: GraspRecording) -> None:
    track = solve(GraspSegments(posed(still), 2.0, 1e-8, 1e-8))
    again = solve(track.problem.with_walk(static=True))
    assert np.max(lie.angle_between(track.rotation, again.rotation)) < 1e-6
    np.testing.assert_allclose(
        track.translation, np.repeat(again.translation, track.t.size, axis=0), atol=1e-6
    )


@pytest.mark.parametrize("solver", ["clarabel", "gtsam", "gtsam-gauss-newton"])
def test_solvers_agree_on_a_grasp_that_wanders(solver: str) -> None:
    recording = wandering(6, 1e-3, duration=16.0)
    settled = solve(GraspSegments(posed(recording), 2.0, 1e-3, 1e-3)).problem
    same = settled.with_walk(1e-3, 1e-3)
    one, other = solve(same), solve(same, solver)
    assert other.status is Status.SOLVED
    assert np.max(lie.angle_between(one.rotation, other.rotation)) < 1e-6
    np.testing.assert_allclose(one.translation, other.translation, atol=1e-6)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-3, atol=1e-10)


def test_graph_has_one_factor_a_segment_and_readable_keys(still: GraspRecording) -> None:
    gtsam = pytest.importorskip("gtsam")
    segments = GraspSegments(posed(still), 3.0, 1e-3, 1e-3)
    state = nearby(segments)
    graph, values = segments.factor_graph(state), segments.graph_values(state)
    K = len(segments.factors)
    assert graph.size() == K + 2 * (K - 1) + 3
    names = {gtsam.DefaultKeyFormatter(key) for key in graph.keyVector()}
    assert names == {f"{letter}{k}" for letter in "rp" for k in range(K)} | {"c0"}
    back = segments.graph_state(values)
    assert list(back) == [variable.name for variable in segments.variables]
    for name, value in state.items():
        np.testing.assert_allclose(back[name], value, atol=1e-14)
    # The same objective and, where nothing is indefinite, the same normal equations as our rows.
    system = segments.linearize(state)
    assert graph.error(values) == pytest.approx(system.objective(np.zeros(system.size)), rel=1e-9)
    node = segments.factors[1].hessian(values)
    form = segments.factors[1].quadratic(segments.local(state, 1))
    size = np.abs(form.matrix).max()
    np.testing.assert_allclose(node.information(), form.matrix, atol=1e-14 * size)
    np.testing.assert_allclose(node.linearTerm().ravel(), -form.gradient, rtol=1e-12)
    assert node.constantTerm() == pytest.approx(2.0 * form.value)


def test_a_slip_is_followed(slip: GraspRecording, slip_track: GraspTrack) -> None:
    assert slip_track.status is Status.SOLVED
    error = errors(slip_track, slip, 1.0)
    assert np.rad2deg(np.sqrt(np.mean(np.sum(error[:, :3] ** 2, axis=1)))) < 0.15
    assert np.sqrt(np.mean(np.sum(error[:, 3:] ** 2, axis=1))) < 4e-3
    change, covariance = slip_track.change(4, -4)
    after = slip.truth.changes[0]
    truth = np.concatenate(
        [
            lie.so3_log(slip.truth.rotation.T @ np.asarray(after.rotation)),
            np.asarray(after.translation) - slip.truth.translation,
        ]
    )
    assert np.linalg.norm(truth[:3]) > np.deg2rad(2.9)
    miss = change - truth
    assert miss @ np.linalg.solve(covariance, miss) < 22.5  # chi-square, 6 degrees of freedom, 99.9 %
    assert np.linalg.norm(miss[3:]) < 5e-3
    # One grasp for all the recording is degrees off.
    static = solve(GraspSegments(posed(slip), 1.0, static=True))
    assert np.rad2deg(np.max(lie.angle_between(static.rotation, slip.truth.grasp_at(slip_track.t)[0]))) > 1.0


@pytest.mark.parametrize("robot", [None, ROUGH_ENCODER_NOISE])
def test_covariances_are_consistent_when_the_grasp_walks(robot: Any) -> None:
    options = {} if robot is None else {"robot": robot}
    ratios = []
    for seed in range(4):
        recording = wandering(seed, 1e-3, duration=20.0, **options)
        track = solve(GraspSegments(posed(recording), 2.0, 1e-3, 1e-3))
        assert track.status is Status.SOLVED
        error = errors(track, recording, 2.0)
        ratios.append(np.mean(np.einsum("ki,kij,kj->k", error, np.linalg.inv(track.covariance), error)) / 6.0)
    # The errors of one track hang together: forty nodes are worth about four. Over many seeds the mean is 0.8 to 1.0.
    assert 0.4 < np.mean(ratios) < 1.5


def test_evidence_prefers_the_true_walk_and_a_still_grasp_for_a_still_hand(still: GraspRecording) -> None:
    track = solve(GraspSegments(posed(wandering(3, 1e-3, duration=16.0)), 1.0, 1e-3, 1e-3))
    evidence = {
        walk: solve(track.problem.with_walk(*walk)).log_evidence
        for walk in ((1e-4, 1e-3), (1e-3, 1e-4), (1e-3, 1e-3), (1e-2, 1e-3), (1e-3, 1e-2))
    }
    assert max(evidence, key=lambda walk: evidence[walk]) == (1e-3, 1e-3)
    assert solve(track.problem.with_walk(static=True)).log_evidence < max(evidence.values()) - 50.0
    track = solve(GraspSegments(posed(still), 2.0, 3e-4, 3e-4))
    assert solve(track.problem.with_walk(static=True)).log_evidence > track.log_evidence + 5.0


def test_robust_loss_and_forgetting_settle_too(slip: GraspRecording, still: GraspRecording) -> None:
    hand = slip.hand
    force = hand.specific_force.copy()
    force[17_000:17_040] += 20.0  # a knock on the sensor
    knocked = ImuStream(hand.t, hand.angular_velocity, force)
    plain, robust = (
        solve(
            GraspSegments(GraspPose(slip.robot, knocked, settings=GraspSettings(loss=loss)), 2.0, 4e-3, 4e-3)
        )
        for loss in ("none", "geman_mcclure")
    )
    assert robust.status is Status.SOLVED
    rms = [np.sqrt(np.mean(errors(track, slip, 3.0)[:, 3:] ** 2)) for track in (plain, robust)]
    assert rms[1] < 2.5e-3
    assert rms[1] < 0.8 * rms[0]
    forgetful = solve(GraspSegments(posed(still, forgetting_time=10.0), 3.0, 4e-3, 4e-3))
    assert forgetful.status is Status.SOLVED
    sd = np.sqrt(np.trace(forgetful.covariance, axis1=1, axis2=2))
    assert sd[1] > 1.5 * sd[-2]


# ---- the answer


def test_track_says_what_it_holds(slip_track: GraspTrack, tmp_path: Any) -> None:
    K = slip_track.t.size
    assert slip_track.rotation.shape == (K, 3, 3)
    assert slip_track.covariance.shape == (K, 6, 6)
    words = slip_track.summary()
    assert f"{K} segments" in words
    assert "solved" in words
    moments = next(term for term in slip_track.estimate.residuals if term.name == "moments")
    assert 0.8 < moments.rms < 1.2
    assert moments.rows > 5_000
    change, covariance = slip_track.change(3, 30)
    np.testing.assert_allclose(change[3:], slip_track.translation[30] - slip_track.translation[3])
    full = slip_track.estimate.covariance("translation_3", "translation_30")
    expected = full[:3, :3] + full[3:, 3:] - full[:3, 3:] - full[3:, :3]
    np.testing.assert_allclose(covariance[3:, 3:], expected, rtol=1e-6)
    # A rotation between segments: numerically through the exponential map.
    R1, R2 = slip_track.rotation[3], slip_track.rotation[30]
    joint = slip_track.estimate.covariance("rotation_3", "rotation_30")
    J = np.empty((3, 6))
    for i in range(6):
        d = 1e-6 * np.eye(6)[i]
        moved = [lie.so3_log((R1 @ lie.so3_exp(s * d[:3])).T @ R2 @ lie.so3_exp(s * d[3:])) for s in (1, -1)]
        J[:, i] = (moved[0] - moved[1]) / 2e-6
    np.testing.assert_allclose(covariance[:3, :3], J @ joint @ J.T, rtol=1e-4, atol=1e-12)
    path = slip_track.save(tmp_path)
    saved = json.loads(path.read_text())
    np.testing.assert_allclose(saved["track"]["t"], slip_track.t)
    assert len(saved["track"]["rotation_wxyz"]) == K
    with np.load(path.with_suffix(".npz")) as arrays:
        np.testing.assert_allclose(arrays["covariance"], slip_track.covariance)


def test_unobserved_directions_are_named_with_their_time() -> None:
    recording = cehajic2015(1, motion="printed", duration=12.0)
    track = solve(GraspSegments(posed(recording), 4.0, 1e-3, 1e-3))
    assert track.status is Status.UNOBSERVABLE
    assert "rotation axis" in track.message
    assert " s" in track.observability.missing[0].words
    axis = np.array([10.0, 40.0, 20.0]) / np.linalg.norm([10.0, 40.0, 20.0])
    C = track.covariance[1][3:, 3:]
    assert np.sqrt(axis @ C @ axis) > 0.5
    assert track.problem.advice


def test_bad_input_is_named(still: GraspRecording) -> None:
    problem = posed(still)
    with pytest.raises(InputError, match="segment_seconds"):
        GraspSegments(problem, 0.2)
    with pytest.raises(InputError, match="rotation_walk_sd"):
        GraspSegments(problem, 2.0, 0.0, 1e-3)
    with pytest.raises(InputError, match="translation_walk_sd"):
        GraspSegments(problem, 2.0, 1e-3, np.nan)
    with pytest.raises(InputError, match="problem"):
        GraspSegments(still.robot)  # type: ignore[arg-type]
    GraspSegments(problem, 2.0, 0.0, 0.0, static=True)


def test_without_any_shared_unknown(still: GraspRecording) -> None:
    pytest.importorskip("gtsam")
    settings = GraspSettings(
        gyro_bias=False, accelerometer_bias=False, time_offset=False, sensor_errors="never"
    )
    segments = GraspSegments(GraspPose(still.robot, still.hand, GraspNoise(), settings), 5.0, 1e-3, 1e-3)
    assert all(len(factor.keys) == 2 for factor in segments.factors)
    values = segments.graph_values(segments.initial_state())
    assert segments.factors[0].hessian(values).information().shape == (6, 6)
    same = segments.with_walk(1e-3, 1e-3)
    one, other = solve(same), solve(same, "gtsam-gauss-newton")
    np.testing.assert_allclose(one.translation, other.translation, atol=1e-6)


def test_a_sensor_on_a_strap_hardly_drifts(broad_trial: Any) -> None:
    robot, hand = broad_trial(BROAD)
    problem = GraspPose(robot, hand)
    track = solve(GraspSegments(problem, 2.0, 1e-4, 1e-4))
    assert track.status is Status.SOLVED
    change, covariance = track.change()
    assert np.rad2deg(np.linalg.norm(change[:3])) < 0.15
    assert np.linalg.norm(change[3:]) < 1.5e-3
    assert np.all(np.sqrt(np.diag(covariance)) < [1e-3] * 3 + [1e-3] * 3)
    compressed = solve(problem)
    static = solve(GraspSegments(problem, 2.0, static=True), "gtsam-isam2")
    assert lie.angle_between(static.rotation[0], compressed.rotation) < 1e-6
    np.testing.assert_allclose(static.translation[0], compressed.translation, atol=1e-6)
    # The track stays about the one grasp.
    assert np.max(np.linalg.norm(track.translation - compressed.translation, axis=1)) < 1.5e-3

"""The streaming grasp estimator on simulated and real streams: accuracy, order, gaps, changes of the grasp, memory."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from factorgrasp import lie, solve
from factorgrasp.errors import InputError
from factorgrasp.online import OnlineGraspEstimate, OnlineGraspPose
from factorgrasp.problems import GraspPose, GraspSettings
from factorgrasp.recordings import ImuStream, PoseStream
from factorgrasp.simulation.cehajic2015 import cehajic2015, grasp_regrasp, grasp_slip
from factorgrasp.simulation.grasp import GraspRecording
from factorgrasp.status import Status
from factorgrasp.uncertainty import nees


def feed(online: OnlineGraspPose, recording: GraspRecording, first: int, last: int) -> None:
    """Samples first ... last - 1 of both sides."""
    part = slice(first, last)
    robot, hand = recording.robot, recording.hand
    online.add_robot(
        robot.t[part],
        angular_velocity=robot.angular_velocity[part],
        angular_acceleration=robot.angular_acceleration[part],
        specific_force=robot.specific_force[part],
    )
    online.add_hand(hand.t[part], hand.angular_velocity[part], hand.specific_force[part])


def stream(recording: GraspRecording, chunk: int = 100, **options: object) -> OnlineGraspPose:
    online = OnlineGraspPose(**options)  # type: ignore[arg-type]
    for first in range(0, len(recording.hand), chunk):
        feed(online, recording, first, first + chunk)
    return online


def error(estimate: OnlineGraspEstimate, R: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.concatenate([lie.so3_log(estimate.rotation.T @ R), p - estimate.translation])


@pytest.fixture(scope="module")
def recording() -> GraspRecording:
    return cehajic2015(seed=8, duration=25.0, time_offset=-0.031)


def test_a_stream_ends_where_the_batch_does(recording: GraspRecording) -> None:
    found = stream(recording).estimate()
    truth = recording.truth
    assert found.status is Status.SOLVED
    assert found.events == ()
    assert nees(error(found, truth.rotation, truth.translation), found.covariance) < 6 * 3.0
    assert np.linalg.norm(found.translation - truth.translation) < 0.002
    assert found.time_offset == pytest.approx(-0.031, abs=5e-4)
    # The stream has the noise's covariance only: the model check needs the whole recording.
    batch = solve(GraspPose(recording.robot, recording.hand, settings=GraspSettings(check_model=False)))
    sd = np.sqrt(np.diag(batch.covariance))
    assert np.max(np.abs(error(found, batch.rotation, batch.translation) / sd)) < 1.5
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), sd, rtol=0.2)


def test_before_the_motion_shows_the_grasp_it_says_so(recording: GraspRecording) -> None:
    online = OnlineGraspPose()
    early = online.estimate()
    assert early.status is Status.UNOBSERVABLE
    assert early.message
    assert np.isinf(early.covariance[0, 0])
    feed(online, recording, 0, 1000)
    assert online.estimate().status is Status.UNOBSERVABLE


def test_late_and_disordered_samples_change_nothing_and_too_late_ones_are_counted(
    recording: GraspRecording,
) -> None:
    straight = stream(recording, lateness=0.2).estimate()
    online = OnlineGraspPose(lateness=0.2)
    rng = np.random.default_rng(0)
    hand, n = recording.hand, len(recording.hand)
    for first in range(0, n, 100):
        part = np.arange(first, min(first + 100, n))
        robot = recording.robot
        online.add_robot(
            robot.t[part],
            angular_velocity=robot.angular_velocity[part],
            angular_acceleration=robot.angular_acceleration[part],
            specific_force=robot.specific_force[part],
        )
        rng.shuffle(part)
        for half in (part[: part.size // 2], part[part.size // 2 :]):
            online.add_hand(hand.t[half], hand.angular_velocity[half], hand.specific_force[half])
    disordered = online.estimate()
    assert disordered.hand.late == 0
    sd = np.sqrt(np.diag(straight.covariance))
    assert np.max(np.abs(error(disordered, straight.rotation, straight.translation) / sd)) < 0.5
    online.add_hand(hand.t[100], hand.angular_velocity[100], hand.specific_force[100])
    assert online.estimate().hand.late == 1


def test_gaps_and_nan_rows_are_used_around(recording: GraspRecording) -> None:
    online = OnlineGraspPose()
    hand = recording.hand
    rate = hand.angular_velocity.copy()
    rate[9000:9400] = np.nan
    torn = ImuStream(hand.t, rate, hand.specific_force)
    for first in range(0, len(hand), 100):
        part = slice(first, first + 100)
        robot = recording.robot
        online.add_robot(
            robot.t[part],
            angular_velocity=robot.angular_velocity[part],
            angular_acceleration=robot.angular_acceleration[part],
            specific_force=robot.specific_force[part],
        )
        if not 15_000 <= first < 15_600:
            online.add_hand(torn.t[part], torn.angular_velocity[part], torn.specific_force[part])
    found = online.estimate()
    assert found.status is Status.SOLVED
    assert found.hand.incomplete == 400
    assert found.hand.gaps == 1
    assert found.events == ()
    truth = recording.truth
    assert nees(error(found, truth.rotation, truth.translation), found.covariance) < 6 * 3.0


@pytest.mark.parametrize("seed", [0, 1])
def test_a_regrasp_is_found_at_once_and_measured(seed: int) -> None:
    run = grasp_regrasp(seed=seed, at=15.0, duration=25.0)
    found = stream(run, chunk=20).estimate()
    assert [event.kind for event in found.events] == ["regrasp"]
    event = found.events[0]
    assert 15.0 < event.detected < 15.2
    assert event.time == pytest.approx(15.0, abs=0.1)
    change = run.truth.changes[0]
    step = np.concatenate(
        [lie.so3_log(run.truth.rotation.T @ change.rotation), change.translation - run.truth.translation]
    )
    assert nees(event.step - step, event.covariance) < 6 * 4.0
    # The grasp starts afresh, the sensor's biases do not.
    assert nees(error(found, change.rotation, change.translation), found.covariance) < 6 * 3.0
    assert found.seconds == pytest.approx(10.0, abs=0.5)
    assert found.gyro_bias_sd.max() < 1.5e-3


def test_a_slip_is_told_from_a_regrasp() -> None:
    run = grasp_slip(seed=3, at=12.0, time=10.0, duration=30.0)
    found = stream(run, chunk=50).estimate()
    assert found.events
    assert all(event.kind == "slip" for event in found.events)
    assert found.events[0].time == pytest.approx(12.0, abs=5.0)


def test_memory_does_not_grow(recording: GraspRecording) -> None:
    online = OnlineGraspPose()
    robot, hand, n = recording.robot, recording.hand, len(recording.hand)
    step = float(hand.t[1] - hand.t[0])
    sizes = []
    for turn in range(4):
        shift = turn * n * step
        for first in range(0, n, 200):
            part = slice(first, first + 200)
            online.add_robot(
                robot.t[part] + shift,
                angular_velocity=robot.angular_velocity[part],
                angular_acceleration=robot.angular_acceleration[part],
                specific_force=robot.specific_force[part],
            )
            online.add_hand(hand.t[part] + shift, hand.angular_velocity[part], hand.specific_force[part])
        if turn == 0:
            tracemalloc.start()
        else:
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    # The watch for slow changes takes its memory in the second minute; after that an hour would add a megabyte at most.
    assert sizes[-1] - sizes[-2] < 50_000
    assert sizes[-1] < 10e6


def test_real_streams_agree_with_the_batch_and_raise_no_alarm(
    broad_trial: Callable[..., tuple[PoseStream, ImuStream]],
) -> None:
    robot, hand = broad_trial("21_undisturbed_fast_combined")
    online = OnlineGraspPose()
    for first in range(0, len(hand), 60):
        part = slice(first, first + 60)
        online.add_robot(robot.t[part], robot.position[part], robot.rotation_wxyz[part])
        online.add_hand(hand.t[part], hand.angular_velocity[part], hand.specific_force[part])
    found = online.estimate()
    assert found.status is Status.SOLVED
    assert found.events == ()
    batch = solve(GraspPose(robot, hand))
    assert np.linalg.norm(found.translation - batch.translation) < 3e-3
    assert lie.angle_between(found.rotation, batch.rotation) < np.deg2rad(0.2)


def test_bad_samples_name_the_field() -> None:
    online = OnlineGraspPose()
    with pytest.raises(InputError, match="rotation_wxyz"):
        online.add_robot(0.0, [0, 0, 0], [2.0, 0, 0, 0])
    with pytest.raises(InputError, match="specific_force"):
        online.add_hand([0.0, 0.1], np.zeros((2, 3)), np.zeros((3, 3)))
    with pytest.raises(InputError, match="lateness"):
        OnlineGraspPose(lateness=-1.0)
    with pytest.raises(InputError, match="buffer_seconds"):
        OnlineGraspPose(buffer_seconds=1.0)

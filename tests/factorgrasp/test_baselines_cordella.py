"""The paper's filter: right where it can be, and wrong as printed."""

from __future__ import annotations

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.baselines.cordella2014 import UkfSettings, WristUkf, matrix_to_zyz, zyz_to_matrix
from factorgrasp.errors import InputError
from factorgrasp.problems.wrist_track import CameraPose
from factorgrasp.simulation.wrist import WristRecording, cordella2014


def angles_off(recording: WristRecording, settings: UkfSettings) -> np.ndarray:
    T = recording.truth.T_c_W0
    start = CameraPose(T[:3, :3], T[:3, 3])
    with np.errstate(all="ignore"):
        track = WristUkf(recording.camera, recording.layout, start, settings=settings).run(recording.blobs)
    return np.degrees(lie.angle_between(track.rotation, recording.truth.rotation))


def test_zyz_angles_are_what_they_say(rng: np.random.Generator) -> None:
    R = lie.so3_exp(rng.standard_normal((50, 3)))
    np.testing.assert_allclose(zyz_to_matrix(matrix_to_zyz(R)), R, atol=1e-12)


def test_with_depth_on_the_manifold_it_follows_the_hand() -> None:
    recording = cordella2014(0, motion="three_axes", duration=3.0)
    off = angles_off(recording, UkfSettings())
    assert np.sqrt(np.mean(off**2)) < 3.0
    track = WristUkf(
        recording.camera, recording.layout, CameraPose(*_start(recording)), settings=UkfSettings()
    ).run(recording.blobs)
    label = recording.label
    assert np.mean((track.association > 0) & (track.association != label)) < 0.005
    e = np.concatenate(
        [
            lie.so3_log(np.swapaxes(track.rotation, 1, 2) @ recording.truth.rotation),
            recording.truth.position - track.position,
        ],
        axis=1,
    )
    value = np.mean(np.einsum("ni,nij,nj->n", e, np.linalg.inv(track.covariance), e)) / 6.0
    assert 0.4 < value < 2.0


def _start(recording: WristRecording) -> tuple[np.ndarray, np.ndarray]:
    T = recording.truth.T_c_W0
    return T[:3, :3], T[:3, 3]


def test_image_points_alone_are_worse_and_euler_angles_fail_at_once() -> None:
    recording = cordella2014(0, motion="abduction", duration=2.0)
    with_depth, image, printed = (
        np.sqrt(np.mean(angles_off(recording, settings) ** 2))
        for settings in (UkfSettings(), UkfSettings(depth=False), UkfSettings(depth=False, attitude="zyz"))
    )
    assert with_depth < 3.0
    assert image > 1.5 * with_depth
    # The ZYZ sequence is singular at the neutral posture, where every recording begins.
    assert printed > 10.0


def test_an_unknown_attitude_is_named() -> None:
    recording = cordella2014(0, duration=0.2)
    with pytest.raises(InputError, match="attitude"):
        WristUkf(
            recording.camera,
            recording.layout,
            CameraPose(*_start(recording)),
            settings=UkfSettings(attitude="xyz"),
        )  # type: ignore[arg-type]

"""Rendered frames against geometry: where markers are, how much of them is seen, what light and blur do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import PALM_POINTS
from factorgrasp.simulation.hand_motion import R_CAMERA_NEUTRAL, swinging_hand
from factorgrasp.simulation.hand_rendering import HandVideo, render_hand
from factorgrasp.simulation.hand_scene import HandScene, Hidden
from factorgrasp.simulation.hand_shape import build_hand

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
AT = np.array([-0.03, 0.01, 0.5])
CLEAN = HandScene(
    sensor_noise=0.0,
    light_gradient=0.0,
    distractors=False,
    depth_noise=0.0,
    depth_missing=0.0,
    depth_outliers=0.0,
)


def blue_centroid(rgb: np.ndarray, near: np.ndarray, radius: int = 8) -> np.ndarray:
    """Centroid of what is bluer than red about a pixel."""
    v, u = np.mgrid[0 : rgb.shape[0], 0 : rgb.shape[1]]
    weight = np.clip(rgb[..., 2].astype(float) - rgb[..., 0], 0.0, None)
    weight = weight * (np.hypot(u - near[0], v - near[1]) < radius)
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def test_markers_are_drawn_where_they_are_said_to_be() -> None:
    frame = render_hand(CAMERA, R_CAMERA_NEUTRAL, AT, PALM_POINTS, CLEAN)
    points = AT + np.array(PALM_POINTS) @ R_CAMERA_NEUTRAL.T
    np.testing.assert_allclose(frame.uv, CAMERA.project(points), atol=1e-12)
    np.testing.assert_allclose(frame.marker_depth, points[:, 2])
    for uv in frame.uv:
        assert np.linalg.norm(blue_centroid(frame.rgb, uv) - uv) < 0.15
    assert (frame.visible > 0.95).all()
    for uv, z in zip(np.rint(frame.uv).astype(int), frame.marker_depth, strict=True):
        assert frame.depth[uv[1], uv[0]] == pytest.approx(z, abs=1.5e-3)


def test_lens_distortion_moves_markers_as_the_camera_says() -> None:
    bent = Camera(300.0, 300.0, 159.5, 119.5, 320, 240, (-0.3, 0.05, 0.001, -0.001))
    frame = render_hand(bent, R_CAMERA_NEUTRAL, np.array([0.05, 0.06, 0.5]), PALM_POINTS, CLEAN)
    straight = render_hand(CAMERA, R_CAMERA_NEUTRAL, np.array([0.05, 0.06, 0.5]), PALM_POINTS, CLEAN)
    assert np.linalg.norm(frame.uv - straight.uv, axis=1).max() > 1.0
    for uv, seen in zip(frame.uv, frame.visible, strict=True):
        if seen > 0.9:
            assert np.linalg.norm(blue_centroid(frame.rgb, uv) - uv) < 0.2


def test_hidden_and_turned_away_markers_are_seen_less() -> None:
    half = render_hand(
        CAMERA, R_CAMERA_NEUTRAL, AT, PALM_POINTS, HandScene(hidden=(Hidden(1, 0.5, angle=2.0),))
    )
    assert half.visible[1] == pytest.approx(0.5, abs=0.08)
    assert (half.visible[[0, 2, 3, 4, 5]] > 0.9).all()
    whole = render_hand(
        CAMERA, R_CAMERA_NEUTRAL, AT, PALM_POINTS, HandScene(hidden=(Hidden(1, 1.0, angle=2.0),))
    )
    assert whole.visible[1] < 0.1
    outside = render_hand(CAMERA, R_CAMERA_NEUTRAL, np.array([0.2, 0.01, 0.5]), PALM_POINTS, CLEAN)
    beyond = outside.uv[:, 0] > CAMERA.width
    assert beyond.any()
    assert (outside.visible[beyond] < 0.1).all()


def test_light_lamp_and_skin_change_the_image_as_they_should() -> None:
    def mean(**settings: object) -> np.ndarray:
        scene = HandScene(sensor_noise=0.0, **settings)  # type: ignore[arg-type]
        return render_hand(CAMERA, R_CAMERA_NEUTRAL, AT, PALM_POINTS, scene).rgb.reshape(-1, 3).mean(axis=0)

    plain, dark, warm = mean(), mean(light=0.5), mean(colour_temperature=3500.0)
    assert dark.sum() < 0.85 * plain.sum()
    assert warm[0] / warm[2] > 1.2 * plain[0] / plain[2]
    at = np.rint(render_hand(CAMERA, R_CAMERA_NEUTRAL, AT, PALM_POINTS).uv[0]).astype(int) - [15, 0]
    tones = [
        render_hand(CAMERA, R_CAMERA_NEUTRAL, AT, PALM_POINTS, HandScene(skin=skin, sensor_noise=0.0)).rgb[
            at[1], at[0], 1
        ]
        for skin in ("light", "medium", "dark")
    ]
    assert tones[0] > tones[1] > tones[2]


def test_motion_blur_widens_markers_and_leaves_their_centres() -> None:
    blurring = replace(CLEAN, shutter=0.02)
    sharp, blurred = (
        swinging_hand(3, scene, 1, 0.5, 2.0, camera=CAMERA).frame(1) for scene in (CLEAN, blurring)
    )
    np.testing.assert_array_equal(sharp.uv, blurred.uv)
    # Less of the picture is as dark as a marker is inside.
    assert (blurred.rgb[..., 0] < 60).sum() < 0.97 * (sharp.rgb[..., 0] < 60).sum()
    for uv in blurred.uv:
        assert np.linalg.norm(blue_centroid(blurred.rgb, uv) - uv) < 0.5


def test_the_same_seed_gives_the_same_frame_in_any_order() -> None:
    first, again = (swinging_hand(3, seed=4, distance=0.5, camera=CAMERA) for _ in range(2))
    last = again.frame(2)
    np.testing.assert_array_equal(list(first)[2].rgb, last.rgb)
    np.testing.assert_array_equal(first.frame(2).depth, last.depth)
    assert (first.frame(1).rgb != last.rgb).any()


def test_depth_has_gaps_noise_and_whole_millimetres() -> None:
    frame = swinging_hand(1, seed=2, distance=0.5, camera=CAMERA).frame(0)
    share = float((frame.depth == 0.0).mean())
    assert 0.01 < share < 0.1
    assert np.abs(1e3 * frame.depth - np.rint(1e3 * frame.depth)).max() < 1e-6


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"skin": "green"}, "skin"),
        ({"light": 0.0}, "light"),
        ({"colour_temperature": 300.0}, "colour_temperature"),
        ({"shutter": -1.0}, "shutter"),
        ({"marker_diameter": 12.0}, "marker_diameter"),
    ],
)
def test_scenes_that_cannot_be_are_refused(settings: dict[str, object], field: str) -> None:
    with pytest.raises(InputError, match=field):
        HandScene(**settings)  # type: ignore[arg-type]


def test_videos_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="shapes"):
        HandVideo(CAMERA, np.zeros(2), np.eye(3)[None], np.zeros((1, 3)), np.array(PALM_POINTS))
    with pytest.raises(InputError, match="before the camera"):
        render_hand(CAMERA, R_CAMERA_NEUTRAL, [0.0, 0.0, -0.5], PALM_POINTS)
    with pytest.raises(InputError, match="six finite"):
        build_hand(np.zeros((5, 3)))

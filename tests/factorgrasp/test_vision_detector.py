"""The detector on rendered hands, against the truth of the renderer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import PALM_POINTS
from factorgrasp.simulation.hand_motion import R_CAMERA_NEUTRAL, swinging_hand
from factorgrasp.simulation.hand_rendering import RenderedFrame, render_hand
from factorgrasp.simulation.hand_scene import HandScene, Hidden
from factorgrasp.vision import (
    BlobDetector,
    ColourReference,
    DetectedBlobs,
    DetectorSettings,
    learn_colour,
    propose_colour,
    read_colour,
)
from factorgrasp.vision.blob_depth import disc_depth
from factorgrasp.vision.light import light_shift
from factorgrasp.vision.outline_fit import fit_outline
from factorgrasp.vision.soft_blob import polygon_moments
from factorgrasp.vision.table_plane import fit_table

pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'factorgrasp[vision]'")

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
DISTANCE = 0.42
"""m: markers of 12 mm are 8.6 px wide."""


def hand(scene: HandScene | None = None, seed: int = 0) -> RenderedFrame:
    return swinging_hand(1, scene, seed, DISTANCE, camera=CAMERA).frame(0)


@pytest.fixture(scope="module")
def reference() -> ColourReference:
    frame = hand(seed=9)
    return learn_colour(frame.rgb, click=(float(frame.uv[3, 0]), float(frame.uv[3, 1])))


def nearest(blobs: DetectedBlobs, frame: RenderedFrame) -> tuple[np.ndarray, np.ndarray]:
    """Distance (6,) of each marker to its nearest blob, and which one that is."""
    assert len(blobs)
    away = np.linalg.norm(blobs.uv[:, None] - frame.uv[None], axis=2)
    return away.min(axis=0), away.argmin(axis=0)


def test_all_markers_are_found_with_depth_and_honest_covariances(reference: ColourReference) -> None:
    detector = BlobDetector(reference, camera=CAMERA)
    nees, depth_nees = [], []
    for seed in range(4):
        frame = hand(seed=seed)
        blobs = detector.detect(frame.rgb, frame.depth)
        away, which = nearest(blobs, frame)
        assert len(blobs) == 6
        assert away.max() < 0.3
        assert sorted(which) == list(range(6))
        assert blobs.table is not None
        error = blobs.uv[which] - frame.uv
        nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(blobs.covariance_uv[which]), error) / 2.0)
        gap = blobs.depth[which] - frame.marker_depth
        assert np.abs(gap).max() < 3e-3
        depth_nees.append(gap**2 / blobs.covariance_depth[which])
    assert 0.1 < np.mean(nees) < 2.0
    assert 0.1 < np.mean(depth_nees) < 2.0


@pytest.mark.parametrize(
    "scene",
    [
        HandScene(light=0.5),
        HandScene(light=1.4),
        HandScene(colour_temperature=3000.0),
        HandScene(colour_temperature=9000.0),
        HandScene(skin="dark"),
        HandScene(skin="light"),
        HandScene(table="grey"),
        HandScene(lens_blur=1.2, sensor_noise=4.0),
    ],
    ids=["dim", "bright", "lamp", "sky", "dark skin", "light skin", "grey table", "blurred"],
)
def test_one_reference_serves_in_other_scenes(reference: ColourReference, scene: HandScene) -> None:
    frame = hand(scene, seed=1)
    blobs = BlobDetector(reference, camera=CAMERA).detect(frame.rgb, frame.depth)
    away, _ = nearest(blobs, frame)
    assert away.max() < 0.4
    assert len(blobs) == 6


def test_without_depth_what_is_not_on_skin_is_left_out(reference: ColourReference) -> None:
    frame = hand(HandScene(table="grey"), seed=2)
    blobs = BlobDetector(reference).detect(frame.rgb)
    away, _ = nearest(blobs, frame)
    assert away.max() < 0.3
    assert len(blobs) == 6
    assert np.isnan(blobs.depth).all()
    assert np.isfinite(blobs.covariance_depth).all()
    anywhere = BlobDetector(reference, DetectorSettings(region="none")).detect(frame.rgb)
    assert len(anywhere) >= len(blobs)


def test_half_hidden_markers_are_mended(reference: ColourReference) -> None:
    for angle in (0.4, 2.5, 4.5):
        frame = hand(HandScene(hidden=(Hidden(1, 0.5, angle=angle),)), seed=0)
        blobs = BlobDetector(reference, camera=CAMERA).detect(frame.rgb, frame.depth)
        away, which = nearest(blobs, frame)
        assert blobs.kind[which[1]] == "hidden"
        assert away[1] < 0.6
        assert away[[0, 2, 3, 4, 5]].max() < 0.3
        assert blobs.covariance_uv[which[1], 0, 0] > blobs.covariance_uv[which[0], 0, 0]


def test_touching_and_overlapping_markers_are_two(reference: ColourReference) -> None:
    for apart in (0.0125, 0.0095):
        layout = np.array(PALM_POINTS)
        layout[2] = [0.094, apart, 0.0]
        frame = render_hand(CAMERA, R_CAMERA_NEUTRAL, [-0.03, 0.01, DISTANCE], layout)
        blobs = BlobDetector(reference, camera=CAMERA).detect(frame.rgb, frame.depth)
        away, which = nearest(blobs, frame)
        assert which[2] != which[3]
        assert away.max() < 0.5
        assert len(blobs) == 6


def test_small_marker_far_away_is_found(reference: ColourReference) -> None:
    scene = HandScene(marker_diameter=0.008)
    frame = swinging_hand(1, scene, 0, 300.0 / 525.0, camera=CAMERA).frame(
        0
    )  # as many pixels as at 1 m with 525 px
    blobs = BlobDetector(reference, DetectorSettings(marker_diameter=0.008), CAMERA).detect(
        frame.rgb, frame.depth
    )
    away, _ = nearest(blobs, frame)
    assert away.max() < 0.4


def test_nothing_is_found_where_nothing_is(reference: ColourReference) -> None:
    detector = BlobDetector(reference)
    black = detector.detect(np.zeros((120, 160, 3), np.uint8), np.zeros((120, 160)))
    assert len(black) == 0
    assert black.uv.shape == (0, 2)
    assert black.covariance_uv.shape == (0, 2, 2)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (120, 160, 3), dtype=np.uint8)
    assert len(detector.detect(noise)) <= detector.settings.most_blobs


def test_a_plane_that_is_the_hands_own_is_no_table(reference: ColourReference) -> None:
    frame = hand(HandScene(distractors=False), seed=2)
    flat = np.full(frame.depth.shape, DISTANCE)
    blobs = BlobDetector(reference, camera=CAMERA).detect(frame.rgb, flat)
    assert len(blobs) == 6
    assert nearest(blobs, frame)[0].max() < 0.4


@pytest.mark.parametrize("diameter", [0.006, 0.03, 0.0])
def test_markers_of_another_size_than_said_are_found(reference: ColourReference, diameter: float) -> None:
    frame = hand(seed=4)
    blobs = BlobDetector(reference, DetectorSettings(marker_diameter=diameter), CAMERA).detect(
        frame.rgb, frame.depth
    )
    assert len(blobs) == 6
    assert nearest(blobs, frame)[0].max() < 0.3


def test_most_markers_half_hidden_do_not_make_halves_whole(reference: ColourReference) -> None:
    hidden = tuple(
        Hidden(marker, 0.5, angle=angle) for marker, angle in ((0, 3.5), (1, 2.0), (2, 0.9), (5, 4.6))
    )
    frame = hand(HandScene(hidden=hidden), seed=0)
    blobs = BlobDetector(reference, camera=CAMERA).detect(frame.rgb, frame.depth)
    away, which = nearest(blobs, frame)
    partly = (frame.visible > 0.3) & (frame.visible < 0.7)
    assert partly.sum() >= 3
    assert all(blobs.kind[which[i]] == "hidden" for i in np.flatnonzero(partly))
    assert away[partly].max() < 0.8


def test_images_that_do_not_fit_are_refused(reference: ColourReference) -> None:
    frame = hand()
    detector = BlobDetector(reference, camera=CAMERA)
    with pytest.raises(InputError, match="camera's size, 320 x 240"):
        detector.detect(frame.rgb[:200])
    with pytest.raises(InputError, match="uint8"):
        detector.detect(frame.rgb / 255.0)
    with pytest.raises(InputError, match="alpha"):
        detector.detect(np.dstack([frame.rgb, frame.rgb[..., :1]]))
    with pytest.raises(InputError, match="Register"):
        detector.detect(frame.rgb, frame.depth[:, :100])
    with pytest.raises(InputError, match="Millimetres"):
        detector.detect(frame.rgb, np.rint(1e3 * frame.depth).astype(np.uint16))
    with pytest.raises(InputError, match="region = 'depth'"):
        BlobDetector(reference, DetectorSettings(region="depth")).detect(frame.rgb)


@pytest.mark.parametrize(
    "settings",
    [
        {"region": "hand"},
        {"threshold": 1.5},
        {"marker_diameter": 12.0},
        {"centroid_sd": -1.0},
        {"least_height": np.nan},
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(InputError, match=next(iter(settings))):
        DetectorSettings(**settings)  # type: ignore[arg-type]


def test_a_click_on_the_background_is_refused() -> None:
    frame = hand()
    with pytest.raises(InputError, match="marker"):
        learn_colour(frame.rgb, click=(5, 5))
    hidden = np.rint(frame.uv[0]).astype(int) - [20, 0]
    with pytest.raises(InputError, match="marker"):
        learn_colour(frame.rgb, click=(int(hidden[0]), int(hidden[1])))
    with pytest.raises(InputError, match="within 320 x 240"):
        learn_colour(frame.rgb, click=(400, 10))
    with pytest.raises(InputError, match="light"):
        learn_colour(np.zeros((60, 80, 3), np.uint8), click=(5, 5))
    with pytest.raises(InputError, match="neither"):
        learn_colour(frame.rgb)
    with pytest.raises(InputError, match="box"):
        learn_colour(frame.rgb, patch=(10, 10, 5, 20))


def test_click_patch_and_mask_learn_the_same_colour(tmp_path: Path) -> None:
    frame = hand()
    u, v = np.rint(frame.uv[0]).astype(int)
    by_click = learn_colour(frame.rgb, click=(int(u), int(v)))
    by_patch = learn_colour(frame.rgb, patch=(int(u) - 2, int(v) - 2, int(u) + 3, int(v) + 3))
    mask = np.zeros(frame.rgb.shape[:2], dtype=bool)
    mask[v - 2 : v + 3, u - 2 : u + 3] = True
    np.testing.assert_allclose(by_patch.marker, learn_colour(frame.rgb, patch=mask).marker)
    assert np.linalg.norm(by_click.marker_mean - by_patch.marker_mean) < 0.1
    around = learn_colour(frame.rgb, patch=(int(u) - 8, int(v) - 8, int(u) + 9, int(v) + 9))
    assert np.linalg.norm(around.marker_mean - by_click.marker_mean) < 0.2
    stored = read_colour(by_click.save(tmp_path / "blue.json"))
    np.testing.assert_allclose(stored.table, by_click.table)
    with pytest.raises(InputError, match="colour reference"):
        read_colour(tmp_path / "none.json")


def test_the_reference_is_proposed_when_none_is_given() -> None:
    for scene in (
        HandScene(),
        HandScene(skin="dark", light=0.6),
        HandScene(marker_colour=(0.04, 0.35, 0.06), table="grey"),
    ):
        frame = hand(scene, seed=3)
        for depth in (frame.depth, None):
            blobs = BlobDetector(propose_colour(frame.rgb, depth), camera=CAMERA).detect(frame.rgb, depth)
            assert nearest(blobs, frame)[0].max() < 0.4
    with pytest.raises(InputError, match="black"):
        propose_colour(np.zeros((60, 80, 3), np.uint8))
    with pytest.raises(InputError, match="click"):
        propose_colour(np.full((120, 160, 3), 128, np.uint8))


def test_table_plane_is_found_under_a_hand() -> None:
    v, u = np.mgrid[0:120, 0:160].astype(float)
    depth = 1.0 / (1.1 + 4e-4 * u - 3e-4 * v)
    rng = np.random.default_rng(0)
    depth[30:80, 50:100] = 0.6
    noisy = depth + rng.normal(0.0, 2e-3, depth.shape)
    noisy[rng.random(depth.shape) < 0.1] = 0.0
    table = fit_table(noisy)
    assert table is not None
    np.testing.assert_allclose(
        table.depth([[10.0, 10.0], [150.0, 100.0]]), [depth[10, 10], depth[100, 150]], atol=2e-3
    )
    assert fit_table(np.zeros((120, 160))) is None
    only_hand = np.where(noisy < 0.7, noisy, 0.0)
    assert fit_table(only_hand) is None


def test_disc_depth_rejects_outliers_and_reads_the_centre() -> None:
    v, u = np.mgrid[0:15, 0:15].astype(float)
    mask = np.hypot(u - 7, v - 7) < 5
    depth = 0.7 + 1e-3 * (u - 7)
    rng = np.random.default_rng(1)
    depth += rng.normal(0.0, 5e-4, depth.shape)
    depth[6:8, 5:9] = 0.9
    depth[9, 9] = np.nan
    value, variance = disc_depth(depth, mask, np.array([7.0, 7.0]), 1.0)
    assert abs(value - 0.7) < 4.0 * np.sqrt(variance) < 3e-3
    left = mask & (u < 7)
    value, _ = disc_depth(depth, left, np.array([7.0, 7.0]), 1.0)
    assert value == pytest.approx(0.7, abs=1.5e-3)
    assert np.isnan(disc_depth(np.full((15, 15), np.nan), mask, np.array([7.0, 7.0]), 1.0)[0])


def test_polygon_moments_are_those_of_an_ellipse() -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    points = np.column_stack([3.0 + 5.0 * np.cos(turn), -2.0 + 2.0 * np.sin(turn)])
    area, centre, moment = polygon_moments(points)
    assert area == pytest.approx(np.pi * 10.0, rel=1e-3)
    np.testing.assert_allclose(centre, [3.0, -2.0], atol=1e-9)
    np.testing.assert_allclose(moment, np.diag([25.0, 4.0]) / 4.0, rtol=1e-3, atol=1e-9)


def test_outline_fit_finds_the_centre_of_a_half() -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    points = np.column_stack([4.5 * np.cos(turn), 4.5 * np.sin(turn)])
    points[:, 0] = np.maximum(points[:, 0], -0.5)
    rng = np.random.default_rng(2)
    found = fit_outline(
        points + rng.normal(0.0, 0.1, points.shape), np.eye(2) * 4.5**2 / 4.0, np.array([1.5, 0.0])
    )
    assert np.linalg.norm(found.centre) < 0.25
    assert 0.4 < found.share < 0.8


def test_shifts_of_a_lamp_are_told_from_other_scenes() -> None:
    warm = HandScene(colour_temperature=3500.0).illuminant
    shift = np.array([np.log(warm[0] / warm[1]), np.log(warm[2] / warm[1])])
    np.testing.assert_allclose(light_shift(shift), shift, atol=0.1)
    np.testing.assert_array_equal(light_shift(np.array([1.0, 1.0])), 0.0)

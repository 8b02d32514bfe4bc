"""The camera against finite differences and OpenCV, marker layouts, and recordings of blobs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.recordings import BlobRecording, read_blobs, write_blobs

PLAIN = Camera(525.0, 520.0, 319.5, 239.5, 640, 480)
LENS = Camera(525.0, 520.0, 315.0, 244.0, 640, 480, (0.12, -0.25, 1e-3, -2e-3, 0.08))


def points(rng: np.random.Generator, count: int = 40) -> np.ndarray:
    return rng.uniform([-0.2, -0.15, 0.5], [0.2, 0.15, 1.2], (count, 3))


@pytest.mark.parametrize("camera", [PLAIN, LENS])
def test_projection_has_the_derivative_that_it_says(camera: Camera, rng: np.random.Generator) -> None:
    p = points(rng)
    uv, J = camera.project_with_jacobian(p)
    h = 1e-6
    numerical = np.stack(
        [(camera.project(p + e) - camera.project(p - e)) / (2 * h) for e in h * np.eye(3)], -1
    )
    np.testing.assert_allclose(J, numerical, atol=1e-5)
    np.testing.assert_array_equal(uv, camera.project(p))


@pytest.mark.parametrize("camera", [PLAIN, LENS])
def test_back_projection_undoes_projection(camera: Camera, rng: np.random.Generator) -> None:
    p = points(rng).reshape(4, 10, 3)
    np.testing.assert_allclose(camera.back_project(camera.project(p), p[..., 2]), p, atol=1e-12)


def test_distortion_is_opencvs(rng: np.random.Generator) -> None:
    cv2 = pytest.importorskip("cv2")
    p = points(rng)
    expected = cv2.projectPoints(p, np.zeros(3), np.zeros(3), LENS.matrix, np.array(LENS.distortion))[0][:, 0]
    np.testing.assert_allclose(LENS.project(p), expected, atol=1e-9)


def test_what_is_behind_the_camera_is_not_seen() -> None:
    assert np.isnan(PLAIN.project([0.0, 0.0, -0.5])).all()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"fx": -1.0}, "fx"),
        ({"cx": 900.0}, "swapped"),
        ({"distortion": (0.1,)}, "k1"),
        ({"rate": 0.0}, "rate"),
    ],
)
def test_an_impossible_camera_is_named(change: dict[str, object], word: str) -> None:
    usual = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}
    with pytest.raises(InputError, match=word):
        Camera(**{**usual, **change})  # type: ignore[arg-type]


def test_layouts_that_cannot_hold_a_pose_are_named() -> None:
    palm = MarkerLayout.palm()
    assert len(palm) == 6
    assert not palm.planar
    np.testing.assert_allclose(palm.sd, 1e-3)
    with pytest.raises(InputError, match="three"):
        MarkerLayout(palm.names[:2], palm.points[:2])
    with pytest.raises(InputError, match="line"):
        MarkerLayout(("a", "b", "c"), np.outer([0.0, 0.05, 0.1], [1.0, 1.0, 0.0]))
    with pytest.raises(InputError, match="millimetres"):
        MarkerLayout(palm.names, 1e3 * palm.points)


def recording() -> BlobRecording:
    return BlobRecording(
        np.arange(5) / 30.0,
        np.array([0, 0, 2, 4]),
        np.array([[10.0, 20.0], [30.5, 40.0], [50.0, 60.25], [600.0, 470.0]]),
        np.array([0.7, np.nan, 0.65, 0.8]),
        label=np.array([1, 0, 2, 3]),
    )


def test_blobs_survive_a_file(tmp_path: Path) -> None:
    before = recording()
    after = read_blobs(write_blobs(tmp_path / "blobs.csv", before), PLAIN)
    for name in ("t", "frame", "uv", "depth", "label"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert after.counts.tolist() == [2, 0, 1, 0, 1]
    assert len(after.at(1)) == 0


def test_frames_that_a_file_leaves_out_are_frames_without_blobs(tmp_path: Path) -> None:
    file = tmp_path / "blobs.csv"
    file.write_text("frame,t,u,v,z\n7,1.0,10,20,0.7\n7,1.0,12,22,\n10,1.1,11,21,0.7\n")
    blobs = read_blobs(file)
    assert blobs.counts.tolist() == [2, 0, 0, 1]
    np.testing.assert_allclose(blobs.t, [1.0, 1.0 + 1 / 30, 1.0 + 2 / 30, 1.1])
    assert np.isnan(blobs.depth[1])


@pytest.mark.parametrize(
    ("rows", "word"),
    [
        ("1,0.1,10,20,0.7\n0,0.0,10,20,0.7\n", "order"),
        ("0,0.0,100,620,0.7\n1,0.1,100,620,0.7\n", "swapped"),
        ("0,0.0,10,,0.7\n1,0.1,10,20,0.7\n", "u, v"),
        ("0,0.0,10,20,700\n1,0.1,10,20,710\n", "illimetres"),
        ("0,0.0,10,20,-0.7\n1,0.1,10,20,0.7\n", "depth"),
        ("0,0.0,10,20,0.7\n0,0.1,10,20,0.7\n1,0.2,1,2,0.7\n", "one time"),
        ("0.5,0.0,10,20,0.7\n1,0.1,10,20,0.7\n", "whole"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, rows: str, word: str) -> None:
    file = tmp_path / "blobs.csv"
    file.write_text("frame,t,u,v,z\n" + rows)
    with pytest.raises(InputError, match=word):
        read_blobs(file, PLAIN)

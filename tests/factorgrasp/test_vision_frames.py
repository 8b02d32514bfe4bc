"""Frames on disk, recordings of blobs, and what is said of bad ones."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.models.camera import Camera
from factorgrasp.palm_calibration import calibrate_palm
from factorgrasp.simulation.hand_files import write_frames
from factorgrasp.simulation.hand_motion import swinging_hand
from factorgrasp.simulation.hand_rendering import HandVideo
from factorgrasp.vision import Frame, detect_recording, learn_colour, propose_detector, read_frames
from factorgrasp.vision.problem_table import blobs_from_table

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'factorgrasp[vision]'")

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)


@pytest.fixture(scope="module")
def video() -> HandVideo:
    return swinging_hand(3, seed=5, distance=0.42, camera=CAMERA)


@pytest.fixture(scope="module")
def folder(video: HandVideo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_frames(video, tmp_path_factory.mktemp("frames"), movie=True)


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def test_written_frames_are_read_back(folder: Path, video: HandVideo) -> None:
    source = read_frames(images=folder / "rgb", depth=folder / "depth")
    np.testing.assert_allclose(source.t, video.t)
    assert not source.compressed
    for k, frame in enumerate(source):
        truth = video.frame(k)
        np.testing.assert_array_equal(frame.rgb, truth.rgb)
        assert frame.depth is not None
        np.testing.assert_allclose(frame.depth, truth.depth, atol=1e-9)
    with np.load(folder / "truth.npz") as truth_file:
        assert truth_file["uv"].shape == (3, 6, 2)


@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize("movie", [False, True])
def test_a_recording_is_detected_and_calibrated(
    folder: Path, video: HandVideo, depth: bool, movie: bool
) -> None:
    where = {"video": folder / "movie.avi"} if movie else {"images": folder / "rgb"}
    source = read_frames(**where, depth=folder / "depth" if depth else None)
    blobs = detect_recording(source, CAMERA)
    assert blobs.counts.tolist() == [6, 6, 6]
    for k in range(3):
        away = np.linalg.norm(blobs.at(k).uv[:, None] - video.frame(k).uv[None], axis=2).min(axis=0)
        assert away.max() < (1.0 if movie else 0.3)
    assert blobs.covariance_uv is not None
    assert (blobs.covariance_uv[:, 0, 0] > (0.15**2 if movie else 0.0)).all()
    assert np.isfinite(blobs.depth).all() == depth
    if depth and not movie:
        found = calibrate_palm(blobs, CAMERA)
        assert (
            np.abs(
                found.layout.distances - np.linalg.norm(video.layout[:, None] - video.layout, axis=2)
            ).max()
            < 2e-3
        )
    if not depth:
        with pytest.raises(InputError, match="0 blobs with depth"):
            calibrate_palm(blobs, CAMERA)


def test_a_table_of_a_problem_file_names_images(folder: Path) -> None:
    table = {"images": "rgb", "depth": "depth", "depth_scale": 0.001, "marker_diameter": 0.012}
    blobs, remarks = blobs_from_table(table, folder, CAMERA)
    assert blobs.counts.tolist() == [6, 6, 6]
    assert any("proposed" in remark for remark in remarks)
    first = next(iter(read_frames(images=folder / "rgb")))
    uv = np.load(folder / "truth.npz")["uv"][0, 2]
    learn_colour(first.rgb, click=tuple(uv)).save(folder / "blue.json")
    for more in ({"click": [float(uv[0]), float(uv[1])]}, {"colour": "blue.json"}):
        again, remarks = blobs_from_table({**table, **more}, folder, CAMERA)
        assert again.counts.tolist() == [6, 6, 6]
        assert not remarks
    with pytest.raises(InputError, match=r"\[blobs\] marker_diametre"):
        blobs_from_table({**table, "marker_diametre": 0.012}, folder, CAMERA)
    with pytest.raises(InputError, match="one of click, patch and colour"):
        blobs_from_table({**table, "colour": "blue.json", "click": [1.0, 1.0]}, folder, CAMERA)


def test_folders_that_do_not_fit_are_refused(copy: Path) -> None:
    with pytest.raises(InputError, match="no folder"):
        read_frames(images=copy / "rgb", depth=copy / "depht")
    with pytest.raises(InputError, match="neither"):
        read_frames()
    with pytest.raises(InputError, match="no file"):
        read_frames(video=copy / "none.avi")
    (copy / "empty").mkdir()
    with pytest.raises(InputError, match="none"):
        read_frames(images=copy / "empty")
    (copy / "depth" / "000001.png").unlink()
    with pytest.raises(InputError, match="for each of the 3 frames; found 2"):
        read_frames(images=copy / "rgb", depth=copy / "depth")
    (copy / "rgb" / "timestamps.csv").write_text("t\n0\n0.1\n", encoding="utf-8")
    with pytest.raises(InputError, match="one time for each of the 3"):
        read_frames(images=copy / "rgb")
    (copy / "rgb" / "timestamps.csv").write_text("t\n0\n0.1\n0.1\n", encoding="utf-8")
    with pytest.raises(InputError, match="increasing"):
        read_frames(images=copy / "rgb")


@pytest.mark.parametrize(("scale", "hint"), [(1.0, "0.001"), (1e-6, "0.001")])
def test_absurd_depth_scales_are_refused(folder: Path, scale: float, hint: str) -> None:
    with pytest.raises(InputError, match=f"Is the scale {hint}"):
        list(read_frames(images=folder / "rgb", depth=folder / "depth", depth_scale=scale))


def test_depth_images_that_are_none_are_refused(copy: Path) -> None:
    picture = cv2.imread(str(copy / "rgb" / "000000.png"))
    cv2.imwrite(str(copy / "depth" / "000000.png"), picture)
    with pytest.raises(InputError, match="16 bits"):
        list(read_frames(images=copy / "rgb", depth=copy / "depth"))
    cv2.imwrite(str(copy / "depth" / "000000.png"), np.full((120, 160), 700, np.uint16))
    with pytest.raises(InputError, match="320 x 240; found 160 x 120"):
        list(read_frames(images=copy / "rgb", depth=copy / "depth"))
    (copy / "rgb" / "000001.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="cannot be read"):
        list(read_frames(images=copy / "rgb"))


def test_frame_ten_follows_frame_nine(tmp_path: Path) -> None:
    for k in (10, 9, 1):
        cv2.imwrite(str(tmp_path / f"frame{k}.png"), np.full((20, 20, 3), k, np.uint8))
    assert [int(frame.rgb[0, 0, 0]) for frame in read_frames(images=tmp_path, rate=10.0)] == [1, 9, 10]


def test_black_frames_and_other_sizes_are_said() -> None:
    black = [Frame(0.1 * k, np.zeros((240, 320, 3), np.uint8)) for k in range(2)]
    with pytest.raises(InputError, match="black"):
        detect_recording(black, CAMERA)
    detector = propose_detector([Frame(0.0, swinging_hand(1, distance=0.42, camera=CAMERA).frame(0).rgb)])
    with pytest.raises(InputError, match="2 black frames"):
        detect_recording(black, CAMERA, detector)
    grey = [Frame(0.1 * k, np.full((240, 320, 3), 90, np.uint8)) for k in range(2)]
    with pytest.raises(InputError, match="none in 2 frames"):
        detect_recording(grey, CAMERA, detector)
    small = [Frame(0.0, np.zeros((120, 160, 3), np.uint8))]
    with pytest.raises(InputError, match="320 x 240; found 160 x 120"):
        detect_recording(small, CAMERA, detector)
    with pytest.raises(InputError, match="at least one frame"):
        detect_recording([], CAMERA, detector)

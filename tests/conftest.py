"""Fixtures that all tests share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from factorgrasp import lie
from factorgrasp.recordings import ImuStream, PoseStream

SEED = 20240229


def locate_data() -> Path | None:
    """Folder with the real recordings: ``FACTORGRASP_DATA``, else ``../shared/data`` beside the repository."""
    declared = os.environ.get("FACTORGRASP_DATA")
    folder = Path(declared) if declared else Path(__file__).resolve().parents[2] / "shared" / "data"
    return folder if folder.is_dir() else None


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder with the real recordings; the test is skipped where there is none."""
    folder = locate_data()
    if folder is None:
        pytest.skip("real recordings are not here: set FACTORGRASP_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def dataset(data_dir: Path) -> Callable[[str], Path]:
    """Path of one file or folder of the recordings, by its name below the data folder; skips when it is absent."""

    def find(name: str) -> Path:
        path = data_dir / name
        if not path.exists():
            pytest.skip(f"{name} is not in the data folder")
        return path

    return find


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator that gives every test the same numbers, whatever ran before it."""
    return np.random.default_rng(SEED)


@pytest.fixture(scope="session")
def broad_trial(dataset: Callable[[str], Path]) -> Callable[..., tuple[PoseStream, ImuStream]]:
    """Robot (optical body) and hand (IMU) streams of a `broad` trial.

    The body of the pose stream is moved by a rigid transform, ``p' = p + R offset``, ``R' = R Exp(turn)``;
    `half` takes one half of the motion.
    """

    def load(
        name: str, offset: npt.ArrayLike = (0, 0, 0), turn: npt.ArrayLike = (0, 0, 0), half: int | None = None
    ) -> tuple[PoseStream, ImuStream]:
        data = np.load(dataset(f"broad/{name}.npz"))
        t = np.arange(data["opt_pos"].shape[0]) / float(data["fs"])
        R = lie.quaternion_wxyz_to_matrix(data["opt_quat"])
        position = data["opt_pos"] + R @ np.asarray(offset)
        quaternion = lie.matrix_to_quaternion_wxyz(R @ lie.so3_exp(turn), continuous=True)
        moving = np.asarray(data["movement"], dtype=bool)
        position[~moving], quaternion[~moving] = np.nan, np.nan
        robot = PoseStream(t, position, quaternion)
        hand = ImuStream(t, data["imu_gyr"].astype(float), data["imu_acc"].astype(float))
        if half is not None:
            rows = np.flatnonzero(moving)
            first, middle, last = t[rows[0]], t[rows[rows.size // 2]], t[rows[-1]]
            robot = robot.slice(first, middle) if half == 0 else robot.slice(middle, last)
        return robot, hand

    return load

"""Fixtures that all tests share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

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

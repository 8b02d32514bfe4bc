"""OpenCV, imported where it is used."""

from __future__ import annotations

import importlib
from typing import Any

from factorgrasp.errors import InputError


def load_cv2() -> Any:
    """The module `cv2`.

    Raises
    ------
    InputError
        When it is not installed.
    """
    try:
        return importlib.import_module("cv2")
    except ImportError as error:
        raise InputError(
            "images", "OpenCV (module cv2)", f"none: {error}", "pip install 'factorgrasp[vision]'"
        ) from error

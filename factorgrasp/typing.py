"""The array types that annotations use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.intp]
BoolArray: TypeAlias = NDArray[np.bool_]

State: TypeAlias = Mapping[str, FloatArray]
"""The values of all variables of a problem, by name: ``(size,)`` vectors, ``(3, 3)`` rotations, ``(4, 4)`` poses."""

JsonDict: TypeAlias = dict[str, Any]

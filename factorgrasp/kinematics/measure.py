"""A number with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgrasp.typing import FloatArray, JsonDict

Z_95 = 1.959963984540054


@dataclass(frozen=True)
class Measure:
    """An estimate with its standard deviation, both in `unit`; NaN where it could not be worked out."""

    value: float
    sd: float
    unit: str

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval."""
        return self.value - Z_95 * self.sd, self.value + Z_95 * self.sd

    def to_dict(self) -> JsonDict:
        """Plain numbers: value, sd, interval_95, unit."""
        return {"value": self.value, "sd": self.sd, "interval_95": list(self.interval), "unit": self.unit}


def measured(value: float, samples: FloatArray, unit: str) -> Measure:
    """A value whose standard deviation is that of the same measure over drawn tracks, shape (K,)."""
    kept = samples[np.isfinite(samples)]
    sd = float(np.std(kept, ddof=1)) if kept.size > max(2, samples.size // 2) else float("nan")
    return Measure(float(value), sd, unit)

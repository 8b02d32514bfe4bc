"""Units that files declare, and their conversion to SI at the door."""

from __future__ import annotations

import re

import numpy as np

from factorgrasp.errors import InputError

STANDARD_GRAVITY = 9.80665
_DEG = float(np.pi / 180.0)

# unit as written, without spaces, "^" and case -> (SI unit, factor)
_UNITS: dict[str, tuple[str, float]] = {
    **{u: ("s", 1.0) for u in ("s", "sec", "second", "seconds")},
    "ms": ("s", 1e-3),
    **{u: ("s", 1e-6) for u in ("us", "µs", "μs")},
    "ns": ("s", 1e-9),
    "min": ("s", 60.0),
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    **{u: ("m", 1e-6) for u in ("um", "µm", "μm")},
    "rad": ("rad", 1.0),
    **{u: ("rad", _DEG) for u in ("deg", "°", "degree", "degrees")},
    **{u: ("rad/s", 1.0) for u in ("rad/s", "rads-1")},
    **{u: ("rad/s", _DEG) for u in ("deg/s", "°/s", "degs-1", "dps")},
    "rpm": ("rad/s", 6.0 * _DEG),
    **{u: ("rad/s^2", 1.0) for u in ("rad/s2", "rad/s²", "rads-2")},
    **{u: ("rad/s^2", _DEG) for u in ("deg/s2", "deg/s²", "°/s2", "°/s²", "degs-2")},
    **{u: ("m/s", 1.0) for u in ("m/s", "ms-1")},
    "mm/s": ("m/s", 1e-3),
    **{u: ("m/s^2", 1.0) for u in ("m/s2", "m/s²", "ms-2", "m/s/s")},
    **{u: ("m/s^2", 1e-3) for u in ("mm/s2", "mm/s²", "mms-2")},
    "g": ("m/s^2", STANDARD_GRAVITY),
    "mg": ("m/s^2", 1e-3 * STANDARD_GRAVITY),
    "n": ("N", 1.0),
    "kn": ("N", 1e3),
    **{u: ("N m", 1.0) for u in ("nm", "n*m", "n·m", "n.m")},
    **{u: ("N m", 1e-3) for u in ("nmm", "n*mm", "n·mm", "n.mm")},
    "kg": ("kg", 1.0),
    **{u: ("1", 1.0) for u in ("", "-", "1")},
}

# Which unit a column of the recordings has; a joint may turn or slide.
_COLUMNS: tuple[tuple[str, tuple[str, ...]], ...] = (
    (r"t", ("s",)),
    (r"p[xyz]", ("m",)),
    (r"q[wxyz]", ("1",)),
    (r"w[xyz]", ("rad/s",)),
    (r"al[xyz]", ("rad/s^2",)),
    (r"a[xyz]", ("m/s^2",)),
    (r"q[1-9]\d*", ("rad", "m")),
    (r"qd[1-9]\d*", ("rad/s", "m/s")),
    (r"qdd[1-9]\d*", ("rad/s^2", "m/s^2")),
)


def expected_unit(column: str) -> tuple[str, ...]:
    """SI units that a column of the recordings may have; empty when any will do."""
    for pattern, units in _COLUMNS:
        if re.fullmatch(pattern, column):
            return units
    return ()


def si_factor(unit: str | None, expected: tuple[str, ...], field: str) -> float:
    """Factor from a declared unit to SI; 1 when none is declared.

    Raises
    ------
    InputError
        When the unit is unknown, or that of another quantity.
    """
    if unit is None:
        return 1.0
    key = re.sub(r"[\s^]", "", unit).lower()
    if key in ("", "-", "1"):
        # "[]" or "[-]" says nothing, or says that a quaternion has no unit.
        return 1.0
    known = _UNITS.get(key)
    if known is None:
        wanted = [name for name, (si, _) in _UNITS.items() if name and (not expected or si in expected)]
        raise InputError(field, "a unit out of " + ", ".join(wanted), f"[{unit}]")
    if expected and known[0] not in expected:
        raise InputError(field, "a unit of " + " or ".join(expected), f"[{unit}], which is {known[0]}")
    return known[1]

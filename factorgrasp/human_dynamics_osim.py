"""[model] osim: an OpenSim model with its coordinates over time (.mot, .sto, tables)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.human_dynamics_joint_table import BEYOND, check_stamps, read_columns
from factorgrasp.models.joint_motion import ORDER
from factorgrasp.models.osim import OsimModel
from factorgrasp.problems.human_dynamics_settings import PerName
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_osim import from_osim
from factorgrasp.signals import choose_savgol, resample_uniform, savgol_derivatives, savgol_noise_gain
from factorgrasp.toml_tables import check_keys, close_matches, get, sub_table
from factorgrasp.typing import BoolArray, FloatArray

_KEYS = (
    "file", "columns", "translations", "rate", "bandwidth", "others", "angle_sd", "position_sd", "orientation_sd",
    "start", "end", "max_gap",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class OsimMotion:
    """A motion on its clock (n,); `motion` is at the frames that are `good`."""

    clock: FloatArray
    good: BoolArray
    motion: LinkMotion
    variances: Mapping[str, PerName]


def read_osim_motion(
    model: OsimModel, motion: Mapping[str, Any], file: Path, gravity: FloatArray
) -> OsimMotion:
    """Coordinates of the model from a file, differentiated.

    Raises
    ------
    InputError
        Naming the key, or the file and the column.
    """
    check_keys(motion, _KEYS, "[motion]")
    where = "[motion]"
    t, recorded = _coordinates(model, motion, file)
    rate = get(motion, "rate", float, where, float(1.0 / np.median(np.diff(t))))
    if rate <= 0.0:
        raise InputError("[motion] rate", "a rate above 0 Hz", f"{rate:g}")
    dt = 1.0 / rate
    clock, uniform = resample_uniform(
        t, recorded, dt, max_gap=get(motion, "max_gap", float, where, None), kind="cubic"
    )
    try:
        window = choose_savgol(get(motion, "bandwidth", float, where, 6.0), dt, ORDER)
    except InputError as error:
        raise InputError(f"[motion] {error.field}", error.expected, error.found, error.hint) from error
    if clock.size < window:
        raise InputError(
            where, f"at least {window} frames ({window * dt:.3g} s) for the derivatives", str(clock.size)
        )
    parts = [savgol_derivatives(uniform, dt, window, ORDER, k) for k in (0, 1, 2)]
    good: BoolArray = np.asarray(np.isfinite(parts[2]).all(axis=1))
    if not good.any():
        raise InputError(
            where, "a stretch without gaps that is longer than the filter of the derivatives", "none"
        )
    gain = savgol_noise_gain(window, ORDER, 2, dt) * max(1.0, float(np.median(np.diff(t))) / dt)
    q, qd, qdd = (part[good] for part in parts)
    found = from_osim(model, clock[good], q, qd, qdd, gravity)
    return OsimMotion(clock, good, found, _variances(motion, gain))


def _variances(motion: Mapping[str, Any], gain: float) -> dict[str, PerName]:
    sd = {
        key: get(motion, key, float, "[motion]", None)
        for key in ("angle_sd", "position_sd", "orientation_sd")
    }
    for key, value in sd.items():
        if value is not None and value <= 0.0:
            raise InputError(f"[motion] {key}", "a standard deviation above 0", f"{value:g}")
    out: dict[str, PerName] = {}
    if sd["angle_sd"] is not None:
        out["joint_acceleration"] = gain * sd["angle_sd"] ** 2
    place, turn = sd["position_sd"], sd["orientation_sd"]
    if (place is None) != (turn is None):
        raise InputError("[motion] position_sd, orientation_sd", "both or none", "one of them")
    if place is not None and turn is not None:
        out["link_acceleration"] = (gain * place**2,) * 3 + (gain * turn**2,) * 3
    return out


def _coordinates(model: OsimModel, motion: Mapping[str, Any], file: Path) -> tuple[FloatArray, FloatArray]:
    renamed = {key: str(value) for key, value in sub_table(motion, "columns").items()}
    for key in renamed:
        if key not in model.names:
            raise InputError(
                f"[motion.columns] {key}",
                "a coordinate of the model",
                "none",
                close_matches(key, model.names),
            )
    lengths = [renamed.get(c.name, c.name) for c in model.coordinates if c.slides]
    t, columns = read_columns(file, motion, lengths)
    others = get(motion, "others", Literal["required", "zero"], "[motion]", "required")
    free = [c.name for c in model.coordinates if not c.locked and c.name not in model.coupled]
    missing = [name for name in free if renamed.get(name, name) not in columns]
    if missing and (others == "required" or len(missing) == len(free)):
        listed = ", ".join(missing[:8]) + (" ..." if len(missing) > 8 else "")
        raise InputError(
            f"{file}: columns", "one for every coordinate of the model", f"{len(missing)} missing: {listed}",
            'Coordinates that stay at their default need no column with others = "zero"',
        )  # fmt: skip
    if t.size < 2 or (np.diff(t) <= 0.0).any():
        raise InputError(f"{file}: time", "at least two increasing times", f"{t.size}")
    check_stamps(t, file)
    start, end = (
        get(motion, key, float, "[motion]", default) for key, default in (("start", -np.inf), ("end", np.inf))
    )
    keep = (t >= start) & (t <= end)
    if keep.sum() < 2:
        raise InputError(
            "[motion] start, end", f"times within {t[0]:.6g} to {t[-1]:.6g} s", f"{start:g} to {end:g} s"
        )
    q = np.empty((int(keep.sum()), len(model.names)))
    for k, one in enumerate(model.coordinates):
        column = columns.get(renamed.get(one.name, one.name))
        q[:, k] = one.default if column is None else column[keep]
        if column is None or one.slides or one.locked or one.name in model.coupled:
            continue
        worst = float(np.nanmax(np.abs(q[:, k]), initial=0.0))
        low, high = (
            (one.low, one.high)
            if one.low < one.high and np.isfinite(one.high - one.low)
            else (-2.0 * np.pi, 2.0 * np.pi)
        )
        if np.nanmin(q[:, k], initial=low) < low - BEYOND or np.nanmax(q[:, k], initial=high) > high + BEYOND:
            raise InputError(
                f"{file}: {one.name}", f"rad, within the model's range of {low:.4g} to {high:.4g}", f"{worst:.4g}",
                "Degrees? Declare inDegrees=yes, or [deg] in the header",
            )  # fmt: skip
    return t[keep], q

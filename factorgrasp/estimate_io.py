"""Estimates on disk and in other libraries' tables: JSON for what people read, NPZ for the arrays; never pickle."""

from __future__ import annotations

import json
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.atomic import replacing, write_text
from factorgrasp.errors import InputError, UnobservableError
from factorgrasp.estimate import Certificate, CovarianceSource, Estimate, TermSummary
from factorgrasp.estimate_text import coordinates
from factorgrasp.observability import Direction, Observability
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, JsonDict
from factorgrasp.variables import Variable, slices

FORMAT = "factorgrasp estimate, version 1"

WHOLE_COVARIANCE_UP_TO = 400
"""Unknowns up to which the joint covariance is stored; above it the marginal of every variable."""


def to_dict(estimate: Estimate) -> JsonDict:
    """Plain finite numbers, strings and lists; what is not finite becomes None."""
    known = estimate.covariance_source is not None
    variables = [
        {
            "name": v.name,
            "size": v.size,
            "manifold": v.manifold,
            "unit": v.unit,
            "components": list(v.components),
            "resolution": v.resolution,
            "value": np.asarray(estimate.values[v.name]).tolist(),
            "sd": estimate.sd(v.name).tolist() if known else None,
        }
        for v in estimate.variables
    ]
    out = {
        "format": FORMAT,
        "status": estimate.status.value,
        "message": estimate.message,
        "kind": estimate.kind,
        "solver": estimate.solver,
        "objective": estimate.objective,
        "iterations": estimate.iterations,
        "variables": variables,
        "residuals": [asdict(term) for term in estimate.residuals],
        "observability": None if estimate.observability is None else estimate.observability.to_dict(),
        "certificate": None if estimate.certificate is None else asdict(estimate.certificate),
        "multipliers": {name: np.asarray(value).tolist() for name, value in estimate.multipliers.items()},
        "timing": dict(estimate.timing),
        "versions": dict(estimate.versions),
        "problem_hash": estimate.problem_hash,
    }
    return dict(_finite(out))


def save(estimate: Estimate, directory: Path) -> Path:
    """Write ``estimate.npz`` and ``estimate.json`` into `directory` (made if missing), each atomically; returns the JSON's path."""
    arrays: dict[str, FloatArray] = {f"value/{name}": np.asarray(v) for name, v in estimate.values.items()}
    arrays |= {f"multiplier/{name}": np.asarray(v) for name, v in estimate.multipliers.items()}
    if estimate.covariance_source is not None:
        if estimate.size <= WHOLE_COVARIANCE_UP_TO:
            arrays["covariance"] = estimate.covariance()
        else:
            arrays |= {f"covariance/{v.name}": estimate.covariance(v.name) for v in estimate.variables}
    with replacing(directory / "estimate.npz") as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)
    text = json.dumps(to_dict(estimate), indent=1, allow_nan=False, ensure_ascii=False)
    return write_text(directory / "estimate.json", text + "\n")


def load(directory: Path) -> Estimate:
    """Read what `save` wrote.

    Raises
    ------
    InputError
        When the folder does not hold an estimate.
    """
    path = directory / "estimate.json"
    try:
        stored: JsonDict = json.loads(path.read_text(encoding="utf-8"))
        with np.load(directory / "estimate.npz", allow_pickle=False) as file:
            arrays = {name: np.array(file[name]) for name in file.files}
    except FileNotFoundError as error:
        raise InputError("directory", "estimate.json and estimate.npz", f"no {error.filename}") from None
    except (json.JSONDecodeError, ValueError) as error:
        raise InputError(str(directory), "files that Estimate.save wrote", str(error)) from None
    if stored.get("format") != FORMAT:
        raise InputError(str(path), f"the format {FORMAT!r}", repr(stored.get("format")))
    try:
        return _estimate(stored, arrays)
    except KeyError as error:
        words = f"files without {error}"
        raise InputError(str(directory), "files that Estimate.save wrote", words) from None


def to_dataframe(estimate: Estimate) -> Any:
    """One row a tangent component: variable, component, value, sd, unit. Rotations are given as rotation vectors (rad).

    Raises
    ------
    InputError
        When pandas is not installed.
    """
    try:
        import pandas
    except ImportError:
        raise InputError(
            "to_dataframe", "pandas", "no such package", "pip install factorgrasp[data]"
        ) from None
    rows = []
    for variable in estimate.variables:
        sd = np.full(variable.size, np.nan)
        if estimate.covariance_source is not None:
            sd = estimate.sd(variable.name)
        values = coordinates(variable, estimate.values[variable.name])
        rows += [
            (variable.name, label, float(value), float(spread), variable.unit)
            for label, value, spread in zip(variable.labels, values, sd, strict=True)
        ]
    return pandas.DataFrame(rows, columns=["variable", "component", "value", "sd", "unit"])


def to_xarray(estimate: Estimate) -> Any:
    """``value`` and ``sd`` over ``component``, and ``covariance`` over ``(component, component_2)`` where the size allows.

    Raises
    ------
    InputError
        When xarray is not installed.
    """
    try:
        xarray: Any = import_module("xarray")
    except ImportError:
        raise InputError("to_xarray", "xarray", "no such package", "pip install factorgrasp[data]") from None
    table = to_dataframe(estimate)
    labels = [f"{v}/{c}" for v, c in zip(table["variable"], table["component"], strict=True)]
    data: dict[str, Any] = {
        "value": ("component", table["value"].to_numpy()),
        "sd": ("component", table["sd"].to_numpy()),
    }
    if estimate.covariance_source is not None and estimate.size <= WHOLE_COVARIANCE_UP_TO:
        data["covariance"] = (("component", "component_2"), estimate.covariance())
    attributes = {
        "status": estimate.status.value,
        "kind": estimate.kind,
        "problem_hash": estimate.problem_hash,
    }
    coords: dict[str, Any] = {"component": labels, "unit": ("component", table["unit"].to_numpy())}
    if "covariance" in data:
        coords["component_2"] = labels
    return xarray.Dataset(data, coords, attributes)


# ---- internals --------------------------------------------------------------------------------------------------


def _estimate(stored: JsonDict, arrays: dict[str, FloatArray]) -> Estimate:
    """The estimate that the two files hold."""
    variables = tuple(
        Variable(v["name"], v["size"], v["manifold"], v["unit"], tuple(v["components"]), v["resolution"])
        for v in stored["variables"]
    )
    certificate = stored["certificate"]
    return Estimate(
        status=Status(stored["status"]),
        kind=stored["kind"],
        solver=stored["solver"],
        variables=variables,
        values={v.name: arrays[f"value/{v.name}"] for v in variables},
        message=stored["message"],
        residuals=tuple(TermSummary(**_numbers(term)) for term in stored["residuals"]),
        observability=_observability(stored["observability"]),
        objective=_number(stored["objective"]),
        iterations=stored["iterations"],
        certificate=None if certificate is None else Certificate(**_numbers(certificate)),
        timing=_numbers(stored["timing"]),
        versions=stored["versions"],
        problem_hash=stored["problem_hash"],
        multipliers={
            k.removeprefix("multiplier/"): v for k, v in arrays.items() if k.startswith("multiplier/")
        },
        covariance_source=_stored_covariance(variables, arrays),
    )


def _finite(value: Any) -> Any:
    """The same tree with None for every number that is not finite."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float):
        return float(value) if np.isfinite(value) else None
    return value


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _numbers(stored: JsonDict) -> JsonDict:
    return {key: float("nan") if value is None else value for key, value in stored.items()}


def _observability(stored: JsonDict | None) -> Observability | None:
    if stored is None:
        return None
    directions = tuple(
        Direction(
            variable=d["variable"],
            vector=np.array(d["direction"], dtype=float),
            # An infinite sd is the only one that is stored as None.
            sd=np.inf if d["sd"] is None else d["sd"],
            resolution=_number(d["resolution"]),
            words=d["words"],
            unit=d["unit"],
        )
        for d in stored["directions"]
    )
    return Observability(directions, stored["advice"])


def _stored_covariance(
    variables: tuple[Variable, ...], arrays: dict[str, FloatArray]
) -> CovarianceSource | None:
    if "covariance" in arrays:
        return lambda columns: _times(arrays["covariance"], columns)
    where = slices(variables)
    blocks = {name: arrays[f"covariance/{name}"] for name in where if f"covariance/{name}" in arrays}
    if not blocks:
        return None

    def source(columns: FloatArray) -> FloatArray:
        touched = [name for name, rows in where.items() if np.any(columns[rows])]
        if len(touched) > 1:
            raise UnobservableError(
                f"only the covariance of each variable was stored for a problem of this size, not that of {' with '.join(touched[:4])}"
            )
        out = np.zeros(columns.shape)
        for name in touched:
            out[where[name]] = _times(blocks[name], columns[where[name]])
        return out

    return source


def _times(covariance: FloatArray, columns: FloatArray) -> FloatArray:
    """``P B``, NaN only in the columns that reach an unknown whose variance is."""
    lost = ~np.isfinite(np.diag(covariance))
    out = np.where(np.isfinite(covariance), covariance, 0.0) @ columns
    out[:, np.any(columns[lost] != 0.0, axis=0)] = np.nan
    return np.asarray(out)

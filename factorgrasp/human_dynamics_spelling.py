"""Other ways to write a human-dynamics file: obvious variants become the one spelling that the readers know.

Whatever is not listed here stays as it is, and is refused where it is read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

from factorgrasp.errors import InputError
from factorgrasp.toml_tables import convert, describe, place

_MODEL = {"opensim": "osim", "motion": "links", "motion_file": "links", "gender": "sex", "base_type": "base"}
_MOTION = {
    "csv": "file", "trc": "file", "mot": "file", "sto": "file", "path": "file", "links": "file", "npz": "file",
    "frame_rate": "rate", "sampling_rate": "rate", "cutoff": "bandwidth", "cutoff_hz": "bandwidth", "bandwidth_hz": "bandwidth",
}  # fmt: skip
_FORCE = {
    "path": "file", "body": "link", "on": "link", "torque": "moment", "saturation": "limit", "max_force": "limit",
    "variance": "covariance", "rotation": "rotation_wxyz", "quaternion_wxyz": "rotation_wxyz",
}  # fmt: skip
_SENSOR = {
    "path": "file",
    "body": "link",
    "kind": "type",
    "variance": "covariance",
    "rotation": "rotation_wxyz",
}
_SENSOR_TYPES = {
    "acc": "accelerometer", "accelerometers": "accelerometer", "torque": "joint_torque", "qdd": "joint_acceleration",
    "gyro": "gyroscope", "ft": "wrench", "force_torque": "wrench", "external_wrench": "wrench", "force_plate": "wrench",
}  # fmt: skip
_FRAMES = {"ground": "world", "lab": "world", "body": "link", "local": "link"}
_CONTACTS = {"links": "unmeasured", "unknown": "unmeasured", "holding": "payload"}
_COVARIANCE = {
    "forces": "plate",
    "feet": "plate",
    "plates": "plate",
    "hands": "contact_wrench",
    "unmeasured": "contact_wrench",
}
_WIDE = {
    "model": ("propagation", "balance"), "Sigma_D": ("propagation", "balance"),
    "prior": ("prior_link_acceleration", "prior_external_wrench", "prior_joint_wrench", "prior_joint_acceleration"),
    "Sigma_d": ("prior_link_acceleration", "prior_external_wrench", "prior_joint_wrench", "prior_joint_acceleration"),
}  # fmt: skip
_LISTS = (("contacts", "unmeasured"), ("contacts", "payload"), ("constraints", "feet"))


def canonical(table: Mapping[str, Any]) -> dict[str, Any]:
    """The tables in the spelling of ``docs/human_dynamics.md``.

    Raises
    ------
    InputError
        Where two spellings of one key are given.
    """
    out = dict(table)
    if isinstance(out.get("model"), str):
        out["model"] = {"file": out["model"]}
    if isinstance(out.get("motion"), str):
        out["motion"] = {"file": out["motion"]}
    for key, names in (
        ("model", _MODEL),
        ("motion", _MOTION),
        ("contacts", _CONTACTS),
        ("covariance", _COVARIANCE),
    ):
        if isinstance(out.get(key), Mapping):
            out[key] = _renamed(out[key], names, f"[{key}]")
    if isinstance(out.get("model"), Mapping):
        out["model"] = _model(out["model"])
    if isinstance(out.get("covariance"), Mapping):
        out["covariance"] = _covariance(out["covariance"])
    for key, name in _LISTS:
        section = out.get(key)
        if isinstance(section, Mapping) and isinstance(section.get(name), str):
            out[key] = {**section, name: [section[name]]}
    contacts = out.get("contacts")
    if isinstance(contacts, Mapping) and isinstance(contacts.get("payload"), bool):
        out["contacts"] = {
            **contacts,
            "payload": contacts.get("unmeasured", []) if contacts["payload"] else [],
        }
    for key in ("forces", "sensors"):
        if key in out:
            out[key] = [
                _entry(one, key, number) for number, one in enumerate(_entries(out[key], key), start=1)
            ]
    wrenches = [one for one in out.get("sensors", []) if one.get("type") == "wrench"]
    if wrenches:
        # A force is a force, in whichever table it stands.
        out["forces"] = [
            *out.get("forces", []),
            *({k: v for k, v in one.items() if k != "type"} for one in wrenches),
        ]
        out["sensors"] = [one for one in out["sensors"] if one.get("type") != "wrench"]
    return out


def _entries(value: Any, key: str) -> Sequence[Mapping[str, Any]]:
    """``[[key]]``, a single ``[key]``, or ``[key.name]`` for each."""
    if isinstance(value, Mapping):
        if value and all(isinstance(one, Mapping) for one in value.values()):
            return [{"name": str(name), **one} for name, one in value.items()]
        return [value] if value else []
    if not isinstance(value, list) or not all(isinstance(one, Mapping) for one in value):
        raise InputError(f"[[{key}]]", "tables", describe(value))
    return value


def _entry(one: Mapping[str, Any], key: str, number: int) -> dict[str, Any]:
    where = f"[[{key}]] {number}"
    out = _renamed(one, _FORCE if key == "forces" else _SENSOR, where)
    if key == "sensors" and isinstance(out.get("type"), str):
        out["type"] = _SENSOR_TYPES.get(out["type"], out["type"])
    if isinstance(out.get("frame"), str):
        out["frame"] = _FRAMES.get(out["frame"], out["frame"])
    sd = [name for name in ("sd", "sigma", "std") if name in out]
    if sd:
        if "covariance" in out or len(sd) > 1:
            raise InputError(place(where, sd[0]), "either sd or covariance", "both")
        value = out.pop(sd[0])
        many = value if isinstance(value, list) else [value]
        squares = [convert(x, float, place(where, sd[0])) ** 2 for x in many]
        out["covariance"] = squares if isinstance(value, list) else squares[0]
    if isinstance(out.get("covariance"), list) and key == "forces" and len(out["covariance"]) == 2:
        force, moment = out["covariance"]
        out["covariance"] = [force] * 3 + [moment] * 3
    elif (
        key == "forces"
        and isinstance(out.get("covariance"), int | float)
        and not isinstance(out["covariance"], bool)
    ):
        out["covariance"] = [out["covariance"]] * 6
    return out


def _model(model: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(model)
    if isinstance(body := out.get("anthropometry"), Mapping):
        del out["anthropometry"]
        for key, value in body.items():
            if key in out:
                raise InputError(f"[model] {key}", "the key once", "in anthropometry, too")
            out[key] = value
    if isinstance(out.get("file"), str):
        kind = {".urdf": "urdf", ".xml": "urdf", ".npz": "links", ".osim": "osim"}.get(
            PurePath(out["file"]).suffix.lower()
        )
        if kind is None:
            raise InputError(
                "[model] file",
                "a .urdf or .osim file, or an archive of link-level arrays (.npz)",
                repr(out["file"]),
            )
        if kind in out:
            raise InputError(f"[model] {kind}", "either file or " + kind, "both")
        out[kind] = out.pop("file")
    for key, yes, no in (
        ("floating_base", "floating", "fixed"),
        ("floating", "floating", "fixed"),
        ("fixed_base", "fixed", "floating"),
    ):
        if key in out:
            if "base" in out:
                raise InputError(f"[model] {key}", "either base or " + key, "both")
            out["base"] = yes if convert(out.pop(key), bool, f"[model] {key}") else no
    return out


def _covariance(covariance: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(covariance)
    for key, names in _WIDE.items():
        if key in out:
            value = out.pop(key)
            for name in names:
                out.setdefault(name, value)
    if isinstance(out.get("plate"), int | float) and not isinstance(out["plate"], bool):
        out["plate"] = [out["plate"]] * 6
    elif isinstance(out.get("plate"), list) and len(out["plate"]) == 2:
        out["plate"] = [out["plate"][0]] * 3 + [out["plate"][1]] * 3
    return out


def _renamed(table: Mapping[str, Any], names: Mapping[str, str], where: str) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in table.items():
        name = names.get(key, key)
        if name in out:
            raise InputError(place(where, key), f"{name} once", "another spelling of it, too")
        out[name] = value
    return out

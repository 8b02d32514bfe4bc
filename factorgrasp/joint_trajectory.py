"""A joint trajectory as the ROS 2 message ``trajectory_msgs/JointTrajectory``, in YAML or JSON, and back.

Field names, units and their order are the message's: ``header`` (``stamp``, ``frame_id``), ``joint_names``, ``points`` with ``positions``
(rad), ``velocities`` (rad/s), ``accelerations`` (rad/s^2), ``effort`` (Nm) and ``time_from_start`` (``sec``, ``nanosec``). The YAML form
is what ``ros2 topic pub`` takes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.atomic import write_text
from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray, JsonDict

_FIELDS = ("positions", "velocities", "accelerations", "effort")
_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """Joint positions over time with what else is known of them.

    Parameters
    ----------
    t : (n,) array_like
        Time from the start, s, zero or more and increasing; whole nanoseconds survive a file.
    names : sequence of str
        Joints, as the robot's driver calls them.
    positions : (n, k) array_like
        rad.
    velocities, accelerations, effort : (n, k) array_like, optional
        rad/s, rad/s^2, Nm.
    frame : str
        ``header.frame_id``.

    Raises
    ------
    InputError
        Naming the field, for shapes that do not fit, numbers that are not finite, or time that does not increase.
    """

    t: FloatArray
    names: tuple[str, ...]
    positions: FloatArray
    velocities: FloatArray | None = None
    accelerations: FloatArray | None = None
    effort: FloatArray | None = None
    frame: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(map(str, self.names)))
        t = np.asarray(self.t, dtype=float)
        if t.ndim != 1 or not t.size or not np.isfinite(t).all() or t[0] < 0.0 or np.any(np.diff(t) <= 0.0):
            raise InputError("t", "times (n,) from zero on, increasing [s]", f"shape {t.shape}")
        object.__setattr__(self, "t", t)
        for name in _FIELDS:
            value = getattr(self, name)
            if value is None and name != "positions":
                continue
            array = np.asarray(value, dtype=float)
            if array.shape != (t.size, len(self.names)) or not np.isfinite(array).all():
                raise InputError(
                    name, f"finite numbers, shape {(t.size, len(self.names))}", f"shape {array.shape}"
                )
            object.__setattr__(self, name, array)

    def thinned(self, rate: float) -> JointTrajectory:
        """Every so-many-th point, so that about `rate` (Hz) remain; first and last always do."""
        if not (np.isfinite(rate) and rate > 0.0):
            raise InputError("rate", "a finite number of Hz above zero", repr(rate))
        step = float(np.median(np.diff(self.t))) if self.t.size > 1 else 1.0
        every = max(1, round(1.0 / (rate * step)))
        keep = np.unique(np.append(np.arange(0, self.t.size, every), self.t.size - 1))
        parts = {name: value[keep] for name in _FIELDS if (value := getattr(self, name)) is not None}
        return JointTrajectory(self.t[keep], self.names, frame=self.frame, **parts)

    def to_message(self) -> JsonDict:
        """The message as plain dicts and lists."""
        points = []
        for k, t in enumerate(self.t):
            nanoseconds = round(float(t) * _NANOSECONDS)
            point: JsonDict = {}
            for name in _FIELDS:
                value = getattr(self, name)
                point[name] = [] if value is None else value[k].tolist()
            sec, nanosec = divmod(nanoseconds, _NANOSECONDS)
            point["time_from_start"] = {"sec": sec, "nanosec": nanosec}
            points.append(point)
        return {
            "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": self.frame},
            "joint_names": list(self.names),
            "points": points,
        }

    @classmethod
    def from_message(cls, message: Any) -> JointTrajectory:
        """From the message as plain dicts and lists.

        Raises
        ------
        InputError
            When something of it is missing or of another kind.
        """
        try:
            points = message["points"]
            t = [
                int(p["time_from_start"]["sec"]) + 1e-9 * int(p["time_from_start"]["nanosec"]) for p in points
            ]
            arrays = {name: [p.get(name) or [] for p in points] for name in _FIELDS}
            names, frame = message["joint_names"], message.get("header", {}).get("frame_id", "")
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                "JointTrajectory", "header, joint_names and points with time_from_start", repr(error)
            ) from error
        given = {name: values for name, values in arrays.items() if name == "positions" or any(values)}
        for name, values in given.items():
            if any(len(row) != len(names) for row in values):
                raise InputError(
                    f"points.{name}", f"{len(names)} numbers in every point", "another number of them"
                )
        return cls(np.array(t), tuple(names), frame=frame, **{k: np.array(v) for k, v in given.items()})

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write .json or .yaml (.yml), atomically; returns the path."""
        file = Path(path)
        suffix = file.suffix.lower()
        if suffix == ".json":
            return write_text(file, json.dumps(self.to_message(), indent=1) + "\n")
        if suffix in (".yaml", ".yml"):
            return write_text(file, _yaml(self.to_message()))
        raise InputError(str(file), "a name that ends in .json, .yaml or .yml", file.suffix or "no ending")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> JointTrajectory:
        """Read what :meth:`save` wrote, or what ``ros2 topic echo`` writes.

        Raises
        ------
        InputError
        """
        file = Path(path)
        if not file.is_file():
            raise InputError(str(file), "a JointTrajectory (JSON or YAML)", "no such file")
        text = file.read_text(encoding="utf-8")
        try:
            message = json.loads(text) if file.suffix.lower() == ".json" else _load_yaml(text, file)
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            raise InputError(str(file), "JSON", str(error)) from error
        return cls.from_message(message)


def joint_trajectory(
    t: FloatArray,
    names: Sequence[str],
    q: FloatArray,
    qd: FloatArray | None = None,
    qdd: FloatArray | None = None,
    tau: FloatArray | None = None,
    rate: float | None = None,
) -> JointTrajectory:
    """A trajectory from arrays, its time counted from its first point.

    Parameters
    ----------
    t : (n,) ndarray
        s.
    names : sequence of str
    q, qd, qdd, tau : (n, k) ndarray
        rad, rad/s, rad/s^2, Nm.
    rate : float, optional
        Hz; see :meth:`JointTrajectory.thinned`.
    """
    out = JointTrajectory(np.asarray(t) - t[0], tuple(names), q, qd, qdd, tau)
    return out if rate is None else out.thinned(rate)


def _yaml(message: JsonDict) -> str:
    """The message in block style; numbers keep all their digits."""
    stamp = message["header"]["stamp"]
    lines = [
        "header:",
        "  stamp:",
        f"    sec: {stamp['sec']}",
        f"    nanosec: {stamp['nanosec']}",
        f"  frame_id: {json.dumps(message['header']['frame_id'])}",
        "joint_names:",
        *(f"- {json.dumps(name)}" for name in message["joint_names"]),
        "points:",
    ]
    for point in message["points"]:
        lines += [f"{'- ' if name == 'positions' else '  '}{name}: {_row(point[name])}" for name in _FIELDS]
        lines += ["  time_from_start:", *(f"    {k}: {v}" for k, v in point["time_from_start"].items())]
    return "\n".join(lines) + "\n"


def _row(values: list[float]) -> str:
    # YAML 1.1 reads 1e-05 as a word: it wants a dot in the mantissa.
    return "[" + ", ".join(_number(value) for value in values) + "]"


def _number(value: float) -> str:
    text = repr(float(value))
    mantissa, mark, exponent = text.partition("e")
    return f"{mantissa}.0e{exponent}" if mark and "." not in mantissa else text


def _load_yaml(text: str, file: Path) -> Any:
    """Mappings and lists in block style, lists of numbers in brackets, scalars: what this module and ``ros2 topic echo`` write."""
    lines = [
        (len(line) - len(line.lstrip(" ")), line.strip())
        for line in text.splitlines()
        if line.strip() and not line.lstrip().startswith("#") and line.strip() != "---"
    ]
    try:
        value, rest = _block(lines)
    except (ValueError, IndexError) as error:
        raise InputError(str(file), "YAML in block style", str(error)) from error
    if rest:
        raise InputError(str(file), "YAML in block style", f"{rest[0][1]!r} out of place")
    return value


_Lines = list[tuple[int, str]]


def _block(lines: _Lines) -> tuple[Any, _Lines]:
    """The list or mapping that begins with the first line, and the lines after it."""
    indent = lines[0][0]
    if not lines[0][1].startswith("- ") and lines[0][1] != "-":
        return _mapping(lines, indent)
    items: list[Any] = []
    while lines and lines[0][0] == indent and lines[0][1].startswith("-"):
        inner = lines[0][1][1:].strip()
        # What follows the dash is indented by the dash itself.
        lines = [(indent + 2, inner), *lines[1:]] if inner else lines[1:]
        if inner and not _is_key(inner):
            items.append(_scalar(inner))
            lines = lines[1:]
        else:
            item, lines = _block(lines)
            items.append(item)
    return items, lines


def _mapping(lines: _Lines, indent: int) -> tuple[Any, _Lines]:
    out: dict[str, Any] = {}
    while lines and lines[0][0] == indent and not lines[0][1].startswith("- "):
        key, mark, value = lines[0][1].partition(":")
        if not mark:
            raise ValueError(f"no key in {lines[0][1]!r}")
        lines = lines[1:]
        if value.strip():
            out[key] = _scalar(value.strip())
        elif lines and (lines[0][0] > indent or (lines[0][0] == indent and lines[0][1].startswith("-"))):
            out[key], lines = _block(lines)
        else:
            out[key] = None
    return out, lines


def _is_key(text: str) -> bool:
    key, mark, value = text.partition(":")
    return bool(mark) and not key.startswith(('"', "[")) and (not value or value.startswith(" "))


def _scalar(text: str) -> Any:
    if text.startswith("["):
        inner = text.strip("[]").strip()
        return [_scalar(part.strip()) for part in inner.split(",")] if inner else []
    if text.startswith('"'):
        return json.loads(text)
    if text.startswith("'"):
        return text[1:-1].replace("''", "'")
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text

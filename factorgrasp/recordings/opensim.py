"""OpenSim's text files: storages (.mot, .sto) and marker trajectories (.trc), in SI units.

Degrees and millimetres are converted from what the file itself declares (``inDegrees=yes``, ``Units mm``). A gap (an empty field or nan)
stays one.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.recordings import _validate
from factorgrasp.recordings.tables import PathLike
from factorgrasp.recordings.units import si_factor
from factorgrasp.typing import FloatArray

# More than two turns in "radians" are degrees; joints of people turn less.
_MOST_RADIANS = 4.0 * np.pi
_TRANSLATION = re.compile(r".*_t[xyz]")


@dataclass(frozen=True)
class StorageTable:
    """The content of a storage file as it is written, before any conversion.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s.
    names : tuple of str
        Columns other than time.
    values : ndarray, shape (n, c)
    in_degrees : bool or None
        What the header declares; None when it does not.
    title : str
        First line of the header.
    """

    t: FloatArray
    names: tuple[str, ...]
    values: FloatArray
    in_degrees: bool | None
    title: str

    def column(self, name: str) -> FloatArray:
        """One column (n,)."""
        return self.columns((name,))[:, 0]

    def columns(self, names: Collection[str]) -> FloatArray:
        """Some columns (n, k).

        Raises
        ------
        InputError
            Naming those that are missing.
        """
        missing = [name for name in names if name not in self.names]
        if missing:
            raise InputError(
                "columns",
                ", ".join(names),
                f"{', '.join(missing)} missing; there are {', '.join(self.names)}",
            )
        return self.values[:, [self.names.index(name) for name in names]]


@dataclass(frozen=True)
class CoordinateTable:
    """Generalised coordinates over time.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s.
    names : tuple of str
    values : ndarray, shape (n, c)
        rad, and m for translations.
    translations : tuple of str
        Which of the names are translations.
    """

    t: FloatArray
    names: tuple[str, ...]
    values: FloatArray
    translations: tuple[str, ...]


@dataclass(frozen=True)
class OsimMarker:
    """A marker of an OpenSim model: its name, the body that carries it, and where (m, in the body's frame)."""

    name: str
    link: str
    position: tuple[float, float, float]


@dataclass(frozen=True)
class MarkerRecording:
    """Positions of markers over time.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s.
    names : tuple of str
    position : ndarray, shape (n, m, 3)
        m, in the laboratory's frame; NaN where a marker was not seen.
    rate : float
        Hz, as the file declares it.
    """

    t: FloatArray
    names: tuple[str, ...]
    position: FloatArray
    rate: float


def read_storage(path: PathLike) -> StorageTable:
    """A .mot or .sto file, as it is written.

    Raises
    ------
    InputError
        Naming the file and line: no ``endheader``, another number of rows or columns than declared, text among the numbers.
    """
    file = Path(path)
    lines = _lines(file)
    end = next((k for k, line in enumerate(lines) if line.strip().lower() == "endheader"), None)
    if end is None:
        raise InputError(str(file), "an OpenSim storage (.mot, .sto) with a line 'endheader'", "none")
    header: dict[str, str] = {}
    for line in lines[:end]:
        key, separator, value = line.strip().partition("=")
        if separator:
            header[key.strip().lower()] = value.strip()
        elif len(words := line.split()) == 2 and words[0].lower() in ("datacolumns", "datarows"):
            # The SIMM dialect.
            header[{"datacolumns": "ncolumns", "datarows": "nrows"}[words[0].lower()]] = words[1]
    body = [(number, line) for number, line in enumerate(lines[end + 1 :], start=end + 2) if line.strip()]
    if len(body) < 3:
        raise InputError(
            str(file),
            "a line of names and at least two rows of numbers",
            f"{len(body)} line(s) below the header",
        )
    names = body[0][1].split()
    if names[0].lower() != "time":
        raise InputError(
            f"{file}: line {body[0][0]}", "the names of the columns, the first of them 'time'", repr(names[0])
        )
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{file}: columns", "unique names", ", ".join(twice) + " more than once")
    rows = np.array([_row(file, number, line.split(), len(names)) for number, line in body[1:]])
    for key, found, what in (("ncolumns", len(names), "columns"), ("nrows", len(rows), "rows")):
        declared = header.get(key, "")
        if declared.isdigit() and int(declared) != found:
            raise InputError(
                str(file), f"{declared} {what}, as its header declares", f"{found}", "Is the file complete?"
            )
    flag = header.get("indegrees", "").lower()
    if flag not in ("", "yes", "no"):
        raise InputError(f"{file}: inDegrees", "yes or no", repr(flag))
    return StorageTable(
        _validate.times(rows[:, 0], f"{file}: time"),
        tuple(names[1:]),
        _validate.read_only(np.ascontiguousarray(rows[:, 1:])),
        None if not flag else flag == "yes",
        lines[0].strip().removeprefix("name").strip(" =\t"),
    )


def read_coordinates(
    path: PathLike, translations: Collection[str] = (), in_degrees: bool | None = None
) -> CoordinateTable:
    """Generalised coordinates (inverse kinematics) from a .mot or .sto file, in rad and m.

    Parameters
    ----------
    path : path
    translations : collection of str
        Coordinates that are lengths, beside those that end in ``_tx``, ``_ty`` or ``_tz``.
    in_degrees : bool, optional
        For a file that does not declare ``inDegrees``.

    Raises
    ------
    InputError
        When the file does not say its unit, or says radians where only degrees make sense.
    """
    table = read_storage(path)
    degrees = table.in_degrees if table.in_degrees is not None else in_degrees
    if degrees is None:
        raise InputError(
            f"{path}: inDegrees", "yes or no in the header", "no such line", "Or say in_degrees="
        )
    lengths = tuple(name for name in table.names if _TRANSLATION.fullmatch(name) or name in translations)
    values = table.values.copy()
    angles = np.array([name not in lengths for name in table.names])
    if degrees:
        values[:, angles] *= np.pi / 180.0
    largest = np.nanmax(np.abs(values), axis=0, initial=0.0)
    wild = np.flatnonzero(angles & (largest > _MOST_RADIANS))
    if wild.size:
        name = table.names[int(wild[0])]
        hint = (
            "Degrees that the header calls radians?"
            if not degrees
            else f"If it is a length, name it in translations=({name!r},)"
        )
        raise InputError(
            f"{path}: {name}", "angles of less than two turns", f"{largest[wild[0]]:.4g} rad", hint
        )
    return CoordinateTable(table.t, table.names, _validate.read_only(values), lengths)


def read_trc(path: PathLike) -> MarkerRecording:
    """Marker trajectories from a .trc file, in m.

    Raises
    ------
    InputError
        Naming the file and line: an unknown unit, another number of markers or frames than declared.
    """
    file = Path(path)
    lines = _lines(file)
    if len(lines) < 6 or not lines[0].lower().startswith("pathfiletype"):
        raise InputError(
            str(file),
            "a marker file (.trc) that begins with PathFileType",
            repr(lines[0][:40] if lines else ""),
        )
    declared = dict(zip(lines[1].split(), lines[2].split(), strict=False))
    for key in ("NumMarkers", "Units", "DataRate", "NumFrames"):
        if key not in declared:
            raise InputError(f"{file}: line 2", f"the key {key}", ", ".join(declared))
    factor = si_factor(declared["Units"], ("m",), f"{file}: Units")
    head = lines[3].split("\t")
    names = [name.strip() for name in head[2:] if name.strip()]
    count = _integer(file, "NumMarkers", declared["NumMarkers"])
    if len(names) != count:
        raise InputError(f"{file}: line 4", f"the names of {count} markers", f"{len(names)} names")
    width = 2 + 3 * count
    rows = []
    for number, line in enumerate(lines[5:], start=6):
        if not line.strip():
            continue
        fields = [field.strip() for field in line.rstrip("\r\n").split("\t")]
        # Markers that are not seen are empty fields; at the end of a line they may be missing altogether.
        if len(fields) > width and not any(fields[width:]):
            fields = fields[:width]
        fields += [""] * (width - len(fields))
        rows.append(_row(file, number, fields, width))
    frames = _integer(file, "NumFrames", declared["NumFrames"])
    if len(rows) != frames:
        raise InputError(
            str(file), f"{frames} frames, as its header declares", f"{len(rows)}", "Is the file complete?"
        )
    data = np.array(rows)
    position = factor * data[:, 2:].reshape(len(rows), count, 3)
    # A marker is seen or it is not.
    position[np.isnan(position).any(axis=2)] = np.nan
    return MarkerRecording(
        _validate.times(data[:, 1], f"{file}: Time"),
        tuple(names),
        _validate.read_only(position),
        float(declared["DataRate"]),
    )


def read_osim_markers(path: PathLike) -> tuple[OsimMarker, ...]:
    """Markers of an OpenSim model (.osim), of version 3 or 4.

    Raises
    ------
    InputError
        For a file that is none, without markers, or with a marker that lacks its body or its place.
    """
    file = Path(path)
    _lines(file)
    try:
        root = ElementTree.parse(file).getroot()
    except ElementTree.ParseError as error:
        raise InputError(str(file), "an OpenSim model (.osim)", str(error)) from error
    out = []
    for element in root.iter("Marker"):
        name = element.get("name", "")
        link = next(
            (
                text
                for key in ("socket_parent_frame", "socket_parent_frame_connectee_name", "body")
                if (text := (element.findtext(key) or "").strip())
            ),
            "",
        )
        words = (element.findtext("location") or "").split()
        try:
            x, y, z = (float(word) for word in words)
        except ValueError:
            raise InputError(f"{file}: marker {name}, location", "three numbers", " ".join(words)) from None
        if not name or not link:
            raise InputError(f"{file}: marker {name}", "a name and a body", "none")
        out.append(OsimMarker(name, link.rpartition("/")[2], (x, y, z)))
    if not out:
        raise InputError(str(file), "a model with markers", "none")
    return tuple(out)


def _lines(file: Path) -> list[str]:
    if not file.is_file():
        raise InputError(str(file), "a recording", "a folder" if file.is_dir() else "no such file")
    text = file.read_text(encoding="utf-8-sig", errors="replace")
    if "\0" in text[:4096]:
        raise InputError(str(file), "a text file", "a binary one")
    return text.splitlines()


def _row(file: Path, number: int, fields: list[str], width: int) -> list[float]:
    if len(fields) != width:
        raise InputError(f"{file}: line {number}", f"{width} fields", f"{len(fields)}")
    out = []
    for column, field in enumerate(fields):
        try:
            out.append(float(field) if field else np.nan)
        except ValueError:
            # Windows writes -nan(ind) and 1.#QNAN.
            if "nan" not in field.lower():
                raise InputError(
                    f"{file}: line {number}, column {column + 1}", "a number", repr(field)
                ) from None
            out.append(np.nan)
    return out


def _integer(file: Path, key: str, text: str) -> int:
    try:
        return int(float(text))
    except ValueError:
        raise InputError(f"{file}: {key}", "a whole number", repr(text)) from None

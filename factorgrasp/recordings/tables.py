"""Tables with named columns: CSV, NPZ and Parquet as arrays in SI units.

Without a unit in its name a column is taken to be in SI units; with one (``px [mm]``, ``wx [deg/s]``, ``t [ns]``) it is
converted here. An empty field or ``nan`` is a gap and stays one. In CSV, lines that begin with ``#`` are comments.
"""

from __future__ import annotations

import csv
import io
import os
import re
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.recordings.units import expected_unit, si_factor
from factorgrasp.typing import FloatArray

PathLike: TypeAlias = str | os.PathLike[str]

_HEADER = re.compile(r"\s*(?P<name>[^\[\]()]*?)\s*(?:[\[(](?P<unit>[^\[\]()]*)[\])])?\s*")


def read_table(
    path: PathLike, required: Sequence[str] = (), optional: Sequence[str] = ()
) -> dict[str, FloatArray]:
    """Columns of a .csv, .npz or .parquet file, in SI units.

    Parameters
    ----------
    path : path
        The file; its suffix decides the format (everything that is neither .npz nor .parquet is read as CSV).
    required : sequence of str
        Columns that must be there. Empty, with ``optional`` empty too: all columns.
    optional : sequence of str
        Columns that are read when they are there.

    Returns
    -------
    dict of str to ndarray, shape (n,)
        float64, NaN for gaps; no NaN in ``t``.

    Raises
    ------
    InputError
        When the file is missing, empty or has a header only; when columns are missing, not numeric or in an
        unknown unit; when a time is missing. It names the file, the line and the column.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(str(file), "a recording", "a folder" if file.is_dir() else "no such file")
    read = {".npz": _read_npz, ".parquet": _read_parquet}.get(file.suffix.lower(), _read_csv)
    if file.stat().st_size == 0:
        raise InputError(str(file), "a header line and rows of numbers", "an empty file")
    return read(file, tuple(required), tuple(optional))


def column_names(path: PathLike) -> tuple[str, ...]:
    """Names of a table's columns, without their units."""
    file = Path(path)
    if not file.is_file():
        raise InputError(str(file), "a recording", "a folder" if file.is_dir() else "no such file")
    suffix = file.suffix.lower()
    if suffix == ".npz":
        with _open_npz(file) as arrays:
            headers: Sequence[str] = arrays.files
    elif suffix == ".parquet":
        headers = _parquet_names(file)
    else:
        headers = _split_csv(file, _text(file))[0]
    return tuple(name for name, _ in _columns(headers))


def _columns(headers: Sequence[str]) -> list[tuple[str, str | None]]:
    """Name and unit of each column."""
    out = []
    for header in headers:
        match = _HEADER.fullmatch(header)
        # What is not "name" or "name [unit]" is nobody's column; only a wanted one would be missed.
        out.append((match["name"], match["unit"]) if match else (header.strip(), None))
    return out


def _select(
    file: Path, headers: Sequence[str], required: tuple[str, ...], optional: tuple[str, ...]
) -> dict[str, tuple[int, float]]:
    """Index and factor to SI for every column that is wanted."""
    columns = _columns(headers)
    names = [name for name, _ in columns]
    missing = [name for name in required if name not in names]
    if missing:
        raise InputError(
            f"{file}: columns",
            ", ".join(required),
            f"{', '.join(missing)} missing; the file has {', '.join(n for n in names if n) or 'none'}",
        )
    wanted = (
        [n for n in (*required, *optional) if n in names] if required or optional else [n for n in names if n]
    )
    out = {}
    for name in wanted:
        if names.count(name) > 1:
            raise InputError(f"{file}: columns", f"one column {name}", f"{names.count(name)} of them")
        index = names.index(name)
        out[name] = (index, si_factor(columns[index][1], expected_unit(name), f"{file}: column {name}"))
    return out


def _finish(
    file: Path,
    table: dict[str, FloatArray],
    selected: dict[str, tuple[int, float]],
    where: Callable[[int], str],
) -> dict[str, FloatArray]:
    for name, (_, factor) in selected.items():
        if factor != 1.0:
            table[name] = table[name] * factor
    time = table.get("t")
    if time is not None and np.isnan(time).any():
        lost = np.isnan(time)
        raise InputError(
            f"{file}: column t",
            "a time in every row",
            f"{int(lost.sum())} row(s) without one, the first in {where(int(np.argmax(lost)))}",
            "A gap is a row with a time and empty values, or no row at all",
        )
    return table


# ------------------------------------------------------------------------------------------ CSV


def _text(file: Path) -> str:
    data = file.read_bytes()
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = data.decode("utf-16")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            # What spreadsheet programs write for a degree sign.
            text = data.decode("cp1252", errors="replace")
    if "\0" in text[:4096]:
        raise InputError(str(file), "a text table (CSV)", "a binary file")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def _split_csv(file: Path, text: str) -> tuple[list[str], str, str, int]:
    """Header fields, delimiter, everything below the header, and the number of lines above that."""
    position, line = 0, 0
    commented = ""
    while position < len(text):
        end = text.find("\n", position)
        end = len(text) if end < 0 else end
        content = text[position:end].strip()
        line += 1
        if content.startswith("#"):
            commented = content.lstrip("#").strip()
        elif content:
            delimiter = next((d for d in (",", ";", "\t") if d in content), ",")
            fields = next(csv.reader([content], delimiter=delimiter))
            if not all(_is_number(field) for field in fields):
                return [field.strip() for field in fields], delimiter, text[end + 1 :], line
            # Numbers at once: the header may be the comment above them ("#t,px,py,...").
            named = next(csv.reader([commented], delimiter=delimiter), [])
            if len(named) == len(fields) and not all(_is_number(field) for field in named):
                return [field.strip() for field in named], delimiter, text[position:], line - 1
            raise InputError(
                f"{file}: header", "a first line with the names of the columns", repr(content[:80])
            )
        position = end + 1
    raise InputError(str(file), "a header line and rows of numbers", "an empty file")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _data_lines(body: str, delimiter: str, above: int) -> Iterator[tuple[int, list[str]]]:
    """Line number in the file (from 1) and fields of every line that is neither blank nor a comment."""
    for number, line in enumerate(body.split("\n"), start=above + 1):
        content = line.strip()
        if content and not content.startswith("#"):
            # The line as it is: with tabs, stripping would take away empty fields.
            yield number, next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))


def _read_csv(file: Path, required: tuple[str, ...], optional: tuple[str, ...]) -> dict[str, FloatArray]:
    text = _text(file)
    headers, delimiter, body, above = _split_csv(file, text)
    selected = _select(file, headers, required, optional)
    if not selected:
        raise InputError(f"{file}: columns", "named columns", "none")
    if not body.strip():
        raise InputError(str(file), "rows of numbers below the header", "a header only")
    values = _load_fast(body, delimiter, len(headers), [index for index, _ in selected.values()])
    if values is None:
        values = _load_thoroughly(file, body, delimiter, above, headers, selected)
    table = {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(selected)}

    def where(row: int) -> str:
        numbers = (number for number, _ in _data_lines(body, delimiter, above))
        return f"line {next(number for k, number in enumerate(numbers) if k == row)}"

    return _finish(file, table, selected, where)


def _load_fast(body: str, delimiter: str, width: int, indices: list[int]) -> FloatArray | None:
    """The columns by numpy's C parser; None when anything is out of the ordinary."""
    try:
        values = np.loadtxt(io.StringIO(body), delimiter=delimiter, comments=None, usecols=indices, ndmin=2)
    except ValueError:
        return None
    # A longer row would be read with its columns displaced; with `usecols` numpy does not mind.
    if body.count(delimiter) != values.shape[0] * (width - 1):
        return None
    return np.asarray(values, dtype=np.float64)


def _load_thoroughly(
    file: Path,
    body: str,
    delimiter: str,
    above: int,
    headers: Sequence[str],
    selected: dict[str, tuple[int, float]],
) -> FloatArray:
    """The same line by line: knows gaps, comments and quotes, and says where a mistake is."""
    rows: list[list[float]] = []
    for number, fields in _data_lines(body, delimiter, above):
        # A delimiter at the end of the line is harmless; anything else displaces columns.
        surplus = any(field.strip() for field in fields[len(headers) :])
        if len(fields) < len(headers) or surplus:
            raise InputError(
                f"{file}: line {number}", f"{len(headers)} fields like the header", f"{len(fields)} fields"
            )
        row = []
        for name, (index, _) in selected.items():
            cell = fields[index].strip()
            try:
                row.append(float(cell) if cell else np.nan)
            except ValueError:
                raise InputError(
                    f"{file}: line {number}, column {name}", "a number, nan or an empty field", repr(cell)
                ) from None
        rows.append(row)
    if not rows:
        raise InputError(str(file), "rows of numbers below the header", "a header only")
    return np.array(rows, dtype=np.float64)


# ------------------------------------------------------------------------------------------ NPZ, Parquet


def _open_npz(file: Path) -> np.lib.npyio.NpzFile:
    try:
        arrays = np.load(file, allow_pickle=False)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(str(file), "an .npz archive of numpy arrays", str(error)) from error
    if not isinstance(arrays, np.lib.npyio.NpzFile):
        raise InputError(str(file), "an .npz archive of named arrays", "a single array")
    return arrays


def _read_npz(file: Path, required: tuple[str, ...], optional: tuple[str, ...]) -> dict[str, FloatArray]:
    with _open_npz(file) as arrays:
        headers = list(arrays.files)
        selected = _select(file, headers, required, optional)
        table = {}
        for name, (index, _) in selected.items():
            try:
                table[name] = _numeric(file, name, arrays[headers[index]])
            except (ValueError, zipfile.BadZipFile) as error:
                if isinstance(error, InputError):
                    raise
                raise InputError(f"{file}: array {name}", "numbers, shape (n,)", str(error)) from error
    return _check_table(file, table, selected)


def _pyarrow(file: Path) -> Any:
    try:
        import pyarrow.parquet as parquet
    except ImportError as error:
        raise InputError(
            str(file),
            "pyarrow, which reads Parquet",
            "it is not installed",
            "pip install 'factorgrasp[data]'",
        ) from error
    return parquet


def _parquet_names(file: Path) -> list[str]:
    parquet = _pyarrow(file)
    try:
        return [str(name) for name in parquet.read_schema(file).names]
    except (OSError, ValueError) as error:
        raise InputError(str(file), "a Parquet file", str(error)) from error


def _read_parquet(file: Path, required: tuple[str, ...], optional: tuple[str, ...]) -> dict[str, FloatArray]:
    parquet = _pyarrow(file)
    headers = _parquet_names(file)
    selected = _select(file, headers, required, optional)
    data = parquet.read_table(file, columns=[headers[index] for index, _ in selected.values()])
    table = {}
    for name, (index, _) in selected.items():
        # Nulls of integer columns become NaN only through floating point.
        table[name] = _numeric(file, name, data.column(headers[index]).to_numpy())
    return _check_table(file, table, selected)


def _numeric(file: Path, name: str, values: npt.NDArray[Any]) -> FloatArray:
    if values.ndim != 1 or values.dtype.kind not in "fiub":
        raise InputError(
            f"{file}: array {name}", "numbers, shape (n,)", f"{values.dtype} of shape {values.shape}"
        )
    return np.array(values, dtype=np.float64)


def _check_table(
    file: Path, table: dict[str, FloatArray], selected: dict[str, tuple[int, float]]
) -> dict[str, FloatArray]:
    lengths = {name: values.size for name, values in table.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(
            f"{file}: arrays", "one length", ", ".join(f"{name}: {size}" for name, size in lengths.items())
        )
    if lengths and not any(lengths.values()):
        raise InputError(str(file), "rows of numbers", "columns without rows")
    return _finish(file, table, selected, lambda row: f"row {row} (counted from 0)")

"""Tables of numbers for a terminal, a page, a spreadsheet and a program, from one description of their columns.

A missing value stays missing in every form: a dash for people, an empty cell in CSV, null in JSON. It never becomes a zero.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.atomic import write_text
from factorgrasp.errors import InputError
from factorgrasp.typing import JsonDict

MISSING = "-"


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes
    ----------
    key : str
        Where its values stand in a row; also its name in CSV and JSON.
    header : str
        For people; the key when empty.
    unit : str
        Unit of what is shown, in brackets behind the header.
    format : str
        Format of a number for people, such as ``".3g"``.
    scale : float
        Factor from the stored number to the shown one, such as 1e3 from s to ms. CSV and JSON hold the stored number.
    """

    key: str
    header: str = ""
    unit: str = ""
    format: str = ".4g"
    scale: float = 1.0

    @property
    def title(self) -> str:
        """Header with its unit."""
        return (self.header or self.key) + (f" [{self.unit}]" if self.unit else "")

    def cell(self, value: Any) -> str:
        """What people read."""
        if is_missing(value):
            return MISSING
        if isinstance(value, bool | np.bool_):
            return "yes" if value else "no"
        if isinstance(value, int | np.integer) and self.scale == 1.0:
            return str(int(value))
        if isinstance(value, int | float | np.integer | np.floating):
            return format(float(value) * self.scale, self.format)
        return str(value)


@dataclass(frozen=True)
class Table:
    """Rows of values under described columns.

    Attributes
    ----------
    columns : tuple of Column
    rows : tuple of mapping
        Values by column key; a key that is absent counts as missing.
    title : str
    notes : tuple of str
        Lines under the table: conditions of the measurement and its limitations.
    """

    columns: tuple[Column, ...]
    rows: tuple[Mapping[str, Any], ...]
    title: str = ""
    notes: tuple[str, ...] = field(default=())

    def cells(self) -> list[list[str]]:
        """What people read, row by row."""
        return [[column.cell(row.get(column.key)) for column in self.columns] for row in self.rows]

    def text(self, width: int | None = None) -> str:
        """For a terminal, `width` characters wide; as wide as it needs when None."""
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table as RichTable

        table = RichTable(title=self.title or None, box=SIMPLE_HEAD, title_justify="left", pad_edge=False)
        for column, numeric in zip(self.columns, self._numeric(), strict=True):
            # Brackets of a unit would be taken for markup.
            table.add_column(
                column.title.replace("[", "\\["), justify="right" if numeric else "left", overflow="fold"
            )
        for cells in self.cells():
            table.add_row(*(cell.replace("[", "\\[") for cell in cells))
        stream = io.StringIO()
        console = Console(file=stream, width=width or 10_000, no_color=True, highlight=False)
        console.print(table)
        lines = [line.rstrip() for line in stream.getvalue().splitlines()]
        return "\n".join([*lines, *self.notes])

    def markdown(self) -> str:
        """As a table of GitHub's Markdown."""
        titles = [_escape(column.title) for column in self.columns]
        rule = ["---:" if numeric else "---" for numeric in self._numeric()]
        lines = [titles, rule, *([_escape(cell) for cell in cells] for cells in self.cells())]
        body = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        head = f"### {self.title}\n\n" if self.title else ""
        notes = "\n\n" + "\n".join(f"- {note}" for note in self.notes) if self.notes else ""
        return head + body + notes + "\n"

    def csv(self) -> str:
        """Comma-separated, full precision, the stored units; missing values are empty."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([column.key for column in self.columns])
        for row in self.rows:
            values = [plain(row.get(column.key)) for column in self.columns]
            writer.writerow(["" if value is None else value for value in values])
        return stream.getvalue()

    def to_dict(self) -> JsonDict:
        """Plain numbers and strings; missing values are None."""
        return {
            "title": self.title,
            "columns": [
                {"key": c.key, "header": c.header or c.key, "unit": c.unit, "scale": c.scale}
                for c in self.columns
            ],
            "rows": [
                {column.key: plain(row.get(column.key)) for column in self.columns} for row in self.rows
            ],
            "notes": list(self.notes),
        }

    def json(self) -> str:
        """As JSON text, see :meth:`to_dict`."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"

    def render(self, form: str, width: int | None = None) -> str:
        """In one of the forms "text", "markdown", "csv" and "json"."""
        if form == "text":
            return self.text(width) + "\n"
        if form in ("markdown", "csv", "json"):
            return str(getattr(self, form)())
        raise InputError("form of the table", "one of text, markdown, csv, json", repr(form))

    def write(self, path: str | Path) -> Path:
        """Write it atomically in the form that the suffix says (.txt, .md, .csv, .json); returns the path."""
        target = Path(path)
        form = {".txt": "text", ".md": "markdown", ".csv": "csv", ".json": "json"}.get(target.suffix.lower())
        if form is None:
            raise InputError("file of the table", "a name that ends in .txt, .md, .csv or .json", target.name)
        return write_text(target, self.render(form))

    def _numeric(self) -> list[bool]:
        """Whether a column holds numbers (and stands at the right)."""
        out = []
        for column in self.columns:
            values = [row.get(column.key) for row in self.rows if not is_missing(row.get(column.key))]
            numbers = [
                v
                for v in values
                if isinstance(v, int | float | np.number) and not isinstance(v, bool | np.bool_)
            ]
            out.append(bool(values) and len(numbers) == len(values))
        return out


def is_missing(value: Any) -> bool:
    """Whether a value counts as missing: None, NaN or an empty string."""
    if value is None or (isinstance(value, str) and value == ""):
        return True
    return isinstance(value, float | np.floating) and math.isnan(float(value))


def plain(value: Any) -> Any:
    """A value as JSON knows it: missing ones as None, infinite ones as the words "inf" and "-inf"."""
    if is_missing(value):
        return None
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        number = float(value)
        return number if math.isfinite(number) else ("inf" if number > 0 else "-inf")
    return value


def _escape(cell: str) -> str:
    return cell.replace("|", "\\|").replace("\n", " ")


def shifted_geometric_mean(values: Sequence[float], shift: float = 1e-3) -> float:
    """Geometric mean of ``value + shift``, less the shift: the mean of run times that no single one dominates.

    Parameters
    ----------
    values : sequence of float
        Seconds; none may be missing.
    shift : float
        Seconds. A millisecond, since our problems take milliseconds: the ten seconds that are usual elsewhere would hide them.
    """
    array = np.asarray(values, dtype=float)
    if array.size == 0:
        return math.nan
    return float(np.exp(np.mean(np.log(array + shift))) - shift)


def log10_summary(values: Sequence[float], floor: float = 1e-16) -> tuple[float, float]:
    """Median and maximum of ``log10(value)``, values below `floor` taken as `floor`; NaN without values.

    A geometric mean of residuals would be ruled by noise at 1e-15; the median and the worst are not.
    """
    array = np.asarray([v for v in values if not is_missing(v)], dtype=float)
    if array.size == 0:
        return math.nan, math.nan
    logs = np.log10(np.maximum(array, floor))
    return float(np.median(logs)), float(np.max(logs))

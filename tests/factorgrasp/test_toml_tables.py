from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import pytest

from factorgrasp.errors import InputError
from factorgrasp.toml_tables import check_keys, close_matches, convert, from_table, get, sub_table


@dataclass(frozen=True)
class _Example:
    density: float = 1.0
    count: int = 3
    switch: bool = True
    loss: Literal["none", "huber", "cauchy"] = "none"
    limit: float | None = None
    either: bool | float = False

    def __post_init__(self) -> None:
        if self.density < 0.0:
            raise InputError("example.density", "zero or more", repr(self.density))


def test_dataclass_from_table() -> None:
    made = from_table(_Example, {"density": 2, "limit": 0.5, "either": 0.25, "loss": "huber"}, "[noise]")
    assert made == _Example(density=2.0, limit=0.5, either=0.25, loss="huber")
    assert isinstance(made.density, float)


@pytest.mark.parametrize(
    ("table", "field", "expected"),
    [
        ({"density": "small"}, "[noise] density", "a finite number"),
        ({"density": True}, "[noise] density", "a finite number"),
        ({"density": float("nan")}, "[noise] density", "a finite number"),
        ({"density": float("inf")}, "[noise] density", "a finite number"),
        ({"count": 3.5}, "[noise] count", "a whole number"),
        ({"switch": 1}, "[noise] switch", "true or false"),
        ({"loss": "hubber"}, "[noise] loss", "one of 'none', 'huber', 'cauchy'"),
        ({"limit": False}, "[noise] limit", "a finite number"),
        ({"either": "yes"}, "[noise] either", "true or false or a finite number"),
        ({"density": -1.0}, "[noise] density", "zero or more"),
    ],
)
def test_wrong_values_name_key_and_type(table: dict[str, Any], field: str, expected: str) -> None:
    with pytest.raises(InputError) as raised:
        from_table(_Example, table, "[noise]")
    assert raised.value.field == field
    assert raised.value.expected == expected


def test_unknown_key_names_the_close_one() -> None:
    with pytest.raises(InputError, match=r"\[noise\] densty: .*Did you mean density\?"):
        from_table(_Example, {"densty": 1.0}, "[noise]")
    with pytest.raises(InputError, match=r"Known: density, count"):
        from_table(_Example, {"zzz": 1.0}, "[noise]")


def test_skipped_fields_are_unknown_in_a_file() -> None:
    with pytest.raises(InputError, match="an unknown one"):
        from_table(_Example, {"count": 4}, "[noise]", skip=("count",))
    assert from_table(_Example, {}, "[noise]", skip=("count",), count=4).count == 4


def test_tuples_are_arrays_of_numbers() -> None:
    kind = tuple[float, float, float]
    assert convert([0, 1, 2.5], kind, "gravity") == (0.0, 1.0, 2.5)
    for wrong in ([0, 1], [0, 1, "2"], [0, 1, True], 3, "0,1,2", [[0, 1, 2]]):
        with pytest.raises(InputError, match="gravity: expected an array of 3 numbers"):
            convert(wrong, kind, "gravity")
    assert convert([1, 2, 3, 4], tuple[float, ...], "weights") == (1.0, 2.0, 3.0, 4.0)


def test_required_and_absent_keys() -> None:
    assert get({}, "gap", float, "[robot]", 0.5) == 0.5
    with pytest.raises(InputError, match=r"\[robot\] file: expected a string; found no such key"):
        get({}, "file", str, "[robot]")
    assert sub_table({}, "noise") == {}
    with pytest.raises(InputError, match=r"\[robot\]: expected a table of this name; found none"):
        sub_table({}, "robot", required=True)
    with pytest.raises(InputError, match=r"\[robot\]: expected a table; found the string 'robot.csv'"):
        sub_table({"robot": "robot.csv"}, "robot")


def test_close_matches_ignore_case() -> None:
    assert close_matches("Kind", ["kind", "title"]) == "Did you mean kind?"
    check_keys({"kind": 1}, ("kind",), "")

"""Tables of a TOML file as typed values, with errors that name the key, what was expected and what was found."""

from __future__ import annotations

import difflib
import math
import types
from collections.abc import Collection, Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from factorgrasp.errors import InputError

T = TypeVar("T")


def close_matches(name: str, known: Iterable[str]) -> str:
    """A hint that names what was probably meant, or everything that is known."""
    names = list(known)
    lower = {candidate.lower(): candidate for candidate in names}
    close = difflib.get_close_matches(name.lower(), lower, n=3, cutoff=0.6)
    if close:
        return "Did you mean " + " or ".join(lower[candidate] for candidate in close) + "?"
    return "Known: " + ", ".join(names)


def check_keys(table: Mapping[str, Any], known: Collection[str], where: str) -> None:
    """Raise InputError at the first key of `table` that is not in `known`."""
    for key in table:
        if key not in known:
            raise InputError(place(where, key), "a known key", "an unknown one", close_matches(key, known))


def sub_table(table: Mapping[str, Any], key: str, required: bool = False) -> Mapping[str, Any]:
    """The table ``[key]``; empty when it is absent and not required."""
    if key not in table:
        if required:
            raise InputError(f"[{key}]", "a table of this name", "none")
        return {}
    value = table[key]
    if not isinstance(value, Mapping):
        raise InputError(f"[{key}]", "a table", describe(value))
    return value


def get(table: Mapping[str, Any], key: str, annotation: Any, where: str, default: Any = MISSING) -> Any:
    """Value of `key` as the type `annotation`; `default` when it is absent, an error when there is no default."""
    if key not in table:
        if default is MISSING:
            raise InputError(place(where, key), type_words(annotation), "no such key")
        return default
    return convert(table[key], annotation, place(where, key))


def from_table(
    cls: type[T], table: Mapping[str, Any], where: str, skip: Collection[str] = (), **extra: Any
) -> T:
    """A dataclass whose fields are the keys of a table; absent keys keep the defaults of the class.

    Parameters
    ----------
    cls : type
        A dataclass.
    table : mapping
    where : str
        The table as the user writes it, such as ``[noise]``.
    skip : collection of str
        Fields that do not belong into a file.
    **extra
        Values of fields that the caller has already worked out from other keys.
    """
    assert is_dataclass(cls)
    hints = get_type_hints(cls)
    known = [field.name for field in fields(cls) if field.init and field.name not in skip]
    check_keys(table, known, where)
    values = {key: convert(value, hints[key], place(where, key)) for key, value in table.items()}
    try:
        return cls(**values, **extra)
    except InputError as error:
        # The class names its field its own way ("noise.gyro_density"), the file has tables.
        key = error.field.rpartition(".")[2]
        raise InputError(place(where, key), error.expected, error.found, error.hint) from error


def place(where: str, key: str) -> str:
    """How a key is named to the user: ``[noise] gyro_density``."""
    return f"{where} {key}".strip()


def convert(value: Any, annotation: Any, field: str) -> Any:
    """`value` from a TOML file as the type `annotation`, or an InputError for `field`.

    Known are bool, int, float, str, Literal, None, unions of them, and tuples of them from arrays.
    """
    options = _alternatives(annotation)
    for option in options:
        found, converted = _as(value, option)
        if found:
            return converted
    hint = ""
    words = [word for option in options if get_origin(option) is Literal for word in get_args(option)]
    if isinstance(value, str) and words:
        hint = close_matches(value, map(str, words)) if len(words) > 4 else ""
    raise InputError(field, type_words(annotation), describe(value), hint)


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    if get_origin(annotation) in (Union, types.UnionType):
        return get_args(annotation)
    return (annotation,)


def _as(value: Any, kind: Any) -> tuple[bool, Any]:
    """Whether `value` is of the `kind`, and the value in it."""
    origin = get_origin(kind)
    if origin is Literal:
        # True == 1 in Python; a switch is no number here.
        return any(value == word and type(value) is type(word) for word in get_args(kind)), value
    if origin is tuple:
        return _as_tuple(value, get_args(kind))
    if kind is float:
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        return number, float(value) if number else value
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool), value
    if kind in (bool, str):
        return isinstance(value, kind), value
    return False, value


def _as_tuple(value: Any, kinds: tuple[Any, ...]) -> tuple[bool, Any]:
    if not isinstance(value, list):
        return False, value
    if len(kinds) == 2 and kinds[1] is ...:
        kinds = (kinds[0],) * len(value)
    if len(value) != len(kinds):
        return False, value
    parts = [_as(part, kind) for part, kind in zip(value, kinds, strict=True)]
    return all(found for found, _ in parts), tuple(converted for _, converted in parts)


_WORDS = {float: "a finite number", int: "a whole number", bool: "true or false", str: "a string"}


def type_words(annotation: Any) -> str:
    """What a type is called in an error message."""
    parts = []
    for option in _alternatives(annotation):
        if option is type(None):
            continue
        if get_origin(option) is Literal:
            parts.append("one of " + ", ".join(map(repr, get_args(option))))
        elif get_origin(option) is tuple:
            kinds = get_args(option)
            count = "an array of numbers" if ... in kinds else f"an array of {len(kinds)} numbers"
            parts.append(count)
        else:
            parts.append(_WORDS.get(option, getattr(option, "__name__", str(option))))
    return " or ".join(parts)


def describe(value: Any) -> str:
    """A value of a TOML file as an error message shows it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list):
        return (
            f"an array of {len(value)}: {value!r}" if len(value) < 8 else f"an array of {len(value)} values"
        )
    if isinstance(value, str):
        return f"the string {value!r}"
    return repr(value)

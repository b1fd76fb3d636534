"""Values of an experiment file: their types, units and ranges.

They are checked where the file is read, before the methods are loaded: this module
does not import JAX.
"""

import difflib
import json
import math
import types
import typing
from collections.abc import Iterable, Sequence
from operator import ge, gt, le, lt
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from jaxid.errors import InputError
from jaxid.units import Unit, unit

MAX_NUMBER = 1e12
"""Largest number of a key, infinity apart, in any unit."""


class Bounds(NamedTuple):
    """Range of a number in `Annotated[float, Bounds(above=0.0)]`; None for no bound."""

    above: float | None = None  # exclusive lower bound
    minimum: float | None = None  # inclusive lower bound
    maximum: float | None = None  # inclusive upper bound
    below: float | None = None  # exclusive upper bound


Positive = Annotated[float, Bounds(above=0.0)]
Magnitude = Annotated[float, Bounds(minimum=0.0)]
Fraction = Annotated[float, Bounds(above=0.0, below=1.0)]
Finite = Annotated[float, Bounds()]
Count = Annotated[int, Bounds(minimum=1, maximum=10_000)]
Vector = tuple[Finite, Finite, Finite]
Corner = tuple[float, float, float]
Times = tuple[float, float]
PerJoint = list[float]
Positives = Positive | list[Positive]
Column = str | int | list[str | int]
Units = Unit | float | list[Unit | float]
TomlTable = dict[str, Any]
"""Table of a TOML file, or arguments that are made of one."""


def check_names(
    table: TomlTable, known_names: Iterable[str], place: str = "the file"
) -> None:
    """Reject a key of a table, or a table of the file, that is not known."""
    known_names = list(known_names)
    for name in table:
        if name in known_names:
            continue
        is_file = place == "the file"
        path = name if is_file else f"{place}.{name}"
        similar_names = difflib.get_close_matches(name, known_names, n=1, cutoff=0.6)
        if similar_names:
            raise InputError(
                f"`{path}` is not a known key: did you mean `{similar_names[0]}`?"
            )
        owner = place if is_file else f"the table `[{place}]`"
        raise InputError(
            f"`{path}` is not a known key: {owner} has {', '.join(known_names)}."
        )


def decode_table(table: TomlTable, hints: TomlTable, place: str) -> TomlTable:
    """Return the values of a table's keys, all of which are declared."""
    check_names(table, hints, place)
    return {
        name: decode_value(value, hints[name], f"{place}.{name}")
        for name, value in table.items()
    }


_MISMATCH = object()
"""Result for a value that a declared type is not meant for."""


def decode_value(value: Any, hint: Any, place: str) -> Any:
    """Return a value of the file as its declaration asks.

    Args:
        value: Value as TOML has it.
        hint: A type; a tuple of several; a dict of keys for a table, in a list for a
            list of tables.
        place: Table and key, for messages.
    """
    options = _options(hint)
    for option in options:
        result = _convert(value, option, place)
        if result is not _MISMATCH:
            return result
    words = dict.fromkeys(_describe(option) for option in options)
    text = "a table"
    if not isinstance(value, dict):
        text = json.dumps(value, ensure_ascii=False, default=str)
    raise InputError(f"`{place}` must be {' or '.join(words)}, but is {text}.")


def _options(hint: Any) -> tuple[Any, ...]:
    """Return the types that a value may have."""
    if isinstance(hint, tuple):
        return hint
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return typing.get_args(hint)
    return (hint,)


_SCALARS: dict[Any, tuple[Any, str]] = {
    bool: (bool, "true or false"),
    int: (int, "a whole number"),
    float: ((float, int), "a number"),
    str: (str, "a text in quotes"),
    Unit: (str, "a text in quotes"),
}
"""Types of scalars: those of TOML that become one, and words for them."""


def _convert(value: Any, option: Any, place: str) -> Any:
    """Return a value as a type asks, or `_MISMATCH` if it is of another kind."""
    origin = typing.get_origin(option)
    arguments = typing.get_args(option)
    if isinstance(option, dict):
        if not isinstance(value, dict):
            return _MISMATCH
        return decode_table(value, option, place)
    if isinstance(option, list):
        if not isinstance(value, list):
            return _MISMATCH
        return _convert_list(value, option * len(value), place)
    if origin is Annotated:
        kind, bounds = arguments
        result = _convert(value, kind, place)
        if result is not _MISMATCH:
            _require_in_range(result, bounds, place)
        return result
    if origin is Literal:
        return value if value in arguments else _MISMATCH
    if origin is dict:
        if not isinstance(value, dict):
            return _MISMATCH
        _, hint = arguments
        return {k: decode_value(x, hint, f"{place}.{k}") for k, x in value.items()}
    if origin in (list, tuple):
        if not isinstance(value, list):
            return _MISMATCH
        is_repeated = origin is list or arguments[-1] is Ellipsis
        hints = arguments[:1] * len(value) if is_repeated else arguments
        return origin(_convert_list(value, hints, place))
    if option is np.ndarray:
        return _convert_array(value, place)
    return _convert_scalar(value, option, place)


def _require_in_range(value: float, bounds: Bounds, place: str) -> None:
    """Reject a number out of its range, NaN and infinity."""
    if not math.isfinite(value):
        raise InputError(f"`{place}` must be finite, but is {value}.")
    comparisons = {"above": gt, "at least": ge, "at most": le, "below": lt}
    for bound, (words, comparison) in zip(bounds, comparisons.items(), strict=True):
        if bound is not None and not comparison(value, bound):
            raise InputError(f"`{place}` must be {words} {bound:.10g}, but is {value}.")


def _convert_list(values: list[Any], hints: Sequence[Any], place: str) -> list[Any]:
    """Return the values of a list, each by its own type."""
    if len(hints) != len(values):
        raise InputError(
            f"`{place}` must hold {len(hints)} values, but holds {len(values)}."
        )
    results = []
    for number, hint in enumerate(hints):
        results.append(decode_value(values[number], hint, f"{place}[{number}]"))
    return results


def _convert_array(value: Any, place: str) -> Any:
    """Return numbers as an array."""
    if isinstance(value, str | dict):
        return _MISMATCH
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"`{place}` must hold numbers, in rows of equal length."
        ) from error
    finite_numbers = array[np.isfinite(array)]
    if (np.abs(finite_numbers) > MAX_NUMBER).any():
        raise InputError(f"`{place}`: no quantity is larger than {MAX_NUMBER:g}.")
    return array


def _convert_scalar(value: Any, kind: Any, place: str) -> Any:
    """Return one number, text, unit or truth value."""
    toml_kinds, _ = _SCALARS[kind]
    # In Python, but not in TOML, a truth value is a whole number.
    if not isinstance(value, toml_kinds) or isinstance(value, bool) != (kind is bool):
        return _MISMATCH
    if kind in (int, float) and math.isfinite(value) and abs(value) > MAX_NUMBER:
        raise InputError(
            f"`{place}` is {value:g}: no quantity is larger than {MAX_NUMBER:g}."
        )
    if isinstance(value, str) and not value.isprintable():
        raise InputError(f"`{place}` holds a control character, {value!a}: remove it.")
    return unit(value) if kind is Unit else kind(value)


def _describe(option: Any) -> str:
    """Return a type in words, for messages."""
    origin = typing.get_origin(option)
    arguments = typing.get_args(option)
    if origin is Annotated:
        return _describe(arguments[0])
    if origin is Literal:
        return quoted(arguments)
    if origin in (list, tuple) or isinstance(option, list):
        return "a list"
    if origin is dict or isinstance(option, dict):
        return "a table"
    if option is np.ndarray:
        return "a number or a list"
    _, words = _SCALARS[option]
    return words


def quoted(values: Iterable[Any]) -> str:
    """Return values as a sentence lists them: `"a", "b" or "c"`."""
    words = [f'"{v}"' if isinstance(v, str) else str(v) for v in values]
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))

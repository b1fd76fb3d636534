"""Decoding of TOML tables: a table calls a function with its keys as arguments.

Names, types and defaults of the keys are those of the arguments, and the function's
docstring describes them: `keys_of` gives all of it, also for the template that `jaxid
init` prints. The function may be a class of the package. Of other functions, arguments
before the `*` come from elsewhere and are no keys.
"""

import inspect
import json
import math
import re
import typing
from collections.abc import Callable, Iterable, Sequence
from operator import ge, gt, le, lt
from typing import Annotated, Any, Literal, NamedTuple

import jaxtyping
import numpy as np

from jaxid.errors import InputError
from jaxid.experiment_file import TomlTable, check_names, within
from jaxid.io import union_members
from jaxid.units import Unit, unit
from jaxid.workflow.allowed_values import Bounds, OneOf

MAX_NUMBER = 1e12
"""Largest number of a key, infinity apart, in any unit."""


class Key(NamedTuple):
    """A key of a table."""

    name: str  # name in the file
    hint: Any  # annotation of the argument
    default: Any  # default value; `inspect.Parameter.empty` if the key is needed
    text: str  # description, from the docstring


def keys_of(function: Callable) -> dict[str, Key]:
    """Return the keys of a table that calls a function or class."""
    texts = descriptions(function)
    # Converters widen the annotations of arguments; those of the fields say what is
    # meant.
    hints = typing.get_type_hints(function, include_extras=True)
    keys = {}
    for argument in inspect.signature(function, eval_str=True).parameters.values():
        name = argument.name
        if isinstance(function, type) or argument.kind is argument.KEYWORD_ONLY:
            hint = hints.get(name, argument.annotation)
            keys[name] = Key(name, hint, argument.default, texts.get(name, ""))
    return keys


def descriptions(function: Callable) -> dict[str, str]:
    """Return the descriptions of arguments or attributes in a docstring, by name."""
    text = inspect.getdoc(function) or ""
    sections = re.findall(
        r"^(?:Args|Attributes):\n((?:    .*\n?|\n)+)", text, flags=re.M
    )
    entries = re.findall(
        r"^    (\w+): ((?:.*\n?)(?:        .*\n?)*)", "\n".join(sections), re.M
    )
    return {name: " ".join(words.split()) for name, words in entries}


def call(function: Callable, table: Any, place: str, *context: Any) -> Any:
    """Call a function with the keys of a table as arguments."""
    (arguments,) = decode([function], table, place)
    with within(place):
        return function(*context, **arguments)


def decode(
    functions: Sequence[Callable],
    table: Any,
    place: str,
    *,
    complete: bool = True,
    skip: Iterable[str] = (),
) -> list[TomlTable]:
    """Return a table's arguments for each of several functions that share it.

    Arguments in `skip` are no keys; keys without default are needed where the table is
    `complete`.
    """
    keys: dict[str, Key] = {}
    for function in functions:
        keys |= keys_of(function)
    for name in skip:
        keys.pop(name, None)
    check_names(table, list(keys), place)
    if complete:
        _require_keys(keys, table, place)
    values = {
        name: decode_value(value, keys[name].hint, f"{place}.{name}")
        for name, value in table.items()
    }
    groups = []
    for function in functions:
        names = keys_of(function).keys() & values.keys()
        groups.append({name: values[name] for name in names})
    return groups


def _require_keys(keys: dict[str, Key], table: TomlTable, place: str) -> None:
    """Reject a table that lacks a key without default."""
    for name, key in keys.items():
        if key.default is inspect.Parameter.empty and name not in table:
            table_name = re.sub(r"\[\d+\]", "", place)
            raise InputError(f"`{place}.{name}` is missing: `[{table_name}]` needs it.")


_MISMATCH = object()
"""Result for a value that an annotation is not meant for."""


def decode_value(value: Any, hint: Any, place: str) -> Any:
    """Return a value of the file as an argument with such an annotation."""
    options = [x for x in union_members(hint) if x is not type(None)]
    for option in options:
        result = _convert(value, option, place)
        if result is not _MISMATCH:
            return result
    words = dict.fromkeys(_describe(option) for option in options)
    text = "a table"
    if not isinstance(value, dict):
        text = json.dumps(value, ensure_ascii=False, default=str)
    raise InputError(f"`{place}` must be {' or '.join(words)}, but is {text}.")


_SCALARS: dict[Any, tuple[Any, str]] = {
    bool: (bool, "true or false"),
    int: (int, "a whole number"),
    float: ((float, int), "a number"),
    str: (str, "a text in quotes"),
    Unit: (str, "a text in quotes"),
}
"""Types of scalars: those of TOML that become one, and words for them."""


def _convert(value: Any, option: Any, place: str) -> Any:
    """Return a value as an annotation asks, or `_MISMATCH` if it is of another kind."""
    origin = typing.get_origin(option)
    arguments = typing.get_args(option)
    function = table_of(option)
    if function is not None:
        return call(function, value, place) if isinstance(value, dict) else _MISMATCH
    if origin is Annotated:
        kind, rule = arguments
        result = _convert(value, kind, place)
        if result is not _MISMATCH:
            _require_allowed(result, rule, place)
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
    if option in _SCALARS:
        return _convert_scalar(value, option, place)
    return _convert_array(value, place)


def _require_allowed(value: Any, rule: Bounds | OneOf, place: str) -> None:
    """Reject an unknown name, or a number out of its range."""
    if isinstance(rule, Bounds):
        _require_in_range(value, rule, place)
    elif value not in rule.names:
        text = json.dumps(value, ensure_ascii=False)
        raise InputError(f"`{place}` must be {quoted(rule.names)}, but is {text}.")


def _require_in_range(value: float, bounds: Bounds, place: str) -> None:
    """Reject a number out of its range, NaN and infinity."""
    if not math.isfinite(value):
        raise InputError(f"`{place}` must be finite, but is {value}.")
    comparisons = {"above": gt, "at least": ge, "at most": le, "below": lt}
    for bound, (words, comparison) in zip(bounds, comparisons.items(), strict=True):
        if bound is not None and not comparison(value, bound):
            raise InputError(f"`{place}` must be {words} {bound:.10g}, but is {value}.")


def _convert_list(values: list[Any], hints: Sequence[Any], place: str) -> list[Any]:
    """Return the values of a list, each by its own annotation."""
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


def table_of(option: Any) -> Callable | None:
    """Return a table's function: a class, or that of `Annotated[Result, function]`."""
    if typing.get_origin(option) is Annotated:
        return next((x for x in typing.get_args(option)[1:] if callable(x)), None)
    is_class = isinstance(option, type) and typing.get_origin(option) is None
    is_table = is_class and option not in _SCALARS and not _is_array(option)
    return option if is_table else None


def _is_array(option: Any) -> bool:
    return isinstance(option, type) and issubclass(option, jaxtyping.AbstractArray)


def _describe(option: Any) -> str:
    """Return an annotation in words, for messages."""
    origin = typing.get_origin(option)
    arguments = typing.get_args(option)
    if origin is Annotated and not table_of(option):
        kind, rule = arguments
        if isinstance(rule, OneOf):
            return quoted(rule.names)
        return _describe(kind)
    if origin is Literal:
        return quoted(arguments)
    if origin in (list, tuple):
        return "a list"
    if _is_array(option):
        return "a number or a list"
    _, words = _SCALARS.get(option, (None, "a table"))
    return words


def quoted(values: Iterable[Any]) -> str:
    """Return values as a sentence lists them: `"a", "b" or "c"`."""
    words = [f'"{v}"' if isinstance(v, str) else str(v) for v in values]
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))

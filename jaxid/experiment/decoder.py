"""Decoding of TOML tables: a table calls a function with its keys as arguments.

`experiment_file.py` declares the values of the keys and has checked them. Names and
defaults of the keys are those of the arguments. The function may be a class of the
package. Of other functions, arguments before the `*` come from elsewhere and are no
keys.
"""

import dataclasses
import inspect
import re
import typing
from collections.abc import Callable, Sequence
from typing import Annotated, Any

from jaxid.errors import InputError
from jaxid.experiment_file import within
from jaxid.experiment_values import TomlTable, check_names
from jaxid.io import union_members
from jaxid.units import Unit

Keys = dict[str, inspect.Parameter]
"""Keys of a table by their names, with their annotations and defaults."""


def keys_of(function: Callable) -> Keys:
    """Return the keys of a table that calls a function or class."""
    # Converters widen the annotations of arguments; those of the fields say what is
    # meant.
    hints = typing.get_type_hints(function, include_extras=True)
    keys = {}
    for argument in inspect.signature(function, eval_str=True).parameters.values():
        name = argument.name
        if isinstance(function, type) or argument.kind is argument.KEYWORD_ONLY:
            hint = hints.get(name, argument.annotation)
            keys[name] = argument.replace(annotation=hint)
    return keys


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
) -> list[TomlTable]:
    """Return a table's arguments for each of several functions that share it.

    Keys without default are needed where the table is `complete`.
    """
    keys: Keys = {}
    for function in functions:
        keys |= keys_of(function)
    check_names(table, list(keys), place)
    if complete:
        _require_keys(keys, table, place)
    values = {
        name: _build_inner(value, keys[name].annotation, f"{place}.{name}")
        for name, value in table.items()
    }
    groups = []
    for function in functions:
        names = keys_of(function).keys() & values.keys()
        groups.append({name: values[name] for name in names})
    return groups


def _require_keys(keys: Keys, table: TomlTable, place: str) -> None:
    """Reject a table that lacks a key without default."""
    for name, key in keys.items():
        if key.default is key.empty and name not in table:
            table_name = re.sub(r"\[\d+\]", "", place)
            raise InputError(f"`{place}.{name}` is missing: `[{table_name}]` needs it.")


def _build_inner(value: Any, hint: Any, place: str) -> Any:
    """Return a value, or what the function of an inner table makes of it."""
    for option in union_members(hint):
        function = table_of(option)
        if isinstance(value, dict) and function is not None:
            return call(function, value, place)
        if isinstance(value, list) and typing.get_origin(option) is tuple:
            function = table_of(typing.get_args(option)[0])
            if function is not None:
                places = [f"{place}[{i}]" for i in range(len(value))]
                return tuple(map(call, [function] * len(value), value, places))
    return value


def table_of(option: Any) -> Callable | None:
    """Return a table's function: a class, or that of `Annotated[Result, function]`."""
    if typing.get_origin(option) is Annotated:
        return next((x for x in typing.get_args(option)[1:] if callable(x)), None)
    is_table = dataclasses.is_dataclass(option) and option is not Unit
    return option if is_table and isinstance(option, type) else None

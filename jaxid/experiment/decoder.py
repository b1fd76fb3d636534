"""Decoding of TOML tables: a table calls a function, and its keys are the function's arguments.

Names, types and defaults of the keys are those of the arguments, and the function's
docstring describes them: `keys_of` gives all of it, also for the template that `jaxid
init` prints. The function may be a class of the package. Of other functions, arguments
before the `*` come from elsewhere and are no keys.
"""

import dataclasses
import difflib
import inspect
import json
import math
import re
import typing
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from operator import ge, gt, le, lt
from typing import Annotated, Any, Literal, NamedTuple

import jaxtyping
import numpy as np

from jaxid.errors import InputError
from jaxid.io import union_members
from jaxid.units import Unit, unit

LARGEST = 1e12
"""Largest number of a key, infinity apart, in any unit."""
RENAMED = {"rows.slow": "min_speed", "rows.every": "step", "collision.ground": "floor"}
"""Old keys and their new names."""


class Bounds(NamedTuple):
    """Range of a number, given as `Annotated[float, Bounds(above=0.0)]`; None for no bound."""

    above: float | None = None  # exclusive lower bound
    least: float | None = None  # inclusive lower bound
    most: float | None = None  # inclusive upper bound
    below: float | None = None  # exclusive upper bound

    def check(self, value: float | int, place: str) -> None:
        """Reject a number out of the range, NaN and infinity."""
        if not math.isfinite(value):
            raise InputError(f"`{place}` must be finite, but is {value}.")
        rules = (("above", gt), ("at least", ge), ("at most", le), ("below", lt))
        for bound, (words, holds) in zip(self, rules, strict=True):
            if bound is not None and not holds(value, bound):
                raise InputError(
                    f"`{place}` must be {words} {bound:.10g}, but is {value}."
                )


@dataclasses.dataclass(frozen=True, eq=False)
class OneOf:
    """Names that a text may have, given as `Annotated[str, OneOf(CRITERIA)]`."""

    names: Collection[str]

    def check(self, value: str, place: str) -> None:
        """Reject a text that is none of the names."""
        if value not in self.names:
            shown = json.dumps(value, ensure_ascii=False)
            raise InputError(f"`{place}` must be {quoted(self.names)}, but is {shown}.")


Positive = Annotated[float, Bounds(above=0.0)]
Magnitude = Annotated[float, Bounds(least=0.0)]
Fraction = Annotated[float, Bounds(above=0.0, below=1.0)]
Finite = Annotated[float, Bounds()]
Count = Annotated[int, Bounds(least=1, most=10_000)]
Vector = tuple[Finite, Finite, Finite]
PerJoint = list[float]


class Key(NamedTuple):
    """A key of a table."""

    name: str  # name in the file
    hint: Any  # annotation of the argument
    default: Any  # default value; `inspect.Parameter.empty` if the key is needed
    text: str  # description, from the docstring


def keys_of(function: Callable) -> dict[str, Key]:
    """Return the keys of a table that calls a function or class."""
    sections = re.findall(
        r"^(?:Args|Attributes):\n((?:    .*\n?|\n)+)",
        inspect.getdoc(function) or "",
        flags=re.M,
    )
    entries = re.findall(
        r"^    (\w+): ((?:.*\n?)(?:        .*\n?)*)", "\n".join(sections), re.M
    )
    texts = {name: " ".join(text.split()) for name, text in entries}
    parameters = inspect.signature(function, eval_str=True).parameters.values()
    kept = (
        p for p in parameters if isinstance(function, type) or p.kind is p.KEYWORD_ONLY
    )
    # Converters widen the annotations of arguments; those of the fields say what is
    # meant.
    fields = typing.get_type_hints(function, include_extras=True)
    return {
        p.name: Key(
            p.name, fields.get(p.name, p.annotation), p.default, texts.get(p.name, "")
        )
        for p in kept
    }


def call(function: Callable, table: Any, place: str, *context: Any) -> Any:
    """Call a function with the keys of a table as arguments."""
    (arguments,) = decode([function], table, place)
    with within(place):
        return function(*context, **arguments)


@contextmanager
def within(place: str, file: str = "") -> Iterator[None]:
    """Name a table, and the file if it is not named further above, in errors of deeper layers."""
    try:
        yield
    except (InputError, FileNotFoundError) as error:
        raise InputError(f"{file}{': ' if file else ''}`{place}`: {error}") from error


def decode(
    functions: Sequence[Callable],
    table: Any,
    place: str,
    *,
    complete: bool = True,
    skip: Iterable[str] = (),
) -> list[dict[str, Any]]:
    """Return the arguments that a table holds for each of several functions that share it.

    Arguments in `skip` are no keys; keys without default are needed where the table is
    `complete`.
    """
    groups = [{k: v for k, v in keys_of(f).items() if k not in skip} for f in functions]
    known = {name: key for keys in groups for name, key in keys.items()}
    check_names(table, list(known), place)
    needed = (n for n, key in known.items() if key.default is inspect.Parameter.empty)
    missing = next((name for name in needed if name not in table), None)
    if missing and complete:
        table_name = re.sub(r"\[\d+\]", "", place)
        raise InputError(f"`{place}.{missing}` is missing: `[{table_name}]` needs it.")
    values = {
        n: decode_value(v, known[n].hint, f"{place}.{n}") for n, v in table.items()
    }
    return [{n: values[n] for n in keys if n in values} for keys in groups]


def check_names(
    table: dict[str, Any], known: list[str], place: str = "the file"
) -> None:
    """Reject a key of a table, or a table of the file, that is not known."""
    name = next((name for name in table if name not in known), None)
    if name is None:
        return
    full = name if place == "the file" else f"{place}.{name}"
    if full in RENAMED:
        raise InputError(f"`{full}` was renamed to `{RENAMED[full]}`.")
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if near:
        raise InputError(f"`{full}` is no known key: did you mean `{near[0]}`?")
    where = place if full == name else f"the table `[{place}]`"
    raise InputError(f"`{full}` is no known key: {where} has {', '.join(known)}.")


_OTHER = object()
"""Result for a value that an annotation is not meant for."""


def decode_value(value: Any, hint: Any, place: str) -> Any:
    """Return a value of the file as an argument with such an annotation."""
    options = [o for o in union_members(hint) if o is not type(None)]
    for option in options:
        made = _convert(value, option, place)
        if made is not _OTHER:
            return made
    words = dict.fromkeys(_describe(option) for option in options)
    shown = json.dumps(value, ensure_ascii=False, default=str)
    came = "a table" if isinstance(value, dict) else shown
    raise InputError(f"`{place}` must be {' or '.join(words)}, but is {came}.")


_SCALARS: dict[Any, tuple[Any, str]] = {
    bool: (bool, "true or false"),
    int: (int, "a whole number"),
    float: ((float, int), "a number"),
    str: (str, "a text in quotes"),
    Unit: (str, "a text in quotes"),
}
"""Types of scalars: those of TOML that become one, and words for them."""


def _convert(value: Any, option: Any, place: str) -> Any:
    """Return a value as an annotation asks for it, or `_OTHER` if it is of another kind."""
    origin, arguments = typing.get_origin(option), typing.get_args(option)
    if function := table_of(option):
        return call(function, value, place) if isinstance(value, dict) else _OTHER
    if origin is Annotated:
        made = _convert(value, arguments[0], place)
        if made is not _OTHER:
            arguments[1].check(made, place)
        return made
    if origin is Literal:
        return value if value in arguments else _OTHER
    if origin in (list, tuple):
        if not isinstance(value, list):
            return _OTHER
        repeated = origin is list or arguments[-1] is Ellipsis
        hints = arguments[:1] * len(value) if repeated else arguments
        if len(hints) != len(value):
            raise InputError(
                f"`{place}` must hold {len(hints)} values, but holds {len(value)}."
            )
        pairs = enumerate(zip(value, hints, strict=True))
        return origin(decode_value(x, hint, f"{place}[{k}]") for k, (x, hint) in pairs)
    if origin is dict:
        if not isinstance(value, dict):
            return _OTHER
        return {
            k: decode_value(x, arguments[1], f"{place}.{k}") for k, x in value.items()
        }
    if option not in _SCALARS:
        if isinstance(value, str | dict):
            return _OTHER
        try:
            made = np.array(value, np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"`{place}` must hold numbers, in rows of equal length."
            ) from error
        if (np.abs(made[np.isfinite(made)]) > LARGEST).any():
            raise InputError(f"`{place}`: no quantity is larger than {LARGEST:g}.")
        return made
    if not isinstance(value, _SCALARS[option][0]) or isinstance(value, bool) != (
        option is bool
    ):
        return _OTHER
    if option in (int, float) and math.isfinite(value) and abs(value) > LARGEST:
        raise InputError(
            f"`{place}` is {value:g}: no quantity is larger than {LARGEST:g}."
        )
    if isinstance(value, str) and not value.isprintable():
        raise InputError(f"`{place}` holds a control character, {value!a}: remove it.")
    return unit(value) if option is Unit else option(value)


def table_of(option: Any) -> Callable | None:
    """Return the function of a table: a class, or that of `Annotated[Result, function]`."""
    if typing.get_origin(option) is Annotated:
        return next((x for x in typing.get_args(option)[1:] if callable(x)), None)
    plain = isinstance(option, type) and typing.get_origin(option) is None
    return None if not plain or option in _SCALARS or _is_array(option) else option


def _is_array(option: Any) -> bool:
    return isinstance(option, type) and issubclass(option, jaxtyping.AbstractArray)


def _describe(option: Any) -> str:
    origin, arguments = typing.get_origin(option), typing.get_args(option)
    if origin is Annotated and not table_of(option):
        rule = arguments[1]
        is_name = isinstance(rule, OneOf)
        return quoted(rule.names) if is_name else _describe(arguments[0])
    if origin is Literal:
        return quoted(arguments)
    if origin in (list, tuple):
        return "a list"
    if _is_array(option):
        return "a number or a list"
    return _SCALARS.get(option, (None, "a table"))[1]


def quoted(values: Iterable[Any]) -> str:
    """Return values as a sentence lists them: `"a", "b" or "c"`."""
    words = [f'"{v}"' if isinstance(v, str) else str(v) for v in values]
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))

"""Decoding of TOML tables: a table calls a function, and its keys are the function's arguments.

Names, types and defaults of the keys are those of the arguments, and the function's docstring
describes them: `keys_of` gives all of it, also for the template that `jaxid init` prints. The
function may be a class of the package. Of other functions, arguments before the `*` come from
elsewhere and are no keys.
"""

import difflib
import inspect
import math
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, Literal, NamedTuple

import jaxtyping
import numpy as np

from jaxid.errors import InputError
from jaxid.io import union_members
from jaxid.measurement.units import Unit, unit

RENAMED = {"rows.slow": "min_speed", "rows.every": "step"}
"""Old keys and their new names."""


class Bounds(NamedTuple):
    """Range of a number, given as `Annotated[float, Bounds(above=0.0)]`.

    Attributes:
        above: Exclusive lower bound.
        least: Inclusive lower bound.
        most: Inclusive upper bound.
        below: Exclusive upper bound.
    """

    above: float = -math.inf
    least: float = -math.inf
    most: float = math.inf
    below: float = math.inf

    def broken_by(self, value: float | int) -> str:
        """Return the rule that a number breaks, and nothing if it breaks none."""
        if not value > self.above and self.above > -math.inf:
            return "positive" if self.above == 0 else f"above {self.above:g}"
        if not value >= self.least:
            return f"at least {self.least:.10g}"
        if not value <= self.most:
            return f"at most {self.most:.10g}"
        return "" if value < self.below or self.below == math.inf else f"below {self.below:.10g}"


Positive = Annotated[float, Bounds(above=0.0)]
Magnitude = Annotated[float, Bounds(least=0.0)]
Fraction = Annotated[float, Bounds(above=0.0, below=1.0)]
Count = Annotated[int, Bounds(least=1, most=10_000)]
Vector = tuple[float, float, float]
PerJoint = list[float]


class Key(NamedTuple):
    """A key of a table.

    Attributes:
        name: Name in the file.
        hint: Annotation of the argument.
        default: Default value; `inspect.Parameter.empty` if the key is needed.
        text: Description, from the docstring.
    """

    name: str
    hint: Any
    default: Any
    text: str

    @property
    def needed(self) -> bool:
        """Whether the table must have the key."""
        return self.default is inspect.Parameter.empty

    @property
    def tables(self) -> list[Callable]:
        """Functions of tables that the value may hold."""
        return list(_functions(self.hint))


def keys_of(function: Callable) -> dict[str, Key]:
    """Return the keys of a table that calls a function or class.

    Args:
        function: Function with keyword-only arguments, or class with any arguments.
    """
    texts = _descriptions(inspect.getdoc(function) or "")
    parameters = inspect.signature(function, eval_str=True).parameters.values()
    kept = (p for p in parameters if isinstance(function, type) or p.kind is p.KEYWORD_ONLY)
    # Converters widen the annotations of arguments; those of the fields say what is meant.
    fields = typing.get_type_hints(function, include_extras=True)
    return {
        p.name: Key(p.name, fields.get(p.name, p.annotation), p.default, texts.get(p.name, ""))
        for p in kept
    }


def _descriptions(docstring: str) -> dict[str, str]:
    """Return the descriptions of arguments or attributes in a docstring."""
    sections = re.findall(r"^(?:Args|Attributes):\n((?:    .*\n?|\n)+)", docstring, flags=re.M)
    entries = re.findall(r"^    (\w+): ((?:.*\n?)(?:        .*\n?)*)", "\n".join(sections), re.M)
    return {name: " ".join(text.split()) for name, text in entries}


def call(function: Callable, table: Any, place: str, *context: Any) -> Any:
    """Call a function with the keys of a table as arguments.

    Args:
        function: Function or class.
        table: The table, as `tomllib` reads it.
        place: Path of the table in the file.
        context: Arguments of the function that are no keys.

    Raises:
        InputError: If a key or a value does not fit, or the function rejects it.
    """
    (arguments,) = decode([function], table, place)
    with within(place):
        return function(*context, **arguments)


@contextmanager
def within(place: str, file: str = "") -> Iterator[None]:
    """Name the table of the file in the error of a deeper layer.

    Args:
        place: Path of the table in the file.
        file: Name of the file, if it is not named further above.
    """
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
    others: Mapping[str, str] | None = None,
) -> list[dict[str, Any]]:
    """Return the arguments that a table holds for each of several functions.

    Args:
        functions: Functions and classes that share the table.
        table: The table, as `tomllib` reads it.
        place: Path of the table in the file.
        complete: Whether keys without default are needed.
        skip: Arguments that are no keys.
        others: Keys that are known elsewhere, and the sentence that tells where.

    Raises:
        InputError: If a key is unknown or missing, or a value is not what it should be.
    """
    if not isinstance(table, dict):
        raise InputError(f"`{place}` must be a table, but {_came(table)}.")
    groups = [{k: v for k, v in keys_of(f).items() if k not in skip} for f in functions]
    known = {name: key for keys in groups for name, key in keys.items()}
    for name in table:
        if name not in known:
            raise InputError(_unknown(name, place, list(known), others or {}))
    missing = [name for name, key in known.items() if key.needed and name not in table]
    if missing and complete:
        table_name = re.sub(r"\[\d+\]", "", place)
        raise InputError(f"`{place}.{missing[0]}` is missing: `[{table_name}]` needs it.")
    values = {n: decode_value(v, known[n].hint, f"{place}.{n}") for n, v in table.items()}
    return [{n: values[n] for n in keys if n in values} for keys in groups]


def _unknown(name: str, place: str, known: list[str], others: Mapping[str, str]) -> str:
    full = f"{place}.{name}" if place else name
    if full in RENAMED:
        return f"`{full}` was renamed to `{RENAMED[full]}`."
    if name in others:
        return f"`{full}`: {others[name]}"
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if near:
        return f"`{full}` is no known key: did you mean `{near[0]}`?"
    where = f"the table `[{place}]`" if place else "the file"
    return f"`{full}` is no known key: {where} has {', '.join(known)}."


def check_tables(content: dict[str, Any], known: list[str]) -> None:
    """Check the names of the tables of a file.

    Args:
        content: The whole file.
        known: Names of the tables that it may have.

    Raises:
        InputError: If there is another one.
    """
    for name in content:
        if name not in known:
            raise InputError(_unknown(name, "", known, {}))


def decode_value(value: Any, hint: Any, place: str) -> Any:
    """Return a value of the file as an argument with such an annotation.

    Args:
        value: The value, as `tomllib` reads it.
        hint: Annotation of the argument.
        place: Path of the value in the file.

    Raises:
        InputError: If it does not fit.
    """
    options = [o for o in union_members(hint) if o not in (None, type(None))]
    for option in options:
        if _is_of_kind(value, option):
            return _convert(value, option, place)
    words = list(dict.fromkeys(_describe(option) for option in options))
    raise InputError(f"`{place}` must be {' or '.join(words)}, but {_came(value)}.")


def _is_of_kind(value: Any, option: Any) -> bool:
    """Whether a value has the kind of an annotation; what is in it may still be wrong."""
    origin = typing.get_origin(option)
    if origin is Annotated:
        return isinstance(value, dict) if _function(option) else _is_of_kind(value, _plain(option))
    if origin is Literal:
        return any(type(value) is type(x) and value == x for x in typing.get_args(option))
    if isinstance(value, bool) or option is bool:
        return isinstance(value, bool) and option is bool
    if origin in (list, tuple):
        return isinstance(value, list)
    if option is float:
        return isinstance(value, float | int)
    if option in (int, str):
        return isinstance(value, option)
    if option is Unit:
        return isinstance(value, str)
    if _is_array(option):
        return isinstance(value, float | int | list)
    return isinstance(value, dict)


def _convert(value: Any, option: Any, place: str) -> Any:
    origin = typing.get_origin(option)
    if origin is Annotated and (function := _function(option)):
        return call(function, value, place)
    if origin is Annotated:
        value = _convert(value, _plain(option), place)
        rules = (x.broken_by(value) for x in option.__metadata__ if isinstance(x, Bounds))
        if rule := next(filter(None, rules), ""):
            raise InputError(f"`{place}` must be {rule}, but is {value}.")
        return value
    if origin is Literal or option in (bool, int):
        return value
    if origin in (list, tuple):
        return _elements(value, option, place)
    if option is float:
        return float(value)
    if option is str:
        return _printable(value, place)
    if option is Unit:
        return unit(value)
    if _is_array(option):
        return _array(value, place)
    return call(option, value, place)


def _elements(value: list, option: Any, place: str) -> Any:
    arguments = typing.get_args(option)
    if typing.get_origin(option) is list or arguments[-1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(arguments) != len(value):
        raise InputError(f"`{place}` must hold {len(arguments)} values, but holds {len(value)}.")
    pairs = enumerate(zip(value, arguments, strict=True))
    made = [decode_value(x, a, f"{place}[{k}]") for k, (x, a) in pairs]
    return tuple(made) if typing.get_origin(option) is tuple else made


def _array(value: Any, place: str) -> np.ndarray:
    def leaf(x: Any) -> Any:
        return [leaf(y) for y in x] if isinstance(x, list) else decode_value(x, float, place)

    try:
        return np.array(leaf(value), np.float64)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"`{place}` must have rows of equal length.") from error


def _printable(text: str, place: str) -> str:
    signs = [c for c in text if not c.isprintable()]
    if signs:
        raise InputError(f"`{place}` holds the control character U+{ord(signs[0]):04X}: remove it.")
    return text


def _plain(option: Any) -> Any:
    return typing.get_args(option)[0]


def _function(option: Any) -> Callable | None:
    """Return the function of a table that is annotated as `Annotated[Result, function]`."""
    return next((x for x in option.__metadata__ if callable(x)), None)


def _functions(hint: Any) -> Iterator[Callable]:
    for option in union_members(hint):
        origin = typing.get_origin(option)
        if origin is Annotated and (function := _function(option)):
            yield function
        elif origin in (list, tuple):
            yield from (f for x in typing.get_args(option) for f in _functions(x))
        elif origin is None and isinstance(option, type) and not _is_scalar(option):
            yield option


def _is_scalar(option: type) -> bool:
    return option in (bool, int, float, str, Unit, type(None)) or _is_array(option)


def _is_array(option: Any) -> bool:
    return isinstance(option, type) and issubclass(option, jaxtyping.AbstractArray)


def choices(hint: Any) -> list[Any]:
    """Return the values of a key that has few of them.

    Args:
        hint: Annotation of the argument.
    """
    found = [o for o in union_members(hint) if typing.get_origin(o) is Literal]
    return [value for option in found for value in typing.get_args(option)]


def _describe(option: Any) -> str:
    origin = typing.get_origin(option)
    if origin is Annotated:
        return "a table" if _function(option) else _describe(_plain(option))
    if origin is Literal:
        return quoted(typing.get_args(option))
    if origin in (list, tuple) or (_is_array(option)):
        return "a list" if origin else "a number or a list"
    names = {float: "a number", int: "a whole number", bool: "true or false"}
    return names.get(option, "a text in quotes" if option in (str, Unit) else "a table")


def quoted(values: Iterable[Any]) -> str:
    """Return values as a sentence lists them: `"a", "b" or "c"`.

    Args:
        values: Texts and numbers.
    """
    words = [f'"{v}"' if isinstance(v, str) else str(v) for v in values]
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def _came(value: Any) -> str:
    if isinstance(value, dict):
        return "is a table"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "is a list of tables (`[[…]]`)"
    if isinstance(value, bool):
        return f"is {str(value).lower()}"
    return f'is "{value}"' if isinstance(value, str) else f"is {value}"

"""Immutable modules as plain JSON values and back: exact to the last bit, and nothing can run.

A module becomes an object with the name of its class under `kind` and one entry for each field, an
array an object with its type as the only key. Which classes a file may name is decided by the
annotations of the fields that hold them: a field of a family takes its subclasses, and nothing
else is looked up. A subclass of one's own is found if its module is imported.
"""

import dataclasses
import enum
import json
import math
import re
import types
import typing
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray
from jaxid.errors import InputError

KIND = "kind"
SHAPE = "shape"
FLOAT, ENUM = "float", "member"
DTYPES = ("float64", "float32", "int64", "int32", "bool")
_NOT_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}


class NotAValueError(ValueError):
    """Something that no document can hold: a function, or data that do not belong there."""


def text_of(content: dict[str, Any]) -> str:
    """JSON that programs read exactly and people can read.

    Args:
        content: Of strings, finite numbers, lists and objects.
    """
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    # A list of numbers or texts stands on one line. Texts hold no line breaks, so none is touched.
    return re.sub(r"\[\n[^\[\]{}]*\n *\]", lambda m: re.sub(r"\n *", " ", m[0]), text) + "\n"


def encoded(value: Any, refused: tuple[type, ...] = ()) -> Any:
    """A module, or what stands in its fields, as plain JSON values.

    Args:
        value: Modules, enumerations, tuples, arrays, numbers, texts.
        refused: Classes that must not be in it, such as recordings.

    Raises:
        NotAValueError: If there is something else in it.
    """
    if isinstance(value, refused):
        raise NotAValueError(f"a document cannot hold `{type(value).__name__}`.")
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, enum.Enum):
        return {ENUM: f"{type(value).__name__}.{value.name}"}
    if isinstance(value, AnyArray | np.generic):
        return _encoded_array(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else {FLOAT: repr(value)}
    if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        return [encoded(x, refused) for x in value]
    if isinstance(value, eqx.Module) and dataclasses.is_dataclass(value):
        fields = (f for f in dataclasses.fields(value) if f.init)
        entries = {f.name: encoded(getattr(value, f.name), refused) for f in fields}
        return {KIND: type(value).__name__, **entries}
    raise NotAValueError(f"a document cannot hold {value!r:.60}.")


def _encoded_array(value: Any) -> Any:
    if isinstance(value, jax.Array) and not value.is_fully_addressable:
        raise NotAValueError("a document cannot hold an array that is spread over processes.")
    array = np.asarray(value)
    if isinstance(value, np.generic):
        return encoded(value.item())
    name = array.dtype.name
    if name not in DTYPES:
        raise NotAValueError(f"a document cannot hold an array of {name}.")
    entries = array.tolist()
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        entries = _with_names(entries)
    return {name: entries} if array.size else {name: [], SHAPE: list(array.shape)}


def _with_names(entries: Any) -> Any:
    if isinstance(entries, list):
        return [_with_names(x) for x in entries]
    return entries if math.isfinite(entries) else repr(entries)


def decoded(value: Any, hint: Any, place: str = "") -> Any:
    """What `encoded` has made such values of.

    Args:
        value: Plain JSON values.
        hint: The class, or the annotation of the field, that it must fit.
        place: Where this stands in the document, for messages.

    Raises:
        InputError: If the values are not of a module that fits, with the place.
    """
    if isinstance(value, dict):
        found = _decoded_object(value, hint, place)
    elif isinstance(value, list):
        found = tuple(
            decoded(x, _element(hint, k, len(value)), f"{place}[{k}]") for k, x in enumerate(value)
        )
    else:
        found = value
    options = _options(hint)
    if not any(_fits(found, option) for option in options) and isinstance(
        found, float | np.ndarray
    ):
        # A number and an array without axes are the same thing to who made them.
        found = np.array(found) if isinstance(found, float) else found[()]
    if not any(_fits(found, option) for option in options):
        raise InputError(f"`{place}` holds {value!r:.60}, which does not belong there")
    return found


def _decoded_object(value: dict[str, Any], hint: Any, place: str) -> Any:
    if KIND in value:
        return _decoded_module(value, hint, place)
    if set(value) == {FLOAT}:
        return _not_finite(value[FLOAT], place)
    if set(value) == {ENUM}:
        for option in _options(hint):
            if isinstance(option, type) and issubclass(option, enum.Enum):
                family, _, member = str(value[ENUM]).partition(".")
                if family == option.__name__ and member in option.__members__:
                    return option[member]
        raise InputError(f"`{place}` names `{value[ENUM]}`, which is not known")
    names = set(value) - {SHAPE}
    if len(names) != 1 or not names <= set(DTYPES):
        raise InputError(f"`{place}` has the keys {', '.join(sorted(map(str, value)))}")
    (name,) = names
    try:
        return _array(value[name], name, value.get(SHAPE), place)
    except (TypeError, OverflowError) as error:
        raise InputError(f"`{place}` is no array of {name}") from error


def _array(entries: Any, name: str, shape: Any, place: str) -> np.ndarray:
    if shape is not None:
        return np.zeros(tuple(shape), name)
    exact = {"f": float, "i": int, "b": bool}[np.dtype(name).kind]

    def leaf(x: Any) -> Any:
        if isinstance(x, list):
            return [leaf(y) for y in x]
        x = _not_finite(x, place) if isinstance(x, str) and exact is float else x
        if type(x) is not exact:
            raise InputError(f"`{place}` holds {x!r:.30} in an array of {name}")
        return x

    checked = leaf(entries)
    try:
        return np.array(checked, name)
    except ValueError as error:
        raise InputError(f"`{place}` has rows of different lengths") from error


def _not_finite(word: Any, place: str) -> float:
    if word not in _NOT_FINITE:
        raise InputError(f"`{place}` holds {word!r:.30} in the place of a number")
    return _NOT_FINITE[word]


def _decoded_module(value: dict[str, Any], hint: Any, place: str) -> Any:
    kind = value[KIND]
    family = [o for o in _options(hint) if isinstance(o, type) and issubclass(o, eqx.Module)]
    found = [c for o in family for c in _all_below(o) if c.__name__ == kind]
    # Of classes of one name the last one counts; not a twin that Equinox derives for its own ends.
    found = [c for c in found if not any(b in found for b in c.__mro__[1:])]
    if not found:
        raise InputError(
            f"`{place or 'the model'}` is a `{kind}`, which is not known: import the module that "
            "defines it, or use a newer version of jaxid"
        )
    fields = {f.name: f for f in dataclasses.fields(found[-1]) if f.init}
    unknown = [key for key in value if key != KIND and key not in fields]
    needed = [f for f in fields.values() if f.name not in value and _is_needed(f)]
    if unknown or needed:
        complaint = f"has an unknown key `{unknown[0]}`" if unknown else f"lacks `{needed[0].name}`"
        raise InputError(f"`{place or kind}` ({kind}) {complaint}")
    entries = {
        name: decoded(value[name], field.type, f"{place}.{name}".strip("."))
        for name, field in fields.items()
        if name in value
    }
    return found[-1](**entries)


def _is_needed(field: dataclasses.Field) -> bool:
    missing = dataclasses.MISSING
    return field.default is missing and field.default_factory is missing


def _all_below(family: type) -> list[type]:
    """A class and everything that is derived from it, older ones first."""
    return [family, *(c for child in family.__subclasses__() for c in _all_below(child))]


def _options(hint: Any) -> tuple[Any, ...]:
    """The members of a union, and everything else alone."""
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        return tuple(o for x in typing.get_args(hint) for o in _options(x))
    return (hint,)


def _element(hint: Any, place: int, length: int) -> Any:
    """What an element of a tuple must fit."""
    for option in _options(hint):
        if typing.get_origin(option) is tuple:
            arguments = typing.get_args(option)
            if len(arguments) == 2 and arguments[1] is Ellipsis:
                return arguments[0]
            if len(arguments) == length:
                return arguments[place]
    return None


def _fits(value: Any, option: Any) -> bool:
    if option is Any:
        return value is None or isinstance(value, str | bool | int | float)
    if option is None or option is type(None):
        return value is None
    origin = typing.get_origin(option)
    if origin is tuple:
        return isinstance(value, tuple)
    if option is float:
        return isinstance(value, float)
    if option is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(option, type) and isinstance(value, option)

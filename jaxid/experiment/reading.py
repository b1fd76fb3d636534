"""Reads an experiment file, and says in one sentence what is wrong with it."""

import difflib
import re
import tomllib
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import msgspec

from jaxid.errors import InputError
from jaxid.experiment.tables import FILTERS, Tables

_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "a text in quotes",
    "bool": "true or false",
    "array": "a list",
    "object": "a table",
}


def _structs(table: type[msgspec.Struct], key: str = "") -> dict[str, type[msgspec.Struct]]:
    """A table and those in it by their keys; not the filters, of which one key has several."""
    found = {key: table}
    for name, hint in typing.get_type_hints(table).items():
        inner = list(_tables_in(hint))
        if len(inner) == 1:
            found |= _structs(inner[0], f"{key}.{name}" if key else name)
    return found


def _tables_in(hint: Any) -> Iterator[type[msgspec.Struct]]:
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        yield hint
    for one in typing.get_args(hint):
        yield from _tables_in(one)


_STRUCTS = _structs(Tables)


def read_tables(path: Path) -> tuple[Tables, str]:
    """Reads and checks a file: structure, names and types; and gives back its text.

    Raises:
        OSError: If the file cannot be read.
        InputError: If it is no TOML, or a key or a value is not what it should be.
    """
    if path.is_dir():
        raise InputError(f"`{path}` is a folder: name the experiment file in it.")
    if not path.is_file():
        raise InputError(
            f"`{path}` is no file: check its path, or write one with `jaxid init arm.urdf`."
        )
    try:
        text = path.read_bytes().decode("utf-8-sig")
        raw = tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise InputError(f"{path.name}: is no text in UTF-8 (byte {error.start}).") from error
    except RecursionError as error:
        raise InputError(f"{path.name}: is no TOML: brackets are nested too deeply.") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path.name}: is no TOML: {_lowered(str(error))}.") from error
    except ValueError as error:
        raise InputError(f"{path.name}: holds a number of thousands of digits.") from error
    try:
        found = msgspec.convert(raw, Tables)
    except msgspec.ValidationError as error:
        sentence = _sentence(str(error), raw)
        stop = "" if sentence.endswith("?") else "."
        raise InputError(f"{path.name}: {sentence}{stop}") from error
    for key, value in _texts(raw):
        if not value.replace("\t", " ").replace("\n", " ").isprintable():
            raise InputError(f"{path.name}: `{key}` holds control characters: remove them.")
    return found, text


def _texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """All texts in a table, with their keys."""
    if isinstance(value, str):
        yield key, value
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _texts(inner, f"{key}.{name}" if key else name)
    if isinstance(value, list):
        for k, inner in enumerate(value):
            yield from _texts(inner, f"{key}[{k}]")


def _lowered(text: str) -> str:
    return text[:1].lower() + text[1:]


def _sentence(message: str, raw: dict[str, Any]) -> str:
    """A message of msgspec in the words of the file."""
    what, _, where = message.partition(" - at `$")
    key = where.rstrip("`").lstrip(".")
    if found := re.fullmatch(r"Object contains unknown field `(.*)`", what):
        return _unknown(found[1], key, raw)
    if found := re.fullmatch(r"Object missing required field `(.*)`", what):
        return _missing(found[1], key)
    value = _lookup(raw, key)
    return f"`{key}` must {_expected(what, key)}, but {_came(what, value)}"


def _expected(what: str, key: str) -> str:
    if what.startswith("Invalid"):
        return f"be {_choices(key)}"
    if found := re.match(r"Expected `array` of length (\d+)", what):
        return f"hold {found[1]} numbers"
    if found := re.match(r"Expected `(\w+)` ([<>]=?) ([-+.\w]+)", what):
        bound = float(found[3])
        if found[2] == ">" and bound == 0:
            return "be positive"
        words = {">": "above", ">=": "at least", "<": "below", "<=": "at most"}
        return f"be {words[found[2]]} {bound:.10g}"
    if found := re.match(r"Expected `([^`]*)`", what):
        kinds = [_WORDS.get(k, k) for k in found[1].split(" | ") if k != "null"]
        return f"be {' or '.join(kinds)}"
    return f"be valid ({what})"


def _came(what: str, value: Any) -> str:
    if "of length" in what and isinstance(value, list):
        return f"holds {len(value)}"
    if isinstance(value, dict):
        return "is a table"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "is a list of tables (`[[…]]`)"
    if isinstance(value, bool):
        return f"is {str(value).lower()}"
    if isinstance(value, str):
        return f'is "{value}"'
    return f"is {value}"


def _missing(name: str, key: str) -> str:
    if name == "robot":
        return "the table `[robot]` is missing: give it `urdf`, `builtin` or `dh`"
    choices = f" ({_choices(f'{key}.{name}')})" if name == "kind" else ""
    return f"`{key}.{name}` is missing: `[{_table(key)}]` needs it{choices}"


def _unknown(name: str, key: str, raw: dict[str, Any]) -> str:
    full = f"{key}.{name}" if key else name
    known = _keys(_table(key), raw)
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if near:
        return f"`{full}` is no known key: did you mean `{near[0]}`?"
    homes = [t for t in (*_STRUCTS, "filter") if t and t != _table(key) and name in _keys(t, {})]
    if homes:
        return f"`{full}` is no known key: `{name}` belongs into the table `[{homes[0]}]`"
    where = f"the table `[{_table(key)}]`" if key else "the file"
    return f"`{full}` is no known key: {where} has {', '.join(known)}"


def _table(key: str) -> str:
    return re.sub(r"\[\d+\]", "", key)


def _keys(table: str, raw: dict[str, Any]) -> list[str]:
    """The keys of a table; of a filter, those of its kind or of all kinds."""
    if table != "filter":
        return list(_STRUCTS[table].__struct_encode_fields__)
    kind = raw.get("filter", {}).get("kind") if raw else None
    kinds = [FILTERS[kind]] if kind in FILTERS else list(FILTERS.values())
    return list(dict.fromkeys(k for c in kinds for k in ("kind", *c.__struct_encode_fields__)))


def _choices(key: str) -> str:
    """What a key with few possible values may be."""
    table, _, name = _table(key).rpartition(".")
    if (table, name) == ("filter", "kind"):
        values: list[Any] = list(FILTERS)
    else:
        values = _literals(typing.get_type_hints(_STRUCTS[table])[name])
    quoted = [f'"{v}"' if isinstance(v, str) else str(v) for v in values]
    if (table, name) == ("estimator", "ridge"):
        quoted.insert(0, "a number")
    return " or ".join(filter(None, [", ".join(quoted[:-1]), quoted[-1]]))


def _literals(annotation: Any) -> list[Any]:
    if typing.get_origin(annotation) is Literal:
        return list(typing.get_args(annotation))
    inner = typing.get_args(annotation)
    if typing.get_origin(annotation) in (types.UnionType, typing.Union, list):
        return [v for one in inner for v in _literals(one)]
    return []


def _lookup(raw: Any, key: str) -> Any:
    for part in re.findall(r"[^.\[\]]+", key):
        raw = raw[int(part)] if isinstance(raw, list) else raw.get(part)
    return raw

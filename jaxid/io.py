"""Atomic writes, safe reading of JSON, and modules as JSON values.

A module becomes an object with the name of its class under `kind` and one entry for
each field; an array becomes an object with its dtype as the only key. Numbers are exact
to the last bit. Only classes that fit the annotation of a field are looked up, so that
no file can run code. A user's own subclass is found once its module is imported.
"""

import contextlib
import dataclasses
import enum
import importlib
import json
import math
import os
import re
import shutil
import threading
import types
import typing
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray
from jaxid.errors import InputError

PLACING = threading.Lock()
"""Held while files take their places."""
TEMPORARY: set[Path] = set()
"""Temporary folders in use; who ends the process at once removes them."""
_DTYPES = ("float64", "float32", "int64", "int32", "bool")


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all."""
    write_bytes(path, text.encode())


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file, whole or not at all; missing folders above it are made."""
    path = Path(path)
    with atomic_folder(path.parent) as folder:
        (folder / path.name).write_bytes(data)


@contextlib.contextmanager
def atomic_folder(
    folder: str | Path, outdated: Callable[[Path], Iterable[str]] = lambda folder: ()
) -> Iterator[Path]:
    """Yield an empty temporary folder whose files appear in `folder` when the block ends.

    After an error in the block nothing has changed. A new folder appears in one step.
    In an existing folder, each file replaces the one of its name in one step, files in
    JSON last: a result whose JSON file is there is complete. Other files stay, but
    those that `outdated` names.
    """
    folder = Path(folder).absolute()
    with _temporary_folder(folder) as staging:
        yield staging
        with PLACING:
            if folder.exists():
                _move_files(staging, folder, outdated(folder))
            else:
                folder.parent.mkdir(parents=True, exist_ok=True)
                os.replace(staging, folder)


def require_writable(folder: str | Path) -> None:
    """Check that files can be written to a folder, which need not exist, before long work."""
    with _temporary_folder(Path(folder).absolute()):
        pass


@contextlib.contextmanager
def _temporary_folder(folder: Path) -> Iterator[Path]:
    """Make a hidden folder on the same file system, and remove it in the end."""
    place = folder
    while not place.exists() and not place.is_symlink():
        place = place.parent
    if not place.is_dir():
        raise InputError(
            f"`{place}` must be a folder, but is none: choose another place."
        )
    path = place / f".jaxid-{uuid.uuid4().hex[:12]}"
    TEMPORARY.add(path)
    try:
        path.mkdir()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from error
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        TEMPORARY.discard(path)


def _move_files(staging: Path, folder: Path, outdated: Iterable[str]) -> None:
    paths = sorted(
        staging.iterdir(), key=lambda path: (path.suffix == ".json", path.name)
    )
    for path in paths:
        if (folder / path.name).is_dir():
            raise InputError(
                f"`{folder / path.name}` must be a file, but is a folder: remove it."
            )
    old = {name for name in outdated if (folder / name).is_file()} - {
        p.name for p in paths
    }
    if len(paths) > 1:
        # Without its JSON files, no mixture of old and new files is taken for a result.
        old |= {p.name for p in paths if p.suffix == ".json"}
    for name in old:
        (folder / name).unlink(missing_ok=True)
    for path in paths:
        os.replace(path, folder / path.name)


def read_json(path: str | Path) -> Any:
    """Read a JSON file."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(str(error)) from error


def json_text(content: dict[str, Any]) -> str:
    """Return the text of a JSON file that programs read exactly and people can read."""
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    # A list of numbers or texts stands on one line. Texts hold no line breaks, so none
    # is touched.
    return (
        re.sub(r"\[\n[^\[\]{}]*\n *\]", lambda m: re.sub(r"\n *", " ", m[0]), text)
        + "\n"
    )


def fill_template(path: Path, **values: Any) -> str:
    """Return the text of a Jinja template with these values; a missing one is an error."""
    import jinja2  # loaded by those who write such files

    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.from_string(path.read_text(encoding="utf-8")).render(values)


def import_extra(module: str, extra: str, use: str) -> Any:
    """Return a module of an extra; say how to install it where it is missing.

    Args:
        module: Full name of the module.
        extra: Name of the extra that holds its package.
        use: Beginning of the sentence, like "`log.mcap` is read by".
    """
    try:
        return importlib.import_module(module)
    except ImportError as missing:
        package = module.partition(".")[0]
        raise InputError(
            f"{use} the package `{package}`: install it (`pip install "
            f'"jaxid-robotics[{extra}]"`).'
        ) from missing


def to_json(value: Any, refused: tuple[type, ...] = ()) -> Any:
    """Return a module, or the value of a field, as plain JSON values."""
    if isinstance(value, refused):
        raise InputError(f"a document cannot hold `{type(value).__name__}`.")
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, enum.Enum):
        return {"member": f"{type(value).__name__}.{value.name}"}
    if isinstance(value, np.generic):
        return to_json(value.item())
    if isinstance(value, AnyArray) and getattr(value, "is_fully_addressable", True):
        array = np.asarray(value)
        name, entries = array.dtype.name, array.tolist()
        if name not in _DTYPES:
            raise InputError(f"a document cannot hold an array of {name}.")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            shown = np.where(
                np.isfinite(array), array.astype(object), array.astype(str)
            )
            entries = shown.tolist()
        return {name: entries} if array.size else {name: [], "shape": list(array.shape)}
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": repr(value)}
    if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        return [to_json(x, refused) for x in value]
    if isinstance(value, eqx.Module) and dataclasses.is_dataclass(value):
        fields = (f for f in dataclasses.fields(value) if f.init)
        entries = {f.name: to_json(getattr(value, f.name), refused) for f in fields}
        return {"kind": type(value).__name__, **entries}
    raise InputError(f"a document cannot hold {value!r:.60}.")


def from_json(value: Any, hint: Any, place: str = "") -> Any:
    """Return the module or value that `to_json` has made these values of."""
    options = union_members(hint)
    if isinstance(value, dict):
        result = _object_from_json(value, options, place)
    elif isinstance(value, list):
        hints = _element_hints(options, len(value))
        pairs = enumerate(zip(value, hints, strict=True))
        result = tuple(from_json(x, h, f"{place}[{k}]") for k, (x, h) in pairs)
    else:
        result = value
    forms = [result]
    if isinstance(result, float | np.ndarray):
        # A number and an array without axes are the same.
        forms.append(np.array(result) if isinstance(result, float) else result[()])
    for form in forms:
        if any(_fits(form, option) for option in options):
            return form
    raise InputError(f"`{place}` holds {value!r:.60}, which does not belong there")


def _object_from_json(value: dict[str, Any], options: Sequence[Any], place: str) -> Any:
    if "kind" in value:
        return _module_from_json(value, options, place)
    names = set(value) - {"shape"}
    if len(names) != 1 or not names <= {*_DTYPES, "float", "member"}:
        raise InputError(f"`{place}` has the keys {', '.join(sorted(map(str, value)))}")
    (name,) = names
    entries = value[name]
    if name == "float" and entries in ("inf", "-inf", "nan"):
        return float(entries)
    if name == "member":
        enums = (o for o in options if isinstance(o, type) and issubclass(o, enum.Enum))
        members = {f"{o.__name__}.{member.name}": member for o in enums for member in o}
        if str(entries) not in members:
            raise InputError(f"`{place}` names `{entries}`, which is not known")
        return members[entries]
    try:
        array = np.array(entries, name)
        array = array.reshape(value.get("shape", array.shape))
    except (TypeError, ValueError, OverflowError):
        array = None
    if array is None or to_json(array) != value:
        raise InputError(f"`{place}` is no array of {name}")
    return array


def _module_from_json(value: dict[str, Any], options: Sequence[Any], place: str) -> Any:
    kind = value["kind"]
    families = [o for o in options if isinstance(o, type) and issubclass(o, eqx.Module)]
    named = [
        c for family in families for c in _subclasses(family) if c.__name__ == kind
    ]
    # Of classes of one name the last one counts; not a twin that Equinox derives for
    # its own ends.
    named = [c for c in named if not any(b in named for b in c.__mro__[1:])]
    if not named:
        raise InputError(
            f"`{place or 'the model'}` is a `{kind}`, which is not known: import the "
            "module that defines it, or use a newer version of jaxid"
        )
    hints = {f.name: f.type for f in dataclasses.fields(named[-1]) if f.init}
    entries = {
        name: from_json(entry, hints.get(name, Any), f"{place}.{name}".strip("."))
        for name, entry in value.items()
        if name != "kind"
    }
    try:
        return named[-1](**entries)
    except TypeError as error:
        raise InputError(
            f"`{place or kind}` ({kind}) has other keys: {error}"
        ) from error


def _subclasses(family: type) -> list[type]:
    """Return a class and all that are derived from it, older ones first."""
    return [
        family,
        *(c for child in family.__subclasses__() for c in _subclasses(child)),
    ]


def union_members(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the annotation itself if it is none."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return tuple(o for x in typing.get_args(hint) for o in union_members(x))
    return (hint,)


def _element_hints(options: Sequence[Any], length: int) -> tuple[Any, ...]:
    """Return the annotations of the elements of a tuple."""
    for option in options:
        if typing.get_origin(option) is tuple:
            arguments = typing.get_args(option)
            if arguments[1:] == (Ellipsis,):
                return arguments[:1] * length
            if len(arguments) == length:
                return arguments
    return (None,) * length


def _fits(value: Any, option: Any) -> bool:
    if option is Any:
        return value is None or isinstance(value, str | bool | int | float)
    if option is None or option is type(None):
        return value is None
    if typing.get_origin(option) is tuple:
        return isinstance(value, tuple)
    if option is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(option, type) and isinstance(value, option)

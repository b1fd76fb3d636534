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

FilePath = str | Path
"""Path of a file or folder."""
PLACING = threading.Lock()
"""Held while files take their places."""
TEMPORARY: set[Path] = set()
"""Temporary folders in use; who ends the process at once removes them."""
DTYPES = ("float64", "float32", "int64", "int32", "bool")
"""Types of the arrays that a document can hold."""


def write_text(path: FilePath, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all."""
    write_bytes(path, text.encode())


def write_bytes(path: FilePath, data: bytes) -> None:
    """Write a file, whole or not at all; missing folders above it are made."""
    path = Path(path)
    with atomic_folder(path.parent) as folder:
        (folder / path.name).write_bytes(data)


@contextlib.contextmanager
def atomic_folder(
    folder: FilePath,
    outdated_names: Callable[[Path], Iterable[str]] = lambda folder: (),
) -> Iterator[Path]:
    """Yield an empty temporary folder, whose files move to `folder` at the end.

    After an error in the block nothing has changed. A new folder appears in one step.
    In an existing folder, each file replaces the one of its name in one step, files in
    JSON last: a result whose JSON file is there is complete. Other files stay, but
    those of `outdated_names`.
    """
    folder = Path(folder).absolute()
    with _temporary_folder(folder) as staging:
        yield staging
        with PLACING:
            if folder.exists():
                _move_files(staging, folder, outdated_names(folder))
            else:
                folder.parent.mkdir(parents=True, exist_ok=True)
                os.replace(staging, folder)


def require_writable(folder: FilePath) -> None:
    """Check that files can be written to a folder, before long work starts.

    The folder need not exist.
    """
    with _temporary_folder(Path(folder).absolute()):
        pass


@contextlib.contextmanager
def _temporary_folder(folder: Path) -> Iterator[Path]:
    """Make a hidden folder on the same file system, and remove it in the end."""
    parent = folder
    while not parent.exists() and not parent.is_symlink():
        parent = parent.parent
    if not parent.is_dir():
        raise InputError(
            f"`{parent}` must be a folder, but is none: choose another place."
        )
    path = parent / f".jaxid-{uuid.uuid4().hex[:12]}"
    TEMPORARY.add(path)
    try:
        path.mkdir()
    except OSError as error:
        # The user knows the folder, not the hidden one in it.
        raise OSError(error.errno, error.strerror, str(folder)) from error
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        TEMPORARY.discard(path)


def _move_files(staging: Path, folder: Path, outdated_names: Iterable[str]) -> None:
    """Replace files in a folder by those of the same name, those in JSON last."""
    names = sorted(
        (path.name for path in staging.iterdir()),
        key=lambda name: (name.endswith(".json"), name),
    )
    for name in names:
        if (folder / name).is_dir():
            raise InputError(
                f"`{folder / name}` must be a file, but is a folder: remove it."
            )
    outdated_files = {name for name in outdated_names if (folder / name).is_file()}
    removals = outdated_files - set(names)
    if len(names) > 1:
        # Without its JSON files, no mixture of earlier and later files is taken for a
        # result.
        removals |= {name for name in names if name.endswith(".json")}
    for name in removals:
        (folder / name).unlink(missing_ok=True)
    for name in names:
        os.replace(staging / name, folder / name)


def read_json(path: FilePath) -> Any:
    """Read a JSON file."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise InputError("it is not text in UTF-8") from error
    except json.JSONDecodeError as error:
        raise InputError(f"{error.msg} in line {error.lineno}") from error
    except ValueError as error:
        raise InputError("it holds a number with thousands of digits") from error
    except RecursionError as error:
        raise InputError("its brackets are nested too deeply") from error


def json_text(content: dict[str, Any]) -> str:
    """Return the text of a JSON file that programs read exactly and people can read."""
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    # A list of numbers or texts stands on one line. Texts hold no line breaks, so none
    # is touched.
    flat_list = re.compile(r"\[\n[^\[\]{}]*\n *\]")
    one_line = flat_list.sub(lambda match: re.sub(r"\n *", " ", match[0]), text)
    return f"{one_line}\n"


def fill_template(path: Path, **values: Any) -> str:
    """Return the text of a Jinja template with these values; each must be given."""
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
    except ImportError as error:
        package = module.partition(".")[0]
        raise InputError(
            f"{use} the package `{package}`: install it (`pip install "
            f'"jaxid-robotics[{extra}]"`).'
        ) from error


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
    # An array on the devices of other processes has no numbers here.
    if isinstance(value, AnyArray) and getattr(value, "is_fully_addressable", True):
        return _array_to_json(np.asarray(value))
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": repr(value)}
    if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        return [to_json(entry, refused) for entry in value]
    if isinstance(value, eqx.Module) and dataclasses.is_dataclass(value):
        entries = {
            field.name: to_json(getattr(value, field.name), refused)
            for field in dataclasses.fields(value)
            if field.init
        }
        return {"kind": type(value).__name__, **entries}
    raise InputError(f"a document cannot hold {value!r:.60}.")


def _array_to_json(array: np.ndarray) -> dict[str, Any]:
    """Return an array as an object with its type; NaN and infinity become texts."""
    name = array.dtype.name
    if name not in DTYPES:
        raise InputError(f"a document cannot hold an array of {name}.")
    if not array.size:
        return {name: [], "shape": list(array.shape)}
    is_finite = np.isfinite(array)
    if not is_finite.all():
        array = np.where(is_finite, array.astype(object), array.astype(str))
    return {name: array.tolist()}


def from_json(value: Any, hint: Any, place: str = "") -> Any:
    """Return the module or value that `to_json` has made these values of.

    Args:
        value: Values of a document.
        hint: Annotation that the result has to fit, such as that of a field.
        place: Place in the document, for messages.
    """
    options = union_members(hint)
    result = value
    if isinstance(value, dict):
        result = _object_from_json(value, options, place)
    elif isinstance(value, list):
        hints = _element_hints(options, len(value))
        result = tuple(
            from_json(entry, entry_hint, f"{place}[{k}]")
            for k, (entry, entry_hint) in enumerate(zip(value, hints, strict=True))
        )
    if any(_fits(result, option) for option in options):
        return result
    # A number and an array without axes are the same.
    if isinstance(result, float | np.ndarray):
        alternative_value = (
            np.array(result) if isinstance(result, float) else result[()]
        )
        if any(_fits(alternative_value, option) for option in options):
            return alternative_value
    raise InputError(f"`{place}` holds {value!r:.60}, which does not belong there")


def _object_from_json(value: dict[str, Any], options: Sequence[Any], place: str) -> Any:
    """Return the module, array, number or enumeration member that an object holds."""
    if "kind" in value:
        return _module_from_json(value, options, place)
    names = set(value) - {"shape"}
    if len(names) != 1 or not names <= {*DTYPES, "float", "member"}:
        raise InputError(f"`{place}` has the keys {', '.join(sorted(map(str, value)))}")
    (name,) = names
    content = value[name]
    if name == "float" and content in ("inf", "-inf", "nan"):
        return float(content)
    if name == "member":
        return _member_from_json(content, options, place)
    try:
        array = np.array(content, name)
        array = array.reshape(value.get("shape", array.shape))
    except (TypeError, ValueError, OverflowError):
        array = None
    # NumPy reads more than `to_json` writes, such as `true` as 1.
    if array is None or to_json(array) != value:
        raise InputError(f"`{place}` is not an array of {name}")
    return array


def _member_from_json(name: Any, options: Sequence[Any], place: str) -> enum.Enum:
    """Return a member of one of the enumerations among the options."""
    for option in options:
        if isinstance(option, type) and issubclass(option, enum.Enum):
            for member in option:
                if name == f"{option.__name__}.{member.name}":
                    return member
    raise InputError(f"`{place}` names `{name}`, which is not known")


def _module_from_json(value: dict[str, Any], options: Sequence[Any], place: str) -> Any:
    """Return a module of a class that is derived from one of the options."""
    kind = value["kind"]
    classes = [
        subclass
        for option in options
        if isinstance(option, type) and issubclass(option, eqx.Module)
        for subclass in _subclasses(option)
        if subclass.__name__ == kind
    ]
    # Of classes of one name the last one counts; not a twin that Equinox derives for
    # its own ends.
    classes = [c for c in classes if not any(b in classes for b in c.__mro__[1:])]
    if not classes:
        raise InputError(
            f"`{place or 'the model'}` is a `{kind}`, which is not known: import the "
            "module that defines it, or use a newer version of jaxid"
        )
    module_class = classes[-1]
    hints = {field.name: field.type for field in dataclasses.fields(module_class)}
    entries = {
        name: from_json(entry, hints.get(name, Any), f"{place}.{name}".strip("."))
        for name, entry in value.items()
        if name != "kind"
    }
    try:
        return module_class(**entries)
    except TypeError as error:
        raise InputError(
            f"`{place or kind}` ({kind}) has other keys: {error}"
        ) from error


def _subclasses(family: type) -> list[type]:
    """Return a class and all classes derived from it, in the order of definition."""
    classes = [family]
    for child in family.__subclasses__():
        classes += _subclasses(child)
    return classes


def union_members(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the annotation itself if it is none."""
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return (hint,)
    return tuple(
        member
        for argument in typing.get_args(hint)
        for member in union_members(argument)
    )


def _element_hints(options: Sequence[Any], length: int) -> tuple[Any, ...]:
    """Return the annotations of the elements of a tuple."""
    for option in options:
        if typing.get_origin(option) is tuple:
            arguments = typing.get_args(option)
            if arguments[1:] == (Ellipsis,):
                return arguments[:1] * length
            if len(arguments) == length:
                return arguments
    # No value fits these.
    return (None,) * length


def _fits(value: Any, option: Any) -> bool:
    """Return whether a value belongs to an annotated type that is no union."""
    if option is Any:
        return value is None or isinstance(value, str | bool | int | float)
    if option is None or option is type(None):
        return value is None
    if typing.get_origin(option) is tuple:
        return isinstance(value, tuple)
    if option is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(option, type) and isinstance(value, option)

"""The model file: one JSON document that holds an identified model whole."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx

from jaxid.errors import InputError
from jaxid.io import from_json, json_text, read_json, to_json, write_text

FORMAT = "jaxid model"
VERSION = 1
KEYS = ("format", "version", "checksum", "model")
_Kind = TypeVar("_Kind", bound=eqx.Module)


def write_model(path: str | Path, model: eqx.Module) -> Path:
    """Writes a model file, whole or not at all.

    Args:
        path: Path of the file.
        model: An identified model.

    Raises:
        InputError: If the model holds something that no file can hold.
    """
    path = Path(path)
    content = to_json(model)
    document = {
        "format": FORMAT,
        "version": VERSION,
        "checksum": checksum_of(content),
        "model": content,
    }
    write_text(path, json_text(document))
    return path


def read_model(path: str | Path, kind: type[_Kind], check: Callable[[_Kind], None]) -> _Kind:
    """Reads a model file.

    Args:
        path: Path of the file.
        kind: What it must hold.
        check: Raises a `ValueError` where parts of it do not belong together.

    Raises:
        OSError: If the file cannot be read.
        InputError: If it is no model file, of another version, or not as it was written.
    """
    try:
        document = read_json(path, _without_repetition)
    except ValueError as error:
        raise InputError(f"`{path}` is no model file: it cannot be read as JSON.") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError(
            f'`{path}` is no model file (`"format": "{FORMAT}"`), as `save` writes it.'
        )
    if document.get("version") is True or document.get("version") != VERSION:
        raise InputError(
            f"`{path}` is a model file of version {document.get('version')!r:.20}, but this jaxid "
            f"reads version {VERSION}: use the jaxid that wrote it, or identify again."
        )
    if set(document) != set(KEYS):
        other = sorted(set(document) ^ set(KEYS))
        raise InputError(
            f"`{path}` must have the keys {', '.join(KEYS)}, but differs by {', '.join(other)}."
        )
    content = document["model"]
    try:
        checksum = checksum_of(content)
    except RecursionError as error:
        raise InputError(f"`{path}` is no model file: it is nested too deeply.") from error
    if document["checksum"] != checksum:
        raise InputError(
            f"`{path}` is damaged or was changed by hand: its checksum does not fit its content; "
            "save the model again."
        )
    try:
        model = from_json(content, kind)
        check(model)
    except (ValueError, TypeError, RecursionError) as error:
        said = " ".join(str(error).split()).rstrip(".")
        raise InputError(f"`{path}` holds no model that can be used: {said}.") from error
    return model


def checksum_of(content: Any) -> str:
    """SHA-256 of plain JSON values, whatever their layout in a file."""
    plain = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return f"sha256:{hashlib.sha256(plain.encode()).hexdigest()}"


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        raise InputError("a key comes twice")
    return content

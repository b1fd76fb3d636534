"""The state of a design as a file: written whole, and only read back for the same problem."""

import dataclasses
import hashlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxid.errors import InputError
from jaxid.io import read_arrays, write_bytes


def fingerprint(*parts: Any) -> str:
    """A digest of everything that a result depends on: numbers by their bits, the rest by name."""
    digest = hashlib.sha256()
    for leaf in (*jax.tree.leaves(parts, is_leaf=lambda x: x is None), *_settings(parts)):
        array = np.asarray(leaf) if not isinstance(leaf, str) and leaf is not None else None
        if array is None or array.dtype == object:
            digest.update(str(leaf).encode())
        else:
            digest.update(f"{array.shape}{array.dtype.str}".encode() + array.tobytes())
    return digest.hexdigest()


def _settings(part: Any) -> Iterator[str]:
    """What of modules is no array: names, numbers of bodies, pairs that are watched.

    Not what else they hold: of functions and programs only the address would be known.
    """
    if isinstance(part, list | tuple):
        for one in part:
            yield from _settings(one)
    elif isinstance(part, eqx.Module):
        yield type(part).__name__
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            if not field.metadata.get("static", False):
                yield from _settings(value)
            elif _is_plain(value):
                yield f"{field.name}={value!r}"


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_is_plain(one) for one in value)
    return value is None or isinstance(value, str | int | float | bool)


def save_state(path: Path, digest: str, state: Any) -> None:
    """Writes a state, or leaves the file as it was.

    Args:
        path: Of the file.
        digest: Of the problem that the state belongs to.
        state: Any tree of arrays and numbers.
    """
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
    buffer = io.BytesIO()
    np.savez(buffer, np.array(digest), *leaves)
    write_bytes(path, buffer.getvalue())


def load_state(path: Path, digest: str, like: Any) -> Any:
    """Reads a state that was saved for the same problem.

    Args:
        path: Of the file.
        digest: Of the problem.
        like: A state of the same structure.

    Raises:
        InputError: If the file is no state, or belongs to another problem.
    """
    try:
        content = read_arrays(path)
        arrays = [content[f"arr_{k}"] for k in range(len(content))]
        saved = str(arrays[0])
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"`{path}` is no saved state of a design: remove it.") from error
    structure = jax.tree.structure(like)
    if saved != digest or len(arrays) - 1 != structure.num_leaves:
        raise InputError(
            f"`{path}` was saved by a design with other settings: use those again, or remove the "
            "file to start anew."
        )
    return jax.tree.unflatten(structure, arrays[1:])

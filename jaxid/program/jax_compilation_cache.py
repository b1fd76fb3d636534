"""JAX's persistent cache of compiled functions in the user's cache folder."""

import contextlib
import os
import sys
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

from jaxid.errors import InputError

VARIABLE = "JAXID_CACHE_DIR"
"""Environment variable that names the folder of the cache, or turns the cache off."""
WORDS_FOR_OFF = ("", "0", "off", "none")
"""Values of the variable that turn the cache off."""
MAX_BYTES = 2**28
"""Maximum size of the cache [bytes]: some hundreds of functions."""


def enable_compilation_cache(folder: str | Path | None = None) -> Path | None:
    """Store compiled functions on disk, where the next process finds them.

    The commands call it; call it first in a notebook. A cache that JAX was given
    otherwise (`JAX_COMPILATION_CACHE_DIR`) stays in use. Functions lie in a folder of
    their own, which only its owner can read or write, for JAX runs what it finds there.
    The least recently used ones are removed when they take more than 256 MiB; no other
    file is ever touched.

    Args:
        folder: Folder above that of the cache. If None, the one in the environment
            variable `JAXID_CACHE_DIR` (`off` turns the cache off), or `jaxid` in the
            user's cache folder.

    Returns:
        Folder in use; None if the cache is off or nothing can be written there.

    Raises:
        InputError: If the folder belongs to somebody else, or others can write to it.
    """
    jax_folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is None and jax_folder:
        return Path(jax_folder)
    variable = os.environ.get(VARIABLE)
    is_off = variable is not None and variable.strip().lower() in WORDS_FOR_OFF
    if folder is None and is_off:
        return None
    parent = Path(folder or variable or user_cache()).expanduser().absolute()
    place = parent / "compiled"
    try:
        _require_private(parent)
        _require_private(place)
        _remove_oldest(place, MAX_BYTES)
    except OSError:
        return None
    if not os.access(place, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    # JAX looks for its cache once, at the first compilation.
    compilation_cache.reset_cache()
    return place


def user_cache() -> Path:
    """Return the folder of this package among the user's caches."""
    home_folder = Path.home()
    if sys.platform == "darwin":
        return home_folder / "Library" / "Caches" / "jaxid"
    if sys.platform == "win32":
        default_folder = home_folder / "AppData" / "Local"
        local_folder = Path(os.environ.get("LOCALAPPDATA") or default_folder)
        return local_folder / "jaxid" / "Cache"
    xdg = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (xdg if xdg.is_absolute() else home_folder / ".cache") / "jaxid"


def _require_private(folder: Path):
    """Check that a folder is the user's own; make it if it is missing."""
    for path in reversed([folder, *folder.parents]):
        with contextlib.suppress(FileExistsError):
            path.mkdir()
            path.chmod(0o700)
    status = folder.stat()
    if hasattr(os, "getuid") and (
        status.st_uid != os.getuid() or status.st_mode & 0o022
    ):
        raise InputError(
            f"`{folder}` belongs to somebody else, or others can write to it. Code "
            f"from this folder is executed: give {VARIABLE} a folder of your own, or "
            "turn the cache off with `off`."
        )


def _remove_oldest(folder: Path, max_bytes: int):
    """Remove the least recently used files."""
    files = []
    for path in folder.glob("*-cache"):
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            if path.is_file():
                files.append(
                    (max(status.st_atime, status.st_mtime), status.st_size, path)
                )
    size = sum(bytes_ for _, bytes_, _ in files)
    for _, bytes_, path in sorted(files):
        if size > max_bytes:
            path.unlink(missing_ok=True)
        size -= bytes_

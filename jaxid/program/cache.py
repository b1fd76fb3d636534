"""Compiled functions that outlive the process: JAX's persistent cache in the user's own folder."""

import os
import sys
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

VARIABLE = "JAXID_CACHE_DIR"
OFF = ("", "0", "off", "none")
"""Values of the variable that turn the cache off."""
LARGEST = 2**28
"""Bytes that the cache may hold: some hundreds of functions."""
SHORTEST = 0.2
"""Compile time from which a function is kept [s]."""


def keep_compiled(folder: str | Path | None = None) -> Path | None:
    """Lets JAX keep what it compiles on the disk: the next process finds it.

    The commands call it; in a notebook call it first. A cache that JAX was given otherwise
    (`JAX_COMPILATION_CACHE_DIR`) stays. What was not used for longest goes when the folder holds
    more than 256 MiB.

    Args:
        folder: Of the cache. If None, that of the environment variable `JAXID_CACHE_DIR` (`off`
            turns the cache off), or `jaxid` where the system keeps users' caches.

    Returns:
        The folder; None if there is no cache, because it is off or nothing can be written there.
    """
    given = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is None and given:
        return Path(given)
    asked = os.environ.get(VARIABLE)
    if folder is None and asked is not None and asked.strip().lower() in OFF:
        return None
    place = Path(folder or asked or user_cache()).expanduser().absolute()
    try:
        place.mkdir(parents=True, exist_ok=True)
        _shrink(place, LARGEST)
    except OSError:
        return None
    if not os.access(place, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    # JAX looks for its cache once, at the first compilation.
    compilation_cache.reset_cache()
    return place


def user_cache() -> Path:
    """Where the system keeps this user's caches, with a folder of this package."""
    home = Path.home()
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "jaxid"
    if sys.platform == "win32":
        local = os.environ.get("LOCALAPPDATA")
        return (Path(local) if local else home / "AppData" / "Local") / "jaxid" / "Cache"
    chosen = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(chosen) if Path(chosen).is_absolute() else home / ".cache") / "jaxid"


def _shrink(folder: Path, most: int) -> None:
    """Removes what was not used for longest; other processes may do the same at the same time."""
    found = []
    for path in folder.iterdir():
        try:
            status = path.stat()
        except FileNotFoundError:
            continue
        if path.is_file():
            found.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    size = sum(bytes_ for _, bytes_, _ in found)
    for _, bytes_, path in sorted(found):
        if size <= most:
            return
        path.unlink(missing_ok=True)
        size -= bytes_

"""Folders that are written whole or not at all; files that cannot run code or exhaust a reader."""

import contextlib
import json
import os
import platform
import shutil
import time
import uuid
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError

PATIENCE = 60.0
"""Seconds for which a run waits for another one that writes into the same folder."""
HIDDEN = ".jaxid-"
"""How names of folders begin that hold a result until it is whole."""
NEW, OLD = "new", "old"
"""Folders in them: of the result, and of what it replaces."""


def read_json(path: str | Path, hook: Callable[[list[tuple[str, Any]]], Any] | None = None) -> Any:
    """Reads a JSON file, however deep it claims to be.

    Args:
        path: Of the file.
        hook: Makes what stands for an object of its pairs; a dict if None.

    Raises:
        OSError: If the file cannot be read.
        InputError: If it is no JSON in UTF-8; the message says why.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"), object_pairs_hook=hook)
    except RecursionError as error:
        raise InputError("its brackets are nested too deeply") from error


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """Reads the arrays of an NPZ file; objects, which could run code, are refused.

    Args:
        path: Of the file.

    Raises:
        OSError: If the file cannot be opened.
        InputError: If it is no archive of plain arrays, or is damaged; the message says how.
    """
    with Path(path).open("rb") as file:
        try:
            with np.load(file, allow_pickle=False) as archive:
                held = {name: archive[name] for name in archive.files}
                # What is no array comes as bytes, and was not put there by NumPy.
                return {name: x for name, x in held.items() if isinstance(x, np.ndarray)}
        except AttributeError as error:
            raise InputError("it is one array, not an archive of them") from error
        except Exception as error:  # of some ten kinds: it depends on which bytes are damaged
            raise InputError(" ".join(str(error).split()) or type(error).__name__) from error


@contextlib.contextmanager
def written_whole(
    folder: Path, outdated: Callable[[Path], Iterable[str]] = lambda folder: ()
) -> Iterator[Path]:
    """Gives an empty folder to write into; what is in it appears in `folder` when all is done.

    After an error nothing is left and nothing has changed. A new folder, with its parents, appears
    in one step. In a folder that is there already the files take the places of those of the same
    names, and others stay. What a process that was killed has left hidden goes too; what one that
    lives is writing does not.

    Args:
        folder: Where the files shall be.
        outdated: Tells the names of files of an earlier result in a folder, which go with it.

    Raises:
        InputError: If `folder`, or what should be above it, is a file; or a file's place is taken
            by a folder; or another process writes into it for `PATIENCE` seconds.
    """
    given, folder = folder, folder.absolute()
    ancestor = _standing(folder)
    # Beside their place, for only within one file system files move in one step.
    with _hidden(ancestor, given) as hidden:
        staging, replaced = hidden / NEW, hidden / OLD
        staging.mkdir()
        yield staging
        if not _appeared(staging, folder):
            replaced.mkdir()
            with _alone(folder):
                earlier = {*outdated(folder), *_moved(folder, outdated)}
                _replace(staging, folder, replaced, earlier)
    for place in {ancestor, folder.parent}:
        _clear(place)


def require_place(folder: Path) -> None:
    """Refuses a place where no result can appear: before the work, not after it.

    Args:
        folder: Where files shall be; it need not be there yet.

    Raises:
        OSError: If nothing can be written there.
        InputError: If something else is in its place, or above it.
    """
    with _hidden(_standing(folder.absolute()), folder):
        pass


def _standing(folder: Path) -> Path:
    """The folder itself if it is there, else the first one above it that is."""
    ancestor = folder
    while not ancestor.exists():
        if ancestor.is_symlink():
            raise InputError(
                f"`{ancestor}` is a link to `{os.readlink(ancestor)}`, which is not there: choose "
                "another place."
            )
        ancestor = ancestor.parent
    if not ancestor.is_dir():
        raise InputError(f"`{ancestor}` must be a folder, but is a file: choose another place.")
    return ancestor


def unfinished(folder: Path) -> list[Path]:
    """Results on their way into a folder and out of it, also of a process that was killed.

    Args:
        folder: Where they would appear.
    """
    return [hidden / part for hidden in _hidden_in(folder) for part in (NEW, OLD)]


def _hidden_in(place: Path) -> list[Path]:
    try:
        return sorted(p for p in place.iterdir() if p.name.startswith(HIDDEN) and p.is_dir())
    except OSError:  # may not be read
        return []


def _moved(folder: Path, outdated: Callable[[Path], Iterable[str]]) -> Iterator[str]:
    """Files in a folder of results that were killed among their moves, or moved out of one's way.

    What is in the hidden folder still, or already, is not in the folder.
    """
    for part in unfinished(folder):
        yield from (name for name in outdated(part) if not (part / name).exists())


@contextlib.contextmanager
def _hidden(place: Path, given: Path) -> Iterator[Path]:
    """A folder that is this process's own as long as it lives, and is removed in the end.

    Args:
        place: Where it lies.
        given: What a user called the place for which it stands in.
    """
    while True:
        path = place / f"{_of_this_machine()}{uuid.uuid4().hex[:12]}"
        try:
            path.mkdir()
        except OSError as error:
            # Nobody has heard of the hidden folder.
            raise OSError(error.errno, error.strerror, str(given)) from error
        try:
            handle = _taken(path)
        except FileNotFoundError:  # removed by a process that found it before it was taken
            continue
        except OSError:  # without locks; then nobody removes it either
            handle = None
            break
        if handle is not None:
            break
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        if handle is not None:
            os.close(handle)


def _clear(place: Path) -> None:
    """Removes what processes of this machine have left hidden when they were killed."""
    for path in _hidden_in(place):
        # Some file systems keep the locks of other machines to themselves.
        if not path.name.startswith(_of_this_machine()):
            continue
        try:
            handle = _taken(path)
        except OSError:
            continue
        if handle is not None:
            shutil.rmtree(path, ignore_errors=True)
            os.close(handle)


def _of_this_machine() -> str:
    return f"{HIDDEN}{zlib.crc32(platform.node().encode()):08x}-"


def _appeared(staging: Path, folder: Path) -> bool:
    """Makes a folder that is not there yet of the new one, unless another run is faster."""
    if folder.exists():
        return False
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.rename(staging, folder)
    except OSError:
        if not folder.is_dir():
            raise
        return False
    return True


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keeps other runs from putting their files into a folder at the same time."""
    end = time.monotonic() + PATIENCE
    try:
        while (handle := _taken(folder)) is None:
            if time.monotonic() > end:
                raise InputError(
                    f"another run has been writing into `{folder}` for {PATIENCE:g} s: end it, "
                    "or choose another folder."
                )
            time.sleep(0.01)
    except FileNotFoundError:
        raise
    except OSError:  # without locks
        handle = None
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


def _taken(folder: Path) -> int | None:
    """Locks a folder until the handle is closed or the process ends; None if another has it.

    Raises:
        FileNotFoundError: If it is not there, or no longer.
        OSError: If there are no locks: on Windows, and in some file systems.
    """
    try:
        import fcntl
    except ImportError as error:
        raise OSError("no locks for folders") from error
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(handle), folder.stat()):
            return handle
        raise FileNotFoundError(folder)
    except BlockingIOError:
        os.close(handle)
        return None
    except BaseException:
        os.close(handle)
        raise


def _replace(staging: Path, folder: Path, replaced: Path, earlier: Iterable[str]) -> None:
    """Moves files into a folder, or none of them: what they replace is kept until all are there.

    One file takes the place of another in one step. Of several, those in JSON tell that all are
    there: they go first and come last, so that whatever stops this, old and new are never taken for
    one result. Files of an earlier result that have no successor go after those in JSON.
    """
    paths = sorted(staging.iterdir(), key=lambda path: (path.suffix == ".json", path.name))
    for path in paths:
        if (folder / path.name).is_dir():
            raise InputError(f"`{folder / path.name}` must be a file, but is a folder: remove it.")
    moved: list[Path] = []
    try:
        if len(paths) > 1:
            for path in paths:
                if path.suffix == ".json" and (folder / path.name).exists():
                    os.replace(folder / path.name, replaced / path.name)
        for name in set(earlier) - {path.name for path in paths}:
            if (folder / name).is_file():
                os.replace(folder / name, replaced / name)
        for path in paths:
            place = folder / path.name
            if place.exists():
                _kept(place, replaced / path.name)
            moved.append(place)
            os.replace(path, place)
    except BaseException:
        for place in moved:
            place.unlink(missing_ok=True)
        for path in replaced.iterdir():
            os.replace(path, folder / path.name)
        raise


def _kept(place: Path, copy: Path) -> None:
    """Another name for a file, which stays where it is."""
    try:
        os.link(place, copy)
    except OSError:  # a file system without links
        shutil.copy2(place, copy)

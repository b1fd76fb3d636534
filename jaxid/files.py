"""Folders that are written whole or not at all."""

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def written_whole(folder: Path) -> Iterator[Path]:
    """Gives an empty folder to write into; what is in it appears in `folder` when all is done.

    After an error nothing is left and nothing has changed. A new folder, with its parents, appears
    in one step. In a folder that is there already the files take the places of those of the same
    names, and others stay.

    Args:
        folder: Where the files shall be.

    Raises:
        ValueError: If `folder`, or what should be above it, is a file; or a file's place is taken
            by a folder.
    """
    folder = folder.absolute()
    ancestor = folder
    while not ancestor.exists():
        ancestor = ancestor.parent
    if not ancestor.is_dir():
        raise ValueError(f"`{ancestor}` must be a folder, but is a file: choose another place.")
    # Beside their place, for only within one file system files move in one step.
    staging, replaced = (ancestor / f".jaxid-{uuid.uuid4().hex[:12]}" for _ in range(2))
    staging.mkdir()
    try:
        yield staging
        if folder.exists():
            replaced.mkdir()
            _replace(staging, folder, replaced)
        else:
            folder.parent.mkdir(parents=True, exist_ok=True)
            os.rename(staging, folder)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        shutil.rmtree(replaced, ignore_errors=True)


def _replace(staging: Path, folder: Path, replaced: Path) -> None:
    """Moves files into a folder, or none of them: what they replace is kept until all are there."""
    paths = sorted(staging.iterdir())
    for path in paths:
        if (folder / path.name).is_dir():
            raise ValueError(f"`{folder / path.name}` must be a file, but is a folder: remove it.")
    moved: list[Path] = []
    try:
        for path in paths:
            place = folder / path.name
            if place.exists():
                os.replace(place, replaced / path.name)
            moved.append(place)
            os.replace(path, place)
    except BaseException:
        for place in moved:
            place.unlink(missing_ok=True)
        for path in replaced.iterdir():
            os.replace(path, folder / path.name)
        raise

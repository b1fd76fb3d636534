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
    in one step. Into a folder that is there already the files are moved one by one, over files of
    the same names; others stay.

    Args:
        folder: Where the files shall be.

    Raises:
        ValueError: If `folder`, or what should be above it, is a file.
    """
    folder = folder.absolute()
    ancestor = folder
    while not ancestor.exists():
        ancestor = ancestor.parent
    if not ancestor.is_dir():
        raise ValueError(f"`{ancestor}` must be a folder, but is a file: choose another place.")
    staging = ancestor / f".jaxid-{uuid.uuid4().hex[:12]}"
    staging.mkdir()
    try:
        yield staging
        if folder.exists():
            for path in sorted(staging.iterdir()):
                os.replace(path, folder / path.name)
        else:
            folder.parent.mkdir(parents=True, exist_ok=True)
            os.rename(staging, folder)
    finally:
        shutil.rmtree(staging, ignore_errors=True)

"""Readers of log files by the suffixes of their names."""

import contextlib
from pathlib import Path

from jaxid.arrays import Texts
from jaxid.errors import InputError

from ..log_columns import Selections, joined_elements
from ..text_format import TEXT_SUFFIXES
from .array_files import Hdf5File, MatFile, NpzFile
from .bags import BagFile
from .log_file import AbstractLogFile
from .parquet_files import ParquetFile
from .text_files import TextFile

READERS: dict[str, type[AbstractLogFile]] = {
    **dict.fromkeys(TEXT_SUFFIXES, TextFile),
    ".parquet": ParquetFile,
    ".npz": NpzFile,
    ".mat": MatFile,
    ".h5": Hdf5File,
    ".hdf5": Hdf5File,
    ".mcap": BagFile,
    ".bag": BagFile,
    ".db3": BagFile,
}
"""Readers by suffix."""


def open_log_file(
    path: Path, selections: Selections, joint_names: Texts | None = None
) -> AbstractLogFile:
    """Open a file from which some columns will be read; its suffix tells the format."""
    if is_bag_folder(path):
        return BagFile(path, selections, joint_names)
    if not path.is_file():
        raise InputError(
            f"`{path}` is not a file or a ROS 2 bag: give the path of a log."
        )
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"`{path.name}` must end in {', '.join(READERS)}: convert it.")
    return reader(path, selections, joint_names)


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder is a bag of ROS 2."""
    return (path / "metadata.yaml").is_file()


def summarise_columns(path: Path) -> str:
    """Return the names of the columns of a file, as messages show them."""
    names = open_log_file(path, {}).names
    return f"`{'`, `'.join(joined_elements(names))}`"


def estimated_rows(path: Path) -> int:
    """Estimate the number of rows of a file; 0 if it cannot be read in parts."""
    with contextlib.suppress(InputError, OSError):
        return open_log_file(path, {}).estimated_rows()
    return 0

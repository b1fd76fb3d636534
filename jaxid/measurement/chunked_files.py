"""Log files that are read in parts: Parquet, mapped NPZ, and CSV, which is converted to Parquet."""

import abc
import atexit
import dataclasses
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
import polars as pl

from jaxid.errors import InputError
from jaxid.measurement.files import (
    HEAD,
    SUFFIXES,
    CsvFormat,
    LogTable,
    detect_csv_format,
    require_file,
    require_parquet,
)

BLOCK = 2**26
"""Bytes of a text file that are converted at once."""


class AbstractLogFile(abc.ABC):
    """Columns of a long file, of which any rows can be read."""

    @property
    @abc.abstractmethod
    def rows(self) -> int:
        """Number of rows."""

    @abc.abstractmethod
    def read(self, start: int, stop: int) -> LogTable:
        """Return some consecutive rows."""

    @abc.abstractmethod
    def only(self, names: tuple[str, ...]) -> "AbstractLogFile":
        """Return the same file with some of its columns."""


@dataclasses.dataclass(frozen=True)
class ParquetFile(AbstractLogFile):
    """Parquet file, or several that are parts of one log.

    Attributes:
        path: Path of the file, or pattern of several.
        source: Name of the log, for messages.
        names: Names of the columns that are needed; all if None.
        first_line: Line of the first row in the text file that was converted; None if there is
            none.
        named: Whether the columns have names of their own.
    """

    path: Path
    source: str
    names: tuple[str, ...] | None = None
    first_line: int | None = None
    named: bool = True

    @property
    def rows(self) -> int:  # noqa: D102
        with require_parquet(self.source):
            return int(pl.scan_parquet(self.path).select(pl.len()).collect().item())

    def read(self, start, stop):  # noqa: D102
        with require_parquet(self.source):
            frame = pl.scan_parquet(self.path)
            if self.names is not None:
                frame = frame.select(self.names)
            columns = frame.slice(start, stop - start).collect().to_dict(as_series=True)
        return LogTable(self.source, columns, self.first_line, self.named, start)

    def only(self, names):  # noqa: D102
        return dataclasses.replace(self, names=names)


@dataclasses.dataclass(frozen=True)
class ArrayFile(AbstractLogFile):
    """Arrays of an uncompressed NPZ file, mapped into memory.

    Attributes:
        source: Name of the file, for messages.
        arrays: Arrays by name.
    """

    source: str
    arrays: Mapping[str, np.ndarray]

    @property
    def rows(self) -> int:  # noqa: D102
        return max((len(x) for x in self.arrays.values()), default=0)

    def read(self, start, stop):  # noqa: D102
        arrays = {name: x[start:stop] for name, x in self.arrays.items()}
        return LogTable(self.source, arrays, before=start)

    def only(self, names):  # noqa: D102
        return ArrayFile(self.source, {name: self.arrays[name] for name in names})


def open_log_file(
    path: str | Path, select: Callable[[LogTable], tuple[str, ...]]
) -> AbstractLogFile:
    """Open a file of which any rows can be read: Parquet, uncompressed NPZ, or CSV.

    A CSV file is converted to Parquet once, in a temporary folder that is removed at exit.

    Args:
        path: Path of the file.
        select: Function that names the columns that are needed, given the first rows.

    Raises:
        InputError: If the file is missing, of another kind, or damaged.
    """
    path = require_file(path)
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        return _converted(path, select)
    if suffix == ".parquet":
        file = ParquetFile(path, path.name)
        return file.only(select(file.read(0, 4096)))
    if suffix == ".npz":
        file = ArrayFile(path.name, _mapped_arrays(path))
        return file.only(select(file.read(0, min(file.rows, 4096))))
    raise InputError(
        f"`{path.name}` must end in {', '.join(SUFFIXES)}, .parquet or .npz to be read in parts: "
        "convert it to one of them."
    )


def estimated_rows(path: str | Path) -> int:
    """Estimate the number of rows of a file; 0 if it cannot be read in parts."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in SUFFIXES and path.is_file():
        with path.open("rb") as file:
            head = file.read(HEAD)
        return path.stat().st_size * head.count(b"\n") // max(len(head), 1)
    if suffix not in (".parquet", ".npz"):
        return 0
    try:
        return open_log_file(path, lambda table: tuple(table.columns)).rows
    except ValueError:
        return 0


_conversions: dict[tuple, ParquetFile] = {}


def _converted(path: Path, select: Callable[[LogTable], tuple[str, ...]]) -> ParquetFile:
    """Convert the needed columns of a text file to Parquet, unless this has been done."""
    with path.open("rb") as file:
        text = detect_csv_format(path.name, file.read(HEAD))
        file.seek(text.start)
        blocks = _blocks_of_lines(file)
        first = next(blocks, b"")
        table = LogTable(path.name, text.read(first), text.first_line, text.named)
        names = select(table)
        state = path.stat()
        key = (path.resolve(), state.st_size, state.st_mtime_ns, names)
        if key not in _conversions:
            folder = Path(tempfile.mkdtemp(prefix="jaxid-"))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            _write_parts(folder, text, table, names, blocks)
            parts = folder / "*.parquet"
            _conversions[key] = ParquetFile(parts, path.name, names, text.first_line, text.named)
    return _conversions[key]


def _write_parts(
    folder: Path, text: CsvFormat, table: LogTable, names: tuple[str, ...], blocks: Iterator[bytes]
) -> None:
    """Write a Parquet file for each block of lines."""
    exact = {name for name in names if _is_large_integer(table.columns[name])}
    types = {name: pl.Int64() if name in exact else pl.Float64() for name in names}
    number = 0
    while True:
        columns = {
            name: table.columns[name] if name in exact else table.numbers(name)[:, 0]
            for name in names
        }
        pl.DataFrame(columns).write_parquet(folder / f"{number:09}.parquet")
        block = next(blocks, None)
        if block is None:
            return
        rows = table.before + len(table.columns[names[0]])
        part = text.read(block, rows, types)
        table = LogTable(text.source, part, text.first_line, text.named, rows)
        number += 1


def _blocks_of_lines(file: BinaryIO) -> Iterator[bytes]:
    """Yield blocks of whole lines, without the line ends behind the last row."""
    rest = b""
    while data := file.read(BLOCK) + file.readline():
        data = rest + data
        rows = data.rstrip(b"\r\n")
        rest = data[len(rows) :].partition(b"\n")[2]
        if rows:
            yield rows


def _is_large_integer(column: pl.Series | np.ndarray) -> bool:
    """Return whether float64 cannot hold a column of integers, such as nanoseconds since 1970."""
    if not isinstance(column, pl.Series) or column.dtype != pl.Int64:
        return False
    numbers = column.fill_null(0).cast(pl.Float64).to_numpy()
    return bool(np.abs(numbers).max(initial=0.0) > 2**53)


def _mapped_arrays(path: Path) -> dict[str, np.ndarray]:
    """Map the arrays of an NPZ file.

    Raises:
        InputError: If an array is compressed or damaged.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(path) as archive, path.open("rb") as file:
            for entry in archive.infolist():
                if entry.compress_type != zipfile.ZIP_STORED:
                    raise InputError(
                        f"`{entry.filename}` in `{path.name}` is compressed, so it cannot be "
                        "mapped: write it with `np.savez`, or as Parquet."
                    )
                array = _mapped_array(file, path, entry.header_offset)
                if array.ndim:
                    arrays[entry.filename.removesuffix(".npy")] = array
    except InputError:
        raise
    except Exception as error:  # of many kinds: it depends on which bytes are damaged
        reason = " ".join(str(error).split())
        raise InputError(
            f"`{path.name}` is no NPZ file of numbers, or is damaged ({reason}): write it again."
        ) from error
    return arrays


def _mapped_array(file: BinaryIO, path: Path, header: int) -> np.ndarray:
    """Map an array of an archive, given where its local header begins."""
    file.seek(header + 26)
    lengths = np.frombuffer(file.read(4), "<u2")
    file.seek(header + 30 + int(lengths.sum()))
    first = np.lib.format.read_magic(file) == (1, 0)
    read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    return np.memmap(path, dtype, "r", file.tell(), shape, "F" if fortran else "C")

"""Files from which rows can be read anywhere: text, Parquet, and arrays that are mapped."""

import os
import zipfile
from abc import abstractmethod
from pathlib import Path
from typing import BinaryIO

import equinox as eqx
import numpy as np
import polars as pl

from jaxid.arrays import Int
from jaxid.errors import InputError
from jaxid.measurement.tables import Table, whole_parquet
from jaxid.measurement.text import HEAD, SUFFIXES, Dialect

FIRST = 4096
"""Rows by which a file is got to know."""
STRIDE = 2**18
"""Bytes of a text between two marks, or a little more: so much is read in vain at either end."""

EXACT = 2**53
"""Largest whole number up to which float64 holds all."""


class AbstractParts(eqx.Module):
    """A file from which rows can be read anywhere."""

    @property
    @abstractmethod
    def rows(self) -> int:
        """Number of rows."""

    @abstractmethod
    def part(self, start: int, stop: int) -> Table:
        """Some consecutive rows, in the columns that are wanted."""

    @abstractmethod
    def only(self, names: tuple[str, ...]) -> "AbstractParts":
        """The same file, of which only some columns are wanted."""


class ParquetParts(AbstractParts):
    """A Parquet file; only the row groups and columns in question are read.

    Attributes:
        path: Of the file.
        names: Of the columns that are wanted; all if None.
    """

    path: Path = eqx.field(static=True)
    names: tuple[str, ...] | None = eqx.field(static=True, default=None)

    @property
    def rows(self) -> int:  # noqa: D102
        with whole_parquet(self.path):
            return int(pl.scan_parquet(self.path).select(pl.len()).collect().item())

    def part(self, start, stop):  # noqa: D102
        with whole_parquet(self.path):
            frame = pl.scan_parquet(self.path)
            if self.names is not None:
                frame = frame.select(self.names)
            frame = frame.slice(start, stop - start).collect()
        return Table(self.path.name, frame.to_dict(as_series=True), before=start)

    def only(self, names):  # noqa: D102
        return ParquetParts(self.path, names)


class ArrayParts(AbstractParts):
    """The arrays of an NPZ file that was not compressed, mapped and not read.

    Attributes:
        path: Of the file.
        arrays: By name.
    """

    path: Path = eqx.field(static=True)
    arrays: dict[str, np.ndarray]

    @classmethod
    def of(cls, path: Path) -> "ArrayParts":
        """Maps the arrays.

        Raises:
            InputError: If an array is compressed.
        """
        arrays = {}
        with zipfile.ZipFile(path) as archive, path.open("rb") as file:
            for entry in archive.infolist():
                if entry.compress_type != zipfile.ZIP_STORED:
                    raise InputError(
                        f"`{entry.filename}` in `{path.name}` is compressed, so it cannot be "
                        "mapped: write it with `np.savez`, or as Parquet."
                    )
                try:
                    mapped = _mapped(file, path, entry.header_offset)
                except Exception as error:  # it depends on which bytes are damaged
                    raise InputError(
                        f"`{entry.filename}` in `{path.name}` is no array of numbers, or is "
                        f"damaged ({' '.join(str(error).split())}): write it again."
                    ) from error
                arrays[entry.filename.removesuffix(".npy")] = mapped
        return cls(path, arrays)

    @property
    def rows(self) -> int:  # noqa: D102
        return max((len(x) for x in self.arrays.values() if x.ndim), default=0)

    def part(self, start, stop):  # noqa: D102
        arrays = {k: x[start:stop] for k, x in self.arrays.items() if x.ndim}
        return Table(self.path.name, arrays, before=start)

    def only(self, names):  # noqa: D102
        return ArrayParts(self.path, {name: self.arrays[name] for name in names})


def _mapped(file: BinaryIO, path: Path, header: int) -> np.ndarray:
    """An array of an archive, from where its local header begins."""
    file.seek(header + 26)
    lengths = np.frombuffer(file.read(4), "<u2")
    file.seek(header + 30 + int(lengths.sum()))
    first = np.lib.format.read_magic(file) == (1, 0)
    read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    return np.memmap(path, dtype, "r", file.tell(), shape, "F" if fortran else "C")


class TextParts(AbstractParts):
    """A text file of numbers, whose lines were counted once.

    Attributes:
        path: Of the file.
        dialect: How it is written.
        bytes: Where marked lines begin, and the last one ends.
        lines: Rows before each of them.
        names: Of the columns that are wanted.
        whole: Columns of whole numbers that float64 does not hold, like nanoseconds since 1970.
    """

    path: Path = eqx.field(static=True)
    dialect: Dialect = eqx.field(static=True)
    bytes: Int[np.ndarray, " marks"]
    lines: Int[np.ndarray, " marks"]
    names: tuple[str, ...] = eqx.field(static=True)
    whole: tuple[str, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(cls, path: Path) -> "TextParts":
        """Counts the lines.

        Raises:
            InputError: If the file is empty, or its header names a column twice.
        """
        with path.open("rb") as file:
            dialect = Dialect.of(path.name, file.read(HEAD))
            end = _end(file)
            file.seek(dialect.start)
            place, rows, marks = dialect.start, 0, []
            while place < end:
                marks.append((place, rows))
                block = file.read(STRIDE) + file.readline()
                place += len(block)
                if place >= end:
                    block = block[: len(block) - (place - end)]
                    rows += 1
                rows += block.count(b"\n")
            marks.append((end, rows))
        starts, counts = np.array(marks, np.int64).T
        first = dialect.columns(_lines(path, starts, counts, 0, FIRST)[0])
        whole = tuple(name for name, column in first.items() if _is_large(column))
        return cls(path, dialect, starts, counts, dialect.names, whole)

    @property
    def rows(self) -> int:  # noqa: D102
        return int(self.lines[-1])

    def part(self, start, stop):  # noqa: D102
        lines, before = _lines(self.path, self.bytes, self.lines, start, stop)
        found = self.dialect.numbers(lines, self.names, self.whole, before)
        own = slice(start - before, stop - before)
        table = {name: column[own] for name, column in found.items()}
        return Table(
            self.path.name, table, self.dialect.first_line, self.dialect.named, before=start
        )

    def only(self, names):  # noqa: D102
        return TextParts(self.path, self.dialect, self.bytes, self.lines, names, self.whole)


def _is_large(column: pl.Series) -> bool:
    if not column.dtype.is_integer():
        return False
    # As floating numbers: NumPy has no type for the whole numbers beyond 64 bits.
    return float(column.fill_null(0).cast(pl.Float64).abs().to_numpy().max(initial=0.0)) > EXACT


def _end(file) -> int:
    """Where the last row ends, line breaks behind it not counted."""
    end = file.seek(0, os.SEEK_END)
    while end:
        begin = max(0, end - HEAD)
        file.seek(begin)
        block = file.read(end - begin).rstrip(b"\r\n")
        end = begin + len(block)
        if block:
            break
    return end


def _lines(
    path: Path, places: np.ndarray, counts: np.ndarray, start: int, stop: int
) -> tuple[bytes, int]:
    """The lines between the marks around some rows, and the number of rows before them."""
    low = max(0, int(np.searchsorted(counts, start, "right")) - 1)
    high = min(len(counts) - 1, max(low + 1, int(np.searchsorted(counts, stop, "left"))))
    with path.open("rb") as file:
        file.seek(int(places[low]))
        return file.read(int(places[high] - places[low])), int(counts[low])


def open_parts(path: Path) -> AbstractParts:
    """Opens a file of numbers by its suffix, to be read part by part.

    Raises:
        InputError: If the file is missing, of another kind, or damaged.
    """
    suffix = path.suffix.lower()
    if not path.is_file():
        raise InputError(f"`{path}` is no file: check the path of the log.")
    if suffix in SUFFIXES:
        return TextParts.of(path)
    if suffix == ".parquet":
        found = ParquetParts(path)
        found.part(0, 1)
        return found
    if suffix == ".npz":
        try:
            return ArrayParts.of(path)
        except zipfile.BadZipFile as error:
            raise InputError(f"`{path.name}` is no NPZ file ({error}).") from error
    raise InputError(
        f"`{path.name}` must end in {', '.join(SUFFIXES)}, .parquet or .npz to be read part by "
        "part: convert it to one of them."
    )


def estimated_rows(path: Path) -> int:
    """About how many rows a file has, at a glance; 0 for one that cannot be read part by part."""
    suffix = path.suffix.lower()
    if suffix in SUFFIXES and path.is_file():
        with path.open("rb") as file:
            head = file.read(HEAD)
        return path.stat().st_size * head.count(b"\n") // max(len(head), 1)
    if suffix not in (".parquet", ".npz"):
        return 0
    try:
        return open_parts(path).rows
    except ValueError:
        return 0

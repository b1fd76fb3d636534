"""Channels of a log file as numbers, and complaints about rows that hold none."""

import contextlib
import dataclasses
import functools
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from jaxid.arrays import Matrix, Texts, Vector
from jaxid.errors import InputError

from ..recording import MAX_NUMBER
from ..time_grid import NeedsMemory
from ..time_series import MIN_SPARSE_SHARE

Complaints = dict[int, str]
"""Complaints about rows, by their numbers."""
COMMENT = "a comment"
"""Complaint about a line that is no row, and no bad one either."""
BadRows = Complaints | None
"""Complaints about unreadable rows, by row number; None if each is an error."""
NUMBER_SIZE = 8
"""Bytes of a number in memory, whatever its type in the file."""
MAX_INFLATION = 20
"""Memory of a log, relative to the size of its file; measurements compress less."""
MIN_REFUSED_MEMORY = 2**26
"""Memory that any file may need [bytes]."""
NO_NUMBER = "not a number"
"""Words of the complaint about a cell with another text."""
NUMBER_PARTS = {
    r"(?i)(\d\.?)d([+-]?\d+)$": "${1}e$2",
    r"^([+-]?[1-9]\d{0,2}),(\d{3}\.)": "$1$2",
}
"""Parts of numbers that Fortran and spreadsheets write, and what they become."""


@contextlib.contextmanager
def readable(source: str, kind: str) -> Iterator[None]:
    """Report a file that a library cannot read as damaged."""
    try:
        yield
    except InputError:
        raise
    except (Exception, pl.exceptions.PanicException) as error:
        # Of many kinds: it depends on which bytes are damaged.
        # Some add a dump of the data in braces, or a mark below a line.
        text, *_ = re.split(r"[{^]", " ".join(str(error).split()))
        reason = text[:200].rstrip(" .:;,(") or "its parts contradict each other"
        if isinstance(error, MemoryError):
            reason = "it declares more data than fit into memory"
        elif isinstance(error, UnicodeDecodeError):
            reason = "it holds bytes that are not text"
        raise InputError(
            f"`{source}` is damaged or not a valid {kind}: {reason}."
        ) from error


def refuse_inflation(path: Path, sizes: Mapping[str, int]) -> None:
    """Refuse columns whose sizes in memory [bytes] do not suit that of their file."""
    file_size = path.stat().st_size
    if sum(sizes.values()) > max(MIN_REFUSED_MEMORY, MAX_INFLATION * file_size):
        name = max(sizes, key=lambda name: sizes[name])
        raise InputError(
            f"`{name}` of `{path.name}` needs {sizes[name]:.3g} bytes of memory, but "
            f"the whole file has {file_size}: save it again with the recorded samples "
            "only, or without compression."
        )


@dataclasses.dataclass(frozen=True, eq=False)
class LogTable:
    """Channels of one file, in memory or on disk.

    Attributes:
        source: Name of the file, for messages.
        columns: Columns, or whole arrays (samples x joints), by name; or a lazy frame.
        channels: Names of the columns of each channel, in the order of the joints.
        first_row: Number of the first row in the file, for messages.
        unit: Name of a row, for messages: `line` in text files.
        bad_rows: Complaints about rows that cannot be read, by their numbers; None if
            the first one is an error.
        notes: Remarks about how the columns were made.
        is_merged: Whether channels have times of their own, and are NaN at others.
    """

    source: str
    columns: Any
    channels: Mapping[str, Texts]
    first_row: int = 1
    unit: str = "row"
    bad_rows: BadRows = None
    notes: Texts = ()
    is_merged: bool = False

    @functools.cached_property
    def rows(self) -> int:
        """Number of rows."""
        if isinstance(self.columns, pl.LazyFrame):
            with readable(self.source, "Parquet file"):
                rows = int(self.columns.select(pl.len()).collect().item())
        else:
            rows = self._common_length()
        if rows == 0:
            raise InputError(f"`{self.source}` has no rows: is the log cut?")
        return rows

    def _common_length(self) -> int:
        first_name, *other_names = itertools.chain(*self.channels.values())
        length = len(self.columns[first_name])
        for name in other_names:
            samples = len(self.columns[name])
            if samples != length:
                raise InputError(
                    f"`{name}` of `{self.source}` has {samples} samples, but "
                    f"`{first_name}` has {length}: one row for each sample is needed."
                )
        return length

    def read(
        self, channels: Iterable[str], start: int = 0, stop: int | None = None
    ) -> "LogTable":
        """Return some rows of some channels, in memory."""
        subset = {channel: self.channels[channel] for channel in channels}
        names = list(itertools.chain(*subset.values()))
        if isinstance(self.columns, pl.LazyFrame):
            length = None if stop is None else stop - start
            with readable(self.source, "Parquet file"):
                frame = self.columns.select(names).slice(start, length).collect()
            columns = frame.to_dict(as_series=True)
        else:
            columns = {name: self.columns[name][start:stop] for name in names}
        row = self.first_row + start
        return dataclasses.replace(
            self, columns=columns, channels=subset, first_row=row
        )

    def stamps(self, unit: float) -> Vector:
        """Return the time stamps [s] of a unit [s]; dates have their own.

        Integers and dates count from the first of these rows: nanoseconds since 1970 do
        not fit into float64, but their differences do.
        """
        names = self.channels["time"]
        if len(names) == 2:
            seconds, parts = (self.numbers(name)[:, 0] for name in names)
            return seconds - seconds[0] + 1e-9 * parts
        (name,) = names
        column = self.columns[name]
        if isinstance(column, pl.Series) and column.dtype.is_temporal():
            ticks = nanoseconds(column)
            self.refuse_first(name, ticks.is_null().to_numpy(), ticks, "is empty")
            integers = ticks.to_numpy()
            return (integers - integers[0]) * 1e-9
        integers = integer_array(column)
        if integers is not None:
            elapsed_ticks = (integers - integers[0]).astype(np.float64)
            return elapsed_ticks * unit
        block = self.numbers(name)
        if block.shape[1] != 1:
            raise InputError(
                f"`{name}` of `{self.source}` must be one column, but has "
                f"{block.shape[1]}."
            )
        return block[:, 0] * unit

    def numbers(self, name: str) -> Matrix:
        """Return a column as finite numbers (samples x columns)."""
        column = self.columns[name]
        if isinstance(column, pl.Series):
            array = self._series_numbers(name, column)
        elif column.dtype.kind in "iufb" and column.ndim <= 2:
            with np.errstate(invalid="ignore"):  # signalling NaN
                array = np.asarray(column, np.float64)
        else:
            array = np.zeros(0)
        if array.size == 0:
            raise InputError(
                f"`{name}` of `{self.source}` must hold columns of real numbers, but "
                f"holds {column.dtype} of shape {column.shape}."
            )
        array = np.array(array.reshape(len(array), -1), np.float64)
        size = np.abs(array).max(axis=1)
        complaint = "is not finite, or too large for a sensor ({:.2g} in size)"
        self.refuse_first(name, ~(size <= MAX_NUMBER), size, complaint)
        return array

    def _series_numbers(self, name: str, column: pl.Series) -> Vector:
        try:
            numbers = column.cast(pl.Float64, strict=False)
            if column.dtype == pl.String and numbers.null_count():
                texts = column.str.strip_chars()
                for pattern, text in NUMBER_PARTS.items():
                    texts = texts.str.replace(pattern, text)
                numbers = texts.cast(pl.Float64, strict=False)
        except pl.exceptions.PolarsError as error:
            raise InputError(
                f"column `{name}` of `{self.source}` holds {column.dtype}: name one "
                "of numbers."
            ) from error
        texts = column.drop_nulls()
        # Drivers that measure nothing write words without digits.
        if numbers.is_null().all() and re.search(r"\d", str(texts.first())):
            raise InputError(
                f"column `{name}` of `{self.source}` holds texts such as "
                f"`{texts.first()}`: name one of numbers, or export the log with one "
                "number in each cell."
            )
        is_empty = column.is_null().to_numpy()
        self.refuse_first(name, is_empty, column, "is empty")
        is_text = numbers.is_null().to_numpy()
        self.refuse_first(name, is_text, column, f"is `{{}}`, {NO_NUMBER}")
        # Damaged bytes may be a NaN with which NumPy warns.
        return numbers.fill_nan(np.nan).to_numpy()

    def refuse_first(
        self, name: str, is_bad: np.ndarray, column: Any, complaint: str
    ) -> None:
        """Refuse the first bad row of a column, or collect complaints about all."""
        rows = np.flatnonzero(is_bad).tolist()
        if self.bad_rows is not None:
            numbers = {k + self.first_row for k in rows}
            # A damaged file may hold a million of them.
            for number in numbers - self.bad_rows.keys():
                words = complaint.format(column[number - self.first_row])
                text = f"{self.unit} {number} (`{name}` {words})"
                self.bad_rows[number] = text
        elif len(rows) > MIN_SPARSE_SHARE * len(is_bad):
            raise NeedsMemory(
                f"many cells of `{name}` of `{self.source}` hold no number. If this is "
                "a merged table, read it with `read_recording`."
            )
        elif rows:
            number = rows[0] + self.first_row
            words = complaint.format(column[rows[0]])
            further_rows = f" (and {len(rows) - 1} more)" if len(rows) > 1 else ""
            raise NeedsMemory(
                f"column `{name}` of `{self.source}`, {self.unit} {number}, "
                f"{words}{further_rows}: repair the log or remove those rows."
            )


def nanoseconds(column: pl.Series) -> pl.Series:
    """Return dates as integers [ns]."""
    is_duration = column.dtype == pl.Duration
    kind = pl.Duration("ns") if is_duration else pl.Datetime("ns")
    return column.cast(kind).cast(pl.Int64)


def integer_array(column: Any) -> np.ndarray | None:
    """Return a column of integers as an array; None if it is another one."""
    # An empty cell of a series makes its array one of floats.
    array = np.asarray(column)
    is_whole = array.dtype.kind in "iu" and array.ndim == 1
    return array.astype(np.int64) if is_whole else None

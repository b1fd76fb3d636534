"""Text files: tables of any separator, with or without a header."""

import atexit
import codecs
import dataclasses
import io
import itertools
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import polars as pl

from jaxid.arrays import Vector
from jaxid.errors import InputError

from ..text_format import (
    STAMP,
    TextColumns,
    TextFormat,
    is_number,
    split_line,
    with_line_feeds,
)
from ..time_grid import NeedsMemory
from .log_file import AbstractLogFile
from .log_table import COMMENT, BadRows, Complaints, LogTable, readable

BLOCK_SIZE = 2**26
"""Bytes that are read at once."""
MAX_BAD_LINES = 100_000
"""Lines of such a block that may be no rows; with more the text is no table."""
MAX_EXACT_INTEGER = 2**53
"""Largest size of integers that float64 holds without rounding."""
HOUR = 3600 * 10**9
"""Length of an hour [ns]."""
DAY = 24 * HOUR
"""Length of a day [ns]."""
ZONE = r" ?(Z|[+-]\d\d:?\d\d)$"
"""Distance from the time of Greenwich, which may change within a log."""
STAMP_PARTS = {
    ZONE: "",
    r"^(\d+:\d+[.,]\d+)$": "00:${1}",
    "T": " ",
    "/": "-",
    ",": ".",
    r"^(\d+ days? )?(\d+:)": "1970-01-01 ${2}",
}
"""Parts of dates and times, and what they become in dates of one form."""

_conversions: dict[tuple, Path] = {}
"""Folders with the Parquet files of long text files."""


class TextFile(TextColumns, AbstractLogFile):
    """Table of text; it stays on the disk as Parquet, to which it is converted once."""

    def estimated_rows(self):  # noqa: D102
        head = self.head()
        return self.path.stat().st_size * head.count(b"\n") // max(len(head), 1)

    def table(self, channels, on_disk, bad_rows):  # noqa: D102
        table = LogTable(
            self.path.name,
            columns={},
            channels=channels,
            first_row=self.format.first_line,
            unit="line",
            bad_rows=bad_rows,
        )
        if on_disk:
            columns = pl.scan_parquet(self._parquet_folder(table) / "*.parquet")
        else:
            columns = pl.concat(self._frames(table)).lazy()
        return dataclasses.replace(table, columns=columns)

    def _parquet_folder(self, table: LogTable) -> Path:
        """Convert the columns to Parquet, unless this was done."""
        time = self.path.stat().st_mtime_ns
        key = (self.path.resolve(), time, *table.channels.values())
        if key not in _conversions:
            folder = Path(tempfile.mkdtemp(prefix="jaxid-"))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            for number, frame in enumerate(self._frames(table)):
                frame.write_parquet(folder / f"{number:09}.parquet")
            _conversions[key] = folder
        return _conversions[key]

    def _frames(self, table: LogTable) -> Iterator[pl.DataFrame]:
        """Yield the numbers of consecutive blocks of lines."""
        names = list(itertools.chain(*table.channels.values()))
        first_line = table.first_row
        read_stamps = None
        times = table.channels.get("time", ())
        number_names = [name for name in names if name not in times]
        with self.path.open("rb") as file:
            for block in line_blocks(file, first_line - 1):
                cells = self._cells(block, first_line, table.bad_rows)
                part = dataclasses.replace(table, columns=cells, first_row=first_line)
                columns: dict[str, Any] = {
                    name: part.numbers(name)[:, 0] for name in number_names
                }
                for name in times:
                    read_stamps = read_stamps or stamp_reader(part, name)
                    columns[name] = read_stamps(part, name)
                yield pl.DataFrame(columns)
                first_line += len(cells[names[0]])
        if first_line == table.first_row:
            raise InputError(f"`{self.path.name}` has no rows: is the log cut?")

    def _cells(
        self, block: bytes, first_line: int, bad_rows: BadRows
    ) -> dict[str, pl.Series]:
        """Return the cells of whole lines; those of lines without a row are empty."""
        if self.format.separator == " ":
            lines = block.split(b"\n")
            block = b"\n".join(b" ".join(line.split()) for line in lines)
        complaints = bad_lines(self.format, block)
        if len(complaints) > MAX_BAD_LINES:
            raise InputError(
                f"{len(complaints)} lines of `{self.path.name}` are not rows, such as "
                f"line {first_line + min(complaints)}: export the log again."
            )
        if complaints:
            lines = block.split(b"\n")
            for k, complaint in complaints.items():
                number = first_line + k
                if bad_rows is None:
                    raise NeedsMemory(
                        f"line {number} of `{self.path.name}` is not a row "
                        f"({complaint}): repair or remove that line."
                    )
                bad_rows[number] = f"line {number} ({complaint})"
                lines[k] = blank_row(self.format)
            block = b"\n".join(lines)
        with readable(self.path.name, "table of text"):
            return read_lines(self.format, block)


def blank_row(form: TextFormat) -> bytes:
    """Return a line whose cells are empty."""
    separators = form.separator * (len(form.names) - 1)
    return separators.encode() or b'""'


def read_lines(form: TextFormat, block: bytes) -> dict[str, pl.Series]:
    """Return the cells of whole lines, as texts."""
    # The first line has all columns; rows may lack the last ones.
    frame = pl.read_csv(
        io.BytesIO(blank_row(form) + b"\n" + block),
        schema=dict.fromkeys(form.names, pl.String()),
        separator=form.separator,
        has_header=False,
        encoding="utf8-lossy",
        truncate_ragged_lines=True,
    )
    if form.has_decimal_commas:
        frame = frame.select(pl.all().str.replace(",", ".", literal=True))
    return frame[1:].to_dict(as_series=True)


def bad_lines(form: TextFormat, block: bytes) -> Complaints:
    """Return complaints about lines that are no rows, by their positions."""
    separator = form.separator.encode()
    is_suspect = count_per_line(block, separator) != len(form.names) - 1
    if b'"' in block:
        is_suspect |= count_per_line(block, b'"') > 0
    suspects = np.flatnonzero(is_suspect).tolist()
    lines = block.split(b"\n") if suspects else []
    complaints = {}
    for k in suspects:
        # Separators between quotation marks are text.
        text = b"_".join(lines[k].split(b'"')[::2])
        cells = text.count(separator) + 1 if text.strip() else 0
        # Empty cells beyond the last column do not count.
        filled_cells = text.rstrip(separator).count(separator) + 1
        if lines[k].count(b'"') % 2:
            complaints[k] = "an open quotation"
        elif cells < form.columns or filled_cells > len(form.names):
            line_cells = split_line(text.decode(errors="replace"), form.separator)
            # An empty line may stand for a row, but not one of words.
            is_comment = any(line_cells) and not any(map(is_number, line_cells))
            complaint = f"{cells} cells, but {form.columns} columns"
            complaints[k] = COMMENT if is_comment else complaint
    return complaints


def line_blocks(file: BinaryIO, lines_before: int) -> Iterator[bytes]:
    """Yield blocks of whole lines; empty lines at the end of a file are left out.

    The first lines, before the rows, are left out as well.
    """
    blank_lines = b""
    while block := file.read(BLOCK_SIZE) + file.readline():
        block = blank_lines + with_line_feeds(block)
        if lines_before:
            lines = block.split(b"\n", lines_before)
            block = lines[-1] if len(lines) > lines_before else b""
            lines_before = 0
        block = block.removeprefix(codecs.BOM_UTF8)
        rows = block.rstrip(b"\n")
        blank_lines = block[len(rows) :].partition(b"\n")[2] if rows else block
        if rows:
            yield rows


def count_per_line(block: bytes, character: bytes) -> np.ndarray:
    """Return how often each line of a text holds a character."""
    text = np.frombuffer(block, np.uint8)
    line_ends = np.flatnonzero(text == ord("\n"))
    positions = np.flatnonzero(text == ord(character))
    # Positions before the end of each line.
    counts = np.searchsorted(positions, np.append(line_ends, len(text)))
    return np.diff(counts, prepend=0)


def stamp_reader(part: LogTable, name: str) -> Callable[[LogTable, str], Any]:
    """Return the function that reads all time stamps of a log like these."""
    texts = part.columns[name].str.strip_chars()
    if (texts.str.contains(STAMP).mean() or 0.0) > 0.5:
        return calendar_stamps
    numbers = texts.cast(pl.Float64, strict=False).abs().fill_nan(None)
    return tick_stamps if (numbers.max() or 0.0) > MAX_EXACT_INTEGER else number_stamps


def number_stamps(part: LogTable, name: str) -> Vector:
    """Return stamps that are numbers of moderate size."""
    return part.numbers(name)[:, 0]


def tick_stamps(part: LogTable, name: str) -> Any:
    """Return stamps as integers, if all of good rows are: float64 cannot hold them."""
    numbers = number_stamps(part, name)
    texts = part.columns[name].str.strip_chars()
    ticks = texts.cast(pl.Int64, strict=False)
    bad_rows = part.bad_rows or ()
    if ticks.null_count() > len(bad_rows):
        return numbers
    return without_gaps(ticks)


def without_gaps(ticks: pl.Series) -> pl.Series:
    """Return integers, those of bad rows as in the row before or behind."""
    return ticks.fill_null(strategy="forward").fill_null(strategy="backward")


def calendar_stamps(part: LogTable, name: str) -> pl.Series:
    """Return dates, times since midnight or durations, as dates."""
    texts = part.columns[name].str.strip_chars()
    # Minutes of zones do not change.
    zone_hours = texts.str.extract(r":\d\d.*([+-]\d\d):?\d\d$").cast(pl.Int64)
    for pattern, text in STAMP_PARTS.items():
        texts = texts.str.replace_all(pattern, text)
    dates = texts.str.to_datetime("%Y-%m-%d %T%.f", time_unit="ns", strict=False)
    complaint = "is `{}`, neither a number nor a time"
    is_bad = dates.is_null().to_numpy()
    part.refuse_first(name, is_bad, part.columns[name], complaint)

    ticks = without_gaps(dates.cast(pl.Int64) - HOUR * zone_hours.fill_null(0))
    if (ticks < DAY).all():
        # A clock without a date begins again at midnight, one without hours earlier.
        period = HOUR if (ticks < HOUR).all() else DAY
        starts = (ticks.diff() < -period // 2).cast(pl.Int64).cum_sum()
        ticks += period * starts.fill_null(0)
    return ticks.cast(dates.dtype)

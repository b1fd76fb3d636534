"""Text files: tables of any separator, with or without a header."""

import atexit
import codecs
import dataclasses
import functools
import io
import itertools
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import polars as pl

from jaxid.arrays import Texts, Vector
from jaxid.errors import InputError

from .log_file import AbstractLogFile
from .log_table import BadRows, Complaints, LogTable, readable

HEAD_SIZE = 65536
"""Bytes from which the format is detected."""
BLOCK_SIZE = 2**26
"""Bytes that are read at once."""
MAX_EXACT_INTEGER = 2**53
"""Largest size of integers that float64 holds without rounding."""

_conversions: dict[tuple, Path] = {}
"""Folders with the Parquet files of long text files."""


class TextFormat(NamedTuple):
    """Format of a table of text."""

    names: Texts  # names of the columns; positions without a header
    has_header: bool
    separator: str  # a space is any number of spaces or tabs
    has_decimal_commas: bool
    start: int  # bytes before the first row

    def read_lines(self, block: bytes) -> dict[str, pl.Series]:
        """Return the cells of whole lines, as texts."""
        frame = pl.read_csv(
            io.BytesIO(block),
            schema=dict.fromkeys(self.names, pl.String()),
            separator=self.separator,
            has_header=False,
            encoding="utf8-lossy",
        )
        if self.has_decimal_commas:
            frame = frame.select(pl.all().str.replace(",", ".", literal=True))
        return frame.to_dict(as_series=True)

    def bad_lines(self, block: bytes) -> Complaints:
        """Return complaints about lines that are no rows, by their positions."""
        separator = self.separator.encode()
        columns = len(self.names)
        is_suspect = count_per_line(block, separator) != columns - 1
        if b'"' in block:
            is_suspect |= count_per_line(block, b'"') > 0
        suspects = np.flatnonzero(is_suspect).tolist()
        lines = block.split(b"\n") if suspects else []
        complaints = {}
        for k in suspects:
            # Separators between quotation marks are text.
            text = b"".join(lines[k].split(b'"')[::2])
            cells = text.count(separator) + 1 if lines[k].strip() else 0
            if lines[k].count(b'"') % 2:
                complaints[k] = "an open quotation"
            elif cells != columns:
                complaints[k] = f"{cells} cells, but {columns} columns"
        return complaints

    def empty_line(self) -> bytes:
        """Return a line whose cells are empty."""
        separators = self.separator * (len(self.names) - 1)
        return separators.encode() or b'""'


class TextFile(AbstractLogFile):
    """Table of text; it stays on the disk as Parquet, to which it is converted once."""

    @functools.cached_property
    def format(self) -> TextFormat:
        """Format of the text."""
        return detect_format(self.path.name, self._head())

    @property
    def names(self):  # noqa: D102
        return self.format.names

    @property
    def has_header(self):  # noqa: D102
        return self.format.has_header

    def estimated_rows(self):  # noqa: D102
        head = self._head()
        return self.path.stat().st_size * head.count(b"\n") // max(len(head), 1)

    def table(self, channels, on_disk, bad_rows):  # noqa: D102
        table = LogTable(
            self.path.name,
            columns={},
            channels=channels,
            first_row=2 if self.has_header else 1,
            unit="line",
            bad_rows=bad_rows,
        )
        if on_disk:
            columns = pl.scan_parquet(self._parquet_folder(table) / "*.parquet")
        else:
            columns = pl.concat(self._frames(table)).lazy()
        return dataclasses.replace(table, columns=columns)

    def _head(self) -> bytes:
        with self.path.open("rb") as file:
            return file.read(HEAD_SIZE)

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
        are_ticks = None
        with self.path.open("rb") as file:
            file.seek(self.format.start)
            for block in line_blocks(file):
                cells = self._cells(block, first_line, table.bad_rows)
                part = dataclasses.replace(table, columns=cells, first_row=first_line)
                columns: dict[str, Any] = {
                    name: part.numbers(name)[:, 0] for name in names
                }
                for name in table.channels.get("time", ()):
                    if are_ticks is None:
                        largest_stamp = np.nanmax(np.abs(columns[name]), initial=0.0)
                        are_ticks = largest_stamp > MAX_EXACT_INTEGER
                    if are_ticks:
                        columns[name] = _ticks(part, name, columns[name])
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
        complaints = self.format.bad_lines(block)
        if complaints:
            lines = block.split(b"\n")
            for k, complaint in complaints.items():
                number = first_line + k
                if bad_rows is None:
                    raise InputError(
                        f"line {number} of `{self.path.name}` is no row ({complaint}): "
                        "repair or remove that line."
                    )
                bad_rows[number] = f"line {number} ({complaint})"
                lines[k] = self.format.empty_line()
            block = b"\n".join(lines)
        with readable(self.path.name, "table of text"):
            return self.format.read_lines(block)


def line_blocks(file: BinaryIO) -> Iterator[bytes]:
    """Yield blocks of whole lines; empty lines at the end of a file are left out."""
    blank_lines = b""
    while block := file.read(BLOCK_SIZE) + file.readline():
        block = blank_lines + block
        rows = block.rstrip(b"\r\n")
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


def _ticks(part: LogTable, name: str, numbers: Vector) -> Any:
    """Return stamps as integers, if all of good rows are: float64 cannot hold them."""
    texts = part.columns[name].str.strip_chars()
    ticks = texts.cast(pl.Int64, strict=False)
    bad_rows = part.bad_rows or ()
    return ticks.fill_null(0) if ticks.null_count() <= len(bad_rows) else numbers


def detect_format(source: str, head: bytes) -> TextFormat:
    """Detect the format of a text file by its first bytes."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"`{source}` is text in UTF-16: save it again in UTF-8.")
    if b"\0" in head:
        raise InputError(
            f"`{source}` is no text, as its suffix says: give it the suffix of its "
            "format, or export it again."
        )
    first_line, _, _ = head.partition(b"\n")
    # Some programs write the header as a comment.
    text = first_line.decode("utf-8-sig", errors="replace").strip("\r").lstrip("#% ")
    if not text.strip():
        raise InputError(
            f"`{source}` must start with a header or with numbers, but is empty."
        )
    separators = [s for s in (";", "\t", ",", " ") if s in text.strip()]
    separator = separators[0] if separators else ","
    if separator == " ":
        text = " ".join(text.split())
    cells = [cell.strip().strip('"') for cell in text.split(separator)]
    has_header = not are_numbers(cells)
    names = cells if has_header else [str(k) for k in range(len(cells))]
    repeated_names = sorted({name for name in names if names.count(name) > 1})
    if repeated_names:
        raise InputError(
            f"the header of `{source}` names the column `{repeated_names[0]}` twice: "
            "rename one of them."
        )
    mark = len(codecs.BOM_UTF8) if first_line.startswith(codecs.BOM_UTF8) else 0
    return TextFormat(
        names=tuple(names),
        has_header=has_header,
        separator=separator,
        has_decimal_commas=separator == ";" and has_decimal_comma(head),
        start=min(len(first_line) + 1, len(head)) if has_header else mark,
    )


def are_numbers(cells: Sequence[str]) -> bool:
    """Return whether cells that are not empty hold numbers; some must."""
    texts = [cell.replace(",", ".") for cell in cells if cell]
    numbers = pl.Series(texts, dtype=pl.String).cast(pl.Float64, strict=False)
    return bool(texts) and numbers.null_count() == 0


def has_decimal_comma(head: bytes) -> bool:
    """Return whether a comma stands between two digits somewhere."""
    return re.search(rb"\d,\d", head) is not None

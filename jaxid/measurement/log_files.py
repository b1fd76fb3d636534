"""Log files as columns: texts of any separator, Parquet, arrays, and bags."""

import atexit
import codecs
import contextlib
import dataclasses
import difflib
import functools
import io
import itertools
import re
import shutil
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import polars as pl

from jaxid.errors import InputError

from .array_files import (
    map_arrays,
    read_hdf5,
    read_mat,
    read_npz,
    readable,
    with_elements,
)
from .bags import BAGS, CLOCK, is_bag, join_topics, read_bag
from .recording import LARGEST

Selection = str | int | tuple[str | int, ...]
"""A name, a pattern with `{}` for the joint's number, a position from 0, or several."""
Selections = Mapping[str, Selection | None]
"""Selections by channel; None is the clock that some kinds of files have."""
SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
"""Suffixes of text files."""
HEAD = 65536
"""Bytes from which a format is detected."""
BLOCK = 2**26
"""Bytes of a text file that are read at once."""


@dataclasses.dataclass(frozen=True, eq=False)
class LogTable:
    """Channels of one file, in memory or on disk."""

    source: str  # name of the file, for messages
    columns: (
        Any  # columns, or whole arrays (samples x joints), by name; or a lazy frame
    )
    # names of the columns of each channel, in the order of the joints
    channels: Mapping[str, tuple[str, ...]]
    first_row: int = 1  # number of the first row in the file, for messages
    unit: str = "row"  # name of a row, for messages: `line` in text files
    # complaints about rows that cannot be read, by their numbers; None if the first one
    # is an error
    bad: dict[int, str] | None = None
    notes: tuple[str, ...] = ()  # remarks about how the columns were made

    @functools.cached_property
    def rows(self) -> int:
        """Number of rows."""
        if isinstance(self.columns, pl.LazyFrame):
            with readable(self.source, "Parquet file"):
                rows = int(self.columns.select(pl.len()).collect().item())
        else:
            first, *others = itertools.chain(*self.channels.values())
            rows = len(self.columns[first])
            for name in others:
                if (own := len(self.columns[name])) != rows:
                    raise InputError(
                        f"`{name}` of `{self.source}` has {own} samples, but "
                        f"`{first}` has {rows}: "
                        "one row for each sample is needed."
                    )
        if rows == 0:
            raise InputError(f"`{self.source}` has no rows: is the log cut?")
        return rows

    def read(
        self, channels: Iterable[str], start: int = 0, stop: int | None = None
    ) -> "LogTable":
        """Return some rows of some channels, in memory."""
        kept = {channel: self.channels[channel] for channel in channels}
        names = list(itertools.chain(*kept.values()))
        columns = self.columns
        if isinstance(columns, pl.LazyFrame):
            with readable(self.source, "Parquet file"):
                length = None if stop is None else stop - start
                part = columns.select(names).slice(start, length).collect()
                columns = part.to_dict(as_series=True)
        else:
            columns = {name: columns[name][start:stop] for name in names}
        row = self.first_row + start
        return dataclasses.replace(self, columns=columns, channels=kept, first_row=row)

    def stamps(self) -> tuple[np.ndarray, bool]:
        """Return the time stamps, and whether they are dates (then in seconds).

        Integers and dates count from the first of these rows: nanoseconds since 1970 do
        not fit into float64, but their differences do.
        """
        (name,) = self.channels["time"]
        column = self.columns[name]
        if isinstance(column, pl.Series) and column.dtype.is_temporal():
            fine = (
                pl.Duration("ns") if column.dtype == pl.Duration else pl.Datetime("ns")
            )
            ticks = column.cast(fine).cast(pl.Int64)
            self._refuse_first(name, ticks.is_null().to_numpy(), ticks, "is empty")
            integers = ticks.to_numpy()
            return (integers - integers[0]) * 1e-9, True
        if (
            isinstance(column, pl.Series)
            and column.dtype.is_integer()
            and not column.null_count()
        ):
            column = column.to_numpy()
        if (
            isinstance(column, np.ndarray)
            and column.ndim == 1
            and column.dtype.kind in "iu"
        ):
            return (column.astype(np.int64) - np.int64(column[0])).astype(
                np.float64
            ), False
        block = self.numbers(name)
        if block.shape[1] != 1:
            raise InputError(
                f"`{name}` of `{self.source}` must be one column, but has "
                f"{block.shape[1]}."
            )
        return block[:, 0], False

    def numbers(self, name: str) -> np.ndarray:
        """Return a column as finite numbers (samples x columns)."""
        column = self.columns[name]
        if isinstance(column, pl.Series):
            array = self._series(name, column)
        elif column.dtype.kind in "iufb" and column.ndim <= 2:
            with np.errstate(invalid="ignore"):  # signalling NaN
                array = np.asarray(column, np.float64)
        else:
            array = np.zeros(0)
        if array.size == 0:
            raise InputError(
                f"`{name}` of `{self.source}` must hold columns of real numbers, but "
                "holds "
                f"{column.dtype} of shape {column.shape}."
            )
        array = np.array(array.reshape(len(array), -1), np.float64)
        size = np.abs(array).max(axis=1)
        complaint = "is not finite, or larger than any sensor tells ({} in size)"
        self._refuse_first(name, ~(size <= LARGEST), size, complaint)
        return array

    def _series(self, name: str, column: pl.Series) -> np.ndarray:
        try:
            numbers = column.cast(pl.Float64, strict=False)
            if column.dtype == pl.String and numbers.null_count():
                numbers = column.str.strip_chars().cast(pl.Float64, strict=False)
        except pl.exceptions.PolarsError as error:
            raise InputError(
                f"column `{name}` of `{self.source}` holds {column.dtype}: name one "
                "of numbers."
            ) from error
        self._refuse_first(name, column.is_null().to_numpy(), column, "is empty")
        self._refuse_first(
            name, numbers.is_null().to_numpy(), column, "is `{}`, no number"
        )
        return numbers.to_numpy()

    def _refuse_first(
        self, name: str, bad: np.ndarray, column: Any, complaint: str
    ) -> None:
        rows = np.flatnonzero(bad)
        if self.bad is not None:
            for k in rows.tolist():
                text = (
                    f"{self.unit} {k + self.first_row} (`{name}` "
                    f"{complaint.format(column[k])})"
                )
                self.bad.setdefault(k + self.first_row, text)
        elif rows.size:
            first = int(rows[0])
            more = f" (and {rows.size - 1} more)" if rows.size > 1 else ""
            raise InputError(
                f"column `{name}` of `{self.source}`, {self.unit} "
                f"{first + self.first_row}, "
                f"{complaint.format(column[first])}{more}: repair the log or remove "
                "those rows."
            )


def open_table(
    path: Path, selections: Selections, on_disk: bool, lenient: bool = False
) -> LogTable:
    """Open a file; its suffix tells the format. With `lenient`, bad rows are collected."""
    if path.suffix.lower() in SUFFIXES and path.is_file():
        return _open_text(path, selections, on_disk, lenient)
    chosen = itertools.chain(
        *(x if isinstance(x, tuple) else [x] for x in selections.values())
    )
    columns, layout = _open_columns(
        path, on_disk, {str(x).partition(".")[0] for x in chosen}
    )
    channels, notes = layout.channels(selections), ()
    if isinstance(columns, list):
        columns, notes = join_topics(
            path.name, columns, [*itertools.chain(*channels.values())]
        )
    return LogTable(
        path.name, columns, channels, bad={} if lenient else None, notes=notes
    )


def summarise_columns(path: Path) -> str:
    """Return the names of the columns of a file, as messages show them."""
    _, layout = _open_columns(path, on_disk=True)
    return f"`{'`, `'.join(_shortened(layout.names))}`"


def _open_columns(
    path: Path, on_disk: bool, topics: Collection[str] = ()
) -> tuple[Any, "_Layout"]:
    """Return the columns of a file (None of a text), or the topics of a bag; and names."""
    suffix, clock = path.suffix.lower(), ""
    if is_bag(path):
        columns, clock = read_bag(path, topics), CLOCK
        names = itertools.chain(*(topic.columns for topic in columns))
    elif not path.is_file():
        raise InputError(
            f"`{path}` is no file and no bag of ROS 2: check the path of the log."
        )
    elif suffix in SUFFIXES:
        with path.open("rb") as file:
            return None, _detect_format(path.name, file.read(HEAD))
    elif suffix == ".parquet":
        with readable(path.name, "Parquet file"):
            columns = _with_elements(pl.scan_parquet(path))
            names = columns.collect_schema().names()
        clock = "timestamp" if {"timestamp", "episode_index"} <= {*names} else ""
    elif suffix == ".npz":
        columns = names = with_elements(
            (map_arrays(path) if on_disk else None) or read_npz(path)
        )
    elif suffix in (".mat", ".h5", ".hdf5"):
        columns = names = with_elements(
            (read_mat if suffix == ".mat" else read_hdf5)(path)
        )
    else:
        known = ", ".join(
            (*SUFFIXES, ".parquet", ".npz", ".mat", ".h5", ".hdf5", *BAGS)
        )
        raise InputError(f"`{path.name}` must end in {known}: convert it.")
    return columns, _Layout(path.name, tuple(dict.fromkeys(names)), clock=clock)


def _with_elements(frame: pl.LazyFrame) -> pl.LazyFrame:
    """Add the elements of lists, named like `action[0]`; episodes follow each other after 10 s."""
    schema, columns = frame.collect_schema(), []
    kinds = {
        x: kind for x, kind in schema.items() if isinstance(kind, pl.List | pl.Array)
    }
    for name, values in (
        frame.select(list(kinds)).head(1).collect().to_dict(as_series=False).items()
    ):
        elements = pl.col(name).cast(pl.List(kinds[name].inner)).list
        for k in range(len(values[0] or ()) if values else 0):
            columns.append(elements.get(k, null_on_oob=True).alias(f"{name}[{k}]"))
    if {"timestamp", "episode_index"} <= {*schema}:
        stamps = pl.col("timestamp").cast(pl.Float64)
        begins = (pl.col("episode_index").diff() != 0).fill_null(False)
        pauses = pl.when(begins).then(10.0 - stamps.diff()).otherwise(0.0)
        columns.append((stamps + pauses.cum_sum()).alias("timestamp"))
    return frame.with_columns(columns).drop(list(kinds))


def estimated_rows(path: Path) -> int:
    """Estimate the number of rows of a file; 0 if it cannot be read in parts."""
    suffix = path.suffix.lower()
    with contextlib.suppress(InputError, OSError):
        if suffix in SUFFIXES:
            with path.open("rb") as file:
                head = file.read(HEAD)
            return path.stat().st_size * head.count(b"\n") // max(len(head), 1)
        if suffix == ".parquet":
            return LogTable(path.name, pl.scan_parquet(path), {}).rows
        if suffix == ".npz":
            return max(map(len, (map_arrays(path) or {}).values()), default=0)
    return 0


class _Layout(NamedTuple):
    """Names of the columns of a file (positions if they are not `named`), and a text's format."""

    source: str
    names: tuple[str, ...]
    named: bool = True
    separator: str = ","
    decimal_comma: bool = False
    start: int = 0
    clock: str = ""

    def channels(self, selections: Selections) -> dict[str, tuple[str, ...]]:
        """Return the names of the columns of each channel, each of which has its own."""
        channels = {
            c: self._expand(c, selection) for c, selection in selections.items()
        }
        names = [*itertools.chain(*channels.values())]
        if repeated := [name for name in names if names.count(name) > 1]:
            owners = [
                f"`{channel}`"
                for channel in channels
                if repeated[0] in channels[channel]
            ]
            raise InputError(
                f"the column `{repeated[0]}` of `{self.source}` is used twice, for "
                f"{' and '.join(owners)}: name the right one for each joint."
            )
        return channels

    def _expand(self, channel: str, selection: Selection | None) -> tuple[str, ...]:
        """Return the names of the columns of a selection, in the order of the joints."""
        if selection is None:
            if not self.clock:
                raise InputError(
                    f"`{self.source}` has no clock of its own: give `time` (its "
                    "column of time "
                    "stamps) or `sample_time` [s]."
                )
            return (self.clock,)
        if isinstance(selection, tuple):
            return tuple(self._name(channel, one) for one in selection)
        if selection not in self.names and f"{selection}[0]" in self.names:
            selection = f"{selection}[{{}}]"
        if isinstance(selection, int) or "{}" not in selection:
            return (self._name(channel, selection),)
        pattern = re.escape(selection).replace(re.escape("{}"), r"(\d{1,18})")
        found = sorted(
            (int(m[1]), m[0])
            for name in self.names
            if (m := re.fullmatch(pattern, name))
        )
        if not found:
            return (self._name(channel, selection.replace("{}", "1")),)
        numbers = [number for number, _ in found]
        columns = [column for _, column in found]
        first = min(numbers[0], 1)
        if numbers != list(range(first, first + len(numbers))):
            raise InputError(
                f"the columns of `{self.source}` for `{channel}`, "
                f"`{'`, `'.join(columns[:20])}`, "
                f"must have the numbers from {first} to {first + len(numbers) - 1}: "
                "name each."
            )
        return tuple(columns)

    def _name(self, channel: str, column: str | int) -> str:
        names = self.names
        if isinstance(column, int) and 0 <= column < len(names):
            return names[column]
        if self.named and column in names:
            return str(column)
        if isinstance(column, int) or not self.named:
            has = "columns" if self.named else "no header, and columns"
            raise InputError(
                f"`{channel}` asks for column {column} of `{self.source}`, which has "
                f"{has} from 0 "
                f"to {len(names) - 1}: give another position."
            )
        near = difflib.get_close_matches(column, _shortened(names), n=40, cutoff=0)
        raise InputError(
            f"`{self.source}` has no column `{column}` for `{channel}`: name one of "
            "its columns, "
            f"the closest first: `{'`, `'.join(near)}`."
        )

    def read_lines(
        self, rows: bytes, line: int, bad: dict[int, str] | None = None
    ) -> dict[str, pl.Series]:
        """Return the cells of whole lines, of which `line` is the first.

        Lines that are no rows are put into `bad`, and are empty then; without it they
        are an error.
        """
        if self.separator == " ":
            rows = b"\n".join(b" ".join(row.split()) for row in rows.splitlines())
        if bad is not None:
            rows = self._without_bad_lines(rows, line, bad)
        if b'"' in rows:
            for index, text in enumerate(rows.split(b"\n")):
                if text.count(b'"') % 2:
                    raise InputError(
                        f"line {index + line} of `{self.source}` opens a quotation: "
                        "close it there."
                    )
        try:
            frame = pl.read_csv(
                io.BytesIO(rows),
                schema=dict.fromkeys(self.names, pl.String()),
                separator=self.separator,
                has_header=False,
                encoding="utf8-lossy",
            )
        except pl.exceptions.PolarsError as error:
            cells = [
                text.count(self.separator.encode()) + 1 for text in rows.split(b"\n")
            ]
            most = len(self.names)
            wrong = next((k for k, count in enumerate(cells) if count > most), 0)
            raise InputError(
                f"line {wrong + line} of `{self.source}` has {cells[wrong]} cells, "
                "but there are "
                f"{most} columns: repair or remove that line."
            ) from error
        if self.decimal_comma:
            frame = frame.select(pl.all().str.replace(",", ".", literal=True))
        return frame.to_dict(as_series=True)

    def _without_bad_lines(self, rows: bytes, line: int, bad: dict[int, str]) -> bytes:
        """Return lines with empty ones in place of those that are no rows, which go into `bad`."""
        separator, count, lines = (
            self.separator.encode(),
            len(self.names),
            rows.split(b"\n"),
        )
        for k, text in enumerate(lines):
            # Separators between quotation marks are text.
            cells = (
                b"".join(text.split(b'"')[::2]).count(separator) + 1
                if text.strip()
                else 0
            )
            is_open = text.count(b'"') % 2 == 1
            if cells == count and not is_open:
                continue
            odd = (
                "an open quotation"
                if is_open
                else f"{cells} cells, but {count} columns"
            )
            bad[line + k] = f"line {line + k} ({odd})"
            lines[k] = separator * (count - 1) if count > 1 else b'""'
        return b"\n".join(lines)


def _shortened(names: Iterable[str]) -> list[str]:
    """Return names, with one for all columns of an array, like `q[{}]`."""
    return [*dict.fromkeys(re.sub(r"\[\d+\]$", "[{}]", name) for name in names)]


_conversions: dict[tuple, Path] = {}
"""Folders with the Parquet files of long text files."""


def _open_text(
    path: Path, selections: Selections, on_disk: bool, lenient: bool
) -> LogTable:
    """Read the needed columns of a text file, or convert them to Parquet unless this was done."""
    with path.open("rb") as file:
        text = _detect_format(path.name, file.read(HEAD))
        file.seek(text.start)
        channels = text.channels(selections)
        bad = {} if lenient else None
        table = LogTable(path.name, {}, channels, 1 + int(text.named), "line", bad)
        frames = _read_frames(file, text, table)
        if not on_disk:
            return dataclasses.replace(table, columns=pl.concat(frames).lazy())
        key = (path.resolve(), path.stat().st_mtime_ns, *channels.values())
        if key not in _conversions:
            folder = Path(tempfile.mkdtemp(prefix="jaxid-"))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            for number, frame in enumerate(frames):
                frame.write_parquet(folder / f"{number:09}.parquet")
            _conversions[key] = folder
    return dataclasses.replace(
        table, columns=pl.scan_parquet(_conversions[key] / "*.parquet")
    )


def _read_frames(
    file: BinaryIO, text: _Layout, table: LogTable
) -> Iterator[pl.DataFrame]:
    """Yield the numbers of consecutive blocks of lines."""
    names = list(itertools.chain(*table.channels.values()))
    stamps, exact, line, rest = (
        table.channels.get("time", ()),
        None,
        table.first_row,
        b"",
    )
    while data := file.read(BLOCK) + file.readline():
        data = rest + data
        rows = data.rstrip(b"\r\n")
        rest = data[len(rows) :].partition(b"\n")[2]
        if not rows:
            continue
        cells = text.read_lines(rows, line, table.bad)
        part = dataclasses.replace(table, columns=cells, first_row=line)
        columns: dict[str, Any] = {name: part.numbers(name)[:, 0] for name in names}
        for name in stamps:
            # Float64 cannot hold nanoseconds since 1970.
            largest = np.nanmax(np.abs(columns[name]), initial=0.0)
            exact = largest > 2**53 if exact is None else exact
            ticks = cells[name].str.strip_chars().cast(pl.Int64, strict=False)
            if exact and ticks.null_count() <= len(table.bad or ()):
                columns[name] = ticks.fill_null(0)
        yield pl.DataFrame(columns)
        line += len(cells[names[0]])
    if line == table.first_row:
        raise InputError(f"`{table.source}` has no rows: is the log cut?")


def _detect_format(source: str, head: bytes) -> _Layout:
    """Detect the format of a text file by its first bytes."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"`{source}` is text in UTF-16: save it again in UTF-8.")
    if b"\0" in head:
        raise InputError(
            f"`{source}` is no text: a log is CSV, Parquet, NPZ, MAT, HDF5 or a bag "
            "of ROS, as its "
            "suffix says."
        )
    first, _, _ = head.partition(b"\n")
    line = first.decode("utf-8-sig", errors="replace").strip("\r").lstrip("#% ")
    if not line.strip():
        raise InputError(
            f"`{source}` must start with a header or with numbers, but is empty."
        )
    separator = next((s for s in (";", "\t", ",", " ") if s in line.strip()), ",")
    line = " ".join(line.split()) if separator == " " else line
    cells = [cell.strip().strip('"') for cell in line.split(separator)]
    filled = pl.Series(
        [cell.replace(",", ".") for cell in cells if cell], dtype=pl.String
    )
    named = filled.is_empty() or filled.cast(pl.Float64, strict=False).null_count() > 0
    names = cells if named else [str(i) for i in range(len(cells))]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise InputError(
            f"the header of `{source}` names the column `{repeated[0]}` twice: rename "
            "one of them."
        )
    comma = separator == ";" and re.search(rb"\d,\d", head) is not None
    mark = len(codecs.BOM_UTF8) if first.startswith(codecs.BOM_UTF8) else 0
    start = min(len(first) + 1, len(head)) if named else mark
    return _Layout(source, tuple(names), named, separator, comma, start)

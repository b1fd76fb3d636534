"""Log files as named columns: CSV (any separator, with or without header), Parquet, NPZ and MAT."""

import codecs
import contextlib
import dataclasses
import difflib
import io
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from jaxid.errors import InputError
from jaxid.io import read_arrays
from jaxid.measurement.columns import Selection

SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
"""Suffixes of text files."""
HEAD = 65536
"""Bytes from which a format is detected."""


LARGEST = 1e30
"""Largest number in a log, in any unit: its square still is finite."""


@dataclasses.dataclass(frozen=True)
class LogTable:
    """Columns of a file, not yet checked.

    Attributes:
        source: Name of the file, for messages.
        columns: Columns or whole arrays (samples x joints) by name.
        first_line: Line of the file with the first row; None if it is no text file.
        named: Whether the columns have names of their own.
        before: Number of rows of the file before the first of these.
    """

    source: str
    columns: Mapping[str, pl.Series | np.ndarray]
    first_line: int | None = None
    named: bool = True
    before: int = 0

    def row(self, index: int) -> str:
        """Return where a row is in the file, for messages."""
        index += self.before
        return f"row {index + 1}" if self.first_line is None else f"line {index + self.first_line}"

    def expand(self, channel: str, selection: Selection) -> tuple[str, ...]:
        """Return the names of the columns of a selection, in the order of the joints.

        Raises:
            InputError: If there is no such column, or a number of a pattern is missing or there
                twice.
        """
        if isinstance(selection, tuple):
            return tuple(self._name(channel, one) for one in selection)
        if isinstance(selection, int) or "{}" not in selection:
            return (self._name(channel, selection),)
        pattern = re.escape(selection).replace(re.escape("{}"), r"(\d{1,18})")
        matches: dict[int, str] = {}
        for column in self.columns:
            if not (match := re.fullmatch(pattern, column)):
                continue
            number = int(match[1])
            if number in matches:
                raise InputError(
                    f"`{self.source}` has `{matches[number]}` and `{column}`, which both are "
                    f"number {number} of `{channel}`: name the columns one by one."
                )
            matches[number] = column
        if not matches:
            return (self._name(channel, selection.replace("{}", "1")),)
        numbers = range(min(*matches, 1), max(matches) + 1)
        missing = next((number for number in numbers if number not in matches), None)
        if missing is not None:
            raise InputError(
                f"`{self.source}` has no column `{selection.replace('{}', str(missing))}` for "
                f"`{channel}`, though it has `{matches[max(matches)]}`: name the columns one by "
                "one."
            )
        return tuple(matches[number] for number in numbers)

    def _name(self, channel: str, column: str | int) -> str:
        names = list(self.columns)
        if isinstance(column, int):
            if not 0 <= column < len(names):
                raise InputError(
                    f"`{channel}` asks for column {column} of `{self.source}`, but its columns are "
                    f"numbered from 0 to {len(names) - 1}."
                )
            return names[column]
        if column in self.columns:
            return column
        if not self.named:
            raise InputError(
                f"`{self.source}` has no header, so `{channel}` cannot name the column `{column}`: "
                f"give positions from 0 to {len(names) - 1}."
            )
        near = difflib.get_close_matches(column, names, n=1, cutoff=0.5)
        hint = f" (did you mean `{near[0]}`?)" if near else ""
        shown = ", ".join(f"`{name}`" for name in names[:40])
        more = f" and {len(names) - 40} more" if len(names) > 40 else ""
        raise InputError(
            f"`{self.source}` has no column `{column}` for `{channel}`{hint}: it has {shown}{more}."
        )

    def refuse_shared(self, channels: Mapping[str, Selection | None]) -> None:
        """Refuse a column that is used for two channels.

        Args:
            channels: Selections by channel; those that are None are left out.

        Raises:
            InputError: If a column comes twice.
        """
        used: dict[str, str] = {}
        for channel, selection in channels.items():
            for name in () if selection is None else self.expand(channel, selection):
                if name in used:
                    both = (
                        "twice" if used[name] == channel else f"for `{used[name]}` and `{channel}`"
                    )
                    raise InputError(
                        f"the column `{name}` of `{self.source}` is used {both}: one column holds "
                        "one channel; name the right one."
                    )
                used[name] = channel

    def array(self, channel: str, selection: Selection) -> np.ndarray:
        """Return the numbers of a selection (samples x columns).

        Raises:
            InputError: If a column is missing, has another length, or holds something else than
                numbers.
        """
        names = self.expand(channel, selection)
        blocks = [self.numbers(name) for name in names]
        for name, block in zip(names, blocks, strict=True):
            if len(block) != len(blocks[0]):
                raise InputError(
                    f"column `{name}` of `{self.source}` has {len(block)} samples, but "
                    f"`{names[0]}` has {len(blocks[0])}: they must be of one log."
                )
        return np.concatenate(blocks, axis=1)

    def stamps(self, selection: str | int) -> tuple[np.ndarray, bool]:
        """Return the time stamps, and whether they are dates (then in seconds).

        Integers and dates count from the first of these rows: nanoseconds since 1970 do not fit
        into float64, but their differences do.

        Raises:
            InputError: Like `array`.
        """
        name = self._name("time", selection)
        column = self.columns[name]
        if isinstance(column, pl.Series) and column.dtype.is_temporal():
            fine = pl.Duration("ns") if column.dtype == pl.Duration else pl.Datetime("ns")
            ticks = column.cast(fine).cast(pl.Int64)
            self._refuse_first(name, ticks.is_null().to_numpy(), ticks, "is empty")
            integers = ticks.to_numpy()
            return (integers - integers[0]) * 1e-9, True
        if isinstance(column, pl.Series) and column.dtype.is_integer() and not column.null_count():
            column = column.to_numpy()
        if isinstance(column, np.ndarray) and column.ndim == 1 and column.dtype.kind in "iu":
            return (column.astype(np.int64) - np.int64(column[0])).astype(np.float64), False
        block = self.numbers(name)
        if block.shape[1] != 1:
            raise InputError(
                f"`{name}` of `{self.source}` must be one column of time stamps, "
                f"but is an array of {block.shape[1]} columns."
            )
        return block[:, 0], False

    def numbers(self, name: str) -> np.ndarray:
        """Return a column as finite numbers (samples x columns).

        Raises:
            InputError: If it holds something else; the message names column and line.
        """
        column = self.columns[name]
        if len(column) == 0:
            raise InputError(f"column `{name}` of `{self.source}` has no rows: is the log cut?")
        if isinstance(column, pl.Series):
            array = self._series(name, column)
        elif column.dtype.kind in "iufb" and column.ndim <= 2:
            with np.errstate(invalid="ignore"):  # signalling NaN
                array = np.asarray(column, np.float64)
        else:
            raise InputError(
                f"`{name}` of `{self.source}` must be an array of real numbers of one or two "
                f"axes, but holds {column.dtype} with {column.ndim} axes."
            )
        if array.size == 0:
            raise InputError(f"`{name}` of `{self.source}` has rows, but no columns.")
        array = np.array(array.reshape(len(array), -1), np.float64)
        with np.errstate(invalid="ignore"):
            shown = array.min(axis=1) + array.max(axis=1)
        bad = np.asarray(~np.isfinite(array).all(axis=1))
        self._refuse_first(name, bad, shown, "is not finite ({})")
        size = np.abs(array).max(axis=1)
        self._refuse_first(name, size > LARGEST, size, "is {} in size, which nothing measures")
        return array

    def _series(self, name: str, column: pl.Series) -> np.ndarray:
        try:
            if isinstance(column.dtype, pl.List | pl.Array):
                return self._nested(name, column)
            if column.dtype.is_numeric() or column.dtype == pl.Boolean:
                numbers = column.cast(pl.Float64)
            else:
                text = column.cast(pl.String, strict=False).str.strip_chars()
                numbers = text.cast(pl.Float64, strict=False)
        except pl.exceptions.PolarsError as error:
            raise InputError(
                f"column `{name}` of `{self.source}` holds {column.dtype} and no numbers: "
                "write it as floating-point numbers, or name another column."
            ) from error
        self._refuse_first(name, column.is_null().to_numpy(), column, "is empty")
        self._refuse_first(name, numbers.is_null().to_numpy(), column, "is `{}`, no number")
        return numbers.to_numpy()

    def _nested(self, name: str, column: pl.Series) -> np.ndarray:
        lengths = column.list.len() if isinstance(column.dtype, pl.List) else column.arr.len()
        uneven = (lengths.fill_null(-1) != lengths[0]).to_numpy()
        self._refuse_first(name, uneven, lengths, "has {} numbers, not as many as the first row")
        cells = column.explode().cast(pl.Float64, strict=False)
        empty = np.asarray(cells.is_null().to_numpy().reshape(len(column), -1).any(axis=1))
        self._refuse_first(name, empty, column, "has an empty cell")
        return cells.to_numpy().reshape(len(column), -1)

    def _refuse_first(self, name: str, bad: np.ndarray, column: Any, complaint: str) -> None:
        rows = np.flatnonzero(bad)
        if rows.size:
            first = int(rows[0])
            more = f" (and {rows.size - 1} more)" if rows.size > 1 else ""
            raise InputError(
                f"column `{name}` of `{self.source}`, {self.row(first)}, "
                f"{complaint.format(column[first])}{more}: repair the log or remove those rows."
            )


def read_table(path: str | Path) -> LogTable:
    """Read a whole file; its suffix tells the format.

    Raises:
        InputError: If the file is missing, of an unknown kind, or damaged.
    """
    path = require_file(path)
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        data = path.read_bytes().rstrip(b"\r\n")
        text = detect_csv_format(path.name, data)
        columns = text.read(data[text.start :])
        return LogTable(path.name, columns, text.first_line, text.named)
    if suffix == ".parquet":
        with require_parquet(path.name):
            return LogTable(path.name, pl.read_parquet(path).to_dict(as_series=True))
    if suffix == ".npz":
        try:
            return LogTable(path.name, _arrays(read_arrays(path)))
        except ValueError as error:
            raise InputError(
                f"`{path.name}` is no NPZ file of plain arrays ({error}): save the log with "
                "`numpy.savez` and without objects."
            ) from error
    if suffix == ".mat":
        return LogTable(path.name, _arrays(_read_mat(path)))
    raise InputError(
        f"`{path.name}` must end in {', '.join(SUFFIXES)}, .parquet, .npz or .mat, to be read as a "
        "log: convert it to one of them."
    )


def require_file(path: str | Path) -> Path:
    """Return the path of a file that exists."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"`{path}` is no file: check the path of the log.")
    return path


@contextlib.contextmanager
def require_parquet(source: str) -> Iterator[None]:
    """Report a Parquet file that polars cannot read as damaged."""
    try:
        yield
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"`{source}` is no Parquet file, or is damaged: {reason}.") from error


def _read_mat(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        content = loadmat(path, simplify_cells=True)
    except NotImplementedError as error:
        raise InputError(
            f"`{path.name}` is a MAT file of version 7.3, which cannot be read: save it with "
            "`save(name, ..., '-v7')`, or as CSV."
        ) from error
    except Exception as error:  # of many kinds: it depends on which bytes are damaged
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"`{path.name}` is no MAT file, or is damaged: {reason}.") from error
    return {name: value for name, value in content.items() if not name.startswith("__")}


def _arrays(content: dict[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    """Return arrays by name; those in a structure are named like `log.q`."""
    arrays: dict[str, np.ndarray] = {}
    for name, value in content.items():
        if isinstance(value, dict):
            arrays |= _arrays(value, f"{prefix}{name}.")
        elif isinstance(value, np.ndarray) and value.ndim > 0:
            # Single rows, as MATLAB writes them, are columns here.
            arrays[prefix + name] = value.ravel() if 1 in value.shape else value
    return arrays


@dataclasses.dataclass(frozen=True)
class CsvFormat:
    """Format of a text file of numbers.

    Attributes:
        source: Name of the file, for messages.
        separator: Character between two cells.
        names: Names of the columns; their positions if there is no header.
        named: Whether the first line is a header.
        decimal_comma: Whether numbers have decimal commas.
        start: Byte at which the rows begin.
    """

    source: str
    separator: str
    names: tuple[str, ...]
    named: bool
    decimal_comma: bool
    start: int

    @property
    def first_line(self) -> int:
        """Line of the file that holds the first row."""
        return 1 + int(self.named)

    def read(
        self, rows: bytes, before: int = 0, types: Mapping[str, Any] | None = None
    ) -> dict[str, pl.Series]:
        """Read whole lines.

        Args:
            rows: Lines of the file.
            before: Number of rows of the file before these.
            types: Types of the columns that are needed, which saves looking for them; all columns,
                with the types that their cells have, if None or if some cell is of another type.

        Raises:
            InputError: If lines differ in their number of cells, or a quotation does not end.
        """
        rows = self._without_blanks(rows)
        self._refuse_open_quotation(rows, before)
        if types is not None:
            columns = self._read_as(rows, types)
            if columns is not None:
                return columns
        try:
            frame = pl.read_csv(
                io.BytesIO(rows),
                new_columns=list(self.names),
                infer_schema_length=None,
                **self._options(),
            )
        except pl.exceptions.NoDataError as error:
            raise InputError(
                f"`{self.source}` has a header, but no rows: is the log cut?"
            ) from error
        except pl.exceptions.PolarsError as error:
            raise InputError(
                f"`{self.source}` is no table with {len(self.names)} columns in every line: repair "
                "or remove the lines that differ."
            ) from error
        if frame.width != len(self.names):
            raise InputError(
                f"`{self.source}` has {len(self.names)} names in its header, but {frame.width} "
                "columns of numbers: make them agree."
            )
        return frame.to_dict(as_series=True)

    def _read_as(self, rows: bytes, types: Mapping[str, Any]) -> dict[str, pl.Series] | None:
        """Read columns of known types; None if some line or cell is of another kind."""
        lines = rows.count(b"\n") + (not rows.endswith(b"\n"))
        if rows.count(self.separator.encode()) != lines * (len(self.names) - 1):
            return None
        schema = {name: types.get(name, pl.String()) for name in self.names}
        wanted = [k for k, name in enumerate(self.names) if name in types]
        try:
            frame = pl.read_csv(io.BytesIO(rows), schema=schema, columns=wanted, **self._options())
        except pl.exceptions.PolarsError:
            return None
        return frame.to_dict(as_series=True)

    def _refuse_open_quotation(self, rows: bytes, before: int) -> None:
        """Refuse a quotation that goes on in the next line: it would swallow rows."""
        if b'"' not in rows:
            return
        for index, line in enumerate(rows.split(b"\n")):
            if line.count(b'"') % 2:
                raise InputError(
                    f"line {index + before + self.first_line} of `{self.source}` opens a quotation "
                    "that does not end in that line: remove the quotation mark, or close it there."
                )

    def _options(self) -> dict:
        return {
            "separator": self.separator,
            "has_header": False,
            "decimal_comma": self.decimal_comma,
            "encoding": "utf8-lossy",
        }

    def _without_blanks(self, rows: bytes) -> bytes:
        """Remove the blanks that polars would take for cells or parts of cells."""
        if self.separator == " ":
            return b"\n".join(b" ".join(row.split()) for row in rows.splitlines())
        if b" " in rows:
            mark = self.separator.encode()
            return re.sub(rb" *" + mark + rb" *", mark, rows)
        return rows


def detect_csv_format(source: str, head: bytes) -> CsvFormat:
    """Detect the format of a text file.

    Args:
        source: Name of the file, for messages.
        head: First bytes of the file, or all of them.

    Raises:
        InputError: If the file is empty, not in UTF-8, or names a column twice.
    """
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"`{source}` is text in UTF-16: save it again in UTF-8.")
    first, _, _ = head.partition(b"\n")
    if b"\r" in first.rstrip(b"\r"):
        raise InputError(
            f"`{source}` ends its lines with carriage returns alone: save it again with line ends "
            "of Unix or Windows (LF or CRLF)."
        )
    line = first.decode("utf-8-sig", errors="replace").strip("\r").lstrip("#% ")
    if not line.strip():
        raise InputError(f"`{source}` must start with a header or with numbers, but is empty.")
    separator = next((s for s in (";", "\t", ",", " ") if s in line.strip()), ",")
    line = " ".join(line.split()) if separator == " " else line
    cells = [cell.strip().strip('"') for cell in line.split(separator)]
    named = not all(_is_number(cell) for cell in cells if cell) or not any(cells)
    names = cells if named else [str(i) for i in range(len(cells))]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise InputError(
            f"the header of `{source}` names the column `{repeated[0]}` twice: rename one of them."
        )
    comma = separator == ";" and re.search(rb"\d,\d", head[:HEAD]) is not None
    mark = len(codecs.BOM_UTF8) if first.startswith(codecs.BOM_UTF8) else 0
    start = min(len(first) + 1, len(head)) if named else mark
    return CsvFormat(source, separator, tuple(names), named, comma, start)


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True

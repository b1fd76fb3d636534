"""Files of numbers: CSV, Parquet, NPZ and MAT, seen alike as named columns."""

import contextlib
import dataclasses
import difflib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from jaxid.errors import InputError
from jaxid.io import read_arrays
from jaxid.measurement.columns import Selection
from jaxid.measurement.text import SUFFIXES, Dialect

LARGEST = 1e30
"""Numbers that no robot's log goes beyond, in any unit: their squares still are numbers."""
LONGEST = 200
"""Letters of a library's words about a damaged file that are passed on."""


@dataclasses.dataclass(frozen=True)
class Table:
    """The columns of one file, not yet checked.

    Attributes:
        source: Name of the file, as messages cite it.
        columns: By name: one column, or a whole array (samples x joints).
        first_line: Line of the file that holds the first row of numbers; None if not a text.
        named: Whether the columns have names of their own.
        before: Rows of the file before the first of these.
    """

    source: str
    columns: Mapping[str, pl.Series | np.ndarray]
    first_line: int | None = None
    named: bool = True
    before: int = 0

    def row(self, index: int) -> str:
        """Where a row is found in the file."""
        index += self.before
        return f"row {index + 1}" if self.first_line is None else f"line {index + self.first_line}"

    def expand(self, what: str, selection: Selection) -> tuple[str, ...]:
        """Names of the columns of a selection, in the order of the joints.

        Raises:
            InputError: If there is no such column, or a number of a pattern is missing or there
                twice.
        """
        if isinstance(selection, tuple):
            return tuple(self._name(what, one) for one in selection)
        if isinstance(selection, int) or "{}" not in selection:
            return (self._name(what, selection),)
        pattern = re.escape(selection).replace(re.escape("{}"), r"(\d{1,18})")
        found: dict[int, str] = {}
        for column in self.columns:
            if not (match := re.fullmatch(pattern, column)):
                continue
            if other := found.get(int(match[1])):
                raise InputError(
                    f"`{self.source}` has `{other}` and `{column}`, which both are number "
                    f"{int(match[1])} of `{what}`: name the columns one by one."
                )
            found[int(match[1])] = column
        if not found:
            return (self._name(what, selection.replace("{}", "1")),)
        first = min(found)
        numbers = range(min(first, 1), max(found) + 1)
        missing = next((number for number in numbers if number not in found), None)
        if missing is not None:
            raise InputError(
                f"`{self.source}` has no column `{selection.replace('{}', str(missing))}` for "
                f"`{what}`, though it has `{found[max(found)]}`: name the columns one by one."
            )
        return tuple(found[number] for number in numbers)

    def _name(self, what: str, column: str | int) -> str:
        names = list(self.columns)
        if isinstance(column, int):
            if not 0 <= column < len(names):
                raise InputError(
                    f"`{what}` asks for column {column} of `{self.source}`, but its columns are "
                    f"numbered from 0 to {len(names) - 1}."
                )
            return names[column]
        if column in self.columns:
            return column
        if not self.named:
            raise InputError(
                f"`{self.source}` has no header, so `{what}` cannot name the column `{column}`: "
                f"give positions from 0 to {len(names) - 1}."
            )
        near = difflib.get_close_matches(column, names, n=1, cutoff=0.5)
        hint = f" (did you mean `{near[0]}`?)" if near else ""
        shown = ", ".join(f"`{name}`" for name in names[:40])
        more = f" and {len(names) - 40} more" if len(names) > 40 else ""
        raise InputError(
            f"`{self.source}` has no column `{column}` for `{what}`{hint}: it has {shown}{more}."
        )

    def refuse_shared(self, channels: dict[str, Selection | None]) -> None:
        """Refuses one column that is meant to be two things.

        Args:
            channels: Selections by what they are for; those of None are left out.

        Raises:
            InputError: If a column comes twice.
        """
        used: dict[str, str] = {}
        for what, selection in channels.items():
            for name in () if selection is None else self.expand(what, selection):
                if name in used:
                    both = "twice" if used[name] == what else f"for `{used[name]}` and `{what}`"
                    raise InputError(
                        f"the column `{name}` of `{self.source}` is used {both}: one column holds "
                        "one channel; name the right one."
                    )
                used[name] = what

    def array(self, what: str, selection: Selection) -> np.ndarray:
        """The numbers of some columns (samples x columns).

        Raises:
            InputError: If a column is missing, has another length, or holds what is no number.
        """
        names = self.expand(what, selection)
        blocks = [self._numbers(name) for name in names]
        for name, block in zip(names, blocks, strict=True):
            if len(block) != len(blocks[0]):
                raise InputError(
                    f"column `{name}` of `{self.source}` has {len(block)} samples, but "
                    f"`{names[0]}` has {len(blocks[0])}: they must be of one log."
                )
        return np.concatenate(blocks, axis=1)

    def stamps(self, selection: str | int) -> tuple[np.ndarray, bool]:
        """The time stamps, and whether they were dates (then in seconds).

        Raises:
            InputError: Like `array`.
        """
        name = self._name("time", selection)
        column = self.columns[name]
        if isinstance(column, pl.Series) and column.dtype.is_temporal():
            fine = pl.Duration("ns") if column.dtype == pl.Duration else pl.Datetime("ns")
            ticks = column.cast(fine).cast(pl.Int64)
            self._refuse_first(name, ticks.is_null().to_numpy(), ticks, "is empty")
            whole = ticks.to_numpy()
            return (whole - whole[0]) * 1e-9, True
        if isinstance(column, pl.Series) and column.dtype.is_integer() and not column.null_count():
            column = column.to_numpy()
        if isinstance(column, np.ndarray) and column.ndim == 1 and column.dtype.kind in "iu":
            # Nanoseconds since 1970 do not fit into float64: the difference does.
            return (column.astype(np.int64) - np.int64(column[0])).astype(np.float64), False
        block = self._numbers(name)
        if block.shape[1] != 1:
            raise InputError(
                f"`{name}` of `{self.source}` must be one column of time stamps, "
                f"but is an array of {block.shape[1]} columns."
            )
        return block[:, 0], False

    def _numbers(self, name: str) -> np.ndarray:
        column = self.columns[name]
        if len(column) == 0:
            raise InputError(f"column `{name}` of `{self.source}` has no rows: is the log cut?")
        if isinstance(column, pl.Series):
            try:
                if isinstance(column.dtype, pl.List | pl.Array):
                    return self._nested(name, column)
                numbers = _as_numbers(column)
            except pl.exceptions.PolarsError as error:
                raise InputError(
                    f"column `{name}` of `{self.source}` holds {column.dtype} and no numbers: "
                    "write it as floating numbers, or name another column."
                ) from error
            self._refuse_first(name, column.is_null().to_numpy(), column, "is empty")
            self._refuse_first(name, numbers.is_null().to_numpy(), column, "is `{}`, no number")
            array = numbers.to_numpy()
        else:
            if column.dtype.kind not in "iufb" or column.ndim > 2:
                raise InputError(
                    f"`{name}` of `{self.source}` must be an array of real numbers of one or two "
                    f"axes, but holds {column.dtype} with {column.ndim} axes."
                )
            # Some bits of NaN are a signal to whoever copies them.
            with np.errstate(invalid="ignore"):
                array = np.asarray(column, np.float64)
        if array.size == 0:
            raise InputError(f"`{name}` of `{self.source}` has rows, but no columns.")
        array = np.array(array.reshape(len(array), -1), np.float64)
        bad = np.asarray(np.logical_not(np.isfinite(array)).any(axis=1))
        with np.errstate(invalid="ignore"):
            said = array.min(axis=1) + array.max(axis=1)
        self._refuse_first(name, bad, said, "is not finite ({})")
        size = np.abs(array).max(axis=1)
        self._refuse_first(name, size > LARGEST, size, "is {} in size, which nothing measures")
        return array

    def _nested(self, name: str, column: pl.Series) -> np.ndarray:
        lengths = column.list.len() if isinstance(column.dtype, pl.List) else column.arr.len()
        uneven = (lengths.fill_null(-1) != lengths[0]).to_numpy()
        self._refuse_first(name, uneven, lengths, "has {} numbers, not as many as the first row")
        cells = column.explode().cast(pl.Float64, strict=False)
        empty = np.asarray(cells.is_null().to_numpy().reshape(len(column), -1).any(axis=1))
        self._refuse_first(name, empty, column, "has an empty cell")
        rows = cells.to_numpy().reshape(len(column), -1)
        return Table(self.source, {name: rows})._numbers(name)

    def _refuse_first(self, name: str, bad: np.ndarray, column: Any, complaint: str) -> None:
        rows = np.flatnonzero(bad)
        if rows.size:
            first = int(rows[0])
            more = f" (and {rows.size - 1} more)" if rows.size > 1 else ""
            raise InputError(
                f"column `{name}` of `{self.source}`, {self.row(first)}, "
                f"{complaint.format(column[first])}{more}: repair the log or remove those rows."
            )


def _as_numbers(column: pl.Series) -> pl.Series:
    """A column in float64, with nulls for what is no number."""
    if column.dtype.is_numeric() or column.dtype == pl.Boolean:
        return column.cast(pl.Float64)
    text = column.cast(pl.String, strict=False).str.strip_chars()
    return text.cast(pl.Float64, strict=False)


def read_table(path: str | Path) -> Table:
    """Opens a file of numbers by its suffix.

    Raises:
        InputError: If the file is missing, of an unknown kind, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"`{path}` is no file: check the path of the log.")
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        return _read_text(path)
    if suffix == ".parquet":
        return _read_parquet(path)
    if suffix == ".npz":
        return _read_npz(path)
    if suffix == ".mat":
        return _read_mat(path)
    raise InputError(
        f"`{path.name}` must end in {', '.join(SUFFIXES)}, .parquet, .npz or .mat, to be read as a "
        "log: convert it to one of them."
    )


def _read_text(path: Path) -> Table:
    raw = path.read_bytes().rstrip(b"\r\n")
    dialect = Dialect.of(path.name, raw)
    columns = dialect.columns(raw[dialect.start :])
    return Table(path.name, columns, dialect.first_line, dialect.named)


@contextlib.contextmanager
def whole_parquet(path: Path) -> Iterator[None]:
    """Says of a Parquet file that cannot be read that it is damaged.

    Args:
        path: Of the file.

    Raises:
        InputError: If reading fails, also where Polars itself takes damage for a bug of its own.
    """
    try:
        yield
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        said = " ".join(str(error).split())[:LONGEST]
        raise InputError(f"`{path.name}` is no Parquet file, or is damaged: {said}.") from error


def _read_parquet(path: Path) -> Table:
    with whole_parquet(path):
        frame = pl.read_parquet(path)
    return Table(path.name, frame.to_dict(as_series=True))


def _read_npz(path: Path) -> Table:
    try:
        arrays = read_arrays(path)
    except ValueError as error:
        raise InputError(
            f"`{path.name}` is no NPZ file of plain arrays ({error}): save the log with "
            "`numpy.savez` and without objects."
        ) from error
    return Table(path.name, _arrays(arrays))


def _read_mat(path: Path) -> Table:
    from scipy.io import loadmat

    try:
        content = loadmat(path, simplify_cells=True)
    except NotImplementedError as error:
        raise InputError(
            f"`{path.name}` is a MAT file of version 7.3, which cannot be read: save it with "
            "`save(name, ..., '-v7')`, or as CSV."
        ) from error
    except Exception as error:  # of many kinds: it depends on which bytes are damaged
        said = " ".join(str(error).split())[:LONGEST]
        raise InputError(f"`{path.name}` is no MAT file, or is damaged: {said}.") from error
    return Table(path.name, _arrays({k: v for k, v in content.items() if not k.startswith("__")}))


def _arrays(content: dict[str, Any], prefix: str = "") -> dict[str, pl.Series | np.ndarray]:
    """Arrays by name; those in a structure are named like `log.q`."""
    found: dict[str, pl.Series | np.ndarray] = {}
    for name, value in content.items():
        if isinstance(value, dict):
            found |= _arrays(value, f"{prefix}{name}.")
        elif isinstance(value, np.ndarray) and value.ndim > 0:
            # MATLAB's and others' single rows are columns here.
            found[prefix + name] = value.ravel() if 1 in value.shape else value
    return found

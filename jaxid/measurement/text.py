"""Text files of numbers: how one is written, and its rows as columns."""

import codecs
import dataclasses
import io
import re

import polars as pl

from jaxid.errors import InputError

SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
SEPARATORS = (";", "\t", ",", " ")
HEAD = 65536
"""Bytes that tell how a file is written."""


@dataclasses.dataclass(frozen=True)
class Dialect:
    """How a text file of numbers is written.

    Attributes:
        source: Name of the file, as messages cite it.
        separator: Between two cells.
        names: Of the columns; their positions if there is no header.
        named: Whether the first line is a header.
        decimal_comma: Whether numbers have commas for points.
        start: Byte at which the rows begin.
    """

    source: str
    separator: str
    names: tuple[str, ...]
    named: bool
    decimal_comma: bool
    start: int

    @classmethod
    def of(cls, source: str, head: bytes) -> "Dialect":
        """Looks at the beginning of a file.

        Raises:
            InputError: If it is empty, or names a column twice.
        """
        if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise InputError(f"`{source}` is text in UTF-16: save it again in UTF-8.")
        first, _, _ = head.partition(b"\n")
        if b"\r" in first.rstrip(b"\r"):
            raise InputError(
                f"`{source}` ends its lines with carriage returns alone, as old Macintosh programs "
                "do: save it again with line ends of Unix or Windows (LF or CRLF)."
            )
        line = first.decode("utf-8-sig", errors="replace").strip("\r").lstrip("#% ")
        if not line.strip():
            raise InputError(f"`{source}` must start with a header or with numbers, but is empty.")
        separator = next((s for s in SEPARATORS if s in line.strip()), ",")
        line = " ".join(line.split()) if separator == " " else line
        cells = [cell.strip().strip('"') for cell in line.split(separator)]
        named = not all(_is_number(cell) for cell in cells if cell) or not any(cells)
        names = cells if named else [str(i) for i in range(len(cells))]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(
                f"the header of `{source}` names the column `{twice[0]}` twice: rename one of them."
            )
        comma = separator == ";" and re.search(rb"\d,\d", head[:HEAD]) is not None
        mark = len("\ufeff".encode()) if first.startswith("\ufeff".encode()) else 0
        start = min(len(first) + 1, len(head)) if named else mark
        return cls(source, separator, tuple(names), named, comma, start)

    @property
    def first_line(self) -> int:
        """Line of the file that holds the first row."""
        return 1 + int(self.named)

    def columns(self, rows: bytes, before: int = 0) -> dict[str, pl.Series]:
        """The columns of some whole lines, each of the type that its cells have.

        Args:
            rows: The lines.
            before: Rows of the file before these.

        Raises:
            InputError: If lines differ in their number of cells, or one reaches into the next.
        """
        tidied = self._tidied(rows)
        self._refuse_open_quotes(tidied, before)
        try:
            frame = pl.read_csv(
                io.BytesIO(tidied),
                new_columns=list(self.names),
                infer_schema_length=None,
                **self._options(),
            )
        except pl.exceptions.PolarsError as error:
            if isinstance(error, pl.exceptions.NoDataError):
                raise InputError(
                    f"`{self.source}` has a header, but no rows: is the log cut?"
                ) from error
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

    def numbers(
        self,
        rows: bytes,
        names: tuple[str, ...],
        whole: tuple[str, ...] = (),
        before: int = 0,
    ) -> dict[str, pl.Series]:
        """Some columns of some whole lines as numbers: several times as fast as `columns`.

        Where that fails they are as `columns` reads them, to be judged where they are used.

        Args:
            rows: The lines.
            names: Of the columns.
            whole: Those of them that hold whole numbers, which float64 may not hold.
            before: Rows of the file before these.

        Raises:
            InputError: Like `columns`.
        """
        tidied = self._tidied(rows)
        lines = tidied.count(b"\n") + (not tidied.endswith(b"\n"))
        self._refuse_open_quotes(tidied, before)
        if tidied.count(self.separator.encode()) == lines * (len(self.names) - 1):
            types = {name: pl.Int64() if name in whole else pl.Float64() for name in names}
            schema = {name: types.get(name, pl.String()) for name in self.names}
            wanted = [k for k, name in enumerate(self.names) if name in types]
            try:
                frame = pl.read_csv(
                    io.BytesIO(tidied), schema=schema, columns=wanted, **self._options()
                )
                return frame.to_dict(as_series=True)
            except pl.exceptions.PolarsError:
                pass
        found = self.columns(rows, before)
        return {name: found[name] for name in self.names if name in names}

    def _refuse_open_quotes(self, rows: bytes, before: int) -> None:
        """A quotation that goes on in the next line would swallow the rows until it ends."""
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

    def _tidied(self, rows: bytes) -> bytes:
        """The lines without the blanks that polars would take for cells or parts of cells."""
        if self.separator == " ":
            rows = b"\n".join(b" ".join(row.split()) for row in rows.splitlines())
        elif b" " in rows:
            mark = self.separator.encode()
            rows = re.sub(rb" *" + mark + rb" *", mark, rows)
        return rows


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True

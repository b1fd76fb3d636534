"""Report on several runs of a robot: a payload, gains of drives, or states."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxid.identification.parameter_changes import LEVEL
from jaxid.io import FilePath
from jaxid.result_table import Remark, Status, Summarised, Table

from .page import render_page
from .result_files import write_page_and_table
from .result_records import Record


@dataclasses.dataclass(frozen=True, eq=False)
class RunsReport(Summarised):
    """Result of several runs, and doubts about their logs.

    Attributes:
        kind: Kind of the result: "payload", "gains" or "states".
        result: The result.
        estimates: Estimates in the files, one row each.
        content: Further content of the JSON file.
        sources: Logs and reports of each run.
        doubts: Doubts about the logs, as sentences.
        details: Tables beside that of the result.
    """

    kind: str
    result: Any
    estimates: list[Record]
    content: Record
    sources: Mapping[str, Sequence[Path]]
    doubts: Sequence[str]
    details: Sequence[Table] = ()

    @property
    def remarks(self) -> list[Remark]:
        """Doubts, as remarks."""
        return [Remark(text, Status.DOUBTFUL) for text in self.doubts]

    @property
    def status(self) -> Status:
        """Whether the result can be used: that of the worst remark on it."""
        remarks = self.result.summary().remarks
        is_bad = any(remark.status is Status.BAD for remark in remarks)
        return Status.BAD if is_bad else Status.NEUTRAL

    def tables(self) -> list[Table]:
        """Return all tables of the result."""
        return [self.result.summary(), *self.details]

    def save(self, folder: FilePath) -> list[Path]:
        """Write a page, and the numbers as JSON and CSV; return the files."""
        paths = {run: list(map(str, logs)) for run, logs in self.sources.items()}
        record = {
            "sources": paths,
            "level": LEVEL,
            "parameters": self.estimates,
            "covariance": self.result.uncertainty.covariance,
            **self.content,
        }
        facts = [(run, ", ".join(names)) for run, names in paths.items()]
        results = [self.remarks, *self.tables()] if self.doubts else self.tables()
        sections = [("Result", results), ("Logs", [Table("", facts=facts)])]
        page = render_page(f"{self.kind.capitalize()}: results", sections)
        return write_page_and_table(
            Path(folder), self.kind, page, record, self.estimates
        )

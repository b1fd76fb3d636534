"""Report on several runs of a robot: a payload, gains of drives, or states."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxid.identification.fit_result import Fit
from jaxid.identification.parameter_changes import LEVEL
from jaxid.io import FilePath
from jaxid.result_table import Remark, Status, Summarised, Table

from .figure import Figure
from .page import Section, Settings, code, folded, provenance, render_page, tiles
from .result_files import MODEL, write_page_and_table
from .result_records import Record, verdict_rows


class Answer(NamedTuple):
    """Content of the page of a result: numbers, figures, and how to read them."""

    title: str  # title of the page
    sentence: str  # the result in one sentence, if nothing speaks against it
    numbers: Sequence[tuple[str, str]]  # three numbers, and what they are
    figures: Sequence[Figure]
    words: str  # how to read the estimates
    experiment_lines: Sequence[str] = ()  # lines for the experiment file


@dataclasses.dataclass(frozen=True, eq=False)
class RunsReport(Summarised):
    """Result of several runs, and findings on their logs.

    Attributes:
        kind: Kind of the result, such as "payload" or "states".
        result: The result.
        answer: What the page says and shows.
        estimates: Estimates in the files, one row each.
        content: Further content of the JSON file.
        sources: Logs and reports of each run.
        findings: Findings on the logs, mostly doubts.
        details: Tables beside that of the result.
        glance: Tables of the overview, if it is not that of the result.
        settings: Origin of the result, as `provenance` takes it.
        model: Fit whose model file is written too, or None.
    """

    kind: str
    result: Any
    answer: Answer
    estimates: list[Record]
    content: Record
    sources: Mapping[str, Sequence[Path]]
    findings: Sequence[Remark]
    details: Sequence[Table] = ()
    glance: Sequence[Table] = ()
    settings: Settings = dataclasses.field(default_factory=dict)
    model: Fit | None = None

    @property
    def verdict(self) -> Remark:
        """Whether the result can be used, in one sentence."""
        # What is wrong with the logs explains what is wrong with the result.
        remarks = [*self.findings, *self.result.summary().remarks]
        faults = [remark for remark in remarks if remark.status is Status.BAD]
        if faults:
            return faults[0]
        if any(remark.status is Status.DOUBTFUL for remark in remarks):
            text = f"{self.answer.sentence}. Look at what is marked ! before you use it"
            return Remark(text, Status.DOUBTFUL)
        return Remark(self.answer.sentence, Status.GOOD)

    def tables(self) -> list[Table]:
        """Return all tables of the result, then the findings and the verdict."""
        findings = Table("", remarks=dict.fromkeys([*self.findings, self.verdict]))
        return [self.result.summary(), *self.details, findings]

    def overview(self) -> list[Table]:
        """Return the verdict, the findings, and the one table of the answer."""
        findings = Table("", remarks=dict.fromkeys([self.verdict, *self.findings]))
        return [findings, *(self.glance or [self.result.summary()])]

    def save(self, folder: FilePath) -> list[Path]:
        """Write a page, and the numbers as JSON and CSV; return the files.

        With a model its file too.
        """
        paths = {run: list(map(str, logs)) for run, logs in self.sources.items()}
        record = {
            "sources": paths,
            "level": LEVEL,
            "parameters": self.estimates,
            "covariance": self.result.uncertainty.covariance,
            **self.content,
        }
        facts = [(run, ", ".join(names)) for run, names in paths.items()]
        remarks = [*self.result.summary().remarks, *self.findings]
        record["verdict"] = verdict_rows([self.verdict, *remarks])
        glance = [
            self.verdict,
            tiles(*self.answer.numbers),
            Table("", facts=facts),
            [remark for remark in remarks if remark != self.verdict],
        ]
        estimates: Any = self.result.summary()
        estimates.title = ""
        # They are findings, at a glance.
        estimates.remarks = ()
        if self.details:
            estimates = folded("All estimates", estimates)
        sections: list[Section] = [
            ("At a glance", glance),
            ("Figures", self.answer.figures),
            ("Estimates", [*self.details, estimates, self.answer.words]),
            provenance(self.settings),
        ]
        if self.answer.experiment_lines and self.verdict.status is not Status.BAD:
            text = code("\n".join(self.answer.experiment_lines))
            sections.insert(1, ("For the experiment file", [text]))
        page = render_page(self.answer.title, sections)
        files = write_page_and_table(
            Path(folder), self.kind, page, record, self.estimates
        )
        if self.model is None:
            return files
        return [*files, self.model.save(Path(folder) / MODEL)]

"""Report on two fits of a robot: what has changed, and which one predicts a log."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxid.identification.parameter_changes import LEVEL, Comparison, Verdict
from jaxid.io import FilePath
from jaxid.result_table import Column, Remark, Status, Summarised, Table, percent
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import TorqueErrors

from .comparison_figure import comparison_figure
from .page import Section, Settings, provenance, render_page, tiles
from .result_files import write_page_and_table
from .result_records import comparison_rows, error_record
from .torques import model_force_figure

ONE_MOTION = (
    "Effects that the model lacks also cause differences between runs with different "
    "motions. For two runs of the same motion, use `jaxid states`, which is more "
    "sensitive: it fits both at once, with the same inertial parameters."
)


@dataclasses.dataclass(frozen=True, eq=False)
class ComparisonReport(Summarised):
    """Two fits of one robot side by side.

    Attributes:
        robot: The robot.
        comparison: Parameters of the fits; None if the models have different ones.
        errors: Torque errors of both on one log, by name; empty without a log.
        doubts: What the data of the fits have in common.
        settings: Origin of the result, as `provenance` takes it.
    """

    robot: Robot
    comparison: Comparison | None
    errors: Mapping[str, TorqueErrors]
    doubts: Sequence[Remark]
    settings: Settings = dataclasses.field(default_factory=dict)

    @property
    def verdict(self) -> Remark:
        """Which model predicts the log better; without a log, what has changed."""
        status = Status.DOUBTFUL if self.doubts else Status.NEUTRAL
        if not self.errors:
            return Remark(" ".join(self.numbers[0]), status)
        best = min(self.errors, key=lambda name: self.errors[name].relative)
        text = f"`{best}` predicts {self.errors[best].name} better than the other model"
        return Remark(text, status)

    @property
    def numbers(self) -> list[tuple[str, str]]:
        """Numbers in large letters, and what they are."""
        numbers = [
            (
                f"{percent(x.relative)} %",
                f"torque error of {name} on {x.name}{x.band_words}",
            )
            for name, x in self.errors.items()
        ]
        if self.comparison is not None:
            verdicts = self.comparison.verdicts
            count = f"{verdicts.count(Verdict.CHANGED)} of {len(verdicts)}"
            numbers.append((count, "parameters have changed"))
        return numbers

    def error_table(self) -> Table:
        """Return the errors on the log, joint by joint."""
        columns = [
            Column(name, errors.rms_relative, "%", percent)
            for name, errors in self.errors.items()
        ]
        joints = Column("joint", self.robot.joint_names)
        return Table("torque errors (RMS over RMS)", joints, *columns)

    def overview(self) -> list[Table]:
        """Return errors on the log, what has changed, doubts and verdict."""
        changes = [] if self.comparison is None else self.comparison.overview()[1:]
        errors = [self.error_table()] if self.errors else []
        return [*errors, *changes, Table("", remarks=[*self.doubts, self.verdict])]

    def tables(self) -> list[Table]:
        """Return all parameters, then the overview."""
        parameters = [] if self.comparison is None else self.comparison.tables()[:1]
        return [*parameters, *self.overview()]

    def save(self, folder: FilePath) -> list[Path]:
        """Write a page, and the numbers as JSON and CSV; return the files."""
        comparison = self.comparison
        records = {x: error_record(y, self.robot) for x, y in self.errors.items()}
        content = {"level": LEVEL, "errors": records}
        rows = [
            {"model": x, **row}
            for x, record in records.items()
            for row in record["joints"]
        ]
        glance = [
            self.verdict,
            tiles(*self.numbers),
            self.doubts,
        ]
        sections: list[Section] = [("At a glance", glance)]
        if records:
            title = next(iter(self.errors.values())).name
            figure = model_force_figure(self.errors, self.robot, title)
            sections.append(("Both models on one log", [figure, self.error_table()]))
        if comparison is not None:
            rows = comparison_rows(comparison)
            content |= {
                "first": comparison.first.name,
                "second": comparison.second.name,
                "parameters": rows,
                "covariance_of_differences": comparison.uncertainty.covariance,
                "groups": comparison.groups,
            }
            tables = reversed(comparison.tables())
            blocks = [comparison_figure(comparison), *tables, ONE_MOTION]
            sections.append(("Estimates side by side", blocks))
        sections.append(provenance(self.settings))
        page = render_page(f"{self.robot.name}: two models compared", sections)
        return write_page_and_table(Path(folder), "comparison", page, content, rows)

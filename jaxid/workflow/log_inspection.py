"""Examination of logs: is this log sane, and what does it determine?"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from jaxid.identification.fit_result import Fit
from jaxid.identification.identify import identify
from jaxid.io import FilePath
from jaxid.measurement.columns import Columns
from jaxid.report.identification_page import motor_tables
from jaxid.report.inspection_page import write_inspection
from jaxid.report.page import Settings
from jaxid.result_table import Remark, Status, Summarised, Table
from jaxid.validation.diagnosis import Diagnosis

from .log_loading import load_log, select_filter
from .setup import Paths, Progress, Setup, ignore_progress


class ExaminedLog(NamedTuple):
    """Findings on a log, also by a fit to it alone, and what it determines."""

    diagnosis: Diagnosis  # statistics and findings
    fit: Fit  # least-squares fit to this log alone

    @property
    def doubts(self) -> list[Remark]:
        """Findings, and what the log does not determine."""
        remarks = list(self.diagnosis.summary().remarks)
        # Of a log with a mistake, much is not determined because of it.
        if not self.diagnosis.is_mistaken:
            remarks += self.fit.determination
        return [x for x in remarks if x.status in (Status.BAD, Status.DOUBTFUL)]


@dataclasses.dataclass(frozen=True, eq=False)
class Inspection(Summarised):
    """Examined logs, and what was assumed of them."""

    setup: Setup  # robot and model
    logs: Sequence[ExaminedLog] = ()  # examined logs

    @property
    def verdict(self) -> Remark:
        """Whether the logs can be identified with, in one sentence."""
        base = self.setup.base
        if not self.logs:
            robot = base.model.robot
            return Remark(
                f"{robot.name} has {len(robot.driven)} joints, and "
                f"{base.size} base parameters of {base.model.size} standard parameters"
            )
        count = sum(len(log.doubts) for log in self.logs)
        if count:
            text = f"Look at what is marked before you identify; findings: {count}"
            return Remark(text, Status.DOUBTFUL)
        text = "Nothing suspicious was found, and all base parameters are determined"
        return Remark(text, Status.GOOD)

    def overview(self) -> list[Table]:
        """Return the verdict, and the logs with what is suspicious of them."""
        verdict = Table("", remarks=[self.verdict])
        if not self.logs:
            return [self.setup.robot.summary(), verdict]
        tables = [verdict]
        for log in self.logs:
            table = log.diagnosis.summary()
            table.remarks = tuple(log.doubts)
            tables.append(table)
        return tables

    def save(self, folder: FilePath, settings: Settings) -> list[Path]:
        """Write a page on the logs, and their statistics; return the files."""
        details = Inspection(self.setup).tables()
        return write_inspection(
            Path(folder), self.verdict, self.logs, details, settings
        )

    def tables(self) -> list[Table]:
        """Return robot and parameters, findings on each log, and what it determines."""
        setup = self.setup
        motors = motor_tables(setup.robot)
        tables = [setup.robot.summary(), *motors, setup.base.summary()]
        if setup.notes:
            tables.append(Table("", remarks=setup.notes))
        for diagnosis, fit in self.logs:
            determination = Table("", facts=fit.facts, remarks=fit.determination)
            tables += [diagnosis.summary(), determination]
        return tables


def inspect_logs(
    setup: Setup,
    logs: Paths,
    columns: Columns,
    progress: Progress = ignore_progress,
) -> Inspection:
    """Look for mistakes in logs, and for what each of them does not determine.

    Args:
        setup: How logs become parameters.
        logs: Paths of logs.
        columns: Meaning of their columns.
        progress: Callback, called with a stage and its completed fraction (0 to 1).
    """
    paths = [Path(log) for log in logs]
    setup = select_filter(setup, paths, columns, progress)
    bodies = setup.file_bodies
    examined_logs = []
    for path in paths:
        observations, diagnosis = load_log(setup, path, columns, progress)
        fit_progress = partial(progress, f"factorising {path.name}")
        fit = identify(setup.base, observations, setup.least_squares, fit_progress)
        progress(f"looking for mistakes in {path.name}", 0.0)
        examined_logs.append(ExaminedLog(diagnosis.with_fit(fit, bodies), fit))
    return Inspection(setup, examined_logs)

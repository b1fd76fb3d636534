"""Examination of logs: is this log sane, and what does it determine?"""

import dataclasses
from functools import partial
from pathlib import Path
from typing import NamedTuple

from jaxid.arrays import Texts
from jaxid.identification.fit_result import Fit
from jaxid.identification.identify import identify
from jaxid.measurement.columns import Columns
from jaxid.result_table import Summarised, Table
from jaxid.validation.diagnosis import Diagnosis

from .log_loading import load_log, select_filter
from .setup import Paths, Progress, Setup, ignore_progress


class ExaminedLog(NamedTuple):
    """Findings on a log, also by a fit to it alone, and what it determines."""

    diagnosis: Diagnosis  # statistics and findings
    fit: Fit  # least-squares fit to this log alone


@dataclasses.dataclass(frozen=True, eq=False)
class Inspection(Summarised):
    """Examined logs, and what was assumed of them."""

    notes: Texts  # assumptions, as sentences
    logs: list[ExaminedLog]  # examined logs

    def tables(self) -> list[Table]:
        """Return findings on each log, and what it determines."""
        tables = []
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
    return Inspection(setup.notes, examined_logs)

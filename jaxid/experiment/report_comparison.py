"""Comparison of two reports: their parameters, and what both predict of a log."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from jaxid.errors import InputError
from jaxid.identification.fit_result import Fit
from jaxid.identification.parameter_changes import Comparison, compare
from jaxid.report.comparison_page import ComparisonReport
from jaxid.report.result_files import read_fit, read_result
from jaxid.report.result_records import Record
from jaxid.result_table import Remark, Status
from jaxid.validation.torque_errors import TorqueErrors, torque_errors
from jaxid.workflow.log_loading import load_logs, select_filter
from jaxid.workflow.setup import Progress, ignore_progress

from .experiment import parse_experiment


def compare_reports(
    reports: tuple[Path, Path],
    log: Path | None = None,
    progress: Progress = ignore_progress,
) -> ComparisonReport:
    """Compare the fits of two reports, and what both predict of a log.

    Args:
        reports: Folders that `jaxid identify` has written.
        log: Log that both models predict, in one band; without it the models must have
            the same effects.
        progress: Callback, called with a stage and its completed fraction (0 to 1).

    Raises:
        InputError: If the models differ and there is no log, or the first report does
            not say how its logs were read.
    """
    first_fit, second_fit = (
        dataclasses.replace(read_fit(path), name=str(path)) for path in reports
    )
    fits = (first_fit, second_fit)
    results = [read_result(path) for path in reports]
    errors = {}
    if log is not None:
        errors = errors_on_log(results[0], fits, log, progress)
    comparison = None
    try:
        comparison = compare(*fits)
    except InputError as error:
        if log is None:
            raise InputError(
                f"{error} Or add `--log` with a log on which to compare their "
                "predictions."
            ) from error
    doubts = data_doubts(results, fits, comparison, log)
    return ComparisonReport(first_fit.base.model.robot, comparison, errors, doubts)


def errors_on_log(
    result: Record, fits: Sequence[Fit], log: Path, progress: Progress
) -> dict[str, TorqueErrors]:
    """Return the torque errors of fits on a log that is read as for a report."""
    settings = result.get("settings", {})
    if "experiment_text" not in settings:
        raise InputError(
            f"`{fits[0].name}` does not say how its logs were read: identify again "
            "with `jaxid identify`."
        )
    path = Path(settings["experiment"])
    content = parse_experiment(settings["experiment_text"], path)
    columns = content.require_columns([log])
    setup = select_filter(content.setup, [log], columns, progress)
    observations = load_logs(setup, [log], columns, progress)[0].observations
    progress("predicting torques", 0.0)
    return {fit.name: torque_errors(fit, observations) for fit in fits}


def data_doubts(
    results: Sequence[Record],
    fits: Sequence[Fit],
    comparison: Comparison | None,
    log: Path | None,
) -> list[Remark]:
    """Return which logs both reports were made of, and which reports saw the log."""
    logs = [x.get("settings", {}).get("identification", ()) for x in results]
    places = [{Path(name).resolve() for name in names} for names in logs]
    doubts = []
    for path in sorted(set.intersection(*places)):
        # Different models are compared on one log on purpose.
        if comparison is not None:
            doubts.append(
                f"Both reports were made from one log, `{path.name}`, or from parts of "
                "it: differences between their parameters do not show that the robot "
                "has changed"
            )
    for fit, paths in zip(fits, places, strict=True):
        if log is not None and log.resolve() in paths:
            doubts.append(
                f"`{fit.name}` was fitted to `{log.name}`, or to a part of it: compare "
                "on another log"
            )
    return [Remark(text, Status.DOUBTFUL) for text in doubts]

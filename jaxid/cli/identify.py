"""The commands `jaxid inspect` and `jaxid identify`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from jaxid.cli.options import (
    ExperimentFile,
    Force,
    command_line,
    open_console,
    open_stages,
    refuse_foreign_folder,
)
from jaxid.diagnosis import Diagnosis
from jaxid.errors import InputError
from jaxid.experiment.experiment import Experiment, load_experiment
from jaxid.experiment.progress import Stages
from jaxid.experiment.session import (
    Identification,
    identify_logs,
    is_report,
    load_log,
    select_filter,
)
from jaxid.identification.fit import Fit
from jaxid.identification.identify import identify as estimate
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording
from jaxid.report.identification import (
    alternative_table,
    body_table,
    motor_tables,
    residual_table,
)
from jaxid.report.page import show, show_files, show_remarks
from jaxid.report.result_files import write_report
from jaxid.table import Remark, Status, Table, significant


def inspect(
    experiment: ExperimentFile,
    logs: Annotated[
        list[Path] | None, typer.Argument(help="Logs to examine.", metavar="LOG")
    ] = None,
) -> None:
    """Show what can be identified, and if logs are sane.

    Joints, motors and limits; base parameters and what becomes of each standard parameter; ranges,
    speeds and forces of each log beside the limits, and what the log does not determine.
    """
    console = open_console()
    loaded = load_experiment(experiment)
    paths = logs or []
    choices = len(paths) + 1 if loaded.candidates else 0
    with open_stages(1 + choices + 4 * len(paths)) as stage:
        stage("finding base parameters")
        _ = loaded.base.expressions
        loaded, _ = select_filter(loaded, paths, stage)
        examined = [_examine(loaded, path, stage) for path in paths]
    show(console, loaded.robot.summary(), *motor_tables(loaded.robot), loaded.base.summary())
    show_remarks(console, loaded.notes)
    for log, diagnosis, fit in examined:
        gaps = len(log.segments) - 1
        facts = [
            ("samples", f"{log.samples} at {significant(1 / log.sample_time, 4)} Hz"),
            ("duration", f"{significant(log.duration, 4)} s"),
            ("gaps", str(gaps or "none")),
        ]
        show(console, diagnosis.summary())
        remarks = [*map(Remark, log.notes), *fit.determination]
        show(console, Table("", facts=[*facts, *fit.facts], remarks=remarks))


def _examine(
    experiment: Experiment, path: Path, stage: Stages
) -> tuple[Recording | Observations, Diagnosis, Fit]:
    log = load_log(experiment, path, stage)
    stage(f"factorising {path.name}")
    progress = stage.through(log.recording.samples)
    fit = estimate(experiment.base, log.observations, experiment.estimation.plain, progress)
    stage(f"looking for mistakes in {path.name}")
    findings = dict.fromkeys((*log.diagnosis.findings, *log.diagnosis.fit_findings(fit)))
    return log.recording, dataclasses.replace(log.diagnosis, findings=tuple(findings)), fit


def identify(
    experiment: ExperimentFile,
    logs: Annotated[
        list[Path],
        typer.Argument(
            help="Logs to identify with, fitted together; the folder of an earlier report stands "
            "for the logs it was made of.",
            metavar="LOG",
        ),
    ],
    verify: Annotated[
        list[Path] | None,
        typer.Option(
            "--verify",
            metavar="LOG",
            help="A log to verify with, which the fit does not see; may be repeated.",
        ),
    ] = None,
    split: Annotated[
        float | None,
        typer.Option(
            "--split",
            metavar="F",
            help="Use the first fraction F (0-1) of each log for identification, the rest for "
            "validation.",
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the report.")
    ] = Path("report"),
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Write the figures as PDF too, for papers.")
    ] = False,
    force: Force = False,
) -> None:
    """Estimate the parameters and write a report.

    A page for the browser, with figures and a verdict; the same numbers for programs.
    """
    console, unseen = open_console(), verify or []
    _check_logs(logs, unseen, split)
    refuse_foreign_folder(output, force)
    loaded = load_experiment(experiment)
    files = [p for p in logs if not is_report(p)]
    if not files:
        raise InputError(
            "folders of earlier reports stand for their logs, but at least one log must be given "
            "as a file, for torque errors and figures."
        )
    choices = len(files) + 1 if loaded.candidates else 0
    with open_stages(4 + choices + 2 * (len(files) + len(unseen))) as stage:
        result = identify_logs(loaded, logs, unseen, split, stage)
        stage("writing the report")
        settings = {
            "experiment": str(experiment),
            "command": command_line(experiment, logs, unseen, split, output, pdf),
            "identification": [str(p) for p in logs],
            "verification": [str(p) for p in unseen],
            "split": split,
        }
        written = _write(result, output, settings, pdf)
    _show(console, result)
    show_files(console, output, [p.name for p in written])


def _check_logs(logs: list[Path], verify: list[Path], split: float | None) -> None:
    if split is not None and not 0 < split < 1:
        raise InputError(f"`--split` must lie between 0 and 1, like 0.6, but is {split:g}.")
    places = [p.resolve() for p in logs]
    repeated = next((p for k, p in enumerate(logs) if places[k] in places[:k]), None)
    if repeated is not None:
        raise InputError(f"`{repeated}` is given twice: its rows would count double.")
    both = set(places) & {p.resolve() for p in verify}
    if both:
        raise InputError(
            f"`{sorted(both)[0].name}` is given both to identify and to verify with: a model that "
            "has seen a log is not verified by it; use `--split` to divide one log."
        )


def _write(result: Identification, output: Path, settings: dict, pdf: bool) -> list[Path]:
    experiment, errors = result.experiment, result.validation.errors
    return write_report(
        output,
        result.fit,
        errors[: result.fitted],
        errors[result.fitted :],
        result.validation.definiteness,
        {
            **settings,
            "experiment_text": experiment.text,
            "filter": str(experiment.filter),
            "decimation": str(experiment.decimation),
            "slow": experiment.min_speed,
        },
        (*experiment.notes, *result.notes, *result.findings),
        result.alternative,
        result.choice,
        (*result.findings, *result.mistakes),
        pdf,
    )


def _show(console: Console, result: Identification) -> None:
    fit, robot = result.fit, result.experiment.robot
    tabulated = () if fit.consistency is None else fit.consistency.findings
    notes = [*result.experiment.notes, *result.notes]
    notes += [note for note in fit.notes if note not in tabulated]
    show(console, robot.summary(), *motor_tables(robot))
    show_remarks(console, [*notes, *(Remark(text, Status.DOUBTFUL) for text in result.findings)])
    show(console, fit.summary())
    if fit.residual_spectra is not None:
        show(console, residual_table(fit.residual_spectra, robot))
    show_remarks(console, [Remark(text, Status.DOUBTFUL) for text in result.mistakes])
    if fit.consistency is not None:
        show(console, body_table(fit.consistency, robot.joint_names))
    show(console, result.validation.summary())
    if result.alternative is not None:
        other = result.alternative
        show(console, alternative_table(result.validation.errors, other.errors, other.names))

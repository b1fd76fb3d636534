"""Work of the commands: logs are loaded and diagnosed, runs put together, models identified."""

import dataclasses
import functools
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress, TimeElapsedColumn

from jaxid.errors import InputError
from jaxid.excitation.design import DesignProgress
from jaxid.identification.combination import (
    combine_fits,
    replace_estimates,
    require_same_base,
    share_rows,
    without_bounds,
)
from jaxid.identification.consistency import PhysicallyConsistent
from jaxid.identification.encoder_resolution import resolution_note
from jaxid.identification.estimators import AbstractEstimator, Complete, GivenWeights
from jaxid.identification.filter_selection import (
    FilterChoice,
    choose_filter,
)
from jaxid.identification.fit_result import Fit
from jaxid.identification.identify import fit_problem
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.log_files import is_bag_folder
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import NeedsMemory, Recording
from jaxid.report.result_files import read_fit
from jaxid.validation.diagnosis import Diagnosis, diagnose, mistakes_in_logs
from jaxid.validation.torque_errors import (
    TorqueErrors,
    Validation,
    comparison_step,
    torque_errors,
    validate,
)
from jaxid.validation.verdict import Report

from .decoder import within
from .experiment import Experiment

LoadedLog = tuple[Recording | Observations, Observations, Diagnosis]
"""Log as it was read (of a log on disk its observations), filtered log, and diagnosis."""


class Stages:
    """Progress bar of a command, called with the name of each stage as it begins."""

    def __init__(self, bar: Progress):
        self._bar = bar
        self._task = bar.add_task("starting", total=1.0)

    def __call__(self, name: str) -> None:
        """Begin a stage."""
        self._bar.reset(self._task, description=name)

    def through(self, fraction: float) -> None:
        """Show the completed fraction (0 to 1) of the stage."""
        self._bar.update(self._task, completed=fraction)

    def design(self, now: DesignProgress) -> None:
        """Show the progress of a design, and the best value so far."""
        kept = "" if now.feasible else ", limits not yet kept"
        text = f"{now.task}, best so far {now.best:.5g}{kept}"
        self._bar.update(self._task, description=text, completed=now.fraction)


@contextmanager
def stages(console: Console) -> Iterator[Stages]:
    """Show a progress bar in a terminal, and nothing elsewhere."""
    columns = (*Progress.get_default_columns(), TimeElapsedColumn())
    quiet = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=quiet) as progress:
        yield Stages(progress)


def load_log(
    experiment: Experiment, path: Path, stage: Stages, name: str | None = None
) -> LoadedLog:
    """Read and diagnose a log; one of many samples stays on the disk."""
    notes = ()
    if experiment.is_long(path):
        try:
            stage(f"opening {path.name}")
            log = experiment.open(path)
            log = log if name is None else log.replace(name=name)
            stage(f"looking through {path.name}")
            robot, min_speed = experiment.robot, experiment.min_speed
            diagnosis = diagnose(
                log, robot, min_speed=min_speed, progress=stage.through
            )
            notes, step = (*log.notes, *diagnosis.notes), comparison_step(log)
            if step > 1:
                what = f"one of every {step} of its {log.rows} rows"
                notes = (*notes, f"{log.name}: torque errors and figures take {what}")
            log = log.replace(notes=notes)
            return log, log, diagnosis
        except NeedsMemory as why:
            notes = (f"{path.name} is long, but was read as a whole: {why}",)
    stage(f"reading {path.name}")
    recording = experiment.read(path)
    if name is not None:
        recording = dataclasses.replace(recording, name=name)
    stage(f"filtering {path.name}")
    observations = experiment.observe(recording)
    diagnosis = diagnose(recording, experiment.robot, observations=observations)
    return (
        recording,
        observations.replace(notes=(*observations.notes, *notes)),
        diagnosis,
    )


def findings(logs: Sequence[LoadedLog]) -> list[str]:
    """Return the findings on logs, each behind the name of its log."""
    return [
        f"{log.name}: {text}"
        for log, _, diagnosis in logs
        for text in diagnosis.findings
    ]


def require_motion(logs: Sequence[LoadedLog]) -> None:
    """Reject logs in which nothing moves."""
    for log, _, diagnosis in logs:
        if diagnosis.statistics.speed.max() < 1e-9:
            raise InputError(
                f"no joint moves in `{log.name}`: name other columns, or another log."
            )


def select_filter(
    experiment: Experiment,
    logs: Sequence[Path],
    stage: Stages,
    split: float | None = None,
) -> tuple[Experiment, FilterChoice | None]:
    """Return the experiment with the filter that suits some logs best, and the choice.

    The rest of each log beyond the fraction `split` stays unseen.
    """
    if not experiment.candidates or not logs:
        return experiment, None
    long = [log.name for log in logs if experiment.is_long(log)]
    if long:
        raise InputError(
            f"{experiment.path.name}: `filter.cutoff` is a list, but `{long[0]}` is "
            "long: choose "
            "with a short part of it, and give that one number for the whole."
        )
    recordings = []
    for log in logs:
        stage(f"reading {log.name}")
        recording = experiment.read(log)
        recordings.append(recording if split is None else recording.split(split)[0])
    stage("choosing the filter")
    with within("filter` and `rows", experiment.path.name):
        choice = choose_filter(
            experiment.base,
            recordings,
            experiment.candidates,
            estimator=_without_bounds(experiment),
            min_speed=experiment.min_speed,
            progress=stage.through,
        )
    notes = (*experiment.notes, str(choice))
    return dataclasses.replace(
        experiment, filter=choice.filter, candidates=(), notes=notes
    ), choice


def _without_bounds(experiment: Experiment) -> AbstractEstimator:
    """Return the estimator of an experiment; for bodies that can exist, plain least squares."""
    chosen = experiment.estimation
    bounded = isinstance(chosen.estimator, PhysicallyConsistent)
    return chosen.plain if bounded else chosen.estimator


def is_report(path: Path) -> bool:
    """Return whether a folder is an earlier report, and no bag."""
    return path.is_dir() and not is_bag_folder(path)


def earlier_run(experiment: Experiment, folder: Path) -> Fit:
    """Return the fit of the report in a folder."""
    fit = read_fit(folder)
    try:
        require_same_base(
            (fit, dataclasses.replace(fit, base=experiment.base, name="these logs"))
        )
    except InputError as error:
        raise InputError(
            f"`{folder}` does not fit `{experiment.path.name}`: {error}"
        ) from error
    return fit


def read_runs(
    experiment: Experiment,
    groups: Sequence[Sequence[Path]],
    names: Sequence[str],
    stage: Stages,
) -> tuple[list[Fit], list[str]]:
    """Return a run of the logs and reports of each group, and doubts about the logs."""
    if experiment.linear is not None:
        raise InputError(
            f"{experiment.path.name}: `estimator.nonlinear_friction` would find other "
            "shapes of "
            "friction in each run: leave it out, and give all runs one `epsilon` and "
            "`stribeck`."
        )
    estimation, doubts = experiment.estimation, []
    complete = isinstance(estimation.plain.solution, Complete)
    plain = _without_bounds(experiment) is estimation.plain and complete
    if not plain or estimation.essential is not None:
        rest = "the rest of `[estimator]` does not count"
        doubts.append(f"all runs are weighted least squares here: {rest}")
    stage("finding base parameters")
    files = [path for paths in groups for path in paths if not is_report(path)]
    experiment, _ = select_filter(experiment, files, stage)
    runs = []
    for paths, name in zip(groups, names, strict=True):
        fits = [earlier_run(experiment, path) for path in paths if is_report(path)]
        logs = [
            load_log(experiment, path, stage) for path in paths if not is_report(path)
        ]
        require_motion(logs)
        doubts += findings(logs)
        if logs:
            stage(f"factorising the rows, {name}")
            observations = [log for _, log, _ in logs]
            rows = RegressionProblem(experiment.base, observations, stage.through)
            fits.append(fit_problem(rows, estimation.plain))
            doubts += mistakes_in_logs([diagnosis for *_, diagnosis in logs], fits[-1])[
                0
            ]
        runs.append(
            dataclasses.replace(functools.reduce(combine_fits, fits), name=name)
        )
    return runs, doubts


def identify_logs(
    experiment: Experiment,
    paths: Sequence[Path],
    verify: Sequence[Path],
    split: float | None,
    command: str,
    stage: Stages,
) -> tuple[Report, Validation]:
    """Identify with logs and with what earlier reports keep, and validate."""
    logs = [p for p in paths if not is_report(p)]
    reports = [p for p in paths if is_report(p)]
    experiment, choice = select_filter(experiment, logs, stage, split)
    loaded, stems = [], [path.stem for path in (*logs, *verify)]
    for path in (*logs, *verify):
        # Equal names are preceded by their folders.
        folder = Path(os.path.realpath(path)).parent.name
        name = f"{folder}/{path.stem}" if stems.count(path.stem) > 1 else None
        loaded.append(load_log(experiment, path, stage, name))
    require_motion(loaded)
    observations = [log for _, log, _ in loaded]
    fitted, unseen = observations[: len(logs)], observations[len(logs) :]
    if split is not None:
        parts = [log.split(split) for log in fitted]
        fitted = [
            a.replace(name=f"{a.name}, first {100 * split:g} %") for a, _ in parts
        ]
        unseen = [*(b.replace(name=f"{b.name}, rest") for _, b in parts), *unseen]
    stage("finding base parameters")
    base = experiment.base
    stage("factorising the rows")
    rows = RegressionProblem(base, fitted, stage.through)
    fit = experiment.fit(rows, stage.through)
    if reports:
        fit = _add_reports(experiment, reports, fit, unseen)
    stage("predicting torques")
    every = [*fitted, *unseen]
    validation = validate(fit, every, progress=stage.through)
    stage("looking for mistakes")
    # Bounds would hide what is wrong.
    free, diagnoses = (
        without_bounds(fit),
        [diagnosis for *_, diagnosis in loaded[: len(logs)]],
    )
    mistakes, more = mistakes_in_logs(diagnoses, free)
    notes = [*(note for o in every for note in o.notes), *more]
    for log, whole, diagnosis in loaded[: len(logs)]:
        if isinstance(log, Recording) and not diagnosis.faulty:
            notes += [f"{log.name}: {x}" for x in resolution_note(fit, log, whole)]
    settings = {
        "experiment": str(experiment.path),
        "command": command,
        "identification": [str(p) for p in paths],
        "verification": [str(p) for p in verify],
        "split": split,
        "experiment_text": experiment.text,
        "filter": str(experiment.filter),
        "decimation": str(experiment.decimation),
        "min_speed": experiment.min_speed,
    }
    claimed, claimed_mass = _errors_of_claims(experiment, fit, every)
    report = Report(
        fit,
        validation.errors[: len(fitted)],
        validation.errors[len(fitted) :],
        validation.definiteness,
        settings,
        notes=(*experiment.notes, *dict.fromkeys(notes)),
        doubts=findings(loaded),
        mistakes=mistakes,
        choice=choice,
        claimed=claimed,
        claimed_mass=claimed_mass,
    )
    return report, validation


def _errors_of_claims(
    experiment: Experiment, fit: Fit, logs: Sequence[Observations]
) -> tuple[tuple[TorqueErrors, ...], float]:
    """Return torque errors of the parameters that the robot's file claims, and its mass [kg]."""
    try:
        known = experiment.source.claims(experiment.path.parent)
    except InputError:
        return (), 0.0  # the robot's notes name the body
    if not known:
        return (), 0.0
    standard = [known.get(name, 0.0) for name in fit.base.model.parameter_names]
    claim = dataclasses.replace(
        fit, parameters=np.asarray(fit.base.from_standard(standard))
    )
    mass = float(np.sum([known[f"m{k + 1}"] for k in range(experiment.robot.joints)]))
    return tuple(torque_errors(claim, log) for log in logs), mass


def _add_reports(
    experiment: Experiment,
    reports: Sequence[Path],
    fit: Fit,
    unseen: Sequence[Observations],
) -> Fit:
    """Return a fit to all logs, those of earlier reports included, which must not be unseen."""
    bounded = fit.consistency is not None
    if fit.base.names != experiment.base.names or not (bounded or fit.is_least_squares):
        essential = experiment.estimation.essential is not None
        kind = "for essential parameters" if essential else fit.estimator
        raise InputError(
            f"{experiment.path.name}: earlier reports can be added to least squares "
            "only, "
            f"but the estimator is {kind}: leave `[estimator]` out, or give the logs "
            "themselves."
        )
    estimator = experiment.estimation.estimator
    fit = functools.reduce(
        combine_fits, [*(earlier_run(experiment, p) for p in reports), fit]
    )
    if isinstance(estimator, PhysicallyConsistent):
        rows = RegressionProblem(fit.base, blocks=fit.time_blocks, names=fit.recordings)
        weighted = dataclasses.replace(estimator, weights=GivenWeights(fit.weights))
        found = dataclasses.replace(fit_problem(rows, weighted), name=fit.name)
        fit = replace_estimates(found, found.parameters, fit.uncertainty)
    for log in unseen:
        rows = RegressionProblem(experiment.base, [log])
        if fit.blocks is not None and share_rows(fit.blocks, rows.blocks):
            raise InputError(
                f"a report that was given has seen the data of `{log.name}`: verify "
                "with another."
            )
    return fit

"""Work of the commands: logs are loaded and diagnosed, runs put together, models identified."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

from jaxid.diagnosis import Diagnosis, diagnose
from jaxid.diagnosis.diagnosis import mistakes_in_logs
from jaxid.diagnosis.mislabelled import BAD
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.experiment.decoder import within
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.progress import Stages
from jaxid.identification.choices import FilterChoice, choose_filter
from jaxid.identification.combination import require_same_base, share_rows, update
from jaxid.identification.fit import Fit, load
from jaxid.identification.identify import fit_problem
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording
from jaxid.measurement.timestamps import NeedsMemory
from jaxid.report.identification import solution_name
from jaxid.report.result_files import MODEL, Alternative
from jaxid.validation import Validation, comparison_step, torque_errors, validate


@dataclasses.dataclass(frozen=True)
class LoadedLog:
    """Log of an experiment, and its diagnosis.

    Attributes:
        recording: Log as it was read; the observations of a log on disk.
        observations: Filtered log.
        diagnosis: Statistics beside the limits of the robot, and findings.
        notes: Remarks on how it was read, as sentences.
    """

    recording: Recording | Observations
    observations: Observations
    diagnosis: Diagnosis
    notes: tuple[str, ...] = ()


def load_log(
    experiment: Experiment, path: Path, stage: Stages, name: str | None = None
) -> LoadedLog:
    """Read and diagnose a log; one of many samples stays on the disk.

    Args:
        experiment: Experiment of the log.
        path: Path of the log.
        stage: Progress bar.
        name: Name of the log; the file's if None.

    Raises:
        InputError: If the log is not as the experiment's file says.
    """
    notes = ()
    if experiment.is_long(path):
        try:
            return _scan_log(experiment, path, stage, name)
        except NeedsMemory as why:
            notes = (f"{path.name} is long, but was read as a whole: {why}",)
    stage(f"reading {path.name}")
    recording = experiment.read(path)
    if name is not None:
        recording = dataclasses.replace(recording, name=name)
    stage(f"filtering {path.name}")
    observations = experiment.observe(recording)
    diagnosis = diagnose(recording, experiment.robot, observations=observations)
    return LoadedLog(recording, observations, diagnosis, notes)


def _scan_log(experiment: Experiment, path: Path, stage: Stages, name: str | None) -> LoadedLog:
    stage(f"opening {path.name}")
    log = experiment.open(path)
    log = log if name is None else log.replace(name=name)
    stage(f"looking through {path.name}")
    diagnosis = diagnose(
        log,
        experiment.robot,
        min_speed=experiment.min_speed,
        progress=stage.through(log.samples),
    )
    log = log.replace(notes=(*log.notes, *diagnosis.notes))
    step = comparison_step(log)
    if step == 1:
        return LoadedLog(log, log, diagnosis)
    note = f"{log.name}: torque errors and figures take one of every {step} of its {log.rows} rows"
    return LoadedLog(log, log, diagnosis, (note,))


def load_logs(experiment: Experiment, paths: Sequence[Path], stage: Stages) -> list[LoadedLog]:
    """Read and diagnose logs; equal names are preceded by their folders.

    Args:
        experiment: Experiment of the logs.
        paths: Paths of the logs.
        stage: Progress bar.

    Raises:
        InputError: If a log is not as the experiment's file says.
    """
    stems = [p.stem for p in paths]
    logs = []
    for path in paths:
        twice = stems.count(path.stem) > 1
        name = f"{path.resolve().parent.name}/{path.stem}" if twice else None
        logs.append(load_log(experiment, path, stage, name))
    return logs


def findings_of(logs: Sequence[LoadedLog]) -> list[str]:
    """Return the findings on logs, with their names.

    Args:
        logs: Loaded logs.
    """
    return [f"{log.recording.name}: {text}" for log in logs for text in log.diagnosis.findings]


def select_filter(
    experiment: Experiment, logs: Sequence[Path], stage: Stages, split: float | None = None
) -> tuple[Experiment, FilterChoice | None]:
    """Return the experiment with the filter that suits some logs best, and the choice.

    Args:
        experiment: Experiment; unchanged if its file names one filter.
        logs: Logs to identify with.
        stage: Progress bar.
        split: Fraction of each log to identify with; the rest stays unseen here too.

    Raises:
        InputError: If a log and a filter do not go together, or a log is long.
    """
    if not experiment.candidates or not logs:
        return experiment, None
    long = [log.name for log in logs if experiment.is_long(log)]
    if long:
        raise InputError(
            f"{experiment.path.name}: `filter.cutoff` is a list, but `{long[0]}` is long: choose "
            "with a short part of it, and give that one number for the whole."
        )
    recordings = []
    for log in logs:
        stage(f"reading {log.name}")
        recording = experiment.read(log)
        recordings.append(recording if split is None else recording.split(split)[0])
    stage("choosing the filter")
    samples = len(experiment.candidates) * sum(r.samples for r in recordings)
    with within("filter` and `rows", experiment.path.name):
        choice = choose_filter(
            experiment.base,
            recordings,
            experiment.candidates,
            estimator=experiment.estimation.estimator,
            min_speed=experiment.min_speed,
            progress=stage.through(samples),
        )
    notes = (*experiment.notes, str(choice))
    return dataclasses.replace(experiment, filter=choice.filter, candidates=(), notes=notes), choice


def is_report(path: Path) -> bool:
    """Return whether a path stands for the logs that a report was made of.

    Args:
        path: Path of a log or of a report.
    """
    return path.is_dir()


def earlier_run(experiment: Experiment, folder: Path) -> Fit:
    """Return the fit of an earlier report.

    Args:
        experiment: Experiment with the same robot and model.
        folder: Folder that `jaxid identify` has written.

    Raises:
        InputError: If it keeps nothing, or of another robot or model.
    """
    path = folder / MODEL
    if not path.is_file():
        raise InputError(
            f"`{folder}` is a folder, but holds no `{MODEL}`: name a log, or the folder of a "
            "report that `jaxid identify` has written."
        )
    fit = load(path)
    try:
        require_same_base((fit, dataclasses.replace(fit, base=experiment.base, name="these logs")))
    except InputError as error:
        raise InputError(f"`{path}` does not fit `{experiment.path.name}`: {error}") from error
    return fit


def require_plain(experiment: Experiment) -> tuple[str, ...]:
    """Reject estimators that two runs cannot share; return a note on what others disregard.

    Args:
        experiment: Experiment of the runs.

    Raises:
        InputError: If the shape of friction is sought.
    """
    if experiment.linear is not None:
        raise InputError(
            f"{experiment.path.name}: `estimator.nonlinear_friction` would find other shapes of "
            "friction in each run: leave it out, and give both runs the shapes that `jaxid "
            "identify` finds, as `epsilon` and `stribeck` of `model.coulomb`."
        )
    estimation = experiment.estimation
    plain = estimation.estimator is estimation.plain and not estimation.regularised
    if plain and estimation.essential is None:
        return ()
    return ("all runs are weighted least squares here: the rest of `[estimator]` does not count",)


def read_run(
    experiment: Experiment, paths: Sequence[Path], stage: Stages, name: str
) -> tuple[Fit, list[str]]:
    """Return logs, and reports that stand for theirs, as one run; and findings on the logs.

    Args:
        experiment: Experiment of the logs.
        paths: Paths of logs and of folders of reports.
        stage: Progress bar.
        name: Name of the run.

    Raises:
        InputError: If a log is not as the experiment's file says, or a folder holds no report.
    """
    runs = [earlier_run(experiment, path) for path in paths if is_report(path)]
    logs = [load_log(experiment, path, stage) for path in paths if not is_report(path)]
    findings = findings_of(logs)
    if logs:
        observations = [log.observations for log in logs]
        stage(f"factorising the rows, {name}")
        through = stage.through(sum(o.samples for o in observations))
        rows = RegressionProblem(experiment.base, observations, through)
        fit = fit_problem(rows, experiment.estimation.plain)
        findings += mistakes_in_logs([log.diagnosis for log in logs], fit)
        runs.append(fit)
    return functools.reduce(update, runs), findings


@dataclasses.dataclass(frozen=True)
class Identification:
    """Result of the command `jaxid identify`.

    Attributes:
        experiment: Experiment with the filter that was chosen.
        choice: Choice of the filter, where it was left to the logs.
        fit: Identified parameters.
        validation: Torque errors of all logs, those of the fit first.
        fitted: Number of logs, or of parts of logs, of the fit.
        alternative: Another solution of the same equations, where logs do not determine everything.
        notes: Notes on the logs, as sentences.
        findings: Findings on the logs.
        mistakes: Likely mistakes in the columns of the logs, by the fit.
    """

    experiment: Experiment
    choice: FilterChoice | None
    fit: Fit
    validation: Validation
    fitted: int
    alternative: Alternative | None
    notes: list[str]
    findings: list[str]
    mistakes: tuple[str, ...]


def identify_logs(
    experiment: Experiment,
    paths: Sequence[Path],
    verify: Sequence[Path],
    split: float | None,
    stage: Stages,
) -> Identification:
    """Identify with logs and with what earlier reports keep, and validate.

    Args:
        experiment: Experiment of the logs.
        paths: Logs to identify with, and folders of earlier reports.
        verify: Logs to verify with.
        split: Fraction of each log to identify with; None for all.
        stage: Progress bar.

    Raises:
        InputError: If a log is not as the file says, or a log would verify a model that has seen
            it.
    """
    logs = [p for p in paths if not is_report(p)]
    reports = [p for p in paths if is_report(p)]
    experiment, choice = select_filter(experiment, logs, stage, split)
    loaded = load_logs(experiment, [*logs, *verify], stage)
    observations = [log.observations for log in loaded]
    fitted, unseen = observations[: len(logs)], observations[len(logs) :]
    if split is not None:
        fitted, rests = _split(fitted, split)
        unseen = [*rests, *unseen]
    stage("finding base parameters")
    base = experiment.base
    stage("factorising the rows")
    samples = sum(o.samples for o in fitted)
    rows = RegressionProblem(base, fitted, stage.through(samples))
    fit = experiment.fit(rows, stage.through(samples))
    notes = [note for o in (*fitted, *unseen) for note in o.notes]
    notes += [note for log in loaded for note in log.notes]
    if reports:
        fit = _add_reports(experiment, reports, fit)
        _refuse_seen(fit, base, unseen)
    stage("predicting torques")
    through = stage.through(max(o.samples for o in [*fitted, *unseen]))
    validation = validate(fit, [*fitted, *unseen], progress=through)
    alternative = None
    if (experiment.estimation.regularised or fit.undetermined) and not reports:
        same = rows if fit.base is base else RegressionProblem(fit.base, fitted)
        alternative = _alternative(experiment, fit, same, [*fitted, *unseen])
    mistakes = mistakes_in_logs([log.diagnosis for log in loaded[: len(logs)]], fit)
    if fit.residual > BAD and not mistakes:
        notes.append(
            "whether the forces stand later in the logs than the angles takes longer to tell: "
            "`jaxid inspect` says so for each log."
        )
    return Identification(
        experiment,
        choice,
        fit,
        validation,
        len(fitted),
        alternative,
        list(dict.fromkeys(notes)),
        findings_of(loaded),
        mistakes,
    )


def _split(
    logs: Sequence[Observations], fraction: float
) -> tuple[list[Observations], list[Observations]]:
    """Return the first parts of logs and their rests, with names that say so."""
    parts = [log.split(fraction) for log in logs]
    first = [a.replace(name=f"{a.name}, first {100 * fraction:g} %") for a, _ in parts]
    return first, [b.replace(name=f"{b.name}, rest") for _, b in parts]


def _add_reports(experiment: Experiment, reports: Sequence[Path], fit: Fit) -> Fit:
    """Return a fit to all logs, those of earlier reports included."""
    if fit.base.names != experiment.base.names or not fit.is_least_squares:
        essential = experiment.estimation.essential is not None
        kind = "for essential parameters" if essential else fit.estimator
        raise InputError(
            f"{experiment.path.name}: earlier reports can be added to plain least squares only, "
            f"but the estimator is {kind}: leave `[estimator]` out, or give the logs themselves."
        )
    return functools.reduce(update, [*(earlier_run(experiment, p) for p in reports), fit])


def _refuse_seen(fit: Fit, base: BaseParameters, unseen: Sequence[Observations]) -> None:
    for log in unseen:
        if fit.blocks is not None and share_rows(fit.blocks, RegressionProblem(base, [log]).blocks):
            raise InputError(
                f"a report that was given has seen the data of `{log.name}`: a model that has seen "
                "a log is not verified by it; verify with another."
            )


def _alternative(
    experiment: Experiment, fit: Fit, rows: RegressionProblem, logs: Sequence[Observations]
) -> Alternative:
    other = fit_problem(rows, experiment.other_estimator)
    names = (solution_name(fit.solution), solution_name(other.solution))
    return Alternative(other, [torque_errors(other, log) for log in logs], names)

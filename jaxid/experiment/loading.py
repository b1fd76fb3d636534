"""Logs as a command needs them: short ones as a whole, long ones part by part."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from jaxid.diagnose import Diagnosis, diagnose
from jaxid.errors import InputError
from jaxid.experiment.decoder import within
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.progress import Stages
from jaxid.identification.filter_choice import FilterChoice, choose_filter
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording
from jaxid.measurement.timestamps import NeedsMemory
from jaxid.validation import comparison_step


@dataclasses.dataclass(frozen=True)
class Loaded:
    """A log, and what is strange about it.

    Attributes:
        recording: As it was read.
        observations: What the filter makes of it.
        diagnosis: Statistics of the log beside the limits of its robot, and findings.
        notes: How it was read, in sentences.
    """

    recording: Recording | Observations
    observations: Observations
    diagnosis: Diagnosis
    notes: tuple[str, ...] = ()


def load_log(experiment: Experiment, path: Path, stage: Stages, name: str | None = None) -> Loaded:
    """Reads a log and looks through it; one of many samples stays on the disk.

    Args:
        experiment: Whose log it is.
        path: Of the log.
        stage: Is told what is done.
        name: Of the log; the file's if None.

    Raises:
        InputError: If the log is not as the experiment's file says.
    """
    notes = ()
    if experiment.is_long(path):
        try:
            return _opened(experiment, path, stage, name)
        except NeedsMemory as why:
            notes = (f"{path.name} is long, but was read as a whole: {why}",)
    stage(f"reading {path.name}")
    recording = experiment.read(path)
    if name is not None:
        recording = dataclasses.replace(recording, name=name)
    stage(f"filtering {path.name}")
    observations = experiment.observe(recording)
    diagnosis = diagnose(recording, experiment.robot, observations=observations)
    return Loaded(recording, observations, diagnosis, notes)


def _opened(experiment: Experiment, path: Path, stage: Stages, name: str | None) -> Loaded:
    stage(f"opening {path.name}")
    log = experiment.open(path)
    log = log if name is None else log.replace(name=name)
    stage(f"looking through {path.name}")
    diagnosis = diagnose(
        log, experiment.robot, min_speed=experiment.min_speed, progress=stage.through(log.samples)
    )
    log = log.replace(notes=(*log.notes, *diagnosis.notes))
    every = comparison_step(log)
    if every == 1:
        return Loaded(log, log, diagnosis)
    note = f"{log.name}: torque errors and figures take one of every {every} of its {log.rows} rows"
    return Loaded(log, log, diagnosis, (note,))


def choose(
    experiment: Experiment, logs: Sequence[Path], stage: Stages, split: float | None = None
) -> tuple[Experiment, FilterChoice | None]:
    """The experiment with the filter that suits some logs best, and why it was chosen.

    Args:
        experiment: Unchanged where its file names one filter.
        logs: Those to identify with.
        stage: Is told what is done.
        split: First part of each log to identify with, of 1; the rest stays unseen here too.

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
        whole = experiment.read(log)
        recordings.append(whole if split is None else whole.split(split)[0])
    stage("choosing the filter")
    with within("filter` and `rows", experiment.path.name):
        choice = choose_filter(
            experiment.base,
            recordings,
            experiment.candidates,
            estimator=experiment.estimation.estimator,
            min_speed=experiment.min_speed,
            progress=stage.through(len(experiment.candidates) * sum(r.samples for r in recordings)),
        )
    notes = (*experiment.notes, str(choice))
    chosen = dataclasses.replace(experiment, filter=choice.filter, candidates=(), notes=notes)
    return chosen, choice


def load_logs(experiment: Experiment, paths: Sequence[Path], stage: Stages) -> list[Loaded]:
    """Reads and looks through logs; equal names take their folders' in front.

    Args:
        experiment: Whose logs they are.
        paths: Of the logs.
        stage: Is told what is done.

    Raises:
        InputError: If a log is not as the experiment's file says.
    """
    stems = [p.stem for p in paths]
    found = []
    for path in paths:
        twice = stems.count(path.stem) > 1
        name = f"{path.resolve().parent.name}/{path.stem}" if twice else None
        found.append(load_log(experiment, path, stage, name))
    return found


def doubts_of(logs: Sequence[Loaded]) -> list[str]:
    """What is strange about the channels of logs, by their names."""
    return [f"{log.recording.name}: {said}" for log in logs for said in log.diagnosis.findings]

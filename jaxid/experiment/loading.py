"""Logs as a command needs them: short ones as a whole, long ones part by part."""

import dataclasses
from pathlib import Path

from jaxid.experiment.experiment import Experiment
from jaxid.experiment.progress import Stages
from jaxid.experiment.sanity import LogCheck, check_log, check_long_log
from jaxid.identification.streaming_log import LongLog
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording
from jaxid.measurement.survey import NeedsMemory
from jaxid.validation.errors import compared_rows


@dataclasses.dataclass(frozen=True)
class Loaded:
    """A log, and what is strange about it.

    Attributes:
        recording: As it was read.
        observations: What the filter makes of it.
        check: What it holds beside the robot's limits.
        notes: How it was read, in sentences.
    """

    recording: Recording | LongLog
    observations: Observations | LongLog
    check: LogCheck
    notes: tuple[str, ...] = ()


def load_log(experiment: Experiment, path: Path, stage: Stages, name: str | None = None) -> Loaded:
    """Reads a log and looks through it; one of many samples stays on the disk.

    Args:
        experiment: Whose log it is.
        path: Of the log.
        stage: Is told what is done.
        name: Of the log; the file's if None.

    Raises:
        ValueError: If the log is not as the experiment's file says.
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
    check = check_log(experiment.robot, recording, observations)
    return Loaded(recording, observations, check, notes)


def _opened(experiment: Experiment, path: Path, stage: Stages, name: str | None) -> Loaded:
    stage(f"opening {path.name}")
    log = experiment.open(path)
    log = log if name is None else log.named(name)
    stage(f"looking through {path.name}")
    check = check_long_log(experiment.robot, log, stage.through(log.samples))
    every = compared_rows(log)
    if every == 1:
        return Loaded(log, log, check)
    note = f"{log.name}: torque errors and figures take one of every {every} of its {log.rows} rows"
    return Loaded(log, log, check, (note,))

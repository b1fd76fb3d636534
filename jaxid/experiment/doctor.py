"""The doctor: everything that a log gives away about slips in its experiment file."""

from collections.abc import Sequence

from jaxid.experiment.experiment import Experiment
from jaxid.experiment.lateness import delay_doubts
from jaxid.experiment.loading import Loaded
from jaxid.experiment.mistakes import likely_mistake
from jaxid.experiment.sanity import check_log, negative_friction
from jaxid.identification.fit import Fit
from jaxid.identification.identify import identify
from jaxid.measurement.recording import Recording


def examine(experiment: Experiment, recording: Recording) -> tuple[str, ...]:
    """What is strange about a log, in sentences; nothing if all is well.

    Args:
        experiment: What its file says of the log.
        recording: The log, as the file says it is to be read.

    Raises:
        InputError: If the log and the filter do not go together.
    """
    observations = experiment.observe(recording)
    check = check_log(experiment.robot, recording, observations)
    fit = identify(experiment.base, observations, experiment.estimation.plain)
    log = Loaded(recording, observations, check, observations)
    return (*fitted_doubts(log, fit), *check.warnings)


def fitted_doubts(log: Loaded, fit: Fit) -> tuple[str, ...]:
    """What a fit to one log gives away, a delay included.

    Args:
        log: As it was read.
        fit: Of this log alone.
    """
    # Slips and faults of channels that are known explain the rest.
    if log.check.faulty:
        return ()
    slips = () if log.examined is None else likely_mistake(fit.base, log.examined, *log.sides)
    if slips or log.examined is None:
        return slips or negative_friction(fit)
    return (*negative_friction(fit), *delay_doubts(fit.base, log.examined, fit))


def slips_of(logs: Sequence[Loaded], fit: Fit) -> tuple[str, ...]:
    """What a fit to several logs gives away, apart from delays, with the names of the logs.

    Args:
        logs: All of which it was made of.
        fit: Of these logs together.
    """
    sound = [log for log in logs if not log.check.faulty]
    slips = [
        f"{log.recording.name}: {said}"
        for log in sound
        if log.examined is not None
        for said in likely_mistake(fit.base, log.examined, *log.sides)
    ]
    return (*(negative_friction(fit) if len(sound) == len(logs) else ()), *slips)

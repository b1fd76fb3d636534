"""The doctor: everything that a log gives away about slips in its experiment file."""

from jaxid.experiment.experiment import Experiment
from jaxid.experiment.lateness import delay_doubts
from jaxid.experiment.mistakes import likely_mistake
from jaxid.experiment.sanity import check_log, negative_friction
from jaxid.identification.fit import Fit
from jaxid.identification.identify import identify
from jaxid.identification.streaming_log import LongLog
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording


def examine(experiment: Experiment, recording: Recording) -> tuple[str, ...]:
    """What is strange about a log, in sentences; nothing if all is well.

    Args:
        experiment: What its file says of the log.
        recording: The log, as the file says it is to be read.

    Raises:
        ValueError: If the log and the filter do not go together.
    """
    observations = experiment.observe(recording)
    check = check_log(experiment.robot, recording, observations)
    fit = identify(experiment.base, observations, experiment.plain)
    sides = recording.angles_on_motor_side, recording.forces_on_motor_side
    return (*fitted_doubts(observations, fit, *sides), *check.warnings)


def fitted_doubts(
    observations: Observations | LongLog,
    fit: Fit,
    angles_on_motor_side: bool,
    forces_on_motor_side: bool,
) -> tuple[str, ...]:
    """What a fit to one log gives away.

    Args:
        observations: Of the log.
        fit: Of this log alone.
        angles_on_motor_side: Whether its angles are taken for the motors'.
        forces_on_motor_side: Whether its forces are taken for the motors'.
    """
    sides = angles_on_motor_side, forces_on_motor_side
    slips = likely_mistake(fit.base, observations, *sides)
    # A slip that is known explains both of the others.
    return slips or (*negative_friction(fit), *delay_doubts(fit.base, observations, fit))

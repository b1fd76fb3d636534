"""Work of `jaxid rollout`: logs of commands or of torques become a report."""

from collections.abc import Sequence
from pathlib import Path

from jaxid.errors import InputError
from jaxid.report.rollout import RolloutReport
from jaxid.report.torque_rollout import TorqueRolloutReport
from jaxid.result_table import Remark, Status
from jaxid.rollout import identify_rollout, identify_torque_rollout

from .decoder import within
from .experiment import Experiment
from .identify_logs import Stages, findings, load_log, require_motion, select_filter
from .model_and_log_tables import SERVO_OPTIONS


def identify_rollouts(
    experiment: Experiment,
    logs: Sequence[Path],
    verify: Sequence[Path],
    command: str,
    stage: Stages,
) -> RolloutReport | TorqueRolloutReport:
    """Identify from commands if the file names them, otherwise from torques; and simulate."""
    torques = experiment.logs.commands is None
    with within("rollout", experiment.path.name):
        options = experiment.rollout.options(torques)
    settings = {"command": command, "experiment_text": experiment.text}
    identify = _with_torques if torques else _with_commands
    return identify(experiment, logs, verify, options, settings, stage)


def _with_commands(experiment, logs, verify, options, settings, stage) -> RolloutReport:
    """Identify joints behind position servos."""
    seen, unseen = [], []
    for log, kept in [*((x, seen) for x in logs), *((x, unseen) for x in verify)]:
        stage(f"reading {log.name}")
        kept.append(experiment.read_commands(log))
    stage("identifying")
    fit = identify_rollout(
        seen,
        experiment.bodies(),
        joint_names=experiment.robot.joint_names,
        **{key: options[key] for key in SERVO_OPTIONS},
    )
    stage("simulating")
    errors, windows = fit.validate(unseen or seen), fit.window_errors(unseen or seen)
    return RolloutReport(
        fit, errors, windows, bool(unseen), options["samples"], settings
    )


def _with_torques(
    experiment, logs, verify, options, settings, stage
) -> TorqueRolloutReport:
    """Identify the model of `jaxid identify` by simulations under the recorded torques."""
    if experiment.load_transition is not None:
        raise InputError(
            f"{experiment.path.name}: give `rollout.load_friction`, not `model.load`."
        )
    stage("finding base parameters")
    base = experiment.base
    experiment, _ = select_filter(experiment, logs, stage)
    loaded = [load_log(experiment, path, stage) for path in (*logs, *verify)]
    require_motion(loaded)
    observations = [log for _, log, _ in loaded]
    seen, unseen = observations[: len(logs)], observations[len(logs) :]
    stage("identifying")
    fit = identify_torque_rollout(base, seen, **options)
    stage("simulating")
    doubts = [Remark(text, Status.DOUBTFUL) for text in findings(loaded)]
    notes = [*experiment.notes, *(note for o in observations for note in o.notes)]
    return TorqueRolloutReport(
        fit, unseen or seen, bool(unseen), doubts, [*map(Remark, notes)], settings
    )

"""Identification so that simulations move like the robot: logs become a report."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import RigidBodies
from jaxid.errors import InputError
from jaxid.measurement.columns import Columns
from jaxid.measurement.recording import Recording
from jaxid.result_table import Remark, Status

from .log_identification import require_separate_logs
from .log_loading import load_logs, read_commands, select_filter
from .setup import Paths, Progress, Setup, ignore_progress

if TYPE_CHECKING:
    from jaxid.report.rollout_report import RolloutReport, Sources
    from jaxid.rollout import Bodies

Span = tuple[float, float]
"""Start and end of a stretch of time [s]."""


@dataclasses.dataclass(frozen=True)
class ServoSettings:
    """Settings of `jaxid rollout`: for logs of commands, without torques.

    Attributes:
        bodies: Whether the bodies of the robot's file load the joints; by default, if
            the file has any.
        stiffness: Stiffness (proportional gain) of the servos if it is known [N m/rad
            or N/m], like `12.0`, or a list with `nan` where it is not; otherwise a
            known load determines it.
        damping: Derivative gain of the servos if it is known, for a comparison with the
            estimate [N m s/rad or N s/m].
        feed_forward: Gain of the command's velocity if it is known; likewise.
        alike: Words in the names of joints of one kind, like `[["hip"], ["knee"]]`:
            they get similar parameters unless the logs contradict. By default joints
            whose names differ only in a side are of one kind.
        contacts: Times in which something holds the robot, like `[[6.5, 64.7]]`, or
            those of single logs, as in `{ sines = [[6.5, 64.7]] }`; these samples do
            not count [s].
        samples: Number of MJCF files drawn from the distribution of the estimates.
    """

    bodies: bool | None = None
    stiffness: float | list[float] | None = None
    damping: float | list[float] | None = None
    feed_forward: float | list[float] | None = None
    alike: list[list[str]] | None = None
    contacts: list[Span] | dict[str, list[Span]] | None = None
    samples: int = 0


@dataclasses.dataclass(frozen=True)
class TorqueSettings:
    """Settings of `jaxid rollout` for logs of torques.

    Attributes:
        horizon: With torques: length of the windows that are simulated [s].
    """

    horizon: float = 0.2


def identify_rollout_from_logs(
    setup: Setup,
    logs: Paths,
    columns: Columns,
    settings: ServoSettings | TorqueSettings,
    verify: Paths = (),
    progress: Progress = ignore_progress,
) -> "RolloutReport":
    """Identify a robot so that simulations follow its positions, and simulate.

    Args:
        setup: How logs become parameters.
        logs: Paths of logs.
        columns: Meaning of their columns.
        settings: Settings for logs of commands, or for logs of torques.
        verify: Paths of logs for the validation; by default those of the fit.
        progress: Callback, called with a stage and its completed fraction (0 to 1).
    """
    sources = {"fit": [Path(log) for log in logs]}
    unseen_logs = [Path(log) for log in verify]
    require_separate_logs(sources["fit"], unseen_logs)
    if unseen_logs:
        sources["validation"] = unseen_logs
    if isinstance(settings, TorqueSettings):
        return _follow_torques(setup, sources, columns, settings, progress)
    return _follow_commands(setup, sources, columns, settings, progress)


def _follow_commands(
    setup: Setup,
    sources: "Sources",
    columns: Columns,
    settings: ServoSettings,
    progress: Progress,
) -> "RolloutReport":
    """Identify joints behind position servos."""
    # Other commands do not wait for rollouts, which take a third of a second to load.
    from jaxid.report.rollout_report import servo_report
    from jaxid.rollout import identify_rollout

    recordings: dict[str, list[Recording]] = {}
    for name, logs in sources.items():
        progress(f"reading the logs of the {name}", 0.0)
        recordings[name] = [read_commands(setup, log, columns) for log in logs]
    every_recording = [x for group in recordings.values() for x in group]
    _require_logs_of_contacts(settings, every_recording)
    fit = identify_rollout(
        recordings["fit"],
        bodies_of_file(setup, settings),
        joint_names=setup.robot.joint_names,
        stiffness=settings.stiffness,
        damping=settings.damping,
        feed_forward=settings.feed_forward,
        alike=settings.alike,
        contacts=settings.contacts or (),
        progress=progress,
    )
    progress("simulating", 0.0)
    test_recordings = recordings.get("validation", recordings["fit"])
    errors = fit.validate(test_recordings)
    windows = fit.window_errors(test_recordings)
    return servo_report(setup.robot, fit, errors, windows, sources, settings.samples)


def _require_logs_of_contacts(
    settings: ServoSettings, recordings: Sequence[Recording]
) -> None:
    """Reject contacts of a log that is not there."""
    if not isinstance(settings.contacts, dict):
        return
    names = [recording.name for recording in recordings]
    for name in settings.contacts:
        if name not in names:
            raise InputError(
                "`rollout.contacts` must name logs of this command "
                f"(`{'`, `'.join(names)}`), but names `{name}`."
            )


def bodies_of_file(setup: Setup, settings: ServoSettings) -> "Bodies | None":
    """Return the bodies that the robot's file describes, as loads of its joints."""
    if settings.bodies is False:
        return None
    if setup.robot_file is None:
        if settings.bodies:
            raise InputError("`rollout.bodies` needs a robot from a URDF or MJCF file.")
        return None
    bodies = setup.robot_file.bodies()
    has_mass = bool((bodies[:, 0] > 0).any())
    if not has_mass:
        return None
    from jaxid.rollout import Bodies

    return Bodies(Model(setup.robot, (RigidBodies(),)), bodies.ravel())


def _follow_torques(
    setup: Setup,
    sources: "Sources",
    columns: Columns,
    settings: TorqueSettings,
    progress: Progress,
) -> "RolloutReport":
    """Identify the model of `identify_logs`, beside the fit of torques."""
    from jaxid.report.rollout_report import torque_report
    from jaxid.rollout import identify_torque_rollout

    if setup.load_friction:
        raise InputError(
            "`model.load` is for `jaxid identify`: simulations do not include "
            "friction that grows with torque. Leave the key out."
        )
    progress("finding base parameters", 0.0)
    base = setup.base
    every_log = [log for logs in sources.values() for log in logs]
    setup = select_filter(setup, sources["fit"], columns, progress)
    loaded_logs = load_logs(setup, every_log, columns, progress)
    observations = [log.observations for log in loaded_logs]
    training_logs = observations[: len(sources["fit"])]
    unseen_logs = observations[len(training_logs) :]
    progress("identifying", 0.0)
    fit = identify_torque_rollout(
        base, training_logs, horizon=settings.horizon, progress=progress
    )
    progress("simulating", 0.0)
    errors = fit.validate(unseen_logs or training_logs)
    findings = [Remark(note) for note in setup.notes]
    if not fit.converged:
        text = "the search was stopped before its end: these are the best values so far"
        findings.append(Remark(text, Status.DOUBTFUL))
    for log in loaded_logs:
        findings += [Remark(text, Status.DOUBTFUL) for text in log.findings]
        findings += [Remark(note) for note in log.observations.notes]
    return torque_report(setup.robot, fit, errors, sources, findings)

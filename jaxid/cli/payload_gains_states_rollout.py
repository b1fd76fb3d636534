"""Commands for several runs: `payload`, `gains`, `states`, `rollout`, `calibrate`."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.console import Console

import jaxid as jid

from . import options, terminal

if TYPE_CHECKING:
    from jaxid.report.several_runs_report import RunsReport
    from jaxid.robot.inertia import Tool

TITLE_OF_LINES = "to use this result for other logs, add to the experiment file:"


def payload(
    experiment: options.ExperimentFile,
    loaded: options.Loaded,
    logs: options.OptionalLogs = None,
    body: Annotated[
        str | None,
        typer.Option(metavar="JOINT", help="The joint that moves the payload."),
    ] = None,
    mass: Annotated[
        float | None,
        typer.Option(metavar="KG", min=1e-6, help="Its mass, if you have weighed it."),
    ] = None,
    output: options.OutputFolder = Path("payload"),
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Find a payload's mass, centre of mass and moments of inertia.

    From logs without it and logs with it. Friction may differ between them. With the
    table `[sensor]` of a force sensor, logs without the payload may be left out.
    """
    logs = logs or []
    console = options.start(
        *logs, *loaded, experiment=experiment, output=output, force=force
    )
    from jaxid.workflow.robot_file import joint_number

    content = jid.experiment.load_experiment(experiment)
    robot = content.setup.robot
    carrier = None if body is None else joint_number(robot, body, "--body")
    columns = content.require_columns([*logs, *loaded])
    with terminal.progress_bar() as progress:
        report = jid.workflow.identify_payload_from_logs(
            content.setup,
            logs,
            loaded,
            columns,
            carrier,
            mass,
            progress,
            content.sensor,
        )
    show_runs(console, detail, report, output, content.text)


def gains(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    loaded: options.Loaded,
    output: options.OutputFolder = Path("gains"),
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Find the drives' true forces with a load that is known.

    Compare logs without the load and logs with it. The table `[load]` of the experiment
    file describes the load.
    """
    console = options.start(
        *logs,
        *loaded,
        experiment=experiment,
        output=output,
        force=force,
        needs_load=True,
    )
    content = jid.experiment.load_experiment(experiment)
    load = cast("Tool | float", content.load)  # required already
    columns = content.require_columns([*logs, *loaded])
    with terminal.progress_bar() as progress:
        report = jid.workflow.identify_gains_from_logs(
            content.setup, logs, loaded, columns, load, progress
        )
    show_runs(console, detail, report, output, content.text)


def states(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    output: options.OutputFolder = Path("states"),
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Fit several states at once: one inertia, friction for each.

    One log for each, like cold and warm. Friction and offsets are each
    state's own, all else is shared.
    """
    console = options.start(*logs, experiment=experiment, output=output, force=force)
    content = jid.experiment.load_experiment(experiment)
    columns = content.require_columns(logs)
    with terminal.progress_bar() as progress:
        report = jid.workflow.identify_states_from_logs(
            content.setup, logs, columns, progress
        )
    show_runs(console, detail, report, output, content.text)


def show_runs(
    console: Console,
    detail: bool | None,
    report: "RunsReport",
    output: Path,
    experiment_text: str,
) -> None:
    """Write and print the result of several runs, and lines for the experiment file."""
    origin = options.report_origin(experiment_text)
    files = dataclasses.replace(report, settings=origin).save(output)
    lines = report.answer.experiment_lines
    if lines:
        lines = [TITLE_OF_LINES, *lines]
    terminal.show_result(console, detail, report, output, files, lines)


def rollout(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    verify: options.Verified = None,
    output: options.OutputFolder = Path("rollout"),
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Identify so that a simulation moves like the robot.

    If the experiment file names columns of commands: joints behind position servos,
    with numbers for simulators and MJCF; otherwise the model of `identify`, with errors
    beside those of other methods. A page shows measured and simulated motion.
    """
    unseen_logs = verify or []
    console = options.start(
        *logs, *unseen_logs, experiment=experiment, output=output, force=force
    )
    content = jid.experiment.load_experiment(experiment)
    columns = content.require_columns([*logs, *unseen_logs])
    with terminal.progress_bar() as progress:
        report = jid.workflow.identify_rollout_from_logs(
            content.setup, logs, columns, content.rollout, unseen_logs, progress
        )
    show_runs(console, detail, report, output, content.text)


def calibrate(
    experiment: options.ExperimentFile,
    sessions: Annotated[
        list[Path],
        typer.Argument(
            help="A folder with a folder for each session, or files of poses.",
            metavar="SESSIONS",
        ),
    ],
    log: Annotated[
        list[Path] | None,
        typer.Option(metavar="LOG", help="Torques that both geometries shall explain."),
    ] = None,
    output: options.OutputFolder = Path("calibrated"),
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Find the true geometry: joint origins, zeros, compliances.

    From poses in which something was touched or measured, in several sessions. The
    table `[calibration]` of the experiment file says what. Writes the robot's file with
    calibrated origins, a page with the errors of every pose before and after, and a
    table of poses to record next.
    """
    paths = log or []
    # Files of poses have columns of their own.
    options.require_paths(sessions)
    options.require_experiment_first(experiment, sessions)
    console = options.start(*paths, experiment=experiment, output=output, force=force)
    content = jid.experiment.load_experiment(experiment)
    logs = None
    if paths:
        logs = jid.workflow.TorqueLogs(paths, content.require_columns(paths))
    with terminal.progress_bar(counts_all=True) as progress:
        report = jid.workflow.calibrate_from_files(
            content.setup,
            sessions,
            content.calibration,
            progress,
            lambda: content.surroundings.clearance,
            logs,
        )
    show_runs(console, detail, report, output, content.text)

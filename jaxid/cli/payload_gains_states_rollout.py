"""Commands for several runs: `payload`, `gains`, `states`, `rollout`."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.console import Console

import jaxid as jid
from jaxid.errors import InputError
from jaxid.result_table import Status, significant

from . import options, terminal
from .command_help import UNUSABLE_CODE

if TYPE_CHECKING:
    from jaxid.identification.payload import Payload
    from jaxid.report.several_runs_report import RunsReport

TITLE_OF_TOOL = "to subtract it from other logs, in the experiment file:"
TITLE_OF_GAINS = "to use them, in the experiment file:"


def payload(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    loaded: options.Loaded,
    body: Annotated[
        str | None,
        typer.Option(metavar="JOINT", help="The joint that moves the payload."),
    ] = None,
    mass: Annotated[
        float | None,
        typer.Option(metavar="KG", min=1e-6, help="Its mass, if a scale told it."),
    ] = None,
    output: options.OutputFolder = Path("payload"),
    force: options.Force = False,
) -> None:
    """Find a payload's mass, centre of mass and moments of inertia.

    From logs without it and logs with it. Friction may differ between them.
    """
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
            content.setup, logs, loaded, columns, carrier, mass, progress
        )
    joint = robot.body_names[report.result.body]
    lines = [TITLE_OF_TOOL, *tool_lines(report.result, joint)]
    show_runs(console, report, output, lines)


def tool_lines(payload: "Payload", joint: str) -> list[str]:
    """Return the table of an experiment file that subtracts a payload."""
    from jaxid.experiment.template import toml_text

    entries = []
    for i, j in zip(*np.triu_indices(3), strict=True):
        entries.append(f"{'xyz'[i]}{'xyz'[j]} = {payload.inertia[i, j]:.6g}")
    centre = [f"{value:.6g}" for value in payload.centre_of_mass]
    return [
        "[robot.tool]",
        f"body = {toml_text(joint)}",
        f"mass = {payload.mass:.6g}",
        f"centre_of_mass = [{', '.join(centre)}]",
        f"inertia = {{ {', '.join(entries)} }}",
    ]


def gains(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    loaded: options.Loaded,
    output: options.OutputFolder = Path("gains"),
    force: options.Force = False,
) -> None:
    """Find the drives' true forces with a load that is known.

    Compare logs without the load and logs with it. The table `[load]` of the experiment
    file describes the load.
    """
    console = options.start(
        *logs, *loaded, experiment=experiment, output=output, force=force
    )
    content = jid.experiment.load_experiment(experiment)
    if content.load is None:
        raise InputError(
            f"{experiment.name}: the table `[load]` is missing: "
            "it describes the load behind `--loaded`."
        )
    columns = content.require_columns([*logs, *loaded])
    with terminal.progress_bar() as progress:
        report = jid.workflow.identify_gains_from_logs(
            content.setup, logs, loaded, columns, content.load, progress
        )
    ((key, values),) = report.content.items()
    digits = ", ".join(significant(value, 5) for value in values)
    lines = [TITLE_OF_GAINS, "[recording]", f"{key} = [{digits}]"]
    show_runs(console, report, output, lines)


def states(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    output: options.OutputFolder = Path("states"),
    force: options.Force = False,
) -> None:
    """Fit several states at once: one inertia, friction for each.

    One log or report for each, like cold and warm. Friction and offsets are each
    state's own, all else is shared.
    """
    console = options.start(*logs, experiment=experiment, output=output, force=force)
    content = jid.experiment.load_experiment(experiment)
    columns = content.require_columns(logs)
    with terminal.progress_bar() as progress:
        report = jid.workflow.identify_states_from_logs(
            content.setup, logs, columns, progress
        )
    show_runs(console, report, output)


def show_runs(
    console: Console, report: "RunsReport", output: Path, lines: Sequence[str] = ()
) -> None:
    """Write and print the result of several runs, and lines for the experiment file.

    Of a result that cannot be used there are no such lines.
    """
    files = report.save(output)
    table, *details = report.tables()
    terminal.show(console, table)
    terminal.show_remarks(console, report.remarks)
    terminal.show(console, *details)
    is_usable = report.status is not Status.BAD
    if lines and is_usable:
        terminal.show_text(console, "\n".join(["", *lines]))
    terminal.show_files(console, output, files)
    if not is_usable:
        raise typer.Exit(UNUSABLE_CODE)


def rollout(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    verify: options.Verified = None,
    output: options.OutputFolder = Path("rollout"),
    force: options.Force = False,
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
        settings = options.report_origin(content.text)
        report = dataclasses.replace(report, settings=settings)
        progress("writing the report", 0.0)
        files = report.write(output)
    terminal.show(console, *report.tables())
    terminal.show_files(console, output, files)

"""Work of the commands for an experiment and its logs, and what they print."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import typer
from rich.console import Console
from rich.text import Text

from jaxid.errors import InputError
from jaxid.experiment.decoder import within
from jaxid.experiment.experiment import Experiment, load_experiment
from jaxid.experiment.experiment_variants import variants
from jaxid.experiment.template import toml_text
from jaxid.export import (
    export_c,
    export_jax,
    export_mjcf,
    export_pinocchio,
    export_urdf,
)
from jaxid.identification.fit_result import Fit
from jaxid.identification.parameter_changes import compare as compare_fits
from jaxid.identification.payload import Payload
from jaxid.io import require_writable, write_text
from jaxid.report.excitation_page import motion_verdict, plan_remarks, sort_remarks
from jaxid.report.identification_page import motor_tables
from jaxid.report.result_files import read_faults, read_fit, write_comparison
from jaxid.result_table import Remark, Status, significant
from jaxid.robot.robot import Robot
from jaxid.trajectory.trajectory import LinearTrajectory
from jaxid.workflow.log_identification import identify_logs
from jaxid.workflow.log_inspection import inspect_logs
from jaxid.workflow.log_rollout import identify_rollout_from_logs
from jaxid.workflow.motion_design import (
    MotionTask,
    design_motion,
    prepare_motion,
    write_design,
)
from jaxid.workflow.motion_files import make_playable, write_motion
from jaxid.workflow.payload_gains_and_states import (
    RunsReport,
    identify_gains_from_logs,
    identify_payload_from_logs,
    identify_states_from_logs,
)
from jaxid.workflow.robot_file import joint_number
from jaxid.workflow.setup_choice import choose_setup

from . import process
from .options import command_line, open_console
from .printing import show, show_files, show_remarks
from .progress_bar import progress_bar

EXPORTS = {
    "c": "arm.c",
    "urdf": "arm.urdf",
    "mjcf": "arm.xml",
    "json": "arm.json",
    "pinocchio": "arm_pinocchio.json",
    "jax": "arm.jax",
}
"""Formats of `jaxid export`, and the file where none is named."""
TITLE_OF_TOOL = "to subtract it from other logs, in the experiment file:"
TITLE_OF_GAINS = "to use them, in the experiment file:"
UNUSABLE_CODE = 3
"""Exit code for a verdict against the use of a model, or recording of a motion."""


def inspect(console: Console, path: Path, logs: list[Path]) -> None:
    """Show what can be identified, and if logs are sane."""
    experiment = load_experiment(path)
    setup = experiment.setup
    notes = setup.notes
    tables = []
    with progress_bar(open_console(stderr=True)) as progress:
        progress("finding base parameters", 0.0)
        base_table = setup.base.summary()
        if logs:
            columns = experiment.require_columns(logs)
            inspection = inspect_logs(setup, logs, columns, progress)
            notes = inspection.notes
            tables = inspection.tables()
    show(console, setup.robot.summary(), *motor_tables(setup.robot), base_table)
    show_remarks(console, notes)
    show(console, *tables)


def identify(
    console: Console,
    path: Path,
    logs: list[Path],
    verify: list[Path],
    split: float | None,
    output: Path,
    figures: str | None,
) -> None:
    """Estimate the parameters and write a report."""
    if split is not None and not 0 < split < 1:
        raise InputError(
            f"`--split` must lie between 0 and 1, like 0.6, but is {split:g}."
        )
    held_out_share = None if split is None else 1.0 - split
    experiment = load_experiment(path)
    columns = experiment.require_columns([*logs, *verify])
    with progress_bar(open_console(stderr=True)) as progress:
        report = identify_logs(
            experiment.setup, logs, columns, held_out_share, verify, progress
        )
        settings = {"experiment": str(path), **origin(experiment), **report.settings}
        report = dataclasses.replace(report, settings=settings)
        progress("writing the report", 0.0)
        files = report.save(output, figures or "")
    show(console, *report.tables())
    show_files(console, output, [file.name for file in files])
    if report.verdict.status is Status.BAD:
        raise typer.Exit(UNUSABLE_CODE)


def origin(experiment: Experiment) -> dict[str, str]:
    """Return command and experiment file of a report, for those who repeat it."""
    return {"command": command_line(), "experiment_text": experiment.text}


def excite(
    console: Console,
    path: Path,
    output: Path,
    resume: bool,
    seconds: float | None,
) -> None:
    """Design a motion; the best one so far is written whenever a better is found."""
    experiment = load_experiment(path)
    earlier_design = None
    if resume:
        earlier_design = output.with_suffix(".json")
        if not earlier_design.is_file():
            raise InputError(
                f"`{earlier_design}` is not there: "
                "`--resume` needs a motion to go on with."
            )
    with within("excitation", path.name):
        task = prepare_motion(
            experiment.setup,
            experiment.excitation,
            experiment.surroundings,
            earlier_design,
        )
    error_console = open_console(stderr=True)
    show_remarks(error_console, [Remark(text, Status.BAD) for text in task.faults])
    best_motion = _BestMotion(task, output)
    with (
        process.handing_over(best_motion.farewell),
        progress_bar(error_console) as progress,
    ):
        with within("excitation", path.name):
            design = design_motion(task, progress, best_motion.keep, seconds)
        progress("writing the report", 0.0)
        files = write_design(task, design, output, **origin(experiment))
    show(console, *design.plan.tables())
    verdict = motion_verdict(design.plan, design.remarks)
    remarks = sort_remarks((*plan_remarks(design.plan), *design.remarks))
    show_remarks(console, [*remarks, verdict])
    names = [str(file.relative_to(output.parent)) for file in files]
    show_files(console, output.parent, names)
    if verdict.status is Status.BAD:
        raise typer.Exit(UNUSABLE_CODE)


class _BestMotion:
    """The best motion of a search so far, in its files."""

    def __init__(self, task: MotionTask, output: Path):
        self._task = task
        self._output = output
        self._is_written = False

    def keep(self, motion: LinearTrajectory) -> None:
        """Write a better motion."""
        robot = self._task.setup.robot
        excitation = self._task.excitation
        playable = make_playable(robot, excitation, motion)
        write_motion(robot, excitation, playable, self._output)
        self._is_written = True

    def farewell(self) -> str:
        """Return the sentence with which Ctrl-C ends the search."""
        if not self._is_written:
            return "stopped before a motion kept all limits, and nothing was written"
        faults = self._task.faults
        note = f"; NOT CHECKED: {'; '.join(faults)}" if faults else ""
        return (
            f"stopped: `{self._output}` and the files beside it hold "
            "the best motion so far, which keeps all limits that "
            f"were checked{note}; `--resume` goes on with it"
        )


def export(
    report: Path,
    to: str,
    path: Path,
    urdf: Path | None,
    tip: str | None,
    base: str | None,
    double: bool,
    force: bool,
) -> list[Path]:
    """Write the model of a report in a format; return the files.

    An unusable model is written only by force.
    """
    files = [path, path.with_suffix(".h")] if to == "c" else [path]
    _require_free(files, to, force)
    require_writable(path.parent)
    faults = read_faults(report)
    if faults and not force:
        raise InputError(
            f"the verdict of `{report}` is that its model must not be used: "
            f"{faults[0]} Mend that first, or write it nonetheless with `--force`."
        )
    fit = read_fit(report)
    match to:
        case "c":
            export_c(fit, path.parent, name=path.stem, double=double)
        case "urdf":
            export_urdf(fit, urdf or _own_urdf(fit), path, tip=tip, base=base)
        case "mjcf":
            export_mjcf(fit, path)
        case "pinocchio":
            export_pinocchio(fit, path)
        case "jax":
            export_jax(fit, path)
        case "json":
            fit.save(path)
    return files


def _require_free(files: Sequence[Path], to: str, force: bool) -> None:
    """Reject files of an export that are there already, or have a wrong suffix."""
    if to == "c" and files[0].suffix != ".c":
        raise InputError(
            f"`--output` must be a C file like arm.c, but is `{files[0]}`."
        )
    for file in files:
        if file.is_dir():
            raise InputError(f"`{file}` is a folder: choose another `--output`.")
        if file.exists() and not force:
            raise InputError(
                f"`{file}` is there already: choose another `--output`, or `--force`."
            )


def _own_urdf(fit: Fit) -> Path:
    """Return the file that the robot of a fit was read from."""
    source = Path(fit.base.model.robot.source)
    if source.suffix not in (".urdf", ".xacro", ".xml") or not source.is_file():
        raise InputError(
            "`--to urdf` changes the robot's own file: name it with `--urdf`."
        )
    return source


def compare(console: Console, paths: tuple[Path, Path], output: Path) -> None:
    """Decide which parameters have changed between two runs."""
    cold_fit, warm_fit = (dataclasses.replace(read_fit(p), name=str(p)) for p in paths)
    comparison = compare_fits(cold_fit, warm_fit)
    files = write_comparison(output, comparison, paths)
    show(console, comparison.summary(), comparison.group_summary())
    show_files(console, output, [p.name for p in files])


def choose(console: Console, path: Path, logs: list[Path], output: Path) -> None:
    """Choose a model, print the table, and write the experiment file."""
    experiment = load_experiment(path)
    if output.parent.resolve() != path.parent.resolve():
        raise InputError(
            "`--output` must lie beside the experiment file: its paths count from it."
        )
    columns = experiment.require_columns(logs)
    experiments = variants(experiment)
    setups = {name: variant.setup for name, variant in experiments.items()}
    with progress_bar(open_console(stderr=True)) as progress:
        choice = choose_setup(setups, logs, columns, progress)
    write_text(output, experiments[choice.chosen.name].text)
    show(console, choice.summary())
    show_files(console, output.parent, [output.name])


def payload(
    console: Console,
    path: Path,
    logs: list[Path],
    loaded: list[Path],
    body: str | None,
    mass: float | None,
    output: Path,
) -> None:
    """Find a payload, and print the table of the experiment file that subtracts it."""
    experiment = load_experiment(path)
    robot = experiment.setup.robot
    carrier = None if body is None else joint_number(robot, body, "--body")
    columns = experiment.require_columns([*logs, *loaded])
    with progress_bar(open_console(stderr=True)) as progress:
        report = identify_payload_from_logs(
            experiment.setup, logs, loaded, columns, carrier, mass, progress
        )
    lines = tool_lines(report.result, robot)
    show_runs(console, report, output, TITLE_OF_TOOL, lines)


def tool_lines(payload: Payload, robot: Robot) -> list[str]:
    """Return the table of an experiment file that subtracts a payload."""
    entries = []
    for i, j in zip(*np.triu_indices(3), strict=True):
        entries.append(f"{'xyz'[i]}{'xyz'[j]} = {payload.inertia[i, j]:.6g}")
    centre = [f"{value:.6g}" for value in payload.centre_of_mass]
    return [
        "[robot.tool]",
        f"body = {toml_text(robot.joint_names[payload.body])}",
        f"mass = {payload.mass:.6g}",
        f"centre_of_mass = [{', '.join(centre)}]",
        f"inertia = {{ {', '.join(entries)} }}",
    ]


def gains(
    console: Console,
    path: Path,
    logs: list[Path],
    loaded: list[Path],
    output: Path,
) -> None:
    """Find the drives' true forces with a load that is known."""
    experiment = load_experiment(path)
    if experiment.load is None:
        raise InputError(
            f"{path.name}: the table `[load]` is missing: "
            "it describes the load behind `--loaded`."
        )
    columns = experiment.require_columns([*logs, *loaded])
    with progress_bar(open_console(stderr=True)) as progress:
        report = identify_gains_from_logs(
            experiment.setup, logs, loaded, columns, experiment.load, progress
        )
    ((key, values),) = report.content.items()
    digits = ", ".join(significant(value, 5) for value in values)
    lines = ["[recording]", f"{key} = [{digits}]"]
    show_runs(console, report, output, TITLE_OF_GAINS, lines)


def states(console: Console, path: Path, logs: list[Path], output: Path) -> None:
    """Fit several states of a robot at once: one inertia, friction for each."""
    experiment = load_experiment(path)
    columns = experiment.require_columns(logs)
    with progress_bar(open_console(stderr=True)) as progress:
        report = identify_states_from_logs(experiment.setup, logs, columns, progress)
    show_runs(console, report, output)


def show_runs(
    console: Console,
    report: RunsReport,
    output: Path,
    title: str = "",
    lines: Sequence[str] = (),
) -> None:
    """Write and print the result of several runs, and lines for the experiment file."""
    files = report.save(output)
    table, *details = report.tables()
    show(console, table)
    show_remarks(console, report.remarks)
    show(console, *details)
    if lines:
        console.print(Text("\n".join(["", title, *lines])), soft_wrap=True)
    show_files(console, output, [file.name for file in files])


def rollout(
    console: Console, path: Path, logs: list[Path], verify: list[Path], output: Path
) -> None:
    """Identify so that simulations follow the positions, and write the report."""
    experiment = load_experiment(path)
    columns = experiment.require_columns([*logs, *verify])
    with progress_bar(open_console(stderr=True)) as progress:
        report = identify_rollout_from_logs(
            experiment.setup, logs, columns, experiment.rollout, verify, progress
        )
        report = dataclasses.replace(report, settings=origin(experiment))
        progress("writing the report", 0.0)
        files = report.write(output)
    show(console, *report.tables())
    show_remarks(console, [report.verdict])
    show_files(console, output, [file.name for file in files])

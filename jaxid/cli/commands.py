"""Work of the commands for an experiment and its logs, and what they print."""

import dataclasses
import functools
import os
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console
from rich.text import Text

from jaxid.errors import InputError
from jaxid.excitation.criteria import CRITERIA
from jaxid.excitation.design import DesignProgress
from jaxid.experiment import choose as choosing, identify_logs
from jaxid.experiment.excitation import (
    compare_criteria,
    design_motion,
    play,
    prepare_design,
    write_design,
    write_motion,
)
from jaxid.experiment.experiment import Experiment, load_experiment
from jaxid.experiment.robot_tables import joint_number
from jaxid.experiment.rollout_logs import identify_rollouts
from jaxid.experiment.template import toml_text
from jaxid.export import (
    export_c,
    export_jax,
    export_mjcf,
    export_pinocchio,
    export_urdf,
)
from jaxid.identification.drive_gains import identify_drive_gains
from jaxid.identification.fit_result import Fit
from jaxid.identification.identify import identify as estimate
from jaxid.identification.operating_states import identify_states
from jaxid.identification.parameter_changes import compare as compare_fits
from jaxid.identification.payload import (
    CENTRAL_NAMES,
    CENTRAL_UNITS,
    identify_payload,
)
from jaxid.io import require_writable, write_text
from jaxid.report.excitation import headline, ordered, plan_remarks, side_by_side_table
from jaxid.report.identification import body_table, motor_tables, residual_table
from jaxid.report.page import show, show_files, show_remarks
from jaxid.report.result_files import (
    read_faults,
    read_fit,
    write_comparison,
    write_estimates,
    write_report,
)
from jaxid.result_table import Remark, Status, Table, significant
from jaxid.robot.inertia import INERTIAL_NAMES, INERTIAL_UNITS
from jaxid.validation.verdict import verdict

from . import process
from .options import command_line, open_console

STOPPED = 130
"""Exit code of a command that Ctrl-C has ended, as shells expect it."""
UNUSABLE = 3
"""Exit code if the verdict is that a model must not be used, or a motion not be recorded."""


def inspect(console: Console, path: Path, logs: list[Path]) -> None:
    """Show what can be identified, and if logs are sane."""
    experiment, examined = load_experiment(path), []
    with identify_logs.stages(open_console(stderr=True)) as stage:
        stage("finding base parameters")
        _ = experiment.base.expressions
        experiment, _ = identify_logs.select_filter(experiment, logs, stage)
        for log in logs:
            _, observations, diagnosis = identify_logs.load_log(experiment, log, stage)
            stage(f"factorising {log.name}")
            estimator = experiment.estimation.plain
            fit = estimate(experiment.base, observations, estimator, stage.through)
            stage(f"looking for mistakes in {log.name}")
            examined.append((diagnosis.with_fit(fit, experiment.commanded(log)), fit))
    robot = experiment.robot
    show(console, robot.summary(), *motor_tables(robot), experiment.base.summary())
    show_remarks(console, experiment.notes)
    for diagnosis, fit in examined:
        table = Table("", facts=fit.facts, remarks=fit.determination)
        show(console, diagnosis.summary(), table)


def _check_logs(logs: list[Path], verify: list[Path], split: float | None) -> None:
    """Reject logs that would count twice, or verify a model that has seen them."""
    if split is not None and not 0 < split < 1:
        raise InputError(
            f"`--split` must lie between 0 and 1, like 0.6, but is {split:g}."
        )
    places = [os.path.realpath(p) for p in logs]
    repeated = next((p for k, p in enumerate(logs) if places[k] in places[:k]), None)
    if repeated is not None:
        raise InputError(f"`{repeated}` is given twice: its rows would count double.")
    both = set(places) & {os.path.realpath(p) for p in verify}
    if both:
        raise InputError(
            f"`{Path(sorted(both)[0]).name}` is given both to identify and to verify "
            "with: use "
            "`--split`."
        )
    if all(map(identify_logs.is_report, logs)):
        raise InputError(
            "give at least one log as a file, for torque errors and figures."
        )


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
    _check_logs(logs, verify, split)
    experiment = load_experiment(path)
    with identify_logs.stages(open_console(stderr=True)) as stage:
        report, validation = identify_logs.identify_logs(
            experiment, logs, verify, split, command_line(), stage
        )
        stage("writing the report")
        written = write_report(output, report, figures or "")
    fit, robot = report.fit, experiment.robot
    tabulated = () if fit.consistency is None else fit.consistency.findings
    show(console, robot.summary(), *motor_tables(robot))
    show_remarks(
        console, [*report.notes, *(n for n in fit.notes if n not in tabulated)]
    )
    show(console, fit.summary())
    if fit.residual_spectra is not None:
        show(console, residual_table(fit.residual_spectra, robot))
    if fit.consistency is not None:
        show(console, body_table(fit.consistency, robot.joint_names))
    show(console, validation.summary())
    judged = verdict(report)
    marked = (r for r in judged[1:] if r.status in (Status.DOUBTFUL, Status.BAD))
    show_remarks(console, [judged[0], *marked])
    show_files(console, output, [p.name for p in written])
    if judged[0].status is Status.BAD:
        raise typer.Exit(UNUSABLE)


def _doubts(texts: Any) -> list[Remark]:
    return [Remark(text, Status.DOUBTFUL) for text in texts]


def excite(
    console: Console,
    path: Path,
    output: Path,
    resume: bool,
    seconds: float | None,
    all_criteria: bool,
) -> None:
    """Design a motion; the best one so far is written whenever there is a better one."""
    experiment, errors = load_experiment(path), open_console(stderr=True)
    written = output.with_suffix(".json") if resume else None
    if written is not None and not written.is_file():
        raise InputError(
            f"`{written}` is not there: `--resume` needs a motion to go on with."
        )
    preparation = prepare_design(experiment, written)
    faults = preparation.faults(experiment)
    show_remarks(errors, [Remark(text, Status.BAD) for text in faults])
    motion = _BestMotion(experiment, output, faults)
    with process.handing_over(motion.farewell), identify_logs.stages(errors) as stage:
        try:
            keep = functools.partial(motion.keep, stage)
            design = design_motion(experiment, preparation, keep, seconds)
        except KeyboardInterrupt:
            errors.print(Text(f"jaxid: {motion.farewell()}."), soft_wrap=True)
            raise typer.Exit(STOPPED) from None
        stage("writing the report")
        files = write_design(experiment, design, output, command_line())
    show(console, *design.plan.tables())
    verdict = headline(design.plan, design.remarks)
    show_remarks(
        console, [*ordered((*plan_remarks(design.plan), *design.remarks)), verdict]
    )
    show_files(
        console, output.parent, [str(p.relative_to(output.parent)) for p in files]
    )
    if all_criteria and not design.plan.interrupted:
        with identify_logs.stages(errors) as stage:
            plans = compare_criteria(
                experiment, functools.partial(_show_progress, stage)
            )
        if plans:
            show(console, side_by_side_table(plans))
        done = sum(not plan.interrupted for plan in plans)
        if done < len(CRITERIA):
            show_remarks(
                console, _doubts([f"stopped after {done} of {len(CRITERIA)} criteria"])
            )
    if design.plan.interrupted:
        raise typer.Exit(STOPPED)
    if verdict.status is Status.BAD:
        raise typer.Exit(UNUSABLE)


class _BestMotion:
    """The best motion of a search so far, in its files."""

    def __init__(self, experiment: Experiment, output: Path, faults: tuple[str, ...]):
        self._experiment, self._output, self._faults = experiment, output, faults
        self._value = np.inf

    def keep(self, stage: identify_logs.Stages, now: DesignProgress) -> None:
        """Show the progress of a design, and write every better motion."""
        _show_progress(stage, now)
        if now.feasible and now.best < self._value:
            write_motion(
                self._experiment, play(self._experiment, now.trajectory), self._output
            )
            self._value = now.best

    def farewell(self) -> str:
        """Return what is said when Ctrl-C ends the search."""
        if self._value == np.inf:
            return "stopped before a motion kept all limits, and nothing was written"
        unchecked = f"; NOT CHECKED: {'; '.join(self._faults)}" if self._faults else ""
        return (
            f"stopped: `{self._output}` and the files beside it hold the best motion "
            "so far, which "
            f"keeps all limits that were checked{unchecked}; `--resume` goes on with it"
        )


def _show_progress(stage: identify_logs.Stages, now: DesignProgress) -> None:
    """Show the progress of a design, or end it after a signal."""
    if process.STOP.is_set():
        raise KeyboardInterrupt
    stage.design(now)


def export(
    report: Path,
    to: str,
    path: Path,
    urdf: Path | None,
    chain: dict[str, Any],
    double: bool,
    force: bool,
) -> None:
    """Write the model of a report in a format; an unusable one only by force."""
    require_writable(path.parent)
    fit, faults = read_fit(report), read_faults(report)
    if faults and not force:
        raise InputError(
            f"the verdict of `{report}` is that its model must not be used: "
            f"{faults[0]} Mend "
            "that first, or write it nonetheless with `--force`."
        )
    if to == "c":
        export_c(fit, path.parent, name=path.stem, double=double)
    elif to == "urdf":
        own = Path(fit.base.model.robot.source) if urdf is None else urdf
        known = own.suffix in (".urdf", ".xacro", ".xml") and own.is_file()
        if urdf is None and not known:
            raise InputError(
                "`--to urdf` changes the robot's own file: name it with `--urdf`."
            )
        export_urdf(fit, own, path, **chain)
    else:
        writers = {
            "mjcf": export_mjcf,
            "pinocchio": export_pinocchio,
            "jax": export_jax,
        }
        writers.get(to, Fit.save)(fit, path)


def compare(
    console: Console, paths: tuple[Path, Path], level: float, output: Path
) -> None:
    """Decide which parameters have changed between two runs."""
    cold, warm = (dataclasses.replace(read_fit(p), name=str(p)) for p in paths)
    found = compare_fits(cold, warm, level)
    files = write_comparison(output, found, paths)
    show(console, found.summary(), found.group_summary())
    show_files(console, output, [p.name for p in files])


def choose(console: Console, path: Path, logs: list[Path], output: Path) -> None:
    """Choose a model, print the table, and write the experiment file."""
    _check_logs(logs, [], None)
    experiment = load_experiment(path)
    if output.parent.resolve() != path.parent.resolve():
        raise InputError(
            "`--output` must lie beside the experiment file: its paths count from it."
        )
    with identify_logs.stages(open_console(stderr=True)) as stage:
        choice, text = choosing.choose(experiment, logs, stage)
    write_text(output, text)
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
    carrier = None if body is None else joint_number(experiment.robot, body, "--body")
    (empty, full), doubts = _pair(experiment, logs, loaded)
    found = identify_payload(empty, full, body=carrier, mass=mass)
    name = experiment.robot.joint_names[found.body]
    keys = ("mass", "centre_of_mass", "inertia", "estimate", "distance")
    content = {"body": name, **{key: getattr(found, key) for key in keys}}
    sources = {"unloaded": logs, "loaded": loaded}
    rows = (INERTIAL_NAMES, INERTIAL_UNITS, found.parameters, found.uncertainty)
    central = (CENTRAL_NAMES, CENTRAL_UNITS, *found.central)
    doubts = _doubts(doubts)
    tables = [found.summary()]
    files = write_estimates(
        output, "payload", [rows, central], content, sources, tables, doubts
    )
    show(console, *tables)
    show_remarks(console, doubts)
    upper = [(k, i) for k in range(3) for i in range(k, 3)]
    inertia = ", ".join(
        f"{'xyz'[k]}{'xyz'[i]} = {found.inertia[k, i]:.6g}" for k, i in upper
    )
    lines = [
        "[robot.tool]",
        f"body = {toml_text(name)}",
        f"mass = {found.mass:.6g}",
        f"centre_of_mass = [{', '.join(f'{v:.6g}' for v in found.centre_of_mass)}]",
        f"inertia = {{ {inertia} }}",
    ]
    _show_lines(
        console, "to subtract it from other logs, in the experiment file:", lines
    )
    show_files(console, output, [p.name for p in files])


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
            f"{path.name}: the table `[load]` is missing: it describes the load "
            "behind `--loaded`."
        )
    (empty, full), doubts = _pair(experiment, logs, loaded)
    found = identify_drive_gains(empty, full, experiment.load)
    # The key of the file that corrects forces, and its values.
    columns, key, known = experiment.columns, "force_gains", None
    if columns is not None:
        key = "force_gains" if columns.torque_constants is None else "torque_constants"
        known = getattr(columns, key)
    values = (
        np.array(1.0 if known is None else known) * np.asarray(found.gains)
    ).tolist()
    sources = {"unloaded": logs, "loaded": loaded}
    names = found.joint_names
    rows = (names, ("1",) * len(names), found.gains, found.uncertainty)
    doubts = _doubts(doubts)
    tables = [found.summary()]
    files = write_estimates(
        output, "gains", [rows], {key: values}, sources, tables, doubts
    )
    show(console, *tables)
    show_remarks(console, doubts)
    shown = ", ".join(significant(v, 5) for v in values)
    lines = ["[recording]", f"{key} = [{shown}]"]
    _show_lines(console, "to use them, in the experiment file:", lines)
    show_files(console, output, [p.name for p in files])


def states(console: Console, path: Path, logs: list[Path], output: Path) -> None:
    """Fit several states of a robot at once: one inertia, friction for each."""
    experiment = load_experiment(path)
    names = [Path(os.path.realpath(log)).stem for log in logs]
    if len(set(names)) < max(len(names), 2):
        raise InputError(
            "give one log or report for each of two or more states, with different "
            "names."
        )
    with identify_logs.stages(open_console(stderr=True)) as stage:
        runs, doubts = identify_logs.read_runs(
            experiment, [[log] for log in logs], names, stage
        )
    found = identify_states(runs)
    chance = found.sharing[1]
    content = {
        "states": found.states,
        "shared": [found.base.names[k] for k in found.shared],
        "varying": [found.base.names[k] for k in found.varying],
        "sharing_chance": chance,
    }
    rows = (found.names, found.units, found.parameters, found.uncertainty)
    if chance < 0.01:
        doubts.append(
            "the states do not agree on what they share (chance "
            f"{100 * chance:.2g} %): something else than friction and offsets differs"
        )
    comparisons = [found.compare(names[0], other) for other in names[1:]]
    pairs = [(c.group_summary(), c.summary()) for c in comparisons]
    tables = [found.summary(), *(table for pair in pairs for table in pair)]
    said, sources = _doubts(doubts), {"states": logs}
    files = write_estimates(output, "states", [rows], content, sources, tables, said)
    show(console, tables[0])
    show_remarks(console, said)
    show(console, *tables[1:])
    show_files(console, output, [p.name for p in files])


def rollout(
    console: Console, path: Path, logs: list[Path], verify: list[Path], output: Path
) -> None:
    """Identify so that simulations follow the positions, and write the report."""
    _check_logs(logs, verify, None)
    experiment = load_experiment(path)
    with identify_logs.stages(open_console(stderr=True)) as stage:
        report = identify_rollouts(experiment, logs, verify, command_line(), stage)
        stage("writing the report")
        written = report.write(output)
    show(console, *report.tables())
    show_remarks(console, [report.verdict])
    show_files(console, output, [p.name for p in written])


def _pair(
    experiment: Experiment, logs: list[Path], loaded: list[Path]
) -> tuple[list[Fit], list[str]]:
    twice = {os.path.realpath(p) for p in logs} & {os.path.realpath(p) for p in loaded}
    if twice:
        raise InputError(
            f"`{Path(sorted(twice)[0]).name}` is given both without and with the "
            "load: name it "
            "once."
        )
    with identify_logs.stages(open_console(stderr=True)) as stage:
        return identify_logs.read_runs(
            experiment, [logs, loaded], ["unloaded", "loaded"], stage
        )


def _show_lines(console: Console, text: str, lines: list[str]) -> None:
    console.print(Text("\n".join(["", text, *lines])), soft_wrap=True)

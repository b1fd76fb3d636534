"""What the commands show in the terminal: tables with units, and sentences."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from jaxid.dynamics.base import BaseParameters, Identifiability
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.sanity import LogCheck, known_forces
from jaxid.identification.fit import Fit
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording
from jaxid.report.numbers import MISSING, percent, significant
from jaxid.report.tables import error_table, joint_table, parameter_table
from jaxid.robot.robot import Robot
from jaxid.validation.validate import Validation

GOOD, DOUBTFUL, BAD = "green", "yellow", "red"
LARGE_CONDITION = 1e3
"""Condition number, with scaled columns, above which parameters are hard to tell apart."""


def heading(console: Console, text: str) -> None:
    """A title with an empty line before it."""
    console.print()
    console.print(Text(text, style="bold"))


def sentences(console: Console, texts: Iterable[str], style: str = "", mark: str = "·") -> None:
    """One paragraph for each sentence, indented behind a mark."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(no_wrap=True)
    grid.add_column()
    for text in dict.fromkeys(texts):
        stop = "" if text.endswith((".", "?", "!")) else "."
        grid.add_row(Text(mark, style=style or "dim"), Text(text + stop, style=style))
    if grid.row_count:
        console.print(grid)


def facts(console: Console, rows: Iterable[tuple[str, str | Text]]) -> None:
    """Pairs of a word and what is said about it."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column()
    for name, text in rows:
        grid.add_row(Text(name), text if isinstance(text, Text) else Text(text))
    console.print(grid)


def show_table(console: Console, table: Table) -> None:
    """A table with an empty line before it."""
    console.print()
    console.print(table)


def show_robot(console: Console, experiment: Experiment) -> None:
    """The joints and motors of a robot."""
    robot = experiment.robot
    show_table(console, joint_table(robot))
    drives = robot.drives
    if not drives.is_direct:
        show_table(console, _motor_table(robot))
    said = [(*robot.notes,), (f"assumed: {', '.join(robot.limits.assumed)}",)]
    sentences(console, [*said[0], *(said[1] if robot.limits.assumed else ())])
    tool = robot.tool
    if tool is not None:
        where = robot.joint_names[tool.body]
        sentences(console, [f"a known load of {float(tool.mass):g} kg on the body of `{where}`."])


def _motor_table(robot: Robot) -> Table:
    drives = robot.drives
    table = plain_table("motors")
    for name in ("motor", "turns", "joint at motor zero [rad or m]", "largest torque [N m]"):
        table.add_column(name, justify="left" if name in ("motor", "turns") else "right")
    table.add_column("rotor inertia [kg m²]", justify="right")
    for i in range(robot.joints):
        row = np.asarray(drives.reduction)[i]
        ratios = [f"{float(x):.6g} {robot.joint_names[j]}" for j, x in enumerate(row) if x]
        table.add_row(
            str(i + 1),
            " + ".join(ratios),
            significant(float(drives.zero[i])),
            significant(_known(drives.max_torques[i])),
            significant(float(drives.rotor_inertia[i])),
        )
    return table


def _known(value: float) -> float:
    return float(value) if np.isfinite(value) else np.nan


def plain_table(title: str) -> Table:
    """An empty table in the style of the report's."""
    return Table(
        title=Text(title, style="bold"),
        title_justify="left",
        box=None,
        pad_edge=False,
        header_style="bold",
        padding=(0, 2, 0, 0),
    )


def show_base(console: Console, base: BaseParameters) -> None:
    """The base parameters in letters, and what becomes of each standard parameter."""
    table = plain_table(f"{base.size} base parameters of {base.model.size} standard parameters")
    table.add_column("#", justify="right", style="dim")
    table.add_column("combination that the forces determine", overflow="fold")
    table.add_column("unit", no_wrap=True)
    for k, (expression, unit) in enumerate(zip(base.expressions, base.units, strict=True)):
        table.add_row(str(k + 1), Text(expression), unit)
    show_table(console, table)
    if base.lengths:
        shown = (
            f"{name} = {significant(value, 4)} {'m/s²' if name == 'g' else 'm'}"
            for name, value in base.lengths.items()
        )
        console.print(Text(f"with {', '.join(shown)}", style="dim"))
    console.print()
    names = np.array(base.model.parameter_names)
    kinds = (
        (Identifiability.ALONE, GOOD),
        (Identifiability.COMBINED, DOUBTFUL),
        (Identifiability.NONE, BAD),
    )
    rows = []
    for kind, style in kinds:
        found = [n for n, v in zip(names, base.identifiability, strict=True) if v is kind]
        rows.append(
            (f"{kind.value} ({len(found)})", Text(", ".join(found) or MISSING, style=style))
        )
    facts(console, rows)
    sentences(console, base.notes, DOUBTFUL, "!")


def show_recording(console: Console, recording: Recording) -> None:
    """Samples, rate, duration and gaps of a log."""
    gaps = len(recording.segments) - 1
    heading(console, f"log {recording.name}")
    facts(
        console,
        [
            ("samples", f"{recording.samples} at {significant(1 / recording.sample_time, 4)} Hz"),
            ("duration", f"{significant(recording.duration, 4)} s"),
            ("gaps", "none" if gaps == 0 else str(gaps)),
        ],
    )
    sentences(console, recording.notes)


def show_check(console: Console, robot: Robot, check: LogCheck) -> None:
    """What a log holds beside the robot's limits, and what is strange about it."""
    table = plain_table("motion and forces, with the robot's limits in brackets")
    for name in ("joint", "from", "to", "speed [1/s]", "force", "stands", "units"):
        table.add_column(name, justify="left" if name in ("joint", "units") else "right")
    limits, forces = robot.limits, known_forces(robot)
    for j, name in enumerate(robot.joint_names):
        table.add_row(
            Text(name),
            _beside(check.lowest[j], limits.position_min[j]),
            _beside(check.highest[j], limits.position_max[j]),
            _beside(check.speed[j], limits.velocity[j]),
            _beside(check.force[j], forces[j]),
            f"{100 * check.standing[j]:.0f} %",
            f"{robot.joint_unit(j)}, {robot.force_unit(j)}",
        )
    show_table(console, table)
    if check.warnings:
        console.print()
        sentences(console, check.warnings, DOUBTFUL, "!")


def _beside(value: float, limit: float) -> Text:
    shown = significant(float(limit)) if np.isfinite(limit) else MISSING
    return Text.assemble(significant(float(value)), (f" ({shown})", "dim"))


def show_rows(console: Console, observations: Iterable[Observations], fit: Fit) -> None:
    """How many rows there are, and how well they tell the parameters apart."""
    numbers = fit.condition_numbers
    rows = fit.rows
    count = str(rows[0]) if len(set(rows)) == 1 else f"{min(rows)} to {max(rows)}"
    every = next(iter(observations))
    good = numbers.scaled < LARGE_CONDITION
    facts(
        console,
        [
            ("rows per joint", f"{count}, {significant(1 / every.row_time, 4)} Hz"),
            (
                "condition number",
                Text.assemble(
                    f"{significant(numbers.raw, 4)} in SI units, "
                    f"{significant(numbers.weighted, 4)} weighted, ",
                    (f"{significant(numbers.scaled, 4)}", GOOD if good else DOUBTFUL),
                    " weighted with columns of length one",
                ),
            ),
            ("residual", f"{percent(fit.residual, 3)} % of the forces (norms of all rows)"),
        ],
    )


def show_undetermined(console: Console, fit: Fit) -> None:
    """Which combinations the logs do not determine, and what to do about it."""
    if not fit.undetermined:
        text = f"these logs determine all {fit.base.size} base parameters."
        sentences(console, [text], GOOD, "✓")
        return
    one = len(fit.undetermined) == 1
    heading(
        console,
        f"NOT DETERMINED by these logs: {len(fit.undetermined)} "
        f"combination{'' if one else 's'} of the {fit.base.size} base parameters",
    )
    sentences(
        console,
        (
            f"{d.sentence(fit.base)[:-1]} (singular value {d.singular_value:.1e} of the largest)."
            for d in fit.undetermined
        ),
        BAD,
        "✗",
    )
    console.print(
        Padding(
            Text(
                "Estimates of these parameters mean nothing one by one, and the model may fail on "
                "other motions. Record a motion that moves these joints in more poses, faster and "
                "in both directions; or leave effects out in `[model]`; or add `truncate = 0.01` "
                "to `[estimator]`, which leaves out what the logs do not decide.",
            ),
            (0, 0, 0, 2),
        )
    )


def show_fit(console: Console, fit: Fit) -> None:
    """The estimates; a combination that is too long for its line ends in dots."""
    table = parameter_table(fit)
    names = next(c for c in table.columns if c.header == "parameter")
    names.overflow, names.no_wrap = "ellipsis", True
    show_table(console, table)


def show_validation(console: Console, robot: Robot, found: Validation, identification: int) -> None:
    """Torque errors of each recording, and the definiteness of the mass matrix."""
    for i, errors in enumerate(found.errors):
        table = error_table(errors, robot)
        role = "identification" if i < identification else "verification"
        title = Text(f"torque errors, {role}: ", style="bold")
        table.title = title.append(Text(str(table.title), style="bold"))
        show_table(console, table)
    console.print()
    d = found.definiteness
    if d.positive_definite:
        text = (
            f"the mass matrix is positive definite in all {d.poses} random poses (smallest "
            f"eigenvalue {significant(d.smallest)} in SI units)."
        )
        sentences(console, [text], GOOD, "✓")
    else:
        text = (
            f"the mass matrix is NOT positive definite in {percent(d.indefinite)} % of {d.poses} "
            f"random poses (smallest eigenvalue {significant(d.smallest)} in SI units): do not "
            "simulate or control with this model where the joints were not moved."
        )
        sentences(console, [text], BAD, "✗")


def show_files(console: Console, folder: Path, names: Iterable[str]) -> None:
    """What was written, and where."""
    console.print()
    console.print(Text(f"wrote {folder}: {', '.join(names)}"))

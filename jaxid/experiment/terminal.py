"""What the commands show in the terminal: tables with units, and sentences."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from rich.cells import cell_len
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from jaxid.dynamics.base import BaseParameters, Identifiability
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.sanity import LogCheck
from jaxid.identification.excited import LARGEST_UNCERTAINTY, UndeterminedDirection
from jaxid.identification.fit import DOUBTFUL as DOUBTFUL_SHARE
from jaxid.identification.fit import TRUSTED, Fit, Trust
from jaxid.identification.runs.comparison import Comparison, Verdict
from jaxid.identification.solutions import AbstractSpectralSolution
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording
from jaxid.report.bodies import body_table, consistency_facts
from jaxid.report.compared import comparison_table, group_table
from jaxid.report.content import Beside
from jaxid.report.numbers import MISSING, percent, significant
from jaxid.report.tables import (
    error_table,
    joint_table,
    motor_table,
    parameter_table,
    plain_table,
    residual_table,
)
from jaxid.report.verdict import LARGE_CONDITION
from jaxid.robot.robot import Robot
from jaxid.validation import TorqueErrors, Validation

GOOD, DOUBTFUL, BAD = "green", "yellow", "red"
GAP = 2
"""Blanks between two columns."""
SHORTEST = 12
"""Letters of a combination that are shown at least."""


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
        show_table(console, motor_table(robot))
    said = [(*robot.notes,), (f"assumed: {', '.join(robot.limits.assumed)}",)]
    sentences(console, [*said[0], *(said[1] if robot.limits.assumed else ())])
    tool = robot.tool
    if tool is not None:
        where = robot.joint_names[tool.body]
        sentences(console, [f"a known load of {float(tool.mass):g} kg on the body of `{where}`."])


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


def show_recording(console: Console, recording: Recording | Observations) -> None:
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


def show_check(console: Console, robot: Robot, check: LogCheck, doubts: Iterable[str]) -> None:
    """What a log holds beside the robot's limits, and what is strange about it."""
    alike = len(set(robot.revolute)) == 1
    u, f = robot.joint_unit(0), robot.force_unit(0)
    units = f" [{u}]", f" [{u}]", f" [{u}/s]", f" [{f}]"
    titles = zip(("from", "to", "speed", "force"), units if alike else ("",) * 4, strict=True)
    table = plain_table("motion and forces, with the robot's limits in brackets")
    table.add_column("joint")
    for name, unit in titles:
        table.add_column(Text(name + unit), justify="right")
    table.add_column("stands", justify="right")
    if not alike:
        table.add_column("units")
    limits, forces = robot.limits, robot.known_max_forces
    for j, name in enumerate(robot.joint_names):
        table.add_row(
            Text(name),
            _beside(check.lowest[j], float(limits.position_min[j])),
            _beside(check.highest[j], float(limits.position_max[j])),
            _beside(check.speed[j], float(limits.velocity[j])),
            _beside(check.force[j], float(forces[j])),
            f"{100 * check.standing[j]:.0f} %",
            *(() if alike else (f"{robot.joint_unit(j)}, {robot.force_unit(j)}",)),
        )
    show_table(console, table)
    warnings = [*check.warnings, *doubts]
    if warnings:
        console.print()
        sentences(console, warnings, DOUBTFUL, "!")


def _beside(value: float, limit: float) -> Text:
    shown = significant(limit) if np.isfinite(limit) else MISSING
    return Text.assemble(significant(float(value)), (f" ({shown})", "dim"))


def show_rows(console: Console, observations: Iterable[Observations], fit: Fit) -> None:
    """How many rows there are, and how well they tell the parameters apart."""
    numbers = fit.condition_numbers
    rows = fit.rows
    count = str(rows[0]) if len(set(rows)) == 1 else f"{min(rows)} to {max(rows)}"
    every = next(iter(observations))
    good = numbers.scaled < LARGE_CONDITION
    known = [fit.trust.count(level) for level in (Trust.GOOD, Trust.DOUBTFUL, Trust.NONE)]
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
            (
                "estimates",
                f"{known[0]} of {fit.base.size} known to {100 * TRUSTED:g} %, {known[1]} to "
                f"{100 * DOUBTFUL_SHARE:g} %, {known[2]} worse or undetermined",
            ),
        ],
    )


def _openness(direction: UndeterminedDirection) -> str:
    if not np.isfinite(direction.uncertainty):
        return "not moved at all"
    return f"{percent(direction.uncertainty)} % of the forces left open"


def show_undetermined(console: Console, fit: Fit, regularised: bool) -> None:
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
            f"{d.sentence(fit.base)} ({_openness(d)}, singular value "
            f"{d.singular_value:.1e} of the largest)."
            for d in fit.undetermined
        ),
        BAD,
        "✗",
    )
    advice = (
        "A combination counts as not determined if it leaves more than "
        f"{100 * LARGEST_UNCERTAINTY:g} % of the whole forces open. Estimates of these parameters "
        "mean nothing one by one, and the model may fail on other motions. Record a motion that "
        "moves these joints in more poses, faster and in both directions, or leave effects out in "
        "`[model]`"
    )
    if regularised:
        advice += "; until then `[estimator]` keeps small what these logs do not decide."
    else:
        advice += (
            '; or add `ridge = "cross_validated"` to `[estimator]`, which keeps small what these '
            "logs do not decide."
        )
    console.print(Padding(Text(advice), (0, 0, 0, 2)))


def show_fit(console: Console, fit: Fit) -> None:
    """The estimates; a combination that is too long for its line ends in dots."""
    table = parameter_table(fit)
    names = next(c for c in table.columns if str(c.header) == "parameter")
    others = sum(
        GAP + max(cell_len(str(cell)) for cell in (c.header, *c.cells))
        for c in table.columns
        if c is not names
    )
    names.overflow, names.no_wrap = "ellipsis", True
    names.max_width = max(SHORTEST, console.width - others - GAP)
    show_table(console, table)


def show_notes(console: Console, notes: Sequence[str], fit: Fit) -> None:
    """What was assumed and found, but for what the table of bodies is going to say."""
    shown = () if fit.consistency is None else fit.consistency.findings
    sentences(console, [*notes, *(said for said in fit.notes if said not in shown)])


def show_consistency(console: Console, robot: Robot, fit: Fit) -> None:
    """The bodies of a physically consistent estimate, what it costs, and which bounds decide."""
    if fit.consistency is None:
        return
    show_table(console, body_table(fit.consistency, robot.joint_names))
    console.print()
    facts(console, consistency_facts(fit.consistency))


def show_residuals(console: Console, robot: Robot, fit: Fit) -> None:
    """Whether residuals are white, and how far that widens the standard deviations."""
    spectra, ratios = fit.residual_spectra, fit.uncertainty.ratios
    if spectra is not None:
        show_table(console, residual_table(spectra, robot))
    ratios = ratios[np.isfinite(ratios)]
    if len(ratios) and np.any(np.abs(ratios - 1.0) > 1e-9):
        console.print()
        text = (
            f"standard deviations are {significant(float(np.median(ratios)), 2)} times (median) "
            "those of independent rows: errors of neighbouring rows are alike"
        )
        sentences(console, [text])


def show_validation(console: Console, robot: Robot, found: Validation, identification: int) -> None:
    """Torque errors of each recording, and the definiteness of the mass matrix."""
    for i, errors in enumerate(found.errors):
        table = error_table(errors, robot)
        role = "identification" if i < identification else "verification"
        of = errors.name if errors.name == role else f"{errors.name} ({role})"
        heading(console, f"torque errors of {of}: {percent(errors.relative)} % of the forces")
        table.title = None
        console.print(table)
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


def show_beside(console: Console, fit: Fit, errors: Sequence[TorqueErrors], beside: Beside) -> None:
    """What another way to solve the same equations leaves on each recording."""
    heading(console, "solved otherwise: RMS error in percent of the RMS force, mean of the joints")
    table = plain_table("")
    table.title = None
    table.add_column("recording")
    own, another = beside.ways or (solution_name(fit.solution), solution_name(beside.solution))
    table.add_column(f"this fit ({own})", justify="right")
    table.add_column(another, justify="right")
    for own, other in zip(errors, beside.errors, strict=True):
        shares = (float(np.mean(e.rms_relative)) for e in (own, other))
        table.add_row(own.name, *(percent(share) for share in shares))
    show_table(console, table)


def solution_name(solution: AbstractSpectralSolution) -> str:
    """A solution in words."""
    share = getattr(solution, "share", None)
    name = "plain least squares" if share is None else type(solution).__name__.lower()
    return name if share is None else f"{name} {share:.2g}"


def show_files(console: Console, folder: Path, names: Iterable[str]) -> None:
    """What was written, and where."""
    console.print()
    console.print(Text(f"wrote {folder}: {', '.join(names)}"))


def show_comparison(console: Console, comparison: Comparison) -> None:
    """Which parameters have changed, one by one and by kinds, and how that was decided."""
    show_table(console, comparison_table(comparison))
    show_table(console, group_table(comparison))
    console.print()
    verdicts, level = comparison.verdicts, comparison.level
    tested = len(verdicts) - verdicts.count(Verdict.UNKNOWN)
    sentences(
        console,
        [
            f"{verdicts.count(Verdict.CHANGED)} of {tested} parameters have changed: if none had, "
            f"the chance to call any of them so would be {100 * (1 - level):.3g} % at most (Holm)",
            f"{verdicts.count(Verdict.PERHAPS)} more have perhaps changed: zero lies outside the "
            f"{100 * level:g} % interval of their difference; of {tested} parameters that never "
            f"change, about {(1 - level) * tested:.2g} look so",
        ],
    )

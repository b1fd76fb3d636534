"""What a design has found: tables for the terminal."""

import math
from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from jaxid.excitation.constraints.constraint import Finding
from jaxid.excitation.plan import VAGUE, ExcitationPlan
from jaxid.report.numbers import MISSING, aligned, percent, significant
from jaxid.report.tables import plain_table


def criteria_table(plan: ExcitationPlan) -> Table:
    """All criteria of a random motion and of the designed one."""
    table = plain_table("criteria: smaller is better")
    table.add_column("criterion")
    table.add_column("random motion", justify="right", no_wrap=True)
    table.add_column("this motion", justify="right", no_wrap=True)
    for row in plan.criteria:
        chosen = "bold" if row.name == plan.criterion.name else ""
        numbers = (significant(row.before), significant(row.after))
        table.add_row(*(Text(text, style=chosen) for text in (row.name, *numbers)))
    return table


def side_by_side_table(plans: Sequence[ExcitationPlan]) -> Table:
    """What minimising each criterion does to all of them, and to the standard deviations."""
    table = plain_table("what each criterion buys: motions that make one of them small")
    table.add_column("#", justify="right", style="dim")
    table.add_column("criterion")
    table.add_column("random", justify="right", no_wrap=True)
    for number in range(len(plans)):
        table.add_column(f"by #{number + 1}", justify="right", no_wrap=True)
    for k, row in enumerate(plans[0].criteria):
        cells = [Text(significant(plan.criteria[k].after)) for plan in plans]
        if k < len(cells):
            cells[k].stylize("bold")
        table.add_row(str(k + 1), Text(row.name), significant(row.before), *cells)
    means = (significant(plan.mean_gain) for plan in plans)
    table.add_row("", Text("deviations, times smaller than random"), "1", *means)
    return table


def deviation_table(plan: ExcitationPlan) -> Table:
    """Standard deviations to expect of every base parameter, before the experiment."""
    base, relative = plan.base, plan.relative_deviations
    table = plain_table("standard deviations to expect")
    table.add_column("#", justify="right", style="dim")
    table.add_column("parameter", overflow="fold")
    table.add_column("±", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("better than random", justify="right", no_wrap=True)
    if relative is not None:
        table.add_column("± [%]", justify="right", no_wrap=True)
    deviations = aligned([significant(float(s)) for s in plan.standard_deviations])
    gains = aligned([f"{gain:.2f}x" for gain in plan.gains])
    for k, name in enumerate(base.names):
        row = [str(k + 1), Text(name), deviations[k], base.units[k], gains[k]]
        if relative is not None:
            style = "red" if relative[k] > VAGUE else ""
            row.append(Text(percent(float(relative[k])), style=style))
        table.add_row(*row)
    return table


def use_table(plan: ExcitationPlan) -> Table:
    """Share of each limit that the motion uses, for all times."""
    table = plain_table("use of the limits [%]")
    table.add_column("joint")
    kinds = ("range", "speed", "acceleration", "jerk")
    use = plan.use
    shown = [k for k in range(4) if (use[k] > 0).any()]
    for k in shown:
        table.add_column(kinds[k], justify="right", no_wrap=True)
    for j, name in enumerate(plan.base.model.robot.joint_names):
        table.add_row(Text(name), *(f"{100 * use[k, j]:.1f}" for k in shown))
    return table


def findings_table(findings: Sequence[Finding]) -> Table:
    """How near a motion comes to the limits that are not those of joints' motion.

    Args:
        findings: Of their constraints.
    """
    table = plain_table("use of the other limits")
    table.add_column("what")
    for title in ("reaches", "limit", "use [%]"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("made of", overflow="fold")
    for one in findings:
        style = "red" if one.value > 0 else ""
        limit = f"{'≥' if one.least else '≤'} {one.limit:.4g} {one.unit}"
        reached = f"{significant(one.reached, 4)} {one.unit}"
        share = f"{100 * one.used:.1f}" if math.isfinite(one.used) else MISSING
        cells = (one.name.removeprefix("the "), reached, limit, share, one.note)
        table.add_row(*(Text(cell, style=style) for cell in cells))
    return table

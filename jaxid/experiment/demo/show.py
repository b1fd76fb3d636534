"""The demo's summary in the terminal."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from jaxid.experiment.demo.study import Study
from jaxid.experiment.demo.tables import (
    ASKED,
    Grid,
    average_errors,
    beside_paper,
    coverage,
    criteria,
    following,
    keeps,
    temperature,
)
from jaxid.experiment.terminal import BAD, GOOD, sentences, show_table
from jaxid.report.tables import plain_table


def show_study(console: Console, study: Study) -> None:
    """Tables and a verdict.

    Args:
        console: The terminal.
        study: What was found.
    """
    designs = (criteria(study),) if study.excitation.plans else ()
    for grid in (
        beside_paper(study),
        *designs,
        average_errors(study, 0),
        average_errors(study, 1),
        temperature(study),
        following(study),
    ):
        show_table(console, _table(grid))
    console.print()
    sentences(console, coverage(study))
    if isinstance(study.timing, str):
        sentences(console, [study.timing])
    good = keeps(study)
    said = "below" if good else "not below"
    sentences(
        console,
        [
            f"the average error of every axis is {said} {ASKED:g} % of its largest torque, on "
            "identification and verification"
        ],
        GOOD if good else BAD,
        "✓" if good else "!",
    )


def _table(grid: Grid) -> Table:
    table = plain_table(grid.title)
    for k, head in enumerate(grid.columns):
        table.add_column(Text(head), justify="right" if k else "left", overflow="fold")
    for row in grid.rows:
        table.add_row(*(Text(cell) for cell in row))
    return table

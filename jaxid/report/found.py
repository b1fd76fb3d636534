"""Estimates with their intervals, for the terminal and in files: payloads, gains, states."""

import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from jaxid.identification.runs.comparison import LEVEL
from jaxid.identification.runs.estimates import Estimates
from jaxid.io import atomic_folder
from jaxid.report.content import plain, versions
from jaxid.report.numbers import aligned, with_deviation
from jaxid.report.tables import plain_table
from jaxid.report.write import write_csv, write_json

PAYLOAD, GAINS, STATES = "jaxid-payload/1", "jaxid-gains/1", "jaxid-states/1"
"""Schemas of the files."""


def estimate_table(estimates: Estimates, level: float = LEVEL) -> Table:
    """Estimates with the digits that their intervals leave meaningful.

    Args:
        estimates: What was found.
        level: Confidence of the intervals, of 1.
    """
    pairs = [
        with_deviation(float(p), float(half))
        for p, half in zip(estimates.parameters, estimates.half_widths(level), strict=True)
    ]
    values, halves = (aligned(column) for column in zip(*pairs, strict=True))
    table = plain_table("")
    table.title = None
    table.add_column("parameter")
    table.add_column("estimate", justify="right", no_wrap=True)
    table.add_column(f"± ({100 * level:g} %)", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for name, value, half, unit in zip(
        estimates.names, values, halves, estimates.units, strict=True
    ):
        table.add_row(Text(name), value, half, unit)
    return table


def rows_of(estimates: Estimates, level: float = LEVEL) -> list[dict[str, Any]]:
    """Estimates as rows of a table for programs.

    Args:
        estimates: What was found.
        level: Confidence of the intervals, of 1.
    """
    columns = {
        "name": estimates.names,
        "unit": estimates.units,
        "estimate": np.asarray(estimates.parameters).tolist(),
        "standard_deviation": estimates.standard_deviations.tolist(),
        "half_width": estimates.half_widths(level).tolist(),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def write_found(
    folder: Path,
    schema: str,
    estimates: Sequence[Estimates],
    content: Mapping[str, Any],
    sources: Mapping[str, Sequence[Path]],
) -> list[Path]:
    """Writes `payload.json` and `payload.csv`, or those of gains; both of them or nothing.

    Args:
        folder: Of the files; made with its parents.
        schema: What they hold.
        estimates: The rows of the table; the first go into the list `parameters` of the JSON file.
        content: What else the JSON file holds.
        sources: What was identified with, for the record.

    Returns:
        The files.

    Raises:
        InputError: If `folder` is a file.
    """
    stem = schema.partition("/")[0].removeprefix("jaxid-")
    first, rows = estimates[0], [row for one in estimates for row in rows_of(one)]
    everything = {
        "schema": schema,
        "made": {
            "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "versions": versions(),
        },
        "sources": {key: [str(p) for p in paths] for key, paths in sources.items()},
        "level": LEVEL,
        "parameters": rows,
        "covariance": first.covariance,
        **content,
    }
    names = [f"{stem}.json", f"{stem}.csv"]
    with atomic_folder(folder) as staging:
        write_json(staging / names[0], plain(everything))
        write_csv(staging / names[1], rows)
    return [folder / name for name in names]

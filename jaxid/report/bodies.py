"""A physically consistent estimate in the report: bodies, what they cost, which bounds decide."""

from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from jaxid.identification.consistency import Consistency
from jaxid.identification.fit import Fit
from jaxid.report.numbers import aligned, percent, significant
from jaxid.report.tables import plain_table


def body_table(found: Consistency, names: tuple[str, ...]) -> Table:
    """Mass, centre of mass and extent of each body, and how far it is from impossible.

    Args:
        found: The estimate.
        names: Of the joints that move the bodies.
    """
    bodies = np.asarray(found.bodies)
    mass, loose = bodies[:, 0], found.masses_from_bounds
    centre = bodies[:, 1:4] / mass[:, None]
    table = plain_table("bodies that could exist")
    table.add_column("body of joint")
    columns = [
        ("mass\n[kg]", [significant(x) for x in mass]),
        *(
            (f"{axis} of centre\n[m]", [significant(x, 2) for x in centre[:, k]])
            for k, axis in enumerate("xyz")
        ),
        ("from flat\n[%]", [percent(x) for x in found.margins]),
    ]
    for title, _ in columns:
        table.add_column(Text(title), justify="right", no_wrap=True)
    table.add_column("mass follows from")
    cells = [aligned(texts) for _, texts in columns]
    for k, name in enumerate(names):
        source = Text("bounds too", "yellow") if k in loose else Text("forces", "green")
        table.add_row(Text(name), *(column[k] for column in cells), source)
    return table


def consistency_facts(found: Consistency) -> list[tuple[str, str]]:
    """Price, proof and deciding bounds, each with its word.

    Args:
        found: The estimate.
    """
    proof = f"within {found.error_bound:.1e} of it, {found.iterations} iterations"
    return [
        (
            "price",
            f"weighted residuals {100 * found.residual_increase:.2g} % above those without bounds",
        ),
        ("optimum", proof),
        ("bounds that decide", "; ".join(found.active) or "none"),
    ]


def consistency_content(fit: Fit) -> dict[str, Any] | None:
    """The same for the result file, with all standard parameters; None for other estimates.

    Args:
        fit: The estimates.
    """
    found = fit.consistency
    if found is None or fit.full_parameters is None:
        return None
    model = fit.base.model
    columns = zip(
        model.parameter_names,
        model.parameter_units,
        np.asarray(fit.full_parameters).tolist(),
        found.determined.tolist(),
        strict=True,
    )
    keys = ("name", "unit", "estimate", "follows_from_forces_alone")
    return {
        "price": found.residual_increase,
        "error_bound": found.error_bound,
        "proved": found.outcome.name == "CERTIFIED",
        "outcome": found.outcome.value,
        "iterations": found.iterations,
        "assumed": str(found.bounds),
        "active_bounds": found.active,
        "masses_from_bounds": [f"m{k + 1}" for k in found.masses_from_bounds],
        "shares_of_a_body": found.margins,
        "standard_parameters": [dict(zip(keys, row, strict=True)) for row in columns],
    }

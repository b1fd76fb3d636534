"""Page of the agreement of several runs: their common factors, with intervals."""

import numpy as np

from jaxid.identification.agreement import Agreement
from jaxid.result_table import significant

from .figure import Figure
from .figure_elements import BLUE, GREY, VERMILION, Curve, Panel
from .several_runs_report import Answer

WORDS = (
    "Each run has its own intervals, which know only its own noise. The intervals of "
    "the pooled estimates come from the differences between the runs that agree: they "
    "hold for the next run of the same robot. A factor of a kind multiplies all "
    "parameters of this kind at once."
)


def agreement_answer(agreement: Agreement) -> Answer:
    """Return what the page of an agreement says and shows."""
    count = len(agreement.runs)
    agreeing = count - len(agreement.odd)
    spread = significant(np.sqrt(np.nanmean(agreement.spreads)), 2)
    return Answer(
        "Agreement of runs",
        agreement.verdict.text.rstrip("."),
        [
            (f"{agreeing} of {count}", "runs agree"),
            (spread, "spread between them, over what their intervals say"),
            (f"{len(agreement.drifts)}", "kinds of parameters that drift"),
        ],
        [factor_figure(agreement)],
        WORDS,
    )


def factor_figure(agreement: Agreement) -> Figure:
    """Return the common factor of each kind in each run, with 95 % intervals."""
    factors = agreement.factors
    names = [run.name for run in agreement.runs]
    is_odd = np.isin(names, agreement.odd_names)
    rows = np.arange(len(names))
    panels = []
    for k, kind in enumerate(factors.kinds):
        changes = 100 * (factors.factors[:, k] - 1)
        half_widths = 2 * 100 * factors.deviations[:, k]
        curves = []
        for members, name, colour in (
            (~is_odd, "run", BLUE),
            (is_odd, "run that differs", VERMILION),
        ):
            if members.any():
                curves.append(
                    Curve(
                        changes[members],
                        rows[members],
                        name,
                        colour,
                        "intervals",
                        low=(changes - half_widths)[members],
                        high=(changes + half_widths)[members],
                    )
                )
        panels.append(
            Panel(
                curves,
                title=kind,
                x="change [%]",
                y_names=names,
                levels=[("x", 0.0, GREY)],
            )
        )
    return Figure(
        "All parameters of a kind, relative to the pooled estimate",
        panels,
        min(2, len(panels)),
        height=0.9 + 0.25 * len(names),
    )

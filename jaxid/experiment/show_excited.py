"""What `jaxid excite` shows: criteria, what to expect, use of the limits, what stays open."""

from collections.abc import Sequence

from rich.console import Console

from jaxid.excitation.plan import CRITERIA, ExcitationPlan
from jaxid.experiment.excitation import Design
from jaxid.experiment.terminal import BAD, DOUBTFUL, GOOD, sentences, show_table
from jaxid.report.blocks import Tone
from jaxid.report.excitation import (
    criteria_table,
    deviation_table,
    findings_table,
    side_by_side_table,
    use_table,
)
from jaxid.report.excitation_words import ordered, remarks

STYLES = {Tone.PLAIN: "", Tone.GOOD: GOOD, Tone.DOUBTFUL: DOUBTFUL, Tone.BAD: BAD}
"""How remarks look in the terminal."""


def show_excited(console: Console, excited: Design) -> None:
    """A designed motion and how a robot gets into it."""
    plan = excited.plan
    tables = [criteria_table(plan), deviation_table(plan), use_table(plan)]
    for table in [*tables, findings_table(plan.findings)] if plan.findings else tables:
        console.print()
        show_table(console, table)
    for remark in ordered((*remarks(plan), *excited.aside.remarks)):
        sentences(console, [remark.text], STYLES[remark.tone], remark.tone.value)


def show_side_by_side(console: Console, plans: Sequence[ExcitationPlan]) -> None:
    """What minimising each criterion does to all of them."""
    if plans:
        _show_criteria(console, plans)
    if len(plans) < len(CRITERIA) or plans[-1].interrupted:
        done = sum(not plan.interrupted for plan in plans)
        text = f"stopped after {done} of {len(CRITERIA)} criteria"
        sentences(console, [text], DOUBTFUL, "!")


def _show_criteria(console: Console, plans: Sequence[ExcitationPlan]) -> None:
    console.print()
    show_table(console, side_by_side_table(plans))
    sentences(
        console,
        [
            "few starts and no polishing for each; `random` is the median of random motions that "
            "fill the same limits; the last row is the geometric mean over the base parameters",
            *(
                f"#{k + 1} does not keep all limits: {'; '.join(plan.diagnosis)}"
                for k, plan in enumerate(plans)
                if not plan.feasible
            ),
            *(f"#{k + 1} was stopped before its end" for k, p in enumerate(plans) if p.interrupted),
        ],
    )

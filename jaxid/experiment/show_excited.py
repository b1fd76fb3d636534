"""What `jaxid excite` shows: criteria, what to expect, use of the limits, what stays open."""

from collections.abc import Sequence

from rich.console import Console

from jaxid.excitation.plan import CRITERIA, VAGUE, ExcitationPlan
from jaxid.experiment.excite import Excited
from jaxid.experiment.terminal import DOUBTFUL, sentences, show_table
from jaxid.report.excitation import (
    criteria_table,
    deviation_table,
    side_by_side_table,
    use_table,
)


def show_excited(console: Console, excited: Excited) -> None:
    """A designed motion and how a robot gets into it."""
    plan = excited.plan
    for table in (criteria_table(plan), deviation_table(plan), use_table(plan)):
        console.print()
        show_table(console, table)
    sentences(console, [str(f) for f in plan.findings])
    sentences(console, _said(excited))
    sentences(console, _warned(excited), DOUBTFUL, "!")


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


def _said(excited: Excited) -> list[str]:
    plan, (begin, end) = excited.plan, excited.window
    limits, said = plan.limits.limits, []
    if begin > 0:
        whole = float(excited.played.duration)
        said.append(
            f"the robot starts at rest and is in the designed motion from {begin:.3f} to "
            f"{end:.3f} s of {whole:.3f} s"
        )
    if limits.assumed:
        said.append(f"limits that nobody published, assumed: {', '.join(limits.assumed)}")
    if plan.nominal is None:
        said.append(
            "for relative deviations, say in `excitation.nominal` where an earlier result is"
        )
    return said


def _warned(excited: Excited) -> list[str]:
    plan, warned = excited.plan, []
    if plan.undetermined:
        warned.append(f"this motion does not determine: {', '.join(plan.undetermined)}")
    if plan.vague:
        warned.append(
            f"deviations above {100 * VAGUE:g} % of the nominal value: {', '.join(plan.vague)}"
        )
    if excited.refused:
        warned.append(f"the motion starts at full speed, for {excited.refused}")
    if plan.interrupted:
        warned.append("the design was stopped: `--resume` goes on where it was")
    return warned

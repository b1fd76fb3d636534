"""Page and remarks of a designed excitation motion."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.arrays import double_precision
from jaxid.excitation.design_result import VAGUE, ExcitationPlan
from jaxid.io import atomic_folder
from jaxid.result_table import Column, Remark, Status, Table, significant
from jaxid.robot.collision import CollisionModel
from jaxid.trajectory.trajectory import AbstractTrajectory

from .motion import joint_figure, pose_figure, tip_figure
from .page import picture, provenance, render_page


def side_by_side_table(plans: Sequence[ExcitationPlan]) -> Table:
    """Return all criteria of motions that minimise one of them each, and their deviations."""
    criteria = plans[0].criteria
    names = [c.name for c in criteria]
    numbers = [names.index(plan.criterion.name) + 1 for plan in plans]
    remarks = [
        "`random` is the median of random motions that fill the same limits; the last "
        "row is the "
        "geometric mean over the base parameters"
    ]
    for number, plan in zip(numbers, plans, strict=True):
        doubts = [
            *plan.diagnosis,
            *(["stopped before its end"] if plan.interrupted else []),
        ]
        remarks += [Remark(f"by #{number}: {text}", Status.DOUBTFUL) for text in doubts]
    return Table(
        "motions that minimise one of the criteria each",
        Column("#", [*map(str, range(1, len(names) + 1)), ""], kind="number"),
        Column("criterion", [*names, "deviations, times smaller than random"]),
        Column("random", [*(float(c.before) for c in criteria), 1.0]),
        *(
            Column(
                f"by #{k}", [*(float(c.after) for c in plan.criteria), plan.mean_gain]
            )
            for k, plan in zip(numbers, plans, strict=True)
        ),
        rules=[len(names)],
        remarks=remarks,
    )


def plan_remarks(plan: ExcitationPlan) -> list[Remark]:
    """Return what must be known of a design, what it assumes, and what it leaves vague."""
    robot, limits = plan.base.model.robot, plan.limits.limits
    rates = {"velocity": "/s", "acceleration": "/s²"}
    assumed = ", ".join(
        f"{name} of `{robot.joint_names[j]}` "
        f"({float(getattr(limits, name)[j]):.4g} "
        f"{robot.joint_unit(j)}{rates.get(name, '')})"
        for name, j in plan.limits.assumed
    )
    published = ", ".join(limits.assumed)
    vague = ", ".join(plan.vague)
    doubts = (
        published and f"Limits that nobody published, assumed: {published}",
        assumed and f"Assumed, because not given: {assumed}",
        vague and f"Deviations above {100 * VAGUE:g} % of the nominal value: {vague}",
        "The search was stopped: `--resume` may find a better motion"
        if plan.interrupted
        else "",
    )
    found = [Remark(text, Status.DOUBTFUL) for text in doubts if text]
    start, then = plan.limits.basis.times(plan.samples)[:2]
    step = float(then - start)
    noise = ", ".join(
        f"{significant(s)} {robot.force_unit(j)}"
        for j, s in enumerate(np.asarray(plan.noise).tolist())
    )
    text = (
        f"Expected deviations are those of {plan.samples} samples in "
        f"{plan.samples * step:.4g} s "
        f"({1 / step:.4g} Hz), of one run, with white noise of the forces: standard "
        "deviation "
        f"{noise}; of n runs they are √n times smaller."
    )
    return [*plan.remarks, Remark(text), *found]


def ordered(remarks: Iterable[Remark]) -> list[Remark]:
    """Return remarks sorted by status: neutral ones first, bad ones last."""
    order = (Status.NEUTRAL, Status.GOOD, Status.DOUBTFUL, Status.BAD)
    return sorted(remarks, key=lambda remark: order.index(remark.status))


def write_excitation(
    folder: Path,
    plan: ExcitationPlan,
    played: AbstractTrajectory,
    remarks: Sequence[Remark],
    settings: Mapping[str, Any],
    shapes: CollisionModel | None,
) -> list[Path]:
    """Write the page of a design; return the file.

    The motion as it is played is drawn among the `shapes`. `settings` tell the origin
    of the design as in `provenance`.
    """
    robot = plan.base.model.robot
    with double_precision():
        time = np.linspace(0.0, float(played.duration), 801)
        motion = played.motion(time)
    limits = plan.limits.limits
    speed, fastest = np.abs(np.asarray(motion.qd)), np.asarray(limits.velocity)
    used = 100.0 * speed / np.where(np.isfinite(fastest), fastest, np.max(speed))
    label = "speed [% of the limit]"
    space = pose_figure(
        robot, motion.q, time=time, values=used, label=label, shapes=shapes
    )
    figures = [
        joint_figure(robot, limits, time, motion),
        tip_figure(robot, time, motion),
    ]
    criteria, deviations, *use = plan.tables()
    every = ordered((*plan_remarks(plan), *remarks))
    said = "Links are coloured by the speed of their joint."
    if shapes is not None:
        said += (
            " Pale shapes are those that were checked for collision; grey ones "
            "stand still."
        )
    text = "A random motion that fills the same limits is shown beside this one."
    page = render_page(
        f"{robot.name}: a motion to record",
        [
            ("Verdict", [headline(plan, remarks), every]),
            ("The motion", [picture(space, said), *figures]),
            ("Use of the limits", use),
            ("Gain over a random motion", [text, criteria]),
            ("Expected standard deviations", [deviations]),
            provenance(settings),
        ],
        f"Designed to determine {plan.base.size} base parameters of {robot.joints} "
        "joints.",
    )
    with atomic_folder(folder) as staging:
        (staging / "report.html").write_text(page, encoding="utf-8")
    return [folder / "report.html"]


def headline(plan: ExcitationPlan, remarks: Sequence[Remark]) -> Remark:
    """Return the verdict on a motion in one sentence; `remarks` hold one for each check."""
    if plan.undetermined:
        return Remark("This motion does not determine all base parameters.", Status.BAD)
    if not plan.feasible:
        return Remark("This motion does not keep all limits.", Status.BAD)
    if any(remark.status is Status.BAD for remark in remarks):
        text = "Do not record this motion yet: what is marked ✗ comes first."
        return Remark(text, Status.BAD)
    if left := [r.text.split(":")[0] for r in remarks if ": not checked, as" in r.text]:
        text = (
            "This motion keeps all limits that were checked; not checked: "
            f"{', '.join(left)}."
        )
        return Remark(text, Status.DOUBTFUL)
    text = (
        "A motion that can be recorded: it keeps all limits, and determines all "
        "parameters."
    )
    return Remark(text, Status.GOOD)

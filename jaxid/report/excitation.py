"""Page and remarks of a designed excitation motion."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.arrays import double_precision
from jaxid.dynamics.motion import Motion
from jaxid.excitation.design_result import MAX_RELATIVE_DEVIATION, ExcitationPlan
from jaxid.io import atomic_folder
from jaxid.result_table import Column, Remark, Status, Table, significant
from jaxid.robot.collision import CollisionModel
from jaxid.trajectory.trajectory import AbstractTrajectory

from .figure import Figure
from .motion import joint_figure, pose_figure, tip_figure
from .page import picture, provenance, render_page


def side_by_side_table(plans: Sequence[ExcitationPlan]) -> Table:
    """Return all criteria and deviations of motions that minimise one of them each."""
    criteria = plans[0].criteria
    names = [criterion.name for criterion in criteria]
    columns = [
        Column("#", [*map(str, range(1, len(names) + 1)), ""], kind="number"),
        Column("criterion", [*names, "deviations, times smaller than random"]),
        Column("random", [*(float(criterion.before) for criterion in criteria), 1.0]),
    ]
    remarks: list[Remark | str] = [
        "`random` is the median of random motions that fill the same limits; the last "
        "row is the geometric mean over the base parameters"
    ]
    for plan in plans:
        number = names.index(plan.criterion.name) + 1
        values = [float(criterion.after) for criterion in plan.criteria]
        columns.append(Column(f"by #{number}", [*values, plan.mean_gain]))
        doubts = list(plan.diagnosis)
        if plan.interrupted:
            doubts.append("stopped before its end")
        remarks += [Remark(f"by #{number}: {x}", Status.DOUBTFUL) for x in doubts]
    return Table(
        "motions that minimise one of the criteria each",
        *columns,
        rules=[len(names)],
        remarks=remarks,
    )


def plan_remarks(plan: ExcitationPlan) -> list[Remark]:
    """Return the assumptions and doubts that a reader of a design must know."""
    robot = plan.base.model.robot
    start, second = plan.limits.basis.times(plan.samples)[:2]
    step = float(second - start)
    noise = ", ".join(
        f"{significant(float(deviation))} {robot.force_unit(j)}"
        for j, deviation in enumerate(plan.noise)
    )
    deviations = Remark(
        f"Expected deviations are those of {plan.samples} samples in "
        f"{plan.samples * step:.4g} s ({1 / step:.4g} Hz), of one run, with white "
        f"noise of the forces: standard deviation {noise}; of n runs they are √n times "
        "smaller."
    )

    doubts = []
    unpublished_limits = ", ".join(plan.limits.limits.assumed)
    if unpublished_limits:
        doubts.append(f"Limits that nobody published, assumed: {unpublished_limits}")
    if plan.limits.assumed:
        doubts.append(f"Assumed, because not given: {_assumed_limits(plan)}")
    if plan.vague:
        threshold = f"{100 * MAX_RELATIVE_DEVIATION:g} %"
        vague = ", ".join(plan.vague)
        doubts.append(f"Deviations above {threshold} of the nominal value: {vague}")
    if plan.interrupted:
        doubts.append("The search was stopped: `--resume` may find a better motion")
    doubtful = [Remark(text, Status.DOUBTFUL) for text in doubts]
    return [*plan.remarks, deviations, *doubtful]


def _assumed_limits(plan: ExcitationPlan) -> str:
    """Return the limits that were assumed, with their values and joints."""
    robot = plan.base.model.robot
    rate_units = {"velocity": "/s", "acceleration": "/s²"}
    texts = []
    for name, j in plan.limits.assumed:
        value = float(getattr(plan.limits.limits, name)[j])
        unit = f"{robot.joint_unit(j)}{rate_units.get(name, '')}"
        texts.append(f"{name} of `{robot.joint_names[j]}` ({value:.4g} {unit})")
    return ", ".join(texts)


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
    caption = "Links are coloured by the speed of their joint."
    if shapes is not None:
        caption += (
            " Pale shapes are those that were checked for collision; grey ones "
            "stand still."
        )
    with double_precision():
        time = np.linspace(0.0, float(played.duration), 801)
        motion = played.motion(time)
    criteria, deviations, *use = plan.tables()
    sections = [
        (
            "Verdict",
            [headline(plan, remarks), ordered((*plan_remarks(plan), *remarks))],
        ),
        (
            "The motion",
            [
                picture(_speed_scene(plan, time, motion, shapes), caption),
                joint_figure(robot, plan.limits.limits, time, motion),
                tip_figure(robot, time, motion),
            ],
        ),
        ("Use of the limits", use),
        (
            "Gain over a random motion",
            [
                "A random motion that fills the same limits is shown beside this one.",
                criteria,
            ],
        ),
        ("Expected standard deviations", [deviations]),
        provenance(settings),
    ]
    page = render_page(
        f"{robot.name}: a motion to record",
        sections,
        f"Designed to determine {plan.base.size} base parameters of {robot.joints} "
        "joints.",
    )
    with atomic_folder(folder) as staging:
        (staging / "report.html").write_text(page, encoding="utf-8")
    return [folder / "report.html"]


def _speed_scene(
    plan: ExcitationPlan,
    time: np.ndarray,
    motion: Motion,
    shapes: CollisionModel | None,
) -> Figure:
    """Return the robot among shapes, coloured by the speeds of its joints."""
    speeds = np.abs(np.asarray(motion.qd))
    limits = np.asarray(plan.limits.limits.velocity)
    scale = np.where(np.isfinite(limits), limits, np.max(speeds))
    return pose_figure(
        plan.base.model.robot,
        motion.q,
        time=time,
        values=100.0 * speeds / scale,
        label="speed [% of the limit]",
        shapes=shapes,
    )


def headline(plan: ExcitationPlan, remarks: Sequence[Remark]) -> Remark:
    """Return the verdict on a motion in one sentence; `remarks` has one per check."""
    if plan.undetermined:
        return Remark("This motion does not determine all base parameters.", Status.BAD)
    if not plan.feasible:
        return Remark("This motion does not keep all limits.", Status.BAD)
    if any(remark.status is Status.BAD for remark in remarks):
        text = "Do not record this motion yet: what is marked ✗ comes first."
        return Remark(text, Status.BAD)
    unchecked_names = [
        remark.text.split(":")[0]
        for remark in remarks
        if ": not checked, as" in remark.text
    ]
    if unchecked_names:
        return Remark(
            "This motion keeps all limits that were checked; not checked: "
            f"{', '.join(unchecked_names)}.",
            Status.DOUBTFUL,
        )
    return Remark(
        "A motion that can be recorded: it keeps all limits, and determines all "
        "parameters.",
        Status.GOOD,
    )

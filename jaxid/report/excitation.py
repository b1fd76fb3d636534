"""Tables, remarks and page of a designed excitation motion."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxid.arrays import double_precision
from jaxid.excitation.plan import VAGUE, ExcitationPlan
from jaxid.io import atomic_folder
from jaxid.report.motion import joint_figure, tip_figure
from jaxid.report.page import Section, block, picture, provenance, render_page
from jaxid.report.robot_figures import path_figure, pose_figure
from jaxid.report.style import save
from jaxid.robot.robot import Robot
from jaxid.table import Column, Remark, Status, Table, significant
from jaxid.trajectory.trajectory import AbstractTrajectory


def side_by_side_table(plans: Sequence[ExcitationPlan]) -> Table:
    """Return all criteria of motions that minimise one of them each, and their deviations."""
    criteria = plans[0].criteria
    remarks = [
        Remark(f"#{k + 1} does not keep all limits: {'; '.join(plan.diagnosis)}", Status.DOUBTFUL)
        for k, plan in enumerate(plans)
        if not plan.feasible
    ]
    remarks += [
        Remark(f"#{k + 1} was stopped before its end", Status.DOUBTFUL)
        for k, plan in enumerate(plans)
        if plan.interrupted
    ]
    return Table(
        "motions that minimise one of the criteria each",
        Column("#", [*(str(k + 1) for k in range(len(criteria))), ""], kind="number"),
        Column("criterion", [*(c.name for c in criteria), "deviations, times smaller than random"]),
        Column("random", [*(float(c.before) for c in criteria), 1.0]),
        *(
            Column(f"by #{k + 1}", [*(float(c.after) for c in plan.criteria), plan.mean_gain])
            for k, plan in enumerate(plans)
        ),
        rules=[len(criteria)],
        remarks=[
            "few starts and no polishing for each; `random` is the median of random motions that "
            "fill the same limits; the last row is the geometric mean over the base parameters",
            *remarks,
        ],
    )


def plan_tables(plan: ExcitationPlan) -> list[Table]:
    """Return all tables of a designed motion, with what the expected deviations assume."""
    criteria, deviations, *use = plan.tables()
    deviations.remarks = (Remark(expectation(plan)),)
    return [criteria, deviations, *use]


def plan_remarks(plan: ExcitationPlan) -> list[Remark]:
    """Return the remarks on a designed motion that follow from its plan."""
    published = plan.limits.limits.assumed
    gain = f"{plan.mean_gain:.3g}"
    found = [Remark(f"Standard deviations are {gain} times smaller than a random motion's")]
    for text in (
        published and f"Limits that nobody published, assumed: {', '.join(published)}",
        plan.limits.assumed and f"Assumed, because not given: {', '.join(assumed_limits(plan))}",
        plan.vague
        and f"Deviations above {100 * VAGUE:g} % of the nominal value: {', '.join(plan.vague)}",
        plan.interrupted and "The design was stopped: `--resume` goes on where it was",
    ):
        if text:
            found.append(Remark(str(text), Status.DOUBTFUL))
    if plan.undetermined:
        text = f"This motion does not determine: {', '.join(plan.undetermined)}"
        found.append(Remark(text, Status.BAD))
    return [*found, *(Remark(text, Status.BAD) for text in plan.diagnosis)]


def ordered(remarks: Iterable[Remark]) -> list[Remark]:
    """Return remarks sorted by status: neutral ones first, bad ones last."""
    order = (Status.NEUTRAL, Status.GOOD, Status.DOUBTFUL, Status.BAD)
    return sorted(remarks, key=lambda remark: order.index(remark.status))


def expectation(plan: ExcitationPlan) -> str:
    """Return the noise and the samples that the expected deviations assume, as a sentence."""
    robot = plan.base.model.robot
    start, then = plan.limits.basis.times(plan.samples)[:2]
    step = float(then - start)
    noise = [
        f"{significant(float(s))} {robot.force_unit(j)}"
        for j, s in enumerate(np.asarray(plan.noise))
    ]
    return (
        f"Expected deviations are those of {plan.samples} samples in {plan.samples * step:.4g} s "
        f"({1 / step:.4g} Hz), of one run, with white noise of the forces: standard deviation "
        f"{', '.join(grouped(robot, noise))}; of n runs they are √n times smaller."
    )


def assumed_limits(plan: ExcitationPlan) -> list[str]:
    """Return the limits that were assumed because nobody gave them, with their values."""
    robot, limits = plan.base.model.robot, plan.limits.limits
    texts = []
    for field, (words, per) in {
        "position_min": ("lower end of the range", ""),
        "position_max": ("upper end of the range", ""),
        "velocity": ("speed", "/s"),
        "acceleration": ("acceleration", "/s²"),
    }.items():
        values: list[str | None] = [None] * robot.joints
        for name, joint in plan.limits.assumed:
            if name == field:
                value = float(np.asarray(getattr(limits, field))[joint])
                values[joint] = f"{value:.4g} {robot.joint_unit(joint)}{per}"
        texts += [f"{words} of {text}" for text in grouped(robot, values)]
    return texts


def grouped(robot: Robot, values: Sequence[str | None]) -> list[str]:
    """Return joints with the same text together, like `all joints (8 rad/s²)`.

    Args:
        robot: Robot of the joints.
        values: A text for each joint; None for those that are left out.
    """
    texts = []
    for value in dict.fromkeys(v for v in values if v is not None):
        joints = [j for j, v in enumerate(values) if v == value]
        texts.append(f"{list_joints(robot, joints)} ({value})")
    return texts


def list_joints(robot: Robot, joints: Iterable[int]) -> str:
    """Return the names of joints in a sentence, or `all joints`.

    Args:
        robot: Robot of the joints.
        joints: Indices of the joints, from 0.
    """
    names = [robot.joint_names[j] for j in joints]
    if len(names) == robot.joints > 1:
        return "all joints"
    return ", ".join(f"`{name}`" for name in names)


def write_excitation(
    folder: Path,
    plan: ExcitationPlan,
    played: AbstractTrajectory | None = None,
    remarks: Sequence[Remark] = (),
    settings: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write the page of a design and its figures: joints, end-effector and its path.

    Args:
        folder: Folder of the files.
        plan: Designed motion.
        played: Motion with its leads, drawn in place of the designed one.
        remarks: Further remarks of the page.
        settings: Origin of the design: `facts`, `command` and `experiment_text`.
    """
    robot, shown = plan.base.model.robot, plan.trajectory if played is None else played
    with double_precision():
        time = np.linspace(0.0, float(shown.duration), 801)
        motion = shown.motion(time)
    figures = {
        "path": path_figure(robot, motion, time),
        "poses": pose_figure(robot, motion.q),
        "joints": joint_figure(robot, plan.limits.limits, time, motion),
        "end_effector": tip_figure(robot, time, motion),
    }
    page = excitation_page(plan, figures, remarks, settings)
    with atomic_folder(folder) as staging:
        (staging / "report.html").write_text(page, encoding="utf-8")
        for name, figure in figures.items():
            save(figure, staging / f"{name}.png")
    return [folder / name for name in ("report.html", *(f"{name}.png" for name in figures))]


def excitation_page(
    plan: ExcitationPlan,
    figures: Mapping[str, Figure],
    remarks: Sequence[Remark] = (),
    settings: Mapping[str, Any] | None = None,
) -> str:
    """Return the page of a designed motion as HTML.

    Args:
        plan: Designed motion.
        figures: Figures of the motion, by the names of their files without suffix.
        remarks: Further remarks of the page.
        settings: Origin of the design: `facts`, `command` and `experiment_text`.
    """
    robot, base = plan.base.model.robot, plan.base
    captions = {"path": "Circle: start; square: end.", "poses": "Earlier poses are paler."}
    criteria, deviations, *use = (block("table", table) for table in plan_tables(plan))
    text = "A random motion that fills the same limits is shown beside this one."
    every = ordered((*plan_remarks(plan), *remarks))
    return render_page(
        f"{robot.name}: a motion to record",
        [
            Section(
                "Verdict", [block("headline", _headline(plan, remarks)), block("remarks", every)]
            ),
            Section("The motion", [picture(f, captions.get(n, "")) for n, f in figures.items()]),
            Section("Use of the limits", use),
            Section("Gain over a random motion", [block("paragraph", text), criteria]),
            Section("Expected standard deviations", [deviations]),
            provenance(settings or {}),
        ],
        f"Designed to determine {base.size} base parameters of {robot.joints} joints.",
    )


def _headline(plan: ExcitationPlan, remarks: Sequence[Remark]) -> Remark:
    if plan.undetermined:
        return Remark("This motion does not determine all base parameters.", Status.BAD)
    if not plan.feasible:
        return Remark("This motion does not keep all limits.", Status.BAD)
    if plan.interrupted:
        text = "A motion that can be recorded, but its design was stopped."
        return Remark(text, Status.DOUBTFUL)
    if any(remark.status is Status.BAD for remark in remarks):
        text = (
            "A motion that determines all base parameters, but read the remarks below before it "
            "is recorded."
        )
        return Remark(text, Status.DOUBTFUL)
    text = "A motion that keeps all given limits, and determines all base parameters."
    return Remark(text, Status.GOOD)

"""The page of a designed motion: what it will tell, how it moves, what it uses of the limits."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxid.excitation.plan import VAGUE, ExcitationPlan
from jaxid.files import written_whole
from jaxid.report.blocks import Facts, Headline, Picture, Prose, Remark, Remarks, Tone
from jaxid.report.content import versions
from jaxid.report.excitation import criteria_table, deviation_table, use_table
from jaxid.report.motion_figures import joint_figure, tip_figure
from jaxid.report.page import Page, Section, write_page
from jaxid.report.sheets import sheet_of
from jaxid.report.space import path_figure, pose_figure
from jaxid.report.style import save
from jaxid.trajectory.trajectory import AbstractTrajectory
from jaxid.types import double_precision

PAGE = "report.html"
"""File of the page."""
CAPTIONS = {
    "joints": "Time in seconds; dashed: limits.",
    "end_effector": "Time in seconds.",
    "path": "Circle: start; square: end.",
    "poses": "Earlier poses are paler.",
}
"""Of the figures, by the names of their files."""


def write_pictures(
    folder: Path, plan: ExcitationPlan, played: AbstractTrajectory | None = None
) -> list[Path]:
    """Writes a page and its figures: joints, end-effector and its path; all of them or nothing.

    Args:
        folder: Where they shall lie.
        plan: With the motion.
        played: The motion with its leads, to be drawn in its place.
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
    with written_whole(folder) as staging:
        write_page(staging / PAGE, excitation_page(plan, figures))
        for name, figure in figures.items():
            save(figure, staging / f"{name}.png")
    return [folder / name for name in (PAGE, *(f"{name}.png" for name in figures))]


def excitation_page(plan: ExcitationPlan, figures: Mapping[str, Figure]) -> Page:
    """What a design has found, for people.

    Args:
        plan: With the motion.
        figures: Of the motion, by the names of their files without suffix.
    """
    robot, base = plan.base.model.robot, plan.base
    return Page(
        f"{robot.name}: a motion to record",
        (
            Section("Verdict", (Headline(_whole(plan)), Remarks(_remarks(plan)))),
            Section(
                "The motion", tuple(Picture(f, CAPTIONS.get(n, "")) for n, f in figures.items())
            ),
            Section("Use of the limits", (sheet_of(use_table(plan), "percent, for all times"),)),
            Section(
                "What it buys",
                (
                    Prose(
                        "A random motion that fills the same limits beside this one; the design "
                        f"made `{plan.criterion.name}` small."
                    ),
                    sheet_of(criteria_table(plan)),
                ),
            ),
            Section("Standard deviations to expect", (sheet_of(deviation_table(plan), ""),)),
            Section("To repeat this", (Facts(tuple(versions().items())),)),
        ),
        f"It shall determine {base.size} base parameters of {robot.joints} joints.",
    )


def _whole(plan: ExcitationPlan) -> Remark:
    if plan.undetermined:
        return Remark(Tone.BAD, "This motion does not determine all base parameters.")
    if not plan.feasible:
        return Remark(Tone.BAD, "This motion does not keep all limits.")
    if plan.interrupted:
        return Remark(Tone.DOUBTFUL, "A motion that can be recorded, but its design was stopped.")
    return Remark(Tone.GOOD, "A motion that keeps all limits and determines all base parameters.")


def _remarks(plan: ExcitationPlan) -> tuple[Remark, ...]:
    mean = f"{plan.mean_gain:.3g}"
    said = [
        Remark(Tone.PLAIN, f"Standard deviations are {mean} times smaller than a random motion's.")
    ]
    if plan.undetermined:
        said.append(Remark(Tone.BAD, f"Not determined: {', '.join(plan.undetermined)}."))
    if plan.vague:
        text = f"Deviations above {100 * VAGUE:g} % of the nominal value: {', '.join(plan.vague)}."
        said.append(Remark(Tone.DOUBTFUL, text))
    said += [Remark(Tone.BAD, text) for text in plan.diagnosis]
    said += [Remark(Tone.PLAIN, str(finding)) for finding in plan.findings]
    assumed = plan.limits.limits.assumed
    if assumed:
        said.append(
            Remark(Tone.DOUBTFUL, f"Limits that nobody published, assumed: {', '.join(assumed)}.")
        )
    return tuple(said)

"""The page of a designed motion: what it will tell, how it moves, what it uses of the limits."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxid.arrays import double_precision
from jaxid.excitation.plan import ExcitationPlan
from jaxid.io import atomic_folder
from jaxid.report.blocks import Headline, Picture, Prose, Remark, Remarks, Tone
from jaxid.report.excitation import criteria_table, deviation_table, findings_table, use_table
from jaxid.report.excitation_words import expectation, ordered, remarks
from jaxid.report.motion_figures import joint_figure, tip_figure
from jaxid.report.page import Page, Section, write_page
from jaxid.report.repeat import repeat
from jaxid.report.sheets import sheet_of
from jaxid.report.space import path_figure, pose_figure
from jaxid.report.style import save
from jaxid.trajectory.trajectory import AbstractTrajectory

PAGE = "report.html"
"""File of the page."""
CAPTIONS = {
    "joints": "Time in seconds; dashed: limits.",
    "end_effector": "Time in seconds.",
    "path": "Circle: start; square: end.",
    "poses": "Earlier poses are paler.",
}
"""Of the figures, by the names of their files."""


class Aside(NamedTuple):
    """What a page says of a design beside its plan.

    Attributes:
        remarks: What else is to be known, in sentences without their full stops.
        settings: How the design came about: `facts`, `command` and `experiment_text`.
    """

    remarks: tuple[Remark, ...] = ()
    settings: Mapping[str, Any] = MappingProxyType({})


def write_pictures(
    folder: Path,
    plan: ExcitationPlan,
    played: AbstractTrajectory | None = None,
    aside: Aside | None = None,
) -> list[Path]:
    """Writes a page and its figures: joints, end-effector and its path; all of them or nothing.

    Args:
        folder: Where they shall lie.
        plan: With the motion.
        played: The motion with its leads, to be drawn in its place.
        aside: What else the page says.
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
    with atomic_folder(folder) as staging:
        write_page(staging / PAGE, excitation_page(plan, figures, aside))
        for name, figure in figures.items():
            save(figure, staging / f"{name}.png")
    return [folder / name for name in (PAGE, *(f"{name}.png" for name in figures))]


def excitation_page(
    plan: ExcitationPlan, figures: Mapping[str, Figure], aside: Aside | None = None
) -> Page:
    """What a design has found, for people.

    Args:
        plan: With the motion.
        figures: Of the motion, by the names of their files without suffix.
        aside: What else the page says.
    """
    robot, base = plan.base.model.robot, plan.base
    aside = Aside() if aside is None else aside
    use = [sheet_of(use_table(plan), "percent, for all times")]
    if plan.findings:
        use.append(sheet_of(findings_table(plan.findings), "at the instants that were checked"))
    said = ordered((*remarks(plan), *aside.remarks))
    return Page(
        f"{robot.name}: a motion to record",
        (
            Section(
                "Verdict",
                (
                    Headline(_whole(plan, aside.remarks)),
                    Remarks(tuple(Remark(r.tone, _sentence(r.text)) for r in said)),
                ),
            ),
            Section(
                "The motion", tuple(Picture(f, CAPTIONS.get(n, "")) for n, f in figures.items())
            ),
            Section("Use of the limits", tuple(use)),
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
            Section(
                "Standard deviations to expect",
                (Prose(_sentence(expectation(plan))), sheet_of(deviation_table(plan), "")),
            ),
            Section("To repeat this", repeat(aside.settings)),
        ),
        f"It shall determine {base.size} base parameters of {robot.joints} joints.",
    )


def _whole(plan: ExcitationPlan, others: tuple[Remark, ...]) -> Remark:
    if plan.undetermined:
        return Remark(Tone.BAD, "This motion does not determine all base parameters.")
    if not plan.feasible:
        return Remark(Tone.BAD, "This motion does not keep all limits.")
    if plan.interrupted:
        return Remark(Tone.DOUBTFUL, "A motion that can be recorded, but its design was stopped.")
    if any(remark.tone is Tone.BAD for remark in others):
        return Remark(
            Tone.DOUBTFUL,
            "A motion that determines all base parameters, but read what stands below before it "
            "is recorded.",
        )
    return Remark(
        Tone.GOOD,
        "A motion that keeps all limits it was designed for, and determines all base parameters.",
    )


def _sentence(text: str) -> str:
    stop = "" if text.endswith((".", "?", "!")) else "."
    return text[:1].upper() + text[1:] + stop

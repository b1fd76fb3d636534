"""The page of an identification: what was asked, what was found, and whether it is good."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxid.identification.fit import Fit
from jaxid.report.blocks import (
    Abreast,
    AbstractBlock,
    Facts,
    Headline,
    Picture,
    Prose,
    Remark,
    Remarks,
    Tone,
)
from jaxid.report.bodies import body_table, consistency_facts
from jaxid.report.numbers import percent, significant
from jaxid.report.page import Page, Section
from jaxid.report.repeat import repeat
from jaxid.report.sheets import parameter_sheet, sheet_of
from jaxid.report.tables import error_table, joint_table, motor_table, residual_table
from jaxid.report.verdict import verdict
from jaxid.robot.robot import Robot
from jaxid.validation import Definiteness, TorqueErrors

PAGE = "report.html"
"""File of the page."""
PANELS = 42
"""Panels of forces over time that a page holds at most, if there is more than one recording."""


def identification_page(
    fit: Fit,
    identification: Sequence[TorqueErrors],
    verification: Sequence[TorqueErrors],
    definiteness: Definiteness,
    settings: Mapping[str, Any],
    figures: Mapping[str, Figure],
    notes: Sequence[str] = (),
    doubts: Sequence[str] = (),
) -> Page:
    """Everything that was found, for people.

    Args:
        fit: The estimates.
        identification: Errors on the recordings of the fit.
        verification: Errors on recordings that the fit has not seen.
        definiteness: Of the mass matrix.
        settings: How the result came about.
        figures: By the names of their files, without suffix.
        notes: What the reader should know, in sentences.
        doubts: About the logs, in sentences.
    """
    base, robot = fit.base, fit.base.model.robot
    said = [
        text for text in dict.fromkeys((*robot.notes, *fit.notes, *notes)) if text not in doubts
    ]
    judged = verdict(fit, identification, verification, definiteness, doubts)
    sections = [
        Section("Verdict", (Headline(judged[0]), Remarks(judged[1:]))),
        Section("What was asked", _asked(fit, settings, said)),
        Section("Robot and drives", _robot(robot)),
        Section(
            "Errors",
            (
                Prose(
                    "Predicted less measured forces. Bars: the mean of their absolute values "
                    "(Eq. 37, Fig. 10 of the paper); marks: their RMS."
                ),
                Picture(figures["errors"]),
                Abreast(
                    tuple(sheet_of(error_table(e, robot)) for e in (*identification, *verification))
                ),
            ),
        ),
        Section("Measured and predicted forces", _torques(figures, robot.joints)),
        Section(f"{base.size} base parameters", _parameters(fit, figures["parameters"])),
    ]
    if fit.consistency is not None:
        bodies = sheet_of(body_table(fit.consistency, robot.joint_names))
        facts = Facts(tuple(consistency_facts(fit.consistency)))
        sections.append(Section("Bodies", (bodies, facts)))
    if fit.residual_spectra is not None:
        sections.append(
            Section(
                "What is left over",
                (
                    Prose(
                        "A good model leaves noise. Power at low frequencies, or residuals that "
                        "resemble their neighbours more than the filters explain (dashed), mean "
                        "that an effect is missing."
                    ),
                    Picture(figures["residuals"], "Frequency in Hz."),
                    Picture(figures["autocorrelation"]),
                    sheet_of(residual_table(fit.residual_spectra, robot)),
                ),
            )
        )
    if "filter" in figures:
        sections.append(Section("Choice of the filter", (Picture(figures["filter"]),)))
    sections.append(Section("To repeat this", repeat(settings)))
    logs = f"{len(fit.recordings)} log{'' if len(fit.recordings) == 1 else 's'}"
    return Page(
        f"{robot.name}: identified parameters",
        tuple(sections),
        f"{base.size} base parameters of {robot.joints} joints, from {logs}.",
        "All numbers: result.json and parameters.csv beside this page.",
    )


def _asked(
    fit: Fit, settings: Mapping[str, Any], notes: Sequence[str]
) -> tuple[AbstractBlock, ...]:
    rows, numbers = fit.rows, fit.condition_numbers
    shown = [
        ("experiment", settings.get("experiment")),
        ("identified with", ", ".join(settings.get("identification", ())) or None),
        ("verified with", ", ".join(settings.get("verification", ())) or None),
        ("split", settings.get("split")),
        ("filter", settings.get("filter")),
        ("decimation", settings.get("decimation")),
        ("estimator", fit.estimator),
        ("solution", fit.solution),
        ("rows per joint", f"{min(rows)} to {max(rows)}" if len(set(rows)) > 1 else rows[0]),
        ("residual", f"{percent(fit.residual, 3)} % of the forces (norms of all rows)"),
        (
            "condition number",
            f"{significant(numbers.raw, 4)} in SI units, {significant(numbers.weighted, 4)} "
            f"weighted, {significant(numbers.scaled, 4)} with columns of length one",
        ),
    ]
    facts = Facts(tuple((word, str(value)) for word, value in shown if value is not None))
    return (facts, Remarks(tuple(Remark(Tone.PLAIN, text) for text in notes)))


def _robot(robot: Robot) -> tuple[AbstractBlock, ...]:
    blocks: list[AbstractBlock] = [sheet_of(joint_table(robot), "")]
    if not robot.drives.is_direct:
        blocks.append(sheet_of(motor_table(robot)))
    g = ", ".join(f"{x:g}" for x in np.asarray(robot.gravity))
    facts = [("source", robot.source), ("gravity [m/s²]", g)]
    if robot.limits.assumed:
        facts.append(("assumed", ", ".join(robot.limits.assumed)))
    if robot.tool is not None:
        where = robot.joint_names[robot.tool.body]
        facts.append(("known load", f"{float(robot.tool.mass):g} kg on the body of {where}"))
    blocks.append(Facts(tuple((word, str(text)) for word, text in facts if text)))
    return tuple(blocks)


def _torques(figures: Mapping[str, Figure], joints: int) -> tuple[AbstractBlock, ...]:
    """Pictures of the first recordings, and where those of the others lie."""
    names = [name for name in figures if name.startswith("torque_")]
    shown = max(1, PANELS // joints)
    blocks: list[AbstractBlock] = [
        Picture(figures[name], "Time in seconds.") for name in names[:shown]
    ]
    if names[shown:]:
        others = ", ".join(f"{name}.png" for name in names[shown:])
        blocks.append(Prose(f"Figures of more recordings lie beside this page: {others}."))
    return tuple(blocks)


def _parameters(fit: Fit, figure: Figure) -> tuple[AbstractBlock, ...]:
    base = fit.base
    blocks: list[AbstractBlock] = []
    if fit.undetermined:
        blocks.append(
            Remarks(
                tuple(
                    Remark(
                        Tone.BAD,
                        f"{d.sentence(base)}.",
                        f"leaves {percent(d.uncertainty)} % of the forces open; singular value "
                        f"{d.singular_value:.1e} of the largest",
                    )
                    for d in fit.undetermined
                )
            )
        )
    blocks += [Picture(figure), parameter_sheet(fit)]
    if base.lengths:
        shown = (
            f"{name} = {significant(value, 4)} {'m/s²' if name == 'g' else 'm'}"
            for name, value in base.lengths.items()
        )
        blocks.append(Prose(f"In the combinations: {', '.join(shown)}."))
    return tuple(blocks)

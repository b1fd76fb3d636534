"""Page of an identification: task, estimates, errors and the verdict on the model."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxid.identification.fit import Fit
from jaxid.report.page import Section, block, facts, picture, provenance, render_page
from jaxid.report.tables import (
    body_table,
    error_table,
    lengths_sentence,
    motor_table,
    residual_table,
)
from jaxid.report.verdict import verdict
from jaxid.robot.robot import Robot
from jaxid.table import (
    MISSING,
    Column,
    Remark,
    Status,
    Table,
    percent,
    significant,
    with_deviations,
)
from jaxid.validation import Definiteness, TorqueErrors

TRUST = {
    Status.GOOD: "trusted",
    Status.DOUBTFUL: "doubtful",
    Status.BAD: "small, or not excited",
}
"""Words for the trust in an estimate."""


def identification_page(
    fit: Fit,
    identification: Sequence[TorqueErrors],
    verification: Sequence[TorqueErrors],
    definiteness: Definiteness,
    settings: Mapping[str, Any],
    figures: Mapping[str, Figure],
    notes: Sequence[str] = (),
    doubts: Sequence[str] = (),
) -> str:
    """Return the page of an identification as HTML.

    Args:
        fit: Identified parameters.
        identification: Errors on the recordings of the fit.
        verification: Errors on recordings that the fit has not seen.
        definiteness: Definiteness of the mass matrix.
        settings: Origin of the result.
        figures: Figures by the names of their files, without suffix.
        notes: Notes for the reader, in sentences.
        doubts: Doubts about the logs, in sentences.
    """
    base, robot = fit.base, fit.base.model.robot
    every_note = dict.fromkeys((*robot.notes, *fit.notes, *notes))
    overall, *criteria = verdict(fit, identification, verification, definiteness, doubts)
    remarks = [Remark(note) for note in every_note if note not in doubts]
    tables = [error_table(errors, robot) for errors in (*identification, *verification)]
    sections = [
        Section("Verdict", [block("headline", overall), block("remarks", criteria)]),
        Section("Task", [_settings_block(fit, settings), block("remarks", remarks)]),
        Section("Robot and drives", _robot_blocks(robot)),
        Section(
            "Errors",
            [
                block(
                    "paragraph",
                    "Predicted less measured forces. Bars: the mean of their absolute values "
                    "(Eq. 37, Fig. 10 of the paper); marks: their RMS.",
                ),
                picture(figures["errors"]),
                block("abreast", *(block("table", table) for table in tables)),
            ],
        ),
        Section("Measured and predicted forces", _torque_blocks(figures, robot.joints)),
        Section(f"{base.size} base parameters", _parameter_blocks(fit, figures["parameters"])),
    ]
    if fit.consistency is not None:
        bodies = body_table(fit.consistency, robot.joint_names)
        sections.append(Section("Bodies", [block("table", bodies, titled=False)]))
    if fit.residual_spectra is not None:
        text = (
            "The residuals of a good model are noise. Power at low frequencies, or residuals that "
            "resemble their neighbours more than the filters explain (dashed), mean that an effect "
            "is missing."
        )
        blocks = [
            block("paragraph", text),
            picture(figures["residuals"]),
            picture(figures["autocorrelation"]),
            block("table", residual_table(fit.residual_spectra, robot)),
        ]
        sections.append(Section("Residuals", blocks))
    if "filter" in figures:
        sections.append(Section("Choice of the filter", [picture(figures["filter"])]))
    logs = f"{len(fit.recordings)} log{'' if len(fit.recordings) == 1 else 's'}"
    return render_page(
        f"{robot.name}: identified parameters",
        [*sections, provenance(settings)],
        f"{base.size} base parameters of {robot.joints} joints, from {logs}.",
        "All numbers: result.json and parameters.csv beside this page.",
    )


def _settings_block(fit: Fit, settings: Mapping[str, Any]) -> str:
    rows = [
        ("experiment", settings.get("experiment")),
        ("identified with", ", ".join(settings.get("identification", ())) or None),
        ("verified with", ", ".join(settings.get("verification", ())) or None),
        ("split", settings.get("split")),
        ("filter", settings.get("filter")),
        ("decimation", settings.get("decimation")),
        ("estimator", fit.estimator),
        ("solution", fit.solution),
        *fit.facts[:-1],
    ]
    return facts((word, text) for word, text in rows if text is not None)


def _robot_blocks(robot: Robot) -> list[str]:
    blocks = [block("table", Table("", *robot.summary().columns))]
    if not robot.drives.is_direct:
        blocks.append(block("table", motor_table(robot)))
    rows = [
        ("source", robot.source),
        ("gravity [m/s²]", ", ".join(f"{x:g}" for x in np.asarray(robot.gravity))),
        ("assumed", ", ".join(robot.limits.assumed)),
    ]
    if robot.tool is not None:
        where = robot.joint_names[robot.tool.body]
        rows.append(("known load", f"{float(robot.tool.mass):g} kg on the body of {where}"))
    return [*blocks, facts((word, text) for word, text in rows if text)]


def _torque_blocks(figures: Mapping[str, Figure], joints: int) -> list[str]:
    """Return pictures of the first recordings (42 panels at most), and the files of the others."""
    names = [name for name in figures if name.startswith("torque_")]
    shown = max(1, 42 // joints)
    blocks = [picture(figures[name]) for name in names[:shown]]
    if names[shown:]:
        others = ", ".join(f"{name}.png" for name in names[shown:])
        text = f"Figures of more recordings lie beside this page: {others}."
        blocks.append(block("paragraph", text))
    return blocks


def _parameter_blocks(fit: Fit, figure: Figure) -> list[str]:
    blocks = [block("remarks", fit.determination)] if fit.undetermined else []
    blocks += [picture(figure), block("table", page_parameter_table(fit))]
    if fit.base.lengths:
        blocks.append(block("paragraph", lengths_sentence(fit.base)))
    return blocks


def page_parameter_table(fit: Fit) -> Table:
    """Return the table of a page with the base parameters and their 95 % intervals.

    Args:
        fit: Identified parameters.
    """
    base, trust = fit.base, fit.trust
    values, deviations = with_deviations(fit.parameters, fit.standard_deviations)
    ends = [_round_like(d, end) for d, end in zip(deviations, fit.intervals(), strict=True)]
    low, high = zip(*ends, strict=True)
    return Table(
        "",
        Column("#", list(range(1, base.size + 1))),
        Column("parameter", base.names),
        Column("estimate", values, kind="number"),
        Column("±", deviations, kind="number"),
        Column("unit", base.units),
        Column("95 %\nfrom", low, kind="number"),
        Column("95 %\nto", high, kind="number"),
        Column("±", fit.relative_standard_deviations, "%", percent),
        Column("trust", [TRUST[level] for level in trust]),
        Column("combination", base.expressions, kind="code"),
        status=trust,
    )


def _round_like(deviation: str, interval: np.ndarray) -> tuple[str, str]:
    """Return both ends of an interval, to the digits of its standard deviation."""
    if not np.isfinite(interval).all():
        return MISSING, MISSING
    if "e" in deviation:
        return significant(float(interval[0]), 5), significant(float(interval[1]), 5)
    decimals = len(deviation.partition(".")[2])
    return f"{interval[0]:.{decimals}f}", f"{interval[1]:.{decimals}f}"

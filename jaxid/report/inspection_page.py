"""Report on logs before any identification: are they sane, what do they determine?"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.identification.fit_result import Fit
from jaxid.measurement.recording import Recording
from jaxid.result_table import Remark, Status, Table, percent
from jaxid.robot.robot import Robot
from jaxid.validation.diagnosis import Diagnosis

from .figure import Figure
from .figure_elements import BLUE, ORANGE, VERMILION, Curve, Panel
from .page import Section, Settings, folded, provenance, render_page, tiles
from .result_files import write_page_and_table
from .result_records import table_rows


def write_inspection(
    folder: Path,
    verdict: Remark,
    logs: Sequence[tuple[Diagnosis, Fit]],
    tables: Sequence[Table],
    settings: Settings,
) -> list[Path]:
    """Write a page on logs, and their statistics as JSON and CSV; return the files.

    Args:
        folder: Folder of the files.
        verdict: Whether the logs can be used, in one sentence.
        logs: Findings on each log, and the fit to it alone; at least one.
        tables: Tables on the robot and its parameters.
        settings: Origin of the result, as `provenance` takes it.
    """
    robot = logs[0][0].robot
    size = logs[0][1].base.size
    findings = [
        Remark(f"{diagnosis.log.name}: {text}", Status.DOUBTFUL)
        for diagnosis, _ in logs
        for text in diagnosis.findings
    ]
    undetermined = max(len(fit.undetermined) for _, fit in logs)
    residual = percent(max(fit.residual for _, fit in logs))
    numbers = tiles(
        (str(len(findings)), "findings to look at"),
        (
            f"{residual} %",
            "of the forces that a fit to the log does not explain",
        ),
        (
            f"{size - undetermined} of {size}",
            "combinations of parameters that the log determines",
        ),
    )
    sections: list[Section] = [("At a glance", [verdict, numbers, findings])]
    rows = []
    for diagnosis, fit in logs:
        name = diagnosis.log.name
        blocks = [log_figure(robot, diagnosis.excerpt), diagnosis.summary()]
        sections.append((name, [*blocks, fit.determination]))
        statistics = diagnosis.statistics
        rows += table_rows(
            log=[name] * robot.joints,
            joint=robot.joint_names,
            lowest=statistics.lowest,
            highest=statistics.highest,
            speed=statistics.speed,
            force=statistics.force,
        )
    sections.append(("Robot and parameters", [folded("Tables", *tables)]))
    sections.append(provenance(settings))
    page = render_page(f"{robot.name}: logs", sections)
    content = {"findings": [finding.text for finding in findings], "joints": rows}
    return write_page_and_table(folder, "inspection", page, content, rows)


def log_figure(robot: Robot, log: Recording) -> Figure:
    """Return angles and forces of a log, with the limits of the joints as lines."""
    limits = robot.limits
    forces = robot.known_max_forces
    panels = []
    for j in range(robot.joints):
        angle = Curve(log.time, log.angles[:, j], "position", BLUE)
        below = []
        if log.forces is not None:
            force = Curve(log.time, log.forces[:, j], "force", ORANGE)
            levels = _lines(-forces[j], forces[j])
            below = [Panel([force], unit=robot.force_unit(j), levels=levels)]
        panels.append(
            Panel(
                [angle],
                title=robot.joint_names[j],
                unit=robot.joint_unit(j),
                levels=_lines(limits.position_min[j], limits.position_max[j]),
                below=below,
            )
        )
    title = f"{log.name}: positions and forces (dashed: limits)"
    return Figure(title, panels, min(2, robot.joints), height=2.6)


def _lines(*values: Any) -> list[tuple[str, float, str]]:
    return [("y", float(value), VERMILION) for value in values if np.isfinite(value)]

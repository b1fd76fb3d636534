"""Page of an identification: verdict, task, estimates, errors; tables of results."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from jaxid.identification.consistency.estimator import Consistency
from jaxid.identification.fit_result import Fit
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Table,
    estimate_columns,
    percent,
    significant,
)
from jaxid.robot.robot import Robot
from jaxid.validation.judgement import Report, judge
from jaxid.validation.torque_errors import (
    TorqueErrors,
    relative_error,
    relative_joint_errors,
)

from .figure import Figure
from .joint_estimates import correlation_blocks, joint_table
from .page import Section, folded, picture, provenance, render_page, tiles
from .parameter_words import FRAMES_NOTE, word_columns

Figures = Mapping[str, Figure]
"""Figures by the names of their files."""
Sections = Iterator[Section]
"""Sections of the page, from the top."""
MAX_PANELS = 28
"""Largest number of joints, of all recordings together, whose forces the page shows."""


def identification_page(report: Report, figures: Figures) -> str:
    """Return the page of an identification as HTML: the verdict first, then details."""
    fit = report.fit
    base = fit.base
    robot = base.model.robot
    sections = [
        ("At a glance", _glance(report)),
        ("Estimates", _estimates(report)),
        *_physics(report, figures),
        ("Measured and predicted forces", _torques(figures, robot)),
        (
            "Details",
            [folded(name, *blocks) for name, blocks in _details(report, figures)],
        ),
        provenance(report.settings),
    ]
    logs = len(fit.recordings)
    ending = "" if logs == 1 else "s"
    return render_page(
        f"{robot.name}: identified model",
        sections,
        f"{base.size} base parameters of {len(robot.driven)} joints, from {logs} "
        f"log{ending}.",
        "All numbers are in result.json and parameters.csv beside this page. Curves "
        "of long logs are thinned out, but keep every peak.",
    )


def _glance(report: Report) -> list[Any]:
    """Return verdict, three numbers, the logs, and what deserves attention."""
    judgement = judge(report)
    faults = judgement.faults
    other_findings = [x for x in judgement.findings if x not in faults]
    return [
        judgement.verdict,
        _three_numbers(report),
        Table("", facts=_data(report)),
        *([faults] if faults else []),
        folded("What else was checked", other_findings),
    ]


def _three_numbers(report: Report) -> Markup:
    """Return the torque error in all and of the worst joint, and what is determined."""
    fit = report.fit
    logs = report.verification
    motion = "on motion that the fit did not use"
    if not logs:
        logs = report.identification
        motion = "on the motion of the fit, since no other log was given"
    band = logs[0].band_words
    errors = relative_joint_errors(logs)
    worst_joint = int(np.argmax(errors))
    joint_name = fit.base.model.robot.joint_names[worst_joint]
    undetermined = len(fit.undetermined)
    return tiles(
        (
            f"{percent(relative_error(logs))} %",
            f"torque error (RMS over RMS){band} {motion}",
        ),
        (
            f"{percent(errors[worst_joint])} %",
            f"the same for the worst joint, {joint_name}",
        ),
        (
            f"{fit.base.size - undetermined} of {fit.base.size}",
            "combinations of parameters that the logs determine",
        ),
    )


def _data(report: Report) -> Iterator[tuple[str, str]]:
    """Yield the logs, each with its word."""
    for log in report.identification:
        yield "identified with", _log_size(log)
    for log in report.verification:
        yield "verified with", _log_size(log)


def _log_size(log: TorqueErrors) -> str:
    """Return the name of a log, and duration and number of the rows that count."""
    counts_for_a_joint = log.counted.any(axis=1)
    times = log.time[counts_for_a_joint]
    duration = significant(float(times[-1] - times[0]))
    return f"{log.name}: {duration} s, {len(times)} rows"


def _physics(report: Report, figures: Figures) -> Sections:
    """Yield sections on what the model says of the robot.

    They show the robot in motion, its torques before and after, and friction.
    """
    text = (
        "The colour of a link shows the torque error of the joint that moves it; the "
        "colour of the path shows the mean error of all joints. Drag the picture to "
        "turn it, and move the slider to follow the motion."
    )
    yield "The robot along the motion", [picture(figures["robot"], text)]
    if "before_and_after" in figures:
        text = (
            "Torque errors with the parameters in the robot's file (friction and "
            "rotors count as zero if it has none), and with the identified ones."
        )
        yield "Before and after", [text, figures["before_and_after"]]
    text = (
        "The line is the model. Each point is the mean measured friction in a range "
        "of speeds: the force minus the gravity and inertia forces of the model. If "
        "the points do not follow the line, friction has a different shape: `jaxid "
        "choose` tries further laws."
    )
    yield "Friction", [text, figures["friction"]]


def _torques(figures: Figures, robot: Robot) -> list[Any]:
    """Return the figures of the recordings, the first one unfolded."""
    logs = [figure for name, figure in figures.items() if name.startswith("torque_")]
    first_logs = logs[: max(1, MAX_PANELS // robot.joints)]
    blocks: list[Any] = [first_logs[0]]
    for figure in first_logs[1:]:
        blocks.append(folded(figure.title, dataclasses.replace(figure, title="")))
    remaining_logs = len(logs) - len(first_logs)
    if remaining_logs:
        blocks.append(
            f"{remaining_logs} more recordings are not shown here; result.json has "
            "their errors."
        )
    return blocks


def _estimates(report: Report) -> list[Any]:
    """Return friction, rotors and gravity of each joint; all parameters folded."""
    fit = report.fit
    text = (
        "Each estimate is followed by ± half the width of its 95 % interval. Masses "
        "times distances are those of the body that the joint moves, combined with "
        "other parameters that forces cannot separate from them."
    )
    note = (
        "* combined with other parameters that forces cannot separate from it: see "
        "its combination. Open: percentage of the torques of random motions that the "
        "interval leaves uncertain. A small parameter matters little, however wide "
        "its interval."
    )
    doubts = [fit.determination] if fit.undetermined else []
    all_parameters = folded(
        f"All {fit.base.size} base parameters", parameter_table(fit), note, FRAMES_NOTE
    )
    correlations = folded("Correlated parameters", *correlation_blocks(fit))
    return [*doubts, text, joint_table(report), all_parameters, correlations]


def _details(report: Report, figures: Figures) -> Sections:
    """Yield what experts ask for."""
    fit = report.fit
    robot = fit.base.model.robot
    notes = [Remark(note) for note in report.every_note]
    yield "Task and notes", [Table("", facts=_settings_and_facts(report)), notes]

    summary = robot.summary()
    gravity = ", ".join(f"{x:g}" for x in robot.gravity)
    assumptions = ", ".join(robot.limits.assumed) or "nothing"
    facts = [*summary.facts, ("gravity [m/s²]", gravity), ("assumed", assumptions)]
    table = Table("", *summary.columns, facts=facts)
    yield "Robot and drives", [table, *motor_tables(robot)]

    band = report.every_error[0].band_words
    text = (
        "RMS of the errors of each joint over the RMS of its measured forces"
        f"{band}. Errors in another band of frequencies are not comparable."
    )
    tables = report.validation.tables()
    yield "Torque errors", [text, figures["errors"], *tables]
    if fit.consistency is not None:
        names = [robot.body_names[body] for body in robot.solid_bodies]
        table = body_table(fit.consistency, names, report.claimed_bodies)
        yield "Bodies", [table]
    if fit.residual_spectra is not None:
        text = (
            "The errors of a complete model are random. If a curve rises above the "
            "dashed line at low frequencies, the model lacks an effect there, such as "
            "friction of another shape: `jaxid choose` tries some."
        )
        yield "Residuals", [text, figures["residuals"]]


def _settings_and_facts(report: Report) -> list[tuple[str, Any]]:
    """Return the settings of an identification, and facts of its fit."""
    settings = report.settings
    facts = [
        (key, settings[key])
        for key in ("experiment", "split", "filter", "decimation")
        if settings.get(key) is not None
    ]
    # The last fact, the count of trusted estimates, stands at the top of the page.
    return [*facts, ("estimator", report.fit.estimator), *report.fit.facts[:-1]]


def parameter_table(fit: Fit) -> Table:
    """Return the base parameters in words, with their 95 % intervals."""
    base = fit.base
    ends = fit.intervals().T
    return Table(
        "",
        Column("parameter", base.names),
        *word_columns(base),
        *estimate_columns(fit.parameters, fit.standard_deviations, ends, base.units),
        Column("open", fit.open_shares, "%", percent),
        Column("combination", base.expressions, kind="code"),
        status=fit.trust,
    )


def motor_tables(robot: Robot) -> list[Table]:
    """Return the motors of a robot with gears or couplings: joints and properties."""
    drives = robot.drives
    if drives.is_direct:
        return []
    turns = []
    driven = list(robot.driven)
    for row in np.asarray(drives.reduction)[driven]:
        joints = np.flatnonzero(row)
        turns.append(" + ".join(f"{row[j]:.6g} {robot.joint_names[j]}" for j in joints))
    columns = [
        Column("motor", list(range(1, len(driven) + 1))),
        Column("turns", turns),
    ]
    for name, values, unit in (
        ("joint at\nmotor zero", drives.zero, "rad or m"),
        ("largest\ntorque", drives.max_torques, "N m"),
        ("rotor\ninertia", drives.rotor_inertia, "kg m²"),
    ):
        values_of_motors = np.asarray(values)[driven]
        if np.isfinite(values_of_motors).any() and np.any(values_of_motors):
            columns.append(Column(name, values_of_motors, unit))
    return [Table("motors", *columns)]


def body_table(
    consistency: Consistency,
    names: Sequence[str],
    file_bodies: np.ndarray | None = None,
) -> Table:
    """Return mass, centre of mass and margin of each body, and the bounds' effect.

    Masses and centres are compared with those of the robot's file, if it has some.
    """
    bodies = consistency.bodies
    mass = bodies[:, 0]
    centre = bodies[:, 1:4] / mass[:, None]
    centre_columns = [
        Column(f"{axis} of\ncentre", centre[:, k], "m", lambda x: significant(x, 2))
        for k, axis in enumerate("xyz")
    ]
    file_columns = []
    if file_bodies is not None:
        file_mass = file_bodies[:, 0]
        divisor = np.where(file_mass > 0, file_mass, np.nan)
        file_centre = file_bodies[:, 1:4] / divisor[:, None]
        distance = np.linalg.norm(centre - file_centre, axis=1)
        file_columns = [
            Column("mass by\nthe file", file_mass, "kg"),
            Column(
                "centre from\nthe file's", distance, "m", lambda x: significant(x, 2)
            ),
        ]
    is_bounded = [k in consistency.masses_from_bounds for k in range(len(names))]
    price = f"{100 * consistency.residual_increase:.2g} %"
    error_bound = f"{consistency.error_bound:.1e}"
    return Table(
        "physically consistent bodies",
        Column("body of joint", names),
        Column("mass", mass, "kg"),
        *centre_columns,
        *file_columns,
        Column("margin", consistency.margins, "%", percent),
        Column(
            "mass follows from", ["bounds too" if x else "forces" for x in is_bounded]
        ),
        status=[Status.DOUBTFUL if x else Status.GOOD for x in is_bounded],
        facts=[
            ("price", f"{price} larger weighted residuals than without bounds"),
            (
                "optimum",
                f"within {error_bound} of it, {consistency.iterations} iterations",
            ),
            ("active bounds", "; ".join(consistency.active) or "none"),
        ],
    )

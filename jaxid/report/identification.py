"""Page of an identification: verdict, task, estimates, errors; and the tables of its results."""

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from jaxid.identification.consistency.estimator import Consistency
from jaxid.identification.fit_result import Fit
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Table,
    percent,
    significant,
    with_deviations,
)
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import TorqueErrors
from jaxid.validation.verdict import RMS_ERROR, Report, verdict

from .figure import Figure
from .page import Section, folded, picture, provenance, render_page, tiles
from .parameter_words import glossary, word_columns
from .physics import gravity_table


def identification_page(report: Report, figures: Mapping[str, Figure]) -> str:
    """Return the page of an identification as HTML: what matters first, then the details."""
    fit, settings = report.fit, report.settings
    base, robot = fit.base, fit.base.model.robot
    overall, *criteria = verdict(report)
    open_points = [r for r in criteria if r.status in (Status.BAD, Status.DOUBTFUL)]
    others = [r for r in criteria if r not in open_points]
    sections = [
        (
            "At a glance",
            [
                overall,
                _three_numbers(report),
                Table("", facts=_data(report)),
                *([open_points] if open_points else []),
                folded("What else was checked", others),
            ],
        ),
        *_physics(report, figures),
        ("Measured and predicted forces", _torques(figures, robot)),
        ("Parameters in words", _parameters(fit, figures["parameters"])),
        (
            "Details",
            [folded(name, *blocks) for name, blocks in _details(report, figures)],
        ),
    ]
    logs = f"{len(fit.recordings)} log{'' if len(fit.recordings) == 1 else 's'}"
    return render_page(
        f"{robot.name}: identified model",
        [*sections, provenance(settings)],
        f"{base.size} base parameters of {robot.joints} joints, from {logs}.",
        "All numbers: result.json and parameters.csv beside this page. Lines of long "
        "logs show the "
        "least and the largest value of each pixel column, so that no peak is lost.",
    )


def _three_numbers(report: Report) -> Markup:
    """Return the torque error, the mean error of the worst joint, and the known parameters."""
    fit = report.fit
    logs, which = report.verification, "on motion that the fit has not seen"
    if not logs:
        logs, which = (
            report.identification,
            "on the motion of the fit: no other log was given",
        )
    error = max(e.relative for e in logs)
    limits = np.searchsorted(np.array(RMS_ERROR) / 100.0, error)
    status = (Status.GOOD, Status.DOUBTFUL, Status.BAD)[int(limits)]
    worst = np.max([e.mean_percent for e in logs], axis=0)
    second, joint = f"{significant(fit.condition_numbers.scaled)}", ""
    meaning = "condition number: how well the motion tells the parameters apart"
    if np.isfinite(worst).all():
        joint = fit.base.model.robot.joint_names[int(np.argmax(worst))]
        second = f"{percent(float(np.max(worst)) / 100.0)} %"
        meaning = f"mean error of the worst joint, {joint}, of its largest torque"
    known = f"{fit.trust.count(Status.GOOD)} of {fit.base.size}"
    return tiles(
        (f"{percent(error)} %", f"torque error (RMS) {which}", status),
        (second, meaning, Status.NEUTRAL),
        (
            known,
            "parameters known to 10 %",
            Status.BAD if fit.undetermined else Status.NEUTRAL,
        ),
    )


def _data(report: Report) -> Iterator[tuple[str, str]]:
    """Yield robot, logs, estimator and total mass, each with its word."""
    fit, robot = report.fit, report.fit.base.model.robot
    yield "robot", f"{robot.name}, {robot.joints} joints"
    for word, logs in (
        ("identified with", report.identification),
        ("verified with", report.verification),
    ):
        for e in logs:
            time = np.asarray(e.time)
            length = significant(float(time[-1] - time[0]))
            yield word, f"{e.name}: {length} s, {len(time)} rows of each joint"
    # A class `LeastSquares` is shown as "least squares".
    estimator = re.sub(
        r"(?<=[a-z])(?=[A-Z])", " ", type(fit.estimator).__name__
    ).lower()
    yield "estimator", estimator
    if fit.consistency is not None:
        mass = np.asarray(fit.consistency.bodies)[:, 0]
        loose = len(fit.consistency.masses_from_bounds)
        proof = f", of which {loose} bodies follow from bounds too" if loose else ""
        yield (
            "total mass of the moving bodies",
            f"{significant(float(mass.sum()))} kg{proof}",
        )
    else:
        text = (
            "forces tell combinations of masses only; physically consistent bodies "
            "have masses"
        )
        yield "total mass", text
    if report.claimed_mass:
        yield "total mass by the robot's file", f"{significant(report.claimed_mass)} kg"


def _physics(report: Report, figures: Mapping[str, Figure]) -> Iterator[Section]:
    """Yield what the model says of the robot: in motion, before and after, friction, weight."""
    text = (
        "Each link has the colour of the torque error of the joint that moves it, "
        "the path "
    )
    text += "of the end-effector that of the mean. Turn it, and move the slider."
    yield "The robot along the motion", [picture(figures["robot"], text)]
    if "before_and_after" in figures:
        text = (
            "Torque errors with the parameters that the robot's file claims (friction "
            "and rotors "
            "count as zero where it claims none), and with those that were identified."
        )
        yield "Before and after", [text, figures["before_and_after"]]
    text = (
        "Lines: the model. Points: means over classes of speed of the measured "
        "forces, less all "
        "that the model explains otherwise. Points far from their line ask for "
        "another shape."
    )
    yield "Friction", [text, figures["friction"]]
    log = report.verification[0] if report.verification else report.identification[0]
    yield "Gravity", [gravity_table(report.fit, log), figures["gravity"]]


def _torques(figures: Mapping[str, Figure], robot: Robot) -> list[Any]:
    """Return the figures of the recordings: with 42 panels at most, the first one unfolded."""
    found: list[Any] = [
        figure for name, figure in figures.items() if name.startswith("torque_")
    ]
    shown = found[: max(1, 42 // robot.joints)]
    # Many panels share the size of the page.
    bins = min(shown[0].bins, 28_000 // sum(len(figure.panels) for figure in shown))
    first, *others = (dataclasses.replace(figure, bins=bins) for figure in shown)
    folds = [folded(f.title, dataclasses.replace(f, title="")) for f in others]
    blocks: list[Any] = [first, *folds]
    if left := len(found) - len(shown):
        blocks.append(
            f"{left} more recordings are not shown here; result.json has their errors."
        )
    return blocks


def _parameters(fit: Fit, figure: Figure) -> list[Any]:
    """Return the meanings of all symbols, and the estimates with theirs."""
    base = fit.base
    text = (
        "* together with what forces cannot tell apart from it: see its combination. "
        "A parameter "
        "near zero is never known to a few percent, and that is no fault."
    )
    lengths = ", ".join(f"{name} = {value:.4g}" for name, value in base.lengths.items())
    said = [
        text,
        *([f"In the combinations: {lengths} (m; m/s² for g)."] if lengths else []),
    ]
    doubts = [fit.determination] if fit.undetermined else []
    summary = f"All {base.size} estimates with 95 % intervals and combinations"
    return [
        *doubts,
        glossary(base),
        folded(summary, parameter_table(fit), *said, figure),
    ]


def _details(report: Report, figures: Mapping[str, Figure]) -> Iterator[Section]:
    """Yield what experts ask for."""
    fit, settings, robot = report.fit, report.settings, report.fit.base.model.robot
    task = [
        ("experiment", settings.get("experiment")),
        *((key, settings.get(key)) for key in ("split", "filter", "decimation")),
        ("estimator", fit.estimator),
        *fit.facts[:-1],
    ]
    about = robot.summary()
    gravity = ", ".join(f"{x:g}" for x in np.asarray(robot.gravity))
    assumed = ", ".join(robot.limits.assumed) or "nothing"
    facts = [*about.facts, ("gravity [m/s²]", gravity), ("assumed", assumed)]
    notes = [Remark(note) for note in report.every_note]
    yield (
        "Task and notes",
        [Table("", facts=[f for f in task if f[1] is not None]), notes],
    )
    yield (
        "Robot and drives",
        [Table("", *about.columns, facts=facts), *motor_tables(robot)],
    )
    text = (
        "Predicted less measured forces. Bars: the mean of their absolute values (Eq. "
        "37, Fig. 10 "
        "of the paper); points: their RMS. The offset is the mean error, which a "
        "constant of the "
        "log explains; RMS values at rest and in motion are about it."
    )
    tables = tuple(error_table(e, robot) for e in report.every_error)
    yield "Torque errors", [text, figures["errors"], tables]
    if fit.consistency is not None:
        yield "Bodies", [body_table(fit.consistency, robot.joint_names)]
    if fit.residual_spectra is not None:
        text = (
            "The residuals of a good model are noise. Power at low frequencies, or "
            "residuals that "
            "resemble their neighbours more than the filters explain (dashed), mean "
            "that an effect "
            "is missing."
        )
        shown = [figures["residuals"], figures["autocorrelation"]]
        yield "Residuals", [text, *shown, residual_table(fit.residual_spectra, robot)]
    if "filter" in figures:
        yield "Choice of the filter", [figures["filter"]]


def parameter_table(fit: Fit) -> Table:
    """Return the base parameters in words, with their 95 % intervals."""
    base, (low, high) = fit.base, fit.intervals().T
    values, deviations = with_deviations(fit.parameters, fit.standard_deviations)
    low, high = (
        with_deviations(ends, fit.standard_deviations)[0] for ends in (low, high)
    )
    return Table(
        "",
        Column("#", list(range(1, base.size + 1))),
        Column("parameter", base.names),
        *word_columns(base),
        Column("estimate", values, kind="number"),
        Column("±", deviations, kind="number"),
        Column("unit", base.units),
        Column("95 %\nfrom", low, kind="number"),
        Column("95 %\nto", high, kind="number"),
        Column("±", fit.relative_standard_deviations, "%", percent),
        Column("combination", base.expressions, kind="code"),
        status=fit.trust,
    )


def motor_tables(robot: Robot) -> list[Table]:
    """Return the motors of a robot, if it has gears or couplings: their joints and properties."""
    drives = robot.drives
    A = np.asarray(robot.drives.reduction)
    if drives.is_direct:
        return []
    turns = [
        " + ".join(f"{row[j]:.6g} {robot.joint_names[j]}" for j in np.flatnonzero(row))
        for row in A
    ]
    columns = [
        Column("joint at\nmotor zero", np.asarray(drives.zero), "rad or m"),
        Column("largest\ntorque", np.asarray(drives.max_torques), "N m"),
        Column("rotor\ninertia", np.asarray(drives.rotor_inertia), "kg m²"),
    ]
    known = (c for c in columns if np.isfinite(c.values).any() and np.any(c.values))
    numbers = Column("motor", list(range(1, robot.joints + 1)))
    return [Table("motors", numbers, Column("turns", turns), *known)]


def error_table(errors: TorqueErrors, robot: Robot) -> Table:
    """Return the torque errors of one recording, joint by joint (Eq. 37)."""
    return Table(
        f"{errors.name}: relative error {percent(errors.relative)} %",
        Column("joint", robot.joint_names),
        Column("unit", [robot.force_unit(j) for j in range(robot.joints)]),
        Column("mean |e|", errors.mean),
        Column("RMS", errors.rms),
        Column("mean", errors.mean_percent, "% of max"),
        Column("RMS", errors.rms_percent, "% of max"),
        Column("RMS", 100 * errors.rms_relative, "% of RMS force"),
        Column("offset", errors.offset),
        Column("RMS at\nrest", errors.rms_at_rest),
        Column("RMS in\nmotion", errors.rms_in_motion),
    )


def residual_table(spectra: ResidualSpectra, robot: Robot) -> Table:
    """Return whether the residuals of each joint are white, and where their power lies."""
    return Table(
        "residuals within the filters' band; white: departure below "
        f"{percent(spectra.limit)} %",
        Column("joint", robot.joint_names),
        Column("white", ["yes" if white else "no" for white in spectra.white]),
        Column("departure", spectra.departure, "%", percent),
        Column(
            f"power below {0.1 * spectra.band:.2g} Hz\n(white: 10 %)",
            spectra.low_frequency,
            "%",
            percent,
        ),
        status=[Status.GOOD if white else Status.DOUBTFUL for white in spectra.white],
    )


def body_table(consistency: Consistency, names: Sequence[str]) -> Table:
    """Return mass, centre of mass and margin of each body, and the effect of the bounds."""
    mass = np.asarray(consistency.bodies)[:, 0]
    bounded = consistency.masses_from_bounds
    centre = np.asarray(consistency.bodies)[:, 1:4] / mass[:, None]
    axes = [
        Column(f"{axis} of\ncentre", centre[:, k], "m", lambda x: significant(x, 2))
        for k, axis in enumerate("xyz")
    ]
    price = f"{100 * consistency.residual_increase:.2g}"
    proof = (
        f"within {consistency.error_bound:.1e} of it, {consistency.iterations} "
        "iterations"
    )
    loose = [k in bounded for k in range(len(names))]
    return Table(
        "physically consistent bodies",
        Column("body of joint", names),
        Column("mass", mass, "kg"),
        *axes,
        Column("margin", consistency.margins, "%", percent),
        Column("mass follows from", ["bounds too" if x else "forces" for x in loose]),
        status=[Status.DOUBTFUL if x else Status.GOOD for x in loose],
        facts=[
            ("price", f"{price} % larger weighted residuals than without bounds"),
            ("optimum", proof),
            ("active bounds", "; ".join(consistency.active) or "none"),
        ],
    )

"""Page of an identification: verdict, task, estimates, errors; and the tables of its results."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from jaxid.identification.consistency.estimator import Consistency
from jaxid.identification.fit_result import Fit
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.model_validation import TorqueErrors
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

from .page import provenance, render_page
from .verdict import Report, verdict


def identification_page(report: Report, figures: Mapping[str, Figure], suffix: str = "svg") -> str:
    """Return the page of an identification as HTML; figures have files with this suffix."""
    fit, settings = report.fit, report.settings
    base, robot = fit.base, fit.base.model.robot
    overall, *criteria = verdict(report)
    notes = [Remark(note) for note in report.every_note]
    errors = (*report.identification, *report.verification)
    lengths = ", ".join(f"{name} = {value:.4g}" for name, value in base.lengths.items())
    task = [
        ("experiment", settings.get("experiment")),
        ("identified with", ", ".join(settings.get("identification", ())) or None),
        ("verified with", ", ".join(settings.get("verification", ())) or None),
        *((key, settings.get(key)) for key in ("split", "filter", "decimation")),
        ("estimator", fit.estimator),
        ("solution", fit.solution),
        *fit.facts[:-1],
    ]
    # 42 panels at most; the files of the others are named.
    names = [name for name in figures if name.startswith("torque_")]
    shown = max(1, 42 // robot.joints)
    blocks: list[Figure | str] = [figures[name] for name in names[:shown]]
    if others := ", ".join(f"{name}.{suffix}" for name in names[shown:]):
        blocks.append(f"Figures of more recordings lie beside this page: {others}.")
    about = robot.summary()
    gravity = ", ".join(f"{x:g}" for x in np.asarray(robot.gravity))
    assumed = ", ".join(robot.limits.assumed) or "nothing"
    facts = [*about.facts, ("gravity [m/s²]", gravity), ("assumed", assumed)]
    sections = [
        ("Verdict", [overall, criteria]),
        ("Task", [Table("", facts=[fact for fact in task if fact[1] is not None]), notes]),
        ("Robot and drives", [Table("", *about.columns, facts=facts), *motor_tables(robot)]),
        (
            "Errors",
            [
                "Predicted less measured forces. Bars: the mean of their absolute values (Eq. 37, "
                "Fig. 10 of the paper); marks: their RMS. In the tables, the offset is the mean "
                "error, which a constant of the log explains; RMS values at rest and in motion are "
                "those about it.",
                figures["errors"],
                tuple(error_table(e, robot) for e in errors),
            ],
        ),
        ("Measured and predicted forces", blocks),
        (
            f"{base.size} base parameters",
            [
                *([fit.determination] if fit.undetermined else []),
                figures["parameters"],
                parameter_table(fit),
                *([f"In the combinations: {lengths} (m; m/s² for g)."] if lengths else []),
            ],
        ),
    ]
    if fit.consistency is not None:
        sections.append(("Bodies", [body_table(fit.consistency, robot.joint_names)]))
    if fit.residual_spectra is not None:
        text = (
            "The residuals of a good model are noise. Power at low frequencies, or residuals that "
            "resemble their neighbours more than the filters explain (dashed), mean that an effect "
            "is missing."
        )
        shown = [figures["residuals"], figures["autocorrelation"]]
        sections.append(("Residuals", [text, *shown, residual_table(fit.residual_spectra, robot)]))
    if "filter" in figures:
        sections.append(("Choice of the filter", [figures["filter"]]))
    logs = f"{len(fit.recordings)} log{'' if len(fit.recordings) == 1 else 's'}"
    return render_page(
        f"{robot.name}: identified parameters",
        [*sections, provenance(settings)],
        f"{base.size} base parameters of {robot.joints} joints, from {logs}.",
        "All numbers: result.json and parameters.csv beside this page.",
    )


def parameter_table(fit: Fit) -> Table:
    """Return the base parameters with their 95 % intervals."""
    base, (low, high) = fit.base, fit.intervals().T
    values, deviations = with_deviations(fit.parameters, fit.standard_deviations)
    low, high = (with_deviations(ends, fit.standard_deviations)[0] for ends in (low, high))
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
        " + ".join(f"{row[j]:.6g} {robot.joint_names[j]}" for j in np.flatnonzero(row)) for row in A
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
        f"residuals within the filters' band; white: departure below {percent(spectra.limit)} %",
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
    proof = f"within {consistency.error_bound:.1e} of it, {consistency.iterations} iterations"
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

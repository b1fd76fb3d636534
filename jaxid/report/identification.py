"""Page of an identification: verdict, task, estimates, errors; and the tables of its results."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxid.identification.consistency.estimator import Consistency
from jaxid.identification.estimators.regularisation_and_weights import LARGEST_UNCERTAINTY
from jaxid.identification.filter_and_parameter_selection import FilterChoice
from jaxid.identification.fit_result import Fit
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.model_validation import Definiteness, TorqueErrors
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

MEAN_ERROR = (1.0, 3.0)
"""Mean errors up to which forces are predicted well, and tolerably [% of the largest forces]."""
RMS_ERROR = (5.0, 15.0)
"""RMS errors that are good, and tolerable [% of the RMS forces]."""
UNSEEN_RATIO = (1.5, 3.0)
"""Errors on new motions, relative to those of the fit, that are good, and tolerable."""
LARGE_CONDITION = 1e3
"""Condition number, with scaled columns, above which parameters are hard to tell apart."""


@dataclasses.dataclass(frozen=True, eq=False)
class Report:
    """Content of the report of an identification.

    Attributes:
        fit: Identified parameters.
        identification: Errors on the logs of the fit.
        verification: Errors on logs that the fit has not seen.
        definiteness: Definiteness of the mass matrix.
        settings: Origin of the result.
        notes: Notes on the logs, as sentences.
        doubts: Findings that deserve attention, as sentences.
        choice: Choice of the filter, where it was left to the logs.
    """

    fit: Fit
    identification: Sequence[TorqueErrors]
    verification: Sequence[TorqueErrors]
    definiteness: Definiteness
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    notes: Sequence[str] = ()
    doubts: Sequence[str] = ()
    choice: FilterChoice | None = None

    @property
    def every_note(self) -> tuple[str, ...]:
        """Notes on the robot, the fit and the logs, each once."""
        fit = self.fit
        return tuple(dict.fromkeys((*fit.base.model.robot.notes, *fit.notes, *self.notes)))


def identification_page(report: Report, figures: Mapping[str, Figure]) -> str:
    """Return the page of an identification as HTML."""
    fit, settings = report.fit, report.settings
    base, robot = fit.base, fit.base.model.robot
    overall, *criteria = verdict(report)
    notes = [Remark(note) for note in report.every_note if note not in report.doubts]
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
    if others := ", ".join(f"{name}.png" for name in names[shown:]):
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
                "Fig. 10 of the paper); marks: their RMS.",
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


def verdict(report: Report) -> list[Remark]:
    """Return the verdict on a model: one sentence for everything, then one for each criterion."""
    fit, definiteness = report.fit, report.definiteness
    condition = fit.condition_numbers.scaled
    eigenvalue = significant(definiteness.smallest)
    bodies = []
    if fit.consistency is not None:
        active = "; ".join(fit.consistency.active) or "none"
        bodies = [Remark(f"All bodies are physically consistent; active bounds: {active}")]
    found = [
        _judge_forces(report.verification or report.identification, bool(report.verification)),
        *_judge_new_motions(report.identification, report.verification),
        dataclasses.replace(
            fit.determination[0],
            detail="A combination counts as undetermined if it leaves more than "
            f"{100 * LARGEST_UNCERTAINTY:g} % of the whole forces open.",
        ),
        Remark(
            f"Estimates: {dict(fit.facts)['estimates']}",
            detail="Standard deviation over estimate. A parameter near zero is never known to a "
            "few percent, and that is no fault: look at its interval.",
        ),
        Remark(
            str(definiteness),
            Status.GOOD if definiteness.positive_definite else Status.BAD,
            f"Smallest eigenvalue over random poses: {eigenvalue} in SI units (Sec. 5). If it is "
            "negative, do not simulate or control with this model where joints were not moved.",
        ),
        *_judge_residuals(fit),
        Remark(
            f"The condition number with columns of length one is {significant(condition, 3)}.",
            Status.GOOD if condition < LARGE_CONDITION else Status.DOUBTFUL,
            f"Good: below {LARGE_CONDITION:g}. Above, some parameters are hard to tell apart.",
        ),
        *bodies,
        *(
            Remark(text[:1].upper() + text[1:], Status.DOUBTFUL)
            for text in dict.fromkeys(report.doubts)
        ),
    ]
    statuses = [remark.status for remark in found]
    if Status.BAD in statuses:
        whole = Remark("Do not rely on this model yet: what is marked ✗ comes first.", Status.BAD)
    elif Status.DOUBTFUL in statuses:
        text = "A usable model; look at what is marked ! before you rely on it."
        whole = Remark(text, Status.DOUBTFUL)
    else:
        whole = Remark("A good model: all criteria below are met.", Status.GOOD)
    return [whole, *found]


def _judge_forces(recordings: Sequence[TorqueErrors], unseen: bool) -> Remark:
    on = "logs that the fit has not seen" if unseen else "the logs of the fit"
    average = max(float(np.mean(e.mean_percent)) for e in recordings)
    if np.isfinite(average):
        worst = max(float(np.max(e.mean_percent)) for e in recordings)
        return Remark(
            f"On {on}, forces are predicted to {significant(average, 2)} % of the largest forces, "
            f"averaged over the joints; the worst joint to {significant(worst, 2)} %.",
            *_grade(average, MEAN_ERROR, "%", "Mean |e| (Eq. 37); the paper states below 1 %."),
        )
    worst = 100 * max(float(np.nanmean(e.rms_relative)) for e in recordings)
    text = f"the RMS error is {significant(worst, 2)} % of the RMS force, averaged over the joints."
    return Remark(
        f"On {on}, {text}",
        *_grade(worst, RMS_ERROR, "%", "The largest forces of the joints are not known."),
    )


def _grade(
    value: float,
    limits: tuple[float, float],
    unit: str,
    more: str,
) -> tuple[Status, str]:
    """Return whether a value is good, tolerable or bad, and the limits in words."""
    good, tolerable = limits
    status = Status.GOOD if value <= good else Status.DOUBTFUL if value <= tolerable else Status.BAD
    return status, f"Good: up to {good:g} {unit}; tolerable: up to {tolerable:g} {unit}. {more}"


def _judge_new_motions(
    identification: Sequence[TorqueErrors], verification: Sequence[TorqueErrors]
) -> list[Remark]:
    if not verification:
        text = "The model was not validated on an unseen log: use `--verify` or `--split`."
        return [Remark(text, Status.DOUBTFUL)]
    if not identification:
        return []
    # Joint by joint, so that large joints do not hide small ones.
    fitted, unseen = (
        np.sqrt(np.mean([np.asarray(e.rms) ** 2 for e in group], axis=0))
        for group in (identification, verification)
    )
    ratio = float(np.fmax.reduce(unseen / np.where(fitted > 0, fitted, np.nan)))
    ratio = ratio if np.isfinite(ratio) else 1.0
    text = f"RMS errors on unseen logs are up to {significant(ratio, 3)} times those of the fit."
    more = "More means that the new motion needs what the fit's logs did not show."
    return [Remark(text, *_grade(ratio, UNSEEN_RATIO, "times", more))]


def _judge_residuals(fit: Fit) -> list[Remark]:
    spectra = fit.residual_spectra
    if spectra is None:
        return []
    joints, white = len(spectra.white), sum(spectra.white)
    rule = (
        f"Bartlett's test: the cumulative spectrum of white residuals departs from a straight "
        f"line by less than {percent(spectra.limit)} % in 95 % of cases. The intervals account "
        "for correlated residuals."
    )
    nearly = float(np.max(np.asarray(spectra.departure))) <= 2.0 * spectra.limit
    status = Status.NEUTRAL if nearly else Status.DOUBTFUL
    doubt = ""
    if white == joints:
        status = Status.GOOD
    elif not nearly:
        doubt = ": some effect is not in the model, or the noise itself is coloured"
    text = f"The residuals are white noise for {white} of {joints} joints{doubt}"
    return [Remark(text, status, rule)]

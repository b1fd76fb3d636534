"""Tables of results for people: robot, parameters, residuals, errors, bodies, comparisons."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxid.dynamics.base import BaseParameters, Identifiability
from jaxid.identification.consistency.estimator import Consistency
from jaxid.identification.estimators import AbstractSpectralSolution
from jaxid.identification.fit import DOUBTFUL, TRUSTED, Fit, Trust
from jaxid.identification.identifiability import LARGEST_UNCERTAINTY
from jaxid.identification.runs.comparison import LEVEL, Comparison, Verdict
from jaxid.identification.runs.estimates import Estimates
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.report.torques import require_joints
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
from jaxid.validation import TorqueErrors

TRUST = {Trust.GOOD: Status.GOOD, Trust.DOUBTFUL: Status.DOUBTFUL, Trust.NONE: Status.BAD}


def robot_table(robot: Robot) -> Table:
    """Return the joints of a robot with what is known of their limits; dashes where it is not."""
    limits = robot.limits

    def known(values: np.ndarray) -> np.ndarray:
        return np.where(np.isfinite(values), values, np.nan)

    remarks = [*robot.notes]
    if limits.assumed:
        remarks.append(f"assumed: {', '.join(limits.assumed)}")
    if robot.tool is not None:
        where = robot.joint_names[robot.tool.body]
        remarks.append(f"a known load of {float(robot.tool.mass):g} kg on the body of `{where}`")
    joints = range(robot.joints)
    return Table(
        f"{robot.name}: {robot.joints} joints",
        Column("joint", robot.joint_names),
        Column("moves", ["turns" if revolute else "slides" for revolute in robot.revolute]),
        Column("from", known(limits.position_min)),
        Column("to", known(limits.position_max)),
        Column("speed", known(limits.velocity), "unit/s"),
        Column("acceleration", known(limits.acceleration), "unit/s²"),
        Column("largest\nforce", known(robot.known_max_forces)),
        Column("unit", [robot.joint_unit(j) for j in joints]),
        Column("force\nunit", [robot.force_unit(j) for j in joints]),
        remarks=remarks,
    )


def motor_table(robot: Robot) -> Table:
    """Return the motors of a robot: the joints that they turn, and their known properties."""
    drives = robot.drives
    A = np.asarray(drives.reduction)
    turns = [
        " + ".join(f"{row[j]:.6g} {robot.joint_names[j]}" for j in np.flatnonzero(row)) for row in A
    ]
    columns = [
        Column("joint at\nmotor zero", np.asarray(drives.zero), "rad or m"),
        Column("largest\ntorque", np.asarray(drives.max_torques), "N m"),
        Column("rotor\ninertia", np.asarray(drives.rotor_inertia), "kg m²"),
    ]
    return Table(
        "motors",
        Column("motor", list(range(1, robot.joints + 1))),
        Column("turns", turns),
        *(c for c in columns if np.isfinite(c.values).any() and np.any(c.values)),
    )


def base_table(base: BaseParameters) -> Table:
    """Return the base parameters in letters, and the identifiability of standard parameters."""
    names = base.model.parameter_names
    facts = []
    for kind in (Identifiability.ALONE, Identifiability.COMBINED, Identifiability.NONE):
        found = [n for n, v in zip(names, base.identifiability, strict=True) if v is kind]
        facts.append((f"{kind.value} ({len(found)})", ", ".join(found) or MISSING))
    remarks = [Remark(note, Status.DOUBTFUL) for note in base.notes]
    return Table(
        f"{base.size} base parameters of {base.model.size} standard parameters",
        Column("#", list(range(1, base.size + 1))),
        Column("combination that the forces determine", base.expressions, kind="code"),
        Column("unit", base.units),
        facts=facts,
        remarks=[*([lengths_sentence(base)] if base.lengths else []), *remarks],
    )


def lengths_sentence(base: BaseParameters) -> str:
    """Return the values of the lengths in the combinations, as a sentence."""
    values = (
        f"{name} = {significant(value, 4)} {'m/s²' if name == 'g' else 'm'}"
        for name, value in base.lengths.items()
    )
    return f"In the combinations: {', '.join(values)}."


def parameter_table(fit: Fit) -> Table:
    """Return the estimates with their standard deviations, and how well they are determined.

    Estimates stand with the digits that their standard deviations leave meaningful. Beside them
    stand the standard deviations that independent rows would have, and the ratio to these.

    Args:
        fit: Identified parameters.
    """
    base, trust = fit.base, fit.trust
    values, deviations = with_deviations(fit.parameters, fit.standard_deviations)
    columns = [
        Column("#", list(range(1, base.size + 1))),
        Column("parameter", base.expressions, kind="code"),
        Column("estimate", values, kind="number"),
        Column("±", deviations, kind="number"),
        Column("unit", base.units),
        Column("±", fit.relative_standard_deviations, "%", percent),
    ]
    ratios = fit.uncertainty.ratios
    finite = ratios[np.isfinite(ratios)]
    remarks = [*determination_remarks(fit)]
    if np.any(np.abs(finite - 1.0) > 1e-9):
        columns += [
            Column("naive ±", fit.naive_standard_deviations, format=lambda x: significant(x, 2)),
            Column("ratio", ratios, format=lambda x: significant(x, 2)),
        ]
        remarks.append(
            Remark(
                f"Standard deviations are {significant(float(np.median(finite)), 2)} times "
                "(median) those of independent rows, because errors of neighbouring rows are "
                "correlated."
            )
        )
    return Table(
        f"{base.model.robot.name}: {base.size} base parameters",
        *columns,
        facts=fit_facts(fit),
        status=[TRUST[level] for level in trust],
        remarks=remarks,
    )


def fit_facts(fit: Fit) -> list[tuple[str, str]]:
    """Return rows, condition numbers and residual of a fit, each with its word."""
    rows, numbers, trust = fit.rows, fit.condition_numbers, fit.trust
    good, fair, poor = (trust.count(level) for level in (Trust.GOOD, Trust.DOUBTFUL, Trust.NONE))
    return [
        ("rows per joint", str(rows[0]) if len(set(rows)) == 1 else f"{min(rows)} to {max(rows)}"),
        (
            "condition number",
            f"{significant(numbers.raw, 4)} in SI units, {significant(numbers.weighted, 4)} "
            f"weighted, {significant(numbers.scaled, 4)} weighted with columns of length one",
        ),
        ("residual", f"{percent(fit.residual, 3)} % of the forces (norms of all rows)"),
        (
            "estimates",
            f"{good} of {fit.base.size} known to {100 * TRUSTED:g} %, {fair} to "
            f"{100 * DOUBTFUL:g} %, {poor} worse or undetermined",
        ),
    ]


def determination_remarks(fit: Fit) -> list[Remark]:
    """Return the combinations that the logs do not determine, and what to do about them."""
    base = fit.base
    if not fit.undetermined:
        return [Remark(f"These logs determine all {base.size} base parameters.", Status.GOOD)]
    count = len(fit.undetermined)
    headline = (
        f"NOT DETERMINED by these logs: {count} combination{'' if count == 1 else 's'} of the "
        f"{base.size} base parameters."
    )
    remarks = [Remark(headline, Status.BAD)]
    for direction in fit.undetermined:
        moved = np.isfinite(direction.uncertainty)
        open_part = f"leaves {percent(direction.uncertainty)} % of the forces open"
        remarks.append(
            Remark(
                f"{direction.sentence(base)}.",
                Status.BAD,
                f"{open_part if moved else 'not moved at all'}; singular value "
                f"{direction.singular_value:.1e} of the largest",
            )
        )
    advice = (
        "A combination counts as not determined if it leaves more than "
        f"{100 * LARGEST_UNCERTAINTY:g} % of the whole forces open. Estimates of these parameters "
        "mean nothing one by one, and the model may fail on other motions. Record a motion that "
        "moves these joints in more poses, faster and in both directions, or leave effects out in "
        '`[model]`; `ridge = "cross_validated"` in `[estimator]` keeps small what they leave open.'
    )
    return [*remarks, Remark(advice)]


def residual_table(spectra: ResidualSpectra, robot: Robot) -> Table:
    """Return whether the residuals of each joint are white, and where their power lies.

    Args:
        spectra: Spectra of the residuals of a fit.
        robot: Robot of the fit.
    """
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


def error_table(errors: TorqueErrors, robot: Robot) -> Table:
    """Return the torque errors of one recording, joint by joint (Eq. 37).

    Columns whose largest forces are not known hold dashes.

    Args:
        errors: Errors on the recording.
        robot: Robot of the recording.

    Raises:
        InputError: If the numbers of joints differ.
    """
    require_joints(errors, robot)
    n = robot.joints
    average = float(np.mean(errors.mean_percent))
    averaged = n > 1 and np.isfinite(average)

    def column(name: str, values: np.ndarray, unit: str = "", digits: int = 3) -> Column:
        last = [significant(average)] if values is errors_percent else [""]
        texts = [significant(float(x), digits) for x in values]
        return Column(name, texts + (last if averaged else []), unit, kind="number")

    errors_percent = errors.mean_percent
    return Table(
        f"{errors.name}: relative error {percent(errors.relative)} %",
        Column("joint", [*robot.joint_names, *(["average"] if averaged else [])]),
        Column("unit", [robot.force_unit(j) for j in range(n)] + ([""] if averaged else [])),
        column("mean |e|", errors.mean),
        column("RMS", errors.rms),
        column("mean", errors_percent, "% of max"),
        column("RMS", errors.rms_percent, "% of max"),
        column("RMS", 100 * errors.rms_relative, "% of RMS force"),
        rules=[n] if averaged else (),
    )


def body_table(consistency: Consistency, names: tuple[str, ...]) -> Table:
    """Return mass, centre of mass and margin of each body, and the effect of the bounds.

    Args:
        consistency: Properties of a physically consistent estimate.
        names: Names of the joints that move the bodies.
    """
    bodies = np.asarray(consistency.bodies)
    mass, loose = bodies[:, 0], consistency.masses_from_bounds
    centre = bodies[:, 1:4] / mass[:, None]
    axes = [
        Column(f"{axis} of\ncentre", centre[:, k], "m", lambda x: significant(x, 2))
        for k, axis in enumerate("xyz")
    ]
    price = f"{100 * consistency.residual_increase:.2g}"
    proof = f"within {consistency.error_bound:.1e} of it, {consistency.iterations} iterations"
    return Table(
        "physically consistent bodies",
        Column("body of joint", names),
        Column("mass", mass, "kg"),
        *axes,
        Column("margin", consistency.margins, "%", percent),
        Column(
            "mass follows from",
            ["bounds too" if k in loose else "forces" for k in range(len(names))],
        ),
        status=[Status.DOUBTFUL if k in loose else Status.GOOD for k in range(len(names))],
        facts=[
            (
                "price",
                f"{price} % larger weighted residuals than without bounds",
            ),
            ("optimum", proof),
            ("active bounds", "; ".join(consistency.active) or "none"),
        ],
    )


def comparison_table(comparison: Comparison) -> Table:
    """Return every parameter in both fits, the difference with its interval, a verdict (Sec. 6).

    Args:
        comparison: Comparison of two fits.
    """
    first, second, verdicts = comparison.first, comparison.second, comparison.verdicts
    half = comparison.half_widths
    a, _ = with_deviations(first.parameters, half)
    b, _ = with_deviations(second.parameters, half)
    change, _ = with_deviations(comparison.difference, half)
    _, width = with_deviations(np.zeros(len(half)), half)
    groups, level = first.groups, comparison.level
    tested = len(verdicts) - verdicts.count(Verdict.UNKNOWN)
    return Table(
        f"{first.label} and {second.label}: {len(first.names)} base parameters",
        Column("#", list(range(1, len(half) + 1))),
        Column("parameter", first.names),
        Column("unit", first.units),
        Column(first.label, a, kind="number"),
        Column(second.label, b, kind="number"),
        Column("difference", [x if x.startswith("-") else f"+{x}" for x in change], kind="number"),
        Column(f"± ({100 * level:g} %)", width, kind="number"),
        Column("verdict", [verdict.value for verdict in verdicts]),
        status=[Status.DOUBTFUL if v is Verdict.CHANGED else Status.NEUTRAL for v in verdicts],
        rules=[k for k in range(1, len(groups)) if groups[k] != groups[k - 1]],
        remarks=[
            f"{verdicts.count(Verdict.CHANGED)} of {tested} parameters have changed: if none had, "
            f"the chance to call any of them so would be {100 * (1 - level):.3g} % at most (Holm)",
            f"{verdicts.count(Verdict.PERHAPS)} more have perhaps changed: zero lies outside the "
            f"{100 * level:g} % interval of their difference; of {tested} parameters that never "
            f"change, about {(1 - level) * tested:.2g} look so",
        ],
    )


def group_table(comparison: Comparison) -> Table:
    """Return the joint test of each kind of parameter.

    Args:
        comparison: Comparison of two fits.
    """
    groups = comparison.groups
    verdicts = [Verdict.CHANGED if g.changed else Verdict.UNCHANGED for g in groups]
    chances = ["< 1e-6" if g.p_value < 1e-6 else significant(g.p_value, 2) for g in groups]
    return Table(
        "all parameters of a kind at once",
        Column("kind", [g.name for g in groups]),
        Column("parameters", [g.size for g in groups]),
        Column("statistic", [float(g.statistic) for g in groups]),
        Column("chance\nwithout a change", chances, kind="number"),
        Column("verdict", [v.value for v in verdicts]),
        status=[Status.DOUBTFUL if g.changed else Status.NEUTRAL for g in groups],
    )


def estimate_table(
    estimates: Estimates, title: str = "", level: float = LEVEL, remarks: Iterable[Remark] = ()
) -> Table:
    """Return estimates with the digits that their intervals leave meaningful.

    Args:
        estimates: Estimated parameters.
        title: Title of the table.
        level: Confidence of the intervals (0 to 1).
        remarks: Remarks below the table.
    """
    values, halves = with_deviations(estimates.parameters, estimates.half_widths(level))
    return Table(
        title,
        Column("parameter", estimates.names),
        Column("estimate", values, kind="number"),
        Column(f"± ({100 * level:g} %)", halves, kind="number"),
        Column("unit", estimates.units),
        remarks=remarks,
    )


def alternative_table(
    errors: Sequence[TorqueErrors], others: Sequence[TorqueErrors], names: tuple[str, str]
) -> Table:
    """Return the errors of a fit beside those of another solution of the same equations.

    Args:
        errors: Errors of the fit, one for each recording.
        others: Errors of the other solution on the same recordings.
        names: Names of both solutions.
    """

    def mean(group: Sequence[TorqueErrors]) -> list[float]:
        return [float(np.mean(e.rms_relative)) for e in group]

    return Table(
        "solved otherwise: RMS error in percent of the RMS force, mean of the joints",
        Column("recording", [e.name for e in errors]),
        Column(f"this fit ({names[0]})", mean(errors), "%", percent),
        Column(names[1], mean(others), "%", percent),
    )


def solution_name(solution: AbstractSpectralSolution) -> str:
    """Return a solution in words, such as `ridge 0.01`."""
    strength = getattr(solution, "strength", getattr(solution, "rcond", None))
    if strength is None:
        return "plain least squares"
    return f"{type(solution).__name__.lower()} {strength:.2g}"


def log_table(log: Any, robot: Robot, check: Any, doubts: Iterable[str]) -> Table:
    """Return the ranges, speeds and forces of a log beside the robot's limits, and all doubts.

    Args:
        log: Recording or log on disk.
        robot: Robot of the log.
        check: Ranges, speeds and forces of the log, and warnings.
        doubts: Further doubts about the log, in sentences.
    """
    limits, gaps = robot.limits, len(log.segments) - 1
    joints = range(robot.joints)

    def beside(values: np.ndarray, limits: np.ndarray) -> list[str]:
        return [
            f"{significant(float(v))} ({_limit(x)})" for v, x in zip(values, limits, strict=True)
        ]

    return Table(
        f"log {log.name} (limits of the robot in brackets)",
        Column("joint", robot.joint_names),
        Column("from", beside(check.lowest, limits.position_min), kind="number"),
        Column("to", beside(check.highest, limits.position_max), kind="number"),
        Column("speed", beside(check.speed, limits.velocity), "unit/s", kind="number"),
        Column("force", beside(check.force, robot.known_max_forces), kind="number"),
        Column("at rest", check.standing, "%", lambda x: f"{100 * x:.0f}"),
        Column("unit", [robot.joint_unit(j) for j in joints]),
        Column("force\nunit", [robot.force_unit(j) for j in joints]),
        facts=[
            ("samples", f"{log.samples} at {significant(1 / log.sample_time, 4)} Hz"),
            ("duration", f"{significant(log.duration, 4)} s"),
            ("gaps", "none" if gaps == 0 else str(gaps)),
        ],
        remarks=[
            *log.notes,
            *(Remark(text, Status.DOUBTFUL) for text in dict.fromkeys((*check.warnings, *doubts))),
        ],
    )


def _limit(value: float) -> str:
    return significant(float(value)) if np.isfinite(value) else MISSING


def robot_tables(robot: Robot) -> list[Table]:
    """Return the tables of a robot's joints and, where it has gears or couplings, its motors."""
    return [robot_table(robot), *([] if robot.drives.is_direct else [motor_table(robot)])]

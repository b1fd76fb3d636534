"""Tables of results for people: robot, parameters, residuals, errors, bodies, comparisons."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxid.arrays import AnyArray
from jaxid.diagnosis import Diagnosis
from jaxid.dynamics.base import BaseParameters, Identifiability
from jaxid.identification.consistency.estimator import Consistency
from jaxid.identification.estimators import AbstractSpectralSolution
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
)
from jaxid.validation import TorqueErrors


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


def log_table(log: Any, diagnosis: Diagnosis, doubts: Iterable[str]) -> Table:
    """Return the ranges, speeds and forces of a log beside the robot's limits, and all doubts.

    Args:
        log: Recording or log on disk.
        diagnosis: Diagnosis of the log.
        doubts: Further doubts about the log, in sentences.
    """
    robot, check = diagnosis.robot, diagnosis.statistics
    limits, gaps = robot.limits, len(log.segments) - 1
    joints = range(robot.joints)

    def beside(values: np.ndarray, limits: AnyArray) -> list[str]:
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
            *(
                Remark(text, Status.DOUBTFUL)
                for text in dict.fromkeys((*diagnosis.findings, *doubts))
            ),
        ],
    )


def _limit(value: float) -> str:
    return significant(float(value)) if np.isfinite(value) else MISSING


def motor_tables(robot: Robot) -> list[Table]:
    """Return the table of a robot's motors, if it has gears or couplings."""
    return [] if robot.drives.is_direct else [motor_table(robot)]

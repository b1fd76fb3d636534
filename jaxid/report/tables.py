"""Tables for the terminal: joints, errors and parameters, with units and aligned numbers."""

import numpy as np
from rich.table import Table
from rich.text import Text

from jaxid.identification.fit import Fit, Trust
from jaxid.identification.uncertainty.residuals import ResidualSpectra
from jaxid.report.numbers import aligned, percent, significant, with_deviation
from jaxid.report.torques import require_joints
from jaxid.robot.robot import Robot
from jaxid.validation import TorqueErrors

STYLES = {Trust.GOOD: "green", Trust.DOUBTFUL: "yellow", Trust.NONE: "red"}


def parameter_table(fit: Fit, expressions: bool = True) -> Table:
    """The base parameters with their estimates and standard deviations, in the paper's order.

    Estimates stand with the digits that their standard deviations leave meaningful. Beside them
    stand the standard deviations that independent rows would have, and the ratio to these.

    Args:
        fit: The estimates.
        expressions: Whether combinations are written out in letters; otherwise the name of the
            parameter that leads each stands alone.
    """
    base = fit.base
    pairs = [
        with_deviation(float(p), float(s))
        for p, s in zip(fit.parameters, fit.standard_deviations, strict=True)
    ]
    values, deviations = (aligned(column) for column in zip(*pairs, strict=True))
    relative = np.asarray(fit.relative_standard_deviations)
    shares = aligned([percent(float(r)) for r in relative])
    table = plain_table(f"{base.model.robot.name}: {base.size} base parameters")
    table.add_column("#", justify="right", style="dim")
    table.add_column("parameter", overflow="fold")
    table.add_column("estimate", justify="right", no_wrap=True)
    table.add_column("±", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("± [%]", justify="right", no_wrap=True)
    ratios = fit.uncertainty.ratios
    differ = bool(np.any(np.abs(ratios[np.isfinite(ratios)] - 1.0) > 1e-9))
    naive = aligned([significant(float(s), 2) for s in fit.naive_standard_deviations])
    ratio = aligned([significant(float(x), 2) for x in ratios])
    if differ:
        table.add_column("naive ±", justify="right", no_wrap=True, style="dim")
        table.add_column("ratio", justify="right", no_wrap=True, style="dim")
    trust = fit.trust
    names = base.expressions if expressions else base.names
    for k, name in enumerate(names):
        table.add_row(
            str(k + 1),
            Text(name),
            values[k],
            deviations[k],
            base.units[k],
            Text(shares[k], style=STYLES[trust[k]]),
            *((naive[k], ratio[k]) if differ else ()),
        )
    return table


def residual_table(spectra: ResidualSpectra, robot: Robot) -> Table:
    """Whether the residuals of each joint are white, and where their power lies.

    Args:
        spectra: Of a fit.
        robot: Whose joints they are.
    """
    table = plain_table("residuals within the filters' band")
    table.add_column("joint")
    table.add_column("white")
    table.add_column(Text("departure [%]\n(white: below)"), justify="right", no_wrap=True)
    slow = Text(f"power below {0.1 * spectra.band:.2g} Hz\n[%] (white: 10)")
    table.add_column(slow, justify="right", no_wrap=True)
    limit = percent(spectra.limit, 2)
    for j, white in enumerate(spectra.white):
        table.add_row(
            Text(robot.joint_names[j]),
            Text("yes" if white else "no", style="green" if white else "yellow"),
            f"{percent(float(spectra.departure[j]), 2)} ({limit})",
            percent(float(spectra.slow[j]), 2),
        )
    return table


def error_table(errors: TorqueErrors, robot: Robot) -> Table:
    """Torque errors of one recording, joint by joint (Eq. 37).

    Columns whose largest forces are not known hold dashes.

    Args:
        errors: Of the recording.
        robot: Whose joints they are.

    Raises:
        InputError: If the numbers of joints differ.
    """
    require_joints(errors, robot)
    n = robot.joints
    table = plain_table(f"{errors.name}: relative error {percent(errors.relative)} %")
    table.add_column("joint")
    table.add_column("unit", no_wrap=True)
    columns = [
        ("mean |e|", [significant(x) for x in errors.mean]),
        ("RMS", [significant(x) for x in errors.rms]),
        ("mean\n[% of max]", [significant(x) for x in errors.mean_percent]),
        ("RMS\n[% of max]", [significant(x) for x in errors.rms_percent]),
        ("RMS\n[% of RMS force]", [percent(x, 3) for x in errors.rms_relative]),
    ]
    for title, _ in columns:
        table.add_column(Text(title), justify="right", no_wrap=True)
    cells = [aligned(texts) for _, texts in columns]
    for j in range(n):
        row = (column[j] for column in cells)
        table.add_row(Text(robot.joint_names[j]), robot.force_unit(j), *row)
    average = float(np.mean(errors.mean_percent))
    if n > 1 and np.isfinite(average):
        table.add_section()
        table.add_row("average", "", "", "", significant(average), "", "")
    return table


def joint_table(robot: Robot) -> Table:
    """The joints of a robot with what is known of their limits; dashes where it is not.

    Args:
        robot: The robot.
    """
    limits = robot.limits
    table = plain_table(f"{robot.name}: {robot.joints} joints")
    table.add_column("joint")
    table.add_column("moves")
    columns = [
        ("from", limits.position_min),
        ("to", limits.position_max),
        ("speed\n[unit/s]", limits.velocity),
        ("acceleration\n[unit/s²]", limits.acceleration),
        ("largest\nforce", robot.known_max_forces),
    ]
    cells = []
    for title, values in columns:
        table.add_column(Text(title), justify="right", no_wrap=True)
        known = np.where(np.isfinite(values), values, np.nan)
        cells.append(aligned([significant(x) for x in known]))
    table.add_column("unit", no_wrap=True)
    table.add_column("force\nunit", no_wrap=True)
    for j in range(robot.joints):
        table.add_row(
            Text(robot.joint_names[j]),
            "turns" if robot.revolute[j] else "slides",
            *(column[j] for column in cells),
            robot.joint_unit(j),
            robot.force_unit(j),
        )
    return table


def motor_table(robot: Robot) -> Table:
    """The motors of a robot: which joints they turn, and what is known of them.

    Args:
        robot: The robot.
    """
    drives, n = robot.drives, robot.joints
    A = np.asarray(drives.reduction)
    turns = [
        " + ".join(f"{A[i, j]:.6g} {robot.joint_names[j]}" for j in np.flatnonzero(A[i]))
        for i in range(n)
    ]
    columns = [
        ("joint at motor zero [rad or m]", np.asarray(drives.zero)),
        ("largest torque [N m]", np.asarray(drives.max_torques)),
        ("rotor inertia [kg m²]", np.asarray(drives.rotor_inertia)),
    ]
    table = plain_table("motors")
    table.add_column("motor")
    table.add_column("turns", no_wrap=True)
    cells = []
    for title, values in columns:
        known = np.isfinite(values)
        if known.any() and values.any():
            table.add_column(Text(title), justify="right")
            cells.append(aligned([significant(x) for x in np.where(known, values, np.nan)]))
    for i in range(n):
        table.add_row(str(i + 1), Text(turns[i]), *(column[i] for column in cells))
    return table


def plain_table(title: str) -> Table:
    """An empty table in the style of the report."""
    return Table(
        title=Text(title, style="bold"),
        title_justify="left",
        box=None,
        pad_edge=False,
        header_style="bold",
        padding=(0, 2, 0, 0),
    )

"""Tables of a kinematic calibration."""

import math
from typing import TYPE_CHECKING

import numpy as np

from jaxid.result_table import (
    MISSING,
    Column,
    Status,
    Table,
    estimate_columns,
    significant,
)

if TYPE_CHECKING:
    from .geometry_fit import GeometryFit

DISPLAY_UNITS = {
    "m": (1e3, "mm"),
    "rad": (1e3, "mrad"),
    "rad/(N m)": (1e6, "µrad/(N m)"),
    "m/N": (1e6, "µm/N"),
}
"""Factors and names of the units of corrections in tables."""


MIN_FACTOR = 1e-3
"""Smallest share of a column in another one that is worth a word."""


def in_thousandths(value: float) -> str:
    """Return a number with three decimals, and a dash for NaN."""
    return MISSING if math.isnan(value) else f"{value:z.3f}"


def session_table(fit: "GeometryFit") -> Table:
    """Return mean errors of the poses of each session and place, before and after."""
    is_pose = fit.problem.poses.is_pose
    names = fit.problem.place_names
    places = list(dict.fromkeys(names[is_pose].tolist()))
    poses = [np.flatnonzero(is_pose & (names == place)) for place in places]
    columns = [
        Column("session, place", places),
        Column("poses", [len(x) for x in poses]),
        Column("left out", [int(fit.solution.is_wrong[x].sum()) for x in poses]),
    ]
    sizes = {"nominal": fit.shown_errors.nominal}
    sizes["calibrated"] = fit.shown_errors.calibrated
    for words, errors in sizes.items():
        means = [1e3 * errors.lengths[x].mean() for x in poses]
        columns.append(Column(words, means, "mm"))
        if np.isfinite(errors.angles).any():
            angles = [np.rad2deg(np.nanmean(errors.angles[x])) for x in poses]
            columns.append(Column(words, angles, "deg"))
    remark = "All poses count, also those that are left out as wrong."
    return Table(f"mean errors, {fit.manner}", *columns, remarks=[remark])


def correction_table(fit: "GeometryFit") -> Table:
    """Return shifts, turns and compliances of all joints."""
    robot = fit.problem.robot
    shifts, turns = np.split(1e3 * fit.origins, 2, axis=1)
    columns = [Column("joint", robot.body_names)]
    for kind, values, unit in (("shift", shifts, "mm"), ("turn", turns, "mrad")):
        for axis, name in enumerate("xyz"):
            header = f"{kind}\n{name}"
            columns.append(Column(header, values[:, axis], unit, format=in_thousandths))
    if fit.has_compliance:
        compliances = 1e6 * np.resize(fit.compliances, robot.bodies)
        compliances[robot.joints :] = np.nan
        unit = "µrad/(N m)" if all(robot.turns) else "µrad/(N m), µm/N"
        columns.append(Column("compliance", compliances, unit, format=in_thousandths))
    return Table(
        "corrections of the joints' origins, along the nominal axes of each body",
        *columns,
        remarks=[
            "Of corrections that the poses cannot tell apart, these are the smallest: "
            "use them together. A turn about the axis of a joint is its zero."
        ],
    )


def combination_table(fit: "GeometryFit") -> Table:
    """Return what the poses determine, with intervals, the session being the unit."""
    combinations = fit.combinations
    corrections = [fit.corrections[k] for k in combinations.leaders]
    scales = [DISPLAY_UNITS[x.unit] for x in corrections]
    factors = np.array([factor for factor, _ in scales])
    values = combinations.of(fit.values)
    half_widths = fit.uncertainty.half_widths()
    is_determined = fit.is_determined
    count = len(fit.corrections)
    return Table(
        "combinations of corrections",
        Column("named after", [x.words for x in corrections]),
        *estimate_columns(
            factors * values,
            factors * fit.uncertainty.standard_deviations,
            factors * np.array([values - half_widths, values + half_widths]),
            [unit for _, unit in scales],
        ),
        facts=[
            ("sessions", f"{len(fit.problem.sessions)}, the units of the intervals"),
            ("prior", fit.solution.prior.words),
            (
                "determined",
                f"{len(corrections)} combinations of {count} corrections; behind them "
                f"the singular values fall by {significant(combinations.gap, 2)}",
            ),
        ],
        status=[Status.GOOD if x else Status.NEUTRAL for x in is_determined],
        remarks=[
            "In the table of combinations, ✓ means that the poses tell more than the "
            "prior, and · that the prior decides."
        ],
    )


def undetermined_table(fit: "GeometryFit") -> Table:
    """Return the corrections that the poses cannot tell from others."""
    combinations = fit.combinations
    leaders = np.array(combinations.leaders)
    words = [correction.words for correction in fit.corrections]
    partners = []
    for factors in combinations.factors.T:
        sizes = np.abs(factors)
        is_part = sizes > MIN_FACTOR * sizes.max(initial=0.0)
        names = [words[leader] for leader in leaders[is_part]]
        partners.append(", ".join(names) or "nothing: it has no effect")
    return Table(
        "corrections that the poses cannot tell from others",
        Column("correction", [words[follower] for follower in combinations.followers]),
        Column("not told from", partners),
    )

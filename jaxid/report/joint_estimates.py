"""Estimates of each joint: friction, rotor, gravity; and parameters that correlate."""

import math
import textwrap
from typing import Any

import numpy as np

from jaxid.dynamics.model import Model
from jaxid.identification.fit_result import Fit
from jaxid.result_table import MISSING, Column, Table, significant, with_deviations
from jaxid.validation.judgement import Report

GRAVITY_MEANINGS = {
    "m": "mass",
    "mx": "mass\ntimes x",
    "my": "mass\ntimes y",
    "mz": "mass\ntimes z",
}
"""Parameters of bodies that gravity acts on, as headers."""
HEADER_WIDTH = 18
"""Largest number of letters in a line of a header."""
MIN_CORRELATION = 0.8
"""Correlation from which a pair of parameters is shown."""
MAX_PAIRS = 20
"""Largest number of pairs of correlated parameters that are shown."""


def joint_table(report: Report) -> Table:
    """Return the estimates of each joint, and below them those of the robot's file."""
    fit = report.fit
    robot = fit.base.model.robot
    units = dict(zip(fit.base.names, fit.base.units, strict=True))
    sources = [_estimate_texts(fit), *_claim_texts(report)]
    has_claims = len(sources) > 1
    heads = []
    bodies = robot.solid_bodies
    for name in (robot.body_names[body] for body in bodies):
        heads.append(name)
        if has_claims:
            heads.append("in the robot's file")
    columns = [Column("joint", heads)]
    for symbol, meaning in _meanings(fit.base.model).items():
        names = [f"{symbol}{robot.numbers[body]}" for body in bodies]
        known_names = [name for name in names if name in units]
        if known_names:
            texts = [source.get(name, MISSING) for name in names for source in sources]
            unit = " or ".join(dict.fromkeys(units[name] for name in known_names))
            columns.append(Column(meaning, texts, unit))
    # A line separates the pairs of rows.
    rules = range(2, len(heads), 2) if has_claims else ()
    return Table("", *columns, rules=rules)


def _meanings(model: Model) -> dict[str, str]:
    """Return friction, rotors and springs, then gravity, in words by their symbols."""
    meanings = {}
    for term in model.terms:
        for parameter in term.joint_parameters:
            # The words behind a colon explain the name.
            name = parameter.meaning.split(":")[0]
            meanings[parameter.name] = textwrap.fill(name, HEADER_WIDTH)
    return meanings | GRAVITY_MEANINGS


def _estimate_texts(fit: Fit) -> dict[str, str]:
    """Return each estimate with half its 95 % interval, by the parameter's name."""
    half_widths = fit.uncertainty.half_widths()
    values, widths = with_deviations(fit.parameters, half_widths)
    texts = {}
    for k, name in enumerate(fit.base.names):
        is_determined = math.isfinite(half_widths[k])
        interval = f"{values[k]} ± {widths[k]}"
        texts[name] = interval if is_determined else "not determined"
    return texts


def _claim_texts(report: Report) -> list[dict[str, str]]:
    """Return the values in the robot's file by the parameters' names, if it has any."""
    values = report.claimed_parameters
    if values is None:
        return []
    texts = [significant(float(value)) for value in values]
    return [dict(zip(report.fit.base.names, texts, strict=True))]


def correlation_blocks(fit: Fit) -> list[Any]:
    """Return the pairs of parameters that logs hardly tell apart, and what that means.

    The strongest come first.
    """
    covariance = fit.covariance
    deviations = np.sqrt(np.diag(covariance))
    scale = np.outer(deviations, deviations)
    # Undetermined parameters have no correlation, and are in no pair.
    is_known = np.isfinite(scale) & (scale > 0.0)
    every_correlation = np.divide(
        covariance, scale, out=np.zeros_like(scale), where=is_known
    )
    correlations = np.triu(every_correlation, 1)
    first, second = np.nonzero(np.abs(correlations) >= MIN_CORRELATION)
    values = correlations[first, second]
    order = np.argsort(-np.abs(values))[:MAX_PAIRS]
    names = np.asarray(fit.base.names)
    text = (
        f"{len(values)} pairs have a correlation of {MIN_CORRELATION} or more: the "
        "logs determine their combination better than each of them. To separate them, "
        "record a motion in which these joints move more independently. At most "
        f"{MAX_PAIRS} are shown."
    )
    table = Table(
        "",
        Column("parameter", names[first[order]]),
        Column("and", names[second[order]]),
        Column("correlation", values[order], kind="number"),
    )
    return [text, table] if len(values) else [text]

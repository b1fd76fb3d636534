"""How friction falls with temperature: from fits to recordings at several temperatures."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.friction import TemperatureScaled
from jaxid.dynamics.terms import AbstractTerm
from jaxid.errors import InputError
from jaxid.identification.fit import Fit

NEGLIGIBLE = 1e-12
"""Standard deviation below which an estimate counts as exact, of its size."""


class TemperatureLaw(eqx.Module):
    r"""Friction $f_0 e^{-a (T - T_0)}$ of each joint, with uncertainties.

    Attributes:
        names: Of the friction parameters, one for each joint.
        values: At the reference temperature, in the parameters' units.
        value_deviations: Their standard deviations.
        rates: The $a$ [1/K]; NaN where an estimate is not positive.
        rate_deviations: Their standard deviations [1/K].
        term: The friction with these rates, for models at any temperature.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[AnyArray, " joints"]
    value_deviations: Float[AnyArray, " joints"]
    rates: Float[AnyArray, " joints"]
    rate_deviations: Float[AnyArray, " joints"]
    term: TemperatureScaled


def temperature_law(
    fits: Sequence[Fit],
    temperatures: Sequence[float] | Float[AnyArray, " fits"],
    term: AbstractTerm,
    *,
    reference: float = 25.0,
) -> TemperatureLaw:
    """Finds how one kind of friction falls with temperature, from fits at several of them.

    The logarithms of the estimates lie on a line, each as uncertain as its fit says.

    Args:
        fits: Of the same model, each to recordings at one temperature.
        temperatures: Of the fits [°C].
        term: Whose parameters fall, such as `ViscousFriction()`: one for each joint.
        reference: Temperature to which the values belong [°C].

    Raises:
        InputError: If there are fewer than two temperatures, or a fit has no such parameters.
    """
    warmer = np.asarray(temperatures, np.float64) - reference
    if warmer.shape != (len(fits),) or len(np.unique(warmer)) < 2:
        raise InputError(
            "`temperatures` must hold one temperature for each fit, and at least two different "
            f"ones, but there are {len(fits)} fits and temperatures of shape {warmer.shape}."
        )
    robot = fits[0].base.model.robot
    names = tuple(name for name, _ in term.parameters(robot))
    if len(names) != robot.joints or any(set(names) - set(fit.base.names) for fit in fits):
        raise InputError(
            f"`term` must have one parameter for each joint ({robot.joints}) that all fits have, "
            f"but has {', '.join(names)}."
        )
    places = [[fit.base.names.index(name) for name in names] for fit in fits]
    f = np.array([np.asarray(fit.parameters)[k] for fit, k in zip(fits, places, strict=True)])
    s = np.array([fit.standard_deviations[k] for fit, k in zip(fits, places, strict=True)])
    lines = np.full((len(names), 4), np.nan)
    for j in range(len(names)):
        if (f[:, j] > 0).all():
            lines[j] = _line(warmer, np.log(f[:, j]), np.maximum(s[:, j] / f[:, j], NEGLIGIBLE))
    level, level_deviation, slope, slope_deviation = lines.T
    values, rates = np.exp(level), -slope
    known = np.where(np.isfinite(rates), rates, 0.0)
    scaled = TemperatureScaled(term, known, reference, reference)
    return TemperatureLaw(names, values, values * level_deviation, rates, slope_deviation, scaled)


def _line(x: np.ndarray, y: np.ndarray, deviations: np.ndarray) -> tuple[float, ...]:
    """Level and slope of a line, each with its standard deviation."""
    A = np.column_stack([np.ones_like(x), x]) / deviations[:, None]
    covariance = np.linalg.inv(A.T @ A)
    level, slope = covariance @ A.T @ (y / deviations)
    a, b = np.sqrt(np.diag(covariance))
    return float(level), float(a), float(slope), float(b)

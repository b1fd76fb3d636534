"""How friction falls with temperature, from fits at several temperatures."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.terms import AbstractTerm, TemperatureScaled
from jaxid.errors import InputError

from ..fit_result import Fit

MIN_RELATIVE_DEVIATION = 1e-12
"""Exact estimates of simulated logs get this deviation, to have finite weights."""


class TemperatureLaw(eqx.Module):
    r"""Friction $f_0 e^{-a (T - T_0)}$ of each joint, with uncertainties.

    Attributes:
        names: Names of the friction parameters, one for each joint.
        values: Values at the reference temperature, in the parameters' units.
        value_deviations: Their standard deviations.
        rates: Rates $a$ [1/K]; NaN where an estimate is not positive.
        rate_deviations: Their standard deviations [1/K].
        term: Friction term with these rates, for models at any temperature.
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
    """Identify how friction falls with temperature, from fits at several temperatures.

    The logarithms of the estimates lie on a line, each as uncertain as in its fit.

    Args:
        fits: Fits of one model, each to recordings at one temperature.
        temperatures: Temperatures of the fits [°C].
        term: Term with one parameter for each joint, such as `ViscousFriction()`.
        reference: Temperature to which the values belong [°C].

    Raises:
        InputError: If there are fewer than two temperatures, or a fit has no such
            parameters.
    """
    warming = np.asarray(temperatures, np.float64) - reference
    if warming.shape != (len(fits),) or len(np.unique(warming)) < 2:
        raise InputError(
            "`temperatures` must be one for each fit, at least two different."
        )
    robot = fits[0].base.model.robot
    names = tuple(name for name, _ in term.parameters(robot))
    in_all_fits = all(set(names) <= set(fit.base.names) for fit in fits)
    if len(names) != robot.joints or not in_all_fits:
        raise InputError(
            f"`term` must have one parameter for each joint, in all fits: {names}."
        )

    estimates = np.empty((len(fits), len(names)))
    deviations = np.empty_like(estimates)
    for row, fit in enumerate(fits):
        places = [fit.base.names.index(name) for name in names]
        estimates[row] = fit.parameters[places]
        deviations[row] = fit.standard_deviations[places]

    # An exponential has no zero and no sign: joints with other estimates stay NaN.
    lines = np.full((4, len(names)), np.nan)
    for joint in np.flatnonzero((estimates > 0).all(axis=0)):
        lines[:, joint] = _exponential(
            warming, estimates[:, joint], deviations[:, joint]
        )
    rates, rate_deviations, values, value_deviations = lines
    finite_rates = np.where(np.isfinite(rates), rates, 0.0)
    return TemperatureLaw(
        names=names,
        values=values,
        value_deviations=value_deviations,
        rates=rates,
        rate_deviations=rate_deviations,
        term=TemperatureScaled(term, finite_rates, reference, reference),
    )


def _exponential(warming, estimates, deviations) -> tuple[float, ...]:
    """Return rate, its deviation, value at the reference, and its deviation."""
    # A small deviation of a logarithm is the relative deviation.
    relative_deviations = np.maximum(deviations / estimates, MIN_RELATIVE_DEVIATION)
    line, covariance = np.polyfit(
        warming,
        np.log(estimates),
        deg=1,
        w=1.0 / relative_deviations,
        cov="unscaled",
    )
    slope_deviation, level_deviation = np.sqrt(np.diag(covariance))
    value = np.exp(line[1])
    return -line[0], slope_deviation, value, value * level_deviation

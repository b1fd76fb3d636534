"""Delay of the forces against the angles, and what it adds to intervals."""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import BaseVector
from jaxid.measurement.observations import ObservedLogs
from jaxid.result_table import significant, with_deviations

from .fit_result import Fit
from .problem import RegressionProblem
from .uncertainty.result import dof_of_sum
from .uncertainty.spectra_of_rows import spread_rows


class DelayLimits(NamedTuple):
    """Bounds of a delay that is told.

    On 135 clean logs of five machines, simulated by MuJoCo, delays were from -3.2 to
    1.7 deviations: disturbances that a controller answers, and friction at low speeds,
    make forces look early, not late. Models of these missed up to 5.7 % of the forces,
    also late ones; a real arm of which a model misses 23 % looked late by 14 ms.
    """

    ratio: float = 3.0  # delay over its deviation
    seconds: float = 1e-3  # shorter delays matter to nobody
    misfit: float = 0.08  # what a model misses that lacks effects, which look late
    widening: float = 1.5  # ratio of intervals, with and without it, that is told


LIMITS = DelayLimits()


class Delay(NamedTuple):
    """Time by which forces stand later in a log than the angles that belong to them.

    Attributes:
        seconds: Delay of all joints [s].
        deviation: Standard deviation of the delay [s].
        dof: Degrees of freedom of the standard deviation.
        misfit: Fraction (0 to 1) of the forces that the model misses without the delay.
    """

    seconds: float
    deviation: float
    dof: float
    misfit: float

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the limits of the delay [s].

        Args:
            level: Probability (0 to 1) that the interval contains the true delay.
        """
        half_width = self.deviation * scipy.special.stdtrit(self.dof, 0.5 + 0.5 * level)
        return self.seconds - float(half_width), self.seconds + float(half_width)

    @property
    def is_certain(self) -> bool:
        """Whether the forces are late, beyond what noise and friction imitate."""
        min_seconds = max(LIMITS.seconds, LIMITS.ratio * self.deviation)
        return self.seconds > min_seconds and self.misfit < LIMITS.misfit

    def __str__(self):
        """Return the delay and its 95 % interval."""
        _, end = self.interval()
        half_width = end - self.seconds
        texts = with_deviations([1e3 * self.seconds], [1e3 * half_width])
        (milliseconds,), (width,) = texts
        return f"{milliseconds} ± {width} ms"


def with_unknown_delay(
    fit: Fit, observations: ObservedLogs | RegressionProblem, delay: Delay
) -> Fit:
    """Return a fit whose uncertainty includes a delay that stays in the log.

    A delay of the forces moves the estimates by a multiple of their derivative. Its
    mean square is that of the delay's deviation and of the delay itself, which the fit
    takes to be zero: intervals then hold whether the delay is certain or not.

    Args:
        fit: Fit of the logs, as they are.
        observations: Observations of the fit, or the regression problem of them.
        delay: Delay of the logs, as from `estimate_delay`.
    """
    problem = observations
    if not isinstance(problem, RegressionProblem):
        problem = RegressionProblem(fit.base, problem)
    elif problem.base is not fit.base:
        # The fit has found other columns, such as friction by load.
        problem = problem.with_base(fit.base)
    derivative = _derivative_by_delay(fit, problem)
    mean_square = delay.seconds**2 + delay.deviation**2
    delay_covariance = mean_square * np.outer(derivative, derivative)
    uncertainty = fit.uncertainty
    variances = np.diag(uncertainty.covariance)
    delay_variances = np.diag(delay_covariance)
    dof = uncertainty.dof.copy()
    # Nothing is known of some parameters, with or without a delay.
    is_known = np.isfinite(variances)
    dof[is_known] = dof_of_sum(
        variances[is_known], delay_variances[is_known], dof[is_known], delay.dof
    )
    wider_uncertainty = dataclasses.replace(
        uncertainty, covariance=uncertainty.covariance + delay_covariance, dof=dof
    )
    ratios = np.ones(len(variances))
    ratios[is_known] = np.sqrt(1.0 + (delay_variances / variances)[is_known])
    notes = fit.notes
    if ratios.max() > LIMITS.widening:
        parameter = fit.base.names[int(np.argmax(ratios))]
        note = (
            f"intervals include a possible delay of the forces, of {delay}: they are "
            f"up to {significant(ratios.max(), 2)} times as wide as without it, with "
            f"the largest change for `{parameter}`; faster motion determines the delay "
            "better."
        )
        notes = (*notes, note)
    return dataclasses.replace(fit, uncertainty=wider_uncertainty, notes=notes)


def _derivative_by_delay(fit: Fit, problem: RegressionProblem) -> BaseVector:
    """Return the derivative of the estimates by a delay of the forces, per second."""
    size = fit.base.size
    information = np.zeros((size, size))
    products = np.zeros(size)
    for chunk in spread_rows(problem):
        if len(chunk.forces) < 2:
            continue
        row_time = problem.recordings[chunk.recording].row_time
        for joint, weight in enumerate(fit.weights):
            indices = list(chunk.indices[joint])
            columns = chunk.columns[joint]
            predicted_forces = columns @ fit.parameters[indices]
            # Forces that are late by a short time lack so much of their rate.
            rates = -np.gradient(predicted_forces, row_time)
            is_counted = chunk.mask[:, joint]
            rows = weight * columns[is_counted]
            information[np.ix_(indices, indices)] += rows.T @ rows
            products[indices] += rows.T @ (weight * rates[is_counted])
    lengths = np.sqrt(np.diag(information))
    scale = np.divide(1.0, lengths, out=np.zeros(size), where=lengths > 0)
    scaled_information = scale[:, None] * information * scale
    solution, *_ = np.linalg.lstsq(scaled_information, scale * products, rcond=1e-10)
    return scale * solution

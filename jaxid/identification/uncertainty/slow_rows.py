"""Errors of friction near rest: what the slow rows of a log change in the estimates."""

import dataclasses
from typing import NamedTuple

import numpy as np

from jaxid.arrays import BaseMatrix, BaseVector
from jaxid.result_table import significant

from ..estimators.estimate import Estimate
from ..problem import RegressionProblem
from .result import Uncertainty
from .spectra_of_rows import divide_into_stretches, spread_rows


class SlowRowLimits(NamedTuple):
    """Which rows are slow, and which change of the estimates they may not make.

    Set on five machines that MuJoCo records (palletiser, seven axes, gantry, two arms,
    oblique axes), whose joints stick where they turn back. Where friction was that of
    the model, less than 1 % of the changes were above `ratio` deviations of noise, on
    slow motions 19 %. White noise alone makes deviations less than 1 % larger.
    """

    speed: float = 0.05  # over the top speed of the joint
    ratio: float = 2.5  # change over its deviation
    growth: float = 0.5  # of the variance without them: else the others tell too little
    widening: float = 1.5  # ratio of intervals, with and without it, that is told


LIMITS = SlowRowLimits()


class SlowRows(NamedTuple):
    """Part of the information of a log that its slow rows give."""

    information: BaseMatrix
    gradient: BaseVector  # products of instruments and residuals
    share: float  # fraction (0 to 1) of the rows that were looked at

    def changes(self, inverse: BaseMatrix) -> tuple[BaseVector, BaseVector]:
        """Return how estimates change without the slow rows, and their variances.

        The variances are relative to those of all rows, for errors that are noise.
        """
        # Unknowns are compared below, which must not depend on their units.
        sizes = np.sqrt(np.maximum(np.diag(inverse), 0.0))
        scale = np.where(sizes > 0, sizes, 1.0)
        scaled_inverse = inverse / np.outer(scale, scale)
        scaled_information = np.outer(scale, scale) * self.information / self.share
        scaled_gradient = scale * self.gradient / self.share

        # What is left of slow rows keeps unknowns determined that need them all.
        remaining_part = np.eye(len(scale)) - (1 - 1e-6) * (
            scaled_inverse @ scaled_information
        )
        right_sides = np.column_stack(
            [scaled_inverse, -scaled_inverse @ scaled_gradient]
        )
        solution = np.linalg.solve(remaining_part, right_sides)
        growth = np.diag(solution) - np.diag(scaled_inverse)
        return scale * solution[:, -1], growth / self.share


def with_friction_near_rest(
    errors: Uncertainty, problem: RegressionProblem, estimate: Estimate
) -> Uncertainty:
    """Return the uncertainty with what friction near rest does to the estimates.

    Joints that stick where they turn back shift friction and inertia alike in every
    log, which no scatter of residuals tells. Estimates without the slow rows do not
    have this error: where both differ by more than noise, intervals include the
    difference.
    """
    slow_rows = _slow_rows(problem, estimate)
    changes, growth = slow_rows.changes(estimate.inverse)
    variances = np.diag(errors.covariance)
    is_known = np.isfinite(variances) & (variances > 0)
    known_variances = np.where(is_known, variances, 1.0)
    is_changed = changes**2 > LIMITS.ratio**2 * growth * known_variances
    is_told = is_known & is_changed & (growth > 0) & (growth < LIMITS.growth)
    errors_of_friction = np.where(is_told, changes, 0.0)
    covariance = errors.covariance + np.outer(errors_of_friction, errors_of_friction)

    ratios = np.sqrt(1.0 + errors_of_friction**2 / known_variances)
    notes = errors.notes
    if ratios.max(initial=1.0) > LIMITS.widening:
        parameter = problem.base.names[int(np.argmax(ratios))]
        note = (
            f"rows slower than {100 * LIMITS.speed:g} % of the top speed of a joint "
            "disagree with the other rows, which is typical of joints that stick. The "
            "intervals include this difference and are up to "
            f"{significant(ratios.max(), 2)} times as wide as without it, with the "
            f"largest change for `{parameter}`; leave slow rows out "
            "(`rows.min_speed`)."
        )
        notes = (*notes, note)
    return dataclasses.replace(errors, covariance=covariance, notes=notes)


def _slow_rows(problem: RegressionProblem, estimate: Estimate) -> SlowRows:
    """Return what the slow rows of each joint tell of the parameters."""
    stretches, _ = divide_into_stretches(problem)
    speeds = []
    for recording, start, stop in stretches:
        speeds.append(problem.recordings[recording].row_speeds(slice(start, stop)))
    top_speeds = np.max([x.max(axis=0) for x in speeds], axis=0)

    size = problem.base.size
    information = np.zeros((size, size))
    gradient = np.zeros(size)
    rows = 0
    for chunk, speed in zip(spread_rows(problem), speeds, strict=True):
        is_slow = speed < LIMITS.speed * top_speeds
        rows += int(chunk.mask.sum())
        residuals = chunk.residuals(estimate.parameters)
        channels = estimate.influence(chunk, residuals)
        for channel, is_slow_row in zip(channels, is_slow.T, strict=True):
            columns = list(channel.columns)
            instruments = channel.instruments[is_slow_row]
            equations = channel.equations[is_slow_row]
            disturbance = channel.disturbance[is_slow_row]
            information[np.ix_(columns, columns)] += instruments.T @ equations
            gradient[columns] += instruments.T @ disturbance
    return SlowRows(information, gradient, rows / problem.factors.rows.sum())

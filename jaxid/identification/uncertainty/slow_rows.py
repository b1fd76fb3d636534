"""Errors of friction near rest: what the slow rows of a log change in the estimates."""

import dataclasses
from typing import NamedTuple

import numpy as np

from jaxid.arrays import BaseMatrix, BaseVector, Joints, Matrix, Vector
from jaxid.dynamics.motion import Motion
from jaxid.result_table import significant
from jaxid.robot.contacts import Legs, legs_of

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


class HeldFriction(NamedTuple):
    """Friction that joints of legs may hold for a while where they turn back.

    Of twelve joints of legs that stand one is always slow: rows of the base without
    slow joints are too few to fit. So each joint gets a column of its own: friction
    that does not change its direction where the speed does, but later.
    """

    cross: Matrix  # products of the weighted rows and these columns [base, joints]
    products: Matrix  # of these columns [joints, joints]
    gradient: Vector  # products of these columns and the residuals
    share: float  # fraction (0 to 1) of the rows that were looked at

    def changes(self, inverse: BaseMatrix) -> tuple[BaseVector, BaseVector]:
        """Return how estimates change with these columns, and their variances.

        The variances are relative to those without, for errors that are noise.
        """
        change_by_column = inverse @ self.cross / self.share
        explained_products = self.cross.T @ change_by_column
        remaining_inverse = np.linalg.pinv(
            self.products - explained_products, rcond=1e-9, hermitian=True
        )
        steps = change_by_column @ remaining_inverse
        variances = np.sum(steps * change_by_column, axis=1)
        sizes = np.diag(inverse)
        growth = variances / np.where(sizes > 0, sizes, np.inf)
        return -steps @ self.gradient, growth


def with_friction_near_rest(
    errors: Uncertainty, problem: RegressionProblem, estimate: Estimate
) -> Uncertainty:
    """Return the uncertainty with what friction near rest does to the estimates.

    Joints that stick where they turn back shift friction and inertia alike in every
    log, which no scatter of residuals tells. Estimates without the slow rows, or of
    legs with friction that is held, do not have this error: where both differ by more
    than noise, intervals include the difference.
    """
    has_legs = bool(problem.base.model.robot.contacts)
    evidence_of = _held_friction if has_legs else _slow_rows
    changes, growth = evidence_of(problem, estimate).changes(estimate.inverse)
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
        advice = "leave slow rows out (`rows.min_speed`)"
        if has_legs:
            advice = "let joints turn back less often, at higher accelerations"
        note = (
            f"rows slower than {100 * LIMITS.speed:g} % of the top speed of a joint "
            "disagree with the other rows, which is typical of joints that stick. The "
            "intervals include this difference and are up to "
            f"{significant(ratios.max(), 2)} times as wide as without it, with the "
            f"largest change for `{parameter}`; {advice}."
        )
        notes = (*notes, note)
    return dataclasses.replace(errors, covariance=covariance, notes=notes)


def _row_motions(problem: RegressionProblem) -> tuple[list[Motion], Joints]:
    """Return the motion of each stretch of rows, and the top speed of each joint."""
    stretches, _ = divide_into_stretches(problem)
    motions = []
    for recording, start, stop in stretches:
        motions.append(problem.recordings[recording].row_motion(slice(start, stop)))
    top_speeds = np.max([np.abs(x.qd).max(axis=0) for x in motions], axis=0)
    return motions, top_speeds


def _held_friction(problem: RegressionProblem, estimate: Estimate) -> HeldFriction:
    """Return what the rows tell of friction that joints of legs hold."""
    robot = problem.base.model.robot
    legs = legs_of(robot)
    motions, top_speeds = _row_motions(problem)
    slow_speeds = LIMITS.speed * np.maximum(top_speeds, 1e-9)
    slow_speeds[list(robot.virtual)] = np.inf

    cross = np.zeros((problem.base.size, robot.joints))
    products = np.zeros((robot.joints, robot.joints))
    gradient = np.zeros(robot.joints)
    rows = 0
    for chunk, motion in zip(spread_rows(problem), motions, strict=True):
        rows += int(chunk.mask.sum())
        slowness = np.exp(-((motion.qd / slow_speeds) ** 2))
        directions = np.sign(motion.qdd)
        directions[:, list(robot.virtual)] = 0.0
        residuals = chunk.residuals(estimate.parameters)
        channels = estimate.influence(chunk, residuals)
        weights = np.where(chunk.mask, estimate.weights, 0.0)
        for joint, channel in enumerate(channels):
            acting = acting_friction(legs, motion, slowness * directions, joint)
            columns = weights[:, joint, None] * acting
            cross[list(channel.columns)] += channel.equations.T @ columns
            products += columns.T @ columns
            gradient += columns.T @ channel.disturbance
    return HeldFriction(cross, products, gradient, rows / problem.factors.rows.sum())


def acting_friction(legs: Legs, motion: Motion, friction: Matrix, joint: int) -> Matrix:
    """Return what friction of each joint does in the rows of one joint."""
    columns = np.zeros_like(friction)
    columns[:, joint] = friction[:, joint]
    if joint in legs.rows:
        shape = (len(friction), len(legs.rows), len(legs.joints))
        entries = np.asarray(motion.contacts).reshape(shape)
        X = entries[:, legs.rows.index(joint)]
        leg_joints = list(legs.joints)
        columns[:, leg_joints] -= X * friction[:, leg_joints]
    return columns


def _slow_rows(problem: RegressionProblem, estimate: Estimate) -> SlowRows:
    """Return what the slow rows of each joint tell of the parameters."""
    motions, top_speeds = _row_motions(problem)
    size = problem.base.size
    information = np.zeros((size, size))
    gradient = np.zeros(size)
    rows = 0
    for chunk, motion in zip(spread_rows(problem), motions, strict=True):
        is_slow = np.abs(motion.qd) < LIMITS.speed * top_speeds
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

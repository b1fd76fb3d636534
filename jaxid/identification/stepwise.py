"""Identification axis by axis, from the tips inward, beside identification at once.

The works before identification at once proceed so: the last axis is identified from its own force,
its parameters are taken for known, then comes the axis before it. Friction can be settled first, by
motions of single axes. Errors of the outer axes are handed on to the inner ones.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.machine import in_numpy
from jaxid.dynamics.observation import random_motion
from jaxid.errors import InputError
from jaxid.identification.estimators import (
    AbstractEstimator,
    Estimate,
    WeightedLeastSquares,
)
from jaxid.identification.fit import Fit
from jaxid.identification.identify import fit_problem
from jaxid.identification.influence import AbstractInfluence, Channel
from jaxid.identification.problem import RegressionProblem, cross_validation_folds
from jaxid.identification.weights import AbstractWeights, MaximumForces
from jaxid.measurement.observations import Observations

DECIDED = 1e-4
"""Share of a column that must be new for an axis to decide its parameter, of 1."""
ALONE = 1e-3
"""Range of another joint's motion up to which a motion is one of a single axis, of the largest."""


class ByAxis(AbstractInfluence):
    """Rows of an axis count only for the parameters that it decides.

    Attributes:
        weights: Of the joints' rows [1/(N m) or 1/N].
        decided: For each joint the base parameters that its rows decide.
    """

    weights: Float[AnyArray, " joints"]
    decided: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def channels(self, chunk, residuals):
        """One channel for each joint."""
        found = []
        for j, (theta, acting) in enumerate(zip(chunk.columns, chunk.indices, strict=True)):
            rows = np.asarray(self.weights)[j] * np.where(chunk.mask[:, j], 1.0, 0.0)
            weighted = rows[:, None] * theta
            own = np.array([k in self.decided[j] for k in acting], bool)
            instruments = np.where(own, weighted, 0.0)
            counted = int(np.count_nonzero(chunk.mask[:, j]))
            found.append(Channel(acting, instruments, weighted, rows * residuals[:, j], counted))
        return found


class Stepwise(AbstractEstimator):
    """Least squares for one axis after the other, from the tips inward.

    Weights do not change the estimates: every axis is on its own. What an axis' rows cannot tell
    from what they see besides is left to the axis before it.

    Attributes:
        single_axes: Motions of one axis each; from them friction is found first, and kept.
        weights: By which joints count where errors are compared.
    """

    single_axes: tuple[Observations, ...] = ()
    weights: AbstractWeights = MaximumForces()

    def __call__(self, rows):
        """Goes from the last joint to the first."""
        base, size = rows.base, rows.base.size
        weights = np.asarray(self.weights(rows.robot, rows.factors))
        p, known = self._friction(base)
        order = np.zeros((size, size))
        fixed = set(known)
        decided: list[tuple[int, ...]] = [()] * rows.robot.joints
        for j in reversed(range(rows.robot.joints)):
            joint = rows.factors.joints[j]
            R = weights[j] * np.asarray(joint.R)
            new = [c for c, k in enumerate(joint.columns) if k not in known]
            new = [new[i] for i in _independent(R[:, new])]
            if not new:
                continue
            names = [joint.columns[c] for c in new]
            left = R[:, -1] - R[:, :-1] @ p[list(joint.columns)]
            p[names] = np.linalg.lstsq(R[:, new], left, rcond=None)[0]
            order[np.ix_(names, list(joint.columns))] = R[:, new].T @ R[:, :-1]
            # What is decided only later was zero here, and stays so in these equations.
            later = [k for k in joint.columns if k not in known and k not in names]
            order[np.ix_(names, later)] = 0.0
            decided[j] = tuple(names)
            known |= set(names)
        live = sorted(known - fixed)
        inverse = np.zeros((size, size))
        inverse[np.ix_(live, live)] = np.linalg.inv(order[np.ix_(live, live)])
        return Estimate(
            base=base,
            parameters=p,
            weights=weights,
            blocks=rows.blocks,
            inverse=inverse,
            influence=ByAxis(weights, tuple(decided)),
            notes=_said(base, known, fixed),
        )

    def _friction(self, base: BaseParameters) -> tuple[np.ndarray, set[int]]:
        """Friction from motions of single axes, and which parameters that are."""
        p, known = np.zeros(base.size), set()
        if not self.single_axes:
            return p, known
        friction = friction_parameters(base)
        for observations in self.single_axes:
            j = _moving(base, observations)
            joint = RegressionProblem(base, [observations], divisions=1).factors.joints[j]
            R = np.asarray(joint.R)
            own = [c for c, k in enumerate(joint.columns) if k in friction]
            others = [c for c, k in enumerate(joint.columns) if k not in friction]
            # In the motion of one axis most columns are alike: only their span counts.
            scale = np.linalg.norm(R, axis=0)
            scaled = R / np.where(scale > 0, scale, 1.0)
            U, s, _ = np.linalg.svd(scaled[:, others], full_matrices=False)
            U = U[:, s > DECIDED * s.max(initial=0.0)]
            beside = scaled - U @ (U.T @ scaled)
            chosen = [own[i] for i in _independent(beside[:, own], 1.0)]
            found = np.linalg.lstsq(beside[:, chosen], beside[:, -1], rcond=None)[0]
            for c, value in zip(chosen, found, strict=True):
                k = joint.columns[c]
                p[k] = value * scale[-1] / scale[c]
                known.add(k)
        return p, known


def friction_parameters(base: BaseParameters) -> set[int]:
    """Base parameters whose columns depend on speeds alone.

    Offsets are none of them: in the motion of one axis they look like its weight.
    """
    motion, other = (random_motion(base.model, 20, seed) for seed in (0, 1))
    a = in_numpy(base, base.columns, motion.q, motion.qd, motion.qdd)
    b = in_numpy(base, base.columns, other.q, motion.qd, other.qdd)
    speed_alone = [np.array_equal(a[:, :, k], b[:, :, k]) for k in range(base.size)]
    return {k for k in np.flatnonzero(speed_alone).tolist() if np.ptp(a[:, :, k], axis=0).any()}


def _independent(R: Float[np.ndarray, "height columns"], size: float | None = None) -> list[int]:
    """Columns of which enough is left beside earlier ones, by Gram-Schmidt.

    Args:
        R: The columns.
        size: What their lengths are compared with; the columns' own if None.
    """
    Q, kept = np.zeros((len(R), 0)), []
    for k, length in enumerate(np.linalg.norm(R, axis=0)):
        left = R[:, k]
        for _ in range(2):
            left = left - Q @ (Q.T @ left)
        new = float(np.linalg.norm(left))
        if new > DECIDED * (length if size is None else size):
            Q = np.column_stack([Q, left / new])
            kept.append(k)
    return kept


def _moving(base: BaseParameters, observations: Observations) -> int:
    reach = np.ptp(np.asarray(observations.motion.q), axis=0)
    j = int(np.argmax(reach))
    others = np.flatnonzero(np.delete(reach, j) > ALONE * reach[j])
    if len(others):
        raise InputError(
            f"`single_axes` must hold motions of one axis each, but in `{observations.name}` "
            f"{len(others) + 1} joints of `{base.model.robot.name}` move."
        )
    return j


def _said(base: BaseParameters, known: set[int], fixed: set[int]) -> tuple[str, ...]:
    notes = []
    left = [base.names[k] for k in range(base.size) if k not in known]
    if left:
        notes.append(f"no axis decides {', '.join(left)} on its own: taken for zero.")
    if fixed:
        notes.append(
            f"{len(fixed)} friction parameters come from motions of single axes, and standard "
            "deviations take them for known."
        )
    return tuple(notes)


class StepwiseComparison(eqx.Module):
    """Identification at once and axis by axis, of the same rows.

    Attributes:
        at_once: The fit to all rows together.
        stepwise: The fit axis by axis.
        at_once_error: Weighted error of the first on blocks of time not seen, relative to the
            forces, of 1.
        stepwise_error: That of the second, of 1.
    """

    at_once: Fit
    stepwise: Fit
    at_once_error: float
    stepwise_error: float

    @property
    def differences(self) -> Float[np.ndarray, " base"]:
        """Stepwise less at once, in standard deviations of the stepwise estimates."""
        difference = np.asarray(self.stepwise.parameters) - np.asarray(self.at_once.parameters)
        deviations = np.asarray(self.stepwise.standard_deviations)
        return difference / np.where(deviations > 0, deviations, np.inf)

    @property
    def table(self) -> str:
        """Both estimates of every parameter, with standard deviations."""
        rows = [f"{'parameter':12s}{'at once':>24s}{'axis by axis':>24s}  unit"]
        columns = (self.at_once, self.stepwise)
        for k, (name, unit) in enumerate(
            zip(self.at_once.base.names, self.at_once.base.units, strict=True)
        ):
            shown = "".join(
                f"{f'{fit.parameters[k]:.4g} ± {fit.standard_deviations[k]:.2g}':>24s}"
                for fit in columns
            )
            rows.append(f"{name:12s}{shown}  {unit}")
        return "\n".join(rows)

    def __str__(self):
        better = "at once" if self.at_once_error <= self.stepwise_error else "axis by axis"
        return (
            f"identification {better} serves better: on blocks of time not seen it leaves "
            f"{100 * min(self.at_once_error, self.stepwise_error):.2f} % of the forces, the other "
            f"way {100 * max(self.at_once_error, self.stepwise_error):.2f} %."
        )


def identify_stepwise(
    base: BaseParameters,
    observations: Observations | Sequence[Observations],
    stepwise: Stepwise | None = None,
    at_once: AbstractEstimator | None = None,
) -> StepwiseComparison:
    """Identifies axis by axis and at once, and judges both on blocks of time that they did not see.

    Args:
        base: What can be identified on this robot.
        observations: Of one recording, or of several that are fitted together.
        stepwise: How axes are done one by one; from these observations alone if None.
        at_once: Weighted least squares with the same weights if None.

    Raises:
        InputError: If the observations do not fit to the model, or a motion of single axes moves
            several.
    """
    single = isinstance(observations, Observations)
    recordings = (observations,) if single else tuple(observations)
    stepwise = Stepwise() if stepwise is None else stepwise
    at_once = WeightedLeastSquares(stepwise.weights) if at_once is None else at_once
    rows = RegressionProblem(base, recordings)
    whole, single_steps = (fit_problem(rows, estimator) for estimator in (at_once, stepwise))
    weights = np.asarray(single_steps.weights)
    errors = [_held_out_error(rows, estimator, weights) for estimator in (at_once, stepwise)]
    return StepwiseComparison(whole, single_steps, errors[0], errors[1])


def _held_out_error(
    problem: RegressionProblem, estimator: AbstractEstimator, weights: Float[np.ndarray, " joints"]
) -> float:
    """Return the weighted error on folds that the estimate has not seen, relative to the forces."""
    w = np.asarray(weights) ** 2
    squares = np.array(
        [
            part.total.residual_squares(
                estimator(RegressionProblem(problem.base, blocks=rest)).parameters
            )
            for rest, part in cross_validation_folds(problem.blocks)
        ]
    )
    return float(np.sqrt(np.sum(squares @ w) / (problem.factors.force_squares @ w)))

"""The estimator that finds the shapes of friction laws beside the parameters."""

import dataclasses
import itertools

import equinox as eqx
import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.base import BaseParameters
from jaxid.identification.estimators import AbstractEstimator, WeightedLeastSquares
from jaxid.identification.nonlinear.projection import Found, Search
from jaxid.identification.nonlinear.separable import SeparableRows
from jaxid.identification.nonlinear.shapes import Free, Shapes
from jaxid.identification.problem import RegressionProblem

STARTS = (0.2, 1.0, 5.0)
"""Multiples of the shapes among which the search chooses its beginning, joint by joint."""


class NonlinearFriction(AbstractEstimator):
    """Finds epsilons, Stribeck speeds and the like by variable projection, then all parameters.

    The weights of the joints are those of the linear estimator at the shapes that the model comes
    with; with the shapes that are found it estimates again. The base parameters of the fit are
    those of the model with these shapes. Standard deviations take the shapes for known:
    `identify_nonlinear` has those that do not, and says whether all this pays.

    Attributes:
        linear: Estimates everything else.
        free: Picks the leaves of the model's terms that are looked for; what the terms want if
            None (epsilons, Stribeck speeds, rates of temperature).
    """

    linear: AbstractEstimator = WeightedLeastSquares()
    free: Free | None = eqx.field(static=True, default=None)

    def __call__(self, rows):
        """Searches, and estimates with what was found.

        Raises:
            InputError: If the model has no shapes, or only factors are known.
        """
        weights = np.asarray(self.linear(rows).weights)
        shapes, _, found = self.search(rows, weights)
        base = shapes.set(rows.base, found.x)
        estimate = self.linear(rows.with_base(base))
        return dataclasses.replace(estimate, notes=(*estimate.notes, *not_converged(found)))

    def search(
        self, rows: RegressionProblem, weights: Float[np.ndarray, " joints"]
    ) -> tuple[Shapes, SeparableRows, Found]:
        """What was looked for, in which rows, and where the search has ended.

        Args:
            rows: With the base parameters of the model.
            weights: Of the joints' rows.
        """
        shapes = Shapes.of(rows.base, self.free)
        separable = SeparableRows(rows, shapes)
        start = shapes.values(rows.base)
        search = Search(separable, weights, start)
        return shapes, separable, search(_beginning(search, rows.base, shapes, start))


def not_converged(found: Found) -> tuple[str, ...]:
    """Says so where a search was given up."""
    if found.success:
        return ()
    return (
        f"the search for the shapes of friction has not converged in {found.steps} steps: the logs "
        "hardly determine some of them; look at their standard deviations, or pick fewer.",
    )


def _beginning(
    search: Search, base: BaseParameters, shapes: Shapes, start: Float[np.ndarray, " shapes"]
) -> Float[np.ndarray, " shapes"]:
    """For each joint the multiples of its shapes with which its own rows are explained best."""
    kinds, joints = len(shapes.chosen), shapes.robot.joints
    candidates = np.array(list(itertools.product(STARTS, repeat=min(kinds, 2))))
    multiples = np.ones((len(candidates), kinds))
    multiples[:, : candidates.shape[1]] = candidates
    grid = start.reshape(kinds, joints) * multiples[:, :, None]
    left = []
    for x in grid:
        projected = search.at(x.ravel())
        p = np.append(projected.linear, np.zeros(projected.factors.size - base.size))
        left.append(projected.factors.residual_squares(p))
    best = np.argmin(left, axis=0)
    return np.stack([grid[k, :, j] for j, k in enumerate(best)], axis=1).ravel()

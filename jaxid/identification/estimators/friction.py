r"""Variable projection: shapes of friction laws beside the linear parameters.

For shapes $x$ the best linear parameters are $c = N^+ z$, where $N = [A \; \Phi(x)]$. The residual,
$r = z - N c = P^\perp z$, is a function of the shapes alone. Its Jacobian is that of Golub and
Pereyra (1973), $-P^\perp \partial N\, c - (N^+)^T \partial N^T r$, exact since JAX differentiates
the friction laws. Everything is computed from the triangles of the rows.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy import optimize

from jaxid.arrays import Float
from jaxid.identification.estimators.estimate import AbstractEstimator
from jaxid.identification.estimators.friction_rows import (
    Selection,
    SeparableProblem,
    join_blocks,
    select_shapes,
)
from jaxid.identification.estimators.least_squares import WeightedLeastSquares
from jaxid.identification.estimators.solutions import Complete, Decomposition
from jaxid.identification.factors import Factors
from jaxid.identification.problem import RegressionProblem


class Projection(NamedTuple):
    """Problem at some shapes with the linear parameters eliminated.

    Attributes:
        linear: Best linear parameters.
        residual: Weighted residual, up to a rotation.
        jacobian: Derivatives of the residual with respect to the shapes.
    """

    linear: Float[np.ndarray, " base"]
    residual: Float[np.ndarray, " columns"]
    jacobian: Float[np.ndarray, "columns shapes"]


class ShapeSearch(NamedTuple):
    """Result of a search for shapes.

    Attributes:
        x: Shapes.
        linear: Best linear parameters for these shapes.
        steps: Number of steps of the search.
        success: Whether the search has converged.
    """

    x: Float[np.ndarray, " shapes"]
    linear: Float[np.ndarray, " base"]
    steps: int
    success: bool

    @property
    def notes(self) -> tuple[str, ...]:
        """Note about a search that has not converged."""
        if self.success:
            return ()
        return (
            f"the search for the shapes of friction has not converged in {self.steps} steps: the "
            "logs hardly determine some of them; look at their standard deviations, or select "
            "fewer.",
        )


class NonlinearFriction(AbstractEstimator):
    """Estimator of epsilons, Stribeck speeds and other shapes, and then of all parameters.

    The weights of the joints are those of the linear estimator at the shapes of the model; with the
    shapes found, it estimates again. The base parameters of the fit are those of the model with
    these shapes. Standard deviations assume that the shapes are known: `identify_nonlinear` also
    accounts for their uncertainty, and compares the result with the linear model.

    Attributes:
        linear: Estimator of the linear parameters.
        free: Function that selects leaves of the model's terms; by default epsilons, Stribeck
            speeds and others that the terms propose.
    """

    linear: AbstractEstimator = WeightedLeastSquares()
    free: Selection | None = eqx.field(static=True, default=None)

    def __call__(self, problem):
        """Search for the shapes, and estimate with them.

        Raises:
            InputError: If the model has no shapes, or only factors are known.
        """
        weights = np.asarray(self.linear(problem).weights)
        separable, found = self.search(problem, weights)
        base = separable.shapes.set(problem.base, found.x)
        estimate = self.linear(problem.with_base(base))
        return dataclasses.replace(estimate, notes=(*estimate.notes, *found.notes))

    def search(
        self, problem: RegressionProblem, weights: Float[np.ndarray, " joints"]
    ) -> tuple[SeparableProblem, ShapeSearch]:
        """Return the separable problem and the result of the search.

        Args:
            problem: Regression problem of the model.
            weights: Weights of the joints' rows.
        """
        separable = SeparableProblem(problem, select_shapes(problem.base, self.free))
        start = separable.shapes.values(problem.base)
        return separable, search_shapes(
            separable, weights, start, _best_multiples(separable, weights, start)
        )


def search_shapes(
    problem: SeparableProblem,
    weights: Float[np.ndarray, " joints"],
    start: Float[np.ndarray, " shapes"],
    begin: Float[np.ndarray, " shapes"] | None = None,
    blocks: Sequence[int] | None = None,
) -> ShapeSearch:
    """Search for shapes by Levenberg-Marquardt over their logarithms.

    Where the rows hardly determine a shape, a weak pull keeps it near `start`: as strong as one row
    that tells that it differs by a factor of ten.

    Args:
        problem: Separable problem.
        weights: Weights of the joints' rows.
        start: Shapes to which the pull leads.
        begin: Shapes at which the search begins; by default `start`.
        blocks: Blocks of time that count; by default all.
    """
    pull = np.log(10.0)
    last: dict[bytes, tuple[Factors, Projection]] = {}

    def at(x: np.ndarray) -> tuple[Factors, Projection]:
        key = x.tobytes()
        if key not in last:
            found = problem.blocks(x)
            factors = found.total if blocks is None else join_blocks(found, blocks)
            last.clear()
            last[key] = factors, project(problem, factors, weights)
        return last[key]

    x, steps, success = (start if begin is None else begin), 0, False
    # Twice, since the strength of the pull depends on the noise, which is known at the end only.
    for _ in range(2):
        factors, projection = at(x)
        dof = max(float(factors.rows.sum()) - problem.base.size, 1.0)
        scale = max(float(np.linalg.norm(projection.residual)) / np.sqrt(dof), 1e-300)

        def residual(u: np.ndarray, scale: float = scale) -> np.ndarray:
            return np.concatenate([at(start * np.exp(u))[1].residual / scale, u / pull])

        def jacobian(u: np.ndarray, scale: float = scale) -> np.ndarray:
            y = start * np.exp(u)
            return np.vstack([at(y)[1].jacobian * y / scale, np.eye(len(u)) / pull])

        options = {"jac": jacobian, "method": "lm", "xtol": 1e-4, "ftol": 1e-6, "max_nfev": 60}
        found = optimize.least_squares(residual, np.log(x / start), **options)
        x, steps, success = start * np.exp(found.x), steps + found.nfev, bool(found.success)
    return ShapeSearch(x, at(x)[1].linear, steps, success)


def project(
    problem: SeparableProblem, factors: Factors, weights: Float[np.ndarray, " joints"]
) -> Projection:
    """Eliminate the linear parameters, and differentiate the residual.

    Args:
        problem: Separable problem.
        factors: Factors of all columns at some shapes, of all rows or a part of them.
        weights: Weights of the joints' rows.
    """
    size, shapes = problem.base.size, problem.shapes.size
    R, z = factors.weighted(weights)
    missing = problem.size + 1 - len(R)
    R, z = np.pad(R, ((0, missing), (0, 0))), np.pad(z, (0, missing))
    N, slopes = R[:, :size], R[:, size:]
    decomposition = Decomposition.of(N, z)
    inverse = Complete().inverse(decomposition.values)
    B = decomposition.inverse_information(inverse)
    c = decomposition.solve(inverse)
    residual = z - N @ c
    # Derivatives of N c, and of N^T times the residual.
    forces, products = np.zeros((len(R), shapes)), np.zeros((size, shapes))
    for place, (v, k) in enumerate(problem.pairs):
        column = problem.varying[v]
        forces[:, k] += c[column] * slopes[:, place]
        products[column, k] += slopes[:, place] @ residual
    orthogonal = forces - N @ (B @ (N.T @ forces))
    return Projection(c, residual, -orthogonal - N @ (B @ products))


def _best_multiples(
    problem: SeparableProblem, weights: np.ndarray, start: Float[np.ndarray, " shapes"]
) -> Float[np.ndarray, " shapes"]:
    """Return for each joint the multiples of its shapes that explain its own rows best."""
    kinds, joints = len(problem.shapes.members), problem.shapes.robot.joints
    candidates = np.array(list(itertools.product((0.2, 1.0, 5.0), repeat=min(kinds, 2))))
    multiples = np.ones((len(candidates), kinds))
    multiples[:, : candidates.shape[1]] = candidates
    grid = start.reshape(kinds, joints) * multiples[:, :, None]
    squares = []
    for x in grid:
        factors = problem.blocks(x.ravel()).total
        linear = project(problem, factors, weights).linear
        p = np.append(linear, np.zeros(factors.size - problem.base.size))
        squares.append(factors.residual_squares(p))
    best = np.argmin(squares, axis=0)
    return np.stack([grid[k, :, j] for j, k in enumerate(best)], axis=1).ravel()

"""Estimates relative to a prior: what data leave open stays as a CAD model says."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.estimators import AbstractEstimator, WeightedLeastSquares
from jaxid.identification.factors import Blocks, Factors
from jaxid.identification.problem import RegressionProblem, Span
from jaxid.identification.solutions import CrossValidated


class RelativeTo(AbstractEstimator):
    r"""Another estimator, applied to what a prior leaves of the forces.

    A regularised solution, which keeps small what data hardly decide, then keeps such parameters
    near those of the prior instead of near zero: a ridge towards a CAD model minimises
    $\|W (Q - \Theta p)\|^2 + \lambda^2 \|D (p - p_0)\|^2$. Without regularisation nothing changes.
    For a pull of whole bodies that respects what can exist (a Bregman divergence) see
    `PhysicallyConsistent` and `EntropicPull`.

    Attributes:
        parameters: Standard parameters of the prior, in the model's order.
        estimator: Weighted least squares with a ridge as strong as left-out time asks for, by
            default.
    """

    parameters: Float[AnyArray, " standard"]
    estimator: AbstractEstimator = eqx.field(
        default_factory=lambda: WeightedLeastSquares(solution=CrossValidated())
    )

    def __call__(self, rows):
        """Subtracts the prior's forces, estimates, and adds the prior.

        Raises:
            InputError: If there is not one for each standard parameter, or the estimator refuses.
        """
        size = rows.base.model.size
        if np.shape(self.parameters) != (size,):
            raise InputError(
                f"`parameters` of `RelativeTo` must be the {size} standard parameters of the "
                f"model, but have the shape {np.shape(self.parameters)}."
            )
        found = self.estimator(_Relative(rows, np.asarray(self.parameters)))
        origin = np.asarray(found.base.from_standard(self.parameters))
        standard = None if found.standard is None else found.standard + np.asarray(self.parameters)
        return dataclasses.replace(
            found,
            parameters=np.asarray(found.parameters) + origin,
            blocks=moved(found.blocks, -origin),
            standard=standard,
        )


class _Relative(RegressionProblem):
    """Rows whose forces are those that a prior does not explain."""

    def __init__(self, whole: RegressionProblem, prior: np.ndarray):
        self._whole, self._prior = whole, prior
        self._origin = np.asarray(whole.base.from_standard(prior))
        blocks = moved(whole.blocks, self._origin)
        super().__init__(whole.base, whole.recordings, whole.progress, blocks=blocks)

    def with_base(self, base: BaseParameters) -> RegressionProblem:
        return _Relative(self._whole.with_base(base), self._prior)

    def chunks(self, spans: Sequence[Span] | None = None):
        for chunk, forces in self._whole.residuals(self._origin, spans):
            yield chunk._replace(forces=forces)


def moved(blocks: Blocks, origin: Float[np.ndarray, " base"]) -> Blocks:
    """The factors of the same rows with the forces of some parameters subtracted."""
    parts = []
    for part in blocks.parts:
        joints = []
        for joint in part.joints:
            R = np.array(joint.R)
            R[:, -1] -= R[:, :-1] @ origin[list(joint.columns)]
            joints.append(dataclasses.replace(joint, R=R))
        parts.append(Factors(tuple(joints), part.size))
    return Blocks(tuple(parts))

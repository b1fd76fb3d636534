r"""What a motion tells of the base parameters: the information matrix $\Theta_B^T W^2 \Theta_B$."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.compiled import regressor_rows
from jaxid.dynamics.joint_rows import JointRows
from jaxid.dynamics.motion import Motion
from jaxid.trajectory.basis import AbstractBasis


class Information(eqx.Module):
    r"""The information of an experiment, as criteria need it.

    Attributes:
        plain: The paper's $\Lambda = \Theta_B^T \Theta_B$ (Eq. 36).
        weighted: The same in units of the noise, with what was known before; its inverse is the
            covariance of weighted least squares.
        sizes: A size of each parameter, in its own unit.
    """

    plain: Float[AnyArray, "*batch base base"]
    weighted: Float[AnyArray, "*batch base base"]
    sizes: Float[AnyArray, " base"]


class InformationMap(eqx.Module):
    """From the numbers of a trajectory to its information, for many trajectories at once.

    Attributes:
        rows: The base regressor, joint by joint.
        motion: Position, velocity and acceleration of a joint at the samples, by its numbers.
        repeats: Measured samples that each evaluated one stands for.
        weights: One over the standard deviation of each joint's noise [1/(N m) or 1/N].
        prior: Information of earlier experiments.
        sizes: A size of each parameter.
    """

    rows: JointRows
    motion: Float[AnyArray, "3 samples variables"]
    repeats: float
    weights: Float[AnyArray, " joints"]
    prior: Float[AnyArray, "base base"]
    sizes: Float[AnyArray, " base"]

    @classmethod
    def of(
        cls,
        base: BaseParameters,
        basis: AbstractBasis,
        *,
        evaluated: int,
        measured: int,
        weights: Float[AnyArray, " joints"],
        prior: Float[AnyArray, "base base"],
        sizes: Float[AnyArray, " base"],
    ) -> "InformationMap":
        """Evaluates a motion at few samples, and counts them as if all had been measured."""
        motion = basis.rows(basis.times(evaluated))[:3]
        rows = JointRows.of_base(base).for_gradients
        return cls(rows, motion, measured / evaluated, weights, prior, sizes)

    def __call__(self, x: Float[AnyArray, "starts joints variables"]) -> Information:
        """The information of some trajectories of the basis."""
        arrays = [jnp.einsum("sk,bjk->jbs", part, x) for part in np.asarray(self.motion)]
        plain = jnp.zeros((x.shape[0], self.rows.size, self.rows.size), x.dtype)
        weighted = plain
        for own, columns, w in zip(
            self.rows.columns, self.rows(*arrays), self.weights, strict=True
        ):
            k = np.array(own, int)
            gram = self.repeats * jnp.asarray(_gram(columns))
            plain = plain.at[:, k[:, None], k].add(gram)
            weighted = weighted.at[:, k[:, None], k].add(w**2 * gram)
        return Information(plain, weighted + self.prior[None], self.sizes)


def information(
    base: BaseParameters,
    motion: Motion,
    weights: Float[AnyArray, " joints"],
    prior: Float[AnyArray, "base base"] | None = None,
    sizes: Float[AnyArray, " base"] | None = None,
) -> Information:
    """The information of one motion, sample by sample in NumPy (Eq. 36).

    Args:
        base: The base parameters.
        motion: All samples that will be measured.
        weights: One over the standard deviation of each joint's noise [1/(N m) or 1/N].
        prior: Information of earlier experiments; none if None.
        sizes: A size of each parameter; one if None.
    """
    plain = np.zeros((base.size, base.size))
    weighted = plain.copy() if prior is None else np.array(prior, np.float64)
    rows = JointRows.of_base(base)
    for own, theta, w in zip(
        rows.columns, regressor_rows(base, motion), np.asarray(weights), strict=True
    ):
        gram = theta.T @ theta
        place = np.ix_(own, own)
        plain[place] += gram
        weighted[place] += w**2 * gram
    return Information(plain, weighted, np.ones(base.size) if sizes is None else sizes)


@jax.custom_vjp
def _gram(
    columns: Float[Array, "starts columns samples"],
) -> Float[Array, "starts columns columns"]:
    """Products of columns; their derivative takes one product, where the plain rule takes two."""
    return jnp.einsum("bis,bjs->bij", columns, columns)


def _gram_forward(columns: Array) -> tuple[Array, Array]:
    return _gram(columns), columns


def _gram_backward(columns: Array, g: Array) -> tuple[Array]:
    return (jnp.einsum("bij,bjs->bis", g + jnp.swapaxes(g, 1, 2), columns),)


_gram.defvjp(_gram_forward, _gram_backward)

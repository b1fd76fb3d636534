"""How single rows move an estimate: what its uncertainty is computed from."""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.identification.factors import RowChunk


class Channel(NamedTuple):
    r"""One series of equations, $u_t = \theta_t (p - \hat p) + $ disturbance; a joint's, as a rule.

    The estimate moves by $B \sum_t z_t u_t$. Rows that do not count are zero.

    Attributes:
        columns: The base parameters in question.
        instruments: $z_t$ [rows, columns]: for least squares the equations themselves.
        equations: $\theta_t$ [rows, columns], weighted.
        disturbance: $u_t$ [rows]: residuals, weighted.
        counted: Number of rows that count.
    """

    columns: tuple[int, ...]
    instruments: np.ndarray
    equations: np.ndarray
    disturbance: np.ndarray
    counted: int


class AbstractInfluence(eqx.Module):
    """How an estimator's rows enter its estimate."""

    @abstractmethod
    def channels(
        self, chunk: RowChunk, residuals: Float[np.ndarray, "rows joints"]
    ) -> list[Channel]:
        """The equations of some rows, as they count.

        Args:
            chunk: The rows.
            residuals: What the estimate leaves of the forces [N m or N].
        """


class ByJoint(AbstractInfluence):
    """Least squares whose rows are weighted by joint.

    Attributes:
        weights: Of the joints' rows [1/(N m) or 1/N].
    """

    weights: Float[AnyArray, " joints"]

    def channels(self, chunk, residuals):
        """One channel for each joint."""
        found = []
        for j, (theta, own) in enumerate(zip(chunk.columns, chunk.indices, strict=True)):
            counted = chunk.mask[:, j]
            rows = np.where(counted, np.asarray(self.weights)[j], 0.0)
            weighted = rows[:, None] * theta
            disturbance = rows * residuals[:, j]
            found.append(Channel(own, weighted, weighted, disturbance, int(counted.sum())))
        return found

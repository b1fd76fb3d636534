"""Solutions of the weighted least-squares system: complete, truncated or regularised (Eq. 33)."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.identification.factors import Blocks

NUMERICAL = 1e-11
"""Relative singular value below which a direction is only rounding."""


class Decomposition(eqx.Module):
    """Singular value decomposition of the weighted observation matrix with columns of length one.

    Scaled columns make the result independent of units. Columns of zeros or of rounding stay zero.

    Attributes:
        scale: Lengths of the columns.
        values: Singular values, in falling order.
        directions: Right singular vectors of the scaled parameters, as rows.
        forces: Weighted forces along the left singular vectors.
        rest: Norm of the forces that the columns cannot explain.
    """

    scale: Float[AnyArray, " base"]
    values: Float[AnyArray, " base"]
    directions: Float[AnyArray, "base base"]
    forces: Float[AnyArray, " base"]
    rest: float

    @classmethod
    def of(
        cls, R: Float[AnyArray, "height base"], z: Float[AnyArray, " height"]
    ) -> "Decomposition":
        """Decompose a weighted factor and its right-hand side."""
        R, z = np.asarray(R), np.asarray(z)
        size = R.shape[1]
        if len(R) < size:
            R = np.vstack([R, np.zeros((size - len(R), size))])
            z = np.append(z, np.zeros(size - len(z)))
        norms = np.linalg.norm(R, axis=0)
        # Shorter columns are rounding: units may differ by less.
        present = norms > 1e-13 * norms.max(initial=0.0)
        scale = np.where(present, norms, 1.0)
        U, s, Vt = np.linalg.svd(np.where(present, R / scale, 0.0), full_matrices=False)
        forces = U.T @ z
        rest = float(np.sqrt(max(z @ z - forces @ forces, 0.0)))
        return cls(scale, s, Vt, forces, rest)

    def solve(self, inverse: Float[AnyArray, " base"]) -> Float[np.ndarray, " base"]:
        """Return the parameters for an inverse of the information along each direction."""
        along = np.asarray(inverse) * np.asarray(self.values) * np.asarray(self.forces)
        return np.asarray(self.directions).T @ along / np.asarray(self.scale)

    def inverse_information(
        self, inverse: Float[AnyArray, " base"]
    ) -> Float[np.ndarray, "base base"]:
        """Return the inverse of the information, or its substitute, in the parameters' units."""
        V = np.asarray(self.directions) / np.asarray(self.scale)
        return (V.T * np.asarray(inverse)) @ V


class AbstractSolution(eqx.Module):
    """A solution of a weighted least-squares system (Eq. 33)."""

    @abstractmethod
    def choose(
        self, blocks: Blocks, weights: Float[AnyArray, " joints"]
    ) -> "AbstractSpectralSolution":
        """Return the solution for these observations, all its settings determined."""


class AbstractSpectralSolution(AbstractSolution):
    r"""A solution that treats each direction by its singular value.

    The parameters are $B \Theta^T W^2 Q$, where $B$ is a substitute of the inverse information.
    """

    @abstractmethod
    def inverse(self, values: Float[AnyArray, " base"]) -> Float[np.ndarray, " base"]:
        """Return the substitute of 1 / value² for each singular value."""

    def choose(self, blocks, weights):
        """Return this solution."""
        return self


class Complete(AbstractSpectralSolution):
    """Ordinary least squares: all directions except those of rounding (Eq. 33)."""

    def inverse(self, values):
        """Return the inverse squares; zero for directions of rounding."""
        return _truncated_inverse(values, NUMERICAL)


class Truncated(AbstractSpectralSolution):
    """Only well-determined directions; along the others the parameters are zero.

    Attributes:
        rcond: Smallest singular value that is kept, relative to the largest, with scaled columns.
    """

    rcond: float = eqx.field(static=True, default=1e-2)

    def __check_init__(self):
        if not 0.0 <= self.rcond < 1.0:
            raise InputError(
                f"`rcond` of `Truncated` must be at least 0 and below 1, but is {self.rcond}: from "
                "1 on nothing would be left."
            )

    def inverse(self, values):
        """Return the inverse squares; zero for weak directions."""
        return _truncated_inverse(values, max(self.rcond, NUMERICAL))


class Ridge(AbstractSpectralSolution):
    """Least squares that pull weak directions towards zero (Tikhonov).

    Attributes:
        strength: Singular value, relative to the largest and with scaled columns, at which
            parameters are halved.
    """

    strength: float = eqx.field(static=True, default=1e-2)

    def __check_init__(self):
        if not 0.0 <= self.strength < np.inf:
            raise InputError(
                "`strength` of `Ridge` must be a finite number of at least 0, but is "
                f"{self.strength}."
            )

    def inverse(self, values):
        """Return bounded inverse squares."""
        s = np.asarray(values)
        return 1.0 / (s**2 + (max(self.strength, NUMERICAL) * s.max(initial=0.0)) ** 2)


class CrossValidated(AbstractSolution):
    """The strongest of several solutions whose held-out error is about the smallest.

    Each solution is computed without one contiguous block of time and tested on it. Of those whose
    error lies within one standard error of the smallest, the strongest is taken: neighbouring
    blocks are similar, and other motions are not.

    Attributes:
        candidates: Solutions, from the weakest to the strongest.
    """

    candidates: tuple[AbstractSpectralSolution, ...] = tuple(
        Ridge(float(strength)) for strength in np.geomspace(1e-4, 0.5, 25)
    )

    def choose(self, blocks, weights):
        """Test every candidate on every block."""
        errors = np.array(self.errors(blocks, weights))
        total = errors.sum(axis=1)
        best = int(np.argmin(total))
        margin = errors[best].std(ddof=1) * np.sqrt(errors.shape[1])
        within = np.flatnonzero(total <= total[best] + margin)
        return self.candidates[int(within.max())]

    def errors(
        self, blocks: Blocks, weights: Float[AnyArray, " joints"]
    ) -> Float[np.ndarray, "candidates blocks"]:
        """Return the sums of the squared weighted residuals of each held-out block.

        Raises:
            InputError: If there are fewer than two blocks.
        """
        if len(blocks.parts) < 2:
            raise InputError(
                "cross-validation needs at least two `blocks` of rows, but there is one."
            )
        squares = np.asarray(weights) ** 2
        errors = np.empty((len(self.candidates), len(blocks.parts)))
        for k, held_out in enumerate(blocks.parts):
            decomposition = Decomposition.of(*blocks.without(k).weighted(weights))
            for i, candidate in enumerate(self.candidates):
                p = decomposition.solve(candidate.inverse(decomposition.values))
                errors[i, k] = squares @ held_out.residual_squares(p)
        return errors


def _truncated_inverse(
    values: Float[AnyArray, " base"], rcond: float
) -> Float[np.ndarray, " base"]:
    s = np.asarray(values)
    kept = s > rcond * s.max(initial=0.0)
    return np.where(kept, 1.0 / np.where(kept, s, 1.0) ** 2, 0.0)

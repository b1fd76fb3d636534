"""Least squares from factors: how much weight each direction of the parameters gets (Eq. 33)."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.identification.factors import Blocks

NUMERICAL = 1e-11
"""Singular values below this share of the largest are rounding."""
FELT = 1e-13
"""Columns below this share of the longest are rounding: units may differ by less."""


class Decomposition(eqx.Module):
    """Singular values of the weighted observation matrix with its columns scaled to length one.

    Scaled columns make the answer independent of units. A column of zeros stays zero, and so does
    one of nothing but rounding.

    Attributes:
        scale: Lengths of the columns.
        values: Singular values, falling.
        directions: Rows are the directions in the scaled parameters.
        forces: The weighted forces along the left singular vectors.
        rest: Norm of what the columns cannot explain.
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
        """Decomposes a weighted factor and its right-hand side."""
        R, z = np.asarray(R), np.asarray(z)
        size = R.shape[1]
        if len(R) < size:
            R = np.vstack([R, np.zeros((size - len(R), size))])
            z = np.append(z, np.zeros(size - len(z)))
        norms = np.linalg.norm(R, axis=0)
        felt = norms > FELT * norms.max(initial=0.0)
        scale = np.where(felt, norms, 1.0)
        U, s, Vt = np.linalg.svd(np.where(felt, R / scale, 0.0), full_matrices=False)
        forces = U.T @ z
        rest = float(np.sqrt(max(z @ z - forces @ forces, 0.0)))
        return cls(scale, s, Vt, forces, rest)

    def solve(self, inverse: Float[AnyArray, " base"]) -> Float[np.ndarray, " base"]:
        """Parameters, with the inverse of the information along each direction."""
        along = np.asarray(inverse) * np.asarray(self.values) * np.asarray(self.forces)
        return np.asarray(self.directions).T @ along / np.asarray(self.scale)

    def inverse_information(
        self, inverse: Float[AnyArray, " base"]
    ) -> Float[np.ndarray, "base base"]:
        """What takes the place of the inverse of the information, in the parameters' units."""
        V = np.asarray(self.directions) / np.asarray(self.scale)
        return (V.T * np.asarray(inverse)) @ V


class AbstractSolution(eqx.Module):
    """A way to solve a weighted least-squares problem (Eq. 33)."""

    @abstractmethod
    def choose(
        self, blocks: Blocks, weights: Float[AnyArray, " joints"]
    ) -> "AbstractSpectralSolution":
        """The solution for these observations, with everything that it chooses chosen."""


class AbstractSpectralSolution(AbstractSolution):
    r"""A solution that treats each direction by its singular value.

    The parameters are $B \Theta^T W^2 Q$, where $B$ takes the place of the inverse of the
    information.
    """

    @abstractmethod
    def inverse(self, values: Float[AnyArray, " base"]) -> Float[np.ndarray, " base"]:
        """What takes the place of 1 / value² for each singular value."""

    def choose(self, blocks, weights):
        """Has nothing to choose."""
        return self


class Complete(AbstractSpectralSolution):
    """Every direction that is more than rounding: least squares as they are meant (Eq. 33)."""

    def inverse(self, values):
        """Leaves out only what is nothing but rounding."""
        return _above(values, NUMERICAL)


class Truncated(AbstractSpectralSolution):
    """Only directions that the data decide well; along the others the parameters stay zero.

    Attributes:
        share: Directions whose singular value, with scaled columns, is below this share of the
            largest are left out.
    """

    share: float = eqx.field(static=True, default=1e-2)

    def __check_init__(self):
        if not 0.0 <= self.share < 1.0:
            raise InputError(
                f"`share` of `Truncated` must be at least 0 and below 1, but is {self.share}: from "
                "1 on nothing would be left."
            )

    def inverse(self, values):
        """Leaves out weak directions."""
        return _above(values, max(self.share, NUMERICAL))


class Ridge(AbstractSpectralSolution):
    """Least squares that pull weak directions towards zero (Tikhonov).

    Attributes:
        share: Directions whose singular value, with scaled columns, is this share of the largest
            are halved.
    """

    share: float = eqx.field(static=True, default=1e-2)

    def __check_init__(self):
        if not 0.0 <= self.share < np.inf:
            raise InputError(
                f"`share` of `Ridge` must be a finite number of at least 0, but is {self.share}."
            )

    def inverse(self, values):
        """Bounds the inverse."""
        s = np.asarray(values)
        return 1.0 / (s**2 + (max(self.share, NUMERICAL) * s.max(initial=0.0)) ** 2)


class CrossValidated(AbstractSolution):
    """The strongest of several solutions that predicts left-out time as well as the best one does.

    The observations are divided into contiguous blocks of time. Each solution is found without one
    block and judged on it. Of those whose error lies within one standard error of the smallest, the
    strongest is taken: neighbouring blocks are alike, and other motions are not.

    Attributes:
        candidates: From the weakest to the strongest.
    """

    candidates: tuple[AbstractSpectralSolution, ...] = tuple(
        Ridge(float(share)) for share in np.geomspace(1e-4, 0.5, 25)
    )

    def choose(self, blocks, weights):
        """Judges every candidate on every block."""
        errors = np.array(self.errors(blocks, weights))
        total = errors.sum(axis=1)
        best = int(np.argmin(total))
        margin = errors[best].std(ddof=1) * np.sqrt(errors.shape[1])
        within = np.flatnonzero(total <= total[best] + margin)
        return self.candidates[int(within.max())]

    def errors(
        self, blocks: Blocks, weights: Float[AnyArray, " joints"]
    ) -> Float[np.ndarray, "candidates blocks"]:
        """Sums of the squared weighted residuals of each block left out.

        Raises:
            InputError: If there are fewer than two blocks.
        """
        if len(blocks.parts) < 2:
            raise InputError(
                "cross-validation needs at least two blocks of rows, but there is one."
            )
        squares = np.asarray(weights) ** 2
        errors = np.empty((len(self.candidates), len(blocks.parts)))
        for k, left_out in enumerate(blocks.parts):
            decomposition = Decomposition.of(*blocks.without(k).weighted(weights))
            for i, candidate in enumerate(self.candidates):
                p = decomposition.solve(candidate.inverse(decomposition.values))
                errors[i, k] = squares @ left_out.residual_squares(p)
        return errors


def _above(values: Float[AnyArray, " base"], share: float) -> Float[np.ndarray, " base"]:
    s = np.asarray(values)
    kept = s > share * s.max(initial=0.0)
    return np.where(kept, 1.0 / np.where(kept, s, 1.0) ** 2, 0.0)

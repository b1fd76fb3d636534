"""Least squares from a triangular factor: which directions of the parameters the data decide."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.types import AnyArray, Float

NUMERICAL = 1e-11
"""Singular values below this share of the largest are rounding."""


class Solved(eqx.Module):
    r"""Parameters, and the inverse of the information as far as the data decide.

    Attributes:
        parameters: The solution.
        root: Matrix $S$ with $S S^T = (\Theta^T W^2 \Theta)^{-1}$ on the directions that are kept.
        kept: Number of directions that are kept.
    """

    parameters: Float[AnyArray, " base"]
    root: Float[AnyArray, "base kept"]
    kept: int = eqx.field(static=True)


class Decomposition(eqx.Module):
    """Singular values of the observation matrix with its columns scaled to length one.

    Scaled columns make the answer independent of units. A column of zeros stays zero.

    Attributes:
        scale: Lengths of the columns.
        values: Singular values, falling.
        directions: Rows are the directions in the scaled parameters.
        forces: The forces along the left singular vectors.
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
        scale = np.where(norms > 0, norms, 1.0)
        U, s, Vt = np.linalg.svd(R / scale, full_matrices=False)
        forces = U.T @ z
        rest = float(np.sqrt(max(z @ z - forces @ forces, 0.0)))
        return cls(scale, s, Vt, forces, rest)

    def solve(self, kept: int) -> Solved:
        """The solution of least norm (in scaled parameters) in the first directions."""
        V, s = np.asarray(self.directions)[:kept], np.asarray(self.values)[:kept]
        scale = np.asarray(self.scale)
        x = V.T @ (np.asarray(self.forces)[:kept] / s)
        return Solved(x / scale, (V.T / s) / scale[:, None], kept)

    @property
    def rank(self) -> int:
        """Number of directions that are more than rounding."""
        s = np.asarray(self.values)
        return int(np.count_nonzero(s > NUMERICAL * s.max(initial=0.0)))


class AbstractSolution(eqx.Module):
    """A way to solve a weighted least-squares problem (Eq. 33)."""

    @abstractmethod
    def __call__(self, R: Float[AnyArray, "height base"], z: Float[AnyArray, " height"]) -> Solved:
        r"""Minimises $|R p - z|^2$ as far as the data decide."""


class Complete(AbstractSolution):
    """Every direction that is more than rounding: least squares as they are meant (Eq. 33)."""

    def __call__(self, R, z):
        """Leaves out only what is nothing but rounding."""
        decomposition = Decomposition.of(R, z)
        return decomposition.solve(decomposition.rank)


class Truncated(AbstractSolution):
    """Only directions that the data decide well; the others stay zero.

    Attributes:
        share: Directions whose singular value, with scaled columns, is below this share of the
            largest are left out.
    """

    share: float = eqx.field(static=True, default=1e-2)

    def __call__(self, R, z):
        """Leaves out weak directions."""
        decomposition = Decomposition.of(R, z)
        s = np.asarray(decomposition.values)
        kept = int(np.count_nonzero(s > max(self.share, NUMERICAL) * s[0]))
        return decomposition.solve(kept)

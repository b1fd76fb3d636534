"""Which columns of a matrix depend on those before them (Eqs. 20-22).

Two independent ways to the same answer: Gram-Schmidt in column order, which is a QR decomposition
whose dependent columns use up no direction, and the singular values of the whole matrix. Column
order decides what is chosen, so that the choice is the same for every sample of motions.
"""

from abc import abstractmethod

import equinox as eqx
import numpy as np
import scipy.linalg

from jaxid.arrays import AnyArray, Float, Int

ROUNDING = 1e-12
"""A column below this share of the largest one is nothing but rounding."""


class Dependence(eqx.Module):
    """Which columns are independent, and how clearly.

    Attributes:
        independent: Columns that no earlier ones can replace, in order.
        dependent: The others, in order.
        smallest_independent: Smallest measure of independence among the first.
        largest_dependent: Largest measure among the second.
    """

    independent: tuple[int, ...] = eqx.field(static=True)
    dependent: tuple[int, ...] = eqx.field(static=True)
    smallest_independent: float
    largest_dependent: float

    @property
    def gap(self) -> float:
        """How many times the smallest independent measure exceeds the largest dependent one."""
        return self.smallest_independent / max(self.largest_dependent, np.finfo(float).tiny)


class AbstractRankMethod(eqx.Module):
    """A way to decide which columns depend on earlier ones."""

    @abstractmethod
    def __call__(self, W: Float[AnyArray, "rows columns"]) -> Dependence:
        """Decides it for a matrix whose columns are of comparable size or zero."""


class GramSchmidt(AbstractRankMethod):
    """Gram-Schmidt in column order, orthogonalised again, relative to each column (Eq. 20).

    A dependent column uses up no direction, unlike in a plain QR decomposition without pivoting,
    and every column is measured against its own norm. So near-degenerate geometry is still told
    apart: an elbow offset of a micrometre.

    Attributes:
        tolerance: A column is dependent if less than this share of it is new.
    """

    tolerance: float = 1e-9

    def __call__(self, W):
        """Goes through the columns in order."""
        rows, columns = W.shape
        W = np.asarray(W, np.float64)
        norms = np.linalg.norm(W, axis=0)
        largest = norms.max(initial=0.0)
        Q = np.zeros((rows, min(rows, columns)))
        independent: list[int] = []
        dependent: list[int] = []
        new, old = [np.inf], [0.0]
        for k in range(columns):
            w, share = W[:, k], 0.0
            if norms[k] > ROUNDING * largest and len(independent) < rows:
                w = w / norms[k]
                basis = Q[:, : len(independent)]
                # Twice is enough unless almost nothing is left; the third pass costs little.
                for _ in range(3):
                    w = w - basis @ (basis.T @ w)
                share = float(np.linalg.norm(w))
            if share > self.tolerance:
                Q[:, len(independent)] = w / share
                independent.append(k)
                new.append(share)
            else:
                dependent.append(k)
                old.append(share)
        return Dependence(tuple(independent), tuple(dependent), min(new), max(old))


class SingularValues(AbstractRankMethod):
    """The null space from a singular value decomposition, the paper's alternative method.

    The rank is where the singular values fall by the largest factor. A column depends on earlier
    ones if some vector of the null space ends there: the null space is brought into that form by a
    QR decomposition with its columns reversed.

    Attributes:
        tolerance: Singular values above this share of the largest are never zero.
        rounding: Those below this share always are.
    """

    tolerance: float = 1e-6
    rounding: float = 1e-14

    def __call__(self, W):
        """Finds rank, null space, and where its vectors end."""
        W = np.asarray(W, np.float64)
        columns = W.shape[1]
        norms = np.linalg.norm(W, axis=0)
        live = norms > ROUNDING * norms.max(initial=0.0)
        scaled = np.where(live, W / np.where(live, norms, 1.0), 0.0)
        # The triangular factor has the same singular values and null space, and few rows.
        _, s, Vt = np.linalg.svd(np.linalg.qr(scaled, mode="r"), full_matrices=True)
        s = np.concatenate([s, np.zeros(columns - len(s))]) / max(s[0], np.finfo(float).tiny)
        floored = np.maximum(s, self.rounding)
        certain = int(np.count_nonzero(s > self.tolerance))
        drops = floored[:-1] / floored[1:]
        possible = np.arange(1, columns) >= certain
        rank = certain if not possible.any() else 1 + int(np.argmax(np.where(possible, drops, 0.0)))
        if columns and s[-1] > self.tolerance:
            rank = columns
        if not live.any():
            rank = 0
        null = Vt[rank:]
        dependent: list[int] = []
        # Eliminate from the last column backwards: a pivot found there is where a vector ends.
        for k in reversed(range(columns)):
            if not len(null):
                break
            pivot = null[:, k]
            if np.linalg.norm(pivot) < 1e-8:
                continue
            dependent.append(k)
            Q = np.linalg.qr(pivot[:, None], mode="complete").Q
            null = (Q.T @ null)[1:]
        chosen = tuple(sorted(dependent))
        independent = tuple(k for k in range(columns) if k not in set(chosen))
        small = s[rank] if rank < columns else 0.0
        return Dependence(independent, chosen, float(s[rank - 1]) if rank else np.inf, float(small))


def regrouping(
    W: Float[AnyArray, "rows columns"], dependence: Dependence
) -> tuple[Float[AnyArray, "base dependent"], float]:
    r"""The matrix $\kappa$ with $\hat\Theta_2 = \hat\Theta_1 \kappa$, and what it leaves (Eq. 22).

    Returns:
        $\kappa$, and the largest share of a dependent column that it does not explain.
    """
    W = np.asarray(W, np.float64)
    norms = np.linalg.norm(W, axis=0)
    floor = ROUNDING * norms.max(initial=0.0)
    scale = np.where(norms > floor, norms, 1.0)
    first, second = list(dependence.independent), list(dependence.dependent)
    W1, W2 = W[:, first] / scale[first], W[:, second] / scale[second]
    W2 = np.where(norms[second] > floor, W2, 0.0)
    kappa = solve_from_earlier(W1, W2, np.array(first, int), np.array(second, int))
    left = float(np.linalg.norm(W2 - W1 @ kappa, axis=0).max(initial=0.0))
    kappa = np.where(np.abs(kappa) > 1e-9, kappa, 0.0)
    return kappa * scale[second] / scale[first][:, None], left


def solve_from_earlier(
    W1: Float[np.ndarray, "rows base"],
    W2: Float[np.ndarray, "rows dependent"],
    first: Int[np.ndarray, " base"],
    second: Int[np.ndarray, " dependent"],
) -> Float[np.ndarray, "base dependent"]:
    """The combinations of independent columns closest to dependent ones, of earlier ones only.

    Args:
        W1: Independent columns.
        W2: Dependent columns.
        first: Where the independent columns stand, in ascending order.
        second: Where the dependent columns stand.
    """
    if not first.size:
        return np.zeros((0, len(second)))
    Q, R = np.linalg.qr(W1)
    earlier = first[:, None] < second
    kappa = scipy.linalg.solve_triangular(R, np.where(earlier, Q.T @ W2, 0.0))
    # One step of refinement takes out most of the rounding that poor conditioning amplifies.
    left = np.where(earlier, Q.T @ (W2 - W1 @ kappa), 0.0)
    return kappa + scipy.linalg.solve_triangular(R, left)

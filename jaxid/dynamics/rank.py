"""Rank of the regressor: columns that depend on those before them (Eqs. 20-22).

Two independent methods: Gram-Schmidt in column order, which is a QR decomposition
whose dependent columns use up no direction, and the singular values of the whole
matrix. Column order decides which columns are independent, so that the choice is the
same for all motions.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from jaxid.arrays import AnyArray, Float
from jaxid.units.dimensions import length_power

from .dispatch import in_numpy
from .model import Model
from .motion import Motion

ROUNDING = 1e-12
"""Fraction of the largest column below which a column is nothing but rounding."""


class Dependence(NamedTuple):
    """Independent and dependent columns of a matrix, and how clear the distinction is."""

    independent: tuple[int, ...]  # columns that no earlier ones can replace, in order
    dependent: tuple[int, ...]  # other columns, in order
    smallest_independent: float  # smallest measure of independence among the first
    largest_dependent: float  # largest measure among the second

    @property
    def gap(self) -> float:
        """Ratio of the smallest independent measure to the largest dependent one."""
        return self.smallest_independent / max(
            self.largest_dependent, np.finfo(float).tiny
        )


def gram_schmidt(
    W: Float[AnyArray, "rows columns"], tolerance: float = 1e-9
) -> Dependence:
    """Orthogonalise the columns in order, twice, each relative to its own norm (Eq. 20).

    A dependent column uses up no direction, unlike in a plain QR decomposition without
    pivoting, and every column is measured against its own norm. So near-degenerate
    geometry is still told
    apart: an elbow offset of a micrometre.
    """
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
            # Twice is enough unless almost nothing is left; the third pass costs
            # little.
            for _ in range(3):
                w = w - basis @ (basis.T @ w)
            share = float(np.linalg.norm(w))
        if share > tolerance:
            Q[:, len(independent)] = w / share
            independent.append(k)
            new.append(share)
        else:
            dependent.append(k)
            old.append(share)
    return Dependence(tuple(independent), tuple(dependent), min(new), max(old))


def singular_values(
    W: Float[AnyArray, "rows columns"], tolerance: float = 1e-6
) -> Dependence:
    """Find the null space by a singular value decomposition, the paper's alternative method.

    The rank is where the singular values fall by the largest factor. A column depends
    on earlier ones if some vector of the null space ends there: the null space is
    brought into that form by a QR decomposition with its columns reversed.
    """
    W = np.asarray(W, np.float64)
    columns = W.shape[1]
    norms = np.linalg.norm(W, axis=0)
    live = norms > ROUNDING * norms.max(initial=0.0)
    scaled = np.where(live, W / np.where(live, norms, 1.0), 0.0)
    # The triangular factor has the same singular values and null space, and few rows.
    _, s, Vt = np.linalg.svd(np.linalg.qr(scaled, mode="r"), full_matrices=True)
    s = np.concatenate([s, np.zeros(columns - len(s))]) / max(
        s[0], np.finfo(float).tiny
    )
    floored = np.maximum(s, 1e-14)  # all below are rounding
    certain = int(np.count_nonzero(s > tolerance))
    drops = floored[:-1] / floored[1:]
    possible = np.arange(1, columns) >= certain
    rank = (
        certain
        if not possible.any()
        else 1 + int(np.argmax(np.where(possible, drops, 0.0)))
    )
    rank = min(rank, np.count_nonzero(live))
    null = Vt[rank:]
    dependent: list[int] = []
    # Eliminate from the last column backwards: a pivot found there is where a vector
    # ends.
    for k in reversed(range(columns)):
        if not len(null):
            break
        pivot = null[:, k]
        if np.linalg.norm(pivot) < 1e-8:
            continue
        dependent.append(k)
        Q = np.linalg.qr(pivot[:, None], mode="complete").Q
        null = (Q.T @ null)[1:]
    independent = tuple(k for k in range(columns) if k not in set(dependent))
    smallest = float(s[rank - 1]) if rank else np.inf
    largest = float(s[rank]) if rank < columns else 0.0
    return Dependence(independent, tuple(sorted(dependent)), smallest, largest)


def regrouping(
    W: Float[AnyArray, "rows columns"],
    independent: Sequence[int] | np.ndarray,
    dependent: Sequence[int] | np.ndarray,
) -> tuple[Float[np.ndarray, "base dependent"], float, Float[np.ndarray, " base"]]:
    r"""Return $\kappa$ with $\hat\Theta_2 = \hat\Theta_1 \kappa$, and how exact it is (Eq. 22).

    A dependent column is a combination of independent columns before it. Beside
    $\kappa$ come the largest fraction of a dependent column that it does not explain,
    and the fraction of each independent column that those before it do not explain.
    """
    W = np.asarray(W, np.float64)
    norms = np.linalg.norm(W, axis=0)
    live = norms > ROUNDING * norms.max(initial=0.0)
    scale = np.where(live, norms, 1.0)
    W = np.where(live, W / scale, 0.0)
    first, second = np.array(independent, int), np.array(dependent, int)
    W1, W2 = W[:, first], W[:, second]
    Q, R = np.linalg.qr(W1)
    new = np.abs(np.diag(R))
    kappa = np.zeros((len(first), len(second)))
    if len(first) and new.min() > ROUNDING:
        # The second step takes out most of the rounding that poor conditioning
        # amplifies.
        for _ in range(2):
            left = np.where(first[:, None] < second, Q.T @ (W2 - W1 @ kappa), 0.0)
            kappa = kappa + scipy.linalg.solve_triangular(R, left)
    unexplained = float(np.linalg.norm(W2 - W1 @ kappa, axis=0).max(initial=0.0))
    kappa = np.where(np.abs(kappa) > 1e-9, kappa, 0.0)
    return kappa * scale[second] / scale[first][:, None], unexplained, new


def random_regressor(
    model: Model, seed: int
) -> tuple[Float[np.ndarray, "rows standard"], Float[np.ndarray, " standard"]]:
    r"""Return the regressor at random motions, stacked and free of units: $\Theta_{QR}$ (Eq. 20).

    Lengths are measured in the robot's own size, so that metres or millimetres make no
    difference. It is computed in float64, whatever the precision in which JAX runs.
    With it comes for each parameter the factor by which its column was multiplied.
    """
    samples = max(25, math.ceil(3.0 * model.size / model.robot.joints))
    motion = random_motion(model, samples, seed)
    theta = in_numpy(model, model.columns, motion.q, motion.qd, motion.qdd)
    rows, columns = row_units(model), column_units(model)
    return (theta * rows[:, None] * columns).reshape(-1, model.size), columns


def random_motion(model: Model, samples: int, seed: int) -> Motion:
    """Return uniformly random coordinates, velocities and accelerations.

    Every second sample is slow, by a random factor down to 1e-3: some friction is
    visible only there.
    """
    rng = np.random.default_rng(seed)
    shape = (samples, model.robot.joints)
    q, qd, qdd = (rng.uniform(-s, s, shape) * row_units(model) for s in (3.0, 3.0, 6.0))
    qd[1::2] *= 1e-3 ** rng.uniform(0.0, 1.0, qd[1::2].shape)
    return Motion(q, qd, qdd)


def row_units(model: Model) -> Float[np.ndarray, " joints"]:
    """Return the unit of each joint's coordinate: 1 rad, or the size of the robot [m]."""
    return np.where(np.array(model.robot.revolute), 1.0, characteristic_length(model))


def column_units(model: Model) -> Float[np.ndarray, " standard"]:
    """Return the unit of each parameter: the robot's size to the power of length in its unit."""
    size = characteristic_length(model)
    return np.array([size ** length_power(unit) for unit in model.parameter_units])


def characteristic_length(model: Model) -> float:
    """Return the size of the robot: the largest distance between neighbouring joints [m], or 1."""
    distances = np.linalg.norm(np.asarray(model.robot.offset), axis=-1)
    return float(distances.max()) if distances.any() else 1.0

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

from .model import Model
from .motion import Motion
from .packed_regressor import Columns
from .sample_methods import in_numpy

ROUNDING = 1e-12
"""Fraction of the largest column below which a column is nothing but rounding."""


class Dependence(NamedTuple):
    """Independent and dependent columns, and how clear the distinction is."""

    independent: Columns  # columns that no earlier ones can replace, in order
    dependent: Columns  # other columns, in order
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
    """Orthogonalise the columns in order, each relative to its norm (Eq. 20).

    A dependent column uses up no direction, unlike in a plain QR decomposition without
    pivoting, and every column is measured against its own norm. So near-degenerate
    geometry is still resolved: an elbow offset of a micrometre.
    """
    W = np.asarray(W, np.float64)
    rows, columns = W.shape
    norms = np.linalg.norm(W, axis=0)
    min_norm = ROUNDING * norms.max(initial=0.0)
    Q = np.zeros((rows, min(rows, columns)))
    shares = np.zeros(columns)  # fractions of columns that earlier ones do not explain
    independent: list[int] = []
    for k in range(columns):
        rank = len(independent)
        if norms[k] <= min_norm or rank == rows:
            continue
        # Relative to its own norm: a small column is not a dependent one.
        w = W[:, k] / norms[k]
        # Twice is enough unless almost nothing remains; the third pass costs little.
        for _ in range(3):
            w = w - Q[:, :rank] @ (Q[:, :rank].T @ w)
        shares[k] = np.linalg.norm(w)
        if shares[k] > tolerance:
            Q[:, rank] = w / shares[k]
            independent.append(k)

    dependent = [k for k in range(columns) if k not in set(independent)]
    min_share = shares[independent].min(initial=np.inf)
    max_share = shares[dependent].max(initial=0.0)
    return Dependence(
        tuple(independent), tuple(dependent), float(min_share), float(max_share)
    )


def singular_values(
    W: Float[AnyArray, "rows columns"], tolerance: float = 1e-6
) -> Dependence:
    """Find the null space by a singular value decomposition.

    It is the paper's alternative method. The rank is where the singular values fall by
    the largest factor. A column depends on earlier ones if some vector of the null
    space ends there.
    """
    unit_columns, norms = scale_columns(W)
    columns = len(norms)
    # The triangular factor has the same singular values and null space, and few rows.
    triangle = np.linalg.qr(unit_columns, mode="r")
    _, values, Vt = np.linalg.svd(triangle, full_matrices=True)
    s = np.zeros(columns)
    s[: len(values)] = values / max(values[0], np.finfo(float).tiny)

    max_rank = np.count_nonzero(norms)
    rank = min(_rank_at_largest_fall(s, tolerance), max_rank)
    dependent = _ends_of_null_vectors(Vt[rank:])
    independent = tuple(k for k in range(columns) if k not in dependent)
    min_share = float(s[rank - 1]) if rank else np.inf
    max_share = float(s[rank]) if rank < columns else 0.0
    return Dependence(independent, dependent, min_share, max_share)


def _rank_at_largest_fall(s: np.ndarray, tolerance: float) -> int:
    """Return the rank, behind which singular values fall the most."""
    min_rank = int(np.count_nonzero(s > tolerance))
    ranks = np.arange(1, len(s))
    is_possible = ranks >= min_rank
    if not is_possible.any():
        return min_rank
    values = np.maximum(s, 1e-14)  # all below are rounding
    falls = values[:-1] / values[1:]
    return int(ranks[np.argmax(np.where(is_possible, falls, 0.0))])


def _ends_of_null_vectors(
    null_space: Float[np.ndarray, "vectors columns"],
) -> Columns:
    """Return the columns at which vectors of the null space end."""
    ends: list[int] = []
    # Eliminate from the last column backwards: a pivot found there is where a vector
    # ends.
    for k in reversed(range(null_space.shape[1])):
        if not len(null_space):
            break
        pivot = null_space[:, k]
        if np.linalg.norm(pivot) < 1e-8:
            continue
        ends.append(k)
        Q = np.linalg.qr(pivot[:, None], mode="complete").Q
        null_space = (Q.T @ null_space)[1:]
    return tuple(sorted(ends))


def scale_columns(
    W: Float[AnyArray, "rows columns"],
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, " columns"]]:
    """Return a matrix with columns of length one, and their lengths before.

    Columns that are nothing but rounding become zero, and so does their length.
    """
    W = np.asarray(W, np.float64)
    norms = np.linalg.norm(W, axis=0)
    norms = np.where(norms > ROUNDING * norms.max(initial=0.0), norms, 0.0)
    divisors = np.where(norms > 0, norms, np.inf)
    return W / divisors, norms


class Regrouped(NamedTuple):
    r"""Dependent columns by independent ones: $\hat\Theta_2 = \hat\Theta_1 \kappa$."""

    kappa: Float[np.ndarray, "base dependent"]  # factors of the independent columns
    unexplained: float  # largest fraction of a dependent column that kappa misses
    # fractions of the independent columns that those before them do not explain
    shares: Float[np.ndarray, " base"]


def regrouping(
    W: Float[AnyArray, "rows columns"],
    independent: Sequence[int] | np.ndarray,
    dependent: Sequence[int] | np.ndarray,
) -> Regrouped:
    r"""Return $\kappa$ with $\hat\Theta_2 = \hat\Theta_1 \kappa$ (Eq. 22).

    A dependent column is a combination of independent columns before it.
    """
    leaders = np.array(independent, int)
    others = np.array(dependent, int)
    unit_columns, norms = scale_columns(W)
    W1 = unit_columns[:, leaders]
    W2 = unit_columns[:, others]
    # The diagonal of R is what each column adds to those before it.
    Q, R = np.linalg.qr(W1)
    shares = np.abs(np.diag(R))
    is_before = leaders[:, None] < others
    kappa = np.zeros((len(leaders), len(others)))
    if len(leaders) and shares.min() > ROUNDING:
        # The second step takes out most of the rounding that poor conditioning
        # amplifies.
        for _ in range(2):
            residuals = np.where(is_before, Q.T @ (W2 - W1 @ kappa), 0.0)
            kappa = kappa + scipy.linalg.solve_triangular(R, residuals)
    max_residual = np.linalg.norm(W2 - W1 @ kappa, axis=0).max(initial=0.0)

    kappa = np.where(np.abs(kappa) > 1e-9, kappa, 0.0)
    # Columns of nothing but rounding stay as they are.
    scale = np.where(norms > 0, norms, 1.0)
    kappa = kappa * scale[others] / scale[leaders][:, None]
    return Regrouped(kappa, float(max_residual), shares)


def random_regressor(
    model: Model, seed: int
) -> tuple[Float[np.ndarray, "rows standard"], Float[np.ndarray, " standard"]]:
    r"""Return the regressor $\Theta_{QR}$ at random motions, free of units (Eq. 20).

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
    units = row_units(model)
    q = rng.uniform(-3.0, 3.0, shape) * units
    qd = rng.uniform(-3.0, 3.0, shape) * units
    qdd = rng.uniform(-6.0, 6.0, shape) * units
    slow_samples = qd[1::2]
    slow_samples *= 1e-3 ** rng.uniform(0.0, 1.0, slow_samples.shape)
    return Motion(q, qd, qdd)


def row_units(model: Model) -> Float[np.ndarray, " joints"]:
    """Return the units of the coordinates: 1 rad, or the robot's size [m]."""
    return np.where(np.array(model.robot.revolute), 1.0, characteristic_length(model))


def column_units(model: Model) -> Float[np.ndarray, " standard"]:
    """Return the units of the parameters: powers of the robot's size."""
    size = characteristic_length(model)
    return np.array([size ** length_power(unit) for unit in model.parameter_units])


def characteristic_length(model: Model) -> float:
    """Return the largest distance between neighbouring joints [m], or 1."""
    distances = np.linalg.norm(np.asarray(model.robot.offset), axis=-1)
    return float(distances.max()) if distances.any() else 1.0

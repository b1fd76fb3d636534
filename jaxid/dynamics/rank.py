"""Rank of the regressor: columns that depend on those before them (Eqs. 20-22).

Gram-Schmidt in column order is a QR decomposition whose dependent columns use up no
direction. The singular values of the whole matrix confirm the rank. Column order
decides which columns are independent, so that the choice is the
same for all motions.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Matrix, Vector
from jaxid.program.sample_methods import in_numpy
from jaxid.robot.loop_closing import reachable
from jaxid.units.dimensions import length_power

from .model import Model
from .motion import Motion
from .packed_regressor import Columns

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
    independent_columns: list[int] = []
    for k in range(columns):
        rank = len(independent_columns)
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
            independent_columns.append(k)

    dependent_columns = [k for k in range(columns) if k not in set(independent_columns)]
    min_share = shares[independent_columns].min(initial=np.inf)
    max_share = shares[dependent_columns].max(initial=0.0)
    return Dependence(
        tuple(independent_columns),
        tuple(dependent_columns),
        float(min_share),
        float(max_share),
    )


def rank_by_singular_values(W: AnyArray, tolerance: float = 1e-6) -> int:
    """Return the rank: where the singular values fall by the largest factor.

    It is the paper's alternative method.

    Args:
        W: Matrix, whose columns are scaled to the same length.
        tolerance: Fraction of the largest singular value; larger ones always count.
    """
    unit_columns, norms = scale_columns(W)
    s = np.zeros(len(norms))
    # The triangular factor has the same singular values, and few rows.
    triangle = np.linalg.qr(unit_columns, mode="r")
    values = np.linalg.svd(triangle, compute_uv=False)
    largest_value = max(values[0], np.finfo(float).tiny)
    s[: len(values)] = values / largest_value
    rank = _rank_at_largest_fall(s, tolerance)
    return min(rank, int(np.count_nonzero(norms)))


def _rank_at_largest_fall(s: Vector, tolerance: float):
    """Return the rank, behind which singular values fall the most."""
    min_rank = int(np.count_nonzero(s > tolerance))
    ranks = np.arange(1, len(s))
    is_possible = ranks >= min_rank
    if not is_possible.any():
        return min_rank
    values = np.maximum(s, 1e-14)  # all below are rounding
    ratios = values[:-1] / values[1:]
    possible_falls = np.where(is_possible, ratios, 0.0)
    return int(ranks[np.argmax(possible_falls)])


def scale_columns(
    W: AnyArray,
) -> tuple[Matrix, Vector]:
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
    max_residual: float  # largest fraction of a dependent column that kappa misses
    # fractions of the independent columns that those before them do not explain
    shares: Float[np.ndarray, " base"]


def regrouping(
    W: AnyArray,
    independent: Sequence[int] | np.ndarray,
    dependent: Sequence[int] | np.ndarray,
) -> Regrouped:
    r"""Return $\kappa$ with $\hat\Theta_2 = \hat\Theta_1 \kappa$ (Eq. 22).

    A dependent column is a combination of independent columns before it.
    """
    leaders = np.array(independent, int)
    other_columns = np.array(dependent, int)
    unit_columns, norms = scale_columns(W)
    W1 = unit_columns[:, leaders]
    W2 = unit_columns[:, other_columns]
    # The diagonal of R is what each column adds to those before it.
    Q, R = np.linalg.qr(W1)
    shares = np.abs(np.diag(R))
    is_before = leaders[:, None] < other_columns
    kappa = np.zeros((len(leaders), len(other_columns)))
    if len(leaders) and shares.min() > ROUNDING:
        # The second step takes out most of the rounding that poor conditioning
        # amplifies.
        for _ in range(2):
            projections = Q.T @ (W2 - W1 @ kappa)
            residuals = np.where(is_before, projections, 0.0)
            kappa = kappa + scipy.linalg.solve_triangular(R, residuals)
    errors = np.linalg.norm(W2 - W1 @ kappa, axis=0)
    max_residual = errors.max(initial=0.0)

    kappa = np.where(np.abs(kappa) > 1e-9, kappa, 0.0)
    # Columns of nothing but rounding stay as they are.
    scale = np.where(norms > 0, norms, 1.0)
    leader_scale = scale[leaders]
    kappa = kappa * scale[other_columns] / leader_scale[:, None]
    return Regrouped(kappa, float(max_residual), shares)


def random_regressor(model: Model, seed: int) -> tuple[Matrix, Vector]:
    r"""Return the regressor $\Theta_{QR}$ at random motions, free of units (Eq. 20).

    Lengths are measured in the robot's own size, so that metres or millimetres make no
    difference. It is computed in float64, whatever the precision in which JAX runs.
    With it comes for each parameter the factor by which its column was multiplied.
    """
    joints = model.robot.joints
    samples = max(25, math.ceil(3.0 * model.size / joints))
    motion = random_motion(model, samples, seed)
    theta = in_numpy(model, model.columns, *model.arguments(motion))
    rows = row_units(model)
    columns = column_units(model)
    scaled_theta = theta * rows[:, None] * columns
    return scaled_theta.reshape(-1, model.size), columns


def random_motion(model: Model, samples: int, seed: int) -> Motion:
    """Return uniformly random coordinates, velocities and accelerations.

    Every second sample is slow, by a random factor down to 1e-3: some friction is
    visible only there.
    """
    rng = np.random.default_rng(seed)
    shape = (samples, model.robot.joints)
    units = row_units(model)
    q = reachable(model.robot, rng.uniform(-3.0, 3.0, shape) * units)
    qd = rng.uniform(-3.0, 3.0, shape) * units
    qdd = rng.uniform(-6.0, 6.0, shape) * units
    slow_samples = qd[1::2]
    exponents = rng.uniform(0.0, 1.0, slow_samples.shape)
    slow_samples *= 1e-3**exponents
    return Motion(q, qd, qdd)


def row_units(model: Model) -> Vector:
    """Return the units of the coordinates: 1 rad, or the robot's size [m]."""
    return np.where(np.array(model.robot.revolute), 1.0, characteristic_length(model))


def column_units(model: Model) -> Vector:
    """Return the units of the parameters: powers of the robot's size."""
    size = characteristic_length(model)
    return np.array([size ** length_power(unit) for unit in model.parameter_units])


def characteristic_length(model: Model) -> float:
    """Return the largest distance between neighbouring joints [m], or 1."""
    distances = np.linalg.norm(np.asarray(model.robot.offset), axis=-1)
    return float(distances.max()) if distances.any() else 1.0

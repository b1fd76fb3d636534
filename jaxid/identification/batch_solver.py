"""Least squares of a few data sets by the products of their rows, as one compiled computation.

Columns are evaluated for a group of data sets together; the products of the rows with each other
and with the forces (Gram matrices) and the solution follow for each, with one refinement by the
residuals themselves where products alone would lose digits.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Bool, Float
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.packed_regressor import JointRegressor
from jaxid.program.rules import divided

from .uncertainty.spectral import sandwich_of_columns

AT_ONCE, AT_ONCE_ON_GPU = 2048, 2**17
"""Samples up to which several data sets evaluate their columns together."""
WELL_CONDITIONED = 1e4
"""Condition number, with columns of length one, up to which products of rows are accurate enough;
beyond it a data set is solved again by orthogonal factors."""
RIDGE = 64 * np.finfo(float).eps


class BatchFit(eqx.Module):
    """Identified base parameters of many data sets.

    Attributes:
        parameters: Estimates; zero along what a data set does not determine.
        standard_deviations: Standard deviations by the spectral sandwich if the time between rows
            was given; otherwise naive. Infinite where nothing is known.
        residual_rms: RMS of the residuals of each joint [N m or N].
        condition_numbers: Condition numbers of each weighted observation matrix with columns of
            length one; an upper bound, at most the number of parameters too large, where it is well
            conditioned.
        determined: Whether a data set determines all parameters. Where it is False while JAX
            traces, the estimates are not to be used.
        naive_standard_deviations: Standard deviations for independent rows and a variance of each
            joint.
        dof: Degrees of freedom of each variance, for the t distribution.
    """

    parameters: Float[AnyArray, "*results base"]
    standard_deviations: Float[AnyArray, "*results base"]
    residual_rms: Float[AnyArray, "*results joints"]
    condition_numbers: Float[AnyArray, "*datasets"]
    determined: Bool[AnyArray, "*datasets"]
    naive_standard_deviations: Float[AnyArray, "*results base"]
    dof: Float[AnyArray, "*results base"]


class DataSets(NamedTuple):
    """Data sets of a batch, or one of them.

    Forces have an axis of draws before the samples. The mask is one for rows that count, and None
    if all count; `numbers` are those of the geometry [datasets, numbers], if robots differ.
    """

    motion: Motion
    forces: AnyArray
    weights: AnyArray
    mask: AnyArray | None
    numbers: AnyArray | None


@eqx.filter_jit
def solve(rows: JointRegressor, batch: DataSets, row_time: float | None = None) -> BatchFit:
    """Solve all data sets, a group at a time; devices divide them among themselves.

    With the time between two rows [s], standard deviations come from the spectral sandwich.
    """
    leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, batch))

    def solved(on_cpu: bool, *leaves: Array) -> BatchFit:
        return _solve_groups(rows, jax.tree.unflatten(tree, leaves), row_time, on_cpu)

    def on_any(*leaves: Array) -> BatchFit:
        return jax.lax.platform_dependent(
            *leaves, cpu=functools.partial(solved, True), default=functools.partial(solved, False)
        )

    return divided(on_any)(*leaves)


def _solve_groups(
    rows: JointRegressor, batch: DataSets, row_time: float | None, on_cpu: bool
) -> BatchFit:
    """Solve all data sets: on a CPU in small groups that stay in its cache."""
    datasets, samples, _ = batch.motion.q.shape
    at_once = AT_ONCE if on_cpu else AT_ONCE_ON_GPU
    calls = -(-datasets // max(1, min(at_once // samples, datasets)))
    group = -(-datasets // calls)
    whole = calls * group
    filled = np.arange(whole) % datasets
    groups = jax.tree.map(lambda x: x[filled].reshape(-1, group, *x.shape[1:]), batch)

    def one(pair: tuple[DataSets, list[Array]]) -> BatchFit:
        return _solve_one(rows, *pair, row_time, on_cpu)

    def solve_group(sets: DataSets) -> BatchFit:
        arrays = [jnp.moveaxis(x, -1, 0) for x in jax.tree.leaves(sets.motion)]
        if sets.numbers is not None:
            numbers = sets.numbers.T[:, :, None]
            arrays.insert(0, jnp.broadcast_to(numbers, (*numbers.shape[:2], samples)))
        # Columns of each joint [datasets, columns, samples].
        pairs = sets, rows(*arrays, fence=on_cpu)
        # A CPU multiplies the matrices of one data set faster than those of several together.
        return jax.lax.map(one, pairs) if on_cpu else jax.vmap(one)(pairs)

    fits = jax.lax.map(solve_group, groups)
    return jax.tree.map(lambda x: x.reshape((whole, *x.shape[2:]))[:datasets], fits)


def _solve_one(
    rows: JointRegressor, one: DataSets, A: list[Array], row_time: float | None, on_cpu: bool
) -> BatchFit:
    """Solve one data set by the products of its rows."""
    weights, places = one.weights, [np.array(own, int) for own in rows.columns]
    length, size = len(one.motion.q), rows.size
    Q = list(jnp.moveaxis(one.forces, -1, 0))
    if one.mask is not None:
        masks = one.mask.T[:, None] > 0
        A, Q = ([jnp.where(*x, 0.0) for x in zip(masks, y, strict=True)] for y in (A, Q))

    def weighted_sum(products: list[Array]) -> Array:
        """Add the weighted products of columns with forces [draws, base]."""
        sums = jnp.zeros((len(products[0]), size), weights.dtype)
        for k, y, w in zip(places, products, weights, strict=True):
            sums = sums.at[:, k].add(w**2 * y)
        return sums

    def along(p: Array, products: list[Array]) -> Array:
        """Multiply parameters and products, by joint [draws, joints]."""
        pairs = zip(places, products, strict=True)
        return jnp.stack([jnp.sum(p[:, k] * y, axis=-1) for k, y in pairs], axis=-1)

    count = jnp.full(weights.shape, 1.0 * length) if one.mask is None else one.mask.sum(axis=0)
    grams, (products, forces) = [theta @ theta.T for theta in A], _products(A, Q)
    whole = jnp.zeros((size, size), weights.dtype)
    for k, gram, w in zip(places, grams, weights, strict=True):
        whole = whole.at[k[:, None], k].add(w**2 * gram)
    inverse, condition = inverse_information(whole)
    p = weighted_sum(products) @ inverse
    felt = along(p, [p[:, k] @ gram for k, gram in zip(places, grams, strict=True)])
    squares = forces - 2 * along(p, products) + felt

    def refine() -> tuple[Array, Array]:
        joints = zip(Q, A, places, strict=True)
        residuals = [measured - p[:, k] @ theta for measured, theta, k in joints]
        products, squares = _products(A, residuals)
        step = weighted_sum(products) @ inverse
        # The squares at the refined parameters: what is of second order in the step is rounding.
        return p + step, squares - 2 * along(step, products)

    # Residuals themselves are only needed where differences of large numbers would lose digits.
    lost = (condition > 1e3) | jnp.any(squares < 1e-6 * forces)
    if on_cpu:
        p, squares = jax.lax.cond(lost, refine, lambda: (p, squares))
    else:
        # Under `vmap` both would be computed anyway.
        p, squares = (jnp.where(lost, x, y) for x, y in zip(refine(), (p, squares), strict=True))
    squares = jnp.maximum(squares, 0.0)
    free = jnp.maximum(1.0 - size / jnp.maximum(count.sum(), 1.0), 0.0)
    gains = [inverse[:, k] * w**2 for k, w in zip(places, weights, strict=True)]
    own = [jnp.sum((B @ gram) * B, axis=-1) for B, gram in zip(gains, grams, strict=True)]
    # See `Fit.covariance`.
    naive = squares / jnp.maximum(count * free, 1.0)[None] @ jnp.stack(own)
    naive = jnp.sqrt(jnp.maximum(naive, 0.0))
    deviations, dof = naive, jnp.broadcast_to(count.sum() - size, naive.shape)
    if row_time is not None:
        rest = A, Q, count / length, row_time
        variance, dof = sandwich_of_columns(rows.columns, weights, inverse, p, *rest)
        deviations = jnp.sqrt(jnp.maximum(variance, 0.0))
    return BatchFit(
        p,
        deviations,
        jnp.sqrt(squares / jnp.maximum(count, 1.0)[None]),
        condition,
        (condition < WELL_CONDITIONED) & (count.sum() > size),
        naive,
        dof,
    )


def _products(columns: list[Array], forces: list[Array]) -> tuple[list[Array], Array]:
    """Return products of forces with columns, and the forces' squares by joint."""
    squares = jnp.stack([jnp.sum(Q**2, axis=-1) for Q in forces], axis=-1)
    return [Q @ A.T for A, Q in zip(columns, forces, strict=True)], squares


def inverse_information(whole: Float[Array, "base base"]) -> tuple[Array, Array]:
    """Return the inverse of an information, and a bound of its root's condition number.

    Columns are scaled to length one, and a ridge of rounding's size keeps the factor from failing.
    """
    size = whole.shape[-1]
    square = jnp.diagonal(whole)
    scale = 1.0 / jnp.sqrt(jnp.where(square > 0, square, 1.0))
    scaled = scale[:, None] * whole * scale[None] + RIDGE * np.eye(size)
    L = jnp.linalg.cholesky(scaled)
    Li = jax.lax.linalg.triangular_solve(L, jnp.eye(size), left_side=True, lower=True)
    bound = jnp.sqrt(size * jnp.sum(Li**2))
    Li = Li * scale[None]
    return Li.T @ Li, jnp.where(jnp.isfinite(bound), bound, jnp.inf)

"""Least squares of a few data sets by the products of their rows, as one compiled computation.

Columns are evaluated for a group of data sets together; the products of the rows with each other
and with the forces (Gram matrices) and the solution follow for each, with one refinement by the
residuals themselves where products alone would lose digits.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Bool, Float
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.regressor import JointRegressor
from jaxid.identification.uncertainty.spectral import LineSums, line_sums, variances

AT_ONCE = 2048
"""Samples whose columns are held at once."""
WELL_CONDITIONED = 1e4
"""Condition number, with columns of length one, up to which products of rows are accurate enough;
beyond it a data set is solved again by orthogonal factors."""
ACCURATE = 1e3
"""Bound of the condition number up to which the products' solution needs no refinement."""
SMALL = 1e-6
"""Share of the forces' squares below which the residuals' are summed themselves."""
KEPT = 8
"""Shapes of batches for which what was compiled is kept: memory does not grow with their number."""
RIDGE = 64 * np.finfo(float).eps


class BatchFit(eqx.Module):
    """Identified base parameters of many data sets.

    Attributes:
        parameters: The estimates; zero along what a data set does not determine.
        standard_deviations: Standard deviations by the spectral sandwich if the time between rows
            was given; otherwise naive. Infinite where nothing is known.
        residual_rms: RMS of the residuals of each joint [N m or N].
        condition_numbers: Those of each weighted observation matrix with columns of length one; an
            upper bound, at most the number of parameters too large, where it is well conditioned.
        determined: Whether a data set determines all parameters. Where it is False while JAX
            traces, the estimates are not to be used.
        naive_standard_deviations: For independent rows and a variance of each joint's own.
        freedom: Degrees of freedom behind each standard deviation, for the t distribution.
    """

    parameters: Float[AnyArray, "*results base"]
    standard_deviations: Float[AnyArray, "*results base"]
    residual_rms: Float[AnyArray, "*results joints"]
    condition_numbers: Float[AnyArray, "*datasets"]
    determined: Bool[AnyArray, "*datasets"]
    naive_standard_deviations: Float[AnyArray, "*results base"]
    freedom: Float[AnyArray, "*results base"]


class DataSets(eqx.Module):
    """Data sets of a batch: leading axes datasets, then samples (forces: draws)."""

    motion: Motion
    forces: Float[AnyArray, "datasets draws samples joints"]
    weights: Float[AnyArray, "datasets joints"]
    mask: Float[AnyArray, "datasets samples joints"] | None
    numbers: Float[AnyArray, "datasets numbers"] | None


def solve(rows: JointRegressor, batch: DataSets, row_time: float | None = None) -> BatchFit:
    """Solves all data sets, a group at a time; compiled once for each of the latest shapes.

    Args:
        rows: How columns are divided among joints.
        batch: The data sets.
        row_time: Between two rows [s], for the spectral sandwich; without it all is naive.
    """
    leaves, tree = jax.tree.flatten((rows, batch, row_time))
    known = tuple(not isinstance(x, jax.Array | np.ndarray) for x in leaves)
    arrays = [x for x, is_number in zip(leaves, known, strict=True) if not is_number]
    numbers = tuple(x for x, is_number in zip(leaves, known, strict=True) if is_number)
    shapes = tuple((x.shape, str(x.dtype)) for x in arrays)
    return _compiled(tree, known, numbers, shapes)(arrays)


@functools.lru_cache(maxsize=KEPT)
def _compiled(tree: Any, known: tuple[bool, ...], numbers: tuple, shapes: tuple) -> Callable:
    """The computation for one set of shapes; what is forgotten here gives its memory back."""

    def run(arrays: list[Array]) -> BatchFit:
        held, given = iter(numbers), iter(arrays)
        leaves = [next(held if is_number else given) for is_number in known]
        return _solved(*jax.tree.unflatten(tree, leaves))

    return jax.jit(run)


def _solved(rows: JointRegressor, batch: DataSets, row_time: float | None) -> BatchFit:
    batch = jax.tree.map(jnp.asarray, batch)
    datasets, samples, _ = batch.motion.q.shape
    calls = -(-datasets // max(1, min(AT_ONCE // samples, datasets)))
    group = -(-datasets // calls)
    chunks = -(-samples // AT_ONCE)
    batch = _filled(batch, chunks * -(-samples // chunks) - samples)
    whole = calls * group
    more = jax.tree.map(lambda x: x[np.arange(whole - datasets)], batch)
    groups = jax.tree.map(
        lambda x, y: jnp.concatenate([x, y]).reshape((-1, group, *x.shape[1:])), batch, more
    )
    fits = jax.lax.map(lambda one: _solve_group(rows, one, chunks, row_time), groups)
    return jax.tree.map(lambda x: x.reshape((whole, *x.shape[2:]))[:datasets], fits)


def _filled(batch: DataSets, missing: int) -> DataSets:
    """Appends samples that do not count."""
    if not missing:
        return batch

    def pad(x):
        return jnp.pad(x, (*((0, 0),) * (x.ndim - 2), (0, missing), (0, 0)))

    mask = jnp.ones_like(batch.motion.q) if batch.mask is None else batch.mask
    return DataSets(
        jax.tree.map(pad, batch.motion), pad(batch.forces), batch.weights, pad(mask), batch.numbers
    )


def _solve_group(
    rows: JointRegressor, batch: DataSets, chunks: int, row_time: float | None
) -> BatchFit:
    """Solves a few data sets; those that fit evaluate their columns together, once."""
    length = batch.forces.shape[-2] // chunks
    if chunks == 1:
        columns = _columns(rows, batch)

        def one(x):
            return _solve_one(rows, x[0], lambda f: f(*x), length, row_time)

        # A CPU multiplies the matrices of one data set faster than those of several together.
        together = jax.default_backend() != "cpu"
        return jax.vmap(one)((batch, columns)) if together else jax.lax.map(one, (batch, columns))

    def total(one, f):
        parts = _in_chunks(one, chunks)

        def part(k):
            chunk = jax.tree.map(lambda x: x[k], parts)
            return f(chunk, [A[0] for A in _columns(rows, jax.tree.map(lambda x: x[None], chunk))])

        def add(sums, k):
            return jax.tree.map(jnp.add, sums, part(k)), None

        return jax.lax.scan(add, part(0), np.arange(1, chunks))[0]

    return jax.lax.map(
        lambda one: _solve_one(rows, one, lambda f: total(one, f), length, row_time), batch
    )


def _in_chunks(one: DataSets, chunks: int) -> DataSets:
    """The samples of a data set divided; weights and the geometry's numbers are repeated."""

    def divide(x):
        length = x.shape[-2] // chunks
        return jnp.moveaxis(x.reshape((*x.shape[:-2], chunks, length, x.shape[-1])), -3, 0)

    def repeat(x):
        return jnp.broadcast_to(x, (chunks, *x.shape))

    return DataSets(
        jax.tree.map(divide, one.motion),
        divide(one.forces),
        repeat(one.weights),
        None if one.mask is None else divide(one.mask),
        None if one.numbers is None else repeat(one.numbers),
    )


def _columns(rows: JointRegressor, batch: DataSets) -> list[Array]:
    """For each joint the columns of some data sets, [datasets, columns, samples]."""
    arrays = [jnp.moveaxis(x, -1, 0) for x in jax.tree.leaves(batch.motion)]
    if batch.numbers is not None:
        numbers = batch.numbers.T[:, :, None]
        arrays.append(jnp.broadcast_to(numbers, (*numbers.shape[:2], arrays[0].shape[-1])))
    return rows(*arrays)


def _solve_one(
    rows: JointRegressor, one: DataSets, total: Callable, length: int, row_time: float | None
) -> BatchFit:
    """Solves one data set by the products of its rows.

    Args:
        rows: How columns are divided among joints.
        one: The data set.
        total: Sums a function of data and columns over the data set's chunks.
        length: Rows of a chunk.
        row_time: Between two rows [s], or None.
    """
    weights = jnp.asarray(one.weights)
    grams, products, forces = total(lambda x, A: _products(*_counted(x, A)))
    inverse, condition = inverse_information(_added(rows, grams, weights))
    p = _added_products(rows, products, weights) @ inverse
    squares = _squares(rows, grams, products, forces, p)

    def refine() -> tuple[Array, Array]:
        products, squares = total(lambda x, A: _residuals(rows, *_counted(x, A), p))
        step = _added_products(rows, products, weights) @ inverse
        # The squares at the refined parameters: what is of second order in the step is rounding.
        return p + step, squares - 2 * _along(rows, step, products)

    # Residuals themselves are only needed where differences of large numbers would lose digits.
    lost = (condition > ACCURATE) | jnp.any(squares < SMALL * forces)
    p, squares = jax.lax.cond(lost, refine, lambda: (p, squares))
    squares = jnp.maximum(squares, 0.0)
    if one.mask is None:
        count = jnp.full(weights.shape, float(one.motion.q.shape[0]))
    else:
        count = one.mask.sum(axis=0)
    naive = _deviations(rows, inverse, grams, weights, squares, count)
    deviations, freedom = naive, jnp.broadcast_to(count.sum() - rows.size, naive.shape)
    if row_time is not None:

        def lines(x: DataSets, A: list[Array]) -> LineSums:
            share = jnp.ones(weights.shape) if x.mask is None else x.mask.mean(axis=0)
            return line_sums(rows.columns, weights, inverse, p, *_counted(x, A), share)

        variance, freedom = variances(total(lines), length, row_time)
        deviations = jnp.sqrt(jnp.maximum(variance, 0.0))
    return BatchFit(
        p,
        deviations,
        jnp.sqrt(squares / jnp.maximum(count, 1.0)[None]),
        condition,
        (condition < WELL_CONDITIONED) & (count.sum() > rows.size),
        naive,
        freedom,
    )


def _counted(one: DataSets, columns: list[Array]) -> tuple[list[Array], list[Array]]:
    """For each joint its columns [columns, samples] and forces [draws, samples] that count."""
    forces = list(jnp.moveaxis(one.forces, -1, 0))
    if one.mask is None:
        return columns, forces
    masks = one.mask.T[:, None]
    return (
        [jnp.where(m > 0, x, 0.0) for m, x in zip(masks, columns, strict=True)],
        [jnp.where(m > 0, x, 0.0) for m, x in zip(masks, forces, strict=True)],
    )


def _products(columns: list[Array], forces: list[Array]) -> tuple[list[Array], list[Array], Array]:
    """Products of columns, of forces with columns, and the forces' squares by joint."""
    pairs = list(zip(columns, forces, strict=True))
    squares = jnp.stack([jnp.sum(Q**2, axis=-1) for Q in forces], axis=-1)
    return [A @ A.T for A, _ in pairs], [Q @ A.T for A, Q in pairs], squares


def _squares(
    rows: JointRegressor, grams: list[Array], products: list[Array], forces: Array, p: Array
) -> Array:
    """The residuals' squares by joint [draws, joints], from products alone."""
    felt = []
    for own, gram in zip(rows.columns, grams, strict=True):
        x = p[:, np.array(own, int)]
        felt.append(jnp.sum((x @ gram) * x, axis=-1))
    return forces - 2 * _along(rows, p, products) + jnp.stack(felt, axis=-1)


def _along(rows: JointRegressor, p: Array, products: list[Array]) -> Array:
    """Parameters times products, by joint [draws, joints]."""
    pairs = zip(rows.columns, products, strict=True)
    return jnp.stack([jnp.sum(p[:, np.array(k, int)] * y, axis=-1) for k, y in pairs], axis=-1)


def _residuals(
    rows: JointRegressor, columns: list[Array], forces: list[Array], p: Array
) -> tuple[list[Array], Array]:
    """Products of the columns with the residuals, and the residuals' squares by joint."""
    products, squares = [], []
    for A, Q, own in zip(columns, forces, rows.columns, strict=True):
        r = Q - p[:, np.array(own, int)] @ A
        products.append(r @ A.T)
        squares.append(jnp.sum(r**2, axis=-1))
    return products, jnp.stack(squares, axis=-1)


def _added(rows: JointRegressor, grams: list[Array], weights: Array) -> Array:
    """The weighted information of all joints."""
    whole = jnp.zeros((rows.size, rows.size), weights.dtype)
    for own, gram, w in zip(rows.columns, grams, weights, strict=True):
        k = np.array(own, int)
        whole = whole.at[k[:, None], k].add(w**2 * gram)
    return whole


def _added_products(rows: JointRegressor, products: list[Array], weights: Array) -> Array:
    """The weighted products of columns and forces [draws, base]."""
    sums = jnp.zeros((products[0].shape[0], rows.size), weights.dtype)
    for own, y, w in zip(rows.columns, products, weights, strict=True):
        sums = sums.at[:, np.array(own, int)].add(w**2 * y)
    return sums


def _deviations(
    rows: JointRegressor,
    inverse: Array,
    grams: list[Array],
    weights: Array,
    squares: Array,
    count: Array,
) -> Array:
    """Standard deviations [draws, base]; see `Fit.covariance`."""
    total = count.sum()
    freedom = jnp.maximum(1.0 - rows.size / jnp.maximum(total, 1.0), 0.0)
    variances = squares / jnp.maximum(count * freedom, 1.0)[None]
    felt = []
    for own, gram, w in zip(rows.columns, grams, weights, strict=True):
        B = inverse[:, np.array(own, int)] * w**2
        felt.append(jnp.sum((B @ gram) * B, axis=-1))
    return jnp.sqrt(jnp.maximum(variances @ jnp.stack(felt), 0.0))


def inverse_information(
    whole: Float[Array, "base base"],
) -> tuple[Float[Array, "base base"], Float[Array, ""]]:
    """Inverse of an information, and a bound of its square root's condition number.

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

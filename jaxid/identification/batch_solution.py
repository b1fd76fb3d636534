"""Least squares of many data sets in one compiled computation.

Data sets go through in groups, so that memory does not grow with their number. For each
data set the rows of a joint are reduced to their products with each other and with the
forces (Gram matrices), weighted, added, and solved with columns scaled to length one.
Where that loses digits, a refinement with the residuals brings them back.
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
from jaxid.program.jax_transformation_rules import divided

from .estimators.regularisation_and_weights import inverse_information
from .uncertainty.spectral import sandwich_of_columns

GROUP_SAMPLES = 2048
"""Samples up to which a CPU evaluates the columns of several data sets together."""
GROUP_SAMPLES_ON_GPU = 2**17
"""The same on another device."""
MAX_CONDITION = 1e4
"""Largest condition number for which products of rows are accurate enough.

Columns have length one; beyond it a data set is solved again by orthogonal factors.
"""


JointArrays = list[Array]
"""One array for each joint."""
Estimates = Float[AnyArray, "*results base"]
"""One number for each base parameter of each draw of each data set."""


class BatchFit(eqx.Module):
    """Identified base parameters of many data sets.

    Attributes:
        parameters: Estimates; zero along what a data set does not determine.
        standard_deviations: Standard deviations by the spectral sandwich if the time
            between rows was given; otherwise naive. Infinite where nothing is known.
        residual_rms: RMS of the residuals of each joint [N m or N].
        condition_numbers: Condition numbers of each weighted observation matrix with
            columns of length one; an upper bound, at most the number of parameters too
            large, where it is well conditioned.
        determined: Whether a data set determines all parameters. Where it is False
            while JAX traces, the estimates are not to be used.
        naive_standard_deviations: Standard deviations for independent rows and a
            variance of each joint.
        dof: Degrees of freedom of each variance, for the t distribution.
    """

    parameters: Estimates
    standard_deviations: Estimates
    residual_rms: Float[AnyArray, "*results joints"]
    condition_numbers: Float[AnyArray, "*datasets"]
    determined: Bool[AnyArray, "*datasets"]
    naive_standard_deviations: Estimates
    dof: Estimates


class DataSets(NamedTuple):
    """Data sets of a batch, or one of them.

    Forces may have axes of draws before the samples. The mask is one for rows that
    count, and None if all count; `numbers` are those of the geometry [datasets,
    numbers], if robots differ.
    """

    motion: Motion
    forces: AnyArray
    weights: AnyArray
    mask: AnyArray | None
    numbers: AnyArray | None


@eqx.filter_jit
def solve(
    regressor: JointRegressor, batch: DataSets, row_time: float | None = None
) -> BatchFit:
    """Solve all data sets, a group at a time; devices divide them among themselves.

    With the time between two rows [s], standard deviations come from the spectral
    sandwich.
    """
    sets, *draws, samples, joints = batch.forces.shape
    forces = jnp.reshape(batch.forces, (sets, -1, samples, joints))
    batch = batch._replace(forces=forces)
    leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, batch))

    def solve_leaves(on_cpu: bool, *leaves: Array) -> BatchFit:
        data_sets = jax.tree.unflatten(tree, leaves)
        return _solve_groups(regressor, data_sets, row_time, on_cpu)

    def solve_on_any(*leaves: Array) -> BatchFit:
        return jax.lax.platform_dependent(
            *leaves,
            cpu=functools.partial(solve_leaves, True),
            default=functools.partial(solve_leaves, False),
        )

    def with_axes_of_draws(x):
        return x if x.ndim == 1 else x.reshape(sets, *draws, x.shape[-1])

    fit = divided(solve_on_any)(*leaves)
    return jax.tree.map(with_axes_of_draws, fit)


def _solve_groups(
    regressor: JointRegressor, batch: DataSets, row_time: float | None, on_cpu: bool
) -> BatchFit:
    """Solve all data sets: on a CPU in small groups that stay in its cache."""
    datasets, samples, _ = batch.motion.q.shape
    group_samples = GROUP_SAMPLES if on_cpu else GROUP_SAMPLES_ON_GPU
    max_size = max(1, min(group_samples // samples, datasets))
    groups = -(-datasets // max_size)
    size = -(-datasets // groups)
    # The last group is filled up with the first data sets.
    numbers = np.arange(groups * size) % datasets
    grouped_sets = jax.tree.map(
        lambda x: x[numbers].reshape(groups, size, *x.shape[1:]), batch
    )

    def solve_pair(pair: tuple[DataSets, JointArrays]) -> BatchFit:
        return _solve_one(*pair, regressor, row_time, on_cpu)

    def solve_group(group: DataSets) -> BatchFit:
        arrays = [jnp.moveaxis(x, -1, 0) for x in jax.tree.leaves(group.motion)]
        if group.numbers is not None:
            geometry = group.numbers.T[:, :, None]
            shape = (*geometry.shape[:2], samples)
            arrays.insert(0, jnp.broadcast_to(geometry, shape))
        # Columns of each joint [datasets, columns, samples].
        pairs = group, regressor(*arrays, fence=on_cpu)
        # A CPU multiplies the matrices of one data set faster than those of several
        # together.
        return jax.lax.map(solve_pair, pairs) if on_cpu else jax.vmap(solve_pair)(pairs)

    fits = jax.lax.map(solve_group, grouped_sets)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:datasets], fits)


class _Rows(NamedTuple):
    """Rows of one data set, joint by joint; those that do not count are zero."""

    parameters: list[np.ndarray]  # indices of the parameters that act on the joint
    columns: JointArrays  # [columns, samples]
    forces: JointArrays  # [draws, samples]
    weights: Array  # weight of each joint
    size: int  # number of base parameters

    def masked(self, mask: AnyArray) -> "_Rows":
        """Return the rows with zeros where a mask [samples, joints] is zero."""
        counts = mask.T[:, None] > 0
        columns = zip(counts, self.columns, strict=True)
        forces = zip(counts, self.forces, strict=True)
        return self._replace(
            columns=[jnp.where(is_counted, x, 0.0) for is_counted, x in columns],
            forces=[jnp.where(is_counted, x, 0.0) for is_counted, x in forces],
        )

    def products(self, forces: JointArrays) -> tuple[JointArrays, Array]:
        """Return products of forces with columns, and the forces' squares by joint."""
        squares = [jnp.sum(Q**2, axis=-1) for Q in forces]
        products = [Q @ A.T for A, Q in zip(self.columns, forces, strict=True)]
        return products, jnp.stack(squares, axis=-1)

    def residuals(self, p: Array) -> JointArrays:
        """Return measured less predicted forces of each joint."""
        joints = zip(self.forces, self.columns, self.parameters, strict=True)
        return [forces - p[:, k] @ columns for forces, columns, k in joints]

    def information(self, grams: JointArrays) -> Array:
        """Add the weighted products of columns with columns [base, base]."""
        total = jnp.zeros((self.size, self.size), self.weights.dtype)
        for k, gram, weight in zip(self.parameters, grams, self.weights, strict=True):
            total = total.at[k[:, None], k].add(weight**2 * gram)
        return total

    def gradient(self, products: JointArrays) -> Array:
        """Add the weighted products of columns with forces [draws, base]."""
        total = jnp.zeros((len(products[0]), self.size), self.weights.dtype)
        for k, x, weight in zip(self.parameters, products, self.weights, strict=True):
            total = total.at[:, k].add(weight**2 * x)
        return total

    def along(self, p: Array, products: JointArrays) -> Array:
        """Multiply parameters and products, by joint [draws, joints]."""
        pairs = zip(self.parameters, products, strict=True)
        return jnp.stack([jnp.sum(p[:, k] * x, axis=-1) for k, x in pairs], axis=-1)


def _solve_one(
    data_set: DataSets,
    columns: JointArrays,
    regressor: JointRegressor,
    row_time: float | None,
    on_cpu: bool,
) -> BatchFit:
    """Solve one data set by the products of its rows."""
    samples = len(data_set.motion.q)
    weights = jnp.asarray(data_set.weights)
    rows = _Rows(
        [np.array(k, int) for k in regressor.columns],
        columns,
        list(jnp.moveaxis(data_set.forces, -1, 0)),
        weights,
        regressor.size,
    )
    counts = jnp.full(weights.shape, 1.0 * samples)
    if data_set.mask is not None:
        counts = data_set.mask.sum(axis=0)
        rows = rows.masked(data_set.mask)
    grams = [A @ A.T for A in rows.columns]
    inverse, condition = inverse_information(rows.information(grams))
    p, squares = _estimate(rows, grams, inverse, condition, on_cpu)
    naive_deviations = _naive_deviations(rows, grams, inverse, squares, counts)
    deviations = naive_deviations
    dof = jnp.broadcast_to(counts.sum() - rows.size, deviations.shape)
    if row_time is not None:
        variances, dof = sandwich_of_columns(
            jnp,
            regressor.columns,
            weights,
            inverse,
            p,
            rows.columns,
            rows.forces,
            counts / samples,
            row_time,
        )
        deviations = jnp.sqrt(jnp.maximum(variances, 0.0))
    is_determined = (condition < MAX_CONDITION) & (counts.sum() > rows.size)
    return BatchFit(
        parameters=p,
        standard_deviations=deviations,
        residual_rms=jnp.sqrt(squares / jnp.maximum(counts, 1.0)[None]),
        condition_numbers=condition,
        determined=is_determined,
        naive_standard_deviations=naive_deviations,
        dof=dof,
    )


def _estimate(
    rows: _Rows, grams: JointArrays, inverse: Array, condition: Array, on_cpu: bool
):
    """Return the parameters [draws, base], and squared residuals [draws, joints]."""
    products, force_squares = rows.products(rows.forces)
    p = rows.gradient(products) @ inverse
    predicted_products = [
        p[:, k] @ gram for k, gram in zip(rows.parameters, grams, strict=True)
    ]
    squares = (
        force_squares - 2 * rows.along(p, products) + rows.along(p, predicted_products)
    )

    def refine():
        products, squares = rows.products(rows.residuals(p))
        step = rows.gradient(products) @ inverse
        # The squares at the refined parameters: what is of second order in the step is
        # rounding.
        return p + step, squares - 2 * rows.along(step, products)

    # Residuals themselves are only needed where differences of large numbers would lose
    # digits.
    loses_digits = (condition > 1e3) | jnp.any(squares < 1e-6 * force_squares)
    if on_cpu:
        p, squares = jax.lax.cond(loses_digits, refine, lambda: (p, squares))
    else:
        # Under `vmap` both would be computed anyway, and indices inside of a condition
        # cannot be divided among devices.
        refined_p, refined_squares = refine()
        p = jnp.where(loses_digits, refined_p, p)
        squares = jnp.where(loses_digits, refined_squares, squares)
    return p, jnp.maximum(squares, 0.0)


def _naive_deviations(
    rows: _Rows, grams: JointArrays, inverse: Array, squares: Array, counts: Array
) -> Array:
    """Return deviations for independent rows; see `naive_covariance`."""
    explained_share = rows.size / jnp.maximum(counts.sum(), 1.0)
    remaining_share = jnp.maximum(1.0 - explained_share, 0.0)
    remaining_rows = jnp.maximum(counts * remaining_share, 1.0)
    variances = squares / remaining_rows[None]
    effects = []
    joints = zip(rows.parameters, grams, rows.weights, strict=True)
    for k, gram, weight in joints:
        gain = inverse[:, k] * weight**2
        effect = (gain @ gram) * gain
        effects.append(jnp.sum(effect, axis=-1))
    parameter_variances = variances @ jnp.stack(effects)
    return jnp.sqrt(jnp.maximum(parameter_variances, 0.0))

"""Many data sets in one call: robots of one kind, noise draws, geometries, any estimator.

Data sets go through one compiled computation in groups, so that memory does not grow
with their number. For each data set the rows of a joint are reduced to their products
with each other and with the forces (Gram matrices), weighted, added, and solved with
columns scaled to length one. Where that loses digits, a refinement with the residuals,
or orthogonal factors, bring them back.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    Bool,
    Float,
    in_parts,
    is_traced,
    on_cores,
    require_float64,
)
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import opened
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.packed_regressor import JointRegressor
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations
from jaxid.program.rules import divided
from jaxid.robot.robot import Robot

from .estimators import AbstractEstimator, GivenWeights, WeightedLeastSquares
from .estimators.regularisation_and_weights import inverse_information
from .fit_result import Fit
from .identify import identify
from .uncertainty import IndependentRows
from .uncertainty.spectral import sandwich_of_columns

AT_ONCE, AT_ONCE_ON_GPU = 2048, 2**17
"""Samples up to which several data sets evaluate their columns together."""
WELL_CONDITIONED = 1e4
"""Condition number, with columns of length one, up to which products of rows are accurate enough;
beyond it a data set is solved again by orthogonal factors."""


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

    parameters: Float[AnyArray, "*results base"]
    standard_deviations: Float[AnyArray, "*results base"]
    residual_rms: Float[AnyArray, "*results joints"]
    condition_numbers: Float[AnyArray, "*datasets"]
    determined: Bool[AnyArray, "*datasets"]
    naive_standard_deviations: Float[AnyArray, "*results base"]
    dof: Float[AnyArray, "*results base"]


class DataSets(NamedTuple):
    """Data sets of a batch, or one of them.

    Forces have an axis of draws before the samples. The mask is one for rows that
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
    rows: JointRegressor, batch: DataSets, row_time: float | None = None
) -> BatchFit:
    """Solve all data sets, a group at a time; devices divide them among themselves.

    With the time between two rows [s], standard deviations come from the spectral
    sandwich.
    """
    leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, batch))

    def solved(on_cpu: bool, *leaves: Array) -> BatchFit:
        return _solve_groups(rows, jax.tree.unflatten(tree, leaves), row_time, on_cpu)

    def on_any(*leaves: Array) -> BatchFit:
        return jax.lax.platform_dependent(
            *leaves,
            cpu=functools.partial(solved, True),
            default=functools.partial(solved, False),
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
        # A CPU multiplies the matrices of one data set faster than those of several
        # together.
        return jax.lax.map(one, pairs) if on_cpu else jax.vmap(one)(pairs)

    fits = jax.lax.map(solve_group, groups)
    return jax.tree.map(lambda x: x.reshape((whole, *x.shape[2:]))[:datasets], fits)


def _solve_one(
    rows: JointRegressor,
    one: DataSets,
    A: list[Array],
    row_time: float | None,
    on_cpu: bool,
) -> BatchFit:
    """Solve one data set by the products of its rows."""
    weights, places = one.weights, [np.array(own, int) for own in rows.columns]
    length, size = len(one.motion.q), rows.size
    Q = list(jnp.moveaxis(one.forces, -1, 0))
    if one.mask is not None:
        masks = one.mask.T[:, None] > 0
        A, Q = (
            [jnp.where(*x, 0.0) for x in zip(masks, y, strict=True)] for y in (A, Q)
        )

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

    count = (
        jnp.full(weights.shape, 1.0 * length)
        if one.mask is None
        else one.mask.sum(axis=0)
    )
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
        # The squares at the refined parameters: what is of second order in the step is
        # rounding.
        return p + step, squares - 2 * along(step, products)

    # Residuals themselves are only needed where differences of large numbers would lose
    # digits.
    lost = (condition > 1e3) | jnp.any(squares < 1e-6 * forces)
    if on_cpu:
        p, squares = jax.lax.cond(lost, refine, lambda: (p, squares))
    else:
        # Under `vmap` both would be computed anyway.
        p, squares = (
            jnp.where(lost, x, y) for x, y in zip(refine(), (p, squares), strict=True)
        )
    squares = jnp.maximum(squares, 0.0)
    free = jnp.maximum(1.0 - size / jnp.maximum(count.sum(), 1.0), 0.0)
    gains = [inverse[:, k] * w**2 for k, w in zip(places, weights, strict=True)]
    own = [
        jnp.sum((B @ gram) * B, axis=-1) for B, gram in zip(gains, grams, strict=True)
    ]
    # See `Fit.covariance`.
    naive = squares / jnp.maximum(count * free, 1.0)[None] @ jnp.stack(own)
    naive = jnp.sqrt(jnp.maximum(naive, 0.0))
    deviations, dof = naive, jnp.broadcast_to(count.sum() - size, naive.shape)
    if row_time is not None:
        rest = A, Q, count / length, row_time
        variance, dof = sandwich_of_columns(
            jnp, rows.columns, weights, inverse, p, *rest
        )
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


def identify_batch(
    base: BaseParameters,
    motion: Motion,
    forces: Float[AnyArray, "datasets *draws samples joints"],
    weights: Float[AnyArray, "*sets joints"] | None = None,
    *,
    mask: Bool[AnyArray, "sets rows joints"] | None = None,
    robots: Sequence[Robot] | None = None,
    row_time: float | None = None,
    estimator: AbstractEstimator | None = None,
) -> BatchFit:
    """Estimate the base parameters of many data sets in one call (Eqs. 28-33).

    The parameters are those of `identify` with `WeightedLeastSquares` on each data set.
    Compiles once for each shape; works under `jit`, `vmap`, `grad` and `jvp`, by data
    and by the robot's geometry, where data sets that determine too little are only
    marked. Without tracing they are solved again by orthogonal factors.

    Args:
        base: Base parameters of the robot.
        motion: Motions [datasets, samples, joints], already filtered and decimated.
        forces: Generalised forces [N m or N], reduced like the motion. With an axis of
            draws, many sets of forces over one motion, whose columns are then evaluated
            and factored once.
        weights: Weights of the joints' rows [1/(N m) or 1/N], for all data sets or for
            each; reciprocals of the largest forces if None (Eq. 30).
        mask: Rows that count: data sets of different length are filled up and masked.
        robots: Robot of each data set, of the topology of the base parameters' robot:
            the columns that lead its base parameters are kept.
        row_time: Time between two rows [s]. With it, standard deviations come from the
            spectral sandwich; without it, rows are taken for independent.
        estimator: Another than weighted least squares: it estimates one data set after
            the other, on all cores. It has weights of its own; not with `robots`, and
            not while JAX traces.

    Raises:
        InputError: If shapes do not fit, there are too few rows, or weights are not
            known.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("a batch of identifications")
    robot = base.model.robot
    _check(base, motion, forces, mask, robots)
    if estimator is not None and not (robots is None and weights is None):
        raise InputError(
            "`estimator` has weights of its own: leave out `robots` and `weights`."
        )
    sets, draws = len(forces), forces.shape[1:-2]
    if weights is None and is_traced(robot.limits, robot.drives):
        raise InputError(
            "`weights` must be given where JAX is tracing the robot's limits."
        )
    if weights is None:
        weights = (
            np.ones(robot.joints) if estimator else 1.0 / np.asarray(robot.max_forces)
        )
    batch = DataSets(
        motion,
        jnp.asarray(forces).reshape(sets, -1, *forces.shape[-2:]),
        jnp.broadcast_to(jnp.asarray(weights), (sets, robot.joints)),
        None if mask is None else jnp.asarray(mask, float),
        None,
    )
    if base.model.memory is not None and estimator is None:
        raise InputError(
            "friction with memory needs one data set at a time: give an `estimator`."
        )
    if estimator is not None:
        fit = _estimate_each(base, batch, estimator, row_time)
    else:
        if robots is None and not is_traced(robot):
            rows, reduced = base.joint_regressor, batch
        else:
            family, numbers = opened("columns", base, *_of_each(base, robots or ()))
            n, size = (robot.joints,), numbers.shape[1]
            rows = JointRegressor(family, family.call, (size,), n, n, n)
            numbers = numbers if robots is None else numbers[1:]
            reduced = batch._replace(numbers=jnp.broadcast_to(numbers, (sets, size)))
        if robot.tool is not None:
            known = base.model.tool_forces(motion)
            reduced = reduced._replace(forces=batch.forces - known[:, None])
        if is_traced(reduced):
            fit = solve(rows, reduced, row_time)
        else:
            reduced = jax.tree.map(np.asarray, reduced)
            fit = in_parts(lambda part: solve(rows, part, row_time), reduced)
            fit = _solve_again(base, robots, batch, fit, row_time)
    return jax.tree.map(
        lambda x: x if x.ndim == 1 else x.reshape(sets, *draws, x.shape[-1]), fit
    )


def _check(base, motion, forces, mask, robots) -> None:
    n, samples = base.model.robot.joints, forces.shape[-2]
    wanted = (len(forces), samples, n)
    for name, array in (
        ("motion", motion.q),
        ("mask", motion.q if mask is None else mask),
    ):
        if array.shape != wanted:
            rule = f"the shape [datasets, samples, joints] {wanted} of the forces"
            raise InputError(f"`{name}` must have {rule}, but has {array.shape}.")
    if robots is not None and len(robots) != len(forces):
        raise InputError(
            f"`robots` must be one for each of {len(forces)} data sets: {len(robots)}."
        )
    if samples * n <= base.size:
        raise InputError(
            f"{samples * n} rows for {base.size} base parameters: record longer."
        )


def _solve_again(base, robots, batch: DataSets, fit: BatchFit, row_time) -> BatchFit:
    """Solve the data sets that are not well conditioned by orthogonal factors, one by one."""
    fit = jax.tree.map(np.array, fit)
    for k in np.flatnonzero(~fit.determined):
        one = jax.tree.map(lambda x, k=k: np.asarray(x)[k : k + 1], batch)
        if one.mask is not None and one.mask.sum() <= base.size:
            fit.parameters[k], fit.condition_numbers[k] = 0.0, np.inf
            fit.standard_deviations[k] = fit.naive_standard_deviations[k] = np.inf
            continue
        robot = base.model.robot if robots is None else robots[k]
        own = eqx.tree_at(lambda b: b.model.robot, base, robot)
        estimator = WeightedLeastSquares(GivenWeights(one.weights[0]))
        again = _estimate_each(own, one, estimator, row_time)
        for x, y in zip(jax.tree.leaves(fit), jax.tree.leaves(again), strict=True):
            x[k] = y[0]
    return jax.tree.map(jnp.asarray, fit)


def _estimate_each(
    base, batch: DataSets, estimator: AbstractEstimator, row_time
) -> BatchFit:
    """Return the estimates of `identify` for each data set and draw, on all cores."""
    motion, Q = jax.tree.map(np.asarray, (batch.motion, batch.forces))
    counted = (
        np.ones(motion.q.shape, bool)
        if batch.mask is None
        else np.asarray(batch.mask) > 0
    )
    uncertainty = IndependentRows() if row_time is None else None

    def one(case: tuple[int, int]) -> Fit:
        k, draw = case
        kept, own = counted[k], motion[k]
        kept_forces = np.where(kept, Q[k, draw], 0.0)
        options = {
            "sample_time": row_time or 1.0,
            "mask": kept,
            "name": f"data set {k + 1}",
        }
        o = Observations.of(own.q, own.qd, own.qdd, kept_forces, **options)
        return identify(base, o, estimator, uncertainty=uncertainty)

    cases = itertools.product(range(len(Q)), range(Q.shape[1]))
    fits = list(on_cores(one, cases))
    known = np.array([np.isfinite(fit.naive_standard_deviations).all() for fit in fits])
    condition = np.array([fit.condition_numbers.scaled for fit in fits])
    names = (
        "parameters",
        "standard_deviations",
        "residual_rms",
        "naive_standard_deviations",
    )
    fit = BatchFit(
        **{name: jnp.stack([getattr(fit, name) for fit in fits]) for name in names},
        # Only those that determine all have a condition number.
        condition_numbers=jnp.asarray(np.where(known, condition, np.inf)),
        determined=jnp.asarray(known),
        dof=jnp.stack([fit.uncertainty.dof for fit in fits]),
    )
    draws = Q.shape[1]
    return jax.tree.map(
        lambda x: x.reshape(len(Q), draws, -1) if x.ndim > 1 else x[::draws], fit
    )


def _of_each(base: BaseParameters, robots: Sequence[Robot]) -> list[BaseParameters]:
    """Return the base parameters of robots of one topology, with the geometry of each."""
    own, each = base.model.robot, []
    for robot in robots:
        alike = robot.parent == own.parent and robot.revolute == own.revolute
        if not alike or robot.tool is not None:
            raise InputError(
                f"`{robot.name}` of `robots` must have the topology of `{own.name}`, "
                "and no tool."
            )
        geometry = {
            x: getattr(robot, x) for x in ("axis", "rotation", "offset", "gravity")
        }
        placed = own.replace(**geometry)
        each.append(eqx.tree_at(lambda b: b.model.robot, base, placed))
    return each

"""Many data sets in one call: robots of one kind, noise draws, geometries.

Data sets go through one compiled computation in groups, so that memory does not grow with their
number. For each data set the rows of a joint are reduced to their products with each other and with
the forces (Gram matrices), weighted, added, and solved with columns scaled to length one. Where
that loses digits, a refinement with the residuals, or orthogonal factors, bring them back.
"""

import itertools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Bool, Float, is_traced, require_float64
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.regressor import JointRegressor
from jaxid.errors import InputError
from jaxid.identification.batch_estimators import estimate_each
from jaxid.identification.estimators import AbstractEstimator, GivenWeights, WeightedLeastSquares
from jaxid.identification.factors import Blocks, Factors, JointFactor
from jaxid.identification.identify import fit_problem
from jaxid.identification.normal_equations import BatchFit, DataSets, solve
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.robot_family import geometries
from jaxid.robot.robot import Robot

IN_A_CALL = 16
"""Data sets of one call of the compiled computation."""
BLOCKS = 10
"""Blocks of time of a data set that is solved by orthogonal factors."""


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
    """Estimates the base parameters of many data sets in one call (Eqs. 28-33).

    The parameters are those of `identify` with `WeightedLeastSquares` on each data set. Compiles
    once for each shape; works under `jit`, `vmap` and `grad`, where data sets that determine too
    little are only marked. Without tracing they are solved again by orthogonal factors.

    Args:
        base: What can be identified on this robot.
        motion: Motions [datasets, samples, joints], already filtered and decimated.
        forces: Generalized forces [N m or N], reduced like the motion. With an axis of draws, many
            sets of forces over one motion, whose columns are then evaluated and factored once.
        weights: Weights of the joints' rows [1/(N m) or 1/N], for all data sets or for each;
            reciprocals of the largest forces if None (Eq. 30).
        mask: Which rows count: data sets of different length are filled up and masked.
        robots: The robot of each data set, of the topology of the base parameters' robot: the
            columns that lead its base parameters are kept.
        row_time: Between two rows [s]. With it, standard deviations come from the spectral
            sandwich; without it, rows are taken for independent.
        estimator: Another than weighted least squares: it estimates one data set after the other,
            on all cores. It has weights of its own; not with `robots`, and not while JAX traces.

    Returns:
        The estimates of all data sets.

    Raises:
        InputError: If shapes do not fit, there are too few rows, or weights are not known.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("a batch of identifications")
    robot = base.model.robot
    _check(base, motion, forces, mask, robots)
    if estimator is not None:
        if robots is not None or weights is not None:
            raise InputError(
                "`estimator` goes with neither `robots` nor `weights`: the estimator has its own "
                "weights, and solves for one robot."
            )
        return estimate_each(base, motion, forces, mask, estimator, row_time)
    if weights is None:
        weights = 1.0 / np.asarray(robot.max_forces)
    if robots is None:
        rows, numbers = base.joint_regressor, None
    else:
        family, numbers = geometries(base, robots)
        n = (robot.joints,)
        rows = JointRegressor(family, family.columns, n, n, n, (numbers.shape[1],))
    batch = DataSets(
        motion,
        _without_tool(base, motion, forces).reshape(len(forces), -1, *forces.shape[-2:]),
        jnp.broadcast_to(jnp.asarray(weights), (len(forces), robot.joints)),
        None if mask is None else jnp.asarray(mask, float),
        numbers,
    )
    if is_traced(batch):
        fit = solve(rows, batch, row_time)
    else:
        fit = _solved_again(base, rows, batch, _solve_in_parts(rows, batch, row_time), row_time)
    draws = forces.shape[1:-2]

    def shaped(x: AnyArray) -> AnyArray:
        return x.reshape(len(forces), *draws, x.shape[-1])

    return BatchFit(
        shaped(fit.parameters),
        shaped(fit.standard_deviations),
        shaped(fit.residual_rms),
        fit.condition_numbers,
        fit.determined,
        shaped(fit.naive_standard_deviations),
        shaped(fit.freedom),
    )


def _check(base, motion, forces, mask, robots) -> None:
    n = base.model.robot.joints
    if forces.shape[-1] != n or motion.q.shape[-1] != n:
        raise InputError(
            f"`motion` and `forces` must have the {n} joints of `{base.model.robot.name}`, but "
            f"have {motion.q.shape[-1]} and {forces.shape[-1]}."
        )
    if forces.ndim < 3 or motion.q.shape != (forces.shape[0], *forces.shape[-2:]):
        raise InputError(
            "`motion` must have the shape [datasets, samples, joints] of `forces`, but has "
            f"{motion.q.shape} and `forces` has {forces.shape}."
        )
    if mask is not None and mask.shape != motion.q.shape:
        raise InputError(
            f"`mask` must have the shape {motion.q.shape} of the motion, but has {mask.shape}."
        )
    if robots is not None and len(robots) != len(forces):
        raise InputError(
            f"`robots` must be one for each of {len(forces)} data sets, but are {len(robots)}."
        )
    if forces.shape[-2] * n <= base.size:
        raise InputError(
            f"there are {forces.shape[-2] * n} rows for {base.size} base parameters: record longer."
        )


def _without_tool(base: BaseParameters, motion: Motion, forces: AnyArray) -> Array:
    if base.model.robot.tool is None:
        return jnp.asarray(forces)
    known = base.model.tool_forces(motion)
    return jnp.asarray(forces) - known.reshape(
        len(forces), *(1,) * (forces.ndim - 3), *known.shape[-2:]
    )


def _solve_in_parts(rows: JointRegressor, batch: DataSets, row_time: float | None) -> BatchFit:
    """Calls the compiled computation for a few data sets at a time, on all cores.

    XLA leaves small operations to one core, so each core gets data sets of its own. Parts of equal
    size also mean that another number of data sets compiles nothing anew.
    """
    datasets = len(batch.forces)
    size = min(datasets, IN_A_CALL)
    batch = jax.tree.map(np.asarray, batch)

    def part(start: int) -> BatchFit:
        chosen = np.arange(start, start + size) % datasets
        return jax.block_until_ready(
            solve(rows, jax.tree.map(lambda x: x[chosen], batch), row_time)
        )

    starts = range(0, datasets, size)
    if jax.default_backend() == "cpu" and len(starts) > 1:
        first = part(0)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            fits = [first, *pool.map(part, starts[1:])]
    else:
        fits = [part(start) for start in starts]
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:datasets], *fits)


def _solved_again(
    base: BaseParameters,
    rows: JointRegressor,
    batch: DataSets,
    fit: BatchFit,
    row_time: float | None,
) -> BatchFit:
    """Solves the data sets that are not well conditioned by orthogonal factors, one by one.

    Where standard deviations are not naive, they come from blocks of time, left out in turn.
    """
    weak = np.flatnonzero(~np.asarray(fit.determined))
    if not len(weak):
        return fit
    p, deviations, rms, condition, determined, naive, freedom = (
        np.array(x) for x in jax.tree.leaves(fit)
    )
    for k in weak:
        one = jax.tree.map(lambda x, k=k: np.asarray(x)[k], batch)
        for draw, forces in enumerate(one.forces):
            blocks = _blocks(rows, one, forces)
            if blocks.total.rows.sum() <= rows.size:
                p[k, draw], condition[k] = 0.0, np.inf
                deviations[k, draw] = naive[k, draw] = np.inf
                continue
            estimator = WeightedLeastSquares(GivenWeights(one.weights))
            again = fit_problem(RegressionProblem(base, blocks=blocks), estimator)
            found = again.naive_standard_deviations
            known = np.isfinite(found).all()
            p[k, draw], naive[k, draw] = again.parameters, found
            deviations[k, draw] = found if row_time is None else again.standard_deviations
            if row_time is not None:
                freedom[k, draw] = again.uncertainty.dof
            rms[k, draw] = again.residual_rms
            condition[k] = again.condition_numbers.scaled if known else np.inf
            determined[k] = known
    return BatchFit(*map(jnp.asarray, (p, deviations, rms, condition, determined, naive, freedom)))


def _blocks(rows: JointRegressor, one: DataSets, forces: np.ndarray) -> Blocks:
    """The triangular factors of one data set and one draw of its forces, by blocks of time."""
    edges = np.linspace(0, len(forces), BLOCKS + 1).astype(int)
    parts = []
    for begin, end in itertools.pairwise(edges):
        joints = [JointFactor(c, np.zeros((0, len(c) + 1)), 0) for c in rows.columns]
        for start in range(begin, end, 65536):
            part = slice(start, min(start + 65536, end))
            arrays = [x[part].T for x in jax.tree.leaves(one.motion)]
            if one.numbers is not None:
                shape = (len(one.numbers), arrays[0].shape[-1])
                arrays.append(np.broadcast_to(one.numbers[:, None], shape))
            for j, columns in enumerate(rows.in_numpy(*arrays)):
                kept = slice(None) if one.mask is None else one.mask[part, j] > 0
                joints[j] = joints[j].append(np.column_stack([columns.T, forces[part, j]])[kept])
        parts.append(Factors(tuple(joints), rows.size))
    return Blocks(tuple(parts))

"""Many data sets in one call: robots of one kind, noise draws, geometries.

Data sets go through one compiled computation in groups, so that memory does not grow with their
number. For each data set the rows of a joint are reduced to their products with each other and with
the forces (Gram matrices), weighted, added, and solved with columns scaled to length one. Where
that loses digits, a refinement with the residuals, or orthogonal factors, bring them back.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import is_traced
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.joint_rows import JointRows
from jaxid.dynamics.motion import Motion
from jaxid.identification.estimators import WeightedLeastSquares
from jaxid.identification.factors import CHUNK, Blocks, Factors, JointFactor
from jaxid.identification.geometries import geometries
from jaxid.identification.identify import fit_blocks
from jaxid.identification.normal_equations import BatchFit, DataSets, solve
from jaxid.identification.weights import GivenWeights
from jaxid.robot.robot import Robot
from jaxid.types import AnyArray, Array, Bool, Float, require_float64

IN_A_CALL = 16
"""Data sets of one call of the compiled computation."""


def identify_batch(
    base: BaseParameters,
    motion: Motion,
    forces: Float[AnyArray, "datasets *draws samples joints"],
    weights: Float[AnyArray, "*sets joints"] | None = None,
    *,
    mask: Bool[AnyArray, "sets rows joints"] | None = None,
    robots: Sequence[Robot] | None = None,
) -> BatchFit:
    """Estimates the base parameters of many data sets in one call (Eqs. 28-33).

    The parameters are those of `identify` with `WeightedLeastSquares` on each data set. Compiles
    once for each shape; works under `jit`, `vmap` and `grad`, where data sets that determine too
    little are only marked. Without tracing they are solved again by orthogonal factors.

    Args:
        base: What can be identified on this robot.
        motion: Of each data set, [datasets, samples, joints]: filtered and decimated before.
        forces: Generalized forces [N m or N], reduced like the motion. With an axis of draws, many
            sets of forces over one motion, whose columns are then evaluated and factored once.
        weights: Of the joints' rows [1/(N m) or 1/N], the same for all data sets or for each; the
            reciprocals of the largest forces if None (Eq. 30).
        mask: Which rows count: data sets of different length are filled up and masked.
        robots: The robot of each data set, of the topology of the base parameters' robot: the
            columns that lead its base parameters are kept.

    Returns:
        The estimates of all data sets.

    Raises:
        ValueError: If shapes do not fit, there are too few rows, or weights are not known.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("a batch of identifications")
    robot = base.model.robot
    _check(base, motion, forces, mask, robots)
    if weights is None:
        weights = 1.0 / np.asarray(robot.max_forces)
    if robots is None:
        rows, numbers = JointRows.of_base(base), None
    else:
        family, numbers = geometries(base, robots)
        n = (robot.joints,)
        rows = JointRows.of(family, family.columns, n, n, n, (numbers.shape[1],))
    batch = DataSets(
        motion,
        _without_tool(base, motion, forces).reshape(len(forces), -1, *forces.shape[-2:]),
        jnp.broadcast_to(jnp.asarray(weights), (len(forces), robot.joints)),
        None if mask is None else jnp.asarray(mask, float),
        numbers,
    )
    if is_traced(batch):
        fit = solve(rows, batch)
    else:
        fit = _solved_again(base, rows, batch, _solve_in_parts(rows, batch))
    draws = forces.shape[1:-2]
    return BatchFit(
        fit.parameters.reshape(len(forces), *draws, base.size),
        fit.standard_deviations.reshape(len(forces), *draws, base.size),
        fit.residual_rms.reshape(len(forces), *draws, robot.joints),
        fit.condition_numbers,
        fit.determined,
    )


def _check(base, motion, forces, mask, robots) -> None:
    n = base.model.robot.joints
    if forces.shape[-1] != n or motion.q.shape[-1] != n:
        raise ValueError(
            f"`motion` and `forces` must have the {n} joints of `{base.model.robot.name}`, but "
            f"have {motion.q.shape[-1]} and {forces.shape[-1]}."
        )
    if forces.ndim < 3 or motion.q.shape != (forces.shape[0], *forces.shape[-2:]):
        raise ValueError(
            "`motion` must have the shape [datasets, samples, joints] of `forces`, but has "
            f"{motion.q.shape} and `forces` has {forces.shape}."
        )
    if mask is not None and mask.shape != motion.q.shape:
        raise ValueError(
            f"`mask` must have the shape {motion.q.shape} of the motion, but has {mask.shape}."
        )
    if robots is not None and len(robots) != len(forces):
        raise ValueError(
            f"`robots` must be one for each of {len(forces)} data sets, but are {len(robots)}."
        )
    if forces.shape[-2] * n <= base.size:
        raise ValueError(
            f"there are {forces.shape[-2] * n} rows for {base.size} base parameters: record longer."
        )


def _without_tool(base: BaseParameters, motion: Motion, forces: AnyArray) -> Array:
    if base.model.robot.tool is None:
        return jnp.asarray(forces)
    known = base.model.tool_forces(motion)
    return jnp.asarray(forces) - known.reshape(
        len(forces), *(1,) * (forces.ndim - 3), *known.shape[-2:]
    )


def _solve_in_parts(rows: JointRows, batch: DataSets) -> BatchFit:
    """Calls the compiled computation for a few data sets at a time, on all cores.

    XLA leaves small operations to one core, so each core gets data sets of its own. Parts of equal
    size also mean that another number of data sets compiles nothing anew.
    """
    datasets = len(batch.forces)
    size = min(datasets, IN_A_CALL)
    batch = jax.tree.map(np.asarray, batch)

    def part(start: int) -> BatchFit:
        chosen = np.arange(start, start + size) % datasets
        return jax.block_until_ready(solve(rows, jax.tree.map(lambda x: x[chosen], batch)))

    starts = range(0, datasets, size)
    if jax.default_backend() == "cpu" and len(starts) > 1:
        first = part(0)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            fits = [first, *pool.map(part, starts[1:])]
    else:
        fits = [part(start) for start in starts]
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:datasets], *fits)


def _solved_again(
    base: BaseParameters, rows: JointRows, batch: DataSets, fit: BatchFit
) -> BatchFit:
    """Solves the data sets that are not well conditioned by orthogonal factors, one by one."""
    weak = np.flatnonzero(~np.asarray(fit.determined))
    if not len(weak):
        return fit
    p, deviations, rms, condition, determined = (np.array(x) for x in jax.tree.leaves(fit))
    for k in weak:
        one = jax.tree.map(lambda x, k=k: np.asarray(x)[k], batch)
        for draw, forces in enumerate(one.forces):
            factors = _factors(rows, one, forces)
            if factors.rows.sum() <= rows.size:
                p[k, draw], deviations[k, draw], condition[k] = 0.0, np.inf, np.inf
                continue
            estimator = WeightedLeastSquares(GivenWeights(one.weights))
            again = fit_blocks(base, Blocks((factors,)), estimator)
            known = np.isfinite(again.naive_standard_deviations).all()
            p[k, draw], deviations[k, draw] = again.parameters, again.naive_standard_deviations
            rms[k, draw] = again.residual_rms
            condition[k] = again.condition_numbers.scaled if known else np.inf
            determined[k] = known
    return BatchFit(*(jnp.asarray(x) for x in (p, deviations, rms, condition, determined)))


def _factors(rows: JointRows, one: DataSets, forces: np.ndarray) -> Factors:
    """The triangular factors of one data set and one draw of its forces."""
    joints = [JointFactor(c, np.zeros((0, len(c) + 1)), 0) for c in rows.columns]
    for start in range(0, len(forces), CHUNK):
        part = slice(start, start + CHUNK)
        arrays = [x[part].T for x in jax.tree.leaves(one.motion)]
        if one.numbers is not None:
            arrays.append(
                np.broadcast_to(one.numbers[:, None], (len(one.numbers), len(arrays[0].T)))
            )
        for j, columns in enumerate(rows.in_numpy(*arrays)):
            kept = slice(None) if one.mask is None else one.mask[part, j] > 0
            joints[j] = joints[j].joined(np.column_stack([columns.T, forces[part, j]])[kept])
    return Factors(tuple(joints), rows.size)

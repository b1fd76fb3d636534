"""Many data sets in one call: robots of one kind, noise draws, geometries, any estimator.

Data sets go through one compiled computation in groups, so that memory does not grow with their
number. For each data set the rows of a joint are reduced to their products with each other and with
the forces (Gram matrices), weighted, added, and solved with columns scaled to length one. Where
that loses digits, a refinement with the residuals, or orthogonal factors, bring them back.
"""

import itertools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float, in_parts, is_traced, on_cores, require_float64
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.open_model import opened
from jaxid.dynamics.packed_regressor import JointRegressor
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations
from jaxid.robot.robot import Robot

from .batch_solver import BatchFit, DataSets, solve
from .estimators import AbstractEstimator, GivenWeights, WeightedLeastSquares
from .fit_result import Fit
from .identify import identify
from .uncertainty import IndependentRows


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

    The parameters are those of `identify` with `WeightedLeastSquares` on each data set. Compiles
    once for each shape; works under `jit`, `vmap`, `grad` and `jvp`, by data and by the robot's
    geometry, where data sets that determine too little are only marked. Without tracing they are
    solved again by orthogonal factors.

    Args:
        base: Base parameters of the robot.
        motion: Motions [datasets, samples, joints], already filtered and decimated.
        forces: Generalised forces [N m or N], reduced like the motion. With an axis of draws, many
            sets of forces over one motion, whose columns are then evaluated and factored once.
        weights: Weights of the joints' rows [1/(N m) or 1/N], for all data sets or for each;
            reciprocals of the largest forces if None (Eq. 30).
        mask: Rows that count: data sets of different length are filled up and masked.
        robots: Robot of each data set, of the topology of the base parameters' robot: the columns
            that lead its base parameters are kept.
        row_time: Time between two rows [s]. With it, standard deviations come from the spectral
            sandwich; without it, rows are taken for independent.
        estimator: Another than weighted least squares: it estimates one data set after the other,
            on all cores. It has weights of its own; not with `robots`, and not while JAX traces.

    Raises:
        InputError: If shapes do not fit, there are too few rows, or weights are not known.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("a batch of identifications")
    robot = base.model.robot
    _check(base, motion, forces, mask, robots)
    if estimator is not None and not (robots is None and weights is None):
        raise InputError("`estimator` has weights of its own: leave out `robots` and `weights`.")
    sets, draws = len(forces), forces.shape[1:-2]
    if weights is None and is_traced(robot.limits, robot.drives):
        raise InputError("`weights` must be given where JAX is tracing the robot's limits.")
    if weights is None:
        weights = np.ones(robot.joints) if estimator else 1.0 / np.asarray(robot.max_forces)
    batch = DataSets(
        motion,
        jnp.asarray(forces).reshape(sets, -1, *forces.shape[-2:]),
        jnp.broadcast_to(jnp.asarray(weights), (sets, robot.joints)),
        None if mask is None else jnp.asarray(mask, float),
        None,
    )
    if base.model.memory is not None and estimator is None:
        raise InputError("friction with memory needs one data set at a time: give an `estimator`.")
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
    return jax.tree.map(lambda x: x if x.ndim == 1 else x.reshape(sets, *draws, x.shape[-1]), fit)


def _check(base, motion, forces, mask, robots) -> None:
    n, samples = base.model.robot.joints, forces.shape[-2]
    wanted = (len(forces), samples, n)
    for name, array in (("motion", motion.q), ("mask", motion.q if mask is None else mask)):
        if array.shape != wanted:
            rule = f"the shape [datasets, samples, joints] {wanted} of the forces"
            raise InputError(f"`{name}` must have {rule}, but has {array.shape}.")
    if robots is not None and len(robots) != len(forces):
        raise InputError(
            f"`robots` must be one for each of {len(forces)} data sets: {len(robots)}."
        )
    if samples * n <= base.size:
        raise InputError(f"{samples * n} rows for {base.size} base parameters: record longer.")


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


def _estimate_each(base, batch: DataSets, estimator: AbstractEstimator, row_time) -> BatchFit:
    """Return the estimates of `identify` for each data set and draw, on all cores."""
    motion, Q = jax.tree.map(np.asarray, (batch.motion, batch.forces))
    counted = np.ones(motion.q.shape, bool) if batch.mask is None else np.asarray(batch.mask) > 0
    uncertainty = IndependentRows() if row_time is None else None

    def one(case: tuple[int, int]) -> Fit:
        k, draw = case
        kept, own = counted[k], motion[k]
        kept_forces = np.where(kept, Q[k, draw], 0.0)
        options = {"sample_time": row_time or 1.0, "mask": kept, "name": f"data set {k + 1}"}
        o = Observations.of(own.q, own.qd, own.qdd, kept_forces, **options)
        return identify(base, o, estimator, uncertainty=uncertainty)

    cases = itertools.product(range(len(Q)), range(Q.shape[1]))
    fits = list(on_cores(one, cases))
    known = np.array([np.isfinite(fit.naive_standard_deviations).all() for fit in fits])
    condition = np.array([fit.condition_numbers.scaled for fit in fits])
    names = ("parameters", "standard_deviations", "residual_rms", "naive_standard_deviations")
    fit = BatchFit(
        **{name: jnp.stack([getattr(fit, name) for fit in fits]) for name in names},
        # Only those that determine all have a condition number.
        condition_numbers=jnp.asarray(np.where(known, condition, np.inf)),
        determined=jnp.asarray(known),
        dof=jnp.stack([fit.uncertainty.dof for fit in fits]),
    )
    draws = Q.shape[1]
    return jax.tree.map(lambda x: x.reshape(len(Q), draws, -1) if x.ndim > 1 else x[::draws], fit)


def _of_each(base: BaseParameters, robots: Sequence[Robot]) -> list[BaseParameters]:
    """Return the base parameters of robots of one topology, with the geometry of each."""
    own, each = base.model.robot, []
    for robot in robots:
        alike = robot.parent == own.parent and robot.revolute == own.revolute
        if not alike or robot.tool is not None:
            raise InputError(
                f"`{robot.name}` of `robots` must have the topology of `{own.name}`, and no tool."
            )
        geometry = {x: getattr(robot, x) for x in ("axis", "rotation", "offset", "gravity")}
        placed = own.replace(**geometry)
        each.append(eqx.tree_at(lambda b: b.model.robot, base, placed))
    return each

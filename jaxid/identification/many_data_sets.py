"""Many data sets in one call: similar robots, noise draws, geometries.

Least squares of all data sets are one compiled computation. Data sets that are not well
conditioned are solved again by orthogonal factors, one by one.
"""

import itertools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Bool,
    Float,
    in_parts,
    is_traced,
    namespace,
    on_cores,
    require_float64,
)
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.packed_regressor import JointRegressor
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations
from jaxid.program.open_model import opened
from jaxid.robot.robot import Robot

from .batch_solution import BatchFit, DataSets, solve
from .estimators import GivenWeights, WeightedLeastSquares
from .fit_result import Fit
from .identify import identify
from .uncertainty import IndependentRows

Robots = Sequence[Robot] | None
"""Robot of each data set; None for that of the base parameters."""
Place = tuple[int, ...]
"""Number of a data set, and of a draw of its forces if there are several."""


def identify_batch(
    base: BaseParameters,
    motion: Motion,
    forces: Float[AnyArray, "datasets *draws samples joints"],
    weights: Float[AnyArray, "*sets joints"] | None = None,
    *,
    mask: Bool[AnyArray, "sets rows joints"] | None = None,
    robots: Robots = None,
    row_time: float | None = None,
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

    Raises:
        InputError: If shapes do not fit, there are too few rows, or weights are not
            known.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("a batch of identifications")
    robot = base.model.robot
    _check_arguments(base, motion, forces, mask, robots)
    if base.model.memory is not None:
        raise InputError(
            "friction with memory works with one data set at a time: call `identify`."
        )
    if weights is None:
        if is_traced(robot.limits, robot.drives):
            raise InputError(
                "`weights` must be given where JAX is tracing the robot's limits."
            )
        weights = 1.0 / np.asarray(robot.max_forces)
    # Each operation on arrays of JAX would be sent to the device by itself.
    weights_shape = (len(forces), robot.joints)
    batch = DataSets(
        motion=motion,
        forces=forces,
        weights=namespace(weights).broadcast_to(weights, weights_shape),
        mask=None if mask is None else mask.astype(float),
        numbers=None,
    )
    return _solve_together(base, robots, batch, row_time)


def _check_arguments(base, motion, forces, mask, robots) -> None:
    """Reject arrays of different shapes, and too few rows or robots."""
    joints = base.model.robot.joints
    shape = (len(forces), forces.shape[-2], joints)
    arrays = {"motion": motion.q}
    if mask is not None:
        arrays["mask"] = mask
    for name, array in arrays.items():
        if array.shape != shape:
            raise InputError(
                f"`{name}` must have the shape [datasets, samples, joints] {shape} of "
                f"the forces, but has {array.shape}."
            )
    if robots is not None and len(robots) != len(forces):
        raise InputError(
            f"`robots` must be one for each of {len(forces)} data sets: {len(robots)}."
        )
    rows = forces.shape[-2] * joints
    if rows <= base.size:
        raise InputError(f"{rows} rows for {base.size} base parameters: record longer.")


def _solve_together(
    base: BaseParameters,
    robots: Robots,
    batch: DataSets,
    row_time: float | None,
) -> BatchFit:
    """Return weighted least squares of all data sets."""
    robot = base.model.robot
    data_sets = batch
    if robots is None and not is_traced(robot):
        regressor = base.joint_regressor
    else:
        # The geometry becomes an argument of the columns.
        placed_bases = _with_geometries(base, robots or ())
        family, numbers = opened("columns", base, *placed_bases)
        joints = (robot.joints,)
        count = numbers.shape[1]
        regressor = JointRegressor(
            family, family.call, (count,), joints, joints, joints
        )
        # The first are those of the base parameters' own robot.
        numbers = numbers if robots is None else numbers[1:]
        numbers = jnp.broadcast_to(numbers, (len(batch.forces), count))
        data_sets = batch._replace(numbers=numbers)
    if robot.tool is not None:
        tool_forces = base.model.tool_forces(batch.motion)
        sets, *draws, samples, joints = batch.forces.shape
        shape = (sets, *(1,) * len(draws), samples, joints)
        remaining_forces = batch.forces - tool_forces.reshape(shape)
        data_sets = data_sets._replace(forces=remaining_forces)
    if is_traced(data_sets):
        return solve(regressor, data_sets, row_time)
    fit = in_parts(lambda part: solve(regressor, part, row_time), data_sets)
    return _solve_again(base, robots, batch, fit, row_time)


def _solve_again(
    base: BaseParameters,
    robots: Robots,
    batch: DataSets,
    fit: BatchFit,
    row_time: float | None,
) -> BatchFit:
    """Solve data sets that are not well conditioned by `identify`, on all cores."""
    numbers = np.flatnonzero(~jax.device_get(fit.determined))
    if not len(numbers):
        # Nothing else leaves the device.
        return fit
    fit = jax.tree.map(np.array, fit)
    counts = np.full(len(fit.determined), batch.motion.q[0].size)
    if batch.mask is not None:
        counts = np.sum(batch.mask, axis=(1, 2))
    # Data sets that determine too little have no estimate, and no condition number.
    fit.parameters[numbers] = 0.0
    fit.condition_numbers[numbers] = np.inf
    fit.standard_deviations[numbers] = np.inf
    fit.naive_standard_deviations[numbers] = np.inf

    def identify_one(place: Place) -> Fit:
        k, *_ = place
        robot = base.model.robot if robots is None else robots[k]
        placed_base = eqx.tree_at(lambda b: b.model.robot, base, robot)
        return _identify_one(placed_base, batch, place, row_time)

    draws = np.ndindex(batch.forces.shape[1:-2])
    sufficient_sets = numbers[counts[numbers] > base.size].tolist()
    places = [(k, *draw) for k, draw in itertools.product(sufficient_sets, draws)]
    for place, result in zip(places, on_cores(identify_one, places), strict=True):
        fit.parameters[place] = result.parameters
        fit.standard_deviations[place] = result.standard_deviations
        fit.residual_rms[place] = result.residual_rms
        fit.naive_standard_deviations[place] = result.naive_standard_deviations
        fit.dof[place] = result.uncertainty.dof
        # Whether a data set determines its parameters does not depend on the draw.
        k, *_ = place
        fit.determined[k] = np.isfinite(result.naive_standard_deviations).all()
        if fit.determined[k]:
            fit.condition_numbers[k] = result.condition_numbers.scaled
    return jax.tree.map(jnp.asarray, fit)


def _identify_one(
    base: BaseParameters, batch: DataSets, place: Place, row_time: float | None
) -> Fit:
    """Return the fit of one draw of a data set."""
    k, *_ = place
    motion, forces = jax.tree.map(np.asarray, (batch.motion[k], batch.forces[place]))
    mask = np.ones(forces.shape, bool)
    if batch.mask is not None:
        mask = np.asarray(batch.mask[k]) > 0
    recording = Observations.of(
        motion.q,
        motion.qd,
        motion.qdd,
        np.where(mask, forces, 0.0),
        sample_time=row_time or 1.0,
        mask=mask,
        name=f"data set {k + 1}",
    )
    estimator = WeightedLeastSquares(GivenWeights(np.asarray(batch.weights[k])))
    uncertainty = IndependentRows() if row_time is None else None
    return identify(base, recording, estimator, uncertainty=uncertainty)


def _with_geometries(base: BaseParameters, robots: Sequence[Robot]):
    """Return the base parameters with the geometry of robots of the same topology."""
    robot = base.model.robot
    results = []
    for other_robot in robots:
        is_alike = (
            other_robot.parent == robot.parent
            and other_robot.turns == robot.turns
            and other_robot.followers == robot.followers
        )
        if not is_alike or other_robot.tool is not None:
            raise InputError(
                f"`{other_robot.name}` of `robots` must have "
                f"the topology of `{robot.name}`, and no tool."
            )
        placed_robot = robot.replace(
            axis=other_robot.axis,
            rotation=other_robot.rotation,
            offset=other_robot.offset,
            gravity=other_robot.gravity,
        )
        results.append(eqx.tree_at(lambda b: b.model.robot, base, placed_robot))
    return results

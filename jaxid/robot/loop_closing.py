"""Closed loops of many samples: Newton's steps in NumPy, or compiled.

One step is one short program. Where all samples are closed soon, few steps are made.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    Joints,
    ManyJoints,
    Numbers,
    as_array,
    is_traced,
    namespace,
)
from jaxid.errors import InputError
from jaxid.program.sample_methods import in_numpy, on_samples, program_of
from jaxid.program.xla_sample_blocks import on_rows

from .joint_coordinates import (
    LAST_STEPS,
    PARTS_OF_WAY,
    change_of_motors,
    chebyshev_step,
    closed_coordinates,
    coordinates_on_way,
    extrapolated_coordinates,
    linear_coordinates,
    loop_closure,
    with_loop_rates,
)

MAX_GAP = {"float64": 1e-6, "float32": 1e-4}
"""Distance between points of a loop up to which a last step closes it, by precision.

The error is its third power [m]; near singular poses the limit is in proportion.
"""
MIN_CLOSING_SHARE = 1e-4
"""Determinant of closing relative to that of the description; below, it is singular."""
MIN_SAFE_SHARE = 0.2
"""The same for motions that are designed or drawn."""
STEPS_AT_ONCE = 2
"""Steps of one program, in which sines and cosines of motors are computed once."""
MAX_WAY_AT_ONCE = 1.0
"""Way of a motor from the robot's `loop_pose` up to which it is used [rad or m]."""
PARTS_OF_RANDOM_WAY = 24
"""Points on the way to random coordinates at which it is checked."""


PARTS = (0, PARTS_OF_WAY, 6 * PARTS_OF_WAY)
"""Parts of the motors' way from the robot's `loop_pose`, with one step each.

If 0, the loops start where they would be if their coordinates were cubic functions of
the motors'. Each number is for samples that the one before does not close.
"""


class Closure(eqx.Module):
    """Closing of the loops of a robot.

    Results are the coordinates of all joints and their `loop_closure`.
    """

    robot: Any

    def of_sample(self, q: Joints) -> Array:
        """Close the loops of one sample."""
        coordinates = closed_coordinates(self.robot, q)
        return jnp.concatenate([coordinates, loop_closure(self.robot, coordinates)])

    def start(self, change: Joints) -> AnyArray:
        """Return the joints that loops move, extrapolated from `loop_pose`."""
        coordinates = extrapolated_coordinates(self.robot, change)
        return coordinates[-len(self.robot.loop_rows) :]

    def step(self, others: Joints, moved: Joints) -> Array:
        """Return these joints after a step, and the closure before it."""
        coordinates = jnp.concatenate([others, moved])
        moved = moved + chebyshev_step(self.robot, coordinates)
        return jnp.concatenate([moved, loop_closure(self.robot, coordinates)])

    def at_once(self, q: Joints) -> Array:
        """Close the loops of one sample near `loop_pose`."""
        robot = self.robot
        moved = self.start(q - robot.loop_pose[: robot.joints])
        others = linear_coordinates(robot.followers, q)
        values = moved
        for _ in range(STEPS_AT_ONCE):
            values = self.step(others, values[: len(moved)])
        return jnp.concatenate([others, values])

    def of_samples(self, q: ManyJoints) -> AnyArray:
        """Close the loops of many samples; in float64 for NumPy's arrays."""
        rows: Any = q.reshape(-1, self.robot.joints)
        if isinstance(q, np.ndarray):
            values = self._in_numpy(rows)
        elif is_traced(self.robot):
            values = on_samples(self, self.of_sample, rows)
        else:
            values = self._in_jax(rows)
        return values.reshape(*q.shape[:-1], -1)

    def next_on_way(self, q: np.ndarray, values: AnyArray) -> AnyArray:
        """Close the loops of rows, from values of rows near them."""
        return self._attempted(0, q, values)

    def _in_numpy(self, q: np.ndarray) -> np.ndarray:
        """Close the loops of rows, in each attempt those that are still open."""
        values = in_numpy(self, self.at_once, q)
        is_near = self._is_near(q)
        are_closed = is_near & is_closed(values)
        for parts in PARTS:
            remaining = ~are_closed if parts else is_near & ~are_closed
            if not remaining.any():
                continue
            rows = self._attempted(parts, q[remaining], values[remaining])
            values[remaining] = rows
            are_closed[remaining] = is_closed(rows)
        return values

    def _in_jax(self, q: Array) -> Array:
        """Close the loops of rows, in each attempt those of all of them."""

        def is_open(state):
            number, _, are_closed = state
            return (number < len(PARTS)) & ~are_closed.all()

        def attempt(state):
            number, values, are_closed = state
            parts = jnp.array(PARTS)[number]
            rows = self._attempted(parts, constant_q, values)
            values = jnp.where(are_closed[:, None], values, rows)
            is_on_branch = is_near | (parts > 0)
            return number + 1, values, is_closed(values) & is_on_branch

        constant_q = jax.lax.stop_gradient(q)
        is_near = self._is_near(constant_q)
        others = linear_coordinates(self.robot.followers, constant_q)
        moved = self._evaluated(self.start, self._way(constant_q))
        unknown_closure = jnp.full((len(q), 2), jnp.nan, q.dtype)
        values = jnp.concatenate([others, moved, unknown_closure], axis=1)
        state = (0, values, jnp.zeros(len(q), bool))
        _, values, _ = jax.lax.while_loop(is_open, attempt, state)
        derivable = jax.vmap(with_loop_rates, (None, 0, 0))
        coordinates, closure = jnp.split(values, [self.robot.bodies], axis=1)
        coordinates = derivable(self.robot, q, coordinates)
        return jnp.concatenate([coordinates, closure], axis=1)

    def _way(self, q: ManyJoints):
        """Return how far motors of rows are from `loop_pose`."""
        pose = namespace(q).asarray(self.robot.loop_pose, q.dtype)
        return q - pose[None, : self.robot.joints]

    def _is_near(self, q: ManyJoints):
        """Return whether motors of rows are near `loop_pose`."""
        return (abs(self._way(q)) <= MAX_WAY_AT_ONCE).all(axis=1)

    def _attempted(self, parts: Any, q: ManyJoints, values: AnyArray):
        """Close the loops of rows on a way of some parts, or from where they are."""
        robot = self.robot
        xp = namespace(q)
        change = change_of_motors(robot, q)
        first = robot.bodies - len(robot.loop_rows)
        pose = xp.asarray(robot.loop_pose, q.dtype)
        moved = values[:, first : robot.bodies]
        moved = xp.where(parts == 0, moved, pose[None, first:])
        unknown_closure = xp.full((len(q), 2), xp.nan, q.dtype)

        def is_unfinished(state):
            k, rows = state
            is_open = ~is_closed(rows).all()
            return (k < parts) | ((k < parts + LAST_STEPS) & is_open)

        def step(state):
            k, rows = state
            share = (k + 1) / xp.maximum(parts, 1)
            others = coordinates_on_way(robot, q, change, share)
            return k + 1, self._evaluated(self.step, others, rows[:, :-2])

        state = (0, xp.concatenate([moved, unknown_closure], axis=1))
        if xp is np:
            while is_unfinished(state):
                state = step(state)
        else:
            state = jax.lax.while_loop(is_unfinished, step, state)
        others = linear_coordinates(robot.followers, q)
        return xp.concatenate([others, state[1]], axis=1)

    def _evaluated(self, method: Callable, *arrays: ManyJoints):
        """Return a method of rows, by its program."""
        if isinstance(arrays[0], np.ndarray):
            return in_numpy(self, method, *arrays)
        shapes = [x.shape[1:] for x in arrays]
        program = program_of(self, method, *shapes)
        return on_rows(program, *map(jnp.asarray, arrays))


def is_closed(values: AnyArray, min_share: float = MIN_CLOSING_SHARE) -> AnyArray:
    """Return whether loops are closed, on the branch of the description."""
    max_gap = MAX_GAP[values.dtype.name] * values[..., -1]
    return (values[..., -2] <= max_gap**2) & (values[..., -1] > min_share)


def close_loops(robot: Any, q: Numbers) -> ManyJoints:
    """Return the coordinates of all joints; see `Robot.close`."""
    q = as_array("q", q)
    if q.shape[-1:] != (robot.joints,):
        raise InputError(
            f"`q` must have {robot.joints} joints along its last axis, but has shape "
            f"{q.shape}."
        )
    if not robot.loops:
        return linear_coordinates(robot.followers, q)
    values = Closure(robot).of_samples(q)
    coordinates = values[..., : robot.bodies]
    are_closed = is_closed(values)
    if is_traced(values):
        return jnp.where(are_closed[..., None], coordinates, jnp.nan)
    if not np.all(are_closed):
        sample = int(np.argmin(np.ravel(are_closed)))
        pose = np.asarray(q).reshape(-1, robot.joints)[sample]
        distance = float(np.sqrt(np.ravel(values[..., -2])[sample]))
        raise _open_error(robot, sample, pose, distance)
    return coordinates


def reachable(robot: Any, q: np.ndarray) -> np.ndarray:
    """Return the last coordinates on the way from `loop_pose` that loops reach safely.

    They do not pass a singular pose, behind which a loop may close in two ways.

    Args:
        robot: Robot, which may have no loops.
        q: Coordinates of the joints that move alone, such as random ones.
    """
    if not robot.loops:
        return q
    closure = Closure(robot)
    start = np.asarray(robot.loop_pose)[: robot.joints]
    way = (np.asarray(q, np.float64) - start).reshape(-1, robot.joints)
    shares = np.zeros(len(way))
    is_reached = np.ones(len(way), bool)
    values = closure.of_samples(np.broadcast_to(start, way.shape))
    for part in range(1, PARTS_OF_RANDOM_WAY + 1):
        share = part / PARTS_OF_RANDOM_WAY
        points = start + share * way[is_reached]
        values = closure.next_on_way(points, values)
        are_safe = is_closed(values, MIN_SAFE_SHARE)
        values = values[are_safe]
        is_reached[is_reached] = are_safe
        shares[is_reached] = share
    # Robots close their loops on the shortest way, which may be another one.
    points = start + shares[:, None] * way
    are_safe = is_closed(closure.of_samples(points), MIN_SAFE_SHARE)
    return np.where(are_safe[:, None], points, start).reshape(np.shape(q))


def _open_error(robot: Any, sample: int, pose: np.ndarray, distance: float):
    """Return the error of a motion whose loops do not close at a sample."""
    positions = ", ".join(f"{x:.4g}" for x in pose)
    loops = ", ".join(f"`{loop.name}`" for loop in robot.loops)
    fault = f"the points of {loops} stay {distance:.3g} m apart"
    if distance <= MAX_GAP["float32"]:
        fault = f"{loops} would have to pass a singular pose"
    return InputError(
        f"the loops of `{robot.name}` do not close at sample {sample}, where "
        f"{', '.join(robot.joint_names)} are at {positions}: {fault}; keep `q` within "
        "the reach of the mechanism, on the branch of the description."
    )

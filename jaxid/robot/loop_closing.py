"""Closed loops of samples: Newton's steps on the way of the motors, in NumPy or JAX.

Motors go from the robot's `loop_pose` to their coordinates in parts, and the loops
follow. A part that Newton's steps do not close as they do near a regular pose is halved
(Deuflhard, Newton Methods for Nonlinear Problems, 2011, chapter 5): so no step jumps
over a singular pose, behind which loops may close on another branch.
"""

from typing import Any, NamedTuple

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
from jaxid.program.sample_methods import evaluate_samples

from .joint_coordinates import (
    all_rates,
    change_of_motors,
    linear_coordinates,
    loop_closure,
    newton_step,
    with_loop_rates,
)

MAX_GAP = {"float64": 1e-6, "float32": 1e-4}
"""Distance between points of a loop [m] from which a last step closes it."""
MIN_CLOSING_SHARE = 1e-4
"""Determinant of closing relative to that of the description; below, it is singular."""
MIN_SAFE_SHARE = 0.2
"""The same for motions that are designed or drawn."""
STEPS_AT_ONCE = 4
"""Steps of one program, in which sines and cosines of motors are computed once."""


class WayLimits(NamedTuple):
    """Limits of the parts of the motors' way.

    Attributes:
        motors: Way of the motors up to which it starts with one part [rad or m].
        prediction: Change of the joints that loops move which is trusted [rad or m].
        correction: Largest ratio of the first step to this change.
        contraction: Largest ratio of each step to the one before it; theory ends at 1/2
            (Deuflhard).
        part: Share of the way that is not halved again.
        rounding: Size of steps that are rounding [rad or m].
    """

    motors: float = 1.5
    prediction: float = 1.0
    correction: float = 0.8
    contraction: float = 0.5
    part: float = 1 / 1024
    rounding: float = 1e-9


LIMITS = WayLimits()


class Progress(NamedTuple):
    """How far the loops of one sample have followed the motors.

    Attributes:
        moved: Coordinates of the joints that loops move, while they are being closed.
        limit: Limit of the square of the next step.
        part: Share of the way that the motors go next, at most to its end.
        rate: Derivatives of `origin` by the share of the way.
        origin: Coordinates of these joints where the loops were closed last.
        reached: Share of the way there.
    """

    moved: AnyArray
    limit: AnyArray
    part: AnyArray
    rate: AnyArray
    origin: AnyArray
    reached: AnyArray

    @classmethod
    def at_part(
        cls, origin: Joints, rate: Joints, reached: AnyArray, part: AnyArray
    ) -> "Progress":
        """Return the progress at the beginning of a part of the way."""
        prediction = jnp.minimum(part, 1.0 - reached) * rate
        square = jnp.minimum(prediction @ prediction, LIMITS.prediction**2)
        limit = LIMITS.correction**2 * square
        return cls(origin + prediction, limit, part, rate, origin, reached)

    @classmethod
    def of(cls, numbers: Array) -> "Progress":
        """Read the numbers of `packed`."""
        joints = len(numbers) // 3 - 1
        rate, origin = jnp.split(numbers[joints + 2 : -1], 2)
        limit, part = numbers[joints : joints + 2]
        return cls(numbers[:joints], limit, part, rate, origin, numbers[-1])

    @property
    def packed(self) -> Array:
        """All numbers, one after the other."""
        return jnp.concatenate([jnp.atleast_1d(x) for x in self])


class Closure(eqx.Module):
    """Closing of the loops of a robot, up to poses that are nearly singular.

    Attributes:
        robot: Robot with loops.
        min_share: Least determinant relative to that of the robot's `loop_pose`.
        max_gap: Distance between points of a loop from which a last step closes it [m],
            relative to this determinant. The error is about its square.
    """

    robot: Any
    min_share: float = eqx.field(static=True, default=MIN_CLOSING_SHARE)
    max_gap: float = eqx.field(static=True, default=MAX_GAP["float64"])

    def start(self, change: Joints) -> Array:
        """Return the progress of one sample at the robot's `loop_pose`."""
        joints = len(self.robot.loop_rows)
        pose = jnp.asarray(self.robot.loop_pose, change.dtype)
        rate = all_rates(self.robot, pose, change)[-joints:]
        way = jnp.sqrt(change @ change)
        part = 1.0 / jnp.maximum(way / LIMITS.motors, 1.0)
        return Progress.at_part(pose[-joints:], rate, 0.0 * part, part).packed

    def step(self, q: Joints, change: Joints, numbers: Array) -> Array:
        """Return the progress of one sample after one of Newton's steps."""
        progress = Progress.of(numbers)
        rest = jnp.maximum(1.0 - progress.reached - progress.part, 0.0)
        others = linear_coordinates(self.robot.followers, q - rest * change)
        coordinates = jnp.concatenate([others, progress.moved])
        step = newton_step(self.robot, coordinates)
        moved = progress.moved + step
        square, share = loop_closure(self.robot, coordinates)
        max_gap = self.max_gap * jnp.maximum(share, self.min_share)
        is_closed = square <= max_gap**2
        is_on_way = ~is_closed & (step @ step < progress.limit)
        next_limit = LIMITS.contraction**2 * (step @ step)
        on_way = progress._replace(moved=moved, limit=next_limit)

        # A part at whose end the loops close is followed by a longer one; others are
        # halved.
        has_arrived = is_closed & (share > self.min_share)
        rate = all_rates(self.robot, coordinates, change)[-len(moved) :]
        next_part = Progress.at_part(
            jnp.where(has_arrived, moved, progress.origin),
            jnp.where(has_arrived, rate, progress.rate),
            jnp.where(has_arrived, 1.0 - rest, progress.reached),
            jnp.where(has_arrived, 2.0, 0.5) * progress.part,
        )
        return jnp.where(is_on_way, on_way.packed, next_part.packed)

    def at_once(self, q: Joints, change: Joints) -> Array:
        """Return the joints that loops move after `STEPS_AT_ONCE` steps, and 1.

        The 1 is a 0 where the way has several parts, or where the steps fail.
        """
        progress = Progress.of(self.start(change))
        others = linear_coordinates(self.robot.followers, q)
        moved = progress.moved
        limit = progress.limit
        are_regular = progress.part == 1.0
        coordinates = jnp.concatenate([others, moved])
        for _ in range(STEPS_AT_ONCE):
            coordinates = jnp.concatenate([others, moved])
            step = newton_step(self.robot, coordinates)
            square = step @ step
            are_regular &= square < jnp.maximum(limit, LIMITS.rounding**2)
            limit = LIMITS.contraction**2 * square
            moved = moved + step
        square, share = loop_closure(self.robot, coordinates)
        is_closed = square <= (self.max_gap * share) ** 2
        has_arrived = are_regular & is_closed & (share > self.min_share)
        return jnp.append(moved, jnp.where(has_arrived, 1.0, 0.0))


def follow(closure: Closure, q: ManyJoints, change: ManyJoints) -> AnyArray:
    """Return the joints that loops move, and the share of the way they follow.

    Args:
        closure: How loops are closed.
        q: Coordinates of the motors behind the whole way, in rows.
        change: Way of the motors to these coordinates.
    """
    if isinstance(q, np.ndarray):
        rows = evaluate_samples(closure, closure.at_once, q, change)
        remaining = np.flatnonzero(rows[:, -1] < 1.0)
        if len(remaining):
            rows[remaining] = _by_parts(closure, q[remaining], change[remaining])
        return rows
    return _by_parts(closure, q, change)


def _by_parts(closure: Closure, q: ManyJoints, change: ManyJoints) -> Any:
    """Return the same by one step of all rows after the other."""
    joints = len(closure.robot.loop_rows)
    xp = namespace(q)

    def are_unfinished(rows):
        return (rows[:, -1] < 1.0) & (rows[:, joints + 1] > LIMITS.part)

    def step(rows):
        next_rows = evaluate_samples(closure, closure.step, q, change, rows)
        return xp.where(are_unfinished(rows)[:, None], next_rows, rows)

    rows: Any = evaluate_samples(closure, closure.start, change)
    if xp is np:
        while are_unfinished(rows).any():
            rows = step(rows)
    else:
        rows = jax.lax.while_loop(lambda x: are_unfinished(x).any(), step, rows)
    return rows[:, -joints - 1 :]


def closed_samples(
    robot: Any, q: ManyJoints, min_share: float = MIN_CLOSING_SHARE
) -> tuple[AnyArray, AnyArray]:
    """Return the coordinates of all joints of samples, and how far loops stay closed.

    This share of the motors' way from the robot's `loop_pose` is 1 where they close.
    Elsewhere the joints that they move stay where they were closed last. The results
    are in float64 for NumPy's arrays.
    """
    rows: Any = q.reshape(-1, robot.joints)
    change = change_of_motors(robot, rows)
    others = linear_coordinates(robot.followers, rows)
    if isinstance(q, np.ndarray):
        progress = follow(Closure(robot, min_share), rows, change)
        coordinates = np.concatenate([others, progress[:, :-1]], axis=1)
    else:
        closure = Closure(robot, min_share, MAX_GAP[q.dtype.name])
        if is_traced(robot):
            closure = jax.lax.stop_gradient(closure)
        constants = jax.lax.stop_gradient((rows, change))
        progress = follow(closure, *constants)
        open_rows = jnp.concatenate([others, progress[:, :-1]], axis=1)
        closed_rows = jax.vmap(with_loop_rates, (None, 0, 0))(robot, rows, open_rows)
        is_closed = progress[:, -1:] == 1.0
        coordinates = jnp.where(is_closed, closed_rows, open_rows)
    batch = q.shape[:-1]
    return coordinates.reshape(*batch, -1), progress[:, -1].reshape(batch)


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
    coordinates, reached = closed_samples(robot, q)
    if is_traced(coordinates):
        return jnp.where(reached[..., None] == 1.0, coordinates, jnp.nan)
    if np.any(reached < 1.0):
        raise _open_error(robot, np.asarray(q), np.ravel(reached))
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
    start = np.asarray(robot.loop_pose)[: robot.joints]
    rows = np.asarray(q, np.float64).reshape(-1, robot.joints)
    way = rows - start
    progress = follow(Closure(robot, MIN_SAFE_SHARE), rows, way)
    points = start + progress[:, -1:] * way
    # Robots close their loops on the shortest way, which may be another one.
    _, reached = closed_samples(robot, points, MIN_SAFE_SHARE)
    return np.where(reached[:, None] == 1.0, points, start).reshape(np.shape(q))


def _open_error(robot: Any, q: np.ndarray, reached: np.ndarray):
    """Return the error of a motion whose loops do not close at a sample."""
    sample = int(np.argmax(reached < 1.0))
    pose = q.reshape(-1, robot.joints)[sample]
    last_pose = pose - (1.0 - reached[sample]) * change_of_motors(robot, pose)
    positions = ", ".join(f"{x:.4g}" for x in pose)
    last_positions = ", ".join(f"{x:.4g}" for x in last_pose)
    loops = ", ".join(f"`{loop.name}`" for loop in robot.loops)
    return InputError(
        f"the loops of `{robot.name}` do not close at sample {sample}, where "
        f"{', '.join(robot.joint_names)} are at {positions}: on the way there the "
        f"points of {loops} stay together only up to {last_positions}, near a singular "
        "pose; keep `q` within the reach of the mechanism, on the branch of the "
        "description."
    )

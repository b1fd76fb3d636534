r"""Coordinates, rates and forces of all joints, from the joints that move alone.

With $y$ the coordinates of the joints that move alone, those of all joints are $q(y)$:
followers of others by $k y_l + q_0$, the joints of closed loops by $g(q) = 0$, where
$g$ are the distances between the points that coincide. Speeds are $\Gamma \dot y$ with
$\Gamma = \partial q / \partial y$, accelerations $\Gamma \ddot y + \dot\Gamma \dot y$,
and forces of all joints become those of $y$ by $\Gamma^T$. Functions are for one sample
and take either $y$ or the coordinates of all joints (`Robot.close`), which saves them
closing the loops.
"""

import functools
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
    Matrix,
    Matrix3,
    Numbers,
    Vector3,
    as_array,
    is_traced,
    namespace,
)
from jaxid.errors import InputError
from jaxid.program.sample_methods import in_numpy, on_samples

from .follower_joints import Followers, Loop, chain_to_ground
from .rotations import rotation_about

PARTS_OF_WAY = 24
"""Points on the way to random coordinates at which it is checked."""


class ClosingSteps(NamedTuple):
    """Newton's steps that close loops.

    Attributes:
        parts: Parts of the motors' way from the robot's `loop_pose`, with one step
            each. If 0, the loops start where they would be if their coordinates were
            quadratic functions of the motors'.
        last: Steps behind this way.
    """

    parts: int
    last: int


QUICK = ClosingSteps(0, 4)
"""Steps for many samples: sines and cosines of all steps take most of the time."""
STANDARD = ClosingSteps(8, 6)
"""Steps for one sample in a program, and for samples that the quick ones miss."""
THOROUGH = ClosingSteps(24, 6)
"""Steps for samples whose loops do not close by the standard ones."""
MAX_CHANGE = 0.5
"""Largest change of a joint in one of these steps [rad or m]."""
MAX_GAP = {"float64": 1e-12, "float32": 1e-4}
"""Distance between two points of a loop up to which it is closed, by precision [m]."""
MAX_QUICK_GAP = 1e-7
"""Distance that the last of the quick steps still closes, as it squares it [m]."""
MAX_QUICK_WAY = 1.0
"""Way of a motor from the robot's `loop_pose` up to which they are used [rad or m]."""
MIN_CLOSING_SHARE = 1e-4
"""Determinant of closing relative to that of the description; below, it is singular."""
MIN_SAFE_SHARE = 0.2
"""The same for motions that are designed or drawn."""
SMALLEST_SQUARE = 1e-24
"""Added to squares of columns [m²]: at a singular pose, steps are large but finite."""


def placement_in_parent(
    robot: Any,
    body: int,
    q: AnyArray,
) -> tuple[Matrix3, Vector3]:
    """Return attitude and origin [m] of a body in its parent at its joint's place."""
    R = robot.rotation[body]
    r = robot.offset[body]
    axis = robot.axis[body]
    if body in robot.virtual:
        return R, r
    if robot.turns[body]:
        return R @ rotation_about(axis, q), r
    return R, r + R @ axis * q


def linear_ratios(followers: Followers, joints: int) -> Matrix:
    r"""Return $\Gamma$ of joints that move alone and of those that follow them."""
    led_followers = with_leader(followers)
    ratios = np.eye(joints + len(led_followers), joints)
    for row, follower in enumerate(led_followers, joints):
        ratios[row, follower.leader] = follower.factor
    return ratios


def with_leader(followers: Followers) -> Followers:
    """Return the followers that another joint leads, not loops."""
    return tuple(f for f in followers if f.leader is not None)


def linear_coordinates(followers: Followers, q: ManyJoints) -> AnyArray:
    """Return the coordinates of all joints but those that loops move."""
    led_followers = with_leader(followers)
    if not led_followers:
        return q
    xp = namespace(q)
    values = [f.factor * q[..., f.leader] + f.offset for f in led_followers]
    return xp.concatenate([q, xp.stack(values, axis=-1)], axis=-1)


def at_sample(robot: Any, q: Joints) -> tuple[Any, Joints]:
    """Return a robot with loops with the `coordinates` of one sample, and `q`.

    Args:
        robot: Robot, which stays as it is if it has no loops.
        q: Coordinates of the joints that move alone, which are returned, or those of
            all joints (`Robot.close`).
    """
    is_closed = robot.coordinates is not None and len(q) == robot.joints
    if not robot.loops or is_closed:
        return robot, q
    coordinates = q if len(q) == robot.bodies else closed_coordinates(robot, q)
    place = (lambda robot: robot.coordinates, robot, coordinates)
    robot = eqx.tree_at(*place, is_leaf=lambda x: x is None)
    return robot, coordinates[: robot.joints]


def all_coordinates(robot: Any, q: Joints) -> AnyArray:
    """Return the coordinates of all joints."""
    robot, q = at_sample(robot, q)
    if robot.loops:
        return robot.coordinates
    return linear_coordinates(robot.followers, q)


def all_rates(robot: Any, q: Joints, qd: Joints) -> AnyArray:
    r"""Return the velocities of all joints, $\Gamma \dot y$."""
    if not robot.followers:
        return qd
    return jnp.asarray(speed_ratios(robot, q), qd.dtype) @ qd


def all_accelerations(robot: Any, q: Joints, qd: Joints, qdd: Joints) -> AnyArray:
    r"""Return the accelerations of all joints, $\Gamma \ddot y + \dot\Gamma \dot y$."""
    accelerations = all_rates(robot, q, qdd)
    if not robot.loops:
        return accelerations
    coordinates = all_coordinates(robot, q)
    rates = all_rates(robot, q, qd)

    def gap_rates(coordinates):
        gaps = functools.partial(closing_rows, robot)
        return jax.jvp(gaps, (coordinates,), (rates,))[1]

    _, gap_accelerations = jax.jvp(gap_rates, (coordinates,), (rates,))
    free_slopes, slopes = gap_slopes(robot, coordinates)
    bias = solve_columns(slopes, -gap_accelerations)
    other_joints = free_slopes.shape[1]
    return accelerations + jnp.pad(bias, (other_joints, 0))


def speed_ratios(robot: Any, q: Joints) -> AnyArray:
    r"""Return $\Gamma$: speeds of all joints (rows) by those of the coordinates."""
    ratios = linear_ratios(robot.followers, robot.joints)
    if not robot.loops:
        return ratios
    free_slopes, slopes = gap_slopes(robot, all_coordinates(robot, q))
    return jnp.concatenate([ratios, solve_columns(slopes, -free_slopes @ ratios)])


def on_coordinates(robot: Any, q: Joints, rows: Any) -> Any:
    r"""Return $\Gamma^T$ times rows of all joints, such as their forces."""
    if not robot.followers:
        return rows
    ratios = jnp.asarray(speed_ratios(robot, q), rows.dtype)
    return jnp.tensordot(ratios.T, rows, 1)


def loop_gaps(robot: Any, coordinates: Joints) -> Array:
    """Return the vectors between the points of each loop, one after the other [m].

    Each is in the frame of the nearest body that carries both points: only the joints
    of the loop move it, and the loop of a plane stays in its plane.
    """
    gaps = []
    for loop in robot.loops:
        carrier = _common_body(robot, loop)
        first_point, second_point = (
            _place_on(robot, coordinates, body, point, carrier)
            for body, point in zip(loop.bodies, loop.points, strict=True)
        )
        gaps.append(second_point - first_point)
    return jnp.concatenate(gaps)


def closing_rows(robot: Any, coordinates: Joints) -> Array:
    """Return the independent entries of the gaps: as many as joints that loops move."""
    return loop_gaps(robot, coordinates)[np.array(robot.loop_rows, int)]


def gap_slopes(robot: Any, coordinates: Joints) -> tuple[Array, Array]:
    """Return the slopes of `closing_rows` by other joints, and by those of loops."""
    slopes = jax.jacfwd(functools.partial(closing_rows, robot))(coordinates)
    other_joints = robot.bodies - len(robot.loop_rows)
    return slopes[:, :other_joints], slopes[:, other_joints:]


def _common_body(robot: Any, loop: Loop):
    """Return the nearest body that carries both bodies of a loop; -1 is the ground."""
    first_body, second_body = loop.bodies
    second_chain = chain_to_ground(robot.parent, second_body)
    first_chain = chain_to_ground(robot.parent, first_body)
    return next(body for body in first_chain if body in second_chain)


def _place_on(robot: Any, coordinates: Joints, body: int, point: Vector3, carrier: int):
    """Return a point of a body in the frame of a body that carries it."""
    while body != carrier:
        R, r = placement_in_parent(robot, body, coordinates[body])
        point = r + R @ point
        body = robot.parent[body]
    return point


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def closed_coordinates(robot: Any, q: Joints, steps: ClosingSteps = STANDARD) -> Array:
    """Return the coordinates of all joints, at which the loops are closed.

    The motors go to their coordinates in equal parts, and the loops follow: so they
    stay on their branch. Where no loops close, they are open: see `loop_closure`.
    """
    joints = len(robot.loop_rows)
    pose = jnp.asarray(robot.loop_pose, q.dtype)
    start = pose[: robot.joints]
    change = q - start
    loop_coordinates = pose[-joints:]
    if not steps.parts:
        loop_coordinates = _extrapolated(robot, pose, change)[-joints:]
    elif robot.bodies == robot.joints + joints:
        # A full turn of a motor changes nothing, if no joint follows it by a ratio.
        turn = jnp.arctan2(jnp.sin(change), jnp.cos(change))
        change = jnp.where(np.array(robot.revolute), turn, change)
    end = start + change if steps.parts else q

    def step(k, loop_coordinates):
        # Behind the way these are exactly the motors' coordinates, whose sines and
        # cosines are computed once.
        rest = 1.0 - jnp.minimum((k + 1) / max(steps.parts, 1), 1.0)
        other_coordinates = linear_coordinates(robot.followers, end - rest * change)
        coordinates = jnp.concatenate([other_coordinates, loop_coordinates])
        return loop_coordinates + _newton_step(robot, coordinates)

    loop_coordinates = jax.lax.fori_loop(0, sum(steps), step, loop_coordinates)
    other_coordinates = linear_coordinates(robot.followers, q)
    return jnp.concatenate([other_coordinates, loop_coordinates])


def _newton_step(robot: Any, coordinates: Joints):
    """Return the changes of the joints that loops move, which close them."""
    _, slopes = gap_slopes(robot, coordinates)
    change = solve_columns(slopes, -closing_rows(robot, coordinates))
    return jnp.minimum(jnp.maximum(change, -MAX_CHANGE), MAX_CHANGE)


def _extrapolated(robot: Any, pose: Joints, change: Joints) -> AnyArray:
    """Return the coordinates of all joints to second order around a closed pose."""
    robot, start = at_sample(robot, pose)
    rates = all_rates(robot, start, change)
    curvature = all_accelerations(robot, start, change, jnp.zeros_like(change))
    return pose + rates + curvature / 2


@closed_coordinates.defjvp
def _closed_rates(steps: ClosingSteps, primals: tuple, tangents: tuple):
    """Return the coordinates and their rates, by the implicit function theorem."""
    robot, _ = primals
    coordinates = closed_coordinates(*primals, steps)
    joints = len(robot.loop_rows)
    loop_coordinates = coordinates[-joints:]

    def open_loops(robot, q):
        other_coordinates = linear_coordinates(robot.followers, q)
        open_coordinates = jnp.concatenate([other_coordinates, loop_coordinates])
        return closing_rows(robot, open_coordinates), other_coordinates

    _, (gap_rates, other_rates) = jax.jvp(open_loops, primals, tangents)
    _, slopes = gap_slopes(robot, coordinates)
    loop_rates = solve_columns(slopes, -gap_rates)
    return coordinates, jnp.concatenate([other_rates, loop_rates])


def solve_columns(A: Array, b: Array) -> Array:
    """Solve $A x = b$ by orthogonal columns, without square roots or pivoting.

    A program has no loops, and no order of rows that is good in all poses.
    """
    n = len(A)
    columns = [A[:, j] for j in range(n)]
    products = {}
    solution = []
    for i in range(n):
        square = columns[i] @ columns[i] + SMALLEST_SQUARE
        for j in range(i + 1, n):
            products[i, j] = columns[i] @ columns[j] / square
            columns[j] = columns[j] - products[i, j] * columns[i]
        share = jnp.tensordot(columns[i], b, 1) / square
        solution.append(share)
        b = b - jnp.tensordot(columns[i], share, 0)
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            solution[i] = solution[i] - products[i, j] * solution[j]
    return jnp.stack(solution)


def determinant(A: Array) -> Array:
    """Return the determinant of a matrix near the identity, by elimination."""
    pivots = []
    while len(A):
        pivots.append(A[0, 0])
        factors = A[1:, 0] / A[0, 0]
        A = A[1:, 1:] - factors[:, None] * A[:1, 1:]
    return jnp.prod(jnp.stack(pivots))


def loop_closure(robot: Any, coordinates: Joints) -> Array:
    """Return the square of the distance by which loops are open [m²], and a share.

    The share is the determinant of the slopes by the joints that loops move, relative
    to that at the robot's `loop_pose`: zero where the loops are singular, negative on
    another branch.
    """
    gaps = loop_gaps(robot, coordinates)
    _, slopes = gap_slopes(robot, coordinates)
    pose = jnp.asarray(robot.loop_pose, coordinates.dtype)
    _, slopes_of_pose = gap_slopes(robot, pose)
    share = determinant(solve_columns(slopes_of_pose, slopes))
    return jnp.stack([gaps @ gaps, share])


class Closure(eqx.Module):
    """Closing of the loops of a robot."""

    robot: Any
    steps: ClosingSteps = eqx.field(static=True, default=STANDARD)

    def of_sample(self, q: Joints) -> Array:
        """Return the coordinates of all joints of one sample, and `loop_closure`."""
        robot = self.robot
        coordinates = closed_coordinates(robot, q, self.steps)
        closure = loop_closure(robot, coordinates)
        if self.steps is QUICK:
            # What the closure has computed gives one more step.
            change = _newton_step(robot, coordinates)
            others = jnp.zeros(robot.bodies - len(change))
            coordinates = coordinates + jnp.concatenate([others, change])
        return jnp.concatenate([coordinates, closure])

    def of_samples(self, q: ManyJoints) -> AnyArray:
        """Return the same of many samples; in float64 for NumPy's arrays."""
        if not isinstance(q, np.ndarray):
            return on_samples(self, self.of_sample, q)
        rows = in_numpy(self, self.of_sample, q.reshape(-1, self.robot.joints))
        return rows.reshape(*q.shape[:-1], -1)


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
    if isinstance(q, np.ndarray):
        closure = Closure(robot, QUICK).of_samples(q)
        is_closed = _is_quickly_closed(robot, q, closure)
        for steps in (STANDARD, THOROUGH):
            if not is_closed.all():
                is_open = ~is_closed
                closure[is_open] = Closure(robot, steps).of_samples(q[is_open])
                is_closed = _is_closed(closure)
    else:
        closure = Closure(robot).of_samples(q)
        is_closed = _is_closed(closure)
    coordinates = closure[..., : robot.bodies]
    if is_traced(closure):
        return jnp.where(is_closed[..., None], coordinates, jnp.nan)
    if not np.all(is_closed):
        sample = int(np.argmin(np.ravel(is_closed)))
        pose = np.asarray(q).reshape(-1, robot.joints)[sample]
        raise _open_error(
            robot, sample, pose, float(np.sqrt(closure[..., -2].ravel()[sample]))
        )
    return coordinates


def _is_closed(closure: AnyArray, min_share: float = MIN_CLOSING_SHARE):
    """Return whether loops close, on the branch of the description."""
    max_gap = MAX_GAP[closure.dtype.name]
    return (closure[..., -2] <= max_gap**2) & (closure[..., -1] > min_share)


def _is_quickly_closed(robot: Any, q: np.ndarray, closure: AnyArray):
    """Return whether quick steps surely close loops, and as precisely as others."""
    start = np.asarray(robot.loop_pose)[: robot.joints]
    is_near = np.abs(q - start).max(axis=-1) <= MAX_QUICK_WAY
    is_precise = closure[..., -2] <= MAX_QUICK_GAP**2
    return _is_closed(closure, MIN_SAFE_SHARE) & is_near & is_precise


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
    way = np.asarray(q, np.float64) - start
    shares = np.zeros(way.shape[:-1])
    for part in range(1, PARTS_OF_WAY + 1):
        share = part / PARTS_OF_WAY
        closure = Closure(robot).of_samples(start + share * way)
        is_safe = _is_closed(closure, MIN_SAFE_SHARE)
        is_reached = shares == (part - 1) / PARTS_OF_WAY
        shares[is_safe & is_reached] = share
    return start + shares[..., None] * way


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

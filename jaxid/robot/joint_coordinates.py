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
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxid.arrays import (
    AnyArray,
    Array,
    Joints,
    ManyJoints,
    Matrix,
    Matrix3,
    Vector3,
    namespace,
)

from .follower_joints import Followers, Loop, bodies_in_loop, chain_to_ground
from .rotations import rotation_about

PARTS_OF_WAY = 8
"""Parts of the motors' way from `loop_pose`, each with a step that closes the loops."""
LAST_STEPS = 6
"""Steps behind this way."""
MAX_CHANGE = 0.5
"""Largest change of a joint in one of these steps [rad or m]."""
MAX_JOINTS_OF_COFACTORS = 3
"""Joints that loops move up to which cofactors solve for them: fewer operations."""
SMALLEST_SQUARE = 1e-24
"""Added to squares of columns [m²]: at a singular pose, steps are large but finite."""
SMALLEST_SQUARE_OF_DETERMINANT = 1e-36
"""Added to squares of determinants, for the same."""


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
    free_slopes, slopes = gap_slopes(robot, coordinates)
    bias = solve_columns(slopes, -_gap_curvature(robot, coordinates, rates))
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


def closed_coordinates(robot: Any, q: Joints) -> AnyArray:
    """Return the coordinates of all joints of one sample, where the loops are closed.

    The motors go to their coordinates in equal parts, and the loops follow: so they
    stay on their branch. A program cannot do more where a part is too large: rows of
    samples are closed by `closed_samples`.
    """
    change = change_of_motors(robot, q)

    def step(k, moved):
        # Behind the way these are exactly those of `q`, whose sines and cosines a
        # program computes once.
        rest = 1.0 - jnp.minimum((k + 1) / PARTS_OF_WAY, 1.0)
        others = linear_coordinates(robot.followers, q - rest * change)
        change_of_moved = newton_step(robot, jnp.concatenate([others, moved]))
        return moved + jnp.clip(change_of_moved, -MAX_CHANGE, MAX_CHANGE)

    pose = jnp.asarray(robot.loop_pose, q.dtype)
    moved = pose[-len(robot.loop_rows) :]
    moved = jax.lax.fori_loop(0, PARTS_OF_WAY + LAST_STEPS, step, moved)
    others = linear_coordinates(robot.followers, q)
    return with_loop_rates(robot, q, jnp.concatenate([others, moved]))


def change_of_motors(robot: Any, q: ManyJoints) -> AnyArray:
    """Return how far motors are from the robot's `loop_pose`, on the shortest way."""
    xp = namespace(q)
    pose = xp.asarray(robot.loop_pose, q.dtype)[: robot.joints]
    change = q - xp.broadcast_to(pose, q.shape)
    has_led_followers = robot.bodies > robot.joints + len(robot.loop_rows)
    is_within_turn = xp is np and bool((abs(change) <= np.pi).all())
    if has_led_followers or is_within_turn:
        return change
    # A full turn of a motor changes nothing, if no joint follows it by a ratio.
    turn = xp.arctan2(xp.sin(change), xp.cos(change))
    is_revolute = np.broadcast_to(np.array(robot.revolute), q.shape)
    return xp.where(is_revolute, turn, change)


def newton_step(robot: Any, coordinates: Joints) -> Array:
    """Return the changes of the joints that loops move, which close them."""
    _, slopes = gap_slopes(robot, coordinates)
    return solve_columns(slopes, -closing_rows(robot, coordinates))


def _gap_curvature(robot: Any, coordinates: Joints, rates: Joints):
    """Return the second derivatives of `closing_rows` at constant rates."""

    def gap_rates(coordinates):
        gaps = functools.partial(closing_rows, robot)
        return jax.jvp(gaps, (coordinates,), (rates,))[1]

    return jax.jvp(gap_rates, (coordinates,), (rates,))[1]


@jax.custom_jvp
def with_loop_rates(robot: Any, q: Joints, coordinates: Joints) -> Joints:
    """Return coordinates that close the loops, with their derivatives by `q`."""
    return coordinates


@with_loop_rates.defjvp
def _loop_rates(primals: tuple, tangents: tuple):
    """Return the coordinates and their rates, by the implicit function theorem."""
    robot, q, _ = primals
    coordinates = with_loop_rates(*primals)
    moved = coordinates[-len(robot.loop_rows) :]

    def open_loops(robot, q):
        others = linear_coordinates(robot.followers, q)
        return closing_rows(robot, jnp.concatenate([others, moved])), others

    _, (gap_rates, other_rates) = jax.jvp(open_loops, (robot, q), tangents[:2])
    _, slopes = gap_slopes(robot, coordinates)
    return coordinates, jnp.concatenate(
        [other_rates, solve_columns(slopes, -gap_rates)]
    )


def solve_columns(A: Array, b: Array) -> Array:
    """Solve $A x = b$ by cofactors or orthogonal columns, without roots or pivoting.

    A program has no loops, and no order of rows that is good in all poses.
    """
    n = len(A)
    if n <= MAX_JOINTS_OF_COFACTORS:
        return _solve_by_cofactors(A, b)
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


def _solve_by_cofactors(A: Array, b: Array):
    """Solve at most three equations by Cramer's rule."""
    n = len(A)
    missing = MAX_JOINTS_OF_COFACTORS - n
    ones = np.diag([0.0] * n + [1.0] * missing)
    columns = jnp.pad(A, (0, missing)).T + jnp.asarray(ones, A.dtype)
    x, y, z = columns
    first_cofactors = jnp.cross(y, z)
    second_cofactors = jnp.cross(z, x)
    third_cofactors = jnp.cross(x, y)
    cofactors = jnp.stack([first_cofactors, second_cofactors, third_cofactors])
    value = x @ first_cofactors
    square = value * value + SMALLEST_SQUARE_OF_DETERMINANT
    products = jnp.tensordot(cofactors[:n, :n], b, 1)
    return products * (value / square)


def loop_closure(robot: Any, coordinates: Joints) -> Array:
    """Return the square of the distance by which loops are open [m²], and a share.

    The share is the least determinant of the slopes by the joints that loops move, of
    all blocks of joints that can be closed one after the other, relative to that at the
    robot's `loop_pose`: zero where the loops are singular, negative on another branch.
    """
    gaps = loop_gaps(robot, coordinates)
    pose = jnp.asarray(robot.loop_pose, coordinates.dtype)
    _, slopes = gap_slopes(robot, coordinates)
    _, pose_slopes = gap_slopes(robot, pose)
    shares = [
        _determinant(slopes, block) / _determinant(pose_slopes, block)
        for block in _blocks(robot)
    ]
    return jnp.stack([gaps @ gaps, functools.reduce(jnp.minimum, shares)])


Block = dict[int, set[int]]
"""Rows of a matrix, and for each of them the columns that are not zero."""


def _determinant(slopes: Array, block: Block):
    """Return the determinant of a block, by minors of its first rows."""
    minors: dict[frozenset[int], Any] = {frozenset(): 1.0}
    for row, columns in block.items():
        larger_minors: dict[frozenset[int], Any] = {}
        for minor, value in minors.items():
            for column in columns - minor:
                key = minor | {column}
                swaps = sum(other > column for other in minor)
                term = (-1.0) ** swaps * slopes[row, column] * value
                larger_minors[key] = larger_minors.get(key, 0.0) + term
        minors = larger_minors
    return minors[frozenset().union(*block.values())]


def _blocks(robot: Any) -> list[Block]:
    """Return the diagonal blocks of the slopes by the joints that loops move.

    Each of `closing_rows` has slopes by the joints of one loop only. In a suitable
    order of rows and columns, what stands on one side of these blocks is zero.
    """
    count = len(robot.loop_rows)
    is_slope = np.zeros((count, robot.bodies), bool)
    for row, entry in enumerate(robot.loop_rows):
        bodies = bodies_in_loop(robot.parent, robot.loops[entry // 3].bodies)
        is_slope[row, list(bodies)] = True
    graph = scipy.sparse.csr_array(is_slope[:, -count:])
    columns = scipy.sparse.csgraph.maximum_bipartite_matching(graph, "column")
    _, labels = scipy.sparse.csgraph.connected_components(
        graph[:, columns], connection="strong"
    )
    blocks: dict[int, Block] = {}
    for row, label in enumerate(labels):
        in_block = set(columns[labels == label].tolist())
        block = blocks.setdefault(label, {})
        block[row] = in_block.intersection(graph[[row]].indices.tolist())
    return list(blocks.values())

"""Sessions to record next, at places and in postures that are missing.

Designed poses determine the geometry hardly better than random ones at as many places,
so that places are drawn at random, and those are taken that are far from all others.
"""

import dataclasses

import numpy as np
import scipy

from jaxid.arrays import Matrix, Vector, double_precision
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.excitation.constraints import Clearance
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.limits_and_drives import complete_limits

from .frames import Frame
from .geometry_fit import GeometryFit

POSTURE_SPREAD = 0.25
"""Deviation of proposed poses from the posture of their session, in half ranges."""
MAX_ERROR = 1e-6
"""Largest error of a pose that reaches its place [m]."""
SPARE_POSES = 20
"""Random poses for each that is asked; few are far from obstacles."""
CANDIDATES = 40
"""Number of random places."""


def propose_sessions(
    fit: GeometryFit,
    *,
    sessions: int = 3,
    poses: int = 20,
    clearance: Clearance | None = None,
    seed: int = 0,
) -> list[np.ndarray]:
    """Return joint coordinates of sessions at places that are missing [rad or m].

    They measure what the first session measures, within the limits of the joints. Where
    the tool is in contact, it stays in its place in all poses of a session.

    Args:
        fit: Calibration so far.
        sessions: Number of sessions to propose.
        poses: Number of poses in each.
        clearance: Distance that shapes must keep; None without.
        seed: Seed of the random places.

    Raises:
        InputError: If no place can be reached in so many postures.
    """
    rng = np.random.default_rng(seed)
    limits = complete_limits(fit.robot)
    low = np.asarray(limits.position_min)
    high = np.asarray(limits.position_max)
    ranges = high - low
    shape = (SPARE_POSES * poses, fit.robot.joints)
    shares = rng.uniform(0.0, 1.0, (CANDIDATES * shape[0], shape[1]))
    postures = _possible_poses(fit, low + ranges * shares, clearance)
    candidates = np.split(postures, range(poses, len(postures), poses))
    if _is_contact(fit):
        candidates = []
        for posture in postures[:CANDIDATES]:
            spread = 0.5 * POSTURE_SPREAD * ranges * rng.normal(size=shape)
            touching = _touching_poses(fit, posture, posture + spread)
            candidates.append(_possible_poses(fit, touching, clearance)[:poses])
    candidates = [q for q in candidates if len(q) == poses]
    if not candidates:
        raise InputError(
            f"no place was found that the tool can reach in {poses} postures: ask for "
            "fewer `poses`, or make room for the robot (`clearance`)."
        )
    recorded = fit.problem.poses.q[fit.problem.poses.is_pose]
    places = [mean_place(fit, q) for q in candidates]
    others = tip_jacobian(fit.robot, recorded).position
    best = _farthest(np.stack(places), others, sessions)
    return [candidates[number] for number in best]


def mean_place(fit: GeometryFit, q: Matrix) -> Vector:
    """Return the mean position of the end-effector in some poses [m]."""
    return tip_jacobian(fit.robot, q).position.mean(axis=0)


def _farthest(points: Matrix, others: Matrix, count: int) -> list[int]:
    """Return points far from others and from each other, the farthest first."""
    distances = scipy.spatial.distance.cdist(points, others).min(axis=1)
    numbers = []
    for _ in range(min(count, len(points))):
        numbers.append(int(np.argmax(distances)))
        own_distances = np.linalg.norm(points - points[numbers[-1]], axis=1)
        distances = np.minimum(distances, own_distances)
    return numbers


def _is_contact(fit: GeometryFit) -> bool:
    """Return whether poses of the first place measure the same, as contacts do."""
    poses = fit.problem.poses
    is_first = poses.is_pose & (poses.place == poses.place[0])
    positions = poses.measured.position[is_first]
    return bool(np.all(positions == positions[0]))


def _possible_poses(fit: GeometryFit, q: Matrix, clearance: Clearance | None) -> Matrix:
    """Return the poses within the limits of the joints that keep a distance."""
    limits = complete_limits(fit.robot)
    is_inside = (q >= limits.position_min) & (q <= limits.position_max)
    q = q[np.all(is_inside, axis=1)]
    if clearance is None or not len(q):
        return q
    rest = np.zeros_like(q)
    # Shapes belong to the nominal frames of the bodies.
    with double_precision():
        excess = clearance(fit.problem.robot, Motion(q, rest, rest))
    return q[np.max(excess, axis=1) <= 0.0]


def _touching_poses(fit: GeometryFit, posture: Vector, q: Matrix) -> Matrix:
    """Return poses near others, in which the tool is where it is in a posture."""
    first = fit.problem.poses
    keys = fit.problem.frame_keys
    tool = fit.frames[keys[first.tool[0]]]
    tip = tip_jacobian(fit.robot, posture[None])
    tool_position = (Frame(tip.rotation[0], tip.position[0]) @ tool).position
    place = fit.frames[keys[first.place[0]]]
    lever = place.rotation @ first.measured.position[0]
    starts = [tool, place._replace(position=tool_position - lever)]

    rows = np.zeros(len(q), int)
    fields = {
        field.name: getattr(first, field.name) for field in dataclasses.fields(first)
    }
    measured = fields.pop("measured").at(rows)
    repeated = {name: values[rows] for name, values in fields.items()}
    changes = {"q": q, "measured": measured, "tool": rows, "place": rows + 1}
    problem = dataclasses.replace(
        fit.problem,
        robot=fit.robot,
        frame_keys=keys[:2],
        starts=Frame(*map(np.stack, zip(*starts, strict=True))),
    ).with_poses(**{**repeated, **changes})
    nominal = problem.nominal.vector
    exact = problem.without_errors(nominal)
    errors = exact.error_sizes(exact.pose_errors(nominal).values)
    return exact.poses.q[errors.lengths < MAX_ERROR]

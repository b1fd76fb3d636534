"""Kinematic calibration: from observations to the geometry of a robot."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxid.arrays import Numbers, as_finite_array
from jaxid.errors import InputError
from jaxid.robot.inertia import BodyParameters, Inertia
from jaxid.robot.robot import Robot
from jaxid.robot.urdf import urdf_parameters

from .geometry_fit import GeometryFit
from .observations import AbstractObservation
from .problem import build_problem
from .solution import solve
from .wrong_robots import require_right_robot

NO_MASSES = (
    "Compliance was left out, because the masses of the robot are not known: give "
    "rough ones (`masses` in the experiment file, `jid.calibration.rough_bodies` in "
    "Python)"
)


def calibrate(
    robot: Robot,
    observations: Sequence[AbstractObservation],
    *,
    bodies: Numbers | None = None,
    compliance: bool = True,
) -> GeometryFit:
    """Find the true geometry of a robot from observations in several sessions.

    Unknown are shift and turn of each joint's origin (with the joint's zero), the
    deflection of each joint under gravity, and where tools and places are. What the
    poses do not determine stays as near to the nominal geometry as a prior says, which
    is chosen by leaving sessions out. Poses that do not belong to the others are left
    out. Intervals take the session as the unit.

    Args:
        robot: Nominal robot.
        observations: Observations of all sessions.
        bodies: Inertial parameters of the bodies, ten each, for the torques of gravity;
            those of the robot's file if None.
        compliance: Whether joints deflect under gravity.

    Raises:
        InputError: If there is no observation, or they are too few; if coordinates do
            not fit the robot, or it has closed loops.
    """
    _require_observations(robot, observations)
    parameters = None
    if compliance:
        parameters = _bodies_of_file(robot) if bodies is None else bodies
    if parameters is not None:
        numbers = np.reshape(np.asarray(parameters, np.float64), (-1, 10))
        as_finite_array("`bodies`", numbers, (robot.bodies, 10))
        parameters = numbers
    problem = build_problem(robot, observations, parameters)
    numbers_measured = np.count_nonzero(np.isfinite(problem.poses.deviations))
    numbers_unknown = np.count_nonzero(problem.freedoms)
    if numbers_measured <= numbers_unknown:
        raise InputError(
            f"`observations` must hold more than the {numbers_unknown} unknown numbers "
            f"of tools and places, but hold {numbers_measured}: record 20 to 30 poses "
            "in each place."
        )
    require_right_robot(problem, observations)
    notes = (NO_MASSES,) if compliance and parameters is None else ()
    session_weights = np.ones(len(problem.sessions))
    has_compliance = parameters is not None
    solution = solve(problem, session_weights, has_compliance)
    return GeometryFit(problem, solution, has_compliance, notes)


def _require_observations(
    robot: Robot, observations: Sequence[AbstractObservation]
) -> None:
    """Reject observations that cannot be those of the robot.

    Such are angles that are more than a turn outside the range of their joint.
    """
    if robot.loops:
        raise InputError(
            f"`robot` must be an open chain or tree, but `{robot.name}` has closed "
            "loops: calibrate one of its arms (`tip`)."
        )
    poses = [x for x in observations if x.has_poses]
    if not poses:
        raise InputError("`observations` must hold at least one observation of poses.")
    limits = robot.limits
    for observation in poses:
        owner = f"`q` of the session `{observation.session}`"
        q = observation.q
        if q.shape[1] != robot.joints:
            raise InputError(
                f"{owner} must have {robot.joints} columns, one for each joint of "
                f"`{robot.name}`, but has {q.shape[1]}."
            )
        excess = np.maximum(limits.position_min - q, q - limits.position_max)
        is_far = (excess > 2.0 * np.pi) & np.array(robot.revolute)
        if is_far.any():
            pose, joint = np.argwhere(is_far)[0]
            raise InputError(
                f"{owner} must hold joint angles in radians, but "
                f"`{robot.joint_names[joint]}` is at {q[pose, joint]:.4g}, more than a "
                "turn outside its range: are angles in degrees "
                '(`angle_unit = "deg"` in the experiment file), or columns wrong?'
            )


def _bodies_of_file(robot: Robot) -> BodyParameters | None:
    """Return the bodies that the robot's file describes; None if it has no masses."""
    if not Path(robot.source).is_file():
        return None
    bodies = urdf_parameters(
        robot.source,
        tip=robot.source_tip,
        base=robot.source_base,
        xacro_arguments=dict(robot.source_arguments) or None,
        check=False,
    )
    return np.reshape(bodies, (-1, 10)) if np.any(bodies) else None


def rough_bodies(robot: Robot, masses: Numbers) -> BodyParameters:
    """Return inertial parameters of point masses half-way to the next joint.

    Args:
        robot: Robot.
        masses: Masses of the bodies [kg].

    Raises:
        InputError: If there is not one mass for each body.
    """
    what = f"`masses`, one for each body of `{robot.name}`,"
    body_masses = as_finite_array(what, np.asarray(masses), (robot.bodies,))
    ends = np.zeros((robot.bodies, 3))
    for body, parent in enumerate(robot.parent):
        if parent >= 0:
            ends[parent] = robot.offset[body]
    ends[robot.tip_body] = robot.tip_offset
    tensors = np.zeros((robot.bodies, 3, 3))
    return np.asarray(Inertia(body_masses, 0.5 * ends, tensors).parameters)

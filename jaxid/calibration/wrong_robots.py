"""Poses of another robot, or with mistakes, which no calibration can remove."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Matrix
from jaxid.errors import InputError
from jaxid.result_table import significant
from jaxid.robot.robot import Robot

from .adjustment import Weights, adjust
from .observations import AbstractObservation, MeasuredPose
from .problem import CalibrationProblem, build_problem

SEARCH_STEPS = 10
"""Steps to the tools and places of the nominal robot."""


class MistakeLimits(NamedTuple):
    """When poses cannot be those of a robot, and when a mistake explains this."""

    doubtful_share: float = 0.01  # typical error of the nominal robot, of its reach
    wrong_share: float = 0.05
    left_by_mistake: float = 0.25  # typical error after its correction, relative
    shown_error: float = 1.0  # of the search for tools and places, which may fail [m]


LIMITS = MistakeLimits()


def typical_nominal_error(problem: CalibrationProblem) -> float:
    """Return the median error of the nominal robot, tools and places fitted [m]."""
    weights = Weights(
        np.ones(len(problem.sessions)), np.ones(len(problem.poses.session))
    )
    end = adjust(
        problem, problem.nominal.vector, problem.frame_scales, weights, SEARCH_STEPS
    )
    sizes = problem.error_sizes(end.linearisation.errors)
    return float(np.median(sizes.lengths[problem.poses.is_pose]))


def require_right_robot(
    problem: CalibrationProblem, observations: Sequence[AbstractObservation]
) -> None:
    """Reject poses whose errors no calibration can remove, and name the mistake."""
    robot = problem.robot
    error = typical_nominal_error(problem)
    if error <= LIMITS.doubtful_share * problem.reach:
        return
    errors = {}
    for words, correct in _corrections(robot):
        others = [correct(x) for x in observations]
        errors[words] = typical_nominal_error(build_problem(robot, others, None))
    words = min(errors, key=lambda words: errors[words])
    is_explained = errors[words] < LIMITS.left_by_mistake * error
    if error <= LIMITS.wrong_share * problem.reach and not is_explained:
        return
    cure = (
        "is it the file of this robot, and are order, signs, zeros and units of the "
        "joints right, and the unit of measured lengths?"
    )
    if is_explained:
        remaining_error = significant(1e3 * errors[words])
        cure = f"{words}, it is {remaining_error} mm: correct this first."
    size = f"{significant(1e3 * error)} mm"
    if error > LIMITS.shown_error:
        size = "more than a metre"
    raise InputError(
        f"`observations` are not poses of `{robot.name}`: with the best tools and "
        f"places, their typical error is {size}, far more than wrong lengths and zeros "
        f"explain; {cure}"
    )


def _corrections(robot: Robot) -> Iterator[tuple[str, Callable]]:
    """Yield corrections of usual mistakes in observations."""
    names = robot.joint_names
    identity = np.eye(robot.joints)
    for joint, name in enumerate(names):
        signs = identity.copy()
        signs[joint, joint] = -1.0
        yield f"with the other sign of `{name}`", partial(_with_joints, signs)
    for joint, pair in enumerate(itertools.pairwise(names)):
        order = identity.copy()
        order[[joint, joint + 1]] = order[[joint + 1, joint]]
        yield f"with `{pair[0]}` and `{pair[1]}` swapped", partial(_with_joints, order)
    backwards = partial(_with_joints, identity[::-1])
    yield "with the joints in the reverse order", backwards
    degrees = np.diag(np.where(robot.revolute, np.rad2deg(1.0), 1.0))
    yield "with joint angles 57.3 times as large", partial(_with_joints, degrees)
    for factor, change, unit in ((1e-3, "smaller", "mm"), (1e3, "larger", "m")):
        cure = f'(`length_unit = "{unit}"` in the experiment file)'
        words = f"with known and measured lengths 1,000 times {change} {cure}"
        yield words, partial(_with_lengths, factor)
    yield "with each measured pose the other way round (`eye_in_hand`)", _inverted


def _with_joints(matrix: Matrix, observation: AbstractObservation):
    """Return an observation whose joint coordinates are multiplied by a matrix."""
    if not observation.has_poses:
        return observation
    return dataclasses.replace(observation, q=observation.q @ matrix)


def _with_lengths(factor: float, observation: AbstractObservation):
    """Return an observation whose measured lengths are multiplied by a factor."""
    lengths = {"positions", "distance"} & observation.measurements.keys()
    changes = {name: factor * getattr(observation, name) for name in lengths}
    return dataclasses.replace(observation, **changes)


def _inverted(observation: AbstractObservation):
    """Return an observation whose measured poses, if it has some, are inverted."""
    if not isinstance(observation, MeasuredPose):
        return observation
    pose = observation.measured.inverse
    return dataclasses.replace(
        observation, rotations=pose.rotation, positions=pose.position
    )

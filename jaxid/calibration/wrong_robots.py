"""Poses of another robot, or with mistakes, which no calibration can remove."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxid.errors import InputError
from jaxid.result_table import significant
from jaxid.robot.robot import Robot

from .adjustment import Weights, adjust
from .observations import AbstractObservation
from .problem import CalibrationProblem, build_problem

SEARCH_STEPS = 10
"""Steps to the tools and places of the nominal robot."""


class MistakeLimits(NamedTuple):
    """When poses cannot be those of a robot, and when a mistake explains this."""

    share_of_reach: float = 0.05  # typical error of the nominal robot
    left_by_mistake: float = 0.25  # typical error after its correction, relative


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
    offsets = np.linalg.norm(robot.offset, axis=1)
    reach = float(offsets.sum() + np.linalg.norm(robot.tip_offset))
    error = typical_nominal_error(problem)
    if error <= LIMITS.share_of_reach * reach:
        return
    errors = {}
    for words, (matrix, factor) in _mistakes(robot):
        others = [_without_mistake(x, matrix, factor) for x in observations]
        errors[words] = typical_nominal_error(build_problem(robot, others, None))
    words = min(errors, key=lambda words: errors[words])
    cure = (
        "is it the file of this robot, and are order, signs, zeros and units of the "
        "joints right, and the unit of measured lengths?"
    )
    if errors[words] < LIMITS.left_by_mistake * error:
        left = significant(1e3 * errors[words])
        cure = f"{words}, it is {left} mm: correct this first."
    raise InputError(
        f"`observations` are not poses of `{robot.name}`: with the best tools and "
        f"places, their typical error is {significant(1e3 * error)} mm, far more than "
        f"wrong lengths and zeros explain; {cure}"
    )


def _mistakes(robot: Robot) -> Iterator[tuple[str, tuple[np.ndarray, float]]]:
    """Yield corrections of usual mistakes.

    Each is a matrix from the right joint coordinates to the given ones, and a factor of
    measured lengths.
    """
    names = robot.joint_names
    identity = np.eye(robot.joints)
    for joint, name in enumerate(names):
        signs = identity.copy()
        signs[joint, joint] = -1.0
        yield f"with the other sign of `{name}`", (signs, 1.0)
    for joint, pair in enumerate(itertools.pairwise(names)):
        order = identity.copy()
        order[[joint, joint + 1]] = order[[joint + 1, joint]]
        yield f"with `{pair[0]}` and `{pair[1]}` swapped", (order, 1.0)
    yield "with the joints in the reverse order", (identity[::-1], 1.0)
    degrees = np.where(robot.revolute, np.rad2deg(1.0), 1.0)
    yield "with joint angles 57.3 times as large", (np.diag(degrees), 1.0)
    yield "with measured lengths 1,000 times smaller", (identity, 1e-3)
    yield "with measured lengths 1,000 times larger", (identity, 1e3)


def _without_mistake(
    observation: AbstractObservation, matrix: np.ndarray, factor: float
) -> AbstractObservation:
    """Return an observation with other joint coordinates and measured lengths."""
    if not observation.has_poses:
        return observation
    lengths = {"positions", "distance"} & observation.measurements.keys()
    changes = {name: factor * getattr(observation, name) for name in lengths}
    return dataclasses.replace(observation, q=observation.q @ matrix, **changes)

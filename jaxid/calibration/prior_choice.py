"""How far a robot may be from its nominal geometry, chosen by leaving sessions out."""

import itertools
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Vector

from .adjustment import Weights, common_step, session_equations
from .error_derivatives import Unknowns
from .problem import CalibrationProblem
from .wrong_poses import pose_sizes

SLIDE_FACTOR = 2e-3
"""Compliance of a joint that slides [m/N], by the prior's deflection [rad]."""


class GeometryPrior(NamedTuple):
    """Standard deviations of a robot from its nominal geometry."""

    shift: float  # of the origins of joints [m]
    turn: float  # of the origins of joints [rad]
    deflection: float  # of the joints under the robot's largest torque [rad]

    @property
    def words(self) -> str:
        """The prior in words."""
        return (
            f"origins within {1e3 * self.shift:g} mm and {1e3 * self.turn:g} mrad, "
            f"deflections by the largest torque of gravity within "
            f"{1e3 * self.deflection:g} mrad (standard deviations)"
        )


MIDDLE_PRIOR = GeometryPrior(1e-3, 3e-3, 5e-3)
"""Prior with which wrong poses are found, and where the choice begins."""
PRIORS = tuple(
    itertools.starmap(
        GeometryPrior,
        itertools.product((3e-4, 1e-3, 3e-3), (1e-3, 3e-3, 1e-2), (5e-4, 5e-3)),
    )
)
"""Priors that are tried."""


def prior_scales(
    problem: CalibrationProblem, prior: GeometryPrior, has_compliance: bool
) -> Vector:
    """Return the prior deviation of each unknown: 1 m and 1 rad for frames."""
    robot = problem.robot
    shift_and_turn = np.repeat([prior.shift, prior.turn], 3)
    # Small arms are softer, and weigh less.
    factors = np.where(robot.revolute, 1.0 / problem.largest_torque, SLIDE_FACTOR)
    compliances = prior.deflection * factors
    return Unknowns(
        np.tile(shift_and_turn, (robot.bodies, 1)),
        has_compliance * compliances,
        problem.freedoms.astype(float),
    ).vector


def choose_prior(
    problem: CalibrationProblem,
    vector: Vector,
    weights: Weights,
    has_compliance: bool,
) -> GeometryPrior:
    """Return the prior with the smallest errors on sessions that are left out in turn.

    At this point the problem is linear enough: each prior is one solution of the
    equations at the unknowns.
    """
    sessions = np.flatnonzero(weights.sessions)
    if len(sessions) < 2:
        return MIDDLE_PRIOR
    scales = np.stack([prior_scales(problem, x, has_compliance) for x in PRIORS])
    linearisation = problem.linearise(vector)
    equations = session_equations(problem, linearisation, scales[0], weights.poses)
    common = problem.common_columns
    totals = np.zeros(len(PRIORS))
    for session in sessions:
        other_weights = weights.sessions.copy()
        other_weights[session] = 0.0
        steps = common_step(equations, vector[common], scales[:, common], other_weights)
        own_equations = equations[session]
        poses = problem.poses.session == session
        deviations = problem.poses.deviations[poses]
        errors = np.zeros((len(PRIORS), *deviations.shape))
        rows = own_equations.errors + steps @ own_equations.jacobian.T
        errors[:, np.isfinite(deviations)] = rows
        sizes = pose_sizes(errors, deviations)
        is_counted = problem.poses.is_pose[poses] * weights.poses[poses]
        totals += np.average(sizes, weights=is_counted, axis=1)
    return PRIORS[int(np.argmin(totals))]

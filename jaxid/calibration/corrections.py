"""Names of the corrections, and which of them poses can tell apart.

Some corrections move the tool alike in all poses: a joint's origin may lie anywhere on
its axis, for instance. Their columns depend on others, and only combinations are
determined, as with the base parameters of a dynamic model.
"""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import Indices, Matrix, Vector
from jaxid.dynamics.rank import (
    gram_schmidt,
    regrouping,
)

from .adjustment import session_equations
from .problem import CalibrationProblem, Linearisation

AXES = "xyz"
MIN_SHARE = 1e-7
"""Share of a column that those before it must leave unexplained."""


class Correction(NamedTuple):
    """One number of a correction."""

    owner: str  # joint or tool
    kind: str  # zero (a turn about the joint's axis), shift, turn or compliance
    axis: str  # its direction in words; empty for a compliance or a zero
    unit: str  # of its value
    # Of two that poses cannot tell apart, the one with the smaller rank names both.
    rank: int

    @property
    def group(self) -> str:
        """Kind of the parameter, for comparisons of several calibrations."""
        return {"zero": "joint zero", "compliance": "compliance"}.get(
            self.kind, "joint origin"
        )

    @property
    def words(self) -> str:
        """The correction in words."""
        return f"{self.kind} of `{self.owner}`{self.axis and ' ' + self.axis}"


class Combinations(NamedTuple):
    """Combinations of corrections that the poses determine, and what they cannot tell.

    Attributes:
        leaders: Indices of the corrections after which the combinations are named.
        followers: Indices of the corrections that are part of combinations only.
        factors: Factor of each follower in each combination.
        gap: Ratio of the share of the least independent column that no others explain
            to the largest such share of the dependent ones.
    """

    leaders: Indices
    followers: Indices
    factors: Matrix
    gap: float

    def of(self, values: np.ndarray) -> np.ndarray:
        """Return the values of the combinations.

        Args:
            values: Values of all corrections, in the last axis.
        """
        leaders = values[..., list(self.leaders)]
        return leaders + values[..., list(self.followers)] @ self.factors.T

    def covariance(self, covariance: Matrix) -> Matrix:
        """Return the covariance of the combinations from that of all corrections."""
        return self.of(self.of(covariance).T)


def common_corrections(problem: CalibrationProblem) -> list[Correction]:
    """Return the corrections that all sessions share, in the order of their columns.

    Tools rank first, then compliances, the zeros of joints, shifts and turns across the
    axes, and last the shifts along axes.
    """
    robot = problem.robot
    corrections = []
    for name, axis in zip(robot.body_names, robot.axis, strict=True):
        of_joint = _of_frame(name, 3)
        main = int(np.argmax(np.abs(axis)))
        of_joint[main] = of_joint[main]._replace(rank=4)
        of_joint[3 + main] = of_joint[3 + main]._replace(rank=2)
        if abs(axis[main]) == 1.0:
            of_joint[3 + main] = Correction(name, "zero", "", "rad", 2)
        corrections += of_joint
    for name, does_turn in zip(robot.joint_names, robot.turns, strict=False):
        unit = "rad/(N m)" if does_turn else "m/N"
        corrections.append(Correction(name, "compliance", "", unit, 1))
    for session, name in problem.frame_keys:
        if not session:
            corrections += _of_frame(name, 0)
    return corrections


def _of_frame(name: str, rank: int) -> list[Correction]:
    """Return the corrections of a frame."""
    shifts = [Correction(name, "shift", f"along {x}", "m", rank) for x in AXES]
    turns = [Correction(name, "turn", f"about {x}", "rad", rank) for x in AXES]
    return shifts + turns


def determined_combinations(
    problem: CalibrationProblem, linearisation: Linearisation, scales: Vector
) -> Combinations:
    """Return the combinations that the poses determine.

    Args:
        problem: The problem.
        linearisation: Errors and derivatives at the estimates.
        scales: Prior deviations, in which columns are compared; those without are left
            out.
    """
    common = problem.common_columns
    every_pose = np.ones(len(problem.poses.session))
    equations = session_equations(problem, linearisation, scales, every_pose)
    # In few rows, of the same rank.
    blocks = [np.linalg.qr(x.jacobian, mode="r") for x in equations]
    columns = np.concatenate(blocks) * scales[common]

    ranks = [correction.rank for correction in common_corrections(problem)]
    order = np.argsort(ranks, kind="stable")
    order = order[scales[common][order] > 0.0]
    ordered_columns = columns[:, order]
    dependence = gram_schmidt(ordered_columns, MIN_SHARE)
    regrouped = regrouping(
        ordered_columns, dependence.independent, dependence.dependent
    )
    leaders = order[list(dependence.independent)]
    followers = order[list(dependence.dependent)]
    # The factors are those of columns in units of the prior.
    units = scales[common]
    factors = regrouped.kappa * units[leaders][:, None] / units[followers]
    gap = min(dependence.gap, 1.0 / MIN_SHARE**2)
    return Combinations(
        tuple(leaders.tolist()), tuple(followers.tolist()), factors, gap
    )

"""Result of a kinematic calibration: a robot, intervals, and errors of all poses."""

import dataclasses
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import AnyArray, Texts, Vector
from jaxid.errors import InputError
from jaxid.identification.run_to_run import Run
from jaxid.identification.uncertainty import Uncertainty
from jaxid.identification.uncertainty.result import dof_of_sum
from jaxid.result_table import Remark, Summarised, Table
from jaxid.robot.robot import Robot

from .adjustment import common_step
from .calibration_findings import calibration_findings
from .calibration_tables import (
    combination_table,
    correction_table,
    session_table,
    undetermined_table,
)
from .corrections import (
    Combinations,
    Correction,
    common_corrections,
    determined_combinations,
)
from .error_derivatives import corrected_robot
from .frames import Frame
from .held_out_sessions import HeldOutErrors, held_out_errors, nominal_solution_errors
from .problem import CalibrationProblem, ErrorSizes, gravity_torques
from .solution import Covariances, Solution, covariances

MAX_VARIANCE_RATIO = 0.1
"""Variance of a determined combination, relative to that by the prior alone."""


class GeometryChange(NamedTuple):
    """Differences of combinations that two calibrations determine.

    Attributes:
        names: The combinations, in words.
        units: Their units.
        differences: Values of the second less those of the first.
        half_widths: Halves of the 95 % intervals.
    """

    names: Texts
    units: Texts
    differences: Vector
    half_widths: Vector

    @property
    def is_inside(self) -> np.ndarray:
        """Whether each interval contains zero: no change is seen."""
        return np.abs(self.differences) <= self.half_widths


@dataclasses.dataclass(frozen=True, eq=False)
class GeometryFit(Summarised):
    """Calibrated geometry.

    Attributes:
        problem: Observations of the nominal robot.
        solution: Estimates from all sessions.
        has_compliance: Whether joints deflect under gravity.
        notes: Doubts, in sentences.
    """

    problem: CalibrationProblem
    solution: Solution
    has_compliance: bool
    notes: Texts = ()

    @cached_property
    def robot(self) -> Robot:
        """The calibrated robot."""
        return corrected_robot(self.problem.robot, self.origins)

    @property
    def origins(self) -> np.ndarray:
        """Shifts [m] and turns [rad] of the joints' origins, along nominal body axes.

        The part of a turn about the axis of its joint is the error of the joint's zero.
        """
        return self._unknowns.origins

    @property
    def compliances(self) -> Vector:
        """Deflection of each joint by torque [rad/(N m) or m/N]."""
        return self._unknowns.compliances

    @property
    def _unknowns(self):
        return self.problem.nominal.of(self.solution.adjustment.vector)

    @property
    def frames(self) -> dict[tuple[str, str], Frame]:
        """Tools on the end-effector (no session) and places, by session and name."""
        frames = self.problem.starts.corrected(self._unknowns.frames)
        pairs = map(Frame, *frames)
        return dict(zip(self.problem.frame_keys, pairs, strict=True))

    def deflections(self, q: AnyArray) -> np.ndarray:
        """Return how far gravity deflects the joints in some poses [rad or m].

        Encoders do not see it: the calibrated robot stands where its coordinates plus
        deflections put it.
        """
        problem = self.problem
        return self.compliances * gravity_torques(
            problem.robot, problem.bodies, np.atleast_2d(q)
        )

    @property
    def corrections(self) -> list[Correction]:
        """Names of the common unknowns."""
        return common_corrections(self.problem)

    @property
    def values(self) -> Vector:
        """Values of the common unknowns, in the order of `corrections`."""
        return self.solution.adjustment.vector[self.problem.common_columns]

    @cached_property
    def covariances(self) -> Covariances:
        """Covariances of the common unknowns."""
        return covariances(self.problem, self.solution)

    @cached_property
    def combinations(self) -> Combinations:
        """Combinations of corrections that the poses determine.

        Of the nominal geometry, in which axes that should be parallel are so: that they
        are nearly so tells next to nothing.
        """
        problem = self.problem
        nominal = problem.nominal._replace(frames=self._unknowns.frames).vector
        linearisation = problem.without_errors(nominal).linearise(nominal)
        return determined_combinations(problem, linearisation, self.solution.scales)

    @property
    def dof(self) -> int:
        """Degrees of freedom of the intervals: sessions less one."""
        return len(self.problem.sessions) - 1

    @property
    def next_narrowing(self) -> float:
        """Share by which one more session like these narrows the intervals (0 to 1).

        Their widths are those of means of as many sessions.
        """
        sessions = np.array([0, 1]) + max(self.dof + 1, 2)
        quantiles = scipy.special.stdtrit(sessions - 1, 0.975)
        before, after = quantiles / np.sqrt(sessions)
        return float(1.0 - after / before)

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Uncertainty of the combinations, with the session as the unit."""
        parts = self.covariances
        combine = self.combinations.covariance
        covariance = combine(parts.scatter + parts.prior)
        if self.dof < 1:
            covariance = np.full_like(covariance, np.inf)
        dof = np.full(len(covariance), float(self.dof))
        return Uncertainty(covariance, dof, combine(parts.of_equal_noise))

    @property
    def is_determined(self) -> np.ndarray:
        """For each combination whether the poses say more than the prior."""
        scales = self.solution.scales[self.problem.common_columns]
        prior_covariance = self.combinations.covariance(np.diag(scales**2))
        variances = np.diag(self.uncertainty.naive_covariance)
        return variances < MAX_VARIANCE_RATIO * np.diag(prior_covariance)

    @property
    def errors(self) -> ErrorSizes:
        """Errors of all poses with the calibrated geometry."""
        return self.problem.error_sizes(self.solution.adjustment.linearisation.errors)

    @property
    def can_hold_out(self) -> bool:
        """Whether there are enough sessions to hold each out in turn."""
        return self.dof >= 2

    def mean_error(self, errors: ErrorSizes) -> float:
        """Return the mean length of the errors of all poses [m]."""
        return float(errors.lengths[self.problem.poses.is_pose].mean())

    @cached_property
    def findings(self) -> list[Remark]:
        """The verdict, then the findings, the most severe first."""
        return calibration_findings(self)

    @property
    def verdict(self) -> Remark:
        """Whether the geometry can be used, in one sentence."""
        return self.findings[0]

    @cached_property
    def held_out(self) -> HeldOutErrors:
        """Errors of all poses, each session held out in turn.

        It takes as many calibrations as there are sessions.
        """
        if not self.can_hold_out:
            raise InputError(
                "holding sessions out needs at least three sessions, but there "
                f"are {self.dof + 1}: record more, each with another place of the tool."
            )
        return held_out_errors(self.problem, self.has_compliance)

    @cached_property
    def shown_errors(self) -> HeldOutErrors:
        """Errors of sessions that are held out if there are enough, or of the fit."""
        if self.can_hold_out:
            return self.held_out
        errors = nominal_solution_errors(self.problem, self.solution.weights)
        nominal = self.problem.error_sizes(errors)
        return HeldOutErrors(self.errors, nominal, np.zeros(0))

    @property
    def manner(self) -> str:
        """How these errors were measured, in words."""
        return "sessions held out in turn" if self.can_hold_out else "poses of the fit"

    @property
    def run(self) -> Run:
        """Estimates that all sessions share, for comparisons of calibrations."""
        corrections = [self.corrections[k] for k in self.combinations.leaders]
        return Run(
            self.problem.robot.name,
            tuple(correction.words for correction in corrections),
            tuple(correction.unit for correction in corrections),
            tuple(correction.group for correction in corrections),
            self.combinations.of(self.values),
            self.uncertainty.covariance,
            float(self.dof),
        )

    def compare(self, other: "GeometryFit") -> GeometryChange:
        """Compare with another calibration of the same arm, or of one of its kind.

        Both estimates are drawn to the same nominal geometry, so that only the scatter
        of their sessions counts.

        Args:
            other: Calibration with the same nominal robot and kinds of observations.

        Raises:
            InputError: If the corrections of the other are not the same, or one of both
                has a single session.
        """
        if min(self.dof, other.dof) < 1:
            raise InputError(
                "both calibrations need at least two sessions, whose scatter tells how "
                "sure they are: record more."
            )
        if other.corrections != self.corrections:
            raise InputError(
                "`other` must be a calibration of the same robot with the same tools, "
                "but has other corrections."
            )
        combinations = self.combinations
        sure = set(np.array(other.combinations.leaders)[other.is_determined])
        rows = [
            row
            for row, leader in enumerate(combinations.leaders)
            if self.is_determined[row] and leader in sure
        ]
        first, second = (
            combinations.covariance(fit.covariances.scatter)[np.ix_(rows, rows)]
            for fit in (self, other)
        )
        dof = dof_of_sum(np.diag(first), np.diag(second), self.dof, other.dof)
        covariance = first + second
        uncertainty = Uncertainty(covariance, dof, covariance)
        corrections = [self.corrections[combinations.leaders[row]] for row in rows]
        return GeometryChange(
            tuple(correction.words for correction in corrections),
            tuple(correction.unit for correction in corrections),
            combinations.of(other.values - self.values)[rows],
            uncertainty.half_widths(),
        )

    def bootstrap(self, draws: int = 1000, seed: int = 0) -> np.ndarray:
        """Return common unknowns of calibrations with sessions drawn at random.

        Each draw takes as many sessions as there are, with replacement, and one
        Gauss-Newton step from the estimates: corrections are so small that a second
        step changes nothing.

        Args:
            draws: Number of draws.
            seed: Seed of the draws.
        """
        count = len(self.problem.sessions)
        rng = np.random.default_rng(seed)
        weights = rng.multinomial(count, np.full(count, 1.0 / count), size=draws)
        steps = common_step(
            self.solution.adjustment.equations,
            self.values,
            self.solution.scales[self.problem.common_columns],
            weights.astype(float),
        )
        return self.values + steps

    def summary(self) -> Table:
        """Return a table of what the poses determine, with 95 % intervals."""
        return combination_table(self)

    def tables(self) -> list[Table]:
        """Return errors of the sessions, corrections, and what the poses determine."""
        return [
            session_table(self),
            correction_table(self),
            self.summary(),
            undetermined_table(self),
        ]

    def overview(self) -> list[Table]:
        """Return the verdict, the findings, and errors of the sessions."""
        findings = Table("", remarks=self.findings)
        return [findings, session_table(self)]

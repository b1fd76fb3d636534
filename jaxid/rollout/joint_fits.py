"""Least squares of all joints at once, each with parameters of its own.

The initial states of a joint's motions follow its parameters: they are eliminated from
the normal equations of each motion.
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Matrix, Vector

from .motion import FreeParameters, JointParameters
from .servo import INDEX, LOWER, SCALE, UPPER
from .simulation import Moments, ServoSimulator

RESOLUTION = 1e-4
"""Errors below which no motion counts more [rad or m]."""
START_DAMPING = 1e-2
"""Damping of the first step, relative to the diagonal of the information."""
MAX_DAMPING = 1e3
"""Damping above which no step lowers the cost."""
SIZE = len(INDEX)
"""Number of parameters of a joint."""


class Pull(NamedTuple):
    """Pull between joints of a kind, which are nearly equal.

    Biases are left alone: they are of the assembly, and mirrored joints turn them
    around.

    Attributes:
        groups: Indices of the joints of each kind.
        scatter: Relative scatter of their parameters; infinite without any pull.
    """

    groups: Sequence[Sequence[int]] = ()
    scatter: float = np.inf

    def target(self, parameters: JointParameters) -> JointParameters:
        """Return the means of the parameters over each kind."""
        target = parameters.copy()
        for group in self.groups:
            members = list(group)
            target[members] = parameters[members].mean(axis=0)
        return target

    def precision(self, parameters: JointParameters) -> JointParameters:
        """Return inverse variances, in the units of the mean cost of a motion."""
        precision = np.zeros_like(parameters)
        for group in self.groups:
            members = list(group)
            if len(members) > 1:
                mean = np.abs(parameters[members].mean(axis=0))
                deviation = self.scatter * np.maximum(mean, 0.1 * SCALE)
                precision[members] = 1.0 / deviation**2
        precision[:, INDEX["b"]] = 0.0
        return precision


@dataclasses.dataclass(frozen=True)
class JointFit:
    """Parameters of all joints, with the simulation there.

    Attributes:
        simulator: Motions, and the loads along which they are simulated.
        parameters: Parameters of each joint.
        free: Parameters that are estimated.
        start: Initial states [motions, joints, states].
        weights: Weight of each motion's squared errors [motions, joints].
        pull: Pull of the parameters.
        moments: Errors and their derivatives.
    """

    simulator: ServoSimulator
    parameters: JointParameters
    free: FreeParameters
    start: np.ndarray
    weights: Matrix
    pull: Pull
    moments: Moments

    @classmethod
    def of(
        cls,
        simulator: ServoSimulator,
        parameters: JointParameters,
        free: FreeParameters,
        *,
        start: np.ndarray | None = None,
        weights: Matrix | None = None,
        pull: Pull | None = None,
    ) -> "JointFit":
        """Return simulated joints; all motions weigh the same if no weights are given.

        Initial states are those of the measured positions if they are not given.
        """
        motion = simulator.motion
        start = motion.start if start is None else start
        weights = 1.0 / motion.sample_counts if weights is None else weights
        pull = Pull() if pull is None else pull
        moments = simulator.moments(parameters, start)
        return cls(simulator, parameters, free, start, weights, pull, moments)

    def with_unknowns(
        self, parameters: JointParameters, start: np.ndarray
    ) -> "JointFit":
        """Return the same joints with other parameters and initial states."""
        moments = self.simulator.moments(parameters, start)
        return dataclasses.replace(
            self, parameters=parameters, start=start, moments=moments
        )

    def weighed_by_errors(self) -> "JointFit":
        """Return the fit whose motions weigh by their own errors.

        So the worst motion does not decide alone.
        """
        counts = self.simulator.motion.sample_counts
        weights = 1.0 / (self.mean_squares + RESOLUTION**2) / counts
        return dataclasses.replace(self, weights=weights)

    def along_simulation(self) -> "JointFit":
        """Return the fit along the loads of its own simulation."""
        if self.simulator.bodies is None:
            return self
        simulator = self.simulator.with_loads_of(self.parameters, self.start)
        fit = dataclasses.replace(self, simulator=simulator)
        return fit.with_unknowns(self.parameters, self.start)

    @property
    def mean_squares(self) -> Matrix:
        """Mean square errors of the samples that count [motions, joints]."""
        return self.moments.cost / self.simulator.motion.sample_counts

    @property
    def certainty(self) -> np.ndarray:
        """Inverse variances of initial states, over the number of samples."""
        motion = self.simulator.motion
        spread = motion.spread.copy()
        # A servo without integral action starts with none.
        spread[..., 2] = np.where(
            self.parameters[:, INDEX["ki"]] > 0, spread[..., 2], 1e-6
        )
        return 1.0 / spread**2 / motion.sample_counts[..., None]

    @cached_property
    def cost(self) -> Vector:
        """Weighted squares of each joint, with those of states and pull."""
        states = self.start - self.simulator.motion.start
        state_costs = np.sum(self.certainty * states**2, axis=-1)
        errors = self.weights * self.moments.cost
        motion_costs = errors + state_costs
        changes = self.parameters - self.pull.target(self.parameters)
        precision = self.pull.precision(self.parameters)
        pull_costs = np.sum(precision * changes**2, axis=-1)
        cost = motion_costs.sum(axis=0) + pull_costs
        return np.where(np.isfinite(cost), cost, np.inf)

    @cached_property
    def equations(self) -> "NormalEquations":
        """Normal equations of each motion without the initial states."""
        w = self.weights[..., None]
        g = w * self.moments.gradient
        H = w[..., None] * self.moments.information
        states = self.start - self.simulator.motion.start
        certainty = self.certainty
        by_states = H[..., SIZE:, SIZE:] + certainty[..., None] * np.eye(
            states.shape[-1]
        )
        state_gradient = g[..., SIZE:] + certainty * states
        coupling = H[..., SIZE:, :SIZE]
        response = -np.linalg.solve(by_states, coupling)
        correction = -np.linalg.solve(by_states, state_gradient[..., None])[..., 0]
        gradient = g[..., :SIZE] + np.einsum("...sp,...s->...p", coupling, correction)
        information = H[..., :SIZE, :SIZE] + np.einsum(
            "...sp,...sq->...pq", coupling, response
        )
        return NormalEquations(gradient, information, response, correction)

    @property
    def motion_deviations(self) -> JointParameters:
        """Deviations of the parameters by the scatter of motions; zero if not free."""
        equations = self.equations
        information = equations.information.sum(axis=0)
        deviations = np.zeros_like(self.parameters)
        for j, mask in enumerate(self.free):
            symbols = np.flatnonzero(mask)
            matrix = information[j][np.ix_(symbols, symbols)]
            inverse = np.linalg.pinv(matrix, rcond=1e-12, hermitian=True)
            # Each motion moves the estimate; their scatter holds model errors, too.
            changes = equations.gradient[:, j, symbols] @ inverse
            motions = len(changes)
            variance = motions / max(motions - 1, 1) * (changes**2).sum(axis=0)
            deviations[j, symbols] = np.sqrt(variance)
        return deviations

    def step(self, damping: Vector) -> "tuple[JointParameters, np.ndarray]":
        """Return parameters and initial states behind a damped Gauss-Newton step."""
        equations = self.equations
        change = self._parameter_step(
            equations.gradient.sum(axis=0), equations.information.sum(axis=0), damping
        )
        start = self.start + equations.correction
        start = start + np.einsum("mjsp,jp->mjs", equations.response, change)
        return self.parameters + change, start

    def _parameter_step(
        self, gradient: np.ndarray, information: np.ndarray, damping: np.ndarray
    ) -> np.ndarray:
        """Return damped Gauss-Newton steps of free parameters within their limits."""
        x = np.broadcast_to(self.parameters, gradient.shape)
        precision = self.pull.precision(self.parameters)
        gradient = gradient + precision * (x - self.pull.target(self.parameters))
        information = information + precision[..., None] * np.eye(SIZE)
        diagonal = np.diagonal(information, axis1=-2, axis2=-1)
        scale = np.sqrt(np.maximum(diagonal, 1e-300))
        is_moving = self.free & (diagonal > 1e-280)
        is_moving = is_moving & ~((x <= LOWER) & (gradient > 0))
        is_moving = is_moving & ~((x >= UPPER) & (gradient < 0))

        step = np.zeros_like(gradient)
        # A parameter that would leave its limits goes to them, and the others follow.
        for _ in range(SIZE):
            mask = is_moving.astype(float)
            pinned_step = np.where(is_moving, 0.0, step)
            rest = -gradient - np.einsum("...pq,...q->...p", information, pinned_step)
            moving_scale = mask / scale
            rows = information * moving_scale[..., None]
            matrix = rows * moving_scale[..., None, :]
            diagonal = damping[..., None] + 1e-12 + (1.0 - mask)
            matrix = matrix + diagonal[..., None] * np.eye(SIZE)
            right_side = (moving_scale * rest)[..., None]
            solution = np.linalg.solve(matrix, right_side)[..., 0]
            step = np.where(is_moving, solution / scale, pinned_step)
            end = np.clip(x + step, LOWER, UPPER)
            is_leaving = is_moving & (end != x + step)
            if not is_leaving.any():
                break
            step = np.where(is_leaving, end - x, step)
            is_moving = is_moving & ~is_leaving
        return step

    def improved(self, iterations: int, tolerance: float = 1e-3) -> "JointFit":
        """Return the fit after steps that lower the cost of each joint.

        Args:
            iterations: Largest number of steps.
            tolerance: Relative decrease of all costs below which the search ends.
        """
        fit = self
        damping = np.full(len(self.parameters), START_DAMPING)
        for _ in range(iterations):
            trial = fit.with_unknowns(*fit.step(damping))
            is_better = trial.cost < fit.cost
            decrease = np.where(is_better, 1.0 - trial.cost / fit.cost, 0.0)
            fit = fit.mixed_with(trial, is_better)
            damping = damping * np.where(is_better, 0.1, 10.0)
            is_open = np.where(is_better, decrease > tolerance, damping < MAX_DAMPING)
            if not is_open.any():
                break
        return fit

    def mixed_with(self, other: "JointFit", choice: np.ndarray) -> "JointFit":
        """Return the fit with some joints of another one along the same loads."""
        parts = [
            np.where(choice.reshape(-1, *[1] * (y.ndim - 2)), y, x)
            for x, y in zip(self.moments, other.moments, strict=True)
        ]
        joint_rows = choice[:, None]
        return dataclasses.replace(
            self,
            parameters=np.where(joint_rows, other.parameters, self.parameters),
            free=np.where(joint_rows, other.free, self.free),
            start=np.where(joint_rows, other.start, self.start),
            weights=np.where(choice, other.weights, self.weights),
            moments=Moments(*parts),
        )

    @cached_property
    def held_out_scores(self) -> Matrix:
        """Logarithms of the mean square errors of motions left out in turn.

        Without a motion the parameters move by a Gauss-Newton step; the motion is
        simulated with them [motions, joints].
        """
        equations = self.equations
        gradient = equations.gradient.sum(axis=0) - equations.gradient
        information = equations.information.sum(axis=0) - equations.information
        damping = np.full(self.weights.shape, 1e-3)
        change = self._parameter_step(gradient, information, damping)
        start = self.start + np.einsum("mjsp,mjp->mjs", equations.response, change)
        motion = self.simulator.motion
        path = self.simulator.positions(self.parameters + change, start)
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.sum(((path - motion.positions) * motion.counted) ** 2, axis=-1)
        mean = np.nan_to_num(squares / motion.sample_counts, nan=1e6, posinf=1e6)
        return np.log(mean + RESOLUTION**2)


class NormalEquations(NamedTuple):
    """Normal equations of the parameters in each motion, states eliminated.

    Attributes:
        gradient: Half the gradient of the cost [motions, joints, parameters].
        information: Gauss-Newton matrices [motions, joints, parameters, parameters].
        response: Change of initial states with the parameters [motions, joints, states,
            parameters].
        correction: Change of initial states at fixed parameters.
    """

    gradient: np.ndarray
    information: np.ndarray
    response: np.ndarray
    correction: np.ndarray

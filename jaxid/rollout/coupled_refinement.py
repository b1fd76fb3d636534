"""Least squares of all joints together, with velocities and loads of a simulation."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array, Matrix, Vector, double_precision, on_cores

from .coupled import CoupledSimulator, Path
from .least_squares import bounded_step
from .motion import FreeParameters, JointParameters, MotionSamples, ServoMotion
from .servo import LOWER, UPPER, State

RESOLUTION = 1e-4
"""Errors below which no motion counts more [rad or m]."""
FINE_FALL = 0.0005
"""Fall of the mean square error's logarithm that continues the last search."""
COARSE_FALL = 0.02
"""Fall of the mean square error's logarithm that continues the first search."""
DAMPINGS = (1e-5, 0.01)
"""Dampings of the steps of which the refinement takes the best."""
MAX_ROUNDS = 25
"""Largest number of steps of the refinement."""


def mean_squares(motion: ServoMotion, sums: np.ndarray) -> Matrix:
    """Return mean square errors from sums over counted samples; zero without any."""
    return sums / np.maximum(np.asarray(motion.counted).sum(axis=-1), 1.0)


def weights_of(motion: ServoMotion, sums: np.ndarray) -> Matrix:
    """Weigh motions by their own errors: the worst one does not decide alone."""
    sample_counts = np.asarray(motion.counted).sum(axis=-1)
    mean_errors = mean_squares(motion, sums)
    return np.where(
        sample_counts > 0, 1.0 / (mean_errors + RESOLUTION**2), 0.0
    ) / np.maximum(sample_counts, 1.0)


@dataclasses.dataclass(frozen=True)
class Refinement:
    """All joints with their parameters and the initial states of all motions.

    Attributes:
        simulator: Motions, with their initial states.
        parameters: Parameters of each joint.
        free: Parameters that are estimated; the unknowns are these, then the initial
            states.
        path: Simulation of all motions.
    """

    simulator: CoupledSimulator
    parameters: JointParameters
    free: FreeParameters
    path: Path

    @classmethod
    def of(
        cls,
        simulator: CoupledSimulator,
        parameters: JointParameters,
        free: FreeParameters,
    ) -> "Refinement":
        """Return simulated joints."""
        empty_array = np.zeros(0)
        refinement = cls(
            simulator,
            parameters,
            free,
            Path(State(empty_array, empty_array), empty_array, empty_array),
        )
        return refinement.with_unknowns([refinement.unknowns])[0]

    @property
    def unknowns(self) -> Vector:
        """Free parameters, joint by joint, then the initial state of each motion."""
        start = np.asarray(self.simulator.motion.start)
        return np.concatenate([self.parameters[self.free], start.ravel()])

    def with_unknowns(self, candidates: Sequence[np.ndarray]) -> list["Refinement"]:
        """Return the joints with other unknowns, simulated together."""
        count = int(self.free.sum())
        motion = self.simulator.motion
        motions = []
        theta = np.tile(self.parameters, (len(DAMPINGS), 1, 1))
        # Always as many at once, so that nothing is compiled anew.
        batch = motion.repeated(len(DAMPINGS))
        for k, z in enumerate(candidates):
            theta[k, self.free] = z[:count]
            motions.append(motion.replace(start=z[count:].reshape(motion.start.shape)))
        spare_motions = [motion] * (len(DAMPINGS) - len(motions))
        batch = batch.replace(
            start=np.concatenate([x.start for x in (*motions, *spare_motions)])
        )
        path = dataclasses.replace(self.simulator, motion=batch).simulate(theta)
        parts = [
            slice(k * motion.motions, (k + 1) * motion.motions)
            for k in range(len(motions))
        ]
        return [
            Refinement(
                dataclasses.replace(self.simulator, motion=part_motion),
                x,
                self.free,
                jax.tree.map(lambda y, part=part: y[..., part], path),
            )
            for part_motion, x, part in zip(motions, theta, parts, strict=False)
        ]

    @cached_property
    def residuals(self) -> MotionSamples:
        """Simulated less measured positions, zero where a sample does not count."""
        motion = self.simulator.motion
        errors = self.simulator.positions(self.path) - np.asarray(motion.positions)
        return np.where(np.asarray(motion.counted) > 0, errors, 0.0)

    @cached_property
    def sensitivities(self) -> np.ndarray:
        """Derivatives of the residuals by free parameters and the initial state."""
        S = self.simulator.sensitivities(self.parameters, self.path, self.free)
        S *= np.asarray(self.simulator.motion.counted)[..., None]
        return S

    @cached_property
    def sums(self) -> Matrix:
        """Sums of squared residuals; infinite where a simulation is not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            sums = np.sum(self.residuals**2, axis=-1)
        return np.where(np.isfinite(sums), sums, np.inf)

    @property
    def score(self) -> float:
        """Mean logarithm of the mean square errors."""
        mean = mean_squares(self.simulator.motion, self.sums)
        return float(np.log(mean + 1e-20).mean())

    @cached_property
    def products(self) -> tuple[np.ndarray, np.ndarray]:
        """Sensitivities times residuals, and times themselves, by motion and joint."""
        # NumPy's matrix products wait long for cores that other programs use; those of
        # JAX do not.
        with double_precision():
            motion_products = [
                _products(S, r)
                for S, r in zip(self.sensitivities, self.residuals, strict=True)
            ]
        g, H = (
            np.stack([np.asarray(x) for x in rows])
            for rows in zip(*motion_products, strict=True)
        )
        return g, H

    def moments(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient and Gauss-Newton matrix of the weighted squares."""
        count = int(self.free.sum())
        state_size = self.simulator.motion.start[0].size
        size = count + len(weights) * state_size
        g = np.zeros(size)
        H = np.zeros((size, size))
        for k, (w, motion_g, motion_H) in enumerate(
            zip(weights, *self.products, strict=True)
        ):
            indices = np.r_[
                :count, count + k * state_size : count + (k + 1) * state_size
            ]
            g[indices] += w @ motion_g
            H[np.ix_(indices, indices)] += np.tensordot(w, motion_H, 1)
        return g, H


@jax.jit
def _products(S: Array, r: Array) -> tuple[Array, Array]:
    return jnp.einsum("jtu,jt->ju", S, r), jnp.einsum("jtu,jtv->juv", S, S)


def prepare(
    simulator: CoupledSimulator, parameters: np.ndarray, free_mask: np.ndarray
) -> None:
    """Compile what the refinement of motions of this length needs."""
    refinement = Refinement.of(simulator, parameters, free_mask)
    simulator.transitions(0, parameters, refinement.path, free_mask)


def refine(
    first_start: tuple[CoupledSimulator, np.ndarray],
    second_start: tuple[CoupledSimulator, np.ndarray],
    free_mask: FreeParameters,
) -> tuple[Refinement, bool]:
    """Return the best fit of all joints together, from two that are nearly right.

    The second one goes on if it is clearly better.

    Args:
        first_start: Motions and parameters of each joint.
        second_start: The same of the second one.
        free_mask: Parameters that are estimated.

    Returns:
        The fit, and whether the logs tell which of the two is better.
    """

    def descend(start: tuple[CoupledSimulator, np.ndarray]) -> Refinement:
        return _descend(Refinement.of(*start, free_mask), COARSE_FALL)

    first_fit, second_fit = on_cores(descend, (first_start, second_start))
    gain = first_fit.score - second_fit.score
    best_fit = second_fit if gain > FINE_FALL else first_fit
    return _descend(best_fit, FINE_FALL), abs(gain) > FINE_FALL


def _descend(fit: Refinement, fall: float) -> Refinement:
    """Return the minimum of the squared errors, weighted by the errors of each motion.

    Args:
        fit: Start.
        fall: Fall of the score, promised or found in a step, for which the search goes
            on.
    """
    motion = fit.simulator.motion
    start_unknowns = fit.unknowns
    rows = np.nonzero(fit.free)[1]
    count = len(rows)
    state_limits = np.full(len(start_unknowns) - len(rows), np.inf)
    bounds = np.r_[LOWER[rows], -state_limits], np.r_[UPPER[rows], state_limits]
    prior = np.r_[np.zeros(count), motion.certainty.ravel()]
    free_unknowns = np.ones(len(start_unknowns), bool)
    for _ in range(MAX_ROUNDS):
        weights = weights_of(motion, fit.sums)
        z = fit.unknowns

        def cost(candidate: Refinement, weights=weights) -> float:
            squares = (
                np.sum(weights * candidate.sums)
                + prior @ (candidate.unknowns - start_unknowns) ** 2
            )
            return float(squares) / weights.size

        g, H = fit.moments(weights)
        g = g + prior * (z - start_unknowns)
        H = H + np.diag(prior)
        steps = [
            bounded_step(g, H, z, free_unknowns, bounds, damping)
            for damping in DAMPINGS
        ]
        promised_gain = (
            float(-2.0 * g @ steps[0] - steps[0] @ H @ steps[0]) / weights.size
        )
        if promised_gain < fall:
            break
        trials = fit.with_unknowns([np.clip(z + step, *bounds) for step in steps])
        trial = min(trials, key=cost)
        gain = cost(fit) - cost(trial)
        fit = trial if gain > 0.0 else fit
        if gain < fall or abs(promised_gain - gain) < fall:
            break
    return fit

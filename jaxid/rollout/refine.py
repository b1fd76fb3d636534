"""Least squares of all joints together, with initial velocities and loads of their simulation."""

import dataclasses
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array, Bool, Float, double_precision

from .coupled import CoupledSimulator
from .least_squares import bounded_step, improve
from .motion import ServoMotion, settling
from .servo import INDEX, LOWER, UPPER

RESOLUTION = 1e-4
"""Errors below which no motion counts more [rad or m]."""
FALL, COARSE = 0.002, 0.02
"""Fall of the logarithm of the mean square error for which the last, the first search go on."""
DAMPING = 1e-5
"""Least damping of a step of the refinement."""
ROUNDS = 25
"""Largest number of steps of the refinement."""


def mean_squares(motion: ServoMotion, sums: np.ndarray) -> Float[np.ndarray, "motions joints"]:
    """Return mean square errors from sums over the samples that count; zero without any."""
    return sums / np.maximum(np.asarray(motion.counted).sum(axis=-1), 1.0)


def weights_of(motion: ServoMotion, sums: np.ndarray) -> Float[np.ndarray, "motions joints"]:
    """Weigh motions by their own errors, so that the worst one does not decide alone."""
    counted = np.asarray(motion.counted).sum(axis=-1)
    mean = mean_squares(motion, sums)
    return np.where(counted > 0, 1.0 / (mean + RESOLUTION**2), 0.0) / np.maximum(counted, 1.0)


@dataclasses.dataclass(frozen=True)
class Refinement:
    """All joints with their parameters and the initial states of all motions.

    Attributes:
        simulator: Motions, with their initial states.
        parameters: Parameters of each joint.
        free: Parameters that are estimated; the unknowns are these, then the initial states.
    """

    simulator: CoupledSimulator
    parameters: Float[np.ndarray, "joints parameters"]
    free: Bool[np.ndarray, "joints parameters"]

    @property
    def unknowns(self) -> Float[np.ndarray, " unknowns"]:
        """Free parameters, joint by joint, then positions and velocities of each motion's start."""
        start = np.asarray(self.simulator.motion.start)
        return np.concatenate([self.parameters[self.free], start.ravel()])

    def with_unknowns(self, z: np.ndarray) -> "Refinement":
        """Return the joints with other unknowns."""
        x, count = self.parameters.copy(), int(self.free.sum())
        x[self.free] = z[:count]
        start = z[count:].reshape(self.simulator.motion.start.shape)
        motion = self.simulator.motion.replace(start=start)
        simulator = dataclasses.replace(self.simulator, motion=motion)
        return dataclasses.replace(self, simulator=simulator, parameters=x)

    @cached_property
    def path(self):
        """Simulation of all motions."""
        return self.simulator.simulate(self.parameters)

    @cached_property
    def residuals(self) -> Float[np.ndarray, "motions joints samples"]:
        """Simulated less measured positions, zero where a sample does not count."""
        motion = self.simulator.motion
        errors = self.simulator.positions(self.path) - np.asarray(motion.positions)
        return np.where(np.asarray(motion.counted) > 0, errors, 0.0)

    @cached_property
    def sensitivities(self) -> Float[np.ndarray, "motions joints samples unknowns"]:
        """Derivatives of the residuals by the free parameters and the motion's initial state."""
        S = self.simulator.sensitivities(self.parameters, self.path, self.free)
        S *= np.asarray(self.simulator.motion.counted)[..., None]
        return S

    @cached_property
    def sums(self) -> Float[np.ndarray, "motions joints"]:
        """Sums of squared residuals; infinite where a simulation has left the numbers."""
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
        """Sensitivities times residuals, and times themselves, of each motion and joint."""
        # NumPy's matrix products wait long for cores that other programs use; those of JAX do not.
        with double_precision():
            found = [
                _products(S, r) for S, r in zip(self.sensitivities, self.residuals, strict=True)
            ]
        g, H = (np.stack([np.asarray(x) for x in rows]) for rows in zip(*found, strict=True))
        return g, H

    def moments(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient and Gauss-Newton matrix of the weighted squares, by the unknowns."""
        motions, joints = weights.shape
        count = int(self.free.sum())
        size, each = count + 2 * motions * joints, 2 * joints
        g, H = np.zeros(size), np.zeros((size, size))
        for k, (w, own_g, own_H) in enumerate(zip(weights, *self.products, strict=True)):
            own = np.r_[:count, count + k * each : count + (k + 1) * each]
            g[own] += w @ own_g
            H[np.ix_(own, own)] += np.tensordot(w, own_H, 1)
        return g, H


@jax.jit
def _products(S: Array, r: Array) -> tuple[Array, Array]:
    return jnp.einsum("jtu,jt->ju", S, r), jnp.einsum("jtu,jtv->juv", S, S)


def refine(first: Refinement, other: Refinement) -> tuple[Refinement, bool]:
    """Return the best fit of all joints together, from two that are nearly right.

    The second one goes on if it is clearly better. All samples count in the end from the instant on
    that the first command takes effect; in them the initial states matter.

    Returns:
        The fit, and whether the logs tell which of the two is better.
    """
    best, other = (_descend(x, COARSE) for x in (first, other))
    told = abs(other.score - best.score) > FALL
    best = other if other.score < best.score - FALL else best
    motion, late = best.simulator.motion, float(best.parameters[:, INDEX["d"]].max())
    index = np.arange(motion.positions.shape[-1])
    first_known = np.ceil(max(late, 0.0) / np.asarray(motion.sample_time))
    early = (index < settling(motion)[:, None]) & (index >= first_known[:, None])
    motion = motion.replace(counted=np.where(early[:, None], 1.0, motion.counted))
    simulator = dataclasses.replace(best.simulator, motion=motion)
    return _descend(dataclasses.replace(best, simulator=simulator), FALL), told


def _descend(best: Refinement, fall: float) -> Refinement:
    """Return the minimum of the squared errors, weighted by the errors of each motion.

    Args:
        best: Start.
        fall: Fall of the score, promised or found in a step, for which the search goes on.
    """
    motion, first, damping = best.simulator.motion, best.unknowns, np.array([DAMPING])
    rows = np.nonzero(best.free)[1]
    count, wide = len(rows), np.full(len(first) - len(rows), np.inf)
    bounds = np.r_[LOWER[rows], -wide], np.r_[UPPER[rows], wide]
    prior = np.r_[np.zeros(count), motion.certainty.ravel()]
    for _ in range(ROUNDS):
        weights, tried = weights_of(motion, best.sums), {}

        def cost(found: Refinement, weights=weights) -> float:
            return float(np.sum(weights * found.sums) + prior @ (found.unknowns - first) ** 2)

        def costs(z, _, tried=tried, cost=cost, start=best):
            tried[z.tobytes()] = start.with_unknowns(z[0])
            return np.array([cost(tried[z.tobytes()])])

        g, H = best.moments(weights)
        z = best.unknowns
        g, H = g + prior * (z - first), H + np.diag(prior)
        free = np.ones(len(z), bool)
        step = bounded_step(g, H, z, free, bounds, DAMPING)
        promised = float(-2.0 * g @ step - step @ H @ step) / weights.size
        if promised < fall:
            return best
        terms = z[None], np.array([cost(best)]), g[None], H[None], free[None], damping
        z, damping, _ = improve(costs, np.zeros(1, int), *terms, bounds, 0.0)
        found, damping = tried.get(z.tobytes(), best), np.maximum(damping, DAMPING)
        if found is best and damping < 1.0 and promised > COARSE:
            continue
        if found.score > best.score - fall:
            return min(found, best, key=lambda y: y.score)
        best = found
    return best

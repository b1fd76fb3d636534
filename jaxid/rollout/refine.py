"""Least squares of all joints together, with velocities and loads of a simulation."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array, Bool, Float, double_precision, on_cores

from .coupled import CoupledSimulator, Path
from .least_squares import bounded_step
from .motion import ServoMotion
from .servo import LOWER, UPPER, State

RESOLUTION = 1e-4
"""Errors below which no motion counts more [rad or m]."""
FALL, COARSE = 0.0005, 0.02
"""Fall of the mean square error's logarithm that continues the last, first search."""
DAMPINGS = (1e-5, 0.01)
"""Dampings of the steps of which the refinement takes the best."""
ROUNDS = 25
"""Largest number of steps of the refinement."""


def mean_squares(
    motion: ServoMotion, sums: np.ndarray
) -> Float[np.ndarray, "motions joints"]:
    """Return mean square errors from sums over counted samples; zero without any."""
    return sums / np.maximum(np.asarray(motion.counted).sum(axis=-1), 1.0)


def weights_of(
    motion: ServoMotion, sums: np.ndarray
) -> Float[np.ndarray, "motions joints"]:
    """Weigh motions by their own errors: the worst one does not decide alone."""
    counted = np.asarray(motion.counted).sum(axis=-1)
    mean = mean_squares(motion, sums)
    return np.where(counted > 0, 1.0 / (mean + RESOLUTION**2), 0.0) / np.maximum(
        counted, 1.0
    )


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
    parameters: Float[np.ndarray, "joints parameters"]
    free: Bool[np.ndarray, "joints parameters"]
    path: Path

    @classmethod
    def of(
        cls,
        simulator: CoupledSimulator,
        parameters: Float[np.ndarray, "joints parameters"],
        free: Bool[np.ndarray, "joints parameters"],
    ) -> "Refinement":
        """Return simulated joints."""
        empty = np.zeros(0)
        found = cls(
            simulator, parameters, free, Path(State(empty, empty), empty, empty)
        )
        return found.with_unknowns([found.unknowns])[0]

    @property
    def unknowns(self) -> Float[np.ndarray, " unknowns"]:
        """Free parameters, joint by joint, then the initial state of each motion."""
        start = np.asarray(self.simulator.motion.start)
        return np.concatenate([self.parameters[self.free], start.ravel()])

    def with_unknowns(self, candidates: Sequence[np.ndarray]) -> list["Refinement"]:
        """Return the joints with other unknowns, simulated together."""
        count, motion, motions = int(self.free.sum()), self.simulator.motion, []
        theta = np.tile(self.parameters, (len(DAMPINGS), 1, 1))
        # Always as many at once, so that nothing is compiled anew.
        every = motion.repeated(len(DAMPINGS))
        for k, z in enumerate(candidates):
            theta[k, self.free] = z[:count]
            motions.append(motion.replace(start=z[count:].reshape(motion.start.shape)))
        spare = [motion] * (len(DAMPINGS) - len(motions))
        every = every.replace(
            start=np.concatenate([x.start for x in (*motions, *spare)])
        )
        path = dataclasses.replace(self.simulator, motion=every).simulate(theta)
        parts = [
            slice(k * motion.motions, (k + 1) * motion.motions)
            for k in range(len(motions))
        ]
        return [
            Refinement(
                dataclasses.replace(self.simulator, motion=own),
                x,
                self.free,
                jax.tree.map(lambda y, part=part: y[..., part], path),
            )
            for own, x, part in zip(motions, theta, parts, strict=False)
        ]

    @cached_property
    def residuals(self) -> Float[np.ndarray, "motions joints samples"]:
        """Simulated less measured positions, zero where a sample does not count."""
        motion = self.simulator.motion
        errors = self.simulator.positions(self.path) - np.asarray(motion.positions)
        return np.where(np.asarray(motion.counted) > 0, errors, 0.0)

    @cached_property
    def sensitivities(self) -> Float[np.ndarray, "motions joints samples unknowns"]:
        """Derivatives of the residuals by free parameters and the initial state."""
        S = self.simulator.sensitivities(self.parameters, self.path, self.free)
        S *= np.asarray(self.simulator.motion.counted)[..., None]
        return S

    @cached_property
    def sums(self) -> Float[np.ndarray, "motions joints"]:
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
            found = [
                _products(S, r)
                for S, r in zip(self.sensitivities, self.residuals, strict=True)
            ]
        g, H = (
            np.stack([np.asarray(x) for x in rows]) for rows in zip(*found, strict=True)
        )
        return g, H

    def moments(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient and Gauss-Newton matrix of the weighted squares."""
        count, each = int(self.free.sum()), self.simulator.motion.start[0].size
        size = count + len(weights) * each
        g, H = np.zeros(size), np.zeros((size, size))
        for k, (w, own_g, own_H) in enumerate(
            zip(weights, *self.products, strict=True)
        ):
            own = np.r_[:count, count + k * each : count + (k + 1) * each]
            g[own] += w @ own_g
            H[np.ix_(own, own)] += np.tensordot(w, own_H, 1)
        return g, H


@jax.jit
def _products(S: Array, r: Array) -> tuple[Array, Array]:
    return jnp.einsum("jtu,jt->ju", S, r), jnp.einsum("jtu,jtv->juv", S, S)


def prepare(
    simulator: CoupledSimulator, parameters: np.ndarray, free: np.ndarray
) -> None:
    """Compile what the refinement of motions of this length needs."""
    found = Refinement.of(simulator, parameters, free)
    simulator.transitions(0, parameters, found.path, free)


def refine(
    first: tuple[CoupledSimulator, np.ndarray],
    other: tuple[CoupledSimulator, np.ndarray],
    free: Bool[np.ndarray, "joints parameters"],
) -> tuple[Refinement, bool]:
    """Return the best fit of all joints together, from two that are nearly right.

    The second one goes on if it is clearly better.

    Args:
        first: Motions and parameters of each joint.
        other: The same of the second one.
        free: Parameters that are estimated.

    Returns:
        The fit, and whether the logs tell which of the two is better.
    """

    def descend(start: tuple[CoupledSimulator, np.ndarray]) -> Refinement:
        return _descend(Refinement.of(*start, free), COARSE)

    one, two = on_cores(descend, (first, other))
    told = abs(two.score - one.score) > FALL
    return _descend(two if two.score < one.score - FALL else one, FALL), told


def _descend(best: Refinement, fall: float) -> Refinement:
    """Return the minimum of the squared errors, weighted by the errors of each motion.

    Args:
        best: Start.
        fall: Fall of the score, promised or found in a step, for which the search goes
            on.
    """
    motion, first, rows = best.simulator.motion, best.unknowns, np.nonzero(best.free)[1]
    count, wide = len(rows), np.full(len(first) - len(rows), np.inf)
    bounds = np.r_[LOWER[rows], -wide], np.r_[UPPER[rows], wide]
    prior = np.r_[np.zeros(count), motion.certainty.ravel()]
    free = np.ones(len(first), bool)
    for _ in range(ROUNDS):
        weights, z = weights_of(motion, best.sums), best.unknowns

        def cost(found: Refinement, weights=weights) -> float:
            squares = (
                np.sum(weights * found.sums) + prior @ (found.unknowns - first) ** 2
            )
            return float(squares) / weights.size

        g, H = best.moments(weights)
        g, H = g + prior * (z - first), H + np.diag(prior)
        steps = [bounded_step(g, H, z, free, bounds, damping) for damping in DAMPINGS]
        promised = float(-2.0 * g @ steps[0] - steps[0] @ H @ steps[0]) / weights.size
        if promised < fall:
            break
        trials = best.with_unknowns([np.clip(z + step, *bounds) for step in steps])
        found = min(trials, key=cost)
        gained = cost(best) - cost(found)
        best = found if gained > 0.0 else best
        if gained < fall or abs(promised - gained) < fall:
            break
    return best

"""Joints that do not load each other: simulations of many candidates, derivatives."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, double_precision, on_cores

from .motion import ServoMotion
from .servo import (
    GAMMA,
    PARAMETERS,
    Forces,
    Stages,
    State,
    advance_state,
    balanced_integral,
    partials,
    steps_of,
)

BLOCK_SIZE = 250
"""Samples whose derivatives are found at once."""
HOLD = np.array(False)
"""Whether commands are held until the next one: here they are interpolated."""
BATCH_SIZE = 4
"""Candidates that are simulated at once."""


def _stage(
    state: State, theta: Array, stage: Stages, h: AnyArray
) -> tuple[State, Array]:
    """Return the state behind a stage, and the velocity in it."""
    x = Forces.of(state, theta, stage, h)
    u = x.velocity(state.w, stage)
    return advance_state(state, u, x, stage, h), u


def _start(theta: Array, motion: ServoMotion) -> State:
    """Return the initial state, with balanced integral actions of the servos."""
    q, w, *integral = jnp.asarray(motion.start)
    return State(q, w, balanced_integral(theta, motion, HOLD) if integral else None)


@functools.partial(jax.jit, static_argnums=2)
def _path(theta: Array, motion: ServoMotion, steps: int) -> tuple[Array]:
    """Simulate one motion; return its positions.

    Args:
        theta: Parameters of each joint, as in `PARAMETERS`.
        motion: One motion: commands, load, initial state.
        steps: Steps in each sample time.

    Returns:
        Positions [joints, samples].
    """
    h = motion.sample_time / steps

    def simulate_stage(state: State, stage: Stages):
        state, _ = _stage(state, theta.T, stage, h)
        return state, state.q

    start = _start(theta, motion)
    stages, _ = Stages.of(theta, motion, steps, HOLD)
    _, path = jax.lax.scan(simulate_stage, start, stages)
    return (jnp.concatenate([start.q[None], path[2 * steps - 1 :: 2 * steps]]).T,)


def _advance_tangents(h: AnyArray, state: State, coefficients) -> tuple[State, Array]:
    """Advance derivatives of the state by a sample time; return those of positions."""
    q, w, integral = state
    # Only servos with integral actions have further terms.
    for (
        by_q,
        by_w,
        share,
        factor,
        mask,
        source,
        *terms,
    ) in zip(*coefficients, strict=True):
        u = by_q * q + by_w * w + source
        if integral is not None:
            by_integral, rate, growth = terms
            u = u + by_integral * integral
            integral = integral + share * h * (growth - rate * (q + GAMMA * h * u))
        q = q + share * h * u
        w = mask * (w + factor * (u - w))
    return State(q, w, integral), q


@functools.partial(jax.jit, static_argnums=2)
def _moments(theta: Array, motion: ServoMotion, steps: int) -> tuple[Array, ...]:
    """Return sums of squared errors, half their gradients, and Gauss-Newton matrices.

    Loads are held. In blocks, whose numbers stay in the processor's cache, the
    derivatives of all stages are found at once; only their linear recursion runs in
    time.
    """
    h = motion.sample_time / steps
    n = len(theta)
    P = len(PARAMETERS)

    def simulate_stage(state: State, stage: Stages):
        next_state, u = _stage(state, theta.T, stage, h)
        return next_state, (state, u)

    def tangent_coefficients(states, u, stages, by_delay):
        """Return the coefficients of the linear recursion [samples, stages, ...]."""
        balance = partials(states, u, theta, stages, by_delay, h, jnp.zeros_like(u))
        motion_mask = jnp.where(u == 0.0, 0.0, 1.0)
        factor = motion_mask / balance.resistance
        # One long last axis: `jnp.stack` takes twenty times as long.
        by_theta = jnp.concatenate([factor * x for x in balance.by_theta], axis=-1)
        rows = (
            factor * balance.by_q,
            factor * balance.by_w,
            stages.share,
            stages.ahead,
            motion_mask,
            by_theta,
        )
        if states.integral is not None:
            growth = jnp.concatenate(balance.growth, axis=-1)
            rows = *rows, factor * balance.by_integral, balance.rate, growth
        return tuple(
            x.reshape(BLOCK_SIZE, 2 * steps, -1, min(n, x.shape[-1])) for x in rows
        )

    advance_tangents = functools.partial(_advance_tangents, h)

    def add_block(carry, inputs):
        start_state, start_tangents, *sums = carry
        stages, by_delay, positions, sample_mask = inputs
        end_state, (states, u) = jax.lax.scan(simulate_stage, start_state, stages)
        coefficients = tangent_coefficients(states, u, stages, by_delay)
        # Derivatives S of the positions [samples, parameters, joints].
        end_tangents, S = jax.lax.scan(advance_tangents, start_tangents, coefficients)
        path = jnp.concatenate([states.q[2 * steps :: 2 * steps], end_state.q[None]])
        r = (path - positions) * sample_mask
        S = S * sample_mask[:, None]
        block_sums = (
            jnp.sum(r**2, axis=0),
            jnp.einsum("tpj,tj->jp", S, r),
            jnp.einsum("tpj,tqj->jpq", S, S),
        )
        total_sums = (x + y for x, y in zip(sums, block_sums, strict=True))
        return (end_state, end_tangents, *total_sums), None

    def blocks(x: Array, size: int, mode: str = "edge") -> Array:
        padded_rows = jnp.pad(x, ((0, -len(x) % size), (0, 0)), mode)
        return padded_rows.reshape(-1, size, x.shape[-1])

    stages, by_delay = Stages.of(theta, motion, steps, HOLD)
    stages = jax.tree.map(
        lambda x: blocks(x, 2 * steps * BLOCK_SIZE), (stages, by_delay)
    )
    positions = blocks(jnp.asarray(motion.positions).T[1:], BLOCK_SIZE)
    sample_mask = blocks(jnp.asarray(motion.counted).T[1:], BLOCK_SIZE, "constant")
    sums = jnp.zeros(n), jnp.zeros((n, P)), jnp.zeros((n, P, P))

    def by_parameter(unit_vector: Array) -> State:
        change = jnp.broadcast_to(unit_vector, theta.shape)
        return jax.jvp(lambda x: _start(x, motion), (theta,), (change,))[1]

    tangents = jax.vmap(by_parameter)(jnp.eye(P))
    start = _start(theta, motion), tangents, *sums
    end, _ = jax.lax.scan(add_block, start, (*stages, positions, sample_mask))
    return end[2:]


@dataclasses.dataclass(frozen=True)
class ServoSimulator:
    """Motions with the steps in which they are simulated, by interpolated commands.

    Parameters have the shape [candidates, joints, parameters]; results have the motions
    first.

    Attributes:
        motion: Motions.
        time_step: Longest step, 5 % more if that makes them fewer [s].
    """

    motion: ServoMotion
    time_step: float

    @property
    def steps(self) -> int:
        """Steps in each sample time."""
        return steps_of(self.motion, self.time_step)

    def _map(self, function, reduce, theta: AnyArray, *, each: bool = False):
        """Apply a compiled function to all motions and candidates, on all cores.

        Args:
            function: Compiled function of the parameters of some joints and one motion.
            reduce: Function of the motion's index and the results, joints first.
            theta: Parameters.
            each: Whether the parameters have the motions first.
        """
        theta = np.asarray(theta)
        count, joints, _ = theta.shape[-3:]

        def simulate_batch(place: tuple[int, int]):
            k, first_candidate = place
            motion_parameters = theta[k] if each else theta
            # Always as many at once, so that nothing is compiled anew.
            candidates = np.minimum(
                np.arange(first_candidate, first_candidate + BATCH_SIZE), count - 1
            )
            part = self.motion.part(k)
            copies = {
                key: np.tile(np.asarray(getattr(part, key)), (BATCH_SIZE, 1))
                for key in ("commands", "positions", "load", "inertia", "counted")
            }
            copies |= {
                key: np.tile(np.asarray(getattr(part, key)), BATCH_SIZE)
                for key in ("start", "spread", "acceleration")
            }
            part = dataclasses.replace(part, **copies, lengths=(), names=())
            with double_precision():
                rows = jnp.asarray(
                    motion_parameters[candidates].reshape(BATCH_SIZE * joints, -1)
                )
                outputs = function(rows, part, self.steps)
            candidate_count = min(BATCH_SIZE, count - first_candidate)
            batch_outputs = (
                np.asarray(x).reshape(BATCH_SIZE, joints, *x.shape[1:]) for x in outputs
            )
            return reduce(k, *(x[:candidate_count] for x in batch_outputs))

        places = [
            (k, c)
            for k in range(self.motion.motions)
            for c in range(0, count, BATCH_SIZE)
        ]
        # The first call compiles, and the others wait for it.
        results = [simulate_batch(places[0]), *on_cores(simulate_batch, places[1:])]
        joined_results = (np.concatenate(x) for x in zip(*results, strict=True))
        return tuple(
            x.reshape(self.motion.motions, count, *x.shape[1:]) for x in joined_results
        )

    def paths(self, theta: AnyArray) -> np.ndarray:
        """Return the simulated positions."""
        return self._map(_path, lambda k, q: (q,), theta)[0]

    def costs(self, theta: AnyArray, *, each: bool = False) -> np.ndarray:
        """Return sums of squared errors.

        With `each`, parameters have the motions first, too.
        """

        def reduce(k: int, q: np.ndarray) -> tuple[np.ndarray]:
            errors = (q - np.asarray(self.motion.positions[k])) * np.asarray(
                self.motion.counted[k]
            )
            return (np.sum(errors**2, axis=-1),)

        return self._map(_path, reduce, theta, each=each)[0]

    def moments(self, theta: AnyArray) -> tuple[np.ndarray, ...]:
        """Return costs, their gradients and Gauss-Newton matrices.

        The last two are derivatives of half the cost.
        """
        return self._map(_moments, lambda _, *moments: moments, theta)

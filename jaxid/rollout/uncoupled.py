"""Joints that do not load each other: simulations of many candidates, derivatives."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, double_precision, on_cores

from .motion import ServoMotion
from .servo import (
    GAMMA,
    PARAMETERS,
    Forces,
    Stages,
    State,
    balanced_integral,
    moved,
    partials,
    steps_of,
)

BLOCK = 250
"""Samples whose derivatives are found at once."""
TOGETHER = 4
"""Candidates that are simulated at once."""


def _stage(
    state: State, theta: Array, stage: Stages, h: AnyArray
) -> tuple[State, Array]:
    """Return the state behind a stage, and the velocity in it."""
    x = Forces.of(state, theta, stage, h)
    u = x.velocity(state.w, stage)
    return moved(state, u, x, stage, h), u


def _start(theta: Array, motion: ServoMotion, hold: AnyArray) -> State:
    """Return the initial state, with balanced integral actions of the servos."""
    q, w, *integral = jnp.asarray(motion.start)
    return State(q, w, balanced_integral(theta, motion, hold) if integral else None)


@functools.partial(jax.jit, static_argnums=2)
def _path(
    theta: Array, motion: ServoMotion, steps: int, hold: AnyArray
) -> tuple[Array]:
    """Simulate one motion; return its positions.

    Args:
        theta: Parameters of each joint, as in `PARAMETERS`.
        motion: One motion: commands, load, initial state.
        steps: Steps in each sample time.
        hold: Whether commands are held until the next one, instead of interpolated.

    Returns:
        Positions [joints, samples].
    """
    h = motion.sample_time / steps

    def one(state: State, stage: Stages):
        state, _ = _stage(state, theta.T, stage, h)
        return state, state.q

    start = _start(theta, motion, hold)
    stages, _ = Stages.of(theta, motion, steps, hold)
    _, path = jax.lax.scan(one, start, stages)
    return (jnp.concatenate([start.q[None], path[2 * steps - 1 :: 2 * steps]]).T,)


@functools.partial(jax.jit, static_argnums=2)
def _moments(
    theta: Array, motion: ServoMotion, steps: int, hold: AnyArray
) -> tuple[Array, ...]:
    """Return sums of squared errors, half their gradients, and Gauss-Newton matrices.

    Loads are held. In blocks, whose numbers stay in the processor's cache, the
    derivatives of all stages are found at once; only their linear recursion runs in
    time.
    """
    h, n, P = motion.sample_time / steps, len(theta), len(PARAMETERS)

    def forward(state: State, stage: Stages):
        after, u = _stage(state, theta.T, stage, h)
        return after, (state, u)

    def tangent(state: State, inputs: tuple[Array, ...]):
        q, w, integral = state
        for by_q, by_w, share, ahead, runs, own, *more in zip(*inputs, strict=True):
            u = by_q * q + by_w * w + own
            if integral is not None:
                by_integral, rate, growth = more
                u = u + by_integral * integral
                integral = integral + share * h * (growth - rate * (q + GAMMA * h * u))
            q, w = q + share * h * u, runs * (w + ahead * (u - w))
        return State(q, w, integral), q

    def block(state, inputs):
        state, tangents, *sums = state
        stages, by_delay, measured, counted = inputs
        state, (before, u) = jax.lax.scan(forward, state, stages)
        found = partials(before, u, theta, stages, by_delay, h, jnp.zeros_like(u))
        runs = jnp.where(u == 0.0, 0.0, 1.0)
        factor = runs / found.resistance
        # One long last axis: `jnp.stack` takes twenty times as long.
        by_theta = jnp.concatenate([factor * x for x in found.by_theta], axis=-1)
        rows = (
            factor * found.by_q,
            factor * found.by_w,
            stages.share,
            stages.ahead,
            runs,
            by_theta,
        )
        if before.integral is not None:
            growth = jnp.concatenate(found.growth, axis=-1)
            rows = *rows, factor * found.by_integral, found.rate, growth
        rows = tuple(x.reshape(BLOCK, 2 * steps, -1, min(n, x.shape[-1])) for x in rows)
        tangents, S = jax.lax.scan(tangent, tangents, rows)
        path = jnp.concatenate([before.q[2 * steps :: 2 * steps], state.q[None]])
        r, S = (path - measured) * counted, S * counted[:, None]
        own = (
            jnp.sum(r**2, axis=0),
            jnp.einsum("tpj,tj->jp", S, r),
            jnp.einsum("tpj,tqj->jpq", S, S),
        )
        return (state, tangents, *(x + y for x, y in zip(sums, own, strict=True))), None

    def blocks(x: Array, size: int, mode: str = "edge") -> Array:
        padded = jnp.pad(x, ((0, -len(x) % size), (0, 0)), mode)
        return padded.reshape(-1, size, x.shape[-1])

    stages, by_delay = Stages.of(theta, motion, steps, hold)
    stages = jax.tree.map(lambda x: blocks(x, 2 * steps * BLOCK), (stages, by_delay))
    measured = blocks(jnp.asarray(motion.positions).T[1:], BLOCK)
    counted = blocks(jnp.asarray(motion.counted).T[1:], BLOCK, "constant")
    sums = jnp.zeros(n), jnp.zeros((n, P)), jnp.zeros((n, P, P))

    def by_parameter(one: Array) -> State:
        change = jnp.broadcast_to(one, theta.shape)
        return jax.jvp(lambda x: _start(x, motion, hold), (theta,), (change,))[1]

    tangents = jax.vmap(by_parameter)(jnp.eye(P))
    start = _start(theta, motion, hold), tangents, *sums
    return jax.lax.scan(block, start, (*stages, measured, counted))[0][2:]


@dataclasses.dataclass(frozen=True)
class ServoSimulator:
    """Motions with the steps in which they are simulated.

    Parameters have the shape [candidates, joints, parameters]; results have the motions
    first.

    Attributes:
        motion: Motions.
        time_step: Longest step, 5 % more if that makes them fewer [s].
        hold: Whether commands are held until the next one, instead of interpolated.
    """

    motion: ServoMotion
    time_step: float
    hold: bool = False

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

        def one(place: tuple[int, int]):
            k, first = place
            own = theta[k] if each else theta
            # Always as many at once, so that nothing is compiled anew.
            chosen = np.minimum(np.arange(first, first + TOGETHER), count - 1)
            part = self.motion.part(k)
            copies = {
                key: np.tile(np.asarray(getattr(part, key)), (TOGETHER, 1))
                for key in ("commands", "positions", "load", "inertia", "counted")
            }
            copies |= {
                key: np.tile(np.asarray(getattr(part, key)), TOGETHER)
                for key in ("start", "spread", "acceleration")
            }
            part = dataclasses.replace(part, **copies, lengths=(), names=())
            with double_precision():
                rows = jnp.asarray(own[chosen].reshape(TOGETHER * joints, -1))
                found = function(rows, part, self.steps, np.array(self.hold))
            used = min(TOGETHER, count - first)
            shaped = (
                np.asarray(x).reshape(TOGETHER, joints, *x.shape[1:]) for x in found
            )
            return reduce(k, *(x[:used] for x in shaped))

        places = [
            (k, c)
            for k in range(self.motion.motions)
            for c in range(0, count, TOGETHER)
        ]
        # The first call compiles, and the others wait for it.
        results = [one(places[0]), *on_cores(one, places[1:])]
        joined = (np.concatenate(x) for x in zip(*results, strict=True))
        return tuple(
            x.reshape(self.motion.motions, count, *x.shape[1:]) for x in joined
        )

    def paths(
        self, theta: AnyArray
    ) -> Float[np.ndarray, "motions candidates joints samples"]:
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
        return self._map(_moments, lambda _, *found: found, theta)

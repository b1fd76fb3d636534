r"""A joint behind a position servo: simulation, and exact sensitivities to its parameters.

Positions alone tell torques only in units of the servo's stiffness $K$, which is divided out:

$J \ddot q + B \dot q + (F + \mu |a L| + F_s e^{-(\dot q/v_s)^2})\, \mathrm{sign}\, \dot q
= \mathrm{sat}(g c(t - d) + b - q) - a L$

with the command $c$ and the load torque $L$ of the bodies. Dry friction is exact: it holds a joint
at rest without creep. The steps are of second order and L-stable, so that $J \to 0$ is allowed.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, double_precision, on_cores

from .dry_friction import Slip
from .motion import AHEAD, HISTORY, ServoMotion

GAMMA = 1.0 - math.sqrt(0.5)
"""Fraction of a step that each of its two implicit stages takes."""


BLOCK = 250
"""Samples whose derivatives are found at once."""
TOGETHER = 4
"""Candidates that are simulated at once."""


class ServoParameter(NamedTuple):
    """Parameter of a joint: symbol, meaning, unit (`u` is rad or m), start, limits, scale."""

    symbol: str
    meaning: str
    unit: str
    start: float
    lower: float
    upper: float
    scale: float


PARAMETERS = (
    ServoParameter("J", "inertia / stiffness", "s²", 4e-3, 1e-7, 1.0, 2e-3),
    # With less damping than 6 % of a step, a step may overshoot where friction then holds.
    ServoParameter("B", "damping / stiffness", "s", 0.05, 1e-3, 5.0, 0.03),
    ServoParameter("d", "delay", "s", 0.01, -AHEAD, HISTORY, 0.01),
    ServoParameter("b", "bias / stiffness", "u", 0.0, -1.0, 1.0, 0.01),
    ServoParameter("a", "1 / stiffness", "u/(N m)", 0.0, 0.0, 100.0, 0.05),
    ServoParameter("F", "dry friction / stiffness", "u", 0.01, 0.0, 1.0, 0.01),
    ServoParameter("mu", "friction per load", "1", 0.0, 0.0, 2.0, 0.3),
    ServoParameter("Fs", "Stribeck friction / stiffness", "u", 0.0, 0.0, 1.0, 0.01),
    ServoParameter("vs", "Stribeck speed", "u/s", 0.05, 3e-3, 2.0, 0.05),
    ServoParameter("um", "largest torque / stiffness", "u", 1e3, 0.01, 1e4, 0.2),
    ServoParameter("g", "gain of the command", "1", 1.0, 0.5, 2.0, 0.1),
)
"""Parameters of a joint, in the order of the arrays that hold them."""
INDEX = {parameter.symbol: k for k, parameter in enumerate(PARAMETERS)}
START, LOWER, UPPER, SCALE = (
    np.array([getattr(x, key) for x in PARAMETERS]) for key in ("start", "lower", "upper", "scale")
)


def delayed_command(c: AnyArray, t: Array, hold: AnyArray) -> Array:
    """Return the commands of the two stages of each step between the instants `t`, in samples.

    Commands are interpolated; or they are held until the next one, and count with their mean over
    the step. Before the first they stand still.
    """
    table = jnp.concatenate([jnp.zeros(1), jnp.cumsum(c)])
    held = jnp.clip(t, -1e3, len(c) - 1e-6)
    whole = jnp.clip(jnp.floor(held), 0.0, len(c) - 1.0)
    k = whole.astype(int)
    mean = jnp.diff(table[k] + (held - whole) * c[k]) / jnp.maximum(jnp.diff(held), 1e-12)
    ends = jnp.stack([t[:-1] + GAMMA * jnp.diff(t), t[1:]], axis=1).ravel()
    within = jnp.clip(ends, 0.0, len(c) - 1.0)
    whole = jnp.clip(jnp.floor(within), 0.0, len(c) - 2.0)
    k = whole.astype(int)
    interpolated = c[k] + (within - whole) * (c[k + 1] - c[k])
    return jnp.where(hold, jnp.repeat(mean, 2), interpolated)


class Stages(NamedTuple):
    """Inputs of the implicit Euler stages of a simulation, two for each step [stages, joints].

    Attributes:
        commands: Command of the stage, with gain and bias.
        load: Torque of the bodies [N m or N].
        inertia: Inertia of the bodies [kg m² or kg].
        share: Fraction of the step by which the position moves [stages, 1].
        ahead: Factor of the change of velocity with which the next stage starts.
    """

    commands: Array
    load: Array
    inertia: Array
    share: Array
    ahead: Array

    @classmethod
    def of(cls, theta: Array, motion: ServoMotion, steps: int, hold: AnyArray) -> "Stages":
        """Return the stages of one motion with this number of steps in each sample time."""
        count = motion.positions.shape[-1] - 1

        def repeated(x: AnyArray) -> Array:
            each = (x.shape[-1] - 1) // count
            return jnp.repeat(jnp.asarray(x).T[:-1], 2 * steps // each, axis=0)

        def alternating(first: float, second: float) -> Array:
            return jnp.tile(jnp.array([first, second]), count * steps)[:, None]

        commands = commands_of_stages(theta, motion, steps, hold)
        share = alternating(1.0 - GAMMA, GAMMA)
        ahead = alternating((1.0 - GAMMA) / GAMMA, 1.0)
        return cls(commands, repeated(motion.load), repeated(motion.inertia), share, ahead)

    @classmethod
    def with_delay(
        cls, theta: Array, motion: ServoMotion, steps: int, hold: AnyArray
    ) -> tuple["Stages", Array]:
        """Return the stages, and the derivatives of their commands by the delay."""

        def late(delay: Array) -> Array:
            return commands_of_stages(theta.at[:, INDEX["d"]].set(delay), motion, steps, hold)

        delay = theta[:, INDEX["d"]]
        by_delay = jax.jvp(late, (delay,), (jnp.ones_like(delay),))[1]
        return cls.of(theta, motion, steps, hold), by_delay


def commands_of_stages(theta: Array, motion: ServoMotion, steps: int, hold: AnyArray) -> Array:
    """Return the command of each stage, with gain and bias [stages, joints]."""
    delay, bias, gain = (theta[:, INDEX[key]] for key in ("d", "b", "g"))
    count = motion.positions.shape[-1] - 1
    instants = jnp.asarray(motion.lead + np.arange(count * steps + 1) / steps)

    def of_joint(command: AnyArray, delay: Array) -> Array:
        return delayed_command(command, instants - delay / motion.sample_time, hold)

    commands = jax.vmap(of_joint, out_axes=1)(motion.commands, delay)
    return gain[None] * commands + bias[None]


class Forces(NamedTuple):
    """Forces on the joints in a stage, over the stiffness.

    Attributes:
        force: Force without friction and inertia.
        friction: Dry friction.
        inertia: Inertia over the time of the stage.
        resistance: Decrease of the force with the velocity in the stage, with inertia.
        inside: Whether the servo is not saturated.
        falling: Part of the Stribeck friction that is left.
    """

    force: Array
    friction: Array
    inertia: Array
    resistance: Array
    inside: Array
    falling: Array

    @classmethod
    def of(cls, q: Array, w: Array, theta: Any, stages: Stages, h: AnyArray) -> "Forces":
        """Return the forces at positions and velocities before a stage.

        Args:
            q: Positions.
            w: Velocities.
            theta: Parameters [parameters, joints].
            stages: Inputs of the stages.
            h: Time of a step [s].
        """
        J, B, _, _, a, F, mu, Fs, vs, um, _ = theta
        load, error = a * stages.load, stages.commands - q
        inside = jnp.where(jnp.abs(error) < um, 1.0, 0.0)
        falling = jnp.exp(-((w / vs) ** 2))
        friction = F + mu * jnp.abs(load) + Fs * falling
        inertia = (J + a * stages.inertia) / (GAMMA * h)
        resistance = inertia + B + inside * GAMMA * h
        return cls(jnp.clip(error, -um, um) - load, friction, inertia, resistance, inside, falling)

    def slip(self, w: Array, stages: Stages, force: Array) -> Slip:
        """Return how joints slip under a force."""
        return Slip.of(force, self.inertia, self.friction, self.resistance, w, stages.ahead)


def moved(q: Array, w: Array, u: Array, stage: Stages, h: AnyArray) -> tuple[Array, Array]:
    """Return positions and velocities behind a stage from the velocities in it."""
    # A joint that has stopped in the first stage starts the second one at rest.
    after = jnp.where(u == 0.0, 0.0, w + stage.ahead * (u - w))
    return q + stage.share * h * u, after


def _stage(q: Array, w: Array, theta: Array, stage: Stages, h: AnyArray):
    """Return position and velocity behind a stage, and the velocity in it."""
    x = Forces.of(q, w, theta, stage, h)
    slip = x.slip(w, stage, x.force)
    balance = x.force + x.inertia * w - x.friction * slip.direction
    u = slip.free * balance / x.resistance
    return *moved(q, w, u, stage, h), u


def _start(motion: ServoMotion) -> tuple[Array, Array]:
    position, velocity = jnp.asarray(motion.start)
    return position, velocity


@functools.partial(jax.jit, static_argnums=2)
def _path(theta: Array, motion: ServoMotion, steps: int, hold: AnyArray) -> tuple[Array]:
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

    def one(state: tuple[Array, Array], stage: Stages):
        state = _stage(*state, theta.T, stage, h)[:2]
        return state, state[0]

    start = _start(motion)
    _, path = jax.lax.scan(one, start, Stages.of(theta, motion, steps, hold))
    return (jnp.concatenate([start[0][None], path[2 * steps - 1 :: 2 * steps]]).T,)


@functools.partial(jax.jit, static_argnums=2)
def _moments(theta: Array, motion: ServoMotion, steps: int, hold: AnyArray) -> tuple[Array, ...]:
    """Return sums of squared errors, half their gradients, and Gauss-Newton matrices.

    Loads are held. In blocks, whose numbers stay in the processor's cache, the derivatives of all
    stages are found at once; only their linear recursion runs in time.
    """
    h, n, P = motion.sample_time / steps, len(theta), len(PARAMETERS)

    def forward(state: tuple[Array, Array], stage: Stages):
        after = _stage(*state, theta.T, stage, h)
        return after[:2], (*state, after[2])

    def tangent(state: tuple[Array, Array], inputs: tuple[Array, ...]):
        q, w = state
        for by_q, by_w, share, ahead, runs, own in zip(*inputs, strict=True):
            u = by_q * q + by_w * w + own
            q, w = q + share * h * u, runs * (w + ahead * (u - w))
        return (q, w), q

    def block(state, inputs):
        state, tangents, *sums = state
        stages, by_delay, measured, counted = inputs
        state, (q, w, u) = jax.lax.scan(forward, state, stages)
        found = partials(q, w, u, theta, stages, by_delay, h, jnp.zeros_like(u))
        runs = jnp.where(u == 0.0, 0.0, 1.0)
        factor = runs / found.resistance
        rows = factor * found.by_q, factor * found.by_w, stages.share, stages.ahead, runs
        # One long last axis: `jnp.stack` takes twenty times as long.
        by_theta = jnp.concatenate([factor * x for x in found.by_theta], axis=-1)
        rows = tuple(x.reshape(BLOCK, 2 * steps, 1, x.shape[-1]) for x in rows)
        rows = *rows, by_theta.reshape(BLOCK, 2 * steps, P, n)
        tangents, S = jax.lax.scan(tangent, tangents, rows)
        path = jnp.concatenate([q[2 * steps :: 2 * steps], state[0][None]])
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

    stages, by_delay = Stages.with_delay(theta, motion, steps, hold)
    stages = jax.tree.map(lambda x: blocks(x, 2 * steps * BLOCK), (stages, by_delay))
    measured = blocks(jnp.asarray(motion.positions).T[1:], BLOCK)
    counted = blocks(jnp.asarray(motion.counted).T[1:], BLOCK, "constant")
    zero = jnp.zeros((P, n))
    sums = jnp.zeros(n), jnp.zeros((n, P)), jnp.zeros((n, P, P))
    start = _start(motion), (zero, zero), *sums
    return jax.lax.scan(block, start, (*stages, measured, counted))[0][2:]


class Partials(NamedTuple):
    """Derivatives of the balance of forces in all stages, at fixed velocities in them.

    Attributes:
        by_q: By the position before the stage [stages, joints].
        by_w: By the velocity before the stage.
        by_theta: By each parameter of the joint.
        by_force: By a further force.
        by_inertia: By the inertia over the time of the stage.
        by_load: By the load.
        resistance: Less the derivative by the velocity in the stage.
    """

    by_q: Array
    by_w: Array
    by_theta: tuple[Array, ...]
    by_force: Array
    by_inertia: Array
    by_load: Array
    resistance: Array


def partials(
    q: Array,
    w: Array,
    u: Array,
    theta: Array,
    stages: Stages,
    by_delay: Array,
    h: AnyArray,
    others: Array,
) -> Partials:
    """Return derivatives of the balance of forces in stages of one motion.

    Args:
        q: Positions before the stages [stages, joints].
        w: Velocities before the stages.
        u: Velocities in the stages.
        theta: Parameters of each joint.
        stages: Inputs of the stages.
        by_delay: Derivatives of the commands by the delay.
        h: Time of a step [s].
        others: Torques by the accelerations of other joints [stages, joints] [N m or N].
    """
    every = theta.T[:, None]
    x = Forces.of(q, w, every, stages, h)
    _, _, _, b, a, _, mu, Fs, vs, _, g = every
    slip = x.slip(w, stages, x.force + a * others)
    by_inertia, by_friction = slip.by_inertia - u, slip.by_friction
    by_servo = slip.by_force * x.inside
    falling = 2.0 * Fs * x.falling * w / vs**2
    by_load = mu * by_friction * jnp.sign(stages.load) - slip.by_force
    of_bodies = slip.by_force * others + by_load * stages.load
    derivatives = {
        "J": by_inertia / (GAMMA * h),
        "B": slip.by_resistance - u,
        "d": by_servo * by_delay,
        "b": by_servo,
        "a": of_bodies + by_inertia * stages.inertia / (GAMMA * h),
        "F": by_friction,
        "mu": by_friction * jnp.abs(a * stages.load),
        "Fs": by_friction * x.falling,
        "vs": by_friction * falling * w / vs,
        "um": slip.by_force * (1.0 - x.inside) * jnp.sign(stages.commands - q),
        "g": by_servo * (stages.commands - b) / g,
    }
    by_theta = tuple(derivatives[x] for x in INDEX)
    by_w = slip.by_w - by_friction * falling
    terms = slip.by_force, by_inertia, a * by_load
    return Partials(-by_servo, by_w, by_theta, *terms, x.resistance)


def steps_of(motion: ServoMotion, time_step: float, least: int = 1) -> int:
    """Return the steps in each sample time, of which the longest is 5 % longer than asked."""
    return max(least, math.ceil(float(motion.sample_time.max()) / time_step - 0.05))


@dataclasses.dataclass(frozen=True)
class ServoSimulator:
    """Motions with the steps in which they are simulated.

    Parameters have the shape [candidates, joints, parameters]; results have the motions first.

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
            part = dataclasses.replace(
                part, **copies, start=np.tile(part.start, (1, TOGETHER)), lengths=(), names=()
            )
            with double_precision():
                rows = jnp.asarray(own[chosen].reshape(TOGETHER * joints, -1))
                found = function(rows, part, self.steps, np.array(self.hold))
            used = min(TOGETHER, count - first)
            shaped = (np.asarray(x).reshape(TOGETHER, joints, *x.shape[1:]) for x in found)
            return reduce(k, *(x[:used] for x in shaped))

        places = [(k, c) for k in range(self.motion.motions) for c in range(0, count, TOGETHER)]
        # The first call compiles, and the others wait for it.
        results = [one(places[0]), *on_cores(one, places[1:])]
        joined = (np.concatenate(x) for x in zip(*results, strict=True))
        return tuple(x.reshape(self.motion.motions, count, *x.shape[1:]) for x in joined)

    def paths(self, theta: AnyArray) -> Float[np.ndarray, "motions candidates joints samples"]:
        """Return the simulated positions."""
        return self._map(_path, lambda k, q: (q,), theta)[0]

    def costs(self, theta: AnyArray, *, each: bool = False) -> np.ndarray:
        """Return sums of squared errors; with `each`, parameters have the motions first, too."""

        def reduce(k: int, q: np.ndarray) -> tuple[np.ndarray]:
            errors = (q - np.asarray(self.motion.positions[k])) * np.asarray(self.motion.counted[k])
            return (np.sum(errors**2, axis=-1),)

        return self._map(_path, reduce, theta, each=each)[0]

    def moments(self, theta: AnyArray) -> tuple[np.ndarray, ...]:
        """Return costs, gradients and Gauss-Newton matrices, each halved cost's derivatives."""
        return self._map(_moments, lambda _, *found: found, theta)

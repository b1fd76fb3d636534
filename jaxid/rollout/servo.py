r"""A joint behind a position servo: simulation, and exact sensitivities to its parameters.

Positions alone tell torques only in units of the servo's stiffness $K$, which is divided out:

$J \ddot q + B \dot q + (F + \mu |a L| + F_s e^{-(\dot q/v_s)^2})\, \mathrm{sign}\, \dot q
= \mathrm{sat}(g c(t - d) + b - q) - a L$

with the command $c$ and the load torque $L$ of the bodies. Dry friction is exact: a soft threshold
in implicit steps, which holds a joint at rest without creep. The steps are of second order
and L-stable, so that $J \to 0$ is allowed.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, double_precision, on_cores
from jaxid.dynamics.dispatch import in_numpy
from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording

GAMMA = 1.0 - math.sqrt(0.5)
"""Fraction of a step that each of its two implicit stages takes."""
SETTLING = 0.5
"""Time at the start of a log that does not count, because the initial speed is not known [s]."""
PADDED = 500
"""Samples to a multiple of which motions are padded, so that few lengths are compiled."""


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
    ServoParameter("d", "delay", "s", 0.01, -0.1, 0.3, 0.01),
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


class ServoMotion(eqx.Module):
    """Segments of logs as arrays of one length, padded behind their ends.

    Attributes:
        commands: Commanded positions [motions, joints, samples].
        positions: Measured positions.
        load: Torques of the bodies between a sample and the next one [N m or N].
        inertia: Inertia of the bodies about each joint [kg m² or kg].
        rates: Initial velocities [motions, joints].
        counted: Whether a sample counts in the fit.
        sample_time: Time between two samples of each motion [s].
        lengths: Number of samples of each motion.
        names: Name of the log of each motion.
    """

    commands: Float[AnyArray, "motions joints samples"]
    positions: Float[AnyArray, "motions joints samples"]
    load: Float[AnyArray, "motions joints samples"]
    inertia: Float[AnyArray, "motions joints samples"]
    rates: Float[AnyArray, "motions joints"]
    counted: Float[AnyArray, "motions joints samples"]
    sample_time: Float[AnyArray, " motions"]
    lengths: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, logs: Sequence[Recording]) -> "ServoMotion":
        """Return the segments of logs whose `forces` are the commands.

        Raises:
            InputError: If logs have different joints, or no segment lasts longer than a second.
        """
        if len({log.joints for log in logs}) != 1:
            raise InputError("`logs` must hold at least one log, and all with the same joints.")
        parts = [
            (log, a, b)
            for log in logs
            for a, b in log.segments
            if (b - a) * log.sample_time > 2 * SETTLING
        ]
        if not parts:
            raise InputError("`logs` hold no segment that lasts longer than a second.")
        lengths = tuple(b - a for _, a, b in parts)
        padded = PADDED * math.ceil(max(lengths) / PADDED)

        def stacked(channel: str) -> np.ndarray:
            rows = (np.asarray(getattr(log, channel))[a:b] for log, a, b in parts)
            filled = [np.pad(x, ((0, padded - len(x)), (0, 0)), "edge").T for x in rows]
            return np.stack(filled)

        positions, times = stacked("angles"), np.array([log.sample_time for log, _, _ in parts])
        index = np.arange(padded)
        settling = np.ceil(SETTLING / times)[:, None]
        counted = (index >= settling) & (index < np.array(lengths)[:, None])
        early = np.maximum(2, (0.1 / times).astype(int))
        rates = [
            (x[:, k] - x[:, 0]) / (k * dt) for x, k, dt in zip(positions, early, times, strict=True)
        ]
        return cls(
            commands=stacked("forces"),
            positions=positions,
            load=np.zeros_like(positions),
            inertia=np.zeros_like(positions),
            rates=np.array(rates),
            counted=np.repeat(counted[:, None].astype(float), positions.shape[1], axis=1),
            sample_time=times,
            lengths=lengths,
            names=tuple(log.name for log, _, _ in parts),
        )

    @property
    def motions(self) -> int:
        """Number of motions."""
        return len(self.lengths)

    def replace(self, **fields: Any) -> "ServoMotion":
        """Return the motions with other arrays."""
        return dataclasses.replace(self, **fields)

    def windows(self, horizon: float) -> "ServoMotion":
        """Return consecutive windows of a length [s] as motions of their own."""
        size = max(3, round(horizon / float(self.sample_time.mean())))
        places = [(k, a) for k, n in enumerate(self.lengths) for a in range(0, n - size + 1, size)]
        index = np.array([k for k, _ in places])

        def cut(x: AnyArray) -> np.ndarray:
            return np.stack([np.asarray(x)[k, :, a : a + size] for k, a in places])

        channels = ("commands", "positions", "load", "inertia", "counted")
        arrays = {key: cut(getattr(self, key)) for key in channels}
        q, dt = arrays["positions"], np.asarray(self.sample_time)[index]
        early = min(2, size - 1)
        rates = (q[..., early] - q[..., 0]) / (early * dt[:, None])
        names = tuple(self.names[k] for k in index)
        lengths = (size,) * len(index)
        return self.replace(**arrays, rates=rates, sample_time=dt, lengths=lengths, names=names)

    def part(self, motion: int) -> "ServoMotion":
        """Return one motion, without the axis of motions."""
        return jax.tree.map(lambda x: x[motion], self)


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Bodies that load the joints: a model with its parameters, often from a URDF file.

    Attributes:
        model: Model of the robot.
        parameters: Standard parameters.
        coupled: Whether inertial torques count, beside those of gravity.
    """

    model: Model
    parameters: Float[AnyArray, " standard"]
    coupled: bool = False

    def loads(
        self, motion: ServoMotion, q: np.ndarray | None = None, v: np.ndarray | None = None
    ) -> ServoMotion:
        """Return the motions with the loads between two samples.

        Args:
            motion: Motions.
            q: Positions; the measured ones if None.
            v: Velocities of a simulation, whose changes are the mean accelerations; smoothed
                derivatives of the positions if None.
        """
        q = np.asarray(motion.positions if q is None else q)
        load, inertia = np.zeros_like(q), np.zeros_like(q)
        model, p = self.model, np.asarray(self.parameters)
        for k, dt in enumerate(map(float, motion.sample_time)):
            if v is None:
                rates = smooth_rates(q[k].T, dt)
                path, qd, qdd = (0.5 * (x[1:] + x[:-1]) for x in rates)
            else:
                path, qd = (0.5 * (x[k].T[1:] + x[k].T[:-1]) for x in (q, v))
                qdd = np.diff(v[k].T, axis=0) / dt
            if self.coupled:
                M = in_numpy(model, model.inertia, path, shared=(p,))
                own = np.diagonal(M, axis1=1, axis2=2)
                forces = in_numpy(model, model.forces, path, qd, qdd, shared=(p,)) - own * qdd
                inertia[k, :, :-1] = own.T
            else:
                forces = in_numpy(model, model.forces, path, 0 * qd, 0 * qd, shared=(p,))
            load[k, :, :-1] = forces.T
        return motion.replace(load=load, inertia=inertia)


def smooth_rates(q: np.ndarray, dt: float, cutoff: float = 8.0) -> tuple[np.ndarray, ...]:
    """Return positions below a frequency [Hz] with their first and second derivatives."""
    from scipy.signal import butter, sosfiltfilt

    if cutoff < 0.4 / dt:
        q = sosfiltfilt(butter(2, 2.0 * cutoff * dt, output="sos"), q, axis=0)
    qd = np.gradient(q, dt, axis=0)
    return q, qd, np.gradient(qd, dt, axis=0)


def shrink(x: Array, threshold: Array) -> Array:
    """Return what a force leaves beyond a friction that it must overcome: soft threshold."""
    return x - jnp.clip(x, -threshold, threshold)


def delayed_command(c: AnyArray, t: Array, hold: AnyArray) -> Array:
    """Return the mean command over each step between the instants `t`, in samples.

    Commands are held until the next one, or interpolated; before the first they stand still.
    """
    table = jnp.concatenate([jnp.zeros(1), jnp.cumsum(c)])
    held = jnp.clip(t, -1e3, len(c) - 1e-6)
    whole = jnp.clip(jnp.floor(held), 0.0, len(c) - 1.0)
    k = whole.astype(int)
    mean = jnp.diff(table[k] + (held - whole) * c[k]) / jnp.maximum(jnp.diff(held), 1e-12)
    middle = jnp.clip(0.5 * (t[1:] + t[:-1]), 0.0, len(c) - 1.0)
    whole = jnp.clip(jnp.floor(middle), 0.0, len(c) - 2.0)
    k = whole.astype(int)
    return jnp.where(hold, mean, c[k] + (middle - whole) * (c[k + 1] - c[k]))


def _commands(theta: Array, motion: ServoMotion, steps: int, hold: AnyArray) -> Array:
    """Return the command of each step, with gain and bias [samples less one, steps]."""
    count, (_, _, d, b, *_, g) = len(motion.commands) - 1, theta
    edges = jnp.asarray(np.arange(count * steps + 1) / steps) - d / motion.sample_time
    return g * delayed_command(motion.commands, edges, hold).reshape(count, steps) + b


def _states(theta: Array, motion: ServoMotion, steps: int, hold: AnyArray) -> tuple[Array, Array]:
    """Simulate one joint from its first measured position; return positions and velocities.

    Args:
        theta: Parameters of the joint, as in `PARAMETERS`.
        motion: One joint of one motion: commands, load, initial state.
        steps: Steps in each sample time.
        hold: Whether commands are held until the next one, instead of interpolated.
    """
    h = motion.sample_time / steps

    def sample(state, inputs):
        q, v = state
        command, load, inertia = inputs
        state = _advance(q, v, theta, command, load, inertia, h)
        return state, state

    start: Any = motion.positions[0], motion.rates
    inputs = _commands(theta, motion, steps, hold), motion.load[:-1], motion.inertia[:-1]
    _, path = jax.lax.scan(sample, start, inputs)
    q, v = (jnp.concatenate([x[None], y]) for x, y in zip(start, path, strict=True))
    return q, v


def _advance(q, v, theta, commands, load, inertia, h) -> tuple[Array, Array]:
    """Return position and velocity one sample later, after a step [s] for each command."""
    J, B, _, _, a, F, mu, Fs, vs, um, _ = theta
    load, inertia, hg = a * load, J + a * inertia, GAMMA * h

    def stage(q: Array, v: Array, command: Array) -> Array:
        """Return the velocity at the end of an implicit Euler step."""
        error = command - q
        inside = jnp.where(jnp.abs(error) < um, 1.0, 0.0)
        friction = F + mu * jnp.abs(load) + Fs * jnp.exp(-((v / vs) ** 2))
        drive = inertia / hg * v + jnp.clip(error, -um, um) - load
        return shrink(drive, friction) / (inertia / hg + B + inside * hg)

    for command in commands:
        v1 = stage(q, v, command)
        # A joint that has stopped in the first stage starts the second one at rest.
        middle = jnp.where(v1 == 0.0, 0.0, v + (1.0 - GAMMA) / GAMMA * (v1 - v))
        q = q + (1.0 - GAMMA) * h * v1
        v = stage(q, middle, command)
        q = q + hg * v
    return q, v


AXES = ServoMotion(0, 0, 0, 0, 0, 0, None, (), ())  # pyright: ignore[reportArgumentType]
"""Axis of the joints in one motion."""


@functools.partial(jax.jit, static_argnums=2)
def _all_states(theta: Array, motion: ServoMotion, steps: int, hold: AnyArray):
    """Return positions and velocities [candidates, joints, samples] of one motion."""

    def one(theta: Array, motion: ServoMotion) -> tuple[Array, Array]:
        return _states(theta, motion, steps, hold)

    return jax.vmap(jax.vmap(one, (0, AXES)), (0, None))(theta, motion)


def _paths(theta: Array, motion: ServoMotion, steps: int, hold: AnyArray) -> Array:
    return _all_states(theta, motion, steps, hold)[0]


@functools.partial(jax.jit, static_argnums=2)
def _costs(theta: Array, motion: ServoMotion, steps: int, hold: AnyArray) -> Array:
    y, counted = _paths(theta, motion, steps, hold), motion.counted[None]
    r = counted * (y - motion.positions[None])
    return jnp.sum(r**2, axis=-1)


@functools.partial(jax.jit, static_argnums=2)
def _sensitivities(theta: Array, motion: ServoMotion, steps: int, hold: AnyArray):
    """Return positions, and their derivatives by the parameters of their own joints, first axis."""

    def along(direction: Array):
        return jax.jvp(
            lambda x: _paths(x, motion, steps, hold),
            (theta,),
            (jnp.broadcast_to(direction, theta.shape),),
        )

    return jax.vmap(along, out_axes=(None, 0))(jnp.eye(theta.shape[-1]))


@functools.partial(jax.jit, static_argnums=2)
def _moments(theta: Array, motion: ServoMotion, steps: int, hold: AnyArray):
    y, S = _sensitivities(theta, motion, steps, hold)
    r = motion.counted[None] * (y - motion.positions[None])
    S = motion.counted[None, None] * S
    gradient = jnp.einsum("pcjt,cjt->cjp", S, r)
    return jnp.sum(r**2, axis=-1), gradient, jnp.einsum("pcjt,qcjt->cjpq", S, S)


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
        return math.ceil(float(self.motion.sample_time.max()) / self.time_step - 0.05)

    def _map(self, function, theta: AnyArray, *, each: bool = False):
        """Apply a compiled function to all motions, on all cores."""

        def one(k: int):
            own = theta[k] if each else theta
            with double_precision():
                part = dataclasses.replace(self.motion.part(k), lengths=(), names=())
                found = function(jnp.asarray(own), part, self.steps, np.array(self.hold))
                return jax.tree.map(np.asarray, found)

        # The first call compiles, and the others wait for it.
        first = one(0)
        rest = list(on_cores(one, range(1, self.motion.motions)))
        return jax.tree.map(lambda *x: np.stack(x), first, *rest)

    def paths(self, theta: AnyArray) -> Float[np.ndarray, "motions candidates joints samples"]:
        """Return the simulated positions."""
        return self.states(theta)[0]

    def states(self, theta: AnyArray) -> tuple[np.ndarray, np.ndarray]:
        """Return the simulated positions and velocities."""
        return self._map(_all_states, theta)

    def costs(self, theta: AnyArray, *, each: bool = False) -> np.ndarray:
        """Return sums of squared errors; with `each`, parameters have the motions first, too."""
        return self._map(_costs, theta, each=each)

    def moments(self, theta: AnyArray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return costs, gradients and Gauss-Newton matrices, each halved cost's derivatives."""
        return self._map(_moments, theta)

    def sensitivities(self, theta: AnyArray) -> tuple[np.ndarray, np.ndarray]:
        """Return the simulated positions and their derivatives by the parameters, last axis."""
        y, S = self._map(_sensitivities, theta)
        return y, np.moveaxis(S, 1, -1)

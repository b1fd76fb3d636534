"""Simulation of joints behind position servos, and its derivatives.

A joint is simulated along a known load. Joints that load each other are simulated
again and again, each time along the loads of the last simulation, until they agree:
servos hold their joints so well that few rounds are enough.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, double_precision

from .body_loads import Bodies
from .motion import Place, ServoMotion
from .servo import (
    GAMMA,
    INDEX,
    JUMP_FACTORS,
    MEAN_FACTORS,
    SHARES,
    VELOCITY_FACTORS,
    StageInputs,
    State,
    advance_stage,
    is_held_until_jump,
)

MAX_ROUNDS = 12
"""Largest number of simulations in which joints that load each other agree."""
AGREEMENT = 1e-6
"""Change of positions by a round at which joints agree [rad or m]."""


class Channels(NamedTuple):
    """Inputs and measured positions of all channels: one joint in one motion each.

    The channels are the last axis, which makes the loops over them fast.

    Attributes:
        commands: Commands [samples, channels], which begin before the positions.
        positions: Measured positions [samples, channels].
        counted: Whether a sample counts: 1 or 0.
        load: Torque of the bodies in each step [N m or N].
        inertia: Inertia of the bodies in each step [kg m² or kg].
        sample_time: Time between two samples [s].
    """

    commands: Any
    positions: Any
    counted: Any
    load: Any
    inertia: Any
    sample_time: Any


class Moments(NamedTuple):
    """Sums over the samples of each motion and joint.

    The unknowns are the parameters of the joint, and its initial state in the motion.

    Attributes:
        cost: Sum of squared errors [motions, joints].
        gradient: Half its gradient [motions, joints, unknowns].
        information: Products of sensitivities [motions, joints, unknowns, unknowns].
    """

    cost: Any
    gradient: Any
    information: Any


class DelayedCommand(NamedTuple):
    """Command of each stage for the delay at which it was evaluated.

    Held commands may jump within a step: they have two parts. Others have equal ones.

    Attributes:
        first: Command in the first part of the step.
        second: Command in the second part.
        first_share: Share of the first part.
        slope: Derivative of both by time [1/s].
        rate: Mean derivative by time over the step [1/s].
        bend: Derivative of `rate` by time [1/s²].
    """

    first: Array
    second: Array
    first_share: Array
    slope: Array
    rate: Array
    bend: Array

    def at(self, lateness: Array, h: Array) -> tuple[Array, Array, Array, Array]:
        """Return both commands, share and rate if they come later by a small time.

        Args:
            lateness: Time by which they come later [s].
            h: Time of a step [s].
        """
        change = self.slope * lateness
        share = self.first_share + lateness / h
        rate = self.rate - self.bend * lateness
        return self.first - change, self.second - change, share, rate


def delayed_command(
    commands: Array, ends: Array, sample_time: Array, hold: AnyArray
) -> DelayedCommand:
    """Return the commands of both stages of steps that end at these instants.

    Commands are interpolated, or they are held until the next one. Before the first and
    behind the last they stand still.

    Args:
        commands: Commands [samples].
        ends: First start and then all ends of steps, less the delay, in samples.
        sample_time: Time between two samples [s].
        hold: Whether commands are held.
    """
    held = _held_command(commands, ends)
    interpolated = _interpolated_command(commands, ends)
    command = DelayedCommand(
        *(jnp.where(hold, x, y) for x, y in zip(held, interpolated, strict=True))
    )
    return command._replace(
        slope=command.slope / sample_time,
        rate=command.rate / sample_time,
        bend=command.bend / sample_time**2,
    )


def _held_command(commands: Array, ends: Array) -> DelayedCommand:
    """Return held commands; times are in samples, and steps no longer than one."""
    length = jnp.diff(ends)
    last_index = len(commands) - 1
    jump_times = jnp.floor(ends)
    indices = jump_times.astype(int)
    end_commands = commands[jnp.clip(indices, 0, last_index)]
    first_share = jnp.clip((jump_times[1:] - ends[:-1]) / length, 0.0, 1.0)
    rate = jnp.diff(end_commands) / length
    # Held commands jump: their second derivatives are those of neighbours.
    slopes = jnp.asarray(jnp.gradient(commands))
    bends = jnp.asarray(jnp.gradient(slopes))
    bend = _interpolate(bends, ends[1:])
    slope = jnp.zeros_like(rate)
    by_step = DelayedCommand(
        end_commands[:-1], end_commands[1:], first_share, slope, rate, bend
    )
    return DelayedCommand(*(jnp.repeat(x, 2) for x in by_step))


def _interpolated_command(commands: Array, ends: Array) -> DelayedCommand:
    """Return interpolated commands at the ends of both stages; times are in samples.

    Rates are means over the step, so that the impulse of a jump is exact.
    """

    def command_and_rate(ends: Array) -> tuple[Array, Array]:
        length = jnp.diff(ends)
        first_ends = ends[:-1] + GAMMA * length
        stage_ends = jnp.stack([first_ends, ends[1:]], axis=1).ravel()
        rate = jnp.diff(_interpolate(commands, ends)) / length
        return _interpolate(commands, stage_ends), jnp.repeat(rate, 2)

    later = jnp.ones_like(ends)
    values, slopes = jax.jvp(command_and_rate, (ends,), (later,))
    command, rate = values
    slope, bend = slopes
    return DelayedCommand(command, command, jnp.ones_like(command), slope, rate, bend)


def _interpolate(values: Array, instants: Array) -> Array:
    """Return a series at instants in samples; it stands still outside."""
    last_index = len(values) - 1.0
    places = jnp.clip(instants, 0.0, last_index)
    floors = jnp.clip(jnp.floor(places), 0.0, last_index - 1.0)
    k = floors.astype(int)
    return values[k] + (places - floors) * (values[k + 1] - values[k])


def _path(
    unknowns: Array, delays: Array, channels: Channels, steps: int, hold: AnyArray
) -> State:
    """Return the states of all channels at the first sample and behind all steps.

    Args:
        unknowns: Parameters of the joint, and its initial state [unknowns, channels].
        delays: Delays in the parameters [s], as constants for derivatives.
        channels: Inputs.
        steps: Steps in each sample time.
        hold: Whether commands are held until the next one.
    """
    theta = unknowns[: len(INDEX)]
    start = State(*unknowns[len(INDEX) :])
    samples, count = channels.positions.shape
    lead = channels.commands.shape[0] - samples
    step_count = (samples - 1) * steps
    instants = lead + np.arange(step_count + 1) / steps

    def delay_command(commands: Array, delay: Array, sample_time: Array):
        ends = instants - delay / sample_time
        return delayed_command(commands, ends, sample_time, hold)

    arguments = channels.commands, delays, channels.sample_time
    commands = jax.vmap(delay_command, (1, 0, 0), 1)(*arguments)
    stage_commands = jax.tree.map(lambda x: x.reshape(-1, 2, count), commands)
    lateness = theta[INDEX["d"]] - delays
    h = channels.sample_time / steps

    def step(state: State, inputs: tuple[DelayedCommand, Array, Array]):
        commands, load, inertia = inputs

        def stage_of(stage_inputs: tuple[DelayedCommand, tuple]) -> StageInputs:
            command, constants = stage_inputs
            return StageInputs(*command.at(lateness, h), load, inertia, *constants)

        def advance(state: State, stage_inputs: tuple[DelayedCommand, tuple]):
            stage = stage_of(stage_inputs)
            return advance_stage(state, theta, stage, is_held, h), None

        # If every step holds a jump, mean commands are closer to a smooth motion.
        jump_factors = JUMP_FACTORS if steps > 1 else MEAN_FACTORS
        constants = map(jnp.array, (SHARES, VELOCITY_FACTORS, jump_factors))
        stages = commands, tuple(constants)
        first_stage = stage_of(jax.tree.map(lambda x: x[0], stages))
        is_held = is_held_until_jump(state, theta, first_stage)
        # A loop: XLA would fuse two stages into one long expression, twice as slow.
        state, _ = jax.lax.scan(advance, state, stages)
        return state, state

    inputs = stage_commands, channels.load, channels.inertia
    _, path = jax.lax.scan(step, start, inputs)
    return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), start, path)


@functools.partial(jax.jit, static_argnums=3)
def _states(unknowns: Array, channels: Channels, hold: AnyArray, steps: int) -> State:
    """Return states of all channels at all steps [steps, channels]."""
    return _path(unknowns, unknowns[INDEX["d"]], channels, steps, hold)


@functools.partial(jax.jit, static_argnums=3)
def _sensitivities(
    unknowns: Array, channels: Channels, hold: AnyArray, steps: int
) -> tuple[Array, Array]:
    """Return errors [channels, samples] and derivatives [channels, unknowns, samples].

    Both are zero where a sample does not count.
    """
    delays = unknowns[INDEX["d"]]

    def errors(unknowns: Array) -> Array:
        path = _path(unknowns, delays, channels, steps, hold).q[::steps]
        return (path - channels.positions) * channels.counted

    def differentiate(direction: Array) -> tuple[Array, Array]:
        change = jnp.broadcast_to(direction[:, None], unknowns.shape)
        return jax.jvp(errors, (unknowns,), (change,))

    directions = jnp.eye(len(unknowns))
    r, S = jax.vmap(differentiate, out_axes=(None, 0))(directions)
    return r.T, jnp.moveaxis(S, 2, 0)


@dataclasses.dataclass(frozen=True)
class ServoSimulator:
    """Motions, and how they are simulated.

    Attributes:
        motion: Commands and measured positions.
        time_step: Longest step, 5 % more if that makes them fewer [s].
        hold: Whether commands are held until the next one, instead of interpolated.
        bodies: Bodies that load the joints; None without.
        path: States at all steps whose loads act [motions, joints, steps]; those of the
            measured positions if None.
    """

    motion: ServoMotion
    time_step: float = 0.01
    hold: bool = False
    bodies: Bodies | None = None
    path: State | None = None

    @property
    def steps(self) -> int:
        """Steps in each sample time."""
        sample_time = float(self.motion.sample_time.max())
        return max(1, math.ceil(sample_time / self.time_step - 0.05))

    @functools.cached_property
    def loads(self) -> tuple[np.ndarray, np.ndarray]:
        """Torques and inertias of the bodies in all steps [motions, joints, steps]."""
        motion = self.motion
        if self.bodies is None:
            motions, joints, samples = motion.positions.shape
            zeros = np.zeros((motions, joints, (samples - 1) * self.steps))
            return zeros, zeros
        if self.path is not None:
            step_times = motion.sample_time / self.steps
            return self.bodies.loads(self.path.q, self.path.w, step_times)
        loads = self.bodies.measured_loads(motion.positions, motion.sample_time)
        torques, inertias = (np.repeat(x, self.steps, axis=-1) for x in loads)
        return torques, inertias

    @functools.cached_property
    def _channels(self) -> Channels:
        """Inputs of the simulation."""
        motion = self.motion
        joints = motion.positions.shape[1]
        arrays = (motion.commands, motion.positions, motion.counted, *self.loads)
        # Motions and joints become one last axis.
        commands, positions, counted, load, inertia = (
            x.reshape(-1, x.shape[-1]).T for x in arrays
        )
        sample_times = np.repeat(motion.sample_time, joints)
        return Channels(commands, positions, counted, load, inertia, sample_times)

    def _call(self, function: Callable, theta: np.ndarray, start: np.ndarray) -> Any:
        """Call a compiled function of unknowns and channels."""
        shape = (len(start), *np.shape(theta)[-2:])
        parameters = np.broadcast_to(theta, shape)
        unknowns = np.concatenate([parameters, start], axis=-1)
        columns = unknowns.reshape(-1, unknowns.shape[-1]).T
        with double_precision():
            result = function(columns, self._channels, np.array(self.hold), self.steps)
            return jax.tree.map(np.asarray, result)

    def _by_motion(self, x: np.ndarray) -> np.ndarray:
        """Return an array of channels as one of motions and joints."""
        return x.reshape(*self.motion.positions.shape[:2], *x.shape[1:])

    def moments(self, theta: np.ndarray, start: np.ndarray) -> Moments:
        """Return errors, gradients and products of sensitivities along these loads.

        Args:
            theta: Parameters of each joint, or of each motion and joint.
            start: Initial states [motions, joints, states].
        """
        r, S = self.sensitivities(theta, start)
        cost = np.sum(r**2, axis=-1)
        gradient = (S @ r[..., None])[..., 0]
        return Moments(cost, gradient, S @ S.swapaxes(-1, -2))

    def sensitivities(
        self, theta: np.ndarray, start: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return errors and their derivatives.

        Returns:
            Errors [motions, joints, samples], and derivatives [motions, joints,
            unknowns, samples] by the parameters and the initial state.
        """
        r, S = self._call(_sensitivities, theta, start)
        return self._by_motion(r), self._by_motion(S)

    def states(self, theta: np.ndarray, start: np.ndarray) -> State:
        """Return states at all steps along these loads [motions, joints, steps]."""
        states = self._call(_states, theta, start)
        return State(*(self._by_motion(x.T) for x in states))

    def positions(self, theta: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Return positions of the samples along these loads."""
        return self.states(theta, start).q[..., :: self.steps]

    def with_loads_of(self, theta: np.ndarray, start: np.ndarray) -> "ServoSimulator":
        """Return the simulator with the loads of its own simulation."""
        if self.bodies is None:
            return self
        return dataclasses.replace(self, path=self.states(theta, start))

    def parts(self, places: Sequence[Place]) -> "ServoSimulator":
        """Return the simulator of parts of its motions, along the same loads."""
        path = None
        if self.path is not None:
            steps = self.steps

            def cut(x: np.ndarray) -> np.ndarray:
                return np.stack(
                    [x[k][:, a * steps : (b - 1) * steps + 1] for k, a, b in places]
                )

            path = State(*(cut(x) for x in self.path))
        return dataclasses.replace(self, motion=self.motion.parts(places), path=path)

    def in_agreement(self, theta: np.ndarray, start: np.ndarray) -> "ServoSimulator":
        """Return the simulator with loads that agree with its simulation."""
        simulator = self
        for _ in range(MAX_ROUNDS):
            previous_path = simulator.path
            simulator = simulator.with_loads_of(theta, start)
            if simulator.path is None:
                break
            if previous_path is None:
                continue
            change = np.abs(simulator.path.q - previous_path.q)
            if np.nanmax(change, initial=0.0) < AGREEMENT:
                break
        return simulator

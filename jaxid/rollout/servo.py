r"""A joint behind a position servo: its forces in a step, and their exact derivatives.

Positions alone tell torques only in units of the servo's stiffness $K$, which is
divided out:

$J \ddot q + B \dot q + (F + \mu |a L| + F_s e^{-(\dot q/v_s)^2})\, \mathrm{sign}\, \dot
q = \mathrm{sat}(e + s) - a L, \quad e = g c(t - d) + b - q, \quad \dot s = k_i e$

with the command $c$, the load torque $L$ of the bodies, and the integral action $s$.
Dry friction is exact: it holds a joint at rest without creep. The steps are of second
order and L-stable, so that $J \to 0$ is allowed.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, double_precision

from .dry_friction import Slip
from .motion import MAX_ADVANCE, MAX_DELAY, ServoMotion

GAMMA = 1.0 - math.sqrt(0.5)
"""Fraction of a step that each of its two implicit stages takes."""

SHARES = (1.0 - GAMMA, GAMMA)
"""Fraction of a step by which the position moves in each stage."""
VELOCITY_FACTORS = ((1.0 - GAMMA) / GAMMA, 1.0)
"""Change of velocity behind each stage, over that in it."""


class ServoParameter(NamedTuple):
    """Parameter of a joint: symbol, meaning, unit, start, limits, scale.

    In the unit, `u` is rad or m.
    """

    symbol: str
    meaning: str
    unit: str
    start: float
    lower: float
    upper: float
    scale: float


PARAMETERS = (
    ServoParameter("J", "inertia / stiffness", "s²", 4e-3, 1e-7, 1.0, 2e-3),
    # With less damping than 6 % of a step, a step may overshoot where friction then
    # holds.
    ServoParameter("B", "damping / stiffness", "s", 0.05, 1e-3, 5.0, 0.03),
    ServoParameter("d", "delay", "s", 0.01, -MAX_ADVANCE, MAX_DELAY, 0.01),
    ServoParameter("b", "bias / stiffness", "u", 0.0, -1.0, 1.0, 0.01),
    ServoParameter("a", "1 / stiffness", "u/(N m)", 0.0, 0.0, 100.0, 0.05),
    ServoParameter("F", "dry friction / stiffness", "u", 0.01, 0.0, 1.0, 0.01),
    ServoParameter("mu", "friction per load", "1", 0.0, 0.0, 2.0, 0.3),
    ServoParameter("Fs", "Stribeck friction / stiffness", "u", 0.0, 0.0, 1.0, 0.01),
    ServoParameter("vs", "Stribeck speed", "u/s", 0.05, 3e-3, 2.0, 0.05),
    ServoParameter("um", "largest torque / stiffness", "u", 1e3, 0.01, 1e4, 0.2),
    ServoParameter("g", "gain of the command", "1", 1.0, 0.5, 2.0, 0.1),
    ServoParameter("ki", "integral gain / stiffness", "1/s", 0.0, 0.0, 100.0, 1.0),
)
"""Parameters of a joint, in the order of the arrays that hold them."""
INDEX = {parameter.symbol: k for k, parameter in enumerate(PARAMETERS)}
START, LOWER, UPPER, SCALE = (
    np.array([getattr(x, key) for x in PARAMETERS])
    for key in ("start", "lower", "upper", "scale")
)


def delayed_command(c: AnyArray, t: Array, hold: AnyArray) -> tuple[Array, Array]:
    """Return the commands of both stages of each step between instants `t`, in samples.

    Commands are interpolated; or they are held until the next one, and count with their
    mean over the step. Before the first they stand still.

    Returns:
        The commands, and their changes by a delay of one sample.
    """
    last_index = len(c) - 1.0

    def held_commands() -> tuple[Array, Array]:
        sums = jnp.concatenate([jnp.zeros(1), jnp.cumsum(c)])
        instants = jnp.maximum(t, -1e3)
        floors = jnp.clip(jnp.floor(instants), 0.0, last_index)
        k = floors.astype(int)
        commands = c[k]
        integral = sums[k] + (instants - floors) * commands
        length = jnp.maximum(jnp.diff(instants), 1e-12)
        mean = jnp.diff(integral) / length
        by_delay = -jnp.diff(commands) / length
        return jnp.repeat(mean, 2), jnp.repeat(by_delay, 2)

    def interpolated_commands() -> tuple[Array, Array]:
        first_ends = t[:-1] + GAMMA * jnp.diff(t)
        ends = jnp.stack([first_ends, t[1:]], axis=1).ravel()
        instants = jnp.clip(ends, 0.0, last_index)
        floors = jnp.clip(jnp.floor(instants), 0.0, last_index - 1.0)
        k = floors.astype(int)
        commands = c[k]
        change = c[k + 1] - commands
        by_delay = jnp.where(instants == ends, -change, 0.0)
        return commands + (instants - floors) * change, by_delay

    return jax.lax.cond(hold, held_commands, interpolated_commands)


class Stages(NamedTuple):
    """Inputs of a simulation's implicit Euler stages, two per step [stages, joints].

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
    def of(
        cls, theta: Array, motion: ServoMotion, steps: int, hold: AnyArray
    ) -> tuple["Stages", Array]:
        """Return the stages of one motion, and derivatives of commands by the delay.

        `steps` is the number of steps in each sample time.
        """
        count = motion.positions.shape[-1] - 1

        def repeat_stages(x: AnyArray) -> Array:
            rows_per_sample = (x.shape[-1] - 1) // count
            stages_per_row = 2 * steps // rows_per_sample
            return jnp.repeat(jnp.asarray(x).T[:-1], stages_per_row, axis=0)

        def alternate_stages(values: tuple[float, float]) -> Array:
            return jnp.tile(jnp.array(values), count * steps)[:, None]

        commands, by_delay = commands_of_stages(theta, motion, steps, hold)
        share = alternate_stages(SHARES)
        velocity_factor = alternate_stages(VELOCITY_FACTORS)
        stages = cls(
            commands,
            repeat_stages(motion.load),
            repeat_stages(motion.inertia),
            share,
            velocity_factor,
        )
        return stages, by_delay


def commands_of_stages(
    theta: Array, motion: ServoMotion, steps: int, hold: AnyArray
) -> tuple[Array, Array]:
    """Return each stage's command, with gain and bias, and its derivative by the delay.

    Returns:
        Both with the shape [stages, joints].
    """
    delay = theta[:, INDEX["d"]]
    bias = theta[None, :, INDEX["b"]]
    gain = theta[None, :, INDEX["g"]]
    sample_time = motion.sample_time
    count = motion.positions.shape[-1] - 1
    samples = np.arange(count * steps + 1) / steps
    instants = jnp.asarray(motion.lead + samples)

    def of_joint(command: AnyArray, delay: Array) -> tuple[Array, Array]:
        return delayed_command(command, instants - delay / sample_time, hold)

    commands, by_delay = jax.vmap(of_joint, out_axes=1)(motion.commands, delay)
    return gain * commands + bias, gain * by_delay / sample_time


class State(NamedTuple):
    """State of the joints: positions, velocities, and integral actions of servos."""

    q: Any
    w: Any
    integral: Any = None


class Forces(NamedTuple):
    """Forces on the joints in a stage, over the stiffness.

    Attributes:
        error: Command less position before the stage.
        force: Force without friction and inertia.
        friction: Dry friction.
        inertia: Inertia over the time of the stage.
        resistance: Decrease of the force with the velocity in the stage, with inertia.
        control_share: 1 where the servo is not saturated, otherwise 0.
        stribeck_share: Part of the Stribeck friction that is left.
        gain: Factor of the error in the servo's force: 1, more with integral action.
        rate: Growth of the integral action by the error.
    """

    error: Array
    force: Array
    friction: Array
    inertia: Array
    resistance: Array
    control_share: Array
    stribeck_share: Array
    gain: Array | float
    rate: Array | float

    @classmethod
    def of(cls, state: State, theta: Any, stages: Stages, h: AnyArray) -> "Forces":
        """Return the forces in the state before a stage.

        Args:
            state: State of the joints.
            theta: Parameters [parameters, joints].
            stages: Inputs of the stages.
            h: Time of a step [s].
        """
        J, B, _, _, a, F, mu, Fs, vs, um, _, ki = theta
        q, w, integral = state
        load = a * stages.load
        error = stages.commands - q
        gain = 1.0
        drive = error
        if integral is not None:
            gain = 1.0 + ki * GAMMA * h
            drive = gain * error + integral
        control_share = jnp.where(jnp.abs(drive) < um, 1.0, 0.0)
        stribeck_share = jnp.exp(-((w / vs) ** 2))
        friction = F + mu * jnp.abs(load) + Fs * stribeck_share
        inertia = (J + a * stages.inertia) / (GAMMA * h)
        resistance = inertia + B + control_share * gain * GAMMA * h
        force = jnp.clip(drive, -um, um) - load
        return cls(
            error,
            force,
            friction,
            inertia,
            resistance,
            control_share,
            stribeck_share,
            gain,
            ki,
        )

    def velocity(self, w: Array, stages: Stages) -> Array:
        """Return the velocities in a stage of joints that do not load each other."""
        slip = self.slip(w, stages, self.force)
        balance = self.force + self.inertia * w - self.friction * slip.direction
        return slip.free * balance / self.resistance

    def slip(self, w: Array, stages: Stages, force: Array) -> Slip:
        """Return how joints slip under a force."""
        return Slip.of(
            force, self.inertia, self.friction, self.resistance, w, stages.ahead
        )


def advance_state(
    state: State, u: Array, x: Forces, stage: Stages, h: AnyArray
) -> State:
    """Return the state behind a stage from the velocities in it."""
    q, w, integral = state
    # A joint that has stopped in the first stage starts the second one at rest.
    next_velocity = jnp.where(u == 0.0, 0.0, w + stage.ahead * (u - w))
    if integral is not None:
        integral = integral + stage.share * h * x.rate * (x.error - GAMMA * h * u)
    return State(q + stage.share * h * u, next_velocity, integral)


def balanced_integral(theta: Array, motion: ServoMotion, hold: AnyArray) -> Array:
    """Return the integral actions that balance the torques at the start of a motion."""
    J, B, _, _, a, F, mu, Fs, vs, _, _, ki = theta.T
    q, w = motion.start[:2]
    load = a * motion.load[:, 0]
    body_inertia = a * motion.inertia[:, 0]
    inertia = J + body_inertia
    direction = w / (jnp.abs(w) + motion.spread[1])
    load_friction = mu * jnp.abs(load)
    stribeck_friction = Fs * jnp.exp(-((w / vs) ** 2))
    friction = F + load_friction + stribeck_friction
    torque = load + B * w + friction * direction
    torque = torque + inertia * motion.acceleration
    commands, _ = commands_of_stages(theta, motion, 1, hold)
    error = commands[0] - q
    return jnp.where(ki > 0.0, torque - error, 0.0)


def with_integral(motion: ServoMotion, theta: AnyArray, hold: bool) -> ServoMotion:
    """Return motions with initial integral actions that balance the torques.

    The balance may be wrong, so these actions have a spread.

    Args:
        motion: Motions.
        theta: Parameters of each joint.
        hold: Whether commands are held until the next one.
    """
    initial_motion = motion.replace(
        start=np.asarray(motion.start)[:, :2], spread=np.asarray(motion.spread)[:, :2]
    )
    with double_precision():
        integrals = jax.vmap(balanced_integral, (None, 0, None))(
            jnp.asarray(theta),
            initial_motion.replace(lengths=(), names=()),
            np.array(hold),
        )
    start = np.concatenate(
        [initial_motion.start, np.asarray(integrals)[:, None]], axis=1
    )
    integral_spread = np.where(np.asarray(theta)[:, INDEX["ki"]] > 0.0, 1.0, 1e-6)
    spread = np.concatenate(
        [initial_motion.spread, 0.0 * start[:, 2:] + integral_spread], axis=1
    )
    return motion.replace(start=start, spread=spread)


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
        by_integral: By the integral action before the stage.
        rate: Growth of the integral action by the error.
        growth: Derivatives of the growth by each parameter, at fixed positions.
    """

    by_q: Array
    by_w: Array
    by_theta: tuple[Array, ...]
    by_force: Array
    by_inertia: Array
    by_load: Array
    resistance: Array
    by_integral: Any = None
    rate: Any = None
    growth: tuple[Array, ...] = ()


def partials(
    state: State,
    u: Array,
    theta: Array,
    stages: Stages,
    by_delay: Array,
    h: AnyArray,
    other_torques: Array,
) -> Partials:
    """Return derivatives of the balance of forces in stages of one motion.

    Args:
        state: States before the stages [stages, joints].
        u: Velocities in the stages.
        theta: Parameters of each joint.
        stages: Inputs of the stages.
        by_delay: Derivatives of the commands by the delay.
        h: Time of a step [s].
        other_torques: Torques by the accelerations of other joints [stages, joints]
            [N m or N].
    """
    parameters = theta.T[:, None]
    w = state.w
    x = Forces.of(state, parameters, stages, h)
    _, _, _, b, a, _, mu, Fs, vs, _, g, _ = parameters
    slip = x.slip(w, stages, x.force + a * other_torques)
    by_inertia = slip.by_inertia - u
    by_damping = slip.by_resistance - u
    by_friction = slip.by_friction
    by_integral = slip.by_force * x.control_share
    by_servo = by_integral * x.gain
    by_command = {"d": by_delay, "b": jnp.ones_like(u), "g": (stages.commands - b) / g}
    stribeck_slope = 2.0 * Fs * x.stribeck_share * w / vs**2
    by_load = mu * by_friction * jnp.sign(stages.load) - slip.by_force
    drive_sign = jnp.sign(x.force + a * stages.load)
    by_growth = slip.by_force * x.error + GAMMA * h * by_damping
    by_compliance = slip.by_force * other_torques + by_load * stages.load
    derivatives = {
        "J": by_inertia / (GAMMA * h),
        "B": by_damping,
        **{key: by_servo * value for key, value in by_command.items()},
        "a": by_compliance + by_inertia * stages.inertia / (GAMMA * h),
        "F": by_friction,
        "mu": by_friction * jnp.abs(a * stages.load),
        "Fs": by_friction * x.stribeck_share,
        "vs": by_friction * stribeck_slope * w / vs,
        "um": slip.by_force * (1.0 - x.control_share) * drive_sign,
        "ki": x.control_share * GAMMA * h * by_growth,
    }
    by_theta = tuple(derivatives[x] for x in INDEX)
    by_w = slip.by_w - by_friction * stribeck_slope
    terms = slip.by_force, by_inertia, a * by_load
    balance = Partials(-by_servo, by_w, by_theta, *terms, x.resistance)
    if state.integral is None:
        return balance
    growth_terms = {key: x.rate * value for key, value in by_command.items()}
    growth_terms["ki"] = x.error - GAMMA * h * u
    growth = tuple(growth_terms.get(key, jnp.zeros_like(u)) for key in INDEX)
    return balance._replace(
        by_integral=by_integral, rate=x.rate + 0.0 * u, growth=growth
    )


def steps_of(motion: ServoMotion, time_step: float, minimum: int = 1) -> int:
    """Return the steps in each sample time, the longest up to 5 % longer than asked."""
    return max(minimum, math.ceil(float(motion.sample_time.max()) / time_step - 0.05))

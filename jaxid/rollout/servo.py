r"""A joint behind a position servo: its parameters, and its forces in a step.

Positions alone tell torques only in units of the servo's stiffness $K$, which is
divided out:

$J \ddot q + B \dot q + (F + \mu |a L| + F_s e^{-(\dot q/v_s)^2})\, \mathrm{sign}\, \dot
q = \mathrm{sat}(e + f g \dot c + s) - a L, \quad e = g c(t - d) + b - q, \quad \dot s =
k_i e$

with the command $c$, the load torque $L$ of the bodies, and the integral action $s$.
Dry friction is exact: it holds a joint at rest without creep. The steps are of second
order and L-stable, so that $J \to 0$ is allowed.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array

from .dry_friction import slip_of

GAMMA = 1.0 - math.sqrt(0.5)
"""Fraction of a step that each of its two implicit stages takes."""
SHARES = (1.0 - GAMMA, GAMMA)
"""Fraction of a step by which the position moves in each stage."""
VELOCITY_FACTORS = ((1.0 - GAMMA) / GAMMA, 1.0)
"""Change of velocity behind each stage, over that in it."""
JUMP_FACTORS = (
    (0.5 / (GAMMA * (1.0 - GAMMA)), -1.0 / (1.0 - GAMMA)),
    (-0.5 / GAMMA**2, 2.0 / GAMMA),
)
"""Share of the command behind a jump in each stage, from its share `s` of the step.

The factors are those of `s²` and `s`. So the velocity and the position behind a step
are those of a force that jumps within it.
"""
MEAN_FACTORS = ((0.0, 1.0), (0.0, 1.0))
"""Those of commands whose mean over the step acts in both stages."""
MAX_DELAY = 0.3
"""Largest delay of the commands [s]."""


class ServoParameter(NamedTuple):
    """Parameter of a joint: symbol, meaning, unit, start, limits, scale.

    The unit is that of a joint that turns.
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
    ServoParameter("d", "delay", "s", 0.01, 0.0, MAX_DELAY, 0.01),
    ServoParameter("b", "bias / stiffness", "rad", 0.0, -1.0, 1.0, 0.01),
    ServoParameter("a", "1 / stiffness", "rad/(N m)", 0.0, 0.0, 100.0, 0.05),
    ServoParameter("F", "dry friction / stiffness", "rad", 0.01, 0.0, 1.0, 0.01),
    ServoParameter("mu", "friction per load", "1", 0.0, 0.0, 2.0, 0.3),
    ServoParameter("Fs", "Stribeck friction / stiffness", "rad", 0.0, 0.0, 1.0, 0.01),
    ServoParameter("vs", "Stribeck speed", "rad/s", 0.05, 3e-3, 2.0, 0.05),
    ServoParameter("um", "largest torque / stiffness", "rad", 1e3, 0.01, 1e4, 0.2),
    ServoParameter("g", "gain of the command", "1", 1.0, 0.5, 2.0, 0.1),
    ServoParameter("ki", "integral gain / stiffness", "1/s", 0.0, 0.0, 100.0, 1.0),
    ServoParameter("f", "velocity feed-forward / stiffness", "s", 0.0, 0.0, 1.0, 0.03),
)
"""Parameters of a joint, in the order of the arrays that hold them."""
INDEX = {parameter.symbol: k for k, parameter in enumerate(PARAMETERS)}
START, LOWER, UPPER, SCALE = (
    np.array([getattr(x, key) for x in PARAMETERS])
    for key in ("start", "lower", "upper", "scale")
)


class State(NamedTuple):
    """State of a joint: position, velocity, and integral action of its servo."""

    q: Any
    w: Any
    integral: Any


class StageInputs(NamedTuple):
    """Inputs of an implicit Euler stage, of which each step has two.

    Attributes:
        first_command: Delayed command in the first part of the step.
        second_command: That in the second part.
        first_share: Share of the first part.
        command_rate: Mean derivative of the command by time [1/s].
        load: Torque of the bodies [N m or N].
        inertia: Inertia of the bodies [kg m² or kg].
        share: Fraction of the step by which the position moves.
        ahead: Factor of the change of velocity with which the next stage starts.
        jump_factors: Those of the stage, as in `JUMP_FACTORS`.
    """

    first_command: Any
    second_command: Any
    first_share: Any
    command_rate: Any
    load: Any
    inertia: Any
    share: AnyArray
    ahead: AnyArray
    jump_factors: Any


def is_held_until_jump(state: State, theta: Array, inputs: StageInputs) -> Array:
    """Return whether dry friction holds a joint at rest until its command jumps.

    Args:
        state: State before the step.
        theta: Parameters, in the order of `PARAMETERS`.
        inputs: Inputs of the first stage.
    """
    _, _, _, b, a, F, mu, Fs, _, um, g, _, f = theta
    feed_forward = f * g * inputs.command_rate
    drive = g * inputs.first_command + b - state.q + state.integral + feed_forward
    load = a * inputs.load
    force = jnp.clip(drive, -um, um) - load
    is_at_rest = (state.w == 0.0) & (jnp.abs(force) <= F + mu * jnp.abs(load) + Fs)
    return is_at_rest & (inputs.first_command != inputs.second_command)


def advance_stage(
    state: State, theta: Array, inputs: StageInputs, is_held: Array, h: AnyArray
) -> State:
    """Return the state of a joint behind a stage.

    Args:
        state: State before the stage.
        theta: Parameters, in the order of `PARAMETERS`.
        inputs: Inputs of the stage.
        is_held: Whether dry friction holds the joint in the first part of the step.
        h: Time of a step [s].
    """
    J, B, _, b, a, F, mu, Fs, vs, um, g, ki, f = theta
    q, w, integral = state
    duration = GAMMA * h

    load = a * inputs.load
    integral_factor = 1.0 + ki * duration
    feed_forward = f * g * inputs.command_rate
    step_share = 1.0 - inputs.first_share
    square_factor, factor = inputs.jump_factors
    stage_share = (square_factor * step_share + factor) * step_share
    # While dry friction holds a joint, it balances all other forces.
    first_share = jnp.where(is_held, 0.0, 1.0 - stage_share)
    second_share = jnp.where(is_held, step_share, stage_share)

    def mean_of_parts(first: Array, second: Array) -> Array:
        return first_share * first + second_share * second

    def drive_of(command: Array) -> Array:
        return integral_factor * (g * command + b - q) + integral + feed_forward

    # A held command jumps within the step: the mean command would saturate otherwise.
    drives = drive_of(inputs.first_command), drive_of(inputs.second_command)
    force = mean_of_parts(*(jnp.clip(drive, -um, um) - load for drive in drives))
    friction = F + mu * jnp.abs(load) + Fs * jnp.exp(-((w / vs) ** 2))
    friction = mean_of_parts(friction, friction)

    # The position at the end of the stage counts in the error, unless it saturates.
    is_within = (jnp.where(jnp.abs(drive) < um, 1.0, 0.0) for drive in drives)
    servo_resistance = mean_of_parts(*is_within) * integral_factor * duration
    inertia = (J + a * inputs.inertia) / duration
    resistance = inertia + B + servo_resistance

    is_moving, direction = slip_of(
        force, inertia, friction, resistance, w, inputs.ahead
    )
    balance = force + inertia * w - friction * direction
    u = jnp.where(is_moving, balance / resistance, 0.0)
    # A joint that has stopped in the first stage starts the second one at rest.
    next_velocity = jnp.where(is_moving, w + inputs.ahead * (u - w), 0.0)
    step = inputs.share * h
    jump = inputs.first_command - inputs.second_command
    command = inputs.second_command + (1.0 - second_share) * jump
    error = g * command + b - q
    next_integral = integral + step * ki * (error - duration * u)
    return State(q + step * u, next_velocity, next_integral)

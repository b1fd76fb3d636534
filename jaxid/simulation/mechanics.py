"""Time steps of a robot with drives: bodies, rotors, friction together; its servo."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Hashable, Joints
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.projection_equation import (
    rigid_body_mass_matrix,
    solve_symmetric,
)
from jaxid.errors import InputError
from jaxid.program import to_python
from jaxid.program.sample_methods import program_of

from .friction_and_ripple import AbstractGearFriction, TorqueRipple

RATE_FILTER_TIME = 2e-3
"""Time constant of the low-pass of a servo's rates [s]."""


class DriveTrain(Hashable):
    """Bodies, rotors and friction over one time step; gears are rigid.

    The step is implicit where forces are stiff (friction) and of second order
    elsewhere: positions move by half a step, velocities by a whole one with the forces
    there, positions by the other half.
    """

    model: Model  # equations of motion without friction
    friction: AbstractGearFriction  # friction of the gears
    ripple: TorqueRipple | None  # ripple of the motor torques
    step: float  # length of a step [s]

    def inertia_and_bias(self, p, q, qd) -> AnyArray:
        """Return mass matrix, row by row, and bias forces of one sample (Eq. 38)."""
        model = self.model
        robot = model.robot
        M = model.inertia(p, q)
        h = model.bias(p, q, qd)
        if robot.tool is not None:
            bodies = np.zeros((robot.bodies, 10))
            bodies[robot.tool.body] = robot.tool.parameters
            M = M + rigid_body_mass_matrix(robot, jnp.asarray(bodies), q)
            h = h + model.known_forces(q, qd, jnp.zeros_like(q))
        return jnp.concatenate([M.ravel(), h])

    def advance(
        self,
        bodies: AnyArray,
        state: AnyArray,
        u: Joints,
    ) -> AnyArray:
        r"""Return the state after a step, and where to evaluate the bodies next.

        The state is $(q, \dot q, \ddot q)$ of the joints, and the deflections of the
        friction's bristles. Mass matrix and bias of the bodies are those half a step
        ahead, $u$ the torques of the drives during the step.
        """
        n = u.shape[0]
        dt = self.step
        M = bodies[: n * n].reshape(n, n)
        h = bodies[n * n :]
        q, qd, qdd, z = (state[k] for k in range(4))
        friction = self.friction.over_step(qd, qd + dt * qdd, z, dt)
        forces = u - friction.force
        if self.ripple is not None:
            forces = forces + self.ripple.forces(self.model.robot, q + 0.5 * dt * qd)

        # M (qd' - qd) / dt = forces - slope qd' - h, solved for the speed at the end.
        new_qd = solve_symmetric(
            M / dt + jnp.diag(friction.slope), M @ (qd / dt) + forces - h
        )
        new_q = q + 0.5 * dt * (qd + new_qd)
        new_qdd = (new_qd - qd) / dt
        new_z = friction.deflection + friction.deflection_slope * new_qd
        q_ahead = new_q + 0.5 * dt * new_qd
        qd_ahead = new_qd + 0.5 * dt * new_qdd
        return jnp.stack([new_q, new_qd, new_qdd, new_z, q_ahead, qd_ahead])


class SimulatedPlant:
    """One simulation of a robot, step by step; all numbers are on the joint side."""

    def __init__(self, drives: DriveTrain, parameters: AnyArray):
        n = drives.model.robot.joints
        p = np.asarray(parameters, np.float64)
        bodies = program_of(drives, drives.inertia_and_bias, p.shape, (n,), (n,))
        advance = program_of(drives, drives.advance, (n * n + n,), (4, n), (n,))
        self._bodies = to_python(bodies)
        self._advance = to_python(advance)
        self._drives = drives
        self._joints = n
        self._p = p.tolist()

    def start(self, q: Joints, qd: Joints, qdd: Joints) -> None:
        """Put the robot into a motion, with bent bristles."""
        half_step = 0.5 * self._drives.step
        z = np.asarray(self._drives.friction.settled(qd))
        next_state = [q + half_step * qd, qd + half_step * qdd]
        self._state = np.concatenate([q, qd, qdd, z, *next_state]).tolist()

    def step(self, u: Sequence[float]) -> None:
        """Move on by one step with constant torques of the drives [N m or N]."""
        n = self._joints
        state = self._state
        q_ahead = state[4 * n : 5 * n]
        qd_ahead = state[5 * n :]
        bodies = self._bodies(self._p, q_ahead, qd_ahead)
        self._state = self._advance(bodies, state[: 4 * n], u)

    def read(self) -> Sequence[float]:
        """Return positions, velocities, accelerations of the joints, in this order."""
        return self._state[: 3 * self._joints]


class Servo(eqx.Module):
    r"""Controller of every joint by itself, at a fixed rate.

    $u = Q_{m,d} + K_p e + K_d \dot e$ with the error $e$ of the encoder's angle. Its
    rate is a difference behind a first-order low-pass; $u$ is constant until the next
    tick.

    Attributes:
        proportional: $K_p$ [N m/rad or N/m].
        derivative: $K_d$ [N m s/rad or N s/m].
        sample_time: Time between two ticks [s].
    """

    proportional: Joints
    derivative: Joints
    sample_time: float = 1e-3


class ServoRun(NamedTuple):
    """True motion of the joints at the ticks of a servo, and the forces after each."""

    motion: Motion
    forces: np.ndarray


def follow(
    plant: Any,
    servo: Servo,
    desired: Motion,
    forward: AnyArray,
    limits: Joints,
    resolution: Joints,
    substeps: int,
) -> ServoRun:
    """Follow a motion by a servo, from its first sample without an error.

    Args:
        plant: Simulation: `start`, `step` and `read`.
        servo: Controller.
        desired: Desired motion at the ticks.
        forward: Forces that are fed forward [N m or N].
        limits: Largest forces of the drives [N m or N].
        resolution: Steps of the encoders [rad or m].
        substeps: Steps of the simulation in one tick.
    """
    n = forward.shape[1]
    joints = range(n)
    # Lists: for a few joints Python is faster on floats than on arrays.
    goals = np.asarray(desired.q).tolist()
    feed_forward = forward.tolist()
    kp, kd, limit, encoder_step = (
        np.asarray(x, np.float64).tolist()
        for x in (servo.proportional, servo.derivative, limits, resolution)
    )
    memory = float(np.exp(-servo.sample_time / RATE_FILTER_TIME))
    rate_gain = (1.0 - memory) / servo.sample_time

    first_sample = desired[0]
    plant.start(
        np.asarray(first_sample.q),
        np.asarray(first_sample.qd),
        np.asarray(first_sample.qdd),
    )
    states = []
    forces = []
    rate = [0.0] * n
    previous_error = [0.0] * n
    try:
        for goal, forward_forces in zip(goals, feed_forward, strict=True):
            state = plant.read()
            # The first tick has no error to compare with, and a constant error no rate.
            is_first = not states
            u = []
            for i in joints:
                angle = encoder_step[i] * round(state[i] / encoder_step[i])
                error = goal[i] - angle
                change = 0.0 if is_first else error - previous_error[i]
                rate[i] = memory * rate[i] + rate_gain * change
                previous_error[i] = error
                force = forward_forces[i] + kp[i] * error + kd[i] * rate[i]
                u.append(min(max(force, -limit[i]), limit[i]))
            states.append(list(state))
            forces.append(u)
            for _ in range(substeps):
                plant.step(u)
        states.append(list(plant.read()))
    except (ArithmeticError, ValueError) as failure:
        raise InputError(
            f"the simulated robot diverged after {len(forces) * servo.sample_time:g} "
            "s: make the `servo` softer or `substeps` larger, and check that the "
            "bodies are physically possible."
        ) from failure
    return _servo_run(states, forces)


def _servo_run(states: Sequence[Sequence[float]], forces: Sequence[Sequence[float]]):
    """Return the motion of a run from the states at all ticks and after the last."""
    q, qd, qdd = np.split(np.array(states), 3, axis=1)
    # Accelerations jump at a tick: the mean of before and after it.
    mean_qdd = 0.5 * (qdd[:-1] + qdd[1:])
    motion = Motion(q[:-1], qd[:-1], mean_qdd)
    return ServoRun(motion, np.array(forces))

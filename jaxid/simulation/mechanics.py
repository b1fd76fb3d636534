"""Time steps of a robot with drives: bodies, motors, gears and friction together; its servo."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Hashable, Joints
from jaxid.dynamics import projection_equation
from jaxid.dynamics.dispatch import program_of, solve_symmetric
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.program import to_python

from .friction_and_disturbances import AbstractDisturbance, AbstractGearFriction


class RigidGear(Hashable):
    """Rigid connection of a motor and its joint; others are subclasses.

    All numbers are on the joint side.
    """

    def transmit(
        self, twist: Joints, rate: Joints, inertia: Joints, drive: Joints, step: float
    ) -> tuple[Joints, Joints, Joints, Joints]:
        r"""Return the force over the next step, affine in the joint's speed $\dot q^+$ at its end.

        Motors have the momentum $a \dot\theta^+ = b - \tau$ there.

        Args:
            twist: Angle of the motor less that of the joint, at the step's start [rad
                or m].
            rate: Rate of the twist [rad/s or m/s].
            inertia: $a$, rotors and friction [N m s/rad or N s/m].
            drive: $b$, torques and momentum at the step's start [N m or N].
            step: Length of the step [s].

        Returns:
            $f$, $c$, $w$ and $s$: the force on the joint is $\tau = f - c\,\dot q^+$ [N
            m or N], while its motor turns at $\dot\theta^+ = w + s\,\dot q^+$ [rad/s or
            m/s].
        """
        none = 0.0 * drive
        return drive, inertia, none, none + 1.0

    def twist(self, forces: Joints) -> Joints:
        """Return the twist of the gears under constant forces on the joints [rad or m]."""
        return 0.0 * forces


class FlexibleGear(RigidGear):
    """Spring with a damper between motor and joint (Spong, 1987), with backlash if there is play.

    Attributes:
        stiffness: Stiffness [N m/rad or N/m].
        damping: Damping while the flanks touch [N m s/rad or N s/m].
        play: Play from flank to flank; none if None [rad or m].
    """

    stiffness: Joints
    damping: Joints
    play: Joints | None = None

    def transmit(self, twist, rate, inertia, drive, step):
        """Return the mean of the spring's force at both ends of the step, which damps nothing."""
        slope = 0.25 * step * self.stiffness + 0.5 * self.damping
        if self.play is None:
            force = self.stiffness * twist + slope * rate
        else:
            # The spring acts on one of the flanks, or not at all between them.
            ahead, half = twist + 0.5 * step * rate, 0.5 * self.play
            touches = jnp.abs(ahead) > half
            force = self.stiffness * (twist - jnp.sign(ahead) * half) + slope * rate
            none = jnp.zeros_like(force)
            force, slope = (
                jnp.where(touches, force, none),
                jnp.where(touches, slope, none),
            )
        # The motor's speed is eliminated from the force f + c (theta' - q').
        speed = (drive - force) / (inertia + slope)
        ratio = slope / (inertia + slope)
        return force + slope * speed, slope * (1.0 - ratio), speed, ratio

    def twist(self, forces):
        """Return the force divided by the stiffness, and half of the play."""
        bent = forces / self.stiffness
        return bent if self.play is None else bent + 0.5 * self.play * jnp.sign(forces)


class DriveTrain(Hashable):
    """Bodies, motors, gears and friction over one time step.

    The step is implicit where forces are stiff (friction, gears) and of second order
    elsewhere: positions move by half a step, velocities by a whole one with the forces
        there, positions by the
    other half.
    """

    model: Model  # equations of motion without friction
    rotors: Joints  # inertia of the rotors on the joint side [kg m² or kg]
    friction: AbstractGearFriction  # friction of the gears, on the motors' side of them
    gear: RigidGear  # gears between motors and joints
    disturbances: tuple[AbstractDisturbance, ...]  # further forces on the motors
    step: float  # length of a step [s]

    def inertia_and_bias(self, p, q, qd) -> Float[AnyArray, " entries"]:
        """Return mass matrix, row by row, and bias forces of one sample (Eq. 38)."""
        model, tool = self.model, self.model.robot.tool
        M, h = model.inertia(p, q), model.bias(p, q, qd)
        if tool is not None:
            known = np.zeros((model.robot.joints, 10))
            known[tool.body] = tool.parameters
            M = M + projection_equation.rigid_body_mass_matrix(
                model.robot, jnp.asarray(known), q
            )
            h = h + model.known_forces(q, qd, jnp.zeros_like(q))
        return jnp.concatenate([M.ravel(), h])

    def advance(
        self,
        bodies: Float[AnyArray, " entries"],
        state: Float[AnyArray, "7 joints"],
        u: Joints,
    ) -> Float[AnyArray, "9 joints"]:
        r"""Return the state after a step, and where mass matrix and bias are needed for the next.

        The state is $(q, \dot q, \ddot q)$ of the joints, the same of the motors on the
        joint side, and the deflections of the friction's bristles. Mass matrix and bias
        of the bodies are those half a step ahead, $u$ the torques of the drives during
        the step.
        """
        n, dt = u.shape[0], self.step
        M, h = bodies[: n * n].reshape(n, n), bodies[n * n :]
        q, qd, theta, w, wd, z = (state[k] for k in (0, 1, 3, 4, 5, 6))
        rub, damping, bent, bending = self.friction.over_step(w, w + dt * wd, z, dt)
        acting = u - rub
        halfway = theta + 0.5 * dt * w, w + 0.5 * dt * wd
        for disturbance in self.disturbances:
            acting = acting + disturbance.forces(self.model.robot, *halfway)
        inertia, drive = self.rotors / dt + damping, self.rotors / dt * w + acting
        force, slope, speed, ratio = self.gear.transmit(
            theta - q, w - qd, inertia, drive, dt
        )
        M = M - jnp.diag(self.rotors)
        new_qd = solve_symmetric(M / dt + jnp.diag(slope), M @ (qd / dt) + force - h)
        new_w = speed + ratio * new_qd
        new_q = q + 0.5 * dt * (qd + new_qd)
        new_theta = theta + 0.5 * dt * (w + new_w)
        new_qdd, new_wd = (new_qd - qd) / dt, (new_w - w) / dt
        new_z = bent + bending * new_w
        return jnp.stack(
            [
                *(new_q, new_qd, new_qdd, new_theta, new_w, new_wd, new_z),
                new_q + 0.5 * dt * new_qd,
                new_qd + 0.5 * dt * new_qdd,
            ]
        )


class SimulatedPlant:
    """One simulation of a robot, step by step; all numbers are on the joint side."""

    def __init__(self, drives: DriveTrain, parameters: Float[AnyArray, " standard"]):
        n = drives.model.robot.joints
        p = np.asarray(parameters, np.float64)
        bodies = program_of(drives, drives.inertia_and_bias, p.shape, (n,), (n,))
        self._bodies = to_python(bodies)
        self._advance = to_python(
            program_of(drives, drives.advance, (n * n + n,), (7, n), (n,))
        )
        self._drives, self._joints, self._p = drives, n, p.tolist()

    def start(self, q: Joints, qd: Joints, qdd: Joints) -> None:
        """Put the robot into a motion, with twisted gears and bent bristles."""
        q, qd, qdd = (np.asarray(x, np.float64) for x in (q, qd, qdd))
        n, dt, drives = self._joints, self._drives.step, self._drives
        entries = np.array(self._bodies(self._p, q.tolist(), qd.tolist()))
        M = entries[: n * n].reshape(n, n) - np.diag(np.asarray(drives.rotors))
        theta = q + np.asarray(drives.gear.twist(M @ qdd + entries[n * n :]))
        z = np.asarray(drives.friction.settled(qd))
        halfway = q + 0.5 * dt * qd, qd + 0.5 * dt * qdd
        self._state = np.concatenate([q, qd, qdd, theta, qd, qdd, z, *halfway]).tolist()

    def step(self, u: Sequence[float]) -> None:
        """Move on by one step with constant torques of the drives [N m or N]."""
        n, state = self._joints, self._state
        bodies = self._bodies(self._p, state[7 * n : 8 * n], state[8 * n :])
        self._state = self._advance(bodies, state[: 7 * n], u)

    def read(self) -> tuple[Sequence[float], Sequence[float]]:
        """Return angles of the motors; positions, velocities, accelerations of the joints."""
        n = self._joints
        return self._state[3 * n : 4 * n], self._state[: 3 * n]


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


def follow(
    plant: Any,
    servo: Servo,
    desired: Motion,
    forward: np.ndarray,
    limits: Joints,
    resolution: Joints,
    substeps: int,
) -> tuple[Motion, np.ndarray, np.ndarray]:
    """Return true motion, motor angles, and forces after each tick of a servo from no error."""
    ticks, n = forward.shape
    goals, known = np.asarray(desired.q).tolist(), forward.tolist()
    kp, kd, limit, step = (
        np.asarray(x, np.float64).tolist()
        for x in (servo.proportional, servo.derivative, limits, resolution)
    )
    keep = float(np.exp(-servo.sample_time / 2e-3))
    gain = (1.0 - keep) / servo.sample_time
    joints = range(n)
    plant.start(*(np.asarray(x)[0] for x in (desired.q, desired.qd, desired.qdd)))
    motors, motion, forces = [], [], []
    last, rate = None, [0.0] * n
    try:
        for k in range(ticks):
            (angles, state), goal = plant.read(), goals[k]
            error = [goal[i] - step[i] * round(angles[i] / step[i]) for i in joints]
            # The first tick has no error to compare with, and a constant error no rate.
            before = error if last is None else last
            rate = [keep * rate[i] + gain * (error[i] - before[i]) for i in joints]
            u = [known[k][i] + kp[i] * error[i] + kd[i] * rate[i] for i in joints]
            u = [min(max(u[i], -limit[i]), limit[i]) for i in joints]
            last = error
            motors.append(list(angles))
            motion.append(list(state))
            forces.append(u)
            for _ in range(substeps):
                plant.step(u)
    except (ArithmeticError, ValueError) as failure:
        raise InputError(
            f"the simulated robot diverged after {len(forces) * servo.sample_time:g} "
            "s: make the "
            "`servo` softer or `substeps` larger, and check that the bodies can exist."
        ) from failure
    q, qd, qdd = np.split(np.array(motion), 3, axis=1)
    after = np.concatenate([qdd[1:], np.array(plant.read()[1]).reshape(3, n)[2:]])
    return Motion(q, qd, 0.5 * (qdd + after)), np.array(motors), np.array(forces)

"""One time step of a robot with drives: bodies, motors, gears and friction, solved together."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Hashable
from jaxid.dynamics import projection
from jaxid.dynamics.dispatch import program_of, solve_symmetric
from jaxid.dynamics.model import Model
from jaxid.program import to_python
from jaxid.simulation.experiment import AbstractPlant
from jaxid.simulation.friction import AbstractDisturbance, AbstractGearFriction

Joints = Float[AnyArray, " joints"]


class MotorMomentum(NamedTuple):
    r"""Momentum of the motors over a step: $a \dot\theta^+ = b - \tau$.

    Attributes:
        inertia: $a$, rotors and friction [N m s/rad or N s/m].
        drive: $b$, torques and momentum at the step's start [N m or N].
    """

    inertia: Joints
    drive: Joints


class GearForce(NamedTuple):
    r"""Force on a joint $\tau = f - c\,\dot q^+$, while its motor turns at $w + s\,\dot q^+$.

    Attributes:
        force: $f$ [N m or N].
        slope: $c$ [N m s/rad or N s/m].
        speed: $w$ [rad/s or m/s].
        ratio: $s$.
    """

    force: Joints
    slope: Joints
    speed: Joints
    ratio: Joints


class AbstractGear(Hashable):
    """Gear between a motor and its joint, with all numbers on the joint side."""

    @abstractmethod
    def transmit(
        self, twist: Joints, rate: Joints, motors: MotorMomentum, step: float
    ) -> GearForce:
        """Return the force over the next step, affine in the joint's speed at its end.

        Args:
            twist: Angle of the motor less that of the joint, at the step's start [rad or m].
            rate: Rate of the twist [rad/s or m/s].
            motors: Momentum of the motors.
            step: Length of the step [s].
        """

    @abstractmethod
    def twist(self, forces: Joints) -> Joints:
        """Return the twist of the gears under constant forces [rad or m].

        Args:
            forces: Forces on the joints [N m or N].
        """


class RigidGear(AbstractGear):
    """Rigid connection of motor and joint."""

    def transmit(self, twist, rate, motors, step):
        """Return what the motor does not need itself."""
        none = 0.0 * motors.drive
        return GearForce(motors.drive, motors.inertia, none, none + 1.0)

    def twist(self, forces):
        """Return zeros."""
        return 0.0 * forces


class FlexibleGear(AbstractGear):
    """Spring with a damper between motor and joint (Spong, 1987).

    Attributes:
        stiffness: Stiffness [N m/rad or N/m].
        damping: Damping [N m s/rad or N s/m].
    """

    stiffness: Joints
    damping: Joints

    def transmit(self, twist, rate, motors, step):
        """Return the mean of the spring's force at both ends of the step, which damps nothing."""
        slope = 0.25 * step * self.stiffness + 0.5 * self.damping
        return _eliminate_motor(self.stiffness * twist + slope * rate, slope, motors)

    def twist(self, forces):
        """Return the force divided by the stiffness."""
        return forces / self.stiffness


class BacklashGear(AbstractGear):
    """Spring with a damper and backlash.

    Attributes:
        stiffness: Stiffness [N m/rad or N/m].
        damping: Damping while the flanks touch [N m s/rad or N s/m].
        play: Play from flank to flank [rad or m].
    """

    stiffness: Joints
    damping: Joints
    play: Joints

    def transmit(self, twist, rate, motors, step):
        """Return the force of the spring on one of the flanks, or zero between them."""
        ahead = twist + 0.5 * step * rate
        half = 0.5 * self.play
        slope = 0.25 * step * self.stiffness + 0.5 * self.damping
        touches = jnp.abs(ahead) > half
        force = self.stiffness * (twist - jnp.sign(ahead) * half) + slope * rate
        none = jnp.zeros_like(force)
        force, slope = jnp.where(touches, force, none), jnp.where(touches, slope, none)
        return _eliminate_motor(force, slope, motors)

    def twist(self, forces):
        """Return half of the play and the force divided by the stiffness."""
        return forces / self.stiffness + 0.5 * self.play * jnp.sign(forces)


def _eliminate_motor(force: Joints, slope: Joints, motors: MotorMomentum) -> GearForce:
    r"""Eliminate the motor's speed from $\tau = f + c (\dot\theta^+ - \dot q^+)$.

    Args:
        force: $f$ [N m or N].
        slope: $c$ [N m s/rad or N s/m].
        motors: Momentum of the motors.
    """
    speed = (motors.drive - force) / (motors.inertia + slope)
    ratio = slope / (motors.inertia + slope)
    return GearForce(force + slope * speed, slope * (1.0 - ratio), speed, ratio)


class DriveTrain(Hashable):
    """Bodies, motors, gears and friction over one time step.

    The step is implicit where forces are stiff (friction, gears) and of second order elsewhere:
    positions move by half a step, velocities by a whole one with the forces there, positions by the
    other half.

    Attributes:
        model: Equations of motion without friction.
        rotors: Inertia of the rotors on the joint side [kg m² or kg].
        friction: Friction of the gears, on the motors' side of them.
        gear: Gears between motors and joints.
        disturbances: Further forces on the motors.
        step: Length of a step [s].
    """

    model: Model
    rotors: Joints
    friction: AbstractGearFriction
    gear: AbstractGear
    disturbances: tuple[AbstractDisturbance, ...]
    step: float

    def inertia_and_bias(self, p, q, qd) -> Float[AnyArray, " entries"]:
        """Return mass matrix, row by row, and bias forces of one sample (Eq. 38)."""
        model, tool = self.model, self.model.robot.tool
        M, h = model.inertia(p, q), model.bias(p, q, qd)
        if tool is not None:
            known = np.zeros((model.robot.joints, 10))
            known[tool.body] = tool.parameters
            M = M + projection.rigid_body_mass_matrix(model.robot, jnp.asarray(known), q)
            h = h + model.known_forces(q, qd, jnp.zeros_like(q))
        return jnp.concatenate([M.ravel(), h])

    def advance(
        self, bodies: Float[AnyArray, " entries"], state: Float[AnyArray, "7 joints"], u: Joints
    ) -> Float[AnyArray, "9 joints"]:
        r"""Return the state after a step, and where mass matrix and bias are needed for the next.

        The state is $(q, \dot q, \ddot q)$ of the joints, the same of the motors on the joint side,
        and the deflections of the friction's bristles.

        Args:
            bodies: Mass matrix, row by row, and bias forces half a step ahead.
            state: State at the start.
            u: Torques of the drives during the step, on the joint side [N m or N].
        """
        n, dt = u.shape[0], self.step
        M, h = bodies[: n * n].reshape(n, n), bodies[n * n :]
        q, qd, theta, w, wd, z = (state[k] for k in (0, 1, 3, 4, 5, 6))
        law = self.friction.over_step(w, w + dt * wd, z, dt)
        acting = u - law.force
        halfway = theta + 0.5 * dt * w, w + 0.5 * dt * wd
        for disturbance in self.disturbances:
            acting = acting + disturbance.forces(self.model.robot, *halfway)
        motors = MotorMomentum(self.rotors / dt + law.slope, self.rotors / dt * w + acting)
        gear = self.gear.transmit(theta - q, w - qd, motors, dt)
        M = M - jnp.diag(self.rotors)
        new_qd = solve_symmetric(M / dt + jnp.diag(gear.slope), M @ (qd / dt) + gear.force - h)
        new_w = gear.speed + gear.ratio * new_qd
        new_q = q + 0.5 * dt * (qd + new_qd)
        new_theta = theta + 0.5 * dt * (w + new_w)
        new_qdd, new_wd = (new_qd - qd) / dt, (new_w - w) / dt
        new_z = law.deflection + law.rate * new_w
        return jnp.stack(
            [
                *(new_q, new_qd, new_qdd, new_theta, new_w, new_wd, new_z),
                new_q + 0.5 * dt * new_qd,
                new_qd + 0.5 * dt * new_qdd,
            ]
        )


class SimulatedPlant(AbstractPlant):
    """One simulation of a robot, step by step.

    Args:
        drives: Bodies, motors, gears and friction.
        parameters: Parameters of the equations of motion.
    """

    def __init__(self, drives: DriveTrain, parameters: Float[AnyArray, " standard"]):
        n = drives.model.robot.joints
        p = np.asarray(parameters, np.float64)
        bodies = program_of(drives, drives.inertia_and_bias, p.shape, (n,), (n,))
        self._bodies = to_python(bodies)
        self._advance = to_python(program_of(drives, drives.advance, (n * n + n,), (7, n), (n,)))
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
        self._set(np.concatenate([q, qd, qdd, theta, qd, qdd, z, *halfway]).tolist())

    def _set(self, state: Sequence[float]) -> None:
        n = self._joints
        self._state, self._q, self._qd = (
            list(state[a * n : b * n]) for a, b in ((0, 7), (7, 8), (8, 9))
        )

    def step(self, u: Sequence[float]) -> None:
        """Move on by one step with constant torques of the drives [N m or N]."""
        bodies = self._bodies(self._p, self._q, self._qd)
        self._set(self._advance(bodies, self._state, u))

    def read(self) -> tuple[list[float], list[float]]:
        """Return angles of the motors; positions, velocities, accelerations of the joints."""
        n = self._joints
        return self._state[3 * n : 4 * n], self._state[: 3 * n]

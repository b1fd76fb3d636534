"""One step of time of a robot with drives: bodies, motors, gears and friction, solved at once."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Hashable
from jaxid.dynamics import projection
from jaxid.dynamics.machine import program_of
from jaxid.dynamics.model import Model
from jaxid.dynamics.solve import solve_symmetric
from jaxid.program import to_python, trace
from jaxid.robot.robot import Robot
from jaxid.simulation.disturbances import AbstractDisturbance
from jaxid.simulation.gear_friction import AbstractGearFriction
from jaxid.simulation.gears import AbstractGear, Balance, Shafts
from jaxid.simulation.tracking import AbstractPlant

Joints = Float[AnyArray, " joints"]


class Bodies(Hashable):
    """A model without friction, whose known tool belongs to it.

    Attributes:
        model: Its equations of motion.
    """

    model: Model

    def inertia_and_bias(self, p, q, qd) -> Float[AnyArray, " entries"]:
        """Mass matrix, row by row, and bias forces of one sample (Eq. 38)."""
        robot, rest = self.model.robot, jnp.zeros_like(q)
        M = self.model.inertia(p, q)
        h = self.model.bias(p, q, qd)
        if robot.tool is not None:
            known = np.zeros((robot.joints, 10))
            known[robot.tool.body] = robot.tool.parameters
            M = M + projection.rigid_body_mass_matrix(robot, jnp.asarray(known), q)
            h = h + self.model.known_forces(q, qd, rest)
        return jnp.concatenate([M.ravel(), h])


class DriveTrain(Hashable):
    """What turns torques of the motors into motion, given mass matrix and bias forces.

    The step is implicit where forces are stiff (friction, gears) and of second order elsewhere:
    positions move by half a step, velocities by a whole one with what acts there, positions by
    the other half.

    Attributes:
        robot: With its gears' ratios.
        rotors: Inertia of the rotors on the joints' side [kg m² or kg].
        friction: Of the gears, felt by the motors.
        gear: Between motors and joints.
        disturbances: What else drives the motors.
        step: Length of a step [s].
    """

    robot: Robot
    rotors: Joints
    friction: AbstractGearFriction
    gear: AbstractGear
    disturbances: tuple[AbstractDisturbance, ...]
    step: float

    def resistance(self, q: Joints, qd: Joints) -> Joints:
        """What drives need beside the bodies' forces, at speeds that last [N m or N]."""
        forces = self.friction.steady(qd)
        for disturbance in self.disturbances:
            forces = forces - disturbance.forces(self.robot, q, qd)
        return forces

    def advance(
        self, bodies: Float[AnyArray, " entries"], state: Float[AnyArray, "7 joints"], u: Joints
    ) -> Float[AnyArray, "9 joints"]:
        r"""The state after a step, and where mass matrix and bias are needed for the next.

        The state is $(q, \dot q, \ddot q)$ of the joints, the same of the motors on the joints'
        side, and the deflections of the friction's bristles.

        Args:
            bodies: Mass matrix, row by row, and bias forces half a step ahead.
            state: At the start.
            u: Torques of the drives during the step, on the joints' side [N m or N].
        """
        n, dt = u.shape[0], self.step
        M, h = bodies[: n * n].reshape(n, n), bodies[n * n :]
        q, qd, theta, w, wd, z = (state[k] for k in (0, 1, 3, 4, 5, 6))
        law = self.friction.over_step(w, w + dt * wd, z, dt)
        acting = u - law.force
        halfway = theta + 0.5 * dt * w, w + 0.5 * dt * wd
        for disturbance in self.disturbances:
            acting = acting + disturbance.forces(self.robot, *halfway)
        motors = Balance(self.rotors / dt + law.slope, self.rotors / dt * w + acting)
        felt = self.gear.transmit(Shafts(theta - q, w - qd), motors, dt)
        M = M - jnp.diag(self.rotors)
        new_qd = solve_symmetric(M / dt + jnp.diag(felt.slope), M @ (qd / dt) + felt.force - h)
        new_w = felt.speed + felt.share * new_qd
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
    """A robot that moves when its drives push: the state of one simulation, step by step.

    Args:
        model: Its equations of motion without friction.
        parameters: The model's.
        drives: What moves it.
    """

    def __init__(self, model: Model, parameters: Float[AnyArray, " standard"], drives: DriveTrain):
        n = model.robot.joints
        bodies = Bodies(model)
        shapes = (parameters.shape, (n,), (n,))
        self._bodies = to_python(program_of(bodies, bodies.inertia_and_bias, *shapes))
        self._advance = to_python(trace(drives.advance, (n * n + n,), (7, n), (n,)))
        self._model, self._drives, self._joints = model, drives, n
        self._p = np.asarray(parameters).tolist()

    def start(self, q: Joints, qd: Joints, qdd: Joints) -> None:
        """Puts the robot into a motion, with gears wound up and bristles bent as it asks for."""
        q, qd, qdd = (np.asarray(x, np.float64) for x in (q, qd, qdd))
        n, dt, drives = self._joints, self._drives.step, self._drives
        found = np.array(self._bodies(self._p, q.tolist(), qd.tolist()))
        rotors = np.asarray(drives.rotors)
        forces = (found[: n * n].reshape(n, n) - np.diag(rotors)) @ qdd + found[n * n :]
        theta = q + np.asarray(drives.gear.twist(forces))
        z = np.asarray(drives.friction.settled(qd))
        halfway = q + 0.5 * dt * qd, qd + 0.5 * dt * qdd
        self._set(np.concatenate([q, qd, qdd, theta, qd, qdd, z, *halfway]).tolist())

    def _set(self, state: Sequence[float]) -> None:
        n = self._joints
        self._state, self._q, self._qd = (
            list(state[a * n : b * n]) for a, b in ((0, 7), (7, 8), (8, 9))
        )

    def step(self, u: Sequence[float]) -> None:
        """Moves on by one step with constant torques of the drives [N m or N]."""
        bodies = self._bodies(self._p, self._q, self._qd)
        self._set(self._advance(bodies, self._state, u))

    def read(self) -> tuple[list[float], list[float]]:
        """Angles of the motors; positions, velocities, accelerations of the joints."""
        n = self._joints
        return self._state[3 * n : 4 * n], self._state[: 3 * n]

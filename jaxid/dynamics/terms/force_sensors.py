"""Terms of force sensors: what is wrong with the wrench that a sensor measures."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics import projection_equation
from jaxid.robot.rotations import skew
from jaxid.robot.virtual_joints import FORCE_NAMES, GROUP

from .term import AbstractTerm

USUAL_LOAD = (1.0, 0.01, 0.02, 0.05, 0.01, 0.01, 0.01, 0.0, 0.0, 0.0)
"""Load by which the effect of a rotation is told apart from that of others."""


class SensorBias(AbstractTerm):
    """A constant wrench that a force sensor adds: `bfx8`, … `bmz8` [N, N m].

    The number is that of the body behind the sensor.
    """

    is_of_sensors = True

    @property
    def meanings(self):
        """Meanings of the six numbers of a sensor."""
        words = [f"force along {x}" for x in "xyz"] + [
            f"moment about {x}" for x in "xyz"
        ]
        pairs = zip(FORCE_NAMES, words, strict=True)
        return {f"b{name}": f"bias of the sensor, {text}" for name, text in pairs}

    def parameters(self, robot):
        """Return names and units: forces, then moments, of each sensor."""
        names = []
        for k, joint in enumerate(robot.rigid):
            name = f"b{FORCE_NAMES[k % GROUP]}{robot.numbers[joint]}"
            names.append((name, robot.force_unit(joint)))
        return tuple(names)

    def columns(self, robot, q, qd, qdd):
        """Return ones in the rows of the sensors."""
        return jnp.eye(robot.joints, dtype=q.dtype)[:, np.array(robot.rigid)]


class SensorRotation(AbstractTerm):
    """A small rotation of the wrist's force sensor: `rx8`, `ry8`, `rz8` [rad].

    Rotations about the sensor's own axes, against the attitude in the description. The
    forces are linear in them for a load that is known nearly:
    the load is that of an earlier fit.

    Attributes:
        load: Ten parameters of all bodies behind the sensor.
    """

    load: Float[AnyArray, "10"] = eqx.field(converter=np.asarray, default=USUAL_LOAD)
    is_of_sensors = True

    @property
    def meanings(self):
        """Meanings of the three angles."""
        return {f"r{x}": f"rotation of the sensor about its {x} axis" for x in "xyz"}

    def parameters(self, robot):
        """Return names and units of the three angles."""
        number = robot.numbers[robot.rigid[-1]]
        return tuple((f"r{x}{number}", "rad") for x in "xyz")

    def columns(self, robot, q, qd, qdd):
        """Return the change of the load's wrench for each unit rotation."""
        rows = np.array(robot.rigid[-GROUP:])
        bodies: list[AnyArray] = [np.zeros(10)] * robot.bodies
        bodies[rows[-1]] = self.load
        forces = projection_equation.rigid_body_forces(
            robot, jnp.stack(bodies), q, qd, qdd
        )
        force, moment = forces[rows].reshape(2, 3)
        turned_wrench = jnp.concatenate([skew(force), skew(moment)])
        return jnp.zeros((robot.joints, 3), q.dtype).at[rows].set(turned_wrench)

"""Friction beyond viscous and dry: laws whose shapes are numbers that data can tell.

For given shapes they are terms like all others. `identify_nonlinear` finds the shapes.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, matching, one_or_each
from jaxid.dynamics import projection
from jaxid.dynamics.terms import AbstractTerm, each_joint
from jaxid.dynamics.transitions import AbstractTransition, Shape, Tanh
from jaxid.errors import InputError
from jaxid.robot.inertia import INERTIAL_NAMES
from jaxid.robot.robot import Robot

TINY = 1e-30
"""Keeps the logarithm of a standstill finite."""


class StribeckFriction(AbstractTerm):
    r"""Dry friction that falls from a static level to Coulomb's as a joint gets moving.

    $(f_c + f_s e^{-|\dot q / v_s|^\delta}) \tanh(\dot q / \epsilon)$ with $f_c$ and $f_s$ unknown.
    It takes the place of `CoulombFriction`. (Armstrong-Hélouvry, Dupont and Canudas de Wit, 1994.)

    Attributes:
        speed: Stribeck's speed $v_s$, one for all joints or one for each [rad/s or m/s].
        exponent: The $\delta$, likewise [1].
        transition: From one direction of motion to the other.
    """

    speed: float | Float[AnyArray, "..."] = eqx.field(converter=one_or_each, default=0.1)
    exponent: float | Float[AnyArray, "..."] = eqx.field(converter=one_or_each, default=2.0)
    transition: AbstractTransition = Tanh()

    def parameters(self, robot):
        """`fc1`, … at speed, then `fs1`, … that comes to it near standstill [N m or N]."""
        return (*each_joint(robot, "fc", "N m", "N"), *each_joint(robot, "fs", "N m", "N"))

    def columns(self, robot, q, qd, qdd):
        """The diagonal matrices of smooth signs, and of those that fade with speed."""
        sign = self.transition(qd)
        relative = qd / matching("speed", self.speed, qd)
        power = 0.5 * matching("exponent", self.exponent, qd) * jnp.log(relative**2 + TINY)
        return jnp.concatenate([jnp.diag(sign), jnp.diag(sign * jnp.exp(-jnp.exp(power)))], axis=1)

    def lower_bounds(self, robot):
        """Friction brakes at speed; near standstill it may be less or more."""
        n = robot.joints
        return np.concatenate([np.zeros(n), np.full(n, -np.inf)])

    @property
    def shapes(self):
        """`vs1`, … [rad/s or m/s]; `delta1`, … if asked for; and those of the transition."""
        return (
            *(s.below("transition") for s in self.transition.shapes),
            Shape("vs", ("rad/s", "m/s"), ("speed",)),
            Shape("delta", ("1", "1"), ("exponent",), wanted=False),
        )


class AsymmetricViscousFriction(AbstractTerm):
    """Friction that grows with speed, at one rate for each direction of motion.

    It takes the place of `ViscousFriction`.
    """

    def parameters(self, robot):
        """`fvp1`, … for positive, then `fvn1`, … for negative speeds [N m s/rad or N s/m]."""
        return (
            *each_joint(robot, "fvp", "N m s", "N s/m"),
            *each_joint(robot, "fvn", "N m s", "N s/m"),
        )

    def columns(self, robot, q, qd, qdd):
        """The diagonal matrices of speeds in either direction."""
        size = jnp.abs(qd)
        return jnp.concatenate([jnp.diag(0.5 * (qd + size)), jnp.diag(0.5 * (qd - size))], axis=1)

    def lower_bounds(self, robot):
        """Friction brakes in both directions."""
        return np.zeros(2 * robot.joints)


class LoadFriction(AbstractTerm):
    r"""Dry friction in proportion to the weight on a joint, $|g_i(q)| \tanh(\dot q_i / \epsilon)$.

    It comes to `CoulombFriction`. The load is that of gravity alone, so that forces stay linear in
    the accelerations, and follows from bodies that are known roughly: from CAD, or from an earlier
    fit without this term (`LoadFriction.of`).

    Attributes:
        bodies: The bodies' parameters, each ten in the paper's order.
        transition: From one direction of motion to the other.
    """

    bodies: Float[AnyArray, "joints 10"]
    transition: AbstractTransition = Tanh()

    @classmethod
    def of(
        cls,
        robot: Robot,
        standard_parameters: Float[AnyArray, " standard"],
        transition: AbstractTransition | None = None,
    ) -> "LoadFriction":
        """Takes the load from standard parameters that begin with ten for each body.

        Args:
            robot: The robot.
            standard_parameters: Such as a fit's, of a model whose first term is `RigidBodies`.
            transition: From one direction of motion to the other.

        Raises:
            InputError: If they are fewer than ten for each body.
        """
        size = robot.joints * len(INERTIAL_NAMES)
        p = np.asarray(standard_parameters, np.float64)
        if p.ndim != 1 or len(p) < size:
            raise InputError(
                f"`standard_parameters` must begin with ten numbers for each body ({size}), but "
                f"has shape {p.shape}."
            )
        bodies = p[:size].reshape(robot.joints, -1)
        return cls(bodies, Tanh() if transition is None else transition)

    def parameters(self, robot):
        """`fl1`, …: friction for each unit of load [1]."""
        return each_joint(robot, "fl", "1", "1")

    def columns(self, robot, q, qd, qdd):
        """The diagonal matrix of loads with the signs of the speeds."""
        rest = jnp.zeros_like(q)
        bodies = jnp.asarray(self.bodies, q.dtype)
        load = projection.rigid_body_forces(robot, bodies, q, rest, rest)
        return jnp.diag(jnp.abs(load) * self.transition(qd))

    def lower_bounds(self, robot):
        """Friction brakes."""
        return np.zeros(robot.joints)

    @property
    def shapes(self):
        """Those of the transition, if asked for: `CoulombFriction` finds them better."""
        return tuple(s.below("transition")._replace(wanted=False) for s in self.transition.shapes)


class TemperatureScaled(AbstractTerm):
    r"""Friction that falls as the joints get warm: another term times $e^{-a (T - T_0)}$.

    The parameters are those at the temperature $T_0$.

    Attributes:
        term: The friction.
        rate: The $a$, one for all joints or one for each [1/K].
        temperature: At which the model is used, one for all joints or one for each [°C].
        reference: The $T_0$ [°C].
    """

    term: AbstractTerm
    rate: float | Float[AnyArray, "..."] = 0.01
    temperature: float | Float[AnyArray, "..."] = 25.0
    reference: float = eqx.field(static=True, default=25.0)

    def parameters(self, robot):
        """Those of the term."""
        return self.term.parameters(robot)

    def columns(self, robot, q, qd, qdd):
        """Those of the term, scaled joint by joint."""
        warmer = jnp.asarray(self.temperature, qd.dtype) - self.reference
        scale = jnp.broadcast_to(jnp.exp(-self.rate * warmer), qd.shape)
        return scale[:, None] * self.term.columns(robot, q, qd, qdd)

    def lower_bounds(self, robot):
        """Those of the term."""
        return self.term.lower_bounds(robot)

    def drive_matrices(self, robot):
        """Those of the term: temperature scales them by a positive number."""
        return self.term.drive_matrices(robot)

    @property
    def shapes(self):
        """Those of the term, and `rate1`, … [1/K] if asked for: one recording does not tell."""
        inner = (s.below("term") for s in self.term.shapes)
        return (*inner, Shape("rate", ("1/K", "1/K"), ("rate",), wanted=False))

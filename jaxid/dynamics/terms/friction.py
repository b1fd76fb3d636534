"""Friction of joints: terms that depend on speed, load and temperature."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, matching, one_or_each
from jaxid.dynamics import projection_equation
from jaxid.errors import InputError
from jaxid.robot.inertia import INERTIAL_NAMES
from jaxid.robot.joint_coordinates import speed_ratios
from jaxid.robot.robot import Robot

from .dry_friction_transitions import (
    USUAL_SPEED,
    AbstractTransition,
    EachJoint,
    Tanh,
)
from .term import AbstractTerm, JointParameter, on_drives


class AbstractDryFriction(AbstractTerm):
    """Friction with a `transition` from one direction of motion to the other."""

    transition: eqx.AbstractVar[AbstractTransition]

    @classmethod
    def with_transition(cls, transition):
        """Return the term with a transition, and defaults of all else."""
        return cls(transition=transition)


class ViscousFriction(AbstractTerm):
    r"""Friction `fv1`, … with speed, $\mathrm{diag}\{\dot q_i\}$ (Eq. 13)."""

    joint_parameters = (
        JointParameter(
            "fv", "viscous friction: grows with speed", ("N m s", "N s/m"), "viscous"
        ),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of speeds."""
        return on_drives(robot, qd)


class AsymmetricViscousFriction(AbstractTerm):
    """Friction that grows with speed, at one rate for each direction of motion.

    It takes the place of `ViscousFriction`. Its parameters are `fvp1`, … for positive,
    then `fvn1`, … for negative speeds [N m s or N s/m].
    """

    choice = "viscous by direction"
    choice_keys = {"viscous": "asymmetric"}  # noqa: RUF012
    joint_parameters = (
        JointParameter(
            "fvp", "viscous friction, forwards", ("N m s", "N s/m"), "viscous"
        ),
        JointParameter(
            "fvn", "viscous friction, backwards", ("N m s", "N s/m"), "viscous"
        ),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrices of speeds in either direction."""
        speed = jnp.abs(qd)
        forward_speeds = on_drives(robot, 0.5 * (qd + speed))
        backward_speeds = on_drives(robot, 0.5 * (qd - speed))
        return jnp.concatenate([forward_speeds, backward_speeds], axis=1)


class CoulombFriction(AbstractDryFriction):
    r"""Dry friction, $\mathrm{diag}\{\tanh(\dot q_i / \epsilon_c)\}$ (Eq. 14)."""

    transition: AbstractTransition = Tanh()
    joint_parameters = (
        JointParameter(
            "fc", "Coulomb friction: the same at any speed", ("N m", "N"), "dry"
        ),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of smooth signs."""
        return on_drives(robot, self.transition(qd))


class AsymmetricCoulombFriction(AbstractDryFriction):
    """Dry friction with one level for each direction of motion.

    It takes the place of `CoulombFriction` together with `ConstantOffset`, whose
    columns its own columns span. Its parameters are `fcp1`, … for positive, then
    `fcn1`, … for negative speeds [N m or N].
    """

    transition: AbstractTransition = Tanh()
    joint_parameters = (
        JointParameter("fcp", "Coulomb friction, forwards", ("N m", "N"), "dry"),
        JointParameter("fcn", "Coulomb friction, backwards", ("N m", "N"), "dry"),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the fractions of the two directions."""
        s = self.transition(qd)
        forward_fractions = on_drives(robot, 0.5 * (1.0 + s))
        backward_fractions = on_drives(robot, 0.5 * (s - 1.0))
        return jnp.concatenate([forward_fractions, backward_fractions], axis=1)


class SquareRootFriction(AbstractDryFriction):
    r"""Friction that grows more slowly than speed.

    $\sqrt{|\dot q_i| / v_1} \tanh(\dot q_i / \epsilon)$: with $v_1$ = 1 rad/s or 1 m/s,
    its parameters `fr1`, … are the forces at that speed [N m or N]. It is used beside
    dry and viscous
    friction: greased gears often lie between the two.
    """

    transition: AbstractTransition = Tanh()
    is_switch = True
    choice = "root of speed"
    shares_friction = True
    joint_parameters = (
        JointParameter(
            "fr", "friction that grows with the root of speed", ("N m", "N")
        ),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of the roots of speeds."""
        # The small number keeps the slope finite at standstill.
        root = jnp.sqrt(jnp.sqrt(qd**2 + 1e-16))
        return on_drives(robot, root * self.transition(qd))


class StribeckFriction(AbstractDryFriction):
    r"""Dry friction that falls from a static level to Coulomb's as a joint gets moving.

    $(f_c + f_s e^{-|\dot q / v_s|^\delta}) \tanh(\dot q / \epsilon)$ with $f_c$ and
    $f_s$ unknown: `fc1`, … at speed, then `fs1`, … that is added near standstill [N m
    or N]. It takes the place of `CoulombFriction`. (Armstrong-Hélouvry, Dupont and
    Canudas de Wit, 1994.)

    Attributes:
        speed: Stribeck's speed $v_s$, one for all joints or one for each [rad/s or
            m/s].
        exponent: Exponent $\delta$, likewise [1].
        transition: Transition from one direction of motion to the other.
    """

    speed: EachJoint = eqx.field(converter=one_or_each, default=0.1)
    exponent: EachJoint = eqx.field(converter=one_or_each, default=2.0)
    transition: AbstractTransition = Tanh()
    choice = "Stribeck"
    choice_keys = {"coulomb": {"stribeck": 0.1}}  # noqa: RUF012
    joint_parameters = (
        JointParameter(
            "fc", "Coulomb friction: the same at any speed", ("N m", "N"), "dry"
        ),
        JointParameter("fs", "static friction, above Coulomb's", ("N m", "N")),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrices of smooth and of fading signs."""
        sign = self.transition(qd)
        relative_speed = qd / matching("speed", self.speed, qd)
        exponent = matching("exponent", self.exponent, qd)
        # The small number keeps the logarithm finite at standstill.
        power = jnp.exp(0.5 * exponent * jnp.log(relative_speed**2 + 1e-30))
        static_friction = sign * jnp.exp(-power)
        return jnp.concatenate(
            [on_drives(robot, sign), on_drives(robot, static_friction)], axis=1
        )


class PassiveFriction(AbstractDryFriction):
    r"""Friction of the joints that closed loops move, viscous and dry.

    It acts on the motors by $\Gamma^T$. Its parameters are `fv3`, … with the numbers of
    these joints, then `fc3`, …. Joints that always turn alike share one parameter.
    """

    transition: AbstractTransition = Tanh(USUAL_SPEED)
    is_switch = True
    choice = "friction of passive joints"

    @classmethod
    def with_transition(cls, transition):
        """Return the term with its own transition: that of motors may differ."""
        return cls()

    @property
    def meanings(self):
        """Those of the friction of motors."""
        terms = (ViscousFriction(), CoulombFriction())
        return terms[0].meanings | terms[1].meanings

    def parameters(self, robot):
        """Return names and units: viscous friction, then dry friction.

        Raises:
            InputError: If the robot has no joint that loops move.
        """
        if not robot.loops:
            raise InputError(
                f"`{robot.name}` has no joints that closed loops move: leave "
                "`passive_friction` out."
            )
        parameters = []
        for term in (ViscousFriction(), CoulombFriction()):
            ((name, _, units, _),) = term.joint_parameters
            for body in range(robot.bodies - len(robot.loop_rows), robot.bodies):
                unit = units[0] if robot.turns[body] else units[1]
                parameters.append((f"{name}{robot.numbers[body]}", unit))
        return tuple(parameters)

    def columns(self, robot, q, qd, qdd):
        """Return the forces on the motors of unit friction at the passive joints."""
        ratios = speed_ratios(robot, q)[-len(robot.loop_rows) :]
        rates = ratios @ qd
        dry_friction = self.transition(rates)
        friction = jnp.concatenate([jnp.diag(rates), jnp.diag(dry_friction)], axis=1)
        return ratios.T @ friction

    def lower_bounds(self, robot):
        """Return zeros: friction takes energy away."""
        return np.zeros(len(self.parameters(robot)))


class LoadFriction(AbstractDryFriction):
    r"""Dry friction by load, $|g_i(q)| \tanh(\dot q_i / \epsilon)$.

    It is used beside `CoulombFriction`. The load is that of gravity alone, so that
    forces stay linear in the accelerations; it follows from bodies that are known
    roughly: from CAD, or from an earlier fit without this term.

    Attributes:
        bodies: Parameters of the bodies, ten each in the paper's order: one row for
            each body, or standard parameters that begin with them, as those of a fit
            whose model begins with `RigidBodies`.
        transition: Transition from one direction of motion to the other.
    """

    bodies: Float[AnyArray, "..."]
    transition: AbstractTransition = Tanh()
    joint_parameters = (
        JointParameter("fl", "friction in proportion to the load", ("1", "1"), "load"),
    )

    def parameters(self, robot):
        """Return `fl1`, …: friction for each unit of load [1].

        Raises:
            InputError: If `bodies` holds fewer than ten numbers for each body.
        """
        self._bodies(robot)
        return super().parameters(robot)

    def _bodies(self, robot: Robot):
        """Return the parameters of the bodies, one row for each."""
        size = robot.bodies * len(INERTIAL_NAMES)
        if np.size(self.bodies) < size:
            raise InputError(
                "`bodies` must begin with ten numbers for each body, "
                f"but holds only {np.size(self.bodies)}."
            )
        return self.bodies.ravel()[:size].reshape(robot.bodies, -1)

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of loads with the signs of the speeds."""
        # At standstill only gravity loads the joints.
        standstill = jnp.zeros_like(q)
        bodies = jnp.asarray(self._bodies(robot), q.dtype)
        load = projection_equation.rigid_body_forces(
            robot, bodies, q, standstill, standstill
        )
        return on_drives(robot, jnp.abs(load) * self.transition(qd))


class TemperatureScaled(AbstractTerm):
    r"""Friction that falls with temperature: a term times $e^{-a (T - T_0)}$.

    The parameters are those at the temperature $T_0$.

    Attributes:
        term: Friction at $T_0$.
        rate: Rate $a$, one for all joints or one for each [1/K].
        temperature: Temperature $T$ at which the model is used, likewise [°C].
        reference: Temperature $T_0$ [°C].
    """

    term: AbstractTerm
    rate: EachJoint = 0.01
    temperature: EachJoint = 25.0
    reference: float = eqx.field(static=True, default=25.0)

    def parameters(self, robot):
        """Return those of the term."""
        return self.term.parameters(robot)

    @property
    def meanings(self):
        """Those of the term."""
        return self.term.meanings

    def columns(self, robot, q, qd, qdd):
        """Return those of the term, scaled joint by joint."""
        rise = jnp.asarray(self.temperature, qd.dtype) - self.reference
        scale = jnp.broadcast_to(jnp.exp(-self.rate * rise), qd.shape)
        return scale[:, None] * self.term.columns(robot, q, qd, qdd)

    def lower_bounds(self, robot):
        """Return those of the term."""
        return self.term.lower_bounds(robot)

    def drive_matrices(self, robot):
        """Return those of the term: temperature scales them by a positive number."""
        return self.term.drive_matrices(robot)

"""Friction terms: viscous, Coulomb, Stribeck, by load, by temperature, of coupled drives."""

from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Float,
    Hashable,
    Joints,
    matching,
    namespace,
    one_or_each,
)
from jaxid.dynamics import projection_equation
from jaxid.errors import InputError
from jaxid.robot.inertia import INERTIAL_NAMES
from jaxid.robot.robot import Robot

from .term import AbstractTerm, NonlinearParameter

EachJoint = float | Float[AnyArray, "..."]
"""One number for all joints, or one for each."""
States = Float[AnyArray, " states"]
"""States of friction with memory."""


class AbstractTransition(Hashable):
    """Transition of dry friction from one direction of motion to the other."""

    @abstractmethod
    def __call__(self, qd: Joints) -> Joints:
        """Return a number between -1 and 1 for each speed [rad/s or m/s]."""

    def of_motors(self, speeds: Joints) -> Joints:
        """Return the same for the speeds of the motors, on the side of their own joints."""
        return self(speeds)

    @property
    def nonlinear_parameters(self) -> tuple[NonlinearParameter, ...]:
        """Parameters that `identify_nonlinear` can identify."""
        return ()


class Tanh(AbstractTransition):
    r"""The smooth transition $\tanh(\dot q / \epsilon_c)$ (Eq. 14).

    Attributes:
        epsilon: Speed of the transition, one for all joints or one for each, in the
            joint's own unit [rad/s or m/s].
        dead_zone: Speed below which there is no force, likewise [rad/s or m/s].
    """

    epsilon: EachJoint = eqx.field(converter=one_or_each, default=0.01)
    dead_zone: EachJoint = eqx.field(converter=one_or_each, default=0.0)

    def __check_init__(self):
        if not isinstance(self.epsilon, jax.Array) and not np.all(
            np.asarray(self.epsilon) > 0
        ):
            raise InputError(
                f"`epsilon` must be positive, but is {self.epsilon}: `HardSign` has "
                "no width."
            )

    def __call__(self, qd):
        """Return the smooth sign of the speed."""
        sign = jnp.tanh(qd / matching("epsilon", self.epsilon, qd))
        return _outside_dead_zone(self.dead_zone, qd, sign)

    @property
    def nonlinear_parameters(self):
        """`eps1`, … [rad/s or m/s]."""
        return (NonlinearParameter("eps", ("rad/s", "m/s"), ("epsilon",)),)


class HardSign(AbstractTransition):
    """The sign of the speed, which is undefined at standstill: use a dead zone there.

    Attributes:
        dead_zone: Speed below which there is no force [rad/s or m/s].
    """

    dead_zone: EachJoint = eqx.field(converter=one_or_each, default=0.0)

    def __call__(self, qd):
        """Return the sign of the speed."""
        return _outside_dead_zone(self.dead_zone, qd, jnp.sign(qd))


class Presliding(AbstractTransition):
    r"""Dry friction with memory: a state that follows the motion, and that rest keeps.

    A joint deforms its contacts before it slides: the state $s$ between -1 and 1 obeys
    Dahl's law $\mathrm{d}s = (\mathrm{d}q - s\,|\mathrm{d}q|) / \delta$ (Dahl, AIAA
    Journal 14(12), 1976). It depends on the path alone, not on time. Where no path is
    known, as at single samples and in the design of motions, the state is that of
    steady motion.

    Attributes:
        length: Length $\delta$ of the deformation, one for all joints or one for each
            [rad or m].
        steady: Transition that gives the state of steady motion, and that at the start
            of a path.
        motors: Turns of motors for those of joints, if motors turn several axes: they
            have states.
        state: State at one sample, where it is known.
    """

    length: EachJoint = eqx.field(converter=one_or_each, default=1e-3)
    steady: AbstractTransition = Tanh()
    motors: Float[AnyArray, "joints joints"] | None = None
    state: States | None = None

    def __check_init__(self):
        if not isinstance(self.length, jax.Array) and not np.all(
            np.asarray(self.length) > 0
        ):
            raise InputError(f"`length` must be positive, but is {self.length}.")

    def __call__(self, qd):
        """Return the state: where it is not known, that of steady motion."""
        return (
            self.steady(qd) if self.state is None else self.state[..., : qd.shape[-1]]
        )

    def of_motors(self, speeds: Joints) -> Joints:
        """Return the states of the motors: where they are not known, those of steady motion."""
        s = None if self.motors is None else self.state
        return self.steady(speeds) if s is None else s[..., speeds.shape[-1] :]

    def settled(
        self, qd: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch states"]:
        """Return the states of steady motion."""
        return self._with_motors(qd, self.steady)

    def _with_motors(self, x: AnyArray, function: Any) -> AnyArray:
        """Return a function of the joints, followed by that of their motors."""
        if self.motors is None:
            return function(x)
        return namespace(x).concatenate(
            [function(x), function(x @ self.motors.T)], axis=-1
        )

    def _strain(self, change: AnyArray) -> AnyArray:
        """Return steps of joints and motors, relative to their lengths [1]."""
        length = namespace(change).broadcast_to(self.length, change.shape)
        return self._with_motors(change, lambda x: x / length)

    def advance(self, q_before: Joints, q: Joints, s: States) -> States:
        """Return the state behind a step of one direction [rad or m], from that before it."""
        strain = self._strain(q - q_before)
        way = jnp.sign(strain)
        return way + (s - way) * jnp.exp(-jnp.abs(strain))

    def states(
        self,
        q: Float[AnyArray, "*batch samples joints"],
        start: Float[AnyArray, "*batch states"],
    ) -> Float[AnyArray, "*batch samples states"]:
        """Return the states along a path, from that at its first sample."""
        xp = namespace(q)
        strain = self._strain(xp.diff(xp.moveaxis(q, -2, 0), axis=0))
        kept = xp.exp(-xp.abs(strain))
        s = xp.concatenate([xp.asarray(start)[None], xp.sign(strain) * (1 - kept)])
        kept = xp.concatenate([xp.zeros_like(s[:1]), kept])
        reach = 1
        # Each turn joins twice as many steps to one, which is affine in the state
        # before it.
        while reach < len(s):
            s = xp.concatenate([s[:reach], s[reach:] + kept[reach:] * s[:-reach]])
            kept = xp.concatenate([kept[:reach], kept[reach:] * kept[:-reach]])
            reach *= 2
        return xp.moveaxis(s, 0, -2)


class Reversal(AbstractTransition):
    """Another transition that keeps one direction near standstill, for bounds of forces.

    At a reversal dry friction jumps, at an instant that no grid of samples contains.
    Between the two sides of this class lies every force on the way, and both change
    smoothly.

    Attributes:
        own: Transition elsewhere.
        side: Direction that is kept near standstill, 1 or -1.
        width: Speeds up to which it is kept; at twice these it has faded [rad/s or
            m/s].
    """

    own: AbstractTransition
    side: float
    width: Joints

    def __call__(self, qd):
        """Return the other transition, drawn to the side."""
        one = jnp.ones_like(qd)
        near = jnp.minimum(
            one, jnp.maximum(0 * one, 2 * one - jnp.abs(qd) / self.width)
        )
        near = near**2 * (3 - 2 * near)
        value = self.own(qd)
        return value + near * (self.side - value)


def _outside_dead_zone(dead_zone: Any, qd: Any, value: Any) -> Any:
    if not isinstance(dead_zone, jax.Array) and not np.any(dead_zone):
        return value
    moves = jnp.abs(qd) > matching("dead_zone", dead_zone, qd)
    return jnp.where(moves, value, jnp.zeros_like(value))


class AbstractDryFriction(AbstractTerm):
    """Friction with a `transition` from one direction of motion to the other."""

    transition: eqx.AbstractVar[AbstractTransition]
    # Where not, it is identified only if chosen: `CoulombFriction` determines it
    # better.
    determines_transition: ClassVar[bool] = True

    @property
    def nonlinear_parameters(self):
        """Those of the transition."""
        own = (x.inside("transition") for x in self.transition.nonlinear_parameters)
        return tuple(
            x._replace(default=x.default and self.determines_transition) for x in own
        )


class ViscousFriction(AbstractTerm):
    r"""Friction `fv1`, … that grows with speed, $\mathrm{diag}\{\dot q_i\}$ (Eq. 13)."""

    symbols = (("fv", "N m s", "N s/m"),)
    roles = ("viscous",)

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of speeds."""
        return jnp.diag(qd)


class AsymmetricViscousFriction(AbstractTerm):
    """Friction that grows with speed, at one rate for each direction of motion.

    It takes the place of `ViscousFriction`. Its parameters are `fvp1`, … for positive,
    then `fvn1`, … for negative speeds [N m s or N s/m].
    """

    symbols = (("fvp", "N m s", "N s/m"), ("fvn", "N m s", "N s/m"))
    roles = ("viscous", "viscous")

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrices of speeds in either direction."""
        size = jnp.abs(qd)
        return jnp.concatenate(
            [jnp.diag(0.5 * (qd + size)), jnp.diag(0.5 * (qd - size))], axis=1
        )


class CoulombFriction(AbstractDryFriction):
    r"""Dry friction `fc1`, …, $\mathrm{diag}\{\tanh(\dot q_i / \epsilon_c)\}$ (Eq. 14)."""

    transition: AbstractTransition = Tanh()
    symbols = (("fc", "N m", "N"),)
    roles = ("dry",)

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of smooth signs."""
        return jnp.diag(self.transition(qd))


class AsymmetricCoulombFriction(AbstractDryFriction):
    """Dry friction with one level for each direction of motion.

    It takes the place of `CoulombFriction` together with `ConstantOffset`, whose
    columns its own columns span. Its parameters are `fcp1`, … for positive, then
    `fcn1`, … for negative speeds [N m or N].
    """

    transition: AbstractTransition = Tanh()
    symbols = (("fcp", "N m", "N"), ("fcn", "N m", "N"))
    roles = ("dry", "dry")

    def columns(self, robot, q, qd, qdd):
        """Return the fractions of the two directions."""
        s = self.transition(qd)
        dead_zone = getattr(self.transition, "dead_zone", 0.0)
        moving: Any = 1.0
        if isinstance(dead_zone, jax.Array) or np.any(dead_zone):
            # Within a dead zone both fractions vanish, as the force does.
            moving = jnp.where(s == 0.0, s, jnp.ones_like(s))
        return jnp.concatenate(
            [jnp.diag(0.5 * (moving + s)), jnp.diag(0.5 * (s - moving))], axis=1
        )


class SquareRootFriction(AbstractDryFriction):
    r"""Friction that grows more slowly than speed.

    $\sqrt{|\dot q_i| / v_1} \tanh(\dot q_i / \epsilon)$: with $v_1$ = 1 rad/s or 1 m/s,
    its parameters `fr1`, … are the forces at that speed [N m or N]. It is used beside
    dry and viscous
    friction: greased gears often lie between the two.
    """

    transition: AbstractTransition = Tanh()
    determines_transition = False
    symbols = (("fr", "N m", "N"),)

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of the roots of speeds."""
        # The small number keeps the slope finite at standstill.
        root = jnp.sqrt(jnp.sqrt(qd**2 + 1e-16))
        return jnp.diag(root * self.transition(qd))


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
    symbols = (("fc", "N m", "N"), ("fs", "N m", "N"))
    roles = ("dry", None)

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrices of smooth signs, and of those that fade with speed."""
        sign = self.transition(qd)
        relative = qd / matching("speed", self.speed, qd)
        # The small number keeps the logarithm finite at standstill.
        power = (
            0.5 * matching("exponent", self.exponent, qd) * jnp.log(relative**2 + 1e-30)
        )
        return jnp.concatenate(
            [jnp.diag(sign), jnp.diag(sign * jnp.exp(-jnp.exp(power)))], axis=1
        )

    @property
    def nonlinear_parameters(self):
        """Those of the transition, `vs1`, … [rad/s or m/s], and `delta1`, … if chosen."""
        return (
            *super().nonlinear_parameters,
            NonlinearParameter("vs", ("rad/s", "m/s"), ("speed",)),
            NonlinearParameter("delta", ("1", "1"), ("exponent",), default=False),
        )


class LoadFriction(AbstractDryFriction):
    r"""Dry friction in proportion to the weight on a joint, $|g_i(q)| \tanh(\dot q_i / \epsilon)$.

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
    determines_transition = False
    symbols = (("fl", "1", "1"),)
    roles = ("load",)

    def parameters(self, robot):
        """Return `fl1`, …: friction for each unit of load [1].

        Raises:
            InputError: If `bodies` holds fewer than ten numbers for each body.
        """
        self._bodies(robot)
        return super().parameters(robot)

    def _bodies(self, robot: Robot) -> AnyArray:
        size = robot.joints * len(INERTIAL_NAMES)
        given = np.size(self.bodies)
        if given < size:
            raise InputError(
                "`bodies` must begin with ten numbers for each body, but holds only "
                f"{given}."
            )
        return self.bodies.ravel()[:size].reshape(robot.joints, -1)

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of loads with the signs of the speeds."""
        rest = jnp.zeros_like(q)
        bodies = jnp.asarray(self._bodies(robot), q.dtype)
        load = projection_equation.rigid_body_forces(robot, bodies, q, rest, rest)
        return jnp.diag(jnp.abs(load) * self.transition(qd))


class TemperatureScaled(AbstractTerm):
    r"""Friction that falls as the joints get warm: another term times $e^{-a (T - T_0)}$.

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

    def columns(self, robot, q, qd, qdd):
        """Return those of the term, scaled joint by joint."""
        warmer = jnp.asarray(self.temperature, qd.dtype) - self.reference
        scale = jnp.broadcast_to(jnp.exp(-self.rate * warmer), qd.shape)
        return scale[:, None] * self.term.columns(robot, q, qd, qdd)

    def lower_bounds(self, robot):
        """Return those of the term."""
        return self.term.lower_bounds(robot)

    def drive_matrices(self, robot):
        """Return those of the term: temperature scales them by a positive number."""
        return self.term.drive_matrices(robot)

    @property
    def nonlinear_parameters(self):
        """Those of the term, and `rate1`, … [1/K] if chosen: it takes more than one recording."""
        inner = (x.inside("term") for x in self.term.nonlinear_parameters)
        return (
            *inner,
            NonlinearParameter("rate", ("1/K", "1/K"), ("rate",), default=False),
        )


class CoupledDrives(AbstractTerm):
    r"""Contributions beside the diagonal of motors that turn more than one axis.

    A motor whose row of the reduction has further entries beside that of its own joint
    feels its rotor inertia and friction on all of these axes. The diagonal parts belong
    to `RotorInertia`, `ViscousFriction` and `CoulombFriction` of the axes; this term
    has the parts beside the diagonal, and the Coulomb friction of the motor's own
    motion.

    Attributes:
        transition: Transition of the Coulomb friction, at speeds measured on the side
            of the motor's own joint [rad/s or m/s].
    """

    transition: AbstractTransition = Tanh()

    def couplings(self, robot: Robot) -> tuple[tuple[int, np.ndarray], ...]:
        """Return the motors that turn several axes, with ratios relative to their own joint.

        Raises:
            InputError: If the motors are not in the order of their joints.
        """
        A = np.asarray(robot.drives.reduction)
        scale = np.abs(A).max()
        if not np.diag(A).all():
            motor = int(np.flatnonzero(np.diag(A) == 0)[0]) + 1
            raise InputError(
                f"`drives.reduction`: motor {motor} does not turn joint {motor}: "
                "reorder its rows."
            )
        return tuple(
            (i, A[i] / A[i, i])
            for i in range(robot.joints)
            if (np.abs(np.delete(A[i], i)) > 1e-12 * scale).any()
        )

    def parameters(self, robot):
        """Return `Iam6`, `fvm6`, `fcm6` for a coupled motor 6."""
        kinds = (("Iam", "kg m²", "kg"), ("fvm", "N m s", "N s/m"), ("fcm", "N m", "N"))
        couplings = self.couplings(robot)
        if not couplings:
            raise InputError(
                f"the drives of `{robot.name}` are not coupled: leave `CoupledDrives` "
                "out, or give "
                "`drives.reduction` entries beside its diagonal."
            )
        return tuple(
            (f"{name}{i + 1}", unit_r if robot.revolute[i] else unit_p)
            for name, unit_r, unit_p in kinds
            for i, _ in couplings
        )

    def columns(self, robot, q, qd, qdd):
        """Return inertia and viscous parts beside the diagonal, and Coulomb parts of motors."""
        inertia, viscous, dry = [], [], []
        for i, ratios in self.couplings(robot):
            beside = _beside_diagonal(ratios)
            inertia.append(beside.astype(qdd.dtype) @ qdd)
            viscous.append(beside.astype(qd.dtype) @ qd)
            r = ratios.astype(qd.dtype)
            # The motor's speed takes the place of its joint's, whose transition width
            # it has.
            speeds = jnp.stack(
                [jnp.dot(r, qd) if j == i else qd[j] for j in range(len(r))]
            )
            dry.append(r * self.transition.of_motors(speeds)[i])
        return jnp.stack([*inertia, *viscous, *dry], axis=1)

    def lower_bounds(self, robot):
        """Return zeros: inertia and friction of the motors are positive."""
        return np.zeros(len(self.parameters(robot)))

    def drive_matrices(self, robot):
        """Return the matrices beside the diagonals of the coupled motors."""
        couplings = self.couplings(robot)
        n, found = robot.joints, len(couplings)
        matrices = np.zeros((2, n, n, 3 * found))
        for place, (_, ratios) in enumerate(couplings):
            beside = _beside_diagonal(ratios)
            matrices[0, :, :, place] = matrices[1, :, :, found + place] = beside
        return matrices


def _beside_diagonal(ratios: np.ndarray) -> Float[np.ndarray, "joints joints"]:
    return np.outer(ratios, ratios) * (1.0 - np.eye(len(ratios)))

"""Friction and disturbances of the drives, as they act in a simulation.

A friction law is evaluated for the next time step, and gives a force that is affine in
the speed at the step's end. Solving for that speed treats friction implicitly: however
steep a law is near standstill, a joint that sticks stays where it is, and no small
steps are needed.
"""

import dataclasses
from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Float, Hashable, Joints
from jaxid.dynamics.terms import AbstractTerm, CoulombFriction, Tanh, ViscousFriction
from jaxid.robot.robot import Robot

EPSILON = 0.01
"""Width of the smooth sign in the model's columns of dry friction [rad/s or m/s]."""


class AbstractGearFriction(Hashable):
    """Friction of a gear in a simulation: viscous, dry, and more.

    Attributes:
        viscous: Viscous friction [N m s/rad or N s/m].
        coulomb: Dry friction at speed [N m or N].
        dry: Names of all fields that are levels of dry friction.
    """

    viscous: eqx.AbstractVar[Joints]
    coulomb: eqx.AbstractVar[Joints]
    dry: ClassVar[tuple[str, ...]] = ("coulomb",)

    @abstractmethod
    def steady(self, qd: Joints) -> Joints:
        """Return friction at constant speeds [N m or N]."""

    @abstractmethod
    def over_step(
        self, qd: Joints, expected: Joints, z: Joints, step: float
    ) -> tuple[Joints, Joints, Joints, Joints]:
        r"""Return friction during the next step, affine in the speed $\dot q^+$ at its end.

        Args:
            qd: Speeds at its start [rad/s or m/s].
            expected: Expected speeds at its end [rad/s or m/s].
            z: Deflections of the bristles at its start [rad or m].
            step: Length of the step [s].

        Returns:
            $F_0$, $s$, $z_0$ and $r$: friction is $F_0 + s \dot q^+$ [N m or N], while
            bristles bend to $z_0 + r \dot q^+$ [rad or m].
        """

    def scaled(self, viscous: Joints, dry: Joints) -> "AbstractGearFriction":
        """Return the same law with viscous and all dry friction times factors."""
        levels = {name: getattr(self, name) * dry for name in self.dry}
        return dataclasses.replace(self, viscous=self.viscous * viscous, **levels)

    def settled(self, qd: Joints) -> Joints:
        """Return deflections of the bristles at constant speeds [rad or m]."""
        return 0.0 * qd

    @property
    def terms(self) -> tuple[AbstractTerm, ...]:
        """Part that is linear in parameters: viscous and Coulomb friction (Eqs. 13, 14)."""
        return ViscousFriction(), CoulombFriction(Tanh(EPSILON))

    @property
    def parameters(self) -> Float[np.ndarray, " parameters"]:
        """Parameters of these terms."""
        return np.concatenate([np.asarray(self.viscous), np.asarray(self.coulomb)])


class SmoothFriction(AbstractGearFriction):
    r"""Friction of the model, with optional Stribeck friction near standstill (Eqs. 13, 14).

    $d_v \dot q + d_c \tanh(\dot q / \epsilon) + f_s e^{-(\dot q / v_s)^2} \tanh(4 \dot
    q / v_s)$. Nothing sticks.

    Attributes:
        viscous: $d_v$ [N m s/rad or N s/m].
        coulomb: $d_c$ [N m or N].
        stribeck: $f_s$, which the model lacks [N m or N].
        stribeck_speed: $v_s$ [rad/s or m/s].
    """

    dry: ClassVar[tuple[str, ...]] = ("coulomb", "stribeck")
    viscous: Joints
    coulomb: Joints
    stribeck: Joints | float = 0.0
    stribeck_speed: float = 0.05

    def steady(self, qd):
        """Return the sum of all three parts."""
        return (
            self.viscous * qd + self.coulomb * jnp.tanh(qd / EPSILON) + self._fading(qd)
        )

    def _fading(self, qd):
        relative = qd / self.stribeck_speed
        return self.stribeck * jnp.exp(-(relative**2)) * jnp.tanh(4.0 * relative)

    def over_step(self, qd, expected, z, step):
        """Return the tangent at the expected speed, with the mean viscous part over the step."""
        sign = jnp.tanh(expected / EPSILON)
        slope = self.coulomb / EPSILON * (1.0 - sign**2)
        dry = self.coulomb * sign + self._fading(expected)
        force = dry - slope * expected + 0.5 * self.viscous * qd
        return force, slope + 0.5 * self.viscous, z, 0.0 * z


class LuGreFriction(AbstractGearFriction):
    r"""Viscous, Coulomb and Stribeck friction and stiction: the LuGre law of bent bristles.

    $F = \sigma_0 z + \sigma_1(\dot q) \dot z + d_v \dot q$ with
    $\dot z = \dot q - \sigma_0 |\dot q| z / g(\dot q)$ and
    $g = d_c + (f_s - d_c) e^{-(\dot q / v_s)^2}$ (Canudas de Wit, Olsson, Åström and
    Lischinsky, IEEE Trans. Automatic Control 40(3), 1995). The bristles' damping fades
    with speed like the Stribeck part, which keeps the law passive (Olsson's thesis,
    Lund 1996).

    Attributes:
        viscous: $d_v$ [N m s/rad or N s/m].
        coulomb: $d_c$ [N m or N].
        breakaway: $f_s$, the largest force on a joint at rest [N m or N].
        stribeck_speed: $v_s$ [rad/s or m/s].
        deflection: Deflection of the bristles when they let go, $f_s / \sigma_0$ [rad
            or m].
        damping_time: $\sigma_1 / \sigma_0$ at rest [s].
    """

    dry: ClassVar[tuple[str, ...]] = ("coulomb", "breakaway")
    viscous: Joints
    coulomb: Joints
    breakaway: Joints
    stribeck_speed: Joints | float = 0.05
    deflection: Joints | float = 5e-4
    damping_time: float = 3e-3

    def _level(self, qd):
        fading = jnp.exp(-((qd / self.stribeck_speed) ** 2))
        return self.coulomb + (self.breakaway - self.coulomb) * fading, fading

    @property
    def _stiffness(self) -> Joints:
        return self.breakaway / self.deflection

    def steady(self, qd):
        """Return the Stribeck curve, with the model's smooth sign at the origin."""
        level, _ = self._level(qd)
        return self.viscous * qd + level * jnp.tanh(qd / EPSILON)

    def settled(self, qd):
        """Return the deflections that belong to the friction at these speeds."""
        level, _ = self._level(qd)
        return level / self._stiffness * jnp.sign(qd)

    def over_step(self, qd, expected, z, step):
        """Return friction of bristles that bend with the final speed and yield at the expected."""
        level, fading = self._level(expected)
        kept = 1.0 / (1.0 + step * self._stiffness * jnp.abs(expected) / level)
        damping = self.damping_time * self._stiffness * fading
        bent = (self._stiffness + damping / step) * kept
        force = bent * z - damping / step * z + 0.5 * self.viscous * qd
        return force, bent * step + 0.5 * self.viscous, kept * z, kept * step


class FrictionTemperature(eqx.Module):
    r"""Dependence of friction on temperature, and the heat of friction (Sec. 6).

    Viscous friction is multiplied by $e^{-a (T - T_0)}$, the law of
    `TemperatureScaled`, and dry friction by the same with its own rate. The gear stores
    heat: $t_h \dot T = R P - (T - T_a)$ with the friction's power $P$.

    Attributes:
        viscous_rate: $a$ of the viscous friction [1/K].
        dry_rate: $a$ of the dry friction [1/K].
        resistance: Thermal resistance $R$ from each gear to the air [K/W].
        time: Time constant $t_h$ [s].
        reference: Temperature $T_0$ at which the friction is known, and $T_a$ of the
            air [°C].
    """

    viscous_rate: Joints
    dry_rate: Joints
    resistance: Joints
    time: float = 600.0
    reference: float = 20.0

    def factors(self, temperature: Joints) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors of viscous and dry friction at a temperature [°C]."""
        warmer = np.asarray(temperature) - self.reference
        return np.exp(-self.viscous_rate * warmer), np.exp(-self.dry_rate * warmer)

    def warm_up(
        self, temperature: Joints, power: Joints, duration: float
    ) -> np.ndarray:
        """Return temperatures [°C] after some time [s] with constant power of friction [W]."""
        final = self.reference + np.asarray(self.resistance) * np.asarray(power)
        return final + (np.asarray(temperature) - final) * np.exp(-duration / self.time)


class AbstractDisturbance(Hashable):
    """Force beside those of the drives; the measured torques do not contain it."""

    @abstractmethod
    def forces(self, robot: Robot, q: Joints, qd: Joints) -> Joints:
        """Return the forces on the joints [N m or N].

        Args:
            robot: Robot with its gears.
            q: Positions of the motors, on the joint side [rad or m].
            qd: Speeds of the motors, on the joint side [rad/s or m/s].
        """


class TorqueRipple(AbstractDisturbance):
    """Ripple of the motor torques along the motor angle: cogging and commutation errors.

    Attributes:
        amplitude: Amplitude on the joint side [N m or N].
        waves: Waves in one turn of the motor.
        phase: Phase at the motor's zero [rad].
    """

    amplitude: Joints
    waves: Joints
    phase: Joints

    def forces(self, robot, q, qd):
        """Return a sine of the motor angle."""
        return self.amplitude * jnp.sin(
            self.waves * robot.drives.motor_angles(q) + self.phase
        )


class CableForce(AbstractDisturbance):
    """Force of cables along the arm, or of a cable chain: a soft spring with friction.

    Attributes:
        stiffness: Stiffness [N m/rad or N/m].
        rest: Position without spring force [rad or m].
        friction: Friction of the cables [N m or N].
        speed: Speed from which on friction has its full size [rad/s or m/s].
    """

    stiffness: Joints
    rest: Joints
    friction: Joints
    speed: float = 0.02

    def forces(self, robot, q, qd):
        """Return forces against the deflection and against the motion."""
        return self.stiffness * (self.rest - q) - self.friction * jnp.tanh(
            qd / self.speed
        )

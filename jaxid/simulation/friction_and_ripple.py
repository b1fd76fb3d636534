"""Friction and torque ripple of the drives, as they act in a simulation.

A friction law is evaluated for the next time step, and gives a force that is affine in
the speed at the step's end. Solving for that speed treats friction implicitly: however
steep a law is near standstill, a joint that sticks stays where it is, and no small
steps are needed.
"""

import dataclasses
from abc import abstractmethod
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Hashable, Joints, Texts
from jaxid.dynamics.terms import AbstractTerm, CoulombFriction, Tanh, ViscousFriction
from jaxid.robot.robot import Robot

EPSILON = 0.01
"""Width of the smooth sign in the model's columns of dry friction [rad/s or m/s]."""


class FrictionStep(NamedTuple):
    r"""Friction during a time step, affine in the speed $\dot q^+$ at its end.

    Friction is `force` + `slope` $\dot q^+$ [N m or N], while the bristles bend to
    `deflection` + `deflection_slope` $\dot q^+$ [rad or m].
    """

    force: Joints
    slope: Joints
    deflection: Joints
    deflection_slope: Joints


class AbstractGearFriction(Hashable):
    """Friction of a gear in a simulation: viscous, dry, and more.

    Attributes:
        viscous: Viscous friction [N m s/rad or N s/m].
        coulomb: Dry friction at speed [N m or N].
        dry: Names of all fields that are levels of dry friction.
    """

    viscous: eqx.AbstractVar[Joints]
    coulomb: eqx.AbstractVar[Joints]
    dry: ClassVar[Texts] = ("coulomb",)

    @abstractmethod
    def steady(self, qd: Joints) -> Joints:
        """Return friction at constant speeds [N m or N]."""

    @abstractmethod
    def over_step(
        self, qd: Joints, expected_qd: Joints, z: Joints, step: float
    ) -> FrictionStep:
        """Return friction during the next step.

        Args:
            qd: Speeds at its start [rad/s or m/s].
            expected_qd: Expected speeds at its end [rad/s or m/s].
            z: Deflections of the bristles at its start [rad or m].
            step: Length of the step [s].
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
        """Part that is linear in parameters, viscous and Coulomb (Eqs. 13, 14)."""
        return ViscousFriction(), CoulombFriction(Tanh(EPSILON))

    @property
    def parameters(self) -> np.ndarray:
        """Parameters of these terms."""
        return np.concatenate([np.asarray(self.viscous), np.asarray(self.coulomb)])


class SmoothFriction(AbstractGearFriction):
    r"""Friction of the model, with optional Stribeck friction (Eqs. 13, 14).

    $d_v \dot q + d_c \tanh(\dot q / \epsilon) + f_s e^{-(\dot q / v_s)^2} \tanh(4 \dot
    q / v_s)$. Nothing sticks.

    Attributes:
        viscous: $d_v$ [N m s/rad or N s/m].
        coulomb: $d_c$ [N m or N].
        stribeck: $f_s$, which the model lacks [N m or N].
        stribeck_speed: $v_s$ [rad/s or m/s].
    """

    dry: ClassVar[Texts] = ("coulomb", "stribeck")
    viscous: Joints
    coulomb: Joints
    stribeck: Joints | float = 0.0
    stribeck_speed: float = 0.05

    def steady(self, qd):
        """Return the sum of all three parts."""
        dry_force = self.coulomb * jnp.tanh(qd / EPSILON) + self._stribeck_part(qd)
        return self.viscous * qd + dry_force

    def over_step(self, qd, expected_qd, z, step):
        """Return the tangent at the expected speed.

        The viscous part is the mean one over the step.
        """
        sign = jnp.tanh(expected_qd / EPSILON)
        slope = self.coulomb / EPSILON * (1.0 - sign**2)
        dry_force = self.coulomb * sign + self._stribeck_part(expected_qd)
        half_viscous = 0.5 * self.viscous
        force = dry_force - slope * expected_qd + half_viscous * qd
        return FrictionStep(force, slope + half_viscous, z, 0.0 * z)

    def _stribeck_part(self, qd):
        """Return the part near standstill."""
        x = qd / self.stribeck_speed
        return self.stribeck * jnp.exp(-(x**2)) * jnp.tanh(4.0 * x)


class LuGreFriction(AbstractGearFriction):
    r"""Viscous, Coulomb and Stribeck friction, and stiction: LuGre's law of bristles.

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

    dry: ClassVar[Texts] = ("coulomb", "breakaway")
    viscous: Joints
    coulomb: Joints
    breakaway: Joints
    stribeck_speed: Joints | float = 0.05
    deflection: Joints | float = 5e-4
    damping_time: float = 3e-3

    def steady(self, qd):
        """Return the Stribeck curve, with the model's smooth sign at the origin."""
        return self.viscous * qd + self._dry_level(qd) * jnp.tanh(qd / EPSILON)

    def settled(self, qd):
        """Return the deflections that belong to the friction at these speeds."""
        return self._dry_level(qd) / self._stiffness * jnp.sign(qd)

    def over_step(self, qd, expected_qd, z, step):
        """Return friction of bristles, which bend with the final speed.

        They yield at the expected speed.
        """
        stiffness = self._stiffness
        compliance = (
            step * stiffness * jnp.abs(expected_qd) / self._dry_level(expected_qd)
        )
        # Share of the deflection that is left after the step.
        share = 1.0 / (1.0 + compliance)
        damping = self.damping_time * stiffness * self._stribeck_share(expected_qd)
        total_stiffness = (stiffness + damping / step) * share
        half_viscous = 0.5 * self.viscous
        force = total_stiffness * z - damping / step * z + half_viscous * qd
        slope = total_stiffness * step + half_viscous
        return FrictionStep(force, slope, share * z, share * step)

    def _stribeck_share(self, qd):
        """Return the share of the Stribeck part that a speed leaves: one at rest."""
        return jnp.exp(-((qd / self.stribeck_speed) ** 2))

    def _dry_level(self, qd):
        """Return the level of dry friction at a speed [N m or N]."""
        breakaway_excess = self.breakaway - self.coulomb
        return self.coulomb + breakaway_excess * self._stribeck_share(qd)

    @property
    def _stiffness(self):
        return self.breakaway / self.deflection


class FrictionTemperature(eqx.Module):
    r"""Temperature of the gears, and how friction depends on it (Sec. 6).

    From $T_0$ to $T$ viscous friction is multiplied by $e^{-a (T - T_0)}$, the law of
    `TemperatureScaled`, and dry friction by the same with its own rate.

    Attributes:
        viscous_rate: $a$ of the viscous friction [1/K].
        dry_rate: $a$ of the dry friction [1/K].
        temperature: Present temperature $T_0$ [°C].
    """

    viscous_rate: Joints
    dry_rate: Joints
    temperature: Joints | float = 20.0

    def factors(self, temperature: Joints | float) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors of viscous and dry friction at another temperature."""
        rise = np.asarray(temperature) - self.temperature
        viscous_factors = np.exp(-self.viscous_rate * rise)
        dry_factors = np.exp(-self.dry_rate * rise)
        return viscous_factors, dry_factors


class TorqueRipple(Hashable):
    """Ripple of the motor torques along the motor angle: cogging, commutation errors.

    It acts beside the forces of the drives; the measured torques do not contain it.

    Attributes:
        amplitude: Amplitude on the joint side [N m or N].
        waves: Waves in one turn of the motor.
        phase: Phase at the motor's zero [rad].
    """

    amplitude: Joints
    waves: Joints
    phase: Joints

    def forces(self, robot: Robot, q: Joints) -> Joints:
        """Return a sine of the motor angles, for angles of the joints [rad or m]."""
        angles = self.waves * robot.drives.motor_angles(q) + self.phase
        return self.amplitude * jnp.sin(angles)

"""Friction of gears as it acts in a simulation, stiction included; it falls as the lubricant warms.

A law is asked for the next step of time, and answers with a force that is affine in the speed at
the step's end. Solving for that speed treats friction implicitly: however steep a law is near
standstill, a joint that sticks stays where it is, and nothing has to be stepped finely.
"""

import dataclasses
from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Hashable
from jaxid.dynamics.terms import AbstractTerm, CoulombFriction, ViscousFriction
from jaxid.dynamics.transitions import Tanh

Joints = Float[AnyArray, " joints"]
EPSILON = 0.01
"""Of the smooth sign in the model's columns of dry friction [rad/s or m/s]."""


class StepFriction(NamedTuple):
    r"""Over one step $F = F_0 + s \dot q^+$, and bristles bend to $z^+ = z_0 + r \dot q^+$.

    Attributes:
        force: $F_0$ [N m or N].
        slope: $s$ [N m s/rad or N s/m].
        deflection: $z_0$ [rad or m].
        rate: $r$ [s].
    """

    force: Joints
    slope: Joints
    deflection: Joints
    rate: Joints


class AbstractGearFriction(Hashable):
    """What a gear's friction does in a simulation: viscous, dry, and more.

    Attributes:
        viscous: Friction that grows with speed [N m s/rad or N s/m].
        coulomb: Dry friction at speed [N m or N].
    """

    viscous: eqx.AbstractVar[Joints]
    coulomb: eqx.AbstractVar[Joints]

    @abstractmethod
    def steady(self, qd: Joints) -> Joints:
        """Friction at speeds that last [N m or N]."""

    @abstractmethod
    def over_step(self, qd: Joints, expected: Joints, z: Joints, step: float) -> StepFriction:
        """Friction during the next step.

        Args:
            qd: Speeds at its start [rad/s or m/s].
            expected: Speeds to expect at its end [rad/s or m/s].
            z: Deflections of the bristles at its start [rad or m].
            step: Its length [s].
        """

    @abstractmethod
    def scaled(self, viscous: Joints, dry: Joints) -> "AbstractGearFriction":
        """The same law with other levels, as temperature changes them: steady friction follows.

        Args:
            viscous: Factors of the viscous friction.
            dry: Factors of all dry friction.
        """

    def settled(self, qd: Joints) -> Joints:
        """Deflections of the bristles at speeds that last [rad or m]; none without bristles."""
        return 0.0 * qd

    @property
    def terms(self) -> tuple[AbstractTerm, ...]:
        """The part that is linear in parameters: viscous and Coulomb friction (Eqs. 13, 14)."""
        return ViscousFriction(), CoulombFriction(Tanh(EPSILON))

    @property
    def parameters(self) -> Float[np.ndarray, " parameters"]:
        """Parameters of these terms."""
        return np.concatenate([np.asarray(self.viscous), np.asarray(self.coulomb)])


class SmoothFriction(AbstractGearFriction):
    r"""Friction as the model has it, and if wanted more of it near standstill (Eqs. 13, 14).

    $d_v \dot q + d_c \tanh(\dot q / \epsilon) + f_s e^{-(\dot q / v_s)^2} \tanh(4 \dot q / v_s)$.
    Nothing sticks.

    Attributes:
        viscous: $d_v$ [N m s/rad or N s/m].
        coulomb: $d_c$ [N m or N].
        stribeck: $f_s$, which the model lacks [N m or N].
        stribeck_speed: $v_s$ [rad/s or m/s].
    """

    viscous: Joints
    coulomb: Joints
    stribeck: Joints | float = 0.0
    stribeck_speed: float = 0.05

    def steady(self, qd):
        """All three parts."""
        return self.viscous * qd + self.coulomb * jnp.tanh(qd / EPSILON) + self._fading(qd)

    def _fading(self, qd):
        relative = qd / self.stribeck_speed
        return self.stribeck * jnp.exp(-(relative**2)) * jnp.tanh(4.0 * relative)

    def over_step(self, qd, expected, z, step):
        """The tangent at the expected speed; of the viscous part the mean over the step."""
        sign = jnp.tanh(expected / EPSILON)
        slope = self.coulomb / EPSILON * (1.0 - sign**2)
        dry = self.coulomb * sign + self._fading(expected)
        force = dry - slope * expected + 0.5 * self.viscous * qd
        return StepFriction(force, slope + 0.5 * self.viscous, z, 0.0 * z)

    def scaled(self, viscous, dry):
        """Stribeck's part is dry."""
        return dataclasses.replace(
            self,
            viscous=self.viscous * viscous,
            coulomb=self.coulomb * dry,
            stribeck=self.stribeck * dry,
        )


class LuGreFriction(AbstractGearFriction):
    r"""Viscous, Coulomb, Stribeck and stiction in one: the LuGre law of bent bristles.

    $F = \sigma_0 z + \sigma_1(\dot q) \dot z + d_v \dot q$ with
    $\dot z = \dot q - \sigma_0 |\dot q| z / g(\dot q)$ and
    $g = d_c + (f_s - d_c) e^{-(\dot q / v_s)^2}$ (Canudas de Wit, Olsson, Åström and Lischinsky,
    IEEE Trans. Automatic Control 40(3), 1995). The bristles' damping fades with speed like
    Stribeck's part, which keeps the law passive (Olsson's thesis, Lund 1996).

    Attributes:
        viscous: $d_v$ [N m s/rad or N s/m].
        coulomb: $d_c$ [N m or N].
        breakaway: $f_s$, what a joint at rest withstands [N m or N].
        stribeck_speed: $v_s$ [rad/s or m/s].
        deflection: Of the bristles when they let go, $f_s / \sigma_0$ [rad or m].
        damping_time: $\sigma_1 / \sigma_0$ at rest [s].
    """

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
        """Stribeck's curve, with the model's smooth sign at the origin."""
        level, _ = self._level(qd)
        return self.viscous * qd + level * jnp.tanh(qd / EPSILON)

    def settled(self, qd):
        """As far as the friction of that speed bends them."""
        level, _ = self._level(qd)
        return level / self._stiffness * jnp.sign(qd)

    def over_step(self, qd, expected, z, step):
        """Bristles bend with the speed at the step's end and yield at the rate of the expected."""
        level, fading = self._level(expected)
        kept = 1.0 / (1.0 + step * self._stiffness * jnp.abs(expected) / level)
        damping = self.damping_time * self._stiffness * fading
        bent = (self._stiffness + damping / step) * kept
        return StepFriction(
            force=bent * z - damping / step * z + 0.5 * self.viscous * qd,
            slope=bent * step + 0.5 * self.viscous,
            deflection=kept * z,
            rate=kept * step,
        )

    def scaled(self, viscous, dry):
        """Bristles let go at the same deflection."""
        return dataclasses.replace(
            self,
            viscous=self.viscous * viscous,
            coulomb=self.coulomb * dry,
            breakaway=self.breakaway * dry,
        )

"""How a motor moves its joint: rigidly, through an elastic gear, or through one with play."""

from abc import abstractmethod
from typing import NamedTuple

import jax.numpy as jnp

from jaxid.arrays import AnyArray, Float, Hashable

Joints = Float[AnyArray, " joints"]


class Shafts(NamedTuple):
    """Both ends of the gears at the start of a step, on the joints' side.

    Attributes:
        twist: Angle of the motor less that of the joint [rad or m].
        rate: Of the twist [rad/s or m/s].
    """

    twist: Joints
    rate: Joints


class Balance(NamedTuple):
    r"""Momentum of the motors over a step: $a \dot\theta^+ = b - \tau$.

    Attributes:
        inertia: $a$, rotors and friction [N m s/rad or N s/m].
        drive: $b$, torques and momentum at the step's start [N m or N].
    """

    inertia: Joints
    drive: Joints


class Transmission(NamedTuple):
    r"""What a joint feels: $\tau = f - c\,\dot q^+$, while its motor turns at $w + s\,\dot q^+$.

    Attributes:
        force: $f$ [N m or N].
        slope: $c$ [N m s/rad or N s/m].
        speed: $w$ [rad/s or m/s].
        share: $s$ [1].
    """

    force: Joints
    slope: Joints
    speed: Joints
    share: Joints


class AbstractGear(Hashable):
    """What stands between a motor and its joint. Numbers are on the joint's side."""

    @abstractmethod
    def transmit(self, shafts: Shafts, motors: Balance, step: float) -> Transmission:
        """The torque over the next step, affine in the joint's speed at its end.

        Args:
            shafts: Both ends at the step's start.
            motors: Momentum of the motors.
            step: Length of the step [s].
        """

    @abstractmethod
    def twist(self, forces: Joints) -> Joints:
        """How far the gears are wound up by forces that last [rad or m].

        Args:
            forces: On the joints [N m or N].
        """


class RigidGear(AbstractGear):
    """Motor and joint move as one."""

    def transmit(self, shafts, motors, step):
        """What the motor has left."""
        none = 0.0 * motors.drive
        return Transmission(motors.drive, motors.inertia, none, none + 1.0)

    def twist(self, forces):
        """None."""
        return 0.0 * forces


class FlexibleGear(AbstractGear):
    """A spring with a damper between motor and joint (Spong, 1987).

    Attributes:
        stiffness: [N m/rad or N/m].
        damping: [N m s/rad or N s/m].
    """

    stiffness: Joints
    damping: Joints

    def transmit(self, shafts, motors, step):
        """The mean of the spring's force at both ends of the step: nothing is damped by it."""
        slope = 0.25 * step * self.stiffness + 0.5 * self.damping
        return elastic(self.stiffness * shafts.twist + slope * shafts.rate, slope, motors)

    def twist(self, forces):
        """In proportion to the force."""
        return forces / self.stiffness


class BacklashGear(AbstractGear):
    """A spring with a damper that is felt only where the play is used up.

    Attributes:
        stiffness: [N m/rad or N/m].
        damping: While the flanks touch [N m s/rad or N s/m].
        play: From flank to flank [rad or m].
    """

    stiffness: Joints
    damping: Joints
    play: Joints

    def transmit(self, shafts, motors, step):
        """That of a spring on one of the flanks, or nothing between them."""
        ahead = shafts.twist + 0.5 * step * shafts.rate
        half = 0.5 * self.play
        squeezed = shafts.twist - jnp.sign(ahead) * half
        slope = 0.25 * step * self.stiffness + 0.5 * self.damping
        touches = jnp.abs(ahead) > half
        force = self.stiffness * squeezed + slope * shafts.rate
        none = jnp.zeros_like(force)
        return elastic(jnp.where(touches, force, none), jnp.where(touches, slope, none), motors)

    def twist(self, forces):
        """Beyond the play, in proportion to the force."""
        return forces / self.stiffness + 0.5 * self.play * jnp.sign(forces)


def elastic(force: Joints, slope: Joints, motors: Balance) -> Transmission:
    r"""Eliminates the motor's speed: $\tau = f + c (\dot\theta^+ - \dot q^+)$.

    Args:
        force: $f$ [N m or N].
        slope: $c$ [N m s/rad or N s/m].
        motors: Momentum of the motors.
    """
    speed = (motors.drive - force) / (motors.inertia + slope)
    share = slope / (motors.inertia + slope)
    return Transmission(force + slope * speed, slope * (1.0 - share), speed, share)

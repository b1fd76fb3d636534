"""Forces that a model of bodies, friction and rotors does not know."""

from abc import abstractmethod

import jax.numpy as jnp

from jaxid.arrays import AnyArray, Float, Hashable
from jaxid.robot.robot import Robot

Joints = Float[AnyArray, " joints"]


class AbstractDisturbance(Hashable):
    """A force beside those of the drives; it is not in the measured torques."""

    @abstractmethod
    def forces(self, robot: Robot, q: Joints, qd: Joints) -> Joints:
        """What drives the joints [N m or N].

        Args:
            robot: With its gears.
            q: Of the motors, on the joints' side [rad or m].
            qd: Their speeds [rad/s or m/s].
        """


class TorqueRipple(AbstractDisturbance):
    """A wave of the motors' torques along their angle: cogging, and errors of the commutation.

    Attributes:
        amplitude: On the joints' side [N m or N].
        waves: In one turn of the motor.
        phase: At the motor's zero [rad].
    """

    amplitude: Float[AnyArray, " joints"]
    waves: Float[AnyArray, " joints"]
    phase: Float[AnyArray, " joints"]

    def forces(self, robot, q, qd):
        """A sine of the motor's angle."""
        return self.amplitude * jnp.sin(self.waves * robot.drives.motor_angles(q) + self.phase)


class CableForce(AbstractDisturbance):
    """Cables along the arm, or a cable chain: a soft spring that also rubs.

    Attributes:
        stiffness: [N m/rad or N/m].
        rest: Where the cables do not pull [rad or m].
        rubbing: Friction of the cables [N m or N].
        speed: At which their friction has its full size [rad/s or m/s].
    """

    stiffness: Float[AnyArray, " joints"]
    rest: Float[AnyArray, " joints"]
    rubbing: Float[AnyArray, " joints"]
    speed: float = 0.02

    def forces(self, robot, q, qd):
        """Against the deflection and against the motion."""
        return self.stiffness * (self.rest - q) - self.rubbing * jnp.tanh(qd / self.speed)

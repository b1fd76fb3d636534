"""A virtual robot: bodies that could exist, friction beyond the model, sensors with noise."""

import equinox as eqx
import numpy as np
from scipy import signal

from jaxid.dynamics.machine import in_numpy
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot
from jaxid.trajectory.trajectory import AbstractTrajectory
from jaxid.types import AnyArray, Float, require_float64

GRAINS = 12
"""Point masses of a random body: enough to fill all directions."""
PIECE = 4000
"""Samples that are evaluated at once: so few need no compiling."""


def random_bodies(
    robot: Robot,
    masses: Float[AnyArray, " joints"],
    random: np.random.Generator,
    radius: float = 0.05,
) -> Float[np.ndarray, "joints 10"]:
    """Draws inertial parameters that belong to bodies: clouds of points along the links.

    A cloud reaches from the origin of the body's frame to the next joint, or to the end-effector.
    What is made of masses at points has a possible inertia, whatever the points are.

    Args:
        robot: Whose links they are.
        masses: Of the bodies [kg].
        random: Source of the points.
        radius: Standard deviation of the points about the link's line [m].
    """
    bodies = np.empty((robot.joints, 10))
    for i, mass in enumerate(np.asarray(masses)):
        children = [c for c, parent in enumerate(robot.parent) if parent == i]
        end = robot.offset[children[0]] if children else robot.tip_offset
        along = random.uniform(0.0, 1.0, (GRAINS, 1))
        r = along * np.asarray(end) + radius * random.standard_normal((GRAINS, 3))
        m = random.dirichlet(np.full(GRAINS, 3.0)) * mass
        J = np.einsum("k,kij->ij", m, np.einsum("kl,kl->k", r, r)[:, None, None] * np.eye(3))
        J -= np.einsum("k,ki,kj->ij", m, r, r)
        bodies[i] = [mass, *(m @ r), *np.diag(J), -J[1, 2], -J[0, 2], -J[0, 1]]
    return bodies


class VirtualRobot(eqx.Module):
    """A robot whose parameters are known, with what no measurement is free of.

    Attributes:
        model: Its equations of motion.
        parameters: Its standard parameters.
        stribeck: Friction near standstill that the model lacks [N m or N].
        stribeck_speed: Speed at which it has faded to a third [rad/s or m/s].
        encoder_step: Resolution of the angles [rad or m].
        white_noise: Standard deviation of the forces' noise without memory [N m or N].
        coloured_noise: Standard deviation of the forces' noise with memory [N m or N].
        memory: Time constant of the coloured noise [s].
    """

    model: Model
    parameters: Float[AnyArray, " standard"]
    stribeck: Float[AnyArray, " joints"]
    stribeck_speed: float
    encoder_step: float
    white_noise: Float[AnyArray, " joints"]
    coloured_noise: Float[AnyArray, " joints"]
    memory: float

    def forces(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        """The forces that a motion truly needs [N m or N]."""
        qd = np.asarray(motion.qd)
        fading = np.exp(-((qd / self.stribeck_speed) ** 2)) * np.tanh(
            4.0 * qd / self.stribeck_speed
        )
        modelled = in_numpy(
            self.model,
            self.model.forces,
            motion.q,
            motion.qd,
            motion.qdd,
            shared=(self.parameters,),
        )
        return modelled + fading * np.asarray(self.stribeck)

    def measure(
        self,
        trajectory: AbstractTrajectory,
        *,
        duration: float,
        sample_time: float,
        seed: int,
        name: str = "virtual",
    ) -> Recording:
        """Moves along a trajectory and records angles and forces as sensors give them.

        Args:
            trajectory: What is followed, without error.
            duration: Of the recording [s].
            sample_time: Time between two samples [s].
            seed: Of the noise.
            name: Of the recording.

        Raises:
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("a virtual measurement")
        random = np.random.default_rng(seed)
        motion = trajectory.motion(sample_time * np.arange(round(duration / sample_time)))
        forces = self.forces(motion)
        white, drive = random.standard_normal((2, *forces.shape))
        kept = np.exp(-sample_time / self.memory)
        warm = random.standard_normal((1, forces.shape[1]))
        coloured, _ = signal.lfilter(
            [np.sqrt(1.0 - kept**2)], [1.0, -kept], drive, axis=0, zi=kept * warm
        )
        return Recording.of(
            self.encoder_step * np.round(np.asarray(motion.q) / self.encoder_step),
            forces
            + white * np.asarray(self.white_noise)
            + coloured * np.asarray(self.coloured_noise),
            sample_time=sample_time,
            name=name,
        )
